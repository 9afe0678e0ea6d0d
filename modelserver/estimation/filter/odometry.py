"""Dead reckoning in the odom frame (REP-105): the integrated twist of the filter, which never jumps.

Fixes correct the filter; Odom only integrates the present velocity. A delayed measurement changes the filter's past,
not what Odom has published. Its tilt follows the filter's with time constant TILT_TIME.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from modelserver.estimation.filter.eskf import ZERO, NavState
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

TILT_TIME: Final = 1.0
"""Time constant, seconds, with which the tilt of Odom follows the filter's."""

MAX_EXTRAPOLATION: Final = 0.5
"""Seconds for which a twist is integrated without a new one."""


class Odometry(NamedTuple):
    """The rolling frame in Odom at `utime`: position (m), attitude, and its twist along the body axes.

    Errors of rates and speeds last, so they add up in proportion to time: `drift` is the sigma of the position since
    Odom began, m, `yaw_drift` that of yaw, rad. `is_started` is whether the first attitude was set.
    """

    utime: int = 0
    position: Vector3 = ZERO
    attitude: Quaternion = so3.IDENTITY
    velocity: Vector3 = ZERO
    rate: Vector3 = ZERO
    drift: float = 0.0
    yaw_drift: float = 0.0
    is_started: bool = False

    def advance(self, nav: NavState, base: Vector3, is_stationary: bool) -> Odometry:
        """Return Odom at a newer state; `base` leads from the IMU to the rolling frame's origin, body axes, m."""
        velocity = rate = ZERO
        if not is_stationary:
            velocity, rate = nav.body_velocity(base), nav.angular_rate
        drift, yaw_drift = self.drift, self.yaw_drift
        if not self.is_started:
            tilt = _follow_tilt(so3.IDENTITY, nav.up, 1.0)
            return Odometry(nav.utime, self.position, tilt, velocity, rate, drift, yaw_drift, True)
        dt = (nav.utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        step = min(dt, MAX_EXTRAPOLATION)
        position, attitude = _integrate(self, velocity, rate, step)
        attitude = _follow_tilt(attitude, nav.up, step / (TILT_TIME + step))
        if not is_stationary:
            P = nav.covariance
            speed_sigma = math.sqrt(P.item(3, 3) + P.item(4, 4))
            drift = min(drift + (speed_sigma + yaw_drift * math.hypot(*velocity)) * dt, 1e6)
            yaw_drift = min(yaw_drift + math.sqrt(P.item(11, 11)) * dt, 1e3)
        return new_tuple(Odometry, (nav.utime, position, attitude, velocity, rate, drift, yaw_drift, True))

    def stop(self, utime: int) -> Odometry:
        """Return Odom at its pose from `utime` on, while the motion is unknown."""
        return self._replace(utime=utime, velocity=ZERO, rate=ZERO)

    def pose(self, utime: int) -> Pose:
        """Return the pose at an instant nearby, extrapolated by the twist within MAX_EXTRAPOLATION."""
        dt = max(-MAX_EXTRAPOLATION, min((utime - self.utime) * 1e-6, MAX_EXTRAPOLATION))
        position, attitude = _integrate(self, self.velocity, self.rate, dt)
        return Pose.of_floats(position, attitude)

    def covariance(self) -> tuple[float, ...]:
        """Return the 36 numbers of the covariance of the pose in Odom."""
        p, y, t = self.drift**2 + 1e-6, self.yaw_drift**2 + 1e-8, 4e-4
        numbers = [0.0] * 36
        numbers[0] = numbers[7] = numbers[14] = p
        numbers[21] = numbers[28] = t
        numbers[35] = y
        return tuple(numbers)


def _integrate(odom: Odometry, velocity: Vector3, rate: Vector3, dt: float) -> tuple[Vector3, Quaternion]:
    (ax, ay, az), (bx, by, bz) = odom.rate, rate
    h, q = 0.5 * dt, odom.attitude
    tx, ty, tz = turn = ((ax + bx) * h, (ay + by) * h, (az + bz) * h)
    middle = so3.turn(q, (0.5 * tx, 0.5 * ty, 0.5 * tz))
    (ux, uy, uz), (vx, vy, vz) = odom.velocity, velocity
    x, y, z = so3.rotate(middle, ((ux + vx) * h, (uy + vy) * h, (uz + vz) * h))
    px, py, pz = odom.position
    return (px + x, py + y, pz + z), so3.normalize(so3.turn(q, turn))


def _follow_tilt(attitude: Quaternion, up: Vector3, share: float) -> Quaternion:
    """Return an attitude rotated by a share of the angle to where its up along the body is `up`; yaw stays."""
    x, y, _ = so3.rotate(attitude, up)
    # the body's true up is at (x, y) in Odom: rotate it to (0, 0)
    return so3.normalize(so3.multiply(so3.small_angle_exponential((y * share, -x * share, 0.0)), attitude))
