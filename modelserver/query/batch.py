"""Batch queries: where a frame is in another at each of many instants, computed together in arrays.

The path is a list of `ChainLinkBatch`: a rigid link has one row for all instants, a joint or the vehicle one for each.
Covariances are computed in slices, so that the server can tick between them (`steps`).

With a fixed frame (tf2's advanced `lookupTransform`), the pose of `interest` at each instant is given in `reference` at
another time, through a frame assumed not to move in between. Odom drifts but does not jump: its drift between the two
times is the difference of its covariances, far smaller than the world's, whose correlation between two times is
unknown; for the world |a + b|^2 <= 2 |a|^2 + 2 |b|^2 gives an upper bound, flagged CORRELATION_UNKNOWN.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from modelserver.errors import LimitError, Status
from modelserver.geometry import names
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.topology import EdgeKind
from modelserver.messages import MAX_REQUEST_INSTANTS, Invalid, Origin, Policy, PoseBatch, Quality, TimeQuery
from modelserver.query.batch_links import (
    ROWS_PER_STEP,
    BatchState,
    Times,
    is_different_origin,
    lookup_joint_batch,
    lookup_vehicle_batch,
    odom_drift_factors,
)
from modelserver.query.path import PathState, lookup_path
from modelserver.query.steps import Steps
from modelserver.query.view import WORLD_FRAMES, PlatformView, check_not_reserved
from modelserver.transforms import chain
from modelserver.transforms.chain import ChainLinkBatch
from modelserver.transforms.pose_array import PoseArray
from modelserver.transforms.so3 import Array


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
