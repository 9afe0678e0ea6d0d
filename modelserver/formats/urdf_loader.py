"""Read URDF: `<robot>` with links and joints (wiki.ros.org/urdf/XML).

- A link is a body; the link's own frame is the body's frame `Origin`.
- A joint is a constraint with the joint's name, from a frame of the parent, also with the joint's name, at the parent's
  origin, to the child's `Origin`; its pose is the joint's <origin>. `continuous` is revolute without limits.
- An inertial is the 6x6 inertia of the body; visuals and collisions are stored, and their mesh files never opened.

The root link comes first, the others in the order of the file. Elements of simulators and controllers are ignored with
a note; a file that xacro has not processed is rejected.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from modelserver.errors import Location, Severity, Suggestion, quote, suggest_name
from modelserver.formats.reading import MAX_SUGGESTIONS, ORIGIN, find_cycles, label, suggest_known_key
from modelserver.formats.urdf_elements import ElementReader, read_inertial, read_materials, read_shape
from modelserver.formats.xml_document import get_line, get_tag, iterate_children
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.draft import BodyBuilder
from modelserver.geometry.joint import FIXED, Coordinates, Joint, JointType, Mimic
from modelserver.geometry.shape import Material, Shape
from modelserver.transforms.pose import Pose

if TYPE_CHECKING:
    from lxml.etree import _Element as Element


UNLIMITED = 1e9
"""A greater limit counts as none: URDF requires numbers for a joint without limits."""

_JOINT_TYPES = {
    "revolute": JointType.REVOLUTE,
    "continuous": JointType.REVOLUTE,
    "prismatic": JointType.PRISMATIC,
    "fixed": JointType.FIXED,
    "floating": JointType.FLOATING,
    "planar": JointType.PLANAR,
}
_SINGLE_COORDINATE = (JointType.REVOLUTE, JointType.PRISMATIC)


MAX_LINKS = 100_000

_ROBOT_ELEMENTS = ("link", "joint", "material")
_NAME_ATTRIBUTES = ("name", "link", "joint", "filename")
_LINK_ELEMENTS = ("inertial",)
_SHAPE_ELEMENTS = ("visual", "collision")
_JOINT_ELEMENTS = ("origin", "parent", "child", "axis", "limit", "mimic")


def load(root: Element, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the links and joints below `root`, and their problems, to `builder`."""
    reader = _UrdfReader(builder, file)
    if not reader.has_macros(root):
        reader.read(root)
    return builder


class _ParsedJoint(NamedTuple):
    """A joint of the file."""

    name: str
    parent: str
    child: str
    pose: Pose
    joint: Joint
    element: Element


class _UrdfReader(ElementReader):
    def __init__(self, builder: ModelBuilder, file: str):
        super().__init__(builder, file)
        self.types: dict[str, JointType] = {}
        self.suggestion_count = 0
        self.links: dict[str, Element] = {}
        self.joints: dict[str, _ParsedJoint] = {}
        self.has_errors = False

    def has_macros(self, root: Element) -> bool:
        """Report the first expression that xacro would have replaced; return whether there is one."""
        # a name may hold anything; a $ in it is certainly a variable only if the file uses xacro
        at_work = any("xacro" in str(space) for space in root.nsmap.values())
        for element in root.iter("{*}*"):
            macro = "xacro" in str(element.tag).partition("}")[0]
            values = ((str(key), str(value)) for key, value in element.items())
            variable = next(
                (
                    text
                    for key, text in values
                    if ("${" in text or "$(" in text) and (at_work or key not in _NAME_ATTRIBUTES)
                ),
                None,
            )
            if macro or variable is not None:
                what = f"<xacro:{label(get_tag(element))}>" if macro else quote(variable or "", 60)
                self.error(
                    f"{what} is to be replaced by xacro: this is the source of a URDF file",
                    element,
                    "",
                    "run xacro first: xacro FILE > robot.urdf",
                )
                return True
        return False

    def read(self, root: Element) -> None:
        self.builder.name = (root.get("name") or "").strip()
        elements: dict[str, list[Element]] = {name: [] for name in _ROBOT_ELEMENTS}
        passed: Counter[str] = Counter()
        for child in iterate_children(root):
            name = get_tag(child)
            if name in elements:
                elements[name].append(child)
            elif near := suggest_known_key(name, _ROBOT_ELEMENTS):
                self.warning(f"unknown element <{label(name)}>; ignored", child, "", f"write <{near[0]}>", tuple(near))
            else:
                passed[name] += 1
        if passed:
            others = ", ".join(f"{count} <{label(name)}>" for name, count in list(passed.items())[:8])
            self.builder.add_problem(Severity.NOTE, f"ignored, not geometry: {others}", self.locate(root, ""))
        if len(elements["link"]) > MAX_LINKS:
            self.error(f"the file has more than {MAX_LINKS} links", root, "", "split it into several models")
            return
        for element in elements["link"]:
            self.record_link(element)
        for element in elements["joint"]:
            self.record_type(element)
        for element in elements["joint"]:
            self.read_joint(element)
        self.check_mimics()
        self.report_unsupported(elements["joint"])
        order = self.sort_links(root)
        materials = read_materials(self, elements["material"])
        bodies = {name: self.read_link(name, self.links[name], materials) for name in order}
        if not self.has_errors:
            self.add_joints(bodies)

    def is_valid_name(self, name: str, element: Element, place: str) -> bool:
        """Return whether a name is valid in a model; otherwise report an error."""
        fault = names.find_problem(name)
        if name in names.RESERVED_BODIES and get_tag(element) == "link":
            fault = "this name is reserved for the server's world frames"
        if fault:
            self.error(f"{place}: {fault}", element, place, "rename it, here and wherever it is used")
            self.has_errors = True
        return not fault

    def is_unique(self, name: str, first: Element | None, element: Element, place: str) -> bool:
        if first is not None:
            self.error(
                f"{place} is defined twice (first on line {get_line(first)})", element, place, "rename one of the two"
            )
            self.has_errors = True
        return first is None

    def record_link(self, element: Element) -> None:
        name = (element.get("name") or "").strip()
        place = f"link {label(name)}"
        if self.is_valid_name(name, element, place) and self.is_unique(name, self.links.get(name), element, place):
            self.links[name] = element

    def read_joint(self, element: Element) -> None:
        name = (element.get("name") or "").strip()
        place = f"joint {label(name)}"
        if not self.is_valid_name(name, element, place):
            return
        first = self.joints.get(name)
        if not self.is_unique(name, None if first is None else first.element, element, place):
            return
        parts = self.read_parts(element, _JOINT_ELEMENTS, place)
        ends = [self.read_end(element, parts, key, place) for key in ("parent", "child")]
        pose = self.read_origin(parts.get("origin"), place)
        joint = self.read_motion(element, parts, place)
        if ends[0] is None or ends[1] is None or pose is None or joint is None:
            self.has_errors = True
            return
        self.joints[name] = _ParsedJoint(name, ends[0], ends[1], pose, joint, element)

    def read_end(self, element: Element, parts: dict[str, Element], key: str, place: str) -> str | None:
        """Read the link that a joint names as its parent or child."""
        if key not in parts:
            self.error(f"<{key}> is missing", element, place, f'add <{key} link="..."/>')
            return None
        name = self.read_text(parts[key], "link", place)
        if name is None or name in self.links:
            return name
        other = parts.get("parent" if key == "child" else "child")
        taken = "" if other is None else (other.get("link") or "").strip()
        near = self.suggest(name, [link for link in self.links if link != taken])
        self.error(
            f"{key} names link {quote(name)}, which does not exist",
            parts[key],
            place,
            f"write {near[0]}" if near else "name a link of this file",
            near,
        )
        return None

    def check_mimics(self) -> None:
        """Report cycles of joints that follow one another."""

        def find_leader(name: str) -> str | None:
            mimic = self.joints[name].joint.mimic if name in self.joints else None
            return None if mimic is None else mimic.joint

        for cycle in find_cycles(self.joints, find_leader):
            self.error(
                f"joints follow one another in a cycle: {' follows '.join(map(label, cycle))}",
                self.joints[cycle[-1]].element,
                f"joint {label(cycle[-1])}",
                "one of them must follow none: remove its <mimic>",
            )
            self.has_errors = True

    def sort_links(self, root: Element) -> list[str]:
        """Return the links, root first; report an error if they are not a tree with one root."""
        by_child: dict[str, _ParsedJoint] = {}
        for joint in self.joints.values():
            first = by_child.setdefault(joint.child, joint)
            if first is not joint:
                self.error(
                    f"link {label(joint.child)} has two parents: {label(first.parent)} by joint {label(first.name)} "
                    f"(line {get_line(first.element)}), and {label(joint.parent)} by joint {label(joint.name)}",
                    joint.element,
                    f"joint {label(joint.name)}",
                    "a link is the child of one joint; URDF has no closed loops",
                )
                self.has_errors = True
        if self.has_errors:
            return list(self.links)
        if not self.links:
            self.error("there is no link", root, "", 'add <link name="..."/>')
            self.has_errors = True
            return []
        for cycle in find_cycles(self.links, lambda link: by_child[link].parent if link in by_child else None):
            joint = by_child[cycle[-1]]
            self.error(
                f"links form a cycle: {' on '.join(map(label, cycle))}",
                joint.element,
                f"joint {label(joint.name)}",
                "one of them must have a parent outside the cycle, or none",
            )
            self.has_errors = True
        tops = [name for name in self.links if name not in by_child]
        if len(tops) > 1:
            several = ", ".join(map(label, tops[:8])) + (f", ... ({len(tops)} in all)" if len(tops) > 8 else "")
            self.error(
                f"there are {len(tops)} root links: {several}",
                self.links[tops[1]],
                f"link {label(tops[1])}",
                "a robot is one tree: add a joint whose child each of them but one is",
            )
            self.has_errors = True
        return [*tops, *(name for name in self.links if name in by_child)]

    def read_link(self, name: str, element: Element, materials: dict[str, Material]) -> BodyBuilder:
        """Read a link as a body."""
        place = f"link {label(name)}"
        shapes: dict[str, list[Shape]] = {key: [] for key in _SHAPE_ELEMENTS}
        known: list[Element] = []
        for child in iterate_children(element):
            kind = get_tag(child)
            if kind not in _SHAPE_ELEMENTS:
                known.append(child)
            elif (shape := read_shape(self, child, materials, f"{place}, {kind}")) is not None:
                shapes[kind].append(shape)
        inertia = None
        for child in known:
            if get_tag(child) == "inertial":
                found = read_inertial(self, child, f"{place}, inertial")
                if inertia is not None:
                    self.error("<inertial> is given twice", child, place, "remove one of the two")
                inertia = None if found is None else found.matrix()
            elif near := suggest_known_key(get_tag(child), (*_LINK_ELEMENTS, *_SHAPE_ELEMENTS)):
                message = f"unknown element <{label(get_tag(child))}>; ignored"
                self.warning(message, child, place, f"write <{near[0]}>", tuple(near))
        body = self.builder.add_body(name, inertia=inertia, source=Location(self.file, get_line(element), place))
        body.visuals, body.collisions = tuple(shapes["visual"]), tuple(shapes["collision"])
        return body.add_frame(ORIGIN, source=body.source)

    def add_joints(self, bodies: dict[str, BodyBuilder]) -> None:
        """Add the joints as constraints, each with a frame of its own on the parent."""
        for joint in self.joints.values():
            source = self.locate(joint.element, f"joint {label(joint.name)}")
            mount = joint.name if joint.name != ORIGIN else f"{ORIGIN}_"
            bodies[joint.parent].add_frame(mount, source=source)
            self.builder.add_constraint(
                joint.name,
                names.join(joint.parent, mount),
                names.join(joint.child, ORIGIN),
                joint.pose,
                joint=joint.joint,
                source=source,
            )

    def record_type(self, element: Element) -> None:
        """Record the type of a joint, for joints that follow it."""
        kind = _JOINT_TYPES.get((element.get("type") or "").strip())
        if kind is not None:
            self.types.setdefault((element.get("name") or "").strip(), kind)

    def suggest(self, name: str, known: Iterable[str]) -> Suggestion:
        """Return the known name that an unknown one misspells."""
        self.suggestion_count += 1
        return suggest_name(name, known) if self.suggestion_count <= MAX_SUGGESTIONS else Suggestion()

    def read_motion(self, element: Element, parts: dict[str, Element], place: str) -> Joint | None:
        """Read the motion of a joint; None, with an error, if it is wrong."""
        name = self.read_text(element, "type", place, f"add type, one of {', '.join(_JOINT_TYPES)}")
        if name is None:
            return None
        kind = _JOINT_TYPES.get(name)
        if kind is None:
            near = suggest_known_key(name, tuple(_JOINT_TYPES))
            self.error(
                f"type {quote(name)} is not known",
                element,
                place,
                f"write {near[0]}" if near else f"types are {', '.join(_JOINT_TYPES)}",
                near,
            )
            return None
        if kind is JointType.FIXED:
            return FIXED
        axis = (
            [1.0, 0.0, 0.0]
            if "axis" not in parts
            else self.read_numbers(parts["axis"], "xyz", 3, place, (1.0, 0.0, 0.0))
        )
        limits = self.read_limits(element, name, parts.get("limit"), place)
        mimic = self.read_mimic(parts.get("mimic"), kind, place)
        if axis is None or limits is None:
            return None
        lower, upper, rate = limits
        try:
            return Joint(kind, (axis[0], axis[1], axis[2]), lower, upper, rate, mimic=mimic)
        except ValueError as error:
            where = parts.get("axis" if "axis" in str(error) else "limit", element)
            self.error(str(error), where, place, "write <axis> as a direction, and <limit> with lower below upper")
            return None

    def read_limits(
        self, element: Element, name: str, limit: Element | None, place: str
    ) -> tuple[Coordinates, Coordinates, Coordinates] | None:
        """Read the lower, upper and rate limits of a joint, each empty for none."""
        bounded = name in ("revolute", "prismatic")
        if limit is None:
            if bounded:
                more = ', or write type="continuous"' if name == "revolute" else ""
                fix = f'add <limit lower="..." upper="..." effort="..." velocity="..."/>{more}'
                self.error(f"a {name} joint needs a <limit>", element, place, fix)
            return None if bounded else ((), (), ())
        if name in ("planar", "floating"):
            self.builder.add_problem(
                Severity.NOTE,
                f"the limit of a {name} joint does not name a coordinate; ignored",
                self.locate(limit, place),
            )
            return (), (), ()
        rate = self.read_number(limit, "velocity", place, UNLIMITED)
        if not bounded:
            return None if rate is None else ((), (), _make_bound(abs(rate)))
        if limit.get("lower") is None and limit.get("upper") is None:
            self.warning(
                "the limit has neither lower nor upper, which are 0 then: the joint cannot move",
                limit,
                place,
                "write lower and upper" + (', or type="continuous"' if name == "revolute" else ""),
            )
        lower, upper = self.read_number(limit, "lower", place, 0.0), self.read_number(limit, "upper", place, 0.0)
        if lower is None or upper is None or rate is None:
            return None
        if lower <= -UNLIMITED and upper >= UNLIMITED:
            return (), (), _make_bound(abs(rate))
        lower, upper = (-math.inf if lower <= -UNLIMITED else lower), (math.inf if upper >= UNLIMITED else upper)
        return (lower,), (upper,), _make_bound(abs(rate))

    def read_mimic(self, element: Element | None, kind: JointType, place: str) -> Mimic | None:
        """Read the joint that a joint follows; None if there is none, or, with an error, if it is wrong."""
        if element is None:
            return None
        leader = self.read_text(element, "joint", place)
        factor, offset = (
            self.read_number(element, "multiplier", place, 1.0),
            self.read_number(element, "offset", place, 0.0),
        )
        if leader is None or factor is None or offset is None:
            return None
        if kind not in _SINGLE_COORDINATE:
            self.error(f"a {kind} joint has several coordinates and can follow none", element, place, "remove <mimic>")
            return None
        found = self.types.get(leader)
        if found is None:
            near = self.suggest(leader, self.types)
            self.error(
                f"mimic names joint {quote(leader)}, which does not exist",
                element,
                place,
                f"write {near[0]}" if near else "name a joint of this file",
                near,
            )
            return None
        if found not in _SINGLE_COORDINATE:
            self.error(
                f"mimic names joint {label(leader)}, which is {found}",
                element,
                place,
                "name a revolute, continuous or prismatic joint",
            )
            return None
        return Mimic(leader, factor, offset)

    def report_unsupported(self, joints: list[Element]) -> None:
        """Report once each feature of joints that a model does not support."""
        others: dict[str, list[Element]] = {}
        for joint in joints:
            for child in iterate_children(joint):
                if get_tag(child) == "limit" and child.get("effort") is not None:
                    others.setdefault("effort limits", []).append(child)
                elif get_tag(child) in ("dynamics", "safety_controller", "calibration"):
                    others.setdefault(f"<{get_tag(child)}>", []).append(child)
        for what, found in others.items():
            count = f"{len(found)} joint{'' if len(found) == 1 else 's'}"
            self.builder.add_problem(Severity.NOTE, f"{what} of {count} ignored", self.locate(found[0], ""))


def _make_bound(value: float) -> Coordinates:
    return () if value >= UNLIMITED else (value,)
