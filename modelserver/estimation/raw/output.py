"""Uncertainty of raw mode: covariance, protection levels, and how long they hold.

From the state of raw mode to an estimate: pose in Odom, ENU and UTM, validity, bounds.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

from modelserver.earth.geodesy import GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.estimation.origin import OriginProjection
from modelserver.estimation.raw.heading import UNKNOWN_VARIANCE
from modelserver.estimation.raw.motion import RawMotion
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.raw.state import RawState
from modelserver.estimation.raw.track import compute_growth
from modelserver.messages import NAN, Estimate, Invalid, Quality
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion


@lru_cache(maxsize=16)
def get_factors(risk: float) -> tuple[float, float]:
    """Return sigmas to a horizontal and to a heading bound that are passed with probability `risk`.

    Horizontal: the radius of a circular normal error is Rayleigh, P(r > k s) = exp(-k^2/2), so
    k = sqrt(-2 ln risk); with the longer axis for s this is on the safe side for an ellipse. Heading: two
    sides of a normal, k = quantile(1 - risk/2).
    """
    return math.sqrt(-2.0 * math.log(risk)), NormalDist().inv_cdf(1.0 - 0.5 * risk)


def compute_longest_variance(east: float, north: float, cross: float) -> float:
    """Return the variance along the longest axis of a horizontal error ellipse, m2."""
    half = 0.5 * (east + north)
    return half + math.hypot(0.5 * (east - north), cross)


def compute_covariance(
    fix: AcceptedFix, growth: float, arm: complex, yaw_variance: float, settings: RawSettings
) -> tuple[float, ...]:
    """Return the 36 numbers of the base frame's covariance along east, north, up.

    `arm` leads from the antenna at the fix to the base frame; an error of yaw turns it, so it adds yaw
    variance times (-n, e)(-n, e)' to the position and ties position to yaw.
    """
    ae, an = -arm.imag, arm.real
    tilt = settings.tilt_sigma**2
    ee = fix.east_variance + growth + yaw_variance * ae * ae
    nn = fix.north_variance + growth + yaw_variance * an * an
    en = fix.cross + yaw_variance * ae * an
    uu = fix.up_variance + growth
    ye, yn = yaw_variance * ae, yaw_variance * an
    return (
        *(ee, en, 0.0, 0.0, 0.0, ye),
        *(en, nn, 0.0, 0.0, 0.0, yn),
        *(0.0, 0.0, uu, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(ye, yn, 0.0, 0.0, 0.0, yaw_variance),
    )


def compute_odom_covariance(position: float, yaw: float, settings: RawSettings) -> tuple[float, ...]:
    """Return the 36 numbers of the pose in Odom, from the variances grown since it began."""
    tilt = settings.tilt_sigma**2
    return (
        *(position, 0.0, 0.0, 0.0, 0.0, 0.0),
        *(0.0, position, 0.0, 0.0, 0.0, 0.0),
        *(0.0, 0.0, position, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(0.0, 0.0, 0.0, 0.0, 0.0, yaw),
    )


def compute_seconds_to_limit(variance: float, age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return after how many seconds without fixes the horizontal bound passes its limit; 0 where it has.

    `variance` is that of the longest axis without growth. With x = t^2 the growth is a quadratic of x.
    """
    room = (settings.horizontal_limit / get_factors(settings.risk)[0]) ** 2 - variance
    if room <= 0.0:
        return 0.0
    a, b = (0.5 * settings.usual_acceleration) ** 2, speed_sigma**2
    x = 2.0 * room / (b + math.sqrt(b * b + 4.0 * a * room))
    return max(math.sqrt(x) - age, 0.0)


_CONVERGENCE_RANGE = 100.0
"""Metres from the last fix within which its convergence serves: it changes by 1.6e-5 rad times tan(latitude)."""


def estimate(state: RawState, utime: int) -> Estimate:
    """Return the pose of the base frame at `utime`, from nothing but the state."""
    settings, newest, anchor = state.settings, state.motion, state.fixes.anchor
    invalid = _find_invalid(state, utime)
    if newest is None:
        return Estimate(utime, Pose.identity(), invalid=invalid, pose_epoch=state.pose_epoch, origin=state.origin)
    motion = state.get_motion_at(utime, newest)
    quality = _find_quality(state, utime, motion)
    odom = motion.pose
    odom_covariance = compute_odom_covariance(motion.position_variance, motion.yaw_variance, settings)
    if anchor is None:
        return Estimate(
            utime,
            odom,
            odom_covariance=odom_covariance,
            invalid=invalid,
            quality=quality,
            pose_epoch=state.pose_epoch,
            origin=state.origin,
            is_odom_random_walk=True,
        )

    heading = state.heading
    heading_variance = UNKNOWN_VARIANCE
    if heading.is_known:
        heading_variance = heading.propagate((utime - newest.utime) * 1e-6, settings).variance
    age = max((utime - anchor.utime) * 1e-6, 0.0)
    sigma_v = newest.speed_sigma
    growth = compute_growth(age, sigma_v, settings)
    place, up, arm = anchor.propagate_base(motion, state.direction)
    covariance = compute_covariance(anchor.fix, growth, arm, heading_variance, settings)
    variance = compute_longest_variance(covariance[0], covariance[7], covariance[1])
    k_horizontal, k_heading = get_factors(settings.risk)
    horizontal_protection_level = k_horizontal * math.sqrt(variance)
    heading_protection_level = min(k_heading * math.sqrt(heading_variance), math.pi)
    if heading.is_known and heading_protection_level > settings.heading_limit:
        standing = state.quiet.is_stationary(utime, settings)
        invalid |= Invalid.STATIONARY_HEADING if standing else Invalid.PROTECTION_LEVEL_EXCEEDED
    if horizontal_protection_level > settings.horizontal_limit:
        invalid |= Invalid.PROTECTION_LEVEL_EXCEEDED

    enu = utm = None
    if state.projection is not None and state.fixes.work is not None:
        enu, utm = _compute_world_poses(state, state.projection, state.fixes.work, odom.wxyz, place, up)
    remaining = min(
        settings.gps_timeout - age,
        settings.imu_timeout - (utime - (state.imu_utime or utime)) * 1e-6,
        compute_seconds_to_limit(variance - growth, age, sigma_v, settings),
    )
    return Estimate(
        utime,
        odom,
        enu,
        utm,
        covariance,
        odom_covariance,
        invalid,
        quality,
        state.pose_epoch,
        state.origin,
        horizontal_protection_level,
        heading_protection_level,
        NAN if invalid else max(remaining, 0.0),
        is_odom_random_walk=True,
    )


def _compute_world_poses(
    state: RawState, projected: OriginProjection, work: LocalFrame, q_odom: Quaternion, place: complex, up: float
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM, each from the earth-centred position; None out of reach."""
    geodesy = projected.geodesy
    ecef = work.to_ecef((place.real, place.imag, up))
    convergence = projected.convergence
    q = q_odom
    if state.heading.is_known:
        q = so3.multiply(rotation_about_up(state.heading.offset), q)
    try:
        position = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        anchor = state.fixes.anchor
        if anchor is not None and abs(place - anchor.position) > _CONVERGENCE_RANGE:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            convergence = geodesy.convergence(latitude, longitude)
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(projected.tangent_from_work, q)),
        Pose(position, so3.multiply(rotation_about_up(convergence), q)),
    )


def _find_invalid(state: RawState, utime: int) -> Invalid:
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    invalid = 0
    if anchor is None:
        invalid |= 1  # NO_FIX
    elif (utime - anchor.utime) * 1e-6 > settings.gps_timeout:
        invalid |= 32  # STALE_GPS
    if imu is None:
        invalid |= 2  # NO_IMU
    elif (utime - imu) * 1e-6 > settings.imu_timeout:
        invalid |= 64  # STALE_IMU
    if state.projection is None:
        invalid |= 4  # NO_ORIGIN
    if not state.heading.is_known:
        invalid |= 8  # NOT_MOVED_YET
    if state.fixes.num_rejected >= settings.fix_rejections:
        invalid |= 128  # GPS_REJECTED
    if state.is_clock_stepped or _is_too_early(state, utime):
        invalid |= 512  # CLOCK_STEPPED
    if state.motion is not None and state.motion.up[2] < math.cos(settings.maximum_tilt):
        invalid |= 1024  # TILTED
    return Invalid(invalid)


def _is_too_early(state: RawState, utime: int) -> bool:
    """Return whether `utime` is so far before the newest samples that its clock and theirs cannot be one.

    Before the oldest motion kept there is nothing to look up either.
    """
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    if imu is not None and (imu - utime) * 1e-6 > settings.imu_timeout:
        return True
    if anchor is not None and (anchor.utime - utime) * 1e-6 > settings.gps_timeout:
        return True
    return bool(state.history) and utime < state.history[0].utime


def _find_quality(state: RawState, utime: int, motion: RawMotion) -> Quality:
    settings = state.settings
    quality = 0
    if state.quiet.is_stationary(utime, settings) or abs(motion.speed) < settings.course_speed:
        quality |= 1  # HEADING_FROM_GYRO
    if utime > state.newest:
        quality |= 2  # PREDICTED
    if motion.speed < -max(motion.speed_sigma, settings.stationary_speed):
        quality |= 32  # REVERSING
    return Quality(quality)
