"""What localization says."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from modelserver.messages.flags import NAN, NO_FLAGS, VALID, Invalid, Quality
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of World:UTM: grid coordinates in a pinned zone, ellipsoidal height, metres.

    `origin_id` names it; it changes with any of the numbers.
    """

    easting: float
    northing: float
    height: float
    zone: int
    north: bool
    origin_id: int

    @property
    def initial_utm(self) -> Vector3:
        """Grid easting, grid northing, height above the ellipsoid, metres."""
        return (self.easting, self.northing, self.height)


class MotionCovariance(Protocol):
    """Works out the covariance of a motion when it is called: 36 numbers of velocity and rate, row-major.

    What a journal keeps of it are its fields, so it is a declared value, not a function.
    """

    def __call__(self) -> tuple[float, ...]:
        """Return the numbers: the same each time."""
        ...


class VehicleMotion(NamedTuple):
    """How the vehicle moves relative to the ground, along the axes of the frame that an estimate is of.

    `velocity` (m/s) is that of its origin, `rate` (rad/s) its angular velocity. `acceleration` (m/s2) is that of the
    point `felt_at` (m, from the frame's origin), where the inertial unit is; nan where nobody felt any. `covariance`
    works out the 36 numbers of velocity and rate when it is called; None: not known.
    """

    velocity: Vector3
    rate: Vector3
    acceleration: Vector3 = (NAN, NAN, NAN)
    felt_at: Vector3 = (0.0, 0.0, 0.0)
    covariance: MotionCovariance | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The base frame at one instant.

    `odom` is its pose in Odom:Origin, `enu` in the tangent plane at the origin, `utm` in World:UTM; the last
    two are None before the origin is known. `covariance` is 36 numbers, row-major, of the world pose along
    east, north, up (of `utm` and `enu` alike: the convergence between their axes is below the noise that a
    covariance states). `odom_covariance` has grown since Odom began: as a random walk does where `odom_walks`, so that
    variances add up; else in proportion to time, so that sigmas do. `motion` is None where it is not known.
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
    horizontal_bound: float = NAN
    heading_bound: float = NAN
    seconds_to_limit: float = NAN
    motion: VehicleMotion | None = field(default=None, repr=False)
    odom_walks: bool = False
