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
    MotionAnswer,
    MotionReply,
)
from modelserver.transforms.pose import Pose
from modelserver.wire import fields, poses
from modelserver.wire.fields import LENGTH, pack_text, read_text
from modelserver.wire.poses import pack_reply_header, unpack_reply_header

EDGE_KINDS: Final = ("frame", "constraint", "joint", "vehicle")
PROVENANCES: Final = ("fixed", "measured", "interpolated", "held", "predicted", "default")
"""What the numbers of path_edge_t mean, in their order."""

_MOTION = struct.Struct(">48d")
_EDGE = struct.Struct(">b7dbqd")
_SHARES = struct.Struct(">2d")


_NO_MOTION: Final = poses.NO_POSE_TRANSFORM + pack_text("") + _MOTION.pack(*(0.0,) * 48)
_NO_EXPLANATION: Final = poses.NO_POSE_TRANSFORM + LENGTH.pack(0)
"""What stands in a reply that has no answer."""


def _skip_nothing(data: bytes, at: int, nothing: bytes) -> int:
    """Return the end of a reply without an answer. Raises WireError where it does not end as one does."""
    if data[at:] != nothing:
        raise WireError("truncated" if len(data) - at < len(nothing) else "malformed", "no answer, and yet some of one")
    return len(data)


def pack_get_motion_reply(reply: MotionReply) -> bytes:
    """Return the bytes of a get_motion_reply_t without the fingerprint."""
    head = pack_reply_header(reply.header)
    answer = reply.answer
    if answer is None:
        return head + _NO_MOTION
    numbers = (*answer.velocity, *answer.angular_velocity, *answer.acceleration, *answer.angular_acceleration)
    return b"%b%b%b%b" % (
        head,
        poses.pack_pose_transform(answer.pose),
        pack_text(answer.expressed_in),
        _MOTION.pack(*numbers, *(fields.NAN36 if answer.covariance is None else answer.covariance)),
    )


def unpack_get_motion_reply(data: bytes, at: int) -> tuple[MotionReply, int]:
    """Return the get_motion_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is not Status.OK:
        return MotionReply(header), _skip_nothing(data, at, _NO_MOTION)
    pose, at = poses.unpack_pose_transform(data, at)
    expressed_in, at = read_text(data, at)
    numbers = _MOTION.unpack_from(data, at)
    covariance = numbers[12:]
    reply = MotionReply(
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
    return reply, at + _MOTION.size


def pack_get_explanation_reply(reply: ExplanationReply) -> bytes:
    """Return the bytes of a get_explanation_reply_t without the fingerprint."""
    head = pack_reply_header(reply.header)
    answer = reply.answer
    if answer is None:
        return head + _NO_EXPLANATION
    edges = b"".join(map(_pack_edge, answer.edges))
    return b"%b%b%b%b" % (head, poses.pack_pose_transform(answer.answer), LENGTH.pack(len(answer.edges)), edges)


def _pack_edge(edge: EdgeReport) -> bytes:
    return b"".join(
        (
            struct.pack(">b", EDGE_KINDS.index(edge.kind)),
            pack_text(edge.name),
            pack_text(edge.ends[0]),
            pack_text(edge.ends[1]),
            _EDGE.pack(
                edge.forward, *edge.pose.xyz, *edge.pose.wxyz, PROVENANCES.index(edge.provenance), edge.stamp, edge.age
            ),
            pack_text(edge.source),
            struct.pack(f">i{len(edge.coordinates)}d", len(edge.coordinates), *edge.coordinates),
            _SHARES.pack(edge.position_share, edge.rotation_share),
            pack_text(edge.warning),
        )
    )


def unpack_get_explanation_reply(data: bytes, at: int) -> tuple[ExplanationReply, int]:
    """Return the get_explanation_reply_t that begins at `at`, and its end. Raises WireError, struct.error."""
    header, at = unpack_reply_header(data, at)
    if header.status is not Status.OK:
        return ExplanationReply(header), _skip_nothing(data, at, _NO_EXPLANATION)
    pose, at = poses.unpack_pose_transform(data, at)
    (count,) = LENGTH.unpack_from(data, at)
    edges, at = fields.read_each(_read_edge, data, at + LENGTH.size, count)
    return ExplanationReply(header, Explanation(pose, edges)), at


def _read_edge(data: bytes, at: int) -> tuple[EdgeReport, int]:
    (kind,) = struct.unpack_from(">b", data, at)
    names = []
    at += 1
    for _ in range(3):
        name, at = read_text(data, at)
        names.append(name)
    forward, *vector, provenance, stamp, age = _EDGE.unpack_from(data, at)
    source, at = read_text(data, at + _EDGE.size)
    (count,) = struct.unpack_from(">i", data, at)
    if not 0 <= count <= 6:
        raise WireError("malformed", f"a joint has 0 to 6 coordinates, got {count}")
    coordinates = struct.unpack_from(f">{count}d", data, at + 4)
    at += 4 + 8 * count
    position, rotation = _SHARES.unpack_from(data, at)
    warning, at = read_text(data, at + _SHARES.size)
    if not (0 <= kind < len(EDGE_KINDS) and 0 <= provenance < len(PROVENANCES)):
        raise WireError("malformed", f"kind {kind} or provenance {provenance} of an edge is unknown")
    name, from_end, to_end = names
    edge = EdgeReport(
        EDGE_KINDS[kind],
        name,
        bool(forward),
        (from_end, to_end),
        Pose(vector[:3], vector[3:]),
        PROVENANCES[provenance],
        stamp,
        age,
        source,
        coordinates,
        position,
        rotation,
        warning,
    )
    return edge, at
