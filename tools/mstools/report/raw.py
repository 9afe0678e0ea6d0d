"""What the sensors said, before any localization: turns by the gyro, by the wheels and by the fixes, and ways driven.

All is kept in means of a second, so that a long log needs little memory. A sensor's unit, sign or name is told by
comparing it with another one, which needs no pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from modelserver.messages import FixType, GpsSample, ImuSample
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion

EARTH_RADIUS = 6_371_000.0

COURSE_STEP = 8.0
"""Metres between two fixes that a course is taken from: several times what they scatter."""

LONGEST_STEP_S = 30.0
"""Seconds that a step of so many metres may take."""

WAY_STEP = 10.0
"""Metres of wheels' way over which it is compared with the fixes'."""


@dataclass(frozen=True, slots=True)
class Turning:
    """Two sources of turns compared: how many turns, their correlation, and how much faster the first turns."""

    count: int
    correlation: float
    ratio: float


@dataclass(frozen=True, slots=True)
class Ways:
    """How far the wheels rolled and the fixes moved over the same stretches, metres."""

    wheels: float
    fixes: float


@dataclass(frozen=True)
class RawMotion:
    """Rates and speeds by second, each second by its number since 1970.

    `gyro` is the turn rate about the vehicle's up as felt, rad/s. `wheels` are the speeds by wheel, m/s, as far as the
    vehicle file knows their names; `sides` says of each how far left of the middle it stands, metres. `fixes` are
    seconds since 1970, east and north, metres.
    """

    gyro: Mapping[int, float] = field(default_factory=dict)
    wheels: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    sides: Mapping[str, float] = field(default_factory=dict)
    fixes: tuple[tuple[float, float, float], ...] = ()

    @property
    def wheel_turn(self) -> dict[int, float]:
        """The turn rate by the wheels of the two sides, rad/s; empty where there are not two sides."""
        left = self._side(1.0)
        right = self._side(-1.0)
        track = self._track()
        if track < 0.05:
            return {}
        return {second: (right[second] - left[second]) / track for second in left.keys() & right.keys()}

    def courses(self) -> list[tuple[float, float, float]]:
        """Return by what angle the fixes' course turned, and from when to when: rad, seconds since 1970."""
        places = _spaced(self.fixes, COURSE_STEP)
        courses = [
            (0.5 * (a[0] + b[0]), math.atan2(b[2] - a[2], b[1] - a[1]))
            for a, b in pairwise(places)
            if 0.0 < b[0] - a[0] < LONGEST_STEP_S
        ]
        turns = []
        for (t, before), (u, after) in pairwise(courses):
            turn = math.remainder(after - before, 2.0 * math.pi)
            # a vehicle that reverses seems to turn round on the spot
            if 0.0 < u - t < LONGEST_STEP_S and abs(turn) < 2.0:
                turns.append((t, u, turn))
        return turns

    def course_turn(self) -> dict[int, float]:
        """Return the turn rate of the fixes' course, rad/s."""
        rates: dict[int, float] = {}
        for t, u, turn in self.courses():
            rates.update(dict.fromkeys(range(math.floor(t), math.floor(u)), turn / (u - t)))
        return rates

    def beside_courses(self, rates: Mapping[int, float]) -> Turning | None:
        """Compare a turn rate with the fixes' course, each over the courses' own times."""
        found: dict[int, tuple[float, float]] = {}
        for t, u, turn in self.courses():
            known = [rates[second] for second in range(math.floor(t), math.ceil(u)) if second in rates]
            if known:
                found[math.floor(t)] = (sum(known) / len(known) * (u - t), turn)
        return _compared([a for a, _ in found.values()], [b for _, b in found.values()], 0.1)

    def opposed(self, turn: Mapping[int, float], slowest: float = 0.3, straight: float = 0.05) -> tuple[int, int]:
        """Return in how many seconds of straight driving the sides rolled against each other, and of how many."""
        left, right = self._side(1.0), self._side(-1.0)
        moving = [
            second
            for second in left.keys() & right.keys()
            if min(abs(left[second]), abs(right[second])) > slowest and abs(turn.get(second, math.inf)) < straight
        ]
        return sum(left[second] * right[second] < 0.0 for second in moving), len(moving)

    def backward_wheels(self) -> list[str]:
        """Return the wheels that roll backward in the mean of the time in which they roll."""
        found = []
        for name, speeds in self.wheels.items():
            moving = [each for each in speeds.values() if abs(each) > 0.3]
            if moving and sum(moving) < 0.0:
                found.append(name)
        return sorted(found)

    def ways(self) -> Ways:
        """Return the ways by wheels and by fixes, over stretches of `WAY_STEP` by the wheels."""
        rolled = fixed = 0.0
        speed = self._speed()
        way = 0.0
        anchor: tuple[float, float, float] | None = None
        before = -math.inf
        for each in self.fixes:
            if anchor is None or each[0] - before > 5.0:
                anchor, way, before = each, 0.0, each[0]
                continue
            seconds = range(math.floor(before), math.floor(each[0]) + 1)
            known = [speed[second] for second in seconds if second in speed]
            if known:
                way += sum(known) / len(known) * (each[0] - before)
            before = each[0]
            if way >= WAY_STEP:
                rolled += way
                fixed += math.hypot(each[1] - anchor[1], each[2] - anchor[2])
                anchor, way = each, 0.0
        return Ways(rolled, fixed)

    def driven(self) -> float:
        """Return the way driven by the wheels, without them by the fixes, metres; nan where neither tells."""
        if self.wheels:
            return sum(self._speed().values())
        places = _spaced(self.fixes, COURSE_STEP)
        if not places:
            return math.nan
        return sum(math.hypot(b[1] - a[1], b[2] - a[2]) for a, b in pairwise(places))

    def _speed(self) -> dict[int, float]:
        """Return the mean speed of all wheels, without sign."""
        seconds: dict[int, list[float]] = {}
        for speeds in self.wheels.values():
            for second, value in speeds.items():
                seconds.setdefault(second, []).append(abs(value))
        return {second: sum(values) / len(values) for second, values in sorted(seconds.items())}

    def _names(self, sign: float) -> list[str]:
        return [name for name, left in self.sides.items() if left * sign > 0.05 and name in self.wheels]

    def _track(self) -> float:
        sides = [[self.sides[name] for name in self._names(sign)] for sign in (1.0, -1.0)]
        if not all(sides):
            return 0.0
        return sum(sides[0]) / len(sides[0]) - sum(sides[1]) / len(sides[1])

    def _side(self, sign: float) -> dict[int, float]:
        names = self._names(sign)
        if not names:
            return {}
        known = set.intersection(*(set(self.wheels[name]) for name in names))
        return {second: sum(self.wheels[name][second] for name in names) / len(names) for second in known}


def turning(first: Mapping[int, float], second: Mapping[int, float]) -> Turning | None:
    """Compare two turn rates second by second; None where there is too little turning to compare."""
    shared = sorted(first.keys() & second.keys())
    return _compared([first[each] for each in shared], [second[each] for each in shared], 0.02)


def _compared(first: Sequence[float], second: Sequence[float], least: float) -> Turning | None:
    """Compare turns; None with fewer than 12 of them, or where the second are hardly any (`least`, rms)."""
    a, b = np.array(first), np.array(second)
    squares = float((a * a).sum()), float((b * b).sum())
    if len(a) < 12 or not squares[0] > 0.0 or squares[1] < len(b) * least * least:
        return None
    return Turning(
        len(a), float((a * b).sum()) / math.sqrt(squares[0] * squares[1]), math.sqrt(squares[0] / squares[1])
    )


class RawCollector:
    """Gathers what a `RawMotion` is made of. `q_base_imu` turns the unit's axes to the vehicle's."""

    def __init__(self, q_base_imu: Quaternion | None):
        self._q_base_imu = q_base_imu
        self._rates: dict[int, tuple[float, int]] = {}
        self._places: list[tuple[float, float, float]] = []

    def on_imu(self, sample: ImuSample) -> None:
        """Note the rate about the vehicle's up."""
        rate = sample.angular_velocity
        if self._q_base_imu is None or rate is None or not all(map(math.isfinite, rate)):
            return
        up = so3.rotate(self._q_base_imu, rate)[2]
        second = sample.header.utime // 1_000_000
        total, count = self._rates.get(second, (0.0, 0))
        self._rates[second] = (total + up, count + 1)

    def on_fix(self, sample: GpsSample) -> None:
        """Note where a fix was."""
        latitude, longitude = sample.latitude_deg, sample.longitude_deg
        if sample.fix_type is not FixType.NONE and math.isfinite(latitude) and math.isfinite(longitude):
            self._places.append((sample.header.utime * 1e-6, latitude, longitude))

    def motion(self, turns: Iterable[tuple[int, str, float, float]], sides: Mapping[str, float]) -> RawMotion:
        """Return all of it. `turns` are instant, wheel, speed and steering; wheels that steer tell no turn by speed."""
        sums: dict[str, dict[int, tuple[float, int]]] = {}
        for utime, name, speed, steering in turns:
            if name in sides and abs(steering) < 0.02:
                wheel = sums.setdefault(name, {})
                total, count = wheel.get(utime // 1_000_000, (0.0, 0))
                wheel[utime // 1_000_000] = (total + speed, count + 1)
        return RawMotion(
            gyro={second: total / count for second, (total, count) in self._rates.items()},
            wheels={
                name: {second: total / count for second, (total, count) in wheel.items()}
                for name, wheel in sums.items()
            },
            sides=dict(sides),
            fixes=self._fixes(),
        )

    def _fixes(self) -> tuple[tuple[float, float, float], ...]:
        if not self._places:
            return ()
        _, latitude, longitude = self._places[0]
        scale = math.radians(1.0) * EARTH_RADIUS
        across = math.cos(math.radians(latitude))
        return tuple((t, scale * across * (b - longitude), scale * (a - latitude)) for t, a, b in self._places)


def _spaced(places: Iterable[tuple[float, float, float]], least: float) -> list[tuple[float, float, float]]:
    """Return the places that lie so far from the one before them, at least."""
    found: list[tuple[float, float, float]] = []
    for each in places:
        if not found or math.hypot(each[1] - found[-1][1], each[2] - found[-1][2]) >= least:
            found.append(each)
    return found
