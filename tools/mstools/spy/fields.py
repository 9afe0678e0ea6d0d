"""Messages formatted field by field, with the names of constants.

Python classes of lcm-gen do not state to which field a constant belongs: that is parsed from the .lcm files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import islice
from typing import Any, Final

from mstools.spy.lcm_wheel import MissingToolError, find_type_files


@dataclass(frozen=True, slots=True)
class Constants:
    """Name and comment of each constant of a field. `are_bits`: the value is a bit field of them."""

    names: Mapping[int, str]
    descriptions: Mapping[int, str] = field(default_factory=dict)
    are_bits: bool = False

    def describe(self, value: int) -> str:
        """Format a number with the name of its constant, or the descriptions of its bits."""
        if not self.are_bits:
            name = self.names.get(value)
            return f"{value} {name}" if name else f"{value} (unknown)"
        bits = [self.descriptions.get(bit) or name for bit, name in sorted(self.names.items()) if value & bit]
        rest = value & ~sum(self.names)
        if rest:
            bits.append(f"unknown bits {rest:#x}")
        return f"{value} ({'; '.join(bits)})" if bits else str(value)


_CONST: Final = re.compile(r"const\s+\w+\s+(\w+)\s*=\s*(-?\w+)\s*;")
_FIELD: Final = re.compile(r"([\w.]+)\s+(\w+)\s*(\[.*\])?\s*;")
_REFERENCE: Final = re.compile(r"(?:as in|constants of) (\w+_t)\b")


def constants_of(texts: Mapping[str, str]) -> dict[tuple[str, str], Constants]:
    """Return the constants of each (type, field), parsed from the texts of .lcm files by type name.

    Constants precede their field; a comment may instead name the type whose field of the same name has them ("as in
    pose_transform_t").
    """
    found: dict[tuple[str, str], Constants] = {}
    elsewhere: dict[tuple[str, str], str] = {}
    for type_name, content in texts.items():
        names: dict[int, str] = {}
        words: dict[int, str] = {}
        comment: list[str] = []
        for line in map(str.strip, content.splitlines()):
            if line.startswith("//"):
                # a note to the code generator is no description
                comment += [] if line.startswith("// @") else [line.removeprefix("//").strip()]
                continue
            text = " ".join(comment)
            if const := _CONST.fullmatch(line):
                number = int(const[2], 0)
                names[number] = const[1]
                words[number] = _to_clause(text)
            elif entry := _FIELD.fullmatch(line):
                if names:
                    found[type_name, entry[2]] = Constants(names, words, "bit by bit" in text)
                    names, words = {}, {}
                elif other := _REFERENCE.search(text):
                    elsewhere[type_name, entry[2]] = other[1]
            comment = []
    for (type_name, name), other_type in elsewhere.items():
        if (other_type, name) in found:
            found[type_name, name] = found[other_type, name]
    return found


def _to_clause(text: str) -> str:
    """Return a comment as a part of a sentence: without its period, and in lower case except for abbreviations."""
    text = text.removesuffix(".")
    return text if text[:2].isupper() else text[:1].lower() + text[1:]


@cache
def load_constants() -> Mapping[tuple[str, str], Constants]:
    """Return the constants of this project's types; none if the .lcm files are missing."""
    try:
        return constants_of({path.stem: path.read_text(encoding="utf-8") for path in find_type_files()})
    except (MissingToolError, OSError):
        return {}


MAX_LINES: Final = 500
"""Lines of one message."""

MAX_DEPTH: Final = 6

MAX_NUMBERS: Final = 8
"""Shown numbers of an array, and rows of a matrix."""

MAX_ENTRIES: Final = 16
"""Shown structures of an array."""

MAX_TEXT: Final = 120
"""Shown characters of a text."""

MAX_UTIME: Final = 4_102_444_800_000_000
"""The year 2100; a larger number is no time."""


def format_fields(message: Any, constants: Mapping[tuple[str, str], Constants]) -> list[str]:
    """Format a message, an instance of a class of lcm-gen, as lines; nested structures are indented."""
    lines = list(islice(_format_structure(message, constants, 0), MAX_LINES + 1))
    return lines if len(lines) <= MAX_LINES else [*lines[:MAX_LINES], "... and more"]


def _format_structure(message: Any, constants: Mapping[tuple[str, str], Constants], depth: int) -> Iterator[str]:
    indent = "  " * depth
    if depth == MAX_DEPTH:
        yield f"{indent}..."
        return
    kind = type(message)
    names = kind.__slots__
    width = max(map(len, names), default=0)
    for name, dimensions in zip(names, kind.__dimensions__, strict=True):
        value = getattr(message, name)
        head = f"{indent}{name:<{width}}"
        known = constants.get((kind.__name__, name))
        is_array = dimensions and not isinstance(value, bytes) and value
        if _is_structure(value):
            yield f"{indent}{name}"
            yield from _format_structure(value, constants, depth + 1)
        elif is_array and _is_structure(value[0]):
            for number, each in enumerate(value[:MAX_ENTRIES]):
                yield f"{indent}{name}[{number}]"
                yield from _format_structure(each, constants, depth + 1)
            if len(value) > MAX_ENTRIES:
                yield f"{indent}... and {len(value) - MAX_ENTRIES} more of {name}"
        elif is_array and len(dimensions) > 1:
            for number, row in enumerate(value[:MAX_NUMBERS]):
                yield f"{head if not number else indent + ' ' * width} {_format_array(row, None)}"
            if len(value) > MAX_NUMBERS:
                yield f"{indent}{' ' * width} ... and {len(value) - MAX_NUMBERS} rows more"
        else:
            yield f"{head} {format_value(name, value, known)}"


def _is_structure(value: Any) -> bool:
    return hasattr(value, "__typenames__")


def format_value(name: str, value: Any, constants: Constants | None = None) -> str:
    """Format a field's value: with the constant's name, with the time of day, or truncated."""
    if isinstance(value, bytes):
        more = "..." if len(value) > 16 else ""
        return f"{len(value)} bytes {value[:16].hex(' ')}{more}"
    if isinstance(value, list | tuple):
        return _format_array(value, constants)
    if isinstance(value, str):
        # repr escapes control sequences
        return repr(value) if len(value) <= MAX_TEXT else f"{value[:MAX_TEXT]!r}... ({len(value)} characters)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}"
    if constants is not None:
        return constants.describe(value)
    if (name == "utime" or name.endswith("_utime")) and 0 < value < MAX_UTIME:
        return f"{value} ({datetime.fromtimestamp(value / 1e6, UTC):%Y-%m-%d %H:%M:%S.%f UTC})"
    return str(value)


def _format_array(values: Sequence[Any], constants: Constants | None) -> str:
    if values and all(isinstance(each, float) and math.isnan(each) for each in values):
        return f"nan ({len(values)})"
    shown = ", ".join(format_value("", each, constants) for each in values[:MAX_NUMBERS])
    more = f", ... ({len(values)})" if len(values) > MAX_NUMBERS else ""
    return f"[{shown}{more}]"
