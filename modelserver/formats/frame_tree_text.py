"""Writing a model as Miro frame-tree XML, the reverse of `frame_tree_xml`'s grouping.

A body's origin becomes the instance of the body's name, and each frame of it an instance that hangs there. Two
frames need none of their own: Origin at the body's origin, for which the body's instance stands; and the frame a
body is mounted on, where it has the body's name and the body sits on it squarely, for reading makes it again.
A body's parent is found by a breadth-first walk from the first body.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from modelserver.formats import losses
from modelserver.formats.frame_tree_xml import ORIGIN
from modelserver.formats.miro_text import escaped
from modelserver.formats.saved import Saved, plain, some
from modelserver.formats.yaml_text import degrees_of
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.topology import Crossing, Topology
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose


def save(model: Model) -> Saved:
    """Return the text of `model`, and what it has that this form cannot hold."""
    writer = _Writer(model)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<!DOCTYPE MiroConfigDocument>", "<config>"]
    lines += ['  <section name="Frames">', *writer.instances(), "  </section>", "</config>"]
    return Saved("\n".join(lines) + "\n", (*writer.renamings(), *_losses(model, writer.used)))


def instance_names(model: Model) -> dict[str, str]:
    """Return for each frame of `model`, by full name, the instance that stands for it in the file."""
    return _Writer(model).named


class _Writer:
    def __init__(self, model: Model):
        self.model = model
        self.came_by: dict[str, Crossing] = {}
        topology = Topology(model.bodies, model.constraints)
        for assembly in topology.assemblies:
            for _, crossing in topology.spread(assembly[0]):
                self.came_by[names.split(crossing.leaves)[0]] = crossing
        self.used = {crossing.constraint.name for crossing in self.came_by.values()}
        self.squarely = {body: self._squarely_on(body, crossing) for body, crossing in self.came_by.items()}
        """For each mounted body the frame it sits on, empty where it keeps an instance of its own."""
        self.bodies = self._body_names()
        self.named = self._instance_names()

    def _squarely_on(self, body: str, crossing: Crossing) -> str:
        mount = names.split(crossing.enters)[1]
        return crossing.enters if mount == body != ORIGIN and self._origin_in_mount(crossing) == Pose.identity() else ""

    def _origin_in_mount(self, crossing: Crossing) -> Pose:
        return crossing.pose @ self.model.frame(crossing.leaves).pose.inverse()

    def _body_names(self) -> dict[str, str]:
        """Return each body's instance: its own name, but that no child may be named as what stands for its parent."""
        taken = {body.name for body in self.model.bodies}
        return {name: _free(name, taken) if name == ORIGIN and name in self.came_by else name for name in tuple(taken)}

    def _instance_names(self) -> dict[str, str]:
        """Return for each frame, by full name, the instance that stands for it."""
        count = Counter(frame.name for body in self.model.bodies for frame in body)
        merged = set(self.squarely.values())
        named: dict[str, str] = {}
        taken = {ORIGIN, *self.bodies, *self.bodies.values()}
        for body in self.model.bodies:
            for frame in body:
                full = names.joined(body.name, frame.name)
                if frame.name == ORIGIN and frame.pose == Pose.identity():
                    named[full] = self.bodies[body.name]
                elif full in merged:
                    named[full] = frame.name
                else:
                    shared = count[frame.name] > 1 or frame.name in taken
                    named[full] = _free(f"{body.name}.{frame.name}" if shared else frame.name, taken)
        return named

    def instances(self) -> Iterator[str]:
        """Yield the lines of all instances, a body before its frames."""
        for body in self.model.bodies:
            own = self.bodies[body.name]
            crossing = self.came_by.get(body.name)
            if crossing is None:
                yield from _instance(own, "", body.pose or Pose.identity())
            elif not self.squarely[body.name]:
                yield from _instance(own, self.named[crossing.enters], self._origin_in_mount(crossing))
            for frame in body:
                name = self.named[names.joined(body.name, frame.name)]
                if name != own:
                    yield from _instance(name, own, frame.pose)

    def renamings(self) -> Iterator[str]:
        """Yield which frames get another name, and which bodies will not come back as bodies."""
        renamed = [
            f"{full} as {name}"
            for full, name in self.named.items()
            if name not in (names.split(full)[1], self.bodies[names.split(full)[0]])
        ]
        renamed += [f"body {name} as {own}" for name, own in self.bodies.items() if own != name]
        if renamed:
            yield f"frame names that are not unique in the whole model; written {some(renamed)}"
        carrying = {names.split(crossing.enters)[0] for crossing in self.came_by.values()}
        bare = [
            body.name
            for body in self.model.bodies
            if body.name in self.came_by
            and body.name not in carrying
            and all(self.named[names.joined(body.name, frame.name)] == self.bodies[body.name] for frame in body)
        ]
        if bare:
            yield f"that these are bodies, for nothing hangs on them: {some(bare)}"


def _losses(model: Model, used: set[str]) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    frames = [frame for body in model.bodies for frame in body]
    texts = [model.description, *(each.description for each in model.bodies), *(each.description for each in frames)]
    if described := sum(map(bool, (*texts, *(each.description for each in model.constraints)))):
        yield f"{described} descriptions"
    if sigmas := sum(each is not None for each in (*(f.sigma for f in frames), *(c.sigma for c in model.constraints))):
        yield f"{sigmas} sigmas"
    if heavy := [body.name for body in model.bodies if body.inertia is not None]:
        yield f"the inertia of {len(heavy)} bodies: {some(heavy)}"
    yield from losses.of_joints(model)
    yield from losses.of_shapes(model)
    if model.constraints:
        yield "the names of constraints, and on which of their frames bodies meet"
    if loops := [each.name for each in model.constraints if each.name not in used]:
        yield f"constraints that close a loop: {some(loops)}"
    mounted = {names.split(end)[0] for each in model.constraints for end in (each.from_, each.to)}
    if posed := [body.name for body in model.bodies if body.pose is not None and body.name in mounted]:
        yield f"the own transform of {some(posed)}"


def _free(name: str, taken: set[str]) -> str:
    """Return `name`, lengthened until nobody has it, and take it."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _instance(name: str, parent: str, pose: Pose) -> Iterator[str]:
    yield f'    <instance type="rapid::FrameRpyParameters" name="{escaped(name)}">'
    yield f'      <parameter value="{escaped(parent)}" name="Parent"/>'
    roll, pitch, yaw = degrees_of(pose.wxyz) or (math.degrees(angle) for angle in so3.to_rpy(pose.wxyz))
    for key, value in zip(("X", "Y", "Z"), pose.xyz, strict=True):
        yield f'      <parameter value="{plain(value)}" name="{key}"/>'
    for key, value in (("Roll", roll), ("Pitch", pitch), ("Yaw", yaw)):
        yield f'      <parameter value="{plain(value)}" name="{key}"/>'
    yield "    </instance>"
