"""Timeline: delayed measurements (out-of-sequence).

Each item is inserted at its instant, and what follows is fused again from the state before it, a bounded number of
items at a time. Whatever the order of arrival, the final state is that of one order: instant, source, sequence number.
Items older than the horizon are settled: their decisions are final, and the state before the rest is the base.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Final, NamedTuple, TypeAlias

from modelserver.estimation.filter.fusion import NOTHING, Item
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.estimation.filter.step import step
from modelserver.messages import Decision
from modelserver.named_tuples import new_tuple

MAX_ITEMS: Final = 8192
"""Items within a horizon: more come from a flood, and are rejected."""


class Entry(NamedTuple):
    """An item, the state after it (None: not fused yet), and the decisions on it."""

    item: Item
    state: FilterState | None
    decisions: tuple[Decision, ...]


Key: TypeAlias = tuple[int, str, int, int]


def _get_key(entry: Entry) -> Key:
    return entry.item.key


def _get_order(item: Item) -> tuple[int, str]:
    """Return what orders two items of one source and instant; samples are values, so their repr is complete."""
    return item.seq, repr(item.sample)


class Timeline(NamedTuple):
    """`base` is the state before all `entries`; the first `num_fused` of them are fused."""

    base: FilterState
    entries: tuple[Entry, ...] = ()
    num_fused: int = 0

    @property
    def newest(self) -> FilterState:
        state = self.entries[self.num_fused - 1].state if self.num_fused else self.base
        assert state is not None
        return state

    def is_fused(self, limit: int) -> bool:
        """Return whether everything up to the instant `limit` is fused."""
        return self.num_fused == len(self.entries) or self.entries[self.num_fused].item.utime > limit

    def append(
        self, setup: Setup, items: Sequence[Item], budget: int, limit: int, oldest: int
    ) -> tuple[Timeline, FilterState, tuple[Decision, ...]] | None:
        """Return the timeline with the items of a sample more, all fused and settled, and what follows from it.

        That is its newest state, and the settled decisions. None if the items do not follow all others. The usual case
        of `insert`, `fuse` and `settle`, at a fraction of their cost; `oldest` is the beginning of the horizon.
        """
        base, entries, num_fused = self.base, self.entries, self.num_fused
        first = items[0]
        utime = first.utime
        if not entries or not oldest <= utime <= limit:
            return None
        if len(items) > 1 and any(each.utime != utime for each in items):
            return None
        newest = entries[-1].item
        # one of the same source and instant may be a duplicate
        if utime < newest.utime or (utime == newest.utime and first.source <= newest.source):
            return None
        waiting = len(entries) - num_fused
        if waiting + len(items) > budget:
            return None
        state = self.newest
        fused = []
        for item in (*[entry.item for entry in entries[num_fused:]], *items) if waiting else items:
            state, decisions = step(setup, state, item)
            fused.append(new_tuple(Entry, (item, state, decisions)))
        entries = (*entries[:num_fused], *fused) if waiting else (*entries, *fused)
        # one or two at a time, and never the last one
        cut, settled = 0, NOTHING
        while entries[cut].item.utime < oldest:
            settled += entries[cut].decisions
            cut += 1
        if cut:
            before = entries[cut - 1].state
            assert before is not None
            base, entries = before, entries[cut:]
        return new_tuple(Timeline, (base, entries, len(entries))), state, settled

    def insert(self, item: Item) -> tuple[Timeline, Item | None] | str:
        """Return the timeline with an item more, and the item that it replaces; or in one word why not.

        Of two items of one source and instant the lower sequence number counts, whichever arrived first.
        """
        entries = self.entries
        key = item.key
        if not entries or key > entries[-1].item.key:
            at = len(entries)
        elif len(entries) >= MAX_ITEMS:
            return "overload"
        else:
            at = bisect_left(entries, key, key=_get_key)
        replaced = None
        duplicate = self._find_duplicate(item, at)
        if duplicate is not None:
            replaced = entries[duplicate].item
            if _get_order(replaced) <= _get_order(item):
                return "duplicate"
            entries = entries[:duplicate] + entries[duplicate + 1 :]
        entries = entries[:at] + (Entry(item, None, ()),) + entries[at:]  # noqa: RUF005 - a third faster here
        return Timeline(self.base, entries, min(self.num_fused, at)), replaced

    def _find_duplicate(self, item: Item, at: int) -> int | None:
        """Return the index of the same measurement of the same source and instant; `at` is the item's own index.

        A source measures a thing once at an instant, whatever its numbering; all of that instant are side by side.
        """
        for around in (range(at - 1, -1, -1), range(at, len(self.entries))):
            for n in around:
                other = self.entries[n].item
                if other.utime != item.utime or other.source != item.source:
                    break
                # different types of samples may have the same source name
                if other.part == item.part and type(other.sample) is type(item.sample):
                    return n
        return None

    def fuse(self, setup: Setup, budget: int, limit: int) -> Timeline:
        """Return the timeline with up to `budget` items more fused, none later than the instant `limit`."""
        entries, at = self.entries, self.num_fused
        if self.is_fused(limit):
            return self
        state = self.newest
        fused = []
        for entry in entries[at : at + budget]:
            if entry.item.utime > limit:
                break
            state, decisions = step(setup, state, entry.item)
            fused.append(Entry(entry.item, state, decisions))
        until = at + len(fused)
        return Timeline(self.base, entries[:at] + tuple(fused) + entries[until:], until)

    def settle(self, utime: int) -> tuple[Timeline, tuple[Decision, ...]]:
        """Return the timeline without the fused items older than `utime`, and the decisions on them."""
        entries = self.entries
        cut = 0
        decisions: tuple[Decision, ...] = ()
        # one or two at a time
        while cut < self.num_fused and entries[cut].item.utime < utime:
            decisions += entries[cut].decisions
            cut += 1
        if not cut:
            return self, ()
        state = entries[cut - 1].state
        assert state is not None
        return Timeline(state, entries[cut:], self.num_fused - cut), decisions

    def get_state_at(self, utime: int) -> FilterState:
        """Return the newest fused state not newer than an instant; the base before all."""
        for entry in reversed(self.entries[: self.num_fused]):
            if entry.item.utime <= utime and entry.state is not None:
                found: FilterState = entry.state
                return found
        return self.base
