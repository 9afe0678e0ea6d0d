"""Miro body and constraint XML: the report's geometry file (Annexes B.3, B.4 and C).

Names of the section and of the two lists vary between files, so a body is known by its parameter BodyName and
a constraint by its ConstraintName, wherever they stand. A frame or constraint without HTransform takes the
identity. White space around names is trimmed, and that in descriptions, which comes from line breaks of the
file, is folded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modelserver.errors import Location, Severity, Suggested, shown
from modelserver.formats import numbers
from modelserver.formats.spelling import label, nearest_keys
from modelserver.formats.xml_document import Named, children, line, tag
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.draft import BodyBuilder
from modelserver.spatial.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_BODY = ("BodyName", "Description", "HTransform", "Frames", "FrameList")
_FRAME = ("FrameName", "Description", "HTransform")
_CONSTRAINT = ("ConstraintName", "Description", "From", "To", "HTransform")
_ROWS = ("Row1", "Row2", "Row3")
_TELLTALE = frozenset(("Frames", "FrameList", "FrameName", "HTransform", "From", "To"))
_CONTAINERS = ("config", "section", "parameter", "instance")


def load(root: Element, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the bodies and constraints below `root` to `builder`, and what is wrong with them."""
    _Reader(builder, file).scan(root)
    return builder


def has_bodies(root: Element) -> bool:
    """Return whether anything below `root` states a BodyName or a ConstraintName."""
    return any(_name(each) in ("BodyName", "ConstraintName") for each in root.iter("{*}parameter"))


class _Reader:
    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file

    def scan(self, element: Element) -> None:
        """Look for bodies and constraints; libxml2 bounds the depth, and so this recursion."""
        for child in children(element):
            inside = {_name(each) for each in children(child)}
            if "BodyName" in inside:
                self.body(child)
            elif "ConstraintName" in inside:
                self.constraint(child)
            elif tag(child) not in _CONTAINERS:
                self.builder.warning(
                    f"unexpected element <{label(tag(child))}>; passed over",
                    Location(self.file, line(child)),
                    f"elements here are {', '.join(_CONTAINERS)}",
                    tuple(nearest_keys(tag(child), _CONTAINERS)),
                )
            elif not self.looks_misspelt(child, inside):
                self.scan(child)

    def looks_misspelt(self, element: Element, inside: set[str]) -> bool:
        """Report what has the parts of a body or a constraint but no name, which would be lost in silence."""
        if tag(element) != "parameter":
            return False
        near = Suggested()
        wrong = ""
        for child in children(element):
            if child.get("value") is not None:
                wrong = _name(child)
                near = nearest_keys(wrong, ("BodyName", "ConstraintName"))
                if near:
                    break
        if not near and not inside & _TELLTALE:
            return False
        self.builder.error(
            "this is neither a body nor a constraint: it has no BodyName and no ConstraintName"
            + (f", but {label(wrong)}" if near else ""),
            Location(self.file, line(element)),
            f"write {near[0]}" if near else "add BodyName to a body, ConstraintName to a constraint",
            near,
        )
        return True

    def body(self, element: Element) -> None:
        """Add a body with its frames."""
        place = f"body {label(_value(element, 'BodyName'))}"
        parts = Named(element, (*_BODY, *self.misnamed_lists(element, place)), self.builder, self.file, place)
        body = self.builder.body(
            parts.text("BodyName") or "",
            _folded(parts.text("Description")),
            self.transform(parts),
            source=Location(self.file, line(element), place),
        )
        for name, child in parts.found.items():
            if name not in ("BodyName", "Description", "HTransform"):
                self.frames(child, body, place)

    def misnamed_lists(self, element: Element, place: str) -> list[str]:
        """Return names that are not Frames but hold frames: they are taken for it, with a warning."""
        found = []
        for child in children(element):
            name = _name(child)
            if name in _BODY or not any(_has(each, "FrameName") for each in children(child)):
                continue
            found.append(name)
            self.builder.warning(
                f"unknown parameter {shown(name)} holds frames; taken for Frames",
                Location(self.file, line(child), place),
                "write Frames",
                Suggested.of(name, "Frames"),
            )
        return found

    def frames(self, element: Element, body: BodyBuilder, body_place: str) -> None:
        """Add the frames of a body's list."""
        for child in children(element):
            name = _value(child, "FrameName")
            place = f"{body_place}, frame {label(name)}"
            parts = Named(child, _FRAME, self.builder, self.file, place)
            if "FrameName" not in parts.found:
                self.builder.error(
                    "a frame without a name", parts.source(), 'add <parameter name="FrameName" value="..."/>'
                )
                continue
            if "HTransform" not in parts.found and name != "Origin":
                self.builder.problem(
                    Severity.NOTE, "no HTransform: the frame stands at the body's origin", parts.source()
                )
            body.frame(
                parts.text("FrameName") or "",
                self.transform(parts),
                _folded(parts.text("Description")),
                source=parts.source(),
            )

    def constraint(self, element: Element) -> None:
        """Add a constraint; one that lacks an end is reported and left out."""
        place = f"constraint {label(_value(element, 'ConstraintName'))}"
        parts = Named(element, _CONSTRAINT, self.builder, self.file, place)
        pose = self.transform(parts)
        from_, to = self.end(parts, "From"), self.end(parts, "To")
        if "HTransform" not in parts.found:
            self.builder.problem(Severity.NOTE, "no HTransform: the two frames coincide", parts.source())
        if from_ is not None and to is not None:
            self.builder.constraint(
                parts.text("ConstraintName") or "",
                from_,
                to,
                pose,
                _folded(parts.text("Description")),
                source=parts.source(),
            )
        elif from_ is not None or to is not None:
            sense, end = ("From", from_) if from_ is not None else ("To", to)
            self.builder.loose_ends.append((parts.text("ConstraintName") or "", sense, end or "", parts.source()))

    def end(self, parts: Named, key: str) -> str | None:
        """Return the frame a constraint names, without white space around its two names; None with an error."""
        if key not in parts.found:
            self.builder.error(f"{key} is missing", parts.source(), f'add <parameter name="{key}" value="Body:Frame"/>')
            return None
        text = parts.text(key)
        return None if text is None else ":".join(part.strip() for part in text.split(":"))

    def transform(self, owner: Named) -> Pose | None:
        """Return the pose of `owner`'s HTransform; None where there is none, or an error."""
        element = owner.found.get("HTransform")
        if element is None:
            return None
        place = f"{owner.place}, HTransform"
        parts = Named(element, (*_ROWS, "Row4"), self.builder, self.file, place)
        rows = [self.row(parts, name) for name in _ROWS]
        if "Row4" in parts.found and self.row(parts, "Row4") not in (None, [0.0, 0.0, 0.0, 1.0]):
            self.builder.error(
                "Row4 of a homogeneous transform is 0 0 0 1", parts.source("Row4"), "remove Row4; it carries nothing"
            )
            return None
        first, second, third = rows
        if first is None or second is None or third is None:
            return None
        position = (first[3], second[3], third[3])
        turned = numbers.rotation((first[:3], second[:3], third[:3]), self.builder, parts.source(), "Row1 to Row3")
        if turned is None or not numbers.within_reach(position, self.builder, parts.source()):
            return None
        return Pose(position, turned)

    def row(self, parts: Named, name: str) -> list[float] | None:
        """Return the four numbers of a row, None with an error where it does not hold them."""
        if name in parts.found and (text := parts.text(name)) is None:
            return None
        try:
            if name not in parts.found:
                raise ValueError(f"{name} is missing")
            row = [numbers.parse(word, f"{name}: ") for word in (text or "").split()]
            if len(row) != 4:
                raise ValueError(f"{name} has {len(row)} number{'' if len(row) == 1 else 's'}, not 4")
        except ValueError as error:
            self.builder.error(
                str(error),
                parts.source(name),
                f'write <parameter name="{name}" value="r r r p"/>: a row of the rotation, then a position in metres',
            )
            return None
        return row


def _name(element: Element) -> str:
    return (element.get("name") or "").strip()


def _has(element: Element, key: str) -> bool:
    return any(_name(child) == key for child in children(element))


def _value(element: Element, key: str) -> str:
    """Return the value of the first parameter `key`, without complaint: it names the place of others."""
    for child in children(element):
        if _name(child) == key:
            return (child.get("value") or "").strip()
    return ""


def _folded(text: str | None) -> str:
    return " ".join((text or "").split())
