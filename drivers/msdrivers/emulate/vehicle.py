"""Emulator of a drive-by-wire controller on a CAN bus: commands with a dead-man timer in, status out.

Speed and steering approach the command, each at a limited rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from modelserver.messages import VehicleMode, VehicleStatusSample
from msdrivers.emulate.faults import CanEmulator, InjectedFault
from msdrivers.endpoint import HostTime, Output
from msdrivers.protocol.can.database import CanDatabase, FrameError
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import CommandMap, StatusMap
from msdrivers.protocol.can.vehicle import NUMERIC_FIELDS, BoundCommand, bind_command, bind_status

MAX_REJECTED_COUNT = 255


@dataclass(frozen=True, slots=True)
class VehicleUnit:
    """The controller and its vehicle: seconds, m/s, m/s2, radians."""

    mode: VehicleMode = VehicleMode.AUTONOMOUS
    status_period: float = 0.05
    dead_man: float = 0.25
    """Dead-man timeout."""
    max_speed: float = 5.0
    """Faster commands are rejected."""
    max_steering: float = 0.6
    acceleration: float = 1.5
    braking: float = 3.0
    steering_rate: float = 0.6
    supply_voltage: float = 13.8
    engine_speed: float = 150.0
    fault_bits: int = 0


class VehicleEmulator(CanEmulator[VehicleStatusSample]):
    """An `Endpoint` of CAN frames. With samples, speed, steering and mode are theirs instead of the commanded ones."""

    def __init__(
        self,
        database: CanDatabase,
        status: StatusMap | None,
        command: CommandMap | None = None,
        unit: VehicleUnit | None = None,
        samples: Iterable[VehicleStatusSample] = (),
        faults: Iterable[InjectedFault] = (),
    ):
        """Bind the signals. Raises ConfigError as `bind_status` and `bind_command` do."""
        super().__init__("vehicle controller emulated", samples, faults)
        self.unit = unit or VehicleUnit()
        self.mode = self.unit.mode
        """Driving mode; set it to press the emergency stop."""
        self.speed = 0.0
        self.steering = 0.0
        self.rejected = 0
        """Number of rejected commands."""
        self._database = database
        self._status = bind_status(status, database, "status") if status is not None else None
        self._command: BoundCommand | None = bind_command(command, database, "command") if command is not None else None
        self._follows_samples = self._next is not None
        self._target = (0.0, 0.0)
        self._commanded_ns: int | None = None
        self._alive: float | None = None
        self._updated_ns = 0
        self._status_ns = 0

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Start at the first opening; later the vehicle has continued."""
        if self._started is None:
            self._updated_ns = self._status_ns = now.monotonic_ns
        return super().on_open(now)

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        """Process a command."""
        outputs = self.on_timer(now)
        command = self._command
        is_command = command is not None and not unit.is_error and unit.key == command.forward_speed.key
        if command is None or not is_command or self._faults.is_silent(now.monotonic_ns):
            return outputs
        try:
            self._on_command(command, self._database.decode(unit), now.monotonic_ns)
        except FrameError as error:
            self.counts[f"rejected.{error.reason}"] += 1
        return outputs

    def get_deadline(self) -> int | None:
        """Return when the next status, sample or fault is due, monotonic nanoseconds."""
        if self._started is None:
            return None
        other = super().get_deadline()
        return self._status_ns if other is None else min(self._status_ns, other)

    def _on_fault(self, fault: InjectedFault) -> None:
        if fault.kind == "restart":
            self.rejected, self._commanded_ns, self._alive = 0, None, None

    def _on_command(self, command: BoundCommand, raw: dict[str, float], at_ns: int) -> None:
        self._advance(at_ns)
        if command.alive is not None:
            if raw[command.alive.name] == self._alive:
                self.counts["rejected.repeated"] += 1
                return
            self._alive = raw[command.alive.name]
        enabled = all(raw[name] == bits for name, bits in command.drive_bits.items())
        requested = []
        for signal, mapped in (
            (command.forward_speed, command.map.forward_speed),
            (command.steering_angle, command.map.steering_angle),
        ):
            physical = signal.to_physical(raw[signal.name])
            requested.append(math.nan if physical is None else physical * mapped.scale + mapped.offset)
        fits = abs(requested[0]) <= self.unit.max_speed and abs(requested[1]) <= self.unit.max_steering
        if not fits or (enabled and self.mode is not VehicleMode.AUTONOMOUS):
            self.rejected += 1
            self.counts["rejected"] += 1
            return
        self.counts["commands" if enabled else "stops"] += 1
        self._target = (requested[0] if enabled else 0.0, requested[1])
        self._commanded_ns = at_ns

    def _advance(self, at_ns: int) -> None:
        """Simulate up to an instant: follow the command until the dead-man timer expires, then stop."""
        ends = self._updated_ns if self._commanded_ns is None else self._commanded_ns + round(self.unit.dead_man * 1e9)
        held = min(max(ends, self._updated_ns), at_ns)
        drives = self.mode is VehicleMode.AUTONOMOUS
        self._drive((held - self._updated_ns) * 1e-9, self._target[0] if drives else 0.0, self._target[1])
        self._drive((at_ns - held) * 1e-9, 0.0, self.steering)
        self._updated_ns = at_ns

    def _drive(self, seconds: float, speed: float, steering: float) -> None:
        if self._follows_samples:
            return
        unit = self.unit
        slows = abs(speed) < abs(self.speed) or speed * self.speed < 0.0
        step = (unit.braking if slows else unit.acceleration) * seconds
        self.speed += min(max(speed - self.speed, -step), step)
        step = unit.steering_rate * seconds
        self.steering += min(max(steering - self.steering, -step), step)

    def _make_frames(self, sample: VehicleStatusSample | None, at_ns: int) -> list[CanFrame]:
        if sample is not None:
            self.mode = sample.mode
            self.speed = sample.forward_speed if math.isfinite(sample.forward_speed) else self.speed
            self.steering = sample.steering_angle if math.isfinite(sample.steering_angle) else self.steering
        if self._status_ns > at_ns:
            return []
        self._advance(at_ns)
        self._status_ns += round(self.unit.status_period * 1e9)
        status = self._status
        if status is None:
            return []
        unit = self.unit
        values = dict(
            zip(NUMERIC_FIELDS, (self.speed, self.steering, unit.supply_voltage, unit.engine_speed), strict=True)
        )
        raw: dict[str, dict[str, float]] = {}
        for name, signal in status.signals.items():
            message = raw.setdefault(signal.message, dict.fromkeys(self._database.bind_signals(signal.message), 0))
            if name in values:
                mapped = getattr(status.map, name)
                message[signal.name] = signal.to_bits((values[name] - mapped.offset) / mapped.scale)
            elif name == "mode":
                message[signal.name] = status.map.modes.get(self.mode.name.lower(), 0)
            else:
                message[signal.name] = (
                    unit.fault_bits if name == "fault_bits" else min(self.rejected, MAX_REJECTED_COUNT)
                )
        return [self._database.encode(message, bits) for message, bits in raw.items()]
