"""Clock monitor: delayed and out-of-sequence measurements, stamps from the future, clock steps.

Each source is judged by its own stamps. The time of the filter is that of the leading source: the one with the highest
rank of those received, the IMU if there is one. A stamp far ahead, or behind the newest of its source, is odd. A run of
`clock_jump_samples` odd stamps in ascending order shows that the clock was set; a single one is an outlier. Only the
leading source can set time back; another one may set it forward while the leading source is silent.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

from modelserver.estimation.settings import FixSettings
from modelserver.named_tuples import new_tuple

MAX_SOURCES: Final = 256
"""Sources that are tracked: more names than that come from a flood."""

RECENT_STAMPS: Final = 8
"""Good stamps of a source that are stored, to separate a clock that was set back from one stamp that was ahead."""

MAX_SEQUENCE_STEP: Final = 100
"""Largest step of a sequence number that continues: a larger one is a restart from 0."""

REPLAY_RATE: Final = 2_000.0
REPLAY_BURST: Final = 4_000.0
"""Items per second, and at once, that delayed samples of one source may have fused again. A camera at 30 Hz with 0.2 s
of latency needs 900 beside 150 samples per second of others; a source that keeps stamping back is refused more."""

IMU_RANK: Final = 2
"""The rank of an IMU: no source leads before it."""

IMU_WAIT_US: Final = 60_000
"""Microseconds that a measurement waits for IMU samples up to its instant: most units publish within 50 ms."""


class StampVerdict(Enum):
    """What a stamp means for its sample."""

    GOOD = "good"
    TOO_OLD = "too_old"
    OUT_OF_SEQUENCE = "out_of_sequence"
    FUTURE = "future"
    STEPPED_BACK = "stepped_back"


SourceKey: TypeAlias = tuple[str, str]
"""The type of a sample and the name of its source: two types of samples may have the same source name."""


class SourceClock(NamedTuple):
    """The stamps of one source.

    Attributes
    ----------
    newest, seq: the newest good stamp and its sequence number.
    num_odd, odd_utime, odd_since: a run of odd stamps: how many, the last one, and the leading stamp at its start.
    recent: the last good stamps, the oldest first. The stamps of a clock that was set back cover a time that these
        have covered already; those that follow one stamp that was ahead do not, and are as good as those before it.
    replays: items that this source may still have fused again, as of the leading stamp `replays_utime`.
    """

    newest: int
    seq: int
    num_odd: int = 0
    odd_utime: int = 0
    odd_since: int = 0
    recent: tuple[int, ...] = ()
    replays: float = REPLAY_BURST
    replays_utime: int = 0


NEW_SOURCE: Final = SourceClock(0, -1)
"""A source before its first stamp."""


class ClockMonitor(NamedTuple):
    """The stamps of all sources. `newest` is the newest good stamp, `rank` and `lead_utime` those of the lead."""

    newest: int = 0
    rank: int = -1
    lead_utime: int = 0
    sources: Mapping[SourceKey, SourceClock] = MappingProxyType({})

    def update(
        self, name: SourceKey, rank: int, utime: int, seq: int, settings: FixSettings, horizon: float
    ) -> tuple[ClockMonitor, StampVerdict]:
        """Return the monitor after a stamp, and what it means; `horizon` (s) is how late a sample may come."""
        newest, leading, lead_utime, sources = self
        source = sources.get(name, NEW_SOURCE)
        ahead = utime - newest
        horizon_us = round(horizon * 1e6) if ahead < 0 else 0
        if newest and ahead > settings.clock_jump * 1e6:
            source = _count_odd(source, utime, self.lead_utime)
            if source.num_odd < settings.clock_jump_samples:
                return self._with(name, source), StampVerdict.FUTURE
        elif (
            source.newest
            and utime < source.newest
            and (ahead < -horizon_us or 0 < seq - source.seq < MAX_SEQUENCE_STEP)
        ):
            # its own stamps go back: a source that is merely delayed does not, or its sequence goes back too
            source = _count_odd(source, utime, 0, is_back=True)
            if source.num_odd >= settings.clock_jump_samples and rank >= self.rank:
                return _set_back(name, rank, utime, seq), StampVerdict.STEPPED_BACK
            # within the horizon it is used while it may be chance: the result must not depend on the order of arrival
            return self._with(name, source), StampVerdict.OUT_OF_SEQUENCE if ahead < -horizon_us else StampVerdict.GOOD
        elif newest and ahead < -horizon_us:
            if source.newest or rank < self.rank:
                return self, StampVerdict.TOO_OLD
            # its first stamps: those before may be the wrong ones, and would keep it out forever
            source = _count_odd(source, utime, self.lead_utime)
            if source.num_odd >= settings.clock_jump_samples:
                return _set_back(name, rank, utime, seq), StampVerdict.STEPPED_BACK
            return self._with(name, source), StampVerdict.TOO_OLD
        if utime < source.newest:
            return self, StampVerdict.GOOD
        if source is not NEW_SOURCE or not self._is_full(name):
            recent = (*source.recent[1 - RECENT_STAMPS :], utime)
            clock = (utime, seq, 0, 0, 0, recent, source.replays, source.replays_utime)
            sources = {**sources, name: new_tuple(SourceClock, clock)}
        if rank >= leading:
            leading = rank
            if utime > lead_utime:
                lead_utime = utime
        newest = utime if utime > newest else newest
        return new_tuple(ClockMonitor, (newest, leading, lead_utime, sources)), StampVerdict.GOOD

    def spend_replays(self, name: SourceKey, items: int) -> ClockMonitor | None:
        """Return the monitor after a source has had so many items fused again; None if that is more than it may."""
        source = self.sources.get(name)
        if source is None:
            return self
        # by the time of the lead, which the source cannot stamp
        passed = max(0, self.lead_utime - source.replays_utime) * 1e-6
        left = min(REPLAY_BURST, source.replays + REPLAY_RATE * passed) - items
        return None if left < 0.0 else self._with(name, source._replace(replays=left, replays_utime=self.lead_utime))

    def get_complete_utime(self) -> int:
        """Return the instant up to which measurements can be fused without waiting for the IMU.

        A measurement after the newest IMU sample waits for the next one: fused before it, it would be fused again after
        it. It waits no longer than IMU_WAIT_US.
        """
        if self.rank == IMU_RANK and self.newest - self.lead_utime <= IMU_WAIT_US:
            return self.lead_utime
        return self.newest

    def _is_full(self, name: SourceKey) -> bool:
        """Return whether there is no room for a new source."""
        return name not in self.sources and len(self.sources) >= MAX_SOURCES

    def _with(self, name: SourceKey, source: SourceClock) -> ClockMonitor:
        if self._is_full(name):
            return self
        return self._replace(sources={**self.sources, name: source})


def _set_back(name: SourceKey, rank: int, utime: int, seq: int) -> ClockMonitor:
    return ClockMonitor(utime, rank, utime, {name: SourceClock(utime, seq, recent=(utime,))})


def _count_odd(source: SourceClock, utime: int, lead: int, is_back: bool = False) -> SourceClock:
    """Return a source after an odd stamp: successive ones make a run, unless the lead has advanced.

    A stamp behind the newest (`is_back`) lengthens the run only if good stamps have covered that time before.
    """
    follows = source.num_odd > 0 and 0 < utime - source.odd_utime <= 10_000_000 and source.odd_since == lead
    count = source.num_odd + 1 if follows else 1
    if follows and is_back and not has_covered(source.recent, source.odd_utime, utime):
        count -= 1
    return source._replace(num_odd=count, odd_utime=utime, odd_since=lead)


def has_covered(recent: tuple[int, ...], odd_utime: int, utime: int) -> bool:
    """Return whether good stamps lie between the last odd one and `utime`, as far back as they are stored."""
    return not recent or utime <= recent[0] or any(odd_utime < each <= utime for each in recent)
