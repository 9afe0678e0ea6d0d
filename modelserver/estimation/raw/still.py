"""Stationary detection of raw mode by gyro and fixes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.estimation.raw.settings import RawSettings

_QUIET_SIGMAS = 4.0
"""Sigmas of the bias and of the mean's noise that the mean rate of a standing vehicle may be off zero."""


@dataclass(frozen=True, slots=True)
class Stillness:
    """Running mean and variance of the yaw rate (bias taken off), and since when it has been quiet.

    `slow` is what the newest fix said.
    """

    mean: float = 0.0
    variance: float = 1.0
    quiet_utime: int | None = None
    slow: bool = False

    def felt(self, utime: int, rate: float, dt: float, bias_sigma: float, settings: RawSettings) -> Stillness:
        """Return the stillness with one yaw rate more, rad/s.

        Mean and variance fade with half the standing time. The mean may be off zero by the bias not known yet and
        by its own noise: the better the bias is known, the slower a turn is told from it.
        """
        gain = dt / (0.5 * settings.stationary_time + dt)
        off = rate - self.mean
        mean = self.mean + gain * off
        variance = (1.0 - gain) * (self.variance + gain * off * off)
        noise = max(settings.gyro_noise**2 / settings.stationary_time, 0.5 * gain * variance)
        off_zero = min(
            settings.stationary_rate + 3.0 * bias_sigma, _QUIET_SIGMAS * math.sqrt(bias_sigma * bias_sigma + noise)
        )
        quiet = variance <= settings.stationary_rate**2 and abs(mean) <= off_zero
        since = (self.quiet_utime if self.quiet_utime is not None else utime) if quiet else None
        # a loud gyro is a moving vehicle at once; that it stands needs a fix again
        return Stillness(mean, variance, since, self.slow and quiet)

    def standing(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the vehicle stands at `utime`."""
        return (
            self.slow and self.quiet_utime is not None and (utime - self.quiet_utime) * 1e-6 >= settings.stationary_time
        )
