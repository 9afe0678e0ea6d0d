"""Dead reckoning by wheels and gyro alone: turn and path since the start, which no fix and no hypothesis has corrected.

The turn theta is the integral of the rate about the vertical, with the gyro's bias; the path u that of the wheels' way
along the heading theta, with the error of their scale, and m = int (t - t0) du its moment. Over a step from a to b
(`Increment`, in the heading at a):

    u_ab = e^{-i theta_a} (u_b - u_a),   m_ab = e^{-i theta_a} (m_b - m_a - (t_a - t0) (u_b - u_a))
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple


class Increment(NamedTuple):
    """Dead reckoning over a step.

    `seconds`; `turn` (rad); `path` and `moment` (m, m s), forward + i left in the heading at its begin; `driven` (m);
    `turn_variance` and `path_variance`, of what gyro and wheels have missed (rad2, m2); `is_stationary`, and
    whether the wheels are.
    """

    seconds: float
    turn: float
    path: complex
    moment: complex
    driven: float
    turn_variance: float = 0.0
    path_variance: float = 0.0
    is_stationary: bool = False
    are_wheels_stationary: bool = False


class DeadReckoning(NamedTuple):
    """Turn and path at `utime`, the last wheel sample that was compared; 0: none yet.

    Attributes
    ----------
    heading: the turn at that instant, rad.
    path, moment, driven: see the module's theory; m, m s, m.
    path_variance: of what wheels have missed, m2.
    gyro_utime, rate, turn, turn_variance: the last sample of the gyro, its rate about the vertical (rad/s), the turn
        until then (rad), and the variance of what it has missed (rad2).
    begin: when the path began, the t0 of the moment.
    """

    utime: int = 0
    heading: float = 0.0
    path: complex = 0j
    moment: complex = 0j
    driven: float = 0.0
    path_variance: float = 0.0
    gyro_utime: int = 0
    rate: float = 0.0
    turn: float = 0.0
    turn_variance: float = 0.0
    begin: int = 0

    def follow_gyro(self, utime: int, rate: float, variance: float) -> DeadReckoning:
        """Return dead reckoning after a sample of the gyro; `variance` is that of the turn since the last one, rad2."""
        if not self.gyro_utime:
            return self._replace(gyro_utime=utime, rate=rate)
        turn = self.turn + 0.5e-6 * (self.rate + rate) * (utime - self.gyro_utime)
        return DeadReckoning(*self[:6], utime, rate, turn, self.turn_variance + variance, self.begin)

    def predict_turn(self, utime: int) -> float:
        """Return the turn until an instant, at the last rate, rad."""
        return self.turn + 1e-6 * self.rate * (utime - self.gyro_utime)

    def drive(self, utime: int, distance: float, variance: float = 0.0) -> DeadReckoning:
        """Return dead reckoning after `distance` (m) driven since the last wheel sample, with its variance, m2."""
        heading = self.predict_turn(utime)
        if not self.utime:
            return self._replace(utime=utime, heading=heading, begin=utime)
        half = 0.5 * (heading - self.heading)
        # the chord of an arc
        chord = cmath.rect(distance * (math.sin(half) / half if half else 1.0), self.heading + half)
        middle = (0.5 * (utime + self.utime) - self.begin) * 1e-6
        return self._replace(
            utime=utime,
            heading=heading,
            path=self.path + chord,
            moment=self.moment + middle * chord,
            driven=self.driven + abs(distance),
            path_variance=self.path_variance + variance,
        )

    def since(self, start: DeadReckoning, *, is_stationary: bool, are_wheels_stationary: bool) -> Increment:
        """Return the step from an earlier instant."""
        spin = cmath.rect(1.0, -start.heading)
        path = self.path - start.path
        moment = self.moment - start.moment - (start.utime - self.begin) * 1e-6 * path
        return Increment(
            (self.utime - start.utime) * 1e-6,
            self.heading - start.heading,
            spin * path,
            spin * moment,
            max(self.driven - start.driven, 0.0),
            self.turn_variance - start.turn_variance,
            max(self.path_variance - start.path_variance, 0.0),
            is_stationary,
            are_wheels_stationary,
        )
