"""Fix update: what one good fix changes. Anchor, stationary state, course, speed, and jumps.

Fixes are stored in the working frame, a tangent plane near the vehicle. The antenna velocity of the receiver becomes
that of the base frame by

    v_base = v_antenna - exp(ib) R (w x r)                                                                      (1)

with the lever arm r and the heading offset b; before b is known, its direction is that of the velocity itself.

A fix goes through these steps: complete its height; jump gate against the propagated anchor; working frame near the
vehicle; stationary detection; if not stationary, course update of the heading and speed along it, both from the
velocity of the receiver or else from recent fixes (track.py). A rejected fix changes nothing but the counts.

Read top-down: `update_fixes` -> `_gate_fix` -> `_recenter` -> `_update_course` -> `_estimate_speed`.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import Final, NamedTuple, TypeVar

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic
from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw import track
from modelserver.estimation.raw.heading import CourseResult, Heading
from modelserver.estimation.raw.motion import RawMotion
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.stationary import StationaryPlace, update_stationary
from modelserver.estimation.raw.track import FixAnchor, JumpMonitor, TrackFix, compute_jump_limit, compute_lever_arm
from modelserver.messages import GpsSample, Verdict
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3, cross

WORK_RANGE: Final = 200.0
"""Meters from the origin of the working frame within which its up and north are the vehicle's to 3e-5 rad."""

MAX_VELOCITY_LATENCY: Final = 2.0
"""Seconds of latency of a velocity that are credible."""

Positioned = TypeVar("Positioned", TrackFix, JumpMonitor, StationaryPlace)


class FixMonitor(NamedTuple):
    """State from fixes.

    Attributes
    ----------
    work: working frame, in which the positions are.
    anchor: the last good fix.
    recent, segment: fixes for the speed, and for the course.
    jumps: the run of fixes that the jump gate rejected.
    num_rejected: fixes rejected since the last good one, for any reason.
    stationary: where the vehicle stopped.
    """

    work: LocalFrame | None = None
    anchor: FixAnchor | None = None
    recent: tuple[TrackFix, ...] = ()
    segment: tuple[TrackFix, ...] = ()
    jumps: JumpMonitor = JumpMonitor()
    num_rejected: int = 0
    stationary: StationaryPlace | None = None

    def forget_path(self) -> FixMonitor:
        """Return the monitor without segments: their path is interrupted."""
        return self._replace(recent=(), segment=()) if self.recent or self.segment else self


class FixInput(NamedTuple):
    """A good fix, and the vehicle at its instant.

    Attributes
    ----------
    motion, is_stationary: of the base frame.
    lever: position of the antenna in the base frame, m.
    fallback_height: for a fix without height before any has one, m; nan: unknown.
    turn_variance: of the turn up to the fix for which no IMU sample has arrived, rad2.
    """

    sample: GpsSample
    fix: AcceptedFix
    motion: RawMotion
    is_stationary: bool
    lever: Vector3
    fallback_height: float
    turn_variance: float


class FixStep(NamedTuple):
    """What one fix changed: the new states, whether the world pose has jumped, and what was rejected, in one word."""

    fixes: FixMonitor
    heading: Heading
    speed: float = 0.0
    speed_sigma: float = 0.0
    is_slow: bool = False
    has_jumped: bool = False
    rejected: str = ""
    ecef: Vector3 = ZERO


def update_fixes(fixes: FixMonitor, heading: Heading, given: FixInput, settings: RawSettings) -> FixStep:
    """Update the state from fixes, the heading and the speed with one good fix."""
    motion, utime = given.motion, given.sample.header.utime
    arm, arm_up = compute_lever_arm(motion, given.lever)
    fix = _complete_height(fixes.anchor, given, arm_up, settings)
    ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height)
    work = fixes.work or LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    anchor = FixAnchor(utime, *_locate(work, ecef), fix, motion, arm, arm_up)

    verdict, jumps = _gate_fix(fixes, anchor, heading, settings)
    if verdict is Verdict.REJECTED:
        rejected = fixes._replace(jumps=jumps, num_rejected=fixes.num_rejected + 1)
        return FixStep(rejected, heading, rejected="jump")
    has_jumped = verdict is Verdict.RESET
    if has_jumped:
        fixes = fixes.forget_path()._replace(stationary=None)
    fixes, heading, work = _recenter(fixes, heading, fix, ecef)
    position, up = _locate(work, ecef)
    anchor = anchor._replace(position=position, up=up)

    newest = TrackFix(utime, position, fix.sigma, motion.path, arm, motion.yaw)
    recent = track.append_fix(fixes.recent, newest, settings.speed_window + settings.stationary_time)
    segment = track.append_fix(fixes.segment, newest, settings.course_window)
    velocity = _read_velocity(given, settings)
    if velocity is None:
        measured, is_slow = None, track.is_slow(recent, settings)
    else:
        measured = velocity.to_base(heading), velocity.sigma
        # the speed up to which one velocity may be a stationary vehicle's; their mean over time shows more
        limit = min(settings.stationary_speed + 3.0 * velocity.sigma, settings.course_speed)
        is_slow = abs(measured[0]) <= max(velocity.sigma, limit)
    least_speed = max(abs(motion.speed) - 2.0 * motion.speed_sigma, 0.0)
    place, heading, is_slow = update_stationary(
        fixes.stationary, is_slow, given.is_stationary, newest, measured, least_speed, heading, settings
    )
    rejected_part = ""
    if given.is_stationary and is_slow:
        # the path at 1 m/s continues while the vehicle is stationary: a segment must not reach back into that
        segment = (newest,)
        speed, speed_sigma = 0.0, settings.stationary_speed / 2.0
    else:
        was_known = heading.is_known
        heading, result = _update_course(heading, velocity, segment, given.turn_variance, settings)
        if result is not None:
            segment = (newest,)
            rejected_part = "course" if result is CourseResult.REJECTED else ""
            has_jumped = has_jumped or (result is CourseResult.RESET and was_known)
        speed, speed_sigma = _estimate_speed(heading, velocity, recent, settings)
    fixes = FixMonitor(work, anchor, recent, segment, stationary=place)
    return FixStep(fixes, heading, speed, speed_sigma, is_slow, has_jumped, rejected_part, ecef)


# --- position -----------------------------------------------------------------------------------------------


def _complete_height(before: FixAnchor | None, given: FixInput, arm_up: float, settings: RawSettings) -> AcceptedFix:
    """Return the fix with a height: its own, else that of the fix before propagated, else the fallback."""
    fix, motion = given.fix, given.motion
    if not math.isnan(fix.height):
        return fix
    if before is not None:
        age = max((motion.utime - before.utime) * 1e-6, 0.0)
        height = before.fix.height + motion.z - before.motion.z + arm_up - before.lever_up
        variance = before.fix.up_variance + track.compute_growth(age, motion.speed_sigma, settings)
        return replace(fix, height=height, up_variance=min(variance, settings.unknown_height_sigma**2))
    if math.isnan(given.fallback_height):
        return replace(fix, height=0.0, up_variance=settings.unknown_height_sigma**2)
    return replace(fix, height=given.fallback_height, up_variance=settings.assumed_height_sigma**2)


def _locate(work: LocalFrame, ecef: Vector3) -> tuple[complex, float]:
    """Return an earth-centered position in the working frame: east + i north, and up."""
    east, north, up = work.from_ecef(ecef)
    return complex(east, north), up


def _gate_fix(
    fixes: FixMonitor, newest: FixAnchor, heading: Heading, settings: RawSettings
) -> tuple[Verdict, JumpMonitor]:
    """Return whether a fix is used, rejected as a jump, or resets the position, and the run of rejected ones."""
    before, jumps, motion = fixes.anchor, fixes.jumps, newest.motion
    if before is None:
        return Verdict.USED, jumps
    dt = (newest.utime - before.utime) * 1e-6
    sigmas = before.fix.sigma, newest.fix.sigma
    predicted, speed_sigma = before.position, None
    if heading.is_known and motion.speed_utime:
        predicted = before.propagate_base(motion, heading.direction)[0] + heading.direction * newest.lever
        speed_sigma = motion.speed_sigma
    off = abs(newest.position - predicted)
    # while fixes are rejected, time alone must not let the same ones pass
    limit = compute_jump_limit(min(dt, settings.gps_timeout) if jumps.num_fixes else dt, *sigmas, speed_sigma, settings)
    climb = settings.jump_sigmas * math.sqrt(before.fix.up_variance + newest.fix.up_variance)
    if off > limit or abs(newest.up - before.up) > climb + settings.maximum_speed * dt:
        jumps = jumps.reject(newest, settings)
        return (Verdict.RESET if jumps.is_confirmed(settings) else Verdict.REJECTED), jumps
    # after an outage: what a fix without outage would not have been allowed is a discontinuity
    if dt > settings.gps_timeout and off > compute_jump_limit(settings.gps_timeout, *sigmas, speed_sigma, settings):
        return Verdict.RESET, jumps
    return Verdict.USED, jumps


def _recenter(
    fixes: FixMonitor, heading: Heading, fix: AcceptedFix, ecef: Vector3
) -> tuple[FixMonitor, Heading, LocalFrame]:
    """Return the states in a working frame near the fix, and that frame: the present one, or a new one."""
    old, anchor = fixes.work, fixes.anchor
    if old is not None and math.dist(old.ecef, ecef) <= WORK_RANGE:
        return fixes, heading, old
    work = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    if old is None or anchor is None:
        return fixes, heading, work

    def transform(position: complex) -> tuple[complex, float]:
        return _locate(work, old.to_ecef((position.real, position.imag, anchor.up)))

    def move(item: Positioned) -> Positioned:
        return item._replace(position=transform(item.position)[0])

    position, up = transform(anchor.position)
    turned = so3.logarithm(so3.normalize(work.rotation_of(old)))[2]
    moved = fixes._replace(
        anchor=anchor._replace(position=position, up=up),
        recent=tuple(map(move, fixes.recent)),
        segment=tuple(map(move, fixes.segment)),
        jumps=move(fixes.jumps),
        stationary=None if fixes.stationary is None else move(fixes.stationary),
    )
    return moved, heading._replace(offset=math.remainder(heading.offset + turned, math.tau)), work


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


def _read_velocity(given: FixInput, settings: RawSettings) -> ReceiverVelocity | None:
    """Return the velocity of the receiver, or that of its speed and course; None if it reports neither.

    Unlike the filter's `read_velocity`: horizontal, with one sigma for both axes, and at any speed.
    """
    sample, motion = given.sample, given.motion
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
        compute_lever_arm(motion, cross(motion.rate, given.lever))[0],
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
    found = track.fit_course(segment, heading.direction if heading.is_known else None, settings)
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
        fit = track.fit_best_speed(recent, direction, settings)
        if fit is None:
            return 0.0, settings.maximum_speed / 2.0
        vector, sigma = fit.velocity, fit.sigma
        along = (vector * direction.conjugate()).real
    if not heading.is_known:
        along = abs(vector) if abs(vector) > 3.0 * sigma else 0.0
    return max(-settings.maximum_speed, min(along, settings.maximum_speed)), sigma
