"""Whether the device's ticks are as long as its EEPROM says: the words there take effect after a power cycle only."""

from __future__ import annotations

WINDOW_NS = 5_000_000_000
OFF = 0.005
"""By how much a tick may differ from the host's clock from one window to the next: 25 ms, which are a tick or two and
what the least delay of a window varies by. What is less `device_clock` finds, as drift."""


class TickRate:
    """Compares ticks with the host's clock. `agrees` changes after two windows in a row that say the same.

    Replies come early and late: what is compared is the earliest reply of each window.
    """

    __slots__ = ("_before", "_begin_ns", "_doubts", "_earliest", "_measured", "_tick_s", "agrees")

    def __init__(self, tick_s: float):
        """Take what a tick is said to be, seconds."""
        self._tick_s = tick_s
        self._begin_ns: int | None = None
        self._before: tuple[int, int] | None = None
        self._earliest = (0, 0)
        self._doubts = 0
        self._measured = tick_s
        self.agrees = True

    def take(self, count: int, at_ns: int) -> bool:
        """Take unwrapped ticks and when they were received, monotonic nanoseconds; return whether `agrees` changed."""
        if self._begin_ns is None or at_ns - self._begin_ns < WINDOW_NS:
            if self._begin_ns is None or self._lateness(count, at_ns) < self._lateness(*self._earliest):
                self._earliest = (count, at_ns)
            self._begin_ns = self._begin_ns or at_ns
            return False
        before, self._before = self._before, self._earliest
        self._begin_ns, self._earliest = at_ns, (count, at_ns)
        return before is not None and self._compared(before, self._before)

    def _lateness(self, count: int, at_ns: int) -> float:
        return at_ns - count * self._tick_s * 1e9

    def _compared(self, before: tuple[int, int], earliest: tuple[int, int]) -> bool:
        ticks, elapsed_ns = earliest[0] - before[0], earliest[1] - before[1]
        last, self._measured = self._measured, elapsed_ns * 1e-9 / max(ticks, 1)
        contradicts = _differ(self._measured, self._tick_s)
        if contradicts != self.agrees:
            self._doubts = 0
            return False
        # a host that was late makes one window too long and the next too short
        self._doubts = 1 if _differ(self._measured, last) else self._doubts + 1
        if self._doubts < 2:
            return False
        self._doubts = 0
        self.agrees = not self.agrees
        return True

    def text(self) -> str:
        """Return for a person what was found."""
        said = f"{self._tick_s * 1e3:.4g} ms"
        if self.agrees:
            return f"the device's ticks take {said} again, as they should: its time is used"
        return (
            f"the device's ticks take {self._measured * 1e3:.4g} ms by the host's clock, and should take {said}: its "
            "time is not used; switch its power off and on if its timer words were changed, or set tick in the settings"
        )


def _differ(measured: float, said: float) -> bool:
    return abs(measured / said - 1.0) > OFF
