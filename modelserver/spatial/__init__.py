"""Rotations, poses, named transformations and their covariances. Pure: no clock, socket or file."""

from modelserver.spatial.pose import Pose
from modelserver.spatial.transformation import Transformation

__all__ = ["Pose", "Transformation"]
