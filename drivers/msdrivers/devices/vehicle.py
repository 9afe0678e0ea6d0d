"""Driver of the vehicle controller on a CAN bus: status, and commands with limits and a dead-man timer."""

from __future__ import annotations

import math

from modelserver.errors import ConfigError, Location, Problem, Severity
from modelserver.messages import SensorHeader, VehicleCommand, VehicleMode, VehicleStatusSample
from msdrivers.devices.can_monitor import CanDriver
from msdrivers.devices.command_arbiter import CommandArbiter
from msdrivers.devices.vehicle_settings import VehicleSettings
from msdrivers.endpoint import EndpointStatus, HostTime, MeasuredSample, Output
from msdrivers.protocol.can.database import CanDatabase, CanFrameSet
from msdrivers.protocol.can.frame import CanFrame, FrameKey
from msdrivers.protocol.can.vehicle import NUMERIC_FIELDS, bind_command, bind_status


class VehicleDriver(CanDriver):
    """An `Endpoint` of CAN frames that also accepts commands; see `VehicleSettings` and `CommandArbiter`.

    A status is published if its fault word and its count of rejections were received or are not mapped; missing
    numbers are nan. `commands_rejected` counts the rejections of the controller and of this driver.
    """

    def __init__(self, settings: VehicleSettings, database: CanDatabase):
        """Bind the signals. Raises ConfigError for unknown or unsuitable ones."""
        self.settings = settings
        place = f"drivers.{settings.source}"
        self._status = bind_status(settings.status, database, f"{place}.status") if settings.status else None
        signals = self._status.signals if self._status is not None else {}
        super().__init__(settings, database, {signal.key: signal.message for signal in signals.values()})
        self._has_status_words = "fault_bits" in signals or "commands_rejected" in signals
        self._mode: VehicleMode | None = None
        self._arbiter: CommandArbiter | None = None
        self._command_key: FrameKey | None = None
        if settings.command is not None:
            command = bind_command(settings.command, database, f"{place}.command")
            limits = settings.limits
            for speed, angle in (
                (limits.forward_speed, limits.steering_angle),
                (-limits.reverse_speed, -limits.steering_angle),
            ):
                problem = command.find_range_problem(speed, angle)
                if problem:
                    location = Location(database.name, 0, f"{place}.limits")
                    raise ConfigError([Problem(Severity.ERROR, problem, location, "lower the limit")])
            self._arbiter = CommandArbiter(settings, command, self._monitor, self._counts)
            self._command_key = command.forward_speed.key

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Start; no command survives a reconnect, stop is sent instead."""
        self._mode = None
        outputs = super().on_open(now)
        return outputs + (self._arbiter.on_open(now) if self._arbiter is not None else [])

    def on_receive(self, unit: CanFrame, now: HostTime) -> list[Output[CanFrame]]:
        """Process a received frame; one with the command's identifier is from another node."""
        if unit.key == self._command_key and self._arbiter is not None and not unit.is_error:
            return self._arbiter.on_foreign_command(now)
        return super().on_receive(unit, now)

    def on_command(self, command: VehicleCommand, now: HostTime) -> list[Output[CanFrame]]:
        """Send a command periodically from now on, or reject it."""
        if self._arbiter is None:
            self._counts["rejected.no_command_mapping"] += 1
            return []
        return self._arbiter.on_command(command, now)

    def reject_command(self, reason: str, text: str, now: HostTime) -> list[Output[CanFrame]]:
        """Count and report a malformed command."""
        return self._arbiter.reject_command(reason, text, now) if self._arbiter is not None else []

    def on_timer(self, now: HostTime) -> list[Output[CanFrame]]:
        """Publish instants whose window has passed; send the command that is due; report silence."""
        outputs = self._publish(self._assembler.pop_expired(now.monotonic_ns), now)
        if self._arbiter is not None:
            outputs += self._arbiter.on_timer(now)
        return outputs + self._monitor.on_timer(now)

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        deadlines = (super().get_deadline(), self._arbiter.get_deadline() if self._arbiter is not None else None)
        return min((each for each in deadlines if each is not None), default=None)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        """Stop the vehicle if it was commanded from here."""
        return self._arbiter.on_close(now) if self._arbiter is not None else []

    @property
    def max_silence(self) -> float:
        """Longest normal silence, seconds; inf if no status is mapped."""
        return self.settings.silence if self._needed else math.inf

    def _publish(self, instants: list[CanFrameSet], now: HostTime) -> list[Output[CanFrame]]:
        status = self._status
        outputs: list[Output[CanFrame]] = []
        if status is None:
            return outputs
        for instant in instants:
            self._counts["incomplete"] += not instant.is_complete
            faults, rejected = status.get_word("fault_bits", instant), status.get_word("commands_rejected", instant)
            if faults is None or rejected is None:
                # these have no number for "missing"
                self._counts["rejected.incomplete"] += 1
                continue
            if self._arbiter is not None:
                rejected += self._arbiter.rejected
            numbers = {name: status.get_number(name, instant) for name in NUMERIC_FIELDS}
            mode = status.get_mode(instant)
            if (
                mode is VehicleMode.UNKNOWN
                and not self._has_status_words
                and all(value != value for value in numbers.values())
            ):
                self._counts["rejected.empty"] += 1
                continue
            header = SensorHeader(instant.utime, self.settings.source, self._seq, instant.utime)
            # the highest of the 32 bits is the sign on the wire
            faults = (faults + (1 << 31)) % (1 << 32) - (1 << 31)
            sample = VehicleStatusSample(header, mode, **numbers, fault_bits=faults, commands_rejected=max(0, rejected))
            self._seq += 1
            self._counts["samples"] += 1
            outputs += self._monitor.on_usable(now, f"the vehicle controller sends its status; {_MODE_TEXTS[mode]}")
            if self._mode not in (None, mode):
                outputs.append(EndpointStatus(self._monitor.phase, _MODE_TEXTS[mode]))
            self._mode = mode
            outputs.append(MeasuredSample(sample, self.settings.delay, self.settings.delay_sigma))
        return outputs


_MODE_TEXTS = {
    VehicleMode.UNKNOWN: "its driving mode is unknown",
    VehicleMode.MANUAL: "a person drives: commands have no effect",
    VehicleMode.AUTONOMOUS: "it takes commands",
    VehicleMode.EMERGENCY_STOP: "emergency stop: commands have no effect until it is released",
    VehicleMode.FAULT: "it has a fault and takes no commands: see fault_bits and its manual",
}
