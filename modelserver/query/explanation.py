"""Explanation of an answer: each edge of the path, its provenance, and its share of the uncertainty."""

from __future__ import annotations

import numpy as np

from modelserver.geometry.topology import EdgeKind
from modelserver.joints.history import MAX_CLOCK_LEAD_S
from modelserver.joints.track import MAX_GAP_S, Provenance
from modelserver.messages import NAN, EdgeReport, Explanation, Policy, TimeQuery
from modelserver.query.path import PathStep, find_provenance, lookup_path
from modelserver.query.view import PlatformView
from modelserver.transforms import chain

_ZERO = np.zeros((6, 1))


def explain(view: PlatformView, interest: str, reference: str, time: TimeQuery, now: int) -> Explanation:
    """Return where a frame is in another, with each edge of the path.

    A share is that of the trace of the position's, and of the rotation's, covariance. An edge without a sigma has none,
    and counts as exact for the others. Raises QueryError as `PlatformView.transformation`.
    """
    answer = view.transformation(interest, reference, time, now)
    path = lookup_path(view, interest, reference, time, now)
    known = [
        link._replace(factor=np.zeros((6, 1)) if link.factor is None else link.factor, source=(number,))
        for number, link in enumerate(path.links)
    ]
    shares = chain.contributions(known) or {}
    traces = []
    for link in known:
        share = shares[link.source]
        large_angle = shares.get((*link.source, chain.LARGE_ANGLE), _ZERO)
        traces.append((float(np.sum(share[:3] ** 2) + np.sum(large_angle**2)), float(np.sum(share[3:] ** 2))))
    position, rotation = (sum(each[side] for each in traces) for side in (0, 1))
    return Explanation(
        answer,
        tuple(
            _build_edge_report(
                view, step, (_share(trace[0], position, step), _share(trace[1], rotation, step)), time, now
            )
            for step, trace in zip(path.steps, traces, strict=True)
        ),
    )


def _share(own: float, whole: float, step: PathStep) -> float:
    if step.factor is None:
        return NAN
    return own / whole if whole > 0.0 else 0.0


def _describe_warning(view: PlatformView, step: PathStep, time: TimeQuery, now: int) -> str:
    """Return the warnings of a joint's position as text; see `lookup_joints` for the flags."""
    edge = step.edge
    assert edge.joint is not None
    leader = view.model.drives[edge.name].leader
    warnings = []
    if any(each.provenance is Provenance.DEFAULT for each in step.readings):
        stated = view.model.joints[leader].joint.default
        warnings.append("not received: at its default" if stated else "not received, and no default is stated")
    received = [each for each in step.readings if each.provenance is not Provenance.DEFAULT]
    latest = now and (not time.at or time.policy is Policy.LATEST)
    gap = max((max(each.gap, (now - each.stamp) * 1e-6 if latest else 0.0) for each in received), default=0.0)
    if gap > MAX_GAP_S:
        warnings.append(f"silent for {gap:.1f} s")
    elif latest and any((each.stamp - now) * 1e-6 > MAX_CLOCK_LEAD_S for each in received):
        warnings.append("stamped in the future: the clock was set back")
    if edge.joint.is_out_of_limits(tuple(each.position for each in step.readings)):
        warnings.append("beyond its limits")
    return ", ".join(warnings)


def _describe_source(view: PlatformView, leader: str, step: PathStep) -> str:
    """Return the sources of a joint's coordinates, in their order, each once."""
    tracks = view.joints.tracks
    names = view.model.drives[step.edge.name].names
    found = dict.fromkeys(tracks[name].source or "joints" for name in names if name in tracks)
    source = ", ".join(found)
    return source if leader == step.edge.name else f"{source} of {leader}".strip()


def _build_edge_report(
    view: PlatformView, step: PathStep, shares: tuple[float, float], time: TimeQuery, now: int
) -> EdgeReport:
    edge = step.edge
    X = step.X_FT if edge.forward else step.X_FT.inverse()
    provenance, stamp, source, warning = "fixed", 0, "", ""
    if (found := find_provenance(view, step)) is not None:
        provenance, stamp = found[0].name.lower(), found[1]
    if step.estimate is not None:
        source = "localization"
    elif step.readings:
        source = _describe_source(view, view.model.drives[edge.name].leader, step)
        warning = _describe_warning(view, step, time, now)
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
        provenance=provenance,
        stamp=stamp,
        age=(now - stamp) * 1e-6 if stamp and now else NAN,
        source=source,
        coordinates=tuple(reading.position for reading in step.readings),
        position_share=shares[0],
        rotation_share=shares[1],
        warning=warning,
    )
