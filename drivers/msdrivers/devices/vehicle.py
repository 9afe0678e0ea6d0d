"""The driver of the vehicle controller on a CAN bus: its status out, commands in, with limits and a dead-man."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

from modelserver.errors import ConfigError, Location, Problem, Severity
from modelserver.messages import SensorHeader, VehicleCommand, VehicleMode, VehicleStatusSample
from msdrivers.devices.can_watch import CanWatch, arrival
from msdrivers.devices.commanding import Commanding
from msdrivers.devices.vehicle_settings import VehicleSettings
from msdrivers.protocol.can.assembly import CanFrameAssembler, CanFrameSet
from msdrivers.protocol.can.database import CanDatabase, FrameError
from msdrivers.protocol.can.frame import CanFrame, FrameKey
from msdrivers.protocol.can.vehicle import NUMBERS, bind_command, bind_status
from msdrivers.station import Measured, Now, Output, StationStatus


class VehicleDriver:
    """A `Station` of CAN frames that takes commands too; see `VehicleSettings`.

    A status is published where both its words, faults and refusals, came, or the controller has none; numbers that did
    not come are nan. `commands_refused` counts what the controller refused and what this driver did not let through.
    """

    def __init__(self, settings: VehicleSettings, database: CanDatabase):
        """Take the settings and the DBC file's content. Raises ConfigError for signals that it does not have."""
        self.settings = settings
        self._database = database
        self._counts: Counter[str] = Counter()
        self._status = None
        needed: dict[FrameKey, str] = {}
        if settings.status is not None:
            self._status = bind_status(settings.status, database, f"drivers.{settings.source}.status")
            needed = {signal.key: signal.message for signal in self._status.signals.values()}
        self._needed = frozenset(needed)
        self._watch = CanWatch(needed, settings.silence, self._counts)
        self._commanding = None
        self._command_key: FrameKey | None = None
        if settings.command is not None:
            command = bind_command(settings.command, database, f"drivers.{settings.source}.command")
            limits = settings.limits
            for speed, angle in (
                (limits.forward_speed, limits.steering_angle),
                (-limits.reverse_speed, -limits.steering_angle),
            ):
                beyond = command.beyond(speed, angle)
                if beyond:
                    place = Location(database.name, 0, f"drivers.{settings.source}.limits")
                    raise ConfigError([Problem(Severity.ERROR, beyond, place, "lower the limit")])
            self._commanding = Commanding(settings, command, self._watch, self._counts)
            self._command_key = command.forward_speed.key
        signals = self._status.signals if self._status is not None else {}
        self._has_words = "fault_bits" in signals or "commands_refused" in signals
        self._assembler = CanFrameAssembler(self._needed, round(settings.window * 1e9))
        self._mode: VehicleMode | None = None
        self._seq = 0

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin: no command outlives the line, and where there was one, stop is said."""
        self._assembler.clear()
        self._mode = None
        outputs = self._watch.opened(now)
        return outputs + (self._commanding.opened(now) if self._commanding is not None else [])

    def received(self, unit: CanFrame, now: Now) -> list[Output[CanFrame]]:
        """Take a frame."""
        if unit.is_error:
            return self._watch.error_frame(unit)
        if unit.key == self._command_key and self._commanding is not None:
            return self._commanding.foreign(now)
        if unit.key not in self._needed:
            self._watch.other(unit)
            return []
        try:
            values = self._database.decode(unit)
        except FrameError as error:
            return self._watch.wrong(unit, error)
        self._counts["frames"] += 1
        came = arrival(unit, now)
        return self._published(self._assembler.add(unit.key, values, came.monotonic_ns, came.utime), now)

    def command(self, command: VehicleCommand, now: Now) -> list[Output[CanFrame]]:
        """Take a wish: say it to the controller from now on, or refuse it and say why."""
        if self._commanding is None:
            self._counts["rejected.no_command_mapping"] += 1
            return []
        return self._commanding.take(command, now)

    def refuse(self, reason: str, text: str, now: Now) -> list[Output[CanFrame]]:
        """Count and tell what came as a command and cannot be one; `reason` is a word."""
        if self._commanding is None:
            return []
        return self._commanding.refuse(reason, text, now)

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Say what is due to the controller, publish what has waited long enough, tell silence."""
        outputs = self._published(self._assembler.expired(now.monotonic_ns), now)
        if self._commanding is not None:
            outputs += self._commanding.woken(now)
        return outputs + self._watch.woken(now)

    def due(self) -> int | None:
        """Return when to be woken."""
        commanding = self._commanding
        dues = (
            self._assembler.due(),
            self._watch.due(),
            commanding.due() if commanding is not None else None,
        )
        return min((due for due in dues if due is not None), default=None)

    def leaving(self, now: Now) -> list[Output[CanFrame]]:
        """Leave the vehicle standing where it was commanded from here."""
        return self._commanding.leaving(now) if self._commanding is not None else []

    @property
    def quiet(self) -> float:
        """Seconds for which nothing need come: where no status is expected, for ever."""
        return self.settings.silence if self._needed else math.inf

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames, samples, commands, stops, dead-man time-outs, and what was rejected by reason."""
        return self._counts

    def _published(self, instants: list[CanFrameSet], now: Now) -> list[Output[CanFrame]]:
        status = self._status
        outputs: list[Output[CanFrame]] = []
        if status is None:
            return outputs
        for instant in instants:
            self._counts["incomplete"] += not instant.is_complete
            faults, refused = status.word("fault_bits", instant), status.word("commands_refused", instant)
            if faults is None or refused is None:
                # these have no number for `not said`
                self._counts["rejected.incomplete"] += 1
                continue
            if self._commanding is not None:
                refused += self._commanding.refused
            numbers = {name: status.number(name, instant) for name in NUMBERS}
            mode = status.mode(instant)
            if (
                mode is VehicleMode.UNKNOWN
                and not self._has_words
                and all(value != value for value in numbers.values())
            ):
                self._counts["rejected.empty"] += 1
                continue
            header = SensorHeader(instant.utime, self.settings.source, self._seq, instant.utime)
            # bit by bit: the highest of 32 is the sign on the wire
            faults = (faults + (1 << 31)) % (1 << 32) - (1 << 31)
            sample = VehicleStatusSample(header, mode, **numbers, fault_bits=faults, commands_refused=max(0, refused))
            self._seq += 1
            self._counts["samples"] += 1
            outputs += self._watch.usable(now, f"the vehicle controller is heard; {_MODES[mode]}")
            if self._mode not in (None, mode):
                outputs.append(StationStatus(self._watch.phase, _MODES[mode]))
            self._mode = mode
            outputs.append(Measured(sample, self.settings.delay, self.settings.delay_sigma))
        return outputs


_MODES = {
    VehicleMode.UNKNOWN: "it does not say who drives",
    VehicleMode.MANUAL: "a person drives: commands have no effect",
    VehicleMode.AUTONOMOUS: "it takes commands",
    VehicleMode.EMERGENCY_STOP: "emergency stop: commands have no effect until it is released",
    VehicleMode.FAULT: "it has a fault and takes no commands: see fault_bits and its manual",
}
