"""The stamps of one source: which sample is in order, and when its clock was set."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from modelserver.localization.settings import RawSettings


class Verdict(Enum):
    """What a stamp says about its sample."""

    GOOD = "good"
    DUPLICATE = "duplicate"
    ORDER = "order"
    FUTURE = "future"
    STEPPED_BACK = "stepped_back"


@dataclass(frozen=True, slots=True)
class Stamps:
    """The last good stamp of a source, and a run of odd ones that may turn out to be a clock that was set.

    One odd stamp is an error of the sample; several in a row that agree among themselves are the clock's.
    """

    last: int | None = None
    odd: int = 0
    odd_count: int = 0

    def take(self, utime: int, settings: RawSettings) -> tuple[Stamps, Verdict]:
        """Return the stamps with one more, and what to do with its sample."""
        last = self.last
        if last is None:
            return Stamps(utime), Verdict.GOOD
        ahead = (utime - last) * 1e-6
        if 0.0 < ahead <= settings.clock_ahead:
            return Stamps(utime), Verdict.GOOD
        if utime == last:
            return self, Verdict.DUPLICATE
        if -settings.clock_back <= ahead < 0.0:
            return self, Verdict.ORDER
        # an odd stamp: does it follow the odd one before it?
        follows = self.odd_count > 0 and 0.0 < (utime - self.odd) * 1e-6 <= settings.clock_ahead
        count = self.odd_count + 1 if follows else 1
        if count >= settings.clock_samples:
            return Stamps(utime), Verdict.GOOD if ahead > 0.0 else Verdict.STEPPED_BACK
        return Stamps(last, utime, count), Verdict.FUTURE if ahead > 0.0 else Verdict.ORDER
