"""Stationary detection of raw mode: the gyro is quiet, and the fixes do not move.

Gyro (`QuietDetector`): running mean and variance of the yaw rate without bias. The mean may be off zero by the
uncertainty of the bias and its own noise: the better the bias is known, the slower a turn is found. A gyro that is not
quiet ends the stationary state at once; to start it needs a fix.

Fixes (`StationaryPlace`): a creeping vehicle looks stationary from fix to fix. So the place where it stopped is stored
with the bias at that time, and a fix that is four sigmas away, or a mean receiver velocity that is not 0, shows that it
has left: the bias found since may be a turn and is revoked. A creep of `stationary_speed` shows after the detection
time t_d = 4 sqrt(2) sigma / stationary_speed (20 s at a sigma of 0.5 m). Only after 2 t_d is the bias certain, and a
vehicle that has left a place creeping must stay for 3 t_d at the next one.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.raw.heading import Heading
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.track import TrackFix

MOVED_SIGMAS: Final = 4.0
"""Sigmas of the distance of two fixes (or of the mean velocity) above which the vehicle has moved."""

PLACE_WINDOW: Final = 100.0
"""Seconds after which the place is set again: a bias that only drifts is not taken for a turn since."""

CONFIRM_TIMES: Final = 3.0
"""Detection times, or times `stationary_time` with receiver velocity, for which a place must be held."""

QUIET_SIGMAS: Final = 4.0
"""Sigmas of bias and noise that the mean rate of a stationary vehicle may be off zero."""


class StationaryPlace(NamedTuple):
    """Where the vehicle stopped.

    Attributes
    ----------
    utime, position, sigma: of the fix there, working frame, m.
    bias, bias_variance: of the yaw gyro at that time.
    is_creeping: whether it left the place before slowly: then it must hold this one for longer.
    velocity, num_velocities: sum and number of the receiver velocities since, m/s.
    """

    utime: int
    position: complex
    sigma: float
    bias: float
    bias_variance: float
    is_creeping: bool = False
    velocity: complex = 0j
    num_velocities: int = 0

    @classmethod
    def at(cls, fix: TrackFix, heading: Heading, is_creeping: bool = False) -> StationaryPlace:
        return cls(fix.utime, fix.position, fix.sigma, heading.bias, heading.bias_variance, is_creeping)

    def has_left(self, fix: TrackFix, velocity_sigma: float, settings: RawSettings) -> bool:
        """Return whether a fix or the mean of the velocities shows that the vehicle has left."""
        if abs(fix.position - self.position) > MOVED_SIGMAS * math.hypot(self.sigma, fix.sigma):
            return True
        if self.num_velocities == 0:
            return False
        mean = abs(self.velocity) / self.num_velocities
        return mean > MOVED_SIGMAS * velocity_sigma / math.sqrt(self.num_velocities) + settings.stationary_speed / 3.0

    def get_detection_time(self, settings: RawSettings) -> float:
        """Return after how many seconds the fixes show a creep of `stationary_speed`."""
        return MOVED_SIGMAS * math.sqrt(2.0) * self.sigma / settings.stationary_speed

    def is_bias_certain(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the place was held for so long that a rate is the bias, not a slow turn."""
        age = (utime - self.utime) * 1e-6
        is_measured = self.num_velocities > 0 and age >= CONFIRM_TIMES * settings.stationary_time
        return is_measured or age >= 2.0 * self.get_detection_time(settings)

    def inflate_heading(self, utime: int, dt: float, heading: Heading, settings: RawSettings) -> Heading:
        """Inflate the heading of a stationary vehicle: the change of its bias may be a turn until it is certain."""
        age = (utime - self.utime) * 1e-6
        if not 0.0 < age < 2.0 * self.get_detection_time(settings):
            return heading
        return heading.inflate((heading.bias - self.bias) ** 2 * (2.0 * age + dt) * dt)

    def update(
        self, fix: TrackFix, velocity_sigma: float, heading: Heading, settings: RawSettings
    ) -> tuple[StationaryPlace, bool]:
        """Return the place after a fix of a slow vehicle, and whether the vehicle may be stationary."""
        if self.has_left(fix, velocity_sigma, settings):
            return StationaryPlace.at(fix, heading, is_creeping=True), False
        age = (fix.utime - self.utime) * 1e-6
        if not self.is_creeping:
            return (self if age < PLACE_WINDOW else StationaryPlace.at(fix, heading)), True
        is_resolved = (
            self.num_velocities > 0
            and 3.0 * MOVED_SIGMAS * velocity_sigma / math.sqrt(self.num_velocities) < settings.stationary_speed
        )
        if age >= CONFIRM_TIMES * self.get_detection_time(settings) or (
            is_resolved and age >= CONFIRM_TIMES * settings.stationary_time
        ):
            return self._replace(is_creeping=False), True
        return self, False


def update_stationary(
    place: StationaryPlace | None,
    is_slow: bool,
    is_stationary: bool,
    fix: TrackFix,
    velocity: tuple[complex, float] | None,
    least_speed: float,
    heading: Heading,
    settings: RawSettings,
) -> tuple[StationaryPlace, Heading, bool]:
    """Return place and heading after a fix, and whether the vehicle may be stationary.

    Parameters
    ----------
    is_slow, is_stationary: by recent fixes; so far.
    velocity: of the receiver, with its sigma.
    least_speed: of the vehicle before the fix, m/s.
    """
    if place is None or not (is_slow or least_speed < settings.course_speed):
        return StationaryPlace.at(fix, heading), heading, is_slow
    velocity_sigma = 0.0
    if velocity is not None:
        place = place._replace(velocity=place.velocity + velocity[0], num_velocities=place.num_velocities + 1)
        velocity_sigma = velocity[1]
    after, may_be_stationary = place.update(fix, velocity_sigma, heading, settings)
    if not (place.is_creeping or is_slow or is_stationary):
        after = after._replace(is_creeping=False)  # it left at speed
    if is_stationary and not may_be_stationary:
        heading = heading.revoke_stationary(place.bias, place.bias_variance, (fix.utime - place.utime) * 1e-6)
        after = after._replace(bias=heading.bias, bias_variance=heading.bias_variance)
    return after, heading, may_be_stationary and is_slow


class QuietDetector(NamedTuple):
    """Running mean and variance of the yaw rate, rad/s, since when it is quiet, and whether the newest fix was slow."""

    mean: float = 0.0
    variance: float = 1.0
    quiet_utime: int | None = None
    is_slow: bool = False

    def update(self, utime: int, rate: float, dt: float, bias_sigma: float, settings: RawSettings) -> QuietDetector:
        """Return the detector after a yaw rate without bias; the time constant is half of `stationary_time`."""
        gain = dt / (0.5 * settings.stationary_time + dt)
        deviation = rate - self.mean
        mean = self.mean + gain * deviation
        variance = (1.0 - gain) * (self.variance + gain * deviation * deviation)
        noise = max(settings.gyro_noise**2 / settings.stationary_time, 0.5 * gain * variance)
        most = min(
            settings.stationary_rate + 3.0 * bias_sigma, QUIET_SIGMAS * math.sqrt(bias_sigma * bias_sigma + noise)
        )
        if not (variance <= settings.stationary_rate**2 and abs(mean) <= most):
            return QuietDetector(mean, variance)
        return QuietDetector(mean, variance, utime if self.quiet_utime is None else self.quiet_utime, self.is_slow)

    def is_stationary(self, utime: int, settings: RawSettings) -> bool:
        """Return whether the vehicle is stationary at an instant."""
        since = self.quiet_utime
        return self.is_slow and since is not None and (utime - since) * 1e-6 >= settings.stationary_time
