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
from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from modelserver.errors import Suggestion, quote, suggest_name
from modelserver.formats.reading import MAX_SUGGESTIONS, ORIGIN, find_cycles, label, suggest_known_key
from modelserver.formats.urdf_elements import UrdfElement, read_inertial, read_materials, read_origin, read_shape
from modelserver.formats.xml_document import get_tag
from modelserver.geometry import names
from modelserver.geometry.builder import BodyBuilder, ModelBuilder
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
_LINK_ELEMENTS = ("inertial", "visual", "collision")
_JOINT_ELEMENTS = ("origin", "parent", "child", "axis", "limit", "mimic")


def load(root: Element, builder: ModelBuilder, file: str) -> None:
    """Add the links and joints below `root`, and their problems, to `builder`."""
    reader = _UrdfReader(UrdfElement(builder, file, root))
    if not reader.has_macros():
        reader.read()


class _ParsedJoint(NamedTuple):
    """A joint of the file."""

    name: str
    parent: str
    child: str
    pose: Pose
    joint: Joint
    at: UrdfElement


class _UrdfReader:
    def __init__(self, root: UrdfElement):
        self.root = root
        self.builder = root.builder
        self.types: dict[str, JointType] = {}
        """Types of joints, for joints that follow them."""
        self.suggestion_count = 0
        self.links: dict[str, UrdfElement] = {}
        self.joints: dict[str, _ParsedJoint] = {}
        self.has_errors = False

    def has_macros(self) -> bool:
        """Report the first expression that xacro would have replaced; return whether there is one."""
        # a name may hold anything; a $ in it is certainly a variable only if the file uses xacro
        at_work = any("xacro" in str(space) for space in self.root.element.nsmap.values())
        for element in self.root.element.iter("{*}*"):
            macro = "xacro" in str(element.tag).partition("}")[0]
            texts = [str(value) for key, value in element.items() if at_work or str(key) not in _NAME_ATTRIBUTES]
            variable = next((text for text in texts if "${" in text or "$(" in text), None)
            if macro or variable is not None:
                what = (
                    f"<xacro:{label(get_tag(element).removeprefix('xacro:'))}>" if macro else quote(variable or "", 60)
                )
                message = f"{what} is to be replaced by xacro: this is the source of a URDF file"
                self.root.enter(element, "").error(message, "run xacro first: xacro FILE > robot.urdf")
                return True
        return False

    def read(self) -> None:
        root = self.root
        self.builder.name = root.name
        elements: dict[str, list[UrdfElement]] = {name: [] for name in _ROBOT_ELEMENTS}
        passed: Counter[str] = Counter()
        for child in root.children():
            if child.tag in elements:
                child.place = child.tag if child.tag == "material" else f"{child.tag} {label(child.name)}"
                elements[child.tag].append(child)
            elif not child.warn_unknown(_ROBOT_ELEMENTS):
                passed[child.tag] += 1
        if passed:
            others = ", ".join(f"{count} <{label(name)}>" for name, count in list(passed.items())[:8])
            root.note(f"ignored, not geometry: {others}")
        if len(elements["link"]) > MAX_LINKS:
            root.error(f"the file has more than {MAX_LINKS} links", "split it into several models")
            return
        for link in elements["link"]:
            if self.is_valid_name(link, self.links.get(link.name)):
                self.links[link.name] = link
        for joint in elements["joint"]:
            if (kind := _JOINT_TYPES.get(joint.get("type"))) is not None:
                self.types.setdefault(joint.name, kind)
        for joint in elements["joint"]:
            self.read_joint(joint)
        self.check_mimics()
        _report_unsupported(elements["joint"])
        order = self.sort_links()
        materials = read_materials(elements["material"])
        bodies = {name: self.read_link(self.links[name], materials) for name in order}
        if not self.has_errors:
            self.add_joints(bodies)

    def reject(self, at: UrdfElement, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
        """Report an error in the tree of links and joints."""
        at.error(message, fix, nearest=nearest)
        self.has_errors = True

    def is_valid_name(self, at: UrdfElement, first: UrdfElement | None) -> bool:
        """Return whether the name of a link or joint is valid in a model and new; otherwise report an error."""
        fault = names.find_body_problem(at.name) if at.tag == "link" else names.find_problem(at.name)
        if fault:
            self.reject(at, f"{at.place}: {fault}", "rename it, here and wherever it is used")
        elif first is not None:
            self.reject(at, f"{at.place} is defined twice (first on line {first.line})", "rename one of the two")
        return not fault and first is None

    def read_joint(self, at: UrdfElement) -> None:
        first = self.joints.get(at.name)
        if not self.is_valid_name(at, None if first is None else first.at):
            return
        parts = at.read_parts(_JOINT_ELEMENTS)
        parent, child = (self.read_end(at, parts, key) for key in ("parent", "child"))
        pose = read_origin(parts)
        joint = self.read_motion(at, parts)
        if parent is None or child is None or pose is None or joint is None:
            self.has_errors = True
            return
        self.joints[at.name] = _ParsedJoint(at.name, parent, child, pose, joint, at)

    def read_end(self, at: UrdfElement, parts: dict[str, UrdfElement], key: str) -> str | None:
        """Read the link that a joint names as its parent or child."""
        if key not in parts:
            at.error(f"<{key}> is missing", f'add <{key} link="..."/>')
            return None
        name = parts[key].read_text("link")
        if name is None or name in self.links:
            return name
        other = parts.get("parent" if key == "child" else "child")
        taken = "" if other is None else other.get("link")
        near = self.suggest(name, [link for link in self.links if link != taken])
        fix = f"write {near[0]}" if near else "name a link of this file"
        parts[key].error(f"{key} names link {quote(name)}, which does not exist", fix, nearest=near)
        return None

    def check_mimics(self) -> None:
        """Report cycles of joints that follow one another."""

        def find_leader(name: str) -> str | None:
            mimic = self.joints[name].joint.mimic if name in self.joints else None
            return None if mimic is None else mimic.joint

        for cycle in find_cycles(self.joints, find_leader):
            message = f"joints follow one another in a cycle: {' follows '.join(map(label, cycle))}"
            self.reject(self.joints[cycle[-1]].at, message, "one of them must follow none: remove its <mimic>")

    def sort_links(self) -> list[str]:
        """Return the links, root first; report an error if they are not a tree with one root."""
        by_child: dict[str, _ParsedJoint] = {}
        for joint in self.joints.values():
            first = by_child.setdefault(joint.child, joint)
            if first is not joint:
                message = (
                    f"link {label(joint.child)} has two parents: {label(first.parent)} by joint {label(first.name)} "
                    f"(line {first.at.line}), and {label(joint.parent)} by joint {label(joint.name)}"
                )
                self.reject(joint.at, message, "a link is the child of one joint; URDF has no closed loops")
        if self.has_errors:
            return list(self.links)
        if not self.links:
            self.reject(self.root, "there is no link", 'add <link name="..."/>')
        for cycle in find_cycles(self.links, lambda link: by_child[link].parent if link in by_child else None):
            message = f"links form a cycle: {' on '.join(map(label, cycle))}"
            fix = "one of them must have a parent outside the cycle, or none"
            self.reject(by_child[cycle[-1]].at, message, fix)
        tops = [name for name in self.links if name not in by_child]
        if len(tops) > 1:
            several = ", ".join(map(label, tops[:8])) + (f", ... ({len(tops)} in all)" if len(tops) > 8 else "")
            fix = "a robot is one tree: add a joint whose child each of them but one is"
            self.reject(self.links[tops[1]], f"there are {len(tops)} root links: {several}", fix)
        return [*tops, *(name for name in self.links if name in by_child)]

    def read_link(self, at: UrdfElement, materials: dict[str, Material]) -> BodyBuilder:
        shapes: dict[str, list[Shape]] = {"visual": [], "collision": []}
        inertia = None
        for child in at.children():
            if child.tag in _LINK_ELEMENTS:
                child.place = f"{at.place}, {child.tag}"
            if child.tag == "inertial":
                found = read_inertial(child)
                if inertia is not None:
                    at.error("<inertial> is given twice", "remove one of the two", child.line)
                inertia = None if found is None else found.matrix()
            elif child.tag not in shapes:
                child.warn_unknown(_LINK_ELEMENTS)
            elif (shape := read_shape(child, materials)) is not None:
                shapes[child.tag].append(shape)
        body = self.builder.add_body(at.name, inertia=inertia, source=at.locate())
        body.visuals, body.collisions = tuple(shapes["visual"]), tuple(shapes["collision"])
        return body.add_frame(ORIGIN, source=body.source)

    def add_joints(self, bodies: dict[str, BodyBuilder]) -> None:
        """Add the joints as constraints, each with a frame of its own on the parent."""
        for name, parent, child, pose, joint, at in self.joints.values():
            mount = name if name != ORIGIN else f"{ORIGIN}_"
            bodies[parent].add_frame(mount, source=at.locate())
            ends = (names.join(parent, mount), names.join(child, ORIGIN))
            self.builder.add_constraint(name, *ends, pose, joint=joint, source=at.locate())

    def suggest(self, name: str, known: Iterable[str]) -> Suggestion:
        self.suggestion_count += 1
        return suggest_name(name, known) if self.suggestion_count <= MAX_SUGGESTIONS else Suggestion()

    def read_motion(self, at: UrdfElement, parts: dict[str, UrdfElement]) -> Joint | None:
        """Read the motion of a joint; None, with an error, if it is wrong."""
        name = at.read_text("type", f"add type, one of {', '.join(_JOINT_TYPES)}")
        if name is None:
            return None
        kind = _JOINT_TYPES.get(name)
        if kind is None:
            near = suggest_known_key(name, tuple(_JOINT_TYPES))
            fix = f"write {near[0]}" if near else f"types are {', '.join(_JOINT_TYPES)}"
            at.error(f"type {quote(name)} is not known", fix, nearest=near)
            return None
        if kind is JointType.FIXED:
            return FIXED
        x_axis = [1.0, 0.0, 0.0]
        axis = parts["axis"].read_numbers("xyz", 3, x_axis) if "axis" in parts else x_axis
        limits = _read_limits(at, name, parts.get("limit"))
        mimic = self.read_mimic(parts["mimic"], kind) if "mimic" in parts else None
        if axis is None or limits is None:
            return None
        try:
            return Joint(kind, (axis[0], axis[1], axis[2]), *limits, mimic=mimic)
        except ValueError as error:
            where = parts.get("axis" if "axis" in str(error) else "limit", at)
            where.error(str(error), "write <axis> as a direction, and <limit> with lower below upper")
            return None

    def read_mimic(self, at: UrdfElement, kind: JointType) -> Mimic | None:
        """Read the joint that a joint follows; None, with an error, if it is wrong."""
        leader = at.read_text("joint")
        factor, offset = at.read_number("multiplier", 1.0), at.read_number("offset", 0.0)
        if leader is None or factor is None or offset is None:
            return None
        found = self.types.get(leader)
        if kind not in _SINGLE_COORDINATE:
            at.error(f"a {kind} joint has several coordinates and can follow none", "remove <mimic>")
        elif found is None:
            near = self.suggest(leader, self.types)
            fix = f"write {near[0]}" if near else "name a joint of this file"
            at.error(f"mimic names joint {quote(leader)}, which does not exist", fix, nearest=near)
        elif found not in _SINGLE_COORDINATE:
            fix = "name a revolute, continuous or prismatic joint"
            at.error(f"mimic names joint {label(leader)}, which is {found}", fix)
        else:
            return Mimic(leader, factor, offset)
        return None


def _read_limits(
    joint: UrdfElement, name: str, limit: UrdfElement | None
) -> tuple[Coordinates, Coordinates, Coordinates] | None:
    """Read the lower, upper and rate limits of a joint, each empty for none."""
    bounded = name in ("revolute", "prismatic")
    if limit is None:
        if bounded:
            more = ', or write type="continuous"' if name == "revolute" else ""
            fix = f'add <limit lower="..." upper="..." effort="..." velocity="..."/>{more}'
            joint.error(f"a {name} joint needs a <limit>", fix)
        return None if bounded else ((), (), ())
    if name in ("planar", "floating"):
        limit.note(f"the limit of a {name} joint does not name a coordinate; ignored")
        return (), (), ()
    rate = limit.read_number("velocity", UNLIMITED)
    lower: float | None = -UNLIMITED
    upper: float | None = UNLIMITED
    if bounded:
        if limit.element.get("lower") is None and limit.element.get("upper") is None:
            fix = "write lower and upper" + (', or type="continuous"' if name == "revolute" else "")
            limit.warning("the limit has neither lower nor upper, which are 0 then: the joint cannot move", fix)
        lower, upper = limit.read_number("lower", 0.0), limit.read_number("upper", 0.0)
    if lower is None or upper is None or rate is None:
        return None
    rates: Coordinates = () if abs(rate) >= UNLIMITED else (abs(rate),)
    if lower <= -UNLIMITED and upper >= UNLIMITED:
        return (), (), rates
    return (-math.inf if lower <= -UNLIMITED else lower,), (math.inf if upper >= UNLIMITED else upper,), rates


def _report_unsupported(joints: list[UrdfElement]) -> None:
    """Report once each feature of joints that a model does not support."""
    others: defaultdict[str, list[UrdfElement]] = defaultdict(list)
    for child in (child for joint in joints for child in joint.children()):
        if child.tag == "limit" and child.element.get("effort") is not None:
            others["effort limits"].append(child)
        elif child.tag in ("dynamics", "safety_controller", "calibration"):
            others[f"<{child.tag}>"].append(child)
    for what, found in others.items():
        found[0].place = ""
        found[0].note(f"{what} of {len(found)} joint{'' if len(found) == 1 else 's'} ignored")
