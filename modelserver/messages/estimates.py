"""Results of localization."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from modelserver.earth import Origin as Origin
from modelserver.messages.flags import NAN, NO_FLAGS, VALID, Invalid, Quality
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3


class MotionCovariance(Protocol):
    """Computes the covariance of velocity and angular velocity (36 numbers, row-major) when called.

    A value with fields, not a function, so that the journal can store it.
    """

    def __call__(self) -> tuple[float, ...]: ...


class VehicleMotion(NamedTuple):
    """Motion of the vehicle relative to the ground, along the axes of the estimated frame.

    `velocity` (m/s) is that of the frame's origin, `angular_velocity` in rad/s. `acceleration` (m/s2) is that of the
    IMU at `imu_position` (m, from the frame's origin), with `acceleration_sigma` along each axis; nan = not known.
    `covariance` is None where it is not known.
    """

    velocity: Vector3
    angular_velocity: Vector3
    acceleration: Vector3 = (NAN, NAN, NAN)
    imu_position: Vector3 = (0.0, 0.0, 0.0)
    covariance: MotionCovariance | None = None
    acceleration_sigma: float = NAN


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Estimate of the base frame at one instant.

    `odom` is its pose in Odom:Origin, `enu` in the tangent plane at the origin, `utm` in World:UTM; the last two are
    None before the origin is known. `covariance` (36 numbers, row-major) is that of the world pose along east, north,
    up, for `utm` and `enu` alike: the meridian convergence between their axes is negligible in it. `odom_covariance`
    grows from the start of Odom: as a random walk (variances add) if `is_odom_random_walk`, else in proportion to time
    (sigmas add). `motion` is None where it is not known. Levels and risk: see `PoseAnswer`.
    """

    utime: int
    odom: Pose
    enu: Pose | None = None
    utm: Pose | None = None
    covariance: tuple[float, ...] | None = field(default=None, repr=False)
    odom_covariance: tuple[float, ...] | None = field(default=None, repr=False)
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS
    pose_epoch: int = 0
    origin: Origin | None = None
    horizontal_protection_level: float = NAN
    heading_protection_level: float = NAN
    seconds_to_limit: float = NAN
    motion: VehicleMotion | None = field(default=None, repr=False)
    is_odom_random_walk: bool = False
    horizontal_level: float = NAN
    heading_level: float = NAN
    limit_risk: float = NAN
    horizontal_allowance: float = NAN
