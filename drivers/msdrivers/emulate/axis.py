"""A nodding axis on Modbus/TCP in software: a map of registers, and an axis that turns between its limits.

It turns at the rate it was told, turns back where it reaches a limit, and measures itself in whole steps.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from msdrivers.protocol.modbus.axis_map import AxisRegisters
from msdrivers.protocol.modbus.registers import (
    MAX_READ,
    MAX_WRITE,
    FailureKind,
    ModbusFailure,
    ModbusUnit,
    ReadRegisters,
    Registers,
    Table,
    WriteRegisters,
    Written,
    explain,
)
from msdrivers.station import Now, Output, Send, StationPhase, StationStatus

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3

AxisFaultKind: TypeAlias = Literal["drop", "corrupt", "stall", "restart", "jump", "exception"]


@dataclass(frozen=True, slots=True)
class AxisFault:
    """Something that goes wrong `at` seconds after the start.

    drop: `amount` requests are not answered. corrupt: `amount` replies have a register too few. stall: no answer for
    `amount` seconds. restart: the same, and the axis begins anew at its first limits and rate. jump: its angle jumps by
    `amount` degrees. exception: the next request is refused with code `amount`.
    """

    at: float
    kind: AxisFaultKind
    amount: float = 1.0


@dataclass(frozen=True, slots=True)
class AxisUnit:
    """The axis as it is switched on. Degrees and degrees a second."""

    lower_deg: float = -15.0
    upper_deg: float = 15.0
    rate_deg: float = 0.0
    angle_deg: float = 0.0
    lowest_deg: float = -90.0
    """Limits below are refused."""
    highest_deg: float = 90.0
    slowest_deg: float = 2.0
    """Rates below are refused, but for 0."""
    fastest_deg: float = 90.0
    step_deg: float = 0.072
    measure_hz: float = 500.0
    """Measurements a second; a reading between two gives the last."""


class AxisEmulator:
    """A `Station` of `ModbusUnit` that answers requests."""

    def __init__(self, registers: AxisRegisters, unit: AxisUnit | None = None, faults: Iterable[AxisFault] = ()):
        """Take the registers as the driver has them, the axis, and the faults."""
        self.unit = unit or AxisUnit()
        self._registers = registers
        self._faults = deque(sorted(faults, key=lambda fault: fault.at))
        self._begun_ns: int | None = None
        self._drop = self._corrupt = 0
        self._quiet_until_ns = 0
        self._exceptions: deque[int] = deque()
        self.counts: Counter[str] = Counter()
        self._switch_on(0)

    def opened(self, now: Now) -> list[Output[ModbusUnit]]:
        """Switch on at the first time; later the axis has gone on."""
        if self._begun_ns is None:
            self._begun_ns = self._moved_ns = now.monotonic_ns
        return [StationStatus(StationPhase.STREAMING, "axis emulated")]

    def received(self, unit: ModbusUnit, now: Now) -> list[Output[ModbusUnit]]:
        """Answer a request."""
        self._suffer(now.monotonic_ns)
        if now.monotonic_ns < self._quiet_until_ns or not isinstance(unit, ReadRegisters | WriteRegisters):
            return []
        if self._drop:
            self._drop -= 1
            return []
        self._move(now.monotonic_ns)
        code = self._exceptions.popleft() if self._exceptions else 0
        reply = self._refusal(unit, code) if code else self._answer(unit)
        self.counts["exceptions" if isinstance(reply, ModbusFailure) else "replies"] += 1
        if self._corrupt and isinstance(reply, Registers):
            self._corrupt -= 1
            reply = Registers(reply.address, reply.values[:-1], reply.transaction)
        return [Send(reply)]

    def woken(self, now: Now) -> list[Output[ModbusUnit]]:
        """Do nothing: it only answers."""
        return []

    def due(self) -> int | None:
        """Return None: it only answers."""
        return None

    def leaving(self, now: Now) -> list[Output[ModbusUnit]]:
        """Leave."""
        return []

    @property
    def degrees(self) -> float:
        """Where the axis is, as it was last asked, without steps."""
        return self._angle

    @property
    def commanded(self) -> dict[str, float]:
        """The limits and the rate that it nods by, degrees (a second)."""
        return dict(self._commanded)

    def _switch_on(self, at_ns: int) -> None:
        unit = self.unit
        self._commanded = {"lower_limit": unit.lower_deg, "upper_limit": unit.upper_deg, "nod_rate": unit.rate_deg}
        self._angle = unit.angle_deg
        self._sense = 1.0
        self._moved_ns = at_ns
        self._number = 0
        self._told = self._angle
        self._told_rate = 0.0

    def _suffer(self, at_ns: int) -> None:
        """Let the faults come whose time it is."""
        begun = self._begun_ns or 0
        while self._faults and begun + round(self._faults[0].at * 1e9) <= at_ns:
            fault = self._faults.popleft()
            due = begun + round(fault.at * 1e9)
            if fault.kind == "drop":
                self._drop += round(fault.amount)
            elif fault.kind == "corrupt":
                self._corrupt += round(fault.amount)
            elif fault.kind == "exception":
                self._exceptions.append(round(fault.amount))
            elif fault.kind == "jump":
                self._move(due)
                self._angle += fault.amount
            else:
                self._quiet_until_ns = due + round(fault.amount * 1e9)
                if fault.kind == "restart":
                    self._switch_on(self._quiet_until_ns)

    def _move(self, at_ns: int) -> None:
        """Turn on to an instant, and measure at the last instant of its own before."""
        tick_ns = round(1e9 / self.unit.measure_hz)
        ticks = (at_ns - (self._begun_ns or 0)) // tick_ns
        measured_ns = (self._begun_ns or 0) + ticks * tick_ns
        if measured_ns > self._moved_ns:
            self._number = ticks & 0xFFFF
            turned = self._turn((measured_ns - self._moved_ns) * 1e-9)
            self._moved_ns = measured_ns
            self._told = round(self._angle / self.unit.step_deg) * self.unit.step_deg
            self._told_rate = turned

    def _turn(self, seconds: float) -> float:
        """Turn for so long; return the rate at the end, with its sign."""
        lower, upper, rate = self._commanded["lower_limit"], self._commanded["upper_limit"], self._commanded["nod_rate"]
        if rate == 0.0:
            return 0.0
        left = rate * seconds
        if not lower <= self._angle <= upper:
            # the limits were moved, or it was pushed: back between them first
            near = min(max(self._angle, lower), upper)
            self._sense = 1.0 if near > self._angle else -1.0
            way = min(left, abs(near - self._angle))
            self._angle += self._sense * way
            left -= way
        if left > 0.0:
            # unfolded, nodding goes round a circle of twice the span
            span = upper - lower
            phase = self._angle - lower if self._sense > 0.0 else 2.0 * span - (self._angle - lower)
            phase = (phase + left) % (2.0 * span)
            self._sense = 1.0 if phase < span else -1.0
            self._angle = lower + (phase if phase < span else 2.0 * span - phase)
        return self._sense * rate

    def _answer(self, unit: ReadRegisters | WriteRegisters) -> ModbusUnit:
        if isinstance(unit, WriteRegisters):
            return self._written(unit)
        table = self._table(unit.table)
        wanted = range(unit.address, unit.address + unit.count)
        # between its registers it has others, which are 0
        if not 0 < unit.count <= MAX_READ or not table or wanted[0] < min(table) or wanted[-1] > max(table):
            return self._refusal(unit, ILLEGAL_ADDRESS)
        return Registers(unit.address, tuple(table.get(address, 0) for address in wanted), unit.transaction)

    def _table(self, table: Table) -> dict[int, int]:
        registers = self._registers
        words: dict[int, int] = {}
        if table is Table(registers.table):
            values = {"angle": self._told, "rate": self._told_rate}
            for name, mapped in registers.measured.items():
                found = mapped.words(self._number) if name == "number" else mapped.of_degrees(values[name])
                words |= {mapped.address + index: word for index, word in enumerate(found)}
        if table is Table.HOLDING:
            for name, mapped in registers.commanded.items():
                found = mapped.of_degrees(self._commanded[name])
                words |= {mapped.address + index: word for index, word in enumerate(found)}
        return words

    def _written(self, unit: WriteRegisters) -> ModbusUnit:
        places = {(mapped.address, mapped.registers): name for name, mapped in self._registers.commanded.items()}
        name = places.get((unit.address, len(unit.values)))
        if name is None or len(unit.values) > MAX_WRITE:
            return self._refusal(unit, ILLEGAL_ADDRESS)
        after = self._commanded | {name: self._registers.commanded[name].degrees(unit.values)}
        axis, rate = self.unit, after["nod_rate"]
        slack = 0.5 * axis.step_deg
        fits = axis.lowest_deg - slack <= after["lower_limit"] < after["upper_limit"] <= axis.highest_deg + slack and (
            rate == 0.0 or axis.slowest_deg - slack <= rate <= axis.fastest_deg + slack
        )
        if not fits:
            return self._refusal(unit, ILLEGAL_VALUE)
        self._commanded = after
        return Written(unit.address, len(unit.values), unit.transaction)

    def _refusal(self, unit: ReadRegisters | WriteRegisters, code: int) -> ModbusFailure:
        return ModbusFailure(FailureKind.EXCEPTION, explain(code), code, unit.transaction)
