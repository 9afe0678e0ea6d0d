"""Quality check of GNSS fixes: which are good enough, and their covariance.

The receiver's own covariance is used where it is valid. Otherwise the standard deviation is range error (UERE) times
dilution of precision: HDOP covers both horizontal axes, each has (UERE HDOP)^2 / 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from operator import is_
from typing import Any, Final, ParamSpec, TypeVar

from modelserver.earth.geodesy import NORTHERN_LIMIT, SOUTHERN_LIMIT
from modelserver.estimation.settings import FixSettings
from modelserver.messages import FixType, GpsSample

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
def evaluate_fix(sample: GpsSample, settings: FixSettings, may_lack_type: bool = False, /) -> AcceptedFix | str:
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


def range_error(fix_type: FixType, settings: FixSettings) -> float:
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


def _covariance(sample: GpsSample, settings: FixSettings) -> tuple[float, float, float, float]:
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
