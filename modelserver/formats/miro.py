"""Miro's XML, read and written: bodies and constraints as in the 2005 report, and frame trees as NASA's rovers use.

Bodies and constraints (Annexes B.3, B.4 and C):

The names of the section and of the two lists vary between files, so a body is recognized by its parameter BodyName and
a constraint by its ConstraintName, anywhere in the file. A frame or constraint without HTransform has the identity.
White space around names is trimmed, and folded in descriptions, where it comes from line breaks of the file.

The writer uses the layout of Annex C.

Frame tree, read only: `<instance type="rapid::FrameRpyParameters" name=...>` elements.

Each instance is a frame at X, Y, Z (meters) in its Parent, rotated by Roll, Pitch, Yaw (degrees, about fixed axes:
Rz(yaw) Ry(pitch) Rx(roll)); omitted values are 0. The format has no bodies, so the frames are grouped:

- A frame that is a Parent, or has no Parent, is a body; the body's frame `Origin` is the frame itself.
- Every other frame is a frame of its parent's body.
- A body with a parent is also a frame of the parent's body, and the constraint `<name>Fixed`, an identity, joins that
  frame to the body's Origin.

So a frame keeps its own name, `Parent:Frame`, and what is mounted together moves together. Numbers are used as written:
NASA's own files are x forward, y right, z down.

A Parent is a path: names between slashes, from a frame down to its descendant: `PanTiltUnit/Pan`. `...` matches any
number of levels, `A/.../B`; `.` none; `..` removes the name before it. A path that begins with a slash begins at a
root; any other begins anywhere, so `Pan` is `.../Pan`, and a root has priority over deeper frames. NASA's frame store
has the same rules, but requires a parent before its children; here the order of the file is free. The parents are found
in two passes: first those with a unique name, then, as the paths above them become known, those whose name several
frames have. A Parent that is not in the file but outside a vehicle by its nature (an absolute path, the earth, a UTM
grid) becomes a root, so that its children stay connected.
"""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from modelserver.errors import Location, Severity, Suggestion, find_suggestion, quote, suggest_name
from modelserver.formats import common
from modelserver.formats.xml_document import get_line, get_name, get_tag, iterate_children
from modelserver.geometry import names
from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.geometry.model import Model
from modelserver.geometry.names import ORIGIN
from modelserver.geometry.parts import Body, Constraint
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element


class NamedParameters(common.ElementReader):
    """The children `<parameter name=... value=...>` of an element, by name; unknown and duplicate ones are reported."""

    def __init__(self, element: Element, known: tuple[str, ...], builder: ModelBuilder, file: str, place: str):
        super().__init__(builder, file, get_line(element), place)
        parameters: list[tuple[str, Element, int]] = []
        for child in iterate_children(element):
            if (tag := get_tag(child)) == "parameter":
                parameters.append((get_name(child), child, get_line(child)))
            else:
                fix, near = "write <parameter name=... value=.../>", common.suggest_known_key(tag, ("parameter",))
                self.warning(f"unexpected element <{common.label(tag)}>; ignored", fix, get_line(child), tuple(near))
        self.elements: dict[str, Element] = self.select(parameters, known, "parameter")

    def locate(self, at: int | str = 0) -> Location:
        """Return the location of a line or a parameter; of the element if the parameter is absent."""
        child = self.elements.get(at) if isinstance(at, str) else None
        if child is None:
            return super().locate(at)
        return Location(self.file, get_line(child), f"{self.place}, {at}" if self.place else str(at))

    def read_text(self, name: str) -> str | None:
        """Return the trimmed value of a parameter; None if it is absent or, with an error, has no value."""
        child = self.elements.get(name)
        value = None if child is None else child.get("value")
        if child is not None and value is None:
            self.error(f"parameter {name} has no value", f'write <parameter name="{name}" value="..."/>', name)
        return None if value is None else value.strip()


# --- bodies and constraints -------------------------------------------------------------------------------------------

_BODY_KEYS = ("BodyName", "Description", "HTransform", "Frames", "FrameList")
_FRAME_KEYS = ("FrameName", "Description", "HTransform")
_CONSTRAINT_KEYS = ("ConstraintName", "Description", "From", "To", "HTransform")
_ROWS = ("Row1", "Row2", "Row3")
_PART_NAMES = frozenset(("Frames", "FrameList", "FrameName", "HTransform", "From", "To"))
_CONTAINERS = ("config", "section", "parameter", "instance")


def load(root: Element, builder: ModelBuilder, file: str) -> None:
    _MiroReader(builder, file).scan(root)


def has_bodies(root: Element) -> bool:
    return any(get_name(each) in ("BodyName", "ConstraintName") for each in root.iter("{*}parameter"))


class _MiroReader(common.ElementReader):
    def scan(self, element: Element) -> None:
        """Find bodies and constraints; libxml2 bounds the depth, and so this recursion."""
        for child in iterate_children(element):
            inside, tag = {get_name(each) for each in iterate_children(child)}, get_tag(child)
            if "BodyName" in inside:
                self.read_body(child)
            elif "ConstraintName" in inside:
                self.read_constraint(child)
            elif tag not in _CONTAINERS:
                near, fix = common.suggest_known_key(tag, _CONTAINERS), f"elements here are {', '.join(_CONTAINERS)}"
                self.warning(f"unexpected element <{common.label(tag)}>; ignored", fix, get_line(child), tuple(near))
            elif tag != "parameter" or not self.report_misspelled(child, inside):
                self.scan(child)

    def report_misspelled(self, element: Element, inside: set[str]) -> bool:
        """Report an element with the parts of a body or constraint but no name; return whether it is one."""
        values = [get_name(child) for child in iterate_children(element) if child.get("value") is not None]
        meant = ((name, common.suggest_known_key(name, ("BodyName", "ConstraintName"))) for name in values)
        wrong, near = next((each for each in meant if each[1]), ("", Suggestion()))
        if not near and not inside & _PART_NAMES:
            return False
        message = "this is neither a body nor a constraint: it has no BodyName and no ConstraintName"
        fix = f"write {near[0]}" if near else "add BodyName to a body, ConstraintName to a constraint"
        self.error(message + (f", but {common.label(wrong)}" if near else ""), fix, get_line(element), near)
        return True

    def enter(self, element: Element, known: tuple[str, ...], place: str) -> NamedParameters:
        return NamedParameters(element, known, self.builder, self.file, place)

    def read_body(self, element: Element) -> None:
        place = f"body {common.label(_get_value(element, 'BodyName'))}"
        parts = self.enter(element, (*_BODY_KEYS, *self.find_misnamed_lists(element, place)), place)
        body = self.builder.add_body(
            parts.read_text("BodyName") or "", _read_description(parts), _read_transform(parts), source=parts.locate()
        )
        for name, child in parts.elements.items():
            if name not in ("BodyName", "Description", "HTransform"):
                self.read_frames(child, body, place)

    def find_misnamed_lists(self, element: Element, place: str) -> list[str]:
        """Return the names of lists of frames that are not named Frames; they are read, with a warning."""
        found = []
        for child in iterate_children(element):
            name = get_name(child)
            inside = (get_name(part) for each in iterate_children(child) for part in iterate_children(each))
            if name not in _BODY_KEYS and "FrameName" in inside:
                found.append(name)
                at = common.ElementReader(self.builder, self.file, get_line(child), place)
                message = f"unknown parameter {quote(name)} holds frames; read as Frames"
                at.warning(message, "write Frames", nearest=Suggestion.of(name, "Frames"))
        return found

    def read_frames(self, element: Element, body: BodyBuilder, body_place: str) -> None:
        for child in iterate_children(element):
            name = _get_value(child, "FrameName")
            parts = self.enter(child, _FRAME_KEYS, f"{body_place}, frame {common.label(name)}")
            if "FrameName" not in parts.elements:
                parts.error("a frame without a name", 'add <parameter name="FrameName" value="..."/>')
                continue
            if "HTransform" not in parts.elements and name != "Origin":
                parts.note("no HTransform: the frame is at the body's origin")
            name, pose = parts.read_text("FrameName") or "", _read_transform(parts)
            body.add_frame(name, pose, _read_description(parts), source=parts.locate())

    def read_constraint(self, element: Element) -> None:
        """Read a constraint; one with a missing end is reported and left out."""
        place = f"constraint {common.label(_get_value(element, 'ConstraintName'))}"
        parts = self.enter(element, _CONSTRAINT_KEYS, place)
        pose = _read_transform(parts)
        from_, to = _read_end(parts, "From"), _read_end(parts, "To")
        if "HTransform" not in parts.elements:
            parts.note("no HTransform: the two frames coincide")
        if from_ is None and to is None:
            return
        name, source = parts.read_text("ConstraintName") or "", parts.locate()
        if from_ is not None and to is not None:
            self.builder.add_constraint(name, from_, to, pose, _read_description(parts), source=source)
        else:
            sense, end = ("To", to) if from_ is None else ("From", from_)
            self.builder.unresolved_ends.append((name, sense, end or "", source))


def _read_end(parts: NamedParameters, key: str) -> str | None:
    """Read the frame at one end of a constraint, trimmed; None, with an error, if there is none."""
    if key not in parts.elements:
        parts.error(f"{key} is missing", f'add <parameter name="{key}" value="Body:Frame"/>')
    text = parts.read_text(key)
    return None if text is None else ":".join(part.strip() for part in text.split(":"))


def _read_transform(owner: NamedParameters) -> Pose | None:
    """Read the pose in the HTransform of `owner`; None if there is none, or, with an error, if it is wrong."""
    element = owner.elements.get("HTransform")
    if element is None:
        return None
    parts = NamedParameters(element, (*_ROWS, "Row4"), owner.builder, owner.file, f"{owner.place}, HTransform")
    first, second, third = (_read_row(parts, name) for name in _ROWS)
    if "Row4" in parts.elements and _read_row(parts, "Row4") not in (None, [0.0, 0.0, 0.0, 1.0]):
        parts.error("Row4 of a homogeneous transform is 0 0 0 1", "remove Row4; it is constant", "Row4")
        return None
    if first is None or second is None or third is None:
        return None
    position = (first[3], second[3], third[3])
    turned = parts.repair_rotation((first[:3], second[:3], third[:3]), "Row1 to Row3")
    return None if turned is None or not parts.check_position(position) else Pose(position, turned)


def _read_row(parts: NamedParameters, name: str) -> list[float] | None:
    """Read the four numbers of a row; None, with an error, if there are not four."""
    fix = f'write <parameter name="{name}" value="r r r p"/>: a row of the rotation, then a position in meters'
    if name not in parts.elements:
        parts.error(f"{name} is missing", fix, name)
    text = parts.read_text(name)
    return None if text is None else parts.read_row(text.split(), 4, name, fix, name)


def _read_description(parts: NamedParameters) -> str:
    return " ".join((parts.read_text("Description") or "").split())


def _get_value(element: Element, key: str) -> str:
    """Return the value of the first parameter `key`, empty for none: it names the place of problems."""
    found = (each.get("value") or "" for each in iterate_children(element) if get_name(each) == key)
    return next(found, "").strip()


def save(model: Model) -> common.SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    bodies = [line for body in model.bodies for line in _format_body(body)]
    constraints = [line for each in model.constraints for line in _format_constraint(each)]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<config>", ' <section name="Geometry">']
    for name, inside in (("BodyList", bodies), ("ConstraintList", constraints)):
        lines += [f'  <parameter name="{name}">', *(f"    {line}" for line in inside), "  </parameter>"]
    lines += [" </section>", "</config>"]
    return common.SavedModel("\n".join(lines) + "\n", tuple(_list_unsupported(model)))


def _list_unsupported(model: Model) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    if model.description:
        yield "the model's description"
    frames = [frame for body in model.bodies for frame in body]
    if surveyed := [frame.full_name for frame in frames if frame.sigma is not None]:
        yield f"the sigmas of {len(surveyed)} frames: {common.format_names(surveyed)}"
    if surveyed := [each.name for each in model.constraints if each.sigma is not None]:
        yield f"the sigmas of {len(surveyed)} constraints: {common.format_names(surveyed)}"
    yield from common.list_physical_features(model)
    described = [(body.name, body.description) for body in model.bodies]
    described += [(frame.full_name, frame.description) for frame in frames]
    described += [(each.name, each.description) for each in model.constraints]
    if changed := [name for name, text in described if _fold_description(text) != text]:
        yield f"line breaks and control characters in {len(changed)} descriptions: {common.format_names(changed)}"


def _fold_description(text: str) -> str:
    """Return a text as it is read back: without control characters, which XML does not have, and with folded spaces."""
    return " ".join("".join(each if each.isprintable() else " " for each in text).split())


def _format_body(body: Body) -> Iterator[str]:
    lines = _format_head("BodyName", body.name, body.description)
    if body.pose is not None:
        lines += _format_transform(body.pose)
    lines.append('<parameter name="Frames">')
    for frame in body:
        inside = [*_format_head("FrameName", frame.name, frame.description), *_format_transform(frame.pose)]
        lines += [f"  {line}" for line in common.format_element("parameter", inside, "BodyFrame")]
    lines.append("</parameter>")
    return common.format_element("parameter", lines, "Body")


def _format_constraint(each: Constraint) -> Iterator[str]:
    lines = _format_head("ConstraintName", each.name, each.description)
    for key, end in (("From", each.from_), ("To", each.to)):
        lines += common.format_element("parameter", name=key, value=end)
    return common.format_element("parameter", [*lines, *_format_transform(each.default_pose)], "Constraint")


def _format_head(key: str, name: str, description: str) -> list[str]:
    lines = [*common.format_element("parameter", name=key, value=name)]
    if description:
        lines += common.format_element("parameter", name="Description", value=_fold_description(description))
    return lines


def _format_transform(pose: Pose) -> Iterator[str]:
    rows = enumerate(pose.matrix_rows()[:3], 1)
    inside = [line for n, row in rows for line in common.format_element("parameter", name=f"Row{n}", value=row)]
    return common.format_element("parameter", inside, name="HTransform")


# --- frame trees ------------------------------------------------------------------------------------------------------

_POSITION = ("X", "Y", "Z")
_ROTATION = ("Roll", "Pitch", "Yaw")
_PARAMETERS = ("Name", "Parent", *_POSITION, *_ROTATION)
_VARIABLE = re.compile(r"\$(?:\{(\w+)\}|(\w+))", re.ASCII)


ANY = "..."

MAX_STEPS = 2_000_000
"""Levels visited for all paths of a file: only a hostile file needs more."""


@dataclass(frozen=True, slots=True)
class FramePath:
    """A path: its names from the top down, and whether it begins at a root."""

    parts: tuple[str, ...]
    is_absolute: bool

    @property
    def name(self) -> str:
        return self.parts[-1] if self.parts else ""

    @property
    def is_plain(self) -> bool:
        """Whether it is a single name, which matches any frame of that name."""
        return len(self.parts) == 1 and not self.is_absolute

    def matches(self, names: list[str]) -> bool:
        """Return whether the path matches a frame, given the names from its root down to its own."""
        # the numbers of names that the parts so far can take
        taken = {0} if self.is_absolute else set(range(len(names) + 1))
        for part in self.parts:
            if part == ANY:
                taken = set(range(min(taken), len(names) + 1))
            else:
                taken = {number + 1 for number in taken if names[number : number + 1] == [part]}
            if not taken:
                return False
        return len(names) in taken


ROOT = FramePath((), False)
"""The path of a frame without a parent."""


def parse_path(text: str) -> FramePath:
    """Parse a `Parent`; the path of a root (empty, or a single slash) has no parts."""
    parts: list[str] = []
    for part in (each.strip() for each in text.split("/")):
        if part == ".." and parts and parts[-1] != ANY:
            parts.pop()
        elif part not in ("", ".", ".."):
            parts.append(part)
    return FramePath(tuple(parts), text.startswith("/"))


def find_instances(root: Element) -> Iterator[Element]:
    for element in root.iter("{*}instance"):
        if (element.get("type") or "").strip().endswith("FrameRpyParameters"):
            yield element


def load_frame_tree(root: Element, builder: ModelBuilder, file: str, variables: Mapping[str, str]) -> None:
    """Add the frames below `root`, grouped into bodies, and their problems to `builder`.

    `$NAME` and `${NAME}` are replaced from `variables`, else from the environment.
    """
    reader = _FrameTreeReader(builder, file, variables)
    for element in find_instances(root):
        reader.read_frame(element)
    reader.report_other_types(root)
    reader.report_variables()
    if reader.find_parents():
        reader.add_bodies()


_EXTERNAL_FRAME = re.compile(r"Earth|UtmGrid\d{1,2}[A-Z]|\$\{?SITE_FRAME\}?")
"""Frames that NASA's frame store has without a file: the earth, its UTM grids, and the robot's site."""


@dataclass(slots=True)
class _FrameInstance:
    name: str
    parent: str
    pose: Pose
    source: Location
    parent_source: Location
    path: FramePath


class _FrameTreeReader(common.ElementReader):
    def __init__(self, builder: ModelBuilder, file: str, variables: Mapping[str, str]):
        super().__init__(builder, file)
        self.variables = variables
        self.frames: dict[str, _FrameInstance] = {}
        """By name; a second frame of a name, with another parent, by parent and name."""
        self.parents: dict[str, str] = {}
        """Key of the parent of each frame, empty for a root."""
        self.keys: defaultdict[str, list[str]] = defaultdict(list)
        """Keys of the frames of each name."""
        self.undefined: defaultdict[str, list[Location]] = defaultdict(list)
        self.steps = 0
        """Levels visited for paths."""

    def read_frame(self, element: Element) -> None:
        """Read one instance; a second one of the same name and parent is ignored with a warning."""
        own = get_name(element)
        parts = NamedParameters(element, _PARAMETERS, self.builder, self.file, f"frame {common.label(own)}")
        name = self.expand(own, parts.locate())
        stated = self.expand(parts.read_text("Name") or "", parts.locate("Name"))
        if not name:
            name = stated
        elif stated and stated != name:
            used, unused = common.label(name), common.label(stated)
            message = f"the instance is named {used}, its parameter Name {unused}; {used} is used"
            parts.warning(message, "make the two alike, or remove the parameter Name", "Name")
        parent = self.expand(parts.read_text("Parent") or "", parts.locate("Parent"))
        pose = self.read_pose(parts)
        path = parse_path(parent)
        frame = _FrameInstance(name, parent, pose or Pose.identity(), parts.locate(), parts.locate("Parent"), path)
        first = self.frames.get(name)
        key = name
        if first is not None and first.path != path:
            # names are unique below one parent only
            key = f"{parent}/{name}"
            first = self.frames.get(key)
        if first is None:
            self.frames[key] = frame
        else:
            self.report_duplicate(first, frame)

    def report_duplicate(self, first: _FrameInstance, second: _FrameInstance) -> None:
        moved, turned = first.pose.distance(second.pose)
        lines = f"on line {first.source.line} and on line {second.source.line}"
        message = (
            f"frame {common.label(first.name)} is defined twice: {lines}; "
            f"the two are {moved:.6g} m and {math.degrees(turned):.6g} deg apart; the first is used"
        )
        self.builder.add_warning(message, second.source, "rename one of the two, or remove the wrong one")

    def read_pose(self, parts: NamedParameters) -> Pose | None:
        """Read the pose from X to Yaw; None, with an error, if one is not a number."""
        values: list[float] = []
        for key in (*_POSITION, *_ROTATION):
            text = parts.read_text(key) if key in parts.elements else "0"
            if text is None:
                continue
            filled, missing = self.substitute(text)
            if missing:
                message = f"{key} takes its number from ${missing[0]}, which is not defined"
                fix = f"give it: --set {missing[0]}=NUMBER, or export {missing[0]}"
                parts.error(message, fix, key, suggest_name(missing[0], self.variables))
                continue
            try:
                values.append(common.parse_number(filled.strip()))
            except ValueError as error:
                unit = "meters" if key in _POSITION else "degrees"
                parts.error(f"{key}: {error}", f"write one number, in {unit}", key)
        if len(values) != 6 or not parts.check_position(values[:3]):
            return None
        return Pose.from_rpy(values[:3], *(math.radians(value) for value in values[3:]))

    def substitute(self, text: str) -> tuple[str, list[str]]:
        """Replace the variables in a text; return it, and the names of those that are not defined."""
        missing: list[str] = []

        def replace_variable(match: re.Match[str]) -> str:
            name = match[1] or match[2]
            found = self.variables.get(name, os.environ.get(name))
            if found is None:
                missing.append(name)
                return match[0]
            return found

        return _VARIABLE.sub(replace_variable, text), missing

    def expand(self, text: str, source: Location) -> str:
        """Replace the variables in a name; undefined ones stay, and are recorded."""
        filled, missing = self.substitute(text)
        for name in missing:
            self.undefined[name].append(source)
        return filled.strip()

    def report_variables(self) -> None:
        for name, places in self.undefined.items():
            uses = f" (used {len(places)} times)" if len(places) > 1 else ""
            self.builder.add_warning(
                f"${name} is not defined{uses}; it stays in names as it is written",
                places[0],
                f"give it: --set {name}=NAME, or export {name}",
                tuple(suggest_name(name, self.variables)),
            )

    def report_other_types(self, root: Element) -> None:
        passed: defaultdict[str, list[int]] = defaultdict(list)
        for element in root.iter("{*}instance"):
            kind = (element.get("type") or "").strip()
            if not kind.endswith("FrameRpyParameters"):
                passed[kind].append(get_line(element))
        for kind, lines in passed.items():
            # a type with "frame" in its name is probably meant as one
            message = f"{len(lines)} instance{'' if len(lines) == 1 else 's'} of type {common.label(kind)} ignored"
            if "frame" in kind.casefold():
                self.warning(message, "frames have type rapid::FrameRpyParameters", lines[0])
            else:
                self.note(message, at=lines[0])

    @property
    def is_exhausted(self) -> bool:
        return self.steps > MAX_STEPS

    def match(self, path: FramePath, above: list[str]) -> bool:
        """Return whether a path matches the frame with these names; False when exhausted."""
        self.steps += len(above) * (len(path.parts) if ANY in path.parts else 1)
        return not self.is_exhausted and path.matches(above)

    def list_names(self, key: str) -> list[str] | None:
        """Return the names from the root down to a frame; None if a parent is not known yet, or for a cycle."""
        found: dict[str, str] = {}
        while key:
            self.steps += 1
            if key in found or key not in self.parents or self.is_exhausted:
                return None
            found[key] = self.frames[key].name
            key = self.parents[key]
        return list(found.values())[::-1]

    def find_parents(self) -> bool:
        """Find the parent of each frame; report missing parents and cycles. Return whether there are none."""
        named = {frame.name for frame in self.frames.values()}
        for frame in self.frames.values():
            if "/" in frame.parent and frame.parent in named:
                # a name may hold slashes
                frame.path = FramePath((frame.parent,), False)
        self.add_external_roots()
        for key, frame in self.frames.items():
            self.keys[frame.name].append(key)
        several: list[str] = []
        for key, frame in self.frames.items():
            candidates = self.keys.get(frame.path.name, [])
            if not frame.path.parts:
                self.parents[key] = ""
            elif len(candidates) == 1:
                # its ancestors are compared with the path when all parents are known
                self.parents[key] = candidates[0]
            elif candidates:
                several.append(key)
        self.resolve_shared_names(several)
        missing = [key for key in self.frames if key not in self.parents]
        is_tree = self.has_no_cycles()
        if is_tree:
            for key, frame in self.frames.items():
                parent = self.parents.get(key, "")
                if parent and not frame.path.is_plain and not self.is_parent_on_path(frame, parent):
                    missing.append(key)
        if not self.is_exhausted:
            self.report_missing(missing)
        else:
            self.error("the paths of parents are too many and too deep", "write plain names")
        return is_tree and not missing and not self.is_exhausted

    def add_external_roots(self) -> None:
        """Add a root for each parent that is outside the file by its nature."""
        known = {frame.name for frame in self.frames.values()}
        meant: dict[str, str] = {}
        for frame in tuple(self.frames.values()):
            path = frame.path
            if not path.parts or not known.isdisjoint(path.parts) or path.name == ANY:
                continue
            is_outside = bool(_EXTERNAL_FRAME.fullmatch(path.name))
            if not is_outside:
                if path.is_absolute and path.name not in meant:
                    meant[path.name] = find_suggestion(path.name, known) if len(meant) < common.MAX_SUGGESTIONS else ""
                if not path.is_absolute or meant[path.name]:
                    continue
            if path.name in names.RESERVED_BODIES:
                # the service has a frame of this name itself: its children are roots
                frame.path = ROOT
            elif path.name not in self.frames:
                source = frame.parent_source
                self.frames[path.name] = _FrameInstance(path.name, "", Pose.identity(), source, source, ROOT)
                self.builder.add_problem(
                    Severity.NOTE, f"Parent {common.label(frame.parent)} is not in the file; it becomes a root", source
                )

    def resolve_shared_names(self, several: list[str]) -> None:
        """Find the parents whose name several frames have, when the ancestors of those are known."""
        while several:
            left: list[str] = []
            for key in several:
                if self.is_exhausted:
                    return
                path = self.frames[key].path
                above = {each: self.list_names(each) for each in self.keys[path.name] if each != key}
                fitting = [(len(at), each) for each, at in above.items() if at is not None and self.match(path, at)]
                if None in above.values() and not any(depth == 1 for depth, _ in fitting):
                    left.append(key)
                elif fitting:
                    self.parents[key] = min(fitting, key=lambda found: found[0])[1]
                    if len(fitting) > 1:
                        self.report_ambiguous(key, [each for _, each in fitting])
            if len(left) == len(several):
                return
            several = left

    def report_ambiguous(self, key: str, fitting: list[str]) -> None:
        frame = self.frames[key]
        paths = ["/".join(self.list_names(each) or ()) for each in fitting]
        chosen = "/".join(self.list_names(self.parents[key]) or ())
        self.builder.add_warning(
            f"Parent {common.label(frame.parent)} names {len(fitting)} frames: "
            f"{', '.join(map(common.label, paths[:4]))}; {common.label(chosen)} is used",
            frame.parent_source,
            "write the path of the one that is meant",
        )

    def is_parent_on_path(self, frame: _FrameInstance, parent: str) -> bool:
        """Return whether the ancestors of a frame's parent match its path."""
        above = self.list_names(parent)
        if above is None:
            return self.is_exhausted
        path = frame.path
        if path.is_absolute:
            # the part above the roots of the file cannot be compared
            inside = next((n for n, part in enumerate(path.parts) if part in self.keys or part == ANY), 0)
            path = FramePath(path.parts[inside:], True)
        return self.match(path, above) or self.is_exhausted

    def report_missing(self, missing: list[str]) -> None:
        meant: dict[FramePath, str] = {}
        for key in missing:
            frame = self.frames[key]
            path = frame.path
            if path not in meant:
                meant[path] = self.suggest_parent(frame) if len(meant) < common.MAX_SUGGESTIONS else ""
            near = meant[path]
            why = ""
            if self.parents.get(key):
                why = (
                    f": {common.label(path.name)} is {common.label('/'.join(self.list_names(self.parents[key]) or ()))}"
                )
            self.builder.add_error(
                f"Parent names {quote(frame.parent)}, which does not exist{why}",
                frame.parent_source,
                f"write {near}" if near else "name a frame of this file, or leave it empty for a root",
                Suggestion.of(frame.parent, near),
            )

    def suggest_parent(self, frame: _FrameInstance) -> str:
        """Return the path of which one name is misspelled in a Parent; empty if that is ambiguous.

        It has as many names: an ancestor is another place, and a frame cannot be its own parent.
        """
        parts = list(frame.path.parts)
        unknown = [n for n, part in enumerate(parts) if part not in self.keys and part != ANY]
        if len(unknown) != 1:
            return ""
        (at,) = unknown
        near = find_suggestion(parts[at], [name for name in self.keys if name != frame.name and name not in parts])
        if not near:
            return ""
        parts[at] = near
        found = FramePath(tuple(parts), frame.path.is_absolute)
        placed = (self.list_names(key) for key in self.keys[found.name])
        if not found.is_plain and not any(above is not None and self.match(found, above) for above in placed):
            return ""
        return ("/" if found.is_absolute else "") + "/".join(parts)

    def has_no_cycles(self) -> bool:
        is_tree = True
        for cycle in common.find_cycles(self.frames, lambda key: self.parents.get(key) or None):
            is_tree = False
            self.builder.add_error(
                f"parents form a cycle: {' in '.join(map(common.label, cycle))}",
                self.frames[cycle[-1]].parent_source,
                "one of them must have a Parent outside the cycle, or an empty one",
            )
        return is_tree

    def add_bodies(self) -> None:
        self.remove_duplicates()
        inner = {parent for parent in self.parents.values() if parent}
        roots = [key for key in self.frames if not self.parents[key]]
        mounted = [key for key in self.frames if self.parents[key] and key in inner]
        bodies: dict[str, BodyBuilder] = {}
        taken: set[str] = set()
        for key in (*roots, *mounted):
            frame = self.frames[key]
            name = frame.name
            if name in taken:
                name = f"{self.frames[self.parents[key]].name}.{name}" if self.parents[key] else name
            taken.add(name)
            bodies[key] = self.builder.add_body(name, source=frame.source)
            bodies[key].add_frame(ORIGIN, source=frame.source)
        for key, frame in self.frames.items():
            parent = self.parents[key]
            if not parent:
                if frame.pose != Pose.identity():
                    bodies[key].pose = frame.pose
                continue
            if frame.name == ORIGIN:
                where = common.label(bodies[parent].name)
                message = f"a frame in {where} is named {ORIGIN}, which is the name of the frame of {where} itself"
                self.builder.add_error(message, frame.source, "rename it")
                continue
            bodies[parent].add_frame(frame.name, frame.pose, source=frame.source)
            if key in bodies:
                name = bodies[key].name
                end = f"{bodies[parent].name}:{frame.name}"
                self.builder.add_constraint(f"{name}Fixed", end, f"{name}:{ORIGIN}", source=frame.source)

    def remove_duplicates(self) -> None:
        """Remove frames of the same name whose parents are equal but written differently, e.g. as a name and a path."""
        first: dict[tuple[str, str], str] = {}
        replaced: dict[str, str] = {}
        for key, frame in tuple(self.frames.items()):
            replaced[key] = first.setdefault((frame.name, self.parents[key]), key)
        for key, other in replaced.items():
            if key != other:
                self.report_duplicate(self.frames[other], self.frames.pop(key))
                del self.parents[key]
        self.parents = {key: replaced.get(parent, parent) for key, parent in self.parents.items()}
