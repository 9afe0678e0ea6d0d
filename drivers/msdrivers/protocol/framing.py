"""Frame a byte stream that mixes several formats, with resynchronization after noise.

The scanner searches the next start byte and lets its format check the frame there: length, checksum, values. After a
rejected frame the search continues one byte further, so that a valid frame that began inside a damaged one is found.
The buffer is bounded: every format rejects a frame that would be longer than its limit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

M = TypeVar("M")
M_co = TypeVar("M_co", covariant=True)


MAX_NAMES: Final = 64
"""Largest number of names; further ones are counted as `other`."""

MAX_NAME_LENGTH: Final = 48
"""Longer names are truncated."""


class BoundedCounter(Counter[str]):
    """Counts by name; once `MAX_NAMES` are known, a new one is counted as `other` of its kind.

    The kind is the part before the first dot: `novatel.id 4711B` becomes `novatel.other`.
    """

    def add(self, name: str) -> None:
        """Count one more of `name`."""
        name = name[:MAX_NAME_LENGTH]
        if name not in self and len(self) >= MAX_NAMES:
            # one `other` for each kind; kinds are this program's own words
            name = f"{name.partition('.')[0]}.other"
        self[name] += 1


@dataclass(frozen=True, slots=True)
class ParsedFrame(Generic[M_co]):
    """A valid frame: its end in the buffer, its kind for the counters, its message (None: valid but not used here)."""

    end: int
    kind: str
    message: M_co | None


@dataclass(frozen=True, slots=True)
class RejectedFrame:
    """No valid frame starts here. An empty reason means chance: a byte that only looked like a start."""

    reason: str


NO_FRAME = RejectedFrame("")


class FrameFormat(Protocol[M_co]):
    """A frame format."""

    @property
    def start_bytes(self) -> bytes:
        """First bytes of a frame; formats of one scanner share none."""

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[M_co] | RejectedFrame | None:
        """Parse the frame at `at`, `start` bytes after the beginning of the stream; None: more bytes are needed."""


class FrameScanner(Generic[M]):
    """Finds the frames of several formats in a byte stream; `feed` never raises."""

    def __init__(self, formats: Sequence[FrameFormat[M]]) -> None:
        self._formats = {lead: each for each in formats for lead in each.start_bytes}
        self._start_pattern = re.compile(b"[" + re.escape(bytes(self._formats)) + b"]")
        self._buffer = bytearray()
        self._offset = 0
        self._skipped = 0
        self._frames = BoundedCounter()
        self._rejected: Counter[str] = Counter()

    @property
    def offset(self) -> int:
        """Number of bytes fed so far."""
        return self._offset + len(self._buffer)

    @property
    def pending_bytes(self) -> int:
        """Number of buffered bytes of an incomplete frame."""
        return len(self._buffer)

    @property
    def counts(self) -> dict[str, int]:
        """Frames by kind, `rejected.<reason>`, and `skipped`: bytes in no frame, ends of lines not counted."""
        rejected = {f"rejected.{reason}": number for reason, number in self._rejected.items()}
        return {**self._frames, **rejected, "skipped": self._skipped}

    def reject(self, reason: str) -> None:
        """Count a message that was rejected for its content."""
        self._rejected[reason] += 1

    def clear(self) -> None:
        """Discard the incomplete frame after an interruption; counters and offsets continue."""
        self._skip(0, len(self._buffer))
        self._offset += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[M]:
        """Return the messages that `data` completes, in stream order."""
        buffer = self._buffer
        buffer += data
        messages = []
        at = 0
        while found := self._start_pattern.search(buffer, at):
            if found.start() > at:
                self._skip(at, found.start())
                at = found.start()
            try:
                verdict = self._formats[buffer[at]].scan(buffer, at, self._offset + at)
            except Exception:
                verdict = RejectedFrame("error")
            if verdict is None:
                break
            if isinstance(verdict, RejectedFrame):
                if verdict.reason:
                    self._rejected[verdict.reason] += 1
                self._skip(at, at + 1)
                at += 1
                continue
            self._frames.add(verdict.kind)
            if verdict.message is not None:
                messages.append(verdict.message)
            at = verdict.end
        else:
            self._skip(at, len(buffer))
            at = len(buffer)
        self._offset += at
        del buffer[:at]
        return messages

    def _skip(self, begin: int, end: int) -> None:
        part = self._buffer[begin:end]
        self._skipped += len(part) - part.count(b"\r") - part.count(b"\n")
