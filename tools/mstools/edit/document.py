"""A geometry file as bodies, frames and constraints that are changed in its text.

A frame of a template is on each body that names the template. Changed on one body, it gets an entry of its own there;
with `in_template` the template is changed, and with it all bodies that use it.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, NamedTuple, Self

from modelserver.config.vehicle_file import VehicleConfig, load_config
from modelserver.errors import ModelServerError, Problem, SyntaxProblemError, has_error, quote
from modelserver.files import EXAMINED_BYTES, FileKind, detect_file_kind, read_start
from modelserver.formats import parse_content, read_content
from modelserver.formats.common import format_number, parse_number
from modelserver.formats.yaml_elements import POSE_KEYS, YamlMapping, read_pose
from modelserver.formats.yaml_geometry import format_joint_fields, format_scalar_or_list, format_text, quote_text
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint
from modelserver.geometry.model import Model
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3
from modelserver.yaml_tree import parse_yaml
from mstools.edit.yaml_text import EditError, KeyPath, YamlText
from mstools.terminal.output import open_atomic

DECIMALS: Final = 9
"""Of meters and degrees that are written."""

SAME_METERS: Final = 1e-9
SAME_RADIANS: Final = 1e-9
"""A position or rotation that differs by less stays as it is written."""

WRITTEN_ORDER: Final = ("template", "from", "to", *POSE_KEYS, "sigma", "joint", "description")

_PLAIN_NAME = re.compile(r"[A-Za-z][\w.-]*")
_PLAIN_TEXT = re.compile(r"[A-Za-z][\w .;/()-]*[\w.)]")


class ItemKind(StrEnum):
    """What is edited."""

    BODY = "body"
    FRAME = "frame"
    CONSTRAINT = "constraint"


class GeometryItem(NamedTuple):
    """A body, frame (by its full name) or constraint."""

    kind: ItemKind
    name: str


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
        return self.get_entry(self._find_path(item))

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

    def set_yaml(self, item: GeometryItem, entry: str) -> Self:
        """Write the entry of an item, `name: value`, as given. Its name stays."""
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


MAX_STEPS = 500
"""Changes that can be undone."""

_BOM = "\ufeff"


class Step(NamedTuple):
    """A document with the name of the change that led to it."""

    document: GeometryDocument
    change: str


@dataclass(frozen=True)
class EditedFile:
    """The geometry file that is edited; `config` of the vehicle file `vehicle` if that names it."""

    path: Path
    vehicle: Path | None = None
    config: VehicleConfig | None = None

    @classmethod
    def open(cls, path: Path) -> EditedFile:
        """Return the geometry file at a path, or that of a vehicle file. Raises ConfigError, OSError."""
        if detect_file_kind(read_start(path, EXAMINED_BYTES)) is not FileKind.VEHICLE:
            return cls(path)
        config = load_config(path)
        return cls(Path(config.geometry), path, config)

    def read(self) -> str:
        """Return the text of the file. Raises OSError, GeometryError, EditError for one that is not YAML."""
        content = read_content(self.path)
        if content.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
            raise EditError(f"{self.path} is XML; only YAML is edited: modelserver convert {self.path} geometry.yaml")
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
        document = GeometryDocument(saved.removeprefix(_BOM))
        if not document.list_items():
            path = self.file.path
            raise EditError(f"{path} has no bodies in YAML: modelserver convert {path} geometry.yaml")
        _, drawn, _ = self.file.check(document.text, self._variables)
        if drawn is None:
            raise EditError(f"{self.file.path} has no body that can be drawn: modelserver check {self.file.path}")
        self._saved = saved
        self._steps = [Step(document, "")]
        self._undone: list[Step] = []
        self.drawn: Model = drawn
        """The last model without an error; before there is one, the bodies of the file alone."""
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
        with open_atomic(str(self.file.path), replace=True) as stream:
            stream.write(text)
        self._saved = text
