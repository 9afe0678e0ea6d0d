"""Measurement buffer: a delayed (out-of-sequence) measurement is inserted, and what follows is fused again.

Delayed measurements: each is inserted at its instant and what follows is fused again, a bounded amount at a time.
Whatever the order of arrival, the state in the end is that of the one order: instant, source, sequence.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple, TypeAlias

from modelserver.estimation.filter import engine
from modelserver.estimation.filter.items import Item
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import Decision

MOST = 8192
"""Items within a horizon: more come from a flood, and are refused."""


class Entry(NamedTuple):
    """An item, the state after it (None: not worked through yet), and what became of it."""

    item: Item
    state: FilterState | None
    decisions: tuple[Decision, ...]


Key: TypeAlias = tuple[int, str, int, int]


def _key(entry: Entry) -> Key:
    return entry.item.key


def _order(item: Item) -> tuple[int, str]:
    """Return what decides between two items of one source and instant; samples are values, and say all in words."""
    return item.seq, repr(item.sample)


class Timeline(NamedTuple):
    """`base` is the state before all `entries`; the first `fused` of them are worked through."""

    base: FilterState
    entries: tuple[Entry, ...] = ()
    fused: int = 0

    @property
    def newest(self) -> FilterState:
        """The state after all that is worked through."""
        state = self.entries[self.fused - 1].state if self.fused else self.base
        assert state is not None
        return state

    def settled(self, limit: int) -> bool:
        """Return whether everything up to the instant `limit` is worked through."""
        return self.fused == len(self.entries) or self.entries[self.fused].item.utime > limit

    def with_item(self, item: Item) -> tuple[Timeline, Item | None] | str:
        """Return the timeline with one item more in its place, or in one word why not.

        With it comes the item that had to make room: of two that one source says of one instant the lower number
        counts, whichever came first.
        """
        entries = self.entries
        key = item.key
        if not entries or key > entries[-1].item.key:
            at = len(entries)
        elif len(entries) >= MOST:
            return "overload"
        else:
            at = bisect_left(entries, key, key=_key)
        out = None
        twin = self._twin(item, at)
        if twin is not None:
            out = entries[twin].item
            if _order(out) <= _order(item):
                return "duplicate"
            entries = entries[:twin] + entries[twin + 1 :]
        return Timeline(self.base, entries[:at] + (Entry(item, None, ()),) + entries[at:], min(self.fused, at)), out  # noqa: RUF005 - a third faster here

    def _twin(self, item: Item, at: int) -> int | None:
        """Return where the same source says the same of the same instant; `at` is where the item's place would be.

        A source measures a thing once at an instant, whatever its numbering; all of that instant stand side by side.
        """
        for around in (range(at - 1, -1, -1), range(at, len(self.entries))):
            for n in around:
                other = self.entries[n].item
                if other.utime != item.utime or other.source != item.source:
                    break
                # a range of the same source name is no inertial sample
                if other.part == item.part and type(other.sample) is type(item.sample):
                    return n
        return None

    def worked(self, setup: Setup, budget: int, limit: int) -> Timeline:
        """Return the timeline with up to `budget` items more worked through, none later than the instant `limit`."""
        entries, at = self.entries, self.fused
        if self.settled(limit):
            return self
        state = self.newest
        fresh = []
        for entry in entries[at : at + budget]:
            if entry.item.utime > limit:
                break
            state, decisions = engine.fused(setup, state, entry.item)
            fresh.append(Entry(entry.item, state, decisions))
        until = at + len(fresh)
        return Timeline(self.base, entries[:at] + tuple(fresh) + entries[until:], until)

    def settled_before(self, utime: int) -> tuple[Timeline, tuple[Decision, ...]]:
        """Return the timeline without what is older than `utime` and worked through, and what became of that."""
        entries = self.entries
        cut = 0
        # one or two are past at a time
        while cut < self.fused and entries[cut].item.utime < utime:
            cut += 1
        if not cut:
            return self, ()
        decisions: tuple[Decision, ...] = ()
        for entry in entries[:cut]:
            decisions += entry.decisions
        state = entries[cut - 1].state
        assert state is not None
        return Timeline(state, entries[cut:], self.fused - cut), decisions

    def state_at(self, utime: int) -> FilterState:
        """Return the newest state worked through that is not newer than an instant; the base before all."""
        for entry in reversed(self.entries[: self.fused]):
            if entry.item.utime <= utime and entry.state is not None:
                found: FilterState = entry.state
                return found
        return self.base
