"""Byte format of the journal: LCM event logs of the inputs and outputs of a service, in processing order.

Received and published messages are ordinary events on their own channels, unchanged, so that any LCM tool reads them.
Sections of the journal's own are events on `CHANNEL`. A seal closes a batch of records: it holds the type and instant
of each record before it, the records that never were on a bus (ticks, rejections, warnings), and a CRC over the whole
batch. A batch is accepted as a whole or not at all; `read_segment` resynchronizes at the next section after damage.

    segment = head, state, (batch, seal) ..., end

`encode_*` and `read_segment` are pure functions between records and bytes. `server.journal.writer` links segments.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple, TypeAlias

from modelserver.messages import MAX_CHANNEL_LENGTH
from modelserver.wire.eventlog import Buffer, LogDamage, LogEvent, encode_event, scan
from modelserver.wire.fields import MAX_UTIME

CHANNEL: Final = "MODELSERVER_JOURNAL"

MAGIC: Final = b"MSjrnl1\n"
"""In place of a message's fingerprint."""

FORMAT: Final = 4


class SectionType(IntEnum):
    """Type of a section of the journal's own."""

    HEAD = 1
    STATE = 3
    SEAL = 4
    END = 5


class RecordKind(IntEnum):
    """Type of a record.

    PUBLISHED: a published message. SAMPLE: a sensor sample or a mode command. REQUEST: answered by the core; CACHED:
    answered from the reply cache; OVERLOAD: dropped for lack of time; MALFORMED, FAILED: answered with an error.
    UNDECODABLE: bytes that are no message of their channel. DROPPED: a sample that is not used, as that of a
    conflicting publisher. EVENT: an event of the service's own, encoded by the schema of the segment. DEFERRED_PART:
    the next messages of the deferred reply were sent, as many as its four bytes state.
    """

    PUBLISHED = 0
    SAMPLE = 1
    REQUEST = 2
    CACHED = 3
    OVERLOAD = 4
    MALFORMED = 5
    FAILED = 6
    UNDECODABLE = 7
    DROPPED = 8
    EVENT = 9
    DEFERRED_PART = 10


class JournalRecord(NamedTuple):
    """An input or a published message, at an instant: monotonic clock in ns, and utime.

    A published message has no monotonic time of its own, and the utime of the input that it results from. `at` is the
    byte offset in the segment.
    """

    kind: RecordKind
    monotonic_ns: int
    utime: int
    channel: str
    data: bytes
    at: int = 0


@dataclass(frozen=True, slots=True)
class SegmentHead:
    """Head of a segment: who wrote it, and its link to the previous segment."""

    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class SegmentState:
    """State of the service at the start of the segment."""

    data: bytes


@dataclass(frozen=True, slots=True)
class SegmentEnd:
    """End of a closed segment.

    `digest` is the SHA-256 of all bytes before it, `is_intact` whether they match it. `mac` authenticates the writer,
    empty for a journal without a key.
    """

    is_intact: bool
    digest: bytes
    mac: bytes = b""

    @property
    def seal(self) -> bytes:
        """Seal that the head of the next segment repeats."""
        return self.mac or self.digest


@dataclass(frozen=True, slots=True)
class CorruptRegion:
    """Unusable bytes of a segment. `tail`: nothing usable follows."""

    start: int
    length: int
    reason: str
    tail: bool = False

    def __str__(self) -> str:
        return f"{self.length} bytes at byte {self.start}: {self.reason}"


Item: TypeAlias = SegmentHead | SegmentState | JournalRecord | SegmentEnd | CorruptRegion

_OWN = struct.Struct(">8sBI")  # magic, part, checksum of what follows
_DIGEST: Final = 32

_TIMES: Final = 20
"""Bytes of an event before its lengths: sync word, number, time."""

_SEAL = struct.Struct(">II")  # number of the batch, count of events before the seal
_INLINE = struct.Struct(">BqqHI")  # kind, instant, lengths of channel and data
_RECEIVED = struct.Struct(">Bq")
_INLINE_FLAG: Final = 0x80
"""Flag of a record that is contained in the seal, with channel and data."""

_NAME: Final = CHANNEL.encode()


def _encode_section(part: SectionType, utime: int, body: bytes, before: int = 0) -> bytes:
    """Encode a section; its CRC continues from `before`, the CRC of the batch that it closes."""
    return encode_event(0, utime, _NAME, _OWN.pack(MAGIC, part, zlib.crc32(body, before)) + body)


def encode_head(facts: dict[str, Any], utime: int) -> bytes:
    return _encode_section(SectionType.HEAD, utime, json.dumps(facts).encode())


def encode_state(data: bytes, utime: int) -> bytes:
    return _encode_section(SectionType.STATE, utime, data)


def encode_end(digest: bytes, utime: int, mac: bytes = b"") -> bytes:
    """Encode the end of a segment; see `SegmentEnd`."""
    return _encode_section(SectionType.END, utime, digest + mac)


def encode_batch(number: int, records: Iterable[JournalRecord]) -> bytes:
    """Encode a batch with its seal. Channels must be encodable text, times 63 bits."""
    events: list[bytes] = []
    entries: list[bytes] = []
    utime = 0
    for kind, monotonic_ns, utime, channel, data, _ in records:
        if kind >= RecordKind.EVENT or not _is_plain(channel) or not 0 <= utime < MAX_UTIME:
            name = channel.encode()
            entries.append(_INLINE.pack(kind | _INLINE_FLAG, monotonic_ns, utime, len(name), len(data)) + name + data)
            continue
        events.append(encode_event(len(events), utime, channel.encode(), data))
        entries.append(b"\0" if kind == RecordKind.PUBLISHED else _RECEIVED.pack(kind, monotonic_ns))
    batch = b"".join(events)
    body = _SEAL.pack(number, len(events)) + b"".join(entries)
    return batch + _encode_section(SectionType.SEAL, min(max(utime, 0), MAX_UTIME - 1), body, zlib.crc32(batch))


def _is_plain(channel: str) -> bool:
    """Return whether a channel is valid in a log and is not the journal's own."""
    return 0 < len(channel) <= MAX_CHANNEL_LENGTH and channel.isascii() and channel != CHANNEL


def read_segment(data: Buffer) -> Iterator[Item]:
    """Yield the contents of a segment in order, with `CorruptRegion` in place of unusable bytes. Raises nothing."""
    waiting: list[tuple[int, LogEvent]] = []
    start = at = 0
    expected = 0
    broken = ""
    for each in scan(data):
        if isinstance(each, LogDamage):
            broken = "no events"
            at = each.start + each.length
            continue
        begin, at = at, each.end
        if each.channel != CHANNEL:
            waiting.append((begin, each))
            continue
        own = _decode_section_head(each.data)
        if own is None:
            broken = "a damaged section"
            continue
        part, check, body = own
        sealed = part is SectionType.SEAL
        crc = zlib.crc32(body, zlib.crc32(data[start:begin])) if sealed else zlib.crc32(body)
        found: list[Item] | None = None
        if not broken and crc == check and (sealed or not waiting):
            found = (
                _decode_batch(body, waiting, expected, begin) if sealed else _decode_section(part, body, data, begin)
            )
        if found is None:
            why = broken or ("the checksum is wrong" if crc != check else "batches are missing or out of order")
            yield CorruptRegion(start, at - start, why)
        else:
            yield from found
        if sealed and len(body) >= _SEAL.size:
            expected = _SEAL.unpack_from(body)[0] + 1
        waiting, start, broken = [], at, ""
    if start < len(data):
        yield CorruptRegion(start, len(data) - start, "the segment is truncated: not sealed yet", tail=True)


def read_end(data: Buffer) -> SegmentEnd | None:
    """Return the end of a segment from its last bytes, without checking the digest; None where it is not closed."""
    for size in (2 * _DIGEST, _DIGEST):
        body = bytes(data[-size:])
        event = _encode_section(SectionType.END, 0, body)
        tail = bytes(data[-len(event) :])
        # number and time of the event may be any
        if len(tail) == len(event) and tail[:4] == event[:4] and tail[_TIMES:] == event[_TIMES:]:
            return SegmentEnd(True, body[:_DIGEST], body[_DIGEST:])
    return None


def _decode_section_head(data: bytes) -> tuple[SectionType, int, bytes] | None:
    if len(data) < _OWN.size:
        return None
    magic, part, check = _OWN.unpack_from(data)
    if magic != MAGIC or part not in _SECTION_TYPES:
        return None
    return SectionType(part), check, data[_OWN.size :]


_SECTION_TYPES: Final = frozenset(SectionType)


def _decode_section(part: SectionType, body: bytes, data: Buffer, begin: int) -> list[Item] | None:
    if part is SectionType.END:
        digest, mac = body[:_DIGEST], body[_DIGEST:]
        if len(digest) != _DIGEST or len(mac) not in (0, _DIGEST):
            return None
        return [SegmentEnd(hmac.compare_digest(hashlib.sha256(data[:begin]).digest(), digest), digest, mac)]
    if part is SectionType.STATE:
        return [SegmentState(body)]
    try:
        facts = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return [SegmentHead(facts)] if isinstance(facts, dict) else None


def _decode_batch(body: bytes, events: list[tuple[int, LogEvent]], expected: int, begin: int) -> list[Item] | None:
    """Return the records of a batch; None where the seal does not match them."""
    found: list[Item] = []
    waiting = iter(events)
    try:
        number, count = _SEAL.unpack_from(body)
        if number != expected or count != len(events):
            return None
        at = _SEAL.size
        while at < len(body):
            kind = body[at]
            if kind & _INLINE_FLAG:
                kind, monotonic_ns, utime, name, size = _INLINE.unpack_from(body, at)
                at += _INLINE.size
                channel, data = body[at : at + name].decode(), body[at + name : at + name + size]
                at += name + size
                found.append(JournalRecord(RecordKind(kind & ~_INLINE_FLAG), monotonic_ns, utime, channel, data, begin))
                continue
            place, event = next(waiting)
            monotonic_ns = 0
            if kind == RecordKind.PUBLISHED:
                at += 1
            else:
                kind, monotonic_ns = _RECEIVED.unpack_from(body, at)
                at += _RECEIVED.size
            found.append(JournalRecord(RecordKind(kind), monotonic_ns, event.utime, event.channel, event.data, place))
    except (struct.error, ValueError, StopIteration):
        return None
    return found if at == len(body) and next(waiting, None) is None else None
