"""Clock monitor of one source: out-of-sequence samples and clock steps."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.estimation.filter.clock_monitor import StampVerdict
from modelserver.estimation.raw.settings import RawSettings

_RECENT_STAMPS = 8
"""Good stamps kept, to tell samples that come late from a clock that was set back."""


@dataclass(frozen=True, slots=True)
class StampMonitor:
    """The last good stamp of a source, and a run of odd ones that may turn out to be a clock that was set.

    One odd stamp is an error of the sample; several in a row that agree among themselves are the clock's,
    however little they are back. Samples that merely come late fill holes between the good ones; those of a
    clock that was set back go over ground where good ones were already, so between two of them lies a good one.
    """

    last: int | None = None
    odd_utime: int = 0
    odd_count: int = 0
    odd_first: int = 0
    good: tuple[int, ...] = ()

    def update(self, utime: int, settings: RawSettings) -> tuple[StampMonitor, StampVerdict]:
        """Return the stamps with one more, and what to do with its sample."""
        last = self.last
        if last is None:
            return StampMonitor(utime, good=(utime,)), StampVerdict.GOOD
        ahead = (utime - last) * 1e-6
        if 0.0 < ahead <= settings.clock_jump:
            return StampMonitor(utime, good=(*self.good[1 - _RECENT_STAMPS :], utime)), StampVerdict.GOOD
        if utime == last and not (self.odd_count and self.odd_utime < last):
            return self, StampVerdict.DUPLICATE
        # an odd stamp: does it follow the odd one before it?
        follows = self.odd_count > 0 and 0.0 < (utime - self.odd_utime) * 1e-6 <= settings.clock_jump
        count, first = (self.odd_count + 1, self.odd_first) if follows else (1, utime)
        if follows and ahead <= 0.0 and not self._has_covered(utime):
            count -= 1
        if count >= settings.clock_jump_samples:
            taken = StampMonitor(utime, odd_utime=self.odd_utime, odd_first=first, good=(utime,))
            return taken, StampVerdict.GOOD if ahead > 0.0 else StampVerdict.STEPPED_BACK
        return StampMonitor(
            last, utime, count, first, self.good
        ), StampVerdict.FUTURE if ahead > 0.0 else StampVerdict.OUT_OF_SEQUENCE

    @property
    def lost_time(self) -> float:
        """Seconds that the samples of the run took, the one before it counted: of a clock just set back."""
        return (self.last - self.odd_first + self.last - self.odd_utime) * 1e-6 if self.last is not None else 0.0

    def _has_covered(self, utime: int) -> bool:
        """Return whether good stamps lie between the odd one before and this one, as far back as they are known."""
        return utime <= self.good[0] or any(self.odd_utime < each <= utime for each in self.good)
