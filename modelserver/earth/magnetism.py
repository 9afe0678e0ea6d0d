"""The earth's magnetic field by the World Magnetic Model. Pure.

The expansion and its coefficients are pygeomag's, a port of the program of the National Centers for Environmental
Information. Each release of the model predicts five years: the release that covers the time is used, so that a
recording of 2015 is compared with the field of 2015.

Source: A. Chulliat et al., "The US/UK World Magnetic Model for 2025-2030: technical report", 2025. By its error model
the standard deviation is 0.14 microtesla in each component and sqrt(0.26^2 + (5.417 / H)^2) degrees of declination,
where H is the horizontal field in microtesla; iron in buildings and in the vehicle adds to it and is usually larger.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING

from modelserver.errors import ModelServerError
from modelserver.transforms.so3 import Vector3

if TYPE_CHECKING:
    from pygeomag import GeoMag

FIRST_YEAR = 2010
END_YEAR = 2030
"""The models cover the years from the first to before the end."""

MIN_HEIGHT = -10_000.0
MAX_HEIGHT = 850_000.0
"""Heights above the ellipsoid, meters, between which the expansion is used; the report's own range starts at -1 km."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TESLA = 1e-9


def _utime_of(year: int) -> int:
    return (datetime(year, 1, 1, tzinfo=UTC) - _EPOCH) // timedelta(microseconds=1)


_FIRST = _utime_of(FIRST_YEAR)
_END = _utime_of(END_YEAR)


class MagnetismError(ModelServerError, ValueError):
    """No model covers the time, or the place is invalid."""


def is_covered(utime: int) -> bool:
    """Return whether a model covers a time, so that `field_at` has an answer."""
    return _FIRST <= utime < _END


def field_at(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> Vector3:
    """Return the earth's field along true east, true north and up, tesla, at a place and a time.

    Latitude and longitude are degrees, north and east positive; `height` is meters above the ellipsoid. It costs 0.15
    ms and is not thread-safe: pygeomag works in the memory of its object.

    Raises MagnetismError for a time outside 2010 to 2029 (see `is_covered`) and for an invalid place. Nothing is
    extrapolated past those years: the field turns by up to a degree in five years, and a clock that was never set must
    not affect the heading.
    """
    if not (math.isfinite(latitude_deg + longitude_deg + height) and abs(latitude_deg) <= 90.0):
        raise MagnetismError(f"not a place: latitude {latitude_deg}, longitude {longitude_deg} deg, height {height} m")
    if not MIN_HEIGHT <= height <= MAX_HEIGHT:
        raise MagnetismError(
            f"the World Magnetic Model ends at heights of {MIN_HEIGHT:g} and {MAX_HEIGHT:g} m, got {height:g} m"
        )
    year = _decimal_year(utime)
    result = _load_model(int(year) // 5 * 5).calculate(
        glat=latitude_deg, glon=longitude_deg, alt=height * 1e-3, time=year, allow_date_outside_lifespan=False
    )
    return (result.y * _TESLA, result.x * _TESLA, -result.z * _TESLA)


def declination(latitude_deg: float, longitude_deg: float, height: float, utime: int) -> float:
    """Return the angle from true north to magnetic north, radians; positive where magnetic north lies to the east.

    Arguments and errors are those of `field_at`. Near the magnetic poles the horizontal field vanishes: below 2
    microtesla a compass is not to be used (the model's blackout zones).
    """
    east, north, _ = field_at(latitude_deg, longitude_deg, height, utime)
    return math.atan2(east, north)


def _decimal_year(utime: int) -> float:
    """Return a time in years, with the elapsed share of the year."""
    if not is_covered(utime):
        raise MagnetismError(
            f"utime {utime} lies outside {FIRST_YEAR} to {END_YEAR - 1}, the years of the magnetic models at hand: "
            "check the clock that made the stamp; for later years, a newer modelserver has the next model"
        )
    year = (_EPOCH + timedelta(microseconds=utime)).year
    start, end = _utime_of(year), _utime_of(year + 1)
    # rounding must not move the last microsecond of 2029 past the model's end
    return min(year + (utime - start) / (end - start), math.nextafter(year + 1.0, 0.0))


@lru_cache(maxsize=4)
def _load_model(epoch: int) -> GeoMag:
    """Return the release of an epoch, from Python modules without opening files."""
    from pygeomag import GeoMag
    from pygeomag.wmm import wmm_2010, wmm_2015v2, wmm_2020, wmm_2025

    releases = {
        2010: wmm_2010.WMM_2010,
        2015: wmm_2015v2.WMM_2015v2,  # the second edition: the first erred in the Arctic
        2020: wmm_2020.WMM_2020,
        2025: wmm_2025.WMM_2025,
    }
    return GeoMag(coefficients_data=releases[epoch])
