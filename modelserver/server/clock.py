"""Clocks: the only module of the server that reads the time."""

from __future__ import annotations

import time

from modelserver.core import Instant


class Clock:
    """The host's clocks, the time source of the loop."""

    def monotonic_ns(self) -> int:
        """Return nanoseconds on a clock that never steps."""
        return time.monotonic_ns()

    def utime(self) -> int:
        """Return microseconds since the Unix epoch."""
        return time.time_ns() // 1000

    def now(self) -> Instant:
        """Return both times: monotonic, and microseconds since the Unix epoch."""
        return Instant(time.monotonic_ns(), time.time_ns() // 1000)

    def sleep(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)


class FakeClock(Clock):
    """A clock for replays and tests, which moves only by `set`, `advance`, `sleep` and `step_utime`."""

    def __init__(self, utime: int = 1_700_000_000_000_000, monotonic_ns: int = 1_000_000_000):
        self._utime_ns = utime * 1000
        self._monotonic_ns = monotonic_ns

    def set(self, now: Instant) -> None:
        """Set both clocks."""
        self._monotonic_ns, self._utime_ns = now.monotonic_ns, now.utime * 1000

    def monotonic_ns(self) -> int:
        """Return nanoseconds."""
        return self._monotonic_ns

    def utime(self) -> int:
        """Return microseconds since the Unix epoch."""
        return self._utime_ns // 1000

    def now(self) -> Instant:
        """Return both times."""
        return Instant(self._monotonic_ns, self._utime_ns // 1000)

    def advance(self, seconds: float) -> None:
        """Advance both clocks."""
        self._monotonic_ns += round(seconds * 1e9)
        self._utime_ns += round(seconds * 1e9)

    def sleep(self, seconds: float) -> None:
        """Sleep."""
        self.advance(seconds)

    def step_utime(self, seconds: float) -> None:
        """Step the time of day; monotonic time is not affected."""
        self._utime_ns += round(seconds * 1e9)
