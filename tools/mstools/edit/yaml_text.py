"""YAML text that is changed in place: what a change does not name stays byte for byte.

Libraries that write a parsed document again, ruamel.yaml too, normalize spaces, indentation and line breaks, and move a
comment with the value before it: what is appended to a mapping then stands after the comment of the next one, and what
is deleted takes that comment along. Here a parser only shows where each key and value stands, and the text between is
replaced. A path is a sequence of keys: ("bodies", "Rover", "frames", "GPS").
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Self

import yaml

from modelserver.errors import ModelServerError, SyntaxProblemError, quote
from modelserver.yaml_tree import LOADER, parse_yaml

KeyPath = Sequence[str]
MAX_SPACES = 1000
"""Spaces before a colon that are looked through."""


class EditError(ModelServerError):
    """A change cannot be made; the text is as before."""


class TextEntry(NamedTuple):
    """A key with its value, and where they stand: `key` and `value` are YAML nodes, the others offsets in the text.

    `line` is the begin of the line of the key, `colon` where the colon ends, 0 for a key in braces without one, `end`
    the end of the value, `is_flow` whether braces are around it.
    """

    key: Any
    value: Any
    line: int
    colon: int
    end: int
    is_flow: bool

    @property
    def name(self) -> str:
        return str(self.key.value).strip()


class YamlText:
    """Immutable YAML text. Each change returns another one of this class, or raises EditError."""

    def __init__(self, text: str):
        self.text = text
        try:
            content = text.encode()
        except UnicodeEncodeError as error:
            raise EditError(f"{text[error.start : error.end]!r} is no character of a text file; remove it") from None
        try:
            # bounds depth and size: the parser below is recursive
            parse_yaml(content)
        except SyntaxProblemError as error:
            raise EditError(f"line {error.line}: {error}; {error.fix}") from None
        self._root = yaml.compose(text, Loader=LOADER)
        self._newline = "\r\n" if "\r\n" in text else "\n"
        uses = Counter(id(node) for node in _walk(self._root))
        self._shared = {node for node, count in uses.items() if count > 1}

    # --- reading

    def entries(self, path: KeyPath = ()) -> list[TextEntry]:
        """Return the entries of a mapping, in order; none if it is absent or no mapping."""
        node: Any = self._root if not path else self._get(path)
        return [] if node is None else list(self._list_entries(node))

    def keys(self, path: KeyPath = ()) -> list[str]:
        return [each.name for each in self.entries(path)]

    def has(self, path: KeyPath) -> bool:
        return self._find(path) is not None

    def get_text(self, path: KeyPath) -> str:
        """Return the text of a scalar, empty if it is absent or none."""
        node = self._get(path)
        return str(node.value).strip() if isinstance(node, yaml.ScalarNode) else ""

    def get_list(self, path: KeyPath) -> list[str]:
        """Return the texts of a list of scalars, empty if it is none."""
        node = self._get(path)
        if not isinstance(node, yaml.SequenceNode) or any(not isinstance(each, yaml.ScalarNode) for each in node.value):
            return []
        return [str(each.value) for each in node.value]

    def get_entry(self, path: KeyPath) -> str:
        """Return a key and its value as they are written, without indentation. Raises EditError if it is absent."""
        found = self._require(path)
        begin = found.key.start_mark.index
        text = self.text[begin : found.end].replace("\r\n", "\n")
        return text if found.is_flow else textwrap.dedent(" " * found.key.start_mark.column + text)

    def list_lines(self, path: KeyPath) -> list[tuple[int, str]]:
        """Return the keys of a mapping with their lines, counted from 1."""
        return [(each.key.start_mark.line + 1, each.name) for each in self.entries(path)]

    # --- changes

    def set(self, path: KeyPath, value: str) -> Self:
        """Set the value of a key to a value on one line; the key is added last if it is absent."""
        found = self._find(path)
        if found is None:
            return self.add(path[:-1], f"{path[-1]}: {value}")
        self._check_own(path)
        begin = found.value.start_mark.index
        if found.end <= found.colon or "\n" in self.text[found.colon : begin]:
            # no value yet, or a block
            return self._set_value(found, f" {value}")
        return self._replace(begin, found.end, value)

    def add(self, path: KeyPath, entry: str, after: str = "", *, in_block: bool = False) -> Self:
        """Add an entry `key: value`, of one or more lines without indentation, to a mapping.

        It stands after the key `after`, else last. An empty mapping gets braces, or with `in_block` lines of its own;
        one that is absent is added.
        """
        node: Any = self._root if not path else self._get(path)
        if path and not self.has(path):
            block = f"{path[-1]}:\n{textwrap.indent(entry, '  ')}"
            return self.add(path[:-1], block if in_block else f"{path[-1]}: {{{entry}}}", in_block=in_block)
        self._check_own(path, is_whole=False)
        entries = self.entries(path)
        if not entries:
            found = self._require(path)
            if in_block and not found.is_flow:
                indent = " " * (found.key.start_mark.column + self._get_step())
                return self._set_value(found, self._newline + self._indent(entry, indent))
            return self._set_value(found, f" {{{entry}}}")
        last = next((each for each in entries if each.name == after), entries[-1])
        if node.flow_style:
            if "\n" in entry:
                raise EditError(f"{' '.join(path)} is written in braces; write it on lines of its own first")
            return self._replace(last.end, last.end, f", {entry}")
        indent = " " * entries[0].key.start_mark.column
        end = self._find_line_end(last.end)
        # by the first two, whether a blank line stands between entries
        has_gaps = len(entries) > 1 and self._newline * 2 in self.text[entries[0].end : entries[1].line + 1]
        gap = self._newline if has_gaps else ""
        return self._replace(end, end, self._newline + gap + self._indent(entry, indent))

    def _set_value(self, entry: TextEntry, value: str) -> Self:
        """Write a value, with the space before it, behind the colon of an entry."""
        if entry.colon:
            return self._replace(entry.colon, entry.end, value)
        return self._replace(entry.end, entry.end, f":{value}")

    def insert_first(self, path: KeyPath, entry: str) -> Self:
        """Add an entry on one line before the others of a mapping."""
        entries = self.entries(path)
        if not entries:
            return self.add(path, entry)
        self._check_own(path, is_whole=False)
        first = entries[0]
        at = first.key.start_mark.index
        if first.is_flow:
            return self._replace(at, at, f"{entry}, ")
        return self._replace(at, at, entry + self._newline + " " * first.key.start_mark.column)

    def remove(self, path: KeyPath) -> Self:
        """Remove a key with its value, and the comment on the lines directly before it."""
        found = self._require(path)
        self._check_own(path)
        entries = self.entries(path[:-1])
        if len(entries) == 1 and len(path) > 1:
            if found.is_flow:
                return self._replace(found.key.start_mark.index, found.end, "")
            return self._set_value(self._require(path[:-1]), " {}")
        number = next(n for n, each in enumerate(entries) if each.name == path[-1])
        if found.is_flow:
            if number + 1 < len(entries):
                return self._replace(found.key.start_mark.index, entries[number + 1].key.start_mark.index, "")
            return self._replace(entries[number - 1].end if number else found.key.start_mark.index, found.end, "")
        begin = self._find_comment_begin(found)
        end = self._find_next_line(found.end)
        is_after_gap = begin == 0 or self.text[:begin].endswith(self._newline * 2)
        if is_after_gap and self.text.startswith(self._newline, end):
            end += len(self._newline)
        elif end >= len(self.text) and is_after_gap:
            begin = max(begin - len(self._newline), 0)
        return self._replace(begin, end, "")

    def drop(self, path: KeyPath) -> Self:
        return self.remove(path) if self.has(path) else self

    def rename_key(self, path: KeyPath, key: str) -> Self:
        """Write another key, as YAML, in the place of one."""
        found = self._require(path)
        self._check_own(path[:-1], is_whole=False)
        return self._replace(found.key.start_mark.index, found.key.end_mark.index, key)

    def replace_entry(self, path: KeyPath, entry: str) -> Self:
        """Write another entry, `key: value` of one or more lines without indentation, in the place of one."""
        found = self._require(path)
        self._check_own(path)
        if found.is_flow and "\n" in entry.strip():
            raise EditError("this entry is written within braces; write it on one line")
        indent = "" if found.is_flow else " " * found.key.start_mark.column
        return self._replace(found.key.start_mark.index, found.end, self._indent(entry.strip("\n"), indent).lstrip(" "))

    # --- where things stand

    def _replace(self, begin: int, end: int, text: str) -> Self:
        return type(self)(self.text[:begin] + text + self.text[end:])

    def _get(self, path: KeyPath) -> Any:
        found = self._find(path)
        return None if found is None else found.value

    def _find(self, path: KeyPath) -> TextEntry | None:
        node: Any = self._root
        found: TextEntry | None = None
        for key in path:
            pairs = node.value if isinstance(node, yaml.MappingNode) else ()
            pair = next((each for each in pairs if str(each[0].value).strip() == key), None)
            if pair is None:
                return None
            found = self._make_entry(pair[0], pair[1], bool(node.flow_style))
            node = found.value
        return found

    def _require(self, path: KeyPath) -> TextEntry:
        found = self._find(path)
        if found is None:
            raise EditError(f"there is no {' '.join(path)} in the file")
        return found

    def _check_own(self, path: KeyPath, is_whole: bool = True) -> None:
        """Raise EditError if what a path leads to, or with `is_whole` a part of it, is shared by an alias."""
        for length in range(1, len(path) + 1):
            found = self._find(path[:length])
            if found is not None and id(found.value) in self._shared:
                line = found.value.start_mark.line + 1
                raise EditError(f"{quote(path[length - 1])} is shared by an alias (line {line}); write it out first")
        found = self._find(path)
        if is_whole and found is not None and any(id(each) in self._shared for each in _walk(found.value)):
            raise EditError(f"{quote(path[-1])} has a part that is shared by an alias; write it out first")

    def _list_entries(self, node: Any) -> Iterator[TextEntry]:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                yield self._make_entry(key, value, bool(node.flow_style))

    def _make_entry(self, key: Any, value: Any, is_flow: bool) -> TextEntry:
        line = self.text.rfind("\n", 0, key.start_mark.index) + 1
        colon = self._find_colon(key)
        end = max(self._find_end(value, key.start_mark.column), colon, key.end_mark.index)
        return TextEntry(key, value, line, colon, end, is_flow)

    def _find_colon(self, key: Any) -> int:
        """Return the end of the colon behind a key, 0 if there is none."""
        at = int(key.end_mark.index)
        between = len(self.text[at : at + MAX_SPACES]) - len(self.text[at : at + MAX_SPACES].lstrip())
        return at + between + 1 if self.text[at + between : at + between + 1] == ":" else 0

    def _find_end(self, node: Any, indent: int) -> int:
        """Return the end of a value without the comments and blank lines after it, 0 for one that is not written.

        The parser ends blocks where the next thing begins. `indent` is the column of the key.
        """
        if isinstance(node, yaml.ScalarNode):
            if node.style in ("|", ">"):
                return self._find_block_end(node.start_mark.index, indent)
            return 0 if node.start_mark.index == node.end_mark.index else int(node.end_mark.index)
        if node.flow_style or not node.value:
            return int(node.end_mark.index)
        last = node.value[-1]
        if isinstance(node, yaml.MappingNode):
            key, value = last
            column = key.start_mark.column
            return max(self._find_end(value, column), self._find_colon(key))
        return max(self._find_end(last, node.start_mark.column), int(last.start_mark.index))

    def _find_block_end(self, begin: int, indent: int) -> int:
        """Return the end of a block scalar whose indicator is at `begin`: of its last line that is not blank."""
        end = self._find_line_end(begin)
        line = self._find_next_line(begin)
        while line < len(self.text):
            line_end = self._find_line_end(line)
            text = self.text[line:line_end]
            if text.strip():
                if len(text) - len(text.lstrip(" ")) <= indent:
                    break
                end = line_end
            line = self._find_next_line(line)
        return end

    def _find_line_end(self, at: int) -> int:
        end = self.text.find("\n", at)
        if end < 0:
            return len(self.text)
        return end - 1 if self.text[end - 1 : end] == "\r" else end

    def _find_next_line(self, at: int) -> int:
        end = self.text.find("\n", at)
        return len(self.text) if end < 0 else end + 1

    def _find_comment_begin(self, entry: TextEntry) -> int:
        """Return the begin of the comment on the lines directly before an entry, else of its line."""
        begin = entry.line
        while begin > 0:
            previous = self.text.rfind("\n", 0, begin - 1) + 1
            line = self.text[previous:begin]
            if not line.lstrip(" ").startswith("#") or line.index("#") != entry.key.start_mark.column:
                break
            begin = previous
        return begin

    def _get_step(self) -> int:
        """Return by how much the file indents: as its first nested block does."""
        for entry in self.entries():
            for inner in self._list_entries(entry.value):
                if not inner.is_flow:
                    return int(inner.key.start_mark.column)
        return 2

    def _indent(self, entry: str, indent: str) -> str:
        lines = [indent + line if line.strip() else "" for line in entry.splitlines()]
        return self._newline.join(lines)


def _walk(node: Any) -> Iterator[Any]:
    """Yield all nodes, one that several aliases name once for each."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _walk(key)
            yield from _walk(value)
    elif isinstance(node, yaml.SequenceNode):
        for each in node.value:
            yield from _walk(each)
    if node is not None:
        yield node
