"""The names of the numbers in a message: which constants belong to which field, from the comments of the .lcm files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Final

from mstools.spy.lcm_wheel import MissingToolError, type_files


@dataclass(frozen=True, slots=True)
class Constants:
    """The constants of a field: what each number is called, and what the .lcm file says of it. `are_bits`: they add."""

    names: Mapping[int, str]
    words: Mapping[int, str] = field(default_factory=dict)
    are_bits: bool = False

    def told(self, value: int) -> str:
        """Return a number with its name, or the words for its bits."""
        if not self.are_bits:
            name = self.names.get(value)
            return f"{value} {name}" if name else f"{value} (unknown)"
        said = [self.words.get(bit) or name for bit, name in sorted(self.names.items()) if value & bit]
        rest = value & ~sum(self.names)
        if rest:
            said.append(f"unknown bits {rest:#x}")
        return f"{value} ({'; '.join(said)})" if said else str(value)


_CONST: Final = re.compile(r"const\s+\w+\s+(\w+)\s*=\s*(-?\w+)\s*;")
_FIELD: Final = re.compile(r"([\w.]+)\s+(\w+)\s*(\[.*\])?\s*;")
_ELSEWHERE: Final = re.compile(r"(?:as in|constants of) (\w+_t)\b")


def constants_of(texts: Mapping[str, str]) -> dict[tuple[str, str], Constants]:
    """Return the constants of each (type, field), from the texts of .lcm files by the names of their types.

    Constants stand before the field that they are of; a comment may also name the type whose field of that name has
    them ("as in pose_transform_t").
    """
    found: dict[tuple[str, str], Constants] = {}
    elsewhere: dict[tuple[str, str], str] = {}
    for type_name, text in texts.items():
        names: dict[int, str] = {}
        words: dict[int, str] = {}
        comment: list[str] = []
        for line in map(str.strip, text.splitlines()):
            if line.startswith("//"):
                comment.append(line.removeprefix("//").strip())
                continue
            said = " ".join(comment)
            if const := _CONST.fullmatch(line):
                number = int(const[2], 0)
                names[number] = const[1]
                words[number] = _sentence(said)
            elif entry := _FIELD.fullmatch(line):
                if names:
                    found[type_name, entry[2]] = Constants(names, words, "bit by bit" in said)
                    names, words = {}, {}
                elif other := _ELSEWHERE.search(said):
                    elsewhere[type_name, entry[2]] = other[1]
            comment = []
    for (type_name, name), other_type in elsewhere.items():
        if (other_type, name) in found:
            found[type_name, name] = found[other_type, name]
    return found


def _sentence(text: str) -> str:
    """Return a comment as a part of a sentence: without its stop, and small, but for what is always written large."""
    text = text.removesuffix(".")
    return text if text[:2].isupper() else text[:1].lower() + text[1:]


@cache
def known_constants() -> Mapping[tuple[str, str], Constants]:
    """Return the constants of this project's types; none where the .lcm files are not there."""
    try:
        return constants_of({path.stem: path.read_text(encoding="utf-8") for path in type_files()})
    except (MissingToolError, OSError):
        return {}
