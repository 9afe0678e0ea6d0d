"""Values that the generated messages are made of: flags with the numbers of the wire types, answers, estimates, and the
state of localization that persists across restarts. Values only; files: `server.persistence`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntFlag
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from modelserver.earth import Origin as Origin
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Quaternion, Vector3
from modelserver.transforms.transformation import Transformation

NAN = math.nan


class Invalid(IntFlag):
    """Reasons why a pose may not be used; 0 = it may."""

    NO_FIX = 1
    NO_IMU = 2
    NO_ORIGIN = 4
    NOT_MOVED_YET = 8
    STATIONARY_HEADING = 16
    STALE_GPS = 32
    STALE_IMU = 64
    GPS_REJECTED = 128
    LIMIT_EXCEEDED = 256
    CLOCK_STEPPED = 512
    TILTED = 1024
    STALE_JOINT = 2048
    JOINT_UNKNOWN = 4096
    GNSS_INCONSISTENT = 8192
    MISMOUNTED = 16384

    def explain(self) -> str:
        """Return the reasons in words; empty where there is none."""
        return "; ".join(_INVALID_TEXT[flag] for flag in Invalid if flag in self)


_INVALID_TEXT = {
    Invalid.NO_FIX: "no usable GPS fix yet",
    Invalid.NO_IMU: "no inertial sample yet",
    Invalid.NO_ORIGIN: "the origin is not set yet, still averaging fixes",
    Invalid.NOT_MOVED_YET: "heading is not known before the vehicle moves",
    Invalid.STATIONARY_HEADING: "stationary for too long, the heading has drifted",
    Invalid.STALE_GPS: "the last usable GPS fix is too old",
    Invalid.STALE_IMU: "the last usable inertial sample is too old",
    Invalid.GPS_REJECTED: "GPS fixes arrive but are rejected",
    Invalid.LIMIT_EXCEEDED: "the error may be beyond the limit: that is more probable than 0.01",
    Invalid.CLOCK_STEPPED: "the clock stepped, localization restarts at the new time",
    Invalid.TILTED: "gravity indicates a vehicle on its side: check the mount of the IMU in the geometry",
    Invalid.STALE_JOINT: "a joint on the path was silent around that time",
    Invalid.JOINT_UNKNOWN: "no sample of a joint on the path was received, and the geometry has no default for it",
    Invalid.GNSS_INCONSISTENT: "GPS fixes and the path driven contradict each other",
    Invalid.MISMOUNTED: "the IMU's accelerations do not fit the wheels: its mount, or the wheels' signs, are wrong",
}


class Quality(IntFlag):
    """Properties of a pose that is usable but limited."""

    HEADING_FROM_GYRO = 1
    PREDICTED = 2
    INTERPOLATED = 4
    HELD = 8
    CORRELATION_UNKNOWN = 16
    REVERSING = 32
    OUT_OF_LIMITS = 64
    JOINT_DEFAULT = 128
    LOOP = 256

    def explain(self) -> str:
        """Return the flags in words; empty where there is none."""
        return "; ".join(_QUALITY_TEXT[flag] for flag in Quality if flag in self)


_QUALITY_TEXT = {
    Quality.HEADING_FROM_GYRO: "heading is propagated by the gyro alone",
    Quality.PREDICTED: "predicted past the last sample",
    Quality.INTERPOLATED: "between two samples",
    Quality.HELD: "the last value known before",
    Quality.CORRELATION_UNKNOWN: "the covariance is an upper bound",
    Quality.REVERSING: "the vehicle is assumed to drive backwards",
    Quality.OUT_OF_LIMITS: "a joint on the path is beyond its limits",
    Quality.JOINT_DEFAULT: "no sample of a joint on the path was received; its position is assumed",
    Quality.LOOP: "the loop of constraints has another path; this is the shortest",
}


class Unmet(IntFlag):
    """What an answer lacks of the demand in its request; 0 = all that was asked for is met."""

    HORIZONTAL = 1
    HEADING = 2
    AGE = 4
    NOT_VALID = 8


STALE_SENSORS = Invalid.STALE_GPS | Invalid.STALE_IMU
"""Reasons that sensors which stopped sending have."""

VALID = Invalid(0)
NO_FLAGS = Quality(0)
MET = Unmet(0)


# --- answers to queries -----------------------------------------------------------------------------------------------

if TYPE_CHECKING:
    from modelserver.earth.geodesy import GeodeticPose


class PoseAnswer(NamedTuple):
    """A transformation with the other fields of pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known. The levels, in m and rad, are those
    that an error exceeds with a probability of 1e-4 at an instant; `limit_risk` is that of an error beyond a configured
    limit, `horizontal_allowance` the part of the horizontal level that is an offset for suspected faults.
    `unmet` and `unmet_reason` are those of the reply to a query with a demand.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_protection_level: float = NAN
    heading_protection_level: float = NAN
    seconds_to_limit: float = NAN
    horizontal_level: float = NAN
    heading_level: float = NAN
    limit_risk: float = NAN
    horizontal_allowance: float = NAN
    unmet: Unmet = MET
    unmet_reason: str = ""

    @property
    def geodetic(self) -> GeodeticPose | None:
        """Latitude, longitude, height and true heading of the frame of interest; None if not in a world frame."""
        # loads pyproj
        from modelserver.earth.geodesy import compute_geodetic

        if self.origin is None:
            return None
        found = self.transformation
        return compute_geodetic(found.pose, found.frame_of_reference, self.origin)


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
        return PoseBatch._make([each[first:end] if isinstance(each, np.ndarray) else each for each in self])


# --- results of localization ------------------------------------------------------------------------------------------


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


# --- the state of localization that persists across restarts ----------------------------------------------------------


class PersistedPose(NamedTuple):
    """Pose of a stationary vehicle, persisted only while it is valid.

    `latitude_deg`, `longitude_deg`, `height` (ellipsoidal, m) locate the origin of the tangent plane N. `position` (m)
    is that of the IMU in N, `attitude` the quaternion from body to N axes. `correlated_error` (m along N) is the
    time-correlated GNSS error contained in the pose, `correlated_error_variance` (m2) the variance it adds; `allowance`
    (m) and `gnss_noise_inflation` as in the filter's state. `fix_utime` is the last fix that was used or confirmed, 0 =
    none; `confirmed` counts them. `wheels` holds the distance travelled of each wheel by name (m), from sample
    `wheels_seq` of `wheels_source`.
    """

    latitude_deg: float
    longitude_deg: float
    height: float
    position: Vector3
    attitude: Quaternion
    correlated_error: Vector3
    correlated_error_variance: Vector3
    allowance: float
    gnss_noise_inflation: float
    fix_utime: int
    confirmed: int
    pose_epoch: int
    wheels_source: str = ""
    wheels_seq: int = 0
    wheels: tuple[tuple[str, float], ...] = ()


class PersistedState(NamedTuple):
    """State that one run of the service leaves to the next. Numbers are finite; SI units, body axes.

    `utime` and `monotonic_ns` are the host's clocks when it was saved, `boot` the boot id that the monotonic clock
    counts from, empty = not known. `setup` identifies mounts, kinematics and error states that the numbers depend on.
    `sensor_utime` is the instant of the newest measurement. `names` (n) are the error states; `gyro_bias` (rad/s),
    `accelerometer_bias` (m/s2) and `extras` (those after the strapdown's 15) their estimates, `covariance` (n x n,
    row-major) that of their errors.
    """

    vehicle: str
    utime: int
    monotonic_ns: int
    boot: str
    setup: str
    sensor_utime: int
    names: tuple[str, ...]
    gyro_bias: Vector3
    accelerometer_bias: Vector3
    extras: tuple[float, ...]
    covariance: tuple[float, ...]
    pose: PersistedPose | None = None


class RestoredState(NamedTuple):
    """State of the previous run and its age (s), or the reason why there is none.

    A pose older than `max_pose_age` and biases older than `max_age`, seconds, are not used.
    """

    state: PersistedState | None = None
    age: float = 0.0
    reason: str = ""
    max_pose_age: float = 20.0
    max_age: float = 86400.0
