"""Two receivers on one channel: fixes that alternate between two places which both move as the vehicle. Pure.

A smooth path is fitted to the last fixes. What is left of those of one receiver lies in one cloud, those of two in two,
far apart beside their width, and the fixes go back and forth between them. Noise looks so once in a thousand times: two
windows must agree. No fix shows which of the two receivers is right, so that no pose is valid.
"""

from __future__ import annotations

import math
import statistics
from typing import Final, NamedTuple

import numpy as np

from modelserver.estimation.fix_quality import EARTH_RADIUS, AcceptedFix
from modelserver.messages import GpsSample

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
