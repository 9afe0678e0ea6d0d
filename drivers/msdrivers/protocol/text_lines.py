"""Lines of text with a number in each column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final, Protocol

from msdrivers.protocol.can.mapping import Strict, check_factor

MAX_LINE: Final = 1024
"""Longer lines are cut."""


@dataclass(frozen=True, slots=True)
class ColumnMap(Strict):
    """A number of a line: that of `column` times `scale` plus `offset`, in SI units."""

    column: int
    """Number of the column, from 0."""
    scale: float = 1.0
    """Factor: 9.80665 for g, 0.0174533 for degrees per second, 1e-6 for microtesla, 0.001 for milliseconds."""
    offset: float = 0.0
    """Offset after scaling."""

    def __post_init__(self) -> None:
        if not 0 <= self.column < 256:
            raise ValueError(f"column is 0 to 255, got {self.column}")
        check_factor(self.scale, "scale")


class LineDescription(Protocol):
    """What a line looks like."""

    @property
    def fields(self) -> Mapping[str, ColumnMap]:
        """The columns by what they are."""

    @property
    def columns(self) -> int:
        """Number of columns."""

    @property
    def separator(self) -> str:
        """What separates columns; empty: spaces or tabs."""

    @property
    def starts_with(self) -> str:
        """What a line begins with."""

    @property
    def checksum(self) -> str:
        """`xor` or `none`."""


class LineReader:
    """Collects lines of bounded length, with the offset of their first byte's arrival."""

    def __init__(self) -> None:
        self._buffer = b""
        self._first_utime = 0
        self._is_first = True

    def clear(self) -> None:
        """Discard what is incomplete; the next line is not used."""
        self._buffer, self._is_first = b"", True

    def feed(self, data: bytes, utime: int) -> list[tuple[bytes, int]]:
        """Return the lines that `data`, received at `utime`, completes, each with when its first byte was received."""
        lines = []
        while data:
            if not self._buffer:
                self._first_utime = utime
            part, newline, data = data.partition(b"\n")
            self._buffer = (self._buffer + part)[: MAX_LINE + 1]
            if newline:
                if not self._is_first:
                    lines.append((self._buffer.rstrip(b"\r"), self._first_utime))
                self._buffer, self._is_first = b"", False
        return lines


def encode_line(description: LineDescription, values: Mapping[str, float]) -> bytes:
    """Return the line of some fields in SI units; columns without a field are 0."""
    columns = ["0"] * description.columns
    for name, each in description.fields.items():
        columns[each.column] = f"{(values[name] - each.offset) / each.scale:.9g}"
    if description.starts_with:
        columns[0] = description.starts_with
    text = (description.separator or " ").join(columns)
    if description.checksum == "xor":
        text = f"{text}*{reduce(xor, text.removeprefix('$').encode(), 0):02X}"
    return f"{text}\r\n".encode()
