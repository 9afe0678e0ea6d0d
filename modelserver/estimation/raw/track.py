"""Recent fixes beside the path that rate alone draws: speed and course from positions.

Let u(t) be the integral of the unit vector along Odom's heading (`Motion.path`), as a complex number. A
vehicle of constant speed v, whose heading in the world is Odom's plus b, is at p(t) = p0 + v exp(ib) u(t).
So c = v exp(ib) is a straight-line fit of fixes p_i against u_i, in turns as on straights:
c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2, with variance s^2 / sum |u_i - mean u|^2 of
each component, s the fixes' noise. It compares the fixes with the mean heading over the stretch by itself.
The antenna's lever arm turned by heading, exp(ib) w_i, is taken off first.

The last good fix as an anchor for the pose, and the test whether the next one is a jump.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw.motion import RawMotion, to_level_axes
from modelserver.estimation.raw.settings import RawSettings
from modelserver.transforms.so3 import Vector3

MAX_TRACK_FIXES = 32
"""Fixes kept for one stretch; beyond it every second is dropped, so a longer stretch is seen more coarsely."""


@dataclass(frozen=True, slots=True)
class TrackFix:
    """A fix of the antenna at `utime`: `place` is east + i north, metres; `sigma` of each axis.

    `path` is Motion.path then, `lever` the antenna's level lever arm along Odom's axes, `yaw` Odom's yaw.
    """

    utime: int
    position: complex
    sigma: float
    path: complex
    lever: complex
    yaw: float


@dataclass(frozen=True, slots=True)
class SpeedFit:
    """A fit: `velocity` is v exp(ib), m/s; `sigma` of each of its components; `seconds` the stretch's length.

    `length` is how far the vehicle came, metres; `turned` how far it turned, rad.
    """

    velocity: complex
    sigma: float
    seconds: float
    length: float
    turned: float


def fit_speeds(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Iterator[SpeedFit]:
    """Yield the fits of the last 2, 3, ... fixes; `direction` is exp(ib), 0 leaves the lever arm in."""
    if len(fixes) < 2:
        return
    newest = fixes[-1]
    n, su, sp, suu, sup, ss = 0, 0j, 0j, 0.0, 0j, 0.0
    turned, yaw = 0.0, newest.yaw
    last_place = newest.position - direction * newest.lever
    for fix in reversed(fixes):
        u = fix.path - newest.path
        p = fix.position - direction * fix.lever - last_place
        n += 1
        su += u
        sp += p
        suu += u.real * u.real + u.imag * u.imag
        sup += u.conjugate() * p
        ss += fix.sigma
        turned += abs(fix.yaw - yaw)
        yaw = fix.yaw
        if n < 2:
            continue
        spread = suu - (su.real * su.real + su.imag * su.imag) / n
        if spread < 1e-6:
            continue
        velocity = (sup - su.conjugate() * sp / n) / spread
        noise = settings.fix_noise_share * ss / n
        yield SpeedFit(
            velocity,
            noise / math.sqrt(spread),
            (newest.utime - fix.utime) * 1e-6,
            abs(velocity) * abs(u),
            turned,
        )


def fit_best_speed(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    """Return the fit whose error is least: noise falls with the stretch's length, lag grows with it.

    A stretch of T seconds tells the speed of its middle, T/2 ago; the speed has changed by about
    `usual_acceleration` T/2 since. The sigma returned holds both.
    """
    best: SpeedFit | None = None
    for slope in fit_speeds(fixes, direction, settings):
        if slope.seconds > settings.speed_window:
            break
        sigma = math.hypot(slope.sigma, 0.5 * settings.usual_acceleration * slope.seconds)
        if best is None or sigma < best.sigma:
            best = SpeedFit(slope.velocity, sigma, slope.seconds, slope.length, slope.turned)
    return best


def fit_course(
    fixes: Sequence[TrackFix], direction: complex | None, settings: RawSettings
) -> tuple[float, float] | None:
    """Return the heading offset b that the whole stretch says, rad, and its sigma; None where it says nothing.

    Beside the fit's noise the sigma holds the slow part of the fixes' error, that has wandered by
    sigma sqrt(2 (1 - exp(-T/tau))) since the stretch began, and the turn.
    """
    found = _fit_whole(fixes, 0j if direction is None else direction, settings)
    if direction is None:
        # the lever arm turns with the heading that is sought: two rounds settle it
        for _ in range(2):
            if found is None or abs(found.velocity) < 1e-9:
                return None
            found = _fit_whole(fixes, found.velocity / abs(found.velocity), settings)
    if found is None or found.length < 1e-9:
        return None
    slow = math.sqrt(max(1.0 - settings.fix_noise_share**2, 0.0)) * fixes[-1].sigma
    wander = slow * math.sqrt(-2.0 * math.expm1(-found.seconds / settings.fix_correlation_time))
    sigma = math.hypot(
        found.sigma / abs(found.velocity), wander / found.length, settings.course_turn_share * found.turned
    )
    return cmath.phase(found.velocity), sigma


def _fit_whole(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> SpeedFit | None:
    found = None
    for slope in fit_speeds(fixes, direction, settings):
        found = slope
    return found


def is_slow(fixes: Sequence[TrackFix], settings: RawSettings) -> bool:
    """Return whether the fixes say that the vehicle may be standing.

    The stretch is the shortest that resolves a third of the standing speed, or all there is where that resolves
    the standing speed.
    """
    seen: SpeedFit | None = None
    for slope in fit_speeds(fixes, 0j, settings):
        # at rest the path of rate alone goes straight on at 1 m/s, so it is time, and the fit a velocity
        if slope.seconds >= settings.stationary_time and slope.sigma <= settings.stationary_speed:
            seen = slope
            if slope.sigma <= settings.stationary_speed / 3.0:
                break
    return seen is not None and abs(seen.velocity) <= 2.0 * settings.stationary_speed


def append_fix(fixes: tuple[TrackFix, ...], fix: TrackFix, window: float) -> tuple[TrackFix, ...]:
    """Return the fixes with one more, none older than `window` seconds, every second dropped when too many."""
    oldest = fix.utime - int(window * 1e6)
    first = 0
    while first < len(fixes) and fixes[first].utime < oldest:
        first += 1
    rest = fixes[first:]
    if len(rest) >= MAX_TRACK_FIXES:
        rest = rest[::2]
    return (*rest, fix)


@dataclass(frozen=True, slots=True)
class FixAnchor:
    """The antenna at the last good fix, in the working frame, and the base frame's motion then.

    `lever` is the antenna's lever arm along Odom's axes at that instant: horizontal part and height.
    """

    utime: int
    position: complex
    up: float
    fix: AcceptedFix
    motion: RawMotion
    lever: complex
    lever_up: float

    def propagate_base(self, motion: RawMotion, direction: complex) -> tuple[complex, float, complex]:
        """Return the base frame's place and height in the working frame as carried to `motion`.

        p_base = p_antenna + exp(ib) (Odom's way since the fix - lever arm at the fix); the third value is that
        arm, which an error of heading turns.
        """
        then = self.motion
        arm = direction * (complex(motion.x - then.x, motion.y - then.y) - self.lever)
        return self.position + arm, self.up - self.lever_up + motion.z - then.z, arm


def compute_lever_arm(motion: RawMotion, lever: Vector3) -> tuple[complex, float]:
    """Return a lever arm of the base frame along Odom's axes: horizontal, and up."""
    x, y, z = to_level_axes(motion.up, lever)
    return complex(x, y) * complex(math.cos(motion.yaw), math.sin(motion.yaw)), z


@dataclass(frozen=True, slots=True)
class JumpMonitor:
    """A run of refused fixes that agree: `count` of them, the first at `since`, the last at `utime` and `place`."""

    count: int = 0
    utime: int = 0
    position: complex = 0j
    since: int = 0

    def reject(self, utime: int, place: complex, sigma: float, settings: RawSettings) -> JumpMonitor:
        """Return the run with one more refused fix: longer where it agrees with the last, else begun anew."""
        dt = abs(utime - self.utime) * 1e-6
        reach = settings.maximum_speed * dt + settings.jump_sigmas * math.sqrt(2.0) * sigma
        agrees = self.count > 0 and abs(place - self.position) <= reach
        return JumpMonitor(self.count + 1, utime, place, self.since) if agrees else JumpMonitor(1, utime, place, utime)

    def is_confirmed(self, settings: RawSettings) -> bool:
        """Return whether the run is long enough, in fixes and in time, to be right against the prediction."""
        return self.count >= settings.jump_fixes and (self.utime - self.since) * 1e-6 >= settings.jump_time


def compute_jump_limit(
    dt: float, sigma_before: float, sigma: float, speed_sigma: float | None, settings: RawSettings
) -> float:
    """Return how far a fix may be off its prediction, metres, `dt` seconds after the last good one.

    `speed_sigma` is that of the speed the prediction was made with, None where there was none: then the
    vehicle may have gone anywhere at its maximum speed.
    """
    noise = settings.jump_sigmas * math.hypot(sigma_before, sigma)
    anywhere = settings.maximum_speed * dt
    if speed_sigma is None:
        return noise + anywhere
    carried = 0.5 * settings.maximum_acceleration * dt * dt + settings.jump_sigmas * speed_sigma * dt
    return noise + min(anywhere, carried)


def compute_growth(age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the variance of each horizontal axis that carrying a fix on for `age` seconds adds, m2.

    The speed is uncertain by its sigma and changes unforeseen: (s_v t)^2 + (a t^2 / 2)^2.
    """
    t = min(age, 1e4)
    return (speed_sigma * t) ** 2 + (0.5 * settings.usual_acceleration * t * t) ** 2
