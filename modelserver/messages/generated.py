"""Values of the messages. Generated from lcmtypes/*.lcm by `make types`; do not edit."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from modelserver.errors import Status
from modelserver.messages.answers import PoseAnswer
from modelserver.messages.flags import MET, NAN, Invalid, Unmet
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Matrix3, Quaternion, Vector3


@dataclass(frozen=True, slots=True)
class SensorHeader:
    """Time and source of a sample. First member of every sensor message.

    Attributes
    ----------
    utime
        Instant of measurement, microseconds since the Unix epoch (UTC, host's clock), positive.
    utime_sigma
        Standard deviation of utime, seconds; nan = not known.
    host_utime
        When the host received the sample, microseconds since the Unix epoch (UTC, host's clock); 0 = not known.
    device_utime
        The device's own time of the sample, microseconds in the device's own epoch; 0 = the device has none.
    seq
        Counts the samples of this source, from 0; a gap means lost samples.
    source
        Name of the source as the vehicle file knows it, e.g. gps; 64 characters at most.
    """

    utime: int
    source: str = ""
    seq: int = 0
    host_utime: int = 0
    device_utime: int = 0
    utime_sigma: float = NAN


@dataclass(frozen=True, slots=True)
class AbsolutePoseSample:
    """Pose of a frame of the vehicle in a world frame, from a source other than a GNSS receiver: a motion-capture
    system, a map-based localizer, a survey.

    Attributes
    ----------
    header
        Time and source; header.utime is the instant the pose holds for.
    frame_of_interest
        The frame of the vehicle whose pose this is: full name, Body:Frame; 200 characters at most on each side of the
        colon.
    frame_of_reference
        The frame it is expressed in: World:UTM or World:ENU.
    position
        Position of the frame of interest in the frame of reference, along its axes, meters; nan = not known.
    orientation
        Unit quaternion of the frame of interest in the frame of reference, scalar first (w x y z); nan = not known.
    covariance
        Covariance, row-major: x, y, z (m), about x, about y, about z (rad), along the axes of the frame of reference,
        rotation applied on the left (fixed axes). The first number nan: not known. Rows and columns of a position or an
        orientation that is not known are ignored: write 0.
    """

    header: SensorHeader
    frame_of_interest: str
    frame_of_reference: str
    position: Vector3 | None = None
    orientation: Quaternion | None = None
    covariance: tuple[float, ...] | None = None


class ReplyHeader(NamedTuple):
    """How a request ended. First member of every reply.

    Attributes
    ----------
    request_id
        The request's id.
    utime
        When the server answered, microseconds since the Unix epoch (UTC).
    status
        Status: OK to REJECTED. Treat an unknown number as INTERNAL.
    message
        What went wrong and what to do, for a person; empty when status is OK.
    nearest
        Suggestions: names similar to an unknown one, best first.
    model_revision
        Content hash of the geometry used.
    """

    request_id: int
    utime: int
    status: Status = Status.OK
    message: str = ""
    nearest: tuple[str, ...] = ()
    model_revision: str = ""


class Acknowledgement(NamedTuple):
    """Reply to a command.

    Attributes
    ----------
    header
        Status of the request.
    """

    header: ReplyHeader


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Traffic of one source, or of a sensor of the vehicle file from which no sample was received yet.

    Attributes
    ----------
    channel
        `sensor:NAME` or `command:NAME` with the name in header.source; for a sensor of the vehicle file without
        samples, the name of its channel with the vehicle's prefix.
    count
        Messages received since the start.
    rate_hz
        Messages a second over the last report's interval, Hz.
    age
        Time since the last message, seconds; nan = none yet.
    delay_max
        Greatest time over the last report's interval from when the host received a sample (header.host_utime) until the
        daemon handled it, seconds: driver, bus and queue together; nan = no sample, or host_utime is not known.
    silent
        Whether no sample was received for five of its usual intervals and at least a second, or none at all.
    measured
        Measurements of its samples that localization decided on since the start; a sample may hold several, and wheels
        are evaluated every localization.filter.wheel_period. 0 for an IMU, which propagates the state.
    used
        How many of these were used.
    """

    channel: str
    count: int
    rate_hz: float
    age: float
    delay_max: float = NAN
    silent: bool = False
    measured: int = 0
    used: int = 0


class Verdict(IntEnum):
    """Outcome: USED, REJECTED, MONITORED or RESET."""

    USED = 0
    """The state was updated with it."""
    REJECTED = 1
    """It failed the gate or a quality check, which reason names."""
    MONITORED = 2
    """It was compared and intentionally not used."""
    RESET = 3
    """It initialized or reset the state."""


class Decision(NamedTuple):
    """Innovation test of one measurement in localization, and its outcome. Part of decisions_t.

    Attributes
    ----------
    utime
        The instant of measurement, microseconds since the Unix epoch (UTC).
    source
        Name of the source that the measurement came from, as in its samples' header; 64 characters at most.
    seq
        Number of the sample it was part of, as in its header.
    kind
        What was measured, one word: gps_position, wheel_speed, ...; 64 characters at most.
    verdict
        Outcome: USED, REJECTED, MONITORED or RESET.
    reason
        Reason, one word; may be empty; 64 characters at most.
    residual
        Innovation: measured minus predicted, in the unit of the measurement.
    innovation_covariance
        Predicted covariance S of the residual, noise included, in the squared units of the measurement. The first
        number nan: not known.
    noise
        Covariance R of the measurement noise, in the squared units of the measurement. The first number nan: not known.
    statistic
        Normalized innovation squared (NIS), residual' S^-1 residual, no unit: chi-square distributed with num degrees
        of freedom if the model is right; nan = not known.
    limit
        Chi-square gate: a greater statistic is rejected, no unit; nan = not gated.
    """

    utime: int
    source: str
    seq: int
    kind: str
    verdict: Verdict
    reason: str = ""
    residual: tuple[float, ...] = ()
    innovation_covariance: tuple[float, ...] = ()
    noise: tuple[float, ...] = ()
    statistic: float = NAN
    limit: float = NAN

    @property
    def dof(self) -> int:
        """Degrees of freedom, 0 to 64: the size of the residual; 0 = rejected before the comparison."""
        return len(self.residual)


@dataclass(frozen=True, slots=True)
class PublishDecisions:
    """Decisions about measurements, each published once, when it is final.

    Attributes
    ----------
    utime
        Time of publication, microseconds since the Unix epoch (UTC).
    decisions
        The decisions, in the order in which they were made.
    """

    utime: int
    decisions: tuple[Decision, ...]


class DriverPhase(IntEnum):
    """CLOSED, WAITING, CONFIGURING, STREAMING or SILENT."""

    CLOSED = 0
    """The line is not open: not yet, or the device was unplugged."""
    WAITING = 1
    """The line is open and nothing was received."""
    CONFIGURING = 2
    """The device answers and is being set up."""
    STREAMING = 3
    """Samples arrive."""
    SILENT = 4
    """The device stopped sending, or sends what cannot be used."""


@dataclass(frozen=True, slots=True)
class DriverHealth:
    """Health report of a driver, once a second and at every change of its phase. Counts are since the start of the
    driver.

    Attributes
    ----------
    utime
        When the report was made, microseconds since the Unix epoch (UTC, host's clock).
    source
        Name of the driver in the vehicle file, which is also the source in the headers of its samples, e.g. gps.
    device
        Type of the device, e.g. novatel.
    phase
        CLOSED, WAITING, CONFIGURING, STREAMING or SILENT.
    text
        Details for people: why the line is closed, what is being configured.
    link
        The line, for people, e.g. /dev/ttyUSB0 or tcp 10.0.0.5:3001.
    baud
        Symbols a second on the line; 0 where that makes no sense.
    reconnects
        How often the line was reopened.
    samples
        Samples published.
    rate_hz
        Samples a second over the last report's interval, Hz.
    age
        Time since the last sample, seconds; nan = none yet.
    clock_offset
        Host minus device time at the last sample, seconds; nan = the device has no clock, or sent no time yet.
    clock_drift
        By what fraction the host's clock runs faster than the device's; nan as above.
    clock_sigma
        Standard deviation of the last sample's utime, seconds; nan = no sample yet.
    clock_restarts
        Detected steps of the device's or the host's clock.
    """

    utime: int
    source: str
    device: str
    phase: DriverPhase
    text: str = ""
    link: str = ""
    baud: int = 0
    reconnects: int = 0
    samples: int = 0
    rate_hz: float = 0.0
    age: float = NAN
    clock_offset: float = NAN
    clock_drift: float = NAN
    clock_sigma: float = NAN
    clock_restarts: int = 0
    counters: tuple[tuple[str, int], ...] = ()


class RequestHeader(NamedTuple):
    """Id of the request, and the channel of the reply. First member of every request.

    Attributes
    ----------
    request_id
        Random, chosen by the client; comes back in the reply. A repeated request keeps its id.
    reply_channel
        Channel to answer on: starts with the server's reply prefix (REPLY_) and more, letters, digits and underscores
        only, 63 characters at most. One for each client program, the same at every start.
    """

    request_id: int
    reply_channel: str


class GetBodyFrameList(NamedTuple):
    """Platform.getBodyFrameList: the names of a body's frames. Answered by name_list_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    body
        Name of the body.
    """

    header: RequestHeader
    body: str


class GetBodyList(NamedTuple):
    """Platform.getBodyList: the names of all bodies. Answered by name_list_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    """

    header: RequestHeader


class DynamicsAnswer(NamedTuple):
    """Mass, center of mass and inertia of a vehicle, and its equations of motion.

    Attributes
    ----------
    utime
        Instant of the joints and the attitude, microseconds since the Unix epoch (UTC). Meaningful only when
        header.status is OK, as all below.
    invalid_reasons
        Why the answer may not be used, bit by bit as in pose_transform_t; 0 = it may.
    frame
        The frame of center of mass and inertia.
    mass
        Mass, kg.
    center
        Center of mass in the frame, m.
    inertia
        Inertia about the frame's origin, row-major 6 x 6: x, y, z, then about x, about y, about z; kg, kg m, kg m2.
    coordinates
        Their names: those of the joints, before them those of a floating base.
    position
        Position of each, meters or radians.
    rate
        Its rate; nan = not known.
    gravity
        Gravity vector, N or N m.
    bias
        Bias vector (report eq. 9), N or N m; nan where a rate is not known.
    mass_matrix
        Mass matrix (report eq. 7): the lower triangle as in navigation_state_t; kg, kg m, kg m2.
    center_covariance
        Covariance of the center of mass along the axes of the frame, row-major, m2. nan = not known.
    """

    utime: int
    invalid_reasons: Invalid
    frame: str
    mass: float
    center: Vector3
    inertia: tuple[float, ...]
    coordinates: tuple[str, ...]
    position: tuple[float, ...]
    rate: tuple[float, ...]
    gravity: tuple[float, ...]
    bias: tuple[float, ...]
    mass_matrix: tuple[float, ...]
    center_covariance: Matrix3 | None = None


class DynamicsReply(NamedTuple):
    """Reply to get_dynamics_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answer
        None unless the status is OK.
    """

    header: ReplyHeader
    answer: DynamicsAnswer | None = None


class Policy(IntEnum):
    """Which answer is accepted when `at` is given: INTERPOLATED, LATEST, HELD or PREDICTED."""

    INTERPOLATED = 0
    """Exact, or interpolated between two values of the history; else an error."""
    LATEST = 1
    """As at = 0, whatever `at` is."""
    HELD = 2
    """The last value at or before `at`."""
    PREDICTED = 3
    """As INTERPOLATED, and predicted by the motion model past the last sample."""


class TimeQuery(NamedTuple):
    """Time of a request.

    Attributes
    ----------
    at
        Microseconds since the Unix epoch (UTC); 0 = the latest time for which everything asked for is known.
    policy
        Which answer is accepted when `at` is given: INTERPOLATED, LATEST, HELD or PREDICTED.
    wait_ms
        How long the server may wait for data that cover `at`, milliseconds, not negative; 0 = answer at once.
    """

    at: int = 0
    policy: Policy = Policy.INTERPOLATED
    wait_ms: int = 0


class GetDynamics(NamedTuple):
    """Platform.getDynamics: mass, center of mass and inertia, and the equations of motion. Answered by
    get_dynamics_reply_t. Needs the section `dynamics` in the vehicle file.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    frame
        The frame of center of mass and inertia: full name, as in get_transformation_request_t; empty: the base frame.
    with_equations
        Whether coordinates, mass matrix, bias vector and gravity vector are wanted.
    is_floating
        Whether the base frame moves in World:ENU, with six coordinates of its own; else it is fixed, and level.
    time
        Time of the query. The server does not wait for data: wait_ms is not read.
    """

    header: RequestHeader
    frame: str = ""
    with_equations: bool = False
    is_floating: bool = False
    time: TimeQuery = TimeQuery()


class EdgeReport(NamedTuple):
    """One edge of the path from a frame of reference to a frame of interest.

    Attributes
    ----------
    kind
        What it is: FRAME to VEHICLE.
    name
        Name of the frame, the constraint or the world frame.
    ends
        Name at the end that poses in the file start from. Name at the other end.
    forward
        Whether the path traverses it from from_end to to_end; else the pose here is the inverse of the file's.
    pose
        Pose of the end traversed last in that traversed first: px py pz (m), qs qx qy qz.
    provenance
        Provenance of its value: FIXED to DEFAULT.
    stamp
        Instant of the newest measurement in it, microseconds since the Unix epoch (UTC); 0 = none.
    age
        How old that was when the server answered, seconds; nan = none.
    source
        Source: header.source of a joint's newest sample, or localization; empty = none.
    coordinates
        Position of the joint: radians or meters.
    position_share
        Its part of the sum of the variances of the position, 0 to 1; nan = it states no sigma, and counts as exact.
    rotation_share
        Its part of the sum of the variances of the rotation, 0 to 1; nan as above.
    warning
        Warning in words, e.g. that a joint was silent or is beyond its limits; empty = none.
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
    """A pose with the edges of the path that it was computed along.

    Attributes
    ----------
    answer
        The pose asked for. Meaningful only when header.status is OK.
    edges
        The path from the frame of reference to the frame of interest.
    """

    answer: PoseAnswer
    edges: tuple[EdgeReport, ...]


class ExplanationReply(NamedTuple):
    """Reply to get_explanation_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answer
        None unless the status is OK.
    """

    header: ReplyHeader
    answer: Explanation | None = None


class GetExplanation(NamedTuple):
    """Platform.getExplanation: a transformation, and each edge of its path. Answered by get_explanation_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    time
        Time of the query.
    frame_of_interest
        The frame whose pose is asked for: full name, as in get_transformation_request_t.
    frame_of_reference
        The frame it is to be expressed in: full name.
    """

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    time: TimeQuery = TimeQuery()


class PoseDemand(NamedTuple):
    """What a consumer needs of a pose; each 0 = not asked for. The answer is given in any case, with what is unmet.

    Attributes
    ----------
    max_horizontal
        The horizontal error may be beyond this with a probability of 1 - min_integrity at most, meters: that along x
        and y of the frame of reference.
    max_heading
        The heading error may be beyond this with that probability at most, radians: that about z of the frame of
        reference.
    max_age
        Largest age of the newest data that the pose is computed from, of the vehicle and of each joint, seconds.
    min_integrity
        Probability that a limit holds, below 1; 0 = 0.99 for the limits above. If it is stated, the pose must be valid,
        and without limits above the configured ones must hold with it.
    """

    max_horizontal: float = 0.0
    max_heading: float = 0.0
    max_age: float = 0.0
    min_integrity: float = 0.0


class GetHTransform(NamedTuple):
    """Pose.getHTransform and Pose.getHTransformInv: the vehicle's base frame in World:UTM, or World:UTM in the base
    frame. Answered by get_transformation_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    inverse
        false: the base frame in World:UTM. true: World:UTM in the base frame.
    time
        Time of the query.
    demand
        What the pose is needed for; all 0 = nothing is asked for.
    """

    header: RequestHeader
    inverse: bool = False
    time: TimeQuery = TimeQuery()
    demand: PoseDemand = PoseDemand()


class HistoryReply(NamedTuple):
    """Reply to get_history_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answers
        At start, start + 1/rate, ... up to end; times outside the history are left out.
    """

    header: ReplyHeader
    answers: tuple[PoseAnswer, ...] = ()


class GetHistory(NamedTuple):
    """Pose.getHistory: the vehicle's base frame in World:UTM between two times at an even rate. Answered by
    get_history_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    start_utime
        First time, microseconds since the Unix epoch (UTC).
    end_utime
        Last time, microseconds since the Unix epoch (UTC), not before start_utime.
    rate_hz
        Poses a second, Hz, positive. More than 1,000 poses in one request are rejected.
    """

    header: RequestHeader
    start_utime: int
    end_utime: int
    rate_hz: float


class MotionAnswer(NamedTuple):
    """Pose and motion of a frame relative to another one, along the axes of `expressed_in`.

    Attributes
    ----------
    pose
        Pose of the frame of interest in the frame of reference. Meaningful only when header.status is OK, as all below.
    expressed_in
        The frame along whose axes the vectors are.
    velocity
        Velocity of the frame of interest's origin, m/s. nan = not known, as below.
    angular_velocity
        Angular velocity, rad/s.
    acceleration
        Acceleration of the frame of interest's origin, m/s2.
    angular_acceleration
        Angular acceleration, rad/s2.
    covariance
        Covariance of velocity and rate, row-major, (m/s)2 and (rad/s)2. nan = not known.
    acceleration_covariance
        Covariance of acceleration and angular acceleration, row-major, (m/s2)2 and (rad/s2)2. nan = not known.
    """

    pose: PoseAnswer
    expressed_in: str
    velocity: Vector3
    angular_velocity: Vector3
    acceleration: Vector3
    angular_acceleration: Vector3
    covariance: tuple[float, ...] | None = None
    acceleration_covariance: tuple[float, ...] | None = None


class MotionReply(NamedTuple):
    """Reply to get_motion_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answer
        None unless the status is OK.
    """

    header: ReplyHeader
    answer: MotionAnswer | None = None


class GetMotion(NamedTuple):
    """Platform.getMotion: how one frame moves in another. Answered by get_motion_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    frame_of_interest
        The frame whose motion is asked for: full name, as in get_transformation_request_t.
    frame_of_reference
        The frame that the motion is relative to, as an observer fixed to it measures it.
    expressed_in
        The frame along whose axes the vectors are to be; empty: frame_of_reference.
    time
        Time of the query.
    """

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    expressed_in: str = ""
    time: TimeQuery = TimeQuery()


class StateVectorReply(NamedTuple):
    """Reply to get_state_vector_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answer
        The base frame in World:UTM. Meaningful only when header.status is OK.
    unmet
        What is unmet of the request's demand, bit by bit as in get_transformation_reply_t; 0 = nothing.
    unmet_reason
        What is unmet, by how much, and what was asked for, for a person; empty when unmet is 0.
    """

    header: ReplyHeader
    answer: PoseAnswer | None = None
    unmet: Unmet = MET
    unmet_reason: str = ""


class GetStateVector(NamedTuple):
    """Pose.getStateVector: the vehicle's base frame in World:UTM as a 7-vector. Answered by get_state_vector_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    time
        Time of the query.
    demand
        What the pose is needed for; all 0 = nothing is asked for.
    """

    header: RequestHeader
    time: TimeQuery = TimeQuery()
    demand: PoseDemand = PoseDemand()


class TransformReply(NamedTuple):
    """Reply to get_transformation_request_t and get_h_transform_request_t.

    Attributes
    ----------
    header
        Status of the request.
    answer
        The pose asked for. Meaningful only when header.status is OK.
    unmet
        What is unmet of the request's demand, bit by bit: HORIZONTAL to NOT_VALID. 0 = all that was asked for is met.
    unmet_reason
        What is unmet, by how much, and what was asked for, for a person; empty when unmet is 0.
    """

    header: ReplyHeader
    answer: PoseAnswer | None = None
    unmet: Unmet = MET
    unmet_reason: str = ""


class GetTransformation(NamedTuple):
    """Platform.getTransformation: the pose of frame_of_interest in frame_of_reference. Answered by
    get_transformation_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    frame_of_interest
        The frame whose pose is asked for: full name, Body:Frame. World:UTM, World:ENU and Odom:Origin are known beside
        the geometry file's.
    frame_of_reference
        The frame it is to be expressed in: full name, as above.
    time
        Time of the query.
    demand
        What the pose is needed for; all 0 = nothing is asked for.
    """

    header: RequestHeader
    frame_of_interest: str
    frame_of_reference: str
    time: TimeQuery = TimeQuery()
    demand: PoseDemand = PoseDemand()


class GetTransformations(NamedTuple):
    """Platform.getTransformations: poses of several pairs of frames at many instants, as one batch. Answered by
    get_transformations_reply_t, in parts.

    Attributes
    ----------
    header
        Id of the request, and the channel of the replies.
    at
        The instants, microseconds since the Unix epoch (UTC). Poses are exact or between two held values.
    fixed_frame
        A frame that is assumed to be fixed: then the poses are those of the frames of interest at the instants in the
        frames of reference at reference_at. Odom:Origin for short times, a world frame otherwise. Empty: both at the
        same instant.
    reference_at
        The instant of the frames of reference, microseconds since the Unix epoch (UTC); 0 = the latest. Not read where
        fixed_frame is empty.
    with_covariance
        Whether covariances are wanted: they make the reply five times as long.
    """

    header: RequestHeader
    pairs: tuple[tuple[str, str], ...]
    at: tuple[int, ...]
    fixed_frame: str = ""
    reference_at: int = 0
    with_covariance: bool = True


class FixType(IntEnum):
    """What the fix rests on."""

    NONE = 0
    """No fix: coordinates, if any, must not be used. Of a source that never states another type: not stated; then a
    position with a covariance is used.
    """
    FIX_2D = 1
    """Position only in the horizontal, height held or unknown."""
    FIX_3D = 2
    """Position from the satellites alone."""
    DIFFERENTIAL = 3
    """Position with code corrections (differential, SBAS)."""
    RTK_FLOAT = 4
    """Carrier phase, ambiguities not fixed."""
    RTK_FIXED = 5
    """Carrier phase, ambiguities fixed."""
    DEAD_RECKONING = 6
    """The receiver extrapolates without satellites."""


@dataclass(frozen=True, slots=True)
class GpsSample:
    """One fix of a GNSS receiver. What the receiver does not report is nan. The position is that of the antenna's phase
    center.

    Attributes
    ----------
    header
        Time and source; header.utime is the instant the position holds for.
    fix_type
        What the fix rests on: one of FIX_NONE to FIX_DEAD_RECKONING.
    satellites
        Satellites used in the solution; -1 = not known.
    hdop
        Horizontal dilution of precision, no unit.
    vdop
        Vertical dilution of precision, no unit.
    pdop
        Position dilution of precision, no unit.
    latitude_deg
        Geodetic latitude on WGS 84, degrees, north positive, -90 to 90.
    longitude_deg
        Geodetic longitude on WGS 84, degrees, east positive, -180 to 180.
    height_ellipsoidal
        Height above the WGS 84 ellipsoid, meters, up positive.
    height_msl
        Height above mean sea level, meters, up positive.
    undulation
        Geoid's height above the ellipsoid, meters, up positive: height_ellipsoidal = height_msl + undulation.
    position_covariance
        Covariance of the position, row-major, along true east, true north, up, m2.
    velocity
        Velocity of the antenna over ground along true east, true north, up, m/s.
    velocity_covariance
        Covariance of the velocity, row-major, along true east, true north, up, (m/s)2.
    velocity_latency
        Seconds, not negative: velocity, speed and course hold for header.utime minus this. Some receivers report a
        velocity of the recent past.
    speed
        Horizontal speed over ground, m/s, never negative.
    speed_sigma
        Standard deviation of speed, m/s.
    course
        Direction of motion over ground, radians, counter-clockwise from true east (not a compass course), -pi to pi.
    course_sigma
        Standard deviation of course, radians.
    baseline_yaw
        Direction of the antenna baseline of a dual-antenna receiver, from the antenna whose position is given to the
        other one, radians, counter-clockwise from true east (not a compass heading), -pi to pi.
    baseline_yaw_sigma
        Standard deviation of baseline_yaw, radians.
    """

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
class LocalizationHealth:
    """State of the localization in short, part of health_t.

    Attributes
    ----------
    mode
        Which sources localization uses: one of the constants of localization_mode_t, FULL to DEAD_RECKONING; -1 = none.
    phase
        Phase of the alignment: as in navigation_state_t, LEVELING to ALIGNED; -1 = no filter (raw mode).
    stationary
        Whether the vehicle is detected as stationary.
    horizontal_protection_level
        Horizontal protection level, as in pose_transform_t, meters; nan = not known.
    heading_protection_level
        Heading protection level, as in pose_transform_t, radians; nan = not known.
    seconds_to_limit
        Seconds until a configured limit is passed if nothing more arrives; nan = not known, or passed already.
    fix_age
        Time since the last GPS fix that was used, seconds; nan = none yet.
    latitude_deg
        Latitude of the base frame, degrees, WGS 84, north positive; nan = not known.
    longitude_deg
        Longitude of the base frame, degrees, east positive; nan = not known.
    height
        Height of the base frame above the ellipsoid, meters; nan = not known.
    heading_deg
        Heading of the base frame's x axis, degrees clockwise from true north, 0 to 360; nan = not known.
    sigma_horizontal
        Largest standard deviation of the horizontal position, meters; nan = not known.
    sigma_up
        Standard deviation of the height, meters; nan = not known.
    horizontal_level
        Horizontal level, as in pose_transform_t, meters; nan = not known.
    heading_level
        Heading level, as in pose_transform_t, radians; nan = not known.
    limit_risk
        Probability that the error is beyond a limit, as in pose_transform_t; nan = not known.
    horizontal_limit
        Limit of the horizontal error of a valid pose, meters; nan = not known yet.
    heading_limit
        Limit of the heading error of a valid pose, radians; nan = not known yet.
    """

    mode: Mode | None = None
    phase: Phase | None = None
    stationary: bool = False
    horizontal_protection_level: float = NAN
    heading_protection_level: float = NAN
    seconds_to_limit: float = NAN
    fix_age: float = NAN
    latitude_deg: float = NAN
    longitude_deg: float = NAN
    height: float = NAN
    heading_deg: float = NAN
    sigma_horizontal: float = NAN
    sigma_up: float = NAN
    horizontal_level: float = NAN
    heading_level: float = NAN
    limit_risk: float = NAN
    horizontal_limit: float = NAN
    heading_limit: float = NAN


@dataclass(frozen=True, slots=True)
class StabilityHealth:
    """Tip-over stability in short, part of health_t.

    Attributes
    ----------
    margin
        Static tip-over margin: how far the ground may tilt further, radians; nan = not configured, or not known.
    margin_sigma
        Its standard deviation, radians; nan = not known.
    dynamic_margin
        Tip-over margin with the present acceleration, radians; nan = not known.
    dynamic_margin_sigma
        Its standard deviation, radians; nan = not known.
    limit
        The margin below which the service warns, radians; nan = none.
    contacts
        Frame of each contact.
    loads
        Normal load of each with the present acceleration, else at rest, N; nan = not known, or tipping.
    """

    margin: float = NAN
    margin_sigma: float = NAN
    dynamic_margin: float = NAN
    dynamic_margin_sigma: float = NAN
    limit: float = NAN
    contacts: tuple[str, ...] = ()
    loads: tuple[float, ...] = ()


class RejectedCount(NamedTuple):
    """Number of inputs of one channel that were rejected for one reason.

    Attributes
    ----------
    channel
        Channel, or `sensor:NAME` for samples that were decoded but not used.
    reason
        One word: fingerprint, truncated, malformed, reply_channel, overload, stale, duplicate, out_of_sequence, future,
        too_old, ...
    occurrences
        How many, since the start.
    """

    channel: str
    reason: str
    occurrences: int


@dataclass(frozen=True, slots=True)
class Health:
    """Health report of the service, once a second and at once when the state, the invalid reasons, the geometry, a
    warning or the silence of a sensor changes; at most ten times a second. Counts are since the start. Rates and tick
    latencies are of the last whole period, also in a report of a change.

    Attributes
    ----------
    utime
        When the report was made, microseconds since the Unix epoch (UTC).
    uptime
        Time since the daemon started, seconds.
    version
        Version of the daemon.
    vehicle
        Name of the vehicle, from the vehicle file.
    model_revision
        Content hash of the geometry in use.
    state
        STARTING, RUNNING or DEGRADED.
    invalid_reasons
        Why the last pose may not be used, bit by bit as in pose_transform_t; 0 = it may.
    pose_epoch
        Discontinuities of the world pose, as in pose_transform_t.
    origin_id
        Names the origin of World:UTM, as in pose_transform_t; 0 = none.
    poses_published
        Poses published.
    requests_answered
        Requests answered, whatever the status.
    requests_waiting
        Requests that wait for data.
    ticks_missed
        Timer ticks skipped because the loop was late.
    handler_errors
        Exceptions caught in handlers.
    tick_latency_p50
        Median latency of the ticks since the last report, seconds; 0 = no tick.
    tick_latency_p90
        90th percentile of the tick latency since the last report, seconds; 0 = no tick.
    tick_latency_p99
        99th percentile of the tick latency since the last report, seconds; 0 = no tick.
    tick_latency_max
        Maximum tick latency since the last report, seconds; 0 = no tick.
    invalid_text
        The same in words, for people; empty when it may be used.
    host
        Host name of the machine; empty = not known.
    pid
        Process id; 0 = not known. Host and pid distinguish two services on one bus.
    requests_queued
        Requests in the queue.
    memory
        Resident memory of the service, bytes; 0 = not known.
    cpu_share
        Share of one processor's time over the last report's interval; nan = not known.
    localization
        The localization in short.
    stability
        The tip-over stability in short.
    channels
        Traffic of each.
    rejected
        Rejected input, by channel and reason.
    """

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
    requests_waiting: int
    ticks_missed: int
    handler_errors: int
    tick_latency_p50: float = 0.0
    tick_latency_p90: float = 0.0
    tick_latency_p99: float = 0.0
    tick_latency_max: float = 0.0
    invalid_text: str = ""
    host: str = ""
    pid: int = 0
    requests_queued: int = 0
    memory: int = 0
    cpu_share: float = NAN
    localization: LocalizationHealth = LocalizationHealth()
    stability: StabilityHealth = StabilityHealth()
    channels: tuple[ChannelHealth, ...] = ()
    rejected: tuple[RejectedCount, ...] = ()
    warnings: tuple[tuple[str, str], ...] = ()


class OrientationReference(IntEnum):
    """What the unit's own orientation is measured against."""

    NONE = 0
    """The unit gives no orientation."""
    ENU = 1
    """Reference axes x east, y north, z up; magnetic or true according to yaw_source."""
    NED = 2
    """Reference axes x north, y east, z down; magnetic or true according to yaw_source."""


class YawSource(IntEnum):
    """Where the unit's yaw comes from."""

    NONE = 0
    """The zero of the yaw is arbitrary and drifts (vertical gyro)."""
    MAGNETIC = 1
    """The yaw is against magnetic north."""
    TRUE = 2
    """The yaw is against true north."""


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One sample of an IMU, along the axes of its own sensor frame. What the unit does not measure is nan.

    Attributes
    ----------
    header
        Time and source.
    angular_velocity
        Angular velocity of the sensor with respect to inertial space, along the sensor's axes, rad/s, right-hand rule.
        A gyro with one axis fills that one (imu.yaw_rate_only of the vehicle file).
    angular_velocity_covariance
        Covariance of the angular velocity, row-major, along the sensor's axes, (rad/s)2.
    specific_force
        Specific force along the sensor's axes, m/s2: at rest it points up, against gravity, with 9.81.
    specific_force_covariance
        Covariance of the specific force, row-major, along the sensor's axes, (m/s2)2.
    magnetic_field
        Magnetic field along the sensor's axes, tesla.
    orientation_reference
        What the unit's own orientation is measured against: one of REFERENCE_NONE, REFERENCE_ENU, REFERENCE_NED.
    yaw_source
        Where the unit's yaw comes from: one of YAW_NONE, YAW_MAGNETIC, YAW_TRUE.
    orientation
        The unit's own orientation: unit quaternion of its sensor frame in its reference, scalar first (w x y z).
    orientation_covariance
        Covariance of the orientation about the (fixed) axes of its reference, row-major, rad2.
    temperature_celsius
        Temperature of the unit, degrees Celsius.
    """

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
class JointSample:
    """One row of `joints` of JointsSample.

    Attributes
    ----------
    name
        Names of the constraints in the geometry file.
    position
        Position: radians for a turning joint, meters for a sliding one, along the joint's positive sense.
    position_sigma
        Standard deviation of position, radians or meters.
    rate
        Rate of the position, rad/s or m/s, along the joint's positive sense.
    rate_sigma
        Standard deviation of rate, rad/s or m/s.
    """

    name: str
    position: float
    position_sigma: float = NAN
    rate: float = NAN
    rate_sigma: float = NAN


@dataclass(frozen=True, slots=True)
class JointsSample:
    """Positions of joints (constraints that move). Arrays have one entry for each joint; what was not measured is nan.

    Attributes
    ----------
    header
        Time and source.
    """

    header: SensorHeader
    joints: tuple[JointSample, ...]


class Mode(IntEnum):
    """One of FULL to DEAD_RECKONING."""

    FULL = 0
    """All sources."""
    RAW = 1
    """GPS and IMU directly, without a filter."""
    NO_IMU = 2
    """All but the IMU."""
    NO_WHEELS = 3
    """All but the wheels."""
    NO_GPS = 4
    """All but the GNSS receiver; other absolute sources are used."""
    DEAD_RECKONING = 5
    """IMU and wheels only, no absolute source."""


@dataclass(frozen=True, slots=True)
class SwitchMode:
    """Command to localize with other sources from now on, on the channel localization.mode_channel of the vehicle file;
    without that key the service does not subscribe to it.

    Attributes
    ----------
    header
        Time and source; header.utime is the instant from which it counts.
    mode
        One of FULL to DEAD_RECKONING.
    """

    header: SensorHeader
    mode: Mode


@dataclass(frozen=True, slots=True)
class MeasurementSample:
    """Measurement of a type that an installed package defines; the vehicle file names the type of each source.

    Attributes
    ----------
    header
        Time and source; header.utime is the instant of measurement.
    frame
        The frame of the vehicle that measures: full name, Body:Frame; 200 characters at most on each side of the colon.
        Empty where the type needs none.
    values
        The numbers that were measured, in the order and units of the type; nan = not measured.
    covariance
        Their covariance, in the squared units of the values. The first number nan: not known.
    """

    header: SensorHeader
    values: tuple[float, ...]
    frame: str = ""
    covariance: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class SnapshotPart:
    """A part of the geometry in use, for late subscribers and for logs. The concatenated parts of one revision are a
    zlib stream of UTF-8 JSON: vehicle, base_frame, rolling_frame, history_s, joints_channel, joints_latency_us,
    revision, and geometry, the text of the YAML form.

    Attributes
    ----------
    utime
        When it was sent, microseconds since the Unix epoch (UTC).
    model_revision
        Content hash of the geometry; the same in all parts of it, and in every pose and reply that rests on it.
    part
        Number of this part, from 0.
    parts
        Number of parts, 1 to 100,000.
    data
        The bytes.
    """

    utime: int
    model_revision: str
    part: int
    parts: int
    data: bytes


class NameListReply(NamedTuple):
    """Reply to get_body_list_request_t and get_body_frame_list_request_t.

    Attributes
    ----------
    header
        Status of the request.
    names
        Names of bodies, or of the frames of one body without the body's name; in the order of the geometry file.
    descriptions
        Their descriptions, empty where the file gives none.
    """

    header: ReplyHeader
    names: tuple[str, ...] = ()
    descriptions: tuple[str, ...] = ()


class Phase(IntEnum):
    """Phase of the alignment: LEVELING, UNALIGNED or ALIGNED."""

    LEVELING = 0
    """Coarse alignment: roll and pitch from gravity, and the gyro biases."""
    UNALIGNED = 1
    """Dead reckoning in Odom; heading alignment is not done yet."""
    ALIGNED = 2
    """Heading and position in the world are known."""


@dataclass(frozen=True, slots=True)
class NavigationState:
    """State of the localization filter, for diagnostics.

    Attributes
    ----------
    utime
        The instant the state holds for, that of the newest measurement in it, microseconds since the Unix epoch (UTC).
    mode
        Which sources are used: one of the constants of localization_mode_t, FULL to DEAD_RECKONING.
    phase
        Phase of the alignment: LEVELING, UNALIGNED or ALIGNED.
    stationary
        Whether the vehicle is detected as stationary.
    invalid
        Why the pose may not be used, bit by bit as in pose_transform_t; 0 = it may.
    pose_epoch
        Discontinuities of the world pose, as in pose_transform_t.
    latitude_deg
        Geodetic latitude on WGS 84 of the tangent plane's origin, degrees, north positive; nan = not known.
    longitude_deg
        Geodetic longitude on WGS 84 of the tangent plane's origin, degrees, east positive; nan = not known.
    height
        Height of the tangent plane's origin above the WGS 84 ellipsoid, meters, up positive; nan = not known.
    pose
        Position of the rolling frame in the tangent plane (true east, true north, up at its origin), meters. Unit
        quaternion of the rolling frame in the tangent plane (east, north, up), scalar first (w x y z).
    linear_velocity
        Velocity of the rolling frame relative to the ground, along its own axes, m/s.
    angular_velocity
        Angular velocity of the rolling frame relative to the ground, along its own axes, rad/s, right-hand rule.
    twist_covariance
        Covariance of linear_velocity and angular_velocity, row-major, along the rolling frame's axes, (m/s)2, (rad/s)2
        and their product. The first number nan: not known.
    names
        Their names, e.g. position_east, gyro_bias_x, wheel_scale; 64 characters at most each.
    values
        Their estimates, each in SI units and radians; of rotations fixed-axis roll, pitch, yaw.
    covariance
        Covariance of the states' errors, in the squared units of the states: the lower triangle, row by row, each from
        the first column to the diagonal. Entry (i, j), j <= i, from 0, stands at i (i + 1) / 2 + j.
    """

    utime: int
    mode: Mode
    phase: Phase
    stationary: bool
    invalid: Invalid
    pose_epoch: int
    latitude_deg: float
    longitude_deg: float
    height: float
    pose: Pose
    linear_velocity: Vector3
    angular_velocity: Vector3
    twist_covariance: tuple[float, ...]
    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RangeSample:
    """Distance from a frame of the vehicle to a beacon at a known position, e.g. of a radio ranging tag.

    Attributes
    ----------
    header
        Time and source; header.utime is the instant the distance holds for.
    frame
        The frame of the vehicle that measures: full name, Body:Frame; 200 characters at most on each side of the colon.
    beacon
        Name of the beacon, for people; 64 characters at most.
    beacon_position
        Position of the beacon in the frame of reference, along its axes, meters.
    frame_of_reference
        The frame that beacon_position is expressed in: World:UTM or World:ENU.
    distance
        Distance from the frame's origin to the beacon, meters, never negative.
    sigma
        Standard deviation of the distance, meters; nan = not known.
    """

    header: SensorHeader
    frame: str
    beacon: str
    beacon_position: Vector3
    frame_of_reference: str
    distance: float
    sigma: float = NAN


@dataclass(frozen=True, slots=True)
class RelativePoseSample:
    """Motion of a frame of the vehicle between two instants, e.g. by visual odometry or scan matching.

    Attributes
    ----------
    header
        Time and source; header.utime is the later of the two instants.
    since_utime
        The earlier instant, microseconds since the Unix epoch (UTC, host's clock), positive, before header.utime.
    frame
        The frame of the vehicle: full name, Body:Frame; 200 characters at most on each side of the colon.
    position
        Position of the frame at the later instant in the frame at the earlier one, along its axes then, meters.
    orientation
        Unit quaternion of the frame at the later instant in the frame at the earlier one, scalar first (w x y z).
    covariance
        Covariance, row-major: x, y, z (m), about x, about y, about z (rad), along the axes of the frame at the earlier
        instant, rotation applied on the left (fixed axes). The first number nan: not known.
    """

    header: SensorHeader
    frame: str
    since_utime: int
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...] | None = None


class ReloadReply(NamedTuple):
    """Reply to reload_model_request_t.

    Attributes
    ----------
    header
        Status of the request. REJECTED: the file is invalid, or does not fit the vehicle; the old geometry stays.
    revision
        Content hash of the geometry in the file; empty unless header.status is OK.
    changes
        What changes, one in a line, in words.
    """

    header: ReplyHeader
    revision: str = ""
    changes: tuple[str, ...] = ()


class ReloadModel(NamedTuple):
    """Reload the geometry file, and use it if it is valid; else nothing changes. Denied unless the vehicle file allows
    it (commands.reload). Answered by reload_model_reply_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    dry_run
        Whether only to report what would change.
    """

    header: RequestHeader
    dry_run: bool = False


class SetHTransform(NamedTuple):
    """Pose.setHTransform: as set_state_vector_request_t, with a homogeneous transform.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    pose
        The base frame's pose in World:UTM, as in set_state_vector_request_t.
    """

    header: RequestHeader
    pose: PoseAnswer


class SetStateVector(NamedTuple):
    """Pose.setStateVector: sets the pose of the vehicle. Denied unless the vehicle file allows it (commands.set_pose).
    Answered by acknowledgement_t.

    Attributes
    ----------
    header
        Id of the request, and the channel of the reply.
    pose
        The base frame's pose in World:UTM; utime 0 is now. Without a covariance, sigmas of 1 m and 5 degrees are
        assumed. The origin must be that of the service, or nan.
    """

    header: RequestHeader
    pose: PoseAnswer


class Envelope(NamedTuple):
    """A command with a message authentication code of the vehicle's key. docs/wire.md specifies the bytes that mac is
    computed over, with an example. Answered as the message in it would be.

    Attributes
    ----------
    key_name
        Which of the vehicle's keys, as the key file names it; 64 characters at most.
    sender
        Name of the sender: one for each program on each computer, the same at every start; 64 characters at most.
    utime
        When it was signed, microseconds since the Unix epoch (UTC).
    counter
        Distinguishes messages of one sender and one utime: (utime, counter) increases with each message.
    channel
        The channel that the message would go out on by itself, without the vehicle's prefix.
    payload
        The message, as it would go out by itself.
    mac
        HMAC-SHA256.
    """

    key_name: str
    sender: str
    utime: int
    counter: int
    channel: str
    payload: bytes
    mac: bytes = bytes(32)


@dataclass(frozen=True, slots=True)
class VehicleCommand:
    """Command to the vehicle controller. The controller stops the vehicle when the last command expires (dead-man
    timeout).

    Attributes
    ----------
    utime
        When the command was given, microseconds since the Unix epoch (UTC).
    valid_for
        The command counts until utime plus this, seconds, positive.
    seq
        Counts the commands of this source, from 0.
    source
        Name of the commanding program.
    forward_speed
        Speed of the vehicle's base frame along its x axis (forward), m/s, forward positive.
    steering_angle
        Steering angle of the equivalent front wheel, radians, to the left positive.
    """

    utime: int
    valid_for: float
    seq: int
    source: str
    forward_speed: float
    steering_angle: float


class VehicleMode(IntEnum):
    """Who drives."""

    UNKNOWN = 0
    """Not known."""
    MANUAL = 1
    """A person drives."""
    AUTONOMOUS = 2
    """A program drives."""
    EMERGENCY_STOP = 3
    """Nobody drives, and the vehicle must not move."""
    FAULT = 4
    """The controller has a fault and accepts no commands."""


@dataclass(frozen=True, slots=True)
class VehicleStatusSample:
    """Status of the vehicle controller.

    Attributes
    ----------
    header
        Time and source.
    mode
        Who drives: one of MODE_UNKNOWN to MODE_FAULT.
    forward_speed
        Forward speed as the controller measures it, m/s, forward positive; nan = not known.
    steering_angle
        Steering angle of the equivalent front wheel, radians, to the left positive; nan = not known.
    supply_voltage
        Battery or supply, volts; nan = not known.
    engine_speed
        Engine or motor speed, rad/s; nan = not known.
    fault_bits
        The controller's own fault words, bit by bit as in its manual.
    commands_rejected
        Commands rejected since the controller started: out of limits, too old, or from an unknown source.
    """

    header: SensorHeader
    mode: VehicleMode = VehicleMode.UNKNOWN
    forward_speed: float = NAN
    steering_angle: float = NAN
    supply_voltage: float = NAN
    engine_speed: float = NAN
    fault_bits: int = 0
    commands_rejected: int = 0


class Direction(IntEnum):
    """Direction of rotation as the encoder measures it."""

    BACKWARD = -1
    """The wheel turns backward."""
    STOPPED = 0
    """The wheel does not turn."""
    FORWARD = 1
    """The wheel turns forward."""
    UNKNOWN = 2
    """The encoder does not measure it; travel and speed have a sign all the same."""
    UNSIGNED = 3
    """Nothing measures it: travel counts up and speed is a magnitude, in both directions."""


@dataclass(frozen=True, slots=True)
class WheelSample:
    """One row of `wheels` of WheelsSample.

    Attributes
    ----------
    name
        Names of the wheels, as the vehicle file knows them, e.g. front_left.
    travel
        Distance travelled since the source started, meters along the ground, forward positive; reversing subtracts
        (UNSIGNED: adds).
    travel_sigma
        Standard deviation of travel, meters.
    speed
        Speed of the wheel's contact point over ground without slip, m/s, forward positive.
    speed_sigma
        Standard deviation of speed, m/s.
    direction
        Direction of rotation as the encoder measures it: one of BACKWARD, STOPPED, FORWARD, UNKNOWN, UNSIGNED.
    steering
        Steering angle of the wheel about the vehicle's up axis, radians, to the left positive; 0 = not steered, nan =
        steered, and not measured by the wheel.
    """

    name: str
    travel: float = NAN
    travel_sigma: float = NAN
    speed: float = NAN
    speed_sigma: float = NAN
    direction: Direction = Direction.UNKNOWN
    steering: float = 0.0


@dataclass(frozen=True, slots=True)
class WheelsSample:
    """Travel and speed of each wheel. Arrays have one entry for each wheel; what was not measured is nan.

    Attributes
    ----------
    header
        Time and source.
    """

    header: SensorHeader
    wheels: tuple[WheelSample, ...]
