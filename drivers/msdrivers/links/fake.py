"""Test doubles: a scripted link and a simulated clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Generic

from msdrivers.endpoint import HostTime, U
from msdrivers.links import LinkError


class FakeTimeSource:
    """A clock that advances only in `sleep`."""

    def __init__(self, utime: int = 1_700_000_000_000_000, monotonic_ns: int = 1_000_000_000):
        self.utime_ns, self.monotonic_ns = utime * 1000, monotonic_ns

    def now(self) -> HostTime:
        return HostTime(self.monotonic_ns, self.utime_ns // 1000)

    def sleep(self, seconds: float) -> None:
        self.monotonic_ns += round(seconds * 1e9)
        self.utime_ns += round(seconds * 1e9)


class FakeLink(Generic[U]):
    """A link that delivers scripted units and fails during `outages`.

    `sent` records what was sent with the monotonic nanoseconds, `opened_bauds` the rate of each opening.
    """

    description = "fake"

    def __init__(self, time: FakeTimeSource, units: Iterable[tuple[float, U]] = (), baud: int = 0):
        """`units` have times in seconds of `time`'s monotonic clock."""
        self.time = time
        self.baud = baud
        self.incoming: deque[tuple[float, U]] = deque(units)
        self.outages: list[tuple[float, float]] = []
        """From when to when the line is away, seconds."""
        self.sent: list[tuple[int, U]] = []
        self.opened_bauds: list[int | None] = []
        self.is_open = False

    def open(self, baud: int | None = None) -> None:
        self._check()
        self.baud = baud or self.baud
        self.opened_bauds.append(baud)
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def poll(self, timeout: float) -> Sequence[U]:
        """Return the next unit; advance the clock to its time, at most by `timeout` seconds."""
        self._check()
        now = self.time.monotonic_ns * 1e-9
        until = now + max(0.0, timeout)
        gone = next((start for start, _ in self.outages if now < start <= until), until)
        if self.incoming and self.incoming[0][0] <= gone:
            at, unit = self.incoming.popleft()
            self.time.sleep(max(0.0, at - now))
            return (unit,)
        self.time.sleep(gone - now)
        self._check()
        return ()

    def send(self, unit: U) -> None:
        self._check()
        self.sent.append((self.time.monotonic_ns, unit))

    def _check(self) -> None:
        now = self.time.monotonic_ns * 1e-9
        if any(start <= now < end for start, end in self.outages):
            self.is_open = False
            raise LinkError("fake", "it is away", "waiting for its return")
