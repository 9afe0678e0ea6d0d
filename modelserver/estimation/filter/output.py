"""Output: pose in the odom, ENU and UTM frames, its validity and protection levels, motion, navigation state.

The odom frame (REP-105) is dead reckoning (`Odometry`): the integrated twist of the filter, which never jumps. Fixes
correct the filter; Odom only integrates the present velocity. A delayed measurement changes the filter's past,
not what Odom has published. Its tilt follows the filter's with time constant TILT_TIME.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.filter import eskf, fusion, protection_levels
from modelserver.estimation.filter.eskf import STRAPDOWN, ZERO, NavState, ProcessNoise, compute_tilt
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, LARGEST_CORRELATED, LATENCY
from modelserver.estimation.filter.measurements.measurement import IMU_AVERAGING, body_velocity_jacobian
from modelserver.estimation.filter.protection_levels import Bounds
from modelserver.estimation.filter.state import Aligned, FilterState, Leveling, Navigating, Setup
from modelserver.messages import NAN, Estimate, Invalid, NavigationState, Quality, VehicleMotion
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Quaternion, Vector3

CONVERGENCE_CELL: Final = 200.0
"""Meters within which one meridian convergence is used: it changes by 3e-5 rad times tan(latitude)."""

HEADING_LIMIT: Final = 0.6
HEADING_LIMIT_WITHOUT_WHEELS: Final = 0.35
"""Limit of the heading error, rad, if the settings have none: while wheels measure the speed, and while they do not."""

FIRST_ORDER_LAG: Final = 0.15
"""Seconds over which the covariance of a pose is propagated to first order."""

SLOW: Final = 0.3
"""Speed, m/s, below which only the gyros measure the heading."""


# --- estimate -----------------------------------------------------------------------------------------------


def estimate(setup: Setup, state: FilterState, odom: Odometry, utime: int, newest: int) -> Estimate:
    """Return the rolling frame's pose at `utime` from a state not newer; `newest` is the instant of all samples."""
    geodesy = state.common.geodesy
    origin = None if geodesy is None else geodesy.origin
    epoch = state.common.epoch
    invalid = _find_invalid_bits(setup, state, utime)
    X_odom = odom.pose(utime)
    if isinstance(state, Leveling):
        return Estimate(utime, X_odom, invalid=_to_invalid(invalid), pose_epoch=epoch, origin=origin)
    predicted = fusion.predict(setup, state, utime + _get_sensor_delay_us(setup, state))
    nav = predicted.nav
    velocity = nav.body_velocity(setup.rig.base)
    quality = _find_quality(predicted, velocity[0], utime, newest)
    odom_covariance = odom.covariance()
    if not (isinstance(state, Aligned) and isinstance(predicted, Aligned)):
        return Estimate(
            utime,
            X_odom,
            odom_covariance=odom_covariance,
            invalid=_to_invalid(invalid),
            quality=quality,
            pose_epoch=epoch,
            origin=origin,
            motion=compute_motion(setup, predicted, nav, velocity),
        )
    settings, gnss = setup.settings, state.gnss
    if nav.lag > FIRST_ORDER_LAG:
        nav = eskf.propagate_covariance(nav, fusion.select_noise(setup, predicted, nav), setup.layout)
    P = _compute_base_covariance(nav, setup, fusion.select_noise(setup, predicted, nav))
    own = protection_levels.compute_longest_variance(P), float(P[5, 5])
    silent = 0.0 if state.is_stationary else (utime - gnss.used_utime) * 1e-6
    offset, variance = gnss.offset.decay(silent, settings)
    P[0, 0], P[1, 1], P[2, 2] = P[0, 0] + variance[0], P[1, 1] + variance[1], P[2, 2] + variance[2]
    limits = get_limits(setup, state)
    if state.bounds is None:
        levels = _compute_levels(setup, state, P, limits)
    else:
        levels = state.bounds.grow(own, limits, settings)
    risks = levels.horizontal_risk, levels.heading_risk
    if sum(risks) > protection_levels.LIMIT_RISK:
        is_suspect = state.turns.is_transported if state.bank is None else state.bank.is_suspect
        invalid |= 8192 if is_suspect else 0  # GNSS_INCONSISTENT
        if risks[1] > risks[0]:
            invalid |= 16 if state.is_stationary else 256  # STATIONARY_HEADING, LIMIT_EXCEEDED
        else:
            invalid |= 256 | (128 if gnss.num_rejected else 0)  # LIMIT_EXCEEDED, GPS_REJECTED
    enu = utm = None
    if geodesy is not None:
        x, y, z = nav.point(setup.rig.base)
        position = (x + offset[0], y + offset[1], z + offset[2])
        enu, utm = _compute_world_poses(geodesy, state.site, position, nav.attitude)
    return Estimate(
        utime,
        X_odom,
        enu,
        utm,
        tuple(P.ravel().tolist()),
        odom_covariance,
        _to_invalid(invalid),
        quality,
        epoch,
        origin,
        levels.horizontal_protection,
        levels.heading_protection,
        NAN if invalid else _compute_seconds_to_limit(setup, state, nav, utime),
        compute_motion(setup, predicted, nav, velocity),
        horizontal_level=levels.horizontal_level,
        heading_level=levels.heading_level,
        limit_risk=min(sum(risks), 1.0),
        horizontal_allowance=_get_allowance(setup, state),
    )


def _compute_levels(setup: Setup, state: Aligned, P: Array, limits: tuple[float, float]) -> Bounds:
    """Return levels and risks of a pose with the covariance P, without a bank.

    They are those of the covariance, beside what outliers and inconsistent fixes may have moved it by.
    """
    settings = setup.settings
    variances = protection_levels.compute_longest_variance(P), float(P[5, 5])
    sigma = math.sqrt(variances[0] + settings.lever_arm_sigma**2)
    heading_sigma = math.sqrt(variances[1] + protection_levels.HEADING_FLOOR**2)
    allowance = _get_allowance(setup, state)
    level, heading_level = protection_levels.compute_level(sigma, allowance, heading_sigma)
    turned = state.turns.allowance if state.turns.is_transported else 0.0
    risks = protection_levels.compute_limit_risks(sigma, heading_sigma, limits[0] - allowance, limits[1] - turned)
    horizontal = protection_levels.compute_horizontal(P, state.gnss.outlier_allowance, settings)
    heading = _compute_heading_protection(setup, state, variances[1])
    heading_level = min(heading_level + turned, math.pi)
    return Bounds(level, heading_level, horizontal, heading, *risks, variances)


def get_heading_protection(setup: Setup, state: Aligned) -> float:
    """Return the protection level of the heading at the state's instant, rad."""
    if state.bounds is not None:
        return state.bounds.heading_protection
    variance = float(state.nav.covariance[8, 8])
    return _compute_heading_protection(setup, state, variance)


def _compute_heading_protection(setup: Setup, state: Aligned, variance: float) -> float:
    return min(protection_levels.compute_heading(variance, setup.settings) + state.turns.allowance, math.pi)


def _get_sensor_delay_us(setup: Setup, state: Navigating) -> int:
    """Return by how much IMU and wheels are late, microseconds.

    A fix is not newer than its stamp. Where it seems so, the stamps of the other sensors are late by that latency, and
    so is the state; as much of it counts as is certain to a standard deviation.
    """
    if not isinstance(state, Aligned) or LATENCY not in setup.layout:
        return 0
    at, nav = setup.layout.index(LATENCY), state.nav
    latency = nav.extras[at - STRAPDOWN]
    if not latency < 0.0:
        return 0
    delay = -latency - math.sqrt(max(nav.covariance[at, at], 0.0))
    return round(1e6 * delay) if delay > 0.0 else 0


def compute_covariance(setup: Setup, state: Aligned) -> Array:
    """Return the covariance (6, 6) of the rolling frame along N at the state's instant, without what is published."""
    return _compute_base_covariance(state.nav, setup, fusion.select_noise(setup, state, state.nav))


def _compute_base_covariance(nav: NavState, setup: Setup, noise: ProcessNoise) -> Array:
    """Return the covariance (6, 6) of the rolling frame along N, from that of the IMU.

    Over a short lag to first order: position by velocity, attitude by gyro bias. That is all that a pose needs, at a
    fifth of the cost of the whole.
    """
    n = setup.layout.size
    dt = nav.lag
    x, y, z = so3.rotate(nav.attitude, setup.rig.base)
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(nav.attitude)
    J = _base_buffer(n).fill(
        *(dt, dt, dt),
        *(z, -y, -z, x, y, -x),
        *(-dt * a, -dt * b, -dt * c, -dt * d, -dt * e, -dt * f, -dt * g, -dt * h, -dt * i),
    )
    P: Array = np.dot(np.dot(J, nav.covariance), J.T)
    p, tilt = noise.accelerometer * dt**3 / 3.0, noise.tilt * dt
    P.reshape(-1)[::7] += (p, p, p, tilt, tilt, noise.yaw * dt)
    return P


@lru_cache(maxsize=16)
def _base_buffer(n: int) -> eskf.MatrixBuffer:
    """Return the buffer of a (6, n) matrix with the entries that `_compute_base_covariance` fills in, in its order."""
    J = np.zeros((6, n))
    J[:3, :3] = J[3:, 6:9] = np.eye(3)
    places = [(0, 3), (1, 4), (2, 5), (0, 7), (0, 8), (1, 6), (1, 8), (2, 6), (2, 7)]
    places += [(3 + r, 9 + c) for r in range(3) for c in range(3)]
    return eskf.MatrixBuffer(J, places)


def get_limits(setup: Setup, state: Aligned) -> tuple[float, float]:
    """Return the limits of the errors, m and rad: configured, or by the receiver's class and whether wheels measure."""
    horizontal, heading = setup.settings.horizontal_limit, setup.settings.heading_limit
    if horizontal is None:
        horizontal = state.common.receiver.horizontal_limit
    if heading is None:
        is_measured = state.common.measures_wheel_speed(state.nav.utime)
        heading = HEADING_LIMIT if is_measured else HEADING_LIMIT_WITHOUT_WHEELS
    return horizontal, heading


def _get_allowance(setup: Setup, state: Aligned) -> float:
    """Return by how much the position may be off beside its covariance, m.

    By an outlier, and by what the consistency monitor knows, or by an error of the fixes that is larger than such
    errors are: the state may be off instead.
    """
    if state.bounds is not None:
        return state.bounds.allowance
    gnss, allowance = state.gnss, 0.0
    if gnss.last_fix is not None:
        at = setup.layout.extra_index(CORRELATED_ERROR[0])
        sigmas = math.hypot(*state.nav.extras[at : at + 2])
        allowance = max(allowance, (sigmas - LARGEST_CORRELATED) * gnss.last_fix.correlated)
    return gnss.outlier_allowance + allowance


def _compute_seconds_to_limit(setup: Setup, state: Aligned, nav: NavState, utime: int) -> float:
    """Return the seconds until a limit is exceeded without further samples.

    The variance along each axis grows as p + 2 c t + v t^2 + q t^3 / 3 while nothing measures the motion.
    """
    settings = setup.settings
    sampled = max(state.imu.used_utime, 0 if setup.uses_imu(state.common.mode) else nav.utime)
    left = settings.imu_timeout - (utime - sampled) * 1e-6
    if state.gnss.used_utime and setup.uses_gnss(state.common.mode):
        left = min(left, settings.gps_timeout - (utime - state.gnss.used_utime) * 1e-6)
    left = max(left, 0.0)
    k, _ = protection_levels.compute_factors(protection_levels.LIMIT_RISK)
    limit = get_limits(setup, state)[0] - _get_allowance(setup, state)
    C = nav.covariance
    p = protection_levels.compute_longest_variance(C) + settings.lever_arm_sigma**2
    v, c = max(C.item(3, 3), C.item(4, 4)), 2.0 * max(C.item(0, 3), C.item(1, 4), 0.0)
    q = setup.coasting.accelerometer
    low, high, t = 0.0, left, left
    # at the end first, and then by bisection; written out, since it is a fifth of a pose's work
    for _ in range(21):
        if k * math.sqrt(p + c * t + v * t * t + q * t**3 / 3.0) <= limit:
            if t == left:
                return left
            low = t
        else:
            high = t
        t = 0.5 * (low + high)
    return low


# --- world --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _enu_from_site(geodesy: Geodesy, site: LocalFrame) -> Quaternion:
    return geodesy.tangent.rotation_of(site)


@lru_cache(maxsize=64)
def _grid_from_site(geodesy: Geodesy, site: LocalFrame, east: int, north: int) -> Quaternion:
    """Return the rotation from the site's axes to grid east, grid north and up in a cell of the site."""
    ecef = site.to_ecef((east * CONVERGENCE_CELL, north * CONVERGENCE_CELL, 0.0))
    latitude, longitude, height = geodetic_from_ecef(ecef)
    there = LocalFrame.at(latitude, longitude, height)
    return so3.multiply(rotation_about_up(geodesy.convergence(latitude, longitude)), there.rotation_of(site))


def _compute_world_poses(
    geodesy: Geodesy, site: LocalFrame, position: Vector3, attitude: Quaternion
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM, each from the earth-centered position; None out of range."""
    ecef = site.to_ecef(position)
    try:
        utm = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        grid = _grid_from_site(
            geodesy, site, round(position[0] / CONVERGENCE_CELL), round(position[1] / CONVERGENCE_CELL)
        )
    except GeodesyError:
        return None, None
    return (
        Pose.of_floats(geodesy.tangent.from_ecef(ecef), so3.multiply(_enu_from_site(geodesy, site), attitude)),
        Pose.of_floats(utm, so3.multiply(grid, attitude)),
    )


# --- validity -----------------------------------------------------------------------------------------------


_to_invalid = lru_cache(maxsize=256)(Invalid)
_to_quality = lru_cache(maxsize=256)(Quality)
"""The flags of a number, at a fraction of the cost of calling the enumeration."""


def find_stale_sensors(setup: Setup, state: FilterState, utime: int) -> Invalid:
    """Return the bits of STALE_SENSORS of an estimate at `utime`."""
    return _to_invalid(_find_stale_bits(setup, state, utime))


def _find_stale_bits(setup: Setup, state: FilterState, utime: int) -> int:
    settings, mode, stale = setup.settings, state.common.mode, 0
    if isinstance(state, Aligned):
        gnss = state.gnss
        excludes = state.bank is not None and state.bank.excludes_fixes
        is_old = gnss.used_utime and not excludes and (utime - gnss.used_utime) * 1e-6 > settings.gps_timeout
        if is_old and setup.uses_gnss(mode):
            stale |= 32  # STALE_GPS
    nav_utime = 0 if isinstance(state, Leveling) else state.nav.utime
    used_utime = state.imu.used_utime if setup.uses_imu(mode) else nav_utime
    if used_utime and (utime - used_utime) * 1e-6 > settings.imu_timeout:
        stale |= 64  # STALE_IMU
    return stale


def _find_invalid_bits(setup: Setup, state: FilterState, utime: int) -> int:
    """Return the reasons against an estimate at `utime`, except for the risk of its limits.

    As a number, for `estimate` to add to: combining flags costs more than all else here.
    """
    settings, common = setup.settings, state.common
    invalid = _find_stale_bits(setup, state, utime)
    if not isinstance(state, Aligned):
        invalid |= 8  # NOT_MOVED_YET
        if isinstance(state, Leveling) or state.alignment.last_fix is None:
            invalid |= 1  # NO_FIX
    if setup.uses_imu(common.mode):
        imu_utime = state.imu.used_utime
        if not imu_utime:
            invalid |= 2  # NO_IMU
        elif (imu_utime - utime) * 1e-6 > settings.imu_timeout:
            invalid |= 512  # CLOCK_STEPPED
    if common.geodesy is None:
        invalid |= 4  # NO_ORIGIN
    if common.is_clock_stepped:
        invalid |= 512  # CLOCK_STEPPED
    if common.mount.is_wrong:
        invalid |= 16384  # MISMOUNTED
    tilt = state.tilt if isinstance(state, Leveling) else compute_tilt(state.nav.up) > settings.maximum_tilt
    if tilt:
        invalid |= 1024  # TILTED
    return invalid


def _find_quality(state: Navigating, forward: float, utime: int, newest: int) -> Quality:
    """Return the quality of an estimate; `forward`: the speed along the rolling frame's own axis, m/s."""
    quality = 0
    if state.is_stationary or abs(forward) < SLOW:
        quality |= 1  # HEADING_FROM_GYRO
    if utime > newest:
        quality |= 2  # PREDICTED
    if forward < -0.1 and not state.is_stationary:
        quality |= 32  # REVERSING
    return _to_quality(quality)


# --- motion and navigation state ----------------------------------------------------------------------------


def compute_motion(setup: Setup, state: Navigating, nav: NavState, velocity: Vector3) -> VehicleMotion:
    """Return the motion: the filter's velocity and angular rate, and the specific force without gravity.

    `velocity` is that of the rolling frame along the body axes, m/s.
    """
    base = setup.rig.base
    lever = (-base[0], -base[1], -base[2])
    covariance = TwistCovariance(setup, nav)
    if state.is_stationary:
        return VehicleMotion(ZERO, ZERO, ZERO, lever, covariance, 0.0)
    acceleration, sigma = (NAN, NAN, NAN), NAN
    if setup.uses_imu(state.common.mode):
        g = state.earth.gravity
        (fx, fy, fz), (bx, by, bz), (ux, uy, uz) = nav.force, nav.accelerometer_bias, nav.up
        acceleration = (fx - bx - g * ux, fy - by - g * uy, fz - bz - g * uz)
        P = nav.covariance
        tilt = g * g * max(P.item(6, 6), P.item(7, 7))
        bias = max(P.item(12, 12), P.item(13, 13), P.item(14, 14))
        sigma = math.sqrt(setup.settings.accelerometer_noise**2 / IMU_AVERAGING + bias + tilt)
    return VehicleMotion(velocity, nav.angular_rate, acceleration, lever, covariance, sigma)


class TwistCovariance(NamedTuple):
    """The covariance of a motion, computed when it is called."""

    setup: Setup
    nav: NavState

    def __call__(self) -> tuple[float, ...]:
        """Return the 36 numbers of velocity and angular rate of the rolling frame along its own axes, row-major."""
        setup, nav = self.setup, self.nav
        n = setup.layout.size
        H = np.zeros((6, n))
        H[:3] = body_velocity_jacobian(nav, setup.rig.base, n)
        H[3:, 9:12] = -np.eye(3)
        twist = H @ nav.covariance @ H.T
        twist[3:, 3:] += np.eye(3) * setup.settings.gyro_noise**2 / IMU_AVERAGING
        return tuple(twist.ravel().tolist())


def get_navigation_state(setup: Setup, state: FilterState) -> NavigationState | None:
    """Return the whole state; None while leveling."""
    if isinstance(state, Leveling):
        return None
    nav, common = state.nav, state.common
    base = setup.rig.base
    latitude = longitude = height = NAN
    if isinstance(state, Aligned):
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
        common.mode,
        state.phase,
        state.is_stationary,
        _to_invalid(_find_invalid_bits(setup, state, nav.utime)),
        common.epoch,
        latitude,
        longitude,
        height,
        Pose(nav.point(base), nav.attitude),
        nav.body_velocity(base),
        nav.angular_rate,
        TwistCovariance(setup, nav)(),
        setup.layout.names,
        tuple(map(float, values)),
        tuple(nav.covariance.ravel().tolist()),
    )


# --- odometry -----------------------------------------------------------------------------------------------

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
