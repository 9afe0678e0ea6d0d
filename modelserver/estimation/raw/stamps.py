"""Clock monitor of one source: out-of-sequence stamps and clock steps.

A stamp is odd if it is not later than the last good one, or more than `clock_jump` ahead of it. A single one is an
error of its sample; `clock_jump_samples` in a row in ascending order show that the clock was set. Delayed samples fill
the gaps between good stamps. Those of a clock that was set back cover a time that good stamps have covered already, so
between two of them lies a good one. `filter.clock_monitor` has the same rules for sources that share a horizon; here a
delayed sample is rejected, because raw mode has no buffer to sort samples in.
"""

from __future__ import annotations

from typing import NamedTuple

from modelserver.estimation.filter.clock_monitor import RECENT_STAMPS, StampVerdict, has_covered
from modelserver.estimation.raw.settings import RawSettings


class StampMonitor(NamedTuple):
    """The last good stamp of a source, and a run of odd stamps.

    Attributes
    ----------
    last: the last good stamp; None: none yet.
    odd_utime, num_odd, odd_since: the last odd stamp of the run, their number, and the first one.
    recent: the last good stamps, the oldest first.
    """

    last: int | None = None
    odd_utime: int = 0
    num_odd: int = 0
    odd_since: int = 0
    recent: tuple[int, ...] = ()

    def update(self, utime: int, settings: RawSettings) -> tuple[StampMonitor, StampVerdict]:
        """Return the monitor after a stamp, and what the stamp means."""
        last = self.last
        if last is None:
            return StampMonitor(utime, recent=(utime,)), StampVerdict.GOOD
        ahead = (utime - last) * 1e-6
        if 0.0 < ahead <= settings.clock_jump:
            return StampMonitor(utime, recent=(*self.recent[1 - RECENT_STAMPS :], utime)), StampVerdict.GOOD
        if utime == last and not (self.num_odd and self.odd_utime < last):
            return self, StampVerdict.DUPLICATE
        follows = self.num_odd > 0 and 0.0 < (utime - self.odd_utime) * 1e-6 <= settings.clock_jump
        count, since = (self.num_odd + 1, self.odd_since) if follows else (1, utime)
        if follows and ahead <= 0.0 and not has_covered(self.recent, self.odd_utime, utime):
            count -= 1
        if count >= settings.clock_jump_samples:
            confirmed = StampMonitor(utime, self.odd_utime, 0, since, (utime,))
            return confirmed, StampVerdict.GOOD if ahead > 0.0 else StampVerdict.STEPPED_BACK
        verdict = StampVerdict.FUTURE if ahead > 0.0 else StampVerdict.OUT_OF_SEQUENCE
        return StampMonitor(last, utime, count, since, self.recent), verdict

    @property
    def lost_time(self) -> float:
        """After a step back: seconds that the samples of the run took, and the one before it."""
        return 0.0 if self.last is None else (self.last - self.odd_since + self.last - self.odd_utime) * 1e-6
