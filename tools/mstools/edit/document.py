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
from typing import Final, NamedTuple

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


class GeometryDocument:
    """Immutable text of a geometry file in YAML. Changes return another document, or raise EditError.

    Positions are in meters, angles in degrees: as they are written.
    """

    def __init__(self, text: str | YamlText):
        self._yaml = YamlText(text) if isinstance(text, str) else text

    @property
    def text(self) -> str:
        return self._yaml.text

    # --- what is there

    def list_items(self) -> list[GeometryItem]:
        """Return all bodies, frames and constraints, in order."""
        found = []
        for body in self._yaml.keys(("bodies",)):
            found.append(GeometryItem(ItemKind.BODY, body))
            found += [GeometryItem(ItemKind.FRAME, names.join(body, frame)) for frame in self._list_frames(body)]
        return found + [GeometryItem(ItemKind.CONSTRAINT, name) for name in self._yaml.keys(("constraints",))]

    def find_item(self, line: int) -> GeometryItem | None:
        """Return what stands on a line: the last item that begins on it or before."""
        before = [(at, item) for at, item in self._list_places() if at <= line]
        return max(before, key=lambda each: each[0])[1] if before else None

    def _list_places(self) -> Iterator[tuple[int, GeometryItem]]:
        """Yield each item with its line; a frame of a template is that of the first body that names it."""
        for at, constraint in self._yaml.list_lines(("constraints",)):
            yield at, GeometryItem(ItemKind.CONSTRAINT, constraint)
        seen: set[str] = set()
        for at, body in self._yaml.list_lines(("bodies",)):
            yield at, GeometryItem(ItemKind.BODY, body)
            template = self._get_template(body)
            paths: list[KeyPath] = [("bodies", body, "frames")]
            if template and template not in seen:
                seen.add(template)
                paths.append(("templates", template, "frames"))
            for path in paths:
                for of_frame, frame in self._yaml.list_lines(path):
                    yield of_frame, GeometryItem(ItemKind.FRAME, names.join(body, frame))

    def find_template(self, item: GeometryItem) -> str:
        """Return the template from which a frame of a body comes, empty if it is the body's own."""
        if item.kind is not ItemKind.FRAME:
            return ""
        body, frame = names.split(item.name)
        template = self._get_template(body)
        own = self._yaml.has(("bodies", body, "frames", frame))
        return template if not own and self._yaml.has(("templates", template, "frames", frame)) else ""

    def list_users(self, template: str) -> list[str]:
        return [body for body in self._yaml.keys(("bodies",)) if self._get_template(body) == template]

    def get_yaml(self, item: GeometryItem) -> str:
        """Return the entry of an item as it is written, without indentation."""
        return self._yaml.get_entry(self._find_path(item))

    def _get_template(self, body: str) -> str:
        return self._yaml.get_text(("bodies", body, "template"))

    def _list_frames(self, body: str) -> list[str]:
        own = self._yaml.keys(("bodies", body, "frames"))
        shared = self._yaml.keys(("templates", self._get_template(body), "frames"))
        return list(dict.fromkeys([*shared, *own]))

    def _find_path(self, item: GeometryItem) -> KeyPath:
        """Return where an item is written. Raises EditError if it is not there."""
        if item.kind is ItemKind.FRAME:
            body, frame = names.split(item.name)
            template = self.find_template(item)
            path: KeyPath = ("templates", template) if template else ("bodies", body)
            path = (*path, "frames", frame)
        else:
            path = ("bodies" if item.kind is ItemKind.BODY else "constraints", item.name)
        if not self._yaml.has(path):
            raise EditError(f"there is no {item.kind} {quote(item.name)}")
        return path

    # --- numbers and texts

    def set_pose(
        self, item: GeometryItem, xyz: Vector3, rpy_deg: Vector3, in_template: bool = False
    ) -> GeometryDocument:
        """Set the pose of a frame on its body, or of a constraint. Only what differs is written."""
        _check_finite((*xyz, *rpy_deg))
        text, path = self._open(item, in_template)
        old, new = _read_pose(text, path), Pose.from_rpy(xyz, *map(math.radians, rpy_deg))
        is_turned = old.distance(new)[1] > SAME_RADIANS
        has_matrix = text.has((*path, "matrix"))
        if is_turned or has_matrix:
            for key in ("rpy", "quaternion", "rotation", "matrix"):
                if text.has((*path, key)):
                    text = text.remove((*path, key))
            text = _set_numbers(text, path, "rpy_deg", rpy_deg)
        if has_matrix or max(abs(a - b) for a, b in zip(old.xyz, xyz, strict=True)) > SAME_METERS:
            text = _set_numbers(text, path, "xyz", xyz)
        return GeometryDocument(text)

    def set_sigma(
        self, item: GeometryItem, xyz: Vector3 | None, rpy_deg: Vector3 | None, in_template: bool = False
    ) -> GeometryDocument:
        """Set the standard deviations of a frame or constraint; a part that is None is not stated."""
        _check_finite([*(xyz or ()), *(rpy_deg or ())])
        text, path = self._open(item, in_template)
        stated = [
            f"{key}: {format_scalar_or_list(tuple([round(each, DECIMALS) for each in values]))}"
            for key, values in (("xyz", xyz), ("rpy_deg", rpy_deg))
            if values is not None
        ]
        if stated:
            return GeometryDocument(_set(text, path, "sigma", f"{{{', '.join(stated)}}}"))
        return GeometryDocument(text.remove((*path, "sigma")) if text.has((*path, "sigma")) else text)

    def set_description(self, item: GeometryItem, description: str, in_template: bool = False) -> GeometryDocument:
        """Set the description of an item, or remove it where it is empty."""
        text, path = self._open(item, in_template)
        if description == text.get_text((*path, "description")):
            return GeometryDocument(text)
        if description:
            return GeometryDocument(_set(text, path, "description", _format_word(description)))
        return GeometryDocument(text.remove((*path, "description")) if text.has((*path, "description")) else text)

    def set_ends(self, constraint: str, from_: str, to: str) -> GeometryDocument:
        """Set the frames that a constraint joins."""
        text, path = self._open(GeometryItem(ItemKind.CONSTRAINT, constraint))
        for key, frame in (("from", from_), ("to", to)):
            if _normalize(text.get_text((*path, key))) != frame:
                text = _set(text, path, key, _format_full_name(frame))
        return GeometryDocument(text)

    def set_joint(self, constraint: str, old: Joint, new: Joint) -> GeometryDocument:
        """Set the joint of a constraint, `old` before; keys whose value is the same stay as they are written."""
        text, path = self._open(GeometryItem(ItemKind.CONSTRAINT, constraint))
        inside = (*path, "joint")
        if not new.is_movable:
            return GeometryDocument(text.remove(inside) if text.has(inside) else text)
        was, now = (dict(each.split(": ", 1) for each in format_joint_fields(joint)) for joint in (old, new))
        if not text.keys(inside):
            value = f"{{{', '.join(f'{key}: {each}' for key, each in now.items())}}}"
            return GeometryDocument(_set(text, path, "joint", value))
        for key in [*was, *(each for each in now if each not in was)]:
            if was.get(key) == now.get(key):
                continue
            for written in (key, key.removesuffix("_deg")):
                if text.has((*inside, written)) and (written != key or key not in now):
                    text = text.remove((*inside, written))
            if key in now:
                text = text.set((*inside, key), now[key])
        return GeometryDocument(text)

    # --- items

    def add_body(self, name: str) -> GeometryDocument:
        self._make_new(ItemKind.BODY, name)
        entry = f"{_format_key(name)}:\n  frames:\n    Origin: {{}}"
        return GeometryDocument(self._yaml.add(("bodies",), entry, in_block=True))

    def add_frame(self, body: str, name: str, xyz: Vector3 = (0.0, 0.0, 0.0)) -> GeometryDocument:
        """Add a frame to a body, along the body's axes."""
        self._make_new(ItemKind.FRAME, name, body)
        self._find_path(GeometryItem(ItemKind.BODY, body))
        value = f"{{xyz: {_format_numbers(xyz)}}}" if any(xyz) else "{}"
        return GeometryDocument(
            self._yaml.add(("bodies", body, "frames"), f"{_format_key(name)}: {value}", in_block=True)
        )

    def add_constraint(self, name: str, from_: str, to: str) -> GeometryDocument:
        """Add a constraint at which two frames coincide."""
        self._make_new(ItemKind.CONSTRAINT, name)
        entry = f"{_format_key(name)}:\n  from: {_format_full_name(from_)}\n  to: {_format_full_name(to)}"
        return GeometryDocument(self._yaml.add(("constraints",), entry, in_block=True))

    def duplicate(self, item: GeometryItem, name: str) -> GeometryDocument:
        """Add a copy of an item directly after it; a frame's copy is on the same body, `name` without the body."""
        path = self._find_path(item)
        body = names.split(item.name)[0] if item.kind is ItemKind.FRAME else ""
        self._make_new(item.kind, name, body)
        entry = YamlText(self._yaml.get_entry(path))
        copy = entry.rename((path[-1],), _format_key(name)).text
        place = ("bodies", body, "frames") if body else path[:-1]
        return GeometryDocument(self._yaml.add(place, copy, after=path[-1], in_block=True))

    def rename(self, item: GeometryItem, name: str, in_template: bool = False) -> GeometryDocument:
        """Rename an item, a frame without its body, and what refers to it in this file."""
        body, frame = names.split(item.name) if item.kind is ItemKind.FRAME else (item.name, "")
        new = self._make_new(item.kind, name, body if frame else "")
        template = self.find_template(item)
        if template and not in_template:
            raise EditError(f"{item.name} is a frame of template {template}; change the template to rename it")
        path = self._find_path(item)
        text = self._yaml.rename(path, _format_key(name))
        if item.kind is ItemKind.CONSTRAINT:
            return GeometryDocument(_rename_leader(text, item.name, name))
        renamed = {item.name: new.name}
        if template:
            users = [
                each for each in self.list_users(template) if not self._yaml.has(("bodies", each, "frames", frame))
            ]
            renamed = {names.join(user, frame): names.join(user, name) for user in users}
        for constraint, end, joined in self._list_ends():
            other = renamed.get(joined, joined)
            if item.kind is ItemKind.BODY and joined.partition(":")[0] == body:
                other = names.join(name, joined.partition(":")[2])
            if other != joined:
                text = text.set(("constraints", constraint, end), _format_full_name(other))
        return GeometryDocument(text)

    def delete(self, item: GeometryItem, in_template: bool = False) -> GeometryDocument:
        """Delete an item, and the constraints at a body or frame."""
        template = self.find_template(item)
        if template and not in_template:
            raise EditError(f"{item.name} is a frame of template {template}; change the template to delete it")
        text = self._yaml.remove(self._find_path(item))
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
        return GeometryDocument(text)

    def set_yaml(self, item: GeometryItem, entry: str) -> GeometryDocument:
        """Write the entry of an item, `name: value`, as given. Its name stays."""
        path = self._find_path(item)
        keys = YamlText(entry).keys()
        if keys != [path[-1]]:
            raise EditError(f"the text is one entry that begins with {path[-1]}:")
        return GeometryDocument(self._yaml.replace_entry(path, entry))

    # --- inside

    def _open(self, item: GeometryItem, in_template: bool = False) -> tuple[YamlText, KeyPath]:
        """Return the text, in which a frame of a template has an entry on its body if that alone is changed."""
        path = self._find_path(item)
        if path[0] != "templates" or in_template:
            return self._yaml, path
        body, _ = names.split(item.name)
        text = self._yaml.add(("bodies", body, "frames"), self._yaml.get_entry(path), in_block=True)
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
        found = [GeometryItem(ItemKind.FRAME, names.join(body, frame)) for body in self.list_users(template)]
        return [item.name for item in found if self.find_template(item)]

    def _list_ends(self) -> Iterator[tuple[str, str, str]]:
        """Yield each end of each constraint: constraint, key, frame."""
        for constraint in self._yaml.keys(("constraints",)):
            for end in ("from", "to"):
                if joined := _normalize(self._yaml.get_text(("constraints", constraint, end))):
                    yield constraint, end, joined


def _rename_leader(text: YamlText, old: str, new: str) -> YamlText:
    """Rename the constraint that mimic joints follow."""
    for constraint in text.keys(("constraints",)):
        path = ("constraints", constraint, "joint", "mimic")
        for place in (path, (*path, "joint")):
            if text.get_text(place) == old:
                text = text.set(place, _format_word(new))
    return text


def _read_pose(text: YamlText, path: KeyPath) -> Pose:
    """Return the pose that an entry states, the identity where it states none or a wrong one."""
    try:
        root = parse_yaml(text.get_entry(path).encode())
    except SyntaxProblemError:
        raise EditError(f"{quote(path[-1])} has a part that is shared by an alias; write it out first") from None
    return read_pose(YamlMapping(ModelBuilder(), "", root.pairs[0][1], "", WRITTEN_ORDER)) or Pose.identity()


def _set(text: YamlText, path: KeyPath, key: str, value: str) -> YamlText:
    """Set a key of an entry; a new one stands after those that usually precede it."""
    if text.has((*path, key)):
        return text.set((*path, key), value)
    usual = WRITTEN_ORDER[: WRITTEN_ORDER.index(key)]
    before = [each for each in text.keys(path) if each in usual]
    if before or not text.keys(path):
        return text.add(path, f"{key}: {value}", before[-1] if before else "")
    return text.insert_first(path, f"{key}: {value}")


def _set_numbers(text: YamlText, path: KeyPath, key: str, values: Sequence[float]) -> YamlText:
    """Set a list of numbers; those that are the same stay as they are written."""
    written = text.get_list((*path, key)) or []
    old = [_parse(each) for each in written] if len(written) == len(values) else [math.nan] * len(values)
    new = [round(value, DECIMALS) + 0.0 for value in values]
    if old == new or (not written and not any(new)):
        return text
    same = [a == b for a, b in zip(old, new, strict=True)]
    shown = [written[n] if same[n] else format_number(value) for n, value in enumerate(new)]
    return _set(text, path, key, f"[{', '.join(shown)}]")


def _check_finite(values: Sequence[float]) -> None:
    """Raise EditError for a number that is not finite."""
    for value in values:
        if not math.isfinite(value):
            raise EditError(f"{value} is no number of a pose or sigma; enter a finite one")


def _parse(text: str) -> float:
    try:
        return parse_number(text)
    except ValueError:
        return math.nan


def _format_numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(format_number(round(value, DECIMALS) + 0.0) for value in values)}]"


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


class CheckedText(NamedTuple):
    """The model in a text, None if it has an error; what can be drawn of it, then its bodies alone; all problems."""

    model: Model | None
    drawn: Model | None
    problems: tuple[Problem, ...]


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

    def check(self, text: str, variables: Mapping[str, str]) -> CheckedText:
        """Return what a text has, with all problems, also of frames in the vehicle file."""
        builder = parse_content(text.encode(), str(self.path), variables)
        model, problems = builder.check()
        partial = model or builder.build_bodies()
        if self.config is not None and partial is not None:
            from modelserver.server.vehicle import find_frame_problems

            problems += tuple(find_frame_problems(self.config, partial, str(self.vehicle), model is not None))
        return CheckedText(model, partial, problems)


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
        drawn = self.file.check(document.text, self._variables).drawn
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
        found = self.file.check(self.document.text, self._variables)
        self.problems = found.problems
        if found.model is not None:
            self.model = self.drawn = found.model
            self._loaded = self.document
        elif self.model is None and found.drawn is not None:
            self.drawn = found.drawn

    @property
    def document(self) -> GeometryDocument:
        return self._steps[-1].document

    @property
    def is_changed(self) -> bool:
        """Whether there is something to save."""
        return self.document.text != self._saved.removeprefix(_BOM)

    @property
    def has_errors(self) -> bool:
        """Whether a problem forbids to save."""
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
        """Make the last undone change again."""
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
