"""Writing a model as URDF, the reverse of `urdf_xml`.

A body becomes a link, and a constraint on the tree from the first body a joint. URDF has no frames but links, so every
other frame becomes a link of its own, without mass, fixed to its body's; two need none: `Origin` at the body's origin,
and the frame at the parent's origin that reading makes for each joint. A joint of URDF moves the child link's own
frame: where a joint that moves ends at another frame of its body, that frame's link comes between, and the body's link
is fixed to it. A joint that the tree passes backwards turns the other way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from modelserver.formats.miro_text import escaped
from modelserver.formats.saved import Saved, plain, some
from modelserver.formats.urdf_joints import UNLIMITED
from modelserver.formats.urdf_losses import losses
from modelserver.formats.urdf_shapes_text import MaterialBook, inertial_lines, origin_line, shape_lines
from modelserver.formats.urdf_xml import ORIGIN
from modelserver.geometry import names
from modelserver.geometry.joint import FIXED, Joint, JointType
from modelserver.geometry.model import Model
from modelserver.geometry.topology import Crossing, Topology
from modelserver.spatial.pose import Pose

EFFORT = 1e9
"""Newtons or newton metres: what is written where URDF demands an effort, which a model does not hold."""


def save(model: Model) -> Saved:
    """Return the text of `model`, and what it has that this form cannot hold."""
    writer = _Writer(model)
    materials = MaterialBook(model)
    robot = "".join(each if each.isprintable() else " " for each in model.name).strip()
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<robot name="{escaped(robot)}">']
    lines += [f"  {line}" for line in materials.lines()]
    for name, body in writer.links.items():
        if not body:
            lines.append(f'  <link name="{escaped(name)}"/>')
            continue
        found = model.body(body)
        inside = [*inertial_lines(found.inertia)]
        for key, shapes in (("visual", found.visuals), ("collision", found.collisions)):
            inside += [line for shape in shapes for line in shape_lines(key, shape, materials)]
        head = f'<link name="{escaped(name)}"'
        lines += [f"  {head}>", *(f"    {line}" for line in inside), "  </link>"] if inside else [f"  {head}/>"]
    for joint in writer.joints:
        lines += [f"  {line}" for line in _joint_lines(joint)]
    lines.append("</robot>")
    lost = [*losses(model, writer.stiff, writer.led), *writer.changes()]
    if robot != model.name:
        lost.append("control characters in the model's name")
    return Saved("\n".join(lines) + "\n", tuple(lost))


def link_names(model: Model) -> dict[str, str]:
    """Return for each frame of `model` that is written, by full name, the link that stands for it in the file."""
    return _Writer(model).named


class _Written(NamedTuple):
    """A joint of the file."""

    name: str
    parent: str
    child: str
    pose: Pose
    joint: Joint = FIXED
    turned: bool = False


class _Writer:
    def __init__(self, model: Model):
        self.model = model
        topology = Topology(model.bodies, model.constraints)
        root, *_ = topology.assemblies
        self.came_by: dict[str, Crossing] = {}
        for _, crossing in topology.spread(root[0]):
            self.came_by[names.split(crossing.leaves)[0]] = crossing
        self.bodies = [body for body in model.bodies if body.name in set(root)]
        self.links: dict[str, str] = {body.name: body.name for body in self.bodies}
        """Links to write, each with the body that it is, empty where it is none."""
        self.joints: list[_Written] = []
        self.joint_names = {crossing.constraint.name for crossing in self.came_by.values()}
        self.named: dict[str, str] = {}
        self.stiff = [
            crossing.constraint.name for crossing in self.came_by.values() if not _is_written_moving(crossing)
        ]
        """Joints that move, written as fixed."""
        self.led = {
            crossing.constraint.name: crossing.constraint.joint.mimic.joint
            for crossing in self.came_by.values()
            if crossing.constraint.joint.mimic is not None
        }
        """Which joint each follows; without those that the file cannot say."""
        moving = {
            name
            for crossing in self.came_by.values()
            if (name := crossing.constraint.name) not in self.stiff and crossing.constraint.joint.moves
        }
        self.led = {name: leader for name, leader in self.led.items() if name in moving and leader in moving}
        for body in self.bodies:
            self.write_frames(body.name)
            if body.name in self.came_by:
                self.write_joint(body.name, self.came_by[body.name])
        order = {each.name: number for number, each in enumerate(model.constraints)}
        self.joints.sort(key=lambda joint: order.get(joint.name, len(order)))

    def write_frames(self, body: str) -> None:
        """Make links of a body's frames."""
        mounts = {
            crossing.enters: crossing.constraint.name
            for crossing in self.came_by.values()
            if names.split(crossing.enters)[0] == body
        }
        between = self.between(body)
        for frame in self.model.body(body):
            full = names.joined(body, frame.name)
            square = frame.pose == Pose.identity()
            made = frame.name == mounts.get(full) or (frame.name == f"{ORIGIN}_" and mounts.get(full) == ORIGIN)
            if square and (frame.name == ORIGIN or made):
                self.named[full] = body
                continue
            link = self.new_link(f"{body}.{frame.name}")
            self.named[full] = link
            if full != between:
                self.add(f"{link}_joint", body, link, frame.pose)

    def between(self, body: str) -> str:
        """Return the frame whose link comes between a body's parent and its own link; empty where none need to."""
        crossing = self.came_by.get(body)
        if crossing is None or not crossing.constraint.joint.moves or not _is_written_moving(crossing):
            return ""
        return "" if self.model.frame(crossing.leaves).pose == Pose.identity() else crossing.leaves

    def write_joint(self, body: str, crossing: Crossing) -> None:
        """Make the joint that carries a body."""
        each = crossing.constraint
        parent = names.split(crossing.enters)[0]
        mount = self.model.frame(crossing.enters).pose
        back = self.model.frame(crossing.leaves).pose.inverse()
        if not each.joint.moves or not _is_written_moving(crossing):
            self.joints.append(_Written(each.name, parent, body, mount @ crossing.pose @ back))
            return
        full = self.between(body)
        last = self.named[full] if full else body
        joint = each.joint if each.name in self.led or each.joint.mimic is None else _unled(each.joint)
        if crossing.forward:
            self.joints.append(_Written(each.name, parent, last, mount @ each.pose, joint))
        else:
            # backwards: first the motion undone, then the way back to the other frame, which needs a link between
            step = each.pose.inverse()
            moved = last
            if step != Pose.identity():
                moved = self.new_link(f"{each.name}.moved")
                self.add(f"{moved}_joint", moved, last, step)
            self.joints.append(_Written(each.name, parent, moved, mount, joint, turned=True))
        if full:
            self.add(f"{body}_joint", last, body, back)

    def new_link(self, name: str) -> str:
        """Return a link that is no body, `name` cut to what a name may be and lengthened until nobody has it."""
        name = name[: names.MAX_LENGTH - 20]
        while name in self.links:
            name += "_"
        self.links[name] = ""
        return name

    def add(self, name: str, parent: str, child: str, pose: Pose) -> None:
        """Add a fixed joint that no constraint stands for."""
        while name in self.joint_names:
            name += "_"
        self.joint_names.add(name)
        self.joints.append(_Written(name, parent, child, pose))

    def changes(self) -> Iterator[str]:
        """Yield which frames become links, and what is left out."""
        frames = [f"{full} as {link}" for full, link in self.named.items() if not self.links[link]]
        if frames:
            yield f"frames but as links of their own; written {some(frames)}"
        if gone := [body.name for body in self.model.bodies if body.name not in self.links]:
            yield f"bodies that no constraints join to {self.model.root.name}: {some(gone)}"
        used = {crossing.constraint.name for crossing in self.came_by.values()}
        inside = {body.name for body in self.bodies}
        if loops := [
            each.name
            for each in self.model.constraints
            if each.name not in used and names.split(each.from_)[0] in inside
        ]:
            yield f"constraints that close a loop: {some(loops)}"


def _is_written_moving(crossing: Crossing) -> bool:
    """Return whether URDF has what a joint needs: no ball joint, and only single coordinates the other way round."""
    kind = crossing.constraint.joint.type
    if kind in (JointType.PLANAR, JointType.FLOATING):
        return crossing.forward
    return kind is not JointType.SPHERICAL


def _unled(joint: Joint) -> Joint:
    return Joint(joint.type, joint.axis, joint.lower, joint.upper, joint.rate_limit)


def _joint_lines(written: _Written) -> Iterator[str]:
    joint = written.joint
    bounds = (joint.lower or (-math.inf,), joint.upper or (math.inf,))
    bounded = joint.count == 1 and (bounds[0][0] > -UNLIMITED or bounds[1][0] < UNLIMITED)
    kind = "continuous" if joint.type is JointType.REVOLUTE and not bounded else str(joint.type)
    yield f'<joint name="{escaped(written.name)}" type="{kind}">'
    yield f"  {origin_line(written.pose)}"
    yield f'  <parent link="{escaped(written.parent)}"/>'
    yield f'  <child link="{escaped(written.child)}"/>'
    if joint.type in (JointType.REVOLUTE, JointType.PRISMATIC, JointType.PLANAR):
        sign = -1.0 if written.turned else 1.0
        axis = " ".join(plain(sign * value + 0.0) for value in joint.axis)
        yield f'  <axis xyz="{axis}"/>'
    if joint.count == 1:
        rate = min(joint.rate_limit[0], UNLIMITED) if joint.rate_limit else UNLIMITED
        rest = f'effort="{plain(EFFORT)}" velocity="{plain(rate)}"'
        if kind != "continuous":
            low, high = max(bounds[0][0], -UNLIMITED), min(bounds[1][0], UNLIMITED)
            yield f'  <limit lower="{plain(low)}" upper="{plain(high)}" {rest}/>'
        elif rate < UNLIMITED:
            yield f"  <limit {rest}/>"
        if joint.mimic is not None:
            yield (
                f'  <mimic joint="{escaped(joint.mimic.joint)}" multiplier="{plain(joint.mimic.multiplier)}" '
                f'offset="{plain(joint.mimic.offset)}"/>'
            )
    yield "</joint>"
