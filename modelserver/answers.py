"""Answers: the reply to each kind of request, from what the platform knows. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

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
from modelserver.platform import PlatformView
from modelserver.platform.explained import explained
from modelserver.platform.many import many
from modelserver.platform.moving import motion


def answer(view: PlatformView, request: Request, utime: int) -> Reply | list[ManyReply]:
    """Return the reply to a request at `utime`, or its parts. A question without an answer gives one that says why."""
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


def _get_transformations(view: PlatformView, request: GetTransformations, header: ReplyHeader) -> list[ManyReply]:
    wanted = len(request.pairs) * len(request.at)
    if wanted > MOST_INSTANTS:
        raise LimitError(
            f"{len(request.at)} instants of {len(request.pairs)} pairs are {wanted} poses; at most {MOST_INSTANTS} go "
            "in one question. Ask in parts."
        )
    utimes = np.array(request.at, dtype=np.int64)
    parts: list[tuple[int, int, ManyPoses]] = []
    for number, (interest, reference) in enumerate(request.pairs):
        poses = many(
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

_ANSWERS: Final[Mapping[type, Callable[[PlatformView, Any, ReplyHeader], Reply | list[ManyReply]]]] = {
    GetTransformation: _get_transformation,
    GetBodyList: _get_body_list,
    GetBodyFrameList: _get_body_frame_list,
    GetStateVector: _get_state_vector,
    GetHTransform: _get_h_transform,
    GetHistory: _get_history,
    GetTransformations: _get_transformations,
    GetMotion: _get_motion,
    GetExplanation: _get_explanation,
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
