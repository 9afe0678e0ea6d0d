"""Latency estimator: the delay of GNSS fixes behind their stamps.

The latency is a state of the filter (`gps_latency`), coupled to the position by the speed and in turns to the heading.
If its uncertainty is too small, the heading absorbs what is latency; if it is too large, latency absorbs what is an
error of the fixes. So the latency is also fitted by itself when the heading is aligned (`fit_latency`), and inflated
while rejected or drifting fixes suggest that it has changed (`inflate_latency`). It shows in acceleration and in turns;
at constant speed straight ahead it is a displacement, and on a steady circle a rotation.

On a steady circle fixes determine only the sum of the heading and of turn rate times latency. The latency would follow
whatever turns the heading there, such as an error of the gyro's scale, and take the heading along without limit. So
while the two are correlated it is neither inflated nor corrected, by fixes or by wheels (`hold_latency`), nor is it the
cause of an inconsistency; and the heading's variance is that of a latency which may have changed
(`compute_heading_variance`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from modelserver.estimation.filter.error_layout import ErrorLayout
from modelserver.estimation.filter.eskf import NavState
from modelserver.estimation.filter.heading_alignment import PathFix, compute_velocities
from modelserver.estimation.filter.measurements.gnss import LATENCY
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Array

MIN_FIXES: Final = 6
"""Fixes to fit the latency from: twice the numbers that are fitted."""

CONSISTENT_SIGMAS: Final = 4.0
"""Standard deviations by which the fitted and the estimated latency may differ."""

MIN_SPEED: Final = 0.5
"""m/s below which latency does not show."""

CHANGE_SIGMA: Final = 0.1
"""Standard deviation of a latency that has changed, seconds: receivers compute for 20 to 150 ms (Groves 2013, 10.3)."""

SEPARATE_CORRELATION: Final = 0.1
"""Correlation of heading and latency up to which fixes separate the two; on a steady circle it becomes 0.5."""

DRIFT_INFLATION: Final = 4.0
"""Inflation of the GNSS noise, in variance, from which the latency is inflated too."""


class LatencyFit(NamedTuple):
    """Latency of fixes by dead reckoning, and its standard deviation, seconds."""

    seconds: float
    sigma: float


def fit_latency(segment: tuple[PathFix, ...]) -> LatencyFit | None:
    """Fit p = p_0 + c (u - t u') for the latency t as well; None if the path does not show it."""
    if len(segment) < MIN_FIXES:
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
    if abs(difference) <= CONSISTENT_SIGMAS * math.hypot(math.sqrt(nav.covariance[at, at]), fit.sigma):
        return nav
    P = nav.covariance.copy()
    P[at, :] = 0.0
    P[:, at] = 0.0
    P[at, at] = difference**2 + fit.sigma**2
    extras = list(nav.extras)
    extras[extra] += 0.5 * difference
    return nav._replace(covariance=P, extras=tuple(extras))


def inflate_latency(
    nav: NavState, residual: Sequence[float], weight: float, layout: ErrorLayout, *, is_speed_measured: bool
) -> NavState:
    """Return the state with `weight` times CHANGE_SIGMA^2 added to the variance of the latency.

    A latency that has changed looks like a jump along the path, or like a position that drifts as fast as the vehicle
    turns; the next bend or change of speed separates the two. If no wheel measures the speed, an error of speed looks
    the same, so nothing is inflated. The sigma stays within CHANGE_SIGMA and within the residual (east, north, m)
    expressed as latency: a drift at walking pace would else become a latency of seconds.
    """
    at = layout.index(LATENCY)
    vx, vy, _ = nav.velocity
    square = vx * vx + vy * vy
    if weight <= 0.0 or not square > MIN_SPEED**2 or not is_speed_measured:
        return nav
    seconds = (residual[0] * vx + residual[1] * vy) / square
    variance = float(nav.covariance[at, at])
    inflated = min(variance + CHANGE_SIGMA**2 * weight, CHANGE_SIGMA**2, seconds * seconds)
    if not inflated > variance or not is_separate(nav.covariance, at):
        return nav
    P = nav.covariance.copy()
    P[at, at] = inflated
    return nav._replace(covariance=P)


def hold_latency(before: NavState, after: NavState, layout: ErrorLayout) -> NavState:
    """Return the state `after` an update with the latency that it had `before`, where fixes cannot separate it.

    What turns the heading on a steady circle stays an error of heading and gyro, which fixes correct.
    """
    if LATENCY not in layout:
        return after
    at, extra = layout.index(LATENCY), layout.extra_index(LATENCY)
    if is_separate(after.covariance, at):
        return after
    return after.change(at, before.extras[extra] - after.extras[extra])


def compute_heading_variance(nav: NavState, layout: ErrorLayout) -> float:
    """Return the variance of the heading by a change of the latency that fixes cannot separate from it, rad2."""
    if LATENCY not in layout:
        return 0.0
    at = layout.index(LATENCY)
    if is_separate(nav.covariance, at):
        return 0.0
    turn_rate = nav.rate[2] - nav.gyro_bias[2]
    return max(CHANGE_SIGMA**2 - float(nav.covariance[at, at]), 0.0) * turn_rate * turn_rate


def is_separate(P: Array, at: int) -> bool:
    """Return whether fixes separate latency, at index `at`, and heading, by their covariance (n, n)."""
    return bool(P[8, at] ** 2 <= SEPARATE_CORRELATION**2 * P[8, 8] * P[at, at])


def get_drift_weight(inflation: float, seconds: float, settings: FilterSettings) -> float:
    """Return the weight for `inflate_latency` while the noise of fixes is inflated, for some seconds more."""
    rate = 2.0 * min(seconds, 2.0) / settings.gps_correlation_time
    return (inflation - DRIFT_INFLATION) * rate
