"""Two receivers on one channel are found in their fixes; one receiver, however poor, is not taken for two."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator

import pytest

from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.inputs import FixAlternation, evaluate_fix
from modelserver.messages import FixType, GpsSample, SensorHeader

START = 1_700_000_000_000_000
METER_DEG = math.degrees(1.0 / 6_371_000.0)
Offset = Callable[[int], tuple[float, float]]


def drive(rate: float, speed: float, offset: Offset, seconds: float = 60.0) -> Iterator[GpsSample]:
    """Yield fixes of a circle of 40 m radius, each with an offset east and north, m; their sigma is 0.5 m."""
    for n in range(int(seconds * rate)):
        t = n / rate
        angle = speed * t / 40.0
        east, north = offset(n)
        yield GpsSample(
            SensorHeader(START + round(t * 1e6), "gps"),
            FixType.FIX_3D,
            60.0 + METER_DEG * (40.0 * math.sin(angle) + north),
            11.0 + METER_DEG * (40.0 * math.cos(angle) + east) / math.cos(math.radians(60.0)),
            height_ellipsoidal=100.0,
            position_covariance=(0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.25),
        )


def measure(samples: Iterator[GpsSample]) -> list[float]:
    """Return the distance after each fix."""
    state, found = FixAlternation(), []
    for sample in samples:
        fix = evaluate_fix(sample, FilterSettings(), True)
        assert not isinstance(fix, str)
        state = state.add(sample, fix)
        found.append(state.distance)
    return found


@pytest.mark.parametrize("speed", [0.0, 2.0, 8.0])
@pytest.mark.parametrize("rate", [1.0, 10.0])
@pytest.mark.parametrize("pattern", ["AB", "AAB", "ABBA"])
def test_given_two_receivers_then_they_are_found_with_their_distance(pattern: str, rate: float, speed: float) -> None:
    noise = random.Random(1)

    def offset(n: int) -> tuple[float, float]:
        x, y = (18.0, -24.0) if pattern[n % len(pattern)] == "B" else (0.0, 0.0)
        return x + noise.gauss(0.0, 0.3), y + noise.gauss(0.0, 0.3)

    found = measure(drive(rate, speed, offset))
    assert found[40:] == pytest.approx([30.0] * len(found[40:]), rel=0.05)


NOISE: dict[str, Callable[[random.Random, int], tuple[float, float]]] = {
    "ten times its sigma": lambda noise, n: (noise.gauss(0.0, 5.0), noise.gauss(0.0, 5.0)),
    "along one axis": lambda noise, n: (noise.gauss(0.0, 5.0), 0.0),
    "an outlier every two seconds": lambda noise, n: (30.0 * (n % 20 == 7), 0.0),
    "jumps that last": lambda noise, n: (30.0 * (n // 60 % 2), 0.0),
    "a drift": lambda noise, n: (0.1 * n, 0.0),
    "as stated": lambda noise, n: (0.7 * (n % 2), 0.0),
}


@pytest.mark.parametrize("speed", [0.0, 2.0, 15.0])
@pytest.mark.parametrize("kind", NOISE)
def test_given_one_receiver_then_it_is_not_taken_for_two(kind: str, speed: float) -> None:
    noise = random.Random(1)
    assert not any(measure(drive(10.0, speed, lambda n: NOISE[kind](noise, n), 300.0)))


@pytest.mark.parametrize("rate", [1.0, 10.0])
@pytest.mark.parametrize("speed", [0.0, 0.05, 0.5, 15.0])
def test_given_coarse_digits_then_the_two_sides_of_one_are_not_two_receivers(speed: float, rate: float) -> None:
    # minutes with three decimals, 1.9 m, as of receivers that state no covariance
    def print_digits(sample: GpsSample) -> GpsSample:
        latitude, longitude = (round(each * 60.0, 3) / 60.0 for each in (sample.latitude_deg, sample.longitude_deg))
        return GpsSample(sample.header, FixType.FIX_3D, latitude, longitude, satellites=7, hdop=1.2)

    noise = random.Random(1)
    jitter = drive(rate, speed, lambda n: (noise.gauss(0.0, 0.5), noise.gauss(0.0, 0.5)))
    assert not any(measure(map(print_digits, jitter)))


def test_given_two_receivers_until_one_is_unplugged_then_that_is_over_after_a_minute() -> None:
    found = measure(drive(10.0, 2.0, lambda n: (30.0 * (n % 2 and n < 100), 0.0), 90.0))
    assert found[99] > 20.0
    assert found[600] > 20.0
    assert found[-1] == 0.0


def test_given_fixes_out_of_order_or_twice_then_they_are_left_out() -> None:
    samples = list(drive(10.0, 2.0, lambda n: (30.0 * (n % 2), 0.0)))
    twice = [each for sample in samples for each in (sample, sample, samples[0])]
    assert measure(iter(twice))[-1] == pytest.approx(30.0, rel=0.05)
