"""An emulated device to which faults happen, whatever the device is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

from msdrivers.faults import InjectedFault
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.modbus.registers import Registers
from msdrivers.station import Now, Output, Send, Station, StationPhase, StationStatus

U = TypeVar("U")


class FaultyStation(Generic[U]):
    """A `Station` around another, that loses, damages and holds back what it says, restarts it, or shifts its time.

    `make` makes the device as it is when it was switched on.
    """

    def __init__(self, make: Callable[[], Station[U]], faults: Sequence[InjectedFault]):
        """Take the maker, and what goes wrong how long after the line was first opened."""
        self._make = make
        self._inner = make()
        self._faults = sorted(faults, key=lambda fault: fault.at, reverse=True)
        self._started_ns: int | None = None
        self._dumb_until_ns = 0
        self._restart = False
        self._ahead_ns = 0
        self._pending: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()

    def opened(self, now: Now) -> Sequence[Output[U]]:
        """Switch on."""
        if self._started_ns is None:
            self._started_ns = now.monotonic_ns
        return self._said(self._inner.opened(self._theirs(now)), now)

    def received(self, unit: U, now: Now) -> Sequence[Output[U]]:
        """Hand on what came, unless nobody is there to hear it."""
        struck = self._strike(now)
        if now.monotonic_ns < self._dumb_until_ns:
            return struck
        return [*struck, *self._said(self._inner.received(unit, self._theirs(now)), now)]

    def woken(self, now: Now) -> Sequence[Output[U]]:
        """Let happen what is due."""
        outputs = list(self._strike(now))
        if self._restart and now.monotonic_ns >= self._dumb_until_ns:
            self._restart = False
            self._inner = self._make()
            outputs += self._said(self._inner.opened(self._theirs(now)), now)
        due = self._inner.due()
        if not self._restart and due is not None and now.monotonic_ns + self._ahead_ns >= due:
            outputs += self._said(self._inner.woken(self._theirs(now)), now)
        return outputs

    def due(self) -> int | None:
        """Return when the device, or a fault, is due."""
        due = None if self._restart else self._inner.due()
        dues = [due - self._ahead_ns] if due is not None else []
        if self._restart:
            dues.append(self._dumb_until_ns)
        if self._faults and self._started_ns is not None:
            dues.append(self._started_ns + round(self._faults[-1].at * 1e9))
        return min(dues, default=None)

    def leaving(self, now: Now) -> Sequence[Output[U]]:
        """Leave as the device does."""
        return self._said(self._inner.leaving(self._theirs(now)), now)

    @property
    def counts(self) -> Mapping[str, int]:
        """The device's counters, and the units that faults took or damaged."""
        return {**self._inner.counts, **self._counts}

    def _theirs(self, now: Now) -> Now:
        return Now(now.monotonic_ns + self._ahead_ns, now.utime + self._ahead_ns // 1000)

    def _strike(self, now: Now) -> list[Output[U]]:
        told: list[Output[U]] = []
        since = 0 if self._started_ns is None else now.monotonic_ns - self._started_ns
        while self._faults and round(self._faults[-1].at * 1e9) <= since:
            fault = self._faults.pop()
            amount_ns = round(fault.amount * 1e9)
            if fault.kind in ("stall", "restart"):
                self._dumb_until_ns = now.monotonic_ns + amount_ns
                self._restart = self._restart or fault.kind == "restart"
            elif fault.kind == "jump":
                self._ahead_ns += amount_ns
            else:
                self._pending[fault.kind] += round(fault.amount)
            told.append(StationStatus(StationPhase.STREAMING, f"fault: {fault.kind}, {fault.amount:g}"))
        return told

    def _said(self, outputs: Sequence[Output[U]], now: Now) -> list[Output[U]]:
        kept: list[Output[U]] = []
        for output in outputs:
            if not isinstance(output, Send):
                kept.append(output)
            elif now.monotonic_ns < self._dumb_until_ns:
                self._counts["fault.silenced"] += 1
            elif self._pending["drop"] > 0:
                self._pending["drop"] -= 1
                self._counts["fault.dropped"] += 1
            elif self._pending["corrupt"] > 0:
                self._pending["corrupt"] -= 1
                self._counts["fault.corrupted"] += 1
                kept.append(Send(damaged(output.unit)))
            else:
                kept.append(output)
        return kept


def damaged(unit: Any) -> Any:
    """Return a unit with one bit flipped in its middle; one without anything in it as it is."""
    if isinstance(unit, bytes):
        middle = len(unit) // 2
        return unit[:middle] + bytes((unit[middle] ^ 0x10,)) + unit[middle + 1 :] if unit else unit
    if isinstance(unit, CanFrame):
        return replace(unit, data=damaged(unit.data))
    if isinstance(unit, Registers) and unit.values:
        return replace(unit, values=(unit.values[0] ^ 0x10, *unit.values[1:]))
    return unit
