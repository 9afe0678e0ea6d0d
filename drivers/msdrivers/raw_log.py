"""Record and replay the traffic of a link, one line of text per unit.

    # modelserver raw 1 bytes gps novatel
    = 1750000000000000 81234567890 open /dev/ttyUSB0 38400
    > 1750000000001200 81235767890 6c6f67...
    < 1750000000010500 81245067890 aa44121c...

The first line has the version, the kind of unit, the driver and the device. Each further line has the direction (`<`
received, `>` sent, `=` event of the line), the host's clock in microseconds since 1970, the monotonic clock in
nanoseconds, and the unit in hexadecimal. An incomplete last line is ignored, a damaged line is skipped and counted.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TextIO

from modelserver.errors import RecordingError
from modelserver.files import NotRegularFileError, open_regular
from msdrivers.endpoint import HostTime, U
from msdrivers.links import EndOfRecordingError, Link, LinkWrapper

log = logging.getLogger(__name__)

MAGIC = "# modelserver raw 1 "

MAX_LINE = 1 << 20
"""Characters; longer lines are damage."""


class UnitCodec(NamedTuple, Generic[U]):
    """How a kind of unit is recorded. `unpack` raises ValueError for bytes that are no unit."""

    name: str
    pack: Callable[[U], bytes]
    unpack: Callable[[bytes], U]


BYTES_CODEC: UnitCodec[bytes] = UnitCodec("bytes", bytes, bytes)


class RecordDirection(StrEnum):
    """The direction of a record, as it is written."""

    RECEIVED = "<"
    SENT = ">"
    EVENT = "="


class RawRecord(NamedTuple):
    """One line of a recording."""

    direction: RecordDirection
    time: HostTime
    data: bytes


class TimeSource(Protocol):
    """A clock, and a way to wait."""

    def now(self) -> HostTime:
        """Return the instant."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


@dataclass(slots=True)
class RawWriter:
    """Writes records to the file called `name`, up to a number of bytes or until the disk is full.

    The end of the recording is logged once and sets `is_full`; `dropped` counts the records after it.
    """

    stream: TextIO
    limit: int
    name: str = ""
    bytes_written: int = 0
    is_full: bool = False
    dropped: int = 0

    def begin(self, kind: str, source: str, device: str) -> None:
        self._put(f"{MAGIC}{kind} {source} {device}\n")

    def record(self, way: RecordDirection, now: HostTime, data: bytes) -> None:
        """Write a record; an event as text, a unit in hexadecimal."""
        text = data.decode() if way is RecordDirection.EVENT else data.hex()
        self._put(f"{way} {now.utime} {now.monotonic_ns} {text}\n")

    def close(self) -> None:
        """Close the file and log how many records were dropped."""
        with contextlib.suppress(OSError):
            # the rest of the buffer fails again on a full disk
            self.stream.close()
        if self.dropped:
            log.warning("recording %s: %d records after its end were dropped", self.name, self.dropped)

    def _put(self, line: str) -> None:
        if self.is_full:
            self.dropped += 1
        elif self.bytes_written + len(line) > self.limit:
            self._stop_recording(f"it has its {self.limit / 1e6:g} MB, see --record-limit")
        else:
            try:
                self.stream.write(line)
                # what was received is there after a crash too
                self.stream.flush()
            except OSError as error:
                self._stop_recording(error.strerror or str(error))
            else:
                self.bytes_written += len(line)

    def _stop_recording(self, why: str) -> None:
        self.is_full, self.dropped = True, 1
        log.warning("recording %s ended: %s; the driver continues", self.name, why)


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

    def __iter__(self) -> Iterator[RawRecord]:
        while line := self.stream.readline(MAX_LINE):
            record = _parse_record(line)
            if record is None:
                self.damaged += 1
            else:
                yield record


def _parse_record(line: str) -> RawRecord | None:
    way, _, rest = line.partition(" ")
    parts = rest.split(" ", 2)
    if not line.endswith("\n") or len(parts) != 3:
        return None
    try:
        direction = RecordDirection(way)
        data = parts[2].encode().strip() if direction is RecordDirection.EVENT else bytes.fromhex(parts[2])
        return RawRecord(direction, HostTime(int(parts[1]), int(parts[0])), data)
    except ValueError:
        return None


@contextlib.contextmanager
def open_for_writing(path: Path, limit: int) -> Iterator[RawWriter]:
    """Make the file of a recording of at most `limit` bytes and close it again; one without records is taken away.

    A recording that is there stays: beside gps.raw the next is gps.1.raw. Raises RecordingError for another file of
    that name, which stays too, and OSError.
    """
    file = path
    for number in itertools.count(1):
        try:
            stream = file.open("x", encoding="ascii", errors="replace")
            break
        except FileExistsError:
            if not path.is_file():
                if not path.is_char_device():
                    # opening a FIFO would wait for its reader
                    raise RecordingError(f"{path} is there and is no file; name another") from None
                # e.g. /dev/null
                stream = path.open("w", encoding="ascii", errors="replace")
                break
            if number == 1 and not _is_recording(path):
                raise RecordingError(f"{path} is there, is no recording of a driver, and stays; name another") from None
            file = path.with_suffix(f".{number}{path.suffix}")
    log.info("recording to %s%s", file, f": {path} is there already" if file != path else "")
    writer = RawWriter(stream, limit, str(file))
    try:
        yield writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            if _is_blank(file):
                file.unlink()


def _is_recording(file: Path) -> bool:
    """Return whether a file begins like a recording; also one that a full disk has truncated."""
    with open_regular(file) as stream:
        return MAGIC.encode().startswith(stream.read(len(MAGIC)))


def _is_blank(file: Path) -> bool:
    """Return whether a file has no more than a first line."""
    if not file.is_file():
        return False
    with open_regular(file) as stream:
        stream.readline(MAX_LINE)
        return not stream.read(1)


def open_for_reading(path: Path) -> RawReader:
    """Return the reader of a file. Raises RecordingError where it is no recording, OSError where it cannot be read."""
    try:
        stream = io.TextIOWrapper(open_regular(path), encoding="ascii", errors="replace")
    except NotRegularFileError as error:
        raise RecordingError(f"{path}: this is {error.kind}, not a recording of a driver") from None
    try:
        return RawReader(stream, str(path))
    except RecordingError:
        stream.close()
        raise


class RecordingLink(LinkWrapper[U]):
    """A line whose traffic is recorded."""

    def __init__(self, link: Link[U], codec: UnitCodec[U], writer: RawWriter, time: TimeSource):
        super().__init__(link)
        self._codec, self._writer, self._time_source = codec, writer, time
        self._is_open = False

    def open(self, baud: int | None = None) -> None:
        self._link.open(baud)
        self._is_open = True
        self._record(RecordDirection.EVENT, f"open {self.description} {self.baud}".encode())

    def close(self) -> None:
        self._link.close()
        # one that cannot be opened is closed each time that it was tried
        if self._is_open:
            self._record(RecordDirection.EVENT, b"close")
        self._is_open = False

    def poll(self, timeout: float) -> Sequence[U]:
        units = self._link.poll(timeout)
        for unit in units:
            self._record(RecordDirection.RECEIVED, self._codec.pack(unit))
        return units

    def send(self, unit: U) -> None:
        self._link.send(unit)
        self._record(RecordDirection.SENT, self._codec.pack(unit))

    def _record(self, way: RecordDirection, data: bytes) -> None:
        self._writer.record(way, self._time_source.now(), data)


class ReplayLink(Generic[U]):
    """A link that replays the received units of a recording with their original timing.

    Sent units are discarded. The end raises EndOfRecordingError with the number of damaged lines.
    """

    baud = 0

    def __init__(self, reader: RawReader, unpack: Callable[[bytes], U], time: TimeSource):
        self.description = reader.name
        self._reader = reader
        self._records = (record for record in reader if record.direction is RecordDirection.RECEIVED)
        self._unpack, self._time_source = unpack, time
        self._replayed = self._unreadable = 0
        self._next: RawRecord | None = None
        self._replay_offset_ns: int | None = None

    def open(self, baud: int | None = None) -> None:
        pass

    def close(self) -> None:
        pass

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what is due, waiting `timeout` seconds at most.

        Raises PlayedOutError at the end, RecordingError at the end of one of which nothing could be played.
        """
        if self._next is None:
            self._next = next(self._records, None)
            if self._next is None:
                raise self._make_end_error()
        now_ns = self._time_source.now().monotonic_ns
        if self._replay_offset_ns is None:
            self._replay_offset_ns = now_ns - self._next.time.monotonic_ns
        wait = (self._next.time.monotonic_ns + self._replay_offset_ns - now_ns) * 1e-9
        if wait > 0:
            self._time_source.sleep(min(wait, max(0.0, timeout)))
            if wait > timeout:
                return ()
        record, self._next = self._next, None
        try:
            unit = self._unpack(record.data)
        except ValueError:
            # written by a form of another version, or damaged
            self._unreadable += 1
            return ()
        self._replayed += 1
        return (unit,)

    def send(self, unit: U) -> None:
        pass

    def _make_end_error(self) -> EndOfRecordingError | RecordingError:
        damaged = self._reader.damaged + self._unreadable
        if not self._replayed:
            why = f"all that was received is damaged, {damaged} lines" if damaged else "nothing was received in it"
            return RecordingError(f"{self.description}: nothing of it can be played: {why}")
        left_out = f"; {damaged} damaged lines of it were left out" if damaged else ""
        return EndOfRecordingError(self.description, f"the recording has ended{left_out}")
