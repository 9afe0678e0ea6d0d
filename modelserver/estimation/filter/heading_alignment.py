"""Heading alignment: the path of dead reckoning, rotated onto the GNSS fixes by least squares.

With u_i the antenna by dead reckoning, and p_i by the fixes (both horizontal, as complex numbers), p_i = p_0 + c u_i.
The straight-line fit c = sum conj(u_i - mean u) (p_i - mean p) / sum |u_i - mean u|^2 rotates the path by arg c; |c|
should be 1. Wheels measure the direction of travel, so a vehicle that starts in reverse is right. If nothing measures
the speed, u is the path at speed 1 and |c| the speed: then the course is known, and the heading except for the
direction of travel, which `find_direction_of_travel` finds.

Fixes with the latency t measure p(u - t u'), which rotates the path too little, by t Im sum conj(u_i - mean u) u'_i
over sum |u_i - mean u|^2: on a circle by as much as the vehicle turns in that time.

Direction of travel. A path driven forward and the same path driven backward with the vehicle turned by 180 degrees have
the same fixes, the same turn rate and no side slip; they differ in the accelerations along the body alone, which have
opposite signs. With f_i the position by strapdown integration of the acceleration since the start (at 0 velocity, in
the frame whose yaw is unknown) plus the lever arm to the antenna,

    p_i = p_0 + v_0 t + q t^2 + r t^3 + c f_i,   c = exp(i heading),

where v_0 is the unknown velocity at the start, q the tilt error (times g) and r the gyro bias that changes it. Nothing
here assumes a direction of travel, so the linear fit of the complex p_0, v_0, q, r, c separates c = +1 along the course
from c = -1, once the vehicle has braked, accelerated or turned enough.

Initialization in the world rotates N by the angle found (`rotate`) and puts the antenna on the newest fix (`place`).
Fixes that are later than the state's latency turn the path in a bend; so it is fitted too (`fit_latency`).
"""

from __future__ import annotations

import cmath
import math
from typing import Final, NamedTuple

import numpy as np

from modelserver.earth.geodesy import rotation_about_up
from modelserver.estimation.filter import eskf
from modelserver.estimation.filter.eskf import ErrorLayout, NavState
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, LATENCY
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

MAX_FIXES: Final = 64
"""Fixes stored: of a longer segment every second one is dropped."""

DIRECTION_SPANS: Final = (6.0, 10.0, 15.0)
"""Seconds of fixes to estimate the direction of travel from: over longer ones gyro biases bend more than a cubic."""

DIRECTION_FIXES: Final = 12
"""Fixes that such a segment has at least: five unknowns, and a test whether they explain the rest."""

DIRECTION_SIGMA: Final = 0.15
"""Sigma of c below which the direction of travel is accepted: c is +1 or -1, thirteen sigmas apart."""

TYPICAL_SECONDS: Final = 10.0
"""Seconds of driving after which the heading is usually known."""

CUBIC_VARIANCE_RATIO: Final = 40.0
"""Ratio by which a cubic reduces the variance of a random walk over its segment."""


class PathFix(NamedTuple):
    """A fix beside the state at its instant, all horizontal and complex (east + i north), meters.

    Attributes
    ----------
    position: of the fix, in the site's plane.
    up: its height there, m.
    path: the antenna by the state.
    arm: from the rolling frame's origin to the antenna, along N.
    unit_path: the path at speed 1 so far, seconds.
    white, correlated: standard deviations of the white and of the time-correlated error of the fix, m.
    up_sigma: standard deviation of the time-correlated error of its height, m.
    accelerated_path: the antenna by the accelerations alone, from its position and velocity at the start.
    is_speed_known: whether the speed was known then; otherwise `path` means nothing.
    """

    utime: int
    position: complex
    up: float
    path: complex
    arm: complex
    unit_path: complex
    white: float
    correlated: float
    up_sigma: float
    accelerated_path: complex = 0j
    is_speed_known: bool = True


class Rotation(NamedTuple):
    """The angle by which N must be rotated about up, rad, and its sigma.

    `per_latency` is how much more for each second of latency of the fixes that it was found from, rad/s.
    """

    angle: float
    sigma: float
    per_latency: float = 0.0


class PathFit(NamedTuple):
    """Fit of a path to fixes.

    Attributes
    ----------
    rotation: of N.
    factor, factor_sigma: |c| and its sigma.
    distance: between the ends of the segment, m.
    scatter: rms deviation of the fixes from the path, m.
    seconds: duration of the segment.
    travel: -1 if the path was taken at speed -1.
    """

    rotation: Rotation
    factor: float
    factor_sigma: float
    distance: float
    scatter: float
    seconds: float
    travel: float = 1.0


class HeadingAlignment(NamedTuple):
    """What is known before the heading is.

    Attributes
    ----------
    fixes: fixes beside the path, for the heading.
    last_fix: the newest fix.
    unit_path: the path at speed 1 so far, seconds.
    accelerated_velocity, accelerated_path: first and second integral of the IMU's horizontal acceleration along N,
        m/s and m.
    is_direction_unknown: whether the heading lacks only the direction of travel, forward or backward.
    """

    fixes: tuple[PathFix, ...] = ()
    last_fix: PathFix | None = None
    unit_path: complex = 0j
    accelerated_velocity: complex = 0j
    accelerated_path: complex = 0j
    is_direction_unknown: bool = False

    def update(self, before: NavState, after: NavState) -> HeadingAlignment:
        """Return the alignment after propagation from one state to a later one; propagation alone changes velocity."""
        step = (after.utime - before.utime) * 1e-6
        middle = 0.5 * (cmath.rect(1.0, before.yaw) + cmath.rect(1.0, after.yaw))
        (ax, ay, _), (bx, by, _) = before.velocity, after.velocity
        change = complex(bx - ax, by - ay)
        return HeadingAlignment(
            self.fixes,
            self.last_fix,
            self.unit_path + step * middle,
            self.accelerated_velocity + change,
            self.accelerated_path + step * (self.accelerated_velocity + 0.5 * change),
            self.is_direction_unknown,
        )

    def estimate_distance(self, settings: FilterSettings) -> float:
        """Return how far the vehicle must still drive until the heading is known to `align_sigma`, about, m.

        The sigma of a heading by fixes is that of the change of their error between the ends of the path, over its
        length. nan before the first fix.
        """
        newest = self.last_fix
        if newest is None:
            return math.nan
        seconds = max((newest.utime - self.fixes[0].utime) * 1e-6 if self.fixes else 0.0, TYPICAL_SECONDS)
        changed = newest.correlated * math.sqrt(2.0 * (1.0 - math.exp(-seconds / settings.gps_correlation_time)))
        needed = math.hypot(1.5 * newest.white, changed) / settings.align_sigma
        driven = max((abs(newest.position - each.position) for each in self.fixes), default=0.0)
        return max(needed - driven, 0.0)


# --- fit ----------------------------------------------------------------------------------------------------


def append_fix(fixes: tuple[PathFix, ...], newest: PathFix, seconds: float) -> tuple[PathFix, ...]:
    """Return a segment with one fix more, no longer than `seconds`, and thinned if it has too many."""
    oldest = newest.utime - seconds * 1e6
    segment = tuple(each for each in fixes if oldest <= each.utime < newest.utime)
    if len(segment) >= MAX_FIXES:
        segment = segment[::2]
    return (*segment, newest)


def fit_path(
    segment: tuple[PathFix, ...],
    settings: FilterSettings,
    *,
    is_unit_path: bool,
    rate_sigma: float,
    travel: float = 1.0,
) -> PathFit | None:
    """Fit the path of a segment to its fixes; None if it is too short.

    Parameters
    ----------
    is_unit_path: use the path at speed 1, or at speed `travel` = -1 for backward.
    rate_sigma: standard deviation of the error of the turn rate, rad/s.
    """
    if len(segment) < 3:
        return None
    paths = [travel * each.unit_path if is_unit_path else each.path for each in segment]
    fit = _fit_line(segment, paths, [0j] * len(segment))
    if fit is None:
        return None
    if is_unit_path:
        # the arm turns with the heading, and is no part of the path at speed 1: subtract it with the heading so far
        for _ in range(2):
            direction = fit[0] / abs(fit[0]) if abs(fit[0]) > 0.0 else 1.0
            again = _fit_line(segment, paths, [direction * each.arm for each in segment])
            if again is None:
                return None
            fit = again
    c, spread, scatter = fit
    factor = abs(c)
    seconds = (segment[-1].utime - segment[0].utime) * 1e-6
    size = math.sqrt(spread)
    if factor <= 0.0 or size <= 0.0:
        return None
    ends = paths[-1] - paths[0]
    distance = abs(ends) * (factor if is_unit_path else 1.0)
    newest = segment[-1]
    # neighboring fixes share the time-correlated error; it has changed by this between the ends
    changed = newest.correlated * math.sqrt(2.0 * (1.0 - math.exp(-seconds / settings.gps_correlation_time)))
    if distance <= 0.0:
        return None
    variance = (newest.white / (size * factor)) ** 2 + (changed / distance) ** 2 + (0.5 * rate_sigma * seconds) ** 2
    return PathFit(
        Rotation(cmath.phase(c), math.sqrt(variance), _rotation_per_latency(segment, paths, spread)),
        factor,
        factor * math.sqrt((newest.white / (size * factor)) ** 2 + (changed / distance) ** 2),
        distance,
        scatter,
        seconds,
        travel,
    )


def _fit_line(
    segment: tuple[PathFix, ...], paths: list[complex], arms: list[complex]
) -> tuple[complex, float, float] | None:
    """Return c, sum |u_i - mean u|^2 and the rms deviation."""
    n = len(segment)
    positions = [each.position - arm for each, arm in zip(segment, arms, strict=True)]
    mean_path, mean_position = sum(paths) / n, sum(positions) / n
    spread = sum(abs(path - mean_path) ** 2 for path in paths)
    if not spread > 1e-9:
        return None
    pairs = list(zip(paths, positions, strict=True))
    c = sum((path - mean_path).conjugate() * (position - mean_position) for path, position in pairs) / spread
    deviation = sum(abs(position - mean_position - c * (path - mean_path)) ** 2 for path, position in pairs)
    return c, spread, math.sqrt(deviation / n)


def _rotation_per_latency(segment: tuple[PathFix, ...], paths: list[complex], spread: float) -> float:
    """Return how the rotation of a fit grows with the latency of the fixes, rad/s; `spread` is sum |u_i - mean u|^2."""
    mean = sum(paths) / len(paths)
    pairs = zip(paths, compute_velocities(segment, paths), strict=True)
    found: float = sum(((path - mean).conjugate() * velocity).imag for path, velocity in pairs)
    return found / spread


def compute_velocities(segment: tuple[PathFix, ...], paths: list[complex]) -> list[complex]:
    last = len(paths) - 1
    pairs = [(max(k - 1, 0), min(k + 1, last)) for k in range(len(paths))]
    return [(paths[b] - paths[a]) / ((segment[b].utime - segment[a].utime) * 1e-6) for a, b in pairs]


def is_consistent(fit: PathFit, newest: PathFix) -> bool:
    """Return whether the fixes of a fit lie along the path as closely as their noise allows."""
    return fit.scatter <= 3.0 * (newest.white + 0.5 * newest.correlated) + 0.05 * fit.distance


def select_known_speed(segment: tuple[PathFix, ...]) -> tuple[PathFix, ...]:
    """Return the newest part of a segment throughout which the speed was known."""
    for n in range(len(segment), 0, -1):
        if not segment[n - 1].is_speed_known:
            return segment[n:]
    return segment


def to_horizontal(v: Vector3) -> complex:
    """Return the horizontal part of a vector along N, east + i north."""
    return complex(v[0], v[1])


# --- direction of travel ------------------------------------------------------------------------------------


def find_direction_of_travel(segment: tuple[PathFix, ...], course: float, settings: FilterSettings) -> int:
    """Return 1 for a vehicle that drives forward, -1 backward, 0 if the accelerations do not show it.

    `course` is the yaw of N, rad, with which the fixes' path has the vehicle drive forward. See the module's theory.
    """
    for seconds in DIRECTION_SPANS:
        oldest = segment[-1].utime - seconds * 1e6 if segment else 0.0
        found = _fit_direction(tuple(each for each in segment if each.utime >= oldest), course, settings)
        if found:
            return found
    return 0


def _fit_direction(segment: tuple[PathFix, ...], course: float, settings: FilterSettings) -> int:
    n = len(segment)
    if n < DIRECTION_FIXES:
        return 0
    newest = segment[-1]
    t = np.array([(each.utime - newest.utime) * 1e-6 for each in segment])
    span = float(t[-1] - t[0])
    if span <= 0.0:
        return 0
    basis, _ = np.linalg.qr(np.vander(t / span, 4))
    values = np.array([(each.position, each.accelerated_path) for each in segment])
    p, f = (values - basis @ (basis.T @ values)).T
    power = float((abs(f) ** 2).sum())
    if power <= 0.0:
        return 0
    c = complex((f.conjugate() * p).sum()) / power
    # the time-correlated error changes along the segment like a random walk, of which the cubic leaves this share
    drift = newest.correlated * math.sqrt(2.0 * span / settings.gps_correlation_time / CUBIC_VARIANCE_RATIO)
    # it may correlate with f: then more fixes do not average it
    sigma = math.hypot(newest.white / math.sqrt(power), drift / math.sqrt(power / n))
    scatter = math.sqrt(float((abs(p - c * f) ** 2).sum()) / n)
    if sigma > DIRECTION_SIGMA or scatter > 3.0 * math.hypot(1.5 * newest.white, drift):
        return 0
    along = c * cmath.rect(1.0, -course)
    # one of the two directions, and not anything between them
    if not (0.5 < abs(along.real) < 1.5 and abs(along.imag) < 0.5):
        return 0
    return 1 if along.real > 0.0 else -1


# --- initialization in the world ----------------------------------------------------------------------------


def rotate(nav: NavState, rotation: Rotation, layout: ErrorLayout) -> NavState:
    """Return the state with N rotated about up, and everything in N with it.

    An error of the rotation is one of yaw, and rotates the velocity too. The latency of the fixes adds to the rotation
    as far as it is known; its uncertainty is an error that the two share.
    """
    latency = nav.extras[layout.extra_index(LATENCY)] if rotation.per_latency else 0.0
    spin = rotation_about_up(rotation.angle + rotation.per_latency * latency)
    velocity = so3.rotate(spin, nav.velocity)
    n = len(nav.covariance)
    T = np.eye(n)
    R = np.array(so3.matrix_rows(spin))
    for at in (0, 3, 6):
        T[at : at + 3, at : at + 3] = R
    P = T @ nav.covariance @ T.T
    G = np.zeros(n)
    G[3], G[4], G[8] = -velocity[1], velocity[0], 1.0
    P += np.outer(G, G) * rotation.sigma**2
    if rotation.per_latency:
        L = np.eye(n)
        L[:, layout.index(LATENCY)] += rotation.per_latency * G
        P = L @ P @ L.T
    return nav._replace(
        position=so3.rotate(spin, nav.position),
        velocity=velocity,
        attitude=so3.normalize(so3.multiply(spin, nav.attitude)),
        impulse=so3.rotate(spin, nav.impulse),
        covariance=0.5 * (P + P.T),
    )


def place(nav: NavState, fix: PathFix, displacement: complex, lever: Vector3, layout: ErrorLayout) -> NavState:
    """Return the state with the antenna at a fix plus the `displacement` since then (m along N).

    `lever` leads from the IMU to the antenna, body axes, m. The time-correlated error of the fix and its latency are
    errors of the position from now on: p = fix - correlated - white + latency v.
    """
    arm = so3.rotate(nav.attitude, lever)
    vx, vy, _ = nav.point_velocity(lever)
    latency = nav.extras[layout.extra_index(LATENCY)]
    antenna = fix.position + displacement + latency * complex(vx, vy)
    position = (antenna.real - arm[0], antenna.imag - arm[1], fix.up - arm[2])
    variance_of, latency_at, at = nav.covariance.item, layout.index(LATENCY), layout.index(CORRELATED_ERROR[0])
    # second order: the product of latency and velocity, both unknown
    second = [variance_of(latency_at, latency_at) * variance_of(k, k) for k in (3, 4)]
    # p = antenna - R lever + latency v: an error of attitude moves p by -theta x (R lever) = [arm]x theta
    T = np.eye(layout.size)
    T[0:3, 6:9] = so3.skew(arm)
    T[:2, latency_at] = vx, vy
    T[range(3), range(at, at + 3)] = -fix.correlated, -fix.correlated, -fix.up_sigma
    nav = nav.forget(slice(0, 3)).forget(slice(at, at + 3), np.ones(3)).transform(T)
    nav = nav.widen({0: second[0] + fix.white**2, 1: second[1] + fix.white**2, 2: 0.25 * fix.up_sigma**2})
    extras = list(nav.extras)
    for name in CORRELATED_ERROR:
        extras[layout.extra_index(name)] = 0.0
    return nav._replace(position=position, extras=tuple(extras))


def set_speed(nav: NavState, speed: float, sigma: float) -> NavState:
    """Return the state with a speed along the body's x axis that was found from fixes, m/s."""
    n = len(nav.covariance)
    forward = so3.rotate(nav.attitude, (1.0, 0.0, 0.0))
    along = sum(a * b for a, b in zip(forward, nav.velocity, strict=True))
    H = np.zeros((1, n))
    H[0, 3:6] = forward
    # the mean over the segment is not the speed now: a tenth of it may have changed
    variance = sigma * sigma + (0.1 * speed) ** 2 + 0.04
    error, P = eskf.correct(nav.covariance, np.array((speed - along,)), H, np.array(((variance,),)))
    return nav.inject(error, P)


# --- latency of fixes -----------------------------------------------------------------------------------------

LATENCY_FIXES: Final = 6
"""Fixes to fit the latency from: twice the numbers that are fitted."""

LATENCY_SIGMAS: Final = 4.0
"""Standard deviations by which the fitted and the estimated latency may differ: 6e-5 of a normal error."""


class LatencyFit(NamedTuple):
    """Latency of fixes by dead reckoning, and its standard deviation, seconds."""

    seconds: float
    sigma: float


def fit_latency(segment: tuple[PathFix, ...]) -> LatencyFit | None:
    """Fit p = p_0 + c (u - t u') for the latency t as well; None if the path does not show it."""
    if len(segment) < LATENCY_FIXES:
        return None
    paths = [each.path for each in segment]
    # at the ends the velocity is that of half an interval away, which would look like a changing one
    velocities = np.array(compute_velocities(segment, paths))[1:-1]
    A = np.column_stack((np.ones(len(velocities)), np.array(paths[1:-1]) - paths[0], velocities))
    try:
        inverse = np.linalg.inv(A.conj().T @ A)
    except np.linalg.LinAlgError:
        return None
    positions = np.array([each.position - segment[0].position for each in segment[1:-1]])
    _, c, displaced = inverse @ (A.conj().T @ positions)
    variance = float(inverse[2, 2].real)
    if not (abs(c) > 0.0 and 0.0 < variance < math.inf):
        return None
    return LatencyFit(-float((displaced / c).real), segment[-1].white * math.sqrt(variance) / abs(c))


def reconcile_latency(nav: NavState, fit: LatencyFit | None, layout: ErrorLayout) -> NavState:
    """Return the state with its latency halfway to a fit that contradicts it, and the difference as its sigma.

    A fit within the uncertainties is left to the updates. Beyond, either may be wrong: the fixes may be late, or may
    have stayed in place while the vehicle drove off, as receivers make them do at low speed.
    """
    if fit is None:
        return nav
    at, extra = layout.index(LATENCY), layout.extra_index(LATENCY)
    difference = fit.seconds - nav.extras[extra]
    if abs(difference) <= LATENCY_SIGMAS * math.hypot(math.sqrt(nav.covariance[at, at]), fit.sigma):
        return nav
    extras = list(nav.extras)
    extras[extra] += 0.5 * difference
    return nav.forget([at], [difference**2 + fit.sigma**2])._replace(extras=tuple(extras))
