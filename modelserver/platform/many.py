"""Many instants in one question: where a frame is in another at each of them, worked out together."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from modelserver.errors import LimitError, NoPoseError, Status
from modelserver.geometry import names
from modelserver.geometry.joint import ROUNDING, Joint, JointType
from modelserver.geometry.route import EdgeKind, Leg, Route
from modelserver.joint_vector import VECTORS
from modelserver.joint_vector import columns as vector_columns
from modelserver.joints import LONGEST_GAP_S
from modelserver.messages import MOST_INSTANTS, Estimate, Invalid, ManyPoses, Origin, Policy, Quality, TimeQuery
from modelserver.platform.between import TILT_TIME_S
from modelserver.platform.path import Step, Way, way
from modelserver.platform.view import ODOM_INVALID, PlatformView
from modelserver.platform.worlds import WORLD_FRAMES, check_not_reserved, known_in
from modelserver.spatial import arrays, chain, chains
from modelserver.spatial.arrays import Poses
from modelserver.spatial.chains import Links
from modelserver.spatial.so3 import Array

Times = npt.NDArray[np.int64]
Flags = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class _Rows:
    """The instants, and what is found of each on the way: status, reasons, flags, pose epoch; arrays of n."""

    utimes: Times
    status: Flags
    invalid: Flags
    quality: Flags
    epochs: Flags

    def within(self, first: int, last: int) -> _Rows:
        """Return the rows with those marked that lie outside a span, their times moved to its edge."""
        old, new = self.utimes < first, self.utimes > last
        if not (old.any() or new.any()):
            return self
        status = np.where(self.status != Status.OK, self.status, np.where(old, int(Status.TOO_OLD), 0))
        status = np.where((status == Status.OK) & new, int(Status.TOO_NEW), status)
        return replace(self, utimes=np.clip(self.utimes, first, last), status=status.astype(np.int32))

    def told(self, invalid: Flags | int, quality: Flags | int) -> _Rows:
        """Return the rows with more reasons and flags."""
        return replace(self, invalid=self.invalid | invalid, quality=self.quality | quality)


def many(
    view: PlatformView,
    interest: str,
    reference: str,
    utimes: Times,
    reference_at: int = 0,
    fixed: str = "",
    with_covariance: bool = True,
    now: int = 0,
) -> ManyPoses:
    """Return the poses of `interest` in `reference` at each of `utimes`, interpolated.

    With `fixed`, those at `utimes` in the reference at `reference_at` (0: the latest), as `between`. An instant that is
    not held has a status that says so, and nan for a pose. Raises QueryError where no instant could have an answer,
    LimitError for too many.
    """
    count = len(utimes)
    if count > MOST_INSTANTS:
        raise LimitError(f"{count} instants were asked for; at most {MOST_INSTANTS} go in one question. Ask in parts.")
    utimes = np.asarray(utimes, dtype=np.int64)
    none = np.zeros(count, dtype=np.int32)
    rows = _Rows(utimes, none, none, none, none)
    if fixed:
        there = way(view, fixed, reference, TimeQuery(reference_at, Policy.INTERPOLATED), now)
        links, rows = _links(view, interest, fixed, rows)
        links, rows = _met(view, there, links, rows, fixed)
    else:
        links, rows = _links(view, interest, reference, rows)
        if any(link.source[0] is EdgeKind.VEHICLE for link in links):
            # a mount without stated sigmas counts as exact here: the vehicle's own error is far larger
            links = [link._replace(factor=_EXACT) if _is_unstated(link) else link for link in links]
        links = _folded(links)
    if fixed or any(link.source[0] in (EdgeKind.VEHICLE, EdgeKind.JOINT) for link in links):
        doubt = view.doubt & Invalid.CLOCK_STEPPED if fixed else view.doubt
        rows = rows.told(int(doubt), 0)
    poses = chains.product(links)
    origin = None
    if {interest, reference, fixed} & {names.WORLD_UTM, names.WORLD_ENU} and len(view.history):
        origin, rows = _origin(view, rows)
    good = (rows.status == Status.OK)[:, None]
    # each is one row where it is the same in all
    whole = np.hstack((np.broadcast_to(poses.p, (count, 3)), np.broadcast_to(poses.q, (count, 4))))
    vectors = np.where(good, whole, math.nan)
    covariances = chains.covariances(links, count) if with_covariance else None
    if covariances is not None:
        covariances = np.where(good, covariances.reshape(count, 36), math.nan)
    return ManyPoses(
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


def _links(view: PlatformView, interest: str, reference: str, rows: _Rows) -> tuple[list[Links], _Rows]:
    """Return the links from one frame to another at every row's time."""
    of_world = [frame for frame in (interest, reference) if frame in WORLD_FRAMES]
    if interest == reference and of_world:
        return [], rows
    if not of_world:
        for frame in (interest, reference):
            check_not_reserved(frame)
        return _route(view, view.model.route(interest, reference), rows)
    forth: list[Links] = []
    if reference in WORLD_FRAMES:
        link, rows = _vehicle(view, reference, rows)
        forth = [link]
    if interest in WORLD_FRAMES:
        back, rows = _vehicle(view, interest, rows)
        if forth:
            # how the errors of the vehicle's two poses hang together nobody knows
            forth, back = [forth[0]._replace(factor=None)], back._replace(factor=None)
        else:
            check_not_reserved(reference)
            view.check_carried(reference)
            mounted, rows = _route(view, view.route_from_vehicle(reference), rows)
            forth = [link._replace(forward=not link.forward) for link in reversed(mounted)]
        return [*forth, back._replace(forward=False)], rows
    check_not_reserved(interest)
    view.check_carried(interest)
    mounted, rows = _route(view, view.route_from_vehicle(interest), rows)
    return [*forth, *mounted], rows


def _vehicle(view: PlatformView, world: str, rows: _Rows) -> tuple[Links, _Rows]:
    history = view.history
    if view.localizer is None or not len(history):
        raise view.no_pose()
    rows = rows.within(history.first, history.last)
    held, before = history.around(rows.utimes)
    known = np.array([known_in(world, each) is not None for each in held])
    if not known.any():
        raise NoPoseError(f"the vehicle's pose in {world} was not known then: {held[0].invalid.explain()}")
    found = [known_in(world, each) for each in held]
    p = np.array([(0.0, 0.0, 0.0) if pose is None else pose.xyz for pose in found])
    q = np.array([(1.0, 0.0, 0.0, 0.0) if pose is None else pose.wxyz for pose in found])
    times = np.array([each.utime for each in held])
    epochs = np.array([each.pose_epoch for each in held], dtype=np.int32)
    after = np.minimum(before + 1, len(held) - 1)
    apart = np.maximum(times[after] - times[before], 1)
    part = (rows.utimes - times[before]) / apart
    jump = _jumps(held)[before]
    exact = part == 0.0
    part = np.where(jump, 0.0, part)
    end = np.where(exact | jump, before, after)
    poses = Poses(p[before] + (p[after] - p[before]) * part[:, None], arrays.slerped(q[before], q[after], part))
    keep = int(ODOM_INVALID) if world == names.ODOM else -1
    invalid = np.array([int(each.invalid) for each in held], dtype=np.int32) & keep
    quality = np.array([int(each.quality) for each in held], dtype=np.int32)
    between = np.where(exact, 0, np.where(jump, int(Quality.HELD), int(Quality.INTERPOLATED))).astype(np.int32)
    status = np.where((known[before] & known[end]) | (rows.status != 0), rows.status, int(Status.NO_POSE))
    rows = replace(rows, status=status.astype(np.int32), epochs=epochs[end])
    rows = rows.told(invalid[before] | invalid[end], quality[before] | quality[end] | between)
    numbers = [each.odom_covariance if world == names.ODOM else each.covariance for each in held]
    unsure = np.array([each is None for each in numbers])
    factor = None
    if not unsure.all():
        some = itertools.chain.from_iterable(_NOTHING if each is None else each for each in numbers)
        factors = _factors(np.fromiter(some, float, 36 * len(numbers)).reshape(-1, 6, 6))
        factors[unsure] = math.nan
        factor = factors[end]
    return Links(poses, True, factor, (EdgeKind.VEHICLE, world), bends=True), rows


def _jumps(held: list[Estimate]) -> npt.NDArray[np.bool_]:
    """Return for each estimate whether the next is of another epoch: then what lies between is held, as in `History`.

    What lies between two epochs was nobody's pose.
    """
    return np.array([a.pose_epoch != b.pose_epoch or _differ(a.origin, b.origin) for a, b in pairwise(held)] + [False])


def _factors(stack: Array) -> Array:
    """Return factors (m, 6, 6) of covariances, which need not have full rank."""
    try:
        return np.asarray(np.linalg.cholesky(stack))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(stack)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _route(view: PlatformView, route: Route, rows: _Rows) -> tuple[list[Links], _Rows]:
    if route.closes_loop:
        rows = rows.told(0, int(Quality.LOOP))
    rest = route.rest
    fixed = route.links(rest, [(math.nan,) * leg.joint.count for leg in route.legs])
    # beside the vehicle's own doubt a mount without stated sigmas counts as exact
    links: list[Links] = []
    legs = iter(route.legs)
    for edge, link in zip(route.edges, fixed, strict=True):
        if edge.joint is None:
            links.append(Links(Poses.of(link.X_FT), link.forward, link.factor, link.source))
        else:
            moving, rows = _joint(view, next(legs), rows)
            links.append(moving)
    return links, rows


def _joint(view: PlatformView, leg: Leg, rows: _Rows) -> tuple[Links, _Rows]:
    """Return how far a joint has moved at every row's time."""
    model, joint = view.model, leg.joint
    drive = model.drives[leg.name]
    count = len(rows.utimes)
    tracks = [view.joints.tracks.get(name) for name in drive.names]
    for track in tracks:
        if track is not None:
            rows = rows.within(track.first, track.last)
    rest = model.joints[drive.leader].joint
    positions, sigmas = np.empty((count, len(tracks))), np.empty((count, len(tracks)))
    vector = None
    if joint.type in VECTORS:
        x, y, z = tracks[-3:]
        if x is not None and y is not None and z is not None:
            vector = vector_columns((x, y, z), rows.utimes)
    for number, track in enumerate(tracks):
        if track is None:
            positions[:, number] = rest.rest[number]
            sigmas[:, number] = rest.sigma[number] if rest.sigma else math.nan
            rows = rows.told(0 if rest.default else int(Invalid.JOINT_UNKNOWN), int(Quality.AT_REST))
            continue
        if vector is not None and number >= len(tracks) - 3:
            positions[:, number], sigmas[:, number], apart = (each[:, number - len(tracks)] for each in vector)
        else:
            positions[:, number], sigmas[:, number], apart = track.columns(rows.utimes)
        stale = np.where(apart > LONGEST_GAP_S, int(Invalid.STALE_JOINT), 0).astype(np.int32)
        rows = rows.told(stale, np.where(apart > 0.0, int(Quality.INTERPOLATED), 0).astype(np.int32))
    positions = drive.multiplier * positions + drive.offset
    # with the multiplier's sign: what follows errs with its leader
    sigmas = drive.multiplier * sigmas
    beyond = np.zeros(count, dtype=bool)
    if joint.lower:
        beyond |= (positions < np.array(joint.lower) - ROUNDING).any(axis=1)
    if joint.upper:
        beyond |= (positions > np.array(joint.upper) + ROUNDING).any(axis=1)
    rows = rows.told(0, np.where(beyond, int(Quality.OUT_OF_LIMITS), 0).astype(np.int32))
    axis = np.array(joint.axis)
    if joint.type is JointType.REVOLUTE:
        moved = Poses(np.zeros((1, 3)), arrays.about(axis, positions[:, 0]))
    elif joint.type is JointType.PRISMATIC:
        moved = Poses(positions * axis, np.array([[1.0, 0.0, 0.0, 0.0]]))
    else:
        moved = _moved(joint, positions)
    factor = None
    if not np.isnan(sigmas).all():
        factor = _jacobians(joint, positions) * sigmas[:, None, :]
    return Links(moved, leg.forward, factor, (EdgeKind.JOINT, drive.leader, "rows")), rows


def _moved(joint: Joint, positions: Array) -> Poses:
    """Return `Joint.motion` row by row, of a joint with several coordinates."""
    if joint.type is JointType.PLANAR:
        x, y = joint.jacobian((0.0, 0.0, 0.0))[:3, :2].T
        return Poses(positions[:, :1] * x + positions[:, 1:2] * y, arrays.about(np.array(joint.axis), positions[:, 2]))
    turned = arrays.exponentials(positions[:, -3:])
    return Poses(positions[:, :3] if joint.type is JointType.FLOATING else np.zeros((1, 3)), turned)


def _jacobians(joint: Joint, positions: Array) -> Array:
    """Return `Joint.jacobian` row by row; in one row where it is the same in all."""
    if joint.type not in (JointType.SPHERICAL, JointType.FLOATING):
        return joint.jacobian((0.0,) * joint.count)[None]
    J = np.zeros((len(positions), 6, joint.count))
    J[:, 3:, -3:] = arrays.left_jacobians(positions[:, -3:])
    if joint.type is JointType.FLOATING:
        J[:, :3, :3] = np.eye(3)
    return J


def _met(view: PlatformView, there: Way, links: list[Links], rows: _Rows, fixed: str) -> tuple[list[Links], _Rows]:
    """Return the links behind those of the reference's one time, the vehicle's put together where both meet."""
    before = [_constant(step) for step in there.steps]
    rows = rows.told(int(there.invalid), int(there.quality))
    of_vehicle = any(link.source[0] is EdgeKind.VEHICLE for link in links)
    epochs = [step.estimate.pose_epoch for step in there.steps if step.estimate is not None]
    if epochs and not of_vehicle:
        rows = replace(rows, epochs=np.full_like(rows.epochs, epochs[0]))
    last = there.steps[-1] if there.steps else None
    if last is None or last.estimate is None or not links or links[0].source[0] is not EdgeKind.VEHICLE:
        return [*before, *links], rows
    if fixed == names.ODOM:
        travelled = Links(
            before[-1].X_FT.inverse() @ links[0].X_FT,
            True,
            _drifts(view, last.estimate, rows),
            (EdgeKind.VEHICLE, "drift"),
            bends=True,
        )
        return [*before[:-1], travelled, *links[1:]], rows
    apart = rows.utimes != last.estimate.utime
    other = apart & (rows.epochs != last.estimate.pose_epoch) & (rows.status == Status.OK)
    rows = replace(rows, status=np.where(other, int(Status.NO_POSE), rows.status).astype(np.int32))
    # |a + b|^2 <= 2 |a|^2 + 2 |b|^2, however the errors at the two times hang together; at one time they cancel
    twice = np.where(apart, math.sqrt(2.0), 0.0)[:, None, None]
    doubled = [
        each._replace(factor=None if each.factor is None else each.factor * twice, source=(*each.source, side))
        for side, each in enumerate((before[-1], links[0]))
    ]
    unsure = np.where(apart, int(Quality.CORRELATION_UNKNOWN), 0).astype(np.int32)
    return [*before[:-1], *doubled, *links[1:]], rows.told(0, unsure)


def _origin(view: PlatformView, rows: _Rows) -> tuple[Origin | None, _Rows]:
    """Return the origin of the newest row that has a pose, and the rows without those whose origin is another one."""
    good = np.flatnonzero(rows.status == Status.OK)
    if not len(good):
        return view.history.newest.origin, rows
    held, before = view.history.around(np.clip(rows.utimes, view.history.first, view.history.last))
    newest = held[before[good[np.argmax(rows.utimes[good])]]].origin
    of_others = np.array([_differ(each.origin, newest) for each in held])[before] & (rows.status == Status.OK)
    return newest, replace(rows, status=np.where(of_others, int(Status.NO_POSE), rows.status).astype(np.int32))


def _differ(a: Origin | None, b: Origin | None) -> bool:
    # nearly always the very same, which is told at a tenth of the cost
    return a is not b and a != b


def _is_unstated(link: Links) -> bool:
    return link.factor is None and link.source[0] not in (EdgeKind.VEHICLE, EdgeKind.JOINT)


_EXACT = np.zeros((6, 1))
_NOTHING = (0.0,) * 36


def _folded(links: list[Links]) -> list[Links]:
    """Return the links with neighbours that are the same in all rows put together: what is bolted is one link.

    Not through a fixed frame: there a survey may come twice, and its error with it.
    """
    folded: list[Links] = []
    for link in links:
        pair = [*folded[-1:], link]
        if len(pair) == 2 and all(each.factor is not None and _is_fixed(each) for each in pair):
            covariances = chains.covariances(pair, 1)
            assert covariances is not None
            folded[-1] = Links(chains.product(pair), True, chain.factor(covariances[0]), link.source)
        else:
            folded.append(link)
    return folded


def _is_fixed(link: Links) -> bool:
    return link.source[0] in (EdgeKind.FRAME, EdgeKind.CONSTRAINT)


def _constant(step: Step) -> Links:
    return Links(Poses.of(step.X_FT), step.edge.forward, step.factor, step.source, step.link.bends)


def _drifts(view: PlatformView, since: Estimate, rows: _Rows) -> Array | None:
    """Return the factors (n, 6, 6) of what Odom drifts from an estimate to every row's time; as in `between`."""
    held, before = view.history.around(rows.utimes)
    times = np.array([each.utime for each in held])
    of_one = (times[before] == rows.utimes) | _jumps(held)[before]
    after = np.where(of_one, before, np.minimum(before + 1, len(held) - 1))
    if since.odom_covariance is None or any(each.odom_covariance is None for each in held):
        return None
    first = np.array(since.odom_covariance)[::7]
    then = np.array([each.odom_covariance for each in held])[:, ::7][after]
    if since.odom_walks or held[-1].odom_walks:
        sigma = np.sqrt(np.abs(then - first))
    else:
        sigma = np.abs(np.sqrt(then) - np.sqrt(first))
    apart = np.abs(rows.utimes - since.utime) * 1e-6
    tilt = np.sqrt(np.maximum(first[3:5], then[:, 3:5]))
    sigma[:, 3:5] = tilt * np.minimum(math.sqrt(2.0), apart / TILT_TIME_S)[:, None]
    turn = np.kron(np.eye(2), arrays.matrices(np.array([since.odom.inverse().wxyz]))[0])
    return np.asarray(turn[None] * sigma[:, None, :])
