"""The frames of a ROS bag (/tf and /tf_static) as geometry and joints.

A frame is a body with the frame `Origin`. A transform that stays as it is becomes a fixed constraint; one that moves is
a joint with six coordinates, which are the transform itself. So nothing is guessed about axes and zero positions: a
URDF has those. What a localization publishes (map or odom to the vehicle) is the pose, and no part of the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from modelserver.errors import RecordingError
from modelserver.geometry import Joint, JointType, Model, ModelBuilder, names
from modelserver.geometry.joint import Coordinates, coordinate_names
from modelserver.messages import JointSample
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from mstools.recordings.bags import read_stamp

TF_TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

WORLD_FRAMES: Final = ("map", "odom", "utm", "earth", "world")
"""Frames of REP-105, of navsat_transform and of simulators that are fixed in the world."""

ROUNDING: Final = 1e-6
"""Change of a transform, m and rad, that is rounding: a driver computes it again from single precision."""


class TfEdge(NamedTuple):
    """A transform: the pose of a frame in its parent as first seen, and whether it has moved since."""

    parent: str
    pose: Pose
    is_moving: bool = False


class TfTree:
    """The transforms of a bag, by the child's name; `conflicts` are frames that had two parents."""

    def __init__(self) -> None:
        self.edges: dict[str, TfEdge] = {}
        self.conflicts: set[str] = set()

    def add(self, message: Any) -> None:
        for child, parent, pose in filter(None, map(_read_transform, message.transforms)):
            known = self.edges.get(child)
            if known is None:
                self.edges[child] = TfEdge(parent, pose)
            elif known.parent != parent:
                self.conflicts.add(child)
                self.edges[child] = TfEdge(parent, pose)
            elif not known.is_moving and not pose.is_close(known.pose, ROUNDING, ROUNDING):
                self.edges[child] = known._replace(is_moving=True)

    def find_root(self) -> str:
        """Return the frame of the vehicle with the most frames below it. Raises RecordingError for none."""
        sizes: dict[str, int] = {}
        for child in self.edges:
            seen = {child}
            top = child
            while (edge := self.edges.get(top)) is not None and edge.parent not in seen:
                top = edge.parent
                seen.add(top)
            sizes[top] = sizes.get(top, 0) + 1
        if not sizes:
            raise RecordingError("the bag has no transforms between frames of the vehicle (/tf, /tf_static)")
        return max(sizes, key=lambda each: (sizes[each], each))

    def build_model(self, name: str) -> Model:
        """Return the geometry. Raises RecordingError, GeometryError."""
        root = self.find_root()
        builder = ModelBuilder(name)
        parents = (edge.parent for edge in self.edges.values())
        for frame in dict.fromkeys((root, *parents, *self.edges)):
            builder.add_body(frame).add_frame(names.ORIGIN)
        for child, edge in self.edges.items():
            ends = names.join(edge.parent, names.ORIGIN), names.join(child, names.ORIGIN)
            if edge.is_moving:
                joint = Joint(JointType.FLOATING, default=_to_coordinates(edge.pose))
                builder.add_constraint(_name_joint(child, edge), *ends, joint=joint)
            else:
                builder.add_constraint(_name_joint(child, edge), *ends, edge.pose)
        return builder.build()

    @property
    def has_joints(self) -> bool:
        return any(edge.is_moving for edge in self.edges.values())

    def read_joints(self, message: Any) -> Iterator[tuple[int, tuple[JointSample, ...]]]:
        """Yield the stamp, us, and the coordinates of each joint that a message moves."""
        for each in message.transforms:
            child, parent, pose = _read_transform(each) or ("", "", Pose.identity())
            edge = self.edges.get(child)
            if edge is not None and edge.is_moving and edge.parent == parent:
                coordinates = coordinate_names(_name_joint(child, edge), Joint(JointType.FLOATING))
                values = zip(coordinates, _to_coordinates(pose), strict=True)
                yield read_stamp(each), tuple([JointSample(name, value) for name, value in values])


def _name_joint(child: str, edge: TfEdge) -> str:
    return f"{edge.parent}_to_{child}"


def _to_coordinates(pose: Pose) -> Coordinates:
    return (*pose.xyz, *so3.logarithm(pose.wxyz))


def _read_transform(transform: Any) -> tuple[str, str, Pose] | None:
    """Return child, parent and pose of a transform; None for one that is no pose, or not within the vehicle."""
    parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
    if parent in WORLD_FRAMES or child in WORLD_FRAMES or not parent or parent == child:
        return None
    shift, turn = transform.transform.translation, transform.transform.rotation
    try:
        return child, parent, Pose((shift.x, shift.y, shift.z), (turn.w, turn.x, turn.y, turn.z))
    except ValueError:
        return None
