"""Rigid-body transforms: rotations, poses, transformations between named frames, and their covariances. Pure."""

from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation

__all__ = ["Pose", "Transformation"]
