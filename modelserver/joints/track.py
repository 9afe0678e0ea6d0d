"""The readings of one joint coordinate by time, and its position between and after them. Bounded, immutable. Pure.

Between two readings the position is linear in time; an angle without limits is unwrapped by the rates, or by the
shorter arc. After the newest reading the position is held, or extrapolated at constant rate with a growing sigma
(acceleration noise bounded by the rate limit). Readings may arrive out of sequence: a delayed one is inserted, and the
result does not depend on the order of arrival.

Storage: readings lie in blocks that successive tracks share, as a persistent list. Appending costs constant time,
inserting a delayed reading copies one block. Limits: `MAX_READINGS`, and the seconds that the track is created with.

Rotation vectors of ball joints by time: three coordinates that are one orientation, and are interpolated as one.

Between two readings the orientation turns at a constant rate about one axis (slerp). v and v + 2 pi k v/|v| are the
same orientation: the result is the rotation vector nearest to the readings. With the left Jacobian J of SO(3) the
angular velocity is w = J(v) v' (Sola, "Quaternion kinematics", 2017, eq. 183); v' and v'' are computed from w and its
change by the inverse of J (`transforms.pose`). Assumption: the three coordinates have readings of the same instants;
otherwise each is interpolated by itself. Pure.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.errors import TooNewError, TooOldError
from modelserver.geometry.joint import JointType
from modelserver.messages import NAN
from modelserver.named_tuples import new_tuple
from modelserver.transforms import pose_array, so3
from modelserver.transforms.pose import compute_turn_motion, compute_turn_rate
from modelserver.transforms.so3 import Array, Vector3

MAX_GAP_S: Final = 1.0
"""A joint is stale between two readings farther apart than this, and this long after the last."""

ReadingValues: TypeAlias = tuple[float, float, float, float]
"""Position, its sigma, rate, its sigma."""


class Provenance(IntEnum):
    """How a position at an instant was obtained."""

    MEASURED = 0
    INTERPOLATED = 1
    HELD = 2
    PREDICTED = 3
    DEFAULT = 4
    """Nothing was received: the default position."""


class Reading(NamedTuple):
    """A coordinate at `utime`: radians or meters (per second); sigmas are nan where unknown.

    stamp: of the newest measurement used. gap: seconds between the measurements around it, or since the one that was
    held or extrapolated. acceleration: where more is known of it than the readings of the coordinate itself give.
    """

    utime: int
    position: float
    sigma: float = NAN
    rate: float = NAN
    rate_sigma: float = NAN
    provenance: Provenance = Provenance.MEASURED
    stamp: int = 0
    gap: float = 0.0
    acceleration: float = NAN


class ReadingPair(NamedTuple):
    """Two successive readings, `t0` before `t1`."""

    t0: int
    low: ReadingValues
    t1: int
    high: ReadingValues

    @property
    def span(self) -> float:
        """Seconds between the two."""
        return (self.t1 - self.t0) * 1e-6


PREDICTION_LIMIT_S: Final = 1.0
"""Largest time after the newest reading for which a position is predicted."""

MIN_SPAN_S: Final = 1e-3
"""Readings nearer to each other give no slope: it would be dominated by their errors."""

MIN_ACCELERATION: Final = 1.0
"""Radians or meters per second squared: acceleration of a joint without a rate limit that may start to move at any
time.
"""

MAX_READINGS: Final = 20_000
"""Readings stored for a coordinate; a flood shortens the time covered and does not use more memory."""

BLOCK_SIZE: Final = 512
"""Readings in a block, at most twice as many after insertions: the cost of a delayed reading."""

_COLUMNS: Final = 4

_INTERPOLATED: Final = Provenance.INTERPOLATED
"""Looked up once: accessing an enumeration member costs more than the arithmetic around it."""


class _Block(NamedTuple):
    """Successive readings. A block may grow at its end: each track knows how many readings are its own."""

    times: array[int]
    values: array[float]

    def copy(self, start: int, end: int) -> _Block:
        return _Block(self.times[start:end], self.values[start * _COLUMNS : end * _COLUMNS])

    def at(self, index: int) -> ReadingValues:
        position, sigma, rate, rate_sigma = self.values[index * _COLUMNS : (index + 1) * _COLUMNS]
        return position, sigma, rate, rate_sigma


class ReadingBrackets(NamedTuple):
    """The readings before and after each of n instants, and the fraction of the interval between them: arrays of n."""

    t0: npt.NDArray[np.int64]
    t1: npt.NDArray[np.int64]
    low: Array
    high: Array
    fraction: Array


class JointTrack:
    """The readings of one coordinate, by time. Immutable: `insert` returns the next track.

    Tracks share their blocks and differ in the end of the last one, to which the newest track appends. Where a reading
    is inserted between others, or appended to an older track, the block concerned is copied.
    """

    __slots__ = ("_blocks", "_count", "_end", "_firsts", "_horizon", "_is_continuous", "_start", "source")

    # declared for the journal, which stores them
    _blocks: tuple[_Block, ...]
    _firsts: tuple[int, ...]
    _start: int
    _end: int
    _count: int
    _horizon: int
    _is_continuous: bool
    source: str

    def __init__(self, seconds: float, is_continuous: bool = False):
        """Create an empty track of some seconds; `is_continuous`: an angle without limits, unwrapped at full turns."""
        self._is_continuous = is_continuous
        self._blocks = ()
        self._firsts = ()
        self._start = 0
        """In the first block: earlier readings are dropped."""
        self._end = 0
        """In the last block; the others are used completely."""
        self._count = 0
        self._horizon = round(seconds * 1e6)
        self.source = ""
        """The source of the newest reading; set by the caller of `insert`."""

    def __len__(self) -> int:
        return self._count

    @property
    def first(self) -> int:
        """The oldest time covered. Only when not empty."""
        return self._blocks[0].times[self._start]

    @property
    def last(self) -> int:
        """The newest time covered. Only when not empty."""
        return self._blocks[-1].times[self._end - 1]

    def _copy(self) -> JointTrack:
        twin = JointTrack.__new__(JointTrack)
        twin._blocks, twin._firsts, twin._start, twin._end = self._blocks, self._firsts, self._start, self._end
        twin._count, twin._horizon, twin.source = self._count, self._horizon, self.source
        twin._is_continuous = self._is_continuous
        return twin

    def detach(self) -> JointTrack:
        """Return the same readings with a last block that no successor extends."""
        twin = self._copy()
        if self._blocks:
            twin._blocks = (*self._blocks[:-1], self._blocks[-1].copy(0, self._end))
        return twin

    def with_continuous(self, is_continuous: bool) -> JointTrack:
        """Return the same readings, of a coordinate that is continuous or not."""
        if is_continuous == self._is_continuous:
            return self
        twin = self._copy()
        twin._is_continuous = is_continuous
        return twin

    def is_too_old(self, utime: int) -> bool:
        if not self._count:
            return False
        return self.last - utime > self._horizon or (self._count >= MAX_READINGS and utime < self.first)

    def insert(self, utime: int, values: ReadingValues) -> JointTrack:
        """Return the track with a further reading, which may be delayed (out of sequence).

        Returns itself for a reading that is too old or brings nothing new. Of two for one instant the one with the
        smaller sigma counts.
        """
        if self._count and utime <= self.last:
            return self._insert_delayed(utime, values)
        extended = self._copy()
        end = self._end
        if not self._blocks or end >= BLOCK_SIZE:
            extended._blocks = (*self._blocks, _Block(array("q", (utime,)), array("d", values)))
            extended._firsts = (*self._firsts, utime)
            extended._end = 1
        else:
            tail = self._blocks[-1]
            if end != len(tail.times):
                # an older track is extended, whose block has grown since
                tail = tail.copy(0, end)
                extended._blocks = (*self._blocks[:-1], tail)
            tail.times.append(utime)
            tail.values.extend(values)
            extended._end = end + 1
        extended._count += 1
        return extended._drop_expired()

    def _insert_delayed(self, utime: int, values: ReadingValues) -> JointTrack:
        if self.is_too_old(utime):
            return self
        number, index = self._before(utime) if utime >= self.first else (0, self._start - 1)
        block = self._blocks[number]
        start = self._start if number == 0 else 0
        same = index >= start and block.times[index] == utime
        if same and _sort_key(values) <= _sort_key(block.at(index)):
            return self
        copy = block.copy(start, self._get_length(number))
        index -= start
        if same:
            copy.values[index * _COLUMNS : (index + 1) * _COLUMNS] = array("d", values)
        else:
            copy.times.insert(index + 1, utime)
            copy.values[(index + 1) * _COLUMNS : (index + 1) * _COLUMNS] = array("d", values)
        size = len(copy.times)
        parts = (copy,) if size <= 2 * BLOCK_SIZE else (copy.copy(0, BLOCK_SIZE), copy.copy(BLOCK_SIZE, size))
        extended = self._copy()
        extended._blocks = (*self._blocks[:number], *parts, *self._blocks[number + 1 :])
        extended._firsts = (*self._firsts[:number], *[each.times[0] for each in parts], *self._firsts[number + 1 :])
        if number == 0:
            extended._start = 0
        if number == len(self._blocks) - 1:
            extended._end = len(parts[-1].times)
        extended._count += not same
        return extended._drop_expired()

    def _drop_expired(self) -> JointTrack:
        """Drop readings that are too old or too many; only for a new track that is not shared yet."""
        oldest = self.last - self._horizon
        while self._count > MAX_READINGS or self._blocks[0].times[self._start] < oldest:
            self._start += 1
            self._count -= 1
            if self._start == self._get_length(0):
                self._blocks, self._firsts, self._start = self._blocks[1:], self._firsts[1:], 0
        return self

    def _get_length(self, number: int) -> int:
        return self._end if number == len(self._blocks) - 1 else len(self._blocks[number].times)

    def _before(self, utime: int) -> tuple[int, int]:
        """Return block and index of the newest reading not after a time."""
        firsts = self._firsts
        number = len(firsts) - 1
        if utime >= firsts[number]:
            end = self._end
        else:
            number = bisect_right(firsts, utime) - 1
            end = len(self._blocks[number].times)
        return number, bisect_right(self._blocks[number].times, utime, 0 if number else self._start, end) - 1

    @property
    def newest(self) -> Reading:
        """The newest reading. Only when not empty."""
        return self._read(len(self._blocks) - 1, self._end - 1)

    def _read(self, number: int, index: int) -> Reading:
        block = self._blocks[number]
        utime = block.times[index]
        return Reading(utime, *block.at(index), Provenance.MEASURED, utime)

    def interpolate(self, utime: int) -> Reading:
        """Return the coordinate at a time between two readings: position linear in time.

        The rate is interpolated where both readings have one, else the slope between them; nan where they are too near
        for one. Raises TooOldError, TooNewError.
        """
        blocks = self._blocks
        if utime > blocks[-1].times[self._end - 1]:
            raise TooNewError(
                self._describe_span(utime, "after") + "; ask with policy PREDICTED, or give wait_ms to wait"
            )
        if utime < blocks[0].times[self._start]:
            raise TooOldError(self._describe_span(utime, "before"))
        number, before = self._before(utime)
        times, values = blocks[number]
        t0 = times[before]
        if t0 == utime:
            return self._read(number, before)
        # it is not the last one: that is at `utime` or later
        after = before + 1
        if after < len(times):
            t1 = times[after]
            p0, s0, r0, rs0, p1, s1, r1, rs1 = values[before * _COLUMNS : (after + 1) * _COLUMNS]
        else:
            p0, s0, r0, rs0 = blocks[number].at(before)
            t1 = blocks[number + 1].times[0]
            p1, s1, r1, rs1 = blocks[number + 1].at(0)
        fraction = (utime - t0) / (t1 - t0)
        span = (t1 - t0) * 1e-6
        difference = p1 - p0
        if self._is_continuous:
            difference = _unwrap_difference(p0, p1, 0.5 * (r0 + r1) * span)
        rate = r0 + (r1 - r0) * fraction
        if rate != rate and span >= MIN_SPAN_S:
            rate = difference / span
        # the larger of the two, nan where either is unknown
        sigma = s0 if s0 != s0 or s0 > s1 else s1
        rate_sigma = rs0 if rs0 != rs0 or rs0 > rs1 else rs1
        # as `Reading(...)`, at a third of its cost: every lookup creates one for each joint
        return new_tuple(
            Reading, (utime, p0 + difference * fraction, sigma, rate, rate_sigma, _INTERPOLATED, t1, span, NAN)
        )

    def hold(self, utime: int) -> Reading:
        """Return the newest reading not after a time (hold-last-value). Raises TooOldError."""
        if self.first > utime:
            raise TooOldError(self._describe_span(utime, "before"))
        found = self._read(*self._before(utime))
        if found.utime == utime:
            return found
        return found._replace(utime=utime, provenance=Provenance.HELD, gap=(utime - found.utime) * 1e-6)

    def predict(self, utime: int, rate_limit: float, slope: float | None = None) -> Reading:
        """Return the coordinate at a time after the newest reading: position at constant rate, with growing sigma.

        Where no rate was received it is the slope of the newest readings, limited by `rate_limit`, or `slope` where
        that is given. The rate may change by `rate_limit` within a second; without a limit by twice itself, and by
        `MIN_ACCELERATION` at least. Without any rate the position is held, with an unknown sigma unless there is a
        limit. Raises TooNewError.
        """
        newest = self.newest
        dt = (utime - newest.utime) * 1e-6
        if dt > PREDICTION_LIMIT_S:
            raise TooNewError(
                self._describe_span(utime, "after") + f"; joints are predicted {PREDICTION_LIMIT_S:g} s at most"
            )
        rate, rate_sigma0 = newest.rate, newest.rate_sigma
        limit = rate_limit if math.isfinite(rate_limit) and rate_limit > 0.0 else NAN
        if rate != rate:
            rate, rate_sigma0 = self._slope() if slope is None else slope, NAN
            if limit == limit and rate == rate:
                rate = min(max(rate, -limit), limit)
        if rate != rate:
            rate, rate_sigma0 = 0.0, limit
        elif rate_sigma0 != rate_sigma0:
            rate_sigma0 = 0.1 * abs(rate)
        change = limit if limit == limit else max(2.0 * abs(rate), MIN_ACCELERATION)
        sigma = math.hypot(newest.sigma, rate_sigma0 * dt, 0.5 * change * dt * dt)
        rate_sigma = math.hypot(rate_sigma0, change * dt)
        position = newest.position + rate * dt
        return Reading(utime, position, sigma, rate, rate_sigma, Provenance.PREDICTED, newest.utime, dt)

    def _slope(self) -> float:
        """Return the slope from the newest reading and the next that is not too near; nan where there is none."""
        pair = self.find_last_pair()
        return NAN if pair is None else self._difference(pair) / pair.span

    def find_last_pair(self) -> ReadingPair | None:
        """Return the newest reading and the newest one far enough before it for a slope, None where there is none."""
        end = self.last
        if self.first > end - _MIN_SPAN_US:
            return None
        number, index = self._before(end - _MIN_SPAN_US)
        block = self._blocks[number]
        return ReadingPair(block.times[index], block.at(index), end, self._blocks[-1].at(self._end - 1))

    def find_pair(self, utime: int) -> ReadingPair | None:
        """Return the readings around a time, for a measured one itself and the one before; None without two.

        Outside the time covered they are the last two, or the first two.
        """
        if self._count < 2:
            return None
        number, index = self._before(min(max(utime - 1, self.first), self.last - 1))
        later, after = (number, index + 1) if index + 1 < self._get_length(number) else (number + 1, 0)
        block, other = self._blocks[number], self._blocks[later]
        return ReadingPair(block.times[index], block.at(index), other.times[after], other.at(after))

    def estimate_derivatives(self, reading: Reading) -> tuple[float, float]:
        """Return rate and acceleration at a reading of this track; nan where unknown.

        The rate is the received one, else the slope between the readings around; the acceleration is the reading's own,
        else the slope of the received rates.
        """
        rate = reading.rate
        if reading.provenance is Provenance.HELD:
            return rate, NAN
        pair = self.find_pair(reading.utime)
        if pair is None or not MIN_SPAN_S <= pair.span <= MAX_GAP_S:
            return rate, reading.acceleration
        change = reading.acceleration
        if change != change:
            change = (pair.high[2] - pair.low[2]) / pair.span
        return self._difference(pair) / pair.span if rate != rate else rate, change

    def _difference(self, pair: ReadingPair) -> float:
        (p0, _, r0, _), (p1, _, r1, _) = pair.low, pair.high
        return _unwrap_difference(p0, p1, 0.5 * (r0 + r1) * pair.span) if self._is_continuous else p1 - p0

    def bracket(self, utimes: npt.NDArray[np.int64]) -> ReadingBrackets:
        """Return the readings around each of the times, at least one, within the time covered."""
        begin, index = self._before(int(utimes.min()))
        end, stop = self._before(int(utimes.max()))
        times, values = array("q"), array("d")
        # copies: an array whose buffer is exported cannot grow; the window and one reading after it
        for number in range(begin, min(end + 2, len(self._blocks))):
            low = index if number == begin else 0
            high = self._get_length(number) if number <= end else 1
            if number == end:
                high = min(stop + 2, high)
            times += self._blocks[number].times[low:high]
            values += self._blocks[number].values[low * _COLUMNS : high * _COLUMNS]
        t, rows = np.frombuffer(times, dtype=np.int64), np.frombuffer(values).reshape(-1, _COLUMNS)
        before = np.searchsorted(t, utimes, side="right") - 1
        after = np.where(t[before] == utimes, before, np.minimum(before + 1, len(t) - 1))
        fraction = (utimes - t[before]) / np.maximum(t[after] - t[before], 1)
        return ReadingBrackets(t[before], t[after], rows[before], rows[after], fraction)

    def interpolate_batch(self, utimes: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Return positions, sigmas, and the gaps between readings in seconds, at times within the time covered.

        As `interpolate` for each time.
        """
        if not len(utimes):
            return np.empty(0), np.empty(0), np.empty(0)
        return self.interpolate_brackets(self.bracket(utimes))

    def interpolate_brackets(self, around: ReadingBrackets) -> tuple[Array, Array, Array]:
        """Return what `interpolate_batch` does, from the readings around each time."""
        t0, t1, low, high, fraction = around
        gap = (t1 - t0) * 1e-6
        difference = high[:, 0] - low[:, 0]
        if self._is_continuous:
            expected = 0.5 * (low[:, 2] + high[:, 2]) * gap
            is_known = ~np.isnan(expected)
            short = np.where(np.abs(difference) > math.pi, np.copysign(math.tau, difference), 0.0)
            full = math.tau * np.round((difference - np.where(is_known, expected, 0.0)) / math.tau)
            turns = np.where(is_known, full, short)
            counts = np.maximum(np.abs(low[:, 0]), np.abs(high[:, 0])) > math.tau
            difference = np.where(counts, difference, difference - turns)
        positions = low[:, 0] + difference * fraction
        sigmas = np.where(gap == 0.0, low[:, 1], np.maximum(low[:, 1], high[:, 1]))
        return np.asarray(positions), np.asarray(sigmas), np.asarray(gap)

    def _describe_span(self, utime: int, side: str) -> str:
        edge = self.last if side == "after" else self.first
        return (
            f"{utime} is {abs(utime - edge) / 1e6:.3f} s {side} the time covered: {self.first} to {self.last} "
            f"({(self.last - self.first) / 1e6:.1f} s)"
        )


_MIN_SPAN_US: Final = round(MIN_SPAN_S * 1e6)


def _unwrap_difference(p0: float, p1: float, expected: float) -> float:
    """Return the difference p1 - p0 of two angles, unwrapped where readings restart at a full turn.

    The result is the one nearest to the `expected` difference, which follows from the rates; where those are nan, the
    shorter arc. Readings beyond a full turn are of a joint that counts its turns.
    """
    difference = p1 - p0
    if abs(p0) > math.tau or abs(p1) > math.tau:
        return difference
    if expected == expected:
        return difference - math.tau * round((difference - expected) / math.tau)
    return difference - math.copysign(math.tau, difference) if abs(difference) > math.pi else difference


def _sort_key(values: ReadingValues) -> tuple[float, ...]:
    """Return the order of two readings of one instant: the smaller sigma first, then any fixed order."""
    position, sigma, rate, rate_sigma = values
    return (
        -sigma if sigma == sigma else -math.inf,
        position,
        -rate_sigma if rate_sigma == rate_sigma else -math.inf,
        rate if rate == rate else -math.inf,
    )


ROTATION_VECTOR_TYPES: Final = (JointType.SPHERICAL, JointType.FLOATING)
"""The joint types whose last three coordinates are a rotation vector."""

_UNKNOWN: Final[Vector3] = (math.nan, math.nan, math.nan)


class _Ends(NamedTuple):
    """A rotation vector and its rate at two instants, and the seconds between."""

    v0: Vector3
    rate0: Vector3
    v1: Vector3
    rate1: Vector3
    span: float

    @classmethod
    def of(cls, pairs: Sequence[ReadingPair | None]) -> _Ends | None:
        """Return them from the readings of the three coordinates; None where their times differ, or there are none."""
        x, y, z = pairs
        if x is None or y is None or z is None or not (x.t0 == y.t0 == z.t0 and x.t1 == y.t1 == z.t1):
            return None
        return cls(
            (x.low[0], y.low[0], z.low[0]),
            (x.low[2], y.low[2], z.low[2]),
            (x.high[0], y.high[0], z.high[0]),
            (x.high[2], y.high[2], z.high[2]),
            x.span,
        )

    @property
    def rotation(self) -> Vector3:
        """The rotation vector from the first orientation to the second."""
        q = so3.multiply(so3.exponential(self.v1), so3.conjugate(so3.exponential(self.v0)))
        return so3.logarithm(so3.normalize(q))

    @property
    def angular_velocity(self) -> Array:
        """The angular velocity between the two; nan where they are too near for one."""
        return np.array(self.rotation if self.span >= MIN_SPAN_S else _UNKNOWN) / self.span


def combine(
    tracks: Sequence[JointTrack | None], readings: tuple[Reading, ...], rate_limits: Sequence[float]
) -> tuple[Reading, ...]:
    """Return the readings of a rotation vector's three coordinates, corrected from those of the single coordinates.

    Unchanged where the readings are of different instants or held.
    """
    x, y, z = tracks
    provenance = readings[0].provenance
    if (
        x is None
        or y is None
        or z is None
        or provenance is Provenance.HELD
        or any(each.provenance is not provenance for each in readings)
    ):
        return readings
    utime = readings[0].utime
    if provenance is Provenance.PREDICTED:
        return _predict((x, y, z), utime, rate_limits, readings)
    ends = _Ends.of((x.find_pair(utime), y.find_pair(utime), z.find_pair(utime)))
    if ends is None:
        return readings
    w0, w1 = _compute_turn(ends.v0, ends.rate0), _compute_turn(ends.v1, ends.rate1)
    change = (w1 - w0) / ends.span if ends.span >= MIN_SPAN_S else np.array(_UNKNOWN)
    v = so3.to_vector3([each.position for each in readings])
    if provenance is Provenance.MEASURED:
        rates = np.array([each.rate for each in readings])
        has_rates = not np.isnan(rates).any()
        w = _compute_turn(v, rates) if has_rates else ends.angular_velocity
    else:
        pair = x.find_pair(utime)
        fraction = (utime - pair.t0) / (pair.t1 - pair.t0) if pair is not None else 0.0
        a, b, c = ends.rotation
        turned = so3.multiply(so3.exponential((a * fraction, b * fraction, c * fraction)), so3.exponential(ends.v0))
        v = find_nearest_equivalent(so3.logarithm(so3.normalize(turned)), ends.v0 if fraction < 0.5 else ends.v1)
        w = w0 + (w1 - w0) * fraction
        if np.isnan(w).any():
            w = ends.angular_velocity
    rate, second = _to_vector_rates(v, w, change)
    if provenance is Provenance.MEASURED and has_rates:
        rate = rates
    return tuple(
        [
            each._replace(position=v[n], rate=float(rate[n]), acceleration=float(second[n]))
            for n, each in enumerate(readings)
        ]
    )


def _predict(
    tracks: tuple[JointTrack, JointTrack, JointTrack],
    utime: int,
    rate_limits: Sequence[float],
    readings: tuple[Reading, ...],
) -> tuple[Reading, ...]:
    if not tracks[0].last == tracks[1].last == tracks[2].last:
        return readings
    v1 = so3.to_vector3([track.newest.position for track in tracks])
    ends = _Ends.of([track.find_last_pair() for track in tracks])
    if ends is not None:
        slopes, _ = _to_vector_rates(v1, ends.angular_velocity, np.array(_UNKNOWN))
        readings = tuple(
            [
                track.predict(utime, limit, float(slope))
                for track, limit, slope in zip(tracks, rate_limits, slopes, strict=True)
            ]
        )
    w = _compute_turn(v1, [each.rate for each in readings])
    dt = readings[0].gap
    turned = so3.multiply(so3.exponential(so3.to_vector3(w * dt)), so3.exponential(v1))
    v = find_nearest_equivalent(so3.logarithm(so3.normalize(turned)), v1)
    rate, _ = _to_vector_rates(v, w, np.array(_UNKNOWN))
    return tuple([each._replace(position=v[n], rate=float(rate[n])) for n, each in enumerate(readings)])


def _compute_turn(v: Vector3, rate: Iterable[float]) -> Array:
    """Return the angular velocity J(v) v'."""
    return np.array(compute_turn_motion(v, so3.to_vector3(rate))[0])


def _to_vector_rates(v: Vector3, w: Array, change: Array) -> tuple[Array, Array]:
    """Return v' and v'' from an angular velocity and its change; nan near full turns, where J is singular."""
    angle = math.hypot(*v)
    # the determinant of J is the square of 2 sin(angle / 2) / angle
    if angle > 1.0 and abs(2.0 * math.sin(0.5 * angle)) < 1e-3 * angle:
        return np.array(_UNKNOWN), np.array(_UNKNOWN)
    rate = compute_turn_rate(v, so3.to_vector3(w))
    _, turning = compute_turn_motion(v, rate)
    return np.array(rate), np.array(compute_turn_rate(v, so3.to_vector3(change - turning)))


def find_nearest_equivalent(v: Vector3, other: Vector3) -> Vector3:
    """Return the rotation vector of the same orientation as `v` that is nearest to another."""
    angle = math.hypot(*v)
    axis = v
    if angle < 1e-9:
        # any axis is valid
        angle, axis = 0.0, other
    length = math.hypot(*axis)
    if length < 1e-9:
        return v
    x, y, z = axis[0] / length, axis[1] / length, axis[2] / length
    turns = round((x * other[0] + y * other[1] + z * other[2] - angle) / math.tau)
    if not turns:
        return v
    angle += math.tau * turns
    return (x * angle, y * angle, z * angle)


def interpolate_batch(
    tracks: tuple[JointTrack, JointTrack, JointTrack], utimes: npt.NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Return positions, sigmas and gaps between readings, (n, 3) each, at times within the time covered.

    As `combine` for each time.
    """
    if not len(utimes):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3))
    brackets = [track.bracket(utimes) for track in tracks]
    each = [track.interpolate_brackets(bracket) for track, bracket in zip(tracks, brackets, strict=True)]
    positions, sigmas, gaps = (np.stack(some, axis=1) for some in zip(*each, strict=True))
    turned = _slerp_brackets(brackets)
    first = brackets[0]
    same = np.all([(other.t0 == first.t0) & (other.t1 == first.t1) for other in brackets[1:]], axis=0)
    between = same & (first.fraction > 0.0)
    return np.where(between[:, None], turned, positions), sigmas, gaps


def _slerp_brackets(brackets: Sequence[ReadingBrackets]) -> Array:
    """Return the rotation vectors (n, 3) between readings of the same instants."""
    fraction = brackets[0].fraction
    low = np.stack([bracket.low[:, 0] for bracket in brackets], axis=1)
    high = np.stack([bracket.high[:, 0] for bracket in brackets], axis=1)
    q = pose_array.slerp(pose_array.exponential(low), pose_array.exponential(high), fraction)
    q = np.where(q[:, :1] < 0.0, -q, q)
    other = np.where(fraction[:, None] < 0.5, low, high)
    sines = np.linalg.norm(q[:, 1:], axis=1)
    angles = 2.0 * np.arctan2(sines, q[:, 0])
    none = angles < 1e-9
    lengths = np.where(none, np.linalg.norm(other, axis=1), sines)
    axes = np.where(none[:, None], other, q[:, 1:]) / np.where(lengths < 1e-12, 1.0, lengths)[:, None]
    angles = np.where(none, 0.0, angles)
    turns = np.round((np.einsum("ij,ij->i", axes, other) - angles) / math.tau)
    return np.asarray(axes * (angles + math.tau * turns)[:, None])
