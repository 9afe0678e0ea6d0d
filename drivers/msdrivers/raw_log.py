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

import contextlib
import io
import itertools
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple, Protocol, TextIO, TypeVar

from modelserver.errors import RecordingError
from modelserver.regular_files import NotRegularFileError, open_regular
from msdrivers.station import Now

log = logging.getLogger(__name__)

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


class RecordDirection(StrEnum):
    """The direction of a record, as it is written."""

    RECEIVED = "<"
    SENT = ">"
    WORD = "="


class RawRecord(NamedTuple):
    """One line of a recording."""

    way: RecordDirection
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
    """Writes records to the file called `name`, up to a number of bytes or until the disk is full.

    That the recording has ended then is told once, and `full` says so; `lost` counts the records that came after.
    """

    stream: TextIO
    limit: int
    name: str = ""
    written: int = 0
    full: bool = False
    lost: int = 0

    def begin(self, kind: str, source: str, device: str) -> None:
        """Write the first line."""
        self._put(f"{MAGIC}{kind} {source} {device}\n")

    def record(self, way: RecordDirection, now: Now, data: bytes) -> None:
        """Write a record; the text of a word is written as it is."""
        said = data.decode() if way is RecordDirection.WORD else data.hex()
        self._put(f"{way} {now.utime} {now.monotonic_ns} {said}\n")

    def close(self) -> None:
        """Close the file, and tell what is not in it."""
        with contextlib.suppress(OSError):
            # what the disk did not take stands in the buffer still, and is refused again
            self.stream.close()
        if self.lost:
            log.warning("recording %s: %d records came after its end and are not in it", self.name, self.lost)

    def _put(self, line: str) -> None:
        if self.full:
            self.lost += 1
        elif self.written + len(line) > self.limit:
            self._end(f"it has its {self.limit / 1e6:g} MB, see --record-limit")
        else:
            try:
                self.stream.write(line)
                # what was received is there after a crash too
                self.stream.flush()
            except OSError as error:
                self._end(error.strerror or str(error))
            else:
                self.written += len(line)

    def _end(self, why: str) -> None:
        self.full, self.lost = True, 1
        log.warning("recording %s ended: %s; the driver goes on", self.name, why)


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
            record = _record(line)
            if record is None:
                self.damaged += 1
            else:
                yield record


def _record(line: str) -> RawRecord | None:
    way, _, rest = line.partition(" ")
    parts = rest.split(" ", 2)
    if not line.endswith("\n") or len(parts) != 3:
        return None
    try:
        direction = RecordDirection(way)
        data = parts[2].encode().strip() if direction is RecordDirection.WORD else bytes.fromhex(parts[2])
        return RawRecord(direction, Now(int(parts[1]), int(parts[0])), data)
    except ValueError:
        return None


@contextlib.contextmanager
def recording(path: Path, limit: int) -> Iterator[RawWriter]:
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
    """Return whether a file begins as a recording does, as far as it goes: one that a full disk cut short does too."""
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
