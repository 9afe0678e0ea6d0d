"""Read Miro body and constraint XML: the geometry file of the 2005 report (Annexes B.3, B.4 and C).

The names of the section and of the two lists vary between files, so a body is recognized by its parameter BodyName and
a constraint by its ConstraintName, anywhere in the file. A frame or constraint without HTransform has the identity.
White space around names is trimmed, and folded in descriptions, where it comes from line breaks of the file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modelserver.errors import Location, Severity, Suggestion, quote
from modelserver.formats.reading import check_position, label, parse_numbers, repair_rotation, suggest_known_key
from modelserver.formats.xml_document import NamedParameters, get_line, get_tag, iterate_children
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.draft import BodyBuilder
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_BODY_KEYS = ("BodyName", "Description", "HTransform", "Frames", "FrameList")
_FRAME_KEYS = ("FrameName", "Description", "HTransform")
_CONSTRAINT_KEYS = ("ConstraintName", "Description", "From", "To", "HTransform")
_ROWS = ("Row1", "Row2", "Row3")
_PART_NAMES = frozenset(("Frames", "FrameList", "FrameName", "HTransform", "From", "To"))
_CONTAINERS = ("config", "section", "parameter", "instance")


def load(root: Element, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the bodies and constraints below `root`, and their problems, to `builder`."""
    _MiroReader(builder, file).scan(root)
    return builder


def has_bodies(root: Element) -> bool:
    """Return whether there is a BodyName or a ConstraintName below `root`."""
    return any(_get_name(each) in ("BodyName", "ConstraintName") for each in root.iter("{*}parameter"))


class _MiroReader:
    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file

    def scan(self, element: Element) -> None:
        """Find bodies and constraints; libxml2 bounds the depth, and so this recursion."""
        for child in iterate_children(element):
            inside = {_get_name(each) for each in iterate_children(child)}
            if "BodyName" in inside:
                self.read_body(child)
            elif "ConstraintName" in inside:
                self.read_constraint(child)
            elif get_tag(child) not in _CONTAINERS:
                self.builder.add_warning(
                    f"unexpected element <{label(get_tag(child))}>; ignored",
                    Location(self.file, get_line(child)),
                    f"elements here are {', '.join(_CONTAINERS)}",
                    tuple(suggest_known_key(get_tag(child), _CONTAINERS)),
                )
            elif not self.report_misspelled(child, inside):
                self.scan(child)

    def report_misspelled(self, element: Element, inside: set[str]) -> bool:
        """Report an element with the parts of a body or constraint but no name; return whether it is one."""
        if get_tag(element) != "parameter":
            return False
        near = Suggestion()
        wrong = ""
        for child in iterate_children(element):
            if child.get("value") is not None:
                wrong = _get_name(child)
                near = suggest_known_key(wrong, ("BodyName", "ConstraintName"))
                if near:
                    break
        if not near and not inside & _PART_NAMES:
            return False
        self.builder.add_error(
            "this is neither a body nor a constraint: it has no BodyName and no ConstraintName"
            + (f", but {label(wrong)}" if near else ""),
            Location(self.file, get_line(element)),
            f"write {near[0]}" if near else "add BodyName to a body, ConstraintName to a constraint",
            near,
        )
        return True

    def read_body(self, element: Element) -> None:
        """Read a body with its frames."""
        place = f"body {label(_get_value(element, 'BodyName'))}"
        parts = NamedParameters(
            element, (*_BODY_KEYS, *self.find_misnamed_lists(element, place)), self.builder, self.file, place
        )
        body = self.builder.add_body(
            parts.read_text("BodyName") or "",
            _fold_spaces(parts.read_text("Description")),
            self.read_transform(parts),
            source=Location(self.file, get_line(element), place),
        )
        for name, child in parts.elements.items():
            if name not in ("BodyName", "Description", "HTransform"):
                self.read_frames(child, body, place)

    def find_misnamed_lists(self, element: Element, place: str) -> list[str]:
        """Return the names of lists of frames that are not named Frames; they are read, with a warning."""
        found = []
        for child in iterate_children(element):
            name = _get_name(child)
            if name in _BODY_KEYS or not any(_has_parameter(each, "FrameName") for each in iterate_children(child)):
                continue
            found.append(name)
            self.builder.add_warning(
                f"unknown parameter {quote(name)} holds frames; read as Frames",
                Location(self.file, get_line(child), place),
                "write Frames",
                Suggestion.of(name, "Frames"),
            )
        return found

    def read_frames(self, element: Element, body: BodyBuilder, body_place: str) -> None:
        """Read the frames of a body's list."""
        for child in iterate_children(element):
            name = _get_value(child, "FrameName")
            place = f"{body_place}, frame {label(name)}"
            parts = NamedParameters(child, _FRAME_KEYS, self.builder, self.file, place)
            if "FrameName" not in parts.elements:
                self.builder.add_error(
                    "a frame without a name", parts.locate(), 'add <parameter name="FrameName" value="..."/>'
                )
                continue
            if "HTransform" not in parts.elements and name != "Origin":
                self.builder.add_problem(
                    Severity.NOTE, "no HTransform: the frame is at the body's origin", parts.locate()
                )
            body.add_frame(
                parts.read_text("FrameName") or "",
                self.read_transform(parts),
                _fold_spaces(parts.read_text("Description")),
                source=parts.locate(),
            )

    def read_constraint(self, element: Element) -> None:
        """Read a constraint; one with a missing end is reported and left out."""
        place = f"constraint {label(_get_value(element, 'ConstraintName'))}"
        parts = NamedParameters(element, _CONSTRAINT_KEYS, self.builder, self.file, place)
        pose = self.read_transform(parts)
        from_, to = self.read_end(parts, "From"), self.read_end(parts, "To")
        if "HTransform" not in parts.elements:
            self.builder.add_problem(Severity.NOTE, "no HTransform: the two frames coincide", parts.locate())
        if from_ is not None and to is not None:
            self.builder.add_constraint(
                parts.read_text("ConstraintName") or "",
                from_,
                to,
                pose,
                _fold_spaces(parts.read_text("Description")),
                source=parts.locate(),
            )
        elif from_ is not None or to is not None:
            sense, end = ("From", from_) if from_ is not None else ("To", to)
            self.builder.unresolved_ends.append(
                (parts.read_text("ConstraintName") or "", sense, end or "", parts.locate())
            )

    def read_end(self, parts: NamedParameters, key: str) -> str | None:
        """Read the frame at one end of a constraint, trimmed; None, with an error, if there is none."""
        if key not in parts.elements:
            self.builder.add_error(
                f"{key} is missing", parts.locate(), f'add <parameter name="{key}" value="Body:Frame"/>'
            )
            return None
        text = parts.read_text(key)
        return None if text is None else ":".join(part.strip() for part in text.split(":"))

    def read_transform(self, owner: NamedParameters) -> Pose | None:
        """Read the pose in the HTransform of `owner`; None if there is none, or, with an error, if it is wrong."""
        element = owner.elements.get("HTransform")
        if element is None:
            return None
        place = f"{owner.place}, HTransform"
        parts = NamedParameters(element, (*_ROWS, "Row4"), self.builder, self.file, place)
        rows = [self.read_row(parts, name) for name in _ROWS]
        if "Row4" in parts.elements and self.read_row(parts, "Row4") not in (None, [0.0, 0.0, 0.0, 1.0]):
            self.builder.add_error(
                "Row4 of a homogeneous transform is 0 0 0 1", parts.locate("Row4"), "remove Row4; it is constant"
            )
            return None
        first, second, third = rows
        if first is None or second is None or third is None:
            return None
        position = (first[3], second[3], third[3])
        turned = repair_rotation((first[:3], second[:3], third[:3]), self.builder, parts.locate(), "Row1 to Row3")
        if turned is None or not check_position(position, self.builder, parts.locate()):
            return None
        return Pose(position, turned)

    def read_row(self, parts: NamedParameters, name: str) -> list[float] | None:
        """Read the four numbers of a row; None, with an error, if there are not four."""
        if name in parts.elements and (text := parts.read_text(name)) is None:
            return None
        try:
            if name not in parts.elements:
                raise ValueError(f"{name} is missing")
            return parse_numbers((text or "").split(), 4, name)
        except ValueError as error:
            self.builder.add_error(
                str(error),
                parts.locate(name),
                f'write <parameter name="{name}" value="r r r p"/>: a row of the rotation, then a position in meters',
            )
            return None


def _get_name(element: Element) -> str:
    return (element.get("name") or "").strip()


def _has_parameter(element: Element, key: str) -> bool:
    return any(_get_name(child) == key for child in iterate_children(element))


def _get_value(element: Element, key: str) -> str:
    """Return the value of the first parameter `key`, empty for none: it names the place of problems."""
    for child in iterate_children(element):
        if _get_name(child) == key:
            return (child.get("value") or "").strip()
    return ""


def _fold_spaces(text: str | None) -> str:
    return " ".join((text or "").split())
