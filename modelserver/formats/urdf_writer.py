"""Write a model as URDF, the inverse of `urdf_loader`.

Bodies become links, and the constraints of the spanning tree from the first body joints. URDF has no frames but links,
so every other frame becomes a link without mass, fixed to the link of its body. Two kinds of frames need none: `Origin`
at the body's origin, and the frame at the parent's origin that the reader creates for each joint.

A URDF joint moves the child link's own frame. If a movable joint ends at another frame of its body, the link of that
frame is the child, and the body's link is fixed to it. A joint that the spanning tree crosses backward is written with
the negative axis, and is followed by a fixed joint with the inverse of its pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from modelserver.formats.reading import ORIGIN
from modelserver.formats.urdf_loader import UNLIMITED
from modelserver.formats.writing import SavedModel, format_element, format_names, list_text_and_sigma_features
from modelserver.geometry import names
from modelserver.geometry.inertia import Rows, from_spatial_inertia
from modelserver.geometry.joint import FIXED, TYPES_WITH_AXIS, Joint, JointType
from modelserver.geometry.model import Model
from modelserver.geometry.shape import DIMENSIONS, Material, Shape, ShapeKind
from modelserver.geometry.topology import Crossing, Topology
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose


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


def _format_inertial(inertia: Rows | None) -> Iterator[str]:
    """Yield the inertial of a body, along the axes of its link; nothing if it is not that of a rigid body."""
    found = None if inertia is None else from_spatial_inertia(inertia)
    if found is None:
        return
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = found.about_center
    greatest = max(abs(value) for row in inertia or () for value in row)
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
            parts += _format_inertial(found.inertia)
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
    """Return the link in the file for each written frame of `model`, by full name."""
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
        joints = {crossing.constraint.name: crossing.constraint.joint for crossing in self.crossings.values()}
        movable = {name for name, joint in joints.items() if joint.is_movable and name not in self.fixed_joints}
        self.mimicked_joints = {
            name: joint.mimic.joint
            for name, joint in joints.items()
            if joint.mimic is not None and name in movable and joint.mimic.joint in movable
        }
        """The joint that each joint with a written <mimic> follows."""
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
        joint = (
            each.joint if each.name in self.mimicked_joints or each.joint.mimic is None else _remove_mimic(each.joint)
        )
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
        """Yield the features that are dropped, and the frames that become links."""
        model = self.model
        yield from list_text_and_sigma_features(model)
        inertias = [(body.name, body.inertia) for body in model.bodies if body.inertia is not None]
        if odd := [name for name, inertia in inertias if from_spatial_inertia(inertia) is None]:
            yield f"the inertia of {format_names(odd)}: not that of a rigid body with mass"
        if posed := [body.name for body in model.bodies if body.pose is not None]:
            yield f"the own transform of {format_names(posed)}"
        if self.fixed_joints:
            yield f"the motion of {format_names(self.fixed_joints)}; written as fixed at the default position"
        movable = {name: each.joint for name, each in model.joints.items() if name not in self.fixed_joints}
        if free := [n for n, joint in movable.items() if joint.mimic is not None and n not in self.mimicked_joints]:
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


def _remove_mimic(joint: Joint) -> Joint:
    return Joint(joint.type, joint.axis, joint.lower, joint.upper, joint.rate_limit)


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
