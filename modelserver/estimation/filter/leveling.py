"""Leveling (coarse alignment): roll, pitch and gyro biases (report 5.1, C5).

The mean specific force of a stationary vehicle is gravity, and its mean rate the gyro biases. They are averaged over
`leveling_time`. A vehicle that is not stationary within `leveling_timeout` is leveled on the move, by the mean of that
time and with a larger uncertainty. A mean force that is not gravity, or far from the geometry's up, is reported
(`tilt`) and leveling continues: the mount is wrong, or the vehicle lies on its side.

Up by R f with an accelerometer bias b is wrong by theta x g = -R b, so tilt and bias start correlated along N,
theta_x = -b_y / g and theta_y = b_x / g: then gravity stays explained while the bias is found.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.estimation.filter.eskf import (
    ACCELEROMETER_BIAS,
    GYRO_BIAS,
    STANDARD_GRAVITY,
    STRAPDOWN,
    VELOCITY,
    ZERO,
    Earth,
    NavState,
    compute_tilt,
    level_attitude,
)
from modelserver.estimation.filter.gnss_monitor import GnssMonitor
from modelserver.estimation.filter.heading_alignment import HeadingAlignment
from modelserver.estimation.filter.hypothesis_bank import DeadReckoning
from modelserver.estimation.filter.sensor_monitors import ImuMonitor
from modelserver.estimation.filter.state import Aligned, Leveling, MotionConstraints, Setup, Unaligned
from modelserver.messages import Estimate
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3

LEVEL_SIGMA: Final = 0.1
"""Sigma of roll and pitch, rad, without an IMU: ordinary ground slopes by up to 6 deg."""

MIN_MEAN_TIME: Final = 0.5
"""Seconds of the mean for leveling on the move, at least."""

GRAVITY_TOLERANCE: Final = 2.0
"""m/s2 within which the mean force must be gravity: otherwise the units or the axes of the IMU are wrong."""


def level(setup: Setup, state: Leveling, utime: int, rate: Vector3, force: Vector3) -> Leveling | Unaligned:
    """Return the state after an IMU sample (body axes), `Unaligned` once it is level."""
    settings = setup.settings
    state = _update_mean(state, utime, rate, force)
    mean_time = (utime - state.mean_since) * 1e-6
    # a stationary state that comes and goes restarts the mean each time, but leveling waits no longer than the limit
    is_late = (utime - state.first_utime) * 1e-6 >= settings.leveling_timeout and mean_time >= min(
        MIN_MEAN_TIME, settings.leveling_time
    )
    is_stationary_mean = state.is_stationary and mean_time >= settings.leveling_time
    if not (is_late or is_stationary_mean):
        return state
    n = state.num_samples
    up = (state.force_sum[0] / n, state.force_sum[1] / n, state.force_sum[2] / n)
    mean_rate = (state.rate_sum[0] / n, state.rate_sum[1] / n, state.rate_sum[2] / n)
    tilt = compute_tilt(up) if abs(math.hypot(*up) - STANDARD_GRAVITY) < GRAVITY_TOLERANCE else math.inf
    if tilt > settings.tilt_mount_limit:
        return Leveling(state.common, state.imu, state.stationary, tilt=tilt)
    if is_stationary_mean:
        bias, bias_sigma = mean_rate, max(settings.gyro_noise / math.sqrt(mean_time), 1e-6)
        # the accelerometer bias is what is left
        tilt_sigma = settings.accelerometer_bias_sigma / STANDARD_GRAVITY
        speed_sigma = settings.stationary_sigma
    else:
        bias, bias_sigma = state.common.gyro_biases or (ZERO, settings.gyro_bias_sigma)
        tilt_sigma = settings.leveling_acceleration / STANDARD_GRAVITY
        speed_sigma = 0.5 * settings.maximum_speed
    nav = create_nav(setup, utime, level_attitude(up), tilt_sigma, speed_sigma, bias, bias_sigma)
    if is_stationary_mean:
        nav = _correlate_tilt(nav, settings.accelerometer_bias_sigma)
    return Unaligned(
        nav._replace(rate=rate, force=force),
        state.imu,
        state.stationary,
        DeadReckoning(),
        HeadingAlignment(),
        MotionConstraints(state.is_stationary, utime, utime),
        state.common,
        leveled_since=state.mean_since,
    )


def _update_mean(state: Leveling, utime: int, rate: Vector3, force: Vector3) -> Leveling:
    """Return the state with a sample more in its mean, which restarts when the vehicle stops or starts moving."""
    is_quiet = state.stationary.get_quiet_time(utime) > 0.0 and utime >= state.common.moving_until
    (fx, fy, fz), (rx, ry, rz), n = state.force_sum, state.rate_sum, state.num_samples
    mean_since, is_stationary = state.mean_since, state.is_stationary
    if is_quiet and n and state.stationary.since >= mean_since and not is_stationary:
        # samples before it stopped do not count
        fx = fy = fz = rx = ry = rz = 0.0
        n, is_stationary, mean_since = 0, True, utime
    elif not is_quiet and is_stationary:
        fx = fy = fz = rx = ry = rz = 0.0
        n, is_stationary = 0, False
    return Leveling(
        state.common,
        state.imu,
        state.stationary,
        state.first_utime or utime,
        mean_since or utime,
        is_stationary,
        (fx + force[0], fy + force[1], fz + force[2]),
        (rx + rate[0], ry + rate[1], rz + rate[2]),
        n + 1,
        state.tilt,
    )


def create_nav(
    setup: Setup,
    utime: int,
    attitude: Quaternion,
    tilt_sigma: float,
    speed_sigma: float,
    bias: Vector3,
    bias_sigma: float,
) -> NavState:
    """Return a state at rest in N's origin: N is at the vehicle, with its yaw. Sigmas in rad, m/s and rad/s."""
    settings, layout = setup.settings, setup.layout
    sigmas = np.zeros(layout.size)
    sigmas[VELOCITY] = speed_sigma
    sigmas[6:8] = tilt_sigma
    sigmas[GYRO_BIAS] = bias_sigma
    sigmas[ACCELEROMETER_BIAS] = settings.accelerometer_bias_sigma
    sigmas[STRAPDOWN:] = layout.extra_sigmas
    return NavState(
        utime,
        so3.rotate(attitude, setup.rig.imu),
        ZERO,
        attitude,
        bias,
        ZERO,
        (0.0,) * (layout.size - STRAPDOWN),
        np.diag(np.square(sigmas)),
        force=(0.0, 0.0, STANDARD_GRAVITY),
        rate=bias,
    )


def start_level(setup: Setup, state: Leveling, utime: int) -> Unaligned:
    """Return the state of a vehicle without an IMU, which is taken to be level."""
    nav = create_nav(setup, utime, so3.IDENTITY, LEVEL_SIGMA, 0.5 * setup.settings.maximum_speed, ZERO, 1e-6)
    if setup.yaw_gyro is not None:
        nav.covariance[11, 11] = setup.settings.gyro_bias_sigma**2
    return Unaligned(
        nav,
        state.imu,
        state.stationary,
        DeadReckoning(),
        HeadingAlignment(),
        MotionConstraints(state.is_stationary, utime, utime),
        state.common,
        leveled_since=utime,
    )


def start_from(setup: Setup, first: Leveling, last: Estimate, before: Estimate) -> Aligned | None:
    """Return the state at the pose of another localizer's estimate; None if that is not valid.

    The velocity is the mean between the two estimates. N is World:ENU, the tangent plane at the origin.
    """
    geodesy, pose = first.common.geodesy, last.enu
    if geodesy is None or pose is None or last.covariance is None or last.invalid:
        return None
    settings, rig = setup.settings, setup.rig
    dt = (last.utime - before.utime) * 1e-6
    moved = (before.odom.inverse() @ last.odom).xyz
    along = moved[0] / dt if dt > 0.0 else 0.0
    nav = create_nav(setup, last.utime, pose.wxyz, LEVEL_SIGMA, settings.course_speed, ZERO, settings.gyro_bias_sigma)
    arm = so3.rotate(pose.wxyz, rig.imu)
    stated = np.diagonal(np.array(last.covariance).reshape(6, 6))
    nav = nav.forget(slice(0, 3), stated[:3]).forget(slice(6, 9), np.maximum(stated[3:], 1e-4))
    x, y, z = pose.xyz
    latitude, _, height = geodetic_from_ecef(geodesy.tangent.ecef)
    return Aligned(
        nav._replace(
            position=(x + arm[0], y + arm[1], z + arm[2]),
            velocity=so3.rotate(pose.wxyz, (along, 0.0, 0.0)),
        ),
        ImuMonitor(used_utime=last.utime),
        first.stationary,
        DeadReckoning(),
        MotionConstraints(False, last.utime, last.utime),
        first.common,
        Earth.at(latitude, height),
        geodesy.tangent,
        GnssMonitor(used_utime=last.utime),
    )


def get_tilt_by_bias(attitude: Quaternion) -> Array:
    """Return M (3, 3) of theta = M b: the tilt along N by the accelerometer bias b (body axes) of a leveled state."""
    R = np.array(so3.matrix_rows(attitude))
    M = np.zeros((3, 3))
    M[0] = -R[1] / STANDARD_GRAVITY
    M[1] = R[0] / STANDARD_GRAVITY
    return M


def _correlate_tilt(nav: NavState, bias_sigma: float) -> NavState:
    """Return the state with tilt and accelerometer bias correlated: see the module's theory."""
    P = nav.covariance.copy()
    M = get_tilt_by_bias(nav.attitude)
    variance = bias_sigma * bias_sigma
    P[6:9, 6:9] = variance * (M @ M.T)
    P[6, 6] += 1e-6
    P[7, 7] += 1e-6
    P[6:9, 12:15] = variance * M
    P[12:15, 6:9] = variance * M.T
    return nav._replace(covariance=P)
