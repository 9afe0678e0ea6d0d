"""Fault injection for emulated devices: parsing of faults, and a wrapper that applies them to any endpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

from modelserver.errors import find_nearest_names, quote
from msdrivers.emulate.faults import FaultQueue
from msdrivers.emulate.faults import InjectedFault as InjectedFault
from msdrivers.endpoint import Endpoint, EndpointPhase, EndpointStatus, HostTime, Output, Send
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.modbus.registers import Registers

FAULT_AMOUNTS: Mapping[str, str] = {
    "drop": "units that are lost",
    "corrupt": "units that arrive damaged",
    "stall": "seconds of silence",
    "restart": "seconds that a restart takes",
    "jump": "seconds by which its time jumps ahead",
}
"""Kinds of faults and the default meaning of their amounts."""


def parse_fault(text: str, known: Mapping[str, str] = FAULT_AMOUNTS) -> InjectedFault:
    """Return the fault of `KIND@SECONDS[:AMOUNT]`, one of the `known` kinds.

    Raises ValueError for a malformed text.
    """
    kind, at_sign, when = text.partition("@")
    if not at_sign:
        raise ValueError(f"{quote(text, 40)} is not of the form KIND@SECONDS[:AMOUNT], e.g. stall@10:2")
    if kind not in known:
        near = find_nearest_names(kind, known)
        kinds = "; ".join(f"{name}: {amount}" for name, amount in known.items())
        hint = f"did you mean {near[0]}?" if near else f"there are, with their amounts: {kinds}"
        raise ValueError(f"{quote(kind, 40)} is no fault; {hint}")
    at, _, amount = when.partition(":")
    try:
        fault = InjectedFault(float(at), kind, float(amount) if amount else 1.0)
    except ValueError:
        raise ValueError(f"{quote(when, 40)} is not of the form SECONDS[:AMOUNT], e.g. 10:2") from None
    if not (0.0 <= fault.at < 1e9 and 0.0 < fault.amount < 1e9):
        raise ValueError(f"{quote(when, 40)}: seconds are 0 or more, an amount is above 0")
    return fault


U = TypeVar("U")


class FaultInjector(Generic[U]):
    """An `Endpoint` that wraps another and drops, corrupts or delays its output, restarts it, or shifts its clock.

    `make` returns the device as after power-on.
    """

    def __init__(self, make: Callable[[], Endpoint[U]], faults: Sequence[InjectedFault]):
        self._make = make
        self._inner = make()
        self._faults = FaultQueue[U](faults, corrupt_unit)
        self._is_restarting = False
        self._clock_jump_ns = 0

    def on_open(self, now: HostTime) -> Sequence[Output[U]]:
        """Power on."""
        self._faults.start(now.monotonic_ns)
        return self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)

    def on_receive(self, unit: U, now: HostTime) -> Sequence[Output[U]]:
        """Pass on a received unit unless the device is silent."""
        struck = self._apply_due_faults(now)
        if self._faults.is_silent(now.monotonic_ns):
            return struck
        return [*struck, *self._filter_outputs(self._inner.on_receive(unit, self._to_device_time(now)), now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[U]]:
        """Apply due faults; fire the device's timer."""
        outputs = self._apply_due_faults(now)
        if self._is_restarting and not self._faults.is_silent(now.monotonic_ns):
            self._is_restarting = False
            self._inner = self._make()
            outputs += self._filter_outputs(self._inner.on_open(self._to_device_time(now)), now)
        due = self._inner.get_deadline()
        if not self._is_restarting and due is not None and now.monotonic_ns + self._clock_jump_ns >= due:
            outputs += self._filter_outputs(self._inner.on_timer(self._to_device_time(now)), now)
        return outputs

    def get_deadline(self) -> int | None:
        """Return when the device, or a fault, is due."""
        inner = self._inner.get_deadline()
        device = None if inner is None else inner - self._clock_jump_ns
        dues = (self._faults.silent_until_ns if self._is_restarting else device, self._faults.get_deadline())
        return min((due for due in dues if due is not None), default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[U]]:
        """Close the device."""
        return self._filter_outputs(self._inner.on_close(self._to_device_time(now)), now)

    @property
    def counts(self) -> Mapping[str, int]:
        """The device's counters, and the units that faults took or damaged."""
        return {**self._inner.counts, **self._faults.counts}

    def _to_device_time(self, now: HostTime) -> HostTime:
        return HostTime(now.monotonic_ns + self._clock_jump_ns, now.utime + self._clock_jump_ns // 1000)

    def _apply_due_faults(self, now: HostTime) -> list[Output[U]]:
        outputs: list[Output[U]] = []
        for fault, _ in self._faults.pop_due(now.monotonic_ns):
            self._is_restarting = self._is_restarting or fault.kind == "restart"
            if fault.kind == "jump":
                self._clock_jump_ns += round(fault.amount * 1e9)
            outputs.append(EndpointStatus(EndpointPhase.STREAMING, f"fault: {fault.kind}, {fault.amount:g}"))
        return outputs

    def _filter_outputs(self, outputs: Sequence[Output[U]], now: HostTime) -> list[Output[U]]:
        passed: list[Output[U]] = []
        for output in outputs:
            passed += (
                self._faults.filter_units((output.unit,), now.monotonic_ns) if isinstance(output, Send) else [output]
            )
        return passed


def corrupt_unit(unit: Any) -> Any:
    """Return a unit with one bit flipped in its middle; one without anything in it as it is."""
    if isinstance(unit, bytes):
        middle = len(unit) // 2
        return unit[:middle] + bytes((unit[middle] ^ 0x10,)) + unit[middle + 1 :] if unit else unit
    if isinstance(unit, CanFrame):
        return replace(unit, data=corrupt_unit(unit.data))
    if isinstance(unit, Registers) and unit.values:
        return replace(unit, values=(unit.values[0] ^ 0x10, *unit.values[1:]))
    return unit
