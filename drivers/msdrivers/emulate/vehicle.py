"""Emulators of what moves on a vehicle: wheel encoders and the drive-by-wire controller (CAN), a nodding axis, joints.

The controller takes commands with a dead-man timer and sends its status; the vehicle follows them at once. The axis is
a register map on Modbus/TCP: it turns at the commanded rate, reverses at the limits, and measures its angle in whole
steps. The joints of a pan-tilt head that sends lines of text sweep to and fro.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from modelserver.messages import JointsSample, SensorHeader, VehicleMode, VehicleStatusSample, WheelSample, WheelsSample
from msdrivers import endpoint
from msdrivers.devices.axis import AxisRegisters
from msdrivers.devices.can import BoundSignal, CanDatabase, FrameError
from msdrivers.devices.text import TextSettings, encode_line
from msdrivers.devices.vehicle import NUMERIC_FIELDS, BoundCommand, CommandMap, StatusMap, bind_command, bind_status
from msdrivers.devices.wheels import BoundWheel, WheelMap, bind_wheels
from msdrivers.emulate import InjectedFault, SampleEmulator
from msdrivers.endpoint import CanFrame, Endpoint, HostTime, ModbusRequest, ModbusUnit, Output, Send


class WheelsEmulator(SampleEmulator[WheelsSample, CanFrame]):
    """An `Endpoint` of CAN frames. Missing values of a sample keep the last one; signals that are not mapped are 0."""

    def __init__(
        self,
        wheels: Mapping[str, WheelMap],
        database: CanDatabase,
        samples: Iterable[WheelsSample],
        first_count: int = 0,
    ):
        super().__init__(samples)
        self._database = database
        self._wheels = bind_wheels(wheels, database, "wheels")
        self._raw: dict[str, dict[str, float]] = {}
        for wheel in self._wheels:
            for signal in wheel.signals.values():
                self._raw.setdefault(signal.message, dict.fromkeys(database.bind_signals(signal.message), 0))
        self._offset = dict.fromkeys((wheel.name for wheel in self._wheels), first_count)
        self._counted = dict.fromkeys((wheel.name for wheel in self._wheels), 0)
        self._rolled = dict.fromkeys((wheel.name for wheel in self._wheels), 0)

    def apply_fault(self, fault: InjectedFault, now: HostTime) -> bool:
        for name in self._offset:
            if fault.kind == "jump":
                self._offset[name] += round(fault.amount)
            elif fault.kind == "restart":
                self._offset[name] = -self._counted[name]
        return fault.kind in ("jump", "restart")

    def _encode(self, sample: WheelsSample) -> list[CanFrame]:
        wheels = {wheel.name: wheel for wheel in sample.wheels}
        for wheel in self._wheels:
            if wheel.name in wheels:
                self._set_wheel(wheel, wheels[wheel.name])
        self.counts["frames"] += len(self._raw)
        return [self._database.encode(message, raw) for message, raw in self._raw.items()]

    def _set_wheel(self, wheel: BoundWheel, sample: WheelSample) -> None:
        mapped, get = wheel.map, wheel.signals.get
        if (signal := get("count")) is not None and mapped.count is not None and math.isfinite(sample.travel):
            rolled = round(sample.travel / mapped.count.meters_per_count)
            step = rolled - self._rolled[wheel.name]
            self._counted[wheel.name] += abs(step) if mapped.count.counts_up_only else step
            self._rolled[wheel.name] = rolled
            whole = 1 << signal.length
            count = (self._counted[wheel.name] + self._offset[wheel.name]) % (mapped.count.wrap or whole)
            self._set_raw(signal, count - whole if signal.is_signed and count >= whole // 2 else count)
        if (signal := get("speed")) is not None and mapped.speed is not None and math.isfinite(sample.speed):
            speed = sample.speed / mapped.speed.scale
            self._set_raw(signal, signal.to_bits(abs(speed) if mapped.speed.is_magnitude else speed))
        if (signal := get("direction")) is not None and mapped.direction is not None:
            numbers = mapped.direction.numbers
            unknown = next((each for each in range(1 << signal.length) if each not in numbers.values()), 0)
            self._set_raw(signal, numbers.get(sample.direction, unknown))
        if (signal := get("steering")) is not None and mapped.steering is not None and math.isfinite(sample.steering):
            self._set_raw(signal, signal.to_bits(mapped.steering.from_si(sample.steering)))

    def _set_raw(self, signal: BoundSignal, raw: float) -> None:
        self._raw[signal.message][signal.name] = raw


MAX_REJECTED_COUNT = 255


class VehicleEmulator(SampleEmulator[VehicleStatusSample, CanFrame]):
    """An `Endpoint` of CAN frames. With samples, speed, steering and mode are theirs instead of the commanded ones.

    Commands faster than MAX_SPEED, m/s, or beyond MAX_STEERING, radians, are rejected.
    """

    STATUS_PERIOD_NS, DEAD_MAN_NS = 50_000_000, 250_000_000
    MAX_SPEED, MAX_STEERING = 5.0, 0.6
    SUPPLY_VOLTAGE, ENGINE_SPEED = 13.8, 150.0

    def __init__(
        self,
        database: CanDatabase,
        status: StatusMap | None,
        command: CommandMap | None = None,
        samples: Iterable[VehicleStatusSample] = (),
    ):
        super().__init__(samples)
        self.mode = VehicleMode.AUTONOMOUS
        """Driving mode; set it to press the emergency stop."""
        self.fault_bits = 0
        self.speed = self.steering = 0.0
        self.rejected = 0
        """Number of rejected commands."""
        self._database = database
        self._status = bind_status(status, database, "status") if status is not None else None
        self._command: BoundCommand | None = bind_command(command, database, "command") if command is not None else None
        self._follows_samples = self._next is not None
        self._target = (0.0, 0.0)
        self._commanded_ns: int | None = None
        self._alive: float | None = None
        self._status_ns = 0

    def on_open(self, now: HostTime) -> Sequence[Output[CanFrame]]:
        """Start at the first opening; later the vehicle has continued."""
        if self._now is None:
            self._status_ns = now.monotonic_ns
        super().on_open(now)
        return self.on_timer(now)

    def on_receive(self, unit: CanFrame, now: HostTime) -> Sequence[Output[CanFrame]]:
        outputs = self.on_timer(now)
        command = self._command
        if command is not None and not unit.is_error and unit.key == command.key:
            try:
                self._on_command(command, self._database.decode(unit), now.monotonic_ns)
            except FrameError as error:
                self.counts[f"rejected.{error.reason}"] += 1
        return outputs

    def on_timer(self, now: HostTime) -> Sequence[Output[CanFrame]]:
        super().on_timer(now)
        outputs: list[Output[CanFrame]] = []
        while self._status_ns <= now.monotonic_ns:
            outputs += [Send(each) for each in self._make_status(self._status_ns)]
            self._status_ns += self.STATUS_PERIOD_NS
        return outputs

    def get_deadline(self) -> int | None:
        other = super().get_deadline()
        return None if self._now is None else min(self._status_ns, self._status_ns if other is None else other)

    def apply_fault(self, fault: InjectedFault, now: HostTime) -> bool:
        if fault.kind == "restart":
            self.rejected, self._commanded_ns, self._alive = 0, None, None
        # it has no counters that could jump
        return fault.kind in ("jump", "restart")

    def _on_command(self, command: BoundCommand, raw: dict[str, float], at_ns: int) -> None:
        if (alive := command.signals.get("alive")) is not None:
            if raw[alive.name] == self._alive:
                self.counts["rejected.repeated"] += 1
                return
            self._alive = raw[alive.name]
        enabled = all(raw[name] == bits for name, bits in command.drive_bits.items())
        requested = []
        for signal, mapped in command.motion:
            physical = signal.to_physical(raw[signal.name])
            requested.append(math.nan if physical is None else mapped.to_si(physical))
        fits = abs(requested[0]) <= self.MAX_SPEED and abs(requested[1]) <= self.MAX_STEERING
        if not fits or (enabled and self.mode is not VehicleMode.AUTONOMOUS):
            self.rejected += 1
            self.counts["rejected"] += 1
            return
        self.counts["commands" if enabled else "stops"] += 1
        self._target = (requested[0] if enabled else 0.0, requested[1])
        self._commanded_ns = at_ns

    def _drive(self, at_ns: int) -> None:
        """Follow the command at once, until the dead-man timer expires."""
        if self._follows_samples:
            return
        ends = 0 if self._commanded_ns is None else self._commanded_ns + self.DEAD_MAN_NS
        is_driving = self.mode is VehicleMode.AUTONOMOUS and at_ns < ends
        self.speed, self.steering = self._target if is_driving else (0.0, self.steering)

    def _encode(self, sample: VehicleStatusSample) -> tuple[CanFrame, ...]:
        """Take its state from a sample; it is sent with the next status."""
        self.mode = sample.mode
        self.speed = sample.forward_speed if math.isfinite(sample.forward_speed) else self.speed
        self.steering = sample.steering_angle if math.isfinite(sample.steering_angle) else self.steering
        return ()

    def _make_status(self, at_ns: int) -> list[CanFrame]:
        self._drive(at_ns)
        status = self._status
        if status is None:
            return []
        numbers = (self.speed, self.steering, self.SUPPLY_VOLTAGE, self.ENGINE_SPEED)
        values = dict(zip(NUMERIC_FIELDS, numbers, strict=True))
        raw: dict[str, dict[str, float]] = {}
        for name, signal in status.signals.items():
            message = raw.setdefault(signal.message, dict.fromkeys(self._database.bind_signals(signal.message), 0))
            if name in values:
                bits = signal.to_bits(getattr(status.map, name).from_si(values[name]))
            elif name == "mode":
                bits = status.map.modes.get(self.mode.name.lower(), 0)
            else:
                bits = self.fault_bits if name == "fault_bits" else min(self.rejected, MAX_REJECTED_COUNT)
            message[signal.name] = bits
        return [self._database.encode(name, values) for name, values in raw.items()]


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


class AxisEmulator(SampleEmulator[JointsSample, ModbusUnit]):
    """An `Endpoint` of `ModbusUnit` that answers requests.

    Faults of its own: restart: it restarts with its first limits and rate. jump: its angle jumps by `amount` degrees.
    exception: the next request gets exception code `amount`.
    """

    def __init__(self, registers: AxisRegisters, unit: AxisUnit | None = None):
        super().__init__(())
        self.unit = unit or AxisUnit()
        self._registers = registers
        self._started_ns: int | None = None
        self._exceptions: deque[int] = deque()
        self._switch_on(0)

    def on_open(self, now: HostTime) -> list[Output[ModbusUnit]]:
        """Power on at the first opening; later the axis has continued."""
        if self._started_ns is None:
            self._started_ns = self._updated_ns = now.monotonic_ns
        return [endpoint.EndpointStatus(endpoint.EndpointPhase.STREAMING, "axis emulated")]

    def on_receive(self, unit: ModbusUnit, now: HostTime) -> list[Output[ModbusUnit]]:
        if not isinstance(unit, ModbusRequest):
            return []
        self._advance(now.monotonic_ns)
        code = self._exceptions.popleft() if self._exceptions else 0
        reply = self._make_exception(unit, code) if code else self._reply(unit)
        self.counts["exceptions" if isinstance(reply, endpoint.ModbusFailure) else "replies"] += 1
        return [Send(reply)]

    def _switch_on(self, at_ns: int) -> None:
        unit = self.unit
        self.commanded = {"lower_limit": unit.lower_deg, "upper_limit": unit.upper_deg, "nod_rate": unit.rate_deg}
        """The limits and the rate that it nods by, degrees (a second)."""
        self.degrees = self._measured_deg = unit.angle_deg
        """True angle at the last request."""
        self._direction, self._measured_rate = 1.0, 0.0
        self._updated_ns, self._number = at_ns, 0

    def apply_fault(self, fault: InjectedFault, now: HostTime) -> bool:
        if fault.kind == "exception":
            self._exceptions.append(round(fault.amount))
        elif fault.kind == "jump":
            self._advance(now.monotonic_ns)
            self.degrees += fault.amount
        elif fault.kind == "restart":
            self._switch_on(now.monotonic_ns + round(fault.amount * 1e9))
        return fault.kind in ("exception", "jump", "restart")

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

    def _reply(self, unit: ModbusRequest) -> ModbusUnit:
        if isinstance(unit, endpoint.WriteRegisters):
            return self._write(unit)
        table = self._make_table(unit.table)
        wanted = range(unit.address, unit.address + unit.count)
        # between its registers it has others, which are 0
        if not 0 < unit.count <= endpoint.MAX_READ or not table or wanted[0] < min(table) or wanted[-1] > max(table):
            return self._make_exception(unit, ILLEGAL_ADDRESS)
        return endpoint.Registers(unit.address, tuple(table.get(address, 0) for address in wanted), unit.transaction)

    def _make_table(self, table: endpoint.RegisterTable) -> dict[int, int]:
        registers = self._registers
        values = self.commanded | {"angle": self._measured_deg, "rate": self._measured_rate}
        present = dict(registers.measured) if table == registers.table else {}
        if table == "holding":
            present |= registers.commanded
        words: dict[int, int] = {}
        for name, mapped in present.items():
            found = mapped.to_words(self._number) if name == "sequence" else mapped.from_degrees(values[name])
            words |= {mapped.address + index: word for index, word in enumerate(found)}
        return words

    def _write(self, unit: endpoint.WriteRegisters) -> ModbusUnit:
        places = {(mapped.address, mapped.word_count): name for name, mapped in self._registers.commanded.items()}
        name = places.get((unit.address, len(unit.values)))
        if name is None or len(unit.values) > endpoint.MAX_WRITE:
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
        return endpoint.RegistersWritten(unit.address, len(unit.values), unit.transaction)

    def _make_exception(self, unit: ModbusRequest, code: int) -> endpoint.ModbusFailure:
        return endpoint.ModbusFailure(endpoint.explain_exception(code), code, unit.transaction)


PERIOD_US: Final = 20_000
"""Microseconds between lines."""

AMPLITUDE: Final = 0.5
"""Radians or meters to either side."""

SWEEP_S: Final = 8.0
"""Period of the first joint, seconds; that of each further one is a third shorter."""


class TextJointsEmulator(SampleEmulator[JointsSample, bytes]):
    """An `Endpoint` of bytes that sends a line every `PERIOD_US` from its first opening on."""

    def __init__(self, settings: TextSettings) -> None:
        super().__init__(())
        self._settings = settings

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        if self._now is None:
            self._first_utime = now.utime
            self._samples = (JointsSample(SensorHeader(utime), ()) for utime in count(now.utime, PERIOD_US))
            self._next = next(self._samples)
        return super().on_open(now)

    def _encode(self, sample: JointsSample) -> tuple[bytes]:
        return (encode_line(self._settings, self.get_values((sample.header.utime - self._first_utime) * 1e-6)),)

    def get_values(self, seconds: float) -> dict[str, float]:
        """Return the fields of a line, `seconds` after the first."""
        values = {}
        for number, name in enumerate(self._settings.mapped):
            period = SWEEP_S * (2.0 / 3.0) ** number
            values[name] = 1.0 + seconds if name == "time" else AMPLITUDE * math.sin(math.tau * seconds / period)
        return values


EMULATORS: Final[Mapping[str, Callable[..., Endpoint[Any]]]] = {
    "wheels": lambda settings, samples, database: WheelsEmulator(settings.wheels, database, samples),
    "vehicle": lambda settings, samples, database: VehicleEmulator(
        database, settings.status, settings.command, samples=samples
    ),
    "text_joints": lambda settings, samples: TextJointsEmulator(settings),
    "axis": lambda settings, samples: AxisEmulator(settings.registers),
}
"""By kind of device."""
