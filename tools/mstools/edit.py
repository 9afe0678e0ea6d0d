"""A geometry file as bodies, frames and constraints that are changed in its text, byte for byte the same elsewhere.

Libraries that write a parsed document again, ruamel.yaml too, normalize spaces, indentation and line breaks, and move a
comment with the value before it: what is appended to a mapping then stands after the comment of the next one, and what
is deleted takes that comment along. Here a parser only shows where each key and value stands, and the text between is
replaced. A path is a sequence of keys: ("bodies", "Rover", "frames", "GPS").

A frame of a template is on each body that names the template. Changed on one body, it gets an entry of its own there;
with `in_template` the template is changed, and with it all bodies that use it.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import shlex
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import yaml

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.errors import ModelServerError, Problem, SyntaxProblemError, has_error, quote
from modelserver.files import EXAMINED_BYTES, FileKind, detect_file_kind, read_start
from modelserver.formats import bot_frames, parse_content, read_content
from modelserver.formats.common import format_number, parse_number
from modelserver.formats.yaml_elements import POSE_KEYS, YamlMapping, read_pose
from modelserver.formats.yaml_geometry import format_joint_fields, format_scalar_or_list, format_text, quote_text
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint
from modelserver.geometry.model import Model
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from modelserver.yaml_tree import LOADER, parse_yaml
from mstools.terminal.output import open_atomic

KeyPath = Sequence[str]

DECIMALS: Final = 9
"""Of meters and degrees that are written."""

SAME_METERS: Final = 1e-9
SAME_RADIANS: Final = 1e-9
"""A position or rotation that differs by less stays as it is written."""

WRITTEN_ORDER: Final = ("template", "from", "to", *POSE_KEYS, "sigma", "joint", "description")

_PLAIN_NAME = re.compile(r"[A-Za-z][\w.-]*")
_PLAIN_TEXT = re.compile(r"[A-Za-z][\w .;/()-]*[\w.)]")


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
        return list(self._list_entries(self._get(path)))

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
        if last.is_flow:
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
        return found.value if found is not None else None if path else self._root

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
        end = max(self._find_end(value), colon, key.end_mark.index)
        return TextEntry(key, value, line, colon, end, is_flow)

    def _find_colon(self, key: Any) -> int:
        """Return the end of the colon behind a key, 0 if there is none."""
        found = re.compile(r"\s*:").match(self.text, int(key.end_mark.index))
        return 0 if found is None else found.end()

    def _find_end(self, node: Any) -> int:
        """Return the end of a value without the comments and blank lines after it, 0 for one that is not written.

        The parser ends blocks where the next thing begins.
        """
        if isinstance(node, yaml.ScalarNode):
            if node.style in ("|", ">"):
                written = self.text[node.start_mark.index : node.end_mark.index].rstrip()
                return self._find_line_end(node.start_mark.index + len(written) - 1)
            return 0 if node.start_mark.index == node.end_mark.index else int(node.end_mark.index)
        if node.flow_style or not node.value:
            return int(node.end_mark.index)
        last = node.value[-1]
        if isinstance(node, yaml.MappingNode):
            key, value = last
            return max(self._find_end(value), self._find_colon(key))
        return max(self._find_end(last), int(last.start_mark.index))

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
    if node is None:
        return
    yield node
    if not isinstance(node, yaml.ScalarNode):
        for each in chain.from_iterable(node.value) if isinstance(node, yaml.MappingNode) else node.value:
            yield from _walk(each)


# --- geometry file


class ItemKind(StrEnum):
    """What is edited."""

    BODY = "body"
    FRAME = "frame"
    CONSTRAINT = "constraint"


class GeometryItem(NamedTuple):
    """A body, frame (by its full name) or constraint."""

    kind: ItemKind
    name: str


WHOLE_FILE: Final = GeometryItem(ItemKind.BODY, "")
"""What is edited of a file without bodies: all of its text."""


class GeometryDocument(YamlText):
    """Immutable text of a geometry file in YAML. Changes return another document, or raise EditError.

    Positions are in meters, angles in degrees: as they are written.
    """

    # --- what is there

    def list_items(self) -> list[GeometryItem]:
        return list(dict.fromkeys(item for _, item in self._list_places()))

    def find_item(self, line: int) -> GeometryItem | None:
        """Return what stands on a line: the last item that begins on it or before.

        A frame of a template is that of the first body that names it.
        """
        before = [(at, item) for at, item in self._list_places() if at <= line]
        return max(before, key=lambda each: each[0])[1] if before else None

    def _list_places(self) -> Iterator[tuple[int, GeometryItem]]:
        """Yield each item with its line, the frames of a template on each body that names it."""
        for at, body in self.list_lines(("bodies",)):
            yield at, GeometryItem(ItemKind.BODY, body)
            for path in (("templates", self._get_template(body)), ("bodies", body)):
                for of_frame, frame in self.list_lines((*path, "frames")):
                    yield of_frame, GeometryItem(ItemKind.FRAME, names.join(body, frame))
        for at, constraint in self.list_lines(("constraints",)):
            yield at, GeometryItem(ItemKind.CONSTRAINT, constraint)

    def find_template(self, item: GeometryItem) -> str:
        """Return the template from which a frame of a body comes, empty if it is the body's own."""
        if item.kind is not ItemKind.FRAME:
            return ""
        body, frame = names.split(item.name)
        template = self._get_template(body)
        own = self.has(("bodies", body, "frames", frame))
        return template if not own and self.has(("templates", template, "frames", frame)) else ""

    def list_users(self, template: str) -> list[str]:
        return [body for body in self.keys(("bodies",)) if self._get_template(body) == template]

    def get_yaml(self, item: GeometryItem) -> str:
        """Return the entry of an item as it is written, without indentation."""
        return self.text if item == WHOLE_FILE else self.get_entry(self._find_path(item))

    def _get_template(self, body: str) -> str:
        return self.get_text(("bodies", body, "template"))

    def _find_path(self, item: GeometryItem) -> KeyPath:
        """Return where an item is written. Raises EditError if it is not there."""
        if item.kind is ItemKind.FRAME:
            body, frame = names.split(item.name)
            template = self.find_template(item)
            path: KeyPath = ("templates", template) if template else ("bodies", body)
            path = (*path, "frames", frame)
        else:
            path = ("bodies" if item.kind is ItemKind.BODY else "constraints", item.name)
        if not self.has(path):
            raise EditError(f"there is no {item.kind} {quote(item.name)}")
        return path

    # --- numbers and texts

    def set_pose(self, item: GeometryItem, xyz: Vector3, rpy_deg: Vector3, in_template: bool = False) -> Self:
        """Set the pose of a frame on its body, or of a constraint. Only what differs is written."""
        _check_finite((*xyz, *rpy_deg))
        text, path = self._open(item, in_template)
        old, new = _read_pose(text, path), Pose.from_rpy(xyz, *map(math.radians, rpy_deg))
        is_turned = old.distance(new)[1] > SAME_RADIANS
        has_matrix = text.has((*path, "matrix"))
        if is_turned or has_matrix:
            for key in ("rpy", "quaternion", "rotation", "matrix"):
                text = text.drop((*path, key))
            text = text._set_numbers(path, "rpy_deg", rpy_deg)
        if has_matrix or max(abs(a - b) for a, b in zip(old.xyz, xyz, strict=True)) > SAME_METERS:
            text = text._set_numbers(path, "xyz", xyz)
        return text

    def set_sigma(
        self, item: GeometryItem, xyz: Vector3 | None, rpy_deg: Vector3 | None, in_template: bool = False
    ) -> Self:
        """Set the standard deviations of a frame or constraint; a part that is None is not stated."""
        _check_finite([*(xyz or ()), *(rpy_deg or ())])
        text, path = self._open(item, in_template)
        stated = [
            f"{key}: {format_scalar_or_list(tuple([round(each, DECIMALS) for each in values]))}"
            for key, values in (("xyz", xyz), ("rpy_deg", rpy_deg))
            if values is not None
        ]
        if stated:
            return text._set_key(path, "sigma", f"{{{', '.join(stated)}}}")
        return text.drop((*path, "sigma"))

    def set_description(self, item: GeometryItem, description: str, in_template: bool = False) -> Self:
        """Set the description of an item, or remove it where it is empty."""
        text, path = self._open(item, in_template)
        if description == text.get_text((*path, "description")):
            return text
        if description:
            return text._set_key(path, "description", _format_word(description))
        return text.drop((*path, "description"))

    def set_ends(self, constraint: str, from_: str, to: str) -> Self:
        """Set the frames that a constraint joins."""
        text, path = self._open(GeometryItem(ItemKind.CONSTRAINT, constraint))
        for key, frame in (("from", from_), ("to", to)):
            if _normalize(text.get_text((*path, key))) != frame:
                text = text._set_key(path, key, _format_full_name(frame))
        return text

    def set_joint(self, constraint: str, old: Joint, new: Joint) -> Self:
        """Set the joint of a constraint, `old` before; keys whose value is the same stay as they are written."""
        text, path = self._open(GeometryItem(ItemKind.CONSTRAINT, constraint))
        inside = (*path, "joint")
        if not new.is_movable:
            return text.drop(inside)
        was, now = (dict(each.split(": ", 1) for each in format_joint_fields(joint)) for joint in (old, new))
        if not text.keys(inside):
            return text._set_key(path, "joint", f"{{{', '.join(f'{key}: {each}' for key, each in now.items())}}}")
        for key in [*was, *(each for each in now if each not in was)]:
            if was.get(key) == now.get(key):
                continue
            for written in (key, key.removesuffix("_deg")):
                if written != key or key not in now:
                    text = text.drop((*inside, written))
            if key in now:
                text = text.set((*inside, key), now[key])
        return text

    # --- items

    def add_body(self, name: str) -> Self:
        self._make_new(ItemKind.BODY, name)
        return self.add(("bodies",), f"{_format_key(name)}:\n  frames:\n    Origin: {{}}", in_block=True)

    def add_frame(self, body: str, name: str, xyz: Vector3 = (0.0, 0.0, 0.0)) -> Self:
        """Add a frame to a body, along the body's axes."""
        self._make_new(ItemKind.FRAME, name, body)
        self._find_path(GeometryItem(ItemKind.BODY, body))
        value = (
            f"{{xyz: [{', '.join(format_number(round(each, DECIMALS) + 0.0) for each in xyz)}]}}" if any(xyz) else "{}"
        )
        return self.add(("bodies", body, "frames"), f"{_format_key(name)}: {value}", in_block=True)

    def add_constraint(self, name: str, from_: str, to: str) -> Self:
        self._make_new(ItemKind.CONSTRAINT, name)
        entry = f"{_format_key(name)}:\n  from: {_format_full_name(from_)}\n  to: {_format_full_name(to)}"
        return self.add(("constraints",), entry, in_block=True)

    def duplicate(self, item: GeometryItem, name: str) -> Self:
        """Add a copy of an item directly after it; a frame's copy is on the same body, `name` without the body."""
        path = self._find_path(item)
        body = names.split(item.name)[0] if item.kind is ItemKind.FRAME else ""
        self._make_new(item.kind, name, body)
        entry = YamlText(self.get_entry(path))
        copy = entry.rename_key((path[-1],), _format_key(name)).text
        place = ("bodies", body, "frames") if body else path[:-1]
        return self.add(place, copy, after=path[-1], in_block=True)

    def rename(self, item: GeometryItem, name: str, in_template: bool = False) -> Self:
        """Rename an item, a frame without its body, and what refers to it in this file."""
        body, frame = names.split(item.name) if item.kind is ItemKind.FRAME else (item.name, "")
        new = self._make_new(item.kind, name, body if frame else "")
        template = self.find_template(item)
        if template and not in_template:
            raise EditError(f"{item.name} is a frame of template {template}; change the template to rename it")
        path = self._find_path(item)
        text = self.rename_key(path, _format_key(name))
        if item.kind is ItemKind.CONSTRAINT:
            return text._rename_leader(item.name, name)
        renamed = {item.name: new.name}
        if template:
            copies = self._list_copies(template, frame)
            renamed = {each: names.join(names.split(each)[0], name) for each in copies}
        for constraint, end, joined in self._list_ends():
            other = renamed.get(joined, joined)
            if item.kind is ItemKind.BODY and joined.partition(":")[0] == body:
                other = names.join(name, joined.partition(":")[2])
            if other != joined:
                text = text.set(("constraints", constraint, end), _format_full_name(other))
        return text

    def delete(self, item: GeometryItem, in_template: bool = False) -> Self:
        """Delete an item, and the constraints at a body or frame."""
        template = self.find_template(item)
        if template and not in_template:
            raise EditError(f"{item.name} is a frame of template {template}; change the template to delete it")
        text = self.remove(self._find_path(item))
        gone = {item.name}
        if template:
            gone = set(self._list_copies(template, names.split(item.name)[1]))
        if item.kind is not ItemKind.CONSTRAINT:
            # several ends of one constraint may be gone
            lost = {
                constraint: None
                for constraint, _, joined in self._list_ends()
                if joined in gone or (item.kind is ItemKind.BODY and joined.partition(":")[0] == item.name)
            }
            for constraint in lost:
                text = text.remove(("constraints", constraint))
        return text

    def set_yaml(self, item: GeometryItem, entry: str) -> GeometryDocument:
        """Write the entry of an item, `name: value`, as given. Its name stays."""
        if item == WHOLE_FILE:
            return open_document(entry)
        path = self._find_path(item)
        keys = YamlText(entry).keys()
        if keys != [path[-1]]:
            raise EditError(f"the text is one entry that begins with {path[-1]}:")
        return self.replace_entry(path, entry)

    # --- inside

    def _open(self, item: GeometryItem, in_template: bool = False) -> tuple[Self, KeyPath]:
        """Return the text, in which a frame of a template has an entry on its body if that alone is changed."""
        path = self._find_path(item)
        if path[0] != "templates" or in_template:
            return self, path
        body, _ = names.split(item.name)
        text = self.add(("bodies", body, "frames"), self.get_entry(path), in_block=True)
        return text, ("bodies", body, "frames", path[-1])

    def _make_new(self, kind: ItemKind, name: str, body: str = "") -> GeometryItem:
        """Return a new item, a frame by its name on a body. Raises EditError for a name not allowed or taken."""
        find = names.find_body_problem if kind is ItemKind.BODY else names.find_problem
        if problem := find(name):
            raise EditError(f"{quote(name)}: {problem}")
        item = GeometryItem(kind, names.join(body, name) if body else name)
        if item in self.list_items():
            raise EditError(f"there is a {kind} {quote(item.name)} already")
        return item

    def _list_copies(self, template: str, frame: str) -> list[str]:
        """Return the full names of a template's frame on the bodies that have it from there."""
        copies = (GeometryItem(ItemKind.FRAME, names.join(body, frame)) for body in self.list_users(template))
        return [item.name for item in copies if self.find_template(item)]

    def _list_ends(self) -> Iterator[tuple[str, str, str]]:
        """Yield each end of each constraint: constraint, key, frame."""
        for constraint in self.keys(("constraints",)):
            for end in ("from", "to"):
                if joined := _normalize(self.get_text(("constraints", constraint, end))):
                    yield constraint, end, joined

    def _rename_leader(self, old: str, new: str) -> Self:
        text = self
        for constraint in text.keys(("constraints",)):
            path = ("constraints", constraint, "joint", "mimic")
            for place in (path, (*path, "joint")):
                if text.get_text(place) == old:
                    text = text.set(place, _format_word(new))
        return text

    def _set_key(self, path: KeyPath, key: str, value: str) -> Self:
        """Set a key of an entry; a new one stands after those that usually precede it."""
        if self.has((*path, key)):
            return self.set((*path, key), value)
        usual = WRITTEN_ORDER[: WRITTEN_ORDER.index(key)]
        before = [each for each in self.keys(path) if each in usual]
        if before or not self.keys(path):
            return self.add(path, f"{key}: {value}", before[-1] if before else "")
        return self.insert_first(path, f"{key}: {value}")

    def _set_numbers(self, path: KeyPath, key: str, values: Sequence[float]) -> Self:
        """Set a list of numbers; those that are the same stay as they are written."""
        written = self.get_list((*path, key))
        old = [_parse(each) for each in written] if len(written) == len(values) else [math.nan] * len(values)
        new = [round(value, DECIMALS) + 0.0 for value in values]
        if old == new or (not written and not any(new)):
            return self
        shown = [written[n] if old[n] == value else format_number(value) for n, value in enumerate(new)]
        return self._set_key(path, key, f"[{', '.join(shown)}]")


class UnreadableDocument(GeometryDocument):
    """Text that is not a YAML mapping. It has no items, and is written as a whole: `set_yaml` of `WHOLE_FILE`."""

    def __init__(self, text: str):
        super().__init__("")
        self.text = text

    def add(self, path: KeyPath, entry: str, after: str = "", *, in_block: bool = False) -> Self:
        """Raise EditError: nothing can be added."""
        raise EditError("the file has no readable mapping to which this could be added; write it as text first")


def open_document(text: str) -> GeometryDocument:
    """Return the document of a text, an `UnreadableDocument` where it is not a YAML mapping."""
    with suppress(EditError):
        document = GeometryDocument(text)
        if document.keys():
            return document
    return UnreadableDocument(text)


def _read_pose(text: YamlText, path: KeyPath) -> Pose:
    """Return the pose that an entry states, the identity where it states none or a wrong one."""
    try:
        root = parse_yaml(text.get_entry(path).encode())
    except SyntaxProblemError:
        raise EditError(f"{quote(path[-1])} has a part that is shared by an alias; write it out first") from None
    return read_pose(YamlMapping(ModelBuilder(), "", root.pairs[0][1], "", WRITTEN_ORDER)) or Pose.identity()


def _check_finite(values: Sequence[float]) -> None:
    for value in values:
        if not math.isfinite(value):
            raise EditError(f"{value} is no number of a pose or sigma; enter a finite one")


def _parse(text: str) -> float:
    try:
        return parse_number(text)
    except ValueError:
        return math.nan


def _format_key(name: str) -> str:
    """Return a name as a key, also within braces."""
    return name if _PLAIN_NAME.fullmatch(name) and format_text(name) == name else quote_text(name)


def _format_word(text: str) -> str:
    """Return a text as a value, also within braces."""
    return text if _PLAIN_TEXT.fullmatch(text) and format_text(text) == text else quote_text(text)


def _format_full_name(name: str) -> str:
    return name if all(_PLAIN_NAME.fullmatch(part) for part in name.split(":")) else quote_text(name)


def _normalize(name: str) -> str:
    """Return the full name of a frame without spaces around its parts."""
    return ":".join(part.strip() for part in name.split(":"))


# --- session

MAX_STEPS = 500
"""Changes that can be undone."""

_BOM = "\ufeff"


class Step(NamedTuple):
    """A document with the name of the change that led to it."""

    document: GeometryDocument
    change: str


NEW_GEOMETRY: Final = """\
modelserver: geometry/1
name: {name}

bodies:
  Base:
    frames:
      Origin: {{}}
"""


@dataclass(frozen=True)
class EditedFile:
    """The geometry file that is edited; `config` of the vehicle file `vehicle` if that names it.

    One that `is_new` need not be there yet: its text is empty until it is saved.
    """

    path: Path
    vehicle: Path | None = None
    config: VehicleConfig | None = None
    is_new: bool = False

    @classmethod
    def open(cls, path: Path) -> EditedFile:
        """Return the geometry file at a path, or that of a vehicle file. Raises ConfigError, OSError."""
        if detect_file_kind(read_start(path, EXAMINED_BYTES)) is not FileKind.VEHICLE:
            return cls(path)
        config = load_config(path)
        return cls(Path(config.geometry), path, config)

    def read(self) -> str:
        """Return the text of the file. Raises OSError, GeometryError, EditError for one of another format."""
        if self.is_new and not os.path.lexists(self.path):
            return ""
        content = read_content(self.path)
        start = content.removeprefix(b"\xef\xbb\xbf").lstrip()
        if start.startswith(b"<") or bot_frames.is_bot_param(start):
            known = "XML" if start.startswith(b"<") else "a libbot2 configuration"
            given = shlex.quote(str(self.path))
            raise EditError(
                f"{self.path} is {known}; only YAML is edited: modelserver convert {given} geometry.yaml, "
                "then modelserver view geometry.yaml --edit"
            )
        try:
            return content.decode()
        except UnicodeDecodeError:
            raise EditError(f"{self.path} is not UTF-8 text; save it as that first") from None

    def check(self, text: str, variables: Mapping[str, str]) -> tuple[Model | None, Model | None, tuple[Problem, ...]]:
        """Return the model in a text, None for one with an error; what can be drawn of it; and all problems."""
        builder = parse_content(text.encode(), str(self.path), variables)
        model, problems = builder.check()
        partial = model or builder.build_bodies()
        if self.config is not None and partial is not None:
            from modelserver.server.vehicle import find_frame_problems

            problems += tuple(find_frame_problems(self.config, partial, str(self.vehicle), model is not None))
        return model, partial, problems


class EditSession:
    """Edit a file. Raises EditError for a file that cannot be edited, OSError."""

    def __init__(self, file: EditedFile, variables: Mapping[str, str] | None = None):
        self.file = file
        self._variables = variables or {}
        self.read()

    def read(self) -> None:
        """Read the file again; all changes are dropped. Raises as `EditSession`, with all as before."""
        saved = self.file.read()
        text = saved.removeprefix(_BOM)
        if self.file.is_new and not text:
            text = NEW_GEOMETRY.format(name=format_text(self.file.path.stem))
        document = open_document(text)
        _, drawn, _ = self.file.check(document.text, self._variables)
        self._saved = saved
        self._steps = [Step(document, "")]
        self._undone: list[Step] = []
        self.drawn: Model = drawn or Model((), ())
        """The last model without an error; before there is one, the bodies of the file alone, if it has any."""
        self.model: Model | None = None
        """The last model without an error."""
        self._loaded: GeometryDocument | None = None
        self._check()

    def _check(self) -> None:
        model, drawn, self.problems = self.file.check(self.document.text, self._variables)
        if model is not None:
            self.model = self.drawn = model
            self._loaded = self.document
        elif self.model is None and drawn is not None:
            self.drawn = drawn

    @property
    def document(self) -> GeometryDocument:
        return self._steps[-1].document

    @property
    def is_changed(self) -> bool:
        return self.document.text != self._saved.removeprefix(_BOM)

    @property
    def has_errors(self) -> bool:
        return has_error(self.problems)

    @property
    def undo_name(self) -> str:
        """The change that `undo` undoes, empty for none."""
        return self._steps[-1].change if len(self._steps) > 1 else ""

    @property
    def redo_name(self) -> str:
        """The change that `redo` makes again, empty for none."""
        return self._undone[-1].change if self._undone else ""

    def change(self, name: str, change: Callable[[GeometryDocument], GeometryDocument]) -> bool:
        """Make a change; return whether it changed anything. Raises EditError, with all as before."""
        document = change(self.document)
        if document.text == self.document.text:
            return False
        self._steps.append(Step(document, name))
        del self._steps[1:-MAX_STEPS]
        self._undone.clear()
        self._check()
        return True

    def undo(self) -> None:
        if len(self._steps) > 1:
            self._undone.append(self._steps.pop())
            self._check()

    def redo(self) -> None:
        if self._undone:
            self._steps.append(self._undone.pop())
            self._check()

    def is_as_loaded(self, item: GeometryItem) -> bool:
        """Return whether the entry of an item is written as in the document of `model`."""
        try:
            return self._loaded is not None and self._loaded.get_yaml(item) == self.document.get_yaml(item)
        except EditError:
            return False

    def has_changed_on_disk(self) -> bool:
        """Return whether the file is no longer what was read or saved."""
        try:
            return self.file.read() != self._saved
        except (ModelServerError, OSError):
            return True

    def find_culprit(self, problem: Problem) -> GeometryItem | None:
        return self.document.find_item(problem.line) if problem.file == str(self.file.path) else None

    def make_diff(self) -> str:
        """Return what saving changes, as a unified diff."""
        old, new = (text.splitlines() for text in (self._saved.removeprefix(_BOM), self.document.text))
        name = self.file.path.name
        return "\n".join(difflib.unified_diff(old, new, name, f"{name} (edited)", lineterm=""))

    def save(self) -> None:
        """Write the file whole. Raises EditError if it has an error or changed since it was read, OSError."""
        if self.has_errors:
            raise EditError("the geometry has errors; nothing is saved until they are fixed")
        try:
            current = self.file.read()
        except FileNotFoundError:
            raise EditError(f"{self.file.path} was removed meanwhile; nothing is saved") from None
        if current != self._saved:
            raise EditError(f"{self.file.path} changed meanwhile on disk; nothing is saved. Read it again first")
        text = (_BOM if self._saved.startswith(_BOM) else "") + self.document.text
        with open_atomic(str(self.file.path), replace=not self.file.is_new or self._saved != "") as stream:
            stream.write(text)
        self._saved = text
