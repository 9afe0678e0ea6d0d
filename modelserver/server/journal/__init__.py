"""Queue between the loop and the journal's writer thread: recording costs the loop one append per record.

The recorded objects are immutable, so that the writer may encode them at any later time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

from modelserver.core import CoreState, Instant
from modelserver.messages import HealthWarning
from modelserver.wire.journal import RecordKind

MAX_QUEUED_RECORDS: Final = 100_000
MAX_QUEUED_BYTES: Final = 64 << 20
"""Queued records and message bytes: at 1000 records a second a disk may block for minutes."""

SUBJECT: Final = "journal"
"""Subject of the health warning while nothing is recorded."""

ReceivedMessage: TypeAlias = tuple[str, bytes]
"""Channel and bytes of a message."""


class JournalEntry(NamedTuple):
    """A queued record: a message, an event, or a state (`event` is a `SegmentStart`)."""

    kind: RecordKind
    now: Instant
    channel: str
    data: bytes
    event: Any = None


@dataclass(frozen=True, slots=True)
class SegmentStart:
    """State at the start of a segment; `lost` records before it were dropped."""

    state: CoreState
    lost: int


class JournalQueue:
    """Bounded queue from the loop to the writer's thread, in processing order. Before the first `begin` it drops all.

    On overflow, records are dropped and counted until the next `begin`, which the writer requests (`wants_state`).
    Lock-free: each attribute is written by one thread, and a deque is thread-safe at both ends.
    """

    def __init__(self) -> None:
        self.wants_state = False
        """Whether the writer requests a `begin` before the next record."""
        self.lost = 0
        """Records dropped since the last `begin`. Written by the loop's thread."""
        self._entries: deque[JournalEntry] = deque()
        self._warnings: deque[HealthWarning] = deque()
        self.is_open = False
        """Whether records are accepted; if not, the writer requests a state once there is room."""
        self._is_started = 0  # 1 from the first `begin` on: before it nothing counts as lost
        self._queued_bytes = self._popped_bytes = 0
        self._last = Instant(0, 0)

    # --- called by the loop's thread ---

    def begin(self, state: CoreState, now: Instant) -> None:
        """Record the state: from here on a replay needs nothing from before."""
        self.wants_state = False
        self._last = now
        lost, self.lost = self.lost, 0
        self._entries.append(JournalEntry(RecordKind.EVENT, now, "", b"", SegmentStart(state, lost)))
        self.is_open, self._is_started = True, 1

    def record_event(self, event: object, now: Instant, received: ReceivedMessage | None = None) -> None:
        """Record an event before the core processes it; `received` is the message it was decoded from, if any."""
        self._last = now
        kind = RecordKind.EVENT if received is None else RecordKind.REQUEST
        self._put(kind, now, *(received or ("", b"")), event)

    def record_message(self, kind: RecordKind, received: ReceivedMessage, now: Instant) -> None:
        """Record a received message that the core does not process, and what is done with it instead."""
        self._last = now
        self._put(kind, now, *received)

    def record_published(self, channel: str, data: bytes) -> None:
        self._put(RecordKind.PUBLISHED, self._last, channel, data)

    def poll_warnings(self) -> Sequence[HealthWarning]:
        return [self._warnings.popleft() for _ in range(len(self._warnings))]

    def _put(self, kind: RecordKind, now: Instant, channel: str, data: bytes, event: object = None) -> None:
        if not self.is_open:
            self.lost += self._is_started
            return
        self._queued_bytes += len(data)
        if len(self._entries) >= MAX_QUEUED_RECORDS or self._queued_bytes - self._popped_bytes > MAX_QUEUED_BYTES:
            self.is_open = False
            self.lost += 1
            return
        self._entries.append(JournalEntry(kind, now, channel, data, event))

    # --- called by the writer's thread ---

    def pop(self, max_count: int) -> list[JournalEntry]:
        entries = self._entries
        popped = [entries.popleft() for _ in range(min(max_count, len(entries)))]
        self._popped_bytes += sum(len(entry.data) for entry in popped)
        return popped

    def __len__(self) -> int:
        return len(self._entries)

    def set_warning(self, text: str) -> None:
        """Set the health warning about the journal; an empty text clears it."""
        self._warnings.append(HealthWarning(SUBJECT, text))
