"""The question for a transformation, and the replies that carry poses, packed by hand (see `packed`)."""

from __future__ import annotations

import struct
from collections import OrderedDict
from typing import Final

from modelserver.errors import Status
from modelserver.messages import (
    GetTransformation,
    HistoryReply,
    PoseAnswer,
    ReplyHeader,
    RequestHeader,
    StateVectorReply,
    TransformReply,
)
from modelserver.wire import fields, poses
from modelserver.wire.packed import LENGTH, check_end, read_text, text
from mslcm.get_history_reply_t import get_history_reply_t
from mslcm.get_state_vector_reply_t import get_state_vector_reply_t
from mslcm.get_transformation_reply_t import get_transformation_reply_t
from mslcm.get_transformation_request_t import get_transformation_request_t

_REQUEST_ID = struct.Struct(">q")
_TIME = struct.Struct(">qbi")
_UTIME = struct.Struct(">q")
_REPLY_HEAD = struct.Struct(">qqh")

_STAMPED: Final = 24
"""Where a reply goes on behind fingerprint, id and stamp."""

_KNOWN: Final[OrderedDict[bytes, PoseAnswer]] = OrderedDict()
_MOST_KNOWN: Final = 4096
"""Replies that hold for good, lately read, by their bytes from `_STAMPED` on: 2 kB each, the oldest goes when full.

A program that asks for more pairs reads each reply again, as it does a pair that it sees first; see `read_answer`.
"""

_PLAIN: Final = text("") + LENGTH.pack(0)
_PLAIN_AT: Final = 8 + _REPLY_HEAD.size
_PLAIN_OK: Final = b"\0\0" + _PLAIN
"""No message and no nearest names: what a reply says that has an answer, and where it says so."""

_REQUEST: Final[bytes] = get_transformation_request_t._get_packed_fingerprint()
_TRANSFORM_REPLY: Final[bytes] = get_transformation_reply_t._get_packed_fingerprint()
_VECTOR_REPLY: Final[bytes] = get_state_vector_reply_t._get_packed_fingerprint()
_HISTORY_REPLY: Final[bytes] = get_history_reply_t._get_packed_fingerprint()


def write_request(request: GetTransformation) -> bytes:
    """Return the bytes of a get_transformation_request_t."""
    header, interest, reference, time = request
    return write_question(header.request_id, header.reply_channel, interest, reference, *time)


def write_question(
    request_id: int, channel: str, interest: str, reference: str, at: int, policy: int, wait_ms: int
) -> bytes:
    """Return the bytes of a get_transformation_request_t, without the values that it is made of."""
    head = (_REQUEST, _REQUEST_ID.pack(request_id), text(channel), text(interest), text(reference))
    return b"%b%b%b%b%b%b" % (*head, _TIME.pack(at, policy, wait_ms))


def read_request(data: bytes) -> GetTransformation:
    """Return the request in the bytes of a get_transformation_request_t. Raises WireError, struct.error."""
    (request_id,) = _REQUEST_ID.unpack_from(data, 8)
    channel, at = read_text(data, 16)
    interest, at = read_text(data, at)
    reference, at = read_text(data, at)
    time = fields.time_query(*_TIME.unpack_from(data, at))
    check_end(data, at + _TIME.size)
    return GetTransformation(RequestHeader(request_id, channel), interest, reference, time)


def write_transform_reply(reply: TransformReply) -> bytes:
    """Return the bytes of a get_transformation_reply_t."""
    body = poses.NO_TRANSFORM if reply.answer is None else poses.transform_body(reply.answer)
    return _TRANSFORM_REPLY + header_body(reply.header) + body


def read_transform_reply(data: bytes) -> TransformReply:
    """Return the reply in the bytes of a get_transformation_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    if header.status is not Status.OK:
        poses.check_no_transform(data, at)
        return TransformReply(header)
    answer, end = poses.read_transform_body(data, at)
    check_end(data, end)
    return TransformReply(header, answer)


def read_answer(data: bytes, interest: str, reference: str) -> PoseAnswer | None:
    """Return the answer of a get_transformation_reply_t to a question for these two frames; None: see the whole reply.

    What was asked need not be read again, only compared. A reply with a message or an error, or with other frames, is
    one for `read_transform_reply`. Raises WireError, struct.error.
    """
    if data[:8] != _TRANSFORM_REPLY or data[_STAMPED : _STAMPED + len(_PLAIN_OK)] != _PLAIN_OK:
        return None
    known = _KNOWN.get(data[_STAMPED:])
    if known is not None:
        return known
    (length,) = LENGTH.unpack_from(data, _STAMPED + len(_PLAIN_OK))
    # the revision of the header stands in the pose too, and is read there
    at = _STAMPED + len(_PLAIN_OK) + LENGTH.size + length
    names = text(interest) + text(reference)
    if not data.startswith(names, at + 8):
        return None
    (utime,) = _UTIME.unpack_from(data, at)
    answer, end = poses.read_transform_numbers(data, at + 8 + len(names), utime, interest, reference)
    check_end(data, end)
    if not utime and answer.origin is None:
        if len(_KNOWN) >= _MOST_KNOWN:
            _KNOWN.popitem(last=False)
        _KNOWN[data[_STAMPED:]] = answer
    return answer


def write_state_vector_reply(reply: StateVectorReply) -> bytes:
    """Return the bytes of a get_state_vector_reply_t."""
    body = poses.NO_VECTOR if reply.answer is None else poses.vector_body(reply.answer)
    return _VECTOR_REPLY + header_body(reply.header) + body


def read_state_vector_reply(data: bytes) -> StateVectorReply:
    """Return the reply in the bytes of a get_state_vector_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    if header.status is not Status.OK:
        poses.check_no_vector(data, at)
        return StateVectorReply(header)
    answer, end = poses.read_vector_body(data, at)
    check_end(data, end)
    return StateVectorReply(header, answer)


def write_history_reply(reply: HistoryReply) -> bytes:
    """Return the bytes of a get_history_reply_t."""
    bodies = b"".join(map(poses.vector_body, reply.answers))
    return b"%b%b%b%b" % (_HISTORY_REPLY, header_body(reply.header), LENGTH.pack(len(reply.answers)), bodies)


def read_history_reply(data: bytes) -> HistoryReply:
    """Return the reply in the bytes of a get_history_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    (count,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    answers = []
    for _ in range(count):
        answer, at = poses.read_vector_body(data, at)
        answers.append(answer)
    check_end(data, at)
    return HistoryReply(header, tuple(answers))


def header_body(header: ReplyHeader) -> bytes:
    """Return the bytes of a reply_header_t without its fingerprint."""
    if not header.message and not header.nearest:
        head = _REPLY_HEAD.pack(header.request_id, header.utime, header.status)
        return b"%b%b%b" % (head, _PLAIN, text(header.model_revision))
    return b"%b%b%b%b%b" % (
        _REPLY_HEAD.pack(header.request_id, header.utime, header.status),
        text(header.message),
        LENGTH.pack(len(header.nearest)),
        b"".join(map(text, header.nearest)),
        text(header.model_revision),
    )


def read_header(data: bytes) -> tuple[ReplyHeader, int]:
    """Return the header that a reply begins with, and where it ends. Raises WireError, struct.error."""
    request_id, utime, status = _REPLY_HEAD.unpack_from(data, 8)
    if status == 0 and data[_PLAIN_AT : _PLAIN_AT + len(_PLAIN)] == _PLAIN:
        revision, at = read_text(data, _PLAIN_AT + len(_PLAIN))
        return ReplyHeader(request_id, utime, model_revision=revision), at
    message, at = read_text(data, _PLAIN_AT)
    (count,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    nearest = []
    for _ in range(count):
        name, at = read_text(data, at)
        nearest.append(name)
    revision, at = read_text(data, at)
    known = fields.member(Status, status, "status")
    return ReplyHeader(request_id, utime, known, message, tuple(nearest), revision), at
