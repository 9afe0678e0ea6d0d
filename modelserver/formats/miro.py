"""Miro body and constraint XML, read and written: the geometry file of the 2005 report (Annexes B.3, B.4 and C).

The names of the section and of the two lists vary between files, so a body is recognized by its parameter BodyName and
a constraint by its ConstraintName, anywhere in the file. A frame or constraint without HTransform has the identity.
White space around names is trimmed, and folded in descriptions, where it comes from line breaks of the file.

The writer uses the layout of Annex C.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from modelserver.errors import Suggestion, quote
from modelserver.formats.common import (
    ElementReader,
    SavedModel,
    format_element,
    format_names,
    label,
    list_physical_features,
    suggest_known_key,
)
from modelserver.formats.xml_document import NamedParameters, get_line, get_name, get_tag, iterate_children
from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, Constraint
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element


_BODY_KEYS = ("BodyName", "Description", "HTransform", "Frames", "FrameList")
_FRAME_KEYS = ("FrameName", "Description", "HTransform")
_CONSTRAINT_KEYS = ("ConstraintName", "Description", "From", "To", "HTransform")
_ROWS = ("Row1", "Row2", "Row3")
_PART_NAMES = frozenset(("Frames", "FrameList", "FrameName", "HTransform", "From", "To"))
_CONTAINERS = ("config", "section", "parameter", "instance")


def load(root: Element, builder: ModelBuilder, file: str) -> None:
    """Add the bodies and constraints below `root`, and their problems, to `builder`."""
    _MiroReader(builder, file).scan(root)


def has_bodies(root: Element) -> bool:
    """Return whether there is a BodyName or a ConstraintName below `root`."""
    return any(get_name(each) in ("BodyName", "ConstraintName") for each in root.iter("{*}parameter"))


class _MiroReader(ElementReader):
    def scan(self, element: Element) -> None:
        """Find bodies and constraints; libxml2 bounds the depth, and so this recursion."""
        for child in iterate_children(element):
            inside, tag = {get_name(each) for each in iterate_children(child)}, get_tag(child)
            if "BodyName" in inside:
                self.read_body(child)
            elif "ConstraintName" in inside:
                self.read_constraint(child)
            elif tag not in _CONTAINERS:
                near, fix = suggest_known_key(tag, _CONTAINERS), f"elements here are {', '.join(_CONTAINERS)}"
                self.warning(f"unexpected element <{label(tag)}>; ignored", fix, get_line(child), tuple(near))
            elif tag != "parameter" or not self.report_misspelled(child, inside):
                self.scan(child)

    def report_misspelled(self, element: Element, inside: set[str]) -> bool:
        """Report an element with the parts of a body or constraint but no name; return whether it is one."""
        values = [get_name(child) for child in iterate_children(element) if child.get("value") is not None]
        meant = ((name, suggest_known_key(name, ("BodyName", "ConstraintName"))) for name in values)
        wrong, near = next((each for each in meant if each[1]), ("", Suggestion()))
        if not near and not inside & _PART_NAMES:
            return False
        message = "this is neither a body nor a constraint: it has no BodyName and no ConstraintName"
        fix = f"write {near[0]}" if near else "add BodyName to a body, ConstraintName to a constraint"
        self.error(message + (f", but {label(wrong)}" if near else ""), fix, get_line(element), near)
        return True

    def enter(self, element: Element, known: tuple[str, ...], place: str) -> NamedParameters:
        return NamedParameters(element, known, self.builder, self.file, place)

    def read_body(self, element: Element) -> None:
        place = f"body {label(_get_value(element, 'BodyName'))}"
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
                at = ElementReader(self.builder, self.file, get_line(child), place)
                message = f"unknown parameter {quote(name)} holds frames; read as Frames"
                at.warning(message, "write Frames", nearest=Suggestion.of(name, "Frames"))
        return found

    def read_frames(self, element: Element, body: BodyBuilder, body_place: str) -> None:
        for child in iterate_children(element):
            name = _get_value(child, "FrameName")
            parts = self.enter(child, _FRAME_KEYS, f"{body_place}, frame {label(name)}")
            if "FrameName" not in parts.elements:
                parts.error("a frame without a name", 'add <parameter name="FrameName" value="..."/>')
                continue
            if "HTransform" not in parts.elements and name != "Origin":
                parts.note("no HTransform: the frame is at the body's origin")
            name, pose = parts.read_text("FrameName") or "", _read_transform(parts)
            body.add_frame(name, pose, _read_description(parts), source=parts.locate())

    def read_constraint(self, element: Element) -> None:
        """Read a constraint; one with a missing end is reported and left out."""
        place = f"constraint {label(_get_value(element, 'ConstraintName'))}"
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


def save(model: Model) -> SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    bodies = [line for body in model.bodies for line in _format_body(body)]
    constraints = [line for each in model.constraints for line in _format_constraint(each)]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<config>", ' <section name="Geometry">']
    for name, inside in (("BodyList", bodies), ("ConstraintList", constraints)):
        lines += [f'  <parameter name="{name}">', *(f"    {line}" for line in inside), "  </parameter>"]
    lines += [" </section>", "</config>"]
    return SavedModel("\n".join(lines) + "\n", tuple(_list_unsupported(model)))


def _list_unsupported(model: Model) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    if model.description:
        yield "the model's description"
    frames = [f"{body.name}:{frame.name}" for body in model.bodies for frame in body if frame.sigma is not None]
    if frames:
        yield f"the sigmas of {len(frames)} frames: {format_names(frames)}"
    constraints = [each.name for each in model.constraints if each.sigma is not None]
    if constraints:
        yield f"the sigmas of {len(constraints)} constraints: {format_names(constraints)}"
    yield from list_physical_features(model)
    described = [(body.name, body.description) for body in model.bodies]
    described += [(f"{body.name}:{frame.name}", frame.description) for body in model.bodies for frame in body]
    described += [(each.name, each.description) for each in model.constraints]
    if changed := [name for name, text in described if _fold_description(text) != text]:
        yield f"line breaks and control characters in {len(changed)} descriptions: {format_names(changed)}"


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
        lines += [f"  {line}" for line in format_element("parameter", inside, "BodyFrame")]
    lines.append("</parameter>")
    return format_element("parameter", lines, "Body")


def _format_constraint(each: Constraint) -> Iterator[str]:
    lines = _format_head("ConstraintName", each.name, each.description)
    for key, end in (("From", each.from_), ("To", each.to)):
        lines += format_element("parameter", name=key, value=end)
    return format_element("parameter", [*lines, *_format_transform(each.default_pose)], "Constraint")


def _format_head(key: str, name: str, description: str) -> list[str]:
    lines = [*format_element("parameter", name=key, value=name)]
    if description:
        lines += format_element("parameter", name="Description", value=_fold_description(description))
    return lines


def _format_transform(pose: Pose) -> Iterator[str]:
    rows = enumerate(pose.matrix_rows()[:3], 1)
    inside = [line for n, row in rows for line in format_element("parameter", name=f"Row{n}", value=row)]
    return format_element("parameter", inside, name="HTransform")
