"""Raw mode: the pose directly from GPS and IMU, without odometry and without a filter of the pose (report 7.2, C7).

Position is the newest good fix, moved to the base frame by the lever arm, and propagated by speed along the heading.
Roll and pitch are the IMU's, or its gyros' corrected by the specific force. Heading is the course while moving, the
integrated gyro in between, and held while stationary. Limits: docs/raw-mode.md.

Each sample passes the clock monitor of its source first (`estimation.inputs`, without a horizon: raw mode has no
buffer to sort samples in, so a delayed one is rejected). An IMU sample propagates motion and heading; a fix updates
position, heading and speed at its own instant, for which two seconds of motion are stored. After a step back of a
clock all but Odom, origin and biases restarts.

Motion: dead reckoning of the base frame in Odom by angular rate and speed. It never jumps. Attitude is yaw in Odom and
the vertical u along the base frame's axes; with R = Rz(yaw) Ry(pitch) Rx(roll),
u = R' z = (-sin pitch, cos pitch sin roll, cos pitch cos roll). With the angular rate w along the same axes

    u' = -w x u,   yaw' = (w_y u_y + w_z u_z) / (u_y^2 + u_z^2)                                                 (1)

An interval of constant speed and rate is an arc, whose chord points along its middle heading. After `rate_hold` without
a sample the turn stops. Speed is held for twice `gps_timeout` after its fix: the pose is invalid after once, and for as
long again going on is the better guess than a stop.

Roll and pitch: an IMU that reports its orientation gives u itself; its yaw is magnetic or drifts, and is ignored. Else
the specific force f = a - g corrects u ~ f - a. Of the acceleration a of the IMU the centripetal part w x (v + w x r)
is known, with v along the base frame's x and r the lever arm of the IMU. It is used while |f - a| is near g
(complementary filter: R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group", 2008).

Heading: offset o from yaw in Odom to yaw from true east, and bias b of the yaw gyro, each with its variance,

    do' = -db + gyro noise,   db' = random walk                                                                 (2)

A course measures o, a stationary vehicle b. Both updates are written out for two states (R. Brown and P. Hwang,
"Introduction to Random Signals and Applied Kalman Filtering", 2012, 5.5); `covariance` is that of o with b. A course
half a turn off means reverse. One that fits neither direction is rejected; `course_rejections` of them in a row that
agree reset o. Above a sigma of 60 degrees the two directions cannot be separated, and the course resets o too.

Velocity: c = v exp(io), the speed with the direction from Odom's heading to true east. With the receiver's velocity it
is, with the lever arm r of the antenna (before o is known, its direction is that of the velocity itself)

    c = exp(-i yaw) (v_antenna - exp(io) R (w x r))                                                             (3)

Else it is fitted to fixes p with lever arms l along Odom's axes: with s the integral of the unit vector along Odom's
heading (`RawMotion.path`), least squares of p - exp(io) l = p_0 + c s over a segment, on curves as on straights,

    c = sum conj(s_i - mean s) (p_i - exp(io) l_i - mean) / sum |s_i - mean s|^2                                (4)

with the sigma of two ends, sqrt(2) sigma_p / |s|, as errors of fixes last. A long segment has less noise, but shows the
speed of half its time T ago, which has changed by a T / 2 since with a = `usual_acceleration`: sqrt(2) sigma_p / T =
a T / 2 gives the time for the speed. A course is that of the segment since the last one, once its sigma is within
`course_sigma_limit`: that of new errors in the fit, of the time-correlated rest (Gauss-Markov), and of the turn.

Stationary: the gyros and accelerometers are quiet (`filter.sensor_monitors`) and the vehicle is slow by the fixes,
which resolve `stationary_speed` three times only over long enough. Then the heading is held, and the mean rate of each
`stationary_time` measures the bias, unless it is a turn: more than four sigmas of bias and noise.

Position at an instant: p_base = p_antenna + exp(io) (base in Odom - antenna in Odom at the fix)                 (5)
Its covariance is that of the fix plus the growth by its age, `compute_growth`, plus the yaw error on the arm a from the
antenna at the fix to the base frame: yaw variance times (-a_n, a_e)(-a_n, a_e)', which also correlates position with
yaw. Protection levels are those of `filter.protection_levels`, at probability `risk`.

Horizontal vectors are complex numbers, east + i north or along Odom's x + iy. Limits: pitch below 84 degrees; the base
frame moves along its own x. Read top-down from `RawLocalizer.process` -> `_process_imu`, `_process_gps`; `estimate`.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from enum import Enum
from typing import Final, NamedTuple

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, rotation_about_up
from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, ZERO
from modelserver.estimation.filter.protection_levels import (
    LIMIT_RISK,
    compute_factors,
    compute_level,
    compute_limit_risks,
    compute_longest_axis,
)
from modelserver.estimation.filter.sensor_monitors import MAX_FORCE, MAX_RATE, StationaryDetector
from modelserver.estimation.history import LocalizerEvent
from modelserver.estimation.inputs import (
    AcceptedFix,
    ClockMonitor,
    OriginCapture,
    OriginProjection,
    StampVerdict,
    evaluate_fix,
)
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    STALE_SENSORS,
    Estimate,
    GpsSample,
    ImuSample,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    OrientationReference,
    Origin,
    PersistOrigin,
    Quality,
    Rejected,
    Sample,
    SwitchMode,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3, add, cross, scale

HISTORY_STEP_US: Final = 20_000
HISTORY_LENGTH_US: Final = 2_000_000
"""Microseconds between the motions stored for delayed fixes, and how far back they reach."""

MAX_SECONDS: Final = 1e4
"""Seconds of an age or interval that count at most: a stamp may be wrong by years."""

LEVEL: Final[Vector3] = (0.0, 0.0, 1.0)


# --- IMU ----------------------------------------------------------------------------------------------------


class RawImuSample(NamedTuple):
    """Angular rate, specific force and the unit's own vertical along the base axes; None: not measured."""

    rate: Vector3
    force: Vector3 | None
    up: Vector3 | None


def read_raw_imu(sample: ImuSample, X_base_imu: Pose) -> RawImuSample | str:
    """Return the sample along the base axes, or in one word why it cannot be used.

    Unlike `imu_monitor.read_imu` it accepts a unit without accelerometers: rates alone give the heading.
    """
    rate, force, mount = sample.angular_velocity, sample.specific_force, X_base_imu.wxyz
    if rate is None:
        return "nan"
    for v, most in ((rate, MAX_RATE), (force or ZERO, MAX_FORCE)):
        if not max(map(abs, v)) <= most or not math.isfinite(sum(v)):
            return "range" if math.isfinite(sum(v)) else "nan"
    q, up = sample.orientation, None
    if q is not None and sample.orientation_reference != OrientationReference.NONE and 0.9 < math.hypot(*q) < 1.1:
        # the z axis of the reference; in NED it points down
        z = -1.0 if sample.orientation_reference == OrientationReference.NED else 1.0
        up = so3.rotate(mount, so3.rotate_back(so3.normalize(q), (0.0, 0.0, z)))
    return RawImuSample(so3.rotate(mount, rate), None if force is None else so3.rotate(mount, force), up)


def correct_up(up: Vector3, force: Vector3, motion_force: Vector3, gain: float, settings: RawSettings) -> Vector3:
    """Correct the vertical towards the specific force without that of the vehicle's motion, if that is near g."""
    f = add(force, scale(-1.0, motion_force))
    norm = math.hypot(*f)
    if abs(norm - STANDARD_GRAVITY) > settings.tilt_gate:
        return up
    return normalize_up(add(scale(1.0 - gain, up), scale(gain / norm, f)))


# --- attitude -----------------------------------------------------------------------------------------------


def normalize_up(v: Vector3) -> Vector3:
    """Return a vector at unit length; level if it has no length."""
    n = math.hypot(*v)
    return scale(1.0 / n, v) if 1e-9 < n < 1e150 else LEVEL


def _rotate_up(up: Vector3, rate: Vector3, dt: float) -> Vector3:
    """Propagate the vertical by equation (1): exp(-[w dt]x) u to second order, at unit length."""
    turn = scale(-dt, rate)
    first = cross(turn, up)
    return normalize_up(add(up, first, scale(0.5, cross(turn, first))))


def compute_yaw_rate(rate: Vector3, up: Vector3) -> float:
    """Return the yaw rate by equation (1), rad/s."""
    _, b, c = up
    return (rate[1] * b + rate[2] * c) / max(b * b + c * c, 1e-2)


def compute_roll_pitch(up: Vector3) -> tuple[float, float]:
    """Return fixed-axis roll and pitch of a base frame with a vertical, rad."""
    return math.atan2(up[1], up[2]), math.atan2(-up[0], math.hypot(up[1], up[2]))


def compute_attitude(up: Vector3, yaw: float) -> Quaternion:
    """Return the rotation from the base axes to Odom."""
    return so3.from_rpy(*compute_roll_pitch(up), yaw)


# --- motion -------------------------------------------------------------------------------------------------


class RawMotion(NamedTuple):
    """The base frame in Odom at `utime`. A NamedTuple, because a new one is made for every IMU sample.

    Attributes
    ----------
    x, y, z: position, m.
    yaw: rad, not wrapped.
    up: vertical along the base axes.
    rate: angular rate along the base axes without bias, rad/s.
    path: integral of the unit vector along the heading, seconds: the position at a speed of 1 m/s.
    speed, speed_utime, speed_sigma: horizontal, negative in reverse, m/s, with the instant of its fix and its sigma.
    yaw_variance, position_variance: of the drift since the start of Odom (each horizontal axis), rad2 and m2.
    """

    utime: int
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    up: Vector3 = LEVEL
    rate: Vector3 = ZERO
    path: complex = 0j
    speed: float = 0.0
    speed_utime: int = 0
    speed_sigma: float = 0.0
    yaw_variance: float = 0.0
    position_variance: float = 0.0

    @property
    def pose(self) -> Pose:
        """The base frame in Odom."""
        return Pose((self.x, self.y, self.z), compute_attitude(self.up, self.yaw))

    @property
    def yaw_rate(self) -> float:
        """Yaw rate, rad/s."""
        return compute_yaw_rate(self.rate, self.up)

    def propagate(self, utime: int, rate: Vector3, settings: RawSettings) -> RawMotion:
        """Propagate to `utime` with the mean angular rate until then."""
        dt = (utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        turning = min(dt, settings.rate_hold)
        gap = dt - turning
        up = _rotate_up(self.up, rate, turning)
        turn = compute_yaw_rate(rate, self.up) * turning
        yaw = self.yaw + turn
        half = 0.5 * turn
        chord = 1.0 - half * half / 6.0 if abs(half) < 1e-2 else math.sin(half) / half
        arc = cmath.rect(chord, self.yaw + half)
        straight = cmath.rect(1.0, yaw)
        age = max((self.utime - self.speed_utime) * 1e-6, 0.0)
        driving = max(min(dt, 2.0 * settings.gps_timeout - age), 0.0)
        first = self.speed * min(turning, driving)
        rest = self.speed * max(driving - turning, 0.0)
        step = arc * first + straight * rest
        travel = first + rest
        sigma = self.speed_sigma
        # the error of a speed is correlated over about the segment of fixes that it was found from
        drifted = self.position_variance + sigma * sigma * dt * settings.speed_window
        return self._replace(
            utime=utime,
            x=self.x + step.real,
            y=self.y + step.imag,
            z=self.z + travel * up[0] / math.sqrt(max(1.0 - up[0] * up[0], 1e-2)),
            yaw=yaw,
            up=up,
            path=self.path + arc * turning + straight * min(gap, MAX_SECONDS),
            yaw_variance=min(
                self.yaw_variance + settings.gyro_noise**2 * dt + (settings.gap_rate_sigma * gap) ** 2, 1e3
            ),
            position_variance=min(drifted + self.yaw_variance * travel * travel, 1e12),
        )


# --- heading ---------------------------------------------------------------------------------------------------


UNKNOWN_VARIANCE: Final = (math.pi / math.sqrt(3.0)) ** 2
"""Variance of an unknown direction, rad2: uniform over the circle."""

STATIONARY_GATE: Final = 4.0
"""Sigmas that the rate of a stationary vehicle may be off the bias."""


class CourseResult(Enum):
    """What the heading filter did with a course."""

    USED = "used"
    BACKWARDS = "backwards"
    REJECTED = "rejected"
    RESET = "reset"


class Heading(NamedTuple):
    """State of the heading filter: offset (rad) and bias (rad/s) with their covariance; known after the first course.

    `num_rejected` counts the rejected courses in a row that agree; `rejected_offset` is the last of them.
    """

    is_known: bool = False
    offset: float = 0.0
    variance: float = UNKNOWN_VARIANCE
    bias: float = 0.0
    bias_variance: float = 0.0
    covariance: float = 0.0
    num_rejected: int = 0
    rejected_offset: float = 0.0

    @property
    def direction(self) -> complex:
        """exp(i offset), from Odom's horizontal axes to east + i north."""
        return cmath.rect(1.0, self.offset)

    def propagate(self, dt: float, settings: RawSettings, is_held: bool = False) -> Heading:
        """Propagate by equation (2) over `dt` seconds, of which the gyro measures no more than `rate_hold`.

        `is_held`: the vehicle is stationary, and an error of the bias does not turn it.
        """
        if dt <= 0.0:
            return self
        dt = min(dt, MAX_SECONDS)
        gap = max(dt - settings.rate_hold, 0.0)
        before, turning = self.bias_variance, 0.0 if is_held else dt
        variance = self.variance - 2.0 * self.covariance * turning + before * turning * turning
        variance += settings.gyro_noise**2 * dt + (settings.gap_rate_sigma * gap) ** 2
        variance, covariance = max(variance, settings.heading_floor**2), self.covariance - before * turning
        limit = max(before, settings.gyro_bias_sigma**2)
        bias_variance = min(before + settings.gyro_bias_walk**2 * dt, limit)
        if variance >= UNKNOWN_VARIANCE:
            variance, covariance = UNKNOWN_VARIANCE, 0.0
        return Heading(self.is_known, self.offset, variance, self.bias, bias_variance, covariance, *self[6:])

    def is_turning(self, rate: float, variance: float) -> bool:
        """Return whether a yaw rate without bias, rad/s, is more than the biases and its noise explain."""
        return rate * rate > STATIONARY_GATE**2 * (self.bias_variance + variance)

    def update_stationary(self, rate: float, variance: float) -> Heading:
        """Update with the yaw rate of a stationary vehicle, rad/s, less the bias so far; `variance`: of its noise."""
        return self._update(rate, self.covariance, self.bias_variance, self.bias_variance + variance)

    def update_course(self, offset: float, variance: float, settings: RawSettings) -> tuple[Heading, CourseResult]:
        """Update with the offset that a course measures, behind its gate; the first course is taken as forward."""
        if not self.is_known or self.variance > 1.0:
            return self._reset(offset, variance), CourseResult.RESET
        innovation = math.remainder(offset - self.offset, math.tau)
        is_backwards = abs(innovation) > 0.5 * math.pi
        if is_backwards:
            innovation = math.remainder(innovation - math.pi, math.tau)
        s = self.variance + variance
        if innovation * innovation > settings.course_gate**2 * s:
            apart = math.remainder(offset - self.rejected_offset, math.tau)
            agrees = self.num_rejected > 0 and apart * apart <= settings.course_gate**2 * 2.0 * variance
            count = self.num_rejected + 1 if agrees else 1
            if count >= settings.course_rejections:
                return self._reset(offset, variance), CourseResult.RESET
            return self._replace(num_rejected=count, rejected_offset=offset), CourseResult.REJECTED
        updated = self._update(innovation, self.variance, self.covariance, s)
        updated = updated._replace(variance=max(updated.variance, settings.heading_floor**2), num_rejected=0)
        return updated, CourseResult.BACKWARDS if is_backwards else CourseResult.USED

    def _update(self, innovation: float, p1: float, p2: float, s: float) -> Heading:
        """Update with an innovation of variance s; p1 and p2 are the measured state's covariances with o and b."""
        k1, k2 = p1 / s, p2 / s
        return self._replace(
            offset=math.remainder(self.offset + k1 * innovation, math.tau),
            variance=max(self.variance - k1 * p1, 1e-12),
            bias=self.bias + k2 * innovation,
            bias_variance=max(self.bias_variance - k2 * p2, 1e-18),
            covariance=self.covariance - k1 * p2,
        )

    def _reset(self, offset: float, variance: float) -> Heading:
        return Heading(True, math.remainder(offset, math.tau), variance, self.bias, self.bias_variance)


# --- velocity ---------------------------------------------------------------------------------------------------------


class TrackFix(NamedTuple):
    """A fix of the antenna with the motion at its instant.

    Attributes
    ----------
    ecef, sigma: earth-centered position, m, and the sigma of each horizontal axis.
    path, yaw: those of `RawMotion`.
    lever: lever arm of the antenna along Odom's horizontal axes, m.
    """

    utime: int
    ecef: Vector3
    sigma: float
    path: complex
    lever: complex
    yaw: float


class RawVelocity(NamedTuple):
    """The c of equations (3) and (4), m/s, with the sigma of each component, and that of its direction, rad."""

    c: complex
    sigma: float
    course_sigma: float


MAX_TRACK_FIXES: Final = 64
"""Fixes stored: of a longer track every second one is dropped."""

MAX_VELOCITY_LATENCY: Final = 2.0
"""Seconds of latency of a velocity that are credible."""


def append_fix(track: tuple[TrackFix, ...], fix: TrackFix, window: float) -> tuple[TrackFix, ...]:
    """Return a track with one fix more, no longer than `window` seconds, and thinned if it has too many."""
    oldest = fix.utime - int(window * 1e6)
    recent = tuple(each for each in track if each.utime >= oldest)
    return (*(recent[::2] if len(recent) >= MAX_TRACK_FIXES else recent), fix)


def measure_velocity(
    track: tuple[TrackFix, ...], since: float, work: LocalFrame, heading: Heading, settings: RawSettings
) -> RawVelocity | None:
    """Return the velocity by equation (4) of the fixes from `since` (utime) on, at least the last two."""
    fixes = tuple(each for each in track if each.utime >= since)
    fixes = fixes if len(fixes) > 1 else track[-2:]
    first, newest = fixes[0], fixes[-1]
    s = newest.path - first.path
    if abs(s) < 1e-3:
        return None
    direction = heading.direction if heading.is_known else 0j
    places = [complex(*work.from_ecef(each.ecef)[:2]) - direction * each.lever for each in fixes]
    mean_place, mean_path = sum(places) / len(fixes), sum(each.path for each in fixes) / len(fixes)
    off = [each.path - mean_path for each in fixes]
    spread = sum(abs(u) ** 2 for u in off)
    c = sum(u.conjugate() * (p - mean_place) for u, p in zip(off, places, strict=True)) / spread
    sigma = max(each.sigma for each in fixes)
    # the errors of the two ends differ by the share that is new with each fix, and as the rest has changed since
    seconds = (newest.utime - first.utime) * 1e-6
    changed = -2.0 * math.expm1(-seconds / settings.fix_correlation_time) * (1.0 - settings.fix_noise_share**2)
    error = sigma * abs(s) * math.sqrt(settings.fix_noise_share**2 / spread + changed / abs(s) ** 2)
    # the lever arm turns with the heading: before that is known, its turn is an error of the direction
    lever = 0.0 if heading.is_known else abs(newest.lever - first.lever)
    turn = settings.course_turn_share * (newest.yaw - first.yaw)
    course = math.hypot(math.hypot(error, lever) / max(abs(c * s), 1e-3), turn)
    return RawVelocity(c, math.sqrt(2.0) * sigma / abs(s), max(course, settings.heading_floor))


def read_velocity(
    sample: GpsSample, motion: RawMotion, lever: Vector3, heading: Heading, settings: RawSettings
) -> RawVelocity | None:
    """Return the velocity of the receiver by equation (3), or that of its speed and course; None without either.

    Unlike the filter's `read_velocity`: horizontal, with one sigma for both axes, and at any speed.
    """
    sigma, course_sigma = settings.velocity_sigma, math.nan
    if sample.velocity is not None:
        antenna = complex(sample.velocity[0], sample.velocity[1])
        stated = sample.velocity_covariance
        if stated is not None and 0.0 < stated[0] < math.inf and 0.0 < stated[4] < math.inf:
            sigma = math.sqrt(max(stated[0], stated[4]))
    elif math.isfinite(sample.speed) and math.isfinite(sample.course):
        antenna = cmath.rect(sample.speed, sample.course)
        sigma = sample.speed_sigma if 0.0 < sample.speed_sigma < math.inf else sigma
        course_sigma = sample.course_sigma
    else:
        return None
    # a non-finite velocity, or one without information
    if not (abs(antenna) <= 2.0 * settings.maximum_speed and sigma <= settings.maximum_speed):
        return None
    latency = sample.velocity_latency if 0.0 <= sample.velocity_latency <= MAX_VELOCITY_LATENCY else 0.0
    c = antenna * cmath.rect(1.0, motion.yaw_rate * latency - motion.yaw)
    x, y, _ = so3.rotate(motion.pose.wxyz, cross(motion.rate, lever))
    direction = heading.direction if heading.is_known else c / max(abs(c), 1e-9)
    c -= direction * complex(x, y) * cmath.rect(1.0, -motion.yaw)
    if not course_sigma > 0.0:
        course_sigma = sigma / max(abs(c), 1e-3)
    return RawVelocity(c, sigma, max(course_sigma, settings.heading_floor))


# --- position -----------------------------------------------------------------------------------------------


class FixAnchor(NamedTuple):
    """The newest good fix, the tangent plane at it, and its antenna in Odom at its instant, m."""

    utime: int
    fix: AcceptedFix
    work: LocalFrame
    antenna: Vector3


def compute_growth(age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the variance of each axis that a prediction over `age` seconds adds, m2: (s_v t)^2 + (a t^2 / 2)^2."""
    t = min(age, MAX_SECONDS)
    return (speed_sigma * t) ** 2 + (0.5 * settings.usual_acceleration * t * t) ** 2


def compute_covariance(
    horizontal: tuple[float, float, float], up: float, arm: complex, yaw: float, settings: RawSettings
) -> tuple[float, ...]:
    """Return the 36 numbers of a covariance along east, north, up.

    `horizontal` are the variances east and north and their covariance, `up` and `yaw` the other variances; `arm`: see
    the theory.
    """
    (ee, nn, en), ae, an, tilt = horizontal, -arm.imag, arm.real, settings.tilt_sigma**2
    return (
        *(ee + yaw * ae * ae, en + yaw * ae * an, 0.0, 0.0, 0.0, yaw * ae),
        *(en + yaw * ae * an, nn + yaw * an * an, 0.0, 0.0, 0.0, yaw * an),
        *(0.0, 0.0, up, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(yaw * ae, yaw * an, 0.0, 0.0, 0.0, yaw),
    )


# --- localizer -------------------------------------------------------------------------------------------------


class RawLocalizer(NamedTuple):
    """The localizer of raw mode: an immutable value. Create the first with `start`.

    Attributes
    ----------
    projection, capture: of the origin; None until it is set, and the fixes collected for it.
    motion, history: newest motion, and those of the last seconds for delayed fixes.
    tilt_bias: biases of the roll and pitch gyros, rad/s.
    detector, is_slow: whether the IMU is quiet, and whether the vehicle was slow by the newest fix.
    anchor, track, course_utime: the newest good fix, those before it, and when a course was measured last.
    num_rejected: fixes rejected since the last good one, for any reason.
    imu_utime: of the last IMU sample.
    is_clock_stepped: whether the clock was set back and the heading has not been found since.
    utime: instant of the newest sample, 0 before the first.
    """

    mounts: Mounts
    settings: RawSettings
    projection: OriginProjection | None = None
    capture: OriginCapture = OriginCapture()
    motion: RawMotion | None = None
    history: tuple[RawMotion, ...] = ()
    heading: Heading = Heading()
    tilt_bias: tuple[float, float] = (0.0, 0.0)
    detector: StationaryDetector = StationaryDetector()
    is_slow: bool = False
    anchor: FixAnchor | None = None
    track: tuple[TrackFix, ...] = ()
    course_utime: int = 0
    num_rejected: int = 0
    imu_clock: ClockMonitor = ClockMonitor()
    gps_clock: ClockMonitor = ClockMonitor()
    imu_utime: int | None = None
    pose_epoch: int = 0
    is_clock_stepped: bool = False
    utime: int = 0

    @classmethod
    def start(cls, mounts: Mounts, settings: RawSettings | None = None, origin: Origin | None = None) -> RawLocalizer:
        """Return the initial localizer.

        `origin` is the configured or persisted one; None: the first good fixes give it. Raises GeodesyError for an
        invalid origin.
        """
        settings = settings or RawSettings()
        projection = None if origin is None else OriginProjection(Geodesy(origin))
        return cls(mounts, settings, projection, heading=Heading(bias_variance=settings.gyro_bias_sigma**2))

    @property
    def origin(self) -> Origin | None:
        """The origin of World:UTM, None before it is set."""
        return None if self.projection is None else self.projection.geodesy.origin

    def get_motion_at(self, utime: int, newest: RawMotion) -> RawMotion:
        """Return the motion at an instant, propagated from the one before it in the history; the first before all."""
        if utime < newest.utime and self.history:
            newest = next((each for each in reversed(self.history) if each.utime <= utime), self.history[0])
        return newest.propagate(utime, newest.rate, self.settings)

    def is_stationary(self, utime: int) -> bool:
        """Return whether the vehicle is stationary at an instant."""
        return self.is_slow and self.detector.get_quiet_time(utime) >= self.settings.stationary_time

    def process(self, sample: Sample | SwitchMode) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer after a sample, and the events; wheels and joints are ignored.

        Events are `PersistOrigin` and `Rejected("sensor:<source>", reason)`. Reasons: out_of_sequence, duplicate,
        future (stamp); nan, range (numbers); gap (IMU sample after a gap: the turn in it is unknown); no_fix,
        satellites, dilution, sigma (fix); course (fix whose course is not used).
        """
        if not isinstance(sample, ImuSample | GpsSample):
            return self, ()
        utime, is_imu = sample.header.utime, isinstance(sample, ImuSample)
        before = self.imu_clock if is_imu else self.gps_clock
        if utime == before.newest or utime <= 0:
            return self, _reject(sample, "duplicate" if utime > 0 else "out_of_sequence")
        source = ("imu" if is_imu else "gps", "")
        clock, verdict = before.update(source, 0, utime, sample.header.seq, self.settings, horizon=0.0)
        if verdict is StampVerdict.STEPPED_BACK:
            # the samples until the step was confirmed were about as far apart as the last two
            lost = self.settings.clock_jump_samples * (utime - before.sources[source].odd_utime) * 1e-6
            self = self._restart(utime, lost)
        self = self._replace(imu_clock=clock) if is_imu else self._replace(gps_clock=clock)
        if verdict not in (StampVerdict.GOOD, StampVerdict.STEPPED_BACK):
            return self, _reject(sample, verdict.value)
        return self._process_imu(sample) if isinstance(sample, ImuSample) else self._process_gps(sample)

    def _restart(self, utime: int, lost: float) -> RawLocalizer:
        """Return the localizer after its clock was set back: Odom, origin and biases continue, in a new epoch.

        The motion during the `lost` seconds until the step was confirmed is unknown.
        """
        motion, heading, settings = self.motion, self.heading, self.settings
        if motion is not None:
            travel = max(abs(motion.speed), motion.speed_sigma) * lost
            motion = motion._replace(
                utime=utime,
                rate=ZERO,
                speed=0.0,
                speed_utime=0,
                yaw_variance=min(motion.yaw_variance + (settings.gap_rate_sigma * lost) ** 2, 1e3),
                position_variance=min(motion.position_variance + travel * travel, 1e12),
            )
        return RawLocalizer(
            self.mounts,
            settings,
            self.projection,
            self.capture,
            motion,
            heading=Heading(bias=heading.bias, bias_variance=heading.bias_variance),
            tilt_bias=self.tilt_bias,
            pose_epoch=self.pose_epoch + 1,
            is_clock_stepped=True,
            utime=utime,
        )

    def _process_imu(self, sample: ImuSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings, heading = sample.header.utime, self.settings, self.heading
        imu = read_raw_imu(sample, self.mounts.X_base_imu)
        if isinstance(imu, str):
            return self, _reject(sample, imu)
        before, (wx, wy, wz), (bx, by) = self.motion or RawMotion(utime), imu.rate, self.tilt_bias
        rate = (wx - bx, wy - by, wz - heading.bias)
        dt = 0.0 if self.imu_utime is None else (utime - self.imu_utime) * 1e-6
        is_gap = dt > settings.rate_hold
        step, yaw_rate, bias = min(dt, settings.rate_hold), compute_yaw_rate(rate, before.up), heading.bias
        # the turn rate alone: the biases of roll and pitch rates are unknown until the vehicle is stationary
        measured, force, bias_sigma = (0.0, 0.0, yaw_rate + bias), imu.force or ZERO, math.sqrt(heading.bias_variance)
        detector = self.detector.update(utime, measured, force, (0.0, 0.0, bias), bias_sigma, settings)
        is_held = self.is_slow and detector.get_quiet_time(utime) >= settings.stationary_time
        heading = heading.propagate((utime - before.utime) * 1e-6, settings, is_held and before.rate == ZERO)
        if not is_held:
            detector = detector.restart_mean()
        elif detector.sum_time < settings.stationary_time:
            is_held = before.rate == ZERO  # as before
        else:
            mean_rate = detector.mean_stationary_rate[2] - bias
            noise = settings.gyro_noise**2 / detector.sum_time
            is_held = not heading.is_turning(mean_rate, noise)
            if is_held:
                heading, detector = heading.update_stationary(mean_rate, noise), detector.restart_mean()
        self = self._replace(detector=detector, track=() if is_gap or not dt else self.track)
        if is_held:
            gain = step / (settings.tilt_time + step)
            bx, by = bx + gain * rate[0], by + gain * rate[1]
            before, rate = before._replace(speed=0.0, speed_sigma=0.5 * settings.stationary_speed, rate=ZERO), ZERO
        a, b, c = before.rate
        mean = before.rate if is_gap else (0.5 * (a + rate[0]), 0.5 * (b + rate[1]), 0.5 * (c + rate[2]))
        motion = before.propagate(utime, mean if dt else ZERO, settings)
        up = imu.up or motion.up
        if imu.up is None and imu.force is not None:
            gain = step / (settings.tilt_time + step) if dt else 1.0
            v = add((motion.speed, 0.0, 0.0), cross(rate, self.mounts.X_base_imu.xyz))
            up = correct_up(up, imu.force, cross(rate, v), gain, settings)
        motion = motion._replace(up=up, rate=rate)
        after = self._replace(
            motion=motion,
            history=_append_motion(self.history, motion),
            heading=heading,
            tilt_bias=(bx, by),
            imu_utime=utime,
            utime=max(self.utime, utime),
        )
        return after, _reject(sample, "gap") if is_gap else ()

    def _process_gps(self, sample: GpsSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings, lever = sample.header.utime, self.settings, self.mounts.X_base_antenna
        fix = evaluate_fix(sample, settings)
        if not isinstance(fix, str) and self.projection is not None and not self.projection.is_in_zone(fix):
            fix = "range"
        if isinstance(fix, str):
            return self._replace(num_rejected=self.num_rejected + 1), _reject(sample, fix)
        motion, heading = self.motion or RawMotion(utime), self.heading
        ahead = (utime - motion.utime) * 1e-6
        if ahead > settings.imu_timeout:
            # without IMU samples Odom continues by the prediction. If they are merely delayed they must still be
            # integrated from the last one: until the timeout the prediction is for the fix alone
            heading, ahead = heading.propagate(ahead, settings), 0.0
            motion = motion.propagate(utime, motion.rate, settings)
        at = self.get_motion_at(utime, motion)
        antenna = (at.pose @ lever).xyz
        fix = self._complete_height(fix, utime, antenna[2], at.speed_sigma)
        work = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
        arm, since = complex(antenna[0] - at.x, antenna[1] - at.y), utime
        newest = TrackFix(utime, work.ecef, fix.sigma, at.path, arm, at.yaw)
        track = append_fix(self.track, newest, settings.course_window)
        velocity = course = read_velocity(sample, at, lever.xyz, heading, settings)
        if velocity is not None:
            # the speed up to which one velocity may be a stationary vehicle's
            limit = min(settings.stationary_speed + 3.0 * velocity.sigma, settings.course_speed)
            is_slow = abs(velocity.c) <= max(velocity.sigma, limit)
            has_course = abs(velocity.c) >= settings.course_speed
        else:
            noise = math.sqrt(2.0) * fix.sigma
            seconds = min(math.sqrt(2.0 * noise / settings.usual_acceleration), settings.speed_window)
            velocity = measure_velocity(track, utime - seconds * 1e6, work, heading, settings)
            seconds = max(3.0 * noise / settings.stationary_speed, settings.stationary_time)
            slow = measure_velocity(track, utime - seconds * 1e6, work, heading, settings)
            is_slow = slow is not None and max(slow.sigma, 0.5 * abs(slow.c)) <= settings.stationary_speed
            course = measure_velocity(track, since := max(track[0].utime, self.course_utime), work, heading, settings)
            has_course = True
        result, was_known = None, heading.is_known
        speed, speed_sigma = 0.0, settings.stationary_speed / 2.0
        if not (is_slow and self.is_stationary(utime)):
            if course is not None and has_course and course.course_sigma <= settings.course_sigma_limit:
                turn_sigma = settings.gap_rate_sigma * max(ahead - settings.rate_hold, 0.0)
                # a course is that of the middle of its segment: an error of the bias has turned it since
                drift = 0.5e-6 * (utime - since) * math.sqrt(heading.bias_variance)
                variance = course.course_sigma**2 + turn_sigma**2 + drift**2
                heading, result = heading.update_course(cmath.phase(course.c), variance, settings)
            speed, speed_sigma = _compute_speed(velocity, heading, settings)
        projection, capture = self.projection, self.capture
        events: tuple[LocalizerEvent, ...] = ()
        if projection is None:
            capture, origin = capture.add_fix(utime, work.ecef, fix.sigma, settings)
            if origin is not None:
                projection, events = OriginProjection(Geodesy(origin)), (PersistOrigin(origin),)
        if projection is not None:
            projection = projection.at(fix.latitude_deg, fix.longitude_deg, work)
        after = self._replace(
            projection=projection,
            capture=capture,
            motion=motion._replace(speed=speed, speed_utime=utime, speed_sigma=speed_sigma),
            heading=heading,
            is_slow=is_slow,
            anchor=FixAnchor(utime, fix, work, antenna),
            track=track,
            # the path at 1 m/s continues while the vehicle is stationary: no course must reach back into that
            course_utime=self.course_utime if result is None and not is_slow else utime,
            num_rejected=0,
            # the first course turns no pose that was valid
            pose_epoch=self.pose_epoch + int(result is CourseResult.RESET and was_known),
            is_clock_stepped=self.is_clock_stepped and not heading.is_known,
            utime=max(self.utime, utime),
        )
        return after, (_reject(sample, "course") if result is CourseResult.REJECTED else ()) + events

    def _complete_height(self, fix: AcceptedFix, utime: int, antenna_up: float, speed_sigma: float) -> AcceptedFix:
        """Return the fix with a height: its own, else that of the fix before propagated, else the origin's, else 0."""
        before, settings = self.anchor, self.settings
        if not math.isnan(fix.height):
            return fix
        height, sigma = 0.0, settings.unknown_height_sigma
        if before is not None:
            height = before.fix.height + antenna_up - before.antenna[2]
            growth = compute_growth((utime - before.utime) * 1e-6, speed_sigma, settings)
            sigma = min(math.sqrt(before.fix.up_variance + growth), sigma)
        elif self.origin is not None:
            height, sigma = self.origin.height, settings.assumed_height_sigma
        return replace(fix, height=height, up_variance=sigma * sigma)

    def estimate(self, utime: int) -> Estimate:
        """Return the pose of the base frame at an instant: predicted after the newest sample, held before history."""
        settings, newest, anchor, heading = self.settings, self.motion, self.anchor, self.heading
        invalid = self._find_invalid(utime)
        if newest is None:
            return Estimate(utime, Pose.identity(), invalid=invalid, pose_epoch=self.pose_epoch, origin=self.origin)
        motion = self.get_motion_at(utime, newest)
        odom, position, yaw = motion.pose, motion.position_variance, motion.yaw_variance
        in_odom = Estimate(
            utime,
            odom,
            odom_covariance=compute_covariance((position, position, 0.0), position, 0j, yaw, settings),
            invalid=invalid,
            quality=self._find_quality(utime, motion),
            pose_epoch=self.pose_epoch,
            origin=self.origin,
            is_odom_random_walk=True,
        )
        if anchor is None:
            return in_odom
        q, direction, heading_variance = odom.wxyz, 1.0 + 0j, UNKNOWN_VARIANCE
        if heading.is_known:
            q, direction = so3.multiply(rotation_about_up(heading.offset), q), heading.direction
            is_held = self.is_stationary(utime)
            heading_variance = heading.propagate((utime - newest.utime) * 1e-6, settings, is_held).variance
        x, y, z = anchor.antenna
        arm = direction * complex(motion.x - x, motion.y - y)
        growth = compute_growth(max((utime - anchor.utime) * 1e-6, 0.0), newest.speed_sigma, settings)
        fix = anchor.fix
        horizontal = (fix.east_variance + growth, fix.north_variance + growth, fix.cross)
        covariance = compute_covariance(horizontal, fix.up_variance + growth, arm, heading_variance, settings)
        sigma = math.sqrt(compute_longest_axis(covariance[0], covariance[7], covariance[1]))
        heading_sigma = math.sqrt(heading_variance)
        k_horizontal, k_heading = compute_factors(settings.risk)
        levels = compute_level(sigma, 0.0, heading_sigma)
        risks = compute_limit_risks(sigma, heading_sigma, settings.horizontal_limit, settings.heading_limit)
        if heading.is_known and risks[1] > max(risks[0], LIMIT_RISK):
            invalid |= Invalid.STATIONARY_HEADING if self.is_stationary(utime) else Invalid.LIMIT_EXCEEDED
        elif risks[0] > LIMIT_RISK or (heading.is_known and sum(risks) > LIMIT_RISK):
            invalid |= Invalid.LIMIT_EXCEEDED
        enu, utm = _compute_world_poses(self.projection, anchor.work, q, (arm.real, arm.imag, motion.z - z))
        return replace(
            in_odom,
            enu=enu,
            utm=utm,
            covariance=covariance,
            invalid=invalid,
            horizontal_protection_level=k_horizontal * sigma,
            heading_protection_level=min(k_heading * heading_sigma, math.pi),
            horizontal_level=levels[0],
            heading_level=levels[1],
            limit_risk=min(sum(risks), 1.0),
            horizontal_allowance=0.0,
        )

    def defer_estimate(self, utime: int) -> Estimate:
        """Return `estimate(utime)`, computed at once: it is cheap."""
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: raw mode has no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at an instant."""
        return self._find_invalid(utime) & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return whether the vehicle is stationary, and when a fix was last used."""
        return LocalizerSummary(
            Mode.RAW,
            None,
            self.is_stationary(utime),
            0 if self.anchor is None else self.anchor.utime,
            horizontal_limit=self.settings.horizontal_limit,
            heading_limit=self.settings.heading_limit,
        )

    def _find_invalid(self, utime: int) -> Invalid:
        """Return the reasons against an estimate, except for its protection levels."""
        # numbers, not members: combining flags costs more than all else here
        settings, anchor, imu = self.settings, self.anchor, self.imu_utime
        invalid = 0
        if anchor is None:
            invalid |= 1  # NO_FIX
        elif (utime - anchor.utime) * 1e-6 > settings.gps_timeout:
            invalid |= 32  # STALE_GPS
        if imu is None:
            invalid |= 2  # NO_IMU
        elif (utime - imu) * 1e-6 > settings.imu_timeout:
            invalid |= 64  # STALE_IMU
        if self.projection is None:
            invalid |= 4  # NO_ORIGIN
        if not self.heading.is_known:
            invalid |= 8  # NOT_MOVED_YET
        if self.num_rejected >= settings.fix_rejections:
            invalid |= 128  # GPS_REJECTED
        # so far before the newest sample that the clocks differ
        if self.is_clock_stepped or (self.utime - utime) * 1e-6 > settings.imu_timeout:
            invalid |= 512  # CLOCK_STEPPED
        if self.motion is not None and self.motion.up[2] < math.cos(settings.maximum_tilt):
            invalid |= 1024  # TILTED
        return Invalid(invalid)

    def _find_quality(self, utime: int, motion: RawMotion) -> Quality:
        settings = self.settings
        quality = 0
        if self.is_stationary(utime) or abs(motion.speed) < settings.course_speed:
            quality |= 1  # HEADING_FROM_GYRO
        if utime > self.utime:
            quality |= 2  # PREDICTED
        if motion.speed < -max(2.0 * motion.speed_sigma, settings.stationary_speed):
            quality |= 32  # REVERSING
        return Quality(quality)


def _reject(sample: ImuSample | GpsSample, reason: str) -> tuple[LocalizerEvent, ...]:
    return (Rejected(f"sensor:{sample.header.source}", reason),)


def _append_motion(history: tuple[RawMotion, ...], motion: RawMotion) -> tuple[RawMotion, ...]:
    """Return the history with a motion more, thinned and limited in length."""
    if history and motion.utime - history[-1].utime < HISTORY_STEP_US:
        return history
    oldest = motion.utime - HISTORY_LENGTH_US
    first = next((n for n, each in enumerate(history) if each.utime >= oldest), len(history))
    return (*history[first:], motion)


def _compute_speed(velocity: RawVelocity | None, heading: Heading, settings: RawSettings) -> tuple[float, float]:
    """Return the speed along the heading and its sigma.

    Before the heading is known, motion is taken as forward, and speed within three sigmas as 0.
    """
    if velocity is None:
        return 0.0, settings.maximum_speed / 2.0
    if heading.is_known:
        along = (velocity.c * heading.direction.conjugate()).real
    else:
        along = abs(velocity.c) if abs(velocity.c) > 3.0 * velocity.sigma else 0.0
    return max(-settings.maximum_speed, min(along, settings.maximum_speed)), velocity.sigma


def _compute_world_poses(
    projection: OriginProjection | None, work: LocalFrame, q: Quaternion, position: Vector3
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM from that along a tangent plane; None out of range."""
    if projection is None:
        return None, None
    geodesy, ecef = projection.geodesy, work.to_ecef(position)
    try:
        utm = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(projection.tangent_from_work, q)),
        Pose(utm, so3.multiply(rotation_about_up(projection.convergence), q)),
    )
