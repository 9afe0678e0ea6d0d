"""The 3DM-GX1's tick counter: 16 bits that wrap, unwrapped, and used to tell a reply from bytes that look like one.

A reply's ticks fit if they lie after those before, by no more than the time that has passed. They may lie less far
ahead than that: what a busy host reads late comes all at once.
"""

from __future__ import annotations

TURN = 65536
"""Ticks until the counter begins again."""

SLACK_NS = 500_000_000
"""By how much more than the time passed the ticks may have advanced: the reply before came so late."""

SHORTEST_S = 0.005
"""A tick is at least so long, as long as its length is not known."""

LATE = 2
"""Ticks by which the reply to a poll may lie behind a streamed one that was sent before it."""

AGREEING = 3
"""Replies in a row that fit each other but not those before: then the counter has jumped."""


class TickWatch:
    """Unwraps ticks and judges whether they fit. Instants are the host's monotonic nanoseconds.

    The unwrapped count begins above zero, goes back by at most `LATE`, and goes ahead by more than a turn when the
    counter has jumped or `forget` was called.
    """

    __slots__ = ("_agreeing", "_at_ns", "_candidate", "_count", "_last", "_per_ns", "jumped")

    def __init__(self) -> None:
        self._last: int | None = None
        self._at_ns = 0
        self._candidate: tuple[int, int] = (0, 0)
        self._agreeing = 0
        self._count = TURN
        self._per_ns = 1e-9 / SHORTEST_S
        self.jumped = False
        """The counter has jumped since `forget` was called."""

    def clock(self, tick_s: float) -> None:
        """Tell how long a tick is; the device's clock and the host's may differ by 5 %."""
        self._per_ns = 1.05e-9 / tick_s

    def forget(self) -> None:
        """Take whatever comes next for the beginning: the device may have been away."""
        self._last = None
        self._agreeing = 0
        self._count = (self._count // TURN + 2) * TURN
        self.jumped = False

    def take(self, ticks: int, at_ns: int, streamed: bool) -> int | None:
        """Return the ticks of a reply, received at an instant, unwrapped; None if they do not fit."""
        if self._last is None:
            return self._begin(ticks, at_ns)
        ahead = (ticks - self._last) % TURN
        if ahead <= self._reach(at_ns - self._at_ns):
            self._count += ahead
            self._last, self._at_ns = ticks, at_ns
            self._agreeing = 0
            return self._count
        if not streamed and TURN - ahead <= LATE:
            return self._count - (TURN - ahead)
        return self._strayed(ticks, at_ns)

    def _reach(self, elapsed_ns: int) -> float:
        return (elapsed_ns + SLACK_NS) * self._per_ns + 1.0

    def _begin(self, ticks: int, at_ns: int) -> int:
        self._last, self._at_ns, self._agreeing = ticks, at_ns, 0
        self._count = self._count // TURN * TURN + ticks
        return self._count

    def _strayed(self, ticks: int, at_ns: int) -> int | None:
        before, since_ns = self._candidate
        agrees = self._agreeing > 0 and (ticks - before) % TURN <= self._reach(at_ns - since_ns)
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._candidate = (ticks, at_ns)
        if self._agreeing < AGREEING:
            return None
        self.forget()
        self.jumped = True
        return self._begin(ticks, at_ns)
