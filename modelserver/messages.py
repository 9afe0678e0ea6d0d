"""The values that the core speaks: what comes in, what is asked, what goes out. Pure, immutable.

Units, frames and signs are those of the wire types of the same names in `lcmtypes/`, where each field is
described; the codec in `modelserver.wire` is the only place that knows both. What a device did not say is
nan for a number and None for a vector or a matrix.

Requests and replies are NamedTuples where the rest are dataclasses: they are made with every query, and a
NamedTuple is made at a third of the cost.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from functools import lru_cache
from typing import Final, NamedTuple, TypeAlias

from modelserver.errors import Status
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Quaternion, Vector3
from modelserver.spatial.transformation import Transformation

Matrix3: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""Nine numbers, row-major."""

NAN = math.nan


class FixType(IntEnum):
    """What a fix rests on."""

    NONE = 0
    FIX_2D = 1
    FIX_3D = 2
    DIFFERENTIAL = 3
    RTK_FLOAT = 4
    RTK_FIXED = 5
    DEAD_RECKONING = 6


class OrientationReference(IntEnum):
    """What an inertial unit's own orientation is measured against."""

    NONE = 0
    ENU = 1
    NED = 2


class YawSource(IntEnum):
    """Where an inertial unit's own yaw comes from."""

    NONE = 0
    MAGNETIC = 1
    TRUE = 2


class Direction(IntEnum):
    """Which way a wheel turns, as its encoder tells."""

    BACKWARD = -1
    STOPPED = 0
    FORWARD = 1
    UNKNOWN = 2


class Policy(IntEnum):
    """What a question about a time accepts for an answer."""

    INTERPOLATED = 0
    LATEST = 1
    HELD = 2
    PREDICTED = 3


class Invalid(IntFlag):
    """Why a pose may not be used; 0 = it may."""

    NO_FIX = 1
    NO_IMU = 2
    NO_ORIGIN = 4
    NOT_MOVED_YET = 8
    STATIONARY_HEADING = 16
    STALE_GPS = 32
    STALE_IMU = 64
    GPS_REJECTED = 128
    BOUND_EXCEEDED = 256
    CLOCK_STEPPED = 512

    def explain(self) -> str:
        """Return the reasons in words; empty where there is none."""
        return "; ".join(_INVALID_TEXT[flag] for flag in Invalid if flag in self)


_INVALID_TEXT = {
    Invalid.NO_FIX: "no usable GPS fix yet",
    Invalid.NO_IMU: "no inertial sample yet",
    Invalid.NO_ORIGIN: "the origin is not set yet, still averaging fixes",
    Invalid.NOT_MOVED_YET: "heading is not known before the vehicle moves",
    Invalid.STATIONARY_HEADING: "standing too long, the heading has drifted",
    Invalid.STALE_GPS: "the last usable GPS fix is too old",
    Invalid.STALE_IMU: "the last inertial sample is too old",
    Invalid.GPS_REJECTED: "GPS fixes arrive but are refused",
    Invalid.BOUND_EXCEEDED: "a protection bound passes the configured limit",
    Invalid.CLOCK_STEPPED: "the clock stepped, time is being taken up anew",
}


class Quality(IntFlag):
    """What a user of a pose should know although it may be used."""

    HEADING_FROM_GYRO = 1
    PREDICTED = 2
    INTERPOLATED = 4
    HELD = 8
    CORRELATION_UNKNOWN = 16
    REVERSING = 32


VALID = Invalid(0)
NO_FLAGS = Quality(0)


# --- what comes in ------------------------------------------------------------------------------------------


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
class Tick:
    """The clock has reached a due time, `late` seconds after it; `missed` due times before it were skipped.

    `answered`: requests that were answered from what is remembered, without the core, since the last tick.
    """

    late: float = 0.0
    missed: int = 0
    answered: int = 0


@dataclass(frozen=True, slots=True)
class Rejected:
    """Something that came in and was not understood: counted by channel and reason."""

    channel: str
    reason: str


Sample: TypeAlias = GpsSample | ImuSample | WheelsSample | JointsSample

# --- what is asked ------------------------------------------------------------------------------------------


class RequestHeader(NamedTuple):
    """Which request, and where the answer goes."""

    request_id: int
    reply_channel: str

    def is_answerable(self, prefix: str) -> bool:
        """Return whether a server may speak on the reply channel: within its prefix, plain, not too long."""
        # the length first: what is looked up is kept
        return len(self.reply_channel) <= MAX_CHANNEL_LENGTH and _is_answerable(self.reply_channel, prefix)


MAX_CHANNEL_LENGTH = 63
"""LCM refuses longer names."""

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_]+")


@lru_cache(maxsize=1024)
def _is_answerable(channel: str, prefix: str) -> bool:
    return len(channel) > len(prefix) and channel.startswith(prefix) and _PLAIN_NAME.fullmatch(channel) is not None


class TimeQuery(NamedTuple):
    """What time a request means; `at` 0 is the latest common time. See time_query_t."""

    at: int = 0
    policy: Policy = Policy.INTERPOLATED
    wait_ms: int = 0


class GetTransformation(NamedTuple):
    """Where is `frame_of_interest` in `frame_of_reference`?"""

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    time: TimeQuery = TimeQuery()


class GetBodyList(NamedTuple):
    """Which bodies are there?"""

    header: RequestHeader


class GetBodyFrameList(NamedTuple):
    """Which frames has a body?"""

    header: RequestHeader
    body: str


class GetStateVector(NamedTuple):
    """Where is the vehicle in the world, as a 7-vector?"""

    header: RequestHeader
    time: TimeQuery = TimeQuery()


class GetHTransform(NamedTuple):
    """Where is the vehicle in the world, or with `inverse` the world in the vehicle?"""

    header: RequestHeader
    inverse: bool = False
    time: TimeQuery = TimeQuery()


class GetHistory(NamedTuple):
    """Where was the vehicle in the world between two times?"""

    header: RequestHeader
    start_utime: int
    end_utime: int
    rate_hz: float


Request: TypeAlias = GetTransformation | GetBodyList | GetBodyFrameList | GetStateVector | GetHTransform | GetHistory
CHANNEL_OF: Final[Mapping[type, str]] = {
    GetTransformation: "PLATFORM_GET_TRANSFORMATION",
    GetBodyList: "PLATFORM_GET_BODY_LIST",
    GetBodyFrameList: "PLATFORM_GET_BODY_FRAME_LIST",
    GetStateVector: "POSE_GET_STATE_VECTOR",
    GetHTransform: "POSE_GET_H_TRANSFORM",
    GetHistory: "POSE_GET_HISTORY",
}
"""The channel that each kind of request comes in on, without the vehicle's prefix."""

Event: TypeAlias = Sample | Request | Tick | Rejected

# --- what goes out ------------------------------------------------------------------------------------------


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


class PoseAnswer(NamedTuple):
    """A transformation with all that the wire says beside it; see pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_bound: float = NAN
    heading_bound: float = NAN
    seconds_to_limit: float = NAN


class ReplyHeader(NamedTuple):
    """How a request ended."""

    request_id: int
    utime: int
    status: Status = Status.OK
    message: str = ""
    nearest: tuple[str, ...] = ()
    model_revision: str = ""


class TransformReply(NamedTuple):
    """Answers GetTransformation and GetHTransform; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class NameListReply(NamedTuple):
    """Answers GetBodyList and GetBodyFrameList."""

    header: ReplyHeader
    names: tuple[str, ...] = ()
    descriptions: tuple[str, ...] = ()


class StateVectorReply(NamedTuple):
    """Answers GetStateVector; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class HistoryReply(NamedTuple):
    """Answers GetHistory."""

    header: ReplyHeader
    answers: tuple[PoseAnswer, ...] = ()


Reply: TypeAlias = TransformReply | NameListReply | StateVectorReply | HistoryReply


class SendReply(NamedTuple):
    """Send `reply` on `channel`."""

    channel: str
    reply: Reply


@dataclass(frozen=True, slots=True)
class PublishPose:
    """Broadcast the vehicle's pose in the world, and in Odom."""

    world: PoseAnswer
    odom: PoseAnswer


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Traffic of one channel; see channel_health_t."""

    channel: str
    count: int
    rate_hz: float
    age: float


@dataclass(frozen=True, slots=True)
class Health:
    """How the daemon is; see health_t."""

    utime: int
    uptime: float
    version: str
    vehicle: str
    model_revision: str
    state: int
    invalid_reasons: Invalid
    pose_epoch: int
    origin_id: int
    poses_published: int
    requests_answered: int
    requests_parked: int
    ticks_missed: int
    handler_errors: int
    tick_lateness_p50: float
    tick_lateness_max: float
    channels: tuple[ChannelHealth, ...] = ()
    rejected: tuple[tuple[str, str, int], ...] = ()


@dataclass(frozen=True, slots=True)
class PublishHealth:
    """Broadcast how the daemon is."""

    health: Health


@dataclass(frozen=True, slots=True)
class OriginLatched:
    """The origin was set: keep it across restarts."""

    origin: Origin


Output: TypeAlias = SendReply | PublishPose | PublishHealth | OriginLatched

# --- what localization says ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The base frame at one instant.

    `odom` is its pose in Odom:Origin, `enu` in the tangent plane at the origin, `utm` in World:UTM; the last
    two are None before the origin is known. `covariance` is 36 numbers, row-major, of the world pose along
    east, north, up (of `utm` and `enu` alike: the convergence between their axes is below the noise that a
    covariance states).
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
