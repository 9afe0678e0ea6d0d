"""What has been concluded from fixes, and the step that one more fix makes: anchor, speed, course, origin."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field, replace

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw import track
from modelserver.estimation.raw.heading import CourseResult, Heading
from modelserver.estimation.raw.motion import RawMotion
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stationary import StationaryPlace, update_stationary
from modelserver.estimation.raw.track import (
    FixAnchor,
    JumpMonitor,
    TrackFix,
    compute_growth,
    compute_jump_limit,
    compute_lever_arm,
)
from modelserver.messages import GpsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3, cross

WORK_RANGE = 200.0
"""Metres from the working frame's origin at which it is set anew: so near, its vertical and its north are the
vehicle's to 3e-5 rad."""


@dataclass(frozen=True, slots=True)
class FixMonitor:
    """The state drawn from fixes.

    `work` is a tangent plane near the vehicle in which positions are kept; `anchor` the last good fix; `recent`
    and `stretch` the fixes for speed and for course; `refusals` counts the fixes refused since the last good one;
    `rest` is where the vehicle came to rest.
    """

    work: LocalFrame | None = None
    anchor: FixAnchor | None = None
    recent: tuple[TrackFix, ...] = ()
    segment: tuple[TrackFix, ...] = ()
    jumps: JumpMonitor = field(default_factory=JumpMonitor)
    num_rejected: int = 0
    stationary: StationaryPlace | None = None

    def forget_path(self) -> FixMonitor:
        """Return the state without the stretches: their path is broken."""
        return replace(self, recent=(), segment=()) if self.recent or self.segment else self


@dataclass(frozen=True, slots=True)
class FixStep:
    """What one fix did: the new states, whether the world pose jumped, and a word where a part was refused."""

    fixes: FixMonitor
    heading: Heading
    speed: float = 0.0
    speed_sigma: float = 0.0
    is_slow: bool = False
    has_jumped: bool = False
    rejected: str = ""
    ecef: Vector3 = (0.0, 0.0, 0.0)


def update_fixes(
    fixes: FixMonitor,
    heading: Heading,
    sample: GpsSample,
    fix: AcceptedFix,
    motion: RawMotion,
    standing: bool,
    lever: Vector3,
    fallback_height: float,
    turn_variance: float,
    settings: RawSettings,
) -> FixStep:
    """Return what is concluded with one good fix more; `motion` is the base frame's at the fix's instant.

    `lever` is the antenna's place in the base frame. A fix that told no height has the height carried to it,
    or `fallback_height` before any was told (nan: none is known). `turn_variance` is that of the turn until the
    fix's instant that no inertial sample told of yet. A refused fix leaves all but the counts as it was.
    """
    utime = sample.header.utime
    direction = cmath.rect(1.0, heading.offset) if heading.is_known else 1.0 + 0j
    arm, arm_up = compute_lever_arm(motion, lever)
    swing, _ = compute_lever_arm(motion, cross(motion.rate, lever))
    fix, ecef = _complete_height(fixes, fix, motion, arm_up, fallback_height, settings)
    work = fixes.work or LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    east, north, up = work.from_ecef(ecef)
    place = complex(east, north)

    jumped = False
    before = fixes.anchor
    if before is not None:
        dt = (utime - before.utime) * 1e-6
        carried = known = before.position
        speed_sigma = None
        if heading.is_known and motion.speed_utime:
            base, _, _ = before.propagate_base(motion, direction)
            carried, speed_sigma = base + direction * arm, motion.speed_sigma
        off = abs(place - carried)
        # while fixes are being refused, time alone must not let the same ones in
        within = min(dt, settings.gps_timeout) if fixes.jumps.count else dt
        limit = compute_jump_limit(within, before.fix.sigma, fix.sigma, speed_sigma, settings)
        climb = settings.jump_sigmas * math.sqrt(before.fix.up_variance + fix.up_variance)
        if off > limit or abs(up - before.up) > climb + settings.maximum_speed * dt:
            jumps = fixes.jumps.reject(utime, place, fix.sigma, settings)
            if not jumps.is_confirmed(settings):
                return FixStep(
                    replace(fixes, jumps=jumps, num_rejected=fixes.num_rejected + 1), heading, rejected="jump"
                )
            jumped = True
        elif dt > settings.gps_timeout:
            # back after an outage: what a fix on time would not have been allowed is a discontinuity
            jumped = off > compute_jump_limit(
                settings.gps_timeout, before.fix.sigma, fix.sigma, speed_sigma, settings
            ) or (speed_sigma is None and abs(place - known) > limit)
        if jumped:
            fixes = replace(fixes.forget_path(), stationary=None)

    fixes, heading, work = _recenter(fixes, heading, fix, ecef)
    east, north, up = work.from_ecef(ecef)
    place = complex(east, north)
    anchor = FixAnchor(utime, place, up, fix, motion, arm, arm_up)
    newest = TrackFix(utime, place, fix.sigma, motion.path, arm, motion.yaw)
    recent = track.append_fix(fixes.recent, newest, settings.speed_window + settings.stationary_time)
    stretch = track.append_fix(fixes.segment, newest, settings.course_window)
    velocity = _read_velocity(sample, settings)
    told = None if velocity is None else (_to_base(velocity.vector, heading, motion, swing), velocity.sigma)
    slow = track.is_slow(recent, settings) if told is None else abs(told[0]) <= _get_slow_limit(told[1], settings)
    least = max(abs(motion.speed) - 2.0 * motion.speed_sigma, 0.0)
    rest, heading, slow = update_stationary(fixes.stationary, slow, standing, newest, told, least, heading, settings)
    standing = standing and slow
    refused = ""
    if standing:
        # the path of rate alone runs on at rest: a stretch must not reach back into it
        stretch = (newest,)
        speed, speed_sigma = 0.0, settings.stationary_speed / 2.0
    else:
        was_known = heading.is_known
        heading, met = _update_course(heading, velocity, stretch, motion, swing, turn_variance, settings)
        if met is not None:
            stretch = (newest,)
            refused = "course" if met is CourseResult.REJECTED else ""
            jumped = jumped or (met is CourseResult.RESET and was_known)
        speed, speed_sigma = _estimate_speed(heading, velocity, recent, motion, swing, settings)
    return FixStep(
        FixMonitor(work, anchor, recent, stretch, stationary=rest),
        heading,
        speed,
        speed_sigma,
        slow,
        jumped,
        refused,
        ecef,
    )


def _complete_height(
    fixes: FixMonitor, fix: AcceptedFix, motion: RawMotion, arm_up: float, fallback_height: float, settings: RawSettings
) -> tuple[AcceptedFix, Vector3]:
    """Return the fix with a height, and its earth-centred position."""
    if math.isnan(fix.height):
        before = fixes.anchor
        height, variance = fallback_height, settings.assumed_height_sigma**2
        if math.isnan(height):
            height, variance = 0.0, settings.unknown_height_sigma**2
        if before is not None:
            age = max((motion.utime - before.utime) * 1e-6, 0.0)
            height = before.fix.height + motion.z - before.motion.z + arm_up - before.lever_up
            variance = min(
                before.fix.up_variance + compute_growth(age, motion.speed_sigma, settings),
                settings.unknown_height_sigma**2,
            )
        fix = replace(fix, height=height, up_variance=variance)
    return fix, ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height)


def _recenter(
    fixes: FixMonitor, heading: Heading, fix: AcceptedFix, ecef: Vector3
) -> tuple[FixMonitor, Heading, LocalFrame]:
    """Return the states in a working frame that is near the fix, and that frame: the same one, or one set anew."""
    old = fixes.work
    if old is not None and math.dist(old.ecef, ecef) <= WORK_RANGE:
        return fixes, heading, old
    work = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    if old is None:
        return replace(fixes, work=work), heading, work
    level = fixes.anchor.up if fixes.anchor is not None else 0.0

    def moved(place: complex, up: float = level) -> tuple[complex, float]:
        x, y, z = work.from_ecef(old.to_ecef((place.real, place.imag, up)))
        return complex(x, y), z

    def again(track_fixes: tuple[TrackFix, ...]) -> tuple[TrackFix, ...]:
        return tuple(replace(each, position=moved(each.position)[0]) for each in track_fixes)

    anchor = fixes.anchor
    if anchor is not None:
        place, up = moved(anchor.position, anchor.up)
        anchor = replace(anchor, position=place, up=up)
    turned = so3.logarithm(so3.normalize(work.rotation_of(old)))[2]
    return (
        FixMonitor(
            work,
            anchor,
            again(fixes.recent),
            again(fixes.segment),
            replace(fixes.jumps, position=moved(fixes.jumps.position)[0]) if fixes.jumps.count else fixes.jumps,
            fixes.num_rejected,
            None
            if fixes.stationary is None
            else replace(fixes.stationary, position=moved(fixes.stationary.position)[0]),
        ),
        replace(heading, offset=math.remainder(heading.offset + turned, math.tau)),
        work,
    )


@dataclass(frozen=True, slots=True)
class _ReceiverVelocity:
    """The antenna's velocity as the receiver told it, east + i north, m/s; `age` at the fix's instant, s."""

    vector: complex
    sigma: float
    course_sigma: float
    age: float


def _read_velocity(sample: GpsSample, settings: RawSettings) -> _ReceiverVelocity | None:
    """Return the receiver's own velocity, or that of its speed and course; None where it told neither."""
    age = sample.velocity_latency if 0.0 <= sample.velocity_latency <= 2.0 else 0.0
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
    # a velocity that knows nothing is none; neither is one surer than the axes of a vehicle are straight
    if not (abs(vector) <= 2.0 * settings.maximum_speed and sigma <= settings.maximum_speed):
        return None
    if not course_sigma > 0.0:
        course_sigma = sigma / max(abs(vector), 1e-3)
    course_sigma = max(course_sigma, settings.heading_floor)
    return _ReceiverVelocity(vector, sigma, course_sigma, age)


def _get_slow_limit(sigma: float, settings: RawSettings) -> float:
    """Return the speed up to which a velocity may be a standing vehicle's: its mean over time tells the rest."""
    return max(sigma, min(settings.stationary_speed + 3.0 * sigma, settings.course_speed))


def _to_base(vector: complex, heading: Heading, motion: RawMotion, swing: complex) -> complex:
    """Return the base frame's velocity: the antenna's without its `swing`, what turning gives it along Odom's axes."""
    if heading.is_known:
        direction = cmath.rect(1.0, heading.offset)
    elif abs(vector) > 0.0:
        direction = vector / abs(vector) * cmath.rect(1.0, -motion.yaw)
    else:
        return vector
    return vector - direction * swing


def _update_course(
    heading: Heading,
    velocity: _ReceiverVelocity | None,
    stretch: tuple[TrackFix, ...],
    motion: RawMotion,
    swing: complex,
    turn_variance: float,
    settings: RawSettings,
) -> tuple[Heading, CourseResult | None]:
    """Return the heading after this fix's course, and what became of it; None where there was none to take."""
    if velocity is not None:
        vector = _to_base(velocity.vector, heading, motion, swing)
        if abs(vector) < settings.course_speed or velocity.course_sigma > settings.course_sigma_limit:
            return heading, None
        # the course is of the instant the velocity was measured: heading has turned since
        offset = cmath.phase(vector) - (motion.yaw - motion.yaw_rate * velocity.age)
        return heading.update_course(offset, velocity.course_sigma**2 + turn_variance, settings)
    direction = cmath.rect(1.0, heading.offset) if heading.is_known else None
    found = track.fit_course(stretch, direction, settings)
    if found is None or found[1] > settings.course_sigma_limit:
        return heading, None
    # the stretch tells the offset of its middle; an error of the bias has turned it since
    half = 0.5 * (stretch[-1].utime - stretch[0].utime) * 1e-6
    variance = found[1] ** 2 + heading.bias_variance * half * half + turn_variance
    return heading.update_course(found[0], variance, settings)


def _estimate_speed(
    heading: Heading,
    velocity: _ReceiverVelocity | None,
    recent: tuple[TrackFix, ...],
    motion: RawMotion,
    swing: complex,
    settings: RawSettings,
) -> tuple[float, float]:
    """Return the speed along heading and its sigma: the receiver's, else that of recent fixes.

    Before heading is known the motion is taken as forward, and what is not clearly motion as none.
    """
    direction = cmath.rect(1.0, heading.offset) if heading.is_known else 0j
    if velocity is not None:
        vector, sigma = _to_base(velocity.vector, heading, motion, swing), velocity.sigma
        along = (vector * cmath.rect(1.0, -motion.yaw) * direction.conjugate()).real
    else:
        slope = track.fit_best_speed(recent, direction, settings)
        if slope is None:
            return 0.0, settings.maximum_speed / 2.0
        vector, sigma = slope.velocity, slope.sigma
        along = (vector * direction.conjugate()).real
    if not heading.is_known:
        along = abs(vector) if abs(vector) > 3.0 * sigma else 0.0
    return max(-settings.maximum_speed, min(along, settings.maximum_speed)), sigma
