"""Codec: bytes of a wire type, and the values that the core exchanges."""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Final

from modelserver.errors import WireError
from modelserver.messages import PoseAnswer, RequestHeader
from modelserver.wire.fields import LENGTH, Codec, check_end, pack_text, read_text
from modelserver.wire.generated import CODECS, FINGERPRINTS
from modelserver.wire.poses import PLAIN, UTIME, read_transform_numbers

_BY_TYPE_NAME: Final[Mapping[str, Codec]] = {codec.type_name: codec for codec in CODECS}
_BY_VALUE: Final[Mapping[type, Codec]] = {codec.value: codec for codec in reversed(CODECS)}


def get_type_names() -> tuple[str, ...]:
    """Return the names of the wire types that can be decoded."""
    return tuple(_BY_TYPE_NAME)


def get_type_name(value_type: type) -> str:
    """Return the name of the wire type that a class of values is encoded as; see `encode`."""
    return _BY_VALUE[value_type].type_name


def fingerprint_of(type_name: str) -> bytes:
    """Return the eight bytes that a message of a wire type begins with."""
    return _BY_TYPE_NAME[type_name].fingerprint


def decode(type_name: str, data: bytes) -> Any:
    """Return the value in `data`, which should hold a message of the wire type `type_name`.

    Raises WireError with reason `fingerprint` (another type, or no message at all), `truncated` or `malformed`.
    """
    codec = _BY_TYPE_NAME[type_name]
    if data[:8] != codec.fingerprint:
        raise WireError("fingerprint", f"{len(data)} bytes are no {type_name}: the fingerprint differs")
    try:
        value, end = codec.unpack(data, 8)
        check_end(data, end)
        return value
    except WireError:
        raise
    except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise WireError("truncated", f"{len(data)} bytes are no whole {type_name}: {error}") from None


def encode(value: Any, type_name: str = "") -> bytes:
    """Return the bytes of a value; a pose becomes a pose_transform_t unless `type_name` is another."""
    codec = _BY_TYPE_NAME[type_name] if type_name else _BY_VALUE[type(value)]
    return codec.fingerprint + codec.pack(value)


# --- the hot path of a query --------------------------------------------------------------------------------
# The generated codec reads and writes these messages too; here they are packed without the values in between, and a
# reply that was read before is recognized by its bytes.

_TIME = struct.Struct(">qbi")
_AFTER_UTIME: Final = 24
"""Where a reply goes on behind fingerprint, id and stamp."""

_ANSWER_CACHE: Final[OrderedDict[bytes, PoseAnswer]] = OrderedDict()
_MAX_CACHED_ANSWERS: Final = 4096
"""Replies that hold for good, lately read, by their bytes from `_AFTER_UTIME` on: 2 kB each, the oldest goes when full.

A program that asks for more pairs reads each reply again, as it does a pair that it sees first; see `read_answer`.
"""

_PLAIN_OK: Final = b"\0\0" + PLAIN

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
    head = (_REQUEST, UTIME.pack(request_id), pack_text(channel), pack_text(interest), pack_text(reference))
    return b"%b%b%b%b%b%b" % (*head, _TIME.pack(at, policy, wait_ms))


def read_answer(data: bytes, interest: str, reference: str) -> PoseAnswer | None:
    """Return the answer of a get_transformation_reply_t to a question for these two frames; None: see the whole reply.

    What was asked need not be read again, only compared. A reply with a message or an error, or with other frames, is
    for `decode`. Raises WireError, struct.error.
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
    (utime,) = UTIME.unpack_from(data, at)
    answer, end = read_transform_numbers(data, at + 8 + len(names), utime, interest, reference)
    check_end(data, end)
    if not utime and answer.origin is None:
        if len(_ANSWER_CACHE) >= _MAX_CACHED_ANSWERS:
            _ANSWER_CACHE.popitem(last=False)
        _ANSWER_CACHE[data[_AFTER_UTIME:]] = answer
    return answer
