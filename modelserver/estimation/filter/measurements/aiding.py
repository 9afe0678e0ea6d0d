"""Measurement models of aiding sources: pose, position, range to a beacon, relative pose (visual odometry).

Visual localization, radio ranges, a theodolite, an operator, another robot that has seen this one (its own pose with
what it saw, composed by whoever publishes it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame, rotation_about_up
from modelserver.estimation.filter.layout import ErrorState
from modelserver.estimation.filter.measurements.base import INSTANT, Compared, Scene, register
from modelserver.estimation.filter.nav import (
    ATTITUDE,
    GYRO_BIAS,
    jacobian_of_body_velocity,
    jacobian_of_point,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.geometry import names
from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Quaternion, Vector3

LONGEST_RELATIVE = 1.0
"""Seconds between the two instants of a relative pose, at most: it is compared as a mean velocity and turn rate."""


@dataclass(frozen=True, slots=True)
class _Anywhere:
    @classmethod
    def of(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        return cls()


def in_site(scene: Scene, reference: str, point: Vector3) -> tuple[Vector3, Quaternion] | str:
    """Return a point of a world frame along N's axes, and what turns that frame's axes there to N's; or why not."""
    if scene.site is None or scene.geodesy is None:
        return ""
    geodesy, site = scene.geodesy, scene.site
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


def _block(stated: tuple[float, ...] | None, start: int, sigma: float) -> Array:
    """Return the 3 x 3 block of a stated 6 x 6 covariance where it is one, else that of `sigma`."""
    if stated is not None and len(stated) == 36:
        block = np.array(stated).reshape(6, 6)[start : start + 3, start : start + 3]
        block = 0.5 * (block + block.T)
        if np.isfinite(block).all() and np.linalg.eigvalsh(block)[0] > 0.0:
            return np.asarray(block)
    return np.eye(3) * sigma * sigma


@register
class AbsolutePose(_Anywhere):
    """Where a frame of the vehicle is in World:ENU or World:UTM: position, orientation or both."""

    kind: ClassVar[str] = "absolute_pose"
    sample: ClassVar[type] = AbsolutePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: AbsolutePoseSample) -> int | None:
        """Return the sample's stamp."""
        return sample.header.utime

    def compare(self, scene: Scene, sample: AbsolutePoseSample) -> Compared | str:
        """Compare what is told, position first."""
        if fault := scene.rig.find_problem(sample.frame_of_interest):
            return fault
        position, orientation = sample.position, sample.orientation
        found = in_site(scene, sample.frame_of_reference, position or (0.0, 0.0, 0.0))
        if isinstance(found, str):
            return found
        place, turn = found
        if not all(map(math.isfinite, place)):
            return "nan"
        nav, settings = scene.nav, scene.settings
        turning = np.array(so3.matrix_rows(turn))
        residuals: list[Array] = []
        rows: list[Array] = []
        noises: list[Array] = []
        if position is not None:
            lever = scene.rig.lever_arm(sample.frame_of_interest)
            residuals.append(np.subtract(place, nav.point(lever)))
            rows.append(jacobian_of_point(nav, lever, scene.layout.size))
            noises.append(turning @ _block(sample.covariance, 0, settings.aiding_sigma) @ turning.T)
        if orientation is not None:
            try:
                told = so3.normalize(orientation)
            except ValueError:
                return "nan"
            mounted = scene.rig.pose(sample.frame_of_interest).wxyz
            q = so3.multiply(so3.multiply(turn, told), so3.conjugate(mounted))
            error = so3.logarithm(so3.normalize(so3.multiply(q, so3.conjugate(nav.attitude))))
            H = scene.jacobian(3)
            H[:, ATTITUDE] = np.eye(3)
            residuals.append(np.array(error))
            rows.append(H)
            noises.append(turning @ _block(sample.covariance, 3, settings.aiding_rotation_sigma) @ turning.T)
        if not residuals:
            return "empty"
        return Compared(np.concatenate(residuals), np.vstack(rows), _diagonal(noises))


def _diagonal(blocks: list[Array]) -> Array:
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

    def instant(self, sample: RangeSample) -> int | None:
        """Return the sample's stamp."""
        return sample.header.utime

    def compare(self, scene: Scene, sample: RangeSample) -> Compared | str:
        """Compare the distance; next to the beacon, where its direction is not known, there is nothing to compare."""
        if fault := scene.rig.find_problem(sample.frame):
            return fault
        if not (math.isfinite(sample.distance) and sample.distance >= 0.0):
            return "nan" if not math.isfinite(sample.distance) else "range"
        found = in_site(scene, sample.frame_of_reference, sample.beacon_position)
        if isinstance(found, str):
            return found
        lever = scene.rig.lever_arm(sample.frame)
        away = np.subtract(scene.nav.point(lever), found[0])
        expected = float(np.linalg.norm(away))
        H = jacobian_of_point(scene.nav, lever, scene.layout.size)
        if expected < 1.0:
            return "near"
        sigma = sample.sigma if 0.0 < sample.sigma < 1e3 else scene.settings.aiding_sigma
        line = away / expected
        P = scene.nav.covariance[:3, :3]
        # a doubt across the line lengthens it by its square over twice the distance: what a first order leaves out
        across = max(float(np.trace(P) - line @ P @ line), 0.0)
        variance = sigma * sigma + (across / expected) ** 2
        return Compared(np.array((sample.distance - expected,)), line[None, :] @ H, np.array(((variance,),)))


@register
class RelativePose(_Anywhere):
    """How a frame of the vehicle moved since a moment ago: its mean velocity and turn rate over that time."""

    kind: ClassVar[str] = "relative_pose"
    sample: ClassVar[type] = RelativePoseSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    def instant(self, sample: RelativePoseSample) -> int | None:
        """Return the middle between the two instants: over a short time that is when the means are met."""
        return (sample.header.utime + sample.since_utime) // 2

    def compare(self, scene: Scene, sample: RelativePoseSample) -> Compared | str:
        """Compare the frame's mean velocity and turn rate, along the body's axes."""
        dt = (sample.header.utime - sample.since_utime) * 1e-6
        if not 0.0 < dt <= LONGEST_RELATIVE:
            return "interval"
        if fault := scene.rig.find_problem(sample.frame):
            return fault
        if not all(map(math.isfinite, sample.position)):
            return "nan"
        try:
            angle = so3.logarithm(so3.normalize(sample.orientation))
        except ValueError:
            return "nan"
        nav, settings = scene.nav, scene.settings
        mounted = scene.rig.pose(sample.frame).wxyz
        lever = scene.rig.lever_arm(sample.frame)
        # the way, told along the frame's earlier axes, along those in the middle: half the turn back
        half = so3.exponential((-0.5 * angle[0], -0.5 * angle[1], -0.5 * angle[2]))
        way = so3.rotate(so3.multiply(mounted, half), sample.position)
        turn = so3.rotate(mounted, angle)
        v = np.array(way) / dt - nav.body_velocity(lever)
        w = np.array(turn) / dt - nav.turn_rate
        H = scene.jacobian(6)
        H[:3] = jacobian_of_body_velocity(nav, lever, scene.layout.size)
        # turn rate = felt - bias: an error of the bias lowers it
        H[3:, GYRO_BIAS] = -np.eye(3)
        M = np.array(so3.matrix_rows(mounted))
        R = np.zeros((6, 6))
        R[:3, :3] = M @ _block(sample.covariance, 0, settings.aiding_sigma) @ M.T / (dt * dt)
        R[3:, 3:] = M @ _block(sample.covariance, 3, settings.aiding_rotation_sigma) @ M.T / (dt * dt)
        # the gyros' own noise stands beside it: of the instant, for the state keeps one sample and no mean
        R[3:, 3:] += np.eye(3) * settings.gyro_noise**2 / INSTANT
        return Compared(np.concatenate((v, w)), H, R)
