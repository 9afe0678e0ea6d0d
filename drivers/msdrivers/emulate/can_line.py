"""What goes wrong between an emulated device and a CAN bus, at set times."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from msdrivers.protocol.can.frame import CanFrame, bus_off
from msdrivers.station import Send

CanFaultKind: TypeAlias = Literal["drop", "corrupt", "stall", "restart", "jump", "bus_off"]


@dataclass(frozen=True, slots=True)
class CanFault:
    """Something that goes wrong `at` seconds after the start.

    drop: `amount` frames are lost. corrupt: `amount` frames come with a byte too few. stall: no frame for `amount`
    seconds. restart: the same, and counters begin at 0 afterwards. jump: counters jump by `amount` counts. bus_off: the
    interface says that it has left the bus, and nothing comes for `amount` seconds.
    """

    at: float
    kind: CanFaultKind
    amount: float = 1.0


class CanLine:
    """Lets frames pass or not, as the faults have it."""

    def __init__(self, faults: Iterable[CanFault]):
        """Take the faults, in any order."""
        self._faults = deque(sorted(faults, key=lambda fault: fault.at))
        self._begun_ns: int | None = None
        self._quiet_until_ns = 0
        self._drop = self._corrupt = 0

    def begin(self, at_ns: int) -> None:
        """Let the faults' time begin, the first time."""
        if self._begun_ns is None:
            self._begun_ns = at_ns

    def due(self) -> int | None:
        """Return when the next fault comes."""
        if self._begun_ns is None or not self._faults:
            return None
        return self._begun_ns + round(self._faults[0].at * 1e9)

    def come(self, at_ns: int) -> list[CanFault]:
        """Return the faults that have come since the last time; those of the line itself take effect."""
        found = []
        while (due := self.due()) is not None and due <= at_ns:
            fault = self._faults.popleft()
            found.append(fault)
            if fault.kind == "drop":
                self._drop += round(fault.amount)
            elif fault.kind == "corrupt":
                self._corrupt += round(fault.amount)
            elif fault.kind in ("stall", "restart", "bus_off"):
                self._quiet_until_ns = max(self._quiet_until_ns, due + round(fault.amount * 1e9))
        return found

    def quiet(self, at_ns: int) -> bool:
        """Return whether nothing passes now, in either direction."""
        return at_ns < self._quiet_until_ns

    def passed(self, frames: Iterable[CanFrame], at_ns: int) -> list[Send[CanFrame]]:
        """Return what of some frames gets through."""
        sent = []
        for frame in frames:
            if self.quiet(at_ns):
                continue
            if self._drop:
                self._drop -= 1
                continue
            if self._corrupt:
                self._corrupt -= 1
                frame = CanFrame(frame.arbitration_id, frame.data[:-1], frame.is_extended)
            sent.append(Send(frame))
        return sent


def said(faults: Iterable[CanFault]) -> list[Send[CanFrame]]:
    """Return what the interface says about faults that have come."""
    return [Send(bus_off()) for fault in faults if fault.kind == "bus_off"]
