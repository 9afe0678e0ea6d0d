"""Signed travel of a wheel from its encoder counter: wraps, implausible jumps, counter resets.

A count n at time t is plausible if a wheel of at most `max_speed` could have reached it from the last plausible one:
|dn| <= max_speed * (dt + delay) / meters_per_count + 1. `delay` covers frames that were held up on the bus: two frames
that arrive together need not have been measured together. dn is unwrapped to the nearest value, which is unambiguous
while the bound is below half of `wrap` (all of it for a counter that only counts up); after a longer gap it is not.

An implausible count becomes the suspect. If the next count is plausible from the suspect, the counter was reset: the
travel continues from where it was, without the distance travelled meanwhile. A reset to a plausible count cannot be
detected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Odometer:
    """Immutable state of one wheel's odometer; `update` returns the next one. Meters, m/s, seconds."""

    wrap: int
    meters_per_count: float
    max_speed: float
    delay: float
    counts_up_only: bool = False
    travel_counts: int = 0
    """Signed counts since the first one."""
    sign: int = 0
    """Last known direction of a counter that only counts up; 0: unknown."""
    count: int | None = None
    at_ns: int = 0
    suspect: int | None = None
    suspect_ns: int = 0

    def update(self, raw: float, at_ns: int, direction: int | None = None) -> tuple[Odometer, float, str]:
        """Process a count: return the new odometer, the travel in meters, and a reason.

        The travel is nan for the reasons `range`, `jump`, `gap` and `direction`; `resumed` (after a counter reset)
        comes with a travel. `raw`: the counter's raw bits. `at_ns`: time of the count on any clock without jumps.
        `direction`: -1, 0 or 1 as the encoder reports, None if unknown.
        """
        count = int(raw)
        if count < 0:
            count += self.wrap
        if not 0 <= count < self.wrap:
            return self, math.nan, "range"
        sign = direction or self.sign
        if direction is None and self.counts_up_only:
            sign = 0
        after = replace(self, sign=sign) if sign else self
        if self.count is None:
            return replace(after, count=count, at_ns=at_ns), 0.0, ""
        step, is_unambiguous = self._find_step(self.count, self.at_ns, count, at_ns)
        if step is not None:
            return after._advance(step, count, at_ns, sign, "")
        if self.suspect is not None:
            step, _ = self._find_step(self.suspect, self.suspect_ns, count, at_ns)
            if step is not None:
                return after._advance(step, count, at_ns, sign, "resumed")
        return replace(after, suspect=count, suspect_ns=at_ns), math.nan, "jump" if is_unambiguous else "gap"

    def max_step(self, seconds: float) -> float:
        """Return the largest plausible number of counts within a time, including frame delay and rounding."""
        return self.max_speed * (max(0.0, seconds) + self.delay) / abs(self.meters_per_count) + 1.0

    @property
    def ambiguity(self) -> float:
        """Number of counts from which on a step is ambiguous because of the wrap."""
        return self.wrap if self.counts_up_only else self.wrap / 2

    def _advance(self, step: int, count: int, at_ns: int, sign: int, reason: str) -> tuple[Odometer, float, str]:
        known = replace(self, count=count, at_ns=at_ns, suspect=None)
        if self.counts_up_only and step:
            if not sign:
                return known, math.nan, "direction"
            step *= sign
        moved = replace(known, travel_counts=self.travel_counts + step)
        return moved, moved.travel_counts * self.meters_per_count, reason

    def _find_step(self, before: int, before_ns: int, count: int, at_ns: int) -> tuple[int | None, bool]:
        """Return the step between two counts (None: implausible), and whether it is unambiguous."""
        reach = self.max_step((at_ns - before_ns) * 1e-9)
        if reach >= self.ambiguity:
            return None, False
        step = (count - before) % self.wrap
        if not self.counts_up_only and step >= self.wrap / 2:
            step -= self.wrap
        return (step if abs(step) <= reach else None), True
