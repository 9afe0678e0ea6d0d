"""Whether the device's ticks are as long as its EEPROM says: the words there take effect after a power cycle only."""

from __future__ import annotations

WINDOW_NS = 3_000_000_000
OFF = 0.25
"""By how much a tick may differ from the host's clock over a window: replies come early and late."""


class TickRate:
    """Compares ticks with the host's clock. `agrees` changes after two windows in a row that say the same."""

    __slots__ = ("_begin", "_doubts", "_measured", "_tick_s", "agrees")

    def __init__(self, tick_s: float):
        """Take what a tick is said to be, seconds."""
        self._tick_s = tick_s
        self._begin: tuple[int, int] | None = None
        self._doubts = 0
        self._measured = tick_s
        self.agrees = True

    def take(self, count: int, at_ns: int) -> bool:
        """Take unwrapped ticks and when they were received, monotonic nanoseconds; return whether `agrees` changed."""
        if self._begin is None:
            self._begin = (count, at_ns)
            return False
        ticks, elapsed = count - self._begin[0], at_ns - self._begin[1]
        if elapsed < WINDOW_NS:
            return False
        self._begin = (count, at_ns)
        before, self._measured = self._measured, elapsed * 1e-9 / max(ticks, 1)
        contradicts = _differ(self._measured, self._tick_s)
        if contradicts != self.agrees:
            self._doubts = 0
            return False
        # a host that was late makes one window too long and the next too short
        self._doubts = 1 if _differ(self._measured, before) else self._doubts + 1
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
