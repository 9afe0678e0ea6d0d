"""Simulation of aiding sensors: absolute poses (map matching), visual odometry, ranges to beacons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.simulation.timing import Intervals, Run, Timing, is_within
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

ENU = "World:ENU"
UTM = "World:UTM"

_TIMING = Timing(5.0, latency=0.05, jitter=0.005)
_MIN_SIGMA = 1e-4
"""Smallest standard deviation that a source states, meters or radians."""


@dataclass(frozen=True, slots=True)
class AbsolutePoseModel:
    """A source of poses in a world frame, such as map matching. Meters, radians, seconds.

    Attributes
    ----------
    position_sigma, orientation_sigma : noise of each axis and sample
    frame_of_reference : World:ENU or World:UTM
    outages : (begin, end) in seconds since the start without samples
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.05
    orientation_sigma: float = 0.01
    frame_of_reference: str = ENU
    outages: Intervals = ()

    def __post_init__(self) -> None:
        if self.frame_of_reference not in (ENU, UTM):
            raise ValueError(f"frame_of_reference must be {ENU} or {UTM}; got {self.frame_of_reference!r}")


@dataclass(frozen=True, slots=True)
class RelativePoseModel:
    """Visual odometry: each sample is the pose relative to the last instant. Meters, radians.

    Attributes
    ----------
    position_sigma, orientation_sigma : noise of each axis and sample
    scale_sigma : standard deviation of the scale error, drawn once
    outages : lost samples; the next one is still relative to its own predecessor
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.01
    orientation_sigma: float = 0.002
    scale_sigma: float = 0.0
    outages: Intervals = ()


@dataclass(frozen=True, slots=True)
class RangeModel:
    """Distances to beacons, all at each instant. Meters.

    Attributes
    ----------
    sigma : noise of each distance
    max_range : beacons farther away give no sample
    outages : (begin, end) in seconds since the start without samples
    """

    timing: Timing = _TIMING
    sigma: float = 0.1
    max_range: float = math.inf
    outages: Intervals = ()


def simulate_absolute_poses(model: AbsolutePoseModel, run: Run, frame: str, X_VF: Pose) -> Iterator[AbsolutePoseSample]:
    """Yield samples without end. `X_VF` is the pose of `frame` in the vehicle's moving frame."""
    noise = run.noise("absolute/absolute_pose").prefetch()
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    for header, t in run.generate_headers(model.timing, "absolute/absolute_pose"):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        if is_within(model.outages, t):
            continue
        true = run.drive.at(t).pose_of(X_VF)
        measured = _add_error(run.geodesy.pose_in_utm(true) if model.frame_of_reference == UTM else true, shift, turn)
        yield AbsolutePoseSample(
            header,
            frame,
            model.frame_of_reference,
            position=measured.xyz,
            orientation=measured.wxyz,
            covariance=covariance,
        )


def simulate_relative_poses(model: RelativePoseModel, run: Run, frame: str, X_VF: Pose) -> Iterator[RelativePoseSample]:
    """Yield samples without end, the first at the second instant. `X_VF` as in `simulate_absolute_poses`."""
    noise = run.noise("relative/relative_pose").prefetch()
    scale = 1.0 + noise.normal(model.scale_sigma)
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    since: int | None = None
    before = Pose()
    for header, t in run.generate_headers(model.timing, "relative/relative_pose"):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        here = run.drive.at(t).pose_of(X_VF)
        if since is not None and not is_within(model.outages, t):
            step = before.inverse() @ here
            measured = _add_error(Pose(so3.scale(scale, step.xyz), step.wxyz), shift, turn)
            yield RelativePoseSample(header, frame, since, measured.xyz, measured.wxyz, covariance)
        before, since = here, header.utime


def simulate_ranges(
    model: RangeModel, run: Run, frame: str, X_VF: Pose, beacons: Mapping[str, Vector3]
) -> Iterator[RangeSample]:
    """Yield samples without end. `beacons` are positions in World:ENU, meters, by name; `seq` counts samples."""
    noise = run.noise("range/range").prefetch()
    sigma = max(model.sigma, _MIN_SIGMA)
    seq = 0
    for header, t in run.generate_headers(model.timing, "range/range"):
        errors = {name: noise.normal(model.sigma) for name in beacons}
        if is_within(model.outages, t):
            continue
        here = run.drive.at(t).pose_of(X_VF).xyz
        for name, place in beacons.items():
            distance = math.dist(here, place)
            if distance <= model.max_range:
                measured = max(distance + errors[name], 0.0)
                yield RangeSample(replace(header, seq=seq), frame, name, place, ENU, measured, sigma)
                seq += 1


def _add_error(X: Pose, shift: Vector3, turn: Vector3) -> Pose:
    """Return the pose with an error along the axes of its frame of reference."""
    return Pose(so3.add(X.xyz, shift), so3.multiply(so3.exponential(turn), X.wxyz))


def _covariance(position_sigma: float, orientation_sigma: float) -> tuple[float, ...]:
    """Return the row-major covariance (6, 6) of isotropic position and orientation errors."""
    sigmas = (max(position_sigma, _MIN_SIGMA),) * 3 + (max(orientation_sigma, _MIN_SIGMA),) * 3
    return tuple(sigmas[i] ** 2 if i == j else 0.0 for i in range(6) for j in range(6))
