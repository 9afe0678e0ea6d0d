"""The vehicle controller's status and command: the mapping bound to the signals of a DBC file."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.messages import NAN, VehicleMode
from msdrivers.protocol.can.database import BoundSignal, CanDatabase, CanFrameSet, SignalBinder
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import CommandMap, SignalMap, StatusMap

NUMERIC_FIELDS = ("forward_speed", "steering_angle", "supply_voltage", "engine_speed")
"""Fields of a status that are physical quantities."""


@dataclass(frozen=True, slots=True)
class BoundStatus:
    """Mapping and signals of the status, by field."""

    map: StatusMap
    signals: dict[str, BoundSignal]

    def get_mode(self, instant: CanFrameSet) -> VehicleMode:
        """Return the driving mode; UNKNOWN if it is missing or its number is not mapped."""
        raw = instant.raw(self.signals.get("mode"))
        numbers = {number: VehicleMode[name.upper()] for name, number in self.map.modes.items()}
        return VehicleMode.UNKNOWN if raw is None else numbers.get(int(raw), VehicleMode.UNKNOWN)

    def get_number(self, name: str, instant: CanFrameSet) -> float:
        """Return one of `NUMERIC_FIELDS` in SI units; nan if it is missing."""
        physical = instant.physical(self.signals.get(name))
        mapped: SignalMap | None = getattr(self.map, name)
        return NAN if physical is None or mapped is None else mapped.to_si(physical)

    def get_word(self, name: str, instant: CanFrameSet) -> int | None:
        """Return `fault_bits` or `commands_rejected`: 0 if not mapped, None if not received."""
        if name not in self.signals:
            return 0
        raw = instant.raw(self.signals[name])
        return None if raw is None else int(raw)


def bind_status(status: StatusMap, database: CanDatabase, place: str) -> BoundStatus:
    """Bind the status mapping. Raises ConfigError with every unknown or unsuitable signal."""
    binder = SignalBinder(database, place)
    signals: dict[str, BoundSignal] = {}
    for name in ("mode", "fault_bits", "commands_rejected"):
        path = getattr(status, name)
        found = binder.bind_signal(path, name, whole=True, bits=32 if name == "fault_bits" else 63) if path else None
        if found is not None:
            signals[name] = found
    for name in NUMERIC_FIELDS:
        mapped: SignalMap | None = getattr(status, name)
        found = binder.bind_signal(mapped.signal, name) if mapped is not None else None
        if found is not None:
            signals[name] = found
    binder.finish()
    return BoundStatus(status, signals)


@dataclass(frozen=True, slots=True)
class BoundCommand:
    """Mapping and signals of the command, and the raw values of the other signals of its message."""

    map: CommandMap
    database: CanDatabase
    forward_speed: BoundSignal
    steering_angle: BoundSignal
    alive: BoundSignal | None
    drive_bits: dict[str, float]
    stop_bits: dict[str, float]

    def make_frame(
        self, forward_speed: float, steering_angle: float, number: int, *, is_stop: bool = False
    ) -> CanFrame:
        """Encode a command, m/s and radians; `number` is the frame count for the alive counter."""
        raw = dict(self.stop_bits if is_stop else self.drive_bits)
        raw[self.forward_speed.name] = self.forward_speed.to_bits(self.map.forward_speed.from_si(forward_speed))
        raw[self.steering_angle.name] = self.steering_angle.to_bits(self.map.steering_angle.from_si(steering_angle))
        if self.alive is not None:
            raw[self.alive.name] = number % (1 << self.alive.length)
        return self.database.encode(self.map.message, raw)

    def find_range_problem(self, forward_speed: float, steering_angle: float) -> str:
        """Describe why the signals cannot represent a speed or an angle; empty if they can."""
        for signal, mapped, value, unit in (
            (self.forward_speed, self.map.forward_speed, forward_speed, "m/s"),
            (self.steering_angle, self.map.steering_angle, steering_angle, "rad"),
        ):
            held = mapped.to_si(_round_trip(signal, mapped.from_si(value)))
            if abs(held - value) > 1e-9 + abs(mapped.scale * signal.scale):
                return f"{signal.message}.{signal.name} holds {held:g} {unit} at most, {value:g} is allowed"
        return ""


def bind_command(command: CommandMap, database: CanDatabase, place: str) -> BoundCommand:
    """Bind the command mapping. Raises ConfigError with every missing, unknown or unsuitable signal."""
    binder = SignalBinder(database, place)
    speed = binder.bind_signal(command.forward_speed.signal, "forward_speed")
    steering = binder.bind_signal(command.steering_angle.signal, "steering_angle")
    alive = binder.bind_signal(command.alive, "alive", whole=True) if command.alive else None
    drive_bits = _bind_constants(binder, command, "drive_signals")
    stop_bits = drive_bits | _bind_constants(binder, command, "stop_signals")
    if speed is not None:
        mapped = command.forward_speed
        held = mapped.to_si(_round_trip(speed, mapped.from_si(0.0)))
        # a stop that would be a motion: 0 rounds to another value, and no other signal means stop
        if abs(held) > 1e-9 and drive_bits == stop_bits:
            text = f"{speed.message}.{speed.name} cannot represent 0: stop would be sent as {held:g} m/s"
            fix = "set a signal in `stop_signals` that differs from `drive_signals`, or correct scale and offset"
            binder.add_problem("forward_speed", text, fix)
    if alive is not None and alive.is_signed:
        binder.add_problem("alive", f"{command.alive} is signed; a counter of frames is not", "map the counter")
    if command.message in database.messages:
        bound = {signal.name for signal in (speed, steering, alive) if signal is not None} | drive_bits.keys()
        for name in database.bind_signals(command.message).keys() - bound:
            fix = f"add {name}: 0, or what the controller expects there"
            binder.add_problem(
                "drive_signals", f"{command.message}.{name} is given no value, and the frame needs one", fix
            )
    binder.finish()
    assert speed is not None
    assert steering is not None
    return BoundCommand(command, database, speed, steering, alive, drive_bits, stop_bits)


def _bind_constants(binder: SignalBinder, command: CommandMap, key: str) -> dict[str, float]:
    given = {}
    for name, value in getattr(command, key).items():
        signal = binder.bind_signal(f"{command.message}.{name}", f"{key}.{name}")
        if signal is None:
            continue
        given[name] = signal.to_bits(value)
        if abs(_round_trip(signal, value) - value) > 1e-9 + 0.5 * abs(signal.scale):
            fix = f"{_round_trip(signal, value):g} is the nearest that it holds"
            binder.add_problem(f"{key}.{name}", f"{command.message}.{name} cannot hold {value:g}", fix)
    return given


def _round_trip(signal: BoundSignal, physical: float) -> float:
    return physical if signal.is_float else signal.to_raw(physical) * signal.scale + signal.offset
