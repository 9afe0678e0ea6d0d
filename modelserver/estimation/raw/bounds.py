"""Uncertainty of raw mode: covariance, protection levels, and how long they hold."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.raw.settings import RawSettings


@lru_cache(maxsize=16)
def factors(risk: float) -> tuple[float, float]:
    """Return sigmas to a horizontal and to a heading bound that are passed with probability `risk`.

    Horizontal: the radius of a circular normal error is Rayleigh, P(r > k s) = exp(-k^2/2), so
    k = sqrt(-2 ln risk); with the longer axis for s this is on the safe side for an ellipse. Heading: two
    sides of a normal, k = quantile(1 - risk/2).
    """
    return math.sqrt(-2.0 * math.log(risk)), NormalDist().inv_cdf(1.0 - 0.5 * risk)


def grown(age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the variance of each horizontal axis that carrying a fix on for `age` seconds adds, m2.

    The speed is uncertain by its sigma and changes unforeseen: (s_v t)^2 + (a t^2 / 2)^2.
    """
    t = min(age, 1e4)
    return (speed_sigma * t) ** 2 + (0.5 * settings.usual_acceleration * t * t) ** 2


def longest(east: float, north: float, cross: float) -> float:
    """Return the variance along the longest axis of a horizontal error ellipse, m2."""
    half = 0.5 * (east + north)
    return half + math.hypot(0.5 * (east - north), cross)


def covariance(
    fix: AcceptedFix, growth: float, arm: complex, yaw_variance: float, settings: RawSettings
) -> tuple[float, ...]:
    """Return the 36 numbers of the base frame's covariance along east, north, up.

    `arm` leads from the antenna at the fix to the base frame; an error of yaw turns it, so it adds yaw
    variance times (-n, e)(-n, e)' to the position and ties position to yaw.
    """
    ae, an = -arm.imag, arm.real
    tilt = settings.tilt_sigma**2
    ee = fix.east_variance + growth + yaw_variance * ae * ae
    nn = fix.north_variance + growth + yaw_variance * an * an
    en = fix.cross + yaw_variance * ae * an
    uu = fix.up_variance + growth
    ye, yn = yaw_variance * ae, yaw_variance * an
    return (
        *(ee, en, 0.0, 0.0, 0.0, ye),
        *(en, nn, 0.0, 0.0, 0.0, yn),
        *(0.0, 0.0, uu, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(ye, yn, 0.0, 0.0, 0.0, yaw_variance),
    )


def odom_covariance(position: float, yaw: float, settings: RawSettings) -> tuple[float, ...]:
    """Return the 36 numbers of the pose in Odom, from the variances grown since it began."""
    tilt = settings.tilt_sigma**2
    return (
        *(position, 0.0, 0.0, 0.0, 0.0, 0.0),
        *(0.0, position, 0.0, 0.0, 0.0, 0.0),
        *(0.0, 0.0, position, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(0.0, 0.0, 0.0, 0.0, 0.0, yaw),
    )


def seconds_to_horizontal_limit(variance: float, age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return after how many seconds without fixes the horizontal bound passes its limit; 0 where it has.

    `variance` is that of the longest axis without growth. With x = t^2 the growth is a quadratic of x.
    """
    room = (settings.horizontal_limit / factors(settings.risk)[0]) ** 2 - variance
    if room <= 0.0:
        return 0.0
    a, b = (0.5 * settings.usual_acceleration) ** 2, speed_sigma**2
    x = 2.0 * room / (b + math.sqrt(b * b + 4.0 * a * room))
    return max(math.sqrt(x) - age, 0.0)
