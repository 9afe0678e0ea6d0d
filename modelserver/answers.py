"""Answers: the reply to each kind of request, from what the platform knows. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from modelserver.errors import QueryError, Status
from modelserver.geometry import names
from modelserver.messages import (
    GetBodyFrameList,
    GetBodyList,
    GetHistory,
    GetHTransform,
    GetStateVector,
    GetTransformation,
    HistoryReply,
    NameListReply,
    Reply,
    ReplyHeader,
    Request,
    RequestHeader,
    StateVectorReply,
    TransformReply,
)
from modelserver.platform import PlatformView


def answer(view: PlatformView, request: Request, utime: int) -> Reply:
    """Return the reply to a request at `utime`. A question that has no answer gives a reply that says why."""
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


def _get_history(view: PlatformView, request: GetHistory, header: ReplyHeader) -> Reply:
    return HistoryReply(header, view.vehicle_history(request.start_utime, request.end_utime, request.rate_hz))


def _get_body_list(view: PlatformView, request: GetBodyList, header: ReplyHeader) -> Reply:
    bodies = view.model.bodies
    return NameListReply(header, tuple(body.name for body in bodies), tuple(body.description for body in bodies))


def _get_body_frame_list(view: PlatformView, request: GetBodyFrameList, header: ReplyHeader) -> Reply:
    frames = view.model.body(request.body).frames
    return NameListReply(header, tuple(frame.name for frame in frames), tuple(frame.description for frame in frames))


_ANSWERS: Final[Mapping[type, Callable[[PlatformView, Any, ReplyHeader], Reply]]] = {
    GetTransformation: _get_transformation,
    GetBodyList: _get_body_list,
    GetBodyFrameList: _get_body_frame_list,
    GetStateVector: _get_state_vector,
    GetHTransform: _get_h_transform,
    GetHistory: _get_history,
}

_REPLY_KINDS: Final[Mapping[type, Callable[[ReplyHeader], Reply]]] = {
    GetTransformation: TransformReply,
    GetBodyList: NameListReply,
    GetBodyFrameList: NameListReply,
    GetStateVector: StateVectorReply,
    GetHTransform: TransformReply,
    GetHistory: HistoryReply,
}
