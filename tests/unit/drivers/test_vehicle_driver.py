"""The driver of the vehicle controller against the emulated one: status out, commands in, limits, the dead-man."""

from __future__ import annotations

import dataclasses
import gc
import math
import random
import tracemalloc

import pytest
from support_vehicle_bus import (
    DBC,
    DEG,
    RAPTOR_COMMAND,
    RAPTOR_STATUS,
    START_UTIME,
    Wire,
    at,
    raptor_dbc,
    vehicle_settings,
)

from modelserver.errors import ConfigError
from modelserver.messages import SensorHeader, VehicleCommand, VehicleMode, VehicleStatusSample
from msdrivers.devices.can import SignalMap
from msdrivers.devices.vehicle import CommandLimits, CommandMap, StatusMap, VehicleDriver, VehicleSettings
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.vehicle import VehicleEmulator
from msdrivers.endpoint import CanFrame, EndpointPhase, EndpointStatus, MeasuredSample, Send

DATABASE = raptor_dbc()


def connect(
    *faults: InjectedFault, settings: VehicleSettings | None = None
) -> tuple[Wire[CanFrame], VehicleDriver, VehicleEmulator]:
    driver = VehicleDriver(settings or vehicle_settings(), DATABASE)
    emulator = VehicleEmulator(DATABASE, RAPTOR_STATUS, RAPTOR_COMMAND)
    return Wire(driver, FaultInjector(lambda: emulator, faults)), driver, emulator


def make_command(
    t: float, seq: int, speed: float = 2.0, angle: float = 0.2, valid_for: float = 0.3, source: str = "arbitrator"
) -> VehicleCommand:
    return VehicleCommand(START_UTIME + round(t * 1e6), valid_for, seq, source, speed, angle)


def drive(wire: Wire[CanFrame], driver: VehicleDriver, until: float, speed: float = 2.0, angle: float = 0.2) -> None:
    """Command ten times a second."""
    wire.run(wire.t)
    seq = round(wire.t * 1000)
    while wire.t < until - 1e-9:
        command = make_command(wire.t, seq, speed, angle)
        wire.send_command(lambda now, command=command: driver.on_command(command, now))  # type: ignore[misc]
        seq += 1
        wire.run(min(until, wire.t + 0.1))


def decode_frame(frame: CanFrame) -> dict[str, float]:
    return DATABASE.decode(frame)


def statuses(wire: Wire[CanFrame], begin: float = 0.0) -> list[VehicleStatusSample]:
    found = wire.values(begin)
    assert all(isinstance(each, VehicleStatusSample) for each in found)
    return found  # type: ignore[return-value]


# --- status ----------------------------------------------------------------------------------------------------


def test_given_a_controller_then_its_status_is_published_as_sent() -> None:
    wire, driver, emulator = connect()
    emulator.fault_bits, emulator.steering = 0x8001, 0.1
    wire.run(2.0)
    samples = statuses(wire)
    assert len(samples) == 40
    assert [each.header.seq for each in samples] == list(range(40))
    last = samples[-1]
    assert last.mode is VehicleMode.AUTONOMOUS
    assert last.forward_speed == 0.0
    assert last.steering_angle == pytest.approx(0.1, abs=0.006 * DEG)
    assert last.supply_voltage == pytest.approx(13.8)
    assert last.engine_speed == pytest.approx(150.0, abs=0.02)
    assert (last.fault_bits, last.commands_rejected) == (0x8001, 0)
    assert last.header.source == "raptor"
    assert driver.counts["samples"] == 40


def test_given_the_message_of_voltages_lost_then_they_are_nan_and_the_rest_is_published() -> None:
    wire, _, _ = connect()
    wire.corrupt = lambda frame, t: [] if frame.arbitration_id == 0x201 else [frame]
    wire.run(1.0)
    assert len(statuses(wire)) == 20
    assert all(math.isnan(each.supply_voltage) and math.isnan(each.engine_speed) for each in statuses(wire))
    assert all(each.mode is VehicleMode.AUTONOMOUS for each in statuses(wire))


def test_given_the_message_of_faults_lost_then_nothing_is_published() -> None:
    wire, driver, _ = connect()
    wire.corrupt = lambda frame, t: [] if frame.arbitration_id == 0x200 else [frame]
    wire.run(1.5)
    assert statuses(wire) == []
    assert driver.counts["rejected.incomplete"] >= 19
    assert "silent: no usable VehicleStatus (0x200)" in wire.status_text()


def test_given_a_fault_word_of_32_bits_then_the_highest_is_the_sign() -> None:
    text = 'BO_ 1 S: 8 A\n SG_ F : 0|32@1+ (1,0) [0|0] "" A\n SG_ M : 32|8@1+ (1,0) [0|0] "" A\n'
    from msdrivers.devices.can import parse_dbc

    settings = vehicle_settings(status=StatusMap("S.M", {"fault": 9}, fault_bits="S.F"), command=None)
    driver = VehicleDriver(settings, parse_dbc(text, "s.dbc"))
    driver.on_open(at(0.0))
    (_, measured) = driver.on_receive(CanFrame(1, bytes.fromhex("01000080 09 000000")), at(0.1))
    assert isinstance(measured, MeasuredSample)
    assert isinstance(measured.sample, VehicleStatusSample)
    assert measured.sample.fault_bits == 1 - (1 << 31)
    assert measured.sample.mode is VehicleMode.FAULT
    assert math.isnan(measured.sample.forward_speed)


def test_given_a_mode_that_changes_then_it_is_reported_with_what_it_means() -> None:
    wire, _, emulator = connect()
    wire.run(1.0)
    emulator.mode = VehicleMode.EMERGENCY_STOP
    wire.run(2.0)
    assert statuses(wire)[-1].mode is VehicleMode.EMERGENCY_STOP
    assert "emergency stop: commands have no effect until it is released" in wire.status_text()


def test_given_a_vehicle_that_is_driven_then_the_status_has_its_speed_and_its_steering_angle() -> None:
    driven = (
        VehicleStatusSample(
            SensorHeader(START_UTIME + n * 10_000), VehicleMode.MANUAL, -0.001 * n, 0.4 * math.sin(0.02 * n)
        )
        for n in range(1000)
    )
    emulator = VehicleEmulator(DATABASE, RAPTOR_STATUS, samples=driven)
    wire = Wire(VehicleDriver(vehicle_settings(command=None), DATABASE), emulator).run(9.9)
    assert len(statuses(wire)) > 190
    for sample in statuses(wire):
        t = (sample.header.utime - START_UTIME) * 1e-6
        assert sample.mode is VehicleMode.MANUAL
        assert sample.forward_speed == pytest.approx(-0.1 * t, abs=0.003)
        assert sample.steering_angle == pytest.approx(0.4 * math.sin(2.0 * t), abs=0.01)


# --- commands --------------------------------------------------------------------------------------------------


def test_given_commands_then_the_vehicle_drives_as_commanded() -> None:
    wire, driver, emulator = connect()
    wire.run(0.5)
    assert wire.sent == []
    drive(wire, driver, 4.0)
    assert emulator.speed == pytest.approx(2.0)
    assert emulator.steering == pytest.approx(0.2, abs=0.01 * DEG)
    assert statuses(wire)[-1].forward_speed == pytest.approx(2.0)
    periods = [b - a for (a, _), (b, _) in zip(wire.sent, wire.sent[1:], strict=False)]
    assert max(periods) < 0.0501
    alive = [decode_frame(frame)["Alive"] for _, frame in wire.sent]
    assert alive == [n % 256 for n in range(len(alive))]


def test_given_no_more_commands_then_stop_is_sent_when_the_last_ends_and_the_vehicle_stops() -> None:
    wire, driver, emulator = connect()
    drive(wire, driver, 3.0)
    last = max(t for t, frame in wire.sent if decode_frame(frame)["Enable"] == 1)
    wire.run(6.0)
    stops = [(t, decode_frame(frame)) for t, frame in wire.sent if decode_frame(frame)["Enable"] == 0]
    # the last command was given at 2.9 s and is valid for 0.3 s
    assert stops[0][0] == pytest.approx(3.2, abs=1e-6)
    assert max(t for t, frame in wire.sent if decode_frame(frame)["Enable"] == 1) <= max(last, 3.2)
    assert all(frame["ForwardSpeed"] == 0 for _, frame in stops)
    # the wheels stay where they were steered
    assert {frame["SteeringAngle"] for _, frame in stops} == {round(0.2 / DEG * 100)}
    assert emulator.speed == 0.0
    assert driver.counts["dead_man"] == 1
    assert "no command after number 29 of 'arbitrator': stop" in wire.status_text()


def test_given_a_command_valid_for_long_then_the_dead_man_ends_it() -> None:
    wire, driver, _ = connect(settings=vehicle_settings(dead_man=0.5))
    wire.run(1.0)
    wire.send_command(lambda now: driver.on_command(make_command(1.0, 1, valid_for=60.0), now))
    wire.run(3.0)
    first = next(t for t, frame in wire.sent if decode_frame(frame)["Enable"] == 0)
    assert first == pytest.approx(1.5, abs=1e-6)


def test_given_stop_frames_that_are_lost_then_the_controllers_own_dead_man_stops_it() -> None:
    wire, driver, emulator = connect()
    drive(wire, driver, 3.0)
    wire.to_device.clear()
    wire.device.on_receive = lambda unit, now: []  # type: ignore[method-assign]
    wire.run(6.0)
    assert emulator.speed == 0.0


def test_given_a_new_command_after_the_stop_then_it_drives_again() -> None:
    wire, driver, emulator = connect()
    drive(wire, driver, 2.0)
    wire.run(4.0)
    drive(wire, driver, 6.0, speed=-0.5)
    assert emulator.speed == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("speed", "angle", "speed_sent", "angle_sent"),
    [(9.0, 0.1, 3.0, 0.1), (-9.0, 0.1, -1.0, 0.1), (1.0, 2.0, 1.0, 0.5), (1.0, -2.0, 1.0, -0.5)],
)
def test_given_a_command_beyond_the_limits_then_the_limit_is_commanded_and_reported(
    speed: float, angle: float, speed_sent: float, angle_sent: float
) -> None:
    wire, driver, _ = connect()
    wire.run(0.5)
    for seq in range(3):
        wire.send_command(lambda now, seq=seq: driver.on_command(make_command(wire.t, seq, speed, angle), now))  # type: ignore[misc]
    frames = [decode_frame(frame) for _, frame in wire.sent]
    assert {frame["ForwardSpeed"] for frame in frames} == {round(speed_sent * 1000)}
    assert {frame["SteeringAngle"] for frame in frames} == {round(angle_sent / DEG * 100)}
    assert driver.counts["clamped"] == 3
    assert wire.status_text().count("the limit is commanded") == 1


def test_given_limits_that_reject_then_nothing_is_commanded() -> None:
    limits = CommandLimits(3.0, 1.0, 0.5, "reject")
    wire, driver, _ = connect(settings=vehicle_settings(limits=limits))
    wire.run(0.5)
    wire.send_command(lambda now: driver.on_command(make_command(0.5, 1, speed=3.5), now))
    assert wire.sent == []
    assert driver.counts["rejected.limit"] == 1
    assert "forward_speed 3.5 m/s is outside -1 to 3 m/s" in wire.status_text()
    wire.run(1.0)
    assert statuses(wire)[-1].commands_rejected == 1


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (make_command(0.0, 5), "expired"),
        (make_command(3.0, 5), "future"),
        (make_command(1.0, 5, source="someone"), "source"),
        (make_command(1.0, 0), "stale"),
        (make_command(1.0, 5, speed=math.nan), "malformed"),
        (make_command(1.0, 5, angle=math.inf), "malformed"),
        (make_command(1.0, 5, valid_for=-1.0), "expired"),
    ],
)
def test_given_a_command_that_may_not_count_then_the_one_before_goes_on(command: VehicleCommand, reason: str) -> None:
    wire, driver, _ = connect()
    wire.run(1.0)
    wire.send_command(lambda now: driver.on_command(make_command(1.0, 0, speed=1.0), now))
    wire.send_command(lambda now: driver.on_command(command, now))
    wire.run(1.2)
    assert {decode_frame(frame)["ForwardSpeed"] for _, frame in wire.sent} == {1000}
    assert driver.counts[f"rejected.{reason}"] == 1
    assert "rejected" in wire.status_text()
    wire.run(2.0)
    assert driver.counts["dead_man"] == 1
    assert statuses(wire)[-1].commands_rejected == 1


def test_given_a_commander_by_name_then_others_are_rejected() -> None:
    wire, driver, _ = connect(settings=vehicle_settings(commander="arbitrator"))
    wire.run(1.0)
    wire.send_command(lambda now: driver.on_command(make_command(1.0, 0, source="stranger"), now))
    assert wire.sent == []
    assert "only 'arbitrator' commands" in wire.status_text()


def test_given_a_source_whose_commands_have_ended_then_another_may_command() -> None:
    wire, driver, _ = connect()
    wire.run(1.0)
    wire.send_command(lambda now: driver.on_command(make_command(1.0, 7), now))
    wire.run(2.0)
    wire.send_command(lambda now: driver.on_command(make_command(2.0, 0, speed=1.0, source="joystick"), now))
    assert decode_frame(wire.sent[-1][1])["ForwardSpeed"] == 1000


def test_given_an_emergency_stop_then_the_controller_stops_and_rejects_and_that_is_reported() -> None:
    wire, driver, emulator = connect()
    drive(wire, driver, 3.0)
    emulator.mode = VehicleMode.EMERGENCY_STOP
    drive(wire, driver, 6.0)
    assert emulator.speed == 0.0
    assert statuses(wire)[-1].commands_rejected > 20


def test_given_bus_off_while_driving_then_nothing_is_sent_and_stop_is_sent_when_it_is_back() -> None:
    wire, driver, _ = connect(InjectedFault(3.0, "bus_off", 1.0))
    wire.reopen_s = 0.5
    drive(wire, driver, 4.5)
    off = [t for t, _ in wire.sent if 3.002 < t < 3.5]
    assert off == []
    assert driver.counts["rejected.bus_off"] >= 4
    first = next(decode_frame(frame) for t, frame in wire.sent if t > 3.4)
    assert first["Enable"] == 0
    assert [status.phase for _, status in wire.statuses if "went bus-off" in status.text] == [EndpointPhase.SILENT]


def test_given_that_the_driver_leaves_then_it_sends_stop() -> None:
    wire, driver, _ = connect()
    wire.run(1.0)
    assert driver.on_close(at(1.0)) == []
    drive(wire, driver, 2.0)
    (stop,) = driver.on_close(at(2.0))
    assert isinstance(stop, Send)
    assert decode_frame(stop.unit)["Enable"] == 0


def test_given_no_command_mapping_then_commands_go_nowhere() -> None:
    driver = VehicleDriver(vehicle_settings(command=None), DATABASE)
    driver.on_open(at(0.0))
    assert driver.on_command(make_command(0.0, 0), at(0.0)) == []
    assert driver.counts["rejected.no_command_mapping"] == 1


def test_given_a_flood_of_rejected_commands_then_little_is_reported() -> None:
    wire, driver, _ = connect()
    wire.run(1.0)
    for seq in range(1000):
        wire.send_command(lambda now, seq=seq: driver.on_command(make_command(0.0, seq, source=f"s{seq}"), now))  # type: ignore[misc]
    assert len(wire.statuses) < 5
    assert driver.counts["rejected.expired"] == 1000


@pytest.mark.slow
def test_given_random_frames_and_commands_then_nothing_is_raised_and_memory_stays_flat() -> None:
    rng = random.Random(3)
    driver = VehicleDriver(vehicle_settings(), DATABASE)
    driver.on_open(at(0.0))
    wild = (math.nan, math.inf, -1e300, 0.0, 1.0, 5.0)

    def flood(begin: int, count: int) -> None:
        for n in range(begin, begin + count):
            now = at(0.001 * n)
            identifier = rng.choice((0x200, 0x201, 0x300, rng.randrange(2048)))
            frame = CanFrame(identifier, rng.randbytes(rng.choice((4, 8, 8, rng.randrange(65)))), rng.random() < 0.1)
            command = make_command(
                0.001 * n + rng.uniform(-0.5, 0.5), n, rng.choice(wild), rng.choice(wild), rng.choice(wild), "a"
            )
            outputs = driver.on_receive(frame, now) + driver.on_timer(now) + driver.on_command(command, now)
            for output in outputs:
                if isinstance(output, Send):
                    assert -1000 <= decode_frame(output.unit)["ForwardSpeed"] <= 3000
                    assert abs(decode_frame(output.unit)["SteeringAngle"]) <= 2865
                else:
                    assert isinstance(output, MeasuredSample | EndpointStatus)

    flood(0, 1_000)
    tracemalloc.start()
    try:
        flood(1_000, 1_000)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        flood(2_000, 4_000)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 20_000


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"status": None, "command": None}, "status or command is needed"),
        ({"dbc": ""}, "dbc is the path"),
        ({"dead_man": 0.0}, "dead_man is between"),
        ({"command_period": 0.6}, "command_period is at most dead_man"),
        ({"clock_slack": -1.0}, "clock_slack is between"),
        ({"silence": math.nan}, "silence is between"),
    ],
)
def test_given_settings_that_cannot_be_then_the_key_is_named(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        vehicle_settings(**changes)


def test_given_limits_that_cannot_be_then_the_key_is_named() -> None:
    with pytest.raises(ValueError, match="steering_angle is between"):
        CommandLimits(steering_angle=2.0)
    with pytest.raises(ValueError, match="over_limit is one of clamp, reject"):
        CommandLimits(over_limit="perhaps")  # type: ignore[arg-type]


def test_given_limits_that_the_frame_cannot_represent_then_it_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"ForwardSpeed holds 20 m/s at most, 30 is allowed; fix: lower"):
        VehicleDriver(vehicle_settings(limits=CommandLimits(forward_speed=30.0)), DATABASE)


def test_given_a_mistyped_status_signal_then_the_nearest_is_reported() -> None:
    status = StatusMap(forward_speed=SignalMap("VehicleStatus.ForwardSped"))
    with pytest.raises(ConfigError, match=r"nearest: VehicleStatus\.ForwardSpeed;"):
        VehicleDriver(vehicle_settings(status=status), DATABASE)


def test_given_a_line_reopened_while_a_command_counts_then_stop_is_sent_and_it_counts_no_more() -> None:
    driver = VehicleDriver(vehicle_settings(), DATABASE)
    driver.on_open(at(0.0))
    driver.on_command(make_command(0.0, 0), at(0.0))
    later = [driver.on_open(at(0.05)), driver.on_timer(at(0.1)), driver.on_timer(at(0.15))]
    frames = [output.unit for outputs in later for output in outputs if isinstance(output, Send)]
    assert [decode_frame(frame)["Enable"] for frame in frames] == [0, 0, 0]


def test_given_bus_off_while_a_command_counts_then_nothing_is_sent() -> None:
    driver = VehicleDriver(vehicle_settings(), DATABASE)
    driver.on_open(at(0.0))
    driver.on_command(make_command(0.0, 0), at(0.0))
    driver.on_receive(CanFrame(0x40, is_error=True), at(0.01))
    for t in (0.06, 0.3, 1.0):
        assert not [output for output in driver.on_timer(at(t)) if isinstance(output, Send)]
    assert driver.on_close(at(1.1)) == []


def test_given_a_command_named_by_its_pgn_then_it_is_sent_with_the_identifier_of_the_file() -> None:
    from msdrivers.devices.can import parse_dbc

    number = 0x0CFF0127
    text = DBC.read_text(encoding="utf-8").replace(" 768 ", f" {0x80000000 + number} ")
    command = CommandMap(
        SignalMap("0xFF01.ForwardSpeed"), SignalMap("0xFF01.SteeringAngle", DEG), alive="0xFF01.Alive",
        drive_signals={"Enable": 1}, stop_signals={"Enable": 0},
    )  # fmt: skip
    driver = VehicleDriver(vehicle_settings(command=command), parse_dbc(text, "j.dbc"))
    driver.on_open(at(0.0))
    (frame,) = [each.unit for each in driver.on_command(make_command(0.0, 1), at(0.0)) if isinstance(each, Send)]
    assert (frame.arbitration_id, frame.is_extended) == (number, True)
    broken = dataclasses.replace(command, drive_signals={}, stop_signals={})
    with pytest.raises(ConfigError, match=r"VehicleCommand.Enable is given no value"):
        VehicleDriver(vehicle_settings(command=broken), parse_dbc(text, "j.dbc"))
