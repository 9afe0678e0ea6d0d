"""Read a DBC file (by cantools), also where a part of it that nobody uses is wrong.

cantools reads a whole file or nothing. So a file that it rejects is split into its statements, and each message is read
by itself with what belongs to it: those that can be read may be mapped, and the others are problems of the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from modelserver.errors import ConfigError, Location, Problem, Severity, quote
from msdrivers.protocol.can.database import CanDatabase
from msdrivers.protocol.can.frame import FrameKey

if TYPE_CHECKING:
    from cantools.database.can import Message

MAX_DBC_CHARS: Final = 8 << 20
"""Largest DBC file in characters."""

_WRONG_FILE_FIX = "is this the DBC file of the vehicle, saved as plain text?"
_FIX = "correct it there"
_BYTE_ORDER_MARKS = ("\ufeff", "\u00ef\u00bb\u00bf")
"""As text, and read as Latin-1."""

_KEYWORD = re.compile(r"\s*(BO_|SG_|[A-Z][A-Z_]*_)\b")
_MESSAGE = re.compile(r"\s*BO_\s+(\d+)\s+(\w+)\s*:")
_OF_MESSAGE = re.compile(r"\s*(VAL_|SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\b|\s*BA_\s+\"VFrameFormat\"\s+BO_\s+(\d+)\b")
_FRAME_FORMAT = re.compile(r"\s*BA_DEF_(DEF_)?\s+(BO_\s+)?\"VFrameFormat\"")
_PLACE = re.compile(r"at line (\d+)")
_HEAD: Final = 'VERSION ""\nNS_ :\nBS_:\nBU_:\n'


@dataclass(frozen=True, slots=True)
class _Statement:
    """A statement of the file and the number of its first line."""

    line: int
    text: str


def parse_dbc(text: str, name: str) -> CanDatabase:
    """Parse the text of a DBC file called `name`. Raises ConfigError with the line for a file that has no message."""
    if len(text) > MAX_DBC_CHARS:
        raise ConfigError([Problem(Severity.ERROR, "larger than 8 MiB", Location(name), _WRONG_FILE_FIX)])
    for mark in _BYTE_ORDER_MARKS:
        text = text.removeprefix(mark)
    flaws: dict[str, tuple[Problem, ...]] = {}
    try:
        messages = _load(text)
    except _RejectedError as error:
        messages, flaws = _load_each(text, name, str(error), error.line)
        if not messages and not any(flaws):
            message = f"not a DBC file that can be read: {quote(str(error), 100)}"
            raise ConfigError([Problem(Severity.ERROR, message, Location(name, error.line), _WRONG_FILE_FIX)]) from None
    by_key: dict[FrameKey, Message] = {}
    for found in messages:
        key = FrameKey(found.frame_id, found.is_extended_frame)
        other = by_key.setdefault(key, found)
        if other is not found:
            what = f"messages {other.name} and {found.name} have one identifier, {key}"
            problem = Problem(Severity.ERROR, what, Location(name), "keep the one that the controller uses")
            flaws |= {other.name: (problem,), found.name: (problem,)}
    return CanDatabase(
        name,
        {each.name: each for each in messages if each.name not in flaws},
        {key: each for key, each in by_key.items() if each.name not in flaws},
        flaws,
    )


class _RejectedError(Exception):
    """What cantools rejects a text with; `line` is 0 where it has none."""

    def __init__(self, message: str):
        place = _PLACE.search(message)
        self.line = int(place[1]) if place else 0
        super().__init__(" ".join(message.split()))


def _load(text: str) -> Sequence[Message]:
    from cantools.database import load_string
    from cantools.database.can import Database
    from cantools.database.errors import Error, UnsupportedDatabaseFormatError

    try:
        database = load_string(text, "dbc")
    except UnsupportedDatabaseFormatError as error:
        raise _RejectedError(str(error.e_dbc or error)) from None
    except (Error, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        # what its reader does not expect
        raise _RejectedError(f"{type(error).__name__}: {error}") from None
    assert isinstance(database, Database)
    return database.messages


def _split(text: str) -> Iterator[_Statement]:
    """Yield the statements: each begins with its keyword on a line of its own, a message has its signals."""
    lines: list[str] = []
    begin, is_quoted = 1, False
    for number, line in enumerate(text.splitlines(), 1):
        keyword = None if is_quoted else _KEYWORD.match(line)
        if keyword and keyword[1] != "SG_" and lines:
            yield _Statement(begin, "\n".join(lines))
            lines = []
        if not lines:
            begin = number
        lines.append(line)
        is_quoted ^= line.replace('\\"', "").count('"') % 2 == 1
    if lines:
        yield _Statement(begin, "\n".join(lines))


def _load_each(text: str, name: str, why: str, line: int) -> tuple[list[Message], dict[str, tuple[Problem, ...]]]:
    """Return the messages that can be read by themselves, and what is wrong with the others and the rest."""
    statements = list(_split(text))
    formats = "\n".join(each.text for each in statements if _FRAME_FORMAT.match(each.text))
    parts: dict[str, list[_Statement]] = {}
    for each in statements:
        if found := _OF_MESSAGE.match(each.text):
            parts.setdefault(found[2] or found[3], []).append(each)
    messages: list[Message] = []
    flaws: dict[str, tuple[Problem, ...]] = {}
    rest: list[Problem] = []
    known = set()
    for each in statements:
        if (named := _MESSAGE.match(each.text)) is None:
            continue
        known.add(named[1])
        own = parts.get(named[1], [])
        # a table of names is not needed
        needed = [part for part in own if not part.text.lstrip().startswith("VAL_")]
        try:
            messages += _load_message(each, own, formats)
        except _RejectedError as error:
            try:
                messages += _load_message(each, needed, formats)
                rest += [_describe(error, part, name) for part in own if part not in needed]
            except _RejectedError as inner:
                flaws[named[2]] = (_describe(inner, each, name),)
    for number in parts.keys() - known:
        first = parts[number][0]
        what = f"{quote(first.text.strip(), 60)} is of message {number}, which is not there"
        rest.append(Problem(Severity.ERROR, what, Location(name, first.line), _FIX))
    if not (rest or flaws):
        rest = [Problem(Severity.ERROR, f"a part of it cannot be read: {quote(why, 100)}", Location(name, line), _FIX)]
    if rest:
        flaws[""] = tuple(rest)
    return messages, flaws


def _load_message(message: _Statement, own: Sequence[_Statement], formats: str) -> Sequence[Message]:
    return _load(_HEAD + "\n".join((message.text, formats, *(each.text for each in own), "")))


def _describe(error: _RejectedError, statement: _Statement, name: str) -> Problem:
    """Return the problem of a statement, at the signal that it names, else at its own place."""
    words = re.findall(r"\w+", str(error))
    lines = statement.text.splitlines()
    signals = [(n, found[1]) for n, line in enumerate(lines) if (found := re.match(r"\s*SG_\s+(\w+)", line))]
    at = min(max(error.line - 1 - _HEAD.count("\n"), 0), len(lines) - 1)
    offset = next((n for n, signal in signals if signal in words), at)
    return Problem(Severity.ERROR, quote(str(error), 160), Location(name, statement.line + offset), _FIX)
