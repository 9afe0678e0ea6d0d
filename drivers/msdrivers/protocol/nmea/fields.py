"""Parse and format the fields of NMEA 0183 sentences. An empty field is missing: nan or None, never zero.

Raises ValueError with the field's text for what no receiver should write. pynmea2's own conversions are not used: they
give 0 for a missing hemisphere, cut microseconds, reject 23:59:60 and return the text where they fail.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from math import inf

import pynmea2

from modelserver.messages.flags import NAN

KNOT = 1852.0 / 3600.0
"""Meters per second."""
KMH = 1.0 / 3.6
SECOND = 1_000_000

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")
_CLOCK = re.compile(r"(\d\d)(\d\d)(\d\d)(?:\.(\d*))?")
_ANGLE = re.compile(r"(\d{1,3}?)(\d\d(?:\.\d*)?)")
_UNIX_DAY = date(1970, 1, 1).toordinal()


def parse_number(text: str, least: float = -inf, most: float = inf) -> float:
    """Return a decimal number within bounds; nan for an empty field."""
    if not text:
        return NAN
    if not _NUMBER.fullmatch(text) or not least <= float(text) <= most:
        raise ValueError(f"'{text}' is no number from {least:g} to {most:g}")
    return float(text)


def parse_integer(text: str, least: int = 0, most: int = 1_000_000) -> int | None:
    """Return an integer within bounds; None for an empty field."""
    if not text:
        return None
    if not text.isdecimal() or not least <= int(text) <= most:
        raise ValueError(f"'{text}' is no integer from {least} to {most}")
    return int(text)


def parse_time_of_day(text: str) -> int | None:
    """Return microseconds since midnight of `hhmmss.ss`, up to 86401 s for 23:59:60.99; None for an empty field."""
    if not text:
        return None
    parts = _CLOCK.fullmatch(text)
    hours, minutes, seconds = (int(each) for each in parts.groups()[:3]) if parts else (24, 0, 0)
    leap = seconds == 60 and (hours, minutes) == (23, 59)
    if parts is None or hours > 23 or minutes > 59 or (seconds > 59 and not leap):
        raise ValueError(f"'{text}' is no time of day")
    return (hours * 3600 + minutes * 60 + seconds) * SECOND + int((parts[4] or "")[:6].ljust(6, "0"))


def to_unix_days(day: int, month: int, year: int) -> int:
    """Return days since 1970-01-01. ValueError for a day that does not exist."""
    return date(year, month, day).toordinal() - _UNIX_DAY


def parse_date(text: str) -> int | None:
    """Return days since 1970 of `ddmmyy`, years from 1980 on; None for an empty field."""
    if not text:
        return None
    if len(text) != 6 or not text.isdecimal():
        raise ValueError(f"'{text}' is no date")
    year = int(text[4:])
    return to_unix_days(int(text[:2]), int(text[2:4]), year + (1900 if year >= 80 else 2000))


def parse_angle(text: str, side: str, sides: str, most: float) -> float:
    """Return signed degrees of `dddmm.mmmm` and its hemisphere; nan where both are empty.

    sides: the letters of the positive and the negative hemisphere. most: the largest angle, degrees.
    """
    if not text and not side:
        return NAN
    parts = _ANGLE.fullmatch(text)
    minutes = float(parts[2]) if parts else 60.0
    if parts is None or len(side) != 1 or side not in sides or minutes >= 60.0:
        raise ValueError(f"'{text},{side}' is no angle")
    degrees = int(parts[1]) + minutes / 60.0
    if degrees > most:
        raise ValueError(f"'{text},{side}' is over {most:g} degrees")
    return degrees if side == sides[0] else -degrees


def encode(talker: str, kind: str, fields: Sequence[str]) -> bytes:
    """Return a sentence with its checksum and end of line."""
    return str(pynmea2.TalkerSentence(talker, kind, fields)).encode("ascii") + b"\r\n"


def format_angle(degrees: float, sides: str, digits: int) -> tuple[str, str]:
    """Return `dddmm.mmmmmmm` with as many digits of whole degrees, and the hemisphere's letter; empty for nan."""
    if degrees != degrees:
        return "", ""
    # whole ten-millionths of a minute, so that no 60 minutes come out of rounding
    whole, part = divmod(round(abs(degrees) * 60e7), 60 * 10_000_000)
    text = f"{whole:0{digits}d}{part // 10_000_000:02d}.{part % 10_000_000:07d}"
    return text, sides[0] if degrees >= 0.0 else sides[1]


def format_time_of_day(microseconds: int) -> str:
    """Return `hhmmss.sss`, up to 23:59:60.999."""
    seconds, fraction = divmod(microseconds, 1_000_000)
    leap = max(0, seconds - 86_399)
    hours, rest = divmod(seconds - leap, 3600)
    return f"{hours:02d}{rest // 60:02d}{rest % 60 + leap:02d}.{fraction // 1000:03d}"


def format_number(value: float, digits: int) -> str:
    """Return a decimal; empty for nan."""
    return "" if value != value else f"{value:.{digits}f}"
