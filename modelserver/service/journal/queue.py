"""The black box, as the loop sees it: it tells what it handles and says, which costs it an append to a queue each.

`writer` turns that into files on a thread of its own, `rerun` runs it again. What the loop tells is immutable, so that
the thread may look at it whenever it comes to it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

from modelserver.core import CoreState, Instant
from modelserver.messages import Noticed
from modelserver.wire.journal import RecordKind

MOST_WAITING: Final = 100_000
MOST_BYTES: Final = 64 << 20
"""Records, and bytes of messages, that may wait to be written: at 1000 a second a disk may stand still for minutes."""

SUBJECT: Final = "journal"
"""Of the notice that goes out with the health report while the journal is not kept."""

Heard: TypeAlias = tuple[str, bytes]
"""Channel and bytes of a message."""


class Journal(Protocol):
    """What the loop tells of itself, each in the order in which it happens."""

    @property
    def wants_state(self) -> bool:
        """Whether `begin` is to be called before anything else is told."""
        ...

    def begin(self, state: CoreState, now: Instant) -> None:
        """Note what is known: from here on all can be run again without what was before."""
        ...

    def step(self, event: object, now: Instant, heard: Heard | None = None) -> None:
        """Note an event that the core is about to take; `heard` is the message that it was read from, if any."""
        ...

    def note(self, kind: RecordKind, heard: Heard, now: Instant) -> None:
        """Note a message that is not handed to the core, and what is done with it instead."""
        ...

    def said(self, channel: str, data: bytes) -> None:
        """Note a message that is about to be published."""
        ...

    def news(self) -> Sequence[Noticed]:
        """Return what has become of the journal since it was asked last, mostly nothing."""
        ...


class NoJournal:
    """Keeps nothing."""

    wants_state = False

    def begin(self, state: CoreState, now: Instant) -> None:
        """Do nothing."""

    def step(self, event: object, now: Instant, heard: Heard | None = None) -> None:
        """Do nothing."""

    def note(self, kind: RecordKind, heard: Heard, now: Instant) -> None:
        """Do nothing."""

    def said(self, channel: str, data: bytes) -> None:
        """Do nothing."""

    def news(self) -> Sequence[Noticed]:
        """Return nothing."""
        return ()


class JournalEntry(NamedTuple):
    """Something to be written: a message, an event, or a state (`event` is a `Beginning`)."""

    kind: RecordKind
    now: Instant
    channel: str
    data: bytes
    event: Any = None


@dataclass(frozen=True, slots=True)
class Beginning:
    """What is known where a segment begins; `lost` records were told since the one before and are not written."""

    state: CoreState
    lost: int


class JournalQueue:
    """Where the loop leaves what is to be written, and the writer's thread takes it away. Bounded.

    Where more waits than may, what comes is dropped and counted until a `begin` makes a new start; the writer asks for
    that with `ask`. No lock: each attribute has one thread that writes it, and a deque is safe at both its ends.
    """

    __slots__ = ("_begun", "_entries", "_given", "_last", "_news", "_open", "_taken", "lost", "wants_state")

    def __init__(self) -> None:
        self.wants_state = False
        self.lost = 0
        """Records that were dropped since the last beginning. Written by the loop's thread."""
        self._entries: deque[JournalEntry] = deque()
        self._news: deque[Noticed] = deque()
        self._open = False
        self._begun = 0  # 1 from the first beginning on: before that nothing is lost
        self._given = self._taken = 0
        self._last = Instant(0, 0)

    # --- the loop's side ---

    def begin(self, state: CoreState, now: Instant) -> None:
        """See `Journal`."""
        self.wants_state = False
        self._last = now
        lost, self.lost = self.lost, 0
        self._entries.append(JournalEntry(RecordKind.EVENT, now, "", b"", Beginning(state, lost)))
        self._open, self._begun = True, 1

    def step(self, event: object, now: Instant, heard: Heard | None = None) -> None:
        """See `Journal`."""
        self._last = now
        if not self._open:
            self.lost += self._begun
        elif heard is None:
            self._put(JournalEntry(RecordKind.EVENT, now, "", b"", event))
        else:
            self._put(JournalEntry(RecordKind.REQUEST, now, heard[0], heard[1], event))

    def note(self, kind: RecordKind, heard: Heard, now: Instant) -> None:
        """See `Journal`."""
        self._last = now
        self._put(JournalEntry(kind, now, heard[0], heard[1]))

    def said(self, channel: str, data: bytes) -> None:
        """See `Journal`."""
        self._put(JournalEntry(RecordKind.SAID, self._last, channel, data))

    def news(self) -> Sequence[Noticed]:
        """See `Journal`."""
        if not self._news:
            return ()
        return [self._news.popleft() for _ in range(len(self._news))]

    def _put(self, entry: JournalEntry) -> None:
        if not self._open:
            self.lost += self._begun
            return
        self._given += len(entry.data)
        if len(self._entries) >= MOST_WAITING or self._given - self._taken > MOST_BYTES:
            self._open = False
            self.lost += 1
            return
        self._entries.append(entry)

    # --- the writer's side ---

    @property
    def is_open(self) -> bool:
        """Whether what is told is taken; if not, a beginning is to be asked for once there is room."""
        return self._open

    def take(self, most: int) -> list[JournalEntry]:
        """Return what has waited longest."""
        entries = self._entries
        taken = [entries.popleft() for _ in range(min(most, len(entries)))]
        self._taken += sum(len(entry.data) for entry in taken)
        return taken

    def __len__(self) -> int:
        return len(self._entries)

    def ask(self) -> None:
        """Have the loop make a new beginning as soon as it can."""
        self.wants_state = True

    def tell(self, text: str) -> None:
        """Have the loop say with the health report what is wrong with the journal; nothing takes it back."""
        self._news.append(Noticed(SUBJECT, text))
