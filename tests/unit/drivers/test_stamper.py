"""The stamp of a sample, and what the steps of a device's time do to its sigma."""

from __future__ import annotations

import math

import pytest
from support_gx1 import Line, stationary_samples

from modelserver.messages import ImuSample, SensorHeader
from msdrivers.device_clock import DeviceClock, Stamper
from msdrivers.devices.gx1 import Gx1Driver, Gx1Settings
from msdrivers.emulate.imu import TICK_100_HZ, TICK_DEFAULT, Gx1Emulator, make_eeprom
from msdrivers.endpoint import HostTime, MeasuredSample

UTIME = 1_700_000_000_000_000


def run_stamper(tick: float) -> Stamper:
    stamper = Stamper(DeviceClock())
    for n in range(200):
        header = SensorHeader(0, "imu", n, UTIME + n * 10_000, 5_000_000 + n * 10_000)
        stamper.stamp(MeasuredSample(ImuSample(header), tick=tick), HostTime(n * 10_000_000, header.host_utime))
    return stamper


@pytest.mark.parametrize("tick", [0.0065536, 0.01])
def test_given_a_time_in_steps_then_sigma_has_their_mean_square(tick: float) -> None:
    fine, coarse = run_stamper(1e-6), run_stamper(tick)
    assert coarse.clock.tick_us == pytest.approx(tick * 1e6)
    assert coarse.sigma == pytest.approx(math.hypot(fine.sigma, tick / math.sqrt(3.0)), rel=0.02)


@pytest.mark.parametrize(("hundred_hertz", "tick"), [(True, 0.01), (False, 0.0065536)])
def test_given_an_inertial_unit_then_its_samples_have_its_tick(hundred_hertz: bool, tick: float) -> None:
    line = Line(
        Gx1Driver(Gx1Settings("imu")),
        Gx1Emulator(stationary_samples(), make_eeprom(timer=TICK_100_HZ if hundred_hertz else TICK_DEFAULT)),
    )
    line.run(2.0)
    assert len(line.samples) > 100
    assert [measured.tick for measured in line.samples] == pytest.approx([tick] * len(line.samples))


@pytest.mark.parametrize("step_us", [-3_600_000_000, -4_000, 4_000, 300_000, 3_600_000_000])
def test_given_the_hosts_clock_is_set_then_the_stamps_go_with_it_and_the_devices_clock_is_not_suspected(
    step_us: int,
) -> None:
    stamper = Stamper(DeviceClock())
    errors = []
    for n in range(400):
        utime = UTIME + n * 50_000 + (step_us if n >= 200 else 0)
        header = SensorHeader(0, "imu", n, utime + 1000 * (n % 3), 5_000_000 + n * 50_000)
        # processed 2 ms after it was received
        now = HostTime(n * 50_000_000 + 1_000_000 * (n % 3) + 2_000_000, utime + 1000 * (n % 3) + 2000)
        sample = stamper.stamp(MeasuredSample(ImuSample(header)), now)
        if n >= 40:
            errors.append(abs(sample.header.utime - utime))
    assert max(errors) < 500
    assert stamper.clock.restarts == 0
    assert stamper.sigma < 1e-3
    assert stamper.offset == pytest.approx((UTIME + step_us - 5_000_000) * 1e-6, abs=1e-3)


@pytest.mark.parametrize("away", [-4_000_000, 700_000, 12_000_000])
def test_given_a_line_opened_again_when_the_device_starts_again_then_its_first_stamps_are_right(away: int) -> None:
    stamper = run_stamper(1e-6)
    stamper.reconnect()
    errors, restarts = [], stamper.clock.restarts
    for n in range(200, 400):
        utime = UTIME + 12_000_000 + n * 10_000
        # by its new clock, `away` behind the former one
        header = SensorHeader(0, "imu", n, utime, 17_000_000 + n * 10_000 - away)
        sample = stamper.stamp(MeasuredSample(ImuSample(header)), HostTime(12_000_000_000 + n * 10_000_000, utime))
        errors.append(abs(sample.header.utime - utime))
        assert errors[-1] * 1e-6 < 2.0 * sample.header.utime_sigma <= 0.31
    # until it has learnt how even the delays are now
    assert max(errors) < 20_000
    assert max(errors[20:]) < 1000
    assert stamper.clock.restarts == restarts + 1


def test_given_a_held_up_sample_on_an_open_line_then_it_is_taken_for_a_delay() -> None:
    stamper = run_stamper(1e-6)
    header = SensorHeader(0, "imu", 200, UTIME + 7_000_000, 7_000_000)
    sample = stamper.stamp(MeasuredSample(ImuSample(header)), HostTime(7_000_000_000, header.host_utime))
    assert UTIME + 1_990_000 < sample.header.utime < UTIME + 2_010_000
