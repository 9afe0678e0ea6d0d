"""Heading: yaw of Odom's axes in the world, and the gyro's bias, as a filter of two states.

States: `offset`, to be added to Odom's yaw to get yaw from true east, and `bias` of the yaw gyro. Yaw is
integrated in Odom with the bias taken off, so the errors obey d(offset error) = -(bias error) dt, plus the
gyro's noise, and the bias walks. A course measures the offset, a standing vehicle the bias. This is the
Kalman filter of two states written out (R. Brown and P. Hwang, Introduction to Random Signals, 2012, 5.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from modelserver.estimation.raw.settings import RawSettings

UNKNOWN_VARIANCE = (math.pi / math.sqrt(3.0)) ** 2
"""Variance of a direction of which nothing is known: uniform over the circle."""

_STATIONARY_GATE = 4.0
"""Sigmas that a rate at rest may be off the bias known."""


class CourseResult(Enum):
    """What became of a course."""

    USED = "taken"
    BACKWARDS = "backwards"
    REJECTED = "refused"
    RESET = "anew"


@dataclass(frozen=True, slots=True)
class Heading:
    """Offset (rad) and yaw gyro bias (rad/s) with their covariance; `known` once a course was taken."""

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

    def propagate(self, dt: float, settings: RawSettings, measured: bool = True) -> Heading:
        """Return the heading `dt` seconds on; `measured` false where no gyro told of the turn.

        A step longer than `rate_hold` is measured only so far.
        """
        if dt <= 0.0:
            return self
        if measured and dt > settings.rate_hold:
            held = self.propagate(settings.rate_hold, settings)
            return held.propagate(dt - settings.rate_hold, settings, measured=False)
        b = self.bias_variance
        dt_b = min(dt, 1e4)
        variance = self.variance - 2.0 * self.covariance * dt_b + b * dt_b * dt_b + settings.gyro_noise**2 * dt_b
        if not measured:
            variance += (settings.gap_rate_sigma * dt_b) ** 2
        variance = max(variance, settings.heading_floor**2)
        limit = settings.gyro_bias_sigma**2
        b_new = b + settings.gyro_bias_walk**2 * dt_b
        covariance = self.covariance - b * dt_b
        if b_new > limit:
            b_new = max(b, limit)
        if variance >= UNKNOWN_VARIANCE:
            variance, covariance = UNKNOWN_VARIANCE, 0.0
        return Heading(
            self.is_known, self.offset, variance, self.bias, b_new, covariance, self.num_rejected, self.rejected_offset
        )

    def update_stationary(self, rate: float, variance: float) -> Heading:
        """Return the heading after a yaw rate was measured at rest: what is left of it is bias.

        `rate` is without the bias known so far, rad/s, and `variance` its noise. A rate that neither can explain
        is a turn, and changes nothing.
        """
        s = self.bias_variance + variance
        if rate * rate > _STATIONARY_GATE**2 * s:
            return self
        k1, k2 = self.covariance / s, self.bias_variance / s
        return Heading(
            self.is_known,
            math.remainder(self.offset + k1 * rate, math.tau),
            max(self.variance - k1 * self.covariance, 1e-12),
            self.bias + k2 * rate,
            max(self.bias_variance * (1.0 - k2), 1e-18),
            self.covariance * (1.0 - k2),
            self.num_rejected,
            self.rejected_offset,
        )

    def revoke_stationary(self, bias: float, bias_variance: float, seconds: float) -> Heading:
        """Return the heading after it turned out that the vehicle moved while it was taken to stand.

        `bias` and `bias_variance` are those of `seconds` ago: what the bias has changed by may be a turn.
        """
        turned = (self.bias - bias) * seconds
        variance = min(self.variance + turned * turned + bias_variance * seconds * seconds, UNKNOWN_VARIANCE)
        known = max(bias_variance, self.bias_variance)
        return replace(self, variance=variance, bias=bias, bias_variance=known, covariance=0.0)

    def inflate(self, variance: float) -> Heading:
        """Return the heading with `variance` more."""
        return replace(self, variance=min(self.variance + variance, UNKNOWN_VARIANCE))

    def update_course(self, offset: float, variance: float, settings: RawSettings) -> tuple[Heading, CourseResult]:
        """Return the heading after a course said `offset` with `variance`, and what became of the course.

        Before heading is known the course is taken as forward. Afterwards one about half a turn off is a
        vehicle that drives backwards. A course that fits neither is refused; a run of such, agreeing among
        themselves, is believed.
        """
        if not self.is_known:
            return self._reset(offset, variance), CourseResult.RESET
        innovation = math.remainder(offset - self.offset, math.tau)
        backwards = abs(innovation) > 0.5 * math.pi
        if backwards:
            innovation = math.remainder(innovation - math.pi, math.tau)
        s = self.variance + variance
        # sigma above 60 deg: which end is the front can no longer be told
        if self.variance > 1.0:
            return self._reset(offset, variance), CourseResult.RESET
        if innovation * innovation > settings.course_gate**2 * s:
            apart = math.remainder(offset - self.rejected_offset, math.tau)
            agrees = self.num_rejected > 0 and apart * apart <= settings.course_gate**2 * 2.0 * variance
            count = self.num_rejected + 1 if agrees else 1
            if count >= settings.course_rejections:
                return self._reset(offset, variance), CourseResult.RESET
            return replace(self, num_rejected=count, rejected_offset=offset), CourseResult.REJECTED
        k1, k2 = self.variance / s, self.covariance / s
        return (
            Heading(
                True,
                math.remainder(self.offset + k1 * innovation, math.tau),
                max(self.variance * (1.0 - k1), settings.heading_floor**2),
                self.bias + k2 * innovation,
                max(self.bias_variance - k2 * self.covariance, 1e-18),
                self.covariance * (1.0 - k1),
            ),
            CourseResult.BACKWARDS if backwards else CourseResult.USED,
        )

    def _reset(self, offset: float, variance: float) -> Heading:
        return Heading(True, math.remainder(offset, math.tau), variance, self.bias, self.bias_variance, 0.0, 0)
