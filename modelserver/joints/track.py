"""Where one coordinate of a joint was: its readings by time. Bounded, immutable to their holder. Pure."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.errors import TooNewError, TooOldError
from modelserver.joints.reading import LONGEST_GAP_S, How, Pair, Reading, Values
from modelserver.messages import NAN
from modelserver.spatial.so3 import Array

PREDICTION_LIMIT_S: Final = 1.0
"""How far past its newest reading a joint is carried on by its rate at most."""

LEAST_SPAN_S: Final = 1e-3
"""Between two readings nearer than this no slope is taken: it would tell of their errors, not of the joint."""

LEAST_CHANGE: Final = 1.0
"""Radians or metres per second squared. Where no rate limit is stated, a joint may change its rate by this at least.

A joint that stands may begin to move, and nobody says when.
"""

MOST_READINGS: Final = 20_000
"""Held for a coordinate; a flood of readings makes the time that is held shorter, not the memory larger."""

BLOCK: Final = 512
"""Readings in a block, at most twice as many where late ones were put between: what a late reading costs to copy."""

_COLUMNS: Final = 4

_INTERPOLATED: Final = How.INTERPOLATED
_NEW: Final = tuple.__new__
"""Looked up once: the member of an enumeration costs more than the arithmetic around it."""


class _Block(NamedTuple):
    """Readings one after the other; whoever holds a block knows how many of it are his, for it may grow at its end."""

    times: array[int]
    values: array[float]

    def copied(self, start: int, end: int) -> _Block:
        return _Block(self.times[start:end], self.values[start * _COLUMNS : end * _COLUMNS])

    def at(self, index: int) -> Values:
        position, sigma, rate, rate_sigma = self.values[index * _COLUMNS : (index + 1) * _COLUMNS]
        return position, sigma, rate, rate_sigma


class Around(NamedTuple):
    """For each of many instants the readings before and after it, and what part of the way it is: arrays of n."""

    t0: npt.NDArray[np.int64]
    t1: npt.NDArray[np.int64]
    low: Array
    high: Array
    part: Array


class JointTrack:
    """The readings of one coordinate, by time. Immutable: `extended` returns the longer one.

    They lie in blocks. Successors share them all, and differ in how far they look into the last, which grows at its
    end; where one is put between others, or to an old track, the block concerned is copied, and no other.
    """

    __slots__ = ("_blocks", "_count", "_end", "_firsts", "_horizon", "_start", "_turns", "source")

    _blocks: tuple[_Block, ...]
    _firsts: tuple[int, ...]
    _start: int
    _end: int
    _count: int
    _horizon: int
    _turns: bool
    source: str

    def __init__(self, seconds: float, turns: bool = False):
        """Hold so many seconds; `turns`: an angle without limits, whose readings may begin anew at a full turn."""
        self._turns = turns
        self._blocks = ()
        self._firsts = ()
        self._start = 0
        """Of the first block: what lies before is forgotten."""
        self._end = 0
        """Of the last block; of the others all are held."""
        self._count = 0
        self._horizon = round(seconds * 1e6)
        self.source = ""
        """Who told the newest reading, as he names himself; whoever makes a longer track says it anew."""

    def __len__(self) -> int:
        return self._count

    @property
    def first(self) -> int:
        """The oldest time held. Only when not empty."""
        return self._blocks[0].times[self._start]

    @property
    def last(self) -> int:
        """The newest time held. Only when not empty."""
        return self._blocks[-1].times[self._end - 1]

    def _twin(self) -> JointTrack:
        twin = JointTrack.__new__(JointTrack)
        twin._blocks, twin._firsts, twin._start, twin._end = self._blocks, self._firsts, self._start, self._end
        twin._count, twin._horizon, twin._turns, twin.source = self._count, self._horizon, self._turns, self.source
        return twin

    def apart(self) -> JointTrack:
        """Return the same readings in a last block that no successor extends."""
        twin = self._twin()
        if self._blocks:
            twin._blocks = (*self._blocks[:-1], self._blocks[-1].copied(0, self._end))
        return twin

    def turning(self, turns: bool) -> JointTrack:
        """Return the same readings, of a coordinate that goes round, or does not."""
        if turns == self._turns:
            return self
        twin = self._twin()
        twin._turns = turns
        return twin

    def is_late(self, utime: int) -> bool:
        """Whether a reading of this time is too old to be held."""
        if not self._count:
            return False
        return self.last - utime > self._horizon or (self._count >= MOST_READINGS and utime < self.first)

    def extended(self, utime: int, values: Values) -> JointTrack:
        """Return the track with one reading more: position, its sigma, rate, its sigma.

        Itself for one too old to hold, and for one that tells nothing new. Readings may come in any order: what is
        held in the end is the same. Of two for one instant the surer counts.
        """
        if self._count and utime <= self.last:
            return self._inserted(utime, values)
        longer = self._twin()
        end = self._end
        if not self._blocks or end >= BLOCK:
            longer._blocks = (*self._blocks, _Block(array("q", (utime,)), array("d", values)))
            longer._firsts = (*self._firsts, utime)
            longer._end = 1
        else:
            tail = self._blocks[-1]
            if end != len(tail.times):
                # an old track is extended, whose block has grown since
                tail = tail.copied(0, end)
                longer._blocks = (*self._blocks[:-1], tail)
            tail.times.append(utime)
            tail.values.extend(values)
            longer._end = end + 1
        longer._count += 1
        return longer._forgetting()

    def _inserted(self, utime: int, values: Values) -> JointTrack:
        if self.is_late(utime):
            return self
        number, index = self._before(utime) if utime >= self.first else (0, self._start - 1)
        block = self._blocks[number]
        start = self._start if number == 0 else 0
        same = index >= start and block.times[index] == utime
        if same and _rank(values) <= _rank(block.at(index)):
            return self
        copy = block.copied(start, self._used(number))
        index -= start
        if same:
            copy.values[index * _COLUMNS : (index + 1) * _COLUMNS] = array("d", values)
        else:
            copy.times.insert(index + 1, utime)
            copy.values[(index + 1) * _COLUMNS : (index + 1) * _COLUMNS] = array("d", values)
        size = len(copy.times)
        parts = (copy,) if size <= 2 * BLOCK else (copy.copied(0, BLOCK), copy.copied(BLOCK, size))
        longer = self._twin()
        longer._blocks = (*self._blocks[:number], *parts, *self._blocks[number + 1 :])
        longer._firsts = (*self._firsts[:number], *[each.times[0] for each in parts], *self._firsts[number + 1 :])
        if number == 0:
            longer._start = 0
        if number == len(self._blocks) - 1:
            longer._end = len(parts[-1].times)
        longer._count += not same
        return longer._forgetting()

    def _forgetting(self) -> JointTrack:
        """Return this track, which nobody else holds yet, without what is too old or too much."""
        oldest = self.last - self._horizon
        while self._count > MOST_READINGS or self._blocks[0].times[self._start] < oldest:
            self._start += 1
            self._count -= 1
            if self._start == self._used(0):
                self._blocks, self._firsts, self._start = self._blocks[1:], self._firsts[1:], 0
        return self

    def _used(self, number: int) -> int:
        return self._end if number == len(self._blocks) - 1 else len(self._blocks[number].times)

    def _before(self, utime: int) -> tuple[int, int]:
        """Return the block, and where in it, of the newest reading not newer than a time that is not before all."""
        firsts = self._firsts
        number = len(firsts) - 1
        if utime >= firsts[number]:
            end = self._end
        else:
            number = bisect_right(firsts, utime) - 1
            end = len(self._blocks[number].times)
        return number, bisect_right(self._blocks[number].times, utime, 0 if number else self._start, end) - 1

    def _after(self, number: int, index: int) -> tuple[int, int]:
        """Return the place behind one that is not the last."""
        return (number, index + 1) if index + 1 < self._used(number) else (number + 1, 0)

    @property
    def newest(self) -> Reading:
        """The newest reading. Only when not empty."""
        return self._measured(len(self._blocks) - 1, self._end - 1)

    def _measured(self, number: int, index: int) -> Reading:
        block = self._blocks[number]
        utime = block.times[index]
        return Reading(utime, *block.at(index), How.MEASURED, utime)

    def interpolated(self, utime: int) -> Reading:
        """Return the coordinate at a time, between the two readings around it: position linear in time.

        Its rate is what the two tell, else the slope between them; nan where they are too near for one. Raises
        TooOldError, TooNewError.
        """
        blocks = self._blocks
        if utime > blocks[-1].times[self._end - 1]:
            raise TooNewError(self._span(utime, "after") + "; ask with policy PREDICTED, or give wait_ms to wait")
        if utime < blocks[0].times[self._start]:
            raise TooOldError(self._span(utime, "before"))
        number, before = self._before(utime)
        times, values = blocks[number]
        t0 = times[before]
        if t0 == utime:
            return self._measured(number, before)
        # it is not the last: that is at `utime`, or behind it
        after = before + 1
        if after < len(times):
            t1 = times[after]
            p0, s0, r0, rs0, p1, s1, r1, rs1 = values[before * _COLUMNS : (after + 1) * _COLUMNS]
        else:
            p0, s0, r0, rs0 = blocks[number].at(before)
            t1 = blocks[number + 1].times[0]
            p1, s1, r1, rs1 = blocks[number + 1].at(0)
        part = (utime - t0) / (t1 - t0)
        span = (t1 - t0) * 1e-6
        way = p1 - p0
        if self._turns:
            way = _shorter(p0, p1, 0.5 * (r0 + r1) * span)
        rate = r0 + (r1 - r0) * part
        if rate != rate and span >= LEAST_SPAN_S:
            rate = way / span
        # the worse of the two, nan where either is not known
        sigma = s0 if s0 != s0 or s0 > s1 else s1
        rate_sigma = rs0 if rs0 != rs0 or rs0 > rs1 else rs1
        # what `Reading(...)` does, at a third of its cost: a lookup makes one for each joint on its way
        return _NEW(Reading, (utime, p0 + way * part, sigma, rate, rate_sigma, _INTERPOLATED, t1, span, NAN))

    def held(self, utime: int) -> Reading:
        """Return the newest reading not newer than a time. Raises TooOldError."""
        if self.first > utime:
            raise TooOldError(self._span(utime, "before"))
        found = self._measured(*self._before(utime))
        if found.utime == utime:
            return found
        return found._replace(utime=utime, how=How.HELD, apart=(utime - found.utime) * 1e-6)

    def predicted(self, utime: int, rate_limit: float, slope: float | None = None) -> Reading:
        """Return the coordinate at a time past the newest reading, carried on by its rate, ever less sure.

        Where nobody told its rate that is the slope of the newest readings, no steeper than `rate_limit`, or `slope`
        where that is given. A rate may change by `rate_limit` within a second; where there is no limit, by twice
        itself, and by `LEAST_CHANGE` at least. Where nothing tells its rate the joint stays, and how sure that is
        nobody knows unless there is a limit. Raises TooNewError.
        """
        newest = self.newest
        ahead = (utime - newest.utime) * 1e-6
        if ahead > PREDICTION_LIMIT_S:
            raise TooNewError(self._span(utime, "after") + f"; joints are carried on {PREDICTION_LIMIT_S:g} s at most")
        rate = newest.rate
        limit = rate_limit if math.isfinite(rate_limit) and rate_limit > 0.0 else NAN
        doubt = newest.rate_sigma
        if rate != rate:
            rate = self._slope() if slope is None else slope
            if limit == limit:
                # a rate of nan stays one
                rate = min(max(rate, -limit), limit) if rate == rate else rate
            if rate != rate:
                rate, doubt = 0.0, limit
            else:
                doubt = 0.1 * abs(rate)
        elif doubt != doubt:
            doubt = 0.1 * abs(rate)
        change = limit if limit == limit else max(2.0 * abs(rate), LEAST_CHANGE)
        sigma = math.hypot(newest.sigma, doubt * ahead, 0.5 * change * ahead * ahead)
        rate_sigma = math.hypot(doubt, change * ahead)
        position = newest.position + rate * ahead
        return Reading(utime, position, sigma, rate, rate_sigma, How.PREDICTED, newest.utime, ahead)

    def _slope(self) -> float:
        """Return how fast it went at the end, from the newest reading and the next that is not too near; else nan."""
        pair = self.last_pair()
        return NAN if pair is None else self._way(pair) / pair.span

    def last_pair(self) -> Pair | None:
        """Return the newest reading and the newest of those far enough before it for a slope, where there is one."""
        end = self.last
        if self.first > end - _LEAST_SPAN_US:
            return None
        number, index = self._before(end - _LEAST_SPAN_US)
        block = self._blocks[number]
        return Pair(block.times[index], block.at(index), end, self._blocks[-1].at(self._end - 1))

    def pair(self, utime: int) -> Pair | None:
        """Return the readings around a time, of one that was measured the one before it; None where there are no two.

        Beyond what is held they are the last two, or the first two.
        """
        if self._count < 2:
            return None
        number, index = self._before(min(max(utime - 1, self.first), self.last - 1))
        later, after = self._after(number, index)
        block, other = self._blocks[number], self._blocks[later]
        return Pair(block.times[index], block.at(index), other.times[after], other.at(after))

    def changes(self, reading: Reading) -> tuple[float, float]:
        """Return rate and acceleration at a reading of this track; nan where the readings around do not tell.

        The rate is what was said, else the slope between the readings around it; the acceleration is the reading's
        own, else the slope of the rates that were said.
        """
        rate = reading.rate
        if reading.how is How.HELD:
            return rate, NAN
        pair = self.pair(reading.utime)
        if pair is None or not LEAST_SPAN_S <= pair.span <= LONGEST_GAP_S:
            return rate, reading.change
        change = reading.change
        if change != change:
            change = (pair.high[2] - pair.low[2]) / pair.span
        return self._way(pair) / pair.span if rate != rate else rate, change

    def _way(self, pair: Pair) -> float:
        (p0, _, r0, _), (p1, _, r1, _) = pair.low, pair.high
        return _shorter(p0, p1, 0.5 * (r0 + r1) * pair.span) if self._turns else p1 - p0

    def around(self, utimes: npt.NDArray[np.int64]) -> Around:
        """Return the readings around each of many times, at least one, within what is held."""
        begin, index = self._before(int(utimes.min()))
        end, stop = self._before(int(utimes.max()))
        times, values = array("q"), array("d")
        # slices, for an array that lends its memory to another cannot grow; the window and one more behind it
        for number in range(begin, min(end + 2, len(self._blocks))):
            low = index if number == begin else 0
            high = self._used(number) if number < end else min(stop + 2, self._used(number)) if number == end else 1
            times += self._blocks[number].times[low:high]
            values += self._blocks[number].values[low * _COLUMNS : high * _COLUMNS]
        t, rows = np.frombuffer(times, dtype=np.int64), np.frombuffer(values).reshape(-1, _COLUMNS)
        before = np.searchsorted(t, utimes, side="right") - 1
        after = np.where(t[before] == utimes, before, np.minimum(before + 1, len(t) - 1))
        part = (utimes - t[before]) / np.maximum(t[after] - t[before], 1)
        return Around(t[before], t[after], rows[before], rows[after], part)

    def columns(self, utimes: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Return positions, sigmas, and how far apart in seconds the readings are, at many times within what is held.

        As `interpolated` tells them one by one.
        """
        if not len(utimes):
            return np.empty(0), np.empty(0), np.empty(0)
        return self.columns_of(self.around(utimes))

    def columns_of(self, around: Around) -> tuple[Array, Array, Array]:
        """Return what `columns` does, from the readings around each time."""
        t0, t1, low, high, part = around
        apart = (t1 - t0) * 1e-6
        way = high[:, 0] - low[:, 0]
        if self._turns:
            expected = 0.5 * (low[:, 2] + high[:, 2]) * apart
            told = ~np.isnan(expected)
            short = np.where(np.abs(way) > math.pi, np.copysign(math.tau, way), 0.0)
            turns = np.where(told, math.tau * np.round((way - np.where(told, expected, 0.0)) / math.tau), short)
            counts = np.maximum(np.abs(low[:, 0]), np.abs(high[:, 0])) > math.tau
            way = np.where(counts, way, way - turns)
        positions = low[:, 0] + way * part
        sigmas = np.where(apart == 0.0, low[:, 1], np.maximum(low[:, 1], high[:, 1]))
        return np.asarray(positions), np.asarray(sigmas), np.asarray(apart)

    def _span(self, utime: int, side: str) -> str:
        edge = self.last if side == "after" else self.first
        return (
            f"{utime} is {abs(utime - edge) / 1e6:.3f} s {side} what is held: {self.first} to {self.last} "
            f"({(self.last - self.first) / 1e6:.1f} s)"
        )


_LEAST_SPAN_US: Final = round(LEAST_SPAN_S * 1e6)


def _shorter(p0: float, p1: float, expected: float) -> float:
    """Return how far it is from one angle to another, where the readings may begin anew at a full turn.

    That is the way nearest to the `expected` one, which follows from the rates; where those are nan, the short way
    round. Readings beyond a full turn either way are of a joint that counts its turns.
    """
    way = p1 - p0
    if abs(p0) > math.tau or abs(p1) > math.tau:
        return way
    if expected == expected:
        return way - math.tau * round((way - expected) / math.tau)
    return way - math.copysign(math.tau, way) if abs(way) > math.pi else way


def _rank(values: Values) -> tuple[float, ...]:
    """Return what orders two readings of one instant: the surer first, and then any order that is always the same."""
    position, sigma, rate, rate_sigma = values
    return (
        -sigma if sigma == sigma else -math.inf,
        position,
        -rate_sigma if rate_sigma == rate_sigma else -math.inf,
        rate if rate == rate else -math.inf,
    )
