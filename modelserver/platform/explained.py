"""What an answer rests on: each edge of the way, how it was come by, and its share of what is unsure."""

from __future__ import annotations

import numpy as np

from modelserver.geometry.edges import EdgeKind
from modelserver.joints.joints import AHEAD_S, LONGEST_GAP_S, How
from modelserver.messages import NAN, EdgeReport, Estimate, Explanation, Policy, Quality, TimeQuery
from modelserver.platform.path import PathStep, way
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
            _report(view, step, (_part(trace[0], position, step), _part(trace[1], rotation, step)), time, now)
            for step, trace in zip(path.steps, traces, strict=True)
        ),
    )


def _part(own: float, whole: float, step: PathStep) -> float:
    if step.factor is None:
        return NAN
    return own / whole if whole > 0.0 else 0.0


def _stamp(view: PlatformView, estimate: Estimate, how: How) -> int:
    """Return when the newest estimate was held that another rests on."""
    following = view.history.following(estimate.utime) if how is How.INTERPOLATED else None
    return (following or view.history.held(estimate.utime)).utime


def _doubt(view: PlatformView, step: PathStep, time: TimeQuery, now: int) -> str:
    """Return in words what speaks against where a joint stands, as its flags say of the whole answer; see `placed`."""
    edge = step.edge
    assert edge.joint is not None
    leader = view.model.drives[edge.name].leader
    words = []
    if any(each.how is How.AT_REST for each in step.readings):
        stated = view.model.joints[leader].joint.default
        words.append("never heard: at its default" if stated else "never heard, and no default is stated")
    told = [each for each in step.readings if each.how is not How.AT_REST]
    latest = now and (not time.at or time.policy is Policy.LATEST)
    silent = max((max(each.apart, (now - each.stamp) * 1e-6 if latest else 0.0) for each in told), default=0.0)
    if silent > LONGEST_GAP_S:
        words.append(f"silent for {silent:.1f} s")
    elif latest and any((each.stamp - now) * 1e-6 > AHEAD_S for each in told):
        words.append("told of the future: the clock was set back")
    if edge.joint.out_of_limits(tuple(each.position for each in step.readings)):
        words.append("beyond its limits")
    return ", ".join(words)


def _told_by(view: PlatformView, leader: str, step: PathStep) -> str:
    """Return who told where a joint stands: the sources of its coordinates, in their order, each once."""
    tracks = view.joints.tracks
    names = view.model.drives[step.edge.name].names
    found = dict.fromkeys(tracks[name].source or "joints" for name in names if name in tracks)
    source = ", ".join(found)
    return source if leader == step.edge.name else f"{source} of {leader}".strip()


def _report(view: PlatformView, step: PathStep, shares: tuple[float, float], time: TimeQuery, now: int) -> EdgeReport:
    edge = step.edge
    X = step.X_FT if edge.forward else step.X_FT.inverse()
    how, stamp, source, doubt = "fixed", 0, "", ""
    if step.estimate is not None:
        found = next((how for flag, how in _HOW_OF_FLAG if flag in step.estimate.quality), How.MEASURED)
        how, stamp, source = found.name.lower(), _stamp(view, step.estimate, found), "localization"
    elif step.readings:
        worst = max(step.readings, key=lambda each: each.how)
        how, stamp = worst.how.name.lower(), min(each.stamp for each in step.readings)
        source = _told_by(view, view.model.drives[edge.name].leader, step)
        doubt = _doubt(view, step, time, now)
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
        position_share=shares[0],
        rotation_share=shares[1],
        doubt=doubt,
    )
