"""Satellite receivers: GPS weeks to UTC (leap seconds, week rollovers), and conversions that their drivers share.

GPS time counts weeks from 1980-01-06 00:00 UTC and has no leap seconds. The signal carries the week modulo 1024: a
receiver whose firmware is old reports times 1024 weeks (about 19.6 years) early.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from datetime import date

from modelserver.transforms.so3 import Matrix3

SECOND = 1_000_000
"""Microseconds."""
DAY = 86_400 * SECOND
WEEK = 7 * DAY
ROLLOVER = 1024 * WEEK
GPS_EPOCH = (date(1980, 1, 6) - date(1970, 1, 1)).days * DAY
"""utime of the beginning of GPS time."""

_LEAP_DATES = sorted(
    [date(year, 1, 1) for year in (1988, 1990, 1991, 1996, 1999, 2006, 2009, 2017)]
    + [date(year, 7, 1) for year in (1981, 1982, 1983, 1985, 1992, 1993, 1994, 1997, 2012, 2015)]
)
"""Days before whose beginning a second was inserted, since 1980 (IERS Bulletin C; none after 2017 up to 2026)."""

_LEAP_UTC = tuple((day - date(1970, 1, 1)).days * DAY for day in _LEAP_DATES)
_LEAP_GPS = tuple(utime - GPS_EPOCH + (number + 1) * SECOND for number, utime in enumerate(_LEAP_UTC))
"""GPS microseconds at which UTC's day begins after each inserted second."""


def count_leap_seconds(utime: int) -> int:
    """Return by how many seconds GPS time is ahead of UTC at an instant of UTC."""
    return bisect_right(_LEAP_UTC, utime)


def utime_of(week: int, microseconds: int, pivot: int) -> int:
    """Return the utime of a GPS week (rolled over or not) and microseconds into it.

    pivot: the host's date as utime, see `resolve_rollover`. Within an inserted leap second, which utime cannot
    distinguish from the second after it, the result is that of the second after it.
    """
    gps = resolve_rollover(week * WEEK + microseconds, pivot - GPS_EPOCH)
    return gps + GPS_EPOCH - bisect_right(_LEAP_GPS, gps) * SECOND


def gps_of(utime: int) -> tuple[int, int]:
    """Return the GPS week since 1980, not rolled over, and microseconds into it, of an instant of UTC."""
    return divmod(utime - GPS_EPOCH + count_leap_seconds(utime) * SECOND, WEEK)


def resolve_rollover(utime: int, pivot: int) -> int:
    """Return `utime` set later by as many rollovers as bring it within half a rollover of `pivot`.

    Only a time that is too early is corrected: a rolled-over receiver is never ahead. So a host without a date (1970)
    changes nothing. A recording more than 9.8 years old needs a pivot of its own time.
    """
    if utime >= pivot - ROLLOVER // 2:
        return utime
    return utime + -(-(pivot - ROLLOVER // 2 - utime) // ROLLOVER) * ROLLOVER


def course_from_track(track: float) -> float:
    """Convert degrees clockwise from true north to radians counter-clockwise from true east, -pi to pi."""
    return math.remainder(math.radians(90.0 - track), math.tau)


def to_covariance(east: float, north: float, up: float) -> Matrix3 | None:
    """Return the covariance of standard deviations, m2; None if one is missing (nan or 0)."""
    if not (east > 0.0 and north > 0.0 and up > 0.0):
        return None
    return (east * east, 0.0, 0.0, 0.0, north * north, 0.0, 0.0, 0.0, up * up)
