"""Unwrap the 3DM-GX1's 16-bit tick counter, and reject byte sequences that only look like a reply.

The ticks of a reply are plausible if they are ahead of the previous ones by no more than the elapsed time (plus 0.5 s).
They may be ahead by less: replies that a busy host reads late arrive all at once. Three consecutive implausible
replies that agree with each other mean that the counter has jumped.
"""

from __future__ import annotations

COUNTER_RANGE = 65536
"""Ticks until the counter wraps."""

SLACK_NS = 500_000_000
"""Tolerance: the previous reply may have been read this much late."""

MIN_TICK_S = 0.005
"""Shortest possible tick, used while its length is unknown."""

MAX_POLL_LAG = 2
"""Ticks by which a polled reply may be behind a streamed one that was sent before it."""

MIN_AGREEING = 3
"""Consecutive replies that agree with each other but not with the previous ones: the counter has jumped."""


class TickUnwrapper:
    """Unwraps ticks and checks their plausibility. Instants are the host's monotonic nanoseconds.

    The unwrapped count starts above zero, goes back by at most `MAX_POLL_LAG`, and advances by more than
    `COUNTER_RANGE` when the counter has jumped or `reset` was called.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._at_ns = 0
        self._candidate: tuple[int, int] = (0, 0)
        self._agreeing_count = 0
        self._count = COUNTER_RANGE
        self._ticks_per_ns = 1e-9 / MIN_TICK_S
        self.has_jumped = False
        """The counter has jumped since `reset`."""

    def set_tick(self, tick_s: float) -> None:
        """Set the length of a tick; the device's clock and the host's may differ by 5 %."""
        self._ticks_per_ns = 1.05e-9 / tick_s

    def reset(self) -> None:
        """Accept any next count: the device may have restarted."""
        self._last = None
        self._agreeing_count = 0
        self._count = (self._count // COUNTER_RANGE + 2) * COUNTER_RANGE
        self.has_jumped = False

    def unwrap(self, ticks: int, at_ns: int, streamed: bool) -> int | None:
        """Return the unwrapped ticks of a reply; None if they are implausible."""
        if self._last is None:
            return self._restart(ticks, at_ns)
        ahead = (ticks - self._last) % COUNTER_RANGE
        if ahead <= self._max_advance(at_ns - self._at_ns):
            self._count += ahead
            self._last, self._at_ns = ticks, at_ns
            self._agreeing_count = 0
            return self._count
        if not streamed and COUNTER_RANGE - ahead <= MAX_POLL_LAG:
            return self._count - (COUNTER_RANGE - ahead)
        return self._on_outlier(ticks, at_ns)

    def _max_advance(self, elapsed_ns: int) -> float:
        return (elapsed_ns + SLACK_NS) * self._ticks_per_ns + 1.0

    def _restart(self, ticks: int, at_ns: int) -> int:
        self._last, self._at_ns, self._agreeing_count = ticks, at_ns, 0
        self._count = self._count // COUNTER_RANGE * COUNTER_RANGE + ticks
        return self._count

    def _on_outlier(self, ticks: int, at_ns: int) -> int | None:
        before, since_ns = self._candidate
        agrees = self._agreeing_count > 0 and (ticks - before) % COUNTER_RANGE <= self._max_advance(at_ns - since_ns)
        self._agreeing_count = self._agreeing_count + 1 if agrees else 1
        self._candidate = (ticks, at_ns)
        if self._agreeing_count < MIN_AGREEING:
            return None
        self.reset()
        self.has_jumped = True
        return self._restart(ticks, at_ns)
