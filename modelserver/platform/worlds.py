"""The world frames: which there are, and where an estimate puts the vehicle in each."""

from __future__ import annotations

from typing import Final

from modelserver.errors import NoPoseError, UnknownFrameError, nearest_names, shown
from modelserver.geometry import names
from modelserver.messages import Estimate
from modelserver.spatial.pose import Pose

WORLD_FRAMES: Final = frozenset({names.WORLD_UTM, names.WORLD_ENU, names.ODOM})


def is_absolute(frame: str) -> bool:
    """Return whether a frame is tied to the earth."""
    return frame in (names.WORLD_UTM, names.WORLD_ENU)


def check_not_reserved(frame: str) -> None:
    """Raise UnknownFrameError for a frame of the bodies World and Odom that there is not."""
    if frame.partition(":")[0] in names.RESERVED_BODIES:
        raise UnknownFrameError(
            f"there is no frame {shown(frame)}; the world frames are {', '.join(sorted(WORLD_FRAMES))}",
            nearest_names(frame, WORLD_FRAMES),
        )


def known_in(world: str, estimate: Estimate) -> Pose | None:
    """Return the rolling frame's pose in a world frame, None where it is not known."""
    if world == names.WORLD_UTM:
        return estimate.utm
    return estimate.odom if world == names.ODOM else estimate.enu


def pose_in(world: str, estimate: Estimate) -> Pose:
    """Return the rolling frame's pose in a world frame. Raises NoPoseError."""
    pose = known_in(world, estimate)
    if pose is None:
        raise NoPoseError(f"the vehicle's pose in {world} is not known yet: {estimate.invalid.explain()}")
    return pose
