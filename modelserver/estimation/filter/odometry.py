"""Dead reckoning in the odom frame (REP-105): the integrated twist, which never jumps.

Fixes correct the filter; Odom only goes on by how the vehicle moves now. A measurement that comes late changes the
filter's past, not what Odom has said. Tilt is drawn towards the filter's, slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from modelserver.estimation.filter.nav import ZERO, Nav
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3

LEVEL_TIME = 1.0
"""Time constant, seconds, with which Odom's tilt follows the filter's."""

LONGEST = 0.5
"""Seconds for which a twist is carried on where nothing tells a new one."""


class Odometry(NamedTuple):
    """The rolling frame in Odom at `utime`: position (m), attitude; its twist then, along the body's axes.

    `drift` is by how much the position may be off since Odom began, metres, `yaw_drift` yaw, rad: errors of rates and
    speeds last, so they add up in proportion to time. `started` is whether the first attitude was taken.
    """

    utime: int = 0
    position: Vector3 = ZERO
    attitude: Quaternion = so3.IDENTITY
    velocity: Vector3 = ZERO
    rate: Vector3 = ZERO
    drift: float = 0.0
    yaw_drift: float = 0.0
    started: bool = False

    def advanced(self, nav: Nav, base: Vector3, standing: bool) -> Odometry:
        """Return Odom at a newer state of the filter."""
        velocity, rate = (ZERO, ZERO) if standing else (nav.body_velocity(base), nav.turn_rate)
        if not self.started:
            tilt = _levelled(so3.IDENTITY, nav.up, 1.0)
            return Odometry(nav.utime, self.position, tilt, velocity, rate, self.drift, self.yaw_drift, True)
        dt = (nav.utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        short = min(dt, LONGEST)
        position, attitude = _integrated(self, velocity, rate, short)
        attitude = _levelled(attitude, nav.up, short / (LEVEL_TIME + short))
        P = nav.covariance
        speed_sigma = math.sqrt(P[3, 3] + P[4, 4])
        rate_sigma = math.sqrt(P[11, 11])
        yaw_drift = self.yaw_drift + (0.0 if standing else rate_sigma * dt)
        drift = self.drift + (0.0 if standing else (speed_sigma + self.yaw_drift * math.hypot(*velocity)) * dt)
        return Odometry(nav.utime, position, attitude, velocity, rate, min(drift, 1e6), min(yaw_drift, 1e3), True)

    def stopped(self, utime: int) -> Odometry:
        """Return Odom where it is, from `utime` on, while nothing tells a motion."""
        return self._replace(utime=utime, velocity=ZERO, rate=ZERO)

    def pose(self, utime: int) -> Pose:
        """Return the pose at an instant near, carried on by the twist, at most for half a second either way."""
        dt = max(-LONGEST, min((utime - self.utime) * 1e-6, LONGEST))
        position, attitude = _integrated(self, self.velocity, self.rate, dt)
        return Pose(position, attitude)

    def covariance(self) -> tuple[float, ...]:
        """Return the 36 numbers of the pose in Odom."""
        p, y, t = self.drift**2 + 1e-6, self.yaw_drift**2 + 1e-8, 4e-4
        numbers = [0.0] * 36
        numbers[0] = numbers[7] = numbers[14] = p
        numbers[21] = numbers[28] = t
        numbers[35] = y
        return tuple(numbers)


def _integrated(odom: Odometry, velocity: Vector3, rate: Vector3, dt: float) -> tuple[Vector3, Quaternion]:
    (ax, ay, az), (bx, by, bz) = odom.rate, rate
    h = 0.5 * dt
    turn = ((ax + bx) * h, (ay + by) * h, (az + bz) * h)
    middle = so3.multiply(odom.attitude, so3.small_angle_exponential((0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2])))
    (ux, uy, uz), (vx, vy, vz) = odom.velocity, velocity
    x, y, z = so3.rotate(middle, ((ux + vx) * h, (uy + vy) * h, (uz + vz) * h))
    px, py, pz = odom.position
    attitude = so3.normalize(so3.multiply(odom.attitude, so3.small_angle_exponential(turn)))
    return (px + x, py + y, pz + z), attitude


def _levelled(attitude: Quaternion, up: Vector3, share: float) -> Quaternion:
    """Return an attitude turned by a share of the way to where its up along the body is `up`; yaw stays."""
    x, y, _ = so3.rotate(attitude, up)
    # the body's true up stands at (x, y) in Odom: turn it to (0, 0)
    return so3.normalize(so3.multiply(so3.small_angle_exponential((y * share, -x * share, 0.0)), attitude))
