"""Answers to queries: poses with their validity, motions, explanations and batches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.messages.estimates import Origin
from modelserver.messages.flags import NAN, NO_FLAGS, Quality
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from modelserver.transforms.transformation import Transformation


class PoseAnswer(NamedTuple):
    """A transformation with the other fields of pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_protection_level: float = NAN
    heading_protection_level: float = NAN
    seconds_to_limit: float = NAN


class MotionAnswer(NamedTuple):
    """Pose and motion of a frame relative to another one, along the axes of `expressed_in`.

    Velocity (m/s) and acceleration (m/s2) are those of the frame's origin, angular velocity and acceleration in rad/s
    and rad/s2; nan = not known. `covariance` is that of velocity and angular velocity (36 numbers, row-major), None =
    not known.
    """

    pose: PoseAnswer
    expressed_in: str
    velocity: Vector3
    angular_velocity: Vector3
    acceleration: Vector3
    angular_acceleration: Vector3
    covariance: tuple[float, ...] | None = None


class EdgeReport(NamedTuple):
    """One edge of the path between two frames, from the frame of reference on; see path_edge_t.

    `kind` is frame, constraint, joint or vehicle; `ends` its two names, traversed from the first to the second if
    `forward`; `pose` that of the far end in the near one, as traversed. `provenance` is fixed, measured, interpolated,
    held, predicted or default; `stamp` the utime of its newest measurement, 0 = none, `age` its age in seconds.
    `position_share` and `rotation_share` are its parts of the variance, 0 to 1, nan = no sigma is stated. `warning` is
    empty where nothing is wrong.
    """

    kind: str
    name: str
    forward: bool
    ends: tuple[str, str]
    pose: Pose
    provenance: str
    stamp: int = 0
    age: float = NAN
    source: str = ""
    coordinates: tuple[float, ...] = ()
    position_share: float = NAN
    rotation_share: float = NAN
    warning: str = ""


class Explanation(NamedTuple):
    """A pose with the edges of the path that it was computed along."""

    answer: PoseAnswer
    edges: tuple[EdgeReport, ...]


class PoseBatch(NamedTuple):
    """Poses of one pair of frames at n instants; see get_transformations_reply_t.

    `vectors` (n, 7) are state vectors, nan where `status` is not OK; `covariances` (n, 36), None = not requested or not
    known. `origin` is that of World:UTM, None where no such frame is involved.
    """

    frame_of_interest: str
    frame_of_reference: str
    utimes: npt.NDArray[np.int64]
    vectors: Array
    status: npt.NDArray[np.int32]
    invalid: npt.NDArray[np.int32]
    quality: npt.NDArray[np.int32]
    epochs: npt.NDArray[np.int32]
    covariances: Array | None = None
    origin: Origin | None = None
    model_revision: str = ""

    def slice_instants(self, first: int, end: int) -> PoseBatch:
        """Return the poses at the instants `first:end`."""
        return PoseBatch._make([each[first:end] if isinstance(each, np.ndarray) else each for each in self])
