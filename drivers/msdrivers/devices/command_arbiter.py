"""Arbitration of vehicle commands: validation, limits, dead-man timer, periodic transmission.

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
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

from modelserver.errors import quote
from modelserver.messages import VehicleCommand
from msdrivers.devices.can_monitor import CanBusMonitor
from msdrivers.devices.vehicle_settings import VehicleSettings
from msdrivers.endpoint import EndpointStatus, HostTime, Output, Send
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.vehicle import BoundCommand

_WARNING_INTERVAL_NS = 10_000_000_000
"""Rate limit of equal warnings."""

_FOREIGN_HOLDOFF_NS = 2_000_000_000
"""How long commands are rejected after another node's command."""


class _ActiveCommand(NamedTuple):
    """The active command and the deadline of its dead-man timer, monotonic nanoseconds."""

    command: VehicleCommand
    until_ns: int


class _LastCommand(NamedTuple):
    """Identity of the last accepted command, to reject older and repeated ones."""

    source: str
    seq: int
    utime: int


class CommandArbiter:
    """Accepts commands and makes the frames to send; see the module."""

    def __init__(self, settings: VehicleSettings, signals: BoundCommand, monitor: CanBusMonitor, counts: Counter[str]):
        self._settings = settings
        self._signals = signals
        self._monitor = monitor
        self._counts = counts
        self._period_ns = round(settings.command_period * 1e9)
        self._active: _ActiveCommand | None = None
        self._last: _LastCommand | None = None
        self._is_transmitting = False
        self._next_ns = 0
        self._frame_count = 0
        self._angle = 0.0
        self._holdoff_until_ns: int | None = None
        self._warned_until_ns: dict[str, int] = {}
        self.rejected = 0
        """Number of rejected commands."""

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Discard the active command and send stop instead: no command survives a reconnect."""
        self._active = None
        return [self._make_stop_frame(now)] if self._is_transmitting else []

    def on_command(self, command: VehicleCommand, now: HostTime) -> list[Output[CanFrame]]:
        """Accept or reject a command."""
        remaining = min(command.valid_for, self._settings.max_validity) - (now.utime - command.utime) * 1e-6
        reason, why = self._find_reject_reason(command, remaining, now)
        limited, beyond = self._clamp(command)
        if not reason and beyond and self._settings.limits.over_limit == "reject":
            reason, why = "limit", beyond
        if reason:
            return self.reject_command(reason, f"command of {quote(command.source, 40)} rejected: {why}", now)
        outputs: list[Output[CanFrame]] = []
        if beyond:
            self._counts["clamped"] += 1
            outputs += self._warn("clamp", f"{beyond}; the limit is commanded", now)
        self._counts["commands"] += 1
        self._last = _LastCommand(command.source, command.seq, command.utime)
        self._active = _ActiveCommand(limited, now.monotonic_ns + round(min(remaining, self._settings.dead_man) * 1e9))
        self._is_transmitting = True
        self._angle = limited.steering_angle
        return [*outputs, self._make_frame(now)]

    def reject_command(self, reason: str, text: str, now: HostTime) -> list[Output[CanFrame]]:
        """Count a rejected command under `reason` and warn with `text`."""
        self.rejected += 1
        self._counts[f"rejected.{reason}"] += 1
        return self._warn(reason, text, now)

    def on_foreign_command(self, now: HostTime) -> list[Output[CanFrame]]:
        """Stop and stay silent: another node sent a frame with the command's identifier."""
        self._counts["foreign_commands"] += 1
        self._holdoff_until_ns = now.monotonic_ns + _FOREIGN_HOLDOFF_NS
        outputs = self._warn(
            "foreign",
            f"another node commands the vehicle too: it sends {self._signals.map.message}; no command is sent from "
            "here while it does. Is a second driver running, or another program?",
            now,
        )
        if self._is_transmitting:
            self._active, self._is_transmitting = None, False
            outputs += [] if self._monitor.is_bus_off else [self._make_stop_frame(now)]
        return outputs

    def on_timer(self, now: HostTime) -> list[Output[CanFrame]]:
        """Send the command again, or stop if its dead-man timer has expired."""
        outputs: list[Output[CanFrame]] = []
        if self._monitor.is_bus_off:
            return outputs
        if self._active is not None and now.monotonic_ns >= self._active.until_ns:
            ended, self._active = self._active, None
            self._counts["dead_man"] += 1
            source = quote(ended.command.source, 40)
            outputs.append(
                EndpointStatus(self._monitor.phase, f"no command after number {ended.command.seq} of {source}: stop")
            )
            outputs.append(self._make_stop_frame(now))
        elif self._is_transmitting and now.monotonic_ns >= self._next_ns:
            outputs.append(self._make_frame(now))
        return outputs

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        if not self._is_transmitting or self._monitor.is_bus_off:
            return None
        return self._next_ns if self._active is None else min(self._next_ns, self._active.until_ns)

    def on_close(self, now: HostTime) -> list[Output[CanFrame]]:
        """Send stop if the vehicle was commanded."""
        self._active = None
        return [self._make_stop_frame(now)] if self._is_transmitting and not self._monitor.is_bus_off else []

    def _find_reject_reason(self, command: VehicleCommand, remaining: float, now: HostTime) -> tuple[str, str]:
        """Return why a command is rejected, as counter name and text; empty if it is valid."""
        settings = self._settings
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
        if not reason and self._monitor.is_bus_off:
            return "bus_off", "the CAN interface is bus-off; nothing can be sent"
        return reason, why

    def _check_against_last(self, command: VehicleCommand, now: HostTime) -> tuple[str, str]:
        last = self._last
        is_active = self._active is not None and self._active.until_ns > now.monotonic_ns
        if last is None:
            return "", ""
        if is_active and command.source != last.source:
            return "source", f"{quote(last.source, 40)} commands the vehicle now; one source at a time"
        if last.utime - now.utime > self._settings.clock_slack * 1e6:
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
        limits = self._settings.limits
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
        if self._active is None:
            return self._make_stop_frame(now)
        command = self._active.command
        return self._schedule(
            self._signals.make_frame(command.forward_speed, command.steering_angle, self._frame_count), now
        )

    def _make_stop_frame(self, now: HostTime) -> Send[CanFrame]:
        self._counts["stops_sent"] += 1
        return self._schedule(self._signals.make_frame(0.0, self._angle, self._frame_count, is_stop=True), now)

    def _schedule(self, frame: CanFrame, now: HostTime) -> Send[CanFrame]:
        self._frame_count += 1
        self._next_ns = now.monotonic_ns + self._period_ns
        return Send(frame)

    def _warn(self, reason: str, text: str, now: HostTime) -> list[Output[CanFrame]]:
        if now.monotonic_ns < self._warned_until_ns.get(reason, now.monotonic_ns):
            return []
        self._warned_until_ns[reason] = now.monotonic_ns + _WARNING_INTERVAL_NS
        return [EndpointStatus(self._monitor.phase, text, is_warning=True)]
