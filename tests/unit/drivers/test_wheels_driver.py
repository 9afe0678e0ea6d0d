"""The driver of wheels on a CAN bus against the emulated encoders, and against impossible data."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import itertools
import math
import random
import re
import socket
import time
import tracemalloc
from collections.abc import Callable

import pytest
from support_vehicle_bus import (
    DBC,
    METERS_PER_COUNT,
    START_UTIME,
    Wire,
    at,
    raptor_dbc,
    rolling_samples,
    wheel,
    wheels_settings,
)

from benchmarks.rough_simulation import make_noise_free_wheels
from modelserver import load_model
from modelserver.earth.geodesy import origin_at
from modelserver.errors import ConfigError
from modelserver.messages import Direction, WheelsSample
from modelserver.simulation import Simulation, Timing, Trajectory, figure_eight
from msdrivers.devices.can import SignalMap, parse_dbc
from msdrivers.devices.wheels import CountMap, DirectionMap, SpeedMap, WheelMap, WheelsDriver, WheelsSettings
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.vehicle import WheelsEmulator
from msdrivers.endpoint import CanFrame, EndpointPhase, EndpointStatus, MeasuredSample, Reopen, Send
from msdrivers.links.can_bus import CanLink

BOTH = ("front_left", "front_right")


def connect(
    seconds: float,
    speed: Callable[[float], float],
    *faults: InjectedFault,
    settings: WheelsSettings | None = None,
    first_count: int = 0,
    hz: float = 100.0,
) -> Wire[CanFrame]:
    database = raptor_dbc()
    settings = settings or wheels_settings()
    emulator = WheelsEmulator(settings.wheels, database, rolling_samples(seconds, speed, hz, BOTH), first_count)
    return Wire(WheelsDriver(settings, database), FaultInjector(lambda: emulator, faults))


def oscillate(t: float) -> float:
    """Forward, to a stop, backward, and so on."""
    return 3.0 * math.cos(t)


def wheels_of(wire: Wire[CanFrame], begin: float = 0.0) -> list[WheelsSample]:
    found = wire.values(begin)
    assert all(isinstance(each, WheelsSample) for each in found)
    return found  # type: ignore[return-value]


def test_given_wheels_at_100_hz_over_wraps_and_reversals_then_travel_and_speed_are_theirs() -> None:
    wire = connect(20.0, oscillate, first_count=65_500)
    wire.run(21.0)
    samples = wheels_of(wire)
    assert len(samples) == 2001
    assert [sample.header.seq for sample in samples] == list(range(2001))
    truths = list(rolling_samples(20.0, oscillate, 100.0, BOTH))
    for sample, truth in zip(samples, truths, strict=True):
        assert sample.header.host_utime == sample.header.utime == truth.header.utime + 1000
        assert sample.header.device_utime == 0
        for measured, true in zip(sample.wheels, truth.wheels, strict=True):
            assert measured.name == true.name
            assert measured.travel == pytest.approx(true.travel, abs=0.51 * METERS_PER_COUNT)
            assert measured.speed == pytest.approx(true.speed, abs=0.00051)
            assert measured.direction is true.direction
            assert math.isnan(measured.steering)
    assert min(sample.wheels[0].travel for sample in samples) < 0.0 < max(sample.wheels[0].travel for sample in samples)
    assert wire.host.counts["samples"] == 2001
    assert not [key for key, value in wire.host.counts.items() if key.startswith("rejected") and value]


def test_given_the_settings_then_the_sigmas_and_the_delay_are_reported() -> None:
    wire = connect(0.1, oscillate, settings=wheels_settings(delay=0.005, delay_sigma=0.002)).run(0.2)
    measured = wire.samples[5][1]
    assert (measured.delay, measured.delay_sigma) == (0.005, 0.002)
    (left, _) = wheels_of(wire)[5].wheels
    assert left.travel_sigma == pytest.approx(METERS_PER_COUNT / math.sqrt(12.0))
    assert left.speed_sigma == 0.05


@pytest.mark.slow
def test_given_a_counter_that_wraps_several_times_then_the_way_is_whole() -> None:
    wire = connect(200.0, lambda t: 5.0, hz=20.0, first_count=60_000)
    wire.run(201.0)
    assert wheels_of(wire)[-1].wheels[0].travel == pytest.approx(1000.0, abs=0.02)


def test_given_lost_frames_then_what_was_not_received_is_not_published_and_travel_goes_on() -> None:
    # of the pair of an instant the first, counts and directions, is lost three times
    drops = [InjectedFault(2.0 + 0.1 * n, "drop") for n in range(3)]
    wire = connect(6.0, lambda t: 2.0, *drops).run(6.5)
    samples = wheels_of(wire)
    assert wire.host.counts["incomplete"] == 3
    assert len(samples) == 601 - 3
    assert samples[-1].wheels[0].travel == pytest.approx(12.0, abs=0.02)
    assert wire.host.counts.get("rejected.jump", 0) == 0


def test_given_only_the_frame_of_counts_then_speed_is_nan_and_not_the_last_one() -> None:
    wire = connect(2.0, lambda t: 2.0)
    wire.corrupt = lambda frame, t: [] if frame.arbitration_id == 0x101 and 1.0 < t < 1.5 else [frame]
    wire.run(2.5)
    without = [sample for sample in wheels_of(wire) if math.isnan(sample.wheels[0].speed)]
    assert 49 <= len(without) <= 51
    assert all(math.isfinite(each.wheels[0].travel) for each in without)
    # half an instant waits for the other half, but not for the next instant
    assert all(each.header.utime % 10_000 == 1000 for each in without)


@pytest.mark.parametrize("jump", [40_000.0, -200.0, 3000.0])
def test_given_counters_that_jump_as_no_wheel_can_then_one_sample_has_no_travel(jump: float) -> None:
    wire = connect(6.0, lambda t: 1.0, InjectedFault(3.005, "jump", jump)).run(6.5)
    samples = wheels_of(wire)
    without = [sample for sample in samples if math.isnan(sample.wheels[0].travel)]
    assert [round((each.header.utime - START_UTIME) * 1e-6, 3) for each in without] == [3.011]
    assert without[0].wheels[0].speed == pytest.approx(1.0)
    # without the 1 cm that was rolled unseen
    assert samples[-1].wheels[0].travel == pytest.approx(6.0, abs=0.04)
    assert (wire.host.counts["rejected.jump"], wire.host.counts["resumed"]) == (2, 2)
    assert "no wheel of at most 8 m/s can have reached" in wire.status_text()


def test_given_a_controller_that_restarts_then_travel_goes_on_from_where_it_was() -> None:
    wire = connect(6.0, lambda t: 1.0, InjectedFault(3.0, "restart", 0.3), first_count=20_000).run(6.5)
    travels = [sample.wheels[0].travel for sample in wheels_of(wire) if math.isfinite(sample.wheels[0].travel)]
    steps = [after - before for before, after in itertools.pairwise(travels)]
    assert max(map(abs, steps)) < 0.03
    assert travels[-1] == pytest.approx(6.0 - 0.31, abs=0.04)


def test_given_bus_off_then_it_is_reported_once_and_the_line_is_reopened() -> None:
    wire = connect(4.0, oscillate, InjectedFault(2.0, "bus_off", 0.5)).run(4.5)
    assert [reopen.reason for _, reopen in wire.reopens] == ["the CAN interface went bus-off: too many frames failed"]
    (silent,) = [status for _, status in wire.statuses if status.phase is EndpointPhase.SILENT]
    assert "terminators" in silent.text
    between = [t for t, _ in wire.samples if 2.01 < t < 2.5]
    assert between == []
    assert wire.samples[-1][0] > 4.0
    assert wire.statuses[-1][1].phase is EndpointPhase.STREAMING


def test_given_an_interface_that_reports_bus_off_again_and_again_then_the_line_is_opened_once() -> None:
    driver = WheelsDriver(wheels_settings(), raptor_dbc())
    driver.on_open(at(0.0))
    outputs = [output for n in range(50) for output in driver.on_receive(CanFrame(0x40, is_error=True), at(0.01 * n))]
    assert sum(isinstance(output, Reopen) for output in outputs) == 1
    assert driver.counts["error_frames"] == 50


def test_given_silence_then_it_is_reported_once_and_nothing_is_published() -> None:
    wire = connect(9.0, oscillate, InjectedFault(2.0, "stall", 4.0)).run(9.5)
    silent = [(t, status.text) for t, status in wire.statuses if status.phase is EndpointPhase.SILENT]
    assert [round(t) for t, _ in silent] == [3]
    assert "nothing on the bus: check power, wiring" in silent[0][1]
    assert not [t for t, _ in wire.samples if 2.01 < t < 6.0]
    assert [status.phase for _, status in wire.statuses][-1] is EndpointPhase.STREAMING


def test_given_another_bus_then_what_is_on_it_is_reported() -> None:
    driver = WheelsDriver(wheels_settings(), raptor_dbc())
    driver.on_open(at(0.0))
    for number in range(1000):
        assert driver.on_receive(CanFrame(0x400 + number % 500, bytes(8)), at(0.0005 * number)) == []
    (status,) = driver.on_timer(at(1.0))
    assert isinstance(status, EndpointStatus)
    assert "received 1000 frames: others: 0x400, 0x401" in status.text
    assert len(status.text) < 300


def test_given_frames_of_a_wrong_length_then_they_are_reported_once_and_counted() -> None:
    wire = connect(5.0, oscillate)
    wire.corrupt = lambda frame, t: [dataclasses.replace(frame, data=frame.data + b"\0")] if t > 2.0 else [frame]
    wire.run(5.5)
    assert wire.status_text().count("has 9 bytes, raptor.dbc expects 8") == 1
    assert wire.host.counts["rejected.length"] > 500
    assert not [t for t, _ in wire.samples if t > 2.01]
    assert re.search(r"received \d+ frames: \d+ x WheelCounts \(0x100\) with 9 bytes instead of 8", wire.status_text())


def speeds_of(dbc: str, raw: bytes, number: int = 535) -> tuple[WheelsDriver, list[object]]:
    """Return the driver of two speeds, and what it has made of a hundred frames and seconds of silence."""
    maps = {side: WheelMap(speed=SpeedMap(f"Wheels.V_{side}")) for side in "LR"}
    driver = WheelsDriver(wheels_settings(wheels=maps), parse_dbc(dbc, "d.dbc"))
    found: list[object] = [*driver.on_open(at(0.0))]
    for n in range(100):
        found += driver.on_receive(CanFrame(number % (1 << 29), raw, number > 2047), at(0.01 * n))
    return driver, [*found, *driver.on_timer(at(5.0))]


def make_dbc(signal: str, number: int = 535, more: str = "") -> str:
    two = "".join(f" SG_ V_{side} : {at}|16@1{signal} A\n" for side, at in (("L", 0), ("R", 16)))
    return f'VERSION ""\nNS_ :\nBS_:\nBU_: A\nBO_ {number} Wheels: 8 A\n{two}{more}\n'


@pytest.mark.parametrize(
    ("signal", "raw", "speed", "limits"),
    [
        ('+ (0.0087,0) [0|1] "m/s"', 230, 2.001, "[0|1]"),
        ('- (0.0625,0) [0|255] "m/s"', -16, -1.0, "[0|255]"),
        ('+ (0.01,-327.68) [0|65535] "m/s"', 32668, -1.0, "[0|65535]"),
        ('+ (0.01,0) [5|-5] "m/s"', 100, 1.0, "[5|-5]"),
    ],
)
def test_given_a_value_outside_the_range_of_the_file_then_it_is_used_and_warned_of_once(
    signal: str, raw: int, speed: float, limits: str
) -> None:
    data = (raw % 65536).to_bytes(2, "little") * 2 + bytes(4)
    driver, found = speeds_of(make_dbc(signal), data)
    samples = [each.sample for each in found if isinstance(each, MeasuredSample)]
    assert len(samples) == 100
    assert all(wheel.speed == pytest.approx(speed) for sample in samples for wheel in sample.wheels)
    warnings = [each.text for each in found if isinstance(each, EndpointStatus) and each.is_warning]
    assert len(warnings) == 2
    assert warnings[0].startswith(f"Wheels.V_L is {speed:g} m/s, outside its range {limits} in d.dbc")
    assert driver.counts["outside_range"] == 200


EXTENDED = 0x80000000 + 0x18FE0217
J1939 = (
    'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
    'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\nBA_ "VFrameFormat" BO_ {} 3;\n'
)


@pytest.mark.parametrize(
    ("number", "signal", "more", "raw", "name"),
    [
        (EXTENDED, '+ (0.001,0) [0|64.255] "m/s"', "", 0xFFFF, "not available in J1939"),
        (EXTENDED, '+ (0.001,0) [0|64.255] "m/s"', "", 0xFE12, "error in J1939"),
        (EXTENDED, '+ (0.0001,0) [0|0] "m/s"', J1939.format(EXTENDED), 0xFFFF, "not available in J1939"),
        (535, '- (0.0001,0) [0|0] "m/s"', 'VAL_ 535 V_L -32768 "SNA" ;\nVAL_ 535 V_R -32768 "Error" ;', -32768, "SNA"),
        (535, '+ (0.0001,0) [0|5] "m/s"', 'VAL_ 535 V_L 65535 "off" ;\nVAL_ 535 V_R 65535 "off" ;', 65535, "off"),
    ],
)
def test_given_a_value_that_stands_for_none_then_it_is_missing_and_the_silence_is_explained(
    number: int, signal: str, more: str, raw: int, name: str
) -> None:
    data = (raw % 65536).to_bytes(2, "little") * 2 + bytes(4)
    driver, found = speeds_of(make_dbc(signal, number, more), data, number)
    assert not [each for each in found if isinstance(each, MeasuredSample)]
    texts = [each.text for each in found if isinstance(each, EndpointStatus)]
    assert sum(name in text and "that is no measurement" in text for text in texts) in (1, 2)
    assert "received 100 frames: 100 x no value that can be used" in texts[-1]
    assert name in texts[-1]
    assert "check power" not in texts[-1]
    assert driver.counts["rejected.reserved"] == 200


def test_given_a_standard_frame_whose_highest_values_are_within_the_range_then_they_are_values() -> None:
    _, found = speeds_of(make_dbc('+ (0.0001,0) [0|0] "m/s"'), b"\xff\xff" * 2 + bytes(4))
    samples = [each.sample for each in found if isinstance(each, MeasuredSample)]
    assert samples[0].wheels[0].speed == pytest.approx(6.5535)


def test_given_speeds_that_the_vehicle_cannot_have_then_they_are_not_published() -> None:
    wire = connect(1.0, lambda t: 12.0, settings=wheels_settings(frame_delay=10.0)).run(1.5)
    assert all(math.isnan(sample.wheels[0].speed) for sample in wheels_of(wire))
    assert wire.host.counts["rejected.speed"] == 202


def test_given_a_dbc_of_another_vehicle_then_every_missing_signal_is_reported() -> None:
    other = parse_dbc('BO_ 5 WheelCount: 8 A\n SG_ FrontLeftCounts : 0|16@1+ (1,0) [0|0] "" A\n', "other.dbc")
    with pytest.raises(ConfigError) as caught:
        WheelsDriver(wheels_settings(), other)
    assert len(caught.value.problems) == 6
    assert caught.value.problems[0].element == "drivers.wheels.wheels.front_left.count"
    assert caught.value.problems[0].message == "other.dbc: there is no message 'WheelCounts'"
    assert "nearest: WheelCount" in str(caught.value.problems[0])


def test_given_another_vehicle_then_a_mapping_is_enough() -> None:
    text = """BU_: A
BO_ 2566834688 Axle: 8 A
 SG_ Speed : 7|16@0- (0.01,0) [0|0] "km/h" A
 SG_ Ticks : 23|24@0- (1,0) [0|0] "" A
 SG_ Angle : 47|8@0- (0.5,0) [0|0] "deg" A
 SG_ Moving : 55|1@0+ (1,0) [0|0] "" A
"""
    database = parse_dbc(text, "tractor.dbc")
    maps = {
        "front_left": WheelMap(
            CountMap("Axle.Ticks", -0.002),
            SpeedMap("Axle.Speed", 1.0 / 3.6),
            None,
            True,
            SignalMap("Axle.Angle", -math.pi / 180.0),
        )
    }
    settings = wheels_settings(wheels=maps)
    emulator = WheelsEmulator(maps, database, rolling_samples(10.0, oscillate), first_count=(1 << 23) - 100)
    wire = Wire(WheelsDriver(settings, database), emulator).run(11.0)
    for sample, truth in zip(wheels_of(wire), rolling_samples(10.0, oscillate), strict=True):
        (measured,), (true,) = sample.wheels, truth.wheels
        assert measured.travel == pytest.approx(true.travel, abs=0.0011)
        assert measured.speed == pytest.approx(true.speed, abs=0.0015)
        assert measured.direction is Direction.UNKNOWN
        assert measured.steering == 0.0


@pytest.mark.slow
def test_given_pulses_without_sign_then_the_direction_gives_it() -> None:
    count = CountMap("WheelCounts.FrontLeftCount", METERS_PER_COUNT, wrap=1000, counts_up_only=True)
    settings = wheels_settings(wheels={"front_left": wheel("Left", count=count, is_steered=False)})
    wire = connect(20.0, oscillate, settings=settings).run(21.0)
    # at a reversal one pulse may be counted to the side before
    assert wheels_of(wire)[-1].wheels[0].travel == pytest.approx(3.0 * math.sin(20.0), abs=0.15)
    assert wheels_of(wire)[-1].wheels[0].steering == 0.0


def test_given_pulses_and_speeds_without_sign_or_direction_then_they_are_published_as_sizes() -> None:
    count = CountMap("WheelCounts.FrontLeftCount", METERS_PER_COUNT, wrap=1000, counts_up_only=True)
    size = SpeedMap("WheelSpeeds.FrontLeftSpeed", is_magnitude=True)
    settings = wheels_settings(wheels={"front_left": WheelMap(count, size, is_steered=True)})
    wire = connect(20.0, oscillate, settings=settings).run(21.0)
    wheels = [each.wheels[0] for each in wheels_of(wire)]
    assert {each.direction for each in wheels} == {Direction.UNSIGNED}
    assert all(b.travel >= a.travel for a, b in itertools.pairwise(wheels))
    assert min(each.speed for each in wheels) >= 0.0
    assert max(each.speed for each in wheels) > 2.5
    rolled = sum(abs(oscillate(0.001 * n)) for n in range(20_000)) * 0.001
    assert wheels[-1].travel == pytest.approx(rolled, abs=0.5)


def test_given_the_line_reopened_then_half_an_instant_from_before_is_not_joined() -> None:
    database = raptor_dbc()
    driver = WheelsDriver(wheels_settings(), database)
    driver.on_open(at(0.0))
    counts = CanFrame(0x100, bytes(8))
    speeds = CanFrame(0x101, bytes(4))
    assert driver.on_receive(counts, at(0.1)) == []
    driver.on_open(at(0.101))
    assert driver.on_receive(speeds, at(0.102)) == []
    (status, measured) = driver.on_receive(counts, at(0.103))
    assert isinstance(status, EndpointStatus)
    assert isinstance(measured, MeasuredSample)
    assert measured.sample.header.utime == START_UTIME + 102_000


def test_given_a_wheels_driver_then_it_never_sends() -> None:
    wire = connect(1.0, oscillate).run(1.5)
    assert wire.sent == []
    assert wire.host.on_close(at(2.0)) == []


@pytest.mark.slow
def test_given_random_frames_then_nothing_is_raised_and_memory_stays_flat() -> None:
    rng = random.Random(7)
    driver = WheelsDriver(wheels_settings(), raptor_dbc())
    driver.on_open(at(0.0))

    def flood(begin: int, frames: int) -> None:
        for n in range(begin, begin + frames):
            identifier = rng.choice((0x100, 0x101, 0x200, rng.randrange(0x800)))
            length = rng.choice((4, 8, 8, rng.randrange(65)))
            frame = CanFrame(identifier, rng.randbytes(length), rng.random() < 0.1, rng.random() < 0.01)
            outputs = driver.on_receive(frame, at(0.0003 * n)) + driver.on_timer(at(0.0003 * n + 0.0001))
            assert not any(isinstance(output, Send) for output in outputs)
            for output in outputs:
                if isinstance(output, MeasuredSample):
                    assert isinstance(output.sample, WheelsSample)
                    assert all(not abs(each.speed) > 8.0 for each in output.sample.wheels)

    flood(0, 2_000)
    tracemalloc.start()
    try:
        flood(2_000, 1_000)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        flood(3_000, 5_000)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 20_000
    assert len(driver.counts) < 30


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"dbc": ""}, "dbc is the path"),
        ({"wheels": {}}, "wheels has 1 to 64"),
        ({"wheels": {"": wheel("Left")}}, "wheels names wheels"),
        ({"max_speed": 0.0}, "max_speed is between"),
        ({"max_speed": math.nan}, "max_speed is between"),
        ({"frame_delay": -1.0}, "frame_delay is between"),
        ({"window": 2.0}, "window is between"),
        ({"silence": 0.0}, "silence is between"),
        ({"delay": 6.0}, "delay is between"),
        ({"delay_sigma": -0.1}, "delay_sigma is between"),
    ],
)
def test_given_settings_that_cannot_be_then_the_key_is_named(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        wheels_settings(**changes)


def test_given_a_direction_that_the_mapping_does_not_have_then_it_is_unknown() -> None:
    direction = DirectionMap("WheelCounts.FrontLeftDirection", 0, 1, 3)
    settings = wheels_settings(wheels={"front_left": wheel("Left", direction=direction)})
    wire = connect(0.5, lambda t: -1.0).run(0.1)
    driver = WheelsDriver(settings, raptor_dbc())
    driver.on_open(at(0.0))
    found = [output for _, frame in wire.to_host for output in driver.on_receive(frame, at(0.2))]
    found += [
        output
        for frame in (CanFrame(0x100, bytes((1, 0, 0, 0, 2, 0, 0, 0))), CanFrame(0x101, bytes((232, 3, 0, 0))))
        for output in driver.on_receive(frame, at(0.3))
    ]
    measured = next(output for output in found if isinstance(output, MeasuredSample))
    assert isinstance(measured.sample, WheelsSample)
    assert measured.sample.wheels[0].direction is Direction.UNKNOWN
    assert math.isnan(measured.sample.wheels[0].speed)


@pytest.mark.slow
def test_given_a_simulated_raptor_that_turns_and_backs_up_then_its_wheels_come_over_the_bus() -> None:
    settings = wheels_settings()
    drive = Trajectory(figure_eight(speed=3.0, radius=6.0, stationary=2.0, stop=1.0, reverse=3.0))
    run = Simulation(
        load_model(DBC.with_name("geometry.yaml")),
        "Raptor:CG",
        drive,
        origin_at(50.27, -111.18, 700.0),
        rolling_frame="Raptor:RearAxleCenter",
        wheel_frames={name: f"Raptor:{name.title().replace('_', '')}WheelContact" for name in BOTH},
        wheels_model=make_noise_free_wheels(Timing(100.0), frozenset(BOTH)),
    )
    truths = [sample for sample in run.events(40.0) if isinstance(sample, WheelsSample)]
    wire = Wire(
        WheelsDriver(settings, raptor_dbc()), WheelsEmulator(settings.wheels, raptor_dbc(), truths, 65_000)
    ).run(40.5)
    samples = wheels_of(wire)
    assert len(samples) == len(truths)
    for sample, truth in zip(samples, truths, strict=True):
        for measured, true in zip(sample.wheels, truth.wheels, strict=True):
            assert measured.travel == pytest.approx(true.travel, abs=0.51 * METERS_PER_COUNT)
            assert measured.direction is true.direction
            # below 2 cm/s the direction is `stopped`, and a speed without sign has none
            assert measured.speed == pytest.approx(true.speed, abs=0.00051) or abs(true.speed) <= 0.02
    assert min(wheel.speed for sample in samples for wheel in sample.wheels) < -0.5


# --- J1939 ------------------------------------------------------------------------------------------------------

NULL_SOURCE = 0x18FEBFFE
"""PGN 65215 (EBC2) from the null address, as files have it."""
J1939_FILE = 'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "";\nBA_ "ProtocolType" "J1939";'
SPEED_SIGNAL = '+ (0.001,0) [0|64.255] "m/s"'


def j1939_driver(dbc: str, message: str = "Wheels", **changes: object) -> WheelsDriver:
    maps = {side: WheelMap(speed=SpeedMap(f"{message}.V_{side}")) for side in "LR"}
    return WheelsDriver(wheels_settings(wheels=maps, **changes), parse_dbc(dbc, "d.dbc"))


def j1939_file(more: str = J1939_FILE) -> str:
    return make_dbc(SPEED_SIGNAL, 0x80000000 + NULL_SOURCE, more)


def j1939_frame(number: int, millimeters: int = 2000) -> CanFrame:
    return CanFrame(number, millimeters.to_bytes(2, "little") * 2 + b"\xff" * 4, is_extended=True)


def speeds(outputs: list[object]) -> list[float]:
    return [each.sample.wheels[0].speed for each in outputs if isinstance(each, MeasuredSample)]  # type: ignore[union-attr]


@pytest.mark.parametrize("number", [NULL_SOURCE, 0x18FEBF0B, 0x0CFEBF0B, 0x1CFEBF31])
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (J1939_FILE, "Wheels"),
        (J1939.format(0x80000000 + NULL_SOURCE), "Wheels"),
        (J1939_FILE, "65215"),
        ("", "0xFEBF"),
    ],
)
def test_given_another_priority_or_source_address_then_a_j1939_message_is_matched_by_its_pgn(
    number: int, more: str, message: str
) -> None:
    driver = j1939_driver(j1939_file(more), message)
    (status,) = driver.on_open(at(0.0))
    assert status.text == "waiting for Wheels (PGN 65215)"  # type: ignore[union-attr]
    assert speeds(list(driver.on_receive(j1939_frame(number), at(0.1)))) == [2.0]
    assert speeds(list(driver.on_receive(j1939_frame(number ^ 0x100), at(0.2)))) == []


def test_given_a_file_of_no_stated_protocol_then_the_identifier_is_exact_unless_a_source_is_stated() -> None:
    driver = j1939_driver(j1939_file(""))
    driver.on_open(at(0.0))
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF0B), at(0.1)))) == []
    assert speeds(list(driver.on_receive(j1939_frame(NULL_SOURCE), at(0.1)))) == [2.0]
    driver = j1939_driver(j1939_file(""), source_address={"Wheels": 0x0B})
    (status,) = driver.on_open(at(0.0))
    assert status.text == "waiting for Wheels (PGN 65215 from 0x0B)"  # type: ignore[union-attr]
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF31), at(0.1)))) == []
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF0B), at(0.1)))) == [2.0]


def test_given_two_sources_of_a_pgn_then_one_is_used_and_the_warning_has_the_setting() -> None:
    driver = j1939_driver(j1939_file())
    driver.on_open(at(0.0))
    found: list[object] = []
    for n in range(20):
        found += driver.on_receive(j1939_frame(0x18FEBF0B, 2000), at(0.1 * n))
        found += driver.on_receive(j1939_frame(0x18FEBF31, 3000), at(0.1 * n + 0.05))
    assert speeds(found) == [2.0] * 20
    (warning,) = [each.text for each in found if isinstance(each, EndpointStatus) and each.is_warning]
    assert warning == (
        "source addresses 0x0B and 0x31 send PGN 65215 (Wheels); that of 0x0B is used; state it: "
        "source_address: {Wheels: 0x0B}"
    )
    # the other continues when the first is silent
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF31, 3000), at(4.0)))) == [3.0]


def test_given_a_source_in_the_file_then_it_takes_precedence_over_the_first() -> None:
    driver = j1939_driver(make_dbc(SPEED_SIGNAL, 0x80000000 + 0x18FEBF0B, J1939_FILE))
    driver.on_open(at(0.0))
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF31, 3000), at(0.1)))) == [3.0]
    found = list(driver.on_receive(j1939_frame(0x18FEBF0B), at(0.15)))
    assert speeds(list(found)) == [2.0]
    assert "that of 0x0B is used" in found[0].text  # type: ignore[union-attr]
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF31, 3000), at(0.2)))) == []


def test_given_a_file_with_several_messages_of_a_pgn_then_its_identifiers_or_stated_sources_count() -> None:
    second = f"BO_ {0x80000000 + 0x18FEBF31} Rear: 8 A\n SG_ V_L : 0|16@1{SPEED_SIGNAL} A\n"
    dbc = make_dbc(SPEED_SIGNAL, 0x80000000 + 0x18FEBF0B, second + J1939_FILE)
    driver = j1939_driver(dbc)
    driver.on_open(at(0.0))
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF31), at(0.1)))) == []
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF0B), at(0.1)))) == [2.0]
    with pytest.raises(ConfigError, match=r"2 messages have PGN 65215 \(0xFEBF\); one is needed"):
        j1939_driver(dbc, "65215")


def test_given_a_j1939_message_shorter_than_its_frames_then_the_padding_is_left_out() -> None:
    driver = j1939_driver(j1939_file().replace("Wheels: 8", "Wheels: 4"))
    driver.on_open(at(0.0))
    assert speeds(list(driver.on_receive(j1939_frame(0x18FEBF0B), at(0.1)))) == [2.0]


@pytest.mark.parametrize(
    ("dbc", "message", "source_address", "expected"),
    [
        (
            j1939_file().replace("Wheels: 8", "Wheels: 20"),
            "Wheels",
            {},
            "20 bytes, which J1939 sends in several",
        ),
        (j1939_file(), "65216", {}, "0 messages have PGN 65216"),
        (j1939_file(), "Wheels", {"Wheel": 11}, "no signal of message 'Wheel' is mapped"),
        (make_dbc(SPEED_SIGNAL), "Wheels", {"Wheels": 11}, "message Wheels has the identifier 0x217"),
    ],
)
def test_given_j1939_settings_that_cannot_be_then_the_problem_is_named(
    dbc: str, message: str, source_address: dict[str, int], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        j1939_driver(dbc, message, source_address=source_address)


def test_given_a_source_address_that_cannot_be_then_the_key_is_named() -> None:
    with pytest.raises(ValueError, match=r"source_address of 'Wheels' is 0 to 253 \(0xFD\), got 254"):
        wheels_settings(source_address={"Wheels": 254})


def test_given_a_j1939_bus_over_udp_then_frames_of_another_source_make_samples() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        group = f"239.74.163.2:{probe.getsockname()[1]}"
    one, two = CanLink(group, "udp_multicast"), CanLink(group, "udp_multicast")
    driver = j1939_driver(j1939_file())
    with contextlib.ExitStack() as stack:
        for link in (one, two):
            link.open()
            stack.callback(link.close)
        driver.on_open(at(0.0))
        one.send(j1939_frame(0x0CFEBF0B))
        found: list[object] = []
        deadline = time.monotonic() + 10.0
        while not speeds(found) and time.monotonic() < deadline:
            for frame in two.poll(0.1):
                found += driver.on_receive(frame, at(0.1))
    assert speeds(found) == [2.0]
