"""From an encoder's counter to signed travel: wraps, jumps that no wheel can do, and counters that begin anew."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Odometer:
    """One wheel's counter as it goes on: each `taken` follows the last.

    A count is believed when a wheel of at most `max_speed` could have come there from the last one believed. `delay`
    is by how many seconds frames may be held up on their way: two that come together need not have been measured
    together. A count that is not believed is kept in doubt; when the next one follows from it the counter has begun
    anew, and the travel goes on from where it was, without what was rolled unseen. A counter that begins anew where a
    wheel could have come is taken for a wheel.
    """

    wrap: int
    metres_per_count: float
    max_speed: float
    delay: float
    up_only: bool = False
    way: int = 0
    """Counts since the first one, signed."""
    sign: int = 0
    """Which way it went last, for a counter that counts up only; 0 before that is known."""
    count: int | None = None
    at_ns: int = 0
    doubt: int | None = None
    doubt_ns: int = 0

    def taken(self, raw: float, at_ns: int, direction: int | None = None) -> tuple[Odometer, float, str]:
        """Return the odometer after a count, the travel in metres, and why there is none.

        `raw` are the counter's bits at `at_ns` (any clock that does not jump), `direction` -1, 0, 1 or None as the
        encoder tells. Travel is nan where the reason is not empty: `range`, `jump`, `gap`, `direction`; `resumed`
        comes with a travel.
        """
        count = int(raw)
        if count < 0:
            count += self.wrap
        if not 0 <= count < self.wrap:
            return self, math.nan, "range"
        sign = direction or self.sign
        if direction is None and self.up_only:
            sign = 0
        after = replace(self, sign=sign) if sign else self
        if self.count is None:
            return replace(after, count=count, at_ns=at_ns), 0.0, ""
        step, sure = self._step(self.count, self.at_ns, count, at_ns)
        if step is not None:
            return after._moved(step, count, at_ns, sign, "")
        if self.doubt is not None:
            step, _ = self._step(self.doubt, self.doubt_ns, count, at_ns)
            if step is not None:
                return after._moved(step, count, at_ns, sign, "resumed")
        return replace(after, doubt=count, doubt_ns=at_ns), math.nan, "jump" if sure else "gap"

    def reach(self, seconds: float) -> float:
        """Return how many counts a wheel may come in a time, frames held up and rounding included."""
        return self.max_speed * (max(0.0, seconds) + self.delay) / abs(self.metres_per_count) + 1.0

    @property
    def turn(self) -> float:
        """Counts after which two ways to the same number cannot be told apart."""
        return self.wrap if self.up_only else self.wrap / 2

    def _moved(self, step: int, count: int, at_ns: int, sign: int, reason: str) -> tuple[Odometer, float, str]:
        known = replace(self, count=count, at_ns=at_ns, doubt=None)
        if self.up_only and step:
            if not sign:
                return known, math.nan, "direction"
            step *= sign
        moved = replace(known, way=self.way + step)
        return moved, moved.way * self.metres_per_count, reason

    def _step(self, before: int, before_ns: int, count: int, at_ns: int) -> tuple[int | None, bool]:
        """Return the counts between two readings, None for more than a wheel can do; and whether that is sure.

        After so long a time that the counter may have gone round it is not.
        """
        reach = self.reach((at_ns - before_ns) * 1e-9)
        if reach >= self.turn:
            return None, False
        step = (count - before) % self.wrap
        if not self.up_only and step >= self.wrap / 2:
            step -= self.wrap
        return (step if abs(step) <= reach else None), True
