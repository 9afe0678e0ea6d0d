"""Constraints: non-holonomic constraint (NHC), zero-velocity update (ZUPT), zero angular rate update (ZARU).

Each takes the seconds since it was last applied: what errs for longer than that must not count as new each time.
"""

from __future__ import annotations

import math

import numpy as np

from modelserver.estimation.filter.measurements.base import Compared, Scene
from modelserver.estimation.filter.measurements.wheels import YAW
from modelserver.estimation.filter.nav import GYRO_BIAS, VELOCITY, jacobian_of_body_velocity
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

NON_HOLONOMIC, ZERO_VELOCITY, ZERO_RATE = "non_holonomic", "zero_velocity", "zero_rate"


def non_holonomic(scene: Scene, dt: float) -> Compared:
    """Compare the rolling frame's sideways and upward speed with 0; the noise grows with what makes vehicles slip.

    Sideways along the wheels: v_y - yaw v_x, with the angle between the wheels and the geometry's x axis. The noise is
    side slip (angle proportional to sideways acceleration) and the wandering of the point that moves straight ahead.
    """
    nav, layout, settings = scene.nav, scene.layout, scene.settings
    base = scene.rig.base
    vx, vy, vz = nav.body_velocity(base)
    wz = nav.turn_rate[2]
    yaw = scene.extra(YAW)
    body = jacobian_of_body_velocity(nav, base, layout.size)
    H = np.array((body[1] - yaw * body[0], body[2]))
    if YAW in layout:
        H[0, layout.index(YAW)] = -vx
    slip = settings.side_slip * vx * wz * vx
    wander = settings.roll_point_sigma * wz
    lasting = max(settings.slip_time / dt, 1.0)
    side = (settings.side_sigma**2 + slip * slip + wander * wander) * lasting
    up = (settings.up_sigma**2 + (settings.up_share * vx) ** 2) * lasting
    return Compared(np.array((yaw * vx - vy, -vz)), H, np.diag((side, up)), eased=math.inf)


def zero_velocity(scene: Scene, dt: float) -> Compared:
    """Compare the velocity with 0."""
    nav = scene.nav
    H = scene.jacobian(3)
    H[:, VELOCITY] = np.eye(3)
    lasting = max(scene.settings.slip_time / dt, 1.0)
    return Compared(-np.array(nav.velocity), H, np.eye(3) * (scene.settings.stationary_sigma**2 * lasting))


def zero_rate(scene: Scene, mean_rate: Vector3, earth: Vector3, dt: float) -> Compared:
    """Compare the turn rate with 0: the mean of what the gyros felt for `dt` seconds is their bias and the earth's."""
    nav = scene.nav
    H = scene.jacobian(3)
    H[:, GYRO_BIAS] = np.eye(3)
    variance = scene.settings.gyro_noise**2 / max(dt, 1e-3)
    felt = np.subtract(mean_rate, so3.rotate(so3.conjugate(nav.attitude), earth))
    return Compared(felt - nav.gyro_bias, H, np.eye(3) * variance)


def tilt_of(up: Vector3) -> float:
    """Return the angle between a direction of the body and its up, radians."""
    x, y, z = up
    return math.atan2(math.hypot(x, y), z)
