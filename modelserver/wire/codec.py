"""Codec: bytes of a wire type, and the values that the core exchanges; with shortcuts on the hot path of a query.

Behind it: what can be read and changed in a message without decoding it, and the parts of the geometry's snapshot.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Final

from modelserver.errors import Status, WireError
from modelserver.messages import Policy, PoseAnswer, PoseDemand, Reply, RequestHeader, SnapshotPart, TransformReply
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.fields import (
    LENGTH,
    MAX_UTIME,
    PLAIN,
    UTIME,
    Codec,
    check_end,
    pack_text,
    read_text,
    read_transform_numbers,
)
from modelserver.wire.generated import CODECS, FINGERPRINTS
from modelserver.wire.journal import MAGIC

_BY_TYPE_NAME: Final[Mapping[str, Codec]] = {codec.type_name: codec for codec in CODECS}
_BY_VALUE: Final[Mapping[type, Codec]] = {codec.value: codec for codec in reversed(CODECS)}


def get_type_names() -> tuple[str, ...]:
    return tuple(_BY_TYPE_NAME)


def get_type_name(value_type: type) -> str:
    """Return the name of the wire type that a class of values is encoded as; see `encode`."""
    return _BY_VALUE[value_type].type_name


def fingerprint_of(type_name: str) -> bytes:
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
_DEMAND = struct.Struct(">4d")
_END: Final = _TIME.size + _DEMAND.size
"""Bytes of a request behind the names: time and demand."""

_NO_DEMAND: Final = bytes(_DEMAND.size)
_MET: Final = bytes(4) + pack_text("")
"""End of a reply in which nothing is unmet."""

_AFTER_UTIME: Final = 24
"""Offset in a reply behind fingerprint, request id and utime."""

_ANSWER_CACHE: Final[OrderedDict[bytes, PoseAnswer]] = OrderedDict()
_MAX_CACHED_ANSWERS: Final = 4096
"""Replies that hold for good, lately read, by their bytes from `_AFTER_UTIME` on: 2 kB each, the oldest goes when full.

A program that asks for more pairs reads each reply again, as it does a pair that it sees first; see `read_answer`.
"""

_PLAIN_OK: Final = b"\0\0" + PLAIN

CACHED_TYPE: Final = "get_transformation_request_t"
"""The only type of request whose replies are cached."""

MAX_ENTRIES: Final = 16_384
"""Entries: all pairs of 128 frames, some 10 MB."""

MAX_PAIR_BYTES: Final = 512
"""Bytes of both names; longer ones are not cached."""

_CHANNEL: Final = 20
"""Offset of the reply channel in a request: behind fingerprint, id and the channel's length."""

_LAST_POLICY: Final = max(Policy)
_NOW: Final = bytes(_END)
"""End of a request at the present time with the default policy, without waiting and without a demand."""
_REQUEST: Final = FINGERPRINTS[CACHED_TYPE]
_REPLY: Final = FINGERPRINTS["get_transformation_reply_t"]


def read_request_header(data: bytes) -> RequestHeader | None:
    """Return the header that every request begins with, None where not even that can be read."""
    try:
        channel, _ = read_text(data, 16)
    except (WireError, struct.error):
        return None
    return RequestHeader(int.from_bytes(data[8:16], "big", signed=True), channel)


def pack_get_transformation(
    request_id: int,
    channel: str,
    interest: str,
    reference: str,
    at: int,
    policy: int,
    wait_ms: int,
    demand: PoseDemand | None = None,
) -> bytes:
    """Return the bytes of a get_transformation_request_t, without the values that it is made of."""
    head = (_REQUEST, UTIME.pack(request_id), pack_text(channel), pack_text(interest), pack_text(reference))
    end = _NO_DEMAND if demand is None else _DEMAND.pack(*demand)
    return b"%b%b%b%b%b%b%b" % (*head, _TIME.pack(at, policy, wait_ms), end)


def read_answer(data: bytes, interest: str, reference: str) -> PoseAnswer | None:
    """Return the answer of a get_transformation_reply_t to a question for these two frames; None: see the whole reply.

    What was asked need not be read again, only compared. A reply with a message or an error, with other frames, or with
    anything unmet is for `decode`. Raises WireError, struct.error.
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
    if data[end:] != _MET:
        return None
    if not utime and answer.origin is None:
        if len(_ANSWER_CACHE) >= _MAX_CACHED_ANSWERS:
            _ANSWER_CACHE.popitem(last=False)
        _ANSWER_CACHE[data[_AFTER_UTIME:]] = answer
    return answer


class StaticReplyCache:
    """LRU cache of the encoded static replies (static transforms) of one model, by the pair of frames.

    Most queries are about rigidly mounted frames, and their answers hold until the model changes. The bytes of such a
    reply differ only in request id and utime, and do not depend on the client. So the pair of names in the bytes of a
    request leads to the rest of the reply, without decoding, core or encoding. The capacity is the number of pairs of
    the model's frames, within a limit; the least recently used entry is evicted.
    """

    def __init__(self) -> None:
        self._entries: OrderedDict[bytes, bytes] = OrderedDict()
        self._model: object = None
        self._capacity = 0

    def __len__(self) -> int:
        return len(self._entries)

    def reset(self, model: object, frames: int) -> None:
        """Clear the cache for another model with so many frames."""
        self._entries.clear()
        self._model = model
        self._capacity = min(max(frames, 1) ** 2, MAX_ENTRIES)

    def is_of(self, model: object) -> bool:
        return model is self._model

    def find(self, request: bytes, client: bytes, utime: int) -> bytes | None:
        """Return the bytes of the reply to a get_transformation_request_t; None where it is not cached.

        `client` is the reply channel in the bytes of the request.
        """
        pair = request[_CHANNEL + len(client) : -_END]
        rest = self._entries.get(pair)
        if rest is None or request[:8] != _REQUEST:
            return None
        self._entries.move_to_end(pair)
        if not request.endswith(_NOW):
            at, policy, wait_ms = _TIME.unpack_from(request, len(request) - _END)
            if not (0 <= at < MAX_UTIME and 0 <= policy <= _LAST_POLICY and wait_ms >= 0):
                return None
            if not request.endswith(_NO_DEMAND):
                return None
        return b"%b%b%b%b" % (_REPLY, request[8:16], UTIME.pack(utime), rest)

    def add(self, request: bytes, client: bytes, reply: Reply, encoded: bytes) -> None:
        """Cache a reply to a request, if it does not depend on time; `encoded` are its bytes."""
        if not isinstance(reply, TransformReply) or reply.header.status is not Status.OK or reply.answer is None:
            return
        pair = request[_CHANNEL + len(client) : -_END]
        if reply.answer.transformation.utime or len(pair) > MAX_PAIR_BYTES or not request.endswith(_NO_DEMAND):
            return
        if len(self._entries) >= self._capacity:
            self._entries.popitem(last=False)
        self._entries[pair] = encoded[_AFTER_UTIME:]


# --- encoded messages, without decoding them --------------------------------------------------------------------------

_INPUTS: Final = frozenset(
    FINGERPRINTS[channel.type_name]
    for channel in CHANNELS
    # signed commands are no inputs for playback: signatures protect against replayed commands
    if channel.use in (ChannelUse.SENSOR, ChannelUse.COMMAND) and channel.type_name != "signed_t"
)
_SERVICE: Final = frozenset(codec.fingerprint for codec in CODECS) - _INPUTS | {MAGIC}
_STAMPED: Final = frozenset(
    codec.fingerprint for codec in CODECS if codec.value.__annotations__.get("header") == "SensorHeader"
)
_TYPES: Final = {fingerprint: name for name, fingerprint in FINGERPRINTS.items()}


def type_name_of(data: bytes) -> str:
    """Return the name of the wire type of a message, empty for a foreign type."""
    return _TYPES.get(data[:8], "")


def is_stamped(data: bytes) -> bool:
    """Return whether a message begins with a sensor header: a sample, or a localization mode command."""
    return data[:8] in _STAMPED


def is_of_service(data: bytes) -> bool:
    """Return whether a message is a report, request, signed command or reply of the service, or a journal section."""
    return data[:8] in _SERVICE


_STAMPS = struct.Struct(">qdq")
"""First fields of the sensor header, behind the fingerprint: utime, utime_sigma, host_utime."""

_SINCE = struct.Struct(">q")
_SOURCE_AT: Final = 48
"""Offset of the source, the last field of the sensor header."""

_RELATIVE: Final = FINGERPRINTS["relative_pose_t"]


def restamp(data: bytes, shift: int) -> bytes:
    """Return a stamped message with its stamps shifted by `shift` microseconds; other messages are returned unchanged.

    The stamps are utime, host_utime, and since_utime of a relative pose.
    """
    if not is_stamped(data) or len(data) < 8 + _STAMPS.size:
        return data
    utime, sigma, host_utime = _STAMPS.unpack_from(data, 8)
    restamped = bytearray(data)
    try:
        _STAMPS.pack_into(restamped, 8, utime + shift, sigma, host_utime + shift if host_utime else 0)
        if data[:8] == _RELATIVE:
            # since_utime is the first field behind the header
            _, at = read_text(data, _SOURCE_AT)
            (since,) = _SINCE.unpack_from(data, at)
            _SINCE.pack_into(restamped, at, since + shift)
    except (WireError, struct.error):
        return data  # damaged: the receiver counts it
    return bytes(restamped)


# --- the geometry's snapshot ------------------------------------------------------------------------------------------

PART_BYTES: Final = 1200
"""Of payload: with its header a part fits an Ethernet frame, so that none is lost for a piece of it."""


def split_snapshot(data: bytes, revision: str, utime: int) -> list[SnapshotPart]:
    """Return the parts of a snapshot's bytes."""
    pieces = [data[start : start + PART_BYTES] for start in range(0, len(data), PART_BYTES)]
    return [SnapshotPart(utime, revision, number, len(pieces), piece) for number, piece in enumerate(pieces)]


class SnapshotAssembler:
    """Puts the parts of snapshots together, in whatever order they come; holds one revision at a time."""

    def __init__(self) -> None:
        self._revision = ""
        self._count = 0
        self._parts: dict[int, bytes] = {}

    def add(self, part: SnapshotPart) -> bytes | None:
        """Take a part; return the whole when it is complete, None before."""
        if (part.model_revision, part.parts) != (self._revision, self._count):
            self._revision, self._count, self._parts = part.model_revision, part.parts, {}
        self._parts[part.part] = part.data
        if len(self._parts) < self._count:
            return None
        whole = b"".join(self._parts[number] for number in range(self._count))
        self._parts = {}
        return whole
