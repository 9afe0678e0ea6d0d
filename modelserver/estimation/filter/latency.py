"""Latency estimator: delay of GNSS fixes from acceleration, and its inflation.

Lateness is a state of the filter (`gps_latency`), tied to the position by the speed and in turns to heading. Where it
is too sure heading takes what is lateness's, and where it is too unsure lateness what is a wrong fix's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modelserver.estimation.filter.alignment import Passed, velocities
from modelserver.estimation.filter.layout import Layout
from modelserver.estimation.filter.measurements.gps import LATENCY
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState

LEAST = 6
"""Fixes that tell how late they are: twice the numbers that are found from them."""

DOUBTED = 4.0
"""Sigmas by which lateness that was found and lateness that is expected may differ."""

SLOW = 0.5
"""Metres a second below which lateness does not show."""

CHANGED = 0.1
"""Sigma of lateness that has changed, seconds: receivers compute for 20 to 150 ms (P. Groves 2013, 10.3)."""

RESTLESS = 4.0
"""So many times faster than the settings say, in variance, fixes may wander before their lateness is doubted."""


class Lateness(NamedTuple):
    """By how many seconds fixes are late by what the way says, and its sigma."""

    seconds: float
    sigma: float


def told(stretch: tuple[Passed, ...]) -> Lateness | None:
    """Return how late fixes are: p = p_0 + c (u - t u') fitted for t as well; None where the way does not tell.

    It does where speed or direction change. At steady speed straight ahead lateness is a shift of place, and in a
    steady circle one of heading.
    """
    if len(stretch) < LEAST:
        return None
    ways = [each.way for each in stretch]
    # at the ends the speed is that of half an interval away, which would pass for one that changes
    speeds = np.array(velocities(stretch, ways))[1:-1]
    A = np.column_stack((np.ones(len(speeds)), np.array(ways[1:-1]) - ways[0], speeds))
    try:
        inverse = np.linalg.inv(A.conj().T @ A)
    except np.linalg.LinAlgError:
        return None
    _, c, moved = inverse @ (A.conj().T @ np.array([each.place - stretch[0].place for each in stretch[1:-1]]))
    variance = float(inverse[2, 2].real)
    if not (abs(c) > 0.0 and 0.0 < variance < math.inf):
        return None
    return Lateness(-float((moved / c).real), stretch[-1].white * math.sqrt(variance) / abs(c))


def doubted(nav: Nav, found: Lateness | None, layout: Layout) -> Nav:
    """Return the state with lateness of fixes as unsure as what is expected of it and what was found differ.

    What both allow for is left to the updates. Else either may be wrong: the fixes may be late, or may have stuck to
    their place while the vehicle drove off, as receivers make them do at low speed.
    """
    if found is None:
        return nav
    late_at, extra = layout.index(LATENCY), layout.extra(LATENCY)
    off = found.seconds - nav.extras[extra]
    if abs(off) <= DOUBTED * math.hypot(math.sqrt(nav.covariance[late_at, late_at]), found.sigma):
        return nav
    P = nav.covariance.copy()
    P[late_at, :] = 0.0
    P[:, late_at] = 0.0
    P[late_at, late_at] = off**2 + found.sigma**2
    extras = list(nav.extras)
    extras[extra] += 0.5 * off
    return nav._replace(covariance=P, extras=tuple(extras))


def tardy(setup: Setup, state: FilterState, nav: Nav, residual: Sequence[float], more: float) -> Nav:
    """Return the state less sure of fixes' lateness, which may have changed: by `more` times `CHANGED` squared.

    One that has changed looks like a jump along the way, or like a place that wanders as fast as the vehicle turns.
    Which it is turns out with the next bend, or change of speed. Without wheels an error of speed looks the same. It is
    never less sure than `CHANGED`, nor than the fix's residual (east, north, metres) is as lateness: what wanders at
    walking pace would else pass for lateness of seconds.
    """
    at = setup.layout.index(LATENCY)
    vx, vy, _ = nav.velocity
    square = vx * vx + vy * vy
    if more <= 0.0 or not square > SLOW**2 or not state.on_wheels(nav.utime):
        return nav
    seconds = (residual[0] * vx + residual[1] * vy) / square
    variance = float(nav.covariance[at, at])
    wider = min(variance + CHANGED**2 * more, CHANGED**2, seconds * seconds)
    if not wider > variance:
        return nav
    P = nav.covariance.copy()
    P[at, at] = wider
    return nav._replace(covariance=P)


def restless(
    setup: Setup, state: FilterState, nav: Nav, residual: Sequence[float], factor: float, seconds: float
) -> Nav:
    """Return the state less sure of lateness as far as fixes have been restless by a `factor` for some seconds more."""
    rate = 2.0 * min(seconds, 2.0) / setup.settings.gps_correlation_time
    return tardy(setup, state, nav, residual, (factor - RESTLESS) * rate)
