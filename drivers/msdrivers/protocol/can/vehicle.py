"""The vehicle controller's status and command as the mapping has them, bound to the signals of a DBC file."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.messages import NAN, VehicleMode
from msdrivers.protocol.can.assembly import CanFrameSet
from msdrivers.protocol.can.database import Binder, BoundSignal, CanDatabase
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import CommandMap, SignalMap, StatusMap

NUMBERS = ("forward_speed", "steering_angle", "supply_voltage", "engine_speed")
"""What of a status is a number with a unit."""


@dataclass(frozen=True, slots=True)
class BoundStatus:
    """The status: its mapping and its signals by the name of the value."""

    map: StatusMap
    signals: dict[str, BoundSignal]

    def mode(self, instant: CanFrameSet) -> VehicleMode:
        """Return who drives; UNKNOWN where it is not said, or with a number that the mapping does not have."""
        raw = instant.raw(self.signals.get("mode"))
        numbers = {number: VehicleMode[name.upper()] for name, number in self.map.modes.items()}
        return VehicleMode.UNKNOWN if raw is None else numbers.get(int(raw), VehicleMode.UNKNOWN)

    def number(self, name: str, instant: CanFrameSet) -> float:
        """Return one of `NUMBERS`, in SI units; nan where it is not said."""
        physical = instant.physical(self.signals.get(name))
        mapped: SignalMap | None = getattr(self.map, name)
        return NAN if physical is None or mapped is None else physical * mapped.scale + mapped.offset

    def word(self, name: str, instant: CanFrameSet) -> int | None:
        """Return `fault_bits` or `commands_refused`: 0 where the controller has none, None where it did not come."""
        if name not in self.signals:
            return 0
        raw = instant.raw(self.signals[name])
        return None if raw is None else int(raw)


def bind_status(status: StatusMap, database: CanDatabase, place: str) -> BoundStatus:
    """Return the status with its signals. Raises ConfigError with every signal that is not in the DBC or unfit."""
    binder = Binder(database, place)
    signals: dict[str, BoundSignal] = {}
    for name in ("mode", "fault_bits", "commands_refused"):
        path = getattr(status, name)
        found = binder.signal(path, name, whole=True, bits=32 if name == "fault_bits" else 63) if path else None
        if found is not None:
            signals[name] = found
    for name in NUMBERS:
        mapped: SignalMap | None = getattr(status, name)
        found = binder.signal(mapped.signal, name) if mapped is not None else None
        if found is not None:
            signals[name] = found
    binder.finish()
    return BoundStatus(status, signals)


@dataclass(frozen=True, slots=True)
class BoundCommand:
    """The command: its mapping, its message and signals, and what stands beside them, as bits."""

    map: CommandMap
    database: CanDatabase
    forward_speed: BoundSignal
    steering_angle: BoundSignal
    alive: BoundSignal | None
    driving: dict[str, float]
    stopping: dict[str, float]

    def frame(self, forward_speed: float, steering_angle: float, number: int, *, is_stop: bool = False) -> CanFrame:
        """Return the frame of a command, m/s and radians; `number` counts the frames."""
        raw = dict(self.stopping if is_stop else self.driving)
        for signal, mapped, value in (
            (self.forward_speed, self.map.forward_speed, forward_speed),
            (self.steering_angle, self.map.steering_angle, steering_angle),
        ):
            physical = (value - mapped.offset) / mapped.scale
            raw[signal.name] = signal.bits(physical)
        if self.alive is not None:
            raw[self.alive.name] = number % (1 << self.alive.length)
        return self.database.encode(self.map.message, raw)

    def beyond(self, forward_speed: float, steering_angle: float) -> str:
        """Return what the signals cannot hold of a speed and an angle; empty where they can."""
        for signal, mapped, value, unit in (
            (self.forward_speed, self.map.forward_speed, forward_speed, "m/s"),
            (self.steering_angle, self.map.steering_angle, steering_angle, "rad"),
        ):
            held = _held(signal, (value - mapped.offset) / mapped.scale) * mapped.scale + mapped.offset
            if abs(held - value) > 1e-9 + abs(mapped.scale * signal.scale):
                return f"{signal.message}.{signal.name} holds {held:g} {unit} at most, {value:g} is allowed"
        return ""


def bind_command(command: CommandMap, database: CanDatabase, place: str) -> BoundCommand:
    """Return the command with its signals. Raises ConfigError with every signal that is missing, unknown or unfit."""
    binder = Binder(database, place)
    speed = binder.signal(command.forward_speed.signal, "forward_speed")
    steering = binder.signal(command.steering_angle.signal, "steering_angle")
    alive = binder.signal(command.alive, "alive", whole=True) if command.alive else None
    driving = _beside(binder, command, "driving")
    stopping = driving | _beside(binder, command, "stopping")
    if speed is not None:
        _check_stop(binder, command, speed, driving != stopping)
    if alive is not None and alive.is_signed:
        binder.problem("alive", f"{command.alive} is signed; a counter of frames is not", "map the counter")
    if command.message in database.messages:
        told = {signal.name for signal in (speed, steering, alive) if signal is not None} | driving.keys()
        for name in database.signals(command.message).keys() - told:
            fix = f"add {name}: 0, or what the controller expects there"
            binder.problem("driving", f"{command.message}.{name} is given no value, and the frame needs one", fix)
    binder.finish()
    assert speed is not None
    assert steering is not None
    return BoundCommand(command, database, speed, steering, alive, driving, stopping)


def _check_stop(binder: Binder, command: CommandMap, speed: BoundSignal, has_stop: bool) -> None:
    """Note a stop that would be a motion: its speed of 0 rounds to another, and nothing beside it says stop."""
    mapped = command.forward_speed
    held = _held(speed, -mapped.offset / mapped.scale) * mapped.scale + mapped.offset
    if abs(held) > 1e-9 and not has_stop:
        path = f"{speed.message}.{speed.name}"
        fix = "give a signal that stops it another value in `stopping` than in `driving`, or correct scale and offset"
        binder.problem("forward_speed", f"{path} cannot say 0: stop would be said as {held:g} m/s", fix)


def _beside(binder: Binder, command: CommandMap, key: str) -> dict[str, float]:
    given = {}
    for name, value in getattr(command, key).items():
        signal = binder.signal(f"{command.message}.{name}", f"{key}.{name}")
        if signal is None:
            continue
        given[name] = signal.bits(value)
        if abs(_held(signal, value) - value) > 1e-9 + 0.5 * abs(signal.scale):
            fix = f"{_held(signal, value):g} is the nearest that it holds"
            binder.problem(f"{key}.{name}", f"{command.message}.{name} cannot hold {value:g}", fix)
    return given


def _held(signal: BoundSignal, physical: float) -> float:
    return physical if signal.is_float else signal.raw(physical) * signal.scale + signal.offset
