"""Stationary detection by IMU and wheels together.

Either alone is fooled: an encoder that is stuck says that the vehicle stands, and a smooth ride feels like standing to
the inertial unit. Together they are not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from modelserver.estimation.filter.nav import ZERO
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.transforms.so3 import Vector3

MEMORY = 0.3
"""Time constant of the running mean and spread, seconds: a few strokes of an idling engine."""

WHEELS_FRESH = 1.0
"""Seconds for which what wheels say counts."""


class Stillness(NamedTuple):
    """Running mean and spread of rate (rad/s) and specific force (m/s2), and since when (utime) all has been still.

    `rate_spread` and `force_spread` are variances. `since` is 0 while not still. `wheels` is what the wheels said last:
    1 standing, 0 rolling, -1 nothing, at `wheels_utime`. `summed_rate` is the integral of the rate over `summed`
    seconds of standing since it was last used.
    """

    utime: int = 0
    rate: Vector3 = ZERO
    force: Vector3 = ZERO
    rate_spread: float = math.inf
    force_spread: float = math.inf
    since: int = 0
    wheels: int = -1
    wheels_utime: int = 0
    summed_rate: Vector3 = ZERO
    summed: float = 0.0

    def felt(
        self, utime: int, rate: Vector3, force: Vector3, bias: Vector3, bias_sigma: float, settings: FilterSettings
    ) -> Stillness:
        """Return the stillness with one inertial sample more; `bias` is the gyros', known to `bias_sigma` each axis."""
        dt = (utime - self.utime) * 1e-6
        if not self.utime or not 0.0 < dt <= settings.rate_hold:
            return self._replace(
                utime=utime,
                rate=rate,
                force=force,
                rate_spread=settings.stationary_rate**2 * 9.0,
                force_spread=settings.stationary_force**2 * 9.0,
                since=0,
                summed_rate=ZERO,
                summed=0.0,
            )
        gain = dt / (MEMORY + dt)
        keep = 1.0 - gain
        (mx, my, mz), (rx, ry, rz) = self.rate, rate
        dx, dy, dz = rx - mx, ry - my, rz - mz
        rate_spread = keep * (self.rate_spread + gain * (dx * dx + dy * dy + dz * dz))
        mean = (mx + gain * dx, my + gain * dy, mz + gain * dz)
        (fx, fy, fz), (gx, gy, gz) = self.force, force
        ex, ey, ez = gx - fx, gy - fy, gz - fz
        force_spread = keep * (self.force_spread + gain * (ex * ex + ey * ey + ez * ez))
        mean_force = (fx + gain * ex, fy + gain * ey, fz + gain * ez)
        a, b, c = mean[0] - bias[0], mean[1] - bias[1], mean[2] - bias[2]
        off = settings.stationary_rate + 4.0 * bias_sigma
        quiet = (
            rate_spread < 3.0 * settings.stationary_rate**2
            and force_spread < 3.0 * settings.stationary_force**2
            and a * a + b * b + c * c < off * off
        )
        rolling = self.wheels == 0 and (utime - self.wheels_utime) * 1e-6 < WHEELS_FRESH
        if not quiet or rolling:
            return Stillness(
                utime, mean, mean_force, rate_spread, force_spread, 0, self.wheels, self.wheels_utime, ZERO, 0.0
            )
        sx, sy, sz = self.summed_rate
        return Stillness(
            utime,
            mean,
            mean_force,
            rate_spread,
            force_spread,
            self.since or utime,
            self.wheels,
            self.wheels_utime,
            (sx + rx * dt, sy + ry * dt, sz + rz * dt),
            self.summed + dt,
        )

    def rolled(self, utime: int, standing: bool | None) -> Stillness:
        """Return the stillness after what the wheels said; None where they did not tell."""
        if standing is None:
            return self
        if standing:
            return self._replace(wheels=1, wheels_utime=utime)
        return self._replace(wheels=0, wheels_utime=utime, since=0, summed_rate=ZERO, summed=0.0)

    def used(self) -> Stillness:
        """Return the stillness with the mean rate begun anew."""
        return self._replace(summed_rate=ZERO, summed=0.0)

    @property
    def mean_rate(self) -> Vector3:
        """Mean rate since it was last used, rad/s. Only where `summed` is above 0."""
        x, y, z = self.summed_rate
        return (x / self.summed, y / self.summed, z / self.summed)

    def vouched(self, utime: int) -> bool:
        """Return whether wheels say that they stand."""
        return self.wheels == 1 and (utime - self.wheels_utime) * 1e-6 < WHEELS_FRESH

    def seconds(self, utime: int) -> float:
        """Return for how long all has been still, seconds."""
        return (utime - self.since) * 1e-6 if self.since else 0.0
