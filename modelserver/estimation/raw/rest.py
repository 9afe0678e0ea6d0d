"""Stationary detection by fixes: a creeping vehicle looks stationary from fix to fix."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.track import TrackFix

_MOVED = 4.0
"""Sigmas of two fixes' difference (or of the mean velocity) past which the vehicle has moved."""
_WINDOW = 100.0
"""Seconds after which the place is taken anew: a bias that only wanders is not taken for a turn made meanwhile."""
_PATIENCE = 3.0
"""Times as long as `stationary_speed` takes to be noticed that a place must be kept, once a vehicle crept off."""


@dataclass(frozen=True, slots=True)
class Rest:
    """Where the vehicle came to rest, with the bias known then; `velocity` sums what the receiver said since.

    `creeping` after it left a place slowly: then it must have kept the new one for long before it stands.
    """

    utime: int
    place: complex
    sigma: float
    bias: float
    bias_variance: float
    creeping: bool = False
    velocity: complex = 0j
    count: int = 0

    @classmethod
    def at(cls, utime: int, place: complex, sigma: float, heading: Heading, creeping: bool = False) -> Rest:
        """Return the rest that begins with a fix."""
        return cls(utime, place, sigma, heading.bias, heading.bias_variance, creeping)

    def heard(self, velocity: complex) -> Rest:
        """Return the rest with one velocity more, east + i north, m/s."""
        return replace(self, velocity=self.velocity + velocity, count=self.count + 1)

    def left(self, place: complex, sigma: float, velocity_sigma: float, settings: RawSettings) -> bool:
        """Return whether a fix at `place`, or the mean of the velocities, says that the vehicle has left."""
        if abs(place - self.place) > _MOVED * math.hypot(self.sigma, sigma):
            return True
        if self.count == 0:
            return False
        mean = abs(self.velocity) / self.count
        return mean > _MOVED * velocity_sigma / math.sqrt(self.count) + settings.stationary_speed / 3.0

    def noticed(self, settings: RawSettings) -> float:
        """Return after how many seconds at `stationary_speed` the fixes tell that the vehicle has left."""
        return _MOVED * math.sqrt(2.0) * self.sigma / settings.stationary_speed

    def get_state_to_persist(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the place was kept so long that a rate still there is the bias's, not a slow turn's."""
        age = (utime - self.utime) * 1e-6
        return age >= 2.0 * self.noticed(settings) or (self.count > 0 and age >= _PATIENCE * settings.stationary_time)

    def unsure(self, utime: int, dt: float, heading: Heading, settings: RawSettings) -> Heading:
        """Return the heading of a standing vehicle: what its bias has changed by may yet turn out to be a turn."""
        age = (utime - self.utime) * 1e-6
        if not 0.0 < age < 2.0 * self.noticed(settings):
            return heading
        return heading.widened((heading.bias - self.bias) ** 2 * (2.0 * age + dt) * dt)

    def next(
        self, utime: int, place: complex, sigma: float, velocity_sigma: float, heading: Heading, settings: RawSettings
    ) -> tuple[Rest, bool]:
        """Return the rest after a fix that seems slow, and whether the vehicle may be standing."""
        if self.left(place, sigma, velocity_sigma, settings):
            return Rest.at(utime, place, sigma, heading, creeping=True), False
        age = (utime - self.utime) * 1e-6
        if self.creeping:
            long = age >= _PATIENCE * self.noticed(settings)
            told = self.count > 0 and 3.0 * _MOVED * velocity_sigma / math.sqrt(self.count) < settings.stationary_speed
            if not (long or (told and age >= _PATIENCE * settings.stationary_time)):
                return self, False
            return replace(self, creeping=False), True
        return (self, True) if age < _WINDOW else (Rest.at(utime, place, sigma, heading), True)


def judged(
    rest: Rest | None,
    slow: bool,
    standing: bool,
    fix: TrackFix,
    velocity: tuple[complex, float] | None,
    speed: float,
    heading: Heading,
    settings: RawSettings,
) -> tuple[Rest, Heading, bool]:
    """Return the rest and the heading after a fix, and whether the vehicle may be standing.

    `slow` is what recent fixes said, `velocity` the receiver's with its sigma, `speed` the
    least that the vehicle had before the fix.
    """
    if rest is None or not (slow or abs(speed) < settings.course_speed):
        return Rest.at(fix.utime, fix.place, fix.sigma, heading), heading, slow
    velocity_sigma = 0.0
    if velocity is not None:
        rest, velocity_sigma = rest.heard(velocity[0]), velocity[1]
    was = rest.creeping or slow or standing
    after, may = rest.next(fix.utime, fix.place, fix.sigma, velocity_sigma, heading, settings)
    if after.creeping and not was:
        after = replace(after, creeping=False)  # left at a run, then
    if standing and not may:
        heading = heading.doubted(rest.bias, rest.bias_variance, (fix.utime - rest.utime) * 1e-6)
        after = replace(after, bias=heading.bias, bias_variance=heading.bias_variance)
    return after, heading, may and slow
