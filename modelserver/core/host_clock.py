"""Detect backward steps of the host's time of day from the two clocks of each `Instant`. Pure.

The time of day (CLOCK_REALTIME) may be set, the monotonic clock never is: if the offset between them falls by more than
slewing can explain, the time of day was set back. Stamps of messages are no evidence, since any publisher on the bus
can stamp as it likes.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from modelserver.named_tuples import new_tuple

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

    @classmethod
    def start(cls, now: Instant) -> HostClock:
        monotonic_ns, utime = now
        offset = utime - monotonic_ns // 1000
        return cls(monotonic_ns, utime, offset, offset)

    def update(self, now: Instant) -> tuple[HostClock, bool]:
        """Return the reading at `now`, and whether the time of day was set back since the last one.

        In a recording both times are those of the log, so both fall. After a step earlier offsets do not count.
        """
        monotonic_ns, utime = now
        before_ns, before, last, previous = self
        offset = utime - monotonic_ns // 1000
        has_stepped_back = (previous if previous < last else last) - offset > MIN_STEP_US or (
            monotonic_ns < before_ns and before - utime > MIN_STEP_US
        )
        reading = new_tuple(HostClock, (monotonic_ns, utime, offset, offset if has_stepped_back else last))
        return reading, has_stepped_back
