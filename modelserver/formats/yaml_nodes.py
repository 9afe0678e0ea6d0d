"""YAML text as a tree of nodes that know their lines.

PyYAML's composer calls itself for each level, in C, so that a few kilobytes of brackets end the process; its
events do not. The tree is built from them with a bounded depth, a bounded size counted with aliases written out
(so an alias bomb is refused where it is laid), and without tags: what a scalar means is decided by the key it
stands at, so a frame may be called `on`, `12` or `null`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from typing import Any

import yaml

from modelserver.errors import Location
from modelserver.geometry.builder import ModelBuilder

GREATEST_DEPTH = 20
"""No form of geometry nests deeper than 8."""

GREATEST_SIZE = 4_000_000
"""Nodes with aliases written out; 10,000 frames have about 130,000."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NodeKind(Enum):
    """What a node is."""

    SCALAR = "a single value"
    LIST = "a list"
    MAPPING = "a mapping"


class YamlNode:
    """A value with its line. `text` is a scalar's, `items` a list's, `pairs` a mapping's, in order.

    `plain` is true for a scalar without quotes; `size` counts the nodes in it, aliases written out.
    """

    __slots__ = ("items", "kind", "line", "pairs", "plain", "size", "text")

    def __init__(self, kind: NodeKind, line: int, text: str = "", plain: bool = False):
        self.kind = kind
        self.line = line
        self.text = text
        self.plain = plain
        self.size = 1
        # most nodes are scalars: empty lists of their own would double what the garbage collector walks
        self.items: list[YamlNode] = [] if kind is NodeKind.LIST else _NO_ITEMS
        self.pairs: list[tuple[YamlNode, YamlNode]] = [] if kind is NodeKind.MAPPING else _NO_PAIRS

    @property
    def is_nothing(self) -> bool:
        """Whether it is an empty value, `~` or `null` without quotes."""
        return self.kind is NodeKind.SCALAR and self.plain and self.text in ("", "~", "null", "Null", "NULL")


_NO_ITEMS: list[YamlNode] = []
_NO_PAIRS: list[tuple[YamlNode, YamlNode]] = []


class _RefusedError(Exception):
    def __init__(self, message: str, line: int, fix: str):
        super().__init__(message)
        self.line = line
        self.fix = fix


def parse(content: bytes, builder: ModelBuilder, file: str) -> YamlNode | None:
    """Return the one document in `content`, or None with the problem added to `builder`."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        builder.error(
            f"the file is not UTF-8 text: byte {content[error.start]:#04x} in this line",
            Location(file, line),
            "save it as UTF-8; if it is no text at all, it is not a geometry file",
        )
        return None
    try:
        return _Builder().build(text)
    except _RefusedError as error:
        builder.error(str(error), Location(file, error.line), error.fix)
    except yaml.MarkedYAMLError as error:
        _report_syntax(error, text, builder, file)
    except yaml.reader.ReaderError as error:
        place = error.position if isinstance(error.position, int) else 0
        builder.error(
            f"the file holds a character that YAML forbids: {_character(error.character)}",
            Location(file, text.count("\n", 0, place) + 1),
            "remove it; if the file is no text at all, it is not a geometry file",
        )
    except yaml.YAMLError as error:
        builder.error(f"the YAML cannot be read: {error}", Location(file), "write it as in docs/geometry-files.md")
    return None


def _character(value: object) -> str:
    code = ord(value) if isinstance(value, str) and len(value) == 1 else value
    return f"#x{code:04x}" if isinstance(code, int) else repr(value)


def _report_syntax(error: yaml.MarkedYAMLError, text: str, builder: ModelBuilder, file: str) -> None:
    mark = error.problem_mark or error.context_mark
    number = mark.line + 1 if mark is not None else 0
    lines = text.split("\n")
    indent = re.match(r"[ ]*(\t)?", lines[number - 1]) if 0 < number <= len(lines) else None
    if indent is not None and indent[1]:
        builder.error(
            "the line is indented with a tab, which YAML forbids",
            Location(file, number),
            "write spaces instead of tabs",
        )
        return
    context = f" {error.context}" if error.context else ""
    builder.error(
        f"the YAML is not well-formed: {error.problem or 'unreadable'}{context}",
        Location(file, number),
        "look at this line and the one before: a missing colon, bracket or quote, or a wrong indentation",
    )


class _Builder:
    def __init__(self) -> None:
        self.anchors: dict[str, YamlNode] = {}
        self.total = 0

    def build(self, text: str) -> YamlNode:
        root: YamlNode | None = None
        open_nodes: list[tuple[YamlNode, str | None, YamlNode | None]] = []
        """Containers not yet closed: node, its anchor, and for a mapping the key that waits for its value."""
        events: Iterator[Any] = yaml.parse(text, Loader=_LOADER)
        for event in events:
            kind = type(event)
            if kind is yaml.ScalarEvent:
                line = event.start_mark.line + 1
                if event.tag is not None:
                    self.untagged(event.tag, line)
                node = YamlNode(NodeKind.SCALAR, line, event.value, not event.style)
                self.count(1, line)
                if event.anchor:
                    self.anchors[event.anchor] = node
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                line = event.start_mark.line + 1
                self.untagged(event.tag, line)
                if len(open_nodes) >= GREATEST_DEPTH:
                    raise _RefusedError(
                        f"the file nests deeper than {GREATEST_DEPTH} levels",
                        line,
                        "no form of geometry needs that; look for brackets that are not closed",
                    )
                self.count(1, line)
                container = YamlNode(NodeKind.MAPPING if kind is yaml.MappingStartEvent else NodeKind.LIST, line)
                open_nodes.append((container, event.anchor, None))
                continue
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                node, anchor, _ = open_nodes.pop()
                if anchor:
                    self.anchors[anchor] = node
            elif kind is yaml.AliasEvent:
                node = self.alias(event.anchor, event.start_mark.line + 1)
            elif kind is yaml.DocumentStartEvent and root is not None:
                raise _RefusedError(
                    "a second document begins here", event.start_mark.line + 1, "keep one model in a file; remove ---"
                )
            else:
                continue
            if not open_nodes:
                root = node
                continue
            parent, anchor, key = open_nodes[-1]
            parent.size += node.size
            if parent.kind is NodeKind.LIST:
                parent.items.append(node)
            elif key is None:
                open_nodes[-1] = (parent, anchor, node)
            else:
                parent.pairs.append((key, node))
                open_nodes[-1] = (parent, anchor, None)
        return root or YamlNode(NodeKind.SCALAR, 1, "", plain=True)

    def count(self, size: int, line: int) -> None:
        self.total += size
        if self.total > GREATEST_SIZE:
            raise _RefusedError(
                f"the file, with its aliases written out, holds more than {GREATEST_SIZE} values",
                line,
                "split it, or use a template instead of aliases within aliases",
            )

    def alias(self, anchor: str, line: int) -> YamlNode:
        node = self.anchors.get(anchor)
        if node is None:
            raise _RefusedError(
                f"alias *{anchor} has no anchor &{anchor} before it that is complete",
                line,
                "write the anchor first; a value cannot hold itself",
            )
        self.count(node.size, line)
        return node

    @staticmethod
    def untagged(tag: str | None, line: int) -> None:
        if tag not in (None, "!"):
            raise _RefusedError(f"the tag {tag} has no meaning here", line, "remove it")
