"""Levels of the horizontal and heading error: at an instant, and protection levels at the configured risk per hour.

Errors are correlated over `gps_correlation_time`, so an hour has 3600 / that time independent ones, each with its share
of the risk. Horizontal: the radius of a circular normal error is Rayleigh distributed, P(r > k s) = exp(-k^2 / 2), with
s the longest axis of the error ellipse. Heading: both sides of a normal distribution. The level of an instant is that
of the probability LEVEL_RISK, and the risk of a limit the probability that the error is beyond it now (integrity).
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist
from typing import Final, NamedTuple

from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Array

HEADING_FLOOR: Final = 0.01
"""Sigma of the heading, rad, outside the filter: mounts and the rolling frame are good to half a degree."""


LIMIT_RISK: Final = 0.01
"""Probability of an error beyond its limit with which a pose is valid at most."""

LEAST_SIGMA: Final = 1e-9
"""A standard deviation that is as good as none, m or rad."""

LEVEL_RISK: Final = 1e-4
"""Probability that an error exceeds its level at an instant."""


@lru_cache(maxsize=16)
def get_factors(risk_per_hour: float, correlation_time: float) -> tuple[float, float]:
    """Return the standard deviations to the horizontal and to the heading protection level."""
    return compute_factors(min(risk_per_hour * correlation_time / 3600.0, 0.5))


@lru_cache(maxsize=16)
def compute_factors(risk: float) -> tuple[float, float]:
    """Return the standard deviations to the levels that an error exceeds with a probability of `risk`."""
    # by the lower tail: 1 less a small risk is 1
    return math.sqrt(-2.0 * math.log(risk)), -NormalDist().inv_cdf(0.5 * risk)


def compute_longest_variance(P: Array) -> float:
    """Return the variance along the longest axis of the horizontal error ellipse of a covariance, m2."""
    return compute_longest_axis(float(P[0, 0]), float(P[1, 1]), float(P[0, 1]))


def compute_longest_axis(east: float, north: float, cross: float) -> float:
    """Return the variance along the longest axis of an error ellipse, from variances and covariance, m2."""
    return 0.5 * (east + north) + math.hypot(0.5 * (east - north), cross)


def compute_horizontal(P: Array, outlier_allowance: float, settings: FilterSettings) -> float:
    """Return the horizontal protection level, m: of the covariance, plus the allowance for one outlier.

    An error of the antenna's lever arm displaces the pose, and no fix shows it.
    """
    k, _ = get_factors(settings.risk_per_hour, settings.gps_correlation_time)
    return k * math.sqrt(compute_longest_variance(P) + settings.lever_arm_sigma**2) + outlier_allowance


def compute_heading(variance: float, settings: FilterSettings) -> float:
    """Return the heading protection level, rad, at most pi."""
    _, k = get_factors(settings.risk_per_hour, settings.gps_correlation_time)
    return min(k * math.sqrt(variance + HEADING_FLOOR**2), math.pi)


def compute_level(sigma: float, allowance: float, heading_sigma: float) -> tuple[float, float]:
    """Return the levels at an instant, m and rad: of standard deviations, plus an allowance."""
    horizontal, heading = compute_factors(LEVEL_RISK)
    return horizontal * sigma + allowance, min(heading * heading_sigma, math.pi)


def compute_limit_risks(
    sigma: float, heading_sigma: float, horizontal_limit: float, heading_limit: float
) -> tuple[float, float]:
    """Return the probabilities that the position and the heading error are beyond their limits, m and rad.

    Errors have the standard deviations; the limits are less the allowances, and 0 or less is beyond them.
    """
    horizontal = math.exp(-0.5 * (max(horizontal_limit, 0.0) / max(sigma, LEAST_SIGMA)) ** 2)
    return horizontal, math.erfc(max(heading_limit, 0.0) / (math.sqrt(2.0) * max(heading_sigma, LEAST_SIGMA)))


def invert_heading(level: float, settings: FilterSettings) -> float:
    """Return the variance of the heading that has a protection level, rad2: the reverse of `compute_heading`."""
    _, k = get_factors(settings.risk_per_hour, settings.gps_correlation_time)
    return max((level / k) ** 2 - HEADING_FLOOR**2, 0.0)


class Bounds(NamedTuple):
    """The error of a pose by the mixture: levels, protection levels (m, rad) and risks of the limits.

    `variances` are those of the pose's own covariance then: longest axis (m2) and heading (rad2).
    """

    horizontal_level: float
    heading_level: float
    horizontal_protection: float
    heading_protection: float
    horizontal_risk: float
    heading_risk: float
    variances: tuple[float, float]

    @property
    def risk(self) -> float:
        """Probability that position or heading are beyond their limits."""
        return self.horizontal_risk + self.heading_risk

    @property
    def allowance(self) -> float:
        """The part of the horizontal level that the pose's own covariance does not have, m."""
        k, _ = compute_factors(LEVEL_RISK)
        return max(self.horizontal_level - k * math.sqrt(self.variances[0]), 0.0)

    def grow(self, variances: tuple[float, float], limits: tuple[float, float], settings: FilterSettings) -> Bounds:
        """Return the bounds of a pose that is predicted from then on, by the growth of its own covariance."""
        (before, heading_before), (after, heading_after) = self.variances, variances
        if not (after > before or heading_after > heading_before):
            return self
        floor = HEADING_FLOOR**2
        sigmas = math.sqrt(before), math.sqrt(heading_before + floor)
        grown = math.sqrt(max(after, before)), math.sqrt(max(heading_after, heading_before) + floor)
        level, heading_level = compute_factors(LEVEL_RISK)
        protection, heading_protection = get_factors(settings.risk_per_hour, settings.gps_correlation_time)
        more, turned = grown[0] - sigmas[0], grown[1] - sigmas[1]
        least = compute_limit_risks(*sigmas, limits[0] - self.allowance, limits[1])
        risks = compute_limit_risks(*grown, limits[0] - self.allowance, limits[1])
        return Bounds(
            self.horizontal_level + level * more,
            min(self.heading_level + heading_level * turned, math.pi),
            self.horizontal_protection + protection * more,
            min(self.heading_protection + heading_protection * turned, math.pi),
            min(self.horizontal_risk + risks[0] - least[0], 1.0),
            min(self.heading_risk + risks[1] - least[1], 1.0),
            variances,
        )
