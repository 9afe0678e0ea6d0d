"""Values of several frames put together to what was measured at one instant."""

from __future__ import annotations

from typing import NamedTuple

from msdrivers.protocol.can.database import BoundSignal
from msdrivers.protocol.can.frame import FrameKey


class CanFrameSet(NamedTuple):
    """What the frames of one instant hold: when the first came, and the bits of each signal by frame and name."""

    monotonic_ns: int
    utime: int
    values: dict[FrameKey, dict[str, float]]
    is_complete: bool

    def raw(self, signal: BoundSignal | None) -> float | None:
        """Return the bits of a signal; None where its frame did not come, or does not hold it this time."""
        if signal is None:
            return None
        return self.values.get(signal.key, {}).get(signal.name)

    def physical(self, signal: BoundSignal | None) -> float | None:
        """Return the physical value of a signal; None where it is not said."""
        raw = self.raw(signal)
        return None if raw is None or signal is None else signal.physical(raw)


class CanFrameAssembler:
    """Waits for the frames that make an instant, for at most `window_ns` after the first.

    A frame that comes a second time begins the next instant: what was missing of the last one was lost.
    """

    __slots__ = ("_begun_ns", "_needed", "_pending", "_utime", "_window_ns")

    def __init__(self, needed: frozenset[FrameKey], window_ns: int):
        """Take the kinds of frame that make an instant, and how long to wait for them."""
        self._needed = needed
        self._window_ns = window_ns
        self.clear()

    def clear(self) -> None:
        """Forget what was begun."""
        self._pending: dict[FrameKey, dict[str, float]] = {}
        self._begun_ns = 0
        self._utime = 0

    def add(self, key: FrameKey, values: dict[str, float], monotonic_ns: int, utime: int) -> list[CanFrameSet]:
        """Take a frame's values; return the instants that end with it: the one it completes, the one it ends."""
        ended = self.expired(monotonic_ns)
        if key in self._pending:
            ended.append(self._end(False))
        if not self._pending:
            self._begun_ns, self._utime = monotonic_ns, utime
        self._pending[key] = values
        if self._pending.keys() >= self._needed:
            ended.append(self._end(True))
        return ended

    def expired(self, monotonic_ns: int) -> list[CanFrameSet]:
        """Return the instant that has waited long enough for its missing frames, if there is one."""
        due = self.due()
        return [self._end(False)] if due is not None and monotonic_ns >= due else []

    def due(self) -> int | None:
        """Return when an instant will have waited long enough; None where none is begun."""
        return self._begun_ns + self._window_ns if self._pending else None

    def _end(self, is_complete: bool) -> CanFrameSet:
        ended = CanFrameSet(self._begun_ns, self._utime, self._pending, is_complete)
        self._pending = {}
        return ended
