"""Leveling (coarse alignment): roll, pitch and gyro biases of a stationary vehicle (report 5.1, C5)."""

from __future__ import annotations

import math

import numpy as np

from modelserver.earth.geodesy import geodetic_from_ecef
from modelserver.estimation.filter import strapdown
from modelserver.estimation.filter.layout import ACCELEROMETER_BIAS, GYRO_BIAS, STRAPDOWN, VELOCITY
from modelserver.estimation.filter.measurements.constraints import tilt_of
from modelserver.estimation.filter.nav import ZERO, Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import Estimate, Phase
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

LEVEL_SIGMA = 0.1
"""Sigma of roll and pitch, rad, where no inertial unit tells: ordinary ground slopes by up to 6 deg."""

LEAST_MEAN = 0.5
"""Seconds that the mean for levelling on the move is taken over, at least."""

GRAVITY_WITHIN = 2.0
"""m/s2 within which the mean force must be gravity: else the unit tells other units, or is out of order."""


def levelled(setup: Setup, state: FilterState, utime: int, rate: Vector3, force: Vector3) -> FilterState:
    """Return the state with one inertial sample more towards levelling; with `nav` once it is done.

    A vehicle that stands is averaged for `leveling_time`; one that does not within `leveling_timeout` is levelled by
    the mean of that time, on the move, and less sure for it. Where gravity is far off the geometry's up, the state
    keeps `tilt`, and levelling goes on: the mount is wrong, or the vehicle lies on its side. Infinite: what is felt is
    no gravity.
    """
    settings = setup.settings
    if not state.heard:
        state = state._replace(heard=utime)
    still = state.stillness.seconds(utime) > 0.0 and utime >= state.moved
    if still and state.level_count and state.stillness.since >= state.began and not state.standing:
        # what was felt before it stood does not count
        state = state._replace(level_force=ZERO, level_rate=ZERO, level_count=0, standing=True, began=utime)
    elif not still and state.standing:
        state = state._replace(level_force=ZERO, level_rate=ZERO, level_count=0, standing=False)
    (fx, fy, fz), (rx, ry, rz), n = state.level_force, state.level_rate, state.level_count
    state = state._replace(
        level_force=(fx + force[0], fy + force[1], fz + force[2]),
        level_rate=(rx + rate[0], ry + rate[1], rz + rate[2]),
        level_count=n + 1,
        began=state.began or utime,
        imu_utime=utime,
    )
    waited = (utime - state.began) * 1e-6
    # standing that comes and goes begins its mean anew each time, but nobody waits for it longer than the limit
    late = (utime - state.heard) * 1e-6 >= settings.leveling_timeout and waited >= min(
        LEAST_MEAN, settings.leveling_time
    )
    if not (late or (state.standing and waited >= settings.leveling_time)):
        return state
    n += 1
    up = (state.level_force[0] / n, state.level_force[1] / n, state.level_force[2] / n)
    mean = (state.level_rate[0] / n, state.level_rate[1] / n, state.level_rate[2] / n)
    tilt = tilt_of(up) if abs(math.hypot(*up) - strapdown.STANDARD_GRAVITY) < GRAVITY_WITHIN else math.inf
    if tilt > settings.tilt_mount_limit:
        return state._replace(
            level_force=ZERO, level_rate=ZERO, level_count=0, began=0, heard=0, standing=False, tilt=tilt
        )
    kept = state.biases
    if state.standing and waited >= settings.leveling_time:
        bias, bias_sigma = mean, max(settings.gyro_noise / math.sqrt(waited), 1e-6)
        # half a second's bias walk is far below: what is left is how well the accelerometers know up
        tilt_sigma = settings.accelerometer_bias_sigma / strapdown.STANDARD_GRAVITY
        speed_sigma = settings.stationary_sigma
    else:
        bias, bias_sigma = ZERO, settings.gyro_bias_sigma
        tilt_sigma = settings.leveling_acceleration / strapdown.STANDARD_GRAVITY
        speed_sigma = 0.5 * settings.maximum_speed
        if kept is not None:
            bias, bias_sigma = kept
    nav = first_nav(setup, utime, strapdown.level_attitude(up), tilt_sigma, speed_sigma, bias, bias_sigma)
    # on a slope's own the accelerometers' bias and tilt look the same: tied so that gravity stays explained
    nav = _tied(nav, settings.accelerometer_bias_sigma, tied=state.standing and waited >= settings.leveling_time)
    return state._replace(
        nav=nav._replace(rate=rate, force=force),
        phase=Phase.UNALIGNED,
        tilt=0.0,
        rested_utime=utime,
        rolled_utime=utime,
        level_force=ZERO,
        level_rate=ZERO,
        level_count=0,
    )


def first_nav(
    setup: Setup,
    utime: int,
    attitude: Quaternion,
    tilt_sigma: float,
    speed_sigma: float,
    bias: Vector3,
    bias_sigma: float,
) -> Nav:
    """Return a state at rest in N's origin with yaw 0: N is where the vehicle is, and turned as it is."""
    settings, layout = setup.settings, setup.layout
    sigmas = np.zeros(layout.size)
    sigmas[VELOCITY] = speed_sigma
    sigmas[6:8] = tilt_sigma
    sigmas[GYRO_BIAS] = bias_sigma
    sigmas[ACCELEROMETER_BIAS] = settings.accelerometer_bias_sigma
    sigmas[STRAPDOWN:] = layout.extra_sigmas
    return Nav(
        utime,
        so3.rotate(attitude, setup.rig.imu),
        ZERO,
        attitude,
        bias,
        ZERO,
        (0.0,) * (layout.size - STRAPDOWN),
        np.diag(np.square(sigmas)),
        force=(0.0, 0.0, strapdown.STANDARD_GRAVITY),
        rate=bias,
    )


def start_from(setup: Setup, first: FilterState, last: Estimate, before: Estimate) -> FilterState | None:
    """Return a state in the world where another localizer had the rolling frame, None where it had no valid pose.

    Velocity is what it moved by between the two estimates. N is World:ENU, the tangent plane at the origin.
    """
    geodesy, pose = first.geodesy, last.enu
    if geodesy is None or pose is None or last.covariance is None or last.invalid:
        return None
    settings, rig = setup.settings, setup.rig
    dt = (last.utime - before.utime) * 1e-6
    moved = (before.odom.inverse() @ last.odom).xyz
    along = moved[0] / dt if dt > 0.0 else 0.0
    nav = first_nav(setup, last.utime, pose.wxyz, LEVEL_SIGMA, settings.course_speed, ZERO, settings.gyro_bias_sigma)
    arm = so3.rotate(pose.wxyz, rig.imu)
    P = nav.covariance.copy()
    stated = np.array(last.covariance).reshape(6, 6)
    P[0:3, 0:3] = np.diag(np.diagonal(stated)[:3])
    P[6:9, 6:9] = np.diag(np.maximum(np.diagonal(stated)[3:], 1e-4))
    x, y, z = pose.xyz
    latitude, _, height = geodetic_from_ecef(geodesy.tangent.ecef)
    return first._replace(
        nav=nav._replace(
            position=(x + arm[0], y + arm[1], z + arm[2]),
            velocity=so3.rotate(pose.wxyz, (along, 0.0, 0.0)),
            covariance=P,
        ),
        phase=Phase.ALIGNED,
        site=geodesy.tangent,
        earth=strapdown.Earth.at(latitude, height),
        imu_utime=last.utime,
        fix_utime=last.utime,
        rolled_utime=last.utime,
        rested_utime=last.utime,
        began=last.utime,
    )


def _tied(nav: Nav, bias_sigma: float, *, tied: bool) -> Nav:
    """Return the state with tilt and accelerometer bias correlated as levelling makes them.

    Up was taken from the felt force, so R_true f_true = R f: with f_true = f - b, theta x g = -R b, hence along N
    theta_x = -b_y / g and theta_y = b_x / g for the horizontal components of the bias.
    """
    if not tied:
        return nav
    P = nav.covariance.copy()
    R = np.array(so3.matrix_rows(nav.attitude))
    g = strapdown.STANDARD_GRAVITY
    # theta = M b with b along the body
    M = np.zeros((3, 3))
    M[0] = -R[1] / g
    M[1] = R[0] / g
    variance = bias_sigma * bias_sigma
    P[6:9, 6:9] = variance * (M @ M.T)
    P[6, 6] += 1e-6
    P[7, 7] += 1e-6
    P[6:9, 12:15] = variance * M
    P[12:15, 6:9] = variance * M.T
    return nav._replace(covariance=P)
