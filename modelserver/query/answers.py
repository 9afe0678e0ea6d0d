"""Compute the reply to each type of request from a `PlatformView`. Pure.

An answer that may take milliseconds is deferred: `DeferredAnswer` binds the request to the view at which it was
accepted, and the server loop computes it in steps. The view is immutable, so the answer does not depend on when the
steps run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver.errors import LimitError, QueryError, Status
from modelserver.geometry import names
from modelserver.geometry.parts import Body, BodyFrame
from modelserver.messages import (
    MAX_REQUEST_INSTANTS,
    Acknowledgement,
    DynamicsReply,
    ExplanationReply,
    GetBodyFrameList,
    GetBodyList,
    GetDynamics,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    HistoryReply,
    MotionReply,
    NameListReply,
    PoseBatch,
    PoseBatchReply,
    ReloadModel,
    ReloadReply,
    Reply,
    ReplyHeader,
    Request,
    RequestHeader,
    SetHTransform,
    SetStateVector,
    StateVectorReply,
    TransformReply,
)
from modelserver.query import HISTORY_LIMIT, PlatformView
from modelserver.query.batch import lookup_batch
from modelserver.query.demand import check_demand
from modelserver.query.dynamics import compute_dynamics
from modelserver.query.explanation import explain
from modelserver.query.motion import compute_motion
from modelserver.query.steps import Steps, complete


class DeferredAnswer(NamedTuple):
    """A long answer that the server loop computes in steps and sends to the reply channel."""

    view: PlatformView
    request: Request
    utime: int

    def work(self) -> Steps[list[Reply]]:
        """Compute the messages of the reply in steps; on a QueryError it is one error reply."""
        view, request, utime = self
        try:
            return (yield from _answer_in_steps(view, request, utime))
        except QueryError as error:
            return [
                make_error_reply(view, type(request), request.header, error.status, str(error), utime, error.nearest)
            ]


def effort_of(request: Request) -> float:
    """Return the computing effort of a request in units of a typical one (about 0.1 ms), from the request alone."""
    if isinstance(request, GetTransformations):
        return len(request.pairs) * (PAIR_EFFORT + INSTANT_EFFORT * len(request.at))
    if isinstance(request, GetHistory):
        poses = (request.end_utime - request.start_utime) * 1e-6 * request.rate_hz
        # more than the limit, or non-finite: the reply is an error
        return 1.0 + POSE_EFFORT * poses if 0.0 < poses <= HISTORY_LIMIT else 1.0
    if isinstance(request, GetDynamics):
        return DYNAMICS_EFFORT
    if isinstance(request, GetExplanation):
        return EXPLANATION_EFFORT
    return DEMAND_EFFORT if any(getattr(request, "demand", ())) else 1.0


def is_deferred(request: Request) -> bool:
    """Return whether the answer to a request may take long, so that it is computed in steps."""
    return type(request) in _DEFERRED_ANSWERS and effort_of(request) > DEFERRED_EFFORT


def compute_answer(view: PlatformView, request: Request, utime: int) -> list[Reply]:
    """Compute the messages of the reply to a request at `utime`; most types have one. Raises QueryError."""
    header = ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
    match request:
        case GetTransformation():  # the hot path
            interest, reference, time = request.frame_of_interest, request.frame_of_reference, request.time
            answer = view.transformation(interest, reference, time, utime)
            return [TransformReply(header, answer, *check_demand(view, answer, request.demand, time, utime))]
        case GetStateVector(_, time, demand):
            answer = view.transformation(view.base_frame, names.WORLD_UTM, time, utime)
            return [StateVectorReply(header, answer, *check_demand(view, answer, demand, time, utime))]
        case GetHTransform(_, inverse, time, demand):
            ends = (names.WORLD_UTM, view.base_frame) if inverse else (view.base_frame, names.WORLD_UTM)
            answer = view.transformation(*ends, time, utime)
            return [TransformReply(header, answer, *check_demand(view, answer, demand, time, utime))]
        case GetMotion(_, interest, reference, expressed_in, time):
            return [MotionReply(header, compute_motion(view, interest, reference, expressed_in, time, utime))]
        case GetExplanation(_, interest, reference, time):
            return [ExplanationReply(header, explain(view, interest, reference, time, utime))]
        case GetBodyList():
            return [_list_names(header, view.model.bodies)]
        case GetBodyFrameList(_, body):
            return [_list_names(header, view.model.body(body).frames)]
    return complete(_answer_in_steps(view, request, utime))


def _list_names(header: ReplyHeader, parts: Sequence[Body | BodyFrame]) -> NameListReply:
    return NameListReply(header, tuple(each.name for each in parts), tuple(each.description for each in parts))


def _answer_in_steps(view: PlatformView, request: Request, utime: int) -> Steps[list[Reply]]:
    header = ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
    return (yield from _DEFERRED_ANSWERS[type(request)](view, request, header))


def compute_replies(view: PlatformView, request: Request, utime: int) -> list[Reply]:
    """Compute the messages of the reply to a request at `utime`; on a QueryError it is one error reply."""
    try:
        return compute_answer(view, request, utime)
    except QueryError as error:
        return [make_error_reply(view, type(request), request.header, error.status, str(error), utime, error.nearest)]


def make_error_reply(
    view: PlatformView,
    kind: type[Request],
    header: RequestHeader,
    status: Status,
    message: str,
    utime: int,
    nearest: tuple[str, ...] = (),
) -> Reply:
    return _REPLY_TYPES[kind](ReplyHeader(header.request_id, utime, status, message, nearest, view.model.revision))


def _get_history(view: PlatformView, request: GetHistory, header: ReplyHeader) -> Steps[list[Reply]]:
    span = (request.start_utime, request.end_utime, request.rate_hz)
    return [HistoryReply(header, (yield from view.vehicle_history(*span)))]


def _get_dynamics(view: PlatformView, request: GetDynamics, header: ReplyHeader) -> Steps[list[Reply]]:
    return [DynamicsReply(header, (yield from compute_dynamics(view, request, header.utime)))]


def _get_transformations(view: PlatformView, request: GetTransformations, header: ReplyHeader) -> Steps[list[Reply]]:
    wanted = len(request.pairs) * len(request.at)
    if wanted > MAX_REQUEST_INSTANTS:
        raise LimitError(
            f"{len(request.pairs)} pairs at {len(request.at)} instants are {wanted} poses; a request may have at most "
            f"{MAX_REQUEST_INSTANTS}; split it into several requests"
        )
    utimes = np.array(request.at, dtype=np.int64)
    parts: list[tuple[int, int, PoseBatch]] = []
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
        PoseBatchReply(header, part, len(parts), number, first, poses)
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

_DEFERRED_ANSWERS: Final[Mapping[type, Callable[[PlatformView, Any, ReplyHeader], Steps[list[Reply]]]]] = {
    GetHistory: _get_history,
    GetTransformations: _get_transformations,
    GetDynamics: _get_dynamics,
}

_REPLY_TYPES: Final[Mapping[type, Callable[[ReplyHeader], Reply]]] = {
    GetTransformation: TransformReply,
    GetBodyList: NameListReply,
    GetBodyFrameList: NameListReply,
    GetStateVector: StateVectorReply,
    GetHTransform: TransformReply,
    GetHistory: HistoryReply,
    GetTransformations: PoseBatchReply,
    GetMotion: MotionReply,
    GetExplanation: ExplanationReply,
    GetDynamics: DynamicsReply,
    ReloadModel: ReloadReply,
    SetStateVector: Acknowledgement,
    SetHTransform: Acknowledgement,
}
