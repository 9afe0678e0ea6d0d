"""Answers: the reply to each kind of request, from what the platform knows. Pure.

A deferred answer is one that may take milliseconds: it is a value bound to the view at which the request was accepted,
and its work is done in steps. The view is immutable, so when the steps are done makes no difference to the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from modelserver.errors import LimitError, QueryError, Status
from modelserver.geometry import names
from modelserver.messages import (
    MOST_INSTANTS,
    Acknowledgement,
    ExplanationReply,
    GetBodyFrameList,
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    HistoryReply,
    ManyPoses,
    ManyReply,
    MotionReply,
    NameListReply,
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
from modelserver.platform import HISTORY_LIMIT, PlatformView
from modelserver.platform.explained import explained
from modelserver.platform.many import many_in_steps
from modelserver.platform.moving import motion
from modelserver.platform.steps import Steps, complete


class DeferredAnswer(NamedTuple):
    """The answer to a request that takes long, to be worked out and sent to its reply channel by the server loop."""

    view: PlatformView
    request: Request
    utime: int

    def work(self) -> Steps[list[Reply]]:
        """Return, in steps, the messages of the reply. A question without an answer gives one that says why."""
        view, request, utime = self
        header = ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
        try:
            replies: list[Reply] = yield from _DEFERRED_ANSWERS[type(request)](view, request, header)
        except QueryError as error:
            return [failure(view, type(request), request.header, error.status, str(error), utime, error.nearest)]
        return replies


def effort_of(request: Request) -> float:
    """Return the work of a request in units of a usual one (about 0.1 ms), from the request alone."""
    if isinstance(request, GetTransformations):
        return len(request.pairs) * (PAIR_EFFORT + INSTANT_EFFORT * len(request.at))
    if isinstance(request, GetHistory):
        poses = (request.end_utime - request.start_utime) * 1e-6 * request.rate_hz
        # more than the limit, or not a number: the reply is an error
        return 1.0 + POSE_EFFORT * poses if 0.0 < poses <= HISTORY_LIMIT else 1.0
    return EXPLANATION_EFFORT if isinstance(request, GetExplanation) else 1.0


def is_deferred(request: Request) -> bool:
    """Return whether the answer to a request may take long, so that it is worked out in steps."""
    return type(request) in _DEFERRED_ANSWERS and effort_of(request) > DEFERRED_EFFORT


def answers(view: PlatformView, request: Request, utime: int) -> list[Reply]:
    """Return the messages of the reply to a request at `utime`, one for most kinds."""
    if type(request) in _DEFERRED_ANSWERS:
        return complete(DeferredAnswer(view, request, utime).work())
    return [answer(view, request, utime)]


def answer(view: PlatformView, request: Request, utime: int) -> Reply:
    """Return the one message of the reply to a request at `utime`. Without an answer it is one that says why."""
    header = ReplyHeader(request.header.request_id, utime, model_revision=view.model.revision)
    try:
        return _ANSWERS[type(request)](view, request, header)
    except QueryError as error:
        return failure(view, type(request), request.header, error.status, str(error), utime, error.nearest)


def failure(
    view: PlatformView,
    kind: type[Request],
    header: RequestHeader,
    status: Status,
    message: str,
    utime: int,
    nearest: tuple[str, ...] = (),
) -> Reply:
    """Return the reply to a request of a kind that says why there is no answer."""
    return _REPLY_KINDS[kind](ReplyHeader(header.request_id, utime, status, message, nearest, view.model.revision))


def _get_transformation(view: PlatformView, request: GetTransformation, header: ReplyHeader) -> Reply:
    interest, reference = request.frame_of_interest, request.frame_of_reference
    return TransformReply(header, view.transformation(interest, reference, request.time, header.utime))


def _get_h_transform(view: PlatformView, request: GetHTransform, header: ReplyHeader) -> Reply:
    ends = (view.base_frame, names.WORLD_UTM)
    interest, reference = reversed(ends) if request.inverse else ends
    return TransformReply(header, view.transformation(interest, reference, request.time, header.utime))


def _get_state_vector(view: PlatformView, request: GetStateVector, header: ReplyHeader) -> Reply:
    return StateVectorReply(header, view.vehicle_pose(request.time, header.utime))


def _get_history(view: PlatformView, request: GetHistory, header: ReplyHeader) -> Steps[list[Reply]]:
    span = (request.start_utime, request.end_utime, request.rate_hz)
    return [HistoryReply(header, (yield from view.vehicle_history_in_steps(*span)))]


def _get_body_list(view: PlatformView, request: GetBodyList, header: ReplyHeader) -> Reply:
    bodies = view.model.bodies
    return NameListReply(header, tuple(body.name for body in bodies), tuple(body.description for body in bodies))


def _get_body_frame_list(view: PlatformView, request: GetBodyFrameList, header: ReplyHeader) -> Reply:
    frames = view.model.body(request.body).frames
    return NameListReply(header, tuple(frame.name for frame in frames), tuple(frame.description for frame in frames))


def _get_transformations(view: PlatformView, request: GetTransformations, header: ReplyHeader) -> Steps[list[Reply]]:
    wanted = len(request.pairs) * len(request.at)
    if wanted > MOST_INSTANTS:
        raise LimitError(
            f"{len(request.at)} instants of {len(request.pairs)} pairs are {wanted} poses; at most {MOST_INSTANTS} go "
            "in one question. Ask in parts."
        )
    utimes = np.array(request.at, dtype=np.int64)
    parts: list[tuple[int, int, ManyPoses]] = []
    for number, (interest, reference) in enumerate(request.pairs):
        poses = yield from many_in_steps(
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
        parts += [(number, first, poses.part(first, first + most)) for first in starts]
        yield
    return [
        ManyReply(header, part, len(parts), number, first, poses) for part, (number, first, poses) in enumerate(parts)
    ]


def _get_motion(view: PlatformView, request: GetMotion, header: ReplyHeader) -> Reply:
    _, interest, reference, expressed_in, time = request
    return MotionReply(header, motion(view, interest, reference, expressed_in, time, header.utime))


def _get_explanation(view: PlatformView, request: GetExplanation, header: ReplyHeader) -> Reply:
    _, interest, reference, time = request
    return ExplanationReply(header, explained(view, interest, reference, time, header.utime))


POSES_IN_PART: Final = 600
COVARIANCES_IN_PART: Final = 120
"""Instants in a part of a reply: some 45 kB, which LCM sends as one datagram."""

PAIR_EFFORT: Final = 10.0
INSTANT_EFFORT: Final = 0.06
POSE_EFFORT: Final = 0.33
EXPLANATION_EFFORT: Final = 4.0
"""Work of a pair and of each instant of it in many transformations, of a pose in a history, and of an explanation."""

DEFERRED_EFFORT: Final = 11.0
"""Work beyond which an answer is worked out in steps: about a millisecond."""

_ANSWERS: Final[Mapping[type, Callable[[PlatformView, Any, ReplyHeader], Reply]]] = {
    GetTransformation: _get_transformation,
    GetBodyList: _get_body_list,
    GetBodyFrameList: _get_body_frame_list,
    GetStateVector: _get_state_vector,
    GetHTransform: _get_h_transform,
    GetMotion: _get_motion,
    GetExplanation: _get_explanation,
}

_DEFERRED_ANSWERS: Final[Mapping[type, Callable[[PlatformView, Any, ReplyHeader], Steps[list[Reply]]]]] = {
    GetHistory: _get_history,
    GetTransformations: _get_transformations,
}

_REPLY_KINDS: Final[Mapping[type, Callable[[ReplyHeader], Reply]]] = {
    GetTransformation: TransformReply,
    GetBodyList: NameListReply,
    GetBodyFrameList: NameListReply,
    GetStateVector: StateVectorReply,
    GetHTransform: TransformReply,
    GetHistory: HistoryReply,
    GetTransformations: ManyReply,
    GetMotion: MotionReply,
    GetExplanation: ExplanationReply,
    ReloadModel: ReloadReply,
    SetStateVector: Acknowledgement,
    SetHTransform: Acknowledgement,
}
