"""Emulator of a nodding axis on Modbus/TCP: a register map and an axis that moves between its limits.

It turns at the commanded rate, reverses at the limits, and measures its angle in whole steps.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

from msdrivers.emulate.faults import FaultQueue, InjectedFault
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output
from msdrivers.protocol.modbus import registers as modbus
from msdrivers.protocol.modbus.registers import AxisRegisters

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3


@dataclass(frozen=True, slots=True)
class AxisUnit:
    """The axis as it is switched on. Degrees and degrees a second."""

    lower_deg: float = -15.0
    upper_deg: float = 15.0
    rate_deg: float = 0.0
    angle_deg: float = 0.0
    lowest_deg: float = -90.0
    """Lower limits are rejected."""
    highest_deg: float = 90.0
    slowest_deg: float = 2.0
    """Lower rates except 0 are rejected."""
    fastest_deg: float = 90.0
    step_deg: float = 0.072
    measure_hz: float = 500.0
    """Measurements a second; a reading between two gives the last."""


class AxisEmulator:
    """An `Endpoint` of `ModbusUnit` that answers requests.

    Faults: drop: `amount` requests are not answered. corrupt: `amount` replies lack a register. stall: no answer for
    `amount` seconds. restart: the same, and the axis restarts with its first limits and rate. jump: its angle jumps by
    `amount` degrees. exception: the next request gets exception code `amount`.
    """

    def __init__(self, registers: AxisRegisters, unit: AxisUnit | None = None, faults: Iterable[InjectedFault] = ()):
        self.unit = unit or AxisUnit()
        self._registers = registers
        self._faults = FaultQueue[modbus.ModbusUnit](
            faults, lambda unit: replace(unit, values=unit.values[:-1]) if isinstance(unit, modbus.Registers) else unit
        )
        self._started_ns: int | None = None
        self._exceptions: deque[int] = deque()
        self.counts: Counter[str] = Counter()
        self._switch_on(0)

    def on_open(self, now: HostTime) -> list[Output[modbus.ModbusUnit]]:
        """Power on at the first opening; later the axis has continued."""
        if self._started_ns is None:
            self._started_ns = self._updated_ns = now.monotonic_ns
            self._faults.start(now.monotonic_ns)
        return [EndpointStatus(EndpointPhase.STREAMING, "axis emulated")]

    def on_receive(self, unit: modbus.ModbusUnit, now: HostTime) -> list[Output[modbus.ModbusUnit]]:
        """Answer a request."""
        for fault, due in self._faults.pop_due(now.monotonic_ns):
            self._apply_fault(fault, due)
        if self._faults.is_silent(now.monotonic_ns) or not isinstance(
            unit, modbus.ReadRegisters | modbus.WriteRegisters
        ):
            return []
        self._advance(now.monotonic_ns)
        code = self._exceptions.popleft() if self._exceptions else 0
        reply = self._make_exception(unit, code) if code else self._answer(unit)
        self.counts["exceptions" if isinstance(reply, modbus.ModbusFailure) else "replies"] += 1
        return [*self._faults.filter_units((reply,), now.monotonic_ns)]

    def on_timer(self, now: HostTime) -> list[Output[modbus.ModbusUnit]]:
        """Do nothing: it only answers."""
        return []

    def get_deadline(self) -> int | None:
        """Return None: it only answers."""
        return None

    def on_close(self, now: HostTime) -> list[Output[modbus.ModbusUnit]]:
        return []

    def _switch_on(self, at_ns: int) -> None:
        unit = self.unit
        self.commanded = {"lower_limit": unit.lower_deg, "upper_limit": unit.upper_deg, "nod_rate": unit.rate_deg}
        """The limits and the rate that it nods by, degrees (a second)."""
        self.degrees = self._measured_deg = unit.angle_deg
        """True angle at the last request."""
        self._direction, self._measured_rate = 1.0, 0.0
        self._updated_ns, self._number = at_ns, 0

    def _apply_fault(self, fault: InjectedFault, at_ns: int) -> None:
        if fault.kind == "exception":
            self._exceptions.append(round(fault.amount))
        elif fault.kind == "jump":
            self._advance(at_ns)
            self.degrees += fault.amount
        elif fault.kind == "restart":
            self._switch_on(self._faults.silent_until_ns)

    def _advance(self, at_ns: int) -> None:
        """Turn on to an instant, and measure at the last instant of its own before."""
        tick_ns = round(1e9 / self.unit.measure_hz)
        ticks = (at_ns - (self._started_ns or 0)) // tick_ns
        measured_ns = (self._started_ns or 0) + ticks * tick_ns
        if measured_ns > self._updated_ns:
            self._number = ticks & 0xFFFF
            turned = self._rotate((measured_ns - self._updated_ns) * 1e-9)
            self._updated_ns = measured_ns
            self._measured_deg = round(self.degrees / self.unit.step_deg) * self.unit.step_deg
            self._measured_rate = turned

    def _rotate(self, seconds: float) -> float:
        """Rotate for a time; return the signed rate at its end."""
        lower, upper, rate = self.commanded["lower_limit"], self.commanded["upper_limit"], self.commanded["nod_rate"]
        if rate == 0.0:
            return 0.0
        left = rate * seconds
        if not lower <= self.degrees <= upper:
            # the limits were moved, or it was pushed: back between them first
            near = min(max(self.degrees, lower), upper)
            self._direction = 1.0 if near > self.degrees else -1.0
            way = min(left, abs(near - self.degrees))
            self.degrees += self._direction * way
            left -= way
        if left > 0.0:
            # unfolded, the nodding motion is periodic in twice the span
            span = upper - lower
            phase = self.degrees - lower if self._direction > 0.0 else 2.0 * span - (self.degrees - lower)
            phase = (phase + left) % (2.0 * span)
            self._direction = 1.0 if phase < span else -1.0
            self.degrees = lower + (phase if phase < span else 2.0 * span - phase)
        return self._direction * rate

    def _answer(self, unit: modbus.ReadRegisters | modbus.WriteRegisters) -> modbus.ModbusUnit:
        if isinstance(unit, modbus.WriteRegisters):
            return self._write(unit)
        table = self._make_table(unit.table)
        wanted = range(unit.address, unit.address + unit.count)
        # between its registers it has others, which are 0
        if not 0 < unit.count <= modbus.MAX_READ or not table or wanted[0] < min(table) or wanted[-1] > max(table):
            return self._make_exception(unit, ILLEGAL_ADDRESS)
        return modbus.Registers(unit.address, tuple(table.get(address, 0) for address in wanted), unit.transaction)

    def _make_table(self, table: modbus.RegisterTable) -> dict[int, int]:
        registers = self._registers
        words: dict[int, int] = {}
        if table is modbus.RegisterTable(registers.table):
            values = {"angle": self._measured_deg, "rate": self._measured_rate}
            for name, mapped in registers.measured.items():
                found = mapped.to_words(self._number) if name == "sequence" else mapped.from_degrees(values[name])
                words |= {mapped.address + index: word for index, word in enumerate(found)}
        if table is modbus.RegisterTable.HOLDING:
            for name, mapped in registers.commanded.items():
                found = mapped.from_degrees(self.commanded[name])
                words |= {mapped.address + index: word for index, word in enumerate(found)}
        return words

    def _write(self, unit: modbus.WriteRegisters) -> modbus.ModbusUnit:
        places = {(mapped.address, mapped.registers): name for name, mapped in self._registers.commanded.items()}
        name = places.get((unit.address, len(unit.values)))
        if name is None or len(unit.values) > modbus.MAX_WRITE:
            return self._make_exception(unit, ILLEGAL_ADDRESS)
        after = self.commanded | {name: self._registers.commanded[name].to_degrees(unit.values)}
        axis, rate = self.unit, after["nod_rate"]
        slack = 0.5 * axis.step_deg
        fits = axis.lowest_deg - slack <= after["lower_limit"] < after["upper_limit"] <= axis.highest_deg + slack and (
            rate == 0.0 or axis.slowest_deg - slack <= rate <= axis.fastest_deg + slack
        )
        if not fits:
            return self._make_exception(unit, ILLEGAL_VALUE)
        self.commanded = after
        return modbus.RegistersWritten(unit.address, len(unit.values), unit.transaction)

    def _make_exception(self, unit: modbus.ReadRegisters | modbus.WriteRegisters, code: int) -> modbus.ModbusFailure:
        return modbus.ModbusFailure(
            modbus.FailureKind.EXCEPTION, modbus.explain_exception(code), code, unit.transaction
        )
