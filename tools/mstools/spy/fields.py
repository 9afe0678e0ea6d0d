"""A message of this project's types, field by field, for people to read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

from mstools.spy.types import Constants

MAX_LINES: Final = 500
"""Lines of one message; the rest is counted."""

MAX_DEPTH: Final = 6

NUMBERS: Final = 8
"""Numbers of an array that are shown, and rows of a matrix."""

ENTRIES: Final = 16
"""Structures of an array that are shown."""

TEXT: Final = 120
"""Characters of a text that are shown."""

MAX_UTIME: Final = 4_102_444_800_000_000
"""The year 2100; above it a number is no time of day."""


def fields(message: Any, constants: Mapping[tuple[str, str], Constants]) -> list[str]:
    """Return the lines of a message, an instance of a class made by lcm-gen; nested structures are indented."""
    lines: list[str] = []
    for line in _lines(message, constants, 0):
        if len(lines) == MAX_LINES:
            lines.append("... and more")
            break
        lines.append(line)
    return lines


def _lines(message: Any, constants: Mapping[tuple[str, str], Constants], depth: int) -> Iterator[str]:
    indent = "  " * depth
    kind = type(message)
    names = kind.__slots__
    width = max(map(len, names), default=0)
    for name, dimensions in zip(names, kind.__dimensions__, strict=True):
        value = getattr(message, name)
        head = f"{indent}{name:<{width}}"
        known = constants.get((kind.__name__, name))
        if _is_structure(value):
            yield f"{indent}{name}"
            yield from _nested(value, constants, depth)
        elif dimensions and not isinstance(value, bytes) and value and _is_structure(value[0]):
            for number, each in enumerate(value[:ENTRIES]):
                yield f"{indent}{name}[{number}]"
                yield from _nested(each, constants, depth)
            if len(value) > ENTRIES:
                yield f"{indent}... and {len(value) - ENTRIES} more of {name}"
        elif dimensions and len(dimensions) > 1 and not isinstance(value, bytes) and value:
            for number, row in enumerate(value[:NUMBERS]):
                yield f"{head if not number else indent + ' ' * width} {_array(row, None)}"
            if len(value) > NUMBERS:
                yield f"{indent}{' ' * width} ... and {len(value) - NUMBERS} rows more"
        else:
            yield f"{head} {told(name, value, known)}"


def _nested(value: Any, constants: Mapping[tuple[str, str], Constants], depth: int) -> Iterator[str]:
    if depth + 1 >= MAX_DEPTH:
        yield f"{'  ' * (depth + 1)}..."
    else:
        yield from _lines(value, constants, depth + 1)


def _is_structure(value: Any) -> bool:
    return hasattr(value, "__typenames__")


def told(name: str, value: Any, constants: Constants | None = None) -> str:
    """Return a field's value for people: with the constant's name, the time of day, or cut where it is long."""
    if isinstance(value, bytes):
        more = "..." if len(value) > 16 else ""
        return f"{len(value)} bytes {value[:16].hex(' ')}{more}"
    if isinstance(value, list | tuple):
        return _array(value, constants)
    if isinstance(value, str):
        # repr escapes what a terminal would obey
        return repr(value) if len(value) <= TEXT else f"{value[:TEXT]!r}... ({len(value)} characters)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}"
    if constants is not None:
        return constants.told(value)
    if (name == "utime" or name.endswith("_utime")) and 0 < value < MAX_UTIME:
        return f"{value} ({_time(value)})"
    return str(value)


def _array(values: Sequence[Any], constants: Constants | None) -> str:
    if values and all(isinstance(each, float) and math.isnan(each) for each in values):
        return f"nan ({len(values)})"
    shown = ", ".join(told("", each, constants) for each in values[:NUMBERS])
    more = f", ... ({len(values)})" if len(values) > NUMBERS else ""
    return f"[{shown}{more}]"


def _time(utime: int) -> str:
    return datetime.fromtimestamp(utime / 1e6, UTC).strftime("%Y-%m-%d %H:%M:%S.%f UTC")
