"""Fixes and stamps as they arrive: which are good, whatever is computed with them. With the origin by fixes. Pure.

Quality of fixes (`evaluate_fix`): which are good enough, and their covariance. The receiver's own covariance is used
where it is valid. Otherwise the standard deviation is range error (UERE) times dilution of precision: HDOP covers both
horizontal axes, each has (UERE HDOP)^2 / 2.

Origin of the world frames: its capture from the first fixes (`OriginCapture`), and the projection at the vehicle.

Two receivers on one channel (`FixAlternation`): fixes alternate between two places which both move as the vehicle. A
smooth path is fitted to the last fixes. What is left of those of one receiver lies in one cloud, those of two in two,
far apart beside their width, and the fixes go back and forth between them. Noise looks so once in a thousand times: two
windows must agree. No fix shows which of the two receivers is right, so that no pose is valid.

Clock monitor: delayed and out-of-sequence measurements, stamps from the future, clock steps. Each source is judged by
its own stamps. The time of the filter is that of the leading source: the one with the highest rank of those received,
the IMU if there is one. A stamp far ahead, or behind the newest of its source, is odd. A run of `clock_jump_samples`
odd stamps in ascending order shows that the clock was set; a single one is an outlier. Only the leading source can set
time back; another one may set it forward while the leading source is silent.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import wraps
from operator import is_
from types import MappingProxyType
from typing import Any, Final, NamedTuple, ParamSpec, TypeAlias, TypeVar

import numpy as np

from modelserver.earth.geodesy import (
    NORTHERN_LIMIT,
    SOUTHERN_LIMIT,
    Geodesy,
    GeodesyError,
    LocalFrame,
    geodetic_from_ecef,
    origin_at,
)
from modelserver.estimation.filter.settings import SharedSettings
from modelserver.messages import FixType, GpsSample, Origin
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

EARTH_RADIUS: Final = 6_371_000.0
"""Meters, mean (IUGG): for directions and short ways."""

_MIN_VARIANCE = 1e-6
"""m2; no receiver is better than a millimeter."""

_MAX_VARIANCE = 1e8
"""m2; a height with a sigma of 10 km is unknown."""

_VERTICAL_RATIO = 1.6
"""Vertical over horizontal sigma where the receiver states none: satellites are above the horizon only."""


@dataclass(frozen=True, slots=True)
class AcceptedFix:
    """The position of an antenna, degrees and ellipsoidal meters (nan: unknown), with its covariance, m2.

    `east_variance`, `north_variance`, `cross` and `up_variance` are along true east, north, up. `is_stated`: the
    receiver states the covariance itself.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    east_variance: float
    north_variance: float
    cross: float
    up_variance: float
    is_stated: bool = False

    @property
    def sigma(self) -> float:
        """Sigma of each horizontal axis, root mean square, meters."""
        return math.sqrt(0.5 * (self.east_variance + self.north_variance))


P = ParamSpec("P")
R = TypeVar("R")


def reuse_last(function: Callable[P, R]) -> Callable[P, R]:
    """Return a pure function that reuses its last value if it gets the same objects again (decorator).

    For values of a sample that each of its measurements needs. The arguments are immutable, and given by position.
    """
    last: tuple[tuple[Any, ...], R] | None = None

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal last
        known = last
        if known is not None and len(known[0]) == len(args) and all(map(is_, known[0], args)):
            return known[1]
        found = function(*args, **kwargs)
        last = (args, found)
        return found

    return call


@reuse_last
def evaluate_fix(sample: GpsSample, settings: SharedSettings, may_lack_type: bool = False, /) -> AcceptedFix | str:
    """Return the fix, or the reason why it is not good enough.

    `may_lack_type`: a fix of type NONE with a covariance is one of a publisher that fills in neither type nor number of
    satellites.

    Reasons: no_fix, satellites, dilution, sigma, range (an invalid place, latitude 0 with longitude 0, beyond UTM),
    nan.
    """
    latitude, longitude = sample.latitude_deg, sample.longitude_deg
    # the receiver's dead reckoning is not an independent measurement
    is_untyped = may_lack_type and sample.fix_type is FixType.NONE and _has_covariance(sample)
    fix_type = FixType.FIX_2D if is_untyped else sample.fix_type
    if fix_type < settings.minimum_fix_type or fix_type == FixType.DEAD_RECKONING:
        return "no_fix"
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return "nan"
    if not (SOUTHERN_LIMIT <= latitude <= NORTHERN_LIMIT and -180.0 <= longitude <= 360.0):
        return "range"
    if abs(latitude) < 1e-7 and abs(longitude) < 1e-7:
        return "range"  # sent by receivers and drivers without a fix
    if 0 <= sample.satellites < settings.minimum_satellites and not (is_untyped and sample.satellites == 0):
        return "satellites"
    if sample.hdop > settings.maximum_hdop:
        return "dilution"
    height = sample.height_ellipsoidal
    if math.isnan(height):
        height = sample.height_msl + sample.undulation
    over_sea = math.isnan(height)
    if over_sea:
        height = sample.height_msl  # without undulation: wrong by its size
    if math.isinf(height) or abs(height) > 1e5:
        return "range"
    east, north, cross, up = _covariance(sample, settings)
    if over_sea:
        up = max(up, settings.assumed_height_sigma**2)
    fix = AcceptedFix(latitude, longitude, height, east, north, cross, up, _has_covariance(sample))
    return fix if fix.sigma <= settings.maximum_sigma else "sigma"


def range_error(fix_type: FixType, settings: SharedSettings) -> float:
    """Return the range error (UERE) of a fix type, meters."""
    if fix_type == FixType.RTK_FIXED:
        return settings.uere_rtk_fixed
    if fix_type == FixType.RTK_FLOAT:
        return settings.uere_rtk_float
    if fix_type == FixType.DIFFERENTIAL:
        return settings.uere_differential
    return settings.uere


def _has_covariance(sample: GpsSample) -> bool:
    """Return whether a fix states its horizontal variances."""
    stated = sample.position_covariance
    return stated is not None and 0.0 < stated[0] < math.inf and 0.0 < stated[4] < math.inf


def _covariance(sample: GpsSample, settings: SharedSettings) -> tuple[float, float, float, float]:
    """Return variances east and north, covariance, variance up: the receiver's, else range error times dilution."""
    stated = sample.position_covariance
    if stated is not None and _has_covariance(sample):
        east, cross, north, up = stated[0], stated[1], stated[4], stated[8]
        if not cross * cross < east * north:
            cross = 0.0
        if not 0.0 < up < math.inf:
            up = _VERTICAL_RATIO**2 * 0.5 * (east + north)
        least = _MIN_VARIANCE
        return max(east, least), max(north, least), cross, min(max(up, least), _MAX_VARIANCE)
    uere = range_error(sample.fix_type, settings)
    hdop = sample.hdop if sample.hdop > 0.0 else settings.assumed_hdop
    vdop = sample.vdop if 0.0 < sample.vdop < math.inf else _VERTICAL_RATIO * hdop
    # HDOP is of both axes together
    each = max(0.5 * (uere * hdop) ** 2, _MIN_VARIANCE)
    return each, each, 0.0, min(max(uere * vdop * uere * vdop, _MIN_VARIANCE), _MAX_VARIANCE)


# --- origin -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class OriginCapture:
    """The fixes so far: (utime, ECEF position, sigma)."""

    fixes: tuple[tuple[int, Vector3, float], ...] = ()

    def add_fix(
        self, utime: int, ecef: Vector3, sigma: float, settings: SharedSettings
    ) -> tuple[OriginCapture, Origin | None]:
        """Return the capture with a further fix, and the origin once it is found.

        The origin is the mean of the last `origin_fixes` fixes, once they scatter about a straight drive at constant
        speed by no more than `origin_scatter` sigmas. The vehicle may be moving: any nearby point serves as origin.
        """
        fixes = (*self.fixes, (utime, ecef, sigma))[-settings.origin_fixes :]
        if len(fixes) < settings.origin_fixes:
            return OriginCapture(fixes), None
        n = len(fixes)
        start = fixes[0][0]
        times = [(each[0] - start) * 1e-6 for each in fixes]
        mean_t = sum(times) / n
        spread = sum((t - mean_t) ** 2 for t in times)
        means, squares = [], 0.0
        for axis in range(3):
            values = [each[1][axis] for each in fixes]
            mean = sum(values) / n
            means.append(mean)
            slope = sum((t - mean_t) * (v - mean) for t, v in zip(times, values, strict=True))
            slope = slope / spread if spread > 0.0 else 0.0
            squares += sum((v - mean - slope * (t - mean_t)) ** 2 for t, v in zip(times, values, strict=True))
        scatter = math.sqrt(squares / n)
        # height has a larger error than the horizontal axes: one limit for all three together
        if scatter > settings.origin_scatter * max(each[2] for each in fixes) * math.sqrt(3.0):
            return OriginCapture(fixes), None
        try:
            return OriginCapture(), origin_at(*geodetic_from_ecef((means[0], means[1], means[2])))
        except GeodesyError:
            return OriginCapture(fixes), None


@dataclass(frozen=True, slots=True)
class OriginProjection:
    """The origin's geodesy, evaluated at the last fix and used for all poses until the next.

    `tangent_from_work` rotates from the working frame's axes to World:ENU's; `convergence` from those at the vehicle to
    World:UTM's.
    """

    geodesy: Geodesy
    tangent_from_work: Quaternion = so3.IDENTITY
    convergence: float = 0.0

    def is_in_zone(self, fix: AcceptedFix) -> bool:
        """Return whether a fix is within the range of the pinned zone."""
        try:
            self.geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0)
        except GeodesyError:
            return False
        return True

    def at(self, latitude_deg: float, longitude_deg: float, work: LocalFrame) -> OriginProjection:
        """Return the projection with the vehicle at another place."""
        return OriginProjection(
            self.geodesy,
            self.geodesy.tangent.rotation_of(work),
            self.geodesy.convergence(latitude_deg, longitude_deg),
        )


# --- two receivers on one channel ---------------------------------------------------------------------------

WINDOW: Final = 16
"""Fixes that are compared."""

MAX_STEP_US: Final = 5_000_000
"""Longest time between two of them, microseconds: over more the way driven is not smooth."""

MIN_EACH: Final = 3
MIN_SWITCHES: Final = 5
"""Fixes at each place, and changes between them: an outlier is one place of two changes, a jump one change."""

WIDTHS_APART: Final = 6.0
"""Distance of the two places over the standard deviation in each. One Gaussian cloud, cut in the middle, has 2.7."""

SIGMAS_APART: Final = 3.0
"""Distance over the sigma of a fix: fixes of one receiver that differ by less are as stated."""

AGREEMENT: Final = 0.2
"""Share of their length by which the offsets of two windows may differ."""

HOLD_US: Final = 60_000_000
"""Microseconds for which a finding holds: in a tight turn of slow fixes the path hides the offset."""


class TimedFix(NamedTuple):
    """A fix: utime, latitude and longitude in radians, sigma in m."""

    utime: int
    latitude: float
    longitude: float
    sigma: float


class Offset(NamedTuple):
    """The offset between two places among which the fixes of a window alternate: east, north, m; its last utime."""

    utime: int = 0
    east: float = 0.0
    north: float = 0.0


NO_OFFSET: Final = Offset()


class FixAlternation(NamedTuple):
    """The last fixes; `first` is the offset that waits for a window that agrees, `last` the one that agreed last."""

    fixes: tuple[TimedFix, ...] = ()
    first: Offset = NO_OFFSET
    last: Offset = NO_OFFSET

    @property
    def distance(self) -> float:
        """Distance between two places among which the fixes alternate, m; 0 if they do not."""
        return math.hypot(self.last.east, self.last.north)

    def add(self, sample: GpsSample, fix: AcceptedFix) -> FixAlternation:
        """Return the state after a fix; one that is not later than the last is left out."""
        utime = sample.header.utime
        newest = self.fixes[-1].utime if self.fixes else utime - 1
        if utime <= newest:
            return self
        known = self.fixes[1 - WINDOW :] if utime - newest <= MAX_STEP_US else ()
        place = (math.radians(fix.latitude_deg), math.radians(fix.longitude_deg))
        fixes = (*known, TimedFix(utime, *place, fix.sigma))
        first, last = (each if utime - each.utime <= HOLD_US else NO_OFFSET for each in self[1:])
        found = _find_offset(fixes) if len(fixes) == WINDOW else None
        if found is None:
            return FixAlternation(fixes, first, last)
        if not first.utime or not _agree(first, found):
            return FixAlternation(fixes, found, last)
        # a window that shares no fix with the first
        return (
            FixAlternation(fixes, first, found) if fixes[0].utime > first.utime else FixAlternation(fixes, first, last)
        )


def _agree(a: Offset, b: Offset) -> bool:
    """Return whether two offsets are the same, in either direction."""
    limit = AGREEMENT * math.hypot(b.east, b.north)
    return min(math.hypot(a.east - b.east, a.north - b.north), math.hypot(a.east + b.east, a.north + b.north)) <= limit


def _find_offset(fixes: tuple[TimedFix, ...]) -> Offset | None:
    """Return the offset between two places among which fixes alternate; None if they do not."""
    origin = fixes[0]
    scale = (EARTH_RADIUS * math.cos(origin.latitude), EARTH_RADIUS)
    turned = [(math.remainder(each.longitude - origin.longitude, math.tau), each.latitude) for each in fixes]
    places = (np.array(turned) - (0.0, origin.latitude)) * scale
    times = np.array([each.utime - origin.utime for each in fixes])
    path = np.vander(times / times[-1], 4)
    left = places - path @ np.linalg.lstsq(path, places, rcond=None)[0]
    # cut at the largest gap along the axis on which they differ most
    along = left @ np.linalg.eigh(left.T @ left)[1][:, -1]
    ordered = np.sort(along)
    cut = int(np.argmax(np.diff(ordered)))
    is_far = along > 0.5 * (ordered[cut] + ordered[cut + 1])
    near, far = along[~is_far], along[is_far]
    if min(len(near), len(far)) < MIN_EACH or np.count_nonzero(np.diff(is_far)) < MIN_SWITCHES:
        return None
    width = math.sqrt((near.var() * len(near) + far.var() * len(far)) / len(along))
    sigma = statistics.median(each.sigma for each in fixes)
    if far.mean() - near.mean() <= max(WIDTHS_APART * width, SIGMAS_APART * sigma):
        return None
    # the path took a part of the offset
    east, north = np.linalg.lstsq(np.column_stack((path, is_far)), places, rcond=None)[0][-1].tolist()
    return Offset(fixes[-1].utime, east, north)


# --- stamps -------------------------------------------------------------------------------------------------

MAX_SOURCES: Final = 256
"""Sources that are tracked: more names than that come from a flood."""

RECENT_STAMPS: Final = 8
"""Good stamps of a source that are stored, to separate a clock that was set back from one stamp that was ahead."""

MAX_SEQUENCE_STEP: Final = 100
"""Largest step of a sequence number that continues: a larger one is a restart from 0."""

REPLAY_RATE: Final = 2_000.0
REPLAY_BURST: Final = 4_000.0
"""Items per second, and at once, that delayed samples of one source may have fused again. A camera at 30 Hz with 0.2 s
of latency needs 900 beside 150 samples per second of others; a source that keeps stamping back is refused more."""

IMU_RANK: Final = 2
"""The rank of an IMU: no source leads before it."""

IMU_WAIT_US: Final = 60_000
"""Microseconds that a measurement waits for IMU samples up to its instant: most units publish within 50 ms."""


class StampVerdict(Enum):
    """What a stamp means for its sample."""

    GOOD = "good"
    TOO_OLD = "too_old"
    OUT_OF_SEQUENCE = "out_of_sequence"
    FUTURE = "future"
    STEPPED_BACK = "stepped_back"


SourceKey: TypeAlias = tuple[str, str]
"""The type of a sample and the name of its source: two types of samples may have the same source name."""


class SourceClock(NamedTuple):
    """The stamps of one source.

    Attributes
    ----------
    newest, seq: the newest good stamp and its sequence number.
    num_odd, odd_utime, odd_since: a run of odd stamps: how many, the last one, and the leading stamp at its start.
    recent: the last good stamps, the oldest first. The stamps of a clock that was set back cover a time that these
        have covered already; those that follow one stamp that was ahead do not, and are as good as those before it.
    replays: items that this source may still have fused again, as of the leading stamp `replays_utime`.
    """

    newest: int
    seq: int
    num_odd: int = 0
    odd_utime: int = 0
    odd_since: int = 0
    recent: tuple[int, ...] = ()
    replays: float = REPLAY_BURST
    replays_utime: int = 0


NEW_SOURCE: Final = SourceClock(0, -1)
"""A source before its first stamp."""


class ClockMonitor(NamedTuple):
    """The stamps of all sources. `newest` is the newest good stamp, `rank` and `lead_utime` those of the lead."""

    newest: int = 0
    rank: int = -1
    lead_utime: int = 0
    sources: Mapping[SourceKey, SourceClock] = MappingProxyType({})

    def update(
        self, name: SourceKey, rank: int, utime: int, seq: int, settings: SharedSettings, horizon: float
    ) -> tuple[ClockMonitor, StampVerdict]:
        """Return the monitor after a stamp, and what it means; `horizon` (s) is how late a sample may come."""
        newest, leading, lead_utime, sources = self
        source = sources.get(name, NEW_SOURCE)
        ahead = utime - newest
        horizon_us = round(horizon * 1e6) if ahead < 0 else 0
        if newest and ahead > settings.clock_jump * 1e6:
            source = _count_odd(source, utime, self.lead_utime)
            if source.num_odd < settings.clock_jump_samples:
                return self._with(name, source), StampVerdict.FUTURE
        elif (
            source.newest
            and utime < source.newest
            and (ahead < -horizon_us or 0 < seq - source.seq < MAX_SEQUENCE_STEP)
        ):
            # its own stamps go back: a source that is merely delayed does not, or its sequence goes back too
            source = _count_odd(source, utime, 0, is_back=True)
            if source.num_odd >= settings.clock_jump_samples and rank >= self.rank:
                return _set_back(name, rank, utime, seq), StampVerdict.STEPPED_BACK
            # within the horizon it is used while it may be chance: the result must not depend on the order of arrival
            return self._with(name, source), StampVerdict.OUT_OF_SEQUENCE if ahead < -horizon_us else StampVerdict.GOOD
        elif newest and ahead < -horizon_us:
            if source.newest or rank < self.rank:
                return self, StampVerdict.TOO_OLD
            # its first stamps: those before may be the wrong ones, and would keep it out forever
            source = _count_odd(source, utime, self.lead_utime)
            if source.num_odd >= settings.clock_jump_samples:
                return _set_back(name, rank, utime, seq), StampVerdict.STEPPED_BACK
            return self._with(name, source), StampVerdict.TOO_OLD
        if utime < source.newest:
            return self, StampVerdict.GOOD
        if source is not NEW_SOURCE or not self._is_full(name):
            recent = (*source.recent[1 - RECENT_STAMPS :], utime)
            clock = (utime, seq, 0, 0, 0, recent, source.replays, source.replays_utime)
            sources = {**sources, name: new_tuple(SourceClock, clock)}
        if rank >= leading:
            leading = rank
            if utime > lead_utime:
                lead_utime = utime
        newest = utime if utime > newest else newest
        return new_tuple(ClockMonitor, (newest, leading, lead_utime, sources)), StampVerdict.GOOD

    def spend_replays(self, name: SourceKey, items: int) -> ClockMonitor | None:
        """Return the monitor after a source has had so many items fused again; None if that is more than it may."""
        source = self.sources.get(name)
        if source is None:
            return self
        # by the time of the lead, which the source cannot stamp
        passed = max(0, self.lead_utime - source.replays_utime) * 1e-6
        left = min(REPLAY_BURST, source.replays + REPLAY_RATE * passed) - items
        return None if left < 0.0 else self._with(name, source._replace(replays=left, replays_utime=self.lead_utime))

    def get_complete_utime(self) -> int:
        """Return the instant up to which measurements can be fused without waiting for the IMU.

        A measurement after the newest IMU sample waits for the next one: fused before it, it would be fused again after
        it. It waits no longer than IMU_WAIT_US.
        """
        if self.rank == IMU_RANK and self.newest - self.lead_utime <= IMU_WAIT_US:
            return self.lead_utime
        return self.newest

    def _is_full(self, name: SourceKey) -> bool:
        """Return whether there is no room for a new source."""
        return name not in self.sources and len(self.sources) >= MAX_SOURCES

    def _with(self, name: SourceKey, source: SourceClock) -> ClockMonitor:
        if self._is_full(name):
            return self
        return self._replace(sources={**self.sources, name: source})


def _set_back(name: SourceKey, rank: int, utime: int, seq: int) -> ClockMonitor:
    return ClockMonitor(utime, rank, utime, {name: SourceClock(utime, seq, recent=(utime,))})


def _count_odd(source: SourceClock, utime: int, lead: int, is_back: bool = False) -> SourceClock:
    """Return a source after an odd stamp: successive ones make a run, unless the lead has advanced.

    A stamp behind the newest (`is_back`) lengthens the run only if good stamps have covered that time before.
    """
    follows = source.num_odd > 0 and 0 < utime - source.odd_utime <= 10_000_000 and source.odd_since == lead
    count = source.num_odd + 1 if follows else 1
    if follows and is_back and not has_covered(source.recent, source.odd_utime, utime):
        count -= 1
    return source._replace(num_odd=count, odd_utime=utime, odd_since=lead)


def has_covered(recent: tuple[int, ...], odd_utime: int, utime: int) -> bool:
    """Return whether good stamps lie between the last odd one and `utime`, as far back as they are stored."""
    return not recent or utime <= recent[0] or any(odd_utime < each <= utime for each in recent)
