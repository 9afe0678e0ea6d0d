"""Nominal (navigation) state: position, velocity, attitude, biases, and the error covariance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from modelserver.estimation.filter.layout import ACCELEROMETER_BIAS, ATTITUDE, GYRO_BIAS, POSITION, VELOCITY
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3, cross

ZERO: Vector3 = (0.0, 0.0, 0.0)


class Nav(NamedTuple):
    """The nominal state at `utime`, the covariance of its error, and what was felt last.

    `position` and `velocity` are those of the inertial unit's point, in the navigation frame N: level, with east and
    north once the filter is aligned. `attitude` turns the body's axes (rolling frame: x forward, y left, z up) to N's.
    Biases are along the body's axes. `extras` are the further states of the `Layout`, in its order.

    `covariance` (n, n) is of the error (position, velocity, attitude, biases, further), attitude by
    R_true = exp(error) R. It holds for `utime - 1e6 lag`: covariance is carried on less often than the state, and
    `impulse`, the integral of R f over the lag, is what that needs to know.

    `rate` (rad/s) and `force` (m/s2) are what was felt last along the body's axes, biases not taken off. `rolled` is
    the integral of the rolling frame's velocity along the body's axes, metres, `turned` that of the turn rate, rad,
    each since the last wheel sample. A NamedTuple, because its successor is made for every sample.
    """

    utime: int
    position: Vector3
    velocity: Vector3
    attitude: Quaternion
    gyro_bias: Vector3
    accelerometer_bias: Vector3
    extras: tuple[float, ...]
    covariance: Array
    lag: float = 0.0
    impulse: Vector3 = ZERO
    rate: Vector3 = ZERO
    force: Vector3 = ZERO
    rolled: Vector3 = ZERO
    turned: Vector3 = ZERO

    @property
    def turn_rate(self) -> Vector3:
        """Angular velocity of the body relative to N along the body's axes, rad/s; the earth's own is left in."""
        (a, b, c), (d, e, f) = self.rate, self.gyro_bias
        return (a - d, b - e, c - f)

    def point(self, lever: Vector3) -> Vector3:
        """Return where a point of the body is in N; `lever` leads to it from the inertial unit, body axes."""
        x, y, z = so3.rotate(self.attitude, lever)
        px, py, pz = self.position
        return (px + x, py + y, pz + z)

    def point_velocity(self, lever: Vector3) -> Vector3:
        """Return the velocity of a point of the body along N's axes: v + R (w x lever)."""
        x, y, z = so3.rotate(self.attitude, cross(self.turn_rate, lever))
        vx, vy, vz = self.velocity
        return (vx + x, vy + y, vz + z)

    def body_velocity(self, lever: Vector3) -> Vector3:
        """Return the velocity of a point of the body along the body's axes."""
        x, y, z = so3.rotate(so3.conjugate(self.attitude), self.velocity)
        a, b, c = cross(self.turn_rate, lever)
        return (x + a, y + b, z + c)

    @property
    def yaw(self) -> float:
        """Yaw of the body in N, radians."""
        w, x, y, z = self.attitude
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def up(self) -> Vector3:
        """N's up along the body's axes."""
        return so3.rotate(so3.conjugate(self.attitude), (0.0, 0.0, 1.0))

    def injected(self, error: Array, covariance: Array) -> Nav:
        """Return the state with an error (n) put into it, and the covariance after that.

        Attitude's covariance is turned by half the error (reset Jacobian I + [error/2]x of an error about fixed
        axes; J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, 7.3).
        """
        e = error.tolist()
        angle = (e[6], e[7], e[8])
        size = abs(e[6]) + abs(e[7]) + abs(e[8])
        attitude = so3.normalize(so3.multiply(so3.exponential(angle), self.attitude)) if size else self.attitude
        if size > 1e-3:
            G = np.eye(len(covariance))
            G[ATTITUDE, ATTITUDE] += so3.skew((0.5 * e[6], 0.5 * e[7], 0.5 * e[8]))
            covariance = G @ covariance @ G.T
        px, py, pz = self.position
        vx, vy, vz = self.velocity
        gx, gy, gz = self.gyro_bias
        ax, ay, az = self.accelerometer_bias
        return self._replace(
            position=(px + e[0], py + e[1], pz + e[2]),
            velocity=(vx + e[3], vy + e[4], vz + e[5]),
            attitude=attitude,
            gyro_bias=(gx + e[9], gy + e[10], gz + e[11]),
            accelerometer_bias=(ax + e[12], ay + e[13], az + e[14]),
            extras=tuple(value + delta for value, delta in zip(self.extras, e[15:], strict=True)),
            covariance=covariance,
        )


def jacobian_of_point(nav: Nav, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of the place of a point of the body in N: I for position, -[R lever]x for attitude."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, lever)
    H[0, 0] = H[1, 1] = H[2, 2] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    return H


def jacobian_of_point_velocity(nav: Nav, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of a point's velocity along N: velocity I, attitude -[R (w x l)]x, gyro bias R [l]x."""
    H = np.zeros((3, size))
    x, y, z = so3.rotate(nav.attitude, cross(nav.turn_rate, lever))
    H[0, 3] = H[1, 4] = H[2, 5] = 1.0
    H[0, 7], H[0, 8] = z, -y
    H[1, 6], H[1, 8] = -z, x
    H[2, 6], H[2, 7] = y, -x
    if lever != ZERO:
        # w = felt - bias: an error of the bias changes w x l by l x error
        H[:, GYRO_BIAS] = np.array(so3.matrix_rows(nav.attitude)) @ so3.skew(lever)
    return H


def jacobian_of_body_velocity(nav: Nav, lever: Vector3, size: int) -> Array:
    """Return H (3, n) of a point's velocity along the body: velocity R', attitude R' [v]x, gyro bias [l]x."""
    H = np.zeros((3, size))
    Rt = np.array(so3.matrix_rows(so3.conjugate(nav.attitude)))
    H[:, VELOCITY] = Rt
    H[:, ATTITUDE] = Rt @ so3.skew(nav.velocity)
    if lever != ZERO:
        H[:, GYRO_BIAS] = so3.skew(lever)
    return H


__all__ = [
    "ACCELEROMETER_BIAS",
    "ATTITUDE",
    "GYRO_BIAS",
    "POSITION",
    "VELOCITY",
    "ZERO",
    "Nav",
    "jacobian_of_body_velocity",
    "jacobian_of_point",
    "jacobian_of_point_velocity",
]
