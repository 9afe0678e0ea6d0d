"""Protection levels (integrity): bounds of the horizontal and heading error at the configured risk per hour."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Array

HEADING_FLOOR = 0.01
"""Sigma of heading, rad, that the filter does not know of: mounts and the rolling frame are good to half a degree."""


@lru_cache(maxsize=16)
def factors(risk_per_hour: float, lasting: float) -> tuple[float, float]:
    """Return sigmas to a horizontal and to a heading bound that are passed with a probability in an hour.

    Errors last: in an hour there are 3600 / `lasting` independent ones. Horizontal: the radius of a circular normal
    error is Rayleigh, P(r > k s) = exp(-k^2 / 2); heading: two sides of a normal.
    """
    risk = min(risk_per_hour * lasting / 3600.0, 0.5)
    return math.sqrt(-2.0 * math.log(risk)), NormalDist().inv_cdf(1.0 - 0.5 * risk)


def longest(P: Array) -> float:
    """Return the variance along the longest axis of the horizontal error ellipse of a covariance, m2."""
    e, n, c = float(P[0, 0]), float(P[1, 1]), float(P[0, 1])
    return 0.5 * (e + n) + math.hypot(0.5 * (e - n), c)


def horizontal(P: Array, allowance: float, settings: FilterSettings) -> float:
    """Return the horizontal bound, metres: of the covariance, and what one outlier within its gate may have done."""
    k, _ = factors(settings.risk_per_hour, settings.gps_correlation_time)
    return k * math.sqrt(longest(P)) + allowance


def heading(variance: float, settings: FilterSettings) -> float:
    """Return the heading bound, radians, at most pi."""
    _, k = factors(settings.risk_per_hour, settings.gps_correlation_time)
    return min(k * math.sqrt(variance + HEADING_FLOOR**2), math.pi)
