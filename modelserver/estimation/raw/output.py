"""Output of raw mode: pose in Odom, ENU and UTM, its validity, covariance and protection levels.

Position: the last fix propagated to the instant (track.py, equation 2). Its covariance is that of the fix plus the
growth by its age, `compute_growth`, plus the yaw error on the arm a from the antenna at the fix to the base frame:
yaw variance times (-a_n, a_e)(-a_n, a_e)', which also correlates position with yaw. Protection levels are those of
`filter.protection_levels`, at probability `risk`.

World:UTM and World:ENU are each computed from the earth-centered position.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from modelserver.earth.geodesy import GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.filter.protection_levels import (
    LIMIT_RISK,
    compute_factors,
    compute_level,
    compute_limit_risks,
    compute_longest_axis,
)
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

CONVERGENCE_RANGE: Final = 100.0
"""Meters from the last fix within which its meridian convergence is used: it changes by 1.6e-5 rad tan(latitude)."""


# --- estimate -----------------------------------------------------------------------------------------------


def estimate(state: RawState, utime: int) -> Estimate:
    """Return the pose of the base frame at an instant, by the state alone."""
    settings, newest, anchor, origin = state.settings, state.motion, state.fixes.anchor, state.origin
    invalid = _find_invalid(state, utime)
    if newest is None:
        return Estimate(utime, Pose.identity(), invalid=invalid, pose_epoch=state.pose_epoch, origin=origin)
    motion = state.get_motion_at(utime, newest)
    odom = motion.pose
    in_odom = Estimate(
        utime,
        odom,
        odom_covariance=compute_odom_covariance(motion.position_variance, motion.yaw_variance, settings),
        invalid=invalid,
        quality=_find_quality(state, utime, motion),
        pose_epoch=state.pose_epoch,
        origin=origin,
        is_odom_random_walk=True,
    )
    if anchor is None:
        return in_odom
    heading, q, direction, heading_variance = state.heading, odom.wxyz, 1.0 + 0j, UNKNOWN_VARIANCE
    if heading.is_known:
        q, direction = so3.multiply(rotation_about_up(heading.offset), q), heading.direction
        heading_variance = heading.propagate((utime - newest.utime) * 1e-6, settings).variance
    age = max((utime - anchor.utime) * 1e-6, 0.0)
    growth = compute_growth(age, newest.speed_sigma, settings)
    position, up, arm = anchor.propagate_base(motion, direction)
    covariance = compute_covariance(anchor.fix, growth, arm, heading_variance, settings)
    variance = compute_longest_axis(covariance[0], covariance[7], covariance[1])
    k_horizontal, k_heading = compute_factors(settings.risk)
    horizontal = k_horizontal * math.sqrt(variance)
    heading_level = min(k_heading * math.sqrt(heading_variance), math.pi)
    sigma, heading_sigma = math.sqrt(variance), math.sqrt(heading_variance)
    levels = compute_level(sigma, 0.0, heading_sigma)
    risks = compute_limit_risks(sigma, heading_sigma, settings.horizontal_limit, settings.heading_limit)
    if heading.is_known and risks[1] > max(risks[0], LIMIT_RISK):
        is_stationary = state.quiet.is_stationary(utime, settings)
        invalid |= Invalid.STATIONARY_HEADING if is_stationary else Invalid.LIMIT_EXCEEDED
    elif risks[0] > LIMIT_RISK or (heading.is_known and sum(risks) > LIMIT_RISK):
        invalid |= Invalid.LIMIT_EXCEEDED
    enu = utm = None
    if state.projection is not None and state.fixes.work is not None:
        is_far = abs(position - anchor.position) > CONVERGENCE_RANGE
        enu, utm = _compute_world_poses(state.projection, state.fixes.work, q, position, up, is_far)
    remaining = min(
        settings.gps_timeout - age,
        settings.imu_timeout - (utime - (state.imu_utime or utime)) * 1e-6,
        compute_seconds_to_limit(variance - growth, age, newest.speed_sigma, settings),
    )
    return replace(
        in_odom,
        enu=enu,
        utm=utm,
        covariance=covariance,
        invalid=invalid,
        horizontal_protection_level=horizontal,
        heading_protection_level=heading_level,
        seconds_to_limit=NAN if invalid else max(remaining, 0.0),
        horizontal_level=levels[0],
        heading_level=levels[1],
        limit_risk=min(sum(risks), 1.0),
        horizontal_allowance=0.0,
    )


def _compute_world_poses(
    projection: OriginProjection, work: LocalFrame, q: Quaternion, position: complex, up: float, is_far: bool
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM; `q` is along the working frame. None out of range."""
    geodesy, convergence = projection.geodesy, projection.convergence
    ecef = work.to_ecef((position.real, position.imag, up))
    try:
        utm = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        if is_far:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            convergence = geodesy.convergence(latitude, longitude)
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(projection.tangent_from_work, q)),
        Pose(utm, so3.multiply(rotation_about_up(convergence), q)),
    )


# --- covariance ---------------------------------------------------------------------------------------------


def compute_covariance(
    fix: AcceptedFix, growth: float, arm: complex, yaw_variance: float, settings: RawSettings
) -> tuple[float, ...]:
    """Return the 36 numbers of the covariance of the base frame along east, north, up; `arm`: see the theory."""
    ae, an = -arm.imag, arm.real
    ee = fix.east_variance + growth + yaw_variance * ae * ae
    nn = fix.north_variance + growth + yaw_variance * an * an
    en = fix.cross + yaw_variance * ae * an
    ye, yn = yaw_variance * ae, yaw_variance * an
    return _fill_covariance(ee, en, nn, fix.up_variance + growth, ye, yn, yaw_variance, settings)


def compute_odom_covariance(position: float, yaw: float, settings: RawSettings) -> tuple[float, ...]:
    """Return the 36 numbers of the covariance of the pose in Odom, from its variances of position and yaw."""
    return _fill_covariance(position, 0.0, position, position, 0.0, 0.0, yaw, settings)


def _fill_covariance(
    ee: float, en: float, nn: float, uu: float, ye: float, yn: float, yy: float, settings: RawSettings
) -> tuple[float, ...]:
    tilt = settings.tilt_sigma**2
    return (
        *(ee, en, 0.0, 0.0, 0.0, ye),
        *(en, nn, 0.0, 0.0, 0.0, yn),
        *(0.0, 0.0, uu, 0.0, 0.0, 0.0),
        *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
        *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
        *(ye, yn, 0.0, 0.0, 0.0, yy),
    )


def compute_seconds_to_limit(variance: float, age: float, speed_sigma: float, settings: RawSettings) -> float:
    """Return the seconds without fixes until the position is beyond its limit with LIMIT_RISK; 0 if it is.

    `variance` is that of the longest axis without growth, which is a quadratic of x = t^2.
    """
    room = (settings.horizontal_limit / compute_factors(LIMIT_RISK)[0]) ** 2 - variance
    if room <= 0.0:
        return 0.0
    a, b = (0.5 * settings.usual_acceleration) ** 2, speed_sigma**2
    x = 2.0 * room / (b + math.sqrt(b * b + 4.0 * a * room))
    return max(math.sqrt(x) - age, 0.0)


# --- validity -----------------------------------------------------------------------------------------------


def _find_invalid(state: RawState, utime: int) -> Invalid:
    """Return the reasons against an estimate, except for its protection levels."""
    # numbers, not members: combining flags costs more than all else here
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
    """Return whether an instant is before the history, or so far before the newest samples that the clocks differ."""
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    return (
        (imu is not None and (imu - utime) * 1e-6 > settings.imu_timeout)
        or (anchor is not None and (anchor.utime - utime) * 1e-6 > settings.gps_timeout)
        or (bool(state.history) and utime < state.history[0].utime)
    )


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
