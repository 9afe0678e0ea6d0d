"""Stationary detector: stationary detection by IMU and wheels together.

Each alone can be wrong: a stuck encoder reports 0, and a smooth ride looks stationary to the IMU. The IMU is quiet
while the variance of rate and force, about a running mean with time constant AVERAGING_TIME, and the mean rate beyond
its bias are below their limits. Rolling wheels overrule it. Whether a quiet vehicle is stationary also depends on the
state's own speed and on fixes: see `imu_step`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.raw.settings import RawSettings
from modelserver.named_tuples import new_tuple
from modelserver.transforms.so3 import Vector3

AVERAGING_TIME: Final = 0.3
"""Time constant of the running mean and variance, seconds: a few strokes of an idling engine."""

CONFIRMED_RATE: Final = 0.06
"""Largest mean rate beyond the bias, rad/s, of a vehicle whose wheels are stationary: the bias may have changed."""

SURE_US: Final = 10_000_000
LOUD: Final = 9.0
"""Microseconds for which wheels must have been stationary so that an engine may shake the vehicle, and how much more it
may, in variance: wheels that are stuck while it drives are suspect by then."""

WHEELS_TIMEOUT: Final = 1.0
"""Seconds for which a wheel sample counts."""


class StationaryDetector(NamedTuple):
    """Running mean and variance of the IMU, and what the wheels measured last.

    Attributes
    ----------
    utime: of the last IMU sample.
    mean_rate, mean_force: running means, rad/s and m/s2 along the body axes.
    rate_variance, force_variance: about them, summed over the axes, (rad/s)2 and (m/s2)2.
    since: first sample (utime) of the present quiet; 0 while it is not quiet.
    wheels_stationary: None: the wheels do not measure it.
    wheels_utime, wheels_since: of that wheel sample, and of the first since when they have measured so.
    rate_sum: integral of the rate since the quiet began or the mean was last used, rad.
    sum_time: its duration, seconds.
    """

    utime: int = 0
    mean_rate: Vector3 = ZERO
    mean_force: Vector3 = ZERO
    rate_variance: float = math.inf
    force_variance: float = math.inf
    since: int = 0
    wheels_stationary: bool | None = None
    wheels_utime: int = 0
    wheels_since: int = 0
    rate_sum: Vector3 = ZERO
    sum_time: float = 0.0

    def update(
        self,
        utime: int,
        rate: Vector3,
        force: Vector3,
        bias: Vector3,
        bias_sigma: float,
        settings: FilterSettings | RawSettings,
    ) -> StationaryDetector:
        """Return the detector after an IMU sample; `bias` is that of the gyros, with `bias_sigma` on each axis."""
        dt = (utime - self.utime) * 1e-6
        if not self.utime or not 0.0 < dt <= settings.rate_hold:
            return StationaryDetector(
                utime,
                rate,
                force,
                settings.stationary_rate**2 * 9.0,
                settings.stationary_force**2 * 9.0,
                0,
                *self[6:9],
            )
        _, last_mean_rate, last_mean_force, rate_variance, force_variance, since = self[:6]
        are_stationary, wheels_utime, wheels_since = self[6:9]
        gain = dt / (AVERAGING_TIME + dt)
        keep = 1.0 - gain
        (mx, my, mz), (rx, ry, rz) = last_mean_rate, rate
        dx, dy, dz = rx - mx, ry - my, rz - mz
        rate_variance = keep * (rate_variance + gain * (dx * dx + dy * dy + dz * dz))
        mean_rate = ux, uy, uz = (mx + gain * dx, my + gain * dy, mz + gain * dz)
        (fx, fy, fz), (gx, gy, gz) = last_mean_force, force
        ex, ey, ez = gx - fx, gy - fy, gz - fz
        force_variance = keep * (force_variance + gain * (ex * ex + ey * ey + ez * ez))
        mean_force = (fx + gain * ex, fy + gain * ey, fz + gain * ez)
        loudest = 3.0 * settings.stationary_force**2
        is_confirmed = self.is_confirmed_by_wheels(utime)
        if is_confirmed and utime - wheels_since > SURE_US:
            loudest *= LOUD
        is_quiet = rate_variance < 3.0 * settings.stationary_rate**2 and force_variance < loudest
        if is_quiet:
            bx, by, bz = bias
            a, b, c = ux - bx, uy - by, uz - bz
            most = settings.stationary_rate + 4.0 * bias_sigma
            if is_confirmed:
                most = max(most, CONFIRMED_RATE)
            are_rolling = are_stationary is False and (utime - wheels_utime) * 1e-6 < WHEELS_TIMEOUT
            is_quiet = a * a + b * b + c * c < most * most and not are_rolling
        rate_sum, sum_time = ZERO, 0.0
        if is_quiet:
            sx, sy, sz = self.rate_sum
            rate_sum, sum_time = (sx + rx * dt, sy + ry * dt, sz + rz * dt), self.sum_time + dt
        return new_tuple(
            StationaryDetector,
            (
                utime,
                mean_rate,
                mean_force,
                rate_variance,
                force_variance,
                (since or utime) if is_quiet else 0,
                are_stationary,
                wheels_utime,
                wheels_since,
                rate_sum,
                sum_time,
            ),
        )

    def update_wheels(self, utime: int, are_stationary: bool | None) -> StationaryDetector:
        """Return the detector after a wheel sample; None: it does not measure whether the wheels are stationary."""
        if are_stationary is None:
            return self
        if are_stationary:
            since = self.wheels_since if self.is_confirmed_by_wheels(utime) else utime
            return StationaryDetector(*self[:6], True, utime, since, *self[9:])
        return StationaryDetector(*self[:5], 0, False, utime)

    def restart_mean(self) -> StationaryDetector:
        return self._replace(rate_sum=ZERO, sum_time=0.0)

    @property
    def mean_stationary_rate(self) -> Vector3:
        """Mean rate over `sum_time`, rad/s. Only for a `sum_time` above 0."""
        x, y, z = self.rate_sum
        return (x / self.sum_time, y / self.sum_time, z / self.sum_time)

    def is_confirmed_by_wheels(self, utime: int) -> bool:
        return self.wheels_stationary is True and (utime - self.wheels_utime) * 1e-6 < WHEELS_TIMEOUT

    def get_quiet_time(self, utime: int) -> float:
        """Return for how long the IMU has been quiet, seconds."""
        return (utime - self.since) * 1e-6 if self.since else 0.0
