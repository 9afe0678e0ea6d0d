"""From the state of raw mode to an estimate: pose in Odom, ENU and UTM, validity, bounds."""

from __future__ import annotations

import math

from modelserver.earth.geodesy import GeodesyError, LocalFrame, geodetic_from_ecef, rotation_about_up
from modelserver.estimation.origin import OriginProjection
from modelserver.estimation.raw import bounds
from modelserver.estimation.raw.heading import UNKNOWN_VARIANCE
from modelserver.estimation.raw.motion import Motion
from modelserver.estimation.raw.state import RawState
from modelserver.messages import NAN, Estimate, Invalid, Quality
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion

_CONVERGENCE_REACH = 100.0
"""Metres from the last fix within which its convergence serves: it changes by 1.6e-5 rad times tan(latitude)."""


def estimate(state: RawState, utime: int) -> Estimate:
    """Return the pose of the base frame at `utime`, from nothing but the state."""
    settings, newest, anchor = state.settings, state.motion, state.fixes.anchor
    invalid = _invalid(state, utime)
    if newest is None:
        return Estimate(utime, Pose.identity(), invalid=invalid, pose_epoch=state.pose_epoch, origin=state.origin)
    motion = state.motion_at(utime, newest)
    quality = _quality(state, utime, motion)
    odom = motion.pose
    odom_covariance = bounds.odom_covariance(motion.position_variance, motion.yaw_variance, settings)
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
    if heading.known:
        heading_variance = heading.carried((utime - newest.utime) * 1e-6, settings).variance
    age = max((utime - anchor.utime) * 1e-6, 0.0)
    sigma_v = newest.speed_sigma
    growth = bounds.grown(age, sigma_v, settings)
    place, up, arm = anchor.base(motion, state.direction)
    covariance = bounds.covariance(anchor.fix, growth, arm, heading_variance, settings)
    variance = bounds.longest(covariance[0], covariance[7], covariance[1])
    k_horizontal, k_heading = bounds.factors(settings.risk)
    horizontal_protection_level = k_horizontal * math.sqrt(variance)
    heading_protection_level = min(k_heading * math.sqrt(heading_variance), math.pi)
    if heading.known and heading_protection_level > settings.heading_limit:
        standing = state.stillness.standing(utime, settings)
        invalid |= Invalid.STATIONARY_HEADING if standing else Invalid.PROTECTION_LEVEL_EXCEEDED
    if horizontal_protection_level > settings.horizontal_limit:
        invalid |= Invalid.PROTECTION_LEVEL_EXCEEDED

    enu = utm = None
    if state.projected is not None and state.fixes.work is not None:
        enu, utm = _world_poses(state, state.projected, state.fixes.work, odom.wxyz, place, up)
    remaining = min(
        settings.gps_timeout - age,
        settings.imu_timeout - (utime - (state.imu_utime or utime)) * 1e-6,
        bounds.seconds_to_horizontal_limit(variance - growth, age, sigma_v, settings),
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


def _world_poses(
    state: RawState, projected: OriginProjection, work: LocalFrame, q_odom: Quaternion, place: complex, up: float
) -> tuple[Pose, Pose] | tuple[None, None]:
    """Return the pose in World:ENU and in World:UTM, each from the earth-centred position; None out of reach."""
    geodesy = projected.geodesy
    ecef = work.to_ecef((place.real, place.imag, up))
    convergence = projected.convergence
    q = q_odom
    if state.heading.known:
        q = so3.multiply(rotation_about_up(state.heading.offset), q)
    try:
        position = geodesy.to_relative_utm(geodesy.utm_from_ecef(ecef))
        anchor = state.fixes.anchor
        if anchor is not None and abs(place - anchor.place) > _CONVERGENCE_REACH:
            latitude, longitude, _ = geodetic_from_ecef(ecef)
            convergence = geodesy.convergence(latitude, longitude)
    except GeodesyError:
        return None, None
    return (
        Pose(geodesy.tangent.from_ecef(ecef), so3.multiply(projected.tangent_from_work, q)),
        Pose(position, so3.multiply(rotation_about_up(convergence), q)),
    )


def _invalid(state: RawState, utime: int) -> Invalid:
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
    if state.projected is None:
        invalid |= 4  # NO_ORIGIN
    if not state.heading.known:
        invalid |= 8  # NOT_MOVED_YET
    if state.fixes.refusals >= settings.fix_rejections:
        invalid |= 128  # GPS_REJECTED
    if state.stepped or _too_early(state, utime):
        invalid |= 512  # CLOCK_STEPPED
    if state.motion is not None and state.motion.up[2] < math.cos(settings.maximum_tilt):
        invalid |= 1024  # TILTED
    return Invalid(invalid)


def _too_early(state: RawState, utime: int) -> bool:
    """Return whether `utime` is so far before the newest samples that its clock and theirs cannot be one.

    Before the oldest motion kept there is nothing to look up either.
    """
    settings, anchor, imu = state.settings, state.fixes.anchor, state.imu_utime
    if imu is not None and (imu - utime) * 1e-6 > settings.imu_timeout:
        return True
    if anchor is not None and (anchor.utime - utime) * 1e-6 > settings.gps_timeout:
        return True
    return bool(state.history) and utime < state.history[0].utime


def _quality(state: RawState, utime: int, motion: Motion) -> Quality:
    settings = state.settings
    quality = 0
    if state.stillness.standing(utime, settings) or abs(motion.speed) < settings.course_speed:
        quality |= 1  # HEADING_FROM_GYRO
    if utime > state.newest:
        quality |= 2  # PREDICTED
    if motion.speed < -max(motion.speed_sigma, settings.stationary_speed):
        quality |= 32  # REVERSING
    return Quality(quality)
