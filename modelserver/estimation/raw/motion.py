"""Motion, heading and stationary detection of raw mode, and the fits of recent fixes.

Motion: dead reckoning of the base frame in Odom by angular rate and speed. It never jumps.

Attitude is yaw in Odom and the vertical u along the base frame's axes; with R = Rz(yaw) Ry(pitch) Rx(roll),
u = R' z = (-sin pitch, cos pitch sin roll, cos pitch cos roll). With the angular rate w along the same axes

    u' = -w x u,   yaw' = (w_y u_y + w_z u_z) / (u_y^2 + u_z^2)                                                 (1)

the latter being (w_y sin roll + w_z cos roll) / cos pitch. Position follows the speed along the heading; an interval of
constant speed and rate is an arc, whose chord points along its middle heading.

Roll and pitch: an IMU that reports its orientation gives u itself; its yaw is magnetic or drifts, and is ignored.
Else the specific force f corrects u. f = a - g, so u ~ f - a; of the acceleration a of the IMU the centripetal part
w x (v + w x r) is known, with v along the base frame's x and r the lever arm of the IMU. It is used while |f - a| is
near g (complementary filter: R. Mahony et al., "Nonlinear complementary filters on the special orthogonal group",
2008).

After `rate_hold` without a sample the turn stops; speed is held for `gps_timeout` after its fix, and decays with the
same time constant. Both are closed forms of time: one long step and many short ones end at the same place.

Limits: pitch below 84 degrees; the base frame moves along its own x.

Heading: a Kalman filter of two states.

States: `offset` o, from yaw in Odom to yaw from true east, and `bias` b of the yaw gyro. Yaw is integrated in Odom
without the bias, so the errors follow

    do' = -db + gyro noise,   db' = random walk                                                                 (2)

A course measures o, a stationary vehicle b. Both updates are written out for two states (R. Brown and P. Hwang,
"Introduction to Random Signals and Applied Kalman Filtering", 2012, 5.5); `covariance` is that of o with b.

Gate of a course: a course half a turn off means reverse. One that fits neither direction is rejected;
`course_rejections` of them in a row that agree reset o. Above a sigma of 60 degrees the two directions cannot be
separated, and the course resets o too.

Limits: one course is forward or backward, never sideways; side slip goes into o. The variance has the floor
`heading_floor` and the ceiling of a direction of which nothing is known.

Speed and course: let u be the integral of the unit vector along Odom's heading (`RawMotion.path`), as a complex number.
A vehicle of constant speed v, whose heading is Odom's plus b, is at p = p_0 + v exp(ib) u. So c = v exp(ib) is the
straight-line fit

    c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2,   variance s^2 / sum |u_i - mean u|^2     (3)

of fixes p_i with noise s, on curves as on straights. The lever arm of the antenna, exp(ib) w_i, is subtracted first.
`filter.heading_alignment` fits the same line once per fix; here running sums give the fits of all segments that end
at the newest fix, of which the best is used.
For the speed, noise falls with the length T of the segment. But a fit gives the speed T/2 ago, which has changed by
about `usual_acceleration` T/2 since: the segment with the smallest sum of both is used.
For the course, beside the noise of the fit, sigma includes the time-correlated part of the error of a fix, which
changes by sigma sqrt(2 (1 - exp(-T / tau))) over the segment, and the turn, in which speed is not constant.

Stationary: the gyro is quiet, and the fixes do not move.

Gyro (`QuietDetector`): running mean and variance of the yaw rate without bias. The mean may be off zero by the
uncertainty of the bias and its own noise: the better the bias is known, the slower a turn is found. A gyro that is not
quiet ends the stationary state at once; to start it needs a fix.

Fixes (`StationaryPlace`): a creeping vehicle looks stationary from fix to fix. So the place where it stopped is stored
with the bias at that time, and a fix that is four sigmas away, or a mean receiver velocity that is not 0, shows that it
has left: the bias found since may be a turn and is revoked. A creep of `stationary_speed` shows after the detection
time t_d = 4 sqrt(2) sigma / stationary_speed (20 s at a sigma of 0.5 m). Only after 2 t_d is the bias certain, and a
vehicle that has left a place creeping must stay for 3 t_d at the next one.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from enum import Enum
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, ZERO
from modelserver.estimation.filter.sensor_monitors import MAX_FORCE
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3, cross

LEVEL: Final[Vector3] = (0.0, 0.0, 1.0)

MAX_PATH_TIME: Final = 60.0
"""Seconds of a gap that count in the path: no segment of fixes spans it, and a stamp may be wrong by years."""

MAX_RATE: Final = 50.0
"""rad/s: above the range of any gyro for a vehicle."""


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
    rate, force = sample.angular_velocity, sample.specific_force
    if rate is None:
        return "nan"
    reason = _find_fault(rate, MAX_RATE) or ("" if force is None else _find_fault(force, MAX_FORCE))
    if reason:
        return reason
    mount = X_base_imu.wxyz
    if force is not None:
        force = so3.rotate(mount, force)
    return RawImuSample(so3.rotate(mount, rate), force, _read_up(sample, mount))


def _find_fault(v: Vector3, most: float) -> str:
    if not math.isfinite(v[0] + v[1] + v[2]):
        return "nan"
    return "range" if max(map(abs, v)) > most else ""


def _read_up(sample: ImuSample, mount: Quaternion) -> Vector3 | None:
    """Return the vertical by the unit's orientation, along the base axes; None if it reports no valid one."""
    q, reference = sample.orientation, sample.orientation_reference
    if q is None or reference == OrientationReference.NONE:
        return None
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    if not 0.81 < n < 1.21:
        return None
    # third row of R(q): the z axis of the reference along the sensor's axes; in NED it points down
    s = (-1.0 if reference == OrientationReference.NED else 1.0) / n
    up = (2.0 * s * (x * z - w * y), 2.0 * s * (y * z + w * x), s * (w * w - x * x - y * y + z * z))
    return so3.rotate(mount, up)


def correct_up(
    up: Vector3, force: Vector3, rate: Vector3, speed: float, lever: Vector3, dt: float, settings: RawSettings
) -> Vector3:
    """Correct the vertical towards the specific force without the centripetal acceleration, if that is near g."""
    a, b, c = rate
    x, y, z = lever
    i, j, k = cross(rate, (speed + b * z - c * y, c * x - a * z, a * y - b * x))
    f = (force[0] - i, force[1] - j, force[2] - k)
    norm = _compute_norm(f)
    if abs(norm - STANDARD_GRAVITY) > settings.tilt_gate:
        return up
    gain = min(dt, settings.rate_hold) / (settings.tilt_time + dt) / norm
    keep = 1.0 - gain * norm
    return normalize_up((keep * up[0] + gain * f[0], keep * up[1] + gain * f[1], keep * up[2] + gain * f[2]))


def get_first_up(imu: RawImuSample) -> Vector3 | None:
    """Return the vertical by a first sample; None if it measures none."""
    if imu.up is not None or imu.force is None:
        return imu.up
    return normalize_up(imu.force) if 0.5 < _compute_norm(imu.force) / STANDARD_GRAVITY < 1.5 else None


# --- attitude -----------------------------------------------------------------------------------------------


def _compute_norm(v: Vector3) -> float:
    x, y, z = v
    return math.sqrt(x * x + y * y + z * z)


def normalize_up(v: Vector3) -> Vector3:
    """Return a vector at unit length; level if it has no length."""
    n = _compute_norm(v)
    return (v[0] / n, v[1] / n, v[2] / n) if 1e-9 < n < 1e150 else LEVEL


def _rotate_up(up: Vector3, rate: Vector3, dt: float) -> Vector3:
    """Propagate the vertical by equation (1): exp(-[w dt]x) u to second order, at unit length."""
    turn = (-rate[0] * dt, -rate[1] * dt, -rate[2] * dt)
    first = cross(turn, up)
    (x, y, z), (u, v, w), (i, j, k) = up, first, cross(turn, first)
    return normalize_up((x + u + 0.5 * i, y + v + 0.5 * j, z + w + 0.5 * k))


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


def to_level_axes(up: Vector3, v: Vector3) -> Vector3:
    """Return a vector of the base axes along level axes of the same yaw: Ry(pitch) Rx(roll) v."""
    a, b, c = up
    cp = max(math.hypot(b, c), 1e-9)
    sr, cr, sp = b / cp, c / cp, -a
    down = sr * v[1] + cr * v[2]
    return (cp * v[0] + sp * down, cr * v[1] - sr * v[2], cp * down - sp * v[0])


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
        middle = self.yaw + half
        arc = complex(math.cos(middle), math.sin(middle)) * chord
        straight = complex(math.cos(yaw), math.sin(yaw)) if dt > turning else 0j
        first = self._compute_travel(0.0, turning, settings)
        rest = self._compute_travel(turning, dt, settings) if dt > turning else 0.0
        step = arc * first + straight * rest
        travel = first + rest
        sigma = self.speed_sigma
        # the error of a speed is correlated over about the segment of fixes that it was found from
        drifted = self.position_variance + sigma * sigma * dt * settings.speed_window
        return RawMotion(
            utime,
            self.x + step.real,
            self.y + step.imag,
            self.z + travel * up[0] / math.sqrt(max(1.0 - up[0] * up[0], 1e-2)),
            yaw,
            up,
            self.rate,
            self.path + arc * turning + straight * min(gap, MAX_PATH_TIME),
            self.speed,
            self.speed_utime,
            sigma,
            min(self.yaw_variance + settings.gyro_noise**2 * dt + (settings.gap_rate_sigma * gap) ** 2, 1e3),
            min(drifted + self.yaw_variance * travel * travel, 1e12),
        )

    def _compute_travel(self, start: float, end: float, settings: RawSettings) -> float:
        """Return the distance travelled between two times after `utime`, seconds."""
        speed = self.speed
        if speed == 0.0:
            return 0.0
        age = max((self.utime - self.speed_utime) * 1e-6, 0.0)
        hold = settings.gps_timeout
        if age + end <= hold:
            return speed * (end - start)
        return speed * (_integrate_decay(age + end, hold) - _integrate_decay(age + start, hold))


def _integrate_decay(age: float, hold: float) -> float:
    """Return the integral from 0 to `age` of 1, held for `hold` and then decaying with that time constant."""
    return age if age <= hold else hold + hold * -math.expm1((hold - age) / hold)


def interpolate_motion(a: RawMotion, b: RawMotion, utime: int) -> RawMotion:
    """Return the motion at an instant between two; speed and variances are those of the later one."""
    span = b.utime - a.utime
    if span <= 0:
        return b
    f = (utime - a.utime) / span

    def mix(p: float, q: float) -> float:
        return p + (q - p) * f

    def mix_vectors(p: Vector3, q: Vector3) -> Vector3:
        return (mix(p[0], q[0]), mix(p[1], q[1]), mix(p[2], q[2]))

    return b._replace(
        utime=utime,
        x=mix(a.x, b.x),
        y=mix(a.y, b.y),
        z=mix(a.z, b.z),
        yaw=mix(a.yaw, b.yaw),
        up=normalize_up(mix_vectors(a.up, b.up)),
        rate=mix_vectors(a.rate, b.rate),
        path=a.path + (b.path - a.path) * f,
    )


# --- heading ---------------------------------------------------------------------------------------------------


UNKNOWN_VARIANCE: Final = (math.pi / math.sqrt(3.0)) ** 2
"""Variance of an unknown direction, rad2: uniform over the circle."""

STATIONARY_GATE: Final = 4.0
"""Sigmas that the rate of a stationary vehicle may be off the bias."""

MAX_STEP: Final = 1e4
"""Seconds of one propagation at most: a stamp may be wrong by years."""


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
    def sigma(self) -> float:
        """Sigma of the heading, rad."""
        return math.sqrt(self.variance)

    @property
    def direction(self) -> complex:
        """exp(i offset), from Odom's horizontal axes to east + i north."""
        return cmath.rect(1.0, self.offset)

    def propagate(self, dt: float, settings: RawSettings, measured: bool = True) -> Heading:
        """Propagate by equation (2) over `dt` seconds; `measured`: whether the gyro measured the turn.

        It measures no more than `rate_hold` of a longer interval.
        """
        if dt <= 0.0:
            return self
        if measured and dt > settings.rate_hold:
            held = self.propagate(settings.rate_hold, settings)
            return held.propagate(dt - settings.rate_hold, settings, measured=False)
        before = self.bias_variance
        dt = min(dt, MAX_STEP)
        variance = self.variance - 2.0 * self.covariance * dt + before * dt * dt + settings.gyro_noise**2 * dt
        if not measured:
            variance += (settings.gap_rate_sigma * dt) ** 2
        variance = max(variance, settings.heading_floor**2)
        covariance = self.covariance - before * dt
        limit = settings.gyro_bias_sigma**2
        bias_variance = before + settings.gyro_bias_walk**2 * dt
        if bias_variance > limit:
            bias_variance = max(before, limit)
        if variance >= UNKNOWN_VARIANCE:
            variance, covariance = UNKNOWN_VARIANCE, 0.0
        return Heading(self.is_known, self.offset, variance, self.bias, bias_variance, covariance, *self[6:])

    def update_stationary(self, rate: float, variance: float) -> Heading:
        """Update with the yaw rate of a stationary vehicle, rad/s: what the bias so far leaves of it, with its noise.

        A rate outside the gate is a turn, and changes nothing.
        """
        s = self.bias_variance + variance
        if rate * rate > STATIONARY_GATE**2 * s:
            return self
        k1, k2 = self.covariance / s, self.bias_variance / s
        return Heading(
            self.is_known,
            math.remainder(self.offset + k1 * rate, math.tau),
            max(self.variance - k1 * self.covariance, 1e-12),
            self.bias + k2 * rate,
            max(self.bias_variance * (1.0 - k2), 1e-18),
            self.covariance * (1.0 - k2),
            *self[6:],
        )

    def revoke_stationary(self, bias: float, bias_variance: float, seconds: float) -> Heading:
        """Restore bias and variance of `seconds` ago: the vehicle moved, so the bias found since may be a turn."""
        turned = (self.bias - bias) * seconds
        return self._replace(
            variance=min(self.variance + turned * turned + bias_variance * seconds * seconds, UNKNOWN_VARIANCE),
            bias=bias,
            bias_variance=max(bias_variance, self.bias_variance),
            covariance=0.0,
        )

    def inflate(self, variance: float) -> Heading:
        return self._replace(variance=min(self.variance + variance, UNKNOWN_VARIANCE))

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
        k1, k2 = self.variance / s, self.covariance / s
        updated = Heading(
            True,
            math.remainder(self.offset + k1 * innovation, math.tau),
            max(self.variance * (1.0 - k1), settings.heading_floor**2),
            self.bias + k2 * innovation,
            max(self.bias_variance - k2 * self.covariance, 1e-18),
            self.covariance * (1.0 - k1),
        )
        return updated, CourseResult.BACKWARDS if is_backwards else CourseResult.USED

    def _reset(self, offset: float, variance: float) -> Heading:
        return Heading(True, math.remainder(offset, math.tau), variance, self.bias, self.bias_variance)


# --- speed and course of recent fixes -----------------------------------------------------------------------


class TrackFix(NamedTuple):
    """A fix of the antenna, all horizontal and complex (east + i north of the working frame), meters.

    Attributes
    ----------
    position, sigma: of the fix, and of each of its axes.
    path: `RawMotion.path` at its instant, seconds.
    lever: lever arm of the antenna along Odom's axes.
    yaw: in Odom, rad.
    ecef: the position, earth-centered.
    """

    utime: int
    position: complex
    sigma: float
    path: complex
    lever: complex
    yaw: float
    ecef: Vector3 = ZERO


MAX_TRACK_FIXES: Final = 32
"""Fixes stored: of a longer segment every second one is dropped."""


class SpeedFit(NamedTuple):
    """A fit of equation (3).

    Attributes
    ----------
    velocity, sigma: c and the sigma of each of its components, m/s.
    seconds, length, turned: duration of the segment, distance travelled (m) and angle turned (rad).
    """

    velocity: complex
    sigma: float
    seconds: float
    length: float
    turned: float


def append_fix(fixes: tuple[TrackFix, ...], fix: TrackFix, window: float) -> tuple[TrackFix, ...]:
    """Return a segment with one fix more, no longer than `window` seconds, and thinned if it has too many."""
    oldest = fix.utime - int(window * 1e6)
    segment = tuple(each for each in fixes if each.utime >= oldest)
    return (*(segment[::2] if len(segment) >= MAX_TRACK_FIXES else segment), fix)


def fit_speeds(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Iterator[SpeedFit]:
    """Yield the fits of the last 2, 3, ... fixes; `direction` is exp(ib), or 0 to leave the lever arm in."""
    if len(fixes) < 2:
        return
    newest = fixes[-1]
    n, su, sp, suu, sup, ss = 0, 0j, 0j, 0.0, 0j, 0.0
    turned, yaw = 0.0, newest.yaw
    last_position = newest.position - direction * newest.lever
    for fix in reversed(fixes):
        u = fix.path - newest.path
        p = fix.position - direction * fix.lever - last_position
        n += 1
        su += u
        sp += p
        suu += u.real * u.real + u.imag * u.imag
        sup += u.conjugate() * p
        ss += fix.sigma
        turned += abs(fix.yaw - yaw)
        yaw = fix.yaw
        spread = suu - (su.real * su.real + su.imag * su.imag) / n
        if n < 2 or spread < 1e-6:
            continue
        velocity = (sup - su.conjugate() * sp / n) / spread
        noise = settings.fix_noise_share * ss / n
        seconds = (newest.utime - fix.utime) * 1e-6
        yield SpeedFit(velocity, noise / math.sqrt(spread), seconds, abs(velocity) * abs(u), turned)


def fit_best_speed(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    """Return the fit with the smallest error of the present speed; its sigma includes the change of speed since."""
    best: SpeedFit | None = None
    for fit in fit_speeds(fixes, direction, settings):
        if fit.seconds > settings.speed_window:
            break
        sigma = math.hypot(fit.sigma, 0.5 * settings.usual_acceleration * fit.seconds)
        if best is None or sigma < best.sigma:
            best = fit._replace(sigma=sigma)
    return best


def fit_course(
    fixes: Sequence[TrackFix], direction: complex | None, settings: RawSettings
) -> tuple[float, float] | None:
    """Return the heading offset b of the whole segment and its sigma, rad; None if it does not show one."""
    fit = _fit_whole(fixes, direction or 0j, settings)
    if direction is None:
        # the lever arm turns with the heading to be found: two iterations converge
        for _ in range(2):
            if fit is None or abs(fit.velocity) < 1e-9:
                return None
            fit = _fit_whole(fixes, fit.velocity / abs(fit.velocity), settings)
    if fit is None or fit.length < 1e-9:
        return None
    correlated = math.sqrt(max(1.0 - settings.fix_noise_share**2, 0.0)) * fixes[-1].sigma
    changed = correlated * math.sqrt(-2.0 * math.expm1(-fit.seconds / settings.fix_correlation_time))
    turn = settings.course_turn_share * fit.turned
    return cmath.phase(fit.velocity), math.hypot(fit.sigma / abs(fit.velocity), changed / fit.length, turn)


def _fit_whole(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    fit = None
    for fit in fit_speeds(fixes, direction, settings):  # noqa: B007
        pass
    return fit


def is_slow_by_fixes(fixes: Sequence[TrackFix], settings: RawSettings) -> bool:
    """Return whether by its fixes the vehicle may be stationary.

    The segment is the shortest that resolves a third of `stationary_speed`, or else all fixes if they resolve that.
    """
    found: SpeedFit | None = None
    for fit in fit_speeds(fixes, 0j, settings):
        # the path of a stationary vehicle is straight at 1 m/s, thus time: the fit is its velocity
        if fit.seconds >= settings.stationary_time and fit.sigma <= settings.stationary_speed:
            found = fit
            if fit.sigma <= settings.stationary_speed / 3.0:
                break
    return found is not None and abs(found.velocity) <= 2.0 * settings.stationary_speed


# --- stationary ------------------------------------------------------------------------------------------------


MOVED_SIGMAS: Final = 4.0
"""Sigmas of the distance of two fixes (or of the mean velocity) above which the vehicle has moved."""

PLACE_WINDOW: Final = 100.0
"""Seconds after which the place is set again: a bias that only drifts is not taken for a turn since."""

CONFIRM_TIMES: Final = 3.0
"""Detection times, or times `stationary_time` with receiver velocity, for which a place must be held."""

QUIET_SIGMAS: Final = 4.0
"""Sigmas of bias and noise that the mean rate of a stationary vehicle may be off zero."""


class StationaryPlace(NamedTuple):
    """Where the vehicle stopped.

    Attributes
    ----------
    fix: the fix there.
    bias, bias_variance: of the yaw gyro at that time.
    is_creeping: whether it left the place before slowly: then it must hold this one for longer.
    velocity, num_velocities: sum and number of the receiver velocities since, m/s.
    """

    fix: TrackFix
    bias: float
    bias_variance: float
    is_creeping: bool = False
    velocity: complex = 0j
    num_velocities: int = 0

    @classmethod
    def at(cls, fix: TrackFix, heading: Heading, is_creeping: bool = False) -> StationaryPlace:
        return cls(fix, heading.bias, heading.bias_variance, is_creeping)

    def has_left(self, fix: TrackFix, velocity_sigma: float, settings: RawSettings) -> bool:
        """Return whether a fix or the mean of the velocities shows that the vehicle has left."""
        if abs(fix.position - self.fix.position) > MOVED_SIGMAS * math.hypot(self.fix.sigma, fix.sigma):
            return True
        if self.num_velocities == 0:
            return False
        mean = abs(self.velocity) / self.num_velocities
        return mean > MOVED_SIGMAS * velocity_sigma / math.sqrt(self.num_velocities) + settings.stationary_speed / 3.0

    def get_detection_time(self, settings: RawSettings) -> float:
        """Return after how many seconds the fixes show a creep of `stationary_speed`."""
        return MOVED_SIGMAS * math.sqrt(2.0) * self.fix.sigma / settings.stationary_speed

    def is_bias_certain(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the place was held for so long that a rate is the bias, not a slow turn."""
        age = (utime - self.fix.utime) * 1e-6
        is_measured = self.num_velocities > 0 and age >= CONFIRM_TIMES * settings.stationary_time
        return is_measured or age >= 2.0 * self.get_detection_time(settings)

    def inflate_heading(self, utime: int, dt: float, heading: Heading, settings: RawSettings) -> Heading:
        """Inflate the heading of a stationary vehicle: the change of its bias may be a turn until it is certain."""
        age = (utime - self.fix.utime) * 1e-6
        if not 0.0 < age < 2.0 * self.get_detection_time(settings):
            return heading
        return heading.inflate((heading.bias - self.bias) ** 2 * (2.0 * age + dt) * dt)

    def update(
        self, fix: TrackFix, velocity_sigma: float, heading: Heading, settings: RawSettings
    ) -> tuple[StationaryPlace, bool]:
        """Return the place after a fix of a slow vehicle, and whether the vehicle may be stationary."""
        if self.has_left(fix, velocity_sigma, settings):
            return StationaryPlace.at(fix, heading, is_creeping=True), False
        age = (fix.utime - self.fix.utime) * 1e-6
        if not self.is_creeping:
            return (self if age < PLACE_WINDOW else StationaryPlace.at(fix, heading)), True
        is_resolved = (
            self.num_velocities > 0
            and 3.0 * MOVED_SIGMAS * velocity_sigma / math.sqrt(self.num_velocities) < settings.stationary_speed
        )
        if age >= CONFIRM_TIMES * self.get_detection_time(settings) or (
            is_resolved and age >= CONFIRM_TIMES * settings.stationary_time
        ):
            return self._replace(is_creeping=False), True
        return self, False


def update_stationary(
    place: StationaryPlace | None,
    is_slow: bool,
    is_stationary: bool,
    fix: TrackFix,
    velocity: tuple[complex, float] | None,
    least_speed: float,
    heading: Heading,
    settings: RawSettings,
) -> tuple[StationaryPlace, Heading, bool]:
    """Return place and heading after a fix, and whether the vehicle may be stationary.

    Parameters
    ----------
    is_slow, is_stationary: by recent fixes; so far.
    velocity: of the receiver, with its sigma.
    least_speed: of the vehicle before the fix, m/s.
    """
    if place is None or not (is_slow or least_speed < settings.course_speed):
        return StationaryPlace.at(fix, heading), heading, is_slow
    velocity_sigma = 0.0
    if velocity is not None:
        place = place._replace(velocity=place.velocity + velocity[0], num_velocities=place.num_velocities + 1)
        velocity_sigma = velocity[1]
    after, may_be_stationary = place.update(fix, velocity_sigma, heading, settings)
    if not (place.is_creeping or is_slow or is_stationary):
        after = after._replace(is_creeping=False)  # it left at speed
    if is_stationary and not may_be_stationary:
        heading = heading.revoke_stationary(place.bias, place.bias_variance, (fix.utime - place.fix.utime) * 1e-6)
        after = after._replace(bias=heading.bias, bias_variance=heading.bias_variance)
    return after, heading, may_be_stationary and is_slow


class QuietDetector(NamedTuple):
    """Running mean and variance of the yaw rate, rad/s, since when it is quiet, and whether the newest fix was slow."""

    mean: float = 0.0
    variance: float = 1.0
    quiet_utime: int | None = None
    is_slow: bool = False

    def update(self, utime: int, rate: float, dt: float, bias_sigma: float, settings: RawSettings) -> QuietDetector:
        """Return the detector after a yaw rate without bias; the time constant is half of `stationary_time`."""
        gain = dt / (0.5 * settings.stationary_time + dt)
        deviation = rate - self.mean
        mean = self.mean + gain * deviation
        variance = (1.0 - gain) * (self.variance + gain * deviation * deviation)
        noise = max(settings.gyro_noise**2 / settings.stationary_time, 0.5 * gain * variance)
        most = min(
            settings.stationary_rate + 3.0 * bias_sigma, QUIET_SIGMAS * math.sqrt(bias_sigma * bias_sigma + noise)
        )
        if not (variance <= settings.stationary_rate**2 and abs(mean) <= most):
            return QuietDetector(mean, variance)
        return QuietDetector(mean, variance, utime if self.quiet_utime is None else self.quiet_utime, self.is_slow)

    def is_stationary(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the vehicle is stationary at an instant."""
        since = self.quiet_utime
        return self.is_slow and since is not None and (utime - since) * 1e-6 >= settings.stationary_time
