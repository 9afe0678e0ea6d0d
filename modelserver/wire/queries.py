"""The hot path of a query: the headers, and the question and answer that are exchanged with every lookup.

The generated codec reads and writes these too; here they are packed without the values in between, and a reply that
was read before is recognized by its bytes.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from typing import Final

from modelserver.errors import Status, WireError
from modelserver.messages import PoseAnswer, ReplyHeader, RequestHeader
from modelserver.wire import poses
from modelserver.wire.fields import COUNT, LENGTH, check_count, check_end, pack_text, read_enum, read_text, read_texts
from modelserver.wire.fingerprints import FINGERPRINTS

_REQUEST_ID = struct.Struct(">q")
_TIME = struct.Struct(">qbi")
_UTIME = struct.Struct(">q")
_REPLY_HEAD = struct.Struct(">qqh")

_AFTER_UTIME: Final = 24
"""Where a reply goes on behind fingerprint, id and stamp."""

_ANSWER_CACHE: Final[OrderedDict[bytes, PoseAnswer]] = OrderedDict()
_MAX_CACHED_ANSWERS: Final = 4096
"""Replies that hold for good, lately read, by their bytes from `_AFTER_UTIME` on: 2 kB each, the oldest goes when full.

A program that asks for more pairs reads each reply again, as it does a pair that it sees first; see `read_answer`.
"""

_PLAIN: Final = pack_text("") + LENGTH.pack(0)
_PLAIN_AT: Final = 8 + _REPLY_HEAD.size
_PLAIN_OK: Final = b"\0\0" + _PLAIN
"""The part of a reply's header that is the same in each reply with an answer: no message, no nearest names."""

_REQUEST: Final = FINGERPRINTS["get_transformation_request_t"]
_REPLY: Final = FINGERPRINTS["get_transformation_reply_t"]


def read_request_header(data: bytes) -> RequestHeader | None:
    """Return the header that every request begins with, None where not even that can be read."""
    try:
        channel, _ = read_text(data, 16)
    except (WireError, struct.error):
        return None
    return RequestHeader(int.from_bytes(data[8:16], "big", signed=True), channel)


def pack_get_transformation(
    request_id: int, channel: str, interest: str, reference: str, at: int, policy: int, wait_ms: int
) -> bytes:
    """Return the bytes of a get_transformation_request_t, without the values that it is made of."""
    head = (_REQUEST, _REQUEST_ID.pack(request_id), pack_text(channel), pack_text(interest), pack_text(reference))
    return b"%b%b%b%b%b%b" % (*head, _TIME.pack(at, policy, wait_ms))


def read_answer(data: bytes, interest: str, reference: str) -> PoseAnswer | None:
    """Return the answer of a get_transformation_reply_t to a question for these two frames; None: see the whole reply.

    What was asked need not be read again, only compared. A reply with a message or an error, or with other frames, is
    one for `read_transform_reply`. Raises WireError, struct.error.
    """
    if data[:8] != _REPLY or data[_AFTER_UTIME : _AFTER_UTIME + len(_PLAIN_OK)] != _PLAIN_OK:
        return None
    known = _ANSWER_CACHE.get(data[_AFTER_UTIME:])
    if known is not None:
        return known
    (length,) = LENGTH.unpack_from(data, _AFTER_UTIME + len(_PLAIN_OK))
    # the revision of the header stands in the pose too, and is read there
    at = _AFTER_UTIME + len(_PLAIN_OK) + LENGTH.size + length
    names = pack_text(interest) + pack_text(reference)
    if not data.startswith(names, at + 8):
        return None
    (utime,) = _UTIME.unpack_from(data, at)
    answer, end = poses.read_transform_numbers(data, at + 8 + len(names), utime, interest, reference)
    check_end(data, end)
    if not utime and answer.origin is None:
        if len(_ANSWER_CACHE) >= _MAX_CACHED_ANSWERS:
            _ANSWER_CACHE.popitem(last=False)
        _ANSWER_CACHE[data[_AFTER_UTIME:]] = answer
    return answer


def pack_reply_header(header: ReplyHeader) -> bytes:
    """Return the bytes of a reply_header_t without its fingerprint."""
    if not header.message and not header.nearest:
        head = _REPLY_HEAD.pack(header.request_id, header.utime, header.status)
        return b"%b%b%b" % (head, _PLAIN, pack_text(header.model_revision))
    return b"%b%b%b%b%b" % (
        _REPLY_HEAD.pack(header.request_id, header.utime, header.status),
        pack_text(header.message),
        LENGTH.pack(len(header.nearest)),
        b"".join(map(pack_text, header.nearest)),
        pack_text(header.model_revision),
    )


def unpack_reply_header(data: bytes, at: int) -> tuple[ReplyHeader, int]:
    """Return the reply_header_t that begins at `at`, and its end. Raises WireError, struct.error."""
    request_id, utime, status = _REPLY_HEAD.unpack_from(data, at)
    at += _REPLY_HEAD.size
    if status == 0 and data[at : at + len(_PLAIN)] == _PLAIN:
        revision, at = read_text(data, at + len(_PLAIN))
        return ReplyHeader(request_id, utime, model_revision=revision), at
    message, at = read_text(data, at)
    (count,) = COUNT.unpack_from(data, at)
    check_count(count, "num_nearest")
    nearest, at = read_texts(data, at + COUNT.size, count)
    revision, at = read_text(data, at)
    return ReplyHeader(request_id, utime, read_enum(Status, status, "status"), message, nearest, revision), at
