"""Time-indexed estimates: bounded, immutable to their holder, cheap to extend. Pure."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Generator
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from modelserver.errors import TooNewError, TooOldError
from modelserver.messages import VALID, Estimate, Invalid, Quality, VehicleMotion
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3

LONGEST_STEP_S: Final = 0.5
"""Between estimates farther apart nothing is told of how the turn rate changed."""


STEP_US: Final = 4000
"""Microseconds between the estimates that are worth holding, at least: a flood must not fill the memory."""


class Later(Protocol):
    """An estimate for `utime` that is worked out when it is looked at."""

    @property
    def utime(self) -> int:
        """The instant that it is for."""
        ...

    def resolved(self) -> Estimate:
        """Return it: the same each time."""
        ...


class History:
    """Estimates of the last seconds, by time. Immutable: `extended` returns the longer one.

    Both share one list and differ in how far they look into it; extending an old one, whose list has grown
    since, copies. So the usual course of things, each the successor of the last, costs no copy.
    """

    __slots__ = ("_end", "_estimates", "_horizon", "_start", "_times")

    _times: array[int]
    _estimates: list[Estimate | Later]
    _start: int
    _end: int
    _horizon: int

    def __init__(self, seconds: float):
        self._times = array("q")
        self._estimates = []
        self._start = 0
        self._end = 0
        self._horizon = round(seconds * 1e6)

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def first(self) -> int:
        """The oldest time held. Only when not empty."""
        return self._times[self._start]

    @property
    def last(self) -> int:
        """The newest time held. Only when not empty."""
        return self._times[self._end - 1]

    @property
    def newest(self) -> Estimate:
        """The newest estimate. Only when not empty."""
        return self._at(self._end - 1)

    def _at(self, index: int) -> Estimate:
        found = self._estimates[index]
        if not isinstance(found, Estimate):
            # kept in the list that successors share: it is the same for all of them
            found = self._estimates[index] = found.resolved()
        return found

    def extended(self, estimate: Estimate | Later) -> History:
        """Return the history with one estimate more.

        One that is not newer than the last takes the places of all that are not older than it: it knows more,
        or time has stepped back and two times must not be mixed.
        """
        longer = History.__new__(History)
        longer._horizon = self._horizon
        start, end = self._start, self._end
        while end > start and self._times[end - 1] >= estimate.utime:
            end -= 1
        oldest = estimate.utime - self._horizon
        while start < end and self._times[start] < oldest:
            start += 1
        fresh = end != len(self._times)
        if fresh or (start > 1024 and start > end - start):
            # an old history is extended, or more is past than held: copy what is held
            longer._times = self._times[start:end]
            longer._estimates = self._estimates[start:end]
            start, end = 0, end - start
        else:
            longer._times = self._times
            longer._estimates = self._estimates
        longer._times.append(estimate.utime)
        longer._estimates.append(estimate)
        longer._start, longer._end = start, end + 1
        return longer

    def holds_enough(self, utime: int) -> bool:
        """Return whether an estimate for a time would come too soon after the newest to be worth holding."""
        return len(self) > 0 and 0 < utime - self.last < STEP_US

    def lasting(self, seconds: float) -> History:
        """Return what is held now, to be held for another time from the next estimate on."""
        other = History.__new__(History)
        other._times, other._estimates = self._times, self._estimates
        other._start, other._end, other._horizon = self._start, self._end, round(seconds * 1e6)
        return other

    def recent(self, seconds: float) -> History:
        """Return what is held of the last seconds before the newest, in lists of its own that nobody else extends."""
        other = History.__new__(History)
        start = self._start
        if self._end > start:
            oldest = self._times[self._end - 1] - round(seconds * 1e6)
            start = bisect_left(self._times, oldest, start, self._end)
        other._times, other._estimates = self._times[start : self._end], self._estimates[start : self._end]
        other._start, other._end, other._horizon = 0, self._end - start, self._horizon
        return other

    def at(self, utime: int) -> Estimate:
        """Return the estimate at a time, interpolated between the two around it.

        Raises TooOldError, TooNewError. Where a new epoch begins between the two, the earlier is held: what
        lies between two epochs was nobody's pose.
        """
        self.check_span(utime)
        after = bisect_right(self._times, utime, self._start, self._end)
        before = self._at(after - 1)
        if before.utime == utime or after == self._end:
            return before
        return interpolated(before, self._at(after), utime)

    def turn_acceleration(self, utime: int) -> Vector3 | None:
        """Return how the turn rate of the vehicle changes around a time, rad/s2 along its own axes; None: not known."""
        after = min(max(bisect_left(self._times, utime, self._start, self._end), self._start + 1), self._end - 1)
        if after <= self._start:
            return None
        a, b = self._at(after - 1), self._at(after)
        span = (b.utime - a.utime) * 1e-6
        if a.motion is None or b.motion is None or a.pose_epoch != b.pose_epoch or not span <= LONGEST_STEP_S:
            return None
        (x, y, z), (u, v, w) = a.motion.rate, b.motion.rate
        return ((u - x) / span, (v - y) / span, (w - z) / span)

    def held(self, utime: int) -> Estimate:
        """Return the newest estimate not newer than a time. Raises TooOldError."""
        if self._times[self._start] > utime:
            raise TooOldError(self._span(utime, "before"))
        return self._at(bisect_right(self._times, utime, self._start, self._end) - 1)

    def around(self, utimes: npt.NDArray[np.int64]) -> tuple[list[Estimate], npt.NDArray[np.intp]]:
        """Return the estimates around many times within what is held, and for each time which of them is before it.

        The one behind that is the next of them, where there is one; others than these are not worked out.
        """
        if not len(utimes):
            return [self.newest], np.zeros(0, dtype=np.intp)
        before, needed = self._needed(utimes)
        return [self._at(index) for index in needed.tolist()], np.searchsorted(needed, before)

    def resolve(self, utimes: npt.NDArray[np.int64]) -> Generator[None, None, None]:
        """Work out the estimates that `around` returns, in steps: each may cost a tenth of a millisecond."""
        if not len(utimes):
            return
        for number, index in enumerate(self._needed(utimes)[1].tolist()):
            if not isinstance(self._estimates[index], Estimate):
                self._at(index)
                yield
            elif not number % 1000:
                yield

    def _needed(self, utimes: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Return the index of the estimate before each time, and the indices of all that are around the times."""
        times = np.frombuffer(self._times[self._start : self._end], dtype=np.int64)
        before = np.maximum(np.searchsorted(times, utimes, side="right") - 1, 0)
        needed = np.unique(np.concatenate((before, np.minimum(before + 1, len(times) - 1))))
        return before + self._start, needed + self._start

    def following(self, utime: int) -> Estimate | None:
        """Return the oldest estimate newer than a time, None where there is none."""
        after = bisect_right(self._times, utime, self._start, self._end)
        return None if after == self._end else self._at(after)

    def check_span(self, utime: int) -> None:
        """Raise TooOldError or TooNewError where a time lies outside what is held."""
        if utime > self.last:
            raise TooNewError(
                self._span(utime, "after") + "; ask with policy PREDICTED, or give the server wait_ms to wait"
            )
        if utime < self.first:
            raise TooOldError(self._span(utime, "before"))

    def _span(self, utime: int, side: str) -> str:
        edge = self.last if side == "after" else self.first
        return (
            f"{utime} is {abs(utime - edge) / 1e6:.3f} s {side} what is held: {self.first} to {self.last} "
            f"({(self.last - self.first) / 1e6:.1f} s)"
        )


def interpolated(a: Estimate, b: Estimate, utime: int) -> Estimate:
    """Return the estimate at a time between two: position linear, rotation at constant rate."""
    if a.pose_epoch != b.pose_epoch or a.origin != b.origin:
        return at_time(a, utime, Quality.HELD)
    fraction = (utime - a.utime) / (b.utime - a.utime)

    def between(first: Pose | None, second: Pose | None) -> Pose | None:
        return None if first is None or second is None else first.interpolate(second, fraction)

    return Estimate(
        utime,
        a.odom.interpolate(b.odom, fraction),
        between(a.enu, b.enu),
        between(a.utm, b.utm),
        b.covariance,
        b.odom_covariance,
        a.invalid | b.invalid,
        a.quality | b.quality | Quality.INTERPOLATED,
        b.pose_epoch,
        b.origin,
        max(a.horizontal_bound, b.horizontal_bound),
        max(a.heading_bound, b.heading_bound),
        b.seconds_to_limit,
        _between(a.motion, b.motion, fraction),
        b.odom_walks,
    )


def _between(a: VehicleMotion | None, b: VehicleMotion | None, fraction: float) -> VehicleMotion | None:
    """Return the motion between two instants: each number linear in time."""
    if a is None or b is None:
        return None

    def mixed(first: Vector3, second: Vector3) -> Vector3:
        (x, y, z), (u, v, w) = first, second
        return (x + (u - x) * fraction, y + (v - y) * fraction, z + (w - z) * fraction)

    return VehicleMotion(
        mixed(a.velocity, b.velocity),
        mixed(a.rate, b.rate),
        mixed(a.acceleration, b.acceleration),
        b.felt_at,
        b.covariance,
    )


def at_time(estimate: Estimate, utime: int, flag: Quality, invalid: Invalid = VALID) -> Estimate:
    """Return an estimate restamped to a time, with a flag that says how it came there, and reasons against it added."""
    return Estimate(
        utime,
        estimate.odom,
        estimate.enu,
        estimate.utm,
        estimate.covariance,
        estimate.odom_covariance,
        estimate.invalid | invalid,
        estimate.quality | flag,
        estimate.pose_epoch,
        estimate.origin,
        estimate.horizontal_bound,
        estimate.heading_bound,
        estimate.seconds_to_limit,
        estimate.motion,
        estimate.odom_walks,
    )
