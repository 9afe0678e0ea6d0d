"""State history by time, for queries about the past (time travel): bounded, immutable, with constant cost to append.
Pure.

Between two estimates position is linear and rotation at constant rate; where a new pose epoch begins between them the
earlier one is held. Estimates may be deferred: they are computed when first read (`DeferredEstimate`).

`Localizer` is what the core needs of one.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Generator
from typing import Final, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from modelserver.errors import TooNewError, TooOldError
from modelserver.messages import (
    VALID,
    Decision,
    Estimate,
    Invalid,
    LocalizerSummary,
    NavigationState,
    PersistedState,
    PersistOrigin,
    Quality,
    Rejected,
    Sample,
    SwitchMode,
    VehicleMotion,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3, to_vector3

MAX_DIFFERENCE_SPAN_S: Final = 0.5
"""Estimates farther apart give no angular acceleration."""


SLOPE_WINDOW_US: Final = 300_000
"""Microseconds of turn rates whose slope is the angular acceleration: vehicles turn in slower than in a third of it."""

SLOPE_POINTS: Final = 7
SLOPE_LEAST_POINTS: Final = 5
"""Estimates that are used in it, at most and at least: each may have to be computed first."""

MIN_STEP_US: Final = 4000
"""Microseconds between stored estimates, at least: bounds the memory against a flood."""


class DeferredEstimate(Protocol):
    """An estimate for `utime` that is computed when it is first read."""

    @property
    def utime(self) -> int: ...

    def resolve(self) -> Estimate:
        """Return the estimate, the same each time."""
        ...


BLOCK: Final = 256
"""Estimates of a block: what a history copies when one is replaced, and by which it divides the references that it
copies when a block begins. Both are least together at the root of its length: 387 at 600 s (`history_s` at most) and
`MIN_STEP_US` apart, 122 at the default of 60 s; this is between them."""


class _EstimateBlock:
    """Up to `BLOCK` estimates and their times, which only grow."""

    __slots__ = ("estimates", "times")

    times: array[int]
    estimates: list[Estimate | DeferredEstimate]

    def __init__(self) -> None:
        self.times = array("q")
        self.estimates = []

    def copy(self, count: int) -> _EstimateBlock:
        other = _EstimateBlock()
        other.times, other.estimates = self.times[:count], self.estimates[:count]
        return other


class History:
    """Estimates of the last seconds, by time. Immutable: `append` returns the next history.

    Successive histories share their blocks and differ in their range of them; all but the last block are full.
    Appending to an older one, whose last block has grown since, copies that block; the usual append to the newest one
    copies nothing.
    """

    __slots__ = ("_blocks", "_end", "_horizon", "_start")

    _blocks: tuple[_EstimateBlock, ...]
    _start: int
    _end: int
    _horizon: int

    def __init__(self, seconds: float):
        self._blocks = ()
        self._start = 0
        self._end = 0
        self._horizon = round(seconds * 1e6)

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def first(self) -> int:
        """The oldest time covered. Only when not empty."""
        return self._blocks[self._start // BLOCK].times[self._start % BLOCK]

    @property
    def last(self) -> int:
        """The newest time covered. Only when not empty."""
        return self._time(self._end - 1)

    @property
    def newest(self) -> Estimate:
        """The newest estimate. Only when not empty."""
        return self._at(self._end - 1)

    def _time(self, index: int) -> int:
        return self._blocks[index // BLOCK].times[index % BLOCK]

    def _at(self, index: int) -> Estimate:
        estimates, place = self._blocks[index // BLOCK].estimates, index % BLOCK
        found = estimates[place]
        if not isinstance(found, Estimate):
            # stored in the block that successors share: it is the same for all of them
            found = estimates[place] = found.resolve()
        return found

    def _find(self, utime: int, bisect: Callable[[array[int], int, int, int], int]) -> int:
        """Return the index that a bisection of all times gives."""
        start, end, blocks = self._start, self._end, self._blocks
        if end <= start:
            return start
        low, high = start // BLOCK, (end - 1) // BLOCK
        while low < high:
            middle = (low + high + 1) // 2
            # whether it is in this block or after it
            if bisect(blocks[middle].times, utime, 0, 1):
                low = middle
            else:
                high = middle - 1
        offset = low * BLOCK
        return offset + bisect(blocks[low].times, utime, max(start - offset, 0), min(end - offset, BLOCK))

    def append(self, estimate: Estimate | DeferredEstimate) -> History:
        """Return the history with a further estimate.

        One that is not newer than the last replaces all that are not older than it: it knows more, or the clock stepped
        back and two time scales must not mix.
        """
        extended = History.__new__(History)
        extended._horizon = self._horizon
        start, end, blocks, utime = self._start, self._end, self._blocks, estimate.utime
        while end > start and self._time(end - 1) >= utime:
            end -= 1
        oldest = utime - self._horizon
        while start < end and self._time(start) < oldest:
            start += 1
        if expired := start // BLOCK:
            blocks = blocks[expired:]
            start, end = start - expired * BLOCK, end - expired * BLOCK
        number, used = divmod(end, BLOCK)
        if not used:
            blocks = (*blocks[:number], _EstimateBlock())
        elif used != len(blocks[number].times):
            # the rest of the block is that of another history
            blocks = (*blocks[:number], blocks[number].copy(used))
        else:
            blocks = blocks[: number + 1]
        blocks[number].times.append(utime)
        blocks[number].estimates.append(estimate)
        extended._blocks, extended._start, extended._end = blocks, start, end + 1
        return extended

    def is_too_soon(self, utime: int) -> bool:
        """Return whether an estimate for a time would follow the newest too soon to be stored."""
        end = self._end
        return end > self._start and 0 < utime - self._time(end - 1) < MIN_STEP_US

    def with_duration(self, seconds: float) -> History:
        """Return the same history, with another duration from the next estimate on."""
        other = History.__new__(History)
        other._blocks, other._start, other._end = self._blocks, self._start, self._end
        other._horizon = round(seconds * 1e6)
        return other

    def copy_recent(self, seconds: float) -> History:
        """Return a copy of the last seconds, in blocks that no successor extends and that hold nothing else."""
        other = History(0.0)
        other._horizon = self._horizon
        if self._end > self._start:
            first = self._find(self.last - round(seconds * 1e6), bisect_left)
            blocks: list[_EstimateBlock] = []
            for index in range(first, self._end):
                if not (index - first) % BLOCK:
                    blocks.append(_EstimateBlock())
                blocks[-1].times.append(self._time(index))
                blocks[-1].estimates.append(self._blocks[index // BLOCK].estimates[index % BLOCK])
            other._blocks, other._end = tuple(blocks), self._end - first
        return other

    def at(self, utime: int) -> Estimate:
        """Return the estimate at a time, interpolated between the two around it.

        Raises TooOldError, TooNewError. Where a new epoch begins between the two, the earlier is held: poses of two
        epochs are not comparable.
        """
        self.check_span(utime)
        after = self._find(utime, bisect_right)
        before = self._at(after - 1)
        if before.utime == utime or after == self._end:
            return before
        return interpolate(before, self._at(after), utime)

    def angular_acceleration(self, utime: int) -> tuple[Vector3, float] | None:
        """Return the vehicle's angular acceleration at a time, rad/s2 along its axes, and the variance along each.

        It is the slope of a parabola that is fitted to the turn rates of SLOPE_WINDOW_US around the time (A. Savitzky
        and M. Golay, 1964), or at the ends of the history of as long before or after it; the variance is that of the
        residuals. Of too few estimates for that it is their difference, with variance nan. None where unknown.
        """
        after = min(max(self._find(utime, bisect_left), self._start + 1), self._end - 1)
        if after <= self._start:
            return None
        a, b = self._at(after - 1), self._at(after)
        span = (b.utime - a.utime) * 1e-6
        if a.motion is None or b.motion is None or a.pose_epoch != b.pose_epoch or not span <= MAX_DIFFERENCE_SPAN_S:
            return None
        begin = max(min(utime - SLOPE_WINDOW_US // 2, self.last - SLOPE_WINDOW_US), self.first)
        first = self._find(begin, bisect_left)
        last = self._find(begin + SLOPE_WINDOW_US, bisect_right) - 1
        count = min(last - first + 1, SLOPE_POINTS)
        if count >= SLOPE_LEAST_POINTS:
            near = [self._at(first + (last - first) * k // (count - 1)) for k in range(count)]
            rows = [(each.utime, each.motion) for each in near if each.pose_epoch == a.pose_epoch]
            known = [(at, motion.angular_velocity) for at, motion in rows if motion is not None]
            if len(known) >= SLOPE_LEAST_POINTS:
                return _fit_slope(known, utime)
        (x, y, z), (u, v, w) = a.motion.angular_velocity, b.motion.angular_velocity
        return ((u - x) / span, (v - y) / span, (w - z) / span), math.nan

    def hold(self, utime: int) -> Estimate:
        """Return the newest estimate not after a time (hold-last-value). Raises TooOldError."""
        if self.first > utime:
            raise TooOldError(self._describe_span(utime, "before"))
        return self._at(self._find(utime, bisect_right) - 1)

    def bracket(self, utimes: npt.NDArray[np.int64]) -> tuple[list[Estimate], npt.NDArray[np.intp]]:
        """Return the estimates around times within the history, and for each time the index of the one before it.

        The next one follows it, where there is one. No other deferred estimates are computed.
        """
        if not len(utimes):
            return [self.newest], np.zeros(0, dtype=np.intp)
        before, needed = self._find_indices(utimes)
        return [self._at(index) for index in needed.tolist()], np.searchsorted(needed, before)

    def resolve(self, utimes: npt.NDArray[np.int64]) -> Generator[None, None, None]:
        """Compute the deferred estimates that `bracket` returns, in steps: each may cost a tenth of a millisecond."""
        if not len(utimes):
            return
        for number, index in enumerate(self._find_indices(utimes)[1].tolist()):
            if not isinstance(self._blocks[index // BLOCK].estimates[index % BLOCK], Estimate):
                self._at(index)
                yield
            elif not number % 1000:
                yield

    def _find_indices(self, utimes: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Return the index of the estimate before each time, and the indices of all estimates around the times."""
        times = np.concatenate([np.frombuffer(each.times, dtype=np.int64) for each in self._blocks])
        times = times[self._start : self._end]
        before = np.maximum(np.searchsorted(times, utimes, side="right") - 1, 0)
        needed = np.unique(np.concatenate((before, np.minimum(before + 1, len(times) - 1))))
        return before + self._start, needed + self._start

    def next_after(self, utime: int) -> Estimate | None:
        """Return the oldest estimate newer than a time, None where there is none."""
        after = self._find(utime, bisect_right)
        return None if after == self._end else self._at(after)

    def check_span(self, utime: int) -> None:
        """Raise TooOldError or TooNewError for a time outside the history."""
        if utime > self.last:
            raise TooNewError(
                self._describe_span(utime, "after") + "; ask with policy PREDICTED, or give the server wait_ms to wait"
            )
        if utime < self.first:
            raise TooOldError(self._describe_span(utime, "before"))

    def _describe_span(self, utime: int, side: str) -> str:
        edge = self.last if side == "after" else self.first
        return (
            f"{utime} is {abs(utime - edge) / 1e6:.3f} s {side} the time covered: {self.first} to {self.last} "
            f"({(self.last - self.first) / 1e6:.1f} s)"
        )


def interpolate(a: Estimate, b: Estimate, utime: int) -> Estimate:
    """Return the estimate at a time between two: position linear, rotation at constant rate."""
    if a.pose_epoch != b.pose_epoch or a.origin != b.origin:
        return restamp(a, utime, Quality.HELD)
    fraction = (utime - a.utime) / (b.utime - a.utime)

    def interpolate_pose(first: Pose | None, second: Pose | None) -> Pose | None:
        return None if first is None or second is None else first.interpolate(second, fraction)

    return Estimate(
        utime,
        a.odom.interpolate(b.odom, fraction),
        interpolate_pose(a.enu, b.enu),
        interpolate_pose(a.utm, b.utm),
        b.covariance,
        b.odom_covariance,
        a.invalid | b.invalid,
        a.quality | b.quality | Quality.INTERPOLATED,
        b.pose_epoch,
        b.origin,
        max(a.horizontal_protection_level, b.horizontal_protection_level),
        max(a.heading_protection_level, b.heading_protection_level),
        b.seconds_to_limit,
        _interpolate_motion(a.motion, b.motion, fraction),
        b.is_odom_random_walk,
        max(a.horizontal_level, b.horizontal_level),
        max(a.heading_level, b.heading_level),
        max(a.limit_risk, b.limit_risk),
        max(a.horizontal_allowance, b.horizontal_allowance),
    )


def _fit_slope(rates: list[tuple[int, Vector3]], utime: int) -> tuple[Vector3, float]:
    """Return the slope at a time of the parabola through turn rates, with the variance along each axis."""
    t = np.array([(at - utime) * 1e-6 for at, _ in rates])
    A = np.column_stack((np.ones(len(t)), t, t * t))
    values = np.array([rate for _, rate in rates])
    inverse = np.linalg.inv(A.T @ A)
    x = inverse @ A.T @ values
    rest = values - A @ x
    variance = float((rest * rest).sum()) / (3 * (len(t) - 3)) * float(inverse[1, 1])
    return to_vector3(x[1]), variance


def _interpolate_motion(a: VehicleMotion | None, b: VehicleMotion | None, fraction: float) -> VehicleMotion | None:
    """Return the motion between two instants: each number linear in time."""
    if a is None or b is None:
        return None

    def interpolate_vector(first: Vector3, second: Vector3) -> Vector3:
        (x, y, z), (u, v, w) = first, second
        return (x + (u - x) * fraction, y + (v - y) * fraction, z + (w - z) * fraction)

    return VehicleMotion(
        interpolate_vector(a.velocity, b.velocity),
        interpolate_vector(a.angular_velocity, b.angular_velocity),
        interpolate_vector(a.acceleration, b.acceleration),
        b.imu_position,
        b.covariance,
        b.acceleration_sigma,
    )


def restamp(estimate: Estimate, utime: int, flag: Quality, invalid: Invalid = VALID) -> Estimate:
    """Return an estimate for another time, with a quality flag and reasons against it added."""
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
        estimate.horizontal_protection_level,
        estimate.heading_protection_level,
        estimate.seconds_to_limit,
        estimate.motion,
        estimate.is_odom_random_walk,
        estimate.horizontal_level,
        estimate.heading_level,
        estimate.limit_risk,
        estimate.horizontal_allowance,
    )


# --- interface of a localizer -------------------------------------------------------------------------------

LocalizerEvent: TypeAlias = Rejected | PersistOrigin | Decision
"""What a localizer reports beside its estimate: a rejected sample, the origin that it has set, the decision on a
measurement.
"""


@runtime_checkable
class PersistentLocalizer(Protocol):
    """A localizer with a state for the warm start of the next run."""

    def get_state_to_persist(self) -> PersistedState | None:
        """Return the state for the next run; None where it is no better than what was persisted before."""
        ...


class Localizer(Protocol):
    """An immutable localizer state. No clock: time comes in samples."""

    def process(self, sample: Sample | SwitchMode) -> tuple[Self, tuple[LocalizerEvent, ...]]: ...

    def estimate(self, utime: int) -> Estimate:
        """Return the base frame's pose predicted to `utime` from the samples processed."""
        ...

    def defer_estimate(self, utime: int) -> Estimate | DeferredEstimate:
        """Return `estimate(utime)`, deferred until it is read where that saves work."""
        ...

    def navigation(self, utime: int) -> NavigationState | None:
        """Return the navigation state as of the newest sample; None for a localizer without a filter."""
        ...

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at `utime`, at a fraction of its cost."""
        ...

    def summary(self, utime: int) -> LocalizerSummary: ...

    @property
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before the first."""
        ...
