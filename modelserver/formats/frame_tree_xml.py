"""Miro frame-tree XML: `<instance type="rapid::FrameRpyParameters" name=...>` elements, as NASA's rovers use.

Each instance is a frame that stands in its Parent at X, Y, Z (metres), turned by Roll, Pitch, Yaw (degrees, fixed
axes: Rz(yaw) Ry(pitch) Rx(roll)); what is left out is 0. The form knows no bodies, so frames are grouped:

- A frame that carries others, or has no parent, is a body; the body's frame `Origin` is the frame itself.
- Every other frame is a frame of its parent's body.
- A body that has a parent is also a frame of the parent's body, and the constraint `<name>Fixed`, an identity,
  joins that frame to the body's Origin.

So a frame keeps its own name, `Parent:Frame`, and what is mounted together moves together, which is how joints
will enter. Numbers are taken as written. NASA's own files are x forward, y right, z down.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from modelserver.errors import Severity, Source, nearest_names, shown
from modelserver.formats import numbers
from modelserver.formats.circles import circles
from modelserver.formats.spelling import label
from modelserver.formats.xml_document import Named, line
from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.spatial.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

ORIGIN = "Origin"

SUGGESTED = 50
"""Missing parents for which nearest names are looked up; a file with more wrong has another illness."""

_POSITION = ("X", "Y", "Z")
_ROTATION = ("Roll", "Pitch", "Yaw")
_KNOWN = ("Name", "Parent", *_POSITION, *_ROTATION)
_VARIABLE = re.compile(r"\$(?:\{(\w+)\}|(\w+))", re.ASCII)


def instances(root: Element) -> Iterator[Element]:
    """Yield the elements that this form is known by."""
    for element in root.iter("{*}instance"):
        if (element.get("type") or "").strip().endswith("FrameRpyParameters"):
            yield element


def load(root: Element, builder: ModelBuilder, file: str, variables: Mapping[str, str]) -> ModelBuilder:
    """Add the frames below `root`, grouped into bodies, to `builder`, and what is wrong with them.

    `$NAME` and `${NAME}` are replaced from `variables`, else from the environment.
    """
    reader = _Reader(builder, file, variables)
    for element in instances(root):
        reader.frame(element)
    reader.others(root)
    reader.report_variables()
    if reader.parents_exist():
        reader.group()
    return builder


@dataclass(slots=True)
class _Frame:
    name: str
    parent: str
    pose: Pose
    source: Source
    parent_source: Source


class _Reader:
    def __init__(self, builder: ModelBuilder, file: str, variables: Mapping[str, str]):
        self.builder = builder
        self.file = file
        self.variables = variables
        self.frames: dict[str, _Frame] = {}
        self.undefined: dict[str, list[Source]] = {}

    def frame(self, element: Element) -> None:
        """Take one instance; a second one of a name is refused with a warning, the first stands."""
        own = (element.get("name") or "").strip()
        parts = Named(element, _KNOWN, self.builder, self.file, f"frame {label(own)}")
        name = self.expanded(own, parts.source())
        stated = self.expanded(parts.text("Name") or "", parts.source("Name"))
        if not name:
            name = stated
        elif stated and stated != name:
            self.builder.warning(
                f"the instance is named {label(name)}, its parameter Name {label(stated)}; {label(name)} stands",
                parts.source("Name"),
                "make the two alike, or remove the parameter Name",
            )
        parent = self.expanded(parts.text("Parent") or "", parts.source("Parent"))
        pose = self.pose(parts)
        frame = _Frame(name, parent, pose or Pose.identity(), parts.source(), parts.source("Parent"))
        first = self.frames.get(name)
        if first is None:
            self.frames[name] = frame
            return
        moved, turned = first.pose.distance(frame.pose)
        parents = "" if first.parent == parent else f", and hang on {label(first.parent)} and {label(parent)}"
        self.builder.warning(
            f"frame {label(name)} is defined twice: on line {first.source.line} and on line {frame.source.line}; "
            f"the two are {moved:.6g} m and {math.degrees(turned):.6g} deg apart{parents}; the first stands",
            frame.source,
            "rename one of the two, or remove the wrong one",
        )

    def pose(self, parts: Named) -> Pose | None:
        """Return the pose that X to Yaw give; None, with an error, where one is no number."""
        values: list[float] = []
        for key in (*_POSITION, *_ROTATION):
            if key not in parts.found:
                values.append(0.0)
                continue
            text = parts.text(key)
            if text is None:
                continue
            unit = "metres" if key in _POSITION else "degrees"
            filled, missing = self.substituted(text)
            if missing:
                self.builder.error(
                    f"{key} takes its number from ${missing[0]}, which is not defined",
                    parts.source(key),
                    f"give it: --set {missing[0]}=NUMBER, or export {missing[0]}",
                    nearest_names(missing[0], self.variables),
                )
                continue
            try:
                values.append(numbers.parse(filled.strip()))
            except ValueError as error:
                self.builder.error(f"{key}: {error}", parts.source(key), f"write one number, in {unit}")
        if len(values) != 6 or not numbers.within_reach(values[:3], self.builder, parts.source()):
            return None
        return Pose.from_rpy(values[:3], *(math.radians(value) for value in values[3:]))

    def substituted(self, text: str) -> tuple[str, list[str]]:
        """Return `text` with its variables filled in, and the names of those that are not defined."""
        if "$" not in text:
            return text, []
        missing: list[str] = []

        def value(match: re.Match[str]) -> str:
            name = match[1] or match[2]
            found = self.variables.get(name, os.environ.get(name))
            if found is None:
                missing.append(name)
                return match[0]
            return found

        return _VARIABLE.sub(value, text), missing

    def expanded(self, text: str, source: Source) -> str:
        """Return a name with its variables filled in; what is not defined stays, and is remembered."""
        filled, missing = self.substituted(text)
        for name in missing:
            self.undefined.setdefault(name, []).append(source)
        return filled.strip()

    def report_variables(self) -> None:
        """Report each undefined variable once, where it is first used."""
        for name, places in self.undefined.items():
            uses = f" (used {len(places)} times)" if len(places) > 1 else ""
            self.builder.warning(
                f"${name} is not defined{uses}; it stands in names as it is written",
                places[0],
                f"give it: --set {name}=NAME, or export {name}",
                nearest_names(name, self.variables),
            )

    def others(self, root: Element) -> None:
        """Say which instances are of another type and so are not read."""
        passed: dict[str, list[int]] = {}
        for element in root.iter("{*}instance"):
            kind = (element.get("type") or "").strip()
            if not kind.endswith("FrameRpyParameters"):
                passed.setdefault(kind, []).append(line(element))
        for kind, lines in passed.items():
            # an instance whose type speaks of frames may well be meant as one
            severity = Severity.WARNING if "frame" in kind.casefold() else Severity.NOTE
            self.builder.problem(
                severity,
                f"{len(lines)} instance{'' if len(lines) == 1 else 's'} of type {label(kind)} passed over",
                Source(self.file, lines[0]),
                "frames have type rapid::FrameRpyParameters" if severity is Severity.WARNING else "",
            )

    def parents_exist(self) -> bool:
        """Report parents that are not there and parents that go round in a circle; return whether all is well."""
        well = True
        near: dict[str, tuple[str, ...]] = {}
        for frame in self.frames.values():
            if frame.parent and frame.parent not in self.frames:
                well = False
                if frame.parent not in near:
                    near[frame.parent] = nearest_names(frame.parent, self.frames) if len(near) < SUGGESTED else ()
                names = near[frame.parent]
                self.builder.error(
                    f"Parent names {shown(frame.parent)}, which does not exist",
                    frame.parent_source,
                    f"write {names[0]}" if names else "name a frame of this file, or leave it empty for a root",
                    names,
                )
        for circle in circles(self.frames, lambda name: self.frames[name].parent if name in self.frames else None):
            well = False
            self.builder.error(
                f"parents go round in a circle: {' in '.join(map(label, circle))}",
                self.frames[circle[-1]].parent_source,
                "one of them must stand in a frame outside the circle, or have an empty Parent",
            )
        return well

    def group(self) -> None:
        """Make bodies of roots and of frames that carry others; see the module's text."""
        carrying = {frame.parent for frame in self.frames.values() if frame.parent}
        roots = [frame for frame in self.frames.values() if not frame.parent]
        mounted = [frame for frame in self.frames.values() if frame.parent and frame.name in carrying]
        bodies: dict[str, BodyBuilder] = {}
        for frame in (*roots, *mounted):
            bodies[frame.name] = self.builder.body(frame.name, source=frame.source)
            bodies[frame.name].frame(ORIGIN, source=frame.source)
        for frame in self.frames.values():
            if not frame.parent:
                if frame.pose != Pose.identity():
                    bodies[frame.name].pose = frame.pose
                continue
            if frame.name == ORIGIN:
                self.builder.error(
                    f"a frame in {label(frame.parent)} is named {ORIGIN}, as the frame that stands for "
                    f"{label(frame.parent)} itself will be",
                    frame.source,
                    "rename it",
                )
                continue
            bodies[frame.parent].frame(frame.name, frame.pose, source=frame.source)
            if frame.name in bodies:
                self.builder.constraint(
                    f"{frame.name}Fixed",
                    f"{frame.parent}:{frame.name}",
                    f"{frame.name}:{ORIGIN}",
                    source=frame.source,
                )
