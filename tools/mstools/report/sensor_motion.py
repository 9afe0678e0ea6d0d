"""Motion by each sensor alone, before any localization: turn rates of gyro, wheels and fixes, and distances.

All series are means over one second, so that a long log needs little memory. Two series are compared by their
correlation sum(ab) / sqrt(sum(a^2) sum(b^2)) and by the ratio of their root mean squares: a ratio of 57 reveals degrees
instead of radians, a negative correlation a swapped sign. Fixes give a course from steps of at least COURSE_STEP_M.
Limits: without turns or straight driving there is nothing to compare, and the comparison is None.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from modelserver.messages import FixType, GpsSample

EARTH_RADIUS = 6_371_000.0

COURSE_STEP_M = 8.0
"""Distance between two fixes that give a course, meters: several times their noise."""

MAX_STEP_S = 30.0
"""Longest duration of such a step, seconds."""

DISTANCE_STEP_M = 10.0
"""Distance by the wheels over which it is compared with the fixes', meters."""


class TurnRateComparison(NamedTuple):
    """Two turn rates compared: correlation, and ratio of the first's size to the second's."""

    correlation: float
    ratio: float


class DistanceComparison(NamedTuple):
    """Distance by wheels and by fixes over the same sections, meters."""

    wheels: float
    fixes: float


@dataclass(frozen=True)
class SensorMotion:
    """Rates and speeds per second, each second by its number since 1970.

    `gyro` is the measured turn rate about the vehicle's up axis, rad/s. `wheels` are the speeds of the wheels that the
    vehicle file names, m/s; `lateral_offsets` their positions to the left, meters. `fixes` are seconds since 1970, east
    and north, meters.
    """

    gyro: Mapping[int, float] = field(default_factory=dict)
    wheels: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    lateral_offsets: Mapping[str, float] = field(default_factory=dict)
    fixes: tuple[tuple[float, float, float], ...] = ()

    @property
    def wheel_turn_rate(self) -> dict[int, float]:
        """Turn rate by the wheels of both sides, rad/s; empty without two sides."""
        left, right, track = self._side_speed(1.0), self._side_speed(-1.0), self._track()
        if track < 0.05:
            return {}
        return {second: (right[second] - left[second]) / track for second in left.keys() & right.keys()}

    def course_changes(self) -> list[tuple[float, float, float]]:
        """Return begin, end (s since 1970) and angle (rad) of each change of the fixes' course."""
        places = _thin_by_distance(self.fixes, COURSE_STEP_M)
        courses = [
            (0.5 * (a[0] + b[0]), math.atan2(b[2] - a[2], b[1] - a[1]))
            for a, b in pairwise(places)
            if 0.0 < b[0] - a[0] < MAX_STEP_S
        ]
        turns = []
        for (t, before), (u, after) in pairwise(courses):
            turn = math.remainder(after - before, 2.0 * math.pi)
            # reversing looks like a turn on the spot
            if 0.0 < u - t < MAX_STEP_S and abs(turn) < 2.0:
                turns.append((t, u, turn))
        return turns

    def course_turn_rate(self) -> dict[int, float]:
        """Return the turn rate of the fixes' course, rad/s."""
        rates: dict[int, float] = {}
        for t, u, turn in self.course_changes():
            rates.update(dict.fromkeys(range(math.floor(t), math.floor(u)), turn / (u - t)))
        return rates

    def compare_with_course(self, rates: Mapping[int, float]) -> TurnRateComparison | None:
        """Compare a turn rate with the fixes' course, integrated over the intervals of its changes."""
        found: dict[int, tuple[float, float]] = {}
        for t, u, turn in self.course_changes():
            known = [rates[second] for second in range(math.floor(t), math.ceil(u)) if second in rates]
            if known:
                found[math.floor(t)] = (sum(known) / len(known) * (u - t), turn)
        return _compare(found.values(), 0.1)

    def count_opposed(self, turn: Mapping[int, float]) -> tuple[int, int]:
        """Return the seconds of straight driving in which the sides rolled against each other, and all of them."""
        left, right = self._side_speed(1.0), self._side_speed(-1.0)
        moving = [
            second
            for second in left.keys() & right.keys()
            if min(abs(left[second]), abs(right[second])) > 0.3 and abs(turn.get(second, math.inf)) < 0.05
        ]
        return sum(left[second] * right[second] < 0.0 for second in moving), len(moving)

    def backward_wheels(self) -> list[str]:
        """Return the wheels that roll backward on average."""
        moving = {name: [each for each in speeds.values() if abs(each) > 0.3] for name, speeds in self.wheels.items()}
        return sorted(name for name, speeds in moving.items() if sum(speeds) < 0.0)

    def compare_distances(self) -> DistanceComparison:
        """Return the distances by wheels and by fixes, over sections of `DISTANCE_STEP_M` by the wheels."""
        speed = self._mean_speed()
        rolled = fixed = distance = 0.0
        anchor: tuple[float, float, float] | None = None
        before = -math.inf
        for each in self.fixes:
            if anchor is None or each[0] - before > 5.0:
                anchor, distance, before = each, 0.0, each[0]
                continue
            seconds = range(math.floor(before), math.floor(each[0]) + 1)
            known = [speed[second] for second in seconds if second in speed]
            if known:
                distance += sum(known) / len(known) * (each[0] - before)
            before = each[0]
            if distance >= DISTANCE_STEP_M:
                rolled += distance
                fixed += math.dist(each[1:], anchor[1:])
                anchor, distance = each, 0.0
        return DistanceComparison(rolled, fixed)

    def distance_travelled(self) -> float:
        """Return the distance by the wheels, without them by the fixes, meters; nan without both."""
        if self.wheels:
            return sum(self._mean_speed().values())
        places = _thin_by_distance(self.fixes, COURSE_STEP_M)
        return sum(math.dist(a[1:], b[1:]) for a, b in pairwise(places)) if places else math.nan

    def _mean_speed(self) -> dict[int, float]:
        """Return the mean magnitude of the wheels' speeds."""
        means = SecondMeans()
        for speeds in self.wheels.values():
            for second, value in speeds.items():
                means.add(second, abs(value))
        return means.finish()

    def _wheel_names(self, sign: float) -> list[str]:
        return [name for name, left in self.lateral_offsets.items() if left * sign > 0.05 and name in self.wheels]

    def _track(self) -> float:
        sides = [[self.lateral_offsets[name] for name in self._wheel_names(sign)] for sign in (1.0, -1.0)]
        if not all(sides):
            return 0.0
        return sum(sides[0]) / len(sides[0]) - sum(sides[1]) / len(sides[1])

    def _side_speed(self, sign: float) -> dict[int, float]:
        names = self._wheel_names(sign)
        if not names:
            return {}
        known = set.intersection(*(set(self.wheels[name]) for name in names))
        return {second: sum(self.wheels[name][second] for name in names) / len(names) for second in known}


def compare_turn_rates(first: Mapping[int, float], second: Mapping[int, float]) -> TurnRateComparison | None:
    """Compare two turn rates second by second; None without enough turns."""
    return _compare([(first[each], second[each]) for each in sorted(first.keys() & second.keys())], 0.02)


def _compare(turns: Collection[tuple[float, float]], least: float) -> TurnRateComparison | None:
    """Compare pairs of turns; None with fewer than 12, or where the second ones are smaller than `least` (rms)."""
    a, b = np.array([*turns]).reshape(-1, 2).T
    squares, others = float(a @ a), float(b @ b)
    if len(a) < 12 or not squares > 0.0 or others < len(b) * least * least:
        return None
    return TurnRateComparison(float(a @ b) / math.sqrt(squares * others), math.sqrt(squares / others))


class SecondMeans:
    """Means of the values of each second since 1970."""

    def __init__(self) -> None:
        self._sums: defaultdict[int, tuple[float, int]] = defaultdict(lambda: (0.0, 0))

    def add(self, second: int, value: float) -> None:
        """Add a value."""
        total, count = self._sums[second]
        self._sums[second] = (total + value, count + 1)

    def finish(self) -> dict[int, float]:
        """Return the means."""
        return {second: total / count for second, (total, count) in sorted(self._sums.items())}


def compute_sensor_motion(
    gyro: Mapping[int, float],
    fixes: Iterable[GpsSample],
    turns: Iterable[tuple[int, str, float, float]],
    sides: Mapping[str, float],
) -> SensorMotion:
    """Return the motion by each sensor.

    `turns` are utime, wheel, speed and steering, of which steered ones are left out; `sides` the lateral offsets.
    """
    wheels: defaultdict[str, SecondMeans] = defaultdict(SecondMeans)
    for utime, name, speed, steering in turns:
        if name in sides and abs(steering) < 0.02:
            wheels[name].add(utime // 1_000_000, speed)
    speeds = {name: means.finish() for name, means in wheels.items()}
    places = [
        (each.header.utime * 1e-6, math.radians(each.latitude_deg), math.radians(each.longitude_deg))
        for each in fixes
        if each.fix_type is not FixType.NONE and math.isfinite(each.latitude_deg + each.longitude_deg)
    ]
    _, north, east = places[0] if places else (0.0, 0.0, 0.0)
    flat = tuple((t, EARTH_RADIUS * math.cos(north) * (b - east), EARTH_RADIUS * (a - north)) for t, a, b in places)
    return SensorMotion(gyro, speeds, dict(sides), flat)


def _thin_by_distance(places: Iterable[tuple[float, float, float]], least: float) -> list[tuple[float, float, float]]:
    """Return the positions that are at least `least` from the one before."""
    found: list[tuple[float, float, float]] = []
    for each in places:
        if not found or math.dist(each[1:], found[-1][1:]) >= least:
            found.append(each)
    return found
