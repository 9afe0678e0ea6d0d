"""LCM event logs: a reader that distinguishes damage from the end of a log.

lcm's own reader stops at the first damaged event as if the log ended there, and a corrupt length field crashes the
process (lcm 1.5.3). `scan` is a pure function of the bytes: it yields events and the damaged regions between them, and
resynchronizes at the next sync word. `encode_event` is its inverse for one event; `lcm.EventLog` writes whole logs.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Self, TypeAlias

from modelserver.errors import RecordingError
from modelserver.files import NotRegularFileError, open_regular
from modelserver.messages import MAX_CHANNEL_LENGTH
from modelserver.wire.fields import MAX_UTIME

MAX_DATA = 256 << 20
"""Longer messages are treated as damage."""

RELEASED_BYTES = 32 << 20
"""Bytes of a log after which its pages are released: the most that a long one occupies."""

_HEAD = struct.Struct(">Iqqii")  # sync word, event number, utime, lengths of channel and data
_SYNC_WORD = 0xEDA1DA01
_SYNC = struct.pack(">I", _SYNC_WORD)

Buffer: TypeAlias = bytes | mmap.mmap


class LogEvent(NamedTuple):
    """One message of a log: receive time, channel, bytes. `end` is its end offset in the file."""

    number: int
    utime: int
    channel: str
    data: bytes
    end: int


@dataclass(frozen=True, slots=True)
class LogDamage:
    """Damaged bytes of a log: offset, length, number of good events before.

    `tail`: nothing follows, as after a logger that was stopped while writing.
    """

    start: int
    length: int
    after: int
    tail: bool

    def __str__(self) -> str:
        place = f"after event {self.after}, at byte {self.start}"
        if self.tail:
            return f"the log is truncated {place}: the last {self.length} bytes are no complete event"
        return f"{self.length} bytes {place}, are no event and were skipped"


def encode_event(number: int, utime: int, channel: bytes, data: bytes) -> bytes:
    """Encode an event; `channel` is ASCII, of 1 to MAX_CHANNEL_LENGTH characters."""
    return _HEAD.pack(_SYNC_WORD, number, utime, len(channel), len(data)) + channel + data


def scan(data: Buffer, start: int = 0) -> Iterator[LogEvent | LogDamage]:
    """Yield the events in the bytes of a log from `start` on, and the damaged regions between them."""
    size = len(data)
    at = bad = start
    good = 0
    while at < size:
        event = _event_at(data, at, size)
        if event is None:
            found = data.find(_SYNC, at + 1)
            at = size if found < 0 else found
            continue
        if at > bad:
            yield LogDamage(bad, at - bad, good, tail=False)
        good += 1
        yield event
        at = bad = event.end
    if bad < size:
        yield LogDamage(bad, size - bad, good, tail=True)


@lru_cache(maxsize=1024)
def _decode_channel(name: bytes) -> str:
    return name.decode("ascii")


def _event_at(data: Buffer, at: int, size: int) -> LogEvent | None:
    """Return the event that starts at an offset, None where there is no complete one."""
    if size - at < _HEAD.size:
        return None
    sync, number, utime, channel_length, data_length = _HEAD.unpack_from(data, at)
    if sync != _SYNC_WORD or not (
        0 < channel_length <= MAX_CHANNEL_LENGTH and 0 <= data_length <= MAX_DATA and 0 <= utime < MAX_UTIME
    ):
        return None
    start = at + _HEAD.size
    end = start + channel_length + data_length
    if end > size:
        return None
    # the next event may be cut within its first word
    following = data[end : end + 4]
    if following != _SYNC and not _SYNC.startswith(following) and data.find(_SYNC, at + 4, end) >= 0:
        return None  # the length is corrupt: the event would contain the ones that follow
    try:
        channel = _decode_channel(data[start : start + channel_length])
    except UnicodeDecodeError:
        return None
    return LogEvent(number, utime, channel, data[start + channel_length : end], end)


class LogFile:
    """An event log on disk. A context manager; iterating yields its events and fills `damage`.

    Raises RecordingError for a file without a single event, OSError where it cannot be read.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.damage: list[LogDamage] = []
        self.size = 0
        self._data: Buffer = b""

    def __enter__(self) -> Self:
        try:
            file = open_regular(self.path)
        except NotRegularFileError as error:
            inside = sorted(self.path.glob("*.lcm")) if self.path.is_dir() else []
            fix = f"; give a log in it, such as {inside[-1]}" if inside else ""
            raise RecordingError(f"{self.path}: this is {error.kind}, not an LCM event log{fix}") from None
        with file:
            self.size = file.seek(0, 2)
            if self.size == 0:
                raise RecordingError(f"{self.path}: the log is empty")
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if not any(isinstance(each, LogEvent) for each in scan(self._data)):
            self._close()
            raise RecordingError(f"{self.path}: not an LCM event log: no event in {self.size} bytes")
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if isinstance(self._data, mmap.mmap):
            self._data.close()
        self._data = b""

    def read_from(self, offset: int = 0) -> Iterator[LogEvent]:
        self.damage.clear()
        released = offset
        for each in scan(self._data, offset):
            if isinstance(each, LogEvent):
                yield each
                if each.end > released + RELEASED_BYTES and isinstance(self._data, mmap.mmap):
                    released = each.end
                    # what is read need not stay in this process; the kernel has it
                    self._data.madvise(mmap.MADV_DONTNEED, 0, released - released % mmap.PAGESIZE)
            else:
                self.damage.append(each)

    __iter__ = read_from

    @property
    def is_corrupt(self) -> bool:
        """Whether damage other than a truncated tail was read so far."""
        return any(not each.tail for each in self.damage)
