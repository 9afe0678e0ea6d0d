"""Sources beside GPS, inertial unit and wheels: poses from elsewhere, visual odometry, ranges to beacons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from modelserver.earth.geodesy import Geodesy
from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.simulation import rigid
from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.stamps import Intervals, Timing, headers, within
from modelserver.simulation.trajectory import MotionModel
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Vector3

ENU = "World:ENU"
UTM = "World:UTM"

_TIMING = Timing(5.0, latency=0.05, jitter=0.005)
_LEAST = 1e-4
"""No source claims a smaller standard deviation, metres or radians."""


@dataclass(frozen=True, slots=True)
class AbsolutePoseModel:
    """A source of poses in a world frame, as matching with a map. Metres, radians, seconds.

    position_sigma, orientation_sigma: of each axis in each sample. frame_of_reference: World:ENU or World:UTM.
    tells_position, tells_orientation: what is not told is None. outages: as everywhere.
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.05
    orientation_sigma: float = 0.01
    frame_of_reference: str = ENU
    tells_position: bool = True
    tells_orientation: bool = True
    outages: Intervals = ()

    def __post_init__(self) -> None:
        if self.frame_of_reference not in (ENU, UTM):
            raise ValueError(f"poses are in {ENU} or {UTM}, got {self.frame_of_reference!r}")


@dataclass(frozen=True, slots=True)
class RelativePoseModel:
    """Visual odometry: each sample tells the way since the last. Metres, radians.

    position_sigma, orientation_sigma: of each axis in each sample. scale_sigma: of its error of scale, drawn once.
    outages: samples that are lost; the next tells the way since its own predecessor all the same.
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.01
    orientation_sigma: float = 0.002
    scale_sigma: float = 0.0
    outages: Intervals = ()


@dataclass(frozen=True, slots=True)
class RangeModel:
    """Distances to beacons, all at each instant. Metres.

    sigma: of each distance; bias_sigma: of each beacon's constant error, drawn once. reach: beacons farther away are
    not heard. outages: as everywhere.
    """

    timing: Timing = _TIMING
    sigma: float = 0.1
    bias_sigma: float = 0.0
    reach: float = math.inf
    outages: Intervals = ()


def absolute_poses(
    model: AbsolutePoseModel,
    drive: MotionModel,
    frame: str,
    X_VF: Pose,
    geodesy: Geodesy,
    start_utime: int,
    seed: int,
    source: str,
) -> Iterator[AbsolutePoseSample]:
    """Yield the samples, for ever. `X_VF` is the pose of `frame` in the vehicle's moving frame."""
    noise = NoiseSource(seed, f"absolute/{source}").draw_ahead()
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    arrival = NoiseSource(seed, f"absolute/{source}/arrival")
    for header in headers(model.timing, start_utime, start_utime - 1_000_000, source, arrival):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        t = (header.utime - start_utime) * 1e-6
        if within(model.outages, t):
            continue
        true = rigid.pose(drive.at(t), X_VF)
        if model.frame_of_reference == UTM:
            true = geodesy.pose_in_utm(true)
        said = _disturbed(true, shift, turn)
        yield AbsolutePoseSample(
            header,
            frame,
            model.frame_of_reference,
            position=said.xyz if model.tells_position else None,
            orientation=said.wxyz if model.tells_orientation else None,
            covariance=covariance,
        )


def relative_poses(
    model: RelativePoseModel, drive: MotionModel, frame: str, X_VF: Pose, start_utime: int, seed: int, source: str
) -> Iterator[RelativePoseSample]:
    """Yield the samples, for ever; the first at the second instant. `X_VF` is as in `absolute_poses`."""
    noise = NoiseSource(seed, f"relative/{source}").draw_ahead()
    scale = 1.0 + noise.normal(model.scale_sigma)
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    arrival = NoiseSource(seed, f"relative/{source}/arrival")
    since: int | None = None
    before = Pose()
    for header in headers(model.timing, start_utime, start_utime - 1_000_000, source, arrival):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        t = (header.utime - start_utime) * 1e-6
        here = rigid.pose(drive.at(t), X_VF)
        if since is not None and not within(model.outages, t):
            x, y, z = (way := before.inverse() @ here).xyz
            said = _disturbed(Pose((x * scale, y * scale, z * scale), way.wxyz), shift, turn)
            yield RelativePoseSample(header, frame, since, said.xyz, said.wxyz, covariance)
        before, since = here, header.utime


def ranges(
    model: RangeModel,
    drive: MotionModel,
    frame: str,
    lever: Vector3,
    beacons: Mapping[str, Vector3],
    start_utime: int,
    seed: int,
    source: str,
) -> Iterator[RangeSample]:
    """Yield the samples, for ever. `beacons` are places in World:ENU, metres, by name.

    `lever` is the place of `frame` in the vehicle's moving frame. `seq` counts samples.
    """
    noise = NoiseSource(seed, f"range/{source}").draw_ahead()
    biases = {name: noise.normal(model.bias_sigma) for name in beacons}
    sigma = max(math.hypot(model.sigma, model.bias_sigma), _LEAST)
    arrival = NoiseSource(seed, f"range/{source}/arrival")
    X_VF = Pose(lever)
    seq = 0
    for header in headers(model.timing, start_utime, start_utime - 1_000_000, source, arrival):
        errors = {name: bias + noise.normal(model.sigma) for name, bias in biases.items()}
        t = (header.utime - start_utime) * 1e-6
        if within(model.outages, t):
            continue
        here = rigid.pose(drive.at(t), X_VF).xyz
        for name, place in beacons.items():
            distance = math.dist(here, place)
            if distance <= model.reach:
                said = max(distance + errors[name], 0.0)
                yield RangeSample(replace(header, seq=seq), frame, name, place, ENU, said, sigma)
                seq += 1


def _disturbed(X: Pose, shift: Vector3, turn: Vector3) -> Pose:
    """Return the pose with an error along the axes of its frame of reference."""
    (x, y, z), (dx, dy, dz) = X.xyz, shift
    return Pose((x + dx, y + dy, z + dz), so3.multiply(so3.exponential(turn), X.wxyz))


def _covariance(position_sigma: float, orientation_sigma: float) -> tuple[float, ...]:
    """Return the 36 numbers, row-major, of alike axes."""
    sigmas = (max(position_sigma, _LEAST),) * 3 + (max(orientation_sigma, _LEAST),) * 3
    return tuple(sigmas[i] ** 2 if i == j else 0.0 for i in range(6) for j in range(6))
