"""Poses of all bodies and frames of a model in one frame, with joints where they were received. No viewer's library."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from modelserver.errors import QueryError
from modelserver.geometry.joint import Coordinates
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body
from modelserver.transforms.pose import Pose


class BodyPath(NamedTuple):
    """How a body is reached: the path to its first frame, the body's pose in that frame, and the coordinates passed."""

    path: KinematicPath
    from_frame: Pose
    coordinates: frozenset[str]


class FramePoses:
    """Compute where the bodies of a model are in `base_frame`; only those behind joints change."""

    def __init__(self, model: Model, base_frame: str):
        self._model = model
        found = {body.name: self._find_path(body, base_frame) for body in model.bodies}
        self.paths: dict[str, BodyPath] = {name: path for name, path in found.items() if path is not None}
        """The bodies that are joined to the base frame."""

    def _find_path(self, body: Body, base_frame: str) -> BodyPath | None:
        if not body.frames:
            return None
        first = body.frames[0]
        try:
            path = self._model.get_kinematic_path(first.full_name, base_frame)
        except QueryError:
            return None
        coordinates = frozenset(name for joint in path.joints for name in self._model.drives[joint.name].names)
        return BodyPath(path, first.pose.inverse(), coordinates)

    def compute_bodies(self, joints: Mapping[str, float], moved: Collection[str] | None = None) -> dict[str, Pose]:
        """Return the poses of the bodies by name; with `moved` only of those behind these coordinates."""
        return {
            name: each.path.compute_pose([self._get_position(joint.name, joints) for joint in each.path.joints])
            @ each.from_frame
            for name, each in self.paths.items()
            if moved is None or not each.coordinates.isdisjoint(moved)
        }

    def compute(self, joints: Mapping[str, float], moved: Collection[str] | None = None) -> dict[str, Pose]:
        """Return the poses of the frames by full name; with `moved` only of those behind these coordinates."""
        return {
            frame.full_name: pose @ frame.pose
            for name, pose in self.compute_bodies(joints, moved).items()
            for frame in self._model.body(name)
        }

    def _get_position(self, joint: str, joints: Mapping[str, float]) -> Coordinates:
        """Return a joint's position: received, else its default."""
        drive = self._model.drives[joint]
        leader = self._model.joints[drive.leader].joint
        found = tuple(
            [joints.get(name, default) for name, default in zip(drive.names, leader.default_position, strict=True)]
        )
        if drive.leader == joint:
            return found
        return tuple([drive.multiplier * value + drive.offset for value in found])
