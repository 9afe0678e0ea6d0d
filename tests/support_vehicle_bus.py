"""A driver and an emulated device on one line, with scripted instants, no clocks and no ports; the Raptor's maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from modelserver.messages import Direction, JointsSample, SensorHeader, VehicleStatusSample, WheelSample, WheelsSample
from msdrivers.devices.axis import AxisRegisters, AxisSettings, NodSettings, RegisterMap
from msdrivers.devices.can import CanDatabase, SignalMap, parse_dbc
from msdrivers.devices.vehicle import CommandLimits, CommandMap, StatusMap, VehicleSettings
from msdrivers.devices.wheels import CountMap, DirectionMap, SpeedMap, WheelMap, WheelsSettings
from msdrivers.endpoint import Endpoint, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send

START_UTIME = 1_750_000_000_000_000
START_NS = 5_000_000_000
DBC = Path(__file__).parents[1] / "config" / "raptor" / "raptor.dbc"
METERS_PER_COUNT = 0.0125
DEG = math.pi / 180.0

U = TypeVar("U")


def at(seconds: float) -> HostTime:
    """Return the instant `seconds` after the start."""
    return HostTime(START_NS + round(seconds * 1e9), START_UTIME + round(seconds * 1e6))


def raptor_dbc() -> CanDatabase:
    return parse_dbc(DBC.read_text(encoding="utf-8"), "raptor.dbc")


def wheel(side: str, **changes: object) -> WheelMap:
    parts = {
        "count": CountMap(f"WheelCounts.Front{side}Count", METERS_PER_COUNT),
        "speed": SpeedMap(f"WheelSpeeds.Front{side}Speed", is_magnitude=True, sigma=0.05),
        "direction": DirectionMap(f"WheelCounts.Front{side}Direction"),
        "is_steered": True,
    }
    return WheelMap(**{**parts, **changes})  # type: ignore[arg-type]


def wheels_settings(**changes: object) -> WheelsSettings:
    both = {"front_left": wheel("Left"), "front_right": wheel("Right")}
    values = {"source": "wheels", "dbc": "raptor.dbc", "wheels": both, "max_speed": 8.0}
    return WheelsSettings(**{**values, **changes})  # type: ignore[arg-type]


RAPTOR_STATUS = StatusMap(
    mode="VehicleStatus.Mode",
    modes={"manual": 1, "autonomous": 2, "emergency_stop": 3, "fault": 4},
    forward_speed=SignalMap("VehicleStatus.ForwardSpeed"),
    steering_angle=SignalMap("VehicleStatus.SteeringAngle", DEG),
    supply_voltage=SignalMap("VehiclePower.SupplyVoltage"),
    engine_speed=SignalMap("VehiclePower.EngineSpeed", math.pi / 30.0),
    fault_bits="VehicleStatus.FaultBits",
    commands_rejected="VehicleStatus.CommandsRefused",
)
RAPTOR_COMMAND = CommandMap(
    forward_speed=SignalMap("VehicleCommand.ForwardSpeed"),
    steering_angle=SignalMap("VehicleCommand.SteeringAngle", DEG),
    alive="VehicleCommand.Alive",
    drive_signals={"Enable": 1},
    stop_signals={"Enable": 0},
)


def vehicle_settings(**changes: object) -> VehicleSettings:
    values = {
        "source": "raptor",
        "dbc": "raptor.dbc",
        "status": RAPTOR_STATUS,
        "command": RAPTOR_COMMAND,
        "limits": CommandLimits(forward_speed=3.0, reverse_speed=1.0, steering_angle=0.5),
    }
    return VehicleSettings(**{**values, **changes})  # type: ignore[arg-type]


AXIS_REGISTERS = AxisRegisters(
    angle=RegisterMap(0, 2, scale_deg=0.072),
    rate=RegisterMap(2, scale_deg=0.01),
    sequence=RegisterMap(3, is_signed=False),
    lower_limit=RegisterMap(16, 2, scale_deg=0.072),
    upper_limit=RegisterMap(18, 2, scale_deg=0.072),
    nod_rate=RegisterMap(20, is_signed=False, scale_deg=0.01),
)


def axis_settings(**changes: object) -> AxisSettings:
    values = {
        "source": "front_axis",
        "joint": "FrontNodding",
        "registers": AXIS_REGISTERS,
        "nod": NodSettings(-30.24, 20.16, 45.0),
    }
    return AxisSettings(**{**values, **changes})  # type: ignore[arg-type]


def rolling_samples(
    seconds: float, speed: Callable[[float], float], hz: float = 100.0, names: tuple[str, ...] = ("front_left",)
) -> Iterator[WheelsSample]:
    """Yield samples of wheels that all roll at `speed(t)`, m/s; travel is its integral."""
    travel = 0.0
    for k in range(round(seconds * hz) + 1):
        t = k / hz
        now = speed(t)
        if k:
            travel += speed(t - 0.5 / hz) / hz
        turning = Direction.STOPPED if now == 0.0 else Direction.FORWARD if now > 0.0 else Direction.BACKWARD
        yield WheelsSample(
            SensorHeader(START_UTIME + round(t * 1e6), "truth", k),
            tuple(WheelSample(name, travel, 0.0, now, 0.0, turning) for name in names),
        )


@dataclass
class Wire(Generic[U]):
    """Carries units between a host's and a device's station; each takes `flight_s`. A line that breaks is reopened
    after `reopen_s`. `spoil` may change, drop or add to what comes to the host."""

    host: Endpoint[U]
    device: Endpoint[U]
    flight_s: float = 0.001
    reopen_s: float = 0.1
    corrupt: Callable[[U, float], list[U]] = lambda unit, t: [unit]
    t: float = 0.0
    samples: list[tuple[float, MeasuredSample]] = field(default_factory=list)
    statuses: list[tuple[float, EndpointStatus]] = field(default_factory=list)
    reopens: list[tuple[float, Reopen]] = field(default_factory=list)
    to_host: list[tuple[float, U]] = field(default_factory=list)
    to_device: list[tuple[float, U]] = field(default_factory=list)
    sent: list[tuple[float, U]] = field(default_factory=list)
    _open_at: float | None = 0.0
    _is_started: bool = False

    def run(self, until: float) -> Wire[U]:
        """Carry on until an instant, in seconds after the start."""
        if not self._is_started:
            self._is_started = True
            self._from_device(self.device.on_open(at(self.t)))
        while True:
            nexts = [each[0] for each in (self.to_host[:1] + self.to_device[:1])]
            if self._open_at is not None:
                nexts.append(self._open_at)
            for station, is_open in ((self.host, self._open_at is None), (self.device, True)):
                due = station.get_deadline()
                if due is not None and is_open:
                    nexts.append(max(self.t, (due - START_NS) * 1e-9))
            if not nexts or min(nexts) > until:
                self.t = until
                return self
            self.t = min(nexts)
            self._step()

    def send_command(self, ask: Callable[[HostTime], list[Output[U]]]) -> None:
        """Execute the host's outputs for a command."""
        self._from_host(ask(at(self.t)))

    def values(self, begin: float = 0.0) -> list[WheelsSample | VehicleStatusSample | JointsSample]:
        """Return the samples since an instant."""
        return [each.sample for t, each in self.samples if t >= begin]  # type: ignore[misc]

    def status_text(self) -> str:
        return "\n".join(f"{status.phase.name.lower()}: {status.text}" for _, status in self.statuses)

    def _step(self) -> None:
        now = at(self.t)
        if self._open_at is not None and self._open_at <= self.t:
            self._open_at = None
            self._from_host(self.host.on_open(now))
        while self.to_host and self.to_host[0][0] <= self.t:
            _, unit = self.to_host.pop(0)
            for each in self.corrupt(unit, self.t) if self._open_at is None else []:
                self._from_host(self.host.on_receive(each, now))
        while self.to_device and self.to_device[0][0] <= self.t:
            _, unit = self.to_device.pop(0)
            self._from_device(self.device.on_receive(unit, now))
        due = self.host.get_deadline()
        if due is not None and self._open_at is None and due <= now.monotonic_ns:
            self._from_host(self.host.on_timer(now))
        due = self.device.get_deadline()
        if due is not None and due <= now.monotonic_ns:
            self._from_device(self.device.on_timer(now))

    def _from_host(self, outputs: object) -> None:
        for output in outputs:  # type: ignore[attr-defined]
            if isinstance(output, Send):
                self.sent.append((self.t, output.unit))
                self.to_device.append((self.t + self.flight_s, output.unit))
            elif isinstance(output, MeasuredSample):
                self.samples.append((self.t, output))
            elif isinstance(output, EndpointStatus):
                self.statuses.append((self.t, output))
            elif isinstance(output, Reopen):
                self.reopens.append((self.t, output))
                self._open_at = self.t + self.reopen_s
                self.to_host.clear()
                return

    def _from_device(self, outputs: object) -> None:
        for output in outputs:  # type: ignore[attr-defined]
            if isinstance(output, Send):
                self.to_host.append((self.t + self.flight_s, output.unit))
