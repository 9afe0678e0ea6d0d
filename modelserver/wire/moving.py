"""How frames move, and what an answer rests on, between Python and wire, both ways."""

from __future__ import annotations

import math
import struct
from typing import Final

from modelserver.errors import Status, WireError
from modelserver.messages import (
    EdgeReport,
    Explanation,
    ExplanationReply,
    GetExplanation,
    GetMotion,
    MotionAnswer,
    MotionReply,
    RequestHeader,
)
from modelserver.spatial.pose import Pose
from modelserver.wire import fields, poses
from modelserver.wire.packed import LENGTH, check_end, read_text, text
from modelserver.wire.queries import header_body, read_header
from mslcm.get_explanation_reply_t import get_explanation_reply_t
from mslcm.get_explanation_request_t import get_explanation_request_t
from mslcm.get_motion_reply_t import get_motion_reply_t
from mslcm.get_motion_request_t import get_motion_request_t

KINDS: Final = ("frame", "constraint", "joint", "vehicle")
HOWS: Final = ("fixed", "measured", "interpolated", "held", "predicted", "at_rest")
"""What the numbers of path_edge_t mean, in their order."""

_ID = struct.Struct(">q")
_TIME = struct.Struct(">qbi")
_MOTION = struct.Struct(">48d")
_EDGE = struct.Struct(">b7dbqd")
_SHARES = struct.Struct(">2d")
_MOTION_REQUEST: Final[bytes] = get_motion_request_t._get_packed_fingerprint()
_MOTION_REPLY: Final[bytes] = get_motion_reply_t._get_packed_fingerprint()
_EXPLANATION_REQUEST: Final[bytes] = get_explanation_request_t._get_packed_fingerprint()
_EXPLANATION_REPLY: Final[bytes] = get_explanation_reply_t._get_packed_fingerprint()


_NO_MOTION: Final = poses.NO_TRANSFORM + text("") + _MOTION.pack(*(0.0,) * 48)
_NO_EXPLANATION: Final = poses.NO_TRANSFORM + LENGTH.pack(0)
"""What stands in a reply that has no answer."""


def _check_nothing(data: bytes, at: int, nothing: bytes) -> None:
    """Raise WireError where a reply without an answer does not end as one does."""
    if data[at:] != nothing:
        raise WireError("truncated" if len(data) - at < len(nothing) else "malformed", "no answer, and yet some of one")


def write_get_motion(request: GetMotion) -> bytes:
    """Return the bytes of a get_motion_request_t."""
    header, interest, reference, expressed_in, time = request
    names = text(header.reply_channel) + text(interest) + text(reference) + text(expressed_in)
    return b"%b%b%b%b" % (_MOTION_REQUEST, _ID.pack(header.request_id), names, _TIME.pack(*time))


def read_get_motion(data: bytes) -> GetMotion:
    """Return the request in the bytes of a get_motion_request_t. Raises WireError, struct.error."""
    (request_id,) = _ID.unpack_from(data, 8)
    channel, at = read_text(data, 16)
    names = []
    for _ in range(3):
        name, at = read_text(data, at)
        names.append(fields.frame_name(name, "frame"))
    time = fields.time_query(*_TIME.unpack_from(data, at))
    check_end(data, at + _TIME.size)
    interest, reference, expressed_in = names
    return GetMotion(RequestHeader(request_id, channel), interest, reference, expressed_in, time)


def write_motion_reply(reply: MotionReply) -> bytes:
    """Return the bytes of a get_motion_reply_t."""
    head = _MOTION_REPLY + header_body(reply.header)
    answer = reply.answer
    if answer is None:
        return head + _NO_MOTION
    numbers = (*answer.velocity, *answer.rate, *answer.acceleration, *answer.turn_acceleration)
    return b"%b%b%b%b" % (
        head,
        poses.transform_body(answer.pose),
        text(answer.expressed_in),
        _MOTION.pack(*numbers, *(fields.NAN36 if answer.covariance is None else answer.covariance)),
    )


def read_motion_reply(data: bytes) -> MotionReply:
    """Return the reply in the bytes of a get_motion_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    if header.status is not Status.OK:
        _check_nothing(data, at, _NO_MOTION)
        return MotionReply(header)
    pose, at = poses.read_transform_body(data, at)
    expressed_in, at = read_text(data, at)
    numbers = _MOTION.unpack_from(data, at)
    check_end(data, at + _MOTION.size)
    covariance = numbers[12:]
    return MotionReply(
        header,
        MotionAnswer(
            pose,
            expressed_in,
            numbers[0:3],
            numbers[3:6],
            numbers[6:9],
            numbers[9:12],
            None if math.isnan(covariance[0]) else covariance,
        ),
    )


def write_get_explanation(request: GetExplanation) -> bytes:
    """Return the bytes of a get_explanation_request_t."""
    header, interest, reference, time = request
    return b"%b%b%b%b%b%b" % (
        _EXPLANATION_REQUEST,
        _ID.pack(header.request_id),
        text(header.reply_channel),
        _TIME.pack(*time),
        text(interest),
        text(reference),
    )


def read_get_explanation(data: bytes) -> GetExplanation:
    """Return the request in the bytes of a get_explanation_request_t. Raises WireError, struct.error."""
    (request_id,) = _ID.unpack_from(data, 8)
    channel, at = read_text(data, 16)
    time = fields.time_query(*_TIME.unpack_from(data, at))
    interest, at = read_text(data, at + _TIME.size)
    reference, at = read_text(data, at)
    check_end(data, at)
    return GetExplanation(
        RequestHeader(request_id, channel),
        fields.frame_name(interest, "frame_of_interest"),
        fields.frame_name(reference, "frame_of_reference"),
        time,
    )


def write_explanation_reply(reply: ExplanationReply) -> bytes:
    """Return the bytes of a get_explanation_reply_t."""
    head = _EXPLANATION_REPLY + header_body(reply.header)
    answer = reply.answer
    if answer is None:
        return head + _NO_EXPLANATION
    edges = b"".join(map(_edge_body, answer.edges))
    return b"%b%b%b%b" % (head, poses.transform_body(answer.answer), LENGTH.pack(len(answer.edges)), edges)


def _edge_body(edge: EdgeReport) -> bytes:
    return b"".join(
        (
            struct.pack(">b", KINDS.index(edge.kind)),
            text(edge.name),
            text(edge.ends[0]),
            text(edge.ends[1]),
            _EDGE.pack(edge.forward, *edge.pose.xyz, *edge.pose.wxyz, HOWS.index(edge.how), edge.stamp, edge.age),
            text(edge.source),
            struct.pack(f">i{len(edge.coordinates)}d", len(edge.coordinates), *edge.coordinates),
            _SHARES.pack(edge.position_share, edge.rotation_share),
            text(edge.doubt),
        )
    )


def read_explanation_reply(data: bytes) -> ExplanationReply:
    """Return the reply in the bytes of a get_explanation_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    if header.status is not Status.OK:
        _check_nothing(data, at, _NO_EXPLANATION)
        return ExplanationReply(header)
    pose, at = poses.read_transform_body(data, at)
    (count,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    edges = []
    for _ in range(count):
        edge, at = _read_edge(data, at)
        edges.append(edge)
    check_end(data, at)
    return ExplanationReply(header, Explanation(pose, tuple(edges)))


def _read_edge(data: bytes, at: int) -> tuple[EdgeReport, int]:
    (kind,) = struct.unpack_from(">b", data, at)
    names = []
    at += 1
    for _ in range(3):
        name, at = read_text(data, at)
        names.append(name)
    forward, *vector, how, stamp, age = _EDGE.unpack_from(data, at)
    source, at = read_text(data, at + _EDGE.size)
    (count,) = struct.unpack_from(">i", data, at)
    if not 0 <= count <= 6:
        raise WireError("malformed", f"a joint has 0 to 6 coordinates, got {count}")
    coordinates = struct.unpack_from(f">{count}d", data, at + 4)
    at += 4 + 8 * count
    position, rotation = _SHARES.unpack_from(data, at)
    doubt, at = read_text(data, at + _SHARES.size)
    if not (0 <= kind < len(KINDS) and 0 <= how < len(HOWS)):
        raise WireError("malformed", f"an edge of kind {kind}, come by as {how}: cannot be")
    name, from_end, to_end = names
    edge = EdgeReport(
        KINDS[kind],
        name,
        bool(forward),
        (from_end, to_end),
        Pose(vector[:3], vector[3:]),
        HOWS[how],
        stamp,
        age,
        source,
        coordinates,
        position,
        rotation,
        doubt,
    )
    return edge, at
