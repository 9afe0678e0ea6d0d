"""A drive-by-wire controller on a CAN bus in software: takes commands, has a dead-man of its own, tells its status.

It drives by the simplest rules: speed and steering go to what is commanded, each at a limited rate.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from modelserver.messages import VehicleMode, VehicleStatusSample
from msdrivers.emulate.can_line import CanFault, CanLine, said
from msdrivers.protocol.can.database import CanDatabase, FrameError
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import CommandMap, StatusMap
from msdrivers.protocol.can.vehicle import NUMBERS, BoundCommand, bind_command, bind_status
from msdrivers.station import Now, Output, StationPhase, StationStatus

COUNT_TOP = 255


@dataclass(frozen=True, slots=True)
class VehicleUnit:
    """The controller and its vehicle: seconds, m/s, m/s2, radians."""

    mode: VehicleMode = VehicleMode.AUTONOMOUS
    status_period: float = 0.05
    dead_man: float = 0.25
    """Without a command for so long it stops."""
    top_speed: float = 5.0
    """A command beyond is refused."""
    top_steering: float = 0.6
    acceleration: float = 1.5
    braking: float = 3.0
    steering_rate: float = 0.6
    supply_voltage: float = 13.8
    engine_speed: float = 150.0
    fault_bits: int = 0


class VehicleEmulator:
    """A `Station` of CAN frames. With samples speed, steering and mode are theirs, not what is commanded."""

    def __init__(
        self,
        database: CanDatabase,
        status: StatusMap | None,
        command: CommandMap | None = None,
        unit: VehicleUnit | None = None,
        samples: Iterable[VehicleStatusSample] = (),
        faults: Iterable[CanFault] = (),
    ):
        """Take DBC and mapping as the driver has them, the vehicle, what measures it, and the faults.

        Raises ConfigError as `bind_status` and `bind_command` do.
        """
        self.unit = unit or VehicleUnit()
        self.mode = self.unit.mode
        """Who drives; set it to press the emergency stop."""
        self.speed = 0.0
        self.steering = 0.0
        self.refused = 0
        """Commands that were refused."""
        self._database = database
        self._status = bind_status(status, database, "status") if status is not None else None
        self._command: BoundCommand | None = bind_command(command, database, "command") if command is not None else None
        self._samples = iter(samples)
        self._next = next(self._samples, None)
        self._measured = self._next is not None
        self._line = CanLine(faults)
        self._wanted = (0.0, 0.0)
        self._commanded_ns: int | None = None
        self._alive: float | None = None
        self._begun: tuple[int, int] | None = None
        self._moved_ns = 0
        self._status_ns = 0
        self.counts: Counter[str] = Counter()

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin at the first time; later the vehicle has gone on."""
        self._line.begin(now.monotonic_ns)
        if self._begun is None:
            # samples are told at their stamps; if the first is past already, all as much later
            first = now.utime if self._next is None else self._next.header.utime
            self._begun = (now.monotonic_ns, min(now.utime, first))
            self._moved_ns = self._status_ns = now.monotonic_ns
        return [StationStatus(StationPhase.STREAMING, "vehicle controller emulated"), *self.woken(now)]

    def received(self, unit: CanFrame, now: Now) -> list[Output[CanFrame]]:
        """Take a command."""
        outputs = self.woken(now)
        command = self._command
        if command is None or unit.is_error or unit.key != command.forward_speed.key:
            return outputs
        if self._line.quiet(now.monotonic_ns):
            return outputs
        try:
            raw = self._database.decode(unit)
        except FrameError as error:
            self.counts[f"rejected.{error.reason}"] += 1
            return outputs
        self._take(command, raw, now.monotonic_ns)
        return outputs

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Go on, and tell the status when it is due."""
        outputs: list[Output[CanFrame]] = []
        while (due := self.due()) is not None and due <= now.monotonic_ns:
            faults = self._line.come(due)
            outputs += said(faults)
            for fault in faults:
                if fault.kind == "restart":
                    self.refused, self._commanded_ns, self._alive = 0, None, None
            if self._next is not None and self._at(self._next) <= due:
                self._follow(self._next)
                self._next = next(self._samples, None)
            if self._status_ns <= due:
                self._move(due)
                self._status_ns += round(self.unit.status_period * 1e9)
                outputs += self._line.passed(self._frames(), due)
        return outputs

    def due(self) -> int | None:
        """Return when there is something to do."""
        if self._begun is None:
            return None
        sample = self._at(self._next) if self._next is not None else None
        return min(due for due in (self._status_ns, sample, self._line.due()) if due is not None)

    def leaving(self, now: Now) -> list[Output[CanFrame]]:
        """Leave."""
        return []

    def _at(self, sample: VehicleStatusSample) -> int:
        assert self._begun is not None
        return self._begun[0] + (sample.header.utime - self._begun[1]) * 1000

    def _follow(self, sample: VehicleStatusSample) -> None:
        self.mode = sample.mode
        if math.isfinite(sample.forward_speed):
            self.speed = sample.forward_speed
        if math.isfinite(sample.steering_angle):
            self.steering = sample.steering_angle

    def _take(self, command: BoundCommand, raw: dict[str, float], at_ns: int) -> None:
        self._move(at_ns)
        if command.alive is not None:
            if raw[command.alive.name] == self._alive:
                self.counts["rejected.repeated"] += 1
                return
            self._alive = raw[command.alive.name]
        enabled = all(raw[name] == bits for name, bits in command.driving.items())
        wish = []
        for signal, mapped in (
            (command.forward_speed, command.map.forward_speed),
            (command.steering_angle, command.map.steering_angle),
        ):
            physical = signal.physical(raw[signal.name])
            wish.append(math.nan if physical is None else physical * mapped.scale + mapped.offset)
        fits = abs(wish[0]) <= self.unit.top_speed and abs(wish[1]) <= self.unit.top_steering
        if not fits or (enabled and self.mode is not VehicleMode.AUTONOMOUS):
            self.refused += 1
            self.counts["refused"] += 1
            return
        self.counts["commands" if enabled else "stops"] += 1
        self._wanted = (wish[0] if enabled else 0.0, wish[1])
        self._commanded_ns = at_ns

    def _move(self, at_ns: int) -> None:
        """Go on to an instant: to what is wanted until the dead-man ends, then to a stop."""
        ends = self._moved_ns if self._commanded_ns is None else self._commanded_ns + round(self.unit.dead_man * 1e9)
        held = min(max(ends, self._moved_ns), at_ns)
        drives = self.mode is VehicleMode.AUTONOMOUS
        self._go((held - self._moved_ns) * 1e-9, self._wanted[0] if drives else 0.0, self._wanted[1])
        self._go((at_ns - held) * 1e-9, 0.0, self.steering)
        self._moved_ns = at_ns

    def _go(self, seconds: float, speed: float, steering: float) -> None:
        if self._measured:
            return
        unit = self.unit
        slows = abs(speed) < abs(self.speed) or speed * self.speed < 0.0
        step = (unit.braking if slows else unit.acceleration) * seconds
        self.speed += min(max(speed - self.speed, -step), step)
        step = unit.steering_rate * seconds
        self.steering += min(max(steering - self.steering, -step), step)

    def _frames(self) -> list[CanFrame]:
        status = self._status
        if status is None:
            return []
        unit = self.unit
        values = dict(zip(NUMBERS, (self.speed, self.steering, unit.supply_voltage, unit.engine_speed), strict=True))
        raw: dict[str, dict[str, float]] = {}
        for name, signal in status.signals.items():
            message = raw.setdefault(signal.message, dict.fromkeys(self._database.signals(signal.message), 0))
            if name in values:
                mapped = getattr(status.map, name)
                message[signal.name] = signal.bits((values[name] - mapped.offset) / mapped.scale)
            elif name == "mode":
                message[signal.name] = status.map.modes.get(self.mode.name.lower(), 0)
            else:
                message[signal.name] = unit.fault_bits if name == "fault_bits" else min(self.refused, COUNT_TOP)
        return [self._database.encode(message, bits) for message, bits in raw.items()]
