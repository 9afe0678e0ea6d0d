"""The world frames, and the vehicle's pose in each: World:UTM and World:ENU (map frame of REP-105), Odom:Origin."""

from __future__ import annotations

from typing import Final

from modelserver.errors import NoPoseError, UnknownFrameError, find_nearest_names, quote
from modelserver.geometry import names
from modelserver.messages import Estimate
from modelserver.transforms.pose import Pose

WORLD_FRAMES: Final = frozenset({names.WORLD_UTM, names.WORLD_ENU, names.ODOM})


def is_absolute(frame: str) -> bool:
    """Return whether a frame is fixed to the earth."""
    return frame in (names.WORLD_UTM, names.WORLD_ENU)


def check_not_reserved(frame: str) -> None:
    """Raise UnknownFrameError for a frame of the bodies World and Odom that does not exist."""
    if frame.partition(":")[0] in names.RESERVED_BODIES:
        raise UnknownFrameError(
            f"there is no frame {quote(frame)}; the world frames are {', '.join(sorted(WORLD_FRAMES))}",
            find_nearest_names(frame, WORLD_FRAMES),
        )


def find_vehicle_pose(world: str, estimate: Estimate) -> Pose | None:
    """Return the rolling frame's pose in a world frame, None where it is unknown."""
    if world == names.WORLD_UTM:
        return estimate.utm
    return estimate.odom if world == names.ODOM else estimate.enu


def get_vehicle_pose(world: str, estimate: Estimate) -> Pose:
    """Return the rolling frame's pose in a world frame. Raises NoPoseError."""
    pose = find_vehicle_pose(world, estimate)
    if pose is None:
        raise NoPoseError(f"the vehicle's pose in {world} is not known yet: {estimate.invalid.explain()}")
    return pose
