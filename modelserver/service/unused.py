"""Messages that are not used: counted all of them, and of a few a second it is kept what they were.

Bytes that are no message, samples of a second writer, wishes without a signature: whoever sends them may send many, and
the journal is not to hold them instead of what the vehicle did. So each channel has a budget a second, by the loop's
clock. Beyond it the bytes are not noted and the core is told how many there were, once a second and before each
report of health, instead of with each.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Final, Protocol

from modelserver.core import Instant
from modelserver.messages import Rejected
from modelserver.service.journal.queue import Heard
from modelserver.wire.journal import RecordKind

A_SECOND: Final = 8
"""Messages of a channel a second whose bytes are noted, and refusals of one cause a second that are told singly."""

MOST_NOTED: Final = 512
"""Bytes that the journal keeps of a message that is not used."""

SECOND_NS: Final = 1_000_000_000


class Noting(Protocol):
    """The part of a journal that is told of messages that the core is not handed."""

    def note(self, kind: RecordKind, heard: Heard, now: Instant) -> None:
        """Note a message, and what is done with it."""
        ...


class Budget:
    """Grants each name so much a second: seconds that begin with what is asked for first."""

    def __init__(self, a_second: int = A_SECOND):
        self._a_second = a_second
        self._begun: dict[Hashable, tuple[int, int]] = {}

    def grants(self, name: Hashable, now_ns: int) -> bool:
        """Return whether there is something left for a name at an instant (monotonic, ns), and take it."""
        begin, used = self._begun.get(name, (now_ns, 0))
        if now_ns - begin >= SECOND_NS:
            begin, used = now_ns, 0
        if used >= self._a_second:
            return False
        self._begun[name] = (begin, used + 1)
        return True


class Unused:
    """Counts what is not used, and notes some of it. `step` hands the core an event.

    Channels and reasons are this program's own, so what is remembered of them is bounded.
    """

    def __init__(self, step: Callable[[Rejected, Instant], None], journal: Noting):
        self._step = step
        self._journal = journal
        self._noted, self._singly = Budget(), Budget()
        self._waiting: dict[tuple[str, str], int] = {}
        self._told_ns = 0

    def note(self, kind: RecordKind, channel: str, data: bytes, now: Instant) -> None:
        """Have the journal keep how a message begins, while the channel's budget lasts."""
        if self._noted.grants(channel, now.monotonic_ns):
            self._journal.note(kind, (channel, data[:MOST_NOTED]), now)

    def count(self, channel: str, reason: str, now: Instant) -> None:
        """Have the core count a message: now, or where many come, with `tell`."""
        self._count((channel, reason), now)

    def drop(self, kind: RecordKind, channel: str, reason: str, data: bytes, now: Instant) -> None:
        """Count a message and note it, within the budgets; beyond them this costs a microsecond."""
        if self._count((channel, reason), now):
            self.note(kind, channel, data, now)

    def _count(self, key: tuple[str, str], now: Instant) -> bool:
        """Count a message; return whether the core was handed it singly."""
        if self._singly.grants(key, now.monotonic_ns):
            self._step(Rejected(*key), now)
            return True
        self._waiting[key] = self._waiting.get(key, 0) + 1
        return False

    def tell(self, now: Instant, at_once: bool = False) -> None:
        """Have the core count what waits for that, where it has waited for a second, or `at_once`."""
        if not self._waiting or not (at_once or now.monotonic_ns - self._told_ns >= SECOND_NS):
            return
        waiting, self._waiting, self._told_ns = self._waiting, {}, now.monotonic_ns
        for (channel, reason), count in waiting.items():
            self._step(Rejected(channel, reason, count), now)
