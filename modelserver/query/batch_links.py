"""The links of a batch query: joints and the vehicle at many instants, and the drift of Odom between two times."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import NoPoseError, Status
from modelserver.geometry import names
from modelserver.geometry.joint import LIMIT_TOLERANCE, Joint, JointType
from modelserver.geometry.kinematic_path import PathJoint
from modelserver.geometry.topology import EdgeKind
from modelserver.joints.track import MAX_GAP_S, ROTATION_VECTOR_TYPES, interpolate_batch
from modelserver.messages import Estimate, Invalid, Origin, Quality
from modelserver.query.steps import Steps
from modelserver.query.view import ODOM_INVALID, PlatformView, find_vehicle_pose
from modelserver.transforms import chain, pose_array
from modelserver.transforms.chain import ChainLinkBatch
from modelserver.transforms.pose_array import PoseArray
from modelserver.transforms.so3 import Array

Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.int32]

ROWS_PER_STEP: Final = 250
"""Rows of covariances that are computed in one step."""


@dataclass(frozen=True, slots=True)
class BatchState:
    """The instants, and status, reasons, quality flags and pose epoch of each: arrays of n.

    with_covariance: whether covariances are queried. brackets: the vehicle's estimates around the instants, from
    `History.bracket`, once they were looked up.
    """

    utimes: Times
    status: Flags
    invalid: Flags
    quality: Flags
    epochs: Flags
    with_covariance: bool = True
    brackets: tuple[list[Estimate], npt.NDArray[np.intp]] | None = None

    def clip_times(self, first: int, last: int) -> BatchState:
        """Return the state with the instants outside a span marked, and their times moved to its edge."""
        old, new = self.utimes < first, self.utimes > last
        if not (old.any() or new.any()):
            return self
        status = np.where(self.status != Status.OK, self.status, np.where(old, int(Status.TOO_OLD), 0))
        status = np.where((status == Status.OK) & new, int(Status.TOO_NEW), status)
        return replace(self, utimes=np.clip(self.utimes, first, last), status=status.astype(np.int32))

    def add_flags(self, invalid: Flags | int, quality: Flags | int) -> BatchState:
        return replace(self, invalid=self.invalid | invalid, quality=self.quality | quality)


def lookup_joint_batch(view: PlatformView, item: PathJoint, rows: BatchState) -> tuple[ChainLinkBatch, BatchState]:
    """Return the displacement of a joint at every instant."""
    model, joint = view.model, item.joint
    drive = model.drives[item.name]
    count = len(rows.utimes)
    tracks = [view.joints.tracks.get(name) for name in drive.names]
    for track in tracks:
        if track is not None:
            rows = rows.clip_times(track.first, track.last)
    leader = model.joints[drive.leader].joint
    positions, sigmas = np.empty((count, len(tracks))), np.empty((count, len(tracks)))
    vector = None
    if joint.type in ROTATION_VECTOR_TYPES:
        x, y, z = tracks[-3:]
        if x is not None and y is not None and z is not None:
            vector = interpolate_batch((x, y, z), rows.utimes)
    for number, track in enumerate(tracks):
        if track is None:
            positions[:, number] = leader.default_position[number]
            sigmas[:, number] = leader.sigma[number] if leader.sigma else math.nan
            rows = rows.add_flags(0 if leader.default else int(Invalid.JOINT_UNKNOWN), int(Quality.JOINT_DEFAULT))
            continue
        if vector is not None and number >= len(tracks) - 3:
            positions[:, number], sigmas[:, number], apart = (each[:, number - len(tracks)] for each in vector)
        else:
            positions[:, number], sigmas[:, number], apart = track.interpolate_batch(rows.utimes)
        stale = np.where(apart > MAX_GAP_S, int(Invalid.STALE_JOINT), 0).astype(np.int32)
        rows = rows.add_flags(stale, np.where(apart > 0.0, int(Quality.INTERPOLATED), 0).astype(np.int32))
    positions = drive.multiplier * positions + drive.offset
    # with the multiplier's sign: a mimic joint has its leader's error
    sigmas = drive.multiplier * sigmas
    beyond = np.zeros(count, dtype=bool)
    if joint.lower:
        beyond |= (positions < np.array(joint.lower) - LIMIT_TOLERANCE).any(axis=1)
    if joint.upper:
        beyond |= (positions > np.array(joint.upper) + LIMIT_TOLERANCE).any(axis=1)
    rows = rows.add_flags(0, np.where(beyond, int(Quality.OUT_OF_LIMITS), 0).astype(np.int32))
    axis = np.array(joint.axis)
    if joint.type is JointType.REVOLUTE:
        moved = PoseArray(np.zeros((1, 3)), pose_array.from_axis_angle(axis, positions[:, 0]))
    elif joint.type is JointType.PRISMATIC:
        moved = PoseArray(positions * axis, np.array([[1.0, 0.0, 0.0, 0.0]]))
    else:
        moved = _joint_poses(joint, positions)
    factor = None
    if not np.isnan(sigmas).all():
        factor = _jacobians(joint, positions) * sigmas[:, None, :]
    return ChainLinkBatch(moved, item.forward, factor, (EdgeKind.JOINT, drive.leader, "rows")), rows


def _joint_poses(joint: Joint, positions: Array) -> PoseArray:
    """Return `Joint.compute_pose` for each row, of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        x, y = joint.jacobian((0.0, 0.0, 0.0))[:3, :2].T
        return PoseArray(
            positions[:, :1] * x + positions[:, 1:2] * y,
            pose_array.from_axis_angle(np.array(joint.axis), positions[:, 2]),
        )
    turned = pose_array.exponential(positions[:, -3:])
    return PoseArray(positions[:, :3] if joint.type is JointType.FLOATING else np.zeros((1, 3)), turned)


def _jacobians(joint: Joint, positions: Array) -> Array:
    """Return `Joint.jacobian` for each row; a single row where it is the same in all."""
    if joint.type not in (JointType.SPHERICAL, JointType.FLOATING):
        return joint.jacobian((0.0,) * joint.count)[None]
    J = np.zeros((len(positions), 6, joint.count))
    J[:, 3:, -3:] = pose_array.left_jacobian(positions[:, -3:])
    if joint.type is JointType.FLOATING:
        J[:, :3, :3] = np.eye(3)
    return J


TILT_TIME_S: Final = 1.0
"""Time over which the tilt of a pose in Odom may change by its own uncertainty."""

_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_ZERO_COVARIANCE = (0.0,) * 36


def lookup_vehicle_batch(view: PlatformView, world: str, rows: BatchState) -> Steps[tuple[ChainLinkBatch, BatchState]]:
    """Return, in steps, the vehicle's poses in a world at every instant. Raises NoPoseError where there is none."""
    history = view.history
    if view.localizer is None or not len(history):
        raise view.no_pose_error()
    rows = rows.clip_times(history.first, history.last)
    yield from history.resolve(rows.utimes)
    held, before = history.bracket(rows.utimes)
    yield
    found = [find_vehicle_pose(world, each) for each in held]
    known = np.array([pose is not None for pose in found])
    if not known.any():
        raise NoPoseError(f"the vehicle's pose in {world} was not known then: {held[0].invalid.explain()}")
    flat_poses = itertools.chain.from_iterable([_IDENTITY if pose is None else pose.xyz + pose.wxyz for pose in found])
    vectors = np.fromiter(flat_poses, float, 7 * len(found)).reshape(-1, 7)
    p, q = vectors[:, :3], vectors[:, 3:]
    yield
    times = np.array([each.utime for each in held])
    epochs = np.array([each.pose_epoch for each in held], dtype=np.int32)
    after = np.minimum(before + 1, len(held) - 1)
    apart = np.maximum(times[after] - times[before], 1)
    fraction = (rows.utimes - times[before]) / apart
    jump = _find_epoch_jumps(held)[before]
    exact = fraction == 0.0
    fraction = np.where(jump, 0.0, fraction)
    end = np.where(exact | jump, before, after)
    poses = PoseArray(
        p[before] + (p[after] - p[before]) * fraction[:, None], pose_array.slerp(q[before], q[after], fraction)
    )
    yield
    keep = int(ODOM_INVALID) if world == names.ODOM else -1
    invalid = np.array([int(each.invalid) for each in held], dtype=np.int32) & keep
    quality = np.array([int(each.quality) for each in held], dtype=np.int32)
    between = np.where(exact, 0, np.where(jump, int(Quality.HELD), int(Quality.INTERPOLATED))).astype(np.int32)
    status = np.where((known[before] & known[end]) | (rows.status != 0), rows.status, int(Status.NO_POSE))
    rows = replace(rows, status=status.astype(np.int32), epochs=epochs[end], brackets=(held, before))
    rows = rows.add_flags(invalid[before] | invalid[end], quality[before] | quality[end] | between)
    yield
    factor = (yield from _vehicle_factor(world, held, end)) if rows.with_covariance else None
    return ChainLinkBatch(poses, True, factor, (EdgeKind.VEHICLE, world), is_large_angle=True), rows


def _vehicle_factor(world: str, held: list[Estimate], which: npt.NDArray[np.intp]) -> Steps[Array | None]:
    """Return factors (n, 6, 6) of the covariances of the estimates of `held` with indices `which` (n,)."""
    used, row = np.unique(which, return_inverse=True)
    of_use = [held[index] for index in used.tolist()]
    numbers = [each.odom_covariance if world == names.ODOM else each.covariance for each in of_use]
    is_unknown = np.array([each is None for each in numbers])
    if is_unknown.all():
        return None
    stacks = []
    for start in range(0, len(numbers), ROWS_PER_STEP):
        fraction = [_ZERO_COVARIANCE if each is None else each for each in numbers[start : start + ROWS_PER_STEP]]
        flat = np.fromiter(itertools.chain.from_iterable(fraction), float, 36 * len(fraction))
        stacks.append(chain.factor(flat.reshape(-1, 6, 6)))
        yield
    factors = np.concatenate(stacks)
    factors[is_unknown] = math.nan
    return np.asarray(factors[row])


def _find_epoch_jumps(held: list[Estimate]) -> npt.NDArray[np.bool_]:
    """Return for each estimate whether the next is of another epoch: then it is held in between, as in `History`."""
    return np.array(
        [a.pose_epoch != b.pose_epoch or is_different_origin(a.origin, b.origin) for a, b in pairwise(held)] + [False]
    )


def odom_drift_factors(view: PlatformView, since: Estimate, rows: BatchState) -> Array | None:
    """Return the factors (n, 6, 6) of the drift of Odom from an estimate to every instant.

    They are along the vehicle's axes at the estimate. A drift proportional to time grows by the difference of its
    sigmas, a random walk by that of its variances. Tilt is bounded: it does not drift.
    """
    held, before = view.history.bracket(rows.utimes)
    times = np.array([each.utime for each in held])
    of_one = (times[before] == rows.utimes) | _find_epoch_jumps(held)[before]
    after = np.where(of_one, before, np.minimum(before + 1, len(held) - 1))
    if since.odom_covariance is None or any(each.odom_covariance is None for each in held):
        return None
    first = np.array(since.odom_covariance)[::7]
    # the diagonals alone, for speed
    then = np.array([each.odom_covariance[::7] for each in held if each.odom_covariance is not None])[after]
    if since.is_odom_random_walk or held[-1].is_odom_random_walk:
        sigma = np.sqrt(np.abs(then - first))
    else:
        sigma = np.abs(np.sqrt(then) - np.sqrt(first))
    apart = np.abs(rows.utimes - since.utime) * 1e-6
    tilt = np.sqrt(np.maximum(first[3:5], then[:, 3:5]))
    sigma[:, 3:5] = tilt * np.minimum(math.sqrt(2.0), apart / TILT_TIME_S)[:, None]
    turn = np.kron(np.eye(2), pose_array.to_matrices(np.array([since.odom.inverse().wxyz]))[0])
    return np.asarray(turn[None] * sigma[:, None, :])


def is_different_origin(a: Origin | None, b: Origin | None) -> bool:
    """Return whether two origins differ."""
    # nearly always identical, which is ten times cheaper to test
    return a is not b and a != b
