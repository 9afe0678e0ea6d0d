"""The syntax of libbot2's parameter files: `name = value;`, `name = [a, b];` and `name { ... }`, `#` to the line's end.

A value is a word or a text in double quotes, which mean the same; a cast in parentheses before it is passed over. What
a file holds is decided by its reader. Blocks nest to a bounded depth, and are read without recursion.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from modelserver.errors import Location, shown
from modelserver.geometry.builder import ModelBuilder

GREATEST_DEPTH = 20
"""Frames stand four levels deep."""

_SPACE = r"(?:\s|\#[^\n]*(?:\n|\Z))*"
_TOKEN = re.compile(
    rf"{_SPACE}(?:(?P<word>[A-Za-z0-9_.+-]+)|\"(?P<text>(?:[^\"\\\n]|\\.)*)\"|\((?P<cast>[^)\n]*)\)|(?P<mark>[{{}}\[\],;=])|"
    r"(?P<end>\Z)|(?P<odd>.))",
    re.DOTALL,
)
_BEGIN = re.compile(rb"(?:\s|#[^\n]*(?:\n|\Z))*[A-Za-z0-9_.+-]+(?:\s|#[^\n]*\n)*[={]")
_FRAMES = re.compile(rb"(?:\A|[\s;}])coordinate_frames(?:\s|#[^\n]*\n)*\{")


@dataclass(slots=True)
class Value:
    """What an assignment gives a name: one text or, in brackets, several."""

    texts: list[str]
    line: int
    is_list: bool = False


@dataclass(slots=True)
class ParamBlock:
    """A block: its entries in order, each with its name."""

    line: int
    entries: list[tuple[str, Value | ParamBlock]] = field(default_factory=list)

    def values(self) -> Iterator[tuple[str, Value]]:
        """Yield the assignments."""
        return ((name, entry) for name, entry in self.entries if isinstance(entry, Value))

    def blocks(self) -> Iterator[tuple[str, ParamBlock]]:
        """Yield the blocks inside."""
        return ((name, entry) for name, entry in self.entries if isinstance(entry, ParamBlock))


def is_likely(content: bytes) -> bool:
    """Return whether a file looks like libbot2's parameters with coordinate frames."""
    return _BEGIN.match(content) is not None and _FRAMES.search(content) is not None


class _SyntaxError(Exception):
    def __init__(self, message: str, line: int, fix: str):
        super().__init__(message)
        self.line = line
        self.fix = fix


def parse(content: bytes, builder: ModelBuilder, file: str) -> ParamBlock | None:
    """Return what the file holds as one block, or None with the problem added to `builder`."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        builder.error(
            f"the file is not UTF-8 text: byte {content[error.start]:#04x} in this line",
            Location(file, content.count(b"\n", 0, error.start) + 1),
            "save it as UTF-8",
        )
        return None
    try:
        return _Parser(text).parsed()
    except _SyntaxError as error:
        builder.error(str(error), Location(file, error.line), error.fix)
        return None


class _Parser:
    def __init__(self, text: str):
        self.text = text
        self.at = 0
        self.line = 1

    def next(self) -> tuple[str, str]:
        """Return the kind and the text of the next token: word, text, cast, mark, or end."""
        match = _TOKEN.match(self.text, self.at)
        assert match is not None
        kind = str(match.lastgroup)
        start = match.start(kind)
        self.line += self.text.count("\n", self.at, start)
        self.at = start
        if kind == "odd":
            wrong = match["odd"]
            fix = (
                "close the text with a quote in the same line"
                if wrong == '"'
                else "remove it, or put the text in quotes"
            )
            raise _SyntaxError(f"unexpected {shown(wrong)}", self.line, fix)
        self.line += self.text.count("\n", start, match.end())
        self.at = match.end()
        return kind, match[kind]

    def parsed(self) -> ParamBlock:
        root = ParamBlock(self.line)
        open_blocks = [root]
        while True:
            kind, text = self.next()
            if kind == "end":
                if len(open_blocks) > 1:
                    raise _SyntaxError("a block is not closed", open_blocks[-1].line, "close it with }")
                return root
            if (kind, text) == ("mark", "}"):
                if len(open_blocks) == 1:
                    raise _SyntaxError("a } closes nothing", self.line, "remove it, or look for a missing {")
                open_blocks.pop()
                continue
            if kind != "word":
                raise _SyntaxError(
                    f"expected a name, got {shown(text)}", self.line, "write name = value; or name { ... }"
                )
            line = self.line
            mark = self.next()
            if mark == ("mark", "{"):
                if len(open_blocks) > GREATEST_DEPTH:
                    raise _SyntaxError(
                        f"the file nests deeper than {GREATEST_DEPTH} levels",
                        line,
                        "look for blocks that are not closed",
                    )
                block = ParamBlock(line)
                open_blocks[-1].entries.append((text, block))
                open_blocks.append(block)
            elif mark == ("mark", "="):
                open_blocks[-1].entries.append((text, self.value(text, line)))
            else:
                raise _SyntaxError(
                    f"expected = or {{ after {shown(text)}, got {shown(mark[1])}",
                    line,
                    "write name = value; or name { ... }",
                )

    def value(self, name: str, line: int) -> Value:
        """Return the right side of an assignment, up to and with its semicolon."""
        kind, text = self.next()
        if kind == "cast":
            kind, text = self.next()
        if kind in ("word", "text"):
            value = Value([text], line)
        elif (kind, text) == ("mark", "["):
            value = Value(self.items(name), line, is_list=True)
        else:
            raise _SyntaxError(f"{name} has no value", line, f"write {name} = value; or {name} = [value, value];")
        if self.next() != ("mark", ";"):
            raise _SyntaxError(f"a ; is missing after the value of {shown(name)}", line, "end the assignment with ;")
        return value

    def items(self, name: str) -> list[str]:
        line = self.line
        items: list[str] = []
        while True:
            kind, text = self.next()
            if kind in ("word", "text"):
                items.append(text)
                kind, text = self.next()
                if (kind, text) == ("mark", ","):
                    continue
            if (kind, text) == ("mark", "]"):
                return items
            raise _SyntaxError(
                f"the list of {shown(name)} is not well-formed: got {shown(text)}",
                line,
                f"write {name} = [value, value];",
            )
