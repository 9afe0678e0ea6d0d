"""Measurement models of aiding sources: pose, position, range to a beacon, relative pose (visual odometry).

Visual localization, radio ranges, a theodolite, an operator, another robot that has seen this one (its own pose with
the relative pose that it measured, composed by the publisher).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame, rotation_about_up
from modelserver.estimation.filter.error_layout import ATTITUDE, GYRO_BIAS, ErrorState
from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements.measurement import (
    IMU_AVERAGING,
    MeasurementContext,
    body_velocity_jacobian,
    choose_covariance,
    point_jacobian,
    register,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.geometry import names
from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3

LONGEST_RELATIVE = 1.0
"""Seconds between the two instants of a relative pose, at most: it is compared as a mean velocity and angular rate."""


@dataclass(frozen=True, slots=True)
class _Anywhere:
    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls()


def transform_to_site(context: MeasurementContext, reference: str, point: Vector3) -> tuple[Vector3, Quaternion] | str:
    """Return a point of a world frame in N, and the rotation from its axes there to N; or in one word why not."""
    if context.site is None or context.geodesy is None:
        return ""
    geodesy, site = context.geodesy, context.site
    try:
        if reference == names.WORLD_ENU:
            return site.from_ecef(geodesy.tangent.to_ecef(point)), site.rotation_of(geodesy.tangent)
        if reference == names.WORLD_UTM:
            east, north, height = geodesy.origin.initial_utm
            latitude, longitude, up = geodesy.geodetic_from_utm(east + point[0], north + point[1], height + point[2])
            there = LocalFrame.at(latitude, longitude, up)
            # yaw from grid east to yaw from true east
            grid = rotation_about_up(-geodesy.convergence(latitude, longitude))
            return site.from_ecef(there.ecef), so3.multiply(site.rotation_of(there), grid)
    except GeodesyError:
        return "range"
    return "frame"


def _read_covariance(stated: tuple[float, ...] | None, start: int, sigma: float) -> Array:
    """Return the 3 x 3 block of a reported 6 x 6 covariance if it is positive definite, else that of `sigma`."""
    block = None
    if stated is not None and len(stated) == 36:
        block = np.array(stated).reshape(6, 6)[start : start + 3, start : start + 3]
    return choose_covariance(block, 3, sigma)


@register
class AbsolutePose(_Anywhere):
    """Pose of a frame of the vehicle in World:ENU or World:UTM: position, orientation or both."""

    kind: ClassVar[str] = "absolute_pose"
    sample: ClassVar[type] = AbsolutePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: AbsolutePoseSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: AbsolutePoseSample) -> Innovation | str:
        """Compare what is measured, position first."""
        if fault := context.rig.find_problem(sample.frame_of_interest):
            return fault
        position, orientation = sample.position, sample.orientation
        found = transform_to_site(context, sample.frame_of_reference, position or (0.0, 0.0, 0.0))
        if isinstance(found, str):
            return found
        place, turn = found
        if not all(map(math.isfinite, place)):
            return "nan"
        nav, settings = context.nav, context.settings
        turning = np.array(so3.matrix_rows(turn))
        residuals: list[Array] = []
        rows: list[Array] = []
        noises: list[Array] = []
        if position is not None:
            lever = context.rig.lever_arm(sample.frame_of_interest)
            residuals.append(np.subtract(place, nav.point(lever)))
            rows.append(point_jacobian(nav, lever, context.layout.size))
            noises.append(turning @ _read_covariance(sample.covariance, 0, settings.aiding_sigma) @ turning.T)
        if orientation is not None:
            try:
                measured = so3.normalize(orientation)
            except ValueError:
                return "nan"
            mounted = context.rig.pose(sample.frame_of_interest).wxyz
            q = so3.multiply(so3.multiply(turn, measured), so3.conjugate(mounted))
            error = so3.logarithm(so3.normalize(so3.multiply(q, so3.conjugate(nav.attitude))))
            H = context.zero_jacobian(3)
            H[:, ATTITUDE] = np.eye(3)
            residuals.append(np.array(error))
            rows.append(H)
            noises.append(turning @ _read_covariance(sample.covariance, 3, settings.aiding_rotation_sigma) @ turning.T)
        if not residuals:
            return "empty"
        return Innovation(np.concatenate(residuals), np.vstack(rows), _block_diagonal(noises))


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    R = np.zeros((size, size))
    at = 0
    for block in blocks:
        R[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return R


@register
class BeaconRange(_Anywhere):
    """Distance from a frame of the vehicle to a beacon: |p + R l - b|."""

    kind: ClassVar[str] = "range"
    sample: ClassVar[type] = RangeSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: RangeSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: RangeSample) -> Innovation | str:
        """Compare the distance; within a meter of the beacon its direction is unknown."""
        if fault := context.rig.find_problem(sample.frame):
            return fault
        if not (math.isfinite(sample.distance) and sample.distance >= 0.0):
            return "nan" if not math.isfinite(sample.distance) else "range"
        found = transform_to_site(context, sample.frame_of_reference, sample.beacon_position)
        if isinstance(found, str):
            return found
        lever = context.rig.lever_arm(sample.frame)
        away = np.subtract(context.nav.point(lever), found[0])
        expected = float(np.linalg.norm(away))
        H = point_jacobian(context.nav, lever, context.layout.size)
        if expected < 1.0:
            return "near"
        sigma = sample.sigma if 0.0 < sample.sigma < 1e3 else context.settings.aiding_sigma
        line = away / expected
        P = context.nav.covariance[:3, :3]
        # second order: an error across the line lengthens it by its square over twice the distance
        across = max(float(np.trace(P) - line @ P @ line), 0.0)
        variance = sigma * sigma + (across / expected) ** 2
        return Innovation(np.array((sample.distance - expected,)), line[None, :] @ H, np.array(((variance,),)))


@register
class RelativePose(_Anywhere):
    """Motion of a frame of the vehicle since an earlier instant: its mean velocity and angular rate over that time."""

    kind: ClassVar[str] = "relative_pose"
    sample: ClassVar[type] = RelativePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def get_utime(self, sample: RelativePoseSample) -> int | None:
        """Return the middle between the two instants, where over a short time the means hold."""
        return (sample.header.utime + sample.since_utime) // 2

    def evaluate(self, context: MeasurementContext, sample: RelativePoseSample) -> Innovation | str:
        """Compare the mean velocity and angular rate of the frame along the body axes."""
        dt = (sample.header.utime - sample.since_utime) * 1e-6
        if not 0.0 < dt <= LONGEST_RELATIVE:
            return "interval"
        if fault := context.rig.find_problem(sample.frame):
            return fault
        if not all(map(math.isfinite, sample.position)):
            return "nan"
        try:
            angle = so3.logarithm(so3.normalize(sample.orientation))
        except ValueError:
            return "nan"
        nav, settings = context.nav, context.settings
        mounted = context.rig.pose(sample.frame).wxyz
        lever = context.rig.lever_arm(sample.frame)
        # the displacement is along the earlier axes: half the rotation back gives those in the middle
        half = so3.exponential((-0.5 * angle[0], -0.5 * angle[1], -0.5 * angle[2]))
        displacement = so3.rotate(so3.multiply(mounted, half), sample.position)
        turn = so3.rotate(mounted, angle)
        v = np.array(displacement) / dt - nav.body_velocity(lever)
        w = np.array(turn) / dt - nav.angular_rate
        H = context.zero_jacobian(6)
        H[:3] = body_velocity_jacobian(nav, lever, context.layout.size)
        # angular rate = measured - bias
        H[3:, GYRO_BIAS] = -np.eye(3)
        M = np.array(so3.matrix_rows(mounted))
        R = np.zeros((6, 6))
        R[:3, :3] = M @ _read_covariance(sample.covariance, 0, settings.aiding_sigma) @ M.T / (dt * dt)
        R[3:, 3:] = M @ _read_covariance(sample.covariance, 3, settings.aiding_rotation_sigma) @ M.T / (dt * dt)
        # the noise of the gyros: of one sample, because the state has no mean
        R[3:, 3:] += np.eye(3) * settings.gyro_noise**2 / IMU_AVERAGING
        return Innovation(np.concatenate((v, w)), H, R)
