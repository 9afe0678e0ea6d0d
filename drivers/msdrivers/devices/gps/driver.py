"""Driver of a satellite receiver: configures it, publishes its fixes, diagnoses errors.

A NovAtel receiver is configured by commands (`setup_dialogue`); without an answer the next baud rate is tried. Without
a fix for `silence` the setup is repeated, because a restarted receiver forgets its logs. A plain NMEA receiver is only
read.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from modelserver.messages import SensorHeader
from msdrivers.devices.gps.fixes import FixAssembler, GpsFix
from msdrivers.devices.gps.line_monitor import LineMonitor, explain_missing_receiver
from msdrivers.devices.gps.settings import GpsSettings
from msdrivers.devices.gps.setup_dialogue import SetupDialogue, SetupProgress
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send
from msdrivers.protocol.gps_stream import GpsMessage, GpsStream
from msdrivers.protocol.novatel import CommandResponse, NovatelLog, Prompt

_SECOND_NS = 1_000_000_000
_WARNING_INTERVAL_NS = 60 * _SECOND_NS
"""Rate limit of the warning that no receiver was found."""
_MAX_ARRIVALS = 4096
"""Number of chunks whose receive times are stored: more than an epoch has bytes."""


class GpsDriver:
    """An `Endpoint` of bytes at the host's end of a receiver's line; see `GpsSettings`."""

    def __init__(self, settings: GpsSettings) -> None:
        self._settings = settings
        self.max_silence = settings.silence
        self._novatel = settings.protocol == "novatel"
        self._stream = GpsStream()
        self._fixes = FixAssembler(settings.logs, round(settings.hold * _SECOND_NS), self._silence_ns)
        self._setup = SetupDialogue(
            settings.make_setup_commands(), round(settings.answer_timeout * _SECOND_NS), settings.attempts
        )
        self._monitor = LineMonitor()
        self._attempts: list[tuple[int | None, str]] = []
        self._baud_index = 0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)
        self._phase = EndpointPhase.WAITING
        self._reported = ""
        self._origin = ""
        self._sequence = 0
        self._last_byte_ns: int | None = None
        self._timeout_ns = 0
        self._samples_before = 0
        self._next_warning_ns = 0
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames by kind, `rejected.<reason>`, bytes `skipped`, `samples`, and what was left out and why."""
        return {**self._stream.counts, **self._counts, **self._fixes.counts}

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Discard incomplete data and set the receiver up."""
        self._stream.clear()
        self._fixes.clear()
        self._arrivals.clear()
        self._last_byte_ns = None
        self._monitor.reset(self._stream.counts)
        # no new status within a search over the baud rates
        searching = self._attempts or (self._phase is EndpointPhase.SILENT and len(self._settings.bauds) > 1)
        at = f" at {self._current_baud} baud" if self._current_baud else ""
        status = [] if searching else self._set_status(EndpointPhase.WAITING, f"waiting for a receiver{at}")
        return [*status, *self._start_setup(now)]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process received bytes."""
        self._arrivals.append((self._stream.offset, now.utime))
        self._monitor.add(unit)
        self._last_byte_ns = now.monotonic_ns
        out: list[Output[bytes]] = []
        for message in self._stream.feed(unit):
            out += self._on_message(message, now)
        return out

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Do what is due."""
        out: list[Output[bytes]] = []
        if self._gap_ns is not None and now.monotonic_ns >= self._gap_ns:
            self._last_byte_ns = None
            for epoch in self._stream.flush():
                out += self._on_message(epoch, now)
        out += self._publish_fixes(self._fixes.on_timer(now), now)
        again = self._setup.on_timer(now.monotonic_ns)
        if again:
            out.append(Send(again))
        elif self._setup.progress is SetupProgress.TIMED_OUT:
            out += self._on_setup_timeout(now)
        elif self._setup.progress is not SetupProgress.RUNNING and now.monotonic_ns >= self._timeout_ns:
            out += self._on_data_timeout(now)
        return out

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        asking = self._setup.progress is SetupProgress.RUNNING
        timeout = None if asking else self._timeout_ns
        times = (self._gap_ns, self._fixes.get_deadline(), self._setup.get_deadline(), timeout)
        return min((each for each in times if each is not None), default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Stop the requested logs if the settings demand it."""
        self._setup.stop()
        if not self._settings.restore_on_exit:
            return []
        return [Send(command.encode("ascii") + b"\r\n") for command in self._settings.make_undo_commands()]

    @property
    def _current_baud(self) -> int | None:
        return self._settings.bauds[self._baud_index] if self._settings.bauds else None

    @property
    def _silence_ns(self) -> int:
        return round(self._settings.silence * _SECOND_NS)

    @property
    def _gap_ns(self) -> int | None:
        return None if self._last_byte_ns is None else self._last_byte_ns + round(self._settings.gap * _SECOND_NS)

    def _set_status(self, phase: EndpointPhase, text: str, *, is_warning: bool = False) -> list[Output[bytes]]:
        """Report a status unless it is unchanged."""
        if (phase, text) == (self._phase, self._reported):
            return []
        self._phase, self._reported = phase, text
        return [EndpointStatus(phase, text, is_warning)]

    def _start_setup(self, now: HostTime) -> list[Output[bytes]]:
        """Start the setup; a plain NMEA receiver only gets the commands of the settings."""
        self._timeout_ns = now.monotonic_ns + self._silence_ns
        self._samples_before = self._counts["samples"]
        if self._novatel:
            return [Send(self._setup.start(now.monotonic_ns))]
        return [Send(command.encode("ascii") + b"\r\n") for command in self._settings.commands]

    def _on_message(self, message: GpsMessage, now: HostTime) -> list[Output[bytes]]:
        if isinstance(message, CommandResponse):
            return self._on_command_response(message, now)
        if isinstance(message, Prompt):
            return self._on_prompt(message, now)
        if isinstance(message, NovatelLog):
            return self._publish_fixes(self._fixes.add_log(message, self._get_arrival_utime(message.start), now), now)
        return self._publish_fixes(self._fixes.add_epoch(message, self._get_arrival_utime(message.start), now), now)

    def _get_arrival_utime(self, start: int) -> int:
        """Return the receive time of the byte at `start` of the stream."""
        return next((utime for offset, utime in reversed(self._arrivals) if offset <= start), self._arrivals[0][1])

    def _publish_fixes(self, fixes: Sequence[GpsFix], now: HostTime) -> list[Output[bytes]]:
        out: list[Output[bytes]] = []
        for fix in fixes:
            header = SensorHeader(0, self._settings.source, self._sequence, fix.host_utime, fix.device_utime)
            self._sequence += 1
            self._counts["samples"] += 1
            self._timeout_ns = now.monotonic_ns + self._silence_ns
            self._monitor.reset(self._stream.counts)
            self._attempts = []
            delay = self._settings.delay + fix.delay
            out.append(MeasuredSample(fix.to_sample(header), delay, self._settings.delay_sigma))
            if self._setup.progress is not SetupProgress.RUNNING and (self._phase, self._origin) != (
                EndpointPhase.STREAMING,
                fix.origin,
            ):
                out += self._set_status(EndpointPhase.STREAMING, f"receiving {fix.origin}")
            self._origin = fix.origin
        for problem in self._fixes.pop_problems():
            out += self._set_status(self._phase, problem)
        return out

    def _on_command_response(self, answer: CommandResponse, now: HostTime) -> list[Output[bytes]]:
        asked = self._setup.progress is SetupProgress.RUNNING
        rejected = len(self._setup.rejected)
        following = self._setup.on_response(answer, now.monotonic_ns)
        if not asked:
            return []
        out: list[Output[bytes]] = []
        if self._phase is not EndpointPhase.CONFIGURING:
            out += self._set_status(EndpointPhase.CONFIGURING, "a NovAtel receiver answers, setting it up")
        if len(self._setup.rejected) > rejected:
            command, words = self._setup.rejected[-1]
            text = (
                f"the receiver rejected '{command}': {words}; check the settings `commands`, `device_port` and the logs"
            )
            out += self._set_status(EndpointPhase.CONFIGURING, text, is_warning=True)
        if following:
            return [*out, Send(following)]
        if self._setup.progress is SetupProgress.RUNNING:
            return out
        # set up: from now on its logs must come
        self._timeout_ns = now.monotonic_ns + self._silence_ns
        if not self._setup.rejected:
            out += self._set_status(EndpointPhase.CONFIGURING, f"set up, waiting for {self._settings.position_log}")
        return out

    def _on_prompt(self, prompt: Prompt, now: HostTime) -> list[Output[bytes]]:
        if not self._novatel or self._setup.expects_prompt(now.monotonic_ns):
            return []
        self._counts["restarts"] += 1
        self._fixes.clear()
        text = f"the receiver has restarted (prompt [{prompt.port}] without a command), setting it up again"
        return [*self._set_status(EndpointPhase.CONFIGURING, text), *self._start_setup(now)]

    def _on_setup_timeout(self, now: HostTime) -> list[Output[bytes]]:
        """Use a receiver that sends fixes without answering commands, else try the next baud rate."""
        self._setup.stop()
        if self._counts["samples"] > self._samples_before:
            return self._set_status(
                EndpointPhase.STREAMING,
                "the receiver sends fixes but does not answer commands: using what it sends unasked; "
                "check that the line can send to it",
            )
        return self._try_next_baud(now)

    def _on_data_timeout(self, now: HostTime) -> list[Output[bytes]]:
        """Repeat the setup if data arrives (a restart loses the logs), else try the next baud rate."""
        received, counts = self._monitor.describe(self._stream.counts), self._stream.counts
        if (
            self._phase is EndpointPhase.STREAMING
            or self._monitor.list_valid_kinds(counts)
            or self._monitor.find_flaw(counts)
        ):
            if self._novatel:
                missing = f"no {self._settings.position_log} for {self._settings.silence:g} s"
                text = f"{missing}, received {received} since, setting the receiver up again"
            else:
                text = self._monitor.explain_missing_fix(counts, self._settings.silence)
            out = self._set_status(EndpointPhase.SILENT, text)
            self._monitor.reset(self._stream.counts)
            return [*out, *self._start_setup(now)]
        return self._try_next_baud(now)

    def _try_next_baud(self, now: HostTime) -> list[Output[bytes]]:
        received = self._monitor.describe(self._stream.counts)
        self._timeout_ns = now.monotonic_ns + self._silence_ns
        self._attempts.append((self._current_baud, received))
        out: list[Output[bytes]] = []
        if len(self._attempts) >= max(1, len(self._settings.bauds)):
            wanted = "NovAtel receiver" if self._novatel else "NMEA receiver"
            # the text differs with the noise: rate limit
            if self._phase is not EndpointPhase.SILENT or now.monotonic_ns >= self._next_warning_ns:
                self._next_warning_ns = now.monotonic_ns + _WARNING_INTERVAL_NS
                out += self._set_status(EndpointPhase.SILENT, explain_missing_receiver(wanted, self._attempts))
            self._attempts = []
        self._monitor.reset(self._stream.counts)
        if len(self._settings.bauds) < 2:
            return [*out, *self._start_setup(now)]
        before = self._current_baud
        self._baud_index = (self._baud_index + 1) % len(self._settings.bauds)
        return [*out, Reopen(f"no receiver at {before} baud, received {received}", self._current_baud)]
