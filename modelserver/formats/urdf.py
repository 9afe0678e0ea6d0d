"""URDF, read and written: `<robot>` with links and joints (wiki.ros.org/urdf/XML).

- A link is a body; the link's own frame is the body's frame `Origin`.
- A joint is a constraint with the joint's name, from a frame of the parent, also with the joint's name, at the parent's
  origin, to the child's `Origin`; its pose is the joint's <origin>. `continuous` is revolute without limits.
- An inertial is the 6x6 inertia of the body; visuals and collisions are stored, and their mesh files never opened.

The root link comes first, the others in the order of the file. Elements of simulators and controllers are ignored with
a note; a file that xacro has not processed is rejected.

The writer is the inverse. Bodies become links, and the constraints of the spanning tree from the first body joints.
URDF has no frames but links, so every other frame becomes a link without mass, fixed to the link of its body. Two kinds
of frames need none: `Origin` at the body's origin, and the frame at the parent's origin that the reader creates for
each joint.

A URDF joint moves the child link's own frame. If a movable joint ends at another frame of its body, the link of that
frame is the child, and the body's link is fixed to it. A joint that the spanning tree crosses backward is written with
the negative axis, and is followed by a fixed joint with the inverse of its pose.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from modelserver.errors import Suggestion, quote, suggest_name
from modelserver.formats.common import (
    MAX_POSITION,
    MAX_SUGGESTIONS,
    ElementReader,
    SavedModel,
    find_cycles,
    format_element,
    format_names,
    label,
    list_text_and_sigma_features,
    looks_like_degrees,
    suggest_known_key,
)
from modelserver.formats.xml_document import get_line, get_name, get_tag, iterate_children
from modelserver.geometry import names
from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.geometry.joint import FIXED, TYPES_WITH_AXIS, Coordinates, Joint, JointType, Mimic
from modelserver.geometry.model import Model
from modelserver.geometry.names import ORIGIN
from modelserver.geometry.parts import DIMENSIONS, Body, Material, RigidInertia, Shape, ShapeKind
from modelserver.geometry.topology import Crossing, Topology
from modelserver.transforms import so3
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
            self.read_joint(joint)
        _report_unsupported(elements["joint"])
        order = self.sort_links()
        materials = read_materials(elements["material"])
        bodies = {name: self.read_link(self.links[name], materials) for name in order}
        if not self.has_errors:
            self.add_joints(bodies)

    def reject(self, at: UrdfElement, message: str, fix: str, nearest: tuple[str, ...] = ()) -> None:
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
        if key not in parts:
            at.error(f"<{key}> is missing", f'add <{key} link="..."/>')
            return None
        name = parts[key].read_text("link")
        if name is None or name in self.links:
            return name
        other = parts.get("parent" if key == "child" else "child")
        taken = "" if other is None else other.get("link")
        self.suggestion_count += 1
        known = [link for link in self.links if link != taken]
        near = suggest_name(name, known) if self.suggestion_count <= MAX_SUGGESTIONS else Suggestion()
        fix = f"write {near[0]}" if near else "name a link of this file"
        parts[key].error(f"{key} names link {quote(name)}, which does not exist", fix, nearest=near)
        return None

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

    def read_motion(self, at: UrdfElement, parts: dict[str, UrdfElement]) -> Joint | None:
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
        mimic = _read_mimic(parts["mimic"], kind) if "mimic" in parts else None
        if axis is None or limits is None:
            return None
        try:
            return Joint(kind, (axis[0], axis[1], axis[2]), *limits, mimic=mimic)
        except ValueError as error:
            where = parts.get("axis" if "axis" in str(error) else "limit", at)
            where.error(str(error), "write <axis> as a direction, and <limit> with lower below upper")
            return None


def _read_mimic(at: UrdfElement, kind: JointType) -> Mimic | None:
    """Read the joint that a joint follows, which the builder checks; None, with an error, if it is wrong."""
    leader = at.read_text("joint")
    factor, offset = at.read_number("multiplier", 1.0), at.read_number("offset", 0.0)
    if leader is None or factor is None or offset is None:
        return None
    if kind not in _SINGLE_COORDINATE:
        at.error(f"a {kind} joint has several coordinates and can follow none", "remove <mimic>")
        return None
    return Mimic(leader, factor, offset)


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


_INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SHAPE_NAMES = tuple(str(kind) for kind in ShapeKind)


class UrdfElement(ElementReader):
    """An element: reads its attributes and children; a problem is reported at its line, and None returned."""

    def __init__(self, builder: ModelBuilder, file: str, element: Element, place: str = ""):
        super().__init__(builder, file, get_line(element), place)
        self.element = element
        self.tag = get_tag(element)
        self.name = get_name(element)

    def enter(self, element: Element, place: str) -> UrdfElement:
        return UrdfElement(self.builder, self.file, element, place)

    def children(self) -> Iterator[UrdfElement]:
        return (self.enter(child, self.place) for child in iterate_children(self.element))

    def get(self, key: str) -> str:
        return (self.element.get(key) or "").strip()

    def warn_unknown(self, known: tuple[str, ...]) -> bool:
        """Report an element whose name misspells a known one; return whether it does."""
        near = suggest_known_key(self.tag, known)
        if near:
            self.warning(f"unknown element <{label(self.tag)}>; ignored", f"write <{near[0]}>", nearest=tuple(near))
        return bool(near)

    def read_parts(self, known: tuple[str, ...], once: tuple[str, ...] = ()) -> dict[str, UrdfElement]:
        """Return the first child of each name in `known`; a second one is an error, a misspelled name a warning.

        A second one of a name in `once` is only a warning: no query depends on it.
        """
        found: dict[str, UrdfElement] = {}
        for child in self.children():
            if child.tag not in known:
                child.warn_unknown(known)
            elif child.tag not in found:
                found[child.tag] = child
            else:
                twice = f"<{child.tag}> is given twice (first on line {found[child.tag].line})"
                if child.tag in once:
                    child.warning(f"{twice}; the first is used", "remove one of the two")
                else:
                    child.error(twice, "remove one of the two")
        return found

    def read_numbers(self, key: str, count: int, default: Sequence[float] | None = None) -> list[float] | None:
        """Read the numbers of an attribute; `default` if it is absent, an error if there is no default."""
        fix = f'write {key}="{" ".join(["number"] * count)}"'
        text = self.element.get(key)
        if text is not None:
            return self.read_row(text.split(), count, key, fix)
        if default is None:
            self.error(f"<{self.tag}> has no {key}", fix)
        return None if default is None else list(default)

    def read_number(self, key: str, default: float | None = None) -> float | None:
        values = self.read_numbers(key, 1, None if default is None else (default,))
        return None if values is None else values[0]

    def read_text(self, key: str, fix: str = "") -> str | None:
        """Read the trimmed text of an attribute; an error if it is absent or empty."""
        value = self.get(key)
        if not value:
            self.error(f"<{self.tag}> has no {key}", fix or f'write {key}="..."')
        return value or None


def read_origin(parts: dict[str, UrdfElement]) -> Pose | None:
    """Read the pose of an <origin>, the identity for none; roll, pitch, yaw are in radians."""
    at = parts.get("origin")
    if at is None:
        return Pose.identity()
    for key in map(str, at.element.attrib):
        if key not in ("xyz", "rpy"):
            near = suggest_known_key(key, ("xyz", "rpy"))
            at.warning(f"<origin> has an unknown attribute {label(key)}; ignored", "use xyz, rpy", nearest=near)
    position = at.read_numbers("xyz", 3, (0.0, 0.0, 0.0))
    angles = at.read_numbers("rpy", 3, (0.0, 0.0, 0.0))
    if position is None or angles is None or not at.check_position(position):
        return None
    degrees = [angle for angle in angles if looks_like_degrees(angle)]
    if degrees:
        at.warning(
            f"rpy is in radians, and {degrees[0]:g} rad looks like degrees",
            f"write {math.radians(degrees[0]):.6g} if {degrees[0]:g} deg are meant",
        )
    return Pose.from_rpy(position, *angles)


def read_materials(elements: Sequence[UrdfElement]) -> dict[str, Material]:
    """Read the materials that a robot defines for its visuals, by name."""
    materials: dict[str, Material] = {}
    for at in elements:
        found = read_material(at, {})
        if found is not None and materials.setdefault(found.name, found) is not found:
            at.warning(f"material {label(found.name)} is defined twice; the first is used", "rename one")
    return materials


def read_material(at: UrdfElement, known: dict[str, Material]) -> Material | None:
    """Read a material; a name alone refers to the material of that name in `known`."""
    parts = at.read_parts(("color", "texture"))
    if not parts and at.name in known:
        return known[at.name]
    color = None
    if "color" in parts:
        values = parts["color"].read_numbers("rgba", 4)
        if values is None:
            return None
        color = (values[0], values[1], values[2], values[3])
    try:
        return Material(at.name, color, parts["texture"].get("filename") if "texture" in parts else "")
    except ValueError as error:
        at.warning(f"{error}; the material is ignored", 'write <material name="..."> with rgba')
        return None


def read_shape(at: UrdfElement, known: dict[str, Material]) -> Shape | None:
    """Read a visual or a collision; None, with a warning, without a known geometry."""
    parts = at.read_parts(("origin", "geometry", "material"), once=("material",))
    geometry = parts.get("geometry")
    if geometry is None:
        at.warning(f"<{at.tag}> has no <geometry>; ignored", "add <geometry> with a box or a mesh in it")
        return None
    pose = read_origin(parts)
    inside = list(geometry.children())
    if len(inside) != 1 or inside[0].tag not in _SHAPE_NAMES:
        name = inside[0].tag if inside else ""
        near = suggest_known_key(name, _SHAPE_NAMES)
        what = f"<geometry> holds {len(inside)} shapes, not 1"
        if len(inside) == 1:
            what = f"geometry {label(name)} is not known"
        fix = f"write <{near[0]}>" if near else f"shapes are {', '.join(_SHAPE_NAMES)}"
        geometry.warning(f"{what}; ignored", fix, nearest=tuple(near))
        return None
    (form,) = inside
    size, kind = _read_size(form), ShapeKind(form.tag)
    if size is None or pose is None:
        return None
    material = read_material(parts["material"], known) if "material" in parts else None
    try:
        return Shape(kind, tuple(size), pose, form.get("filename") if kind is ShapeKind.MESH else "", at.name, material)
    except ValueError as error:
        form.error(str(error), "correct it, or remove the shape: no query depends on it")
        return None


def _read_size(form: UrdfElement) -> list[float] | None:
    match ShapeKind(form.tag):
        case ShapeKind.BOX:
            return form.read_numbers("size", 3)
        case ShapeKind.MESH:
            return form.read_numbers("scale", 3, (1.0, 1.0, 1.0))
        case ShapeKind.SPHERE:
            return form.read_numbers("radius", 1)
    radius, length = form.read_number("radius"), form.read_number("length")
    return None if radius is None or length is None else [radius, length]


def read_inertial(at: UrdfElement) -> RigidInertia | None:
    """Read mass, center of mass and inertia; None, with a problem, if they are wrong or there is no mass."""
    parts = at.read_parts(("origin", "mass", "inertia"))
    pose = read_origin(parts)
    for key, fix in (
        ("mass", '<mass value="kilograms"/>'),
        ("inertia", '<inertia ixx="..." ixy="..." ixz="..." iyy="..." iyz="..." izz="..."/>'),
    ):
        if key not in parts:
            at.error(f"<inertial> has no <{key}>", f"add {fix}, or remove <inertial>")
    if "mass" not in parts or "inertia" not in parts:
        return None
    mass = parts["mass"].read_number("value")
    # off-diagonal moments are optional
    moments = [parts["inertia"].read_number(key, None if key[1] == key[2] else 0.0) for key in _INERTIA_KEYS]
    if mass is None or pose is None or any(each is None for each in moments):
        return None
    xx, xy, xz, yy, yz, zz = (each or 0.0 for each in moments)
    found = RigidInertia.from_moments(mass, pose, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    if max(abs(each) for row in found.matrix() for each in row) > MAX_POSITION**2:
        mass_text = parts["mass"].element.get("value") or ""
        at.error(f"the inertia is out of reach: {quote(mass_text)} kg", "look for a slip")
        return None
    fault = found.find_problem()
    if mass < 0.0:
        parts["mass"].error(fault, "look for a wrong sign, or remove <inertial> if it is not known")
        return None
    if fault and not mass > 0.0:
        parts["mass"].warning(f"{fault}; ignored", "remove <inertial> if it is not known")
        return None
    # what no body can have is an error of the model
    if fault and not found.find_error():
        parts["inertia"].warning(fault, "look for a wrong digit or a wrong unit (kg m2)")
    return found


def _format_material(material: Material, is_name_only: bool = False) -> Iterator[str]:
    inside: list[str] = []
    if material.color is not None and not is_name_only:
        inside += format_element("color", rgba=material.color)
    if material.texture and not is_name_only:
        inside += format_element("texture", filename=material.texture)
    return format_element("material", inside, name=material.name)


def _format_shape(key: str, shape: Shape, materials: dict[str, Material]) -> Iterator[str]:
    """Return a visual or a collision; a material defined for the robot is named only."""
    if shape.kind is ShapeKind.BOX:
        form = format_element("box", size=shape.size)
    elif shape.kind is not ShapeKind.MESH:
        form = format_element(str(shape.kind), **dict(zip(DIMENSIONS[shape.kind], shape.size, strict=True)))
    elif shape.size == (1.0, 1.0, 1.0):
        form = format_element("mesh", filename=shape.file)
    else:
        form = format_element("mesh", filename=shape.file, scale=shape.size)
    inside = [*_format_origin(shape.pose)] if shape.pose != Pose.identity() else []
    inside += format_element("geometry", form)
    if shape.material is not None:
        inside += _format_material(shape.material, materials.get(shape.material.name) == shape.material)
    return format_element(key, inside, **({"name": shape.name} if shape.name else {}))


def _format_inertial(body: Body) -> Iterator[str]:
    """Yield the inertial of a body, along the axes of its link; nothing if it is not that of a rigid body."""
    found = body.rigid_inertia
    if found is None:
        return
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = found.about_center
    greatest = max(abs(value) for row in body.inertia or () for value in row)
    x, y, z = (_round_off(value, max(map(abs, found.center))) for value in found.center)
    moments = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
    inside = [*_format_origin(Pose((x, y, z))), *format_element("mass", value=found.mass)]
    inside += format_element("inertia", **{key: _round_off(value, greatest) for key, value in moments.items()})
    yield from format_element("inertial", inside)


def _round_off(value: float, scale: float) -> float:
    """Remove the rounding error that a 6x6 matrix or a quaternion added to a number."""
    rounded = float(f"{value:.12g}")
    return rounded if abs(rounded - value) <= 4e-15 * scale else value


def _format_origin(pose: Pose) -> Iterator[str]:
    """Return the <origin> of a pose; its angles, in radians, read back to 1e-11 everywhere."""
    return format_element("origin", xyz=pose.xyz, rpy=[_round_off(each, 1.0) + 0.0 for each in so3.to_rpy(pose.wxyz)])


UNSPECIFIED_EFFORT = 1e9
"""Newtons or newton meters: the effort that URDF requires, and a model does not have."""


def save(model: Model) -> SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    writer = _UrdfWriter(model)
    materials: dict[str, Material] = {}
    for shape in (shape for body in model.bodies for shape in (*body.visuals, *body.collisions)):
        if shape.material is not None and (shape.material.color is not None or shape.material.texture):
            # of several with one name the first is defined for the robot
            materials.setdefault(shape.material.name, shape.material)
    inside = [line for material in materials.values() for line in _format_material(material)]
    for name, body in writer.links.items():
        parts: list[str] = []
        if body:
            found = model.body(body)
            parts += _format_inertial(found)
            for key, shapes in (("visual", found.visuals), ("collision", found.collisions)):
                parts += [line for shape in shapes for line in _format_shape(key, shape, materials)]
        inside += format_element("link", parts, name=name)
    inside += [line for joint in writer.joints for line in _format_joint(joint)]
    robot = "".join(each if each.isprintable() else " " for each in model.name).strip()
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', *format_element("robot", inside, name=robot)]
    unsupported = [*writer.list_unsupported()]
    if robot != model.name:
        unsupported.append("control characters in the model's name")
    return SavedModel("\n".join(lines) + "\n", tuple(unsupported))


def list_link_names(model: Model) -> dict[str, str]:
    return _UrdfWriter(model).link_names


class _WrittenJoint(NamedTuple):
    """A joint of the file."""

    name: str
    parent: str
    child: str
    pose: Pose
    joint: Joint = FIXED
    is_reversed: bool = False


class _UrdfWriter:
    def __init__(self, model: Model):
        self.model = model
        topology = Topology(model.bodies, model.constraints)
        root, *_ = topology.assemblies
        self.crossings = {each.far_body: each for each in topology.traverse_breadth_first(root[0])}
        self.bodies = [body for body in model.bodies if body.name in set(root)]
        self.links: dict[str, str] = {body.name: body.name for body in self.bodies}
        """Links to write, each with the body that it represents, empty for none."""
        self.joints: list[_WrittenJoint] = []
        self.joint_names = {crossing.constraint.name for crossing in self.crossings.values()}
        self.link_names: dict[str, str] = {}
        self.fixed_joints = [
            crossing.constraint.name for crossing in self.crossings.values() if not _is_movable_in_urdf(crossing)
        ]
        """Movable joints that are written as fixed."""
        movable = self.joint_names & {*model.joints} - {*self.fixed_joints}
        leaders = {name: mimic.joint for name in movable if (mimic := model.joints[name].joint.mimic) is not None}
        self.mimicking_joints = {name for name, leader in leaders.items() if leader in movable}
        """Joints that are written with a <mimic>."""
        for body in self.bodies:
            self.add_frame_links(body.name)
            if body.name in self.crossings:
                self.add_joint(body.name, self.crossings[body.name])
        order = {each.name: number for number, each in enumerate(model.constraints)}
        self.joints.sort(key=lambda joint: order.get(joint.name, len(order)))

    def add_frame_links(self, body: str) -> None:
        mounts = {
            crossing.near_frame: crossing.constraint.name
            for crossing in self.crossings.values()
            if crossing.near_body == body
        }
        between = self.find_intermediate_frame(body)
        for frame in self.model.body(body):
            full = names.join(body, frame.name)
            square = frame.pose == Pose.identity()
            made = frame.name == mounts.get(full) or (frame.name == f"{ORIGIN}_" and mounts.get(full) == ORIGIN)
            if square and (frame.name == ORIGIN or made):
                self.link_names[full] = body
                continue
            link = self.add_link(f"{body}.{frame.name}")
            self.link_names[full] = link
            if full != between:
                self.add_fixed_joint(f"{link}_joint", body, link, frame.pose)

    def find_intermediate_frame(self, body: str) -> str:
        """Return the frame whose link is between a body's parent and its own link, empty for none."""
        crossing = self.crossings.get(body)
        if crossing is None or not crossing.constraint.joint.is_movable or not _is_movable_in_urdf(crossing):
            return ""
        return "" if self.model.frame(crossing.far_frame).pose == Pose.identity() else crossing.far_frame

    def add_joint(self, body: str, crossing: Crossing) -> None:
        each = crossing.constraint
        parent = crossing.near_body
        mount = self.model.frame(crossing.near_frame).pose
        back = self.model.frame(crossing.far_frame).pose.inverse()
        if not each.joint.is_movable or not _is_movable_in_urdf(crossing):
            self.joints.append(_WrittenJoint(each.name, parent, body, mount @ crossing.pose @ back))
            return
        full = self.find_intermediate_frame(body)
        last = self.link_names[full] if full else body
        joint = each.joint
        if each.name not in self.mimicking_joints:
            joint = Joint(joint.type, joint.axis, joint.lower, joint.upper, joint.rate_limit)
        if crossing.forward:
            self.joints.append(_WrittenJoint(each.name, parent, last, mount @ each.pose, joint))
        else:
            # the reversed motion comes first, then the inverse of the fixed pose, which needs a link in between
            step = each.pose.inverse()
            moved = last
            if step != Pose.identity():
                moved = self.add_link(f"{each.name}.moved")
                self.add_fixed_joint(f"{moved}_joint", moved, last, step)
            self.joints.append(_WrittenJoint(each.name, parent, moved, mount, joint, is_reversed=True))
        if full:
            self.add_fixed_joint(f"{body}_joint", last, body, back)

    def add_link(self, name: str) -> str:
        """Add a link that is not a body; return its name, truncated to a valid length and made unique."""
        name = name[: names.MAX_LENGTH - 20]
        while name in self.links:
            name += "_"
        self.links[name] = ""
        return name

    def add_fixed_joint(self, name: str, parent: str, child: str, pose: Pose) -> None:
        while name in self.joint_names:
            name += "_"
        self.joint_names.add(name)
        self.joints.append(_WrittenJoint(name, parent, child, pose))

    def list_unsupported(self) -> Iterator[str]:
        model = self.model
        yield from list_text_and_sigma_features(model)
        if odd := [each.name for each in model.bodies if each.inertia is not None and each.rigid_inertia is None]:
            yield f"the inertia of {format_names(odd)}: not that of a rigid body with mass"
        if posed := [body.name for body in model.bodies if body.pose is not None]:
            yield f"the own transform of {format_names(posed)}"
        if self.fixed_joints:
            yield f"the motion of {format_names(self.fixed_joints)}; written as fixed at the default position"
        movable = {name: each.joint for name, each in model.joints.items() if name not in self.fixed_joints}
        if free := [n for n, joint in movable.items() if joint.mimic is not None and n not in self.mimicking_joints]:
            yield f"which joint {format_names(free)} follows"
        # the default of a joint that follows another is that of the other one
        if defaults := [name for name, joint in movable.items() if joint.default and joint.mimic is None]:
            yield f"the default position of {format_names(defaults)}"
        if uncertain := [name for name, joint in movable.items() if joint.sigma]:
            yield f"the sigma of the position of {format_names(uncertain)}"
        several = {name: joint for name, joint in movable.items() if joint.count > 1}
        if limited := [name for name, joint in several.items() if joint.lower or joint.upper or joint.rate_limit]:
            yield f"the limits of {format_names(limited)}, which has several coordinates"
        if frames := [f"{full} as {link}" for full, link in self.link_names.items() if not self.links[link]]:
            yield f"frames but as links of their own; written {format_names(frames)}"
        if dropped := [body.name for body in model.bodies if body.name not in self.links]:
            yield f"bodies that no constraints join to {model.root.name}: {format_names(dropped)}"
        used = {crossing.constraint.name for crossing in self.crossings.values()}
        inside = {body.name for body in self.bodies}
        unused = [each for each in model.constraints if each.name not in used]
        if loops := [each.name for each in unused if names.split(each.from_)[0] in inside]:
            yield f"constraints that close a loop: {format_names(loops)}"


def _is_movable_in_urdf(crossing: Crossing) -> bool:
    """Return whether URDF has such a joint: no ball joint, and reversed ones only with a single coordinate."""
    kind = crossing.constraint.joint.type
    if kind in (JointType.PLANAR, JointType.FLOATING):
        return crossing.forward
    return kind is not JointType.SPHERICAL


def _format_joint(written: _WrittenJoint) -> Iterator[str]:
    joint = written.joint
    low = max(joint.lower[0] if joint.lower else -math.inf, -UNLIMITED)
    high = min(joint.upper[0] if joint.upper else math.inf, UNLIMITED)
    bounded = joint.count == 1 and (low > -UNLIMITED or high < UNLIMITED)
    kind = "continuous" if joint.type is JointType.REVOLUTE and not bounded else str(joint.type)
    inside = [*_format_origin(written.pose)]
    for key, link in (("parent", written.parent), ("child", written.child)):
        inside += format_element(key, link=link)
    if joint.type in TYPES_WITH_AXIS:
        sign = -1.0 if written.is_reversed else 1.0
        inside += format_element("axis", xyz=[sign * value + 0.0 for value in joint.axis])
    if joint.count == 1:
        rate = min(joint.rate_limit[0], UNLIMITED) if joint.rate_limit else UNLIMITED
        if kind != "continuous":
            inside += format_element("limit", lower=low, upper=high, effort=UNSPECIFIED_EFFORT, velocity=rate)
        elif rate < UNLIMITED:
            inside += format_element("limit", effort=UNSPECIFIED_EFFORT, velocity=rate)
        if joint.mimic is not None:
            factors = {"multiplier": joint.mimic.multiplier, "offset": joint.mimic.offset}
            inside += format_element("mimic", joint=joint.mimic.joint, **factors)
    return format_element("joint", inside, name=written.name, type=kind)
