"""Heading alignment: the path of dead reckoning, rotated onto the GNSS fixes by least squares.

With u_i where the way says the antenna was, and p_i where the fixes say (both horizontal, as complex numbers),
p_i = p_0 + c u_i. The straight-line fit c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2 turns the
way by arg c; |c| should be 1. Wheels know backward from forward, so a vehicle that starts in reverse is right. Where
nothing measures the speed, u is the path at speed 1 and |c| the speed: then the course is known, and the heading but
for the direction of travel, which `direction_of_travel` finds.

Fixes that are late by t tell p(u - t u'), which turns the way too little, by t Im sum conj(u_i - mean u) u'_i over
sum |u_i - mean u|^2: in a circle by as much as the vehicle turns in that time.

Direction of travel. A path driven forward and the same path driven backward with the vehicle turned by 180 degrees have
the same fixes, the same turn rate and no side slip; they differ in the accelerations along the body alone, which have
opposite signs. With f_i the position by strapdown integration of the acceleration since the start (at 0 velocity, in
the frame whose yaw is unknown) plus the lever to the antenna,

    p_i = p_0 + v_0 t + q t^2 + r t^3 + c f_i,   c = exp(i heading),

where v_0 is the unknown velocity at the start, q the tilt error (times g) and r the gyro bias that changes it. Nothing
here assumes a direction of travel, so the linear fit of the complex p_0, v_0, q, r, c tells c = +1 along the course
from c = -1, once the vehicle has braked, accelerated or turned enough.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np

from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Vector3

MOST = 64
"""Fixes kept: of a longer stretch every second one goes."""

DIRECTION_SPANS = (6.0, 10.0, 15.0)
"""Seconds of fixes to estimate the direction of travel from: over longer ones gyro biases bend more than a cubic."""

DIRECTION_FIXES = 12
"""Fixes that such a stretch has at least: five unknowns, and what tells whether they explain the rest."""

DIRECTION_SIGMA = 0.15
"""Sigma of c at which the direction of travel is believed: c is +1 or -1, thirteen sigmas apart."""

CUBIC_LEAVES = 40.0
"""By how much a cubic reduces the variance of a random walk over its stretch."""


class Passed(NamedTuple):
    """A fix beside what the filter thought at its instant, all horizontal and complex, metres.

    `place` is the fix (east + i north of the site), `up` its height there; `way` where the state has the antenna, `arm`
    the lever from the rolling frame's origin to it along N; `unit` the way at speed 1, seconds. `white` and `lingering`
    are the sigmas of what is new with each fix and of the rest; `up_sigma` that of the height. `swept` is where the
    accelerations alone lead the antenna from its place and velocity at the start. `measured`: the speed was known then;
    where it was not, `way` means nothing.
    """

    utime: int
    place: complex
    up: float
    way: complex
    arm: complex
    unit: complex
    white: float
    lingering: float
    up_sigma: float
    swept: complex = 0j
    measured: bool = True


class Turn(NamedTuple):
    """By how much N must be turned about up, rad, known to `sigma`.

    `turning` is how much farther for each second that the fixes are late that told it, rad/s.
    """

    angle: float
    sigma: float
    turning: float = 0.0


class Fit(NamedTuple):
    """What a stretch of fixes tells: how N must be turned; the factor |c|.

    `travel` is -1 where the way was taken at speed -1. `distance` is how far the ends of the stretch are apart, metres;
    `scatter` the fixes' mean deviation from the way.
    """

    turn: Turn
    factor: float
    factor_sigma: float
    distance: float
    scatter: float
    seconds: float
    travel: float = 1.0


def kept(passed: tuple[Passed, ...], newest: Passed, seconds: float) -> tuple[Passed, ...]:
    """Return a stretch with one fix more, no longer than `seconds` and thinned where it has too many."""
    oldest = newest.utime - seconds * 1e6
    stretch = tuple(each for each in passed if oldest <= each.utime < newest.utime)
    if len(stretch) >= MOST:
        stretch = stretch[::2]
    return (*stretch, newest)


def fitted(
    stretch: tuple[Passed, ...],
    settings: FilterSettings,
    *,
    by_unit: bool,
    rate_sigma: float,
    travel: float = 1.0,
) -> Fit | None:
    """Return the fit of a stretch; None where it is too short to say anything.

    `by_unit` takes the way at speed 1, or where `travel` is -1 at speed -1: backward. `rate_sigma` is what the turn
    rate may be off by, rad/s.
    """
    if len(stretch) < 3:
        return None
    ways = [travel * each.unit if by_unit else each.way for each in stretch]
    fit = _line(stretch, ways, [0j] * len(stretch))
    if fit is None:
        return None
    if by_unit:
        # the arm turns with heading, and is no part of the way at speed 1: taken off with the heading found so far
        for _ in range(2):
            direction = fit[0] / abs(fit[0]) if abs(fit[0]) > 0.0 else 1.0
            again = _line(stretch, ways, [direction * each.arm for each in stretch])
            if again is None:
                return None
            fit = again
    c, spread, scatter = fit
    factor = abs(c)
    seconds = (stretch[-1].utime - stretch[0].utime) * 1e-6
    size = math.sqrt(spread)
    if factor <= 0.0 or size <= 0.0:
        return None
    ends = ways[-1] - ways[0]
    distance = abs(ends) * (factor if by_unit else 1.0)
    newest = stretch[-1]
    # what lingers is shared by neighbours and has changed by this between the ends
    changed = newest.lingering * math.sqrt(2.0 * (1.0 - math.exp(-seconds / settings.gps_correlation_time)))
    if distance <= 0.0:
        return None
    variance = (newest.white / (size * factor)) ** 2 + (changed / distance) ** 2 + (0.5 * rate_sigma * seconds) ** 2
    return Fit(
        Turn(cmath.phase(c), math.sqrt(variance), _turning(stretch, ways, spread)),
        factor,
        factor * math.sqrt((newest.white / (size * factor)) ** 2 + (changed / distance) ** 2),
        distance,
        scatter,
        seconds,
        travel,
    )


def measured(stretch: tuple[Passed, ...]) -> tuple[Passed, ...]:
    """Return the newest part of a stretch through which the speed was known."""
    for n in range(len(stretch), 0, -1):
        if not stretch[n - 1].measured:
            return stretch[n:]
    return stretch


def direction_of_travel(stretch: tuple[Passed, ...], course: float, settings: FilterSettings) -> int:
    """Return 1 where the vehicle drives forward, -1 backward, 0 where the accelerations do not tell.

    `course` is the yaw of N, rad, by which the fixes' path has the vehicle drive forward. See the module's theory.
    """
    for seconds in DIRECTION_SPANS:
        oldest = stretch[-1].utime - seconds * 1e6 if stretch else 0.0
        found = _accelerated(tuple(each for each in stretch if each.utime >= oldest), course, settings)
        if found:
            return found
    return 0


def _accelerated(stretch: tuple[Passed, ...], course: float, settings: FilterSettings) -> int:
    n = len(stretch)
    if n < DIRECTION_FIXES:
        return 0
    newest = stretch[-1]
    t = np.array([(each.utime - newest.utime) * 1e-6 for each in stretch])
    span = float(t[-1] - t[0])
    if span <= 0.0:
        return 0
    basis, _ = np.linalg.qr(np.vander(t / span, 4))
    values = np.array([(each.place, each.swept) for each in stretch])
    p, f = (values - basis @ (basis.T @ values)).T
    power = float((abs(f) ** 2).sum())
    if power <= 0.0:
        return 0
    c = complex((f.conjugate() * p).sum()) / power
    # the time-correlated error changes along the stretch like a random walk, of which the cubic leaves this share
    wander = newest.lingering * math.sqrt(2.0 * span / settings.gps_correlation_time / CUBIC_LEAVES)
    # it may correlate with f: then more fixes do not average it
    sigma = math.hypot(newest.white / math.sqrt(power), wander / math.sqrt(power / n))
    scatter = math.sqrt(float((abs(p - c * f) ** 2).sum()) / n)
    if sigma > DIRECTION_SIGMA or scatter > 3.0 * math.hypot(1.5 * newest.white, wander):
        return 0
    along = c * cmath.rect(1.0, -course)
    # one of the two directions, and not anything between them
    if not (0.5 < abs(along.real) < 1.5 and abs(along.imag) < 0.5):
        return 0
    return 1 if along.real > 0.0 else -1


def velocities(stretch: tuple[Passed, ...], ways: list[complex]) -> list[complex]:
    """Return how fast the way goes at each fix, from its neighbours."""
    last = len(ways) - 1
    pairs = [(max(k - 1, 0), min(k + 1, last)) for k in range(len(ways))]
    return [(ways[b] - ways[a]) / ((stretch[b].utime - stretch[a].utime) * 1e-6) for a, b in pairs]


def _turning(stretch: tuple[Passed, ...], ways: list[complex], spread: float) -> float:
    """Return by how much the turn of a fit grows with the fixes' lateness, rad/s; `spread` is sum |u_i - mean u|^2."""
    mean = sum(ways) / len(ways)
    pairs = zip(ways, velocities(stretch, ways), strict=True)
    found: float = sum(((way - mean).conjugate() * velocity).imag for way, velocity in pairs)
    return found / spread


def _line(stretch: tuple[Passed, ...], ways: list[complex], arms: list[complex]) -> tuple[complex, float, float] | None:
    n = len(stretch)
    places = [each.place - arm for each, arm in zip(stretch, arms, strict=True)]
    mean_way, mean_place = sum(ways) / n, sum(places) / n
    spread = sum(abs(way - mean_way) ** 2 for way in ways)
    if not spread > 1e-9:
        return None
    pairs = list(zip(ways, places, strict=True))
    c = sum((way - mean_way).conjugate() * (place - mean_place) for way, place in pairs) / spread
    off = sum(abs(place - mean_place - c * (way - mean_way)) ** 2 for way, place in pairs)
    return c, spread, math.sqrt(off / n)


def agrees(fit: Fit, newest: Passed) -> bool:
    """Return whether the fixes of a fit lie along the way as well as their noise lets them."""
    return fit.scatter <= 3.0 * (newest.white + 0.5 * newest.lingering) + 0.05 * fit.distance


def horizontal(v: Vector3) -> complex:
    """Return the horizontal part of a vector along N."""
    return complex(v[0], v[1])
