"""Transformation: a pose with its two frames, time, validity and covariance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from modelserver.errors import FrameMismatchError
from modelserver.transforms import covariance as cov
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

Numbers: TypeAlias = tuple[float, ...]


def _freeze_covariance(covariance: Array) -> Array:
    """Return a read-only copy (6, 6), which the caller's later changes do not reach."""
    copy = np.array(covariance, dtype=float)
    if copy.shape != (6, 6):
        raise ValueError(f"a covariance has shape (6, 6), got {copy.shape}")
    copy.flags.writeable = False
    return copy


class Transformation:
    """The pose of `frame_of_interest` in `frame_of_reference`: `X_RI` for interest I and reference R.

    Immutable; arrays returned are read-only.

    Parameters
    ----------
    frame_of_interest, frame_of_reference : names, `Body:Frame`
    pose : X_RI
    covariance : (6, 6) along the axes of the frame of reference, None where it is unknown, or a function that returns
        it, or its 36 numbers, at first access
    utime : microseconds since the Unix epoch, 0 for a relation that does not change with time
    invalid_reasons : bits of `modelserver.messages.Invalid`, 0 where it is valid
    pose_epoch, origin_id : 0 where no world frame is involved
    model_revision : revision of the geometry model
    """

    __slots__ = (
        "_covariance",
        "frame_of_interest",
        "frame_of_reference",
        "invalid_reasons",
        "model_revision",
        "origin_id",
        "pose",
        "pose_epoch",
        "utime",
    )

    frame_of_interest: str
    frame_of_reference: str
    pose: Pose
    utime: int
    invalid_reasons: int
    pose_epoch: int
    origin_id: int
    model_revision: str
    _covariance: Array | Numbers | Callable[[], Array | Numbers | None] | None

    def __init__(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        pose: Pose,
        covariance: Array | Callable[[], Array | Numbers | None] | None = None,
        utime: int = 0,
        invalid_reasons: int = 0,
        pose_epoch: int = 0,
        origin_id: int = 0,
        model_revision: str = "",
    ):
        if covariance is not None and not callable(covariance):
            covariance = _freeze_covariance(covariance)
        _put_interest(self, frame_of_interest)
        _put_reference(self, frame_of_reference)
        _put_pose(self, pose)
        _put_covariance(self, covariance)
        _put_utime(self, utime)
        _put_invalid(self, invalid_reasons)
        _put_epoch(self, pose_epoch)
        _put_origin(self, origin_id)
        _put_revision(self, model_revision)

    @property
    def covariance(self) -> Array | None:
        """The covariance (6, 6): x, y, z, about x, about y, about z, along the axes of the reference."""
        found = self._covariance
        if found is None or isinstance(found, np.ndarray):
            return found
        if callable(found):
            found = found()
        if isinstance(found, tuple):
            found = np.array(found).reshape(6, 6)
            found.flags.writeable = False
        elif found is not None:
            found = _freeze_covariance(found)
        _put_covariance(self, found)
        return found

    @property
    def covariance_numbers(self) -> Numbers | None:
        """The 36 numbers of `covariance`, row by row, as plain floats, without making an array where possible."""
        found = self._covariance
        if callable(found):
            found = found()
            if isinstance(found, np.ndarray):
                found = tuple(found.ravel().tolist())
            _put_covariance(self, found)
        return tuple(found.ravel().tolist()) if isinstance(found, np.ndarray) else found

    @property
    def is_valid(self) -> bool:
        """Whether there is no reason against using it."""
        return self.invalid_reasons == 0

    @property
    def matrix(self) -> Array:
        """The homogeneous transform (4, 4)."""
        return self.pose.matrix

    @property
    def position(self) -> Array:
        """The position (3) in meters."""
        return self.pose.position

    @property
    def quaternion(self) -> Array:
        """The unit quaternion (4), scalar first, w >= 0."""
        return self.pose.quaternion

    @property
    def xyzw(self) -> tuple[float, float, float, float]:
        """The unit quaternion x, y, z, w, scalar last, as in scipy and ROS."""
        return self.pose.xyzw

    def to_scipy(self) -> Any:
        """Return the rotation as a scipy.spatial.transform.Rotation. Raises ImportError without scipy."""
        return self.pose.to_scipy()

    @property
    def rotation(self) -> Array:
        """The rotation matrix (3, 3)."""
        return self.pose.rotation

    @property
    def rpy(self) -> Array:
        """Fixed-axis roll, pitch, yaw (3) in radians."""
        return self.pose.rpy

    @property
    def state_vector(self) -> Array:
        """The 7-vector `px py pz qs qx qy qz`."""
        return self.pose.state_vector

    def with_invalid_reasons(self, reasons: int) -> Transformation:
        """Return the same with more reasons against using it."""
        if not reasons & ~self.invalid_reasons:
            return self
        covariance = self.covariance if isinstance(self._covariance, tuple) else self._covariance
        found = Transformation(
            self.frame_of_interest, self.frame_of_reference, self.pose, covariance, *self._validity()
        )
        _put_invalid(found, self.invalid_reasons | reasons)
        return found

    def inverse(self) -> Transformation:
        """Return the pose of the frame of reference in the frame of interest."""

        def invert_covariance() -> Array | None:
            mine = self.covariance
            return None if mine is None else cov.invert(self.pose, mine)

        return Transformation(
            self.frame_of_reference, self.frame_of_interest, self.pose.inverse(), invert_covariance, *self._validity()
        )

    def __matmul__(self, other: Transformation) -> Transformation:
        """Return `X_AB @ X_BC = X_AC`, with covariances taken as independent.

        Raises FrameMismatchError where the frames in the middle differ, or where the two are of different times, pose
        epochs or origins.
        """
        if not isinstance(other, Transformation):
            return NotImplemented
        if self.frame_of_interest != other.frame_of_reference:
            raise FrameMismatchError(
                f"cannot chain: the left side ends at {self.frame_of_interest} but the right side starts at "
                f"{other.frame_of_reference}. Ask for the right side in {self.frame_of_interest}, or invert one."
            )
        for what, mine, theirs in (
            ("utime", self.utime, other.utime),
            ("pose_epoch", self.pose_epoch, other.pose_epoch),
            ("origin_id", self.origin_id, other.origin_id),
        ):
            if mine and theirs and mine != theirs:
                raise FrameMismatchError(
                    f"cannot chain: the left side has {what} {mine}, the right side {theirs}. Ask for both at one time."
                )

        def compose_covariance() -> Array | None:
            first, second = self.covariance, other.covariance
            if first is None or second is None:
                return None
            return cov.compose(self.pose, first, other.pose, second)

        return Transformation(
            other.frame_of_interest,
            self.frame_of_reference,
            self.pose @ other.pose,
            compose_covariance,
            self.utime or other.utime,
            self.invalid_reasons | other.invalid_reasons,
            self.pose_epoch or other.pose_epoch,
            self.origin_id or other.origin_id,
            self.model_revision if self.model_revision == other.model_revision else "",
        )

    def _validity(self) -> tuple[int, int, int, int, str]:
        return self.utime, self.invalid_reasons, self.pose_epoch, self.origin_id, self.model_revision

    def _values(self) -> tuple[object, ...]:
        numbers = None if self.covariance is None else self.covariance.tobytes()
        return self.frame_of_interest, self.frame_of_reference, self.pose, numbers, *self._validity()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Transformation) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash((self.frame_of_interest, self.frame_of_reference, self.pose, self.utime))

    def __reduce__(self) -> tuple[type[Transformation], tuple[object, ...]]:
        values = (self.frame_of_interest, self.frame_of_reference, self.pose, self.covariance, *self._validity())
        return Transformation, values

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a Transformation is immutable; make a new one")

    def __delattr__(self, name: str) -> None:
        raise AttributeError("a Transformation is immutable; make a new one")

    def __repr__(self) -> str:
        return f"<Transformation {self}>"

    def __str__(self) -> str:
        invalid = "" if self.is_valid else f" (invalid: reasons {self.invalid_reasons:#x})"
        return f"{self.frame_of_interest} in {self.frame_of_reference}: {self.pose}{invalid}"


# Setting a slot by its descriptor bypasses the guard above, at half the cost of object.__setattr__.
(
    _put_covariance, _put_interest, _put_reference, _put_invalid, _put_revision, _put_origin, _put_pose, _put_epoch,
    _put_utime,
) = (Transformation.__dict__[name].__set__ for name in Transformation.__slots__)  # fmt: skip
