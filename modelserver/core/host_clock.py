"""Detect backward steps of the host's time of day from the two clocks of each `Instant`. Pure.

The time of day (CLOCK_REALTIME) may be set, the monotonic clock never is: if the offset between them falls by more than
slewing can explain, the time of day was set back. Stamps of messages are no evidence, since any publisher on the bus
can stamp as it likes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

MIN_STEP_US: Final = 100_000
"""A smaller fall of the offset between two readings is slewing: chronyd slews by at most 8 %, 2 ms between ticks."""


class Instant(NamedTuple):
    """When an event is handled: the host's monotonic clock in nanoseconds, and its time of day as utime."""

    monotonic_ns: int
    utime: int


class HostClock(NamedTuple):
    """The last reading of the host's clocks: both times, and the last two offsets of utime from monotonic time, us.

    Two offsets, since a process that is preempted between the two readings sees one offset that is too large; the fall
    back from it is no step.
    """

    monotonic_ns: int = 0
    utime: int = 0
    offset: int = 0
    previous_offset: int = 0

    def has_stepped_back(self, now: Instant) -> bool:
        """Return whether the time of day was set back since the last reading.

        In a recording both times are those of the log, so both fall.
        """
        offset = now.utime - now.monotonic_ns // 1000
        fell = min(self.offset, self.previous_offset) - offset
        return fell > MIN_STEP_US or (now.monotonic_ns < self.monotonic_ns and self.utime - now.utime > MIN_STEP_US)

    def update(self, now: Instant, set_back: bool) -> HostClock:
        """Return the reading at `now`; after a step, as for the first reading, earlier offsets do not count."""
        offset = now.utime - now.monotonic_ns // 1000
        return HostClock(now.monotonic_ns, now.utime, offset, offset if set_back else self.offset)
