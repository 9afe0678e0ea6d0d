"""Compute the reply to each type of request from a `PlatformView`, and the verdict on a demand. Pure.

An answer that may take milliseconds is deferred: `DeferredAnswer` binds the request to the view at which it was
accepted, and the server loop computes it in steps. The view is immutable, so the answer does not depend on when the
steps run.

Demand: the horizontal error, in x and y of the frame of reference, is beyond a limit with the probability
exp(-((limit - a) / s)^2 / 2), s along the longest axis of the error ellipse, a the allowance for suspected faults; the
heading error, about z, by both sides of a normal distribution (`filter.protection_levels`). Met is what has a
probability of 1 - min_integrity at most, or LIMIT_RISK, with which a pose is valid. What is not known is unmet.

The levels of the vehicle's pose count errors that its covariance lacks: of the lever arm and of the mounts. So its
covariance is enlarged to that of the levels, and the answer computed again from it; the configured limits then have the
probability `limit_risk`. A relation within the vehicle has its own covariance and no allowance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver import messages
from modelserver.errors import LimitError, QueryError, Status
from modelserver.estimation.filter.protection_levels import (
    LEVEL_RISK,
    LIMIT_RISK,
    compute_factors,
    compute_limit_risks,
    compute_longest_variance,
)
from modelserver.estimation.history import History
from modelserver.geometry import names
from modelserver.geometry.parts import Body, BodyFrame
from modelserver.query.batch import lookup_batch
from modelserver.query.dynamics import compute_dynamics
from modelserver.query.path import compute_motion, explain, find_provenance, lookup_path
from modelserver.query.view import HISTORY_LIMIT, PlatformView, Steps, complete, is_absolute


class DeferredAnswer(NamedTuple):
    """A long answer that the server loop computes in steps and sends to the reply channel."""

    view: PlatformView
    request: messages.Request
    utime: int

    def work(self) -> Steps[list[messages.Reply]]:
        """Compute the messages of the reply in steps; on a QueryError it is one error reply."""
        view, request, utime = self
        try:
            return (yield from _answer_in_steps(view, request, utime))
        except QueryError as error:
            return _explain_error(view, request, error, utime)


_FRAME_FIELDS: Final[Mapping[type, tuple[str, ...]]] = {
    messages.GetTransformation: ("frame_of_interest", "frame_of_reference"),
    messages.GetMotion: ("frame_of_interest", "frame_of_reference", "expressed_in"),
    messages.GetExplanation: ("frame_of_interest", "frame_of_reference"),
    messages.GetTransformations: ("fixed_frame",),
    messages.GetDynamics: ("frame",),
}


def complete_names(request: messages.Request) -> messages.Request:
    """Return a request with the full names of its frames, as `names.complete` does."""
    full: Any = request
    for field in _FRAME_FIELDS.get(type(request), ()):
        given = getattr(request, field)
        if ":" not in given:
            full = full._replace(**{field: names.complete(given)})
    if isinstance(request, messages.GetTransformations):
        pairs = tuple([(names.complete(interest), names.complete(reference)) for interest, reference in request.pairs])
        full = full._replace(pairs=pairs)
    return full  # type: ignore[no-any-return]


def effort_of(request: messages.Request) -> float:
    """Return the computing effort of a request in units of a typical one (about 0.1 ms), from the request alone."""
    if isinstance(request, messages.GetTransformations):
        return len(request.pairs) * (PAIR_EFFORT + INSTANT_EFFORT * len(request.at))
    if isinstance(request, messages.GetHistory):
        poses = (request.end_utime - request.start_utime) * 1e-6 * request.rate_hz
        # more than the limit, or non-finite: the reply is an error
        return 1.0 + POSE_EFFORT * poses if 0.0 < poses <= HISTORY_LIMIT else 1.0
    if isinstance(request, messages.GetDynamics):
        return DYNAMICS_EFFORT
    if isinstance(request, messages.GetExplanation):
        return EXPLANATION_EFFORT
    return DEMAND_EFFORT if any(getattr(request, "demand", ())) else 1.0


def is_deferred(request: messages.Request) -> bool:
    return type(request) in _LONG and effort_of(request) > DEFERRED_EFFORT


def compute_answer(view: PlatformView, request: messages.Request, utime: int) -> list[messages.Reply]:
    """Compute the messages of the reply to a request at `utime`; most types have one. Raises QueryError."""
    header = messages.ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
    match request:
        case messages.GetTransformation():  # the hot path
            interest, reference, time = request.frame_of_interest, request.frame_of_reference, request.time
            answer = view.transformation(interest, reference, time, utime)
            return [messages.TransformReply(header, answer, *check_demand(view, answer, request.demand, time, utime))]
        case messages.GetStateVector(_, time, demand):
            answer = view.transformation(view.base_frame, names.WORLD_UTM, time, utime)
            return [messages.StateVectorReply(header, answer, *check_demand(view, answer, demand, time, utime))]
        case messages.GetHTransform(_, inverse, time, demand):
            ends = (names.WORLD_UTM, view.base_frame) if inverse else (view.base_frame, names.WORLD_UTM)
            answer = view.transformation(*ends, time, utime)
            return [messages.TransformReply(header, answer, *check_demand(view, answer, demand, time, utime))]
        case messages.GetMotion(_, interest, reference, expressed_in, time):
            return [messages.MotionReply(header, compute_motion(view, interest, reference, expressed_in, time, utime))]
        case messages.GetExplanation(_, interest, reference, time):
            return [messages.ExplanationReply(header, explain(view, interest, reference, time, utime))]
        case messages.GetBodyList():
            return [_list_names(header, view.model.bodies)]
        case messages.GetBodyFrameList(_, body):
            return [_list_names(header, view.model.body(body).frames)]
    return complete(_answer_in_steps(view, request, utime))


def _list_names(header: messages.ReplyHeader, parts: Sequence[Body | BodyFrame]) -> messages.NameListReply:
    return messages.NameListReply(header, tuple(each.name for each in parts), tuple(each.description for each in parts))


def _answer_in_steps(view: PlatformView, request: messages.Request, utime: int) -> Steps[list[messages.Reply]]:
    header = messages.ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
    match request:
        case messages.GetHistory(_, start, end, rate_hz):
            return [messages.HistoryReply(header, (yield from view.vehicle_history(start, end, rate_hz)))]
        case messages.GetDynamics():
            return [messages.DynamicsReply(header, (yield from compute_dynamics(view, request, utime)))]
        case messages.GetTransformations():
            return (yield from _get_transformations(view, request, header))
    raise TypeError(f"{type(request).__name__} has no answer by the view")


def compute_replies(view: PlatformView, request: messages.Request, utime: int) -> list[messages.Reply]:
    """Compute the messages of the reply to a request at `utime`; on a QueryError it is one error reply."""
    try:
        return compute_answer(view, request, utime)
    except QueryError as error:
        return _explain_error(view, request, error, utime)


def _explain_error(
    view: PlatformView, request: messages.Request, error: QueryError, utime: int
) -> list[messages.Reply]:
    return [make_error_reply(view, type(request), request.header, error.status, str(error), utime, error.nearest)]


def make_error_reply(
    view: PlatformView,
    kind: type[messages.Request],
    header: messages.RequestHeader,
    status: Status,
    message: str,
    utime: int,
    nearest: tuple[str, ...] = (),
) -> messages.Reply:
    return messages.REPLY_OF[kind](
        messages.ReplyHeader(header.request_id, utime, status, message, nearest, view.model.revision)
    )


def _get_transformations(
    view: PlatformView, request: messages.GetTransformations, header: messages.ReplyHeader
) -> Steps[list[messages.Reply]]:
    wanted = len(request.pairs) * len(request.at)
    if wanted > messages.MAX_REQUEST_INSTANTS:
        raise LimitError(
            f"{len(request.pairs)} pairs at {len(request.at)} instants are {wanted} poses; a request may have at most "
            f"{messages.MAX_REQUEST_INSTANTS}; split it into several requests"
        )
    utimes = np.array(request.at, dtype=np.int64)
    parts: list[tuple[int, int, messages.PoseBatch]] = []
    for number, (interest, reference) in enumerate(request.pairs):
        poses = yield from lookup_batch(
            view,
            interest,
            reference,
            utimes,
            request.reference_at,
            request.fixed_frame,
            request.with_covariance,
            header.utime,
        )
        most = POSES_IN_PART if poses.covariances is None else COVARIANCES_IN_PART
        starts = range(0, max(len(utimes), 1), most)
        parts += [(number, first, poses.slice_instants(first, first + most)) for first in starts]
        yield
    return [
        messages.PoseBatchReply(header, part, len(parts), number, first, poses)
        for part, (number, first, poses) in enumerate(parts)
    ]


POSES_IN_PART: Final = 600
COVARIANCES_IN_PART: Final = 120
"""Instants in one message of a reply without and with covariances: some 45 kB, which LCM sends as one datagram."""

PAIR_EFFORT: Final = 10.0
INSTANT_EFFORT: Final = 0.06
POSE_EFFORT: Final = 0.33
EXPLANATION_EFFORT: Final = 4.0
DEMAND_EFFORT: Final = 3.0
DYNAMICS_EFFORT: Final = 20.0
"""Effort of a pair of a batch and of each of its instants, of a pose of a history, of an explanation, of a pose with a
demand, of dynamics."""

DEFERRED_EFFORT: Final = 11.0
"""Effort beyond which an answer is deferred: about a millisecond."""

_LONG: Final = frozenset((messages.GetHistory, messages.GetTransformations, messages.GetDynamics))


# --- demands ----------------------------------------------------------------------------------------------------------


def check_demand(
    view: PlatformView, answer: messages.PoseAnswer, demand: messages.PoseDemand, time: messages.TimeQuery, now: int
) -> tuple[messages.Unmet, str]:
    """Return what an answer of `view` at `now` lacks of a demand, with the reason. Raises as `transformation`."""
    if not any(demand):
        return messages.MET, ""
    ends = (answer.transformation.frame_of_interest, answer.transformation.frame_of_reference)
    steps = lookup_path(view, *ends, time, now).steps
    found = [data for step in steps if (data := find_provenance(view, step)) is not None]
    # a joint at its default has no data
    age = max(((now - stamp) * 1e-6 if stamp else math.inf for _, stamp in found), default=0.0)
    estimates = [each.estimate for each in steps if each.estimate is not None and is_absolute(each.edge.name)]
    if not estimates:
        return find_unmet(answer, demand, age=age)
    estimate = estimates[0]
    view = view._replace(history=History(0.0).append(_enlarge(estimate)))
    answer = view.transformation(*ends, time, now)
    return find_unmet(answer, demand, estimate.horizontal_allowance, estimate.limit_risk, age)


def _enlarge(estimate: messages.Estimate) -> messages.Estimate:
    """Return an estimate with the covariance that its levels are computed from, nan where they are not known."""
    if estimate.covariance is None:
        return estimate
    k, k_heading = compute_factors(LEVEL_RISK)
    sigma = (estimate.horizontal_level - estimate.horizontal_allowance) / k
    heading_sigma = estimate.heading_level / k_heading
    P = np.array(estimate.covariance).reshape(6, 6)
    # nan remains nan only in this order
    P[[0, 1], [0, 1]] += max(sigma**2 - compute_longest_variance(P), 0.0)
    P[5, 5] = max(heading_sigma**2, P[5, 5])
    return replace(estimate, covariance=tuple(P.ravel().tolist()))


def find_unmet(
    answer: messages.PoseAnswer,
    demand: messages.PoseDemand,
    allowance: float = 0.0,
    limit_risk: float = 0.0,
    age: float = 0.0,
) -> tuple[messages.Unmet, str]:
    """Return what an answer lacks of a demand, and what, by how much and what was asked for in words.

    Parameters
    ----------
    answer
        With the covariance of all its errors.
    demand
        As in the request, 0 for nothing.
    allowance
        For suspected faults of the position, m.
    limit_risk
        Probability that the vehicle's error is beyond a configured limit; nan where it is not known.
    age
        Of the newest data, seconds; infinite where there are none.
    """
    unmet, reasons = messages.MET, list[str]()
    most = 1.0 - demand.min_integrity if demand.min_integrity else LIMIT_RISK
    P = answer.transformation.covariance
    sigma = heading_sigma = messages.NAN
    if P is not None:
        sigma, heading_sigma = math.sqrt(compute_longest_variance(P)), math.sqrt(max(float(P[5, 5]), 0.0))
    limits = (demand.max_horizontal - allowance, demand.max_heading)
    risk, heading_risk = compute_limit_risks(sigma, heading_sigma, *limits)
    k, k_heading = compute_factors(most)
    # the comparisons are false for nan
    if demand.max_horizontal and not risk <= most:
        unmet |= messages.Unmet.HORIZONTAL
        reasons.append(_describe_error("horizontal", allowance + k * sigma, demand.max_horizontal, "m", most))
    if demand.max_heading and not heading_risk <= most:
        unmet |= messages.Unmet.HEADING
        bound, limit = (math.degrees(min(each, math.pi)) for each in (k_heading * heading_sigma, demand.max_heading))
        reasons.append(_describe_error("heading", bound, limit, "deg", most))
    if demand.max_age and not age <= demand.max_age:
        unmet |= messages.Unmet.AGE
        known = f"the newest data are {age:.4g} s old" if age < math.inf else "a joint on the path has no data"
        reasons.append(f"{known}, asked for: at most {demand.max_age:.4g} s")
    if demand.min_integrity:
        invalid = messages.Invalid(answer.transformation.invalid_reasons)
        has_limits = demand.max_horizontal or demand.max_heading
        if invalid:
            unmet |= messages.Unmet.NOT_VALID
            reasons.append(f"the pose is not valid: {invalid.explain()}")
        elif not limit_risk <= (1.0 if has_limits else most):
            unmet |= messages.Unmet.NOT_VALID
            known = "is not known" if math.isnan(limit_risk) else f"is {limit_risk:.2g}, asked for: at most {most:.2g}"
            reasons.append(f"the probability of an error beyond the configured limits {known}")
    return unmet, "; ".join(reasons)


def _describe_error(which: str, bound: float, limit: float, unit: str, risk: float) -> str:
    """Return by how much an error may be beyond a limit."""
    if math.isnan(bound):
        return f"the {which} error is not known, asked for: at most {limit:.4g} {unit}"
    return (
        f"the {which} error is up to {bound:.4g} {unit} at integrity {1.0 - risk:.12g}, asked for: {limit:.4g} {unit}"
    )
