"""Record and replay the bytes of a line, one line of text per unit.

    # modelserver raw 1 bytes gps novatel
    = 1750000000000000 81234567890 open /dev/ttyUSB0 38400
    > 1750000000001200 81235767890 6c6f67...
    < 1750000000010500 81245067890 aa44121c...

The first line has the version, the driver and the device. Each further line has the direction (`<` received, `>` sent,
`=` event of the line), the host's clock in microseconds since 1970, the monotonic clock in nanoseconds, and the unit in
hexadecimal. An incomplete last line is ignored, a damaged line is skipped and counted.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TextIO

from modelserver.errors import RecordingError
from modelserver.files import NotRegularFileError, open_regular
from msdrivers.endpoint import HostTime, TimeSource
from msdrivers.links import EndOfRecordingError, Link, LinkWrapper

log = logging.getLogger(__name__)

MAGIC = "# modelserver raw 1 bytes "

MAX_LINE = 1 << 20
"""Characters; longer lines are damage."""

MAX_SIZE = 10**9
"""Characters of a recording, days of a receiver: a recorder must not fill the disk."""

RECEIVED, SENT, EVENT = "<>="


class RawRecord(NamedTuple):
    """One line of a recording: its direction, when, and the unit, or the text of an event."""

    direction: str
    time: HostTime
    data: bytes


def open_for_writing(path: Path) -> TextIO:
    """Create the file of a recording. Raises RecordingError where there is one of that name, which stays; OSError."""
    try:
        return path.open("x", encoding="ascii", errors="replace")
    except FileExistsError:
        raise RecordingError(f"{path} is there already, and stays; name another") from None


def open_for_reading(path: Path, driver: str, device: str) -> TextIO:
    """Open the recording of a device. Raises RecordingError where it is none, OSError where it cannot be read."""
    try:
        stream = io.TextIOWrapper(open_regular(path), encoding="ascii", errors="replace")
    except NotRegularFileError as error:
        raise RecordingError(f"{path}: this is {error.kind}, not a recording of a driver") from None
    head = stream.readline(200)
    words = head.removeprefix(MAGIC).split()
    if not head.startswith(MAGIC) or len(words) != 2:
        why = f"{path} is no recording of a driver: it does not begin with {MAGIC.strip()!r}"
    elif words[1] != device:
        why = f"{path}: recording of a {words[1]} (driver {words[0]}), but driver {driver} is a {device}"
    else:
        return stream
    stream.close()
    raise RecordingError(why)


def read_records(stream: TextIO) -> Iterator[RawRecord | None]:
    """Yield the records of a recording after its first line, None for a damaged line."""
    while line := stream.readline(MAX_LINE):
        direction, _, rest = line.partition(" ")
        try:
            utime, monotonic_ns, text = rest.split(" ", 2)
            time = HostTime(int(monotonic_ns), int(utime))
            data = text.encode().strip() if direction == EVENT else bytes.fromhex(text)
        except ValueError:
            yield None
            continue
        is_whole = line.endswith("\n") and direction in (RECEIVED, SENT, EVENT)
        yield RawRecord(direction, time, data) if is_whole else None


class RecordingLink(LinkWrapper[bytes]):
    """A line whose traffic is written to `stream`, until that has its size, or the disk is full."""

    def __init__(self, link: Link[bytes], stream: TextIO, driver: str, device: str, time: TimeSource):
        super().__init__(link)
        self._stream, self._time_source = stream, time
        self._size = 0
        self._write(f"{MAGIC}{driver} {device}\n")

    def open(self, baud: int | None = None) -> None:
        self._link.open(baud)
        self._record(EVENT, f"open {self.description} {self.baud}")

    def poll(self, timeout: float) -> Sequence[bytes]:
        units = self._link.poll(timeout)
        for unit in units:
            self._record(RECEIVED, unit.hex())
        return units

    def send(self, unit: bytes) -> None:
        self._link.send(unit)
        self._record(SENT, unit.hex())

    def _record(self, direction: str, text: str) -> None:
        now = self._time_source.now()
        self._write(f"{direction} {now.utime} {now.monotonic_ns} {text}\n")

    def _write(self, line: str) -> None:
        if self._stream.closed:
            return
        self._size += len(line)
        try:
            if self._size > MAX_SIZE:
                raise OSError(f"it has {MAX_SIZE / 1e6:g} MB")
            self._stream.write(line)
            # what was received is there after a crash too
            self._stream.flush()
        except OSError as error:
            log.warning("the recording has ended: %s; the driver continues", error.strerror or error)
            with contextlib.suppress(OSError):
                # the rest of the buffer fails again on a full disk
                self._stream.close()


class ReplayLink:
    """A link that replays the received bytes of a recording with their original timing.

    Sent units are discarded. The end raises EndOfRecordingError with the number of damaged lines.
    """

    baud = 0

    def __init__(self, stream: TextIO, name: str, time: TimeSource):
        self.description = name
        self._records = read_records(stream)
        self._time_source = time
        self._replayed = self._damaged = 0
        self._next: RawRecord | None = None
        self._replay_offset_ns: int | None = None

    def open(self, baud: int | None = None) -> None:
        pass

    def close(self) -> None:
        pass

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what is due, waiting `timeout` seconds at most.

        Raises EndOfRecordingError at the end, RecordingError at the end of one of which nothing could be played.
        """
        record = self._next = self._next or self._read_next()
        now_ns = self._time_source.now().monotonic_ns
        if self._replay_offset_ns is None:
            self._replay_offset_ns = now_ns - record.time.monotonic_ns
        wait = (record.time.monotonic_ns + self._replay_offset_ns - now_ns) * 1e-9
        if wait > 0:
            self._time_source.sleep(min(wait, max(0.0, timeout)))
            if wait > timeout:
                return ()
        self._next = None
        self._replayed += 1
        return (record.data,)

    def send(self, unit: bytes) -> None:
        pass

    def _read_next(self) -> RawRecord:
        for record in self._records:
            if record is None:
                self._damaged += 1
            elif record.direction == RECEIVED:
                return record
        if not self._replayed:
            damaged = self._damaged
            why = f"all that was received is damaged, {damaged} lines" if damaged else "nothing was received in it"
            raise RecordingError(f"{self.description}: nothing of it can be played: {why}")
        left_out = f"; {self._damaged} damaged lines of it were left out" if self._damaged else ""
        raise EndOfRecordingError(self.description, f"the recording has ended{left_out}")
