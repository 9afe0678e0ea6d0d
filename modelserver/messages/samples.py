"""What sensors say; see the wire types of the same names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from modelserver.messages.flags import NAN, Direction, FixType, OrientationReference, VehicleMode, YawSource
from modelserver.spatial.so3 import Quaternion, Vector3

Matrix3: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""Nine numbers, row-major."""


@dataclass(frozen=True, slots=True)
class SensorHeader:
    """When and by whom a sample was taken. `utime` is the instant of measurement."""

    utime: int
    source: str = ""
    seq: int = 0
    host_utime: int = 0
    device_utime: int = 0
    utime_sigma: float = NAN


@dataclass(frozen=True, slots=True)
class GpsSample:
    """One fix of a satellite receiver, at the antenna's phase centre; see gps_t."""

    header: SensorHeader
    fix_type: FixType
    latitude_deg: float
    longitude_deg: float
    height_ellipsoidal: float = NAN
    height_msl: float = NAN
    undulation: float = NAN
    satellites: int = -1
    hdop: float = NAN
    vdop: float = NAN
    pdop: float = NAN
    position_covariance: Matrix3 | None = None
    velocity: Vector3 | None = None
    velocity_covariance: Matrix3 | None = None
    velocity_latency: float = NAN
    speed: float = NAN
    speed_sigma: float = NAN
    course: float = NAN
    course_sigma: float = NAN
    baseline_yaw: float = NAN
    baseline_yaw_sigma: float = NAN


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One sample of an inertial unit, along the axes of its sensor frame; see imu_t."""

    header: SensorHeader
    angular_velocity: Vector3 | None = None
    specific_force: Vector3 | None = None
    magnetic_field: Vector3 | None = None
    orientation: Quaternion | None = None
    orientation_reference: OrientationReference = OrientationReference.NONE
    yaw_source: YawSource = YawSource.NONE
    angular_velocity_covariance: Matrix3 | None = None
    specific_force_covariance: Matrix3 | None = None
    orientation_covariance: Matrix3 | None = None
    temperature_celsius: float = NAN


@dataclass(frozen=True, slots=True)
class WheelSample:
    """One wheel of a `WheelsSample`; see wheels_t."""

    name: str
    travel: float = NAN
    travel_sigma: float = NAN
    speed: float = NAN
    speed_sigma: float = NAN
    direction: Direction = Direction.UNKNOWN
    steering: float = 0.0


@dataclass(frozen=True, slots=True)
class WheelsSample:
    """Travel and speed of the wheels; see wheels_t."""

    header: SensorHeader
    wheels: tuple[WheelSample, ...]


@dataclass(frozen=True, slots=True)
class JointSample:
    """One joint of a `JointsSample`; see joints_t."""

    name: str
    position: float
    position_sigma: float = NAN
    rate: float = NAN
    rate_sigma: float = NAN


@dataclass(frozen=True, slots=True)
class JointsSample:
    """Positions of joints; see joints_t."""

    header: SensorHeader
    joints: tuple[JointSample, ...]


@dataclass(frozen=True, slots=True)
class AbsolutePoseSample:
    """Where a frame of the vehicle is in a world frame, by a source that is no GPS; see absolute_pose_t.

    `position` or `orientation` is None where the source tells only the other. `covariance` is 36 numbers,
    row-major, of position and orientation along the axes of the frame of reference; None = not told.
    """

    header: SensorHeader
    frame_of_interest: str
    frame_of_reference: str
    position: Vector3 | None = None
    orientation: Quaternion | None = None
    covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class RelativePoseSample:
    """Where a frame of the vehicle is in its own earlier self, as visual odometry tells; see relative_pose_t.

    `since_utime` is the earlier instant, `header.utime` the later. `covariance` is 36 numbers, row-major, along the
    axes of the frame at the earlier instant; None = not told.
    """

    header: SensorHeader
    frame: str
    since_utime: int
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class RangeSample:
    """The distance from a frame of the vehicle to a beacon whose place is known; see range_t."""

    header: SensorHeader
    frame: str
    beacon: str
    beacon_position: Vector3
    frame_of_reference: str
    distance: float
    sigma: float = NAN


@dataclass(frozen=True, slots=True)
class VehicleStatusSample:
    """What the vehicle controller says of itself; see vehicle_status_t."""

    header: SensorHeader
    mode: VehicleMode = VehicleMode.UNKNOWN
    forward_speed: float = NAN
    steering_angle: float = NAN
    supply_voltage: float = NAN
    engine_speed: float = NAN
    fault_bits: int = 0
    commands_refused: int = 0


Sample: TypeAlias = (
    GpsSample
    | ImuSample
    | WheelsSample
    | VehicleStatusSample
    | JointsSample
    | AbsolutePoseSample
    | RelativePoseSample
    | RangeSample
)
