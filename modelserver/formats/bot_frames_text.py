"""libbot2's coordinate frames: the block `coordinate_frames` of a parameter file, as `bot_frames` reads it.

- Each frame is a body, and the body's frame `Origin` is the frame itself.
- A frame is joined to the one it is `relative_to` by a constraint of its own name, whose pose is `initial_transform`.
- A frame with an `update_channel` or `pose_update_channel` is driven while the vehicle runs: its constraint is a
  floating joint, whose coordinates are the transform that those messages carry; it rests at `initial_transform`.

A transform takes what is seen in the frame to the frame it is relative to, so it is the pose of the one in the other:
`bot_frames_get_trans(from, to)` is `get_transformation(frame_of_interest=from, frame_of_reference=to)`. Of rotations
`rpy` is in degrees, about fixed axes, roll first; `rodrigues` is a rotation vector and `angleaxis` an angle before its
axis, in radians; `quat` is w, x, y, z. All as in libbot2's `bot_frames.c`, `param_util.c` and `rotations.c`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.errors import Location, Severity, Suggested, shown, suggestions
from modelserver.formats import bot_param, numbers
from modelserver.formats.bot_param import ParamBlock, Value
from modelserver.formats.circles import circles
from modelserver.formats.spelling import label, nearest_keys
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import FIXED, Joint, JointType
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion

ORIGIN = "Origin"

SUGGESTED = 50
"""Missing frames for which nearest names are looked up; a file with more wrong has another illness."""

_FRAME = ("relative_to", "history", "update_channel", "pose_update_channel", "initial_transform")
_ROTATIONS = {"quat": 4, "rpy": 3, "rodrigues": 3, "angleaxis": 4}
_UNITS = {"quat": "w, x, y, z", "rpy": "degrees", "rodrigues": "radians", "angleaxis": "radians, then the axis"}
_CHANNELS = ("update_channel", "pose_update_channel")


def load(content: bytes, builder: ModelBuilder, file: str) -> ModelBuilder:
    """Add the frames of a parameter file to `builder`, and what is wrong with them."""
    root = bot_param.parse(content, builder, file)
    if root is not None:
        _Reader(builder, file).read(root)
    return builder


@dataclass(slots=True)
class _Frame:
    name: str
    parent: str
    pose: Pose
    driven: bool
    source: Location
    parent_source: Location


class _Reader:
    def __init__(self, builder: ModelBuilder, file: str):
        self.builder = builder
        self.file = file
        self.frames: dict[str, _Frame] = {}
        self.broken = False

    def at(self, line: int, place: str) -> Location:
        return Location(self.file, line, place)

    def error(self, message: str, source: Location, fix: str, nearest: tuple[str, ...] = ()) -> None:
        self.builder.error(message, source, fix, nearest)
        self.broken = True

    def read(self, root: ParamBlock) -> None:
        for name, value in root.values():
            if name == "INCLUDE":
                files = ", ".join(value.texts[:5])
                self.builder.warning(
                    f"INCLUDE is not followed: {shown(files)}",
                    self.at(value.line, name),
                    "paste the included file's coordinate_frames into this one",
                )
        blocks = [block for name, block in root.blocks() if name == "coordinate_frames"]
        others = [name for name, _ in root.blocks() if name != "coordinate_frames"]
        if others:
            self.builder.problem(
                Severity.NOTE,
                f"{len(others)} other block{'' if len(others) == 1 else 's'} passed over: {', '.join(others[:5])}",
                self.at(root.line, ""),
            )
        if not blocks:
            self.error(
                "there is no block coordinate_frames", self.at(1, ""), "see docs/geometry-files.md for an example"
            )
            return
        top = self.root_of(blocks)
        if top is None:
            return
        for block in blocks:
            for name, entry in block.blocks():
                self.frame(name, entry, top)
        if not self.broken and self.parents_exist(top):
            self.join(top, blocks[0])

    def root_of(self, blocks: list[ParamBlock]) -> str | None:
        """Return the name of the root frame."""
        named = [value for block in blocks for name, value in block.values() if name == "root_frame"]
        for block in blocks:
            for name, value in block.values():
                if near := nearest_keys(name, ("root_frame",)) if name != "root_frame" else ():
                    place = self.at(value.line, "coordinate_frames")
                    self.builder.warning(f"unknown name {shown(name)}; passed over", place, f"write {near[0]}", near)
        if not named or not named[0].texts:
            self.error(
                "root_frame is missing", self.at(blocks[0].line, "coordinate_frames"), 'add root_frame = "local";'
            )
            return None
        if len(named) > 1:
            self.error(
                f"root_frame is given twice (first on line {named[0].line})",
                self.at(named[1].line, "coordinate_frames"),
                "remove one of the two",
            )
            return None
        top = named[0].texts[0]
        return top if self.is_sound(top, self.at(named[0].line, "root_frame")) else None

    def is_sound(self, name: str, source: Location) -> bool:
        fault = names.fault(name)
        if name in names.RESERVED_BODIES:
            fault = "the service keeps this name for its world frames"
        if fault:
            self.error(f"frame {shown(name)}: {fault}", source, "rename it, here and in relative_to")
        return not fault

    def frame(self, name: str, block: ParamBlock, top: str) -> None:
        """Take one frame."""
        place = f"frame {label(name)}"
        source = self.at(block.line, place)
        if not block.entries and name == top:
            return
        if not self.is_sound(name, source):
            return
        if name == top:
            self.error(
                f"{place} is the root frame and stands in no other",
                source,
                "leave its block empty, or name another root_frame",
            )
            return
        if name in self.frames:
            first = self.frames[name].source.line
            self.error(f"{place} is defined twice (first on line {first})", source, "rename one of the two")
            return
        fields = self.fields(block, _FRAME, place)
        parent, transform = fields.get("relative_to"), fields.get("initial_transform")
        if not isinstance(parent, Value) or len(parent.texts) != 1 or not parent.texts[0]:
            self.error("relative_to is missing", source, f'add relative_to = "{top}"; or the frame it stands in')
            return
        if not isinstance(transform, ParamBlock):
            fix = "add initial_transform { translation = [0, 0, 0]; rpy = [0, 0, 0]; }"
            self.error("initial_transform is missing", source, fix)
            return
        pose = self.transform(transform, f"{place}, initial_transform")
        channels = [fields[key] for key in _CHANNELS if key in fields]
        driven = any(isinstance(each, Value) and any(each.texts) for each in channels)
        if pose is not None:
            self.frames[name] = _Frame(
                name, parent.texts[0], pose, driven, source, self.at(parent.line, f"{place}, relative_to")
            )

    def fields(self, block: ParamBlock, known: tuple[str, ...], place: str) -> dict[str, Value | ParamBlock]:
        """Return the entries of a block by name; double ones are errors, unknown ones warnings."""
        found: dict[str, Value | ParamBlock] = {}
        for name, entry in block.entries:
            if name in found:
                first = found[name].line
                self.error(
                    f"{name} is given twice (first on line {first})",
                    self.at(entry.line, place),
                    "remove one of the two",
                )
            elif name in known:
                found[name] = entry
            else:
                near = nearest_keys(name, known)
                self.builder.warning(
                    f"unknown name {shown(name)}; passed over",
                    self.at(entry.line, place),
                    f"write {near[0]}" if near else f"known here: {', '.join(known)}",
                    near,
                )
        return found

    def transform(self, block: ParamBlock, place: str) -> Pose | None:
        fields = self.fields(block, ("translation", *_ROTATIONS), place)
        source = self.at(block.line, place)
        turns = [key for key in _ROTATIONS if key in fields]
        if len(turns) != 1:
            said = f"is given twice, as {turns[0]} and as {turns[1]}" if turns else "is missing"
            self.error(f"the rotation {said}", source, f"write one of {', '.join(_ROTATIONS)}")
            return None
        if "translation" not in fields:
            self.error("translation is missing", source, "add translation = [x, y, z]; in metres")
            return None
        position = self.numbers(fields["translation"], "translation", 3, "metres", place)
        values = self.numbers(fields[turns[0]], turns[0], _ROTATIONS[turns[0]], _UNITS[turns[0]], place)
        if position is None or values is None or not numbers.within_reach(position, self.builder, source):
            self.broken = True
            return None
        turned = self.rotation(turns[0], values, self.at(fields[turns[0]].line, place))
        if turned is None:
            self.broken = True
            return None
        return Pose(position, turned)

    def rotation(self, key: str, values: list[float], source: Location) -> Quaternion | None:
        if key == "quat":
            return numbers.quaternion(values, self.builder, source)
        if max(map(abs, values)) > numbers.GREATEST_LENGTH:
            self.error(f"{key} is out of reach", source, "look for a slip in the exponent")
            return None
        if key == "rpy":
            roll, pitch, yaw = map(math.radians, values)
            return so3.from_rpy(roll, pitch, yaw)
        if key == "rodrigues":
            return so3.exponential((values[0], values[1], values[2]))
        angle, x, y, z = values
        length = math.hypot(x, y, z)
        # libbot2 takes an axis of no length for no rotation
        scale = angle / length if length > 0.0 else 0.0
        return so3.exponential((x * scale, y * scale, z * scale))

    def numbers(self, entry: Value | ParamBlock, key: str, count: int, unit: str, place: str) -> list[float] | None:
        source = self.at(entry.line, place)
        fix = f"write {key} = [{', '.join(['number'] * count)}]; ({unit})"
        if isinstance(entry, ParamBlock):
            self.error(f"{key} is a block, not a list of {count} numbers", source, fix)
            return None
        try:
            found = [numbers.parse(text, f"{key}: ") for text in entry.texts]
            if len(found) != count:
                raise ValueError(f"{key} has {len(found)} number{'' if len(found) == 1 else 's'}, not {count}")
        except ValueError as error:
            self.error(str(error), source, fix)
            return None
        return found

    def parents_exist(self, top: str) -> bool:
        """Report frames that stand in none, and in one another."""
        suggested = 0
        for frame in self.frames.values():
            if frame.parent != top and frame.parent not in self.frames:
                suggested += 1
                near = suggestions(frame.parent, (top, *self.frames)) if suggested <= SUGGESTED else Suggested()
                self.error(
                    f"relative_to names frame {shown(frame.parent)}, which does not exist",
                    frame.parent_source,
                    f"write {near[0]}" if near else "name the root frame, or a frame of this file",
                    near,
                )
        if self.broken:
            return False
        for circle in circles(self.frames, lambda name: self.frames[name].parent if name in self.frames else None):
            self.error(
                f"frames go round in a circle: {' in '.join(map(label, circle))}",
                self.frames[circle[-1]].parent_source,
                f"one of them must be relative to the root frame {label(top)}, or to one that is",
            )
        return not self.broken

    def join(self, top: str, block: ParamBlock) -> None:
        """Make bodies of the frames, root first, and join them."""
        bodies = {top: self.builder.body(top, source=self.at(block.line, f"frame {label(top)}"))}
        for frame in self.frames.values():
            bodies[frame.name] = self.builder.body(frame.name, source=frame.source)
        for body in bodies.values():
            body.frame(ORIGIN, source=body.source)
        for frame in self.frames.values():
            mount = frame.name if frame.name != ORIGIN else f"{ORIGIN}_"
            bodies[frame.parent].frame(mount, source=frame.source)
            self.builder.constraint(
                frame.name,
                names.joined(frame.parent, mount),
                names.joined(frame.name, ORIGIN),
                Pose.identity() if frame.driven else frame.pose,
                joint=_floating(frame.pose) if frame.driven else FIXED,
                source=frame.source,
            )


def _floating(rest: Pose) -> Joint:
    """Return a joint that rests where a frame begins; its coordinates are the frame's whole transform."""
    if rest == Pose.identity():
        return Joint(JointType.FLOATING)
    return Joint(JointType.FLOATING, default=(*rest.xyz, *so3.logarithm(rest.wxyz)))
