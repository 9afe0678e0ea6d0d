"""The clocks: the only place where time is read."""

from __future__ import annotations

import time
from typing import Protocol

from modelserver.core import Instant


class Clock(Protocol):
    """What the loop reads its time from."""

    def monotonic_ns(self) -> int:
        """Return nanoseconds on a clock that never steps."""
        ...

    def utime(self) -> int:
        """Return microseconds since the Unix epoch."""
        ...

    def now(self) -> Instant:
        """Return both times: monotonic, and microseconds since the Unix epoch."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let so much time pass."""
        ...


class SystemClock:
    """The host's clocks."""

    def monotonic_ns(self) -> int:
        """Return nanoseconds on a clock that never steps."""
        return time.monotonic_ns()

    def utime(self) -> int:
        """Return microseconds since the Unix epoch."""
        return time.time_ns() // 1000

    def now(self) -> Instant:
        """Return both times."""
        return Instant(time.monotonic_ns(), time.time_ns() // 1000)

    def sleep(self, seconds: float) -> None:
        """Let so much time pass."""
        time.sleep(seconds)


class FakeClock:
    """A clock that stands still until it is told to move; for tests."""

    def __init__(self, utime: int = 1_700_000_000_000_000, monotonic_ns: int = 1_000_000_000):
        self._utime_ns = utime * 1000
        self._monotonic_ns = monotonic_ns

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
        """Let time pass."""
        self._monotonic_ns += round(seconds * 1e9)
        self._utime_ns += round(seconds * 1e9)

    def sleep(self, seconds: float) -> None:
        """Let so much time pass."""
        self.advance(seconds)

    def step_utime(self, seconds: float) -> None:
        """Step the time of day, as an administrator or a time server does; monotonic time does not notice."""
        self._utime_ns += round(seconds * 1e9)
