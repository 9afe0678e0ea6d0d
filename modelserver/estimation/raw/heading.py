"""Heading filter: a Kalman filter of two states.

States: `offset` o, from yaw in Odom to yaw from true east, and `bias` b of the yaw gyro. Yaw is integrated in Odom
without the bias, so the errors follow

    do' = -db + gyro noise,   db' = random walk                                                                 (1)

A course measures o, a stationary vehicle b. Both updates are written out for two states (R. Brown and P. Hwang,
"Introduction to Random Signals and Applied Kalman Filtering", 2012, 5.5); `covariance` is that of o with b.

Gate of a course: a course half a turn off means reverse. One that fits neither direction is rejected;
`course_rejections` of them in a row that agree reset o. Above a sigma of 60 degrees the two directions cannot be
separated, and the course resets o too.

Limits: one course is forward or backward, never sideways; side slip goes into o. The variance has the floor
`heading_floor` and the ceiling of a direction of which nothing is known.
"""

from __future__ import annotations

import cmath
import math
from enum import Enum
from typing import Final, NamedTuple

from modelserver.estimation.raw.settings import RawSettings

UNKNOWN_VARIANCE: Final = (math.pi / math.sqrt(3.0)) ** 2
"""Variance of an unknown direction, rad2: uniform over the circle."""

STATIONARY_GATE: Final = 4.0
"""Sigmas that the rate of a stationary vehicle may be off the bias."""

MAX_STEP: Final = 1e4
"""Seconds of one propagation at most: a stamp may be wrong by years."""


class CourseResult(Enum):
    """What the heading filter did with a course."""

    USED = "used"
    BACKWARDS = "backwards"
    REJECTED = "rejected"
    RESET = "reset"


class Heading(NamedTuple):
    """State of the heading filter: offset (rad) and bias (rad/s) with their covariance; known after the first course.

    `num_rejected` counts the rejected courses in a row that agree; `rejected_offset` is the last of them.
    """

    is_known: bool = False
    offset: float = 0.0
    variance: float = UNKNOWN_VARIANCE
    bias: float = 0.0
    bias_variance: float = 0.0
    covariance: float = 0.0
    num_rejected: int = 0
    rejected_offset: float = 0.0

    @property
    def sigma(self) -> float:
        """Sigma of the heading, rad."""
        return math.sqrt(self.variance)

    @property
    def direction(self) -> complex:
        """exp(i offset), from Odom's horizontal axes to east + i north."""
        return cmath.rect(1.0, self.offset)

    def propagate(self, dt: float, settings: RawSettings, measured: bool = True) -> Heading:
        """Propagate by equation (1) over `dt` seconds; `measured`: whether the gyro measured the turn.

        It measures no more than `rate_hold` of a longer interval.
        """
        if dt <= 0.0:
            return self
        if measured and dt > settings.rate_hold:
            held = self.propagate(settings.rate_hold, settings)
            return held.propagate(dt - settings.rate_hold, settings, measured=False)
        before = self.bias_variance
        dt = min(dt, MAX_STEP)
        variance = self.variance - 2.0 * self.covariance * dt + before * dt * dt + settings.gyro_noise**2 * dt
        if not measured:
            variance += (settings.gap_rate_sigma * dt) ** 2
        variance = max(variance, settings.heading_floor**2)
        covariance = self.covariance - before * dt
        limit = settings.gyro_bias_sigma**2
        bias_variance = before + settings.gyro_bias_walk**2 * dt
        if bias_variance > limit:
            bias_variance = max(before, limit)
        if variance >= UNKNOWN_VARIANCE:
            variance, covariance = UNKNOWN_VARIANCE, 0.0
        return Heading(self.is_known, self.offset, variance, self.bias, bias_variance, covariance, *self[6:])

    def update_stationary(self, rate: float, variance: float) -> Heading:
        """Update with the yaw rate of a stationary vehicle, rad/s: what the bias so far leaves of it, with its noise.

        A rate outside the gate is a turn, and changes nothing.
        """
        s = self.bias_variance + variance
        if rate * rate > STATIONARY_GATE**2 * s:
            return self
        k1, k2 = self.covariance / s, self.bias_variance / s
        return Heading(
            self.is_known,
            math.remainder(self.offset + k1 * rate, math.tau),
            max(self.variance - k1 * self.covariance, 1e-12),
            self.bias + k2 * rate,
            max(self.bias_variance * (1.0 - k2), 1e-18),
            self.covariance * (1.0 - k2),
            *self[6:],
        )

    def revoke_stationary(self, bias: float, bias_variance: float, seconds: float) -> Heading:
        """Restore bias and variance of `seconds` ago: the vehicle moved, so the bias found since may be a turn."""
        turned = (self.bias - bias) * seconds
        return self._replace(
            variance=min(self.variance + turned * turned + bias_variance * seconds * seconds, UNKNOWN_VARIANCE),
            bias=bias,
            bias_variance=max(bias_variance, self.bias_variance),
            covariance=0.0,
        )

    def inflate(self, variance: float) -> Heading:
        return self._replace(variance=min(self.variance + variance, UNKNOWN_VARIANCE))

    def update_course(self, offset: float, variance: float, settings: RawSettings) -> tuple[Heading, CourseResult]:
        """Update with the offset that a course measures, behind its gate; the first course is taken as forward."""
        if not self.is_known or self.variance > 1.0:
            return self._reset(offset, variance), CourseResult.RESET
        innovation = math.remainder(offset - self.offset, math.tau)
        is_backwards = abs(innovation) > 0.5 * math.pi
        if is_backwards:
            innovation = math.remainder(innovation - math.pi, math.tau)
        s = self.variance + variance
        if innovation * innovation > settings.course_gate**2 * s:
            apart = math.remainder(offset - self.rejected_offset, math.tau)
            agrees = self.num_rejected > 0 and apart * apart <= settings.course_gate**2 * 2.0 * variance
            count = self.num_rejected + 1 if agrees else 1
            if count >= settings.course_rejections:
                return self._reset(offset, variance), CourseResult.RESET
            return self._replace(num_rejected=count, rejected_offset=offset), CourseResult.REJECTED
        k1, k2 = self.variance / s, self.covariance / s
        updated = Heading(
            True,
            math.remainder(self.offset + k1 * innovation, math.tau),
            max(self.variance * (1.0 - k1), settings.heading_floor**2),
            self.bias + k2 * innovation,
            max(self.bias_variance - k2 * self.covariance, 1e-18),
            self.covariance * (1.0 - k1),
        )
        return updated, CourseResult.BACKWARDS if is_backwards else CourseResult.USED

    def _reset(self, offset: float, variance: float) -> Heading:
        return Heading(True, math.remainder(offset, math.tau), variance, self.bias, self.bias_variance)
