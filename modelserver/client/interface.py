"""What can be asked of a vehicle, whoever answers: the running service, or a mirror of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from modelserver.messages import Explanation, ManyPoses, MotionAnswer, Policy, PoseAnswer
from modelserver.spatial.transformation import Transformation


class PlatformClient(Protocol):
    """What `Platform` and `PlatformMirror` have in common: the questions. Say this where either will do.

    Times are microseconds since the Unix epoch, 0 for the latest. All raise NoServerError where the service is not
    heard, and the QueryError that says why there is no answer.
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
        """Return what `get_transformation` does, with the origin, the bounds and the flags beside it."""
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
        """Return the vehicle's pose in World:UTM, or with `inverse` the world's in the vehicle."""
        ...

    def get_history(self, start_utime: int, end_utime: int, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at an even rate; times not held are left out."""
        ...

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[int] | npt.NDArray[np.int64],
        *,
        fixed_frame: str = "",
        reference_at: int = 0,
        covariance: bool = True,
    ) -> list[ManyPoses]:
        """Return for each pair, of frame of interest and frame of reference, its poses at all the instants `at`."""
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
        """Return how `frame_of_interest` moves in `frame_of_reference`."""
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
        """Return what `get_pose` does, and each edge it rests on."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


if TYPE_CHECKING:
    from modelserver.client.mirror import PlatformMirror
    from modelserver.client.remote import Platform

    def _both(remote: Platform, mirror: PlatformMirror) -> tuple[PlatformClient, PlatformClient]:
        """Have the type checker see that each is one."""
        return remote, mirror
