"""Raw mode: the pose directly from GPS and IMU, without odometry (report 7.2, C7).

Position is the last good fix, moved to the base frame by the lever arm and propagated by speed along the heading. Roll
and pitch are the IMU's, or its gyros' corrected by the specific force. Heading is the course while moving, and the
integrated gyro in between. A stationary vehicle shows the biases of the gyros (motion.py). Equations and limits
together: docs/raw-mode.md.

Each sample passes its source's clock monitor first. An IMU sample propagates motion and heading; a fix updates
position, heading and speed at its own instant, for which two seconds of motion are stored. After a step back of the
clock all but Odom, origin and biases restarts.

Clock monitor: a stamp is odd if it is not later than the last good one, or more than `clock_jump` ahead of it. A single
one is an error of its sample; `clock_jump_samples` in a row in ascending order show that the clock was set. Delayed
samples fill the gaps between good stamps. Those of a clock that was set back cover a time that good stamps have covered
already, so between two of them lies a good one. `ClockMonitor` has the same rules for sources that share a
horizon; here a delayed sample is rejected, because raw mode has no buffer to sort samples in.

Speed and course are fitted to recent fixes (motion.py), or are those of the receiver. Its antenna velocity becomes that
of the base frame by

    v_base = v_antenna - exp(ib) R (w x r)                                                                      (1)

with the lever arm r; before b is known, its direction is that of the velocity itself.

Position at an instant: p_base = p_antenna + exp(ib) (travel in Odom since the fix - lever arm at the fix)      (2)
Its covariance is that of the fix plus the growth by its age, `compute_growth`, plus the yaw error on the arm a from the
antenna at the fix to the base frame: yaw variance times (-a_n, a_e)(-a_n, a_e)', which also correlates position with
yaw. Protection levels are those of `filter.protection_levels`, at probability `risk`. World:UTM and World:ENU are each
computed from the earth-centered position.

Read top-down from the end of the file: `RawLocalizer.process` -> `_process_imu`, `_process_gps`; `compute_estimate`.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import Final, NamedTuple

from modelserver.earth.geodesy import (
    Geodesy,
    GeodesyError,
    LocalFrame,
    ecef_from_geodetic,
    geodetic_from_ecef,
    rotation_about_up,
)
from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.filter.protection_levels import (
    LIMIT_RISK,
    compute_factors,
    compute_level,
    compute_limit_risks,
    compute_longest_axis,
)
from modelserver.estimation.history import LocalizerEvent
from modelserver.estimation.inputs import (
    RECENT_STAMPS,
    AcceptedFix,
    OriginCapture,
    OriginProjection,
    StampVerdict,
    evaluate_fix,
    has_covered,
)
from modelserver.estimation.raw.motion import (
    UNKNOWN_VARIANCE,
    CourseResult,
    Heading,
    QuietDetector,
    RawImuSample,
    RawMotion,
    StationaryPlace,
    TrackFix,
    append_fix,
    compute_yaw_rate,
    correct_up,
    fit_best_speed,
    fit_course,
    get_first_up,
    interpolate_motion,
    is_slow_by_fixes,
    read_raw_imu,
    to_level_axes,
    update_stationary,
)
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    NAN,
    STALE_SENSORS,
    Estimate,
    GpsSample,
    ImuSample,
    Invalid,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PersistOrigin,
    Quality,
    Rejected,
    Sample,
    SwitchMode,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3, cross

HISTORY_STEP_US: Final = 20_000
HISTORY_LENGTH_US: Final = 2_000_000
"""Microseconds between the motions stored for delayed fixes, and how far back they reach."""


# --- stamps ----------------------------------------------------------------------------------------------------


class StampMonitor(NamedTuple):
    """The last good stamp of a source, and a run of odd stamps.

    Attributes
    ----------
    last: the last good stamp; None: none yet.
    odd_utime, num_odd, odd_since: the last odd stamp of the run, their number, and the first one.
    recent: the last good stamps, the oldest first.
    """

    last: int | None = None
    odd_utime: int = 0
    num_odd: int = 0
    odd_since: int = 0
    recent: tuple[int, ...] = ()

    def update(self, utime: int, settings: RawSettings) -> tuple[StampMonitor, StampVerdict]:
        """Return the monitor after a stamp, and what the stamp means."""
        last = self.last
        if last is None:
            return StampMonitor(utime, recent=(utime,)), StampVerdict.GOOD
        ahead = (utime - last) * 1e-6
        if 0.0 < ahead <= settings.clock_jump:
            return StampMonitor(utime, recent=(*self.recent[1 - RECENT_STAMPS :], utime)), StampVerdict.GOOD
        if utime == last and not (self.num_odd and self.odd_utime < last):
            return self, StampVerdict.DUPLICATE
        follows = self.num_odd > 0 and 0.0 < (utime - self.odd_utime) * 1e-6 <= settings.clock_jump
        count, since = (self.num_odd + 1, self.odd_since) if follows else (1, utime)
        if follows and ahead <= 0.0 and not has_covered(self.recent, self.odd_utime, utime):
            count -= 1
        if count >= settings.clock_jump_samples:
            confirmed = StampMonitor(utime, self.odd_utime, 0, since, (utime,))
            return confirmed, StampVerdict.GOOD if ahead > 0.0 else StampVerdict.STEPPED_BACK
        verdict = StampVerdict.FUTURE if ahead > 0.0 else StampVerdict.OUT_OF_SEQUENCE
        return StampMonitor(last, utime, count, since, self.recent), verdict

    @property
    def lost_time(self) -> float:
        """After a step back: seconds that the samples of the run took, and the one before it."""
        return 0.0 if self.last is None else (self.last - self.odd_since + self.last - self.odd_utime) * 1e-6


# --- anchor -------------------------------------------------------------------------------------------------


MAX_AGE: Final = 1e4
"""Seconds of the age of a fix that count: a stamp may be wrong by years."""


class FixAnchor(NamedTuple):
    """The last good fix, and the motion of the base frame at its instant.

    Attributes
    ----------
    position, up: of the antenna in the working frame, east + i north and height, m.
    lever, lever_up: lever arm of the antenna along Odom's axes, horizontal and up, m.
    """

    utime: int
    position: complex
    up: float
    fix: AcceptedFix
    motion: RawMotion
    lever: complex
    lever_up: float

    def propagate_base(self, motion: RawMotion, direction: complex) -> tuple[complex, float, complex]:
        """Propagate the base frame to `motion` by equation (2): position and height in the working frame.

        The third value is the arm from the antenna at the fix to the base frame, which an error of heading turns.
        """
        then = self.motion
        arm = direction * (complex(motion.x - then.x, motion.y - then.y) - self.lever)
        return self.position + arm, self.up - self.lever_up + motion.z - then.z, arm


def compute_lever_arm(motion: RawMotion, lever: Vector3) -> tuple[complex, float]:
    """Return a vector of the base axes along Odom's axes: horizontal, and up."""
    x, y, z = to_level_axes(motion.up, lever)
    return complex(x, y) * complex(math.cos(motion.yaw), math.sin(motion.yaw)), z


def compute_growth(age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the variance of each axis that a prediction over `age` seconds adds, m2: (s_v t)^2 + (a t^2 / 2)^2."""
    t = min(age, MAX_AGE)
    return (speed_sigma * t) ** 2 + (0.5 * settings.usual_acceleration * t * t) ** 2


# --- fixes -----------------------------------------------------------------------------------------------------


WORK_RANGE: Final = 200.0
"""Meters from the origin of the working frame within which its up and north are the vehicle's to 3e-5 rad."""

MAX_VELOCITY_LATENCY: Final = 2.0
"""Seconds of latency of a velocity that are credible."""


class FixMonitor(NamedTuple):
    """State from fixes.

    Attributes
    ----------
    work: working frame, in which the positions are.
    anchor: the last good fix.
    recent, segment: fixes for the speed, and for the course.
    num_rejected: fixes rejected since the last good one, for any reason.
    stationary: where the vehicle stopped.
    """

    work: LocalFrame | None = None
    anchor: FixAnchor | None = None
    recent: tuple[TrackFix, ...] = ()
    segment: tuple[TrackFix, ...] = ()
    num_rejected: int = 0
    stationary: StationaryPlace | None = None

    def recenter(self, fix: AcceptedFix, ecef: Vector3, heading: Heading) -> tuple[FixMonitor, Heading, LocalFrame]:
        """Return the states in a working frame near the fix, and that frame: the present one, or a new one."""
        old = self.work
        if old is not None and math.dist(old.ecef, ecef) <= WORK_RANGE:
            return self, heading, old
        work = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
        if old is None:
            return self, heading, work

        def move(each: TrackFix) -> TrackFix:
            return each._replace(position=_locate(work, each.ecef)[0])

        place = self.stationary
        moved = self._replace(
            recent=tuple(map(move, self.recent)),
            segment=tuple(map(move, self.segment)),
            stationary=None if place is None else place._replace(fix=move(place.fix)),
        )
        turned = so3.logarithm(so3.normalize(work.rotation_of(old)))[2]
        return moved, heading._replace(offset=math.remainder(heading.offset + turned, math.tau)), work

    def forget_path(self) -> FixMonitor:
        """Return the monitor without segments: their path is interrupted."""
        return self._replace(recent=(), segment=()) if self.recent or self.segment else self


# --- position -----------------------------------------------------------------------------------------------


def _complete_height(
    fix: AcceptedFix, before: FixAnchor | None, motion: RawMotion, arm_up: float, fallback: float, settings: RawSettings
) -> AcceptedFix:
    """Return the fix with a height: its own, else that of the fix before propagated, else `fallback` if not nan."""
    if not math.isnan(fix.height):
        return fix
    if before is not None:
        age = max((motion.utime - before.utime) * 1e-6, 0.0)
        height = before.fix.height + motion.z - before.motion.z + arm_up - before.lever_up
        variance = before.fix.up_variance + compute_growth(age, motion.speed_sigma, settings)
        return replace(fix, height=height, up_variance=min(variance, settings.unknown_height_sigma**2))
    if math.isnan(fallback):
        return replace(fix, height=0.0, up_variance=settings.unknown_height_sigma**2)
    return replace(fix, height=fallback, up_variance=settings.assumed_height_sigma**2)


def _locate(work: LocalFrame, ecef: Vector3) -> tuple[complex, float]:
    """Return an earth-centered position in the working frame: east + i north, and up."""
    east, north, up = work.from_ecef(ecef)
    return complex(east, north), up


# --- velocity -----------------------------------------------------------------------------------------------


class ReceiverVelocity(NamedTuple):
    """Velocity of the antenna by the receiver.

    Attributes
    ----------
    vector, sigma, course_sigma: east + i north and its sigma, m/s, and that of its direction, rad.
    lever_velocity: of the antenna relative to the base frame by the angular rate, along Odom's axes, m/s.
    yaw, measured_yaw: in Odom at the fix, and at the instant of the velocity, rad.
    """

    vector: complex
    sigma: float
    course_sigma: float
    lever_velocity: complex
    yaw: float
    measured_yaw: float

    def to_base(self, heading: Heading) -> complex:
        """Return the velocity of the base frame by equation (1), east + i north, m/s."""
        if heading.is_known:
            direction = heading.direction
        elif abs(self.vector) > 0.0:
            direction = self.vector / abs(self.vector) * cmath.rect(1.0, -self.yaw)
        else:
            return self.vector
        return self.vector - direction * self.lever_velocity


def _read_velocity(
    sample: GpsSample, motion: RawMotion, lever: Vector3, settings: RawSettings
) -> ReceiverVelocity | None:
    """Return the velocity of the receiver, or that of its speed and course; None if it reports neither.

    Unlike the filter's `read_velocity`: horizontal, with one sigma for both axes, and at any speed.
    """
    sigma, course_sigma = settings.velocity_sigma, math.nan
    if sample.velocity is not None:
        vector = complex(sample.velocity[0], sample.velocity[1])
        stated = sample.velocity_covariance
        if stated is not None and 0.0 < stated[0] < math.inf and 0.0 < stated[4] < math.inf:
            sigma = math.sqrt(max(stated[0], stated[4]))
    elif math.isfinite(sample.speed) and math.isfinite(sample.course):
        vector = sample.speed * complex(math.cos(sample.course), math.sin(sample.course))
        sigma = sample.speed_sigma if 0.0 < sample.speed_sigma < math.inf else sigma
        course_sigma = sample.course_sigma
    else:
        return None
    # a non-finite velocity, or one without information
    if not (abs(vector) <= 2.0 * settings.maximum_speed and sigma <= settings.maximum_speed):
        return None
    if not course_sigma > 0.0:
        course_sigma = sigma / max(abs(vector), 1e-3)
    latency = sample.velocity_latency if 0.0 <= sample.velocity_latency <= MAX_VELOCITY_LATENCY else 0.0
    return ReceiverVelocity(
        vector,
        sigma,
        max(course_sigma, settings.heading_floor),
        compute_lever_arm(motion, cross(motion.rate, lever))[0],
        motion.yaw,
        motion.yaw - motion.yaw_rate * latency,
    )


def _update_course(
    heading: Heading,
    velocity: ReceiverVelocity | None,
    segment: tuple[TrackFix, ...],
    turn_variance: float,
    settings: RawSettings,
) -> tuple[Heading, CourseResult | None]:
    """Update the heading with a course, of the receiver or else of a segment; None: neither has one."""
    if velocity is not None:
        vector = velocity.to_base(heading)
        if abs(vector) < settings.course_speed or velocity.course_sigma > settings.course_sigma_limit:
            return heading, None
        offset = cmath.phase(vector) - velocity.measured_yaw
        return heading.update_course(offset, velocity.course_sigma**2 + turn_variance, settings)
    found = fit_course(segment, heading.direction if heading.is_known else None, settings)
    if found is None or found[1] > settings.course_sigma_limit:
        return heading, None
    # the offset is that of the middle of the segment: an error of the bias has turned it since
    half = 0.5 * (segment[-1].utime - segment[0].utime) * 1e-6
    variance = found[1] ** 2 + heading.bias_variance * half * half + turn_variance
    return heading.update_course(found[0], variance, settings)


def _estimate_speed(
    heading: Heading, velocity: ReceiverVelocity | None, recent: tuple[TrackFix, ...], settings: RawSettings
) -> tuple[float, float]:
    """Return the speed along the heading and its sigma, by the receiver or else by recent fixes.

    Before the heading is known, motion is taken as forward, and speed within three sigmas as 0.
    """
    direction = heading.direction if heading.is_known else 0j
    if velocity is not None:
        vector, sigma = velocity.to_base(heading), velocity.sigma
        along = (vector * cmath.rect(1.0, -velocity.yaw) * direction.conjugate()).real
    else:
        fit = fit_best_speed(recent, direction, settings)
        if fit is None:
            return 0.0, settings.maximum_speed / 2.0
        vector, sigma = fit.velocity, fit.sigma
        along = (vector * direction.conjugate()).real
    if not heading.is_known:
        along = abs(vector) if abs(vector) > 3.0 * sigma else 0.0
    return max(-settings.maximum_speed, min(along, settings.maximum_speed)), sigma


# --- localizer -------------------------------------------------------------------------------------------------


class RawLocalizer(NamedTuple):
    """The localizer of raw mode: an immutable value. Create the first with `start`.

    Attributes
    ----------
    projection, capture: of the origin; None until it is set, and the fixes collected for it.
    motion, history: newest motion, and those of the last seconds for delayed fixes.
    tilt_bias: biases of the roll and pitch gyros, rad/s.
    imu_utime: of the last IMU sample.
    is_clock_stepped: whether the clock was set back and the heading has not been found since.
    newest: instant of the newest sample, 0 before the first.
    """

    mounts: Mounts
    settings: RawSettings
    projection: OriginProjection | None = None
    motion: RawMotion | None = None
    history: tuple[RawMotion, ...] = ()
    heading: Heading = Heading()
    quiet: QuietDetector = QuietDetector()
    tilt_bias: tuple[float, float] = (0.0, 0.0)
    fixes: FixMonitor = FixMonitor()
    capture: OriginCapture = OriginCapture()
    imu_stamps: StampMonitor = StampMonitor()
    gps_stamps: StampMonitor = StampMonitor()
    imu_utime: int | None = None
    pose_epoch: int = 0
    is_clock_stepped: bool = False
    newest: int = 0

    @property
    def origin(self) -> Origin | None:
        """The origin of World:UTM, None before it is set."""
        return None if self.projection is None else self.projection.geodesy.origin

    def get_motion_at(self, utime: int, newest: RawMotion) -> RawMotion:
        """Return the motion at an instant: predicted from the newest, or from the history."""
        if utime >= newest.utime or not self.history:
            return newest.propagate(utime, newest.rate, self.settings)
        after = newest
        for motion in reversed(self.history):
            if motion.utime <= utime:
                return interpolate_motion(motion, after, utime)
            after = motion
        return after

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
    def utime(self) -> int:
        """The instant of the newest sample processed, 0 before the first."""
        return self.newest

    def process(self, sample: Sample | SwitchMode) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer after a sample, and the events; wheels and joints are ignored.

        Events are `PersistOrigin` and `Rejected("sensor:<source>", reason)`. Reasons: out_of_sequence, duplicate,
        future (stamp); nan, range (numbers); gap (IMU sample after a gap: the turn in it is unknown); no_fix,
        satellites, dilution, sigma (fix); course (fix whose course is not used).
        """
        if not isinstance(sample, ImuSample | GpsSample):
            return self, ()
        is_imu = isinstance(sample, ImuSample)
        stamps = self.imu_stamps if is_imu else self.gps_stamps
        stamps, verdict = stamps.update(sample.header.utime, self.settings)
        if verdict is StampVerdict.STEPPED_BACK:
            self = self._restart(sample.header.utime, stamps.lost_time)
        self = self._replace(imu_stamps=stamps) if is_imu else self._replace(gps_stamps=stamps)
        if verdict not in (StampVerdict.GOOD, StampVerdict.STEPPED_BACK):
            return self, _reject(sample, verdict.value)
        return self._process_imu(sample) if isinstance(sample, ImuSample) else self._process_gps(sample)

    def estimate(self, utime: int) -> Estimate:
        """Return the pose of the base frame at an instant: predicted after the newest sample, held before history."""
        return compute_estimate(self, utime)

    def defer_estimate(self, utime: int) -> Estimate:
        """Return `estimate(utime)`, computed at once: it is cheap."""
        return self.estimate(utime)

    def navigation(self, utime: int) -> NavigationState | None:
        """Return None: raw mode has no filter."""
        return None

    def find_stale_sensors(self, utime: int) -> Invalid:
        """Return the bits of STALE_SENSORS of an estimate at an instant."""
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        """Return whether the vehicle is stationary, and when a fix was last used."""
        anchor = self.fixes.anchor
        is_stationary = self.quiet.is_stationary(utime, self.settings)
        return LocalizerSummary(
            Mode.RAW,
            None,
            is_stationary,
            0 if anchor is None else anchor.utime,
            horizontal_limit=self.settings.horizontal_limit,
            heading_limit=self.settings.heading_limit,
        )

    # --- IMU ------------------------------------------------------------------------------------------------

    def _process_imu(self, sample: ImuSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings, before = sample.header.utime, self.settings, self.motion
        imu = read_raw_imu(sample, self.mounts.X_base_imu)
        if isinstance(imu, str):
            return self, _reject(sample, imu)
        (wx, wy, wz), (bx, by) = imu.rate, self.tilt_bias
        rate = (wx - bx, wy - by, wz - self.heading.bias)
        if before is None or self.imu_utime is None:
            return self._start_imu(utime, imu, rate), ()
        dt = (utime - self.imu_utime) * 1e-6
        is_gap = dt > settings.rate_hold
        a, b, c = before.rate
        mean = before.rate if is_gap else (0.5 * (a + rate[0]), 0.5 * (b + rate[1]), 0.5 * (c + rate[2]))
        motion = before.propagate(utime, mean, settings)
        heading = self.heading.propagate((utime - before.utime) * 1e-6, settings)
        fixes = self.fixes.forget_path() if is_gap else self.fixes
        up = imu.up or motion.up
        if imu.up is None and imu.force is not None:
            up = correct_up(up, imu.force, rate, motion.speed, self.mounts.X_base_imu.xyz, dt, settings)
        yaw_rate = compute_yaw_rate(rate, up)
        step = min(dt, settings.rate_hold)
        quiet = self.quiet.update(utime, yaw_rate, step, math.sqrt(heading.bias_variance), settings)
        speed, speed_sigma = motion.speed, motion.speed_sigma
        if quiet.is_stationary(utime, settings):
            place = fixes.stationary
            if place is None or not heading.is_known or place.is_bias_certain(utime, settings):
                heading = heading.update_stationary(yaw_rate, max(settings.gyro_noise**2 / step, quiet.variance))
            if place is not None:
                heading = place.inflate_heading(utime, step, heading, settings)
            gain = step / (settings.tilt_time + step)
            bx, by = bx + gain * rate[0], by + gain * rate[1]
            if speed:
                speed, speed_sigma = 0.0, 0.5 * settings.stationary_speed
        localizer = self._replace(heading=heading, quiet=quiet, tilt_bias=(bx, by), fixes=fixes)
        motion = motion._replace(up=up, rate=rate, speed=speed, speed_sigma=speed_sigma)
        return localizer._with_imu(utime, motion), _reject(sample, "gap") if is_gap else ()

    def _start_imu(self, utime: int, imu: RawImuSample, rate: Vector3) -> RawLocalizer:
        """Return the localizer after a first sample: there is nothing to integrate from, but it gives the vertical."""
        before = self.motion or RawMotion(utime)
        motion = before.propagate(utime, ZERO, self.settings)
        heading = self.heading.propagate((utime - before.utime) * 1e-6, self.settings, measured=False)
        localizer = self._replace(heading=heading, fixes=self.fixes.forget_path())
        return localizer._with_imu(utime, motion._replace(up=get_first_up(imu) or motion.up, rate=rate))

    def _with_imu(self, utime: int, motion: RawMotion) -> RawLocalizer:
        history = _append_motion(self.history, motion)
        return self._replace(motion=motion, history=history, imu_utime=utime, newest=max(self.newest, utime))

    # --- fixes ----------------------------------------------------------------------------------------------

    def _process_gps(self, sample: GpsSample) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        utime, settings = sample.header.utime, self.settings
        fix = evaluate_fix(sample, settings)
        if not isinstance(fix, str) and self.projection is not None and not self.projection.is_in_zone(fix):
            fix = "range"
        if isinstance(fix, str):
            fixes = self.fixes._replace(num_rejected=self.fixes.num_rejected + 1)
            return self._replace(fixes=fixes), _reject(sample, fix)
        motion, heading = self.motion or RawMotion(utime), self.heading
        ahead = (utime - motion.utime) * 1e-6
        if ahead > settings.imu_timeout:
            # without IMU samples Odom continues by the prediction. If they are merely delayed they must still be
            # integrated from the last one: until the timeout the prediction is for the fix alone
            heading = heading.propagate(ahead, settings)
            ahead = 0.0
            motion = motion.propagate(utime, motion.rate, settings)
        turn_variance = (settings.gap_rate_sigma * max(ahead - settings.rate_hold, 0.0)) ** 2
        at, is_stationary = self.get_motion_at(utime, motion), self.quiet.is_stationary(utime, settings)
        lever = self.mounts.X_base_antenna.xyz
        arm, arm_up = compute_lever_arm(at, lever)
        fallback = math.nan if self.origin is None else self.origin.height
        fix = _complete_height(fix, self.fixes.anchor, at, arm_up, fallback, settings)
        ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height)
        fixes, heading, work = self.fixes.recenter(fix, ecef, heading)
        position, up = _locate(work, ecef)
        newest = TrackFix(utime, position, fix.sigma, at.path, arm, at.yaw, ecef)
        recent = append_fix(fixes.recent, newest, settings.speed_window + settings.stationary_time)
        segment = append_fix(fixes.segment, newest, settings.course_window)
        velocity = _read_velocity(sample, at, lever, settings)
        if velocity is None:
            measured, is_slow = None, is_slow_by_fixes(recent, settings)
        else:
            measured = velocity.to_base(heading), velocity.sigma
            # the speed up to which one velocity may be a stationary vehicle's; their mean over time shows more
            limit = min(settings.stationary_speed + 3.0 * velocity.sigma, settings.course_speed)
            is_slow = abs(measured[0]) <= max(velocity.sigma, limit)
        least_speed = max(abs(at.speed) - 2.0 * at.speed_sigma, 0.0)
        place, heading, is_slow = update_stationary(
            fixes.stationary, is_slow, is_stationary, newest, measured, least_speed, heading, settings
        )
        course, was_known = None, heading.is_known
        if is_stationary and is_slow:
            # the path at 1 m/s continues while the vehicle is stationary: a segment must not reach back into that
            segment = (newest,)
            speed, speed_sigma = 0.0, settings.stationary_speed / 2.0
        else:
            heading, course = _update_course(heading, velocity, segment, turn_variance, settings)
            if course is not None:
                segment = (newest,)
            speed, speed_sigma = _estimate_speed(heading, velocity, recent, settings)
        anchor = FixAnchor(utime, position, up, fix, at, arm, arm_up)
        localizer = self._replace(
            motion=motion._replace(speed=speed, speed_utime=utime, speed_sigma=speed_sigma),
            fixes=FixMonitor(work, anchor, recent, segment, stationary=place),
            heading=heading,
            quiet=self.quiet._replace(is_slow=is_slow),
            # the first course turns no pose that was valid
            pose_epoch=self.pose_epoch + int(course is CourseResult.RESET and was_known),
            is_clock_stepped=self.is_clock_stepped and not heading.is_known,
            newest=max(self.newest, utime),
        )
        localizer, captured = localizer._set_origin(utime, ecef, fix.sigma)
        return localizer, (_reject(sample, "course") if course is CourseResult.REJECTED else ()) + captured

    def _set_origin(self, utime: int, ecef: Vector3, sigma: float) -> tuple[RawLocalizer, tuple[LocalizerEvent, ...]]:
        """Return the localizer with the origin set, if it can be, and its projection at the new fix."""
        events: tuple[LocalizerEvent, ...] = ()
        capture, projection = self.capture, self.projection
        if projection is None:
            capture, origin = capture.add_fix(utime, ecef, sigma, self.settings)
            if origin is not None:
                projection = OriginProjection(Geodesy(origin))
                events = (PersistOrigin(origin),)
        if projection is not None and self.fixes.work is not None:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            projection = projection.at(latitude, longitude, self.fixes.work)
        return self._replace(capture=capture, projection=projection), events

    # --- clock ----------------------------------------------------------------------------------------------

    def _restart(self, utime: int, lost: float) -> RawLocalizer:
        """Return the localizer after its clock was set back: Odom, origin and biases continue, in a new epoch.

        The motion during the `lost` seconds until the step was confirmed is unknown.
        """
        motion, heading = self.motion, self.heading
        if motion is not None:
            travel = max(abs(motion.speed), motion.speed_sigma) * lost
            motion = motion._replace(
                utime=utime,
                rate=ZERO,
                speed=0.0,
                speed_utime=0,
                yaw_variance=min(motion.yaw_variance + (self.settings.gap_rate_sigma * lost) ** 2, 1e3),
                position_variance=min(motion.position_variance + travel * travel, 1e12),
            )
        return self._replace(
            motion=motion,
            history=(),
            heading=Heading(bias=heading.bias, bias_variance=heading.bias_variance),
            quiet=QuietDetector(),
            fixes=FixMonitor(),
            imu_stamps=StampMonitor(),
            gps_stamps=StampMonitor(),
            imu_utime=None,
            pose_epoch=self.pose_epoch + 1,
            is_clock_stepped=True,
            newest=utime,
        )


def _reject(sample: ImuSample | GpsSample, reason: str) -> tuple[LocalizerEvent, ...]:
    return (Rejected(f"sensor:{sample.header.source}", reason),)


def _append_motion(history: tuple[RawMotion, ...], motion: RawMotion) -> tuple[RawMotion, ...]:
    """Return the history with a motion more, thinned and limited in length."""
    if not history:
        return (motion,)
    if motion.utime - history[-1].utime < HISTORY_STEP_US:
        return history
    oldest = motion.utime - HISTORY_LENGTH_US
    first = next((n for n, each in enumerate(history) if each.utime >= oldest), len(history))
    return (*history[first:], motion)


CONVERGENCE_RANGE: Final = 100.0
"""Meters from the last fix within which its meridian convergence is used: it changes by 1.6e-5 rad tan(latitude)."""


# --- estimate -----------------------------------------------------------------------------------------------


def compute_estimate(state: RawLocalizer, utime: int) -> Estimate:
    """Return the pose of the base frame at an instant, by the state alone."""
    settings, newest, anchor, origin = state.settings, state.motion, state.fixes.anchor, state.origin
    invalid = _find_invalid(state, utime)
    if newest is None:
        return Estimate(utime, Pose.identity(), invalid=invalid, pose_epoch=state.pose_epoch, origin=origin)
    motion = state.get_motion_at(utime, newest)
    odom = motion.pose
    in_odom = Estimate(
        utime,
        odom,
        odom_covariance=compute_odom_covariance(motion.position_variance, motion.yaw_variance, settings),
        invalid=invalid,
        quality=_find_quality(state, utime, motion),
        pose_epoch=state.pose_epoch,
        origin=origin,
        is_odom_random_walk=True,
    )
    if anchor is None:
        return in_odom
    heading, q, direction, heading_variance = state.heading, odom.wxyz, 1.0 + 0j, UNKNOWN_VARIANCE
    if heading.is_known:
        q, direction = so3.multiply(rotation_about_up(heading.offset), q), heading.direction
        heading_variance = heading.propagate((utime - newest.utime) * 1e-6, settings).variance
    age = max((utime - anchor.utime) * 1e-6, 0.0)
    growth = compute_growth(age, newest.speed_sigma, settings)
    position, up, arm = anchor.propagate_base(motion, direction)
    covariance = compute_covariance(anchor.fix, growth, arm, heading_variance, settings)
    variance = compute_longest_axis(covariance[0], covariance[7], covariance[1])
    k_horizontal, k_heading = compute_factors(settings.risk)
    horizontal = k_horizontal * math.sqrt(variance)
    heading_level = min(k_heading * math.sqrt(heading_variance), math.pi)
    sigma, heading_sigma = math.sqrt(variance), math.sqrt(heading_variance)
    levels = compute_level(sigma, 0.0, heading_sigma)
    risks = compute_limit_risks(sigma, heading_sigma, settings.horizontal_limit, settings.heading_limit)
    if heading.is_known and risks[1] > max(risks[0], LIMIT_RISK):
        is_stationary = state.quiet.is_stationary(utime, settings)
        invalid |= Invalid.STATIONARY_HEADING if is_stationary else Invalid.LIMIT_EXCEEDED
    elif risks[0] > LIMIT_RISK or (heading.is_known and sum(risks) > LIMIT_RISK):
        invalid |= Invalid.LIMIT_EXCEEDED
    enu = utm = None
    if state.projection is not None and state.fixes.work is not None:
        is_far = abs(position - anchor.position) > CONVERGENCE_RANGE
        enu, utm = _compute_world_poses(state.projection, state.fixes.work, q, position, up, is_far)
    remaining = min(
        settings.gps_timeout - age,
        settings.imu_timeout - (utime - (state.imu_utime or utime)) * 1e-6,
        compute_seconds_to_limit(variance - growth, age, newest.speed_sigma, settings),
    )
    return replace(
        in_odom,
        enu=enu,
        utm=utm,
        covariance=covariance,
        invalid=invalid,
        horizontal_protection_level=horizontal,
        heading_protection_level=heading_level,
        seconds_to_limit=NAN if invalid else max(remaining, 0.0),
        horizontal_level=levels[0],
        heading_level=levels[1],
        limit_risk=min(sum(risks), 1.0),
        horizontal_allowance=0.0,
    )


def _compute_world_poses(
    projection: OriginProjection, work: LocalFrame, q: Quaternion, position: complex, up: float, is_far: bool
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM; `q` is along the working frame. None out of range."""
    geodesy, convergence = projection.geodesy, projection.convergence
    ecef = work.to_ecef((position.real, position.imag, up))
    try:
        utm = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        if is_far:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            convergence = geodesy.convergence(latitude, longitude)
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(projection.tangent_from_work, q)),
        Pose(utm, so3.multiply(rotation_about_up(convergence), q)),
    )


# --- covariance ---------------------------------------------------------------------------------------------


def compute_covariance(
    fix: AcceptedFix, growth: float, arm: complex, yaw_variance: float, settings: RawSettings
) -> tuple[float, ...]:
    """Return the 36 numbers of the covariance of the base frame along east, north, up; `arm`: see the theory."""
    ae, an = -arm.imag, arm.real
    ee = fix.east_variance + growth + yaw_variance * ae * ae
    nn = fix.north_variance + growth + yaw_variance * an * an
    en = fix.cross + yaw_variance * ae * an
    ye, yn = yaw_variance * ae, yaw_variance * an
    return _fill_covariance(ee, en, nn, fix.up_variance + growth, ye, yn, yaw_variance, settings)


def compute_odom_covariance(position: float, yaw: float, settings: RawSettings) -> tuple[float, ...]:
    """Return the 36 numbers of the covariance of the pose in Odom, from its variances of position and yaw."""
    return _fill_covariance(position, 0.0, position, position, 0.0, 0.0, yaw, settings)


def _fill_covariance(
    ee: float, en: float, nn: float, uu: float, ye: float, yn: float, yy: float, settings: RawSettings
) -> tuple[float, ...]:
    tilt = settings.tilt_sigma**2
    return (
        *(ee, en, 0.0, 0.0, 0.0, ye),
        *(en, nn, 0.0, 0.0, 0.0, yn),
        *(0.0, 0.0, uu, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(ye, yn, 0.0, 0.0, 0.0, yy),
    )


def compute_seconds_to_limit(variance: float, age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the seconds without fixes until the position is beyond its limit with LIMIT_RISK; 0 if it is.

    `variance` is that of the longest axis without growth, which is a quadratic of x = t^2.
    """
    room = (settings.horizontal_limit / compute_factors(LIMIT_RISK)[0]) ** 2 - variance
    if room <= 0.0:
        return 0.0
    a, b = (0.5 * settings.usual_acceleration) ** 2, speed_sigma**2
    x = 2.0 * room / (b + math.sqrt(b * b + 4.0 * a * room))
    return max(math.sqrt(x) - age, 0.0)


# --- validity -----------------------------------------------------------------------------------------------


def _find_invalid(state: RawLocalizer, utime: int) -> Invalid:
    """Return the reasons against an estimate, except for its protection levels."""
    # numbers, not members: combining flags costs more than all else here
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    invalid = 0
    if anchor is None:
        invalid |= 1  # NO_FIX
    elif (utime - anchor.utime) * 1e-6 > settings.gps_timeout:
        invalid |= 32  # STALE_GPS
    if imu is None:
        invalid |= 2  # NO_IMU
    elif (utime - imu) * 1e-6 > settings.imu_timeout:
        invalid |= 64  # STALE_IMU
    if state.projection is None:
        invalid |= 4  # NO_ORIGIN
    if not state.heading.is_known:
        invalid |= 8  # NOT_MOVED_YET
    if state.fixes.num_rejected >= settings.fix_rejections:
        invalid |= 128  # GPS_REJECTED
    if state.is_clock_stepped or _is_too_early(state, utime):
        invalid |= 512  # CLOCK_STEPPED
    if state.motion is not None and state.motion.up[2] < math.cos(settings.maximum_tilt):
        invalid |= 1024  # TILTED
    return Invalid(invalid)


def _is_too_early(state: RawLocalizer, utime: int) -> bool:
    """Return whether an instant is before the history, or so far before the newest samples that the clocks differ."""
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    return (
        (imu is not None and (imu - utime) * 1e-6 > settings.imu_timeout)
        or (anchor is not None and (anchor.utime - utime) * 1e-6 > settings.gps_timeout)
        or (bool(state.history) and utime < state.history[0].utime)
    )


def _find_quality(state: RawLocalizer, utime: int, motion: RawMotion) -> Quality:
    settings = state.settings
    quality = 0
    if state.quiet.is_stationary(utime, settings) or abs(motion.speed) < settings.course_speed:
        quality |= 1  # HEADING_FROM_GYRO
    if utime > state.newest:
        quality |= 2  # PREDICTED
    if motion.speed < -max(motion.speed_sigma, settings.stationary_speed):
        quality |= 32  # REVERSING
    return Quality(quality)
