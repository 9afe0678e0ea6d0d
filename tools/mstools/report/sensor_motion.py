"""Motion by each sensor alone, before any localization: turn rates of gyro, wheels and fixes, and distances.

All series are means over one second, so that a long log needs little memory. A wheel's speed is its travel over time,
however its samples arrived; places are in the tangent plane, the same on all of Earth. Two series are compared by their
correlation sum(ab) / sqrt(sum(a^2) sum(b^2)) and by the ratio of their root mean squares: a ratio of 57 reveals degrees
instead of radians, a negative correlation a swapped sign. Fixes give a course from steps of at least COURSE_STEP_M.
Limits: without turns or straight driving there is nothing to compare, and the comparison is None.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame, ecef_from_geodetic
from modelserver.messages import FixType, GpsSample, WheelsSample

MIN_TRAVEL_US = 50_000
"""Least time over which travel gives a speed, microseconds: one count of 1 mm is then 2 cm/s."""

MAX_TRAVEL_US = 5_000_000
"""Longest time over which travel gives a speed, microseconds."""

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
            mean = _mean_between(rates, t, u)
            if math.isfinite(mean):
                found[math.floor(t)] = (mean * (u - t), turn)
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
            mean = _mean_between(speed, before, each[0])
            if math.isfinite(mean):
                distance += mean * (each[0] - before)
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
    """Weighted means of the values of each second since 1970."""

    def __init__(self) -> None:
        self._sums: defaultdict[int, tuple[float, float]] = defaultdict(lambda: (0.0, 0.0))

    def add(self, second: int, value: float, weight: float = 1.0) -> None:
        total, weights = self._sums[second]
        self._sums[second] = (total + value * weight, weights + weight)

    def finish(self) -> dict[int, float]:
        return {second: total / weights for second, (total, weights) in sorted(self._sums.items())}


class WheelTravel(NamedTuple):
    """Mean speed of a wheel from `begin` to `end`, utimes, m/s; equal for a speed that the wheel itself measured."""

    begin: int
    end: int
    name: str
    speed: float
    steering: float


def compute_wheel_travel(samples: Iterable[WheelsSample]) -> list[WheelTravel]:
    """Return the speeds of wheels by their travel, without travel the measured ones. Any order of samples will do.

    A driver that was started again, whose `seq` is smaller than before, counts its travel from another beginning.
    """
    found: list[WheelTravel] = []
    anchors: dict[tuple[str, str], tuple[int, float]] = {}
    last_seq: dict[str, int] = {}
    for sample in sorted(samples, key=lambda each: each.header.utime):
        utime, source = sample.header.utime, sample.header.source
        if sample.header.seq < last_seq.get(source, 0):
            anchors = {key: anchor for key, anchor in anchors.items() if key[0] != source}
        last_seq[source] = sample.header.seq
        for wheel in sample.wheels:
            if not math.isfinite(wheel.steering):
                continue
            if not math.isfinite(wheel.travel):
                if math.isfinite(wheel.speed):
                    found.append(WheelTravel(utime, utime, wheel.name, wheel.speed, wheel.steering))
                continue
            key = (source, wheel.name)
            begin, travel = anchors.get(key, (0, 0.0))
            if utime - begin >= MIN_TRAVEL_US:
                anchors[key] = (utime, wheel.travel)
                speed = (wheel.travel - travel) / (utime - begin) * 1e6
                if utime - begin <= MAX_TRAVEL_US:
                    found.append(WheelTravel(begin, utime, wheel.name, speed, wheel.steering))
    return found


def compute_sensor_motion(
    gyro: Mapping[int, float],
    fixes: Iterable[GpsSample],
    rolling: Iterable[WheelTravel],
    sides: Mapping[str, float],
) -> SensorMotion:
    """Return the motion by each sensor. `sides` are the lateral offsets of the wheels; steered speeds are left out."""
    wheels: defaultdict[str, SecondMeans] = defaultdict(SecondMeans)
    for begin, end, name, speed, steering in rolling:
        if name in sides and abs(steering) < 0.02:
            for second in range(begin // 1_000_000, end // 1_000_000 + 1):
                overlap = min(end, (second + 1) * 1_000_000) - max(begin, second * 1_000_000)
                if begin == end or overlap > 0:
                    wheels[name].add(second, speed, max(overlap, 1))
    speeds = {name: means.finish() for name, means in wheels.items()}
    places = [(each.header.utime * 1e-6, each) for each in fixes if each.fix_type is not FixType.NONE]
    return SensorMotion(gyro, speeds, dict(sides), tuple(_project_fixes(places)))


def _project_fixes(fixes: Iterable[tuple[float, GpsSample]]) -> Iterator[tuple[float, float, float]]:
    """Yield times, east and north of fixes, by time; those without a place are left out."""
    plane, height = None, 0.0
    for t, fix in sorted(fixes, key=lambda each: each[0]):
        with suppress(GeodesyError):
            if plane is None:
                height = fix.height_ellipsoidal if math.isfinite(fix.height_ellipsoidal) else 0.0
                plane = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, height)
            # of one height: its noise is none of the way
            ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
            yield (t, *plane.from_ecef(ecef)[:2])


def _mean_between(series: Mapping[int, float], begin: float, end: float) -> float:
    """Return the mean of a series of seconds over a time, s since 1970, as far as it is known; nan where it is not."""
    known = [
        (series[second], min(end, second + 1.0) - max(begin, second))
        for second in range(math.floor(begin), math.ceil(end))
        if second in series
    ]
    total = sum(weight for _, weight in known)
    return sum(value * weight for value, weight in known) / total if total > 0.0 else math.nan


def _thin_by_distance(places: Iterable[tuple[float, float, float]], least: float) -> list[tuple[float, float, float]]:
    found: list[tuple[float, float, float]] = []
    for each in places:
        if not found or math.dist(each[1:], found[-1][1:]) >= least:
            found.append(each)
    return found
