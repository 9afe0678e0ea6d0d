"""The device's clock against simulated truth: the instant, its sigma, and what steps, gaps and duplicates do."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import pytest

from msdrivers.device_clock import BLOCK_US, WINDOW_US, DeviceClock

UTIME = 1_700_000_000_000_000

Delay = Callable[[random.Random], float]


def uniform(rng: random.Random) -> float:
    return rng.uniform(0.0, 20_000.0)


@dataclass
class Device:
    """A device that measures periodically and sends with a delay. Times in microseconds."""

    clock: DeviceClock
    seed: int
    drift: float = 0.0
    tick: float = 1.0
    delay: Delay = uniform
    host_step: int = 0
    errors: list[tuple[float, float, float]] = field(default_factory=list)
    """Seconds since the start, error in seconds, sigma."""

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self.offset = self.rng.randrange(-(10**15), 10**15)

    def measure(self, at: float) -> tuple[int, float]:
        """Let it measure `at` seconds after the start; return utime and sigma."""
        true = at * 1e6
        device = math.floor((true * (1.0 + self.drift) + self.offset) / self.tick) * self.tick
        host = UTIME + round(true + self.delay(self.rng)) + self.host_step
        self.clock, utime, sigma = self.clock.update(int(device), host)
        self.errors.append((at, (utime - UTIME - self.host_step - true) * 1e-6, sigma))
        return utime, sigma

    def run(self, seconds: float, rate: float, start: float = 0.0) -> Device:
        for n in range(round(seconds * rate)):
            # no device measures quite evenly
            self.measure(start + n / rate + self.rng.uniform(0.0, 2e-4))
        return self

    def after(self, seconds: float) -> list[tuple[float, float]]:
        return [(abs(error), sigma) for at, error, sigma in self.errors if at >= seconds]


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[int(share * len(values))]


@cache
def devices(rate: float, tick: float, delay: Delay) -> list[Device]:
    seconds = {4: 40.0, 20: 15.0, 100: 8.0}[round(rate)]
    drifts = (-1e-4, 1e-4, 0.0, 5e-5)
    return [
        Device(DeviceClock(tick_us=tick), seed, drifts[seed % 4], tick, delay).run(seconds, rate) for seed in range(4)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("tick", [1.0, 6553.6, 10_000.0])
@pytest.mark.parametrize("rate", [4.0, 20.0, 100.0])
def test_given_delays_to_20_ms_and_drift_to_100_ppm_then_the_instant_is_right_to_2_ms(rate: float, tick: float) -> None:
    errors = [error for device in devices(rate, tick, uniform) for error, _ in device.after(5.0)]
    assert quantile(errors, 0.95) < 2e-3 + (tick * 1e-6 if tick > 1.0 else 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "delay",
    [
        uniform,
        lambda rng: rng.expovariate(1 / 5000.0),
        lambda rng: 0.0,
        lambda rng: rng.choice((0.0, 8000.0)) + rng.uniform(0.0, 200.0),
        lambda rng: rng.uniform(0.0, 3000.0) + (rng.uniform(0.0, 300_000.0) if rng.random() < 0.02 else 0.0),
    ],
    ids=["uniform", "exponential", "none", "two", "stalls"],
)
@pytest.mark.parametrize("rate", [4.0, 20.0, 100.0])
def test_given_any_delays_then_sigma_covers_the_error_from_the_first_sample_on(rate: float, delay: Delay) -> None:
    errors = [each for device in devices(rate, 1.0, delay) for each in device.errors]
    assert sum(abs(error) <= 2.0 * sigma for _, error, sigma in errors) >= 0.95 * len(errors)
    early = [(error, sigma) for at, error, sigma in errors if at < 2.0]
    assert sum(abs(error) <= 2.0 * sigma for error, sigma in early) >= 0.9 * len(early)


def test_given_ticks_then_sigma_covers_them_too() -> None:
    pairs = [pair for device in devices(20.0, 10_000.0, uniform) for pair in device.after(0.0)]
    assert sum(error <= 2.0 * sigma for error, sigma in pairs) >= 0.95 * len(pairs)


def test_given_a_minute_then_drift_and_offset_are_known() -> None:
    device = Device(DeviceClock(), 3, drift=8e-5).run(60.0, 20.0)
    # the host's clock is behind a device's that runs ahead
    assert device.clock.drift == pytest.approx(-8e-5, abs=5e-6)
    assert device.clock.offset == pytest.approx((UTIME - device.offset) * 1e-6 - 60.0 * 8e-5, abs=2e-3)


def test_given_no_sample_then_nothing_is_known() -> None:
    assert math.isnan(DeviceClock().offset)
    assert math.isnan(DeviceClock().drift)


def test_given_the_first_sample_then_it_lies_within_the_delays_that_are_thought_of() -> None:
    _, utime, sigma = DeviceClock().update(123_456, UTIME)
    assert UTIME - 20_000 <= utime <= UTIME
    # and it may have been held up besides
    assert 0.1 < sigma < 0.2


@pytest.mark.parametrize("jump", [-3_600_000_000, -200_000, 3_600_000_000, 400_000_000_000])
def test_given_a_device_that_restarts_then_its_new_time_is_used_at_once(jump: int) -> None:
    device = Device(DeviceClock(), 5).run(10.0, 20.0)
    device.offset += jump
    device.errors.clear()
    device.run(10.0, 20.0, start=12.0)
    # time that jumps ahead is below the envelope, time that jumps far back is above every delay
    assert device.clock.restarts == 1 or jump == -200_000
    late = device.after(15.0) if jump == -200_000 else device.after(12.0)
    assert sum(error <= 2.0 * sigma for error, sigma in late) >= 0.95 * len(late)
    assert max(error for error, _ in device.after(18.0)) < 2e-3


def test_given_a_jump_that_could_be_a_delay_then_sigma_covers_both_until_it_is_sure() -> None:
    device = Device(DeviceClock(), 6, delay=lambda rng: rng.uniform(0.0, 2000.0)).run(10.0, 20.0)
    device.offset -= 500_000
    device.errors.clear()
    device.run(5.0, 20.0, start=10.0)
    assert device.clock.restarts == 1
    assert all(error <= 2.2 * sigma for error, sigma in device.after(10.0))
    assert max(error for error, _ in device.after(12.0)) < 10e-3


@pytest.mark.parametrize("step", [-7_200_000_000, -1_000_000, 3_600_000_000, 2_000_000])
def test_given_the_hosts_clock_stepped_then_the_instants_step_with_it(step: int) -> None:
    device = Device(DeviceClock(), 7).run(10.0, 20.0)
    device.host_step += step
    device.run(10.0, 20.0, start=10.0)
    assert device.clock.restarts == 1
    assert max(error for error, _ in device.after(17.0)) < 3e-3


def test_given_a_stall_that_delivers_late_then_the_instants_stay_and_nothing_restarts() -> None:
    device = Device(DeviceClock(), 8, delay=lambda rng: rng.uniform(0.0, 5000.0)).run(10.0, 100.0)
    for n in range(300):
        at = 10.0 + n / 100.0
        device.delay = lambda rng, at=at: (13.0 - at) * 1e6 + rng.uniform(0.0, 5000.0)  # type: ignore[misc]
        device.measure(at)
    device.delay = lambda rng: rng.uniform(0.0, 5000.0)
    device.run(3.0, 100.0, start=13.0)
    assert device.clock.restarts == 0
    assert max(error for error, _ in device.after(5.0)) < 2e-3


def test_given_a_gap_then_the_clock_goes_on_with_more_uncertainty() -> None:
    device = Device(DeviceClock(), 9, drift=5e-5).run(30.0, 20.0)
    before = device.errors[-1][2]
    _, sigma = device.measure(90.0)
    assert device.clock.restarts == 0
    assert abs(device.errors[-1][1]) <= 2.0 * sigma
    assert sigma > before


def test_given_duplicates_then_they_count_once() -> None:
    once, twice = Device(DeviceClock(), 10).run(10.0, 20.0), Device(DeviceClock(), 10)
    rng = random.Random(1)
    for n in range(200):
        at = n / 20.0 + twice.rng.uniform(0.0, 2e-4)
        twice.measure(at)
        last = round((at * 1e6) + twice.offset)
        # the same time, delivered again a little later
        twice.clock, _, _ = twice.clock.update(
            math.floor(at * 1e6 + twice.offset), UTIME + last - twice.offset + rng.randrange(20_000, 25_000)
        )
    assert twice.clock.restarts == 0
    assert abs(twice.clock.drift - once.clock.drift) < 1e-4
    assert max(error for error, _ in twice.after(5.0)) < 3e-3


def test_given_samples_out_of_order_then_each_has_its_own_instant() -> None:
    device = Device(DeviceClock(), 11).run(10.0, 20.0)
    late, _ = device.measure(10.2)
    early, _ = device.measure(10.15)
    assert late - early == pytest.approx(50_000, abs=1000)
    assert device.clock.restarts == 0


def test_given_many_minutes_then_the_memory_is_bounded() -> None:
    device = Device(DeviceClock(), 12, drift=5e-5).run(1000.0, 1.0)
    assert len(device.clock._blocks) <= WINDOW_US // BLOCK_US + 1
    assert max(error for error, _ in device.after(60.0)) < 6e-3


def test_given_one_clock_when_two_samples_follow_it_then_it_is_itself_unchanged() -> None:
    clock, _, _ = DeviceClock().update(0, UTIME)
    first = clock.update(100_000, UTIME + 100_500)
    clock.update(100_000, UTIME + 99_000)
    assert clock.update(100_000, UTIME + 100_500) == first


def get_coverage(device: Device, since: float = 0.0) -> float:
    """Return the share of samples whose error is within two sigmas."""
    pairs = device.after(since)
    return sum(error <= 2.0 * sigma for error, sigma in pairs) / len(pairs)


def small(rng: random.Random) -> float:
    return rng.expovariate(1 / 1000.0)


@pytest.mark.slow
@pytest.mark.parametrize("longer_us", [3_000, 8_000, 30_000])
@pytest.mark.parametrize("is_way", [True, False], ids=["way", "clock"])
def test_given_a_way_that_becomes_longer_or_a_clock_set_back_then_sigma_covers_either(
    longer_us: int, is_way: bool
) -> None:
    device = Device(DeviceClock(), 13, delay=small).run(60.0, 4.0)
    if is_way:
        device.delay = lambda rng: small(rng) + longer_us
    else:
        device.offset -= longer_us
    # less than the slack is believed some time after the window, more never
    seconds = 150.0 if longer_us < 5000 else 600.0
    device.run(seconds, 4.0, start=60.0)
    assert get_coverage(device) >= 0.97
    device.delay = small
    device.run(20.0, 4.0, start=60.0 + seconds)
    # what comes early again shows that it was the way
    assert not is_way or device.errors[-1][2] < 2e-3


def test_given_a_receiver_that_learns_of_a_leap_second_then_it_is_believed_after_the_window() -> None:
    device = Device(DeviceClock(), 14, delay=small).run(10.0, 4.0)
    device.offset -= 2_000_000
    device.run(150.0, 4.0, start=10.0)
    assert get_coverage(device) >= 0.97
    error, sigma = device.after(155.0)[-1]
    assert error < 1e-3
    assert sigma < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("drift", [-1e-3, -3e-4, 3e-4, 1e-3])
def test_given_a_clock_that_is_off_by_more_than_a_crystal_then_that_is_learned_and_sigma_covers(drift: float) -> None:
    device = Device(DeviceClock(), 15, drift=drift, delay=small).run(60.0, 20.0)
    assert get_coverage(device) >= 0.9
    assert device.clock.drift == pytest.approx(-drift, rel=0.05)
    assert max(error for error, _ in device.after(40.0)) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("slew", [-1e-4, -2e-5, 2e-5, 1e-4])
def test_given_a_clock_whose_drift_changes_then_sigma_covers_most(slew: float) -> None:
    device = Device(DeviceClock(), 16, delay=small).run(100.0, 4.0)
    device.drift = slew
    device.offset -= round(100e6 * slew)
    device.run(200.0, 4.0, start=100.0)
    assert get_coverage(device) >= 0.85
    assert all(error <= 15.0 * sigma for error, sigma in device.after(0.0))


def test_given_a_first_sample_that_was_held_up_then_its_sigma_covers_that() -> None:
    device = Device(DeviceClock(), 17, delay=lambda rng: 300_000.0)
    device.measure(0.0)
    device.delay = small
    device.run(10.0, 4.0, start=0.25)
    assert get_coverage(device) >= 0.97
