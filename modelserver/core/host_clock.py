"""Steps of the host's clock, from the two clocks of each `Instant` alone. Pure.

The time of day may be set, monotonic time never is: where the offset between them falls, the time of day was set back.
Stamps of messages are no evidence, since whoever can send can stamp as it likes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

STEP_US: Final = 100_000
"""A smaller fall of the offset between two looks is slewing: chronyd slews by at most 8 %, 2 ms between two ticks."""


class Instant(NamedTuple):
    """When an event is handled: the host's monotonic clock in nanoseconds, and its time of day as utime."""

    monotonic_ns: int
    utime: int


class HostClock(NamedTuple):
    """The last look at the host's clocks: both times, and the last two offsets of utime from monotonic time, us.

    Two offsets, since a process that is preempted between reading the one clock and the other sees an offset that is
    too large, once; the fall back from it is no step.
    """

    monotonic_ns: int = 0
    utime: int = 0
    offset: int = 0
    previous: int = 0

    @classmethod
    def at(cls, now: Instant) -> HostClock:
        """Return the first look."""
        offset = now.utime - now.monotonic_ns // 1000
        return cls(now.monotonic_ns, now.utime, offset, offset)

    def is_set_back(self, now: Instant) -> bool:
        """Return whether the time of day was set back since the last look.

        In a recording both times are those of the log, so that both fall.
        """
        offset = now.utime - now.monotonic_ns // 1000
        fell = min(self.offset, self.previous) - offset
        return fell > STEP_US or (now.monotonic_ns < self.monotonic_ns and self.utime - now.utime > STEP_US)

    def next(self, now: Instant, set_back: bool) -> HostClock:
        """Return the look at `now`; after a step the offsets of before it do not count."""
        offset = now.utime - now.monotonic_ns // 1000
        return HostClock(now.monotonic_ns, now.utime, offset, offset if set_back else self.offset)
