"""Miro frame-tree XML: `<instance type="rapid::FrameRpyParameters" name=...>` elements, as NASA's rovers use.

Each instance is a frame that stands in its Parent at X, Y, Z (metres), turned by Roll, Pitch, Yaw (degrees, fixed
axes: Rz(yaw) Ry(pitch) Rx(roll)); what is left out is 0. The form knows no bodies, so frames are grouped:

- A frame that carries others, or has no parent, is a body; the body's frame `Origin` is the frame itself.
- Every other frame is a frame of its parent's body.
- A body that has a parent is also a frame of the parent's body, and the constraint `<name>Fixed`, an identity,
  joins that frame to the body's Origin.

So a frame keeps its own name, `Parent:Frame`, and what is mounted together moves together, which is how joints
will enter. Numbers are taken as written. NASA's own files are x forward, y right, z down.

A Parent is a path as `frame_paths` describes it. One that the file does not define but that is outside a vehicle's file
by its nature (an absolute path, the earth, a UTM grid) becomes a root itself, so that what stands in it stays together.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from modelserver.errors import Location, Severity, Suggested, shown, suggestion, suggestions
from modelserver.formats import numbers
from modelserver.formats.circles import circles
from modelserver.formats.frame_paths import ANY, ROOT, Ancestry, FramePath, parse_path
from modelserver.formats.spelling import label
from modelserver.formats.xml_document import Named, line
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.draft import BodyBuilder
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
    if reader.place():
        reader.group()
    return builder


_OUTSIDE = re.compile(r"Earth|UtmGrid\d{1,2}[A-Z]|\$\{?SITE_FRAME\}?")
"""Frames that NASA's frame store has without a file: the earth, its UTM grids, and the site that the robot is at."""


@dataclass(slots=True)
class _Frame:
    name: str
    parent: str
    pose: Pose
    source: Location
    parent_source: Location
    path: FramePath


class _Reader:
    def __init__(self, builder: ModelBuilder, file: str, variables: Mapping[str, str]):
        self.builder = builder
        self.file = file
        self.variables = variables
        self.frames: dict[str, _Frame] = {}
        """By name; a further frame of a name, which stands in another parent, by its parent and name."""
        self.parents: dict[str, str] = {}
        """For each frame the key of its parent, empty for a root."""
        self.undefined: dict[str, list[Location]] = {}

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
        path = parse_path(parent)
        frame = _Frame(name, parent, pose or Pose.identity(), parts.source(), parts.source("Parent"), path)
        first = self.frames.get(name)
        key = name
        if first is not None and first.path != path:
            # names are unique below one parent only
            key = f"{parent}/{name}"
            first = self.frames.get(key)
        if first is None:
            self.frames[key] = frame
        else:
            self.report_twice(first, frame)

    def report_twice(self, first: _Frame, second: _Frame) -> None:
        """Report a second frame of a name in the same parent."""
        moved, turned = first.pose.distance(second.pose)
        lines = f"on line {first.source.line} and on line {second.source.line}"
        self.builder.warning(
            f"frame {label(first.name)} is defined twice: {lines}; "
            f"the two are {moved:.6g} m and {math.degrees(turned):.6g} deg apart; the first stands",
            second.source,
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
                    tuple(suggestions(missing[0], self.variables)),
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

    def expanded(self, text: str, source: Location) -> str:
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
                tuple(suggestions(name, self.variables)),
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
                Location(self.file, lines[0]),
                "frames have type rapid::FrameRpyParameters" if severity is Severity.WARNING else "",
            )

    def place(self) -> bool:
        """Find the parent of each frame; report those that are not there, and cycles. Return whether all is well."""
        named = {frame.name for frame in self.frames.values()}
        for frame in self.frames.values():
            if "/" in frame.parent and frame.parent in named:
                # a name may hold slashes
                frame.path = FramePath((frame.parent,), False)
        self.add_outside()
        keys: dict[str, list[str]] = {}
        for key, frame in self.frames.items():
            keys.setdefault(frame.name, []).append(key)
        ancestry = Ancestry({key: frame.name for key, frame in self.frames.items()}, self.parents)
        several: list[str] = []
        for key, frame in self.frames.items():
            candidates = keys.get(frame.path.name, [])
            if not frame.path.parts:
                self.parents[key] = ""
            elif len(candidates) == 1:
                # whether its own ancestors are those of the path is looked at when all are placed
                self.parents[key] = candidates[0]
            elif candidates:
                several.append(key)
        self.choose(several, keys, ancestry)
        missing = [key for key in self.frames if key not in self.parents]
        well = self.has_no_cycles()
        if well:
            for key, frame in self.frames.items():
                parent = self.parents.get(key, "")
                if parent and not frame.path.is_plain and not self.fits(frame, parent, keys, ancestry):
                    missing.append(key)
        if not ancestry.is_exhausted:
            self.report_missing(missing, keys, ancestry)
        else:
            self.builder.error(
                "the paths of parents are too many and too deep", Location(self.file), "write plain names"
            )
        return well and not missing and not ancestry.is_exhausted

    def add_outside(self) -> None:
        """Make a root of each parent that is not in the file and need not be."""
        known = {frame.name for frame in self.frames.values()}
        meant: dict[str, str] = {}
        for frame in tuple(self.frames.values()):
            path = frame.path
            if not path.parts or not known.isdisjoint(path.parts) or path.name == ANY:
                continue
            is_outside = bool(_OUTSIDE.fullmatch(path.name))
            if not is_outside:
                if path.is_absolute and path.name not in meant:
                    meant[path.name] = suggestion(path.name, known) if len(meant) < SUGGESTED else ""
                if not path.is_absolute or meant[path.name]:
                    continue
            if path.name in names.RESERVED_BODIES:
                # the service has a frame of that name itself: what stands there is a root
                frame.path = ROOT
            elif path.name not in self.frames:
                source = frame.parent_source
                self.frames[path.name] = _Frame(path.name, "", Pose.identity(), source, source, ROOT)
                self.builder.problem(
                    Severity.NOTE, f"Parent {label(frame.parent)} is not in the file; it becomes a root", source
                )

    def choose(self, several: list[str], keys: dict[str, list[str]], ancestry: Ancestry) -> None:
        """Place frames whose parent has a name that several frames have, once the ancestors of those are placed."""
        while several:
            left: list[str] = []
            for key in several:
                if ancestry.is_exhausted:
                    return
                path = self.frames[key].path
                above = {each: ancestry.of(each) for each in keys[path.name] if each != key}
                fitting = [(len(at), each) for each, at in above.items() if at is not None and ancestry.match(path, at)]
                if None in above.values() and not any(depth == 1 for depth, _ in fitting):
                    left.append(key)
                elif fitting:
                    self.parents[key] = min(fitting, key=lambda found: found[0])[1]
                    if len(fitting) > 1:
                        self.report_ambiguous(key, [each for _, each in fitting], ancestry)
            if len(left) == len(several):
                return
            several = left

    def report_ambiguous(self, key: str, fitting: list[str], ancestry: Ancestry) -> None:
        frame = self.frames[key]
        paths = ["/".join(ancestry.of(each) or ()) for each in fitting]
        chosen = "/".join(ancestry.of(self.parents[key]) or ())
        self.builder.warning(
            f"Parent {label(frame.parent)} names {len(fitting)} frames: {', '.join(map(label, paths[:4]))}; "
            f"{label(chosen)} is taken",
            frame.parent_source,
            "write the path of the one that is meant",
        )

    def fits(self, frame: _Frame, parent: str, named: Collection[str], ancestry: Ancestry) -> bool:
        """Return whether the ancestors of the parent of a frame are those of its path."""
        above = ancestry.of(parent)
        if above is None:
            return ancestry.is_exhausted
        path = frame.path
        if path.is_absolute:
            # what stands above the roots of the file cannot be looked at
            inside = next((n for n, part in enumerate(path.parts) if part in named or part == ANY), 0)
            path = FramePath(path.parts[inside:], True)
        return ancestry.match(path, above) or ancestry.is_exhausted

    def report_missing(self, missing: list[str], keys: dict[str, list[str]], ancestry: Ancestry) -> None:
        """Report parents that no frame is, each with what was probably meant, where that is clear."""
        meant: dict[FramePath, str] = {}
        for key in missing:
            frame = self.frames[key]
            path = frame.path
            if path not in meant:
                meant[path] = self.meant(frame, keys, ancestry) if len(meant) < SUGGESTED else ""
            near = meant[path]
            why = ""
            if self.parents.get(key):
                why = f": {label(path.name)} is {label('/'.join(ancestry.of(self.parents[key]) or ()))}"
            self.builder.error(
                f"Parent names {shown(frame.parent)}, which does not exist{why}",
                frame.parent_source,
                f"write {near}" if near else "name a frame of this file, or leave it empty for a root",
                Suggested.of(frame.parent, near),
            )

    def meant(self, frame: _Frame, keys: dict[str, list[str]], ancestry: Ancestry) -> str:
        """Return the parent that a path probably means with one name of it misspelled; empty where that is not clear.

        It has as many names as the path: an ancestor is another place, and the frame itself cannot be its parent.
        """
        parts = list(frame.path.parts)
        unknown = [n for n, part in enumerate(parts) if part not in keys and part != ANY]
        if len(unknown) != 1:
            return ""
        (at,) = unknown
        near = suggestion(parts[at], [name for name in keys if name != frame.name and name not in parts])
        if not near:
            return ""
        parts[at] = near
        found = FramePath(tuple(parts), frame.path.is_absolute)
        placed = (ancestry.of(key) for key in keys[found.name])
        if not found.is_plain and not any(above is not None and ancestry.match(found, above) for above in placed):
            return ""
        return ("/" if found.is_absolute else "") + "/".join(parts)

    def has_no_cycles(self) -> bool:
        """Report parents that form a cycle; return whether there is none."""
        well = True
        for circle in circles(self.frames, lambda key: self.parents.get(key) or None):
            well = False
            self.builder.error(
                f"parents form a cycle: {' in '.join(map(label, circle))}",
                self.frames[circle[-1]].parent_source,
                "one of them must stand in a frame outside the cycle, or have an empty Parent",
            )
        return well

    def group(self) -> None:
        """Make bodies of roots and of frames that carry others; see the module's text."""
        self.drop_repeated()
        carrying = {parent for parent in self.parents.values() if parent}
        roots = [key for key in self.frames if not self.parents[key]]
        mounted = [key for key in self.frames if self.parents[key] and key in carrying]
        bodies: dict[str, BodyBuilder] = {}
        taken: set[str] = set()
        for key in (*roots, *mounted):
            frame = self.frames[key]
            name = frame.name
            if name in taken:
                name = f"{self.frames[self.parents[key]].name}.{name}" if self.parents[key] else name
            taken.add(name)
            bodies[key] = self.builder.body(name, source=frame.source)
            bodies[key].frame(ORIGIN, source=frame.source)
        for key, frame in self.frames.items():
            parent = self.parents[key]
            if not parent:
                if frame.pose != Pose.identity():
                    bodies[key].pose = frame.pose
                continue
            if frame.name == ORIGIN:
                where = label(bodies[parent].name)
                self.builder.error(
                    f"a frame in {where} is named {ORIGIN}, as the frame that stands for {where} itself will be",
                    frame.source,
                    "rename it",
                )
                continue
            bodies[parent].frame(frame.name, frame.pose, source=frame.source)
            if key in bodies:
                name = bodies[key].name
                end = f"{bodies[parent].name}:{frame.name}"
                self.builder.constraint(f"{name}Fixed", end, f"{name}:{ORIGIN}", source=frame.source)

    def drop_repeated(self) -> None:
        """Drop what stands twice in one parent that is written in two ways, e.g. as a name and as a path."""
        first: dict[tuple[str, str], str] = {}
        kept: dict[str, str] = {}
        for key, frame in self.frames.items():
            kept[key] = first.setdefault((frame.name, self.parents[key]), key)
        if len(first) == len(self.frames):
            return
        for key, stays in kept.items():
            if key != stays:
                self.report_twice(self.frames[stays], self.frames.pop(key))
                del self.parents[key]
        self.parents = {key: kept.get(parent, parent) for key, parent in self.parents.items()}
