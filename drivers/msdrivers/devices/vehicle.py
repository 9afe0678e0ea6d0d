"""The vehicle controller on a CAN bus: mapping of status and command, and the driver with limits and a dead-man timer.

A valid command is clamped to the limits (or rejected) and sent to the controller at once and every `command_period`,
for the shortest of its `valid_for`, `max_validity` since its `utime`, and `dead_man` since its arrival. Then the
dead-man timer expires and stop is sent periodically instead. Before the first command nothing is sent, so that a person
can drive. Stop keeps the steering angle: to straighten the wheels of a moving vehicle would swerve it.

A command is rejected if it is not finite, from another source than `commander`, expired, from the future by more than
`clock_slack`, from a second source while another's is active, older than the last one or repeated.

If another node sends the command's identifier, stop is sent once, then nothing, and commands are rejected until that
node has been silent for 2 s: two alternating senders would mix their commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from modelserver.errors import ConfigError, Location, Problem, Severity, quote
from modelserver.messages import NAN, VehicleCommand, VehicleMode, VehicleStatusSample
from msdrivers.devices import Strict, check_choice, check_ranges, check_signal
from msdrivers.devices.can import BoundSignal, BusSettings, CanDatabase, CanDriver, CanFrameSet, SignalBinder, SignalMap
from msdrivers.endpoint import CanFrame, EndpointStatus, FrameKey, HostTime, Output, Send


@dataclass(frozen=True, slots=True)
class StatusMap(Strict):
    """Signals of the vehicle controller's status; omitted ones are published as missing."""

    mode: str = ""
    """Message.Signal of the driving mode; empty: the controller has none."""
    modes: Mapping[str, int] = field(default_factory=dict)
    """The mode signal's number, without the DBC's scale, for each of manual, autonomous, emergency_stop, fault."""
    forward_speed: SignalMap | None = None
    """m/s, forward positive."""
    steering_angle: SignalMap | None = None
    """Radians, to the left positive."""
    supply_voltage: SignalMap | None = None
    """Volts."""
    engine_speed: SignalMap | None = None
    """rad/s; scale 0.10472 for revolutions a minute."""
    fault_bits: str = ""
    """Message.Signal of the controller's fault word, at most 32 bits."""
    commands_rejected: str = ""
    """Message.Signal of the controller's count of rejected commands."""

    def __post_init__(self) -> None:
        for key in ("mode", "fault_bits", "commands_rejected"):
            if getattr(self, key):
                check_signal(getattr(self, key), key)
        known = ("manual", "autonomous", "emergency_stop", "fault")
        for name in self.modes:
            if name not in known:
                raise ValueError(f"modes knows {', '.join(known)}, got {name!r}")
        if bool(self.mode) != bool(self.modes):
            raise ValueError("mode and modes are given together: the signal, and its number for each mode")
        if len(set(self.modes.values())) < len(self.modes):
            raise ValueError("modes has a number of its own for each mode")


@dataclass(frozen=True, slots=True)
class CommandMap(Strict):
    """Signals of a command to the vehicle controller."""

    forward_speed: SignalMap
    """m/s, forward positive, is `scale` times the signal plus `offset`."""
    steering_angle: SignalMap
    """Radians, to the left positive; a signal of the same message."""
    alive: str = ""
    """Message.Signal of the alive counter, which wraps by its bits; empty: none."""
    drive_signals: Mapping[str, float] = field(default_factory=dict)
    """Other signals of the message while driving, by name without the message, in physical units: an enable bit, a
    gear."""
    stop_signals: Mapping[str, float] = field(default_factory=dict)
    """The same in the stop command; omitted ones are as in `drive_signals`."""

    def __post_init__(self) -> None:
        message = self.message
        others = [self.steering_angle.signal, *([self.alive] if self.alive else [])]
        if self.alive:
            check_signal(self.alive, "alive")
        for other in others:
            if other.partition(".")[0] != message:
                raise ValueError(f"a command is one message, {message}; {other} is of another")

    @property
    def message(self) -> str:
        """Name of the message in the DBC file, or its PGN."""
        return self.forward_speed.signal.partition(".")[0]


NUMERIC_FIELDS = ("forward_speed", "steering_angle", "supply_voltage", "engine_speed")
"""Fields of a status that are physical quantities."""


@dataclass(frozen=True, slots=True)
class BoundStatus:
    """Mapping and signals of the status, by field."""

    map: StatusMap
    signals: dict[str, BoundSignal]

    def get_number(self, name: str, instant: CanFrameSet) -> float:
        """Return one of `NUMERIC_FIELDS` in SI units; nan if it is missing."""
        physical = instant.physical(self.signals.get(name))
        mapped: SignalMap | None = getattr(self.map, name)
        return NAN if physical is None or mapped is None else mapped.to_si(physical)


def bind_status(status: StatusMap, database: CanDatabase, place: str) -> BoundStatus:
    """Bind the status mapping. Raises ConfigError with every unknown or unsuitable signal."""
    binder = SignalBinder(database, place)
    numbers = dict.fromkeys(NUMERIC_FIELDS, 0)
    signals = binder.bind_mapped(status, mode=63, fault_bits=32, commands_rejected=63, **numbers)
    binder.finish()
    return BoundStatus(status, signals)


@dataclass(frozen=True, slots=True)
class BoundCommand:
    """Mapping and signals of the command, and the raw values of the other signals of its message."""

    map: CommandMap
    database: CanDatabase
    signals: Mapping[str, BoundSignal]
    drive_bits: Mapping[str, float]
    stop_bits: Mapping[str, float]

    @property
    def key(self) -> FrameKey:
        return self.signals["forward_speed"].key

    @property
    def motion(self) -> tuple[tuple[BoundSignal, SignalMap], tuple[BoundSignal, SignalMap]]:
        """Signal and mapping of the speed, m/s, and of the steering angle, radians."""
        signals = self.signals["forward_speed"], self.signals["steering_angle"]
        return (signals[0], self.map.forward_speed), (signals[1], self.map.steering_angle)

    def make_frame(
        self, forward_speed: float, steering_angle: float, number: int, *, is_stop: bool = False
    ) -> CanFrame:
        """Encode a command, m/s and radians; `number` is the frame count for the alive counter."""
        raw = dict(self.stop_bits if is_stop else self.drive_bits)
        for (signal, mapped), value in zip(self.motion, (forward_speed, steering_angle), strict=True):
            raw[signal.name] = signal.to_bits(mapped.from_si(value))
        if (alive := self.signals.get("alive")) is not None:
            raw[alive.name] = number % (1 << alive.length)
        return self.database.encode(self.signals["forward_speed"].message, raw)

    def find_range_problem(self, forward_speed: float, steering_angle: float) -> str:
        """Describe why the signals cannot represent a speed or an angle; empty if they can."""
        limits = ((forward_speed, "m/s"), (steering_angle, "rad"))
        for (signal, mapped), (value, unit) in zip(self.motion, limits, strict=True):
            held = mapped.to_si(_round_trip(signal, mapped.from_si(value)))
            if abs(held - value) > 1e-9 + abs(mapped.scale * signal.scale):
                return f"{signal.path} holds {held:g} {unit} at most, {value:g} is allowed"
        return ""


def bind_command(command: CommandMap, database: CanDatabase, place: str) -> BoundCommand:
    """Bind the command mapping. Raises ConfigError with every missing, unknown or unsuitable signal."""
    binder = SignalBinder(database, place)
    signals = binder.bind_mapped(command, forward_speed=0, steering_angle=0, alive=64)
    speed, alive = signals.get("forward_speed"), signals.get("alive")
    drive_bits = _bind_constants(binder, command, "drive_signals")
    stop_bits = drive_bits | _bind_constants(binder, command, "stop_signals")
    if speed is not None:
        mapped = command.forward_speed
        held = mapped.to_si(_round_trip(speed, mapped.from_si(0.0)))
        # a stop that would be a motion: 0 rounds to another value, and no other signal means stop
        if abs(held) > 1e-9 and drive_bits == stop_bits:
            text = f"{speed.path} cannot represent 0: stop would be sent as {held:g} m/s"
            fix = "set a signal in `stop_signals` that differs from `drive_signals`, or correct scale and offset"
            binder.add_problem("forward_speed", text, fix)
    if alive is not None and alive.is_signed:
        binder.add_problem("alive", f"{command.alive} is signed; a counter of frames is not", "map the counter")
    message = command.message if speed is None else speed.message
    if message in database.messages:
        bound = {signal.name for signal in signals.values()} | drive_bits.keys()
        for name in database.bind_signals(message).keys() - bound:
            fix = f"add {name}: 0, or what the controller expects there"
            binder.add_problem("drive_signals", f"{message}.{name} is given no value, and the frame needs one", fix)
    binder.finish()
    return BoundCommand(command, database, signals, drive_bits, stop_bits)


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


@dataclass(frozen=True, slots=True)
class CommandLimits(Strict):
    """Limits of commands; 0 forbids the motion."""

    forward_speed: float = 2.0
    """Highest speed forward, m/s."""
    reverse_speed: float = 1.0
    """Highest speed backward, m/s, as a positive number."""
    steering_angle: float = 0.5
    """Greatest steering angle to either side, radians."""
    over_limit: Literal["clamp", "reject"] = "clamp"
    """What happens to a command above a limit: clamp it, or reject it."""

    def __post_init__(self) -> None:
        check_ranges(self, forward_speed=(0.0, 100.0), reverse_speed=(0.0, 100.0), steering_angle=(0.0, 1.6))
        check_choice(self, over_limit=("clamp", "reject"))


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleSettings(BusSettings):
    """Settings of the vehicle controller. Raises ValueError with the key for an invalid value."""

    status: StatusMap | None = None
    """Signals of the status; None: nothing is published."""
    command: CommandMap | None = None
    """Signals of the command; None: the vehicle is not commanded."""
    limits: CommandLimits = CommandLimits()
    """Limits of commands."""
    commander: str = ""
    """The only source whose commands are accepted; empty: any, but one at a time."""
    dead_man: float = 0.5
    """Dead-man timeout: seconds after its arrival until a command expires and stop is sent."""
    max_validity: float = 1.0
    """Longest validity of a command after its `utime`, whatever its `valid_for`, seconds."""
    command_period: float = 0.05
    """Period of the frames of a command, or of the stop after it, seconds."""
    clock_slack: float = 0.2
    """Seconds by which the clock of a command's source may be ahead of ours."""

    def __post_init__(self) -> None:
        BusSettings.__post_init__(self)
        if self.status is None and self.command is None:
            raise ValueError("status or command is needed: without both there is nothing to do")
        check_ranges(self, dead_man=(0.05, 5.0), max_validity=(0.05, 60.0))
        check_ranges(self, command_period=(0.005, 1.0), clock_slack=(0.0, 5.0))
        if self.max_validity < self.dead_man:
            raise ValueError(
                f"max_validity is at least dead_man, {self.dead_man:g}, got {self.max_validity:g}: a command would end "
                "before it"
            )
        if self.command_period > self.dead_man:
            raise ValueError(
                f"command_period is at most dead_man, {self.dead_man:g}, got {self.command_period:g}: the controller "
                "would stop between two frames"
            )


_WARNING_INTERVAL_NS = 10_000_000_000
"""Rate limit of equal warnings."""

_FOREIGN_HOLDOFF_NS = 2_000_000_000
"""How long commands are rejected after another node's command."""


class _ActiveCommand(NamedTuple):
    """The active command and the deadline of its dead-man timer, monotonic nanoseconds."""

    command: VehicleCommand
    until_ns: int


class VehicleDriver(CanDriver):
    """An `Endpoint` of CAN frames that also accepts commands; see `VehicleSettings`.

    A status is published if its fault word and its count of rejections were received or are not mapped; missing
    numbers are nan. `commands_rejected` counts the rejections of the controller and of this driver.
    """

    settings: VehicleSettings

    def __init__(self, settings: VehicleSettings, database: CanDatabase):
        """Bind the signals of status and command. Raises ConfigError for unknown or unsuitable ones."""
        place = f"drivers.{settings.source}"
        self._status = bind_status(settings.status, database, f"{place}.status") if settings.status else None
        signals = self._status.signals if self._status is not None else {}
        super().__init__(database, signals.values(), settings)
        self._has_status_words = "fault_bits" in signals or "commands_rejected" in signals
        self._mode: VehicleMode | None = None
        self._signals: BoundCommand | None = None
        self._command_key: FrameKey | None = None
        self._period_ns = round(settings.command_period * 1e9)
        self._active: _ActiveCommand | None = None
        self._last: VehicleCommand | None = None
        self._is_transmitting = False
        self._next_ns = self._frame_count = self._rejected = 0
        self._angle = 0.0
        self._holdoff_until_ns: int | None = None
        self._warned_until_ns: dict[str, int] = {}
        if settings.command is None:
            return
        limits = settings.limits
        self._signals = bind_command(settings.command, database, f"{place}.command")
        self._command_key = self._signals.key
        problem = self._signals.find_range_problem(limits.forward_speed, limits.steering_angle)
        problem = problem or self._signals.find_range_problem(-limits.reverse_speed, -limits.steering_angle)
        if problem:
            location = Location(database.name, 0, f"{place}.limits")
            raise ConfigError([Problem(Severity.ERROR, problem, location, "lower the limit")])

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Start; discard the active command and send stop instead: no command survives a reconnect."""
        outputs = super().on_open(now)
        self._active, self._mode = None, None
        return [*outputs, self._make_frame(now)] if self._is_transmitting else outputs

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        """Process a received frame; one with the command's identifier is from another node."""
        if unit.key == self._command_key and not unit.is_error:
            return self._on_foreign_command(now)
        return super().on_receive(unit, now)

    def on_command(self, command: VehicleCommand, now: HostTime) -> list[Output[CanFrame]]:
        """Send a command periodically from now on, or reject it."""
        if self._signals is None:
            self.counts["rejected.no_command_mapping"] += 1
            return []
        remaining = min(command.valid_for, self.settings.max_validity) - (now.utime - command.utime) * 1e-6
        reason, why = self._find_reject_reason(command, remaining, now)
        limited, beyond = self._clamp(command)
        if not reason and beyond and self.settings.limits.over_limit == "reject":
            reason, why = "limit", beyond
        if reason:
            return self.reject_command(reason, f"command of {quote(command.source, 40)} rejected: {why}", now)
        outputs: list[Output[CanFrame]] = []
        if beyond:
            self.counts["clamped"] += 1
            outputs += self._warn("clamp", f"{beyond}; the limit is commanded", now)
        self.counts["commands"] += 1
        self._last = command
        self._active = _ActiveCommand(limited, now.monotonic_ns + round(min(remaining, self.settings.dead_man) * 1e9))
        self._is_transmitting = True
        self._angle = limited.steering_angle
        return [*outputs, self._make_frame(now)]

    def reject_command(self, reason: str, text: str, now: HostTime) -> list[Output[CanFrame]]:
        """Count a rejected command under `reason` and warn with `text`."""
        if self._signals is None:
            return []
        self._rejected += 1
        self.counts[f"rejected.{reason}"] += 1
        return self._warn(reason, text, now)

    def _on_foreign_command(self, now: HostTime) -> list[Output[CanFrame]]:
        """Stop and stay silent: another node sent a frame with the command's identifier."""
        assert self._signals is not None
        self.counts["foreign_commands"] += 1
        self._holdoff_until_ns = now.monotonic_ns + _FOREIGN_HOLDOFF_NS
        outputs = self._warn(
            "foreign",
            f"another node commands the vehicle too: it sends {self._signals.map.message}; no command is sent from "
            "here while it does. Is a second driver running, or another program?",
            now,
        )
        if self._is_transmitting:
            self._active, self._is_transmitting = None, False
            outputs += [] if self.is_bus_off else [self._make_frame(now)]
        return outputs

    def on_timer(self, now: HostTime) -> list[Output[CanFrame]]:
        """Publish what is due; send the command again, or stop if its dead-man timer has expired."""
        outputs = super().on_timer(now)
        if self.is_bus_off:
            return outputs
        if self._active is not None and now.monotonic_ns >= self._active.until_ns:
            ended, self._active = self._active, None
            self.counts["dead_man"] += 1
            source = quote(ended.command.source, 40)
            outputs.append(EndpointStatus(self.phase, f"no command after number {ended.command.seq} of {source}: stop"))
            outputs.append(self._make_frame(now))
        elif self._is_transmitting and now.monotonic_ns >= self._next_ns:
            outputs.append(self._make_frame(now))
        return outputs

    def get_deadline(self) -> int | None:
        is_sending = self._is_transmitting and not self.is_bus_off
        deadlines = (super().get_deadline(), self._next_ns if is_sending else None)
        until_ns = self._active.until_ns if self._active is not None and is_sending else None
        return min((each for each in (*deadlines, until_ns) if each is not None), default=None)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        """Stop the vehicle if it was commanded from here."""
        self._active = None
        return [self._make_frame(now)] if self._is_transmitting and not self.is_bus_off else []

    def _find_reject_reason(self, command: VehicleCommand, remaining: float, now: HostTime) -> tuple[str, str]:
        """Return why a command is rejected, as counter name and text; empty if it is valid."""
        settings = self.settings
        numbers = (command.forward_speed, command.steering_angle, command.valid_for)
        if not all(map(math.isfinite, numbers)):
            return "malformed", "it has a number that is not finite"
        if settings.commander and command.source != settings.commander:
            return "source", f"only {quote(settings.commander, 40)} commands; see `commander`"
        if remaining <= 0.0:
            return "expired", f"it expired {-remaining:.3f} s ago; is its clock behind ours, or the network slow?"
        if command.utime - now.utime > settings.clock_slack * 1e6:
            ahead = (command.utime - now.utime) * 1e-6
            return "future", f"its time is {ahead:.3f} s in the future; its clock is ahead of ours"
        reason, why = self._check_against_last(command, now)
        if not reason and self._holdoff_until_ns is not None and now.monotonic_ns < self._holdoff_until_ns:
            return "foreign", "another node commands the vehicle on the bus"
        if not reason and self.is_bus_off:
            return "bus_off", "the CAN interface is bus-off; nothing can be sent"
        return reason, why

    def _check_against_last(self, command: VehicleCommand, now: HostTime) -> tuple[str, str]:
        last = self._last
        is_active = self._active is not None and self._active.until_ns > now.monotonic_ns
        if last is None:
            return "", ""
        if is_active and command.source != last.source:
            return "source", f"{quote(last.source, 40)} commands the vehicle now; one source at a time"
        if last.utime - now.utime > self.settings.clock_slack * 1e6:
            # the clock was set back since: older stamps cannot be compared
            return "", ""
        is_next = command.source == last.source and command.seq > last.seq
        if command.utime < last.utime or (command.utime == last.utime and not is_next):
            age = (last.utime - command.utime) * 1e-6
            return "stale", f"it is not newer than the last accepted one, whose time is {age:.3f} s later"
        # a restarted commander restarts its numbers: accepted once the active command has expired
        if is_active and not is_next:
            return "stale", f"its number {command.seq} is not above the last, {last.seq}"
        return "", ""

    def _clamp(self, command: VehicleCommand) -> tuple[VehicleCommand, str]:
        """Clamp a command to the limits; return it and a text about the limits that were exceeded."""
        limits = self.settings.limits
        speed = min(max(command.forward_speed, -limits.reverse_speed), limits.forward_speed)
        angle = min(max(command.steering_angle, -limits.steering_angle), limits.steering_angle)
        exceeded = []
        if speed != command.forward_speed:
            allowed = f"{-limits.reverse_speed:g} to {limits.forward_speed:g} m/s"
            exceeded.append(f"forward_speed {command.forward_speed:g} m/s is outside {allowed}")
        if angle != command.steering_angle:
            exceeded.append(f"steering_angle {command.steering_angle:g} rad exceeds {limits.steering_angle:g}")
        return replace(command, forward_speed=speed, steering_angle=angle), " and ".join(exceeded)

    def _make_frame(self, now: HostTime) -> Send[CanFrame]:
        assert self._signals is not None
        is_stop = self._active is None
        self.counts["stops_sent"] += is_stop
        speed = 0.0 if self._active is None else self._active.command.forward_speed
        frame = self._signals.make_frame(speed, self._angle, self._frame_count, is_stop=is_stop)
        self._frame_count += 1
        self._next_ns = now.monotonic_ns + self._period_ns
        return Send(frame)

    def _warn(self, reason: str, text: str, now: HostTime) -> list[Output[CanFrame]]:
        if now.monotonic_ns < self._warned_until_ns.get(reason, now.monotonic_ns):
            return []
        self._warned_until_ns[reason] = now.monotonic_ns + _WARNING_INTERVAL_NS
        return [EndpointStatus(self.phase, text, is_warning=True)]

    def _publish_instant(self, instant: CanFrameSet, now: HostTime) -> list[Output[CanFrame]]:
        status = self._status
        assert status is not None
        outputs = self._check_values((status.signals.get(name) for name in NUMERIC_FIELDS), instant)
        raw = {name: instant.raw(signal) for name, signal in status.signals.items()}
        # 0 if not mapped, None if not received
        faults, rejected = raw.get("fault_bits", 0), raw.get("commands_rejected", 0)
        if faults is None or rejected is None:
            # these have no number for "missing"
            self.counts["rejected.incomplete"] += 1
            self._note_useless("without fault_bits or commands_rejected")
            return outputs
        numbers = {name: status.get_number(name, instant) for name in NUMERIC_FIELDS}
        known = (VehicleMode[name.upper()] for name, number in status.map.modes.items() if number == raw.get("mode"))
        mode = next(known, VehicleMode.UNKNOWN)
        is_known = mode is not VehicleMode.UNKNOWN or any(value == value for value in numbers.values())
        if not is_known and not self._has_status_words:
            self._note_empty()
            return outputs
        # the highest of the 32 bits is the sign on the wire
        faults = (int(faults) + (1 << 31)) % (1 << 32) - (1 << 31)
        rejected = max(0, int(rejected) + self._rejected)
        header = self._make_header(instant)
        sample = VehicleStatusSample(header, mode, **numbers, fault_bits=faults, commands_rejected=rejected)
        outputs += self._publish_sample(sample, f"the vehicle controller sends its status; {_MODE_TEXTS[mode]}", now)
        if self._mode not in (None, mode):
            outputs.append(EndpointStatus(self.phase, _MODE_TEXTS[mode]))
        self._mode = mode
        return outputs


_MODE_TEXTS = {
    VehicleMode.UNKNOWN: "its driving mode is unknown",
    VehicleMode.MANUAL: "a person drives: commands have no effect",
    VehicleMode.AUTONOMOUS: "it takes commands",
    VehicleMode.EMERGENCY_STOP: "emergency stop: commands have no effect until it is released",
    VehicleMode.FAULT: "it has a fault and takes no commands: see fault_bits and its manual",
}
