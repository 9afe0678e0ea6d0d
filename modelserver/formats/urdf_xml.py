"""URDF: `<robot>` with links and joints, as ROS describes robots (wiki.ros.org/urdf/XML).

- A link is a body; the link's own frame is the body's frame `Origin`.
- A joint is a constraint of the joint's name, from a frame of the parent that has the joint's name too and stands at
  the parent's origin, to the child's `Origin`; its pose is the joint's <origin>. `continuous` is revolute without
  limits.
- An inertial is the body's 6x6 inertia; visuals and collisions are kept, and their mesh files never opened.

The root link comes first, the others as they stand in the file. What belongs to simulators and controllers is passed
over with a note.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from modelserver.errors import Location, Severity, shown
from modelserver.formats.circles import circles
from modelserver.formats.spelling import label, nearest_keys
from modelserver.formats.urdf_joints import JointReader
from modelserver.formats.urdf_shapes import read_inertial, read_materials, read_shape
from modelserver.formats.xml_document import children, line, tag
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.draft import BodyBuilder
from modelserver.geometry.joint import Joint
from modelserver.geometry.shape import Material, Shape
from modelserver.spatial.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

ORIGIN = "Origin"

GREATEST_LINKS = 100_000

_ROBOT = ("link", "joint", "material")
_NAMES = ("name", "link", "joint", "filename")
_LINK = ("inertial",)
_SHAPES = ("visual", "collision")
_JOINT = ("origin", "parent", "child", "axis", "limit", "mimic")


def load(root: Element, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the links and joints below `root` to `builder`, and what is wrong with them."""
    reader = _Reader(builder, file)
    if not reader.is_macro(root):
        reader.read(root)
    return builder


class _Placed(NamedTuple):
    """A joint as it stands in the file."""

    name: str
    parent: str
    child: str
    pose: Pose
    joint: Joint
    element: Element


class _Reader(JointReader):
    def __init__(self, builder: ModelBuilder, file: str):
        super().__init__(builder, file)
        self.links: dict[str, Element] = {}
        self.joints: dict[str, _Placed] = {}
        self.broken = False

    def is_macro(self, root: Element) -> bool:
        """Report what xacro would have replaced; return whether there is any."""
        # a name may hold anything; only where xacro is at work a $ in it is surely a variable
        at_work = any("xacro" in str(space) for space in root.nsmap.values())
        for element in root.iter("{*}*"):
            macro = "xacro" in str(element.tag).partition("}")[0]
            values = ((str(key), str(value)) for key, value in element.items())
            variable = next(
                (text for key, text in values if ("${" in text or "$(" in text) and (at_work or key not in _NAMES)),
                None,
            )
            if macro or variable is not None:
                what = f"<xacro:{label(tag(element))}>" if macro else shown(variable or "", 60)
                self.error(
                    f"{what} is to be replaced by xacro: this is the source of a URDF file, not yet one",
                    element,
                    "",
                    "run xacro first: xacro FILE > robot.urdf",
                )
                return True
        return False

    def read(self, root: Element) -> None:
        self.builder.name = (root.get("name") or "").strip()
        elements: dict[str, list[Element]] = {name: [] for name in _ROBOT}
        passed: Counter[str] = Counter()
        for child in children(root):
            name = tag(child)
            if name in elements:
                elements[name].append(child)
            elif near := nearest_keys(name, _ROBOT):
                self.warning(
                    f"unknown element <{label(name)}>; passed over", child, "", f"write <{near[0]}>", tuple(near)
                )
            else:
                passed[name] += 1
        if passed:
            said = ", ".join(f"{count} <{label(name)}>" for name, count in list(passed.items())[:8])
            self.builder.problem(Severity.NOTE, f"passed over, for it is no geometry: {said}", self.at(root, ""))
        if len(elements["link"]) > GREATEST_LINKS:
            self.error(f"the file has more than {GREATEST_LINKS} links", root, "", "split it into several models")
            return
        for element in elements["link"]:
            self.note_link(element)
        for element in elements["joint"]:
            self.note_type(element)
        for element in elements["joint"]:
            self.read_joint(element)
        self.check_mimics()
        self.report_efforts(elements["joint"])
        order = self.in_order(root)
        materials = read_materials(self, elements["material"])
        bodies = {name: self.read_link(name, self.links[name], materials) for name in order}
        if not self.broken:
            self.join(bodies)

    def is_sound(self, name: str, element: Element, place: str) -> bool:
        """Report a name that the model cannot hold; return whether there is nothing to report."""
        fault = names.fault(name)
        if name in names.RESERVED_BODIES and tag(element) == "link":
            fault = "the service keeps this name for its world frames"
        if fault:
            self.error(f"{place}: {fault}", element, place, "rename it, here and wherever it is used")
            self.broken = True
        return not fault

    def is_new(self, name: str, first: Element | None, element: Element, place: str) -> bool:
        if first is not None:
            self.error(
                f"{place} is defined twice (first on line {line(first)})", element, place, "rename one of the two"
            )
            self.broken = True
        return first is None

    def note_link(self, element: Element) -> None:
        name = (element.get("name") or "").strip()
        place = f"link {label(name)}"
        if self.is_sound(name, element, place) and self.is_new(name, self.links.get(name), element, place):
            self.links[name] = element

    def read_joint(self, element: Element) -> None:
        name = (element.get("name") or "").strip()
        place = f"joint {label(name)}"
        if not self.is_sound(name, element, place):
            return
        first = self.joints.get(name)
        if not self.is_new(name, None if first is None else first.element, element, place):
            return
        parts = self.parts(element, _JOINT, place)
        ends = [self.end(element, parts, key, place) for key in ("parent", "child")]
        pose = self.origin(parts.get("origin"), place)
        joint = self.motion(element, parts, place)
        if ends[0] is None or ends[1] is None or pose is None or joint is None:
            self.broken = True
            return
        self.joints[name] = _Placed(name, ends[0], ends[1], pose, joint, element)

    def end(self, element: Element, parts: dict[str, Element], key: str, place: str) -> str | None:
        """Return the link that a joint names as its parent or child."""
        if key not in parts:
            self.error(f"<{key}> is missing", element, place, f'add <{key} link="..."/>')
            return None
        name = self.text(parts[key], "link", place)
        if name is None or name in self.links:
            return name
        other = parts.get("parent" if key == "child" else "child")
        taken = "" if other is None else (other.get("link") or "").strip()
        near = self.nearest(name, [link for link in self.links if link != taken])
        self.error(
            f"{key} names link {shown(name)}, which does not exist",
            parts[key],
            place,
            f"write {near[0]}" if near else "name a link of this file",
            near,
        )
        return None

    def check_mimics(self) -> None:
        """Report joints that follow one another in a circle."""

        def leader(name: str) -> str | None:
            mimic = self.joints[name].joint.mimic if name in self.joints else None
            return None if mimic is None else mimic.joint

        for circle in circles(self.joints, leader):
            self.error(
                f"joints follow one another in a circle: {' follows '.join(map(label, circle))}",
                self.joints[circle[-1]].element,
                f"joint {label(circle[-1])}",
                "one of them must follow none: remove its <mimic>",
            )
            self.broken = True

    def in_order(self, root: Element) -> list[str]:
        """Return the links, root first; report where they are no tree with one root."""
        came_by: dict[str, _Placed] = {}
        for joint in self.joints.values():
            first = came_by.setdefault(joint.child, joint)
            if first is not joint:
                self.error(
                    f"link {label(joint.child)} has two parents: {label(first.parent)} by joint {label(first.name)} "
                    f"(line {line(first.element)}), and {label(joint.parent)} by joint {label(joint.name)}",
                    joint.element,
                    f"joint {label(joint.name)}",
                    "a link is the child of one joint; URDF has no closed loops",
                )
                self.broken = True
        if self.broken:
            return list(self.links)
        if not self.links:
            self.error("there is no link", root, "", 'add <link name="..."/>')
            self.broken = True
            return []
        for circle in circles(self.links, lambda link: came_by[link].parent if link in came_by else None):
            joint = came_by[circle[-1]]
            self.error(
                f"links go round in a circle: {' on '.join(map(label, circle))}",
                joint.element,
                f"joint {label(joint.name)}",
                "one of them must have a parent outside the circle, or none",
            )
            self.broken = True
        tops = [name for name in self.links if name not in came_by]
        if len(tops) > 1:
            several = ", ".join(map(label, tops[:8])) + (f", ... ({len(tops)} in all)" if len(tops) > 8 else "")
            self.error(
                f"there are {len(tops)} root links: {several}",
                self.links[tops[1]],
                f"link {label(tops[1])}",
                "a robot is one tree: add a joint whose child each of them but one is",
            )
            self.broken = True
        return [*tops, *(name for name in self.links if name in came_by)]

    def read_link(self, name: str, element: Element, materials: dict[str, Material]) -> BodyBuilder:
        """Add a link as a body."""
        place = f"link {label(name)}"
        shapes: dict[str, list[Shape]] = {key: [] for key in _SHAPES}
        known: list[Element] = []
        for child in children(element):
            kind = tag(child)
            if kind not in _SHAPES:
                known.append(child)
            elif (shape := read_shape(self, child, materials, f"{place}, {kind}")) is not None:
                shapes[kind].append(shape)
        inertia = None
        for child in known:
            if tag(child) == "inertial":
                found = read_inertial(self, child, f"{place}, inertial")
                if inertia is not None:
                    self.error("<inertial> is given twice", child, place, "remove one of the two")
                inertia = None if found is None else found.matrix()
            elif near := nearest_keys(tag(child), (*_LINK, *_SHAPES)):
                said = label(tag(child))
                self.warning(f"unknown element <{said}>; passed over", child, place, f"write <{near[0]}>", tuple(near))
        body = self.builder.body(name, inertia=inertia, source=Location(self.file, line(element), place))
        body.visuals, body.collisions = tuple(shapes["visual"]), tuple(shapes["collision"])
        return body.frame(ORIGIN, source=body.source)

    def join(self, bodies: dict[str, BodyBuilder]) -> None:
        """Add the joints as constraints, each with a frame of its own on the parent."""
        for joint in self.joints.values():
            source = self.at(joint.element, f"joint {label(joint.name)}")
            mount = joint.name if joint.name != ORIGIN else f"{ORIGIN}_"
            bodies[joint.parent].frame(mount, source=source)
            self.builder.constraint(
                joint.name,
                names.joined(joint.parent, mount),
                names.joined(joint.child, ORIGIN),
                joint.pose,
                joint=joint.joint,
                source=source,
            )
