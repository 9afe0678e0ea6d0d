"""Write a model as Miro frame-tree XML, the inverse of the grouping in `frame_tree_loader`.

Each body becomes an instance at its origin, with the body's name, and each frame an instance below it. Two kinds of
frames have no instance of their own: `Origin` at the body's origin, which is the body's instance; and the frame at
which a body is mounted without an offset and with the body's name, because the reader creates it again. The parent of a
body is found by a breadth-first search from the first body.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from modelserver.formats.reading import ORIGIN
from modelserver.formats.writing import (
    SavedModel,
    format_element,
    format_names,
    list_inertia_features,
    list_joint_and_shape_features,
    list_text_and_sigma_features,
)
from modelserver.formats.yaml_writer import to_rpy_degrees
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.topology import Crossing, Topology
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose


def save(model: Model) -> SavedModel:
    """Return the text of `model`, and its features that this format does not support."""
    writer = _FrameTreeWriter(model)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<!DOCTYPE MiroConfigDocument>", "<config>"]
    lines += ['  <section name="Frames">', *writer.format_instances(), "  </section>", "</config>"]
    return SavedModel("\n".join(lines) + "\n", (*writer.list_renamed(), *_list_unsupported(model, writer.used)))


def list_instance_names(model: Model) -> dict[str, str]:
    """Return the instance in the file for each frame of `model`, by full name."""
    return _FrameTreeWriter(model).frame_names


class _FrameTreeWriter:
    def __init__(self, model: Model):
        self.model = model
        self.crossings: dict[str, Crossing] = {}
        topology = Topology(model.bodies, model.constraints)
        for assembly in topology.assemblies:
            self.crossings |= {each.far_body: each for each in topology.traverse_breadth_first(assembly[0])}
        self.used = {crossing.constraint.name for crossing in self.crossings.values()}
        self.aligned = {body: self._find_aligned_mount(body, crossing) for body, crossing in self.crossings.items()}
        """For each mounted body the frame that its instance represents too, empty for none."""
        self.bodies = self._name_bodies()
        self.frame_names = self._name_frames()

    def _find_aligned_mount(self, body: str, crossing: Crossing) -> str:
        mount = names.split(crossing.near_frame)[1]
        return (
            crossing.near_frame if mount == body != ORIGIN and self._locate_origin(crossing) == Pose.identity() else ""
        )

    def _locate_origin(self, crossing: Crossing) -> Pose:
        return crossing.pose @ self.model.frame(crossing.far_frame).pose.inverse()

    def _name_bodies(self) -> dict[str, str]:
        """Return the name of each body's instance: the body's, but a child is not named Origin."""
        taken = {body.name for body in self.model.bodies}
        return {
            name: _make_unique(name, taken) if name == ORIGIN and name in self.crossings else name
            for name in tuple(taken)
        }

    def _name_frames(self) -> dict[str, str]:
        """Return the name of the instance for each frame, by full name."""
        count = Counter(frame.name for body in self.model.bodies for frame in body)
        merged = set(self.aligned.values())
        named: dict[str, str] = {}
        taken = {ORIGIN, *self.bodies, *self.bodies.values()}
        for body in self.model.bodies:
            for frame in body:
                full = names.join(body.name, frame.name)
                if frame.name == ORIGIN and frame.pose == Pose.identity():
                    named[full] = self.bodies[body.name]
                elif full in merged:
                    named[full] = frame.name
                else:
                    shared = count[frame.name] > 1 or frame.name in taken
                    named[full] = _make_unique(f"{body.name}.{frame.name}" if shared else frame.name, taken)
        return named

    def format_instances(self) -> Iterator[str]:
        """Yield the lines of all instances, a body before its frames."""
        for body in self.model.bodies:
            own = self.bodies[body.name]
            crossing = self.crossings.get(body.name)
            if crossing is None:
                yield from _format_instance(own, "", body.pose or Pose.identity())
            elif not self.aligned[body.name]:
                yield from _format_instance(own, self.frame_names[crossing.near_frame], self._locate_origin(crossing))
            for frame in body:
                name = self.frame_names[names.join(body.name, frame.name)]
                if name != own:
                    yield from _format_instance(name, own, frame.pose)

    def list_renamed(self) -> Iterator[str]:
        """Yield the frames that get another name, and the bodies that are not read back as bodies."""
        renamed = [
            f"{full} as {name}"
            for full, name in self.frame_names.items()
            if name not in (names.split(full)[1], self.bodies[names.split(full)[0]])
        ]
        renamed += [f"body {name} as {own}" for name, own in self.bodies.items() if own != name]
        if renamed:
            yield f"frame names that are not unique in the whole model; written {format_names(renamed)}"
        parents = {crossing.near_body for crossing in self.crossings.values()}
        bare = [
            body.name
            for body in self.model.bodies
            if body.name in self.crossings
            and body.name not in parents
            and all(self.frame_names[names.join(body.name, frame.name)] == self.bodies[body.name] for frame in body)
        ]
        if bare:
            yield f"that these are bodies, because nothing is mounted on them: {format_names(bare)}"


def _list_unsupported(model: Model, used: set[str]) -> Iterator[str]:
    if model.name:
        yield f"the model's name, {model.name}"
    yield from list_text_and_sigma_features(model)
    yield from list_inertia_features(model)
    yield from list_joint_and_shape_features(model)
    if model.constraints:
        yield "the names of constraints, and on which of their frames bodies meet"
    if loops := [each.name for each in model.constraints if each.name not in used]:
        yield f"constraints that close a loop: {format_names(loops)}"
    mounted = {names.split(end)[0] for each in model.constraints for end in (each.from_, each.to)}
    if posed := [body.name for body in model.bodies if body.pose is not None and body.name in mounted]:
        yield f"the own transform of {format_names(posed)}"


def _make_unique(name: str, taken: set[str]) -> str:
    """Return `name`, lengthened until it is not in `taken`, and add it there."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _format_instance(name: str, parent: str, pose: Pose) -> Iterator[str]:
    angles = to_rpy_degrees(pose.wxyz) or tuple(map(math.degrees, so3.to_rpy(pose.wxyz)))
    values = zip(("X", "Y", "Z", "Roll", "Pitch", "Yaw"), (*pose.xyz, *angles), strict=True)
    inside = [*format_element("parameter", value=parent, name="Parent")]
    inside += [line for key, value in values for line in format_element("parameter", value=value, name=key)]
    lines = format_element("instance", inside, type="rapid::FrameRpyParameters", name=name)
    return (f"    {line}" for line in lines)
