"""What is wrong with a value, in words: what stands in its place, what is meant, and what to write."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from modelserver.errors import shown, suggestions

_LISTS = ("tuple_type", "list_type")
_SECTIONS = ("dataclass_type", "dict_type")
_CHOICES = ("literal_error", "enum")
_WANTED = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    **dict.fromkeys(_LISTS, "a list"),
    **dict.fromkeys(_SECTIONS, "a section"),
}


class Words(NamedTuple):
    """What to tell of a value."""

    message: str
    fix: str = ""
    nearest: tuple[str, ...] = ()


def of_value(detail: Any, keys: Sequence[str]) -> Words:
    """Return what to tell of one of pydantic's findings; `keys` are those of the section that is wanted there."""
    kind, got = detail["type"], detail.get("input")
    *path, last = detail["loc"]
    name = f"{path[-1]}, number {last + 1} in it," if isinstance(last, int) else str(last)
    said = f", got {written(got)}" if isinstance(got, str | int | float) else ""
    if kind in _CHOICES:
        expected = detail["ctx"]["expected"]
        near = suggestions(str(got), re.findall(r"'([^']*)'", expected))
        return Words(f"{name} is {expected}{said}", f"write {near[0]}" if near else "", near)
    if kind not in _WANTED:
        message = str(detail["msg"])
        return Words(f"{name}: {message[:1].lower()}{message[1:]}{said}")
    return Words(f"{name} is {_WANTED[kind]}{said}", _fix(kind, got, keys))


def _fix(kind: str, got: Any, keys: Sequence[str]) -> str:
    value = got if isinstance(got, str) else written(got) if isinstance(got, int | float) else "..."
    if kind in _LISTS:
        return f"write [{value}]"
    if kind in _SECTIONS:
        return f"write {{{keys[0] if keys else 'NAME'}: {value}}}"
    if kind == "string_type":
        return f'write "{value}"'
    if kind in ("float_type", "int_type") and isinstance(got, str) and _NUMBER.fullmatch(got):
        return f"write {got} without quotes"
    return ""


_NUMBER = re.compile(r"-?\d+(\.\d*)?")


def written(value: str | float) -> str:
    """Return a value as it stands in a vehicle file."""
    if isinstance(value, str):
        return shown(value)
    return str(value).lower() if isinstance(value, bool) else f"{value}"
