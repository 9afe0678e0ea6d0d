"""Clock monitor of one source: out-of-sequence samples and clock steps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from modelserver.estimation.raw.settings import RawSettings

_KEPT = 8
"""Good stamps kept, to tell samples that come late from a clock that was set back."""


class Verdict(Enum):
    """What a stamp says about its sample."""

    GOOD = "good"
    DUPLICATE = "duplicate"
    ORDER = "out_of_sequence"
    FUTURE = "future"
    STEPPED_BACK = "stepped_back"


@dataclass(frozen=True, slots=True)
class Stamps:
    """The last good stamp of a source, and a run of odd ones that may turn out to be a clock that was set.

    One odd stamp is an error of the sample; several in a row that agree among themselves are the clock's,
    however little they are back. Samples that merely come late fill holes between the good ones; those of a
    clock that was set back go over ground where good ones were already, so between two of them lies a good one.
    """

    last: int | None = None
    odd: int = 0
    odd_count: int = 0
    odd_first: int = 0
    good: tuple[int, ...] = ()

    def take(self, utime: int, settings: RawSettings) -> tuple[Stamps, Verdict]:
        """Return the stamps with one more, and what to do with its sample."""
        last = self.last
        if last is None:
            return Stamps(utime, good=(utime,)), Verdict.GOOD
        ahead = (utime - last) * 1e-6
        if 0.0 < ahead <= settings.clock_jump:
            return Stamps(utime, good=(*self.good[1 - _KEPT :], utime)), Verdict.GOOD
        if utime == last and not (self.odd_count and self.odd < last):
            return self, Verdict.DUPLICATE
        # an odd stamp: does it follow the odd one before it?
        follows = self.odd_count > 0 and 0.0 < (utime - self.odd) * 1e-6 <= settings.clock_jump
        count, first = (self.odd_count + 1, self.odd_first) if follows else (1, utime)
        if follows and ahead <= 0.0 and not self._covered(utime):
            count -= 1
        if count >= settings.clock_jump_samples:
            taken = Stamps(utime, odd=self.odd, odd_first=first, good=(utime,))
            return taken, Verdict.GOOD if ahead > 0.0 else Verdict.STEPPED_BACK
        return Stamps(last, utime, count, first, self.good), Verdict.FUTURE if ahead > 0.0 else Verdict.ORDER

    @property
    def lost(self) -> float:
        """Seconds that the samples of the run took, the one before it counted: of a clock just set back."""
        return (self.last - self.odd_first + self.last - self.odd) * 1e-6 if self.last is not None else 0.0

    def _covered(self, utime: int) -> bool:
        """Return whether good stamps lie between the odd one before and this one, as far back as they are known."""
        return utime <= self.good[0] or any(self.odd < each <= utime for each in self.good)
