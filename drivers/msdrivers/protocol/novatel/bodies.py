"""Bodies of NovAtel logs in binary (little-endian, packed) and ASCII: one table of columns for both, read and written.

ASCII has comma-separated fields, names for enumerations and quoted strings. ValueError for a body that cannot be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import partial
from math import isfinite
from operator import itemgetter
from struct import Struct
from typing import Any, NamedTuple

from msdrivers.protocol.novatel import (
    DATUMS,
    Body,
    HeadingLog,
    Position,
    PositionType,
    SolutionStatus,
    UtmPosition,
    Velocity,
)

UNKNOWN_VALUE = 255
"""Status or type whose word is not in the tables; no receiver uses this number."""


class _Column(NamedTuple):
    """A value of a body: its struct code, its ASCII field, and its conversion from and to the number or bytes packed.

    Without `parse` it is reserved: `text` is written in ASCII, and binary has padding.
    """

    code: str
    parse: Callable[[str], object] | None = None
    format: Callable[[Any], str] = str
    unpack: Callable[[Any], object] | None = None
    pack: Callable[[Any], object] | None = None
    text: str = ""


def parse_integer(text: str, most: int, base: int = 10) -> int:
    """Read a number that the binary log has without a sign, `most` being the largest."""
    value = int(text, base)
    if not 0 <= value <= most:
        raise ValueError(f"{value} is not within 0 to {most}")
    return value


def _real(code: str, digits: int) -> _Column:
    return _Column(code, float, f"{{:.{digits}f}}".format)


def _enumeration(kind: type[IntEnum]) -> _Column:
    members = kind.__members__
    return _Column(
        "I",
        lambda word: int(members[word]) if word in members else UNKNOWN_VALUE,
        lambda number: kind(number).name if number != UNKNOWN_VALUE else "UNKNOWN",
    )


def _decode_letter(number: int) -> str:
    if not 65 <= number <= 90:
        raise ValueError(f"{number} is no letter of a zone")
    return chr(number)


_SOLUTION = (_enumeration(SolutionStatus), _enumeration(PositionType))
_COUNTS = (_Column("B", partial(parse_integer, most=0xFF)),) * 2
_STATION = _Column(
    "4s",
    str,
    '"{}"'.format,
    lambda raw: raw.partition(b"\0")[0].decode("ascii", "replace"),
    lambda text: text.encode("ascii"),
)
_DATUM = _Column(
    "I",
    lambda word: DATUMS.get(word, 0),
    lambda number: next((name for name, each in DATUMS.items() if each == number), "USER"),
)
_ZONE = (_Column("I", partial(parse_integer, most=0xFFFF_FFFF)), _Column("I", str, str, _decode_letter, ord))
_RESERVED = _Column("4x", text="0.0")
_TAIL = (_Column("x", text="0"),) * 3 + (_Column("x", text="00"),) * 3
"""Counts of observations and masks that end several logs."""
_FIX = (_DATUM, *(_real("f", 4),) * 3, _STATION, *(_real("f", 3),) * 2, *_COUNTS, *_TAIL)
"""What BESTPOS and BESTUTM have after the place: datum, sigmas, station, ages, satellites."""
_BASELINE = (*_SOLUTION, _real("f", 4), *(_real("f", 6),) * 2, _RESERVED, *(_real("f", 4),) * 2, _STATION)


class BodyLayout:
    """The columns of a kind of body; `is_possible` checks values that are finite."""

    def __init__(self, make: type[Body], is_possible: Callable[[Any], bool], *columns: _Column):
        self._make, self._is_possible, self._columns = make, is_possible, columns
        self._struct = Struct("<" + "".join(each.code for each in columns))
        values = [each for each in columns if each.parse is not None]
        self._converted = [(n, each.unpack, each.pack) for n, each in enumerate(values) if each.unpack and each.pack]
        self._floats = itemgetter(*(n for n, each in enumerate(values) if each.parse is float))
        self.size = self._struct.size
        """Bytes of a binary body."""

    def unpack(self, buffer: bytes | bytearray, at: int) -> Body:
        """Decode a binary body of `size` bytes at `at`."""
        values = self._struct.unpack_from(buffer, at)
        for n, unpack, _ in self._converted:
            values = (*values[:n], unpack(values[n]), *values[n + 1 :])
        return self._check(values)

    def pack(self, body: Body) -> bytes:
        """Encode a body in binary."""
        values: list[Any] = list(body)
        for n, _, pack in self._converted:
            values[n] = pack(values[n])
        return self._struct.pack(*values)

    def parse(self, fields: Sequence[str]) -> Body:
        """Decode the ASCII fields of a body, without quotes."""
        columns = zip(self._columns, fields, strict=True)
        return self._check([each.parse(text) for each, text in columns if each.parse is not None])

    def format(self, body: Body) -> list[str]:
        """Encode a body as ASCII fields."""
        values = iter(body)
        return [each.text if each.parse is None else each.format(next(values)) for each in self._columns]

    def _check(self, values: Sequence[object]) -> Body:
        body = self._make._make(values)
        # an infinity makes the sum infinite, a nan makes it nan
        if not (isfinite(sum(self._floats(values))) and self._is_possible(body)):
            raise ValueError(f"{body} cannot be")
        return body


_POSITION = BodyLayout(
    Position,
    lambda body: abs(body.latitude) <= 90.0 and -180.0 <= body.longitude <= 360.0,
    *_SOLUTION,
    *(_real("d", 11),) * 2,
    _real("d", 4),
    _real("f", 4),
    *_FIX,
)

BODIES = {
    "BESTPOS": _POSITION,
    "PSRPOS": _POSITION,
    "RTKPOS": _POSITION,
    "BESTVEL": BodyLayout(
        Velocity,
        lambda body: body.horizontal >= 0.0,
        *_SOLUTION,
        *(_real("f", 3),) * 2,
        _real("d", 4),
        _real("d", 6),
        _real("d", 4),
        _RESERVED,
    ),
    "BESTUTM": BodyLayout(UtmPosition, lambda _: True, *_SOLUTION, *_ZONE, *(_real("d", 4),) * 3, _real("f", 4), *_FIX),
    "HEADING": BodyLayout(HeadingLog, lambda body: 0.0 <= body.heading <= 360.0, *_BASELINE, *_COUNTS, *_TAIL),
    "HEADING2": BodyLayout(
        HeadingLog,
        lambda body: 0.0 <= body.heading <= 360.0,
        *_BASELINE,
        _Column("4x", text='""'),
        *_COUNTS,
        *_TAIL,
    ),
}
"""Name of a log -> the layout of its body. PSRPOS and RTKPOS are written as BESTPOS; HEADING2 names two stations."""
