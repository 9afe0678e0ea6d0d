"""Whether something else needs the time that request work takes: ticks, sensors, or other programs. Pure.

Three signs count, each a value read at the edge: a tick that was late, samples that wait behind samples, and the
run-queue delay of the service's thread, the time in which it was ready to run and the processor was given to others
(Linux: /proc/thread-self/schedstat). One sign counts for `HOLD_NS`, and a state that is on needs a weaker sign to
stay on: without this hysteresis the limits would come and go with each scheduling tick.
"""

from __future__ import annotations

from typing import Final

SAMPLE_NS: Final = 100_000_000
"""Between two readings of the run-queue delay."""

ENTER_SHARE: Final = 0.2
STAY_SHARE: Final = 0.1
"""Share of the time spent in the run queue from which the processor counts as contended, and below which it no longer
does. The wakeups of one client that waits for each reply come to a few hundredths."""

LATE_NS: Final = 2_000_000
"""A tick that is later than this needed the time."""

HOLD_NS: Final = 500_000_000
"""How long a sign counts."""


class ContentionDetector:
    """Decides from late ticks, waiting samples and run-queue delays whether the time is contended."""

    def __init__(self) -> None:
        self._until_ns = 0
        self._sampled_ns = 0
        self._delay_ns: int | None = None

    def is_contended(self, now_ns: int) -> bool:
        """Return whether something else needs the time."""
        return now_ns < self._until_ns

    def wants_delay(self, now_ns: int) -> bool:
        """Return whether the run-queue delay is to be read and given to `add_delay`."""
        return now_ns - self._sampled_ns >= SAMPLE_NS

    def add_delay(self, total_ns: int | None, now_ns: int) -> None:
        """Add a reading of the thread's total run-queue delay; None where the system has none."""
        before, self._delay_ns = self._delay_ns, total_ns
        elapsed, self._sampled_ns = now_ns - self._sampled_ns, now_ns
        if before is None or total_ns is None or elapsed <= 0:
            return
        share = (total_ns - before) / elapsed
        if share > (STAY_SHARE if self.is_contended(now_ns) else ENTER_SHARE):
            self._until_ns = now_ns + HOLD_NS

    def add_tick(self, late_ns: int, now_ns: int) -> None:
        """Add how late a tick was."""
        if late_ns > LATE_NS:
            self._until_ns = now_ns + HOLD_NS

    def add_sensor_backlog(self, now_ns: int) -> None:
        """Add that more samples wait than one pass of the loop takes."""
        self._until_ns = now_ns + HOLD_NS
