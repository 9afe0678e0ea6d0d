"""Recent fixes beside the path that rate alone draws: speed and course from positions.

Let u(t) be the integral of the unit vector along Odom's heading (`Motion.path`), as a complex number. A
vehicle of constant speed v, whose heading in the world is Odom's plus b, is at p(t) = p0 + v exp(ib) u(t).
So c = v exp(ib) is a straight-line fit of fixes p_i against u_i, in turns as on straights:
c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2, with variance s^2 / sum |u_i - mean u|^2 of
each component, s the fixes' noise. It compares the fixes with the mean heading over the stretch by itself.
The antenna's lever arm turned by heading, exp(ib) w_i, is taken off first.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from modelserver.estimation.raw.settings import RawSettings

MOST_FIXES = 32
"""Fixes kept for one stretch; beyond it every second is dropped, so a longer stretch is seen more coarsely."""


@dataclass(frozen=True, slots=True)
class TrackFix:
    """A fix of the antenna at `utime`: `place` is east + i north, metres; `sigma` of each axis.

    `path` is Motion.path then, `lever` the antenna's level lever arm along Odom's axes, `yaw` Odom's yaw.
    """

    utime: int
    place: complex
    sigma: float
    path: complex
    lever: complex
    yaw: float


@dataclass(frozen=True, slots=True)
class Slope:
    """A fit: `velocity` is v exp(ib), m/s; `sigma` of each of its components; `seconds` the stretch's length.

    `length` is how far the vehicle came, metres; `turned` how far it turned, rad.
    """

    velocity: complex
    sigma: float
    seconds: float
    length: float
    turned: float


def slopes(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Iterator[Slope]:
    """Yield the fits of the last 2, 3, ... fixes; `direction` is exp(ib), 0 leaves the lever arm in."""
    if len(fixes) < 2:
        return
    newest = fixes[-1]
    n, su, sp, suu, sup, ss = 0, 0j, 0j, 0.0, 0j, 0.0
    turned, yaw = 0.0, newest.yaw
    last_place = newest.place - direction * newest.lever
    for fix in reversed(fixes):
        u = fix.path - newest.path
        p = fix.place - direction * fix.lever - last_place
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
        yield Slope(
            velocity,
            noise / math.sqrt(spread),
            (newest.utime - fix.utime) * 1e-6,
            abs(velocity) * abs(u),
            turned,
        )


def best_speed(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Slope | None:
    """Return the fit whose error is least: noise falls with the stretch's length, lag grows with it.

    A stretch of T seconds tells the speed of its middle, T/2 ago; the speed has changed by about
    `usual_acceleration` T/2 since. The sigma returned holds both.
    """
    best: Slope | None = None
    for slope in slopes(fixes, direction, settings):
        if slope.seconds > settings.speed_window:
            break
        sigma = math.hypot(slope.sigma, 0.5 * settings.usual_acceleration * slope.seconds)
        if best is None or sigma < best.sigma:
            best = Slope(slope.velocity, sigma, slope.seconds, slope.length, slope.turned)
    return best


def course(fixes: Sequence[TrackFix], direction: complex | None, settings: RawSettings) -> tuple[float, float] | None:
    """Return the heading offset b that the whole stretch says, rad, and its sigma; None where it says nothing.

    Beside the fit's noise the sigma holds the slow part of the fixes' error, that has wandered by
    sigma sqrt(2 (1 - exp(-T/tau))) since the stretch began, and the turn.
    """
    found = _whole(fixes, 0j if direction is None else direction, settings)
    if direction is None:
        # the lever arm turns with the heading that is sought: two rounds settle it
        for _ in range(2):
            if found is None or abs(found.velocity) < 1e-9:
                return None
            found = _whole(fixes, found.velocity / abs(found.velocity), settings)
    if found is None or found.length < 1e-9:
        return None
    slow = math.sqrt(max(1.0 - settings.fix_noise_share**2, 0.0)) * fixes[-1].sigma
    wander = slow * math.sqrt(-2.0 * math.expm1(-found.seconds / settings.fix_correlation_time))
    sigma = math.hypot(
        found.sigma / abs(found.velocity), wander / found.length, settings.course_turn_share * found.turned
    )
    return cmath.phase(found.velocity), sigma


def _whole(fixes: Sequence[TrackFix], direction: complex, settings: RawSettings) -> Slope | None:
    found = None
    for slope in slopes(fixes, direction, settings):
        found = slope
    return found


def slow(fixes: Sequence[TrackFix], settings: RawSettings) -> bool:
    """Return whether the fixes say that the vehicle may be standing.

    The stretch is the shortest that resolves a third of the standing speed, or all there is where that resolves
    the standing speed.
    """
    seen: Slope | None = None
    for slope in slopes(fixes, 0j, settings):
        # at rest the path of rate alone goes straight on at 1 m/s, so it is time, and the fit a velocity
        if slope.seconds >= settings.stationary_time and slope.sigma <= settings.stationary_speed:
            seen = slope
            if slope.sigma <= settings.stationary_speed / 3.0:
                break
    return seen is not None and abs(seen.velocity) <= 2.0 * settings.stationary_speed


def kept(fixes: tuple[TrackFix, ...], fix: TrackFix, window: float) -> tuple[TrackFix, ...]:
    """Return the fixes with one more, none older than `window` seconds, every second dropped when too many."""
    oldest = fix.utime - int(window * 1e6)
    first = 0
    while first < len(fixes) and fixes[first].utime < oldest:
        first += 1
    rest = fixes[first:]
    if len(rest) >= MOST_FIXES:
        rest = rest[::2]
    return (*rest, fix)
