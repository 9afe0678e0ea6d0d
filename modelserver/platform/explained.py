"""What an answer rests on: each edge of the way, how it was come by, and its share of what is unsure."""

from __future__ import annotations

import numpy as np

from modelserver.geometry.route import EdgeKind
from modelserver.joints import How
from modelserver.messages import NAN, EdgeReport, Estimate, Explanation, Quality, TimeQuery
from modelserver.platform.path import Step, way
from modelserver.platform.view import PlatformView
from modelserver.spatial import chain

_NOTHING = np.zeros((6, 1))
_HOW_OF_FLAG = (
    (Quality.PREDICTED, How.PREDICTED),
    (Quality.HELD, How.HELD),
    (Quality.INTERPOLATED, How.INTERPOLATED),
)


def explained(view: PlatformView, interest: str, reference: str, time: TimeQuery, now: int) -> Explanation:
    """Return where a frame is in another and what that rests on. Raises QueryError as `PlatformView.transformation`.

    A share is that of the trace of the position's, and of the rotation's, covariance; an edge that states no sigma has
    none, and counts as exact for those of the others.
    """
    answer = view.transformation(interest, reference, time, now)
    path = way(view, interest, reference, time, now)
    known = [
        link._replace(factor=np.zeros((6, 1)) if link.factor is None else link.factor, source=(number,))
        for number, link in enumerate(path.links)
    ]
    shares = chain.contributions(known) or {}
    traces = []
    for link in known:
        share = shares[link.source]
        bent = shares.get((*link.source, chain.BEND), _NOTHING)
        traces.append((float(np.sum(share[:3] ** 2) + np.sum(bent**2)), float(np.sum(share[3:] ** 2))))
    position, rotation = (sum(each[side] for each in traces) for side in (0, 1))
    return Explanation(
        answer,
        tuple(
            _report(view, step, _part(trace[0], position, step), _part(trace[1], rotation, step), now)
            for step, trace in zip(path.steps, traces, strict=True)
        ),
    )


def _part(own: float, whole: float, step: Step) -> float:
    if step.factor is None:
        return NAN
    return own / whole if whole > 0.0 else 0.0


def _stamp(view: PlatformView, estimate: Estimate, how: How) -> int:
    """Return when the newest estimate was held that another rests on."""
    following = view.history.following(estimate.utime) if how is How.INTERPOLATED else None
    return (following or view.history.held(estimate.utime)).utime


def _report(view: PlatformView, step: Step, position: float, rotation: float, now: int) -> EdgeReport:
    edge = step.edge
    X = step.X_FT if edge.forward else step.X_FT.inverse()
    how, stamp, source = "fixed", 0, ""
    if step.estimate is not None:
        found = next((how for flag, how in _HOW_OF_FLAG if flag in step.estimate.quality), How.MEASURED)
        how, stamp, source = found.name.lower(), _stamp(view, step.estimate, found), "localization"
    elif step.readings:
        worst = max(step.readings, key=lambda each: each.how)
        how, stamp = worst.how.name.lower(), min(each.stamp for each in step.readings)
        source = "JOINTS" if worst.how is not How.AT_REST else ""
        leader = view.model.drives[edge.name].leader
        if leader != edge.name:
            source += f" of {leader}"
    constraint = None
    if edge.kind in (EdgeKind.CONSTRAINT, EdgeKind.JOINT):
        constraint = next(each for each in view.model.constraints if each.name == edge.name)
    return EdgeReport(
        kind=edge.kind.value,
        name=edge.name,
        forward=edge.forward,
        ends=(constraint.from_, constraint.to)
        if constraint is not None
        else (edge.name, view.rolling_frame)
        if edge.kind is EdgeKind.VEHICLE
        else (edge.name.partition(":")[0], edge.name),
        pose=X,
        how=how,
        stamp=stamp,
        age=(now - stamp) * 1e-6 if stamp and now else NAN,
        source=source,
        coordinates=tuple(reading.position for reading in step.readings),
        position_share=position,
        rotation_share=rotation,
    )
