"""What has been concluded from fixes, and the step that one more fix makes: anchor, speed, course, origin."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field, replace

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw import track
from modelserver.estimation.raw.bounds import grown
from modelserver.estimation.raw.heading import Course, Heading
from modelserver.estimation.raw.motion import Motion
from modelserver.estimation.raw.place import Anchor, Jumps, jump_limit, lever_arm
from modelserver.estimation.raw.rest import Rest, judged
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.track import TrackFix
from modelserver.messages import GpsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3, cross

WORK_REACH = 200.0
"""Metres from the working frame's origin at which it is set anew: so near, its vertical and its north are the
vehicle's to 3e-5 rad."""


@dataclass(frozen=True, slots=True)
class Fixes:
    """The state drawn from fixes.

    `work` is a tangent plane near the vehicle in which positions are kept; `anchor` the last good fix; `recent`
    and `stretch` the fixes for speed and for course; `refusals` counts the fixes refused since the last good one;
    `rest` is where the vehicle came to rest.
    """

    work: LocalFrame | None = None
    anchor: Anchor | None = None
    recent: tuple[TrackFix, ...] = ()
    stretch: tuple[TrackFix, ...] = ()
    jumps: Jumps = field(default_factory=Jumps)
    refusals: int = 0
    rest: Rest | None = None

    def forgotten(self) -> Fixes:
        """Return the state without the stretches: their path is broken."""
        return replace(self, recent=(), stretch=()) if self.recent or self.stretch else self


@dataclass(frozen=True, slots=True)
class Step:
    """What one fix did: the new states, whether the world pose jumped, and a word where a part was refused."""

    fixes: Fixes
    heading: Heading
    speed: float = 0.0
    speed_sigma: float = 0.0
    slow: bool = False
    jumped: bool = False
    refused: str = ""
    ecef: Vector3 = (0.0, 0.0, 0.0)


def take(
    fixes: Fixes,
    heading: Heading,
    sample: GpsSample,
    fix: AcceptedFix,
    motion: Motion,
    standing: bool,
    lever: Vector3,
    fallback_height: float,
    turn_variance: float,
    settings: RawSettings,
) -> Step:
    """Return what is concluded with one good fix more; `motion` is the base frame's at the fix's instant.

    `lever` is the antenna's place in the base frame. A fix that told no height has the height carried to it,
    or `fallback_height` before any was told (nan: none is known). `turn_variance` is that of the turn until the
    fix's instant that no inertial sample told of yet. A refused fix leaves all but the counts as it was.
    """
    utime = sample.header.utime
    direction = cmath.rect(1.0, heading.offset) if heading.known else 1.0 + 0j
    arm, arm_up = lever_arm(motion, lever)
    swing, _ = lever_arm(motion, cross(motion.rate, lever))
    fix, ecef = _complete(fixes, fix, motion, arm_up, fallback_height, settings)
    work = fixes.work or LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    east, north, up = work.from_ecef(ecef)
    place = complex(east, north)

    jumped = False
    before = fixes.anchor
    if before is not None:
        dt = (utime - before.utime) * 1e-6
        carried = known = before.place
        speed_sigma = None
        if heading.known and motion.speed_utime:
            base, _, _ = before.base(motion, direction)
            carried, speed_sigma = base + direction * arm, motion.speed_sigma
        off = abs(place - carried)
        # while fixes are being refused, time alone must not let the same ones in
        within = min(dt, settings.gps_timeout) if fixes.jumps.count else dt
        limit = jump_limit(within, before.fix.sigma, fix.sigma, speed_sigma, settings)
        climb = settings.jump_sigmas * math.sqrt(before.fix.up_variance + fix.up_variance)
        if off > limit or abs(up - before.up) > climb + settings.maximum_speed * dt:
            jumps = fixes.jumps.refused(utime, place, fix.sigma, settings)
            if not jumps.believed(settings):
                return Step(replace(fixes, jumps=jumps, refusals=fixes.refusals + 1), heading, refused="jump")
            jumped = True
        elif dt > settings.gps_timeout:
            # back after an outage: what a fix on time would not have been allowed is a discontinuity
            jumped = off > jump_limit(settings.gps_timeout, before.fix.sigma, fix.sigma, speed_sigma, settings) or (
                speed_sigma is None and abs(place - known) > limit
            )
        if jumped:
            fixes = replace(fixes.forgotten(), rest=None)

    fixes, heading, work = _near(fixes, heading, fix, ecef)
    east, north, up = work.from_ecef(ecef)
    place = complex(east, north)
    anchor = Anchor(utime, place, up, fix, motion, arm, arm_up)
    newest = TrackFix(utime, place, fix.sigma, motion.path, arm, motion.yaw)
    recent = track.kept(fixes.recent, newest, settings.speed_window + settings.stationary_time)
    stretch = track.kept(fixes.stretch, newest, settings.course_window)
    velocity = _velocity(sample, settings)
    told = None if velocity is None else (_at_base(velocity.vector, heading, motion, swing), velocity.sigma)
    slow = track.slow(recent, settings) if told is None else abs(told[0]) <= _slow_limit(told[1], settings)
    least = max(abs(motion.speed) - 2.0 * motion.speed_sigma, 0.0)
    rest, heading, slow = judged(fixes.rest, slow, standing, newest, told, least, heading, settings)
    standing = standing and slow
    refused = ""
    if standing:
        # the path of rate alone runs on at rest: a stretch must not reach back into it
        stretch = (newest,)
        speed, speed_sigma = 0.0, settings.stationary_speed / 2.0
    else:
        was_known = heading.known
        heading, met = _course(heading, velocity, stretch, motion, swing, turn_variance, settings)
        if met is not None:
            stretch = (newest,)
            refused = "course" if met is Course.REFUSED else ""
            jumped = jumped or (met is Course.ANEW and was_known)
        speed, speed_sigma = _speed(heading, velocity, recent, motion, swing, settings)
    return Step(
        Fixes(work, anchor, recent, stretch, rest=rest),
        heading,
        speed,
        speed_sigma,
        slow,
        jumped,
        refused,
        ecef,
    )


def _complete(
    fixes: Fixes, fix: AcceptedFix, motion: Motion, arm_up: float, fallback_height: float, settings: RawSettings
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
                before.fix.up_variance + grown(age, motion.speed_sigma, settings), settings.unknown_height_sigma**2
            )
        fix = replace(fix, height=height, up_variance=variance)
    return fix, ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height)


def _near(fixes: Fixes, heading: Heading, fix: AcceptedFix, ecef: Vector3) -> tuple[Fixes, Heading, LocalFrame]:
    """Return the states in a working frame that is near the fix, and that frame: the same one, or one set anew."""
    old = fixes.work
    if old is not None and math.dist(old.ecef, ecef) <= WORK_REACH:
        return fixes, heading, old
    work = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height)
    if old is None:
        return replace(fixes, work=work), heading, work
    level = fixes.anchor.up if fixes.anchor is not None else 0.0

    def moved(place: complex, up: float = level) -> tuple[complex, float]:
        x, y, z = work.from_ecef(old.to_ecef((place.real, place.imag, up)))
        return complex(x, y), z

    def again(track_fixes: tuple[TrackFix, ...]) -> tuple[TrackFix, ...]:
        return tuple(replace(each, place=moved(each.place)[0]) for each in track_fixes)

    anchor = fixes.anchor
    if anchor is not None:
        place, up = moved(anchor.place, anchor.up)
        anchor = replace(anchor, place=place, up=up)
    turned = so3.logarithm(so3.normalize(work.rotation_of(old)))[2]
    return (
        Fixes(
            work,
            anchor,
            again(fixes.recent),
            again(fixes.stretch),
            replace(fixes.jumps, place=moved(fixes.jumps.place)[0]) if fixes.jumps.count else fixes.jumps,
            fixes.refusals,
            None if fixes.rest is None else replace(fixes.rest, place=moved(fixes.rest.place)[0]),
        ),
        replace(heading, offset=math.remainder(heading.offset + turned, math.tau)),
        work,
    )


@dataclass(frozen=True, slots=True)
class _Velocity:
    """The antenna's velocity as the receiver told it, east + i north, m/s; `age` at the fix's instant, s."""

    vector: complex
    sigma: float
    course_sigma: float
    age: float


def _velocity(sample: GpsSample, settings: RawSettings) -> _Velocity | None:
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
    return _Velocity(vector, sigma, course_sigma, age)


def _slow_limit(sigma: float, settings: RawSettings) -> float:
    """Return the speed up to which a velocity may be a standing vehicle's: its mean over time tells the rest."""
    return max(sigma, min(settings.stationary_speed + 3.0 * sigma, settings.course_speed))


def _at_base(vector: complex, heading: Heading, motion: Motion, swing: complex) -> complex:
    """Return the base frame's velocity: the antenna's without its `swing`, what turning gives it along Odom's axes."""
    if heading.known:
        direction = cmath.rect(1.0, heading.offset)
    elif abs(vector) > 0.0:
        direction = vector / abs(vector) * cmath.rect(1.0, -motion.yaw)
    else:
        return vector
    return vector - direction * swing


def _course(
    heading: Heading,
    velocity: _Velocity | None,
    stretch: tuple[TrackFix, ...],
    motion: Motion,
    swing: complex,
    turn_variance: float,
    settings: RawSettings,
) -> tuple[Heading, Course | None]:
    """Return the heading after this fix's course, and what became of it; None where there was none to take."""
    if velocity is not None:
        vector = _at_base(velocity.vector, heading, motion, swing)
        if abs(vector) < settings.course_speed or velocity.course_sigma > settings.course_sigma_limit:
            return heading, None
        # the course is of the instant the velocity was measured: heading has turned since
        offset = cmath.phase(vector) - (motion.yaw - motion.yaw_rate * velocity.age)
        return heading.met(offset, velocity.course_sigma**2 + turn_variance, settings)
    direction = cmath.rect(1.0, heading.offset) if heading.known else None
    found = track.course(stretch, direction, settings)
    if found is None or found[1] > settings.course_sigma_limit:
        return heading, None
    # the stretch tells the offset of its middle; an error of the bias has turned it since
    half = 0.5 * (stretch[-1].utime - stretch[0].utime) * 1e-6
    variance = found[1] ** 2 + heading.bias_variance * half * half + turn_variance
    return heading.met(found[0], variance, settings)


def _speed(
    heading: Heading,
    velocity: _Velocity | None,
    recent: tuple[TrackFix, ...],
    motion: Motion,
    swing: complex,
    settings: RawSettings,
) -> tuple[float, float]:
    """Return the speed along heading and its sigma: the receiver's, else that of recent fixes.

    Before heading is known the motion is taken as forward, and what is not clearly motion as none.
    """
    direction = cmath.rect(1.0, heading.offset) if heading.known else 0j
    if velocity is not None:
        vector, sigma = _at_base(velocity.vector, heading, motion, swing), velocity.sigma
        along = (vector * cmath.rect(1.0, -motion.yaw) * direction.conjugate()).real
    else:
        slope = track.best_speed(recent, direction, settings)
        if slope is None:
            return 0.0, settings.maximum_speed / 2.0
        vector, sigma = slope.velocity, slope.sigma
        along = (vector * direction.conjugate()).real
    if not heading.known:
        along = abs(vector) if abs(vector) > 3.0 * sigma else 0.0
    return max(-settings.maximum_speed, min(along, settings.maximum_speed)), sigma
