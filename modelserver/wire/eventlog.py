"""LCM event logs, read so that damage is told from the end.

lcm's own reader stops at the first damaged event as if the log ended there, and a length field that was
overwritten makes it crash the process (lcm 1.5.3). `scan` is a pure function over the bytes: it yields the
events, and in their order what lies between them that is none. `written` is its inverse for one event; whole logs are
left to `lcm.EventLog`.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias

from modelserver.errors import RecordingError
from modelserver.messages import MAX_CHANNEL_LENGTH
from modelserver.regular_files import NotRegularFileError, open_regular
from modelserver.wire.fields import MAX_UTIME

MAX_DATA = 256 << 20
"""Messages beyond are taken for damage."""

_HEAD = struct.Struct(">Iqqii")  # sync word, event number, utime, lengths of channel and data
_SYNC = struct.pack(">I", 0xEDA1DA01)

Buffer: TypeAlias = bytes | mmap.mmap


@dataclass(frozen=True, slots=True)
class LogEvent:
    """One message of a log: when it arrived, on which channel, its bytes. `end` is where it ends in the file."""

    number: int
    utime: int
    channel: str
    data: bytes
    end: int


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of a log that are no event: where, how many, after how many good events.

    `tail` is set when nothing follows: what a logger leaves that was stopped in the middle of writing.
    """

    start: int
    length: int
    after: int
    tail: bool

    def __str__(self) -> str:
        place = f"after event {self.after}, at byte {self.start}"
        if self.tail:
            return f"the log breaks off {place}: the last {self.length} bytes are no whole event"
        return f"{self.length} bytes {place}, are no event and were skipped"


def written(number: int, utime: int, channel: bytes, data: bytes) -> bytes:
    """Return an event as it stands in a log; `channel` is ASCII, of 1 to MAX_CHANNEL_LENGTH characters."""
    return _HEAD.pack(0xEDA1DA01, number, utime, len(channel), len(data)) + channel + data


def scan(data: Buffer) -> Iterator[LogEvent | Damage]:
    """Yield the events in the bytes of a log, and the stretches between them that are none."""
    size = len(data)
    at = bad = good = 0
    while at < size:
        event = _event_at(data, at, size)
        if event is None:
            found = data.find(_SYNC, at + 1)
            at = size if found < 0 else found
            continue
        if at > bad:
            yield Damage(bad, at - bad, good, tail=False)
        good += 1
        yield event
        at = bad = event.end
    if bad < size:
        yield Damage(bad, size - bad, good, tail=True)


def _event_at(data: Buffer, at: int, size: int) -> LogEvent | None:
    """Return the event that starts at a place, None where there is no whole one."""
    if size - at < _HEAD.size or data[at : at + 4] != _SYNC:
        return None
    _, number, utime, channel_length, data_length = _HEAD.unpack(data[at : at + _HEAD.size])
    if not (0 < channel_length <= MAX_CHANNEL_LENGTH and 0 <= data_length <= MAX_DATA and 0 <= utime < MAX_UTIME):
        return None
    start = at + _HEAD.size
    end = start + channel_length + data_length
    if end > size:
        return None
    if end < size and data[end : end + 4] != _SYNC and data.find(_SYNC, at + 4, end) >= 0:
        return None  # the length was overwritten: it would swallow the events that follow
    try:
        channel = data[start : start + channel_length].decode("ascii")
    except UnicodeDecodeError:
        return None
    return LogEvent(number, utime, channel, bytes(data[start + channel_length : end]), end)


class LogFile:
    """An event log on disk. A context manager; iterating yields its events, `damage` fills on the way.

    Raises RecordingError for a file without a single event, OSError where it cannot be read.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.damage: list[Damage] = []
        self.size = 0
        self._data: Buffer = b""

    def __enter__(self) -> Self:
        try:
            file = open_regular(self.path)
        except NotRegularFileError as error:
            raise RecordingError(f"{self.path}: this is {error.kind}, not an LCM event log") from None
        with file:
            self.size = file.seek(0, 2)
            if self.size == 0:
                raise RecordingError(f"{self.path}: the log is empty")
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if not any(isinstance(each, LogEvent) for each in scan(self._data)):
            self._close()
            raise RecordingError(f"{self.path}: not an LCM event log: no event in {self.size} bytes")
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self._close()

    def _close(self) -> None:
        if isinstance(self._data, mmap.mmap):
            self._data.close()
        self._data = b""

    def __iter__(self) -> Iterator[LogEvent]:
        self.damage.clear()
        for each in scan(self._data):
            if isinstance(each, LogEvent):
                yield each
            else:
                self.damage.append(each)

    @property
    def torn(self) -> bool:
        """Whether more than a broken-off tail was wrong, of what was read so far."""
        return any(not each.tail for each in self.damage)
