"""Batch queries: where a frame is in another at each of many instants, computed together in arrays.

The path is a list of `ChainLinkBatch`: a rigid link has one row for all instants, a joint or the vehicle one for each.
Covariances are computed in slices, so that the server can tick between them (`Steps`).

With a fixed frame (tf2's advanced `lookupTransform`), the pose of `interest` at each instant is given in `reference` at
another time, through a frame assumed not to move in between. Odom drifts but does not jump: its drift between the two
times is the difference of its covariances, far smaller than the world's, whose correlation between two times is
unknown; for the world |a + b|^2 <= 2 |a|^2 + 2 |b|^2 gives an upper bound, flagged CORRELATION_UNKNOWN.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import LimitError, NoPoseError, Status
from modelserver.geometry import names
from modelserver.geometry.joint import LIMIT_TOLERANCE, Joint, JointType
from modelserver.geometry.kinematic_path import KinematicPath, PathJoint
from modelserver.geometry.topology import EdgeKind
from modelserver.joints.track import MAX_GAP_S, ROTATION_VECTOR_TYPES, interpolate_batch
from modelserver.messages import MAX_REQUEST_INSTANTS, Estimate, Invalid, Origin, Policy, PoseBatch, Quality, TimeQuery
from modelserver.query.path import PathState, lookup_path
from modelserver.query.view import (
    ODOM_INVALID,
    WORLD_FRAMES,
    PlatformView,
    Steps,
    check_not_reserved,
    find_vehicle_pose,
)
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
    # nearly always identical, which is ten times cheaper to test
    return a is not b and a != b


# --- the query --------------------------------------------------------------------------------------------------------


def lookup_batch(
    view: PlatformView,
    interest: str,
    reference: str,
    utimes: Times,
    reference_at: int = 0,
    fixed: str = "",
    with_covariance: bool = True,
    now: int = 0,
) -> Steps[PoseBatch]:
    """Return the poses of `interest` in `reference` at each of `utimes`, interpolated.

    With `fixed`, those at `utimes` in the reference at `reference_at` (0: the latest), through a frame assumed not to
    move in between; see the module. World poses before and after a position reset are not comparable. An instant
    outside the history has a status that states it, and nan for a pose.

    Raises
    ------
    QueryError
        Where no instant can have an answer.
    LimitError
        For too many instants.
    """
    count = len(utimes)
    if count > MAX_REQUEST_INSTANTS:
        raise LimitError(
            f"{count} instants were requested; at most {MAX_REQUEST_INSTANTS} are allowed. Split the request."
        )
    utimes = np.asarray(utimes, dtype=np.int64)
    none = np.zeros(count, dtype=np.int32)
    rows = BatchState(utimes, none, none, none, none, with_covariance)
    if fixed:
        there = lookup_path(view, fixed, reference, TimeQuery(reference_at, Policy.INTERPOLATED), now)
        links, rows = yield from _find_links(view, interest, fixed, rows)
        if view.localizer is not None and len(view.history):
            yield from view.history.resolve(rows.clip_times(view.history.first, view.history.last).utimes)
        links, rows = _join_at_fixed_frame(view, there, links, rows, fixed)
    else:
        links, rows = yield from _find_links(view, interest, reference, rows)
        if any(link.source[0] is EdgeKind.VEHICLE for link in links):
            # a mount without sigmas counts as exact here: the vehicle's own error is far larger
            links = [
                link._replace(factor=_EXACT) if link.factor is None and link.source[0] in _RIGID else link
                for link in links
            ]
        links = _fold_fixed_links(links)
    yield
    if fixed or any(link.source[0] in (EdgeKind.VEHICLE, EdgeKind.JOINT) for link in links):
        reasons = view.invalid & Invalid.CLOCK_STEPPED if fixed else view.invalid
        rows = rows.add_flags(int(reasons), 0)
    frame_poses = chain.frame_pose_batch(links)
    yield
    poses = frame_poses[-1].canonical()
    origin = None
    if {interest, reference, fixed} & {names.WORLD_UTM, names.WORLD_ENU} and len(view.history):
        origin, rows = _find_origin(view, rows)
    good = (rows.status == Status.OK)[:, None]
    # expand single rows
    whole = np.hstack((np.broadcast_to(poses.p, (count, 3)), np.broadcast_to(poses.q, (count, 4))))
    vectors = np.where(good, whole, math.nan)
    yield
    covariances = (yield from _covariance_batch(links, count, frame_poses)) if with_covariance else None
    if covariances is not None:
        covariances = np.where(good, covariances.reshape(count, 36), math.nan)
    return PoseBatch(
        interest,
        reference,
        utimes,
        vectors,
        rows.status,
        rows.invalid,
        rows.quality,
        rows.epochs,
        covariances,
        origin,
        view.model.revision,
    )


def _covariance_batch(links: list[ChainLinkBatch], count: int, frame_poses: list[PoseArray]) -> Steps[Array | None]:
    """Return `chain.covariance_batch`, some rows in each step."""
    vary = any(len(place.p) > 1 or len(place.q) > 1 for place in frame_poses) or any(
        link.factor is not None and link.factor.ndim == 3 for link in links
    )
    if count <= ROWS_PER_STEP or not vary:
        return chain.covariance_batch(links, count, frame_poses)
    parts = []
    for start in range(0, count, ROWS_PER_STEP):
        some = slice(start, min(start + ROWS_PER_STEP, count))
        of_links = []
        for link in links:
            factor = link.factor
            if factor is not None and factor.ndim == 3 and len(factor) > 1:
                factor = factor[some]
            of_links.append(link._replace(X_FT=_slice_poses(link.X_FT, some), factor=factor))
        part = chain.covariance_batch(of_links, some.stop - start, [_slice_poses(place, some) for place in frame_poses])
        if part is None:
            return None
        parts.append(part)
        yield
    return np.concatenate(parts)


def _slice_poses(poses: PoseArray, some: slice) -> PoseArray:
    """Return some rows of poses; a single row for all unchanged."""
    return PoseArray(poses.p[some] if len(poses.p) > 1 else poses.p, poses.q[some] if len(poses.q) > 1 else poses.q)


def _find_links(
    view: PlatformView, interest: str, reference: str, rows: BatchState
) -> Steps[tuple[list[ChainLinkBatch], BatchState]]:
    """Return the links from one frame to another at every instant."""
    of_world = [frame for frame in (interest, reference) if frame in WORLD_FRAMES]
    if interest == reference and of_world:
        return [], rows
    if not of_world:
        for frame in (interest, reference):
            check_not_reserved(frame)
        return (yield from _path_links(view, view.model.get_kinematic_path(interest, reference), rows))
    forth: list[ChainLinkBatch] = []
    if reference in WORLD_FRAMES:
        link, rows = yield from lookup_vehicle_batch(view, reference, rows)
        forth = [link]
    if interest in WORLD_FRAMES:
        back, rows = yield from lookup_vehicle_batch(view, interest, rows)
        if forth:
            # the correlation of the vehicle's two poses is unknown
            forth, back = [forth[0]._replace(factor=None)], back._replace(factor=None)
        else:
            on_vehicle, rows = yield from _path_links(view, view.get_path_from_vehicle(reference), rows)
            forth = [link._replace(forward=not link.forward) for link in reversed(on_vehicle)]
        return [*forth, back._replace(forward=False)], rows
    on_vehicle, rows = yield from _path_links(view, view.get_path_from_vehicle(interest), rows)
    return [*forth, *on_vehicle], rows


def _path_links(
    view: PlatformView, path: KinematicPath, rows: BatchState
) -> Steps[tuple[list[ChainLinkBatch], BatchState]]:
    if path.is_in_loop:
        rows = rows.add_flags(0, int(Quality.LOOP))
    positions = path.default_positions
    fixed = path.build_links(positions, [(math.nan,) * item.joint.count for item in path.joints])

    links: list[ChainLinkBatch] = []
    joints = iter(path.joints)
    for edge, link in zip(path.edges, fixed, strict=True):
        if edge.joint is None:
            links.append(ChainLinkBatch(PoseArray.of(link.X_FT), link.forward, link.factor, link.source))
        else:
            moving, rows = lookup_joint_batch(view, next(joints), rows)
            links.append(moving)
            yield
    return links, rows


def _join_at_fixed_frame(
    view: PlatformView, there: PathState, links: list[ChainLinkBatch], rows: BatchState, fixed: str
) -> tuple[list[ChainLinkBatch], BatchState]:
    """Return the links behind those of the reference's time, with the vehicle's links combined at the fixed frame."""
    before = [ChainLinkBatch(PoseArray.of(link.X_FT), *link[1:]) for link in there.links]
    rows = rows.add_flags(int(there.invalid), int(there.quality))
    of_vehicle = any(link.source[0] is EdgeKind.VEHICLE for link in links)
    epochs = [step.estimate.pose_epoch for step in there.steps if step.estimate is not None]
    if epochs and not of_vehicle:
        rows = replace(rows, epochs=np.full_like(rows.epochs, epochs[0]))
    last = there.steps[-1] if there.steps else None
    if last is None or last.estimate is None or not links or links[0].source[0] is not EdgeKind.VEHICLE:
        return [*before, *links], rows
    if fixed == names.ODOM:
        motion = ChainLinkBatch(
            before[-1].X_FT.inverse() @ links[0].X_FT,
            True,
            odom_drift_factors(view, last.estimate, rows) if rows.with_covariance else None,
            (EdgeKind.VEHICLE, "drift"),
            is_large_angle=True,
        )
        return [*before[:-1], motion, *links[1:]], rows
    apart = rows.utimes != last.estimate.utime
    other = apart & (rows.epochs != last.estimate.pose_epoch) & (rows.status == Status.OK)
    rows = replace(rows, status=np.where(other, int(Status.NO_POSE), rows.status).astype(np.int32))
    # |a + b|^2 <= 2 |a|^2 + 2 |b|^2, whatever the correlation of the two times; at one time the errors cancel
    twice = np.where(apart, math.sqrt(2.0), 0.0)[:, None, None]
    doubled = [
        each._replace(factor=None if each.factor is None else each.factor * twice, source=(*each.source, side))
        for side, each in enumerate((before[-1], links[0]))
    ]
    factors = np.where(apart, int(Quality.CORRELATION_UNKNOWN), 0).astype(np.int32)
    return [*before[:-1], *doubled, *links[1:]], rows.add_flags(0, factors)


def _find_origin(view: PlatformView, rows: BatchState) -> tuple[Origin | None, BatchState]:
    """Return the origin of the newest row that has a pose, and the rows without those of another origin."""
    good = np.flatnonzero(rows.status == Status.OK)
    if not len(good):
        return view.history.newest.origin, rows
    history = view.history
    held, before = rows.brackets or history.bracket(np.clip(rows.utimes, history.first, history.last))
    newest = held[before[good[np.argmax(rows.utimes[good])]]].origin
    of_others = np.array([is_different_origin(each.origin, newest) for each in held])[before] & (
        rows.status == Status.OK
    )
    return newest, replace(rows, status=np.where(of_others, int(Status.NO_POSE), rows.status).astype(np.int32))


_EXACT = np.zeros((6, 1))
_RIGID = (EdgeKind.FRAME, EdgeKind.CONSTRAINT)


def _fold_fixed_links(links: list[ChainLinkBatch]) -> list[ChainLinkBatch]:
    """Return the links with adjacent rigid links composed into one.

    Not across a fixed frame: there a survey may occur twice, with the same error.
    """
    folded: list[ChainLinkBatch] = []
    for link in links:
        pair = [*folded[-1:], link]
        if len(pair) == 2 and all(each.factor is not None and each.source[0] in _RIGID for each in pair):
            covariances = chain.covariance_batch(pair, 1)
            assert covariances is not None
            folded[-1] = ChainLinkBatch(chain.compose_batch(pair), True, chain.factor(covariances[0]), link.source)
        else:
            folded.append(link)
    return folded
