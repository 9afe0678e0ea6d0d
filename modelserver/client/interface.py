"""The queries that `Platform` (asks the server) and `PlatformMirror` (answers from a local replica) share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from modelserver.messages import Explanation, MotionAnswer, Policy, PoseAnswer, PoseBatch
from modelserver.transforms.transformation import Transformation


class PlatformClient(Protocol):
    """Annotate a parameter with this where `Platform` or `PlatformMirror` will do.

    Times are microseconds since the Unix epoch, 0 for the latest. All methods raise NoServerError if the server does
    not answer, and a QueryError with the reason if there is no answer.
    """

    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`."""
        ...

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return the transformation with its origin, protection levels and quality flags."""
        ...

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first."""
        ...

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames."""
        ...

    def get_state_vector(
        self, *, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, through its 7-vector."""
        ...

    def get_h_transform(
        self, *, inverse: bool = False, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, with `inverse` the pose of World:UTM in the vehicle."""
        ...

    def get_history(self, start_utime: int, end_utime: int, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at a fixed rate; times outside the history are left out."""
        ...

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[int] | npt.NDArray[np.int64],
        *,
        fixed_frame: str = "",
        reference_at: int = 0,
        covariance: bool = True,
    ) -> list[PoseBatch]:
        """Return for each pair (frame of interest, frame of reference) its poses at all times `at`."""
        ...

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Return velocity and acceleration of `frame_of_interest` in `frame_of_reference`."""
        ...

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return the pose with the provenance and variance share of each edge on its path."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


if TYPE_CHECKING:
    from modelserver.client.mirror import PlatformMirror
    from modelserver.client.remote import Platform

    def _check_protocol(remote: Platform, mirror: PlatformMirror) -> tuple[PlatformClient, PlatformClient]:
        return remote, mirror
