"""Parse ASCII log headers and bodies: comma-separated fields, names for enumerations, quoted strings."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from enum import IntEnum
from math import isfinite

from msdrivers.protocol.novatel.logs import (
    DATUMS,
    MAX_ANTENNA,
    Body,
    HeadingLog,
    LogHeader,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    UtmPosition,
    Velocity,
)

UNKNOWN_VALUE = 255
"""Status or type whose word is not in the tables; no receiver uses this number."""


def split_fields(text: str) -> list[str]:
    """Return the fields of a comma-separated part; quotes are taken off."""
    return next(csv.reader([text])) if '"' in text else text.split(",")


def parse_long_header(fields: Sequence[str]) -> LogHeader:
    """Read the ten fields of `#NAMEA,...`. ValueError where one is not as it should be."""
    name, port, sequence, _, status, week, seconds, receiver, _, _ = fields
    milliseconds = _parse_milliseconds(seconds)
    known = TimeStatus[status] if status in TimeStatus.__members__ else TimeStatus.UNKNOWN
    name, antenna = _parse_name(name)
    return LogHeader(
        name,
        _parse_integer(week, 0xFFFF),
        milliseconds,
        known,
        port,
        _parse_integer(sequence, 0xFFFF),
        _check_range(int(receiver, 16), 0xFFFF_FFFF),
        False,
        antenna,
    )


def parse_short_header(fields: Sequence[str]) -> LogHeader:
    """Read the three fields of `%NAMESA,...`."""
    name, week, seconds = fields
    name, antenna = _parse_name(name)
    milliseconds = _parse_milliseconds(seconds)
    return LogHeader(name, _parse_integer(week, 0xFFFF), milliseconds, TimeStatus.UNKNOWN, "", 0, 0, False, antenna)


def parse_body(name: str, fields: Sequence[str]) -> Body | None:
    """Return a log's body; None for a log that is not read here.

    Raises:
        ValueError: a wrong number of fields, or an invalid field.
    """
    reader = _READERS.get(name)
    if reader is None:
        return None
    body = reader(fields)
    if not all(isfinite(value) for value in body if isinstance(value, float)):
        raise ValueError("a number is not finite")
    return body


_NAME = re.compile(r"(\w+)A(?:_([0-9]{1,2}))?", re.ASCII)


def _parse_name(text: str) -> tuple[str, int]:
    """Return the name of a log and its measurement source."""
    parts = _NAME.fullmatch(text)
    if parts is None:
        raise ValueError(f"{text} is no ASCII log")
    return parts[1], _parse_integer(parts[2] or "0", MAX_ANTENNA)


def _parse_milliseconds(seconds: str) -> int:
    value = float(seconds) * 1000.0
    # not a number and infinities are not within it either
    if not 0.0 <= value < 604_799_999.5:
        raise ValueError(f"{seconds} is not within a week")
    return round(value)


def _parse_integer(text: str, most: int) -> int:
    """Read a number that the binary log has without a sign, `most` being the largest."""
    return _check_range(int(text), most)


def _check_range(value: int, most: int) -> int:
    if not 0 <= value <= most:
        raise ValueError(f"{value} is not within 0 to {most}")
    return value


def _parse_enum(kind: type[IntEnum], word: str) -> int:
    return int(kind[word]) if word in kind.__members__ else UNKNOWN_VALUE


def _parse_position(f: Sequence[str]) -> Position:
    if len(f) != 21:
        raise ValueError(f"{len(f)} fields where 21 belong")
    latitude, longitude = float(f[2]), float(f[3])
    if abs(latitude) > 90.0 or not -180.0 <= longitude <= 360.0:
        raise ValueError(f"{f[2]},{f[3]} is no place")
    north, east, up = (float(each) for each in f[7:10])
    return Position(
        _parse_enum(SolutionStatus, f[0]),
        _parse_enum(PositionType, f[1]),
        latitude,
        longitude,
        float(f[4]),
        float(f[5]),
        DATUMS.get(f[6], 0),
        north,
        east,
        up,
        f[10],
        float(f[11]),
        float(f[12]),
        _parse_integer(f[13], 0xFF),
        _parse_integer(f[14], 0xFF),
    )


def _parse_velocity(f: Sequence[str]) -> Velocity:
    if len(f) != 8:
        raise ValueError(f"{len(f)} fields where 8 belong")
    latency, age, horizontal, track, vertical = (float(each) for each in f[2:7])
    if horizontal < 0.0:
        raise ValueError(f"{f[4]} is no speed")
    return Velocity(
        _parse_enum(SolutionStatus, f[0]), _parse_enum(PositionType, f[1]), latency, age, horizontal, track, vertical
    )


def _parse_utm(f: Sequence[str]) -> UtmPosition:
    if len(f) != 23:
        raise ValueError(f"{len(f)} fields where 23 belong")
    northing, easting, height, undulation = (float(each) for each in f[4:8])
    north, east, up = (float(each) for each in f[9:12])
    return UtmPosition(
        _parse_enum(SolutionStatus, f[0]),
        _parse_enum(PositionType, f[1]),
        _parse_integer(f[2], 0xFFFF_FFFF),
        f[3],
        northing,
        easting,
        height,
        undulation,
        DATUMS.get(f[8], 0),
        north,
        east,
        up,
        f[12],
        float(f[13]),
        float(f[14]),
        _parse_integer(f[15], 0xFF),
        _parse_integer(f[16], 0xFF),
    )


def _make_heading_parser(stations: int) -> Callable[[Sequence[str]], HeadingLog]:
    def parse_heading(f: Sequence[str]) -> HeadingLog:
        if len(f) != 16 + stations:
            raise ValueError(f"{len(f)} fields where {16 + stations} belong")
        if not 0.0 <= float(f[3]) <= 360.0:
            raise ValueError(f"{f[3]} is no heading")
        return HeadingLog(
            _parse_enum(SolutionStatus, f[0]),
            _parse_enum(PositionType, f[1]),
            float(f[2]),
            float(f[3]),
            float(f[4]),
            float(f[6]),
            float(f[7]),
            f[8],
            _parse_integer(f[8 + stations], 0xFF),
            _parse_integer(f[9 + stations], 0xFF),
        )

    return parse_heading


_READERS: dict[str, Callable[[Sequence[str]], Body]] = {
    "BESTPOS": _parse_position,
    "PSRPOS": _parse_position,
    "RTKPOS": _parse_position,
    "BESTVEL": _parse_velocity,
    "BESTUTM": _parse_utm,
    "HEADING": _make_heading_parser(1),
    "HEADING2": _make_heading_parser(2),
}
