"""A line that is recorded, and a recording in place of a line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from modelserver.errors import RecordingError
from msdrivers.links import Link, PlayedOutError
from msdrivers.raw_log import Form, RawReader, RawRecord, RawWriter, RecordDirection, Time

U = TypeVar("U")


class RecordingLink(Generic[U]):
    """A line whose traffic is recorded."""

    def __init__(self, link: Link[U], form: Form[U], writer: RawWriter, time: Time):
        self._link, self._form, self._writer, self._time = link, form, writer, time
        self._is_open = False

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
        self._is_open = True
        self._word(f"open {self.description} {self.baud}")

    def close(self) -> None:
        """Close the line."""
        self._link.close()
        # one that cannot be opened is closed each time that it was tried
        if self._is_open:
            self._word("close")
        self._is_open = False

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what came in. Raises LinkError."""
        units = self._link.poll(timeout)
        for unit in units:
            self._writer.record(RecordDirection.RECEIVED, self._time.now(), self._form.pack(unit))
        return units

    def send(self, unit: U) -> None:
        """Send a unit. Raises LinkError."""
        self._link.send(unit)
        self._writer.record(RecordDirection.SENT, self._time.now(), self._form.pack(unit))

    def _word(self, text: str) -> None:
        self._writer.record(RecordDirection.WORD, self._time.now(), text.encode())


class PlayedLink(Generic[U]):
    """A recording in place of a line: what was received comes again, as long after each other as then.

    What is sent goes nowhere. The recording's end is a PlayedOutError, which says how much of it was damaged.
    """

    baud = 0

    def __init__(self, reader: RawReader, unpack: Callable[[bytes], U], time: Time):
        self.description = reader.name
        self._reader = reader
        self._records = (record for record in reader if record.way is RecordDirection.RECEIVED)
        self._unpack, self._time = unpack, time
        self._played = self._unfit = 0
        self._next: RawRecord | None = None
        self._ahead_ns: int | None = None

    def open(self, baud: int | None = None) -> None:
        """Begin, or go on."""

    def close(self) -> None:
        """Stop."""

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what is due, waiting `timeout` seconds at most.

        Raises PlayedOutError at the end, RecordingError at the end of one of which nothing could be played.
        """
        if self._next is None:
            self._next = next(self._records, None)
            if self._next is None:
                raise self._ended()
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
            unit = self._unpack(record.data)
        except ValueError:
            # written by a form of another version, or damaged
            self._unfit += 1
            return ()
        self._played += 1
        return (unit,)

    def send(self, unit: U) -> None:
        """Send nothing."""

    def _ended(self) -> PlayedOutError | RecordingError:
        damaged = self._reader.damaged + self._unfit
        if not self._played:
            why = f"all that was received is damaged, {damaged} lines" if damaged else "nothing was received in it"
            return RecordingError(f"{self.description}: nothing of it can be played: {why}")
        left_out = f"; {damaged} damaged lines of it were left out" if damaged else ""
        return PlayedOutError(self.description, f"the recording has ended{left_out}")
