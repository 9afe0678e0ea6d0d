"""The journal's bytes: LCM event logs that say in which order a service handled what, and what it said to that.

What came from the bus and what was said stands there as ordinary events, on its own channel and unchanged, so that any
LCM tool reads it. Between them stand events of the journal's own on `CHANNEL`. A seal closes a batch: it says of each
record before it what it was and at which instant it was handled, carries those records that never were on a bus
(ticks, refusals, notices), and a checksum over the whole batch. A batch counts as a whole or not at all.

    segment = head, files, state, (batch, seal) ..., end

`written` and `read` are pure functions between records and bytes.
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
from modelserver.wire.eventlog import Buffer, Damage, LogEvent, scan
from modelserver.wire.eventlog import written as event_written
from modelserver.wire.fields import MAX_UTIME

CHANNEL: Final = "MODELSERVER_JOURNAL"

MAGIC: Final = b"MSjrnl1\n"
"""Stands where a message's fingerprint does."""

FORMAT: Final = 2


class Part(IntEnum):
    """What an event of the journal's own is."""

    HEAD = 1
    FILE = 2
    STATE = 3
    SEAL = 4
    END = 5


class RecordKind(IntEnum):
    """What a record is.

    SAID: a message that was published. SAMPLE: one that a sensor's channel brought, or a wish about the mode.
    REQUEST: one that the core answered; REMEMBERED: answered without it, from memory; REFUSED: for want of time;
    MALFORMED, FAILED: turned back. UNREAD: bytes that are no message of their channel. IGNORED: a sample that is not
    used, as that of a second writer. EVENT: something of the service's own, encoded by the schema of the segment.
    PORTION: the next messages of the deferred reply in progress were sent, as many as its four bytes say.
    """

    SAID = 0
    SAMPLE = 1
    REQUEST = 2
    REMEMBERED = 3
    REFUSED = 4
    MALFORMED = 5
    FAILED = 6
    UNREAD = 7
    IGNORED = 8
    EVENT = 9
    PORTION = 10


class JournalRecord(NamedTuple):
    """One thing that was handled or said, at an instant: the monotonic clock in ns, and utime.

    What was said has no monotonic time of its own, and the utime of what it follows from. `at` is the place in the
    segment, bytes.
    """

    kind: RecordKind
    monotonic_ns: int
    utime: int
    channel: str
    data: bytes
    at: int = 0


@dataclass(frozen=True, slots=True)
class Head:
    """What a segment begins with: who wrote it, and how it follows from the one before."""

    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class File:
    """A file that the service was started with."""

    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class State:
    """What the service knew when the segment began, encoded with the description of its types."""

    data: bytes


@dataclass(frozen=True, slots=True)
class End:
    """The end of a segment that was closed.

    `digest` is the SHA-256 of all bytes before it, and `intact` whether they still have it. `mac` proves, with the key,
    who wrote that; empty for a journal without a key.
    """

    intact: bool
    digest: bytes
    mac: bytes = b""

    @property
    def seal(self) -> bytes:
        """What the next segment's head holds of this one."""
        return self.mac or self.digest


@dataclass(frozen=True, slots=True)
class Broken:
    """Bytes of a segment that cannot be used: from where, how many, why. `tail`: nothing that can be used follows."""

    start: int
    length: int
    why: str
    tail: bool = False

    def __str__(self) -> str:
        return f"{self.length} bytes at byte {self.start}: {self.why}"


Item: TypeAlias = Head | File | State | JournalRecord | End | Broken

_OWN = struct.Struct(">8sBI")  # magic, part, checksum of what follows
_DIGEST: Final = 32

_TIMES: Final = 20
"""Bytes of an event before its lengths: sync word, number, time."""

_SEAL = struct.Struct(">II")  # number of the batch, count of events before the seal
_INLINE = struct.Struct(">BqqHI")  # kind, instant, lengths of channel and data
_HEARD = struct.Struct(">Bq")
_APART: Final = 0x80
"""Added to the kind of a record that stands in the seal itself, with channel and data."""

_NAME: Final = CHANNEL.encode()


def _own(part: Part, utime: int, body: bytes, before: int = 0) -> bytes:
    """Return an event of the journal's own; its checksum goes on from that of what it closes."""
    return event_written(0, utime, _NAME, _OWN.pack(MAGIC, part, zlib.crc32(body, before)) + body)


def head_written(facts: dict[str, Any], utime: int) -> bytes:
    """Return the beginning of a segment."""
    return _own(Part.HEAD, utime, json.dumps(facts).encode())


def file_written(name: str, data: bytes, utime: int) -> bytes:
    """Return a file that the service was started with."""
    return _own(Part.FILE, utime, name.encode() + b"\0" + data)


def state_written(data: bytes, utime: int) -> bytes:
    """Return what the service knew."""
    return _own(Part.STATE, utime, data)


def end_written(digest: bytes, utime: int, mac: bytes = b"") -> bytes:
    """Return the end of a segment; `digest` is the SHA-256 of all bytes before, `mac` see `End`."""
    return _own(Part.END, utime, digest + mac)


def batch_written(number: int, records: Iterable[JournalRecord]) -> bytes:
    """Return a batch with its seal. The channels of records are to be text, their times 63 bits."""
    events: list[bytes] = []
    entries: list[bytes] = []
    utime = 0
    for kind, monotonic_ns, utime, channel, data, _ in records:
        if kind >= RecordKind.EVENT or not _is_plain(channel) or not 0 <= utime < MAX_UTIME:
            name = channel.encode()
            entries.append(_INLINE.pack(kind | _APART, monotonic_ns, utime, len(name), len(data)) + name + data)
            continue
        events.append(event_written(len(events), utime, channel.encode(), data))
        entries.append(b"\0" if kind == RecordKind.SAID else _HEARD.pack(kind, monotonic_ns))
    batch = b"".join(events)
    body = _SEAL.pack(number, len(events)) + b"".join(entries)
    return batch + _own(Part.SEAL, min(max(utime, 0), MAX_UTIME - 1), body, zlib.crc32(batch))


def _is_plain(channel: str) -> bool:
    """Return whether a channel can stand in a log, and is not the journal's own."""
    return 0 < len(channel) <= MAX_CHANNEL_LENGTH and channel.isascii() and channel != CHANNEL


def read(data: Buffer) -> Iterator[Item]:
    """Yield what a segment holds, in order; what cannot be used is told where it was found. Raises nothing."""
    waiting: list[tuple[int, LogEvent]] = []
    start = at = 0
    expected = 0
    broken = ""
    for each in scan(data):
        if isinstance(each, Damage):
            broken = "no events"
            at = each.start + each.length
            continue
        begin, at = at, each.end
        if each.channel != CHANNEL:
            waiting.append((begin, each))
            continue
        own = _own_read(each.data)
        if own is None:
            broken = "an event of the journal's own that is none"
            continue
        part, check, body = own
        sealed = part is Part.SEAL
        crc = zlib.crc32(body, zlib.crc32(data[start:begin])) if sealed else zlib.crc32(body)
        found: list[Item] | None = None
        if not broken and crc == check and (sealed or not waiting):
            found = _batch(body, waiting, expected, begin) if sealed else _part(part, body, data, begin)
        if found is None:
            why = broken or ("the checksum is wrong" if crc != check else "batches are missing, or do not belong here")
            yield Broken(start, at - start, why)
        else:
            yield from found
        if sealed and len(body) >= _SEAL.size:
            expected = _SEAL.unpack_from(body)[0] + 1
        waiting, start, broken = [], at, ""
    if start < len(data):
        yield Broken(start, len(data) - start, "the segment breaks off: not sealed yet", tail=True)


def read_end(data: Buffer) -> End | None:
    """Return the end of a segment without reading what is before; None where it is not closed. Checks no digest."""
    for size in (2 * _DIGEST, _DIGEST):
        body = bytes(data[-size:])
        event = _own(Part.END, 0, body)
        tail = bytes(data[-len(event) :])
        # number and time of the event may be any
        if len(tail) == len(event) and tail[:4] == event[:4] and tail[_TIMES:] == event[_TIMES:]:
            return End(True, body[:_DIGEST], body[_DIGEST:])
    return None


def _own_read(data: bytes) -> tuple[Part, int, bytes] | None:
    if len(data) < _OWN.size:
        return None
    magic, part, check = _OWN.unpack_from(data)
    if magic != MAGIC or part not in _PARTS:
        return None
    return Part(part), check, data[_OWN.size :]


_PARTS: Final = frozenset(Part)


def _part(part: Part, body: bytes, data: Buffer, begin: int) -> list[Item] | None:
    if part is Part.END:
        digest, mac = body[:_DIGEST], body[_DIGEST:]
        if len(digest) != _DIGEST or len(mac) not in (0, _DIGEST):
            return None
        return [End(hmac.compare_digest(hashlib.sha256(data[:begin]).digest(), digest), digest, mac)]
    if part is Part.STATE:
        return [State(body)]
    try:
        if part is Part.FILE:
            name, _, content = body.partition(b"\0")
            return [File(name.decode(), content)]
        facts = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return [Head(facts)] if isinstance(facts, dict) else None


def _batch(body: bytes, events: list[tuple[int, LogEvent]], expected: int, begin: int) -> list[Item] | None:
    """Return the records of a batch; None where the seal does not fit them."""
    found: list[Item] = []
    waiting = iter(events)
    try:
        number, count = _SEAL.unpack_from(body)
        if number != expected or count != len(events):
            return None
        at = _SEAL.size
        while at < len(body):
            kind = body[at]
            if kind & _APART:
                kind, monotonic_ns, utime, name, size = _INLINE.unpack_from(body, at)
                at += _INLINE.size
                channel, data = body[at : at + name].decode(), body[at + name : at + name + size]
                at += name + size
                found.append(JournalRecord(RecordKind(kind & ~_APART), monotonic_ns, utime, channel, data, begin))
                continue
            place, event = next(waiting)
            monotonic_ns = 0
            if kind == RecordKind.SAID:
                at += 1
            else:
                kind, monotonic_ns = _HEARD.unpack_from(body, at)
                at += _HEARD.size
            found.append(JournalRecord(RecordKind(kind), monotonic_ns, event.utime, event.channel, event.data, place))
    except (struct.error, ValueError, StopIteration):
        return None
    return found if at == len(body) and next(waiting, None) is None else None
