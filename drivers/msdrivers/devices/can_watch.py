"""What every driver on a CAN bus looks after: is anything heard, is it what is needed, is the interface on the bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from msdrivers.protocol.can.database import FrameError
from msdrivers.protocol.can.frame import CanFrame, FrameKey
from msdrivers.station import Now, Output, Reopen, StationPhase, StationStatus

SEEN = 8
"""Identifiers that are remembered to tell a person what is on the bus."""


def arrival(frame: CanFrame, now: Now) -> Now:
    """Return when a frame came that is read `now`: by its own stamp where it has one."""
    if not 0 < frame.utime <= now.utime:
        return now
    return Now(now.monotonic_ns - (now.utime - frame.utime) * 1000, frame.utime)


class CanWatch:
    """Tells silence, errors and recovery, each once; what was told is told again after it has changed.

    Where no kind of frame is needed there is no silence.
    """

    def __init__(self, needed: Mapping[FrameKey, str], silence_s: float, counts: Counter[str]):
        """Take the needed kinds of frame with their names, and after how many seconds without usable ones it tells."""
        self._needed = needed
        self._silence_s = silence_s
        self._counts = counts
        self._silent_at: int | None = None
        self._seen: dict[FrameKey, None] = {}
        self._told_wrong: set[FrameKey] = set()
        self._only_wrong = False
        self.phase = StationPhase.WAITING
        self.is_off = False
        """The interface has left the bus; nothing can be sent."""

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin: the line is open."""
        self.phase, self.is_off = StationPhase.WAITING, False
        self._seen.clear()
        self._told_wrong.clear()
        self._only_wrong = False
        self._wait(now)
        return [StationStatus(StationPhase.WAITING, f"waiting for {self._names()}")] if self._needed else []

    def usable(self, now: Now, text: str) -> list[Output[CanFrame]]:
        """Note that something came that can be used; `text` says what, for the first time."""
        self._wait(now)
        self._only_wrong = False
        self._seen.clear()
        if self.phase is StationPhase.STREAMING:
            return []
        self.phase = StationPhase.STREAMING
        return [StationStatus(StationPhase.STREAMING, text)]

    def other(self, frame: CanFrame) -> None:
        """Note a frame that is not needed here."""
        self._counts["other_frames"] += 1
        if len(self._seen) < SEEN:
            self._seen[frame.key] = None

    def wrong(self, frame: CanFrame, error: FrameError) -> list[Output[CanFrame]]:
        """Note a frame that cannot be used; told once for each kind."""
        self._counts[f"rejected.{error.reason}"] += 1
        self._only_wrong = True
        if frame.key in self._told_wrong:
            return []
        self._told_wrong.add(frame.key)
        return [StationStatus(self.phase, f"{error}; such frames are counted and not used", is_trouble=True)]

    def error_frame(self, frame: CanFrame) -> list[Output[CanFrame]]:
        """Note what the interface says of the bus: bus-off asks to open it anew, once."""
        self._counts["error_frames"] += 1
        if not frame.is_bus_off or self.is_off:
            return []
        self._counts["bus_off"] += 1
        self.is_off = True
        self.phase = StationPhase.SILENT
        self._silent_at = None
        why = "the CAN interface went bus-off: too many frames failed"
        fix = "check wiring, the terminators at both ends (60 ohm between the lines) and the bit rate"
        return [
            StationStatus(StationPhase.SILENT, f"{why}; {fix}; nothing is published or sent until it is back"),
            Reopen(why),
        ]

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Tell silence where it has lasted long enough."""
        if self._silent_at is None or now.monotonic_ns < self._silent_at:
            return []
        self._silent_at = None
        self.phase = StationPhase.SILENT
        self._counts["silences"] += 1
        return [StationStatus(StationPhase.SILENT, self._why())]

    def due(self) -> int | None:
        """Return when silence will have lasted long enough."""
        return self._silent_at

    def _wait(self, now: Now) -> None:
        self._silent_at = now.monotonic_ns + round(self._silence_s * 1e9) if self._needed else None

    def _why(self) -> str:
        head = f"no usable {self._names()} for {self._silence_s:g} s"
        if self._only_wrong:
            return f"{head}: frames come, but not as the DBC says; take the DBC of this controller's version"
        if self._seen:
            seen = ", ".join(map(str, self._seen)) + (", ..." if len(self._seen) == SEEN else "")
            return f"{head}; on the bus are {seen}: is the controller on, and is this its DBC and its bus?"
        return f"{head}, and nothing else on the bus: check power, wiring, the interface's name and the bit rate"

    def _names(self) -> str:
        return ", ".join(f"{name} ({key})" for key, name in sorted(self._needed.items()))
