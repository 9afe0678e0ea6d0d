"""Where the sensors stand on the vehicle, taken from the geometry model alone."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.geometry.model import Model
from modelserver.spatial.pose import Pose


@dataclass(frozen=True, slots=True)
class Mounts:
    """The poses of the sensor frames in the base frame: x forward, y left, z up.

    Of the antenna only the position counts: the phase centre.
    """

    X_base_imu: Pose
    X_base_antenna: Pose

    @classmethod
    def from_model(cls, model: Model, base_frame: str, gps_frame: str, imu_frame: str) -> Mounts:
        """Look the mounts up; names are full, `Body:Frame`.

        Raises UnknownBodyError, UnknownFrameError or NotConnectedError.
        """
        return cls(
            X_base_imu=model.get_transformation(imu_frame, base_frame).pose,
            X_base_antenna=model.get_transformation(gps_frame, base_frame).pose,
        )
