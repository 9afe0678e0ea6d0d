"""Constraints: non-holonomic constraint (NHC), zero-velocity update (ZUPT), zero angular rate update (ZARU).

Measurements without a sensor: a rolling vehicle does not slide sideways or leave the ground, a stationary one does not
move or turn. Each takes the seconds since its last update: an error that lasts longer must not count as a new one each
time, so its variance is multiplied by slip_time / dt.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from modelserver.estimation.filter.error_layout import GYRO_BIAS, VELOCITY
from modelserver.estimation.filter.eskf import ZERO, Innovation
from modelserver.estimation.filter.measurements.measurement import MeasurementContext, body_velocity_jacobian
from modelserver.estimation.filter.measurements.wheels import YAW
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

NON_HOLONOMIC: Final = "non_holonomic"
ZERO_VELOCITY: Final = "zero_velocity"
ZERO_RATE: Final = "zero_rate"


def non_holonomic(context: MeasurementContext, dt: float, *, are_wheels_stationary: bool = False) -> Innovation:
    """Compare the sideways and upward speed of the rolling frame with 0.

    Sideways along the wheels: v_y - yaw v_x, with the angle between the wheels and the geometry's x axis. The noise is
    that of the side slip angle, proportional to the lateral acceleration, and of the point that moves straight ahead.
    While wheels are stationary a velocity is an error, whose direction shows no heading.
    """
    nav, layout, settings = context.nav, context.layout, context.settings
    base = context.rig.base
    vx, vy, vz = nav.body_velocity(base)
    wz = nav.angular_rate[2]
    yaw = context.extra(YAW)
    seen = nav._replace(velocity=ZERO) if are_wheels_stationary else nav
    body = body_velocity_jacobian(seen, base, layout.size)
    H = np.array((body[1] - yaw * body[0], body[2]))
    if YAW in layout:
        H[0, layout.index(YAW)] = -vx
    slip = settings.side_slip * vx * wz * vx
    offset = settings.roll_point_sigma * wz
    correlated = max(settings.slip_time / dt, 1.0)
    side = (settings.side_sigma**2 + slip * slip + offset * offset) * correlated
    up = (settings.up_sigma**2 + (settings.up_share * vx) ** 2) * correlated
    return Innovation(np.array((yaw * vx - vy, -vz)), H, np.diag((side, up)), inflation_limit=math.inf)


def zero_velocity(context: MeasurementContext, dt: float) -> Innovation:
    """Compare the velocity with 0."""
    nav = context.nav
    H = context.zero_jacobian(3)
    H[:, VELOCITY] = np.eye(3)
    correlated = max(context.settings.slip_time / dt, 1.0)
    return Innovation(-np.array(nav.velocity), H, np.eye(3) * (context.settings.stationary_sigma**2 * correlated))


def zero_rate(context: MeasurementContext, mean_rate: Vector3, earth_rate: Vector3, dt: float) -> Innovation:
    """Compare the angular rate with 0: the mean of the gyros over `dt` seconds is their bias and the earth rate."""
    nav = context.nav
    H = context.zero_jacobian(3)
    H[:, GYRO_BIAS] = np.eye(3)
    variance = context.settings.gyro_noise**2 / max(dt, 1e-3)
    measured = np.subtract(mean_rate, so3.rotate(so3.conjugate(nav.attitude), earth_rate))
    return Innovation(measured - nav.gyro_bias, H, np.eye(3) * variance)
