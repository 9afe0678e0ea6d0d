"""Many instants in one question: where a frame is in another at each of them, worked out together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from modelserver.errors import LimitError, Status
from modelserver.geometry import names
from modelserver.geometry.edges import EdgeKind
from modelserver.geometry.route import Route
from modelserver.messages import MOST_INSTANTS, Invalid, ManyPoses, Origin, Policy, Quality, TimeQuery
from modelserver.platform.path import PathState, PathStep, way
from modelserver.platform.rows import STEP_ROWS, Rows, Times
from modelserver.platform.rows_joint import joint_moved
from modelserver.platform.rows_vehicle import differ, drifts, vehicle
from modelserver.platform.steps import Steps, complete
from modelserver.platform.view import PlatformView
from modelserver.platform.worlds import WORLD_FRAMES, check_not_reserved
from modelserver.spatial import chain, chains
from modelserver.spatial.arrays import Poses
from modelserver.spatial.chains import Links
from modelserver.spatial.so3 import Array


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
    """Return what `many_in_steps` does, at once."""
    return complete(many_in_steps(view, interest, reference, utimes, reference_at, fixed, with_covariance, now))


def many_in_steps(
    view: PlatformView,
    interest: str,
    reference: str,
    utimes: Times,
    reference_at: int = 0,
    fixed: str = "",
    with_covariance: bool = True,
    now: int = 0,
) -> Steps[ManyPoses]:
    """Return the poses of `interest` in `reference` at each of `utimes`, interpolated.

    With `fixed`, those at `utimes` in the reference at `reference_at` (0: the latest), through a frame that is taken to
    stand still between. Odom drifts and does not jump: between times near each other it is surer by far than the world,
    whose errors at two times hang together in a way that nobody knows; their covariance is then an upper bound, and
    flagged. A world pose that was taken up anew between the two times does not compare. An instant that is
    not held has a status that says so, and nan for a pose. Raises QueryError where no instant could have an answer,
    LimitError for too many.
    """
    count = len(utimes)
    if count > MOST_INSTANTS:
        raise LimitError(f"{count} instants were asked for; at most {MOST_INSTANTS} go in one question. Ask in parts.")
    utimes = np.asarray(utimes, dtype=np.int64)
    none = np.zeros(count, dtype=np.int32)
    rows = Rows(utimes, none, none, none, none, with_covariance)
    if fixed:
        there = way(view, fixed, reference, TimeQuery(reference_at, Policy.INTERPOLATED), now)
        links, rows = yield from _links(view, interest, fixed, rows)
        if view.localizer is not None and len(view.history):
            yield from view.history.resolve(rows.within(view.history.first, view.history.last).utimes)
        links, rows = _met(view, there, links, rows, fixed)
    else:
        links, rows = yield from _links(view, interest, reference, rows)
        if any(link.source[0] is EdgeKind.VEHICLE for link in links):
            # a mount without stated sigmas counts as exact here: the vehicle's own error is far larger
            links = [link._replace(factor=_EXACT) if _is_unstated(link) else link for link in links]
        links = _folded(links)
    yield
    if fixed or any(link.source[0] in (EdgeKind.VEHICLE, EdgeKind.JOINT) for link in links):
        doubt = view.doubt & Invalid.CLOCK_STEPPED if fixed else view.doubt
        rows = rows.told(int(doubt), 0)
    places = chains.places(links)
    yield
    poses = places[-1].canonical()
    origin = None
    if {interest, reference, fixed} & {names.WORLD_UTM, names.WORLD_ENU} and len(view.history):
        origin, rows = _origin(view, rows)
    good = (rows.status == Status.OK)[:, None]
    # each is one row where it is the same in all
    whole = np.hstack((np.broadcast_to(poses.p, (count, 3)), np.broadcast_to(poses.q, (count, 4))))
    vectors = np.where(good, whole, math.nan)
    yield
    covariances = (yield from _covariances(links, count, places)) if with_covariance else None
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


def _covariances(links: list[Links], count: int, places: list[Poses]) -> Steps[Array | None]:
    """Return `chains.covariances`, some rows in each step."""
    vary = any(len(place.p) > 1 or len(place.q) > 1 for place in places) or any(
        link.factor is not None and link.factor.ndim == 3 for link in links
    )
    if count <= STEP_ROWS or not vary:
        return chains.covariances(links, count, places)
    parts = []
    for start in range(0, count, STEP_ROWS):
        some = slice(start, min(start + STEP_ROWS, count))
        of_links = [
            link._replace(X_FT=_rows_of(link.X_FT, some), factor=_factor_of(link.factor, some)) for link in links
        ]
        part = chains.covariances(of_links, some.stop - start, [_rows_of(place, some) for place in places])
        if part is None:
            return None
        parts.append(part)
        yield
    return np.concatenate(parts)


def _rows_of(poses: Poses, some: slice) -> Poses:
    """Return some rows of poses; of what is the same in all rows, that."""
    return Poses(poses.p[some] if len(poses.p) > 1 else poses.p, poses.q[some] if len(poses.q) > 1 else poses.q)


def _factor_of(factor: Array | None, some: slice) -> Array | None:
    return factor[some] if factor is not None and factor.ndim == 3 and len(factor) > 1 else factor


def _links(view: PlatformView, interest: str, reference: str, rows: Rows) -> Steps[tuple[list[Links], Rows]]:
    """Return the links from one frame to another at every row's time."""
    of_world = [frame for frame in (interest, reference) if frame in WORLD_FRAMES]
    if interest == reference and of_world:
        return [], rows
    if not of_world:
        for frame in (interest, reference):
            check_not_reserved(frame)
        return (yield from _route(view, view.model.route(interest, reference), rows))
    forth: list[Links] = []
    if reference in WORLD_FRAMES:
        link, rows = yield from vehicle(view, reference, rows)
        forth = [link]
    if interest in WORLD_FRAMES:
        back, rows = yield from vehicle(view, interest, rows)
        if forth:
            # how the errors of the vehicle's two poses hang together nobody knows
            forth, back = [forth[0]._replace(factor=None)], back._replace(factor=None)
        else:
            check_not_reserved(reference)
            view.check_carried(reference)
            mounted, rows = yield from _route(view, view.route_from_vehicle(reference), rows)
            forth = [link._replace(forward=not link.forward) for link in reversed(mounted)]
        return [*forth, back._replace(forward=False)], rows
    check_not_reserved(interest)
    view.check_carried(interest)
    mounted, rows = yield from _route(view, view.route_from_vehicle(interest), rows)
    return [*forth, *mounted], rows


def _route(view: PlatformView, route: Route, rows: Rows) -> Steps[tuple[list[Links], Rows]]:
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
            moving, rows = joint_moved(view, next(legs), rows)
            links.append(moving)
            yield
    return links, rows


def _met(view: PlatformView, there: PathState, links: list[Links], rows: Rows, fixed: str) -> tuple[list[Links], Rows]:
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
            drifts(view, last.estimate, rows) if rows.with_covariance else None,
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


def _origin(view: PlatformView, rows: Rows) -> tuple[Origin | None, Rows]:
    """Return the origin of the newest row that has a pose, and the rows without those whose origin is another one."""
    good = np.flatnonzero(rows.status == Status.OK)
    if not len(good):
        return view.history.newest.origin, rows
    history = view.history
    held, before = rows.around or history.around(np.clip(rows.utimes, history.first, history.last))
    newest = held[before[good[np.argmax(rows.utimes[good])]]].origin
    of_others = np.array([differ(each.origin, newest) for each in held])[before] & (rows.status == Status.OK)
    return newest, replace(rows, status=np.where(of_others, int(Status.NO_POSE), rows.status).astype(np.int32))


def _is_unstated(link: Links) -> bool:
    return link.factor is None and link.source[0] not in (EdgeKind.VEHICLE, EdgeKind.JOINT)


_EXACT = np.zeros((6, 1))


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


def _constant(step: PathStep) -> Links:
    return Links(Poses.of(step.X_FT), step.edge.forward, step.factor, step.source, step.link.bends)
