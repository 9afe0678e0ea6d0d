"""YAML text as a tree of nodes with their lines.

PyYAML's composer is recursive in C, so a few kilobytes of brackets would end the process; its events are not. The tree
is built from them with bounded depth and bounded size. The size counts the nodes of each alias again, so an alias bomb
is rejected at the alias that exceeds it. Tags are rejected: the key decides what a scalar means, so a frame may be
named `on`, `12` or `null`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from typing import Any

import yaml

from modelserver.errors import SyntaxProblemError

MAX_DEPTH = 20
"""No geometry file is nested deeper than 8, no vehicle file deeper than 5."""

_DEPTH_MESSAGE = f"the file nests deeper than {MAX_DEPTH} levels"
_DEPTH_FIX = "look for brackets that are not closed"

MAX_NODES = 4_000_000
"""Nodes, aliases expanded; 10,000 frames have about 130,000."""

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NodeKind(Enum):
    """Type of a node; the value is the text of messages."""

    SCALAR = "a single value"
    LIST = "a list"
    MAPPING = "a mapping"


class YamlNode:
    """A value with its line: `text` of a scalar, `items` of a list, `pairs` of a mapping, in order.

    `is_plain` is true for a scalar without quotes; `size` counts its nodes, aliases expanded.
    """

    __slots__ = ("is_plain", "items", "kind", "line", "pairs", "size", "text")

    def __init__(self, kind: NodeKind, line: int, text: str = "", is_plain: bool = False):
        self.kind = kind
        self.line = line
        self.text = text
        self.is_plain = is_plain
        self.size = 1
        # most nodes are scalars: an empty list for each would double the work of the garbage collector
        self.items: list[YamlNode] = [] if kind is NodeKind.LIST else _NO_ITEMS
        self.pairs: list[tuple[YamlNode, YamlNode]] = [] if kind is NodeKind.MAPPING else _NO_PAIRS

    @property
    def is_null(self) -> bool:
        """Whether the value is empty, `~` or `null` without quotes."""
        return self.kind is NodeKind.SCALAR and self.is_plain and self.text in ("", "~", "null", "Null", "NULL")


_NO_ITEMS: list[YamlNode] = []
_NO_PAIRS: list[tuple[YamlNode, YamlNode]] = []


def parse_yaml(content: bytes, has_aliases: bool = True) -> YamlNode:
    """Parse the one document in `content`. Raises SyntaxProblemError, without `has_aliases` for aliases too."""
    text = ""
    try:
        text = content.decode("utf-8-sig")
        return _NodeBuilder(has_aliases).build(text)
    except UnicodeDecodeError as error:
        message = f"the file is not UTF-8 text: byte {content[error.start]:#04x} in this line"
        fix, line = "save it as UTF-8", content.count(b"\n", 0, error.start) + 1
    except yaml.MarkedYAMLError as error:
        message, fix, line = _explain_syntax(error, text)
    except yaml.reader.ReaderError as error:
        place = error.position if isinstance(error.position, int) else 0
        message = f"the file holds a character that YAML forbids: {_format_character(error.character)}"
        fix, line = "remove it, and save the file as UTF-8 text", text.count("\n", 0, place) + 1
    except yaml.YAMLError as error:
        message, fix, line = f"the YAML cannot be read: {error}", "look for a damaged place", 0
    raise SyntaxProblemError(message, line, fix)


def _format_character(value: object) -> str:
    code = ord(value) if isinstance(value, str) and len(value) == 1 else value
    return f"#x{code:04x}" if isinstance(code, int) else repr(value)


def _explain_syntax(error: yaml.MarkedYAMLError, text: str) -> tuple[str, str, int]:
    mark = error.problem_mark or error.context_mark
    number = mark.line + 1 if mark is not None else 0
    lines = text.split("\n")
    if 0 < number <= len(lines) and re.match(r"[ ]*\t", lines[number - 1]):
        return "the line is indented with a tab, which YAML forbids", "write spaces instead of tabs", number
    if "nesting depth" in (error.problem or ""):
        # later versions of libyaml have a limit of their own, which its scanner reaches before the event
        return _DEPTH_MESSAGE, _DEPTH_FIX, number
    context = f" {error.context}" if error.context else ""
    fix = "look at this line and the one before: a missing colon, bracket or quote, or a wrong indentation"
    return f"the YAML is not well-formed: {error.problem or 'unreadable'}{context}", fix, number


class _NodeBuilder:
    def __init__(self, has_aliases: bool) -> None:
        self.has_aliases = has_aliases
        self.anchors: dict[str, YamlNode] = {}
        self.total = 0

    def build(self, text: str) -> YamlNode:
        root: YamlNode | None = None
        open_nodes: list[tuple[YamlNode, str | None, YamlNode | None]] = []
        """Open containers: node, its anchor, and for a mapping the key whose value is next."""
        events: Iterator[Any] = yaml.parse(text, Loader=LOADER)
        for event in events:
            kind, line = type(event), event.start_mark.line + 1
            if kind is yaml.ScalarEvent:
                self.check(event.tag, 1, line)
                node = YamlNode(NodeKind.SCALAR, line, event.value, not event.style)
                if event.anchor:
                    self.anchors[event.anchor] = node
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                self.check(event.tag, 1, line)
                if len(open_nodes) >= MAX_DEPTH:
                    raise SyntaxProblemError(_DEPTH_MESSAGE, line, _DEPTH_FIX)
                container = YamlNode(NodeKind.MAPPING if kind is yaml.MappingStartEvent else NodeKind.LIST, line)
                open_nodes.append((container, event.anchor, None))
                continue
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                node, anchor, _ = open_nodes.pop()
                if anchor:
                    self.anchors[anchor] = node
            elif kind is yaml.AliasEvent:
                if not self.has_aliases:
                    message = f"aliases (*{event.anchor}) are not supported"
                    raise SyntaxProblemError(message, line, "write the value again")
                if event.anchor not in self.anchors:
                    message = f"alias *{event.anchor} has no complete anchor &{event.anchor} before it"
                    raise SyntaxProblemError(message, line, "write the anchor first; a value cannot hold itself")
                node = self.anchors[event.anchor]
                self.check(None, node.size, line)
            elif kind is yaml.DocumentStartEvent and root is not None:
                fix = "keep one model in a file; remove ---"
                raise SyntaxProblemError("a second document begins here", line, fix)
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
        return root or YamlNode(NodeKind.SCALAR, 1, "", is_plain=True)

    def check(self, tag: str | None, size: int, line: int) -> None:
        """Reject a tag, and the node that makes the file too large."""
        if tag not in (None, "!"):
            raise SyntaxProblemError(f"the tag {tag} has no meaning here", line, "remove it")
        self.total += size
        if self.total > MAX_NODES:
            message = f"the file, with its aliases expanded, holds more than {MAX_NODES} values"
            fix = "split it, or use a template instead of aliases within aliases"
            raise SyntaxProblemError(message, line, fix)
