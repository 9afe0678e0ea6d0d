"""The driver of the 3DM-GX1 against its emulator: set-up, streaming, polls, and leaving."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from support_gx1 import FIELD_NED, GRAVITY, START_UTIME, Line, angle_between, rotating_samples, stationary_samples

from modelserver.messages import ImuSample, OrientationReference, YawSource
from modelserver.transforms import so3
from msdrivers.devices.gx1 import CommandByte, EepromAddress, Gains, Gx1Driver, Gx1Settings
from msdrivers.emulate.imu import TICK_DEFAULT, Gx1Emulator, Gx1Unit, make_eeprom
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
    assert line.status_texts(EndpointPhase.STREAMING) == ["3DM-GX1 serial 1234, firmware 3.1.00, receiving message 49"]
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
    settings = Gx1Settings("imu", message=message, heading="magnetic")
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
    unit = Gx1Emulator(rotating_samples((0.0, 0.0, 1.0)), make_eeprom(Gains(10_000, 8500, 2500)))
    line = Line(Gx1Driver(Gx1Settings("imu")), unit)
    line.run(3.0)
    sample = imu_samples(line)[-1]
    assert sample.angular_velocity == pytest.approx((0.0, 0.0, 1.0), abs=2e-4)
    assert sample.specific_force == pytest.approx((0.0, 0.0, -GRAVITY), abs=2e-3)


def test_given_polls_then_the_temperature_is_reported_every_10_s_and_never_repeated():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(), unit=Gx1Unit(celsius=31)))
    line.run(25.0)
    reported = [s.temperature_celsius for s in imu_samples(line) if not math.isnan(s.temperature_celsius)]
    assert reported == pytest.approx([31.0] * 3, abs=0.01)
    assert line.host.counts["message.temperature"] == len(reported)


def test_given_the_default_timer_then_a_tick_is_6553_microseconds_and_a_wrap_goes_unseen():
    unit = Gx1Unit(tick_offset=65_000)
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples(), make_eeprom(timer=TICK_DEFAULT), unit))
    line.run(8.0)
    times = [sample.header.device_utime for sample in imu_samples(line)]
    steps = {b - a for a, b in itertools.pairwise(times)}
    assert steps <= {6553, 6554, 13_107, 13_108}
    turn = 65_536 * 6553.6
    assert times[0] // turn + 1 == times[-1] // turn
    assert line.host.counts.get("restarts", 0) == 0


def test_given_a_drifting_clock_and_bytes_in_pieces_then_no_sample_is_lost():
    line = Line(
        Gx1Driver(Gx1Settings("imu", message=CommandByte.QUATERNION_VECTORS)),
        Gx1Emulator(rotating_samples(), unit=Gx1Unit(drift=150e-6)),
        pieces=random.Random(3),
    )
    line.run(20.0)
    times = [sample.header.device_utime for sample in imu_samples(line)]
    assert {b - a for a, b in itertools.pairwise(times)} == {10_000}
    assert not [name for name in line.host.counts if "rejected" in name]


def test_given_a_device_that_streamed_when_it_was_found_then_it_is_stopped_when_left():
    device = Gx1Emulator(rotating_samples(), unit=Gx1Unit(streamed_at_start=CommandByte.STABILIZED_EULER))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.run(3.0)
    assert device.streamed == CommandByte.EULER_VECTORS
    assert len(line.samples) > 100
    line.close()
    assert device.streamed == 0


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
    device = Gx1Emulator(rotating_samples(), make_eeprom(timer=TICK_DEFAULT))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    device.eeprom |= zip(EepromAddress.TIMER, (4, 10, 250, 10), strict=True)
    line.run(25.0)
    assert any("6.55 ms by the host's clock" in text and "power off and on" in text for text in line.status_texts())
    last = line.samples[-1]
    assert last.sample.header.device_utime == 0
    assert last.delay == pytest.approx(230 / 38400)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"message": 0x07}, "message is one of 2, 3, 12, 13, 14, 49, got 7"),
        ({"message": CommandByte.INSTANTANEOUS_EULER}, "heading is magnetic with message 13"),
        ({"specific_force_sign": 0}, "specific_force_sign is one of 1, -1"),
        ({"bauds": (0,)}, "bauds are above 0"),
        ({"silence": 0.0}, "silence is between 0.05 and 3600, got 0"),
        ({"tick": math.nan}, "tick is between"),
    ],
)
def test_given_settings_that_contradict_then_the_error_names_it(change, text):
    with pytest.raises(ValueError, match=text.replace("(", r"\(")):
        Gx1Settings("imu", **change)
