"""Output: pose in the odom, ENU and UTM frames, validity, protection levels, navigation state."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.filter import bounds, motion, strapdown
from modelserver.estimation.filter.measurements.constraints import tilt_of
from modelserver.estimation.filter.nav import ZERO, Nav, jacobian_of_body_velocity
from modelserver.estimation.filter.odometry import Odometry
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.estimation.filter.strapdown import Noise
from modelserver.messages import NAN, Estimate, Invalid, Mode, NavigationState, Phase, Quality, VehicleMotion
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Quaternion, Vector3

FACTORS_REACH = 200.0
"""Metres within which one convergence serves: it changes by 3e-5 rad times tan(latitude)."""

FADING = 3.0
"""Seconds without a fix after which what lingers in them fades from the pose."""

LAG = 0.15
"""Seconds over which a covariance is carried to first order."""

SLOW = 0.3
"""Speed, m/s, below which nothing but the gyros tells heading."""


def estimate(setup: Setup, state: FilterState, odom: Odometry, utime: int, newest: int) -> Estimate:
    """Return the rolling frame's pose at `utime` from a state not newer than it; `newest` is that of all samples."""
    nav = state.nav
    origin = None if state.geodesy is None else state.geodesy.origin
    reasons = invalid(setup, state, utime)
    if nav is None:
        return Estimate(utime, odom.pose(utime), invalid=reasons, pose_epoch=state.epoch, origin=origin)
    ahead = motion.at(setup, state, utime)
    nav = ahead.nav
    assert nav is not None
    quality = _quality(setup, ahead, nav, utime, newest)
    X_odom = odom.pose(utime)
    odom_covariance = odom.covariance()
    if state.phase is not Phase.ALIGNED or state.site is None:
        return Estimate(
            utime,
            X_odom,
            odom_covariance=odom_covariance,
            invalid=reasons,
            quality=quality,
            pose_epoch=state.epoch,
            origin=origin,
            motion=vehicle_motion(setup, ahead, nav),
        )
    settings = setup.settings
    if nav.lag > LAG:
        nav = strapdown.caught_up(nav, motion.noise(setup, ahead, nav), setup.layout)
    P = _at_base(nav, setup, motion.noise(setup, ahead, nav))
    offset, doubt = _followed(setup, state, utime)
    P[0, 0], P[1, 1], P[2, 2] = P[0, 0] + doubt[0], P[1, 1] + doubt[1], P[2, 2] + doubt[2]
    horizontal = bounds.horizontal(P, state.allowance, settings)
    heading = bounds.heading(float(P[5, 5]), settings)
    if heading > settings.heading_limit:
        reasons |= Invalid.STATIONARY_HEADING if state.standing else Invalid.PROTECTION_LEVEL_EXCEEDED
    if horizontal > settings.horizontal_limit:
        reasons |= Invalid.PROTECTION_LEVEL_EXCEEDED
        if state.refused_count:
            reasons |= Invalid.GPS_REJECTED
    enu = utm = None
    if state.geodesy is not None:
        x, y, z = nav.point(setup.rig.base)
        place = (x + offset[0], y + offset[1], z + offset[2])
        enu, utm = _world_poses(state.geodesy, state.site, place, nav.attitude)
    return Estimate(
        utime,
        X_odom,
        enu,
        utm,
        tuple(P.ravel().tolist()),
        odom_covariance,
        reasons,
        quality,
        state.epoch,
        origin,
        horizontal,
        heading,
        NAN if reasons else _seconds_left(setup, state, nav, utime, horizontal),
        vehicle_motion(setup, ahead, nav),
    )


def vehicle_motion(setup: Setup, state: FilterState, nav: Nav) -> VehicleMotion:
    """Return how the vehicle moves: the filter's velocity and turn rate, and the force felt with gravity taken off."""
    base = setup.rig.base
    lever = (-base[0], -base[1], -base[2])
    covariance = TwistCovariance(setup, nav)
    if state.standing:
        return VehicleMotion(ZERO, ZERO, ZERO, lever, covariance)
    acceleration = (NAN, NAN, NAN)
    if motion.inertial(setup, state.mode):
        g = state.earth.gravity
        (fx, fy, fz), (bx, by, bz), (ux, uy, uz) = nav.force, nav.accelerometer_bias, nav.up
        acceleration = (fx - bx - g * ux, fy - by - g * uy, fz - bz - g * uz)
    return VehicleMotion(nav.body_velocity(base), nav.turn_rate, acceleration, lever, covariance)


class TwistCovariance(NamedTuple):
    """The covariance of a motion, worked out when it is called."""

    setup: Setup
    nav: Nav

    def __call__(self) -> tuple[float, ...]:
        """Return the 36 numbers of velocity and turn rate of the rolling frame along its own axes, row-major."""
        return _twist_covariance(self.setup, self.nav)


def _twist_covariance(setup: Setup, nav: Nav) -> tuple[float, ...]:
    """Return the 36 numbers of velocity and turn rate of the rolling frame along its own axes, row-major."""
    n = setup.layout.size
    H = np.zeros((6, n))
    H[:3] = jacobian_of_body_velocity(nav, setup.rig.base, n)
    H[3:, 9:12] = -np.eye(3)
    twist = H @ nav.covariance @ H.T
    twist[3:, 3:] += np.eye(3) * setup.settings.gyro_noise**2 / 0.02
    return tuple(twist.ravel().tolist())


def _followed(setup: Setup, state: FilterState, utime: int) -> tuple[Vector3, Vector3]:
    """Return how far the pose goes with what lingers in fixes, metres along N, and the variance that this adds, m2.

    The estimate of what lingers is independent of the position's error, as an optimal estimate is of its own error; so
    adding it adds its variance. Where fixes are missing on the move it fades, as what lingers does.
    """
    fade = 1.0
    silent = (utime - state.fix_utime) * 1e-6
    if silent > FADING and not state.standing:
        fade = math.exp(-(silent - FADING) / setup.settings.gps_correlation_time)
    x, y, z = state.shown
    a, b, c = state.doubt
    return (x * fade, y * fade, z * fade), (a * fade * fade, b * fade * fade, c * fade * fade)


def _at_base(nav: Nav, setup: Setup, noise: Noise) -> Array:
    """Return the covariance (6, 6) of the rolling frame along N, from that of the inertial unit's point.

    Over a short lag the errors' equations to first order lead from the covariance kept to that of the instant:
    position by velocity, attitude by gyro bias; that is all that a pose needs, at a fifth of the whole.
    """
    n = setup.layout.size
    dt = nav.lag
    x, y, z = so3.rotate(nav.attitude, setup.rig.base)
    J = np.zeros((6, n))
    J.put(
        _places(n),
        (*(1.0, 1.0, 1.0, 1.0, 1.0, 1.0), *(dt, dt, dt), *(z, -y, -z, x, y, -x)),
    )
    if dt > 0.0:
        (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(nav.attitude)
        J[3:, 9:12] = ((-dt * a, -dt * b, -dt * c), (-dt * d, -dt * e, -dt * f), (-dt * g, -dt * h, -dt * i))
    P: Array = J @ nav.covariance @ J.T
    p, w = noise.accelerometer * dt**3 / 3.0, noise.gyro * dt
    P.reshape(-1)[::7] += (p, p, p, w, w, w)
    return P


@lru_cache(maxsize=16)
def _places(n: int) -> npt.NDArray[np.intp]:
    """Return the flat places in a (6, n) matrix of what `_at_base` writes, in its order."""
    rows = [(0, 0), (1, 1), (2, 2), (3, 6), (4, 7), (5, 8), (0, 3), (1, 4), (2, 5)]
    rows += [(0, 7), (0, 8), (1, 6), (1, 8), (2, 6), (2, 7)]
    return np.array([r * n + c for r, c in rows])


@lru_cache(maxsize=8)
def _axes(geodesy: Geodesy, site: LocalFrame) -> Quaternion:
    """Return what turns the site's axes to World:ENU's."""
    return geodesy.tangent.rotation_of(site)


@lru_cache(maxsize=64)
def _grid(geodesy: Geodesy, site: LocalFrame, east: int, north: int) -> Quaternion:
    """Return what turns the site's axes to grid east, grid north and up at a cell of the site (in FACTORS_REACH)."""
    ecef = site.to_ecef((east * FACTORS_REACH, north * FACTORS_REACH, 0.0))
    latitude, longitude, height = geodetic_from_ecef(ecef)
    there = LocalFrame.at(latitude, longitude, height)
    return so3.multiply(rotation_about_up(geodesy.convergence(latitude, longitude)), there.rotation_of(site))


def _world_poses(
    geodesy: Geodesy, site: LocalFrame, place: tuple[float, float, float], attitude: Quaternion
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM, each from the earth-centred position; None out of reach."""
    ecef = site.to_ecef(place)
    try:
        position = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        grid = _grid(geodesy, site, round(place[0] / FACTORS_REACH), round(place[1] / FACTORS_REACH))
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(_axes(geodesy, site), attitude)),
        Pose(position, so3.multiply(grid, attitude)),
    )


def invalid(setup: Setup, state: FilterState, utime: int) -> Invalid:
    """Return what speaks against an estimate at `utime`, but for its bounds."""
    # numbers, not members: putting flags together costs more than all else here
    settings, nav = setup.settings, state.nav
    invalid = 0
    aligned = state.phase is Phase.ALIGNED
    if not aligned:
        invalid |= 8  # NOT_MOVED_YET
        if state.fixed is None:
            invalid |= 1  # NO_FIX
    elif (
        state.fix_utime
        and (utime - state.fix_utime) * 1e-6 > settings.gps_timeout
        and state.mode not in (Mode.NO_GPS, Mode.DEAD_RECKONING)
    ):
        invalid |= 32  # STALE_GPS
    if motion.inertial(setup, state.mode):
        if not state.imu_utime:
            invalid |= 2  # NO_IMU
        elif (utime - state.imu_utime) * 1e-6 > settings.imu_timeout:
            invalid |= 64  # STALE_IMU
        elif (state.imu_utime - utime) * 1e-6 > settings.imu_timeout:
            invalid |= 512  # CLOCK_STEPPED
    elif nav is not None and (utime - nav.utime) * 1e-6 > settings.imu_timeout:
        invalid |= 64  # STALE_IMU
    if state.geodesy is None:
        invalid |= 4  # NO_ORIGIN
    if state.refused_since and (utime - state.refused_since) * 1e-6 > settings.rejection_timeout:
        invalid |= 128  # GPS_REJECTED
    if state.stepped:
        invalid |= 512  # CLOCK_STEPPED
    if state.tilt or (nav is not None and tilt_of(nav.up) > settings.maximum_tilt):
        invalid |= 1024  # TILTED
    return Invalid(invalid)


def _quality(setup: Setup, state: FilterState, nav: Nav, utime: int, newest: int) -> Quality:
    forward = nav.body_velocity(setup.rig.base)[0]
    quality = 0
    if state.standing or abs(forward) < SLOW:
        quality |= 1  # HEADING_FROM_GYRO
    if utime > newest:
        quality |= 2  # PREDICTED
    if forward < -0.1 and not state.standing:
        quality |= 32  # REVERSING
    return Quality(quality)


def _seconds_left(setup: Setup, state: FilterState, nav: Nav, utime: int, horizontal: float) -> float:
    """Return the seconds until a limit is passed if nothing more comes.

    Variance along each axis grows as p + 2 c t + v t^2 + q t^3 / 3 when nothing tells the motion any more.
    """
    settings = setup.settings
    heard = max(state.imu_utime, nav.utime if not motion.inertial(setup, state.mode) else 0)
    left = settings.imu_timeout - (utime - heard) * 1e-6
    if state.fix_utime and state.mode not in (Mode.NO_GPS, Mode.DEAD_RECKONING):
        left = min(left, settings.gps_timeout - (utime - state.fix_utime) * 1e-6)
    left = max(left, 0.0)
    k, _ = bounds.factors(settings.risk_per_hour, settings.gps_correlation_time)
    room = settings.horizontal_limit - state.allowance
    C = nav.covariance
    p, v, c = bounds.longest(C), float(max(C[3, 3], C[4, 4])), float(max(C[0, 3], C[1, 4], 0.0))
    q = setup.coasting.accelerometer

    def bound(t: float) -> float:
        return k * math.sqrt(p + 2.0 * c * t + v * t * t + q * t**3 / 3.0)

    if bound(left) <= room:
        return left
    low, high = 0.0, left
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if bound(middle) <= room else (low, middle)
    return low


def navigation(setup: Setup, state: FilterState) -> NavigationState | None:
    """Return the whole state; None before there is one."""
    nav = state.nav
    if nav is None:
        return None
    base = setup.rig.base
    latitude = longitude = height = NAN
    if state.site is not None and state.phase is Phase.ALIGNED:
        latitude, longitude, height = geodetic_from_ecef(state.site.ecef)
    values = (
        *nav.position,
        *nav.velocity,
        *so3.to_rpy(nav.attitude),
        *nav.gyro_bias,
        *nav.accelerometer_bias,
        *nav.extras,
    )
    return NavigationState(
        nav.utime,
        state.mode,
        state.phase,
        state.standing,
        invalid(setup, state, nav.utime),
        state.epoch,
        latitude,
        longitude,
        height,
        Pose(nav.point(base), nav.attitude),
        nav.body_velocity(base),
        nav.turn_rate,
        _twist_covariance(setup, nav),
        setup.layout.names,
        tuple(map(float, values)),
        tuple(nav.covariance.ravel().tolist()),
    )
