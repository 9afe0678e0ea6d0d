"""Stationary detection by fixes: a creeping vehicle looks stationary from fix to fix.

Stationary detection of raw mode by gyro and fixes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.track import TrackFix

_MOVED_SIGMAS = 4.0
"""Sigmas of two fixes' difference (or of the mean velocity) past which the vehicle has moved."""
_WINDOW = 100.0
"""Seconds after which the place is taken anew: a bias that only wanders is not taken for a turn made meanwhile."""
_STATIONARY_TIMES = 3.0
"""Times as long as `stationary_speed` takes to be noticed that a place must be kept, once a vehicle crept off."""


@dataclass(frozen=True, slots=True)
class StationaryPlace:
    """Where the vehicle came to rest, with the bias known then; `velocity` sums what the receiver said since.

    `creeping` after it left a place slowly: then it must have kept the new one for long before it stands.
    """

    utime: int
    position: complex
    sigma: float
    bias: float
    bias_variance: float
    is_creeping: bool = False
    velocity: complex = 0j
    count: int = 0

    @classmethod
    def at(cls, utime: int, place: complex, sigma: float, heading: Heading, creeping: bool = False) -> StationaryPlace:
        """Return the rest that begins with a fix."""
        return cls(utime, place, sigma, heading.bias, heading.bias_variance, creeping)

    def add_velocity(self, velocity: complex) -> StationaryPlace:
        """Return the rest with one velocity more, east + i north, m/s."""
        return replace(self, velocity=self.velocity + velocity, count=self.count + 1)

    def has_left(self, place: complex, sigma: float, velocity_sigma: float, settings: RawSettings) -> bool:
        """Return whether a fix at `place`, or the mean of the velocities, says that the vehicle has left."""
        if abs(place - self.position) > _MOVED_SIGMAS * math.hypot(self.sigma, sigma):
            return True
        if self.count == 0:
            return False
        mean = abs(self.velocity) / self.count
        return mean > _MOVED_SIGMAS * velocity_sigma / math.sqrt(self.count) + settings.stationary_speed / 3.0

    def get_detection_time(self, settings: RawSettings) -> float:
        """Return after how many seconds at `stationary_speed` the fixes tell that the vehicle has left."""
        return _MOVED_SIGMAS * math.sqrt(2.0) * self.sigma / settings.stationary_speed

    def is_bias_certain(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the place was kept so long that a rate still there is the bias's, not a slow turn's."""
        age = (utime - self.utime) * 1e-6
        return age >= 2.0 * self.get_detection_time(settings) or (
            self.count > 0 and age >= _STATIONARY_TIMES * settings.stationary_time
        )

    def inflate_heading(self, utime: int, dt: float, heading: Heading, settings: RawSettings) -> Heading:
        """Return the heading of a standing vehicle: what its bias has changed by may yet turn out to be a turn."""
        age = (utime - self.utime) * 1e-6
        if not 0.0 < age < 2.0 * self.get_detection_time(settings):
            return heading
        return heading.inflate((heading.bias - self.bias) ** 2 * (2.0 * age + dt) * dt)

    def update(
        self, utime: int, place: complex, sigma: float, velocity_sigma: float, heading: Heading, settings: RawSettings
    ) -> tuple[StationaryPlace, bool]:
        """Return the rest after a fix that seems slow, and whether the vehicle may be standing."""
        if self.has_left(place, sigma, velocity_sigma, settings):
            return StationaryPlace.at(utime, place, sigma, heading, creeping=True), False
        age = (utime - self.utime) * 1e-6
        if self.is_creeping:
            long = age >= _STATIONARY_TIMES * self.get_detection_time(settings)
            told = (
                self.count > 0
                and 3.0 * _MOVED_SIGMAS * velocity_sigma / math.sqrt(self.count) < settings.stationary_speed
            )
            if not (long or (told and age >= _STATIONARY_TIMES * settings.stationary_time)):
                return self, False
            return replace(self, is_creeping=False), True
        return (self, True) if age < _WINDOW else (StationaryPlace.at(utime, place, sigma, heading), True)


def update_stationary(
    rest: StationaryPlace | None,
    slow: bool,
    standing: bool,
    fix: TrackFix,
    velocity: tuple[complex, float] | None,
    speed: float,
    heading: Heading,
    settings: RawSettings,
) -> tuple[StationaryPlace, Heading, bool]:
    """Return the rest and the heading after a fix, and whether the vehicle may be standing.

    `slow` is what recent fixes said, `velocity` the receiver's with its sigma, `speed` the
    least that the vehicle had before the fix.
    """
    if rest is None or not (slow or abs(speed) < settings.course_speed):
        return StationaryPlace.at(fix.utime, fix.position, fix.sigma, heading), heading, slow
    velocity_sigma = 0.0
    if velocity is not None:
        rest, velocity_sigma = rest.add_velocity(velocity[0]), velocity[1]
    was = rest.is_creeping or slow or standing
    after, may = rest.update(fix.utime, fix.position, fix.sigma, velocity_sigma, heading, settings)
    if after.is_creeping and not was:
        after = replace(after, is_creeping=False)  # left at a run, then
    if standing and not may:
        heading = heading.revoke_stationary(rest.bias, rest.bias_variance, (fix.utime - rest.utime) * 1e-6)
        after = replace(after, bias=heading.bias, bias_variance=heading.bias_variance)
    return after, heading, may and slow


_QUIET_SIGMAS = 4.0
"""Sigmas of the bias and of the mean's noise that the mean rate of a standing vehicle may be off zero."""


@dataclass(frozen=True, slots=True)
class QuietDetector:
    """Running mean and variance of the yaw rate (bias taken off), and since when it has been quiet.

    `slow` is what the newest fix said.
    """

    mean: float = 0.0
    variance: float = 1.0
    quiet_utime: int | None = None
    is_slow: bool = False

    def update(self, utime: int, rate: float, dt: float, bias_sigma: float, settings: RawSettings) -> QuietDetector:
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
        return QuietDetector(mean, variance, since, self.is_slow and quiet)

    def is_stationary(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the vehicle stands at `utime`."""
        return (
            self.is_slow
            and self.quiet_utime is not None
            and (utime - self.quiet_utime) * 1e-6 >= settings.stationary_time
        )
