"""The path of dead reckoning beside the fixes: its nodes, and the discrepancy between two of them.

The path is what no fix corrects: turns by the gyro, way by the wheels. With z_k the fix at a node, o the path in its
own axes, and R_k its rotation to N at that time, a window from node k to another one shows

    e = (z - z_k) - R_k (o - o_k),      cov(e) = 2 s_c^2 (1 - exp(-T / tau)) I + white noise + sum u u'           (1)

over its T seconds. The vectors u are what one standard deviation of each parameter of dead reckoning at the start of
the window adds: with d = R_k (o - o_k) as a complex number, i d s_heading, d s_scale, i m s_rate with the moment
m = integral of (t - t_k) dd, and the noise of slip and of the gyros.
"""

from __future__ import annotations

import cmath
import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.estimation.filter.settings import FilterSettings

COURSE_FLOOR: Final = 0.03
"""Standard deviation of the course beside the heading, rad, where only fixes show how the vehicle moves: it slips
sideways in turns and crabs in wind and on slopes."""

MIN_TURN_PATH: Final = 3.0
"""Meters of a path, at least, that fixes show a heading along."""

LEAST_MOVED: Final = 0.5
"""Way of the fixes relative to that of the path, at least, whose direction shows the heading."""

MAX_INFLATION: Final = 4.0
"""Largest inflation, in variance, of the error of fixes here: a drift must not excuse itself."""

LARGEST_TURN_SIGMA: Final = 0.2
"""Standard deviation of the path's turn since the start of a window, rad, beyond which its errors are not linear."""


class PathNoise(NamedTuple):
    """Noise along the path.

    Attributes
    ----------
    heading, bias: densities of the random walks of the heading, rad2/s, and of the yaw gyro's bias, rad2/s3.
    inflation: of the fixes' errors, in variance.
    """

    heading: float
    bias: float
    inflation: float


class PathNode(NamedTuple):
    """Fix, path and state at an instant; vectors of the plane are complex, meters.

    Attributes
    ----------
    fix, antenna: the antenna by the fix at its stamp, and by the state after it, along N.
    velocity, turn_rate: of the antenna along N, m/s, and of the vehicle, rad/s.
    path: the antenna by dead reckoning, along the path's own axes.
    moment: integral of time along the path, m s, and `seconds` the time, both since the start of the path.
    rotation: yaw from the path's axes to N, rad.
    distance: travelled, m.
    rate_bias, scale: of the yaw gyro, rad/s, and of the wheels, by the state.
    heading_variance, rate_variance, scale_variance: of the heading (rad2), and of those.
    has_gyro, is_measured: whether a gyro measures the turns, and wheels the path too.
    own_heading: by the gyro alone, along the path's axes, rad.
    bias_turn: integral of `rate_bias` since the start of the path, rad.
    latency, latency_variance: of fixes, s and s2; `shows_latency`: whether fixes separate it from the heading.
    lost: variance of the heading that was lost in gaps of the IMU since the start of the path, rad2.
    unmeasured: the part of `distance` whose length nothing measured, m.
    white, correlated: standard deviations of the two errors of the fix, m.
    position_covariance: of the state's position: east, north, cross, m2.
    """

    utime: int
    fix: complex
    antenna: complex
    velocity: complex
    turn_rate: float
    path: complex
    moment: complex
    seconds: float
    rotation: float
    distance: float
    rate_bias: float
    scale: float
    heading_variance: float
    rate_variance: float
    scale_variance: float
    has_gyro: bool
    is_measured: bool
    own_heading: float
    bias_turn: float
    latency: float
    latency_variance: float
    shows_latency: bool
    lost: float
    unmeasured: float
    white: float
    correlated: float
    position_covariance: tuple[float, float, float]


class Discrepancy(NamedTuple):
    """The newest fix against the path since a node.

    Attributes
    ----------
    node: the start of the window.
    error: e of (1) along N, m.
    sigmas: its size in standard deviations.
    sigma: standard deviation of e along its longest axis, m.
    displacement: of the antenna by dead reckoning, along N, m.
    covariance: of dead reckoning alone: east, north, cross, m2.
    turn, turn_sigma: angle from the path to the way of the fixes, which the heading would explain, and its standard
        deviation, rad.
    """

    node: PathNode
    error: complex
    sigmas: float
    sigma: float
    displacement: complex
    covariance: tuple[float, float, float]
    turn: float
    turn_sigma: float


def compare_window(start: PathNode, end: PathNode, noise: PathNoise, settings: FilterSettings) -> Discrepancy:
    """Return the discrepancy (1) between two nodes."""
    seconds = end.seconds - start.seconds
    d = cmath.rect(1.0, start.rotation) * (end.path - start.path)
    error = shift_fix(end, end.latency) - shift_fix(start, end.latency) - d
    m = get_moment(start, end)
    driven = end.distance - start.distance
    square = abs(d) ** 2
    # white noises: slip and side slip that last slip_time, the gyros'
    even = settings.slip_time * (
        (settings.slip_ratio * driven) ** 2 / max(seconds, 1e-3) + settings.side_sigma**2 * seconds
    )
    even += (end.unmeasured - start.unmeasured) ** 2
    across = start.heading_variance + noise.heading * seconds / 3.0 + end.lost - start.lost
    # a turn shortens the path along itself: to the second order, E (1 - cos)^2
    along = start.scale_variance + 0.75 * across * across
    x, y = d.real, d.imag
    east = even + across * y * y + along * x * x + start.rate_variance * m.imag**2
    north = even + across * x * x + along * y * y + start.rate_variance * m.real**2
    cross = (along - across) * x * y - start.rate_variance * m.real * m.imag
    fixes = get_fix_variance(start, end, noise, settings)
    fixes += end.latency_variance * abs(end.velocity - start.velocity) ** 2
    a, b = east + fixes, north + fixes
    ex, ey = error.real, error.imag
    square_sum = (b * ex * ex - 2.0 * cross * ex * ey + a * ey * ey) / (a * b - cross * cross)
    turn = turn_sigma = 0.0
    if square > MIN_TURN_PATH**2:
        # the fixes moved by d + e; where they hardly moved, their direction means nothing
        moved = 1.0 + error * d.conjugate() / square
        turn = cmath.phase(moved) if abs(moved) > LEAST_MOVED else moved.imag
        side = (a * y * y - 2.0 * cross * x * y + b * x * x) / square
        turn_sigma = math.sqrt(side / square) / min(max(abs(moved), LEAST_MOVED), 1.0)
    longest = math.sqrt(compute_longest_axis(a, b, cross))
    return Discrepancy(
        start, error, math.sqrt(max(square_sum, 0.0)), longest, d, (east, north, cross), turn, turn_sigma
    )


def is_direction_known(start: PathNode, end: PathNode) -> bool:
    """Return whether the path's turn between two nodes is known well enough for (1), which is linear in its error."""
    seconds = end.seconds - start.seconds
    return start.heading_variance + start.rate_variance * seconds**2 <= LARGEST_TURN_SIGMA**2


def find_turn(start: PathNode, end: PathNode) -> float:
    """Return by which fixes have turned the heading between two nodes, rad.

    That is beside a gyro with the bias of the start: a state that follows the fixes changes the bias too.
    """
    bias = end.bias_turn - start.bias_turn - start.rate_bias * (end.seconds - start.seconds)
    return wrap_angle(end.rotation - start.rotation - bias)


def get_turn_sigma(start: PathNode, end: PathNode, noise: PathNoise) -> float:
    """Return the standard deviation of what fixes may turn the heading by between two nodes, rad."""
    seconds = end.seconds - start.seconds
    variance = start.heading_variance + noise.heading * seconds
    variance += start.rate_variance * seconds**2 + noise.bias * seconds**3 / 3.0
    return math.sqrt(variance + end.lost - start.lost + COURSE_FLOOR**2)


def shift_fix(node: PathNode, latency: float) -> complex:
    """Return the antenna by a fix of some latency at its stamp, along N, m: to the second order in turns."""
    return node.fix + latency * node.velocity * (1.0 - 0.5j * latency * node.turn_rate)


def get_moment(start: PathNode, end: PathNode) -> complex:
    """Return the integral of the time since a node along the path from there, along N, m s."""
    turned = cmath.rect(1.0, start.rotation)
    return turned * (end.moment - start.moment - start.seconds * (end.path - start.path))


def get_fix_variance(start: PathNode, end: PathNode, noise: PathNoise, settings: FilterSettings) -> float:
    """Return the variance, along each axis, of the difference of two fixes, m2."""
    seconds = end.seconds - start.seconds
    changed = 2.0 * (1.0 - math.exp(-seconds / settings.gps_correlation_time))
    variance = min(noise.inflation, MAX_INFLATION) * changed * start.correlated * end.correlated
    return variance + start.white**2 + end.white**2
