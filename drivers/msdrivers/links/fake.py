"""A line and a clock that do as they are told, for tests."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Generic, TypeVar

from msdrivers.links import LinkError
from msdrivers.station import Now

U = TypeVar("U")


class FakeTime:
    """A clock that stands still but where something waits."""

    def __init__(self, utime: int = 1_700_000_000_000_000, monotonic_ns: int = 1_000_000_000):
        self.utime_ns, self.monotonic_ns = utime * 1000, monotonic_ns

    def now(self) -> Now:
        """Return the instant."""
        return Now(self.monotonic_ns, self.utime_ns // 1000)

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.monotonic_ns += round(seconds * 1e9)
        self.utime_ns += round(seconds * 1e9)


class FakeLink(Generic[U]):
    """A line on which units come at times told beforehand, and that fails when told to.

    `sent` holds what was put on it with the monotonic nanoseconds, `opened` at which rates it was opened.
    """

    description = "fake"

    def __init__(self, time: FakeTime, units: Iterable[tuple[float, U]] = (), baud: int = 0):
        """Take units with their times, in seconds of `time`'s monotonic clock."""
        self.time = time
        self.baud = baud
        self.coming: deque[tuple[float, U]] = deque(units)
        self.gone: list[tuple[float, float]] = []
        """From when to when the line is away, seconds."""
        self.sent: list[tuple[int, U]] = []
        self.opened: list[int | None] = []
        self.is_open = False

    def open(self, baud: int | None = None) -> None:
        """Open it, where it is not away."""
        self._check()
        self.baud = baud or self.baud
        self.opened.append(baud)
        self.is_open = True

    def close(self) -> None:
        """Close it."""
        self.is_open = False

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what has come, letting time pass until it does, at most `timeout` seconds."""
        self._check()
        now = self.time.monotonic_ns * 1e-9
        until = now + max(0.0, timeout)
        gone = next((start for start, _ in self.gone if now < start <= until), until)
        if self.coming and self.coming[0][0] <= gone:
            at, unit = self.coming.popleft()
            self.time.sleep(max(0.0, at - now))
            return (unit,)
        self.time.sleep(gone - now)
        self._check()
        return ()

    def send(self, unit: U) -> None:
        """Remember what was sent."""
        self._check()
        self.sent.append((self.time.monotonic_ns, unit))

    def _check(self) -> None:
        now = self.time.monotonic_ns * 1e-9
        if any(start <= now < end for start, end in self.gone):
            self.is_open = False
            raise LinkError("fake", "it is away", "waiting for its return")
