"""Which commands count, for how long, and what is said to the controller: the wish, or stop."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

from modelserver.errors import shown
from modelserver.messages import VehicleCommand
from msdrivers.devices.can_watch import CanWatch
from msdrivers.devices.vehicle_settings import VehicleSettings
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.vehicle import BoundCommand
from msdrivers.station import Now, Output, Send, StationStatus

_TELL_AGAIN_NS = 10_000_000_000
"""How often a person is told of the same trouble."""

_YIELD_NS = 2_000_000_000
"""How long no command is taken after another node has commanded the vehicle."""


class _InForce(NamedTuple):
    """A command that counts, until `until_ns` of the monotonic clock."""

    command: VehicleCommand
    until_ns: int


class _Last(NamedTuple):
    """The last command that was taken: what is older, or is it again, came late or twice."""

    source: str
    seq: int
    utime: int


class Commanding:
    """Takes wishes and says them again and again, until the last one ends: then it says stop, again and again.

    Before the first wish it says nothing, so that a person can drive. To stop leaves the wheels steered as they were:
    to straighten them while the vehicle still rolls would swerve it. Where another node commands the vehicle too, it
    says stop once and then nothing, and takes no wish until that node has been quiet for a while: two that take turns
    on the bus would have the vehicle do now this, now that.
    """

    def __init__(self, settings: VehicleSettings, bound: BoundCommand, watch: CanWatch, counts: Counter[str]):
        """Take the settings, the command's signals, who knows how the bus is, and where to count."""
        self._settings = settings
        self._bound = bound
        self._watch = watch
        self._counts = counts
        self._period_ns = round(settings.command_period * 1e9)
        self._in_force: _InForce | None = None
        self._last: _Last | None = None
        self._speaks = False
        self._next_ns = 0
        self._frames = 0
        self._angle = 0.0
        self._yields_until_ns: int | None = None
        self._told: dict[str, int] = {}
        self.refused = 0
        """Commands that were not taken."""

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin: no command outlives the line. Where there was one, stop is said."""
        self._in_force = None
        return [self._stop(now)] if self._speaks else []

    def take(self, command: VehicleCommand, now: Now) -> list[Output[CanFrame]]:
        """Take a wish, or refuse it."""
        lasts = min(command.valid_for, self._settings.max_validity) - (now.utime - command.utime) * 1e-6
        reason, why = self._against(command, lasts, now)
        limited, beyond = self._limited(command)
        if not reason and beyond and self._settings.limits.beyond == "refuse":
            reason, why = "limit", beyond
        if reason:
            return self.refuse(reason, f"command of {shown(command.source, 40)} refused: {why}", now)
        outputs: list[Output[CanFrame]] = []
        if beyond:
            self._counts["clamped"] += 1
            outputs += self._tell("clamp", f"{beyond}; the limit is commanded", now)
        self._counts["commands"] += 1
        self._last = _Last(command.source, command.seq, command.utime)
        self._in_force = _InForce(limited, now.monotonic_ns + round(min(lasts, self._settings.dead_man) * 1e9))
        self._speaks = True
        self._angle = limited.steering_angle
        return [*outputs, self._say(now)]

    def refuse(self, reason: str, text: str, now: Now) -> list[Output[CanFrame]]:
        """Count a command that is not taken, and tell `text`; `reason` is a word."""
        self.refused += 1
        self._counts[f"rejected.{reason}"] += 1
        return self._tell(reason, text, now)

    def foreign(self, now: Now) -> list[Output[CanFrame]]:
        """Give way: a frame of the command's identifier came that was not sent from here."""
        self._counts["foreign_commands"] += 1
        self._yields_until_ns = now.monotonic_ns + _YIELD_NS
        outputs = self._tell(
            "foreign",
            f"another node commands the vehicle too: {self._bound.map.message} comes on the bus and was not sent from "
            "here; nothing more is commanded from here while it does. Is a second driver running, or another program?",
            now,
        )
        if self._speaks:
            self._in_force, self._speaks = None, False
            outputs += [] if self._watch.is_off else [self._stop(now)]
        return outputs

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Say the command again, or stop where it has ended."""
        outputs: list[Output[CanFrame]] = []
        if self._watch.is_off:
            return outputs
        if self._in_force is not None and now.monotonic_ns >= self._in_force.until_ns:
            ended, self._in_force = self._in_force, None
            self._counts["dead_man"] += 1
            source = shown(ended.command.source, 40)
            outputs.append(
                StationStatus(self._watch.phase, f"no command after number {ended.command.seq} of {source}: stop")
            )
            outputs.append(self._stop(now))
        elif self._speaks and now.monotonic_ns >= self._next_ns:
            outputs.append(self._say(now))
        return outputs

    def due(self) -> int | None:
        """Return when to be woken."""
        if not self._speaks or self._watch.is_off:
            return None
        return self._next_ns if self._in_force is None else min(self._next_ns, self._in_force.until_ns)

    def leaving(self, now: Now) -> list[Output[CanFrame]]:
        """Say stop where the vehicle was commanded."""
        self._in_force = None
        return [self._stop(now)] if self._speaks and not self._watch.is_off else []

    def _against(self, command: VehicleCommand, lasts: float, now: Now) -> tuple[str, str]:
        """Return why a command does not count, in a word and in a sentence; empty where it does."""
        settings = self._settings
        numbers = (command.forward_speed, command.steering_angle, command.valid_for)
        if not all(map(math.isfinite, numbers)):
            return "malformed", "it has a number that is not finite"
        if settings.commander and command.source != settings.commander:
            return "stranger", f"only {shown(settings.commander, 40)} commands; see `commander`"
        if lasts <= 0.0:
            return "expired", f"it ended {-lasts:.3f} s ago; is its clock behind ours, or the network slow?"
        if command.utime - now.utime > settings.clock_slack * 1e6:
            ahead = (command.utime - now.utime) * 1e-6
            return "future", f"it was given {ahead:.3f} s from now; its clock is ahead of ours"
        reason, why = self._against_the_last(command, now)
        if not reason and self._yields_until_ns is not None and now.monotonic_ns < self._yields_until_ns:
            return "foreign", "another node commands the vehicle on the bus"
        if not reason and self._watch.is_off:
            return "line", "the CAN interface is off the bus; nothing can be sent"
        return reason, why

    def _against_the_last(self, command: VehicleCommand, now: Now) -> tuple[str, str]:
        last, in_force = self._last, self._in_force
        counts = in_force is not None and in_force.until_ns > now.monotonic_ns
        if last is None:
            return "", ""
        if counts and command.source != last.source:
            return "stranger", f"{shown(last.source, 40)} commands now; one at a time does"
        if last.utime - now.utime > self._settings.clock_slack * 1e6:
            # the clock was set back since: stamps from before say nothing of now
            return "", ""
        follows = command.source == last.source and command.seq > last.seq
        if command.utime < last.utime or (command.utime == last.utime and not follows):
            late = (last.utime - command.utime) * 1e-6
            return "old", f"it is not newer than the last one that was taken, which was given {late:.3f} s after it"
        # a commander that was started again numbers anew: that counts when the one before has ended
        if counts and not follows:
            return "old", f"its number {command.seq} is not above the last, {last.seq}"
        return "", ""

    def _limited(self, command: VehicleCommand) -> tuple[VehicleCommand, str]:
        """Return a command within the limits, and what was beyond them."""
        limits = self._settings.limits
        speed = min(max(command.forward_speed, -limits.reverse_speed), limits.forward_speed)
        angle = min(max(command.steering_angle, -limits.steering_angle), limits.steering_angle)
        beyond = []
        if speed != command.forward_speed:
            allowed = f"{-limits.reverse_speed:g} to {limits.forward_speed:g} m/s"
            beyond.append(f"forward_speed {command.forward_speed:g} m/s is beyond {allowed}")
        if angle != command.steering_angle:
            beyond.append(f"steering_angle {command.steering_angle:g} rad is beyond {limits.steering_angle:g}")
        return replace(command, forward_speed=speed, steering_angle=angle), " and ".join(beyond)

    def _say(self, now: Now) -> Send[CanFrame]:
        if self._in_force is None:
            return self._stop(now)
        command = self._in_force.command
        return self._sent(self._bound.frame(command.forward_speed, command.steering_angle, self._frames), now)

    def _stop(self, now: Now) -> Send[CanFrame]:
        self._counts["stops_sent"] += 1
        return self._sent(self._bound.frame(0.0, self._angle, self._frames, is_stop=True), now)

    def _sent(self, frame: CanFrame, now: Now) -> Send[CanFrame]:
        self._frames += 1
        self._next_ns = now.monotonic_ns + self._period_ns
        return Send(frame)

    def _tell(self, reason: str, text: str, now: Now) -> list[Output[CanFrame]]:
        if now.monotonic_ns < self._told.get(reason, now.monotonic_ns):
            return []
        self._told[reason] = now.monotonic_ns + _TELL_AGAIN_NS
        return [StationStatus(self._watch.phase, text, is_trouble=True)]
