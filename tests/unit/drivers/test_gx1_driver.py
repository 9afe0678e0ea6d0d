"""The driver of the 3DM-GX1 against its emulator: set-up, streaming, polls, and leaving."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from support_gx1 import FIELD_NED, GRAVITY, START_UTIME, Line, angle_between, rotating_samples, stationary_samples

from modelserver.messages import ImuSample, OrientationReference, YawSource
from modelserver.transforms import so3
from msdrivers.devices import gx1 as requests
from msdrivers.devices.gx1 import CommandByte, EepromAddress, Gains
from msdrivers.devices.gx1.driver import Gx1Driver, Gx1Settings, HeadingSource, TickRateCheck
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.imu import Eeprom, Gx1Emulator, Gx1Unit
from msdrivers.endpoint import EndpointPhase


def imu_samples(line: Line) -> list[ImuSample]:
    found = [measured.sample for measured in line.samples]
    assert all(isinstance(sample, ImuSample) for sample in found)
    return found  # type: ignore[return-value]


def test_given_a_device_when_opened_then_it_is_identified_set_up_and_streams_at_100_hz():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples()))
    line.run(6.0)
    assert line.status_texts(EndpointPhase.CONFIGURING) == [
        "3DM-GX1 serial 1234, firmware 3.1.00 answers at 38400 baud"
    ]
    assert line.status_texts(EndpointPhase.STREAMING) == ["3DM-GX1 serial 1234, firmware 3.1.00 streams message 49"]
    headers = [sample.header for sample in imu_samples(line)]
    assert [header.seq for header in headers] == list(range(len(headers)))
    assert {b.device_utime - a.device_utime for a, b in itertools.pairwise(headers)} == {10_000}
    assert line.host.counts["message.euler_vectors"] == len(headers) > 440
    assert headers[0].source == "imu"


def test_given_a_turning_unit_then_samples_are_what_it_did_at_the_instants_of_its_ticks():
    rate = (0.1, -0.2, 0.3)
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(rate)))
    line.run(6.0)
    samples = imu_samples(line)
    # by processing and flight the samples come 5 ms after they were measured
    begin = samples[0].header.host_utime - 5000
    for sample in samples:
        assert sample.header.host_utime - sample.header.device_utime == begin + 5000 - samples[0].header.device_utime
        t = (sample.header.host_utime - 5000 - START_UTIME) * 1e-6
        truth = so3.exponential((rate[0] * t, rate[1] * t, rate[2] * t))
        assert sample.orientation is not None
        assert angle_between(sample.orientation, truth) < 1.5e-4
        assert sample.angular_velocity == pytest.approx(rate, abs=1.5e-4)
        assert sample.specific_force == pytest.approx(
            so3.rotate(so3.conjugate(truth), (0.0, 0.0, -GRAVITY)), abs=1.5e-3
        )
        assert sample.orientation_reference is OrientationReference.NED
        assert sample.yaw_source is YawSource.NONE
        assert sample.magnetic_field is None


@pytest.mark.parametrize(
    ("message", "content"),
    [
        (CommandByte.STABILIZED_VECTORS, "rate force field"),
        (CommandByte.INSTANTANEOUS_VECTORS, "rate force field"),
        (CommandByte.QUATERNION_VECTORS, "rate force field orientation"),
        (CommandByte.INSTANTANEOUS_EULER, "orientation"),
        (CommandByte.STABILIZED_EULER, "orientation"),
        (CommandByte.EULER_VECTORS, "rate force orientation"),
    ],
)
def test_given_each_message_then_a_sample_contains_it_and_no_more(message, content):
    settings = Gx1Settings("imu", message, HeadingSource.MAGNETIC)
    line = Line(Gx1Driver(settings), Gx1Emulator(rotating_samples()))
    line.run(3.0)
    sample = imu_samples(line)[-1]
    t = (sample.header.host_utime - 5000 - START_UTIME) * 1e-6
    truth = so3.exponential((0.0, 0.0, 0.2 * t))
    assert (sample.angular_velocity is not None) == ("rate" in content)
    assert (sample.specific_force is not None) == ("force" in content)
    assert (sample.orientation is not None) == ("orientation" in content)
    assert (sample.yaw_source is YawSource.MAGNETIC) == ("orientation" in content)
    assert (sample.orientation_reference is OrientationReference.NED) == ("orientation" in content)
    assert (sample.magnetic_field is not None) == ("field" in content)
    if sample.magnetic_field is not None:
        field = so3.rotate(so3.conjugate(truth), FIELD_NED)
        assert sample.magnetic_field == pytest.approx(field, abs=1e-8)
    if sample.orientation is not None:
        assert angle_between(sample.orientation, truth) < 2e-4
    assert sample.angular_velocity_covariance is None


def test_given_other_gains_in_the_eeprom_then_samples_are_scaled_by_them():
    unit = Gx1Emulator(rotating_samples((0.0, 0.0, 1.0)), Eeprom.make_factory(Gains(10_000, 8500, 2500)))
    line = Line(Gx1Driver(Gx1Settings("imu")), unit)
    line.run(3.0)
    sample = imu_samples(line)[-1]
    assert sample.angular_velocity == pytest.approx((0.0, 0.0, 1.0), abs=2e-4)
    assert sample.specific_force == pytest.approx((0.0, 0.0, -GRAVITY), abs=2e-3)


def test_given_polls_then_the_temperature_is_reported_once_a_period_and_never_repeated():
    line = Line(
        Gx1Driver(Gx1Settings("imu", temperature_period=1.0)), Gx1Emulator(rotating_samples(), unit=Gx1Unit(celsius=31))
    )
    line.run(5.9)
    reported = [s.temperature_celsius for s in imu_samples(line) if not math.isnan(s.temperature_celsius)]
    assert reported == pytest.approx([31.0] * 6, abs=0.01)
    assert line.host.counts["message.temperature"] == len(reported)


def test_given_a_polled_measurement_then_both_are_published_each_with_its_own_tick():
    settings = Gx1Settings("imu", CommandByte.EULER_VECTORS, polled=CommandByte.STABILIZED_VECTORS, poll_period=0.1)
    line = Line(Gx1Driver(settings), Gx1Emulator(rotating_samples()))
    line.run(3.4)
    samples = imu_samples(line)
    fields = [sample for sample in samples if sample.magnetic_field is not None]
    assert len(fields) == pytest.approx(30, abs=1)
    assert len(samples) - len(fields) > 290
    streamed = [s.header.device_utime for s in samples if s.orientation is not None]
    assert len(set(streamed)) == len(streamed)


def test_given_the_default_timer_then_a_tick_is_6553_microseconds_and_a_wrap_goes_unseen():
    unit = Gx1Unit(tick_offset=65_000, cycle_ticks=2)
    line = Line(
        Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(), Eeprom.make_factory(hundred_hertz=False), unit)
    )
    line.run(8.0)
    times = [sample.header.device_utime for sample in imu_samples(line)]
    steps = {b - a for a, b in itertools.pairwise(times)}
    assert steps <= {13_107, 13_108}
    turn = 65_536 * 6553.6
    assert times[0] // turn + 1 == times[-1] // turn
    assert line.host.counts.get("restarts", 0) == 0


def test_given_a_drifting_clock_and_bytes_in_pieces_then_no_sample_is_lost():
    line = Line(
        Gx1Driver(Gx1Settings("imu", message=CommandByte.QUATERNION_VECTORS, temperature_period=0.5)),
        Gx1Emulator(rotating_samples(), unit=Gx1Unit(drift=150e-6)),
        pieces=random.Random(3),
    )
    line.run(20.0)
    times = [sample.header.device_utime for sample in imu_samples(line)]
    assert {b - a for a, b in itertools.pairwise(times)} == {10_000}
    assert not [name for name in line.host.counts if "rejected" in name]


def test_given_biases_captured_at_start_then_the_rates_are_free_of_them():
    bias = (0.02, -0.03, 0.01)
    device = Gx1Emulator(stationary_samples(), unit=Gx1Unit(gyro_bias=bias))
    line = Line(Gx1Driver(Gx1Settings("imu", capture_bias_at_start=True)), device)
    line.run(8.0)
    assert "capturing the gyro biases: keep the vehicle still" in line.status_texts(EndpointPhase.CONFIGURING)
    assert imu_samples(line)[-1].angular_velocity == pytest.approx((0.0, 0.0, 0.0), abs=2e-4)
    without = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(stationary_samples(), unit=Gx1Unit(gyro_bias=bias)))
    without.run(4.0)
    assert imu_samples(without)[-1].angular_velocity == pytest.approx(bias, abs=2e-4)


def test_given_a_capture_that_does_not_end_then_it_is_reported_and_the_device_is_used():
    device = Gx1Emulator(stationary_samples(), unit=Gx1Unit(bias_capture=9.5))
    line = Line(Gx1Driver(Gx1Settings("imu", capture_bias_at_start=True)), device)
    line.run(20.0)
    assert any("timed out after 9 s; using the previous biases" in text for text in line.status_texts())
    assert len(line.samples) > 200


def test_given_a_restart_after_biases_were_captured_then_they_are_not_captured_on_the_move():
    device = FaultInjector(lambda: Gx1Emulator(rotating_samples()), (InjectedFault(8.0, "restart"),))
    line = Line(Gx1Driver(Gx1Settings("imu", capture_bias_at_start=True)), device)
    line.run(14.0)
    assert line.sent.count(requests.make_poll(CommandByte.CAPTURE_BIAS)) == 1
    assert any("not captured again, since the vehicle may be moving" in text for text in line.status_texts())


@pytest.mark.parametrize("found", [0, CommandByte.STABILIZED_EULER])
def test_given_a_device_that_streamed_or_not_when_left_then_it_is_as_it_was_found(found):
    device = Gx1Emulator(rotating_samples(), unit=Gx1Unit(streamed_at_start=found))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.run(3.0)
    assert device.streamed == CommandByte.EULER_VECTORS
    assert len(line.samples) > 100
    line.close()
    assert device.streamed == found


def test_given_leaving_amid_the_set_up_then_what_was_streamed_is_streamed_again():
    device = Gx1Emulator(rotating_samples(), unit=Gx1Unit(streamed_at_start=CommandByte.STABILIZED_EULER))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.run(0.8)
    assert device.streamed == 0
    line.close()
    assert device.streamed == CommandByte.STABILIZED_EULER


def test_given_a_device_that_gives_the_opposite_of_specific_force_then_the_sign_to_set_is_reported():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(stationary_samples(), unit=Gx1Unit(force_sign=-1)))
    line.run(4.0)
    assert any("set specific_force_sign to -1 (it is 1)" in text for text in line.status_texts(EndpointPhase.STREAMING))
    corrected = Line(
        Gx1Driver(Gx1Settings("imu", specific_force_sign=-1)),
        Gx1Emulator(stationary_samples(), unit=Gx1Unit(force_sign=-1)),
    )
    corrected.run(4.0)
    assert not any("specific_force_sign" in text for text in corrected.status_texts())
    assert imu_samples(corrected)[-1].specific_force == pytest.approx((0.0, 0.0, -GRAVITY), abs=2e-3)


@pytest.mark.parametrize(
    "message", [CommandByte.STABILIZED_VECTORS, CommandByte.STABILIZED_EULER, CommandByte.QUATERNION_VECTORS]
)
def test_given_any_message_then_the_sign_of_gravity_is_checked_and_its_poll_is_not_published(message):
    line = Line(Gx1Driver(Gx1Settings("imu", message)), Gx1Emulator(stationary_samples(), unit=Gx1Unit(force_sign=-1)))
    line.run(10.0)
    assert sum("set specific_force_sign" in text for text in line.status_texts()) == 1
    sent = line.sent.count(requests.make_poll(CommandByte.EULER_VECTORS))
    assert sent == (0 if message == CommandByte.QUATERNION_VECTORS else 5)
    assert len(line.samples) == line.host.counts[f"message.{message.name.lower()}"]


def test_given_a_moving_unit_then_gravity_is_not_reported():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(), unit=Gx1Unit(force_sign=-1)))
    line.run(4.0)
    assert not any("specific_force_sign" in text for text in line.status_texts())


def test_given_a_rate_beyond_the_range_then_it_is_not_published_and_counted():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples((0.0, 0.0, 30.0))))
    line.run(3.0)
    sample = imu_samples(line)[-1]
    assert sample.angular_velocity is None
    assert sample.specific_force is not None
    assert line.host.counts["saturated.rate"] == len(line.samples)


def test_given_timer_words_that_take_effect_later_then_the_device_time_is_not_used():
    device = Gx1Emulator(rotating_samples(), Eeprom.make_factory(hundred_hertz=False))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.device.on_open(line.now())
    device.eeprom = device.eeprom.write(dict(zip(EepromAddress.TIMER, (4, 10, 250, 10), strict=True)))
    line.run(20.0)
    assert any("6.554 ms by the host's clock" in text and "power off and on" in text for text in line.status_texts())
    last = line.samples[-1]
    assert last.sample.header.device_utime == 0
    assert last.delay == pytest.approx(230 / 38400)


@pytest.mark.parametrize("off", [0.05, -0.05, 0.01, -0.01])
def test_given_ticks_of_another_length_when_they_are_compared_then_they_contradict(off: float):
    rng = random.Random(1)
    rate = TickRateCheck(0.01)
    changes = [rate.update(n, round((n * (1.0 + off) + rng.uniform(0.0, 2.0)) * 1e7)) for n in range(2500)]
    assert sum(changes) == 1
    assert not rate.is_consistent
    assert f"take {10.0 * (1.0 + off):.2g}" in rate.describe()


@pytest.mark.parametrize("stall_s", [0.0, 0.3, 4.0])
def test_given_a_host_that_stalls_and_a_crystal_that_is_off_when_ticks_are_compared_then_they_agree(stall_s: float):
    rng = random.Random(2)
    rate = TickRateCheck(0.01)
    for n in range(6000):
        at_s = n * 0.01 * 1.0002 + rng.uniform(0.0, 0.02)
        at_s = max(at_s, 7.0 * (at_s // 7.0) + stall_s)
        assert not rate.update(n, round(at_s * 1e9))
    assert rate.is_consistent


def test_given_a_unit_whose_timer_is_not_documented_then_the_tick_is_inferred_and_reported():
    words = dict(zip(EepromAddress.TIMER, (8, 10, 250, 10), strict=True))
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(), Eeprom.make_factory().write(words)))
    line.run(12.0)
    assert any("a tick of 20 ms is inferred" in text for text in line.status_texts(EndpointPhase.CONFIGURING))
    assert line.samples[-1].sample.header.device_utime > 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"message": 0x07}, "message: 7 is no measurement"),
        ({"polled": CommandByte.EULER_VECTORS}, "polled: 49 is streamed already"),
        ({"message": CommandByte.INSTANTANEOUS_EULER}, "choose heading magnetic"),
        ({"specific_force_sign": 0}, "must be 1 or -1"),
        ({"bauds": (0,)}, "bauds: must be above 0"),
        ({"silence": 0.0}, "silence: must be at least 0.05 s, got 0"),
        ({"tick": math.nan}, "tick: must be at least"),
    ],
)
def test_given_settings_that_contradict_then_the_error_names_it(change, text):
    with pytest.raises(ValueError, match=text.replace("(", r"\(")):
        Gx1Settings("imu", **change)
