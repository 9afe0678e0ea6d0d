"""Cuts a stream of bytes into frames of several formats, and finds its way back after noise.

After a frame that is refused the search goes on one byte further, so that a good frame which began inside a broken
one is still found. What is kept is bounded: every format refuses a frame that would be longer than its limit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from msdrivers.protocol.bounded_counter import BoundedCounter

M = TypeVar("M")
M_co = TypeVar("M_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Taken(Generic[M_co]):
    """A good frame: where it ends in the buffer, its kind for the counters, and its message.

    None is a message that is well formed and of no use here.
    """

    end: int
    kind: str
    message: M_co | None


@dataclass(frozen=True, slots=True)
class Refused:
    """No good frame begins here. An empty reason is chance: a byte that only looked like a beginning."""

    reason: str


CHANCE = Refused("")


class Format(Protocol[M_co]):
    """One way to frame messages."""

    @property
    def leads(self) -> bytes:
        """The bytes that a frame may begin with; no two formats of one scanner share one."""

    def scan(self, buffer: bytearray, at: int, start: int) -> Taken[M_co] | Refused | None:
        """Judge what begins at `at`, `start` bytes after the beginning of the stream; None: more bytes are needed."""


class Scanner(Generic[M]):
    """Feeds bytes to formats. `feed` never raises, whatever the bytes."""

    def __init__(self, formats: Sequence[Format[M]]) -> None:
        self._format = {lead: each for each in formats for lead in each.leads}
        self._lead = re.compile(b"[" + re.escape(bytes(self._format)) + b"]")
        self._buffer = bytearray()
        self._offset = 0
        self._skipped = 0
        self._frames = BoundedCounter()
        self._rejected: Counter[str] = Counter()

    @property
    def offset(self) -> int:
        """Bytes that were fed up to now."""
        return self._offset + len(self._buffer)

    @property
    def waiting(self) -> int:
        """Bytes that are kept because the frame they begin is not complete."""
        return len(self._buffer)

    @property
    def counts(self) -> dict[str, int]:
        """Frames by kind, `rejected.<reason>`, and `skipped`: bytes in no frame, ends of lines not counted."""
        rejected = {f"rejected.{reason}": number for reason, number in self._rejected.items()}
        return {**self._frames, **rejected, "skipped": self._skipped}

    def reject(self, reason: str) -> None:
        """Count a message that was refused for what it says, its frame being good."""
        self._rejected[reason] += 1

    def clear(self) -> None:
        """Forget the incomplete frame, for the line was interrupted. Counters and offsets go on."""
        self._skip(0, len(self._buffer))
        self._offset += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> list[M]:
        """Return the messages that `data` completes, in the order of their beginnings."""
        buffer = self._buffer
        buffer += data
        messages = []
        at = 0
        while found := self._lead.search(buffer, at):
            if found.start() > at:
                self._skip(at, found.start())
                at = found.start()
            verdict = self._judged(at)
            if verdict is None:
                break
            if isinstance(verdict, Refused):
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

    def _judged(self, at: int) -> Taken[M] | Refused | None:
        """Ask the format of the frame. An error of its own costs this frame, not all that follow it."""
        try:
            return self._format[self._buffer[at]].scan(self._buffer, at, self._offset + at)
        except Exception:
            return Refused("error")

    def _skip(self, begin: int, end: int) -> None:
        part = self._buffer[begin:end]
        self._skipped += len(part) - part.count(b"\r") - part.count(b"\n")
