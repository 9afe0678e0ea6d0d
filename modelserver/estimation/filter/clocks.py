"""Clock monitor: delayed and out-of-sequence measurements, stamps from the future, clock steps."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from modelserver.estimation.filter.settings import FilterSettings

MOST_SOURCES = 256
"""Sources that are told apart: more names than that come from a flood."""

RECENT = 8
"""Good stamps of a source that are remembered, to tell a clock that was set back from one stamp that was ahead."""

MOST_AHEAD = 100
"""Counts that a sequence is taken to go on by: more is one that began anew from 0."""

REPLAY_RATE = 2_000.0
REPLAY_BURST = 4_000.0
"""Items a second, and at once, that delayed samples of one source may have fused again. A camera at 30 Hz with 0.2 s of
latency needs 900 beside 150 samples a second of others; whoever stamps back without end is refused what is more."""

INERTIAL_RANK = 2
"""The rank of an inertial unit: nothing leads before it."""

AHEAD_US = 60_000
"""Microseconds that a measurement waits for inertial samples up to its instant: most units speak within 50 ms."""


class Verdict(Enum):
    """What a stamp says about its sample."""

    GOOD = "good"
    LATE = "too_old"
    ORDER = "out_of_sequence"
    FUTURE = "future"
    STEPPED_BACK = "stepped_back"


SourceKey: TypeAlias = tuple[str, str]
"""The kind of a sample and the name of its source: a range whose source takes an inertial unit's name is not it."""


class Source(NamedTuple):
    """The stamps of one source: the newest good one with its sequence number, and a run of odd ones.

    `recent` are the last good stamps, the oldest first. The stamps of a clock that was set back cover ground that these
    covered already; those that follow one stamp that was ahead do not, and are as good as those before it. `replays`
    is how many items this source may still have fused again, as of the lead's instant `replays_utime`.
    """

    newest: int
    seq: int
    odd: int = 0
    odd_utime: int = 0
    odd_since: int = 0
    recent: tuple[int, ...] = ()
    replays: float = REPLAY_BURST
    replays_utime: int = 0

    def has_covered(self, utime: int) -> bool:
        """Return whether good stamps lie between the last odd one and `utime`, as far back as they are known."""
        recent = self.recent
        return not recent or utime <= recent[0] or any(self.odd_utime < each <= utime for each in recent)


class Clocks(NamedTuple):
    """The stamps of all sources, each judged by itself.

    `lead` is the source that time goes by: of those received the one with the highest rank. A clock that was set is
    distinguished from an odd sample by a run of `clock_jump_samples` of one source, ascending. Only the lead can set
    time back; another may set it forward while the lead is silent.
    """

    newest: int = 0
    rank: int = -1
    lead_utime: int = 0
    sources: Mapping[SourceKey, Source] = MappingProxyType({})

    def take(
        self, name: SourceKey, rank: int, utime: int, seq: int, settings: FilterSettings
    ) -> tuple[Clocks, Verdict]:
        """Return the clocks with one stamp more, and what to do with its sample."""
        source = self.sources.get(name)
        if source is None:
            source = Source(0, -1)
        horizon = round(settings.horizon * 1e6)
        ahead = utime - self.newest
        if self.newest and ahead > settings.clock_jump * 1e6:
            source = _odd(source, utime, self.lead_utime)
            if source.odd < settings.clock_jump_samples:
                return self._with(name, source), Verdict.FUTURE
        elif source.newest and utime < source.newest and (ahead < -horizon or 0 < seq - source.seq < MOST_AHEAD):
            # its own stamps go back: those of one that merely comes late do not, or its sequence goes back too
            source = _odd(source, utime, 0, is_back=True)
            if source.odd >= settings.clock_jump_samples and rank >= self.rank:
                return _set_back(name, rank, utime, seq), Verdict.STEPPED_BACK
            # within the horizon it is used as long as it may be chance: what counts must not hang on the arrival
            return self._with(name, source), Verdict.ORDER if ahead < -horizon else Verdict.GOOD
        elif self.newest and ahead < -horizon:
            if source.newest or rank < self.rank:
                return self, Verdict.LATE
            # heard for the first time: it may be the stamps before that are wrong, and they would keep it out for ever
            source = _odd(source, utime, self.lead_utime)
            if source.odd >= settings.clock_jump_samples:
                return _set_back(name, rank, utime, seq), Verdict.STEPPED_BACK
            return self._with(name, source), Verdict.LATE
        if utime < source.newest:
            return self, Verdict.GOOD
        source = Source(
            utime,
            seq,
            recent=(*source.recent[1 - RECENT :], utime),
            replays=source.replays,
            replays_utime=source.replays_utime,
        )
        leads = rank >= self.rank
        return (
            Clocks(
                max(self.newest, utime),
                max(rank, self.rank),
                max(utime, self.lead_utime) if leads else self.lead_utime,
                self.sources if self._full(name) else MappingProxyType({**self.sources, name: source}),
            ),
            Verdict.GOOD,
        )

    def with_replay(self, name: SourceKey, items: int) -> Clocks | None:
        """Return the clocks after a source has had so many items fused again; None where that is more than it may."""
        source = self.sources.get(name)
        if source is None:
            return self
        # by the lead's time, which the source cannot stamp
        passed = max(0, self.lead_utime - source.replays_utime) * 1e-6
        left = min(REPLAY_BURST, source.replays + REPLAY_RATE * passed) - items
        return None if left < 0.0 else self._with(name, source._replace(replays=left, replays_utime=self.lead_utime))

    def complete_to(self) -> int:
        """Return the instant up to which measurements can be fused for good, as far as the inertial unit goes.

        What is measured after its newest sample waits for the next: fused before it, it would be fused again after it.
        It does not wait longer than AHEAD_US.
        """
        if self.rank == INERTIAL_RANK and self.newest - self.lead_utime <= AHEAD_US:
            return self.lead_utime
        return self.newest

    def _full(self, name: SourceKey) -> bool:
        """Return whether there is no room for a source that is not known yet."""
        return name not in self.sources and len(self.sources) >= MOST_SOURCES

    def _with(self, name: SourceKey, source: Source) -> Clocks:
        if self._full(name):
            return self
        return self._replace(sources=MappingProxyType({**self.sources, name: source}))


def _set_back(name: SourceKey, rank: int, utime: int, seq: int) -> Clocks:
    """Return the clocks after the lead was set back to `utime`."""
    return Clocks(utime, rank, utime, MappingProxyType({name: Source(utime, seq, recent=(utime,))}))


def _odd(source: Source, utime: int, lead: int, is_back: bool = False) -> Source:
    """Return a source with an odd stamp more: those that follow each other make a run, unless the lead spoke.

    A stamp behind the newest (`is_back`) lengthens the run only where good stamps have covered the ground before.
    """
    follows = source.odd > 0 and 0 < utime - source.odd_utime <= 10_000_000 and source.odd_since == lead
    count = source.odd + 1 if follows else 1
    if follows and is_back and not source.has_covered(utime):
        count -= 1
    return source._replace(odd=count, odd_utime=utime, odd_since=lead)
