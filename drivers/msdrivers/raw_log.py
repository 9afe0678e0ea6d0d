"""Recordings of what came and went on a line, unit by unit, with their times: one line of text for each.

    # modelserver raw 1 bytes gps novatel
    = 1750000000000000 81234567890 open /dev/ttyUSB0 38400
    > 1750000000001200 81235767890 6c6f67...
    < 1750000000010500 81245067890 aa44121c...

The first line names the version, the kind of unit, the driver and the device. Then stand, in this order: the direction
(`<` received, `>` sent, `=` a word on the line itself), the host's clock in microseconds since 1970, the monotonic
clock in nanoseconds, and the unit in hexadecimal. A last line that breaks off is left out, and a damaged one skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TextIO, TypeVar

from modelserver.errors import RecordingError
from msdrivers.links import Link, PlayedOutError
from msdrivers.station import Now

U = TypeVar("U")

MAGIC = "# modelserver raw 1 "

MAX_LINE = 1 << 20
"""Characters; longer lines are damage."""


class Form(Protocol[U]):
    """How a kind of unit is written: its name, and the way to bytes and back."""

    name: str

    def pack(self, unit: U) -> bytes:
        """Return the bytes of a unit."""
        ...

    def unpack(self, data: bytes) -> U:
        """Return the unit of bytes. Raises ValueError for bytes that are none."""
        ...


class BytesForm:
    """Bytes as they are."""

    name = "bytes"

    def pack(self, unit: bytes) -> bytes:
        """Return them."""
        return unit

    def unpack(self, data: bytes) -> bytes:
        """Return them."""
        return data


class Way(StrEnum):
    """The direction of a record, as it is written."""

    RECEIVED = "<"
    SENT = ">"
    WORD = "="


class Record(NamedTuple):
    """One line of a recording."""

    way: Way
    now: Now
    data: bytes


class Time(Protocol):
    """A clock, and a way to wait."""

    def now(self) -> Now:
        """Return the instant."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


@dataclass(slots=True)
class RawWriter:
    """Writes records up to a number of bytes; what does not fit is left out, and `full` says so."""

    stream: TextIO
    limit: int
    written: int = 0
    full: bool = False

    def begin(self, kind: str, source: str, device: str) -> None:
        """Write the first line."""
        self._put(f"{MAGIC}{kind} {source} {device}\n")

    def record(self, way: Way, now: Now, data: bytes) -> None:
        """Write a record; the text of a word is written as it is."""
        said = data.decode() if way is Way.WORD else data.hex()
        self._put(f"{way} {now.utime} {now.monotonic_ns} {said}\n")

    def _put(self, line: str) -> None:
        self.full = self.full or self.written + len(line) > self.limit
        if not self.full:
            self.stream.write(line)
            # what was received is there after a crash too
            self.stream.flush()
            self.written += len(line)


class RecordingLink(Generic[U]):
    """A line whose traffic is recorded."""

    def __init__(self, link: Link[U], form: Form[U], writer: RawWriter, time: Time):
        self._link, self._form, self._writer, self._time = link, form, writer, time

    @property
    def description(self) -> str:
        """The line's."""
        return self._link.description

    @property
    def baud(self) -> int:
        """The line's."""
        return self._link.baud

    def open(self, baud: int | None = None) -> None:
        """Open the line. Raises LinkError."""
        self._link.open(baud)
        self._word(f"open {self.description} {self.baud}")

    def close(self) -> None:
        """Close the line."""
        self._link.close()
        self._word("close")

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what came in. Raises LinkError."""
        units = self._link.poll(timeout)
        for unit in units:
            self._writer.record(Way.RECEIVED, self._time.now(), self._form.pack(unit))
        return units

    def send(self, unit: U) -> None:
        """Send a unit. Raises LinkError."""
        self._link.send(unit)
        self._writer.record(Way.SENT, self._time.now(), self._form.pack(unit))

    def _word(self, text: str) -> None:
        self._writer.record(Way.WORD, self._time.now(), text.encode())


class PlayedLink(Generic[U]):
    """A recording in place of a line: what was received comes again, as long after each other as then.

    What is sent goes nowhere. The recording's end is a PlayedOutError.
    """

    baud = 0

    def __init__(self, description: str, records: Iterable[Record], unpack: Callable[[bytes], U], time: Time):
        self.description = description
        self._records = (record for record in records if record.way is Way.RECEIVED)
        self._unpack, self._time = unpack, time
        self._next: Record | None = None
        self._ahead_ns: int | None = None

    def open(self, baud: int | None = None) -> None:
        """Begin, or go on."""

    def close(self) -> None:
        """Stop."""

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what is due, waiting `timeout` seconds at most. Raises PlayedOutError at the end."""
        if self._next is None:
            self._next = next(self._records, None)
            if self._next is None:
                raise PlayedOutError(self.description, "the recording has ended")
        now_ns = self._time.now().monotonic_ns
        if self._ahead_ns is None:
            self._ahead_ns = now_ns - self._next.now.monotonic_ns
        wait = (self._next.now.monotonic_ns + self._ahead_ns - now_ns) * 1e-9
        if wait > 0:
            self._time.sleep(min(wait, max(0.0, timeout)))
            if wait > timeout:
                return ()
        record, self._next = self._next, None
        try:
            return (self._unpack(record.data),)
        except ValueError:
            # written by a form of another version, or damaged
            return ()

    def send(self, unit: U) -> None:
        """Send nothing."""


@dataclass(slots=True)
class RawReader:
    """Reads the records of a recording; `damaged` counts the lines left out so far."""

    stream: TextIO
    name: str
    kind: str = ""
    source: str = ""
    device: str = ""
    damaged: int = 0

    def __post_init__(self) -> None:
        head = self.stream.readline(200)
        words = head.removeprefix(MAGIC).split()
        if not head.startswith(MAGIC) or len(words) != 3:
            raise RecordingError(f"{self.name} is no recording of a driver: it does not begin with {MAGIC.strip()!r}")
        self.kind, self.source, self.device = words

    def __iter__(self) -> Iterator[Record]:
        while line := self.stream.readline(MAX_LINE):
            record = _record(line)
            if record is None:
                self.damaged += 1
            else:
                yield record


def _record(line: str) -> Record | None:
    way, _, rest = line.partition(" ")
    parts = rest.split(" ", 2)
    if not line.endswith("\n") or len(parts) != 3:
        return None
    try:
        direction = Way(way)
        data = parts[2].encode().strip() if direction is Way.WORD else bytes.fromhex(parts[2])
        return Record(direction, Now(int(parts[1]), int(parts[0])), data)
    except ValueError:
        return None


def open_for_reading(path: Path) -> RawReader:
    """Return the reader of a file. Raises RecordingError where it is no recording, OSError where it cannot be read."""
    stream = path.open(encoding="ascii", errors="replace")
    try:
        return RawReader(stream, str(path))
    except RecordingError:
        stream.close()
        raise
