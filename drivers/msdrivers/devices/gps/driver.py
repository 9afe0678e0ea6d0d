"""The driver of a satellite receiver: sets it up, takes what it says, says what is wrong."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from modelserver.messages import SensorHeader
from msdrivers.devices.gps.fixes import FixAssembler, GpsFix
from msdrivers.devices.gps.heard import LineMonitor, wrong_device
from msdrivers.devices.gps.set_up import SetUp, SetupProgress
from msdrivers.devices.gps.settings import GpsSettings
from msdrivers.protocol.gps_stream import GpsMessage, GpsStream
from msdrivers.protocol.novatel import Answer, NovatelLog, Prompt
from msdrivers.station import Measured, Now, Output, Reopen, Send, StationPhase, StationStatus

_SECOND_NS = 1_000_000_000
_SAY_AGAIN_NS = 60 * _SECOND_NS
"""How often a person is told that still no receiver is there."""
_ARRIVALS = 4096
"""Chunks whose arrival is remembered: more than an epoch has bytes at a time."""


class GpsDriver:
    """A `Station` of bytes at the host's end of a receiver's line; see `GpsSettings`."""

    def __init__(self, settings: GpsSettings) -> None:
        self._settings = settings
        self._novatel = settings.protocol == "novatel"
        self._stream = GpsStream()
        self._fixes = FixAssembler(settings.logs, round(settings.hold * _SECOND_NS), self._silence_ns)
        self._set_up = SetUp(settings.set_up(), round(settings.answer * _SECOND_NS), settings.attempts)
        self._heard = LineMonitor()
        self._attempts: list[tuple[int | None, str]] = []
        self._baud_index = 0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_ARRIVALS)
        self._phase = StationPhase.WAITING
        self._told = ""
        self._origin = ""
        self._sequence = 0
        self._last_byte_ns: int | None = None
        self._patient_until_ns = 0
        self._samples_before = 0
        self._say_again_ns = 0
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames by kind, `rejected.<reason>`, bytes `skipped`, `samples`, and what was left out and why."""
        return {**self._stream.counts, **self._counts, **self._fixes.counts}

    def opened(self, now: Now) -> Sequence[Output[bytes]]:
        """Begin from the start: forget what was incomplete, and set the receiver up."""
        self._stream.clear()
        self._fixes.clear()
        self._arrivals.clear()
        self._last_byte_ns = None
        self._heard.forget(self._stream.counts)
        # amid a round of baud rates there is nothing new to say
        searching = self._attempts or (self._phase is StationPhase.SILENT and len(self._settings.bauds) > 1)
        at = f" at {self._baud} baud" if self._baud else ""
        told = [] if searching else self._tell(StationPhase.WAITING, f"listening for a receiver{at}")
        return [*told, *self._begin(now)]

    def received(self, unit: bytes, now: Now) -> Sequence[Output[bytes]]:
        """Take bytes of any number."""
        self._arrivals.append((self._stream.offset, now.utime))
        self._heard.take(unit)
        self._last_byte_ns = now.monotonic_ns
        out: list[Output[bytes]] = []
        for message in self._stream.feed(unit):
            out += self._handle(message, now)
        return out

    def woken(self, now: Now) -> Sequence[Output[bytes]]:
        """Do what has become due."""
        out: list[Output[bytes]] = []
        if self._gap_ns is not None and now.monotonic_ns >= self._gap_ns:
            self._last_byte_ns = None
            for epoch in self._stream.idle():
                out += self._handle(epoch, now)
        out += self._publish(self._fixes.woken(now), now)
        again = self._set_up.woken(now.monotonic_ns)
        if again:
            out.append(Send(again))
        elif self._set_up.progress is SetupProgress.UNANSWERED:
            out += self._unanswered(now)
        elif self._set_up.progress is not SetupProgress.ASKING and now.monotonic_ns >= self._patient_until_ns:
            out += self._silent(now)
        return out

    def due(self) -> int | None:
        """Return when to be woken."""
        asking = self._set_up.progress is SetupProgress.ASKING
        patience = None if asking else self._patient_until_ns
        times = (self._gap_ns, self._fixes.due(), self._set_up.due(), patience)
        return min((each for each in times if each is not None), default=None)

    def leaving(self, now: Now) -> Sequence[Output[bytes]]:
        """Stop the logs that were asked for, if the settings say so."""
        self._set_up.stop()
        if not self._settings.restore_on_leaving:
            return []
        return [Send(command.encode("ascii") + b"\r\n") for command in self._settings.undo()]

    @property
    def quiet(self) -> float:
        """Seconds for which nothing need come."""
        return self._settings.silence

    @property
    def _baud(self) -> int | None:
        return self._settings.bauds[self._baud_index] if self._settings.bauds else None

    @property
    def _silence_ns(self) -> int:
        return round(self._settings.silence * _SECOND_NS)

    @property
    def _gap_ns(self) -> int | None:
        return None if self._last_byte_ns is None else self._last_byte_ns + round(self._settings.gap * _SECOND_NS)

    def _tell(self, phase: StationPhase, text: str, *, is_trouble: bool = False) -> list[Output[bytes]]:
        """Say a word, once: not again as long as nothing else is to be said."""
        if (phase, text) == (self._phase, self._told):
            return []
        self._phase, self._told = phase, text
        return [StationStatus(phase, text, is_trouble)]

    def _begin(self, now: Now) -> list[Output[bytes]]:
        """Set the receiver up from the first command; a plain NMEA receiver is only told what the settings say."""
        self._patient_until_ns = now.monotonic_ns + self._silence_ns
        self._samples_before = self._counts["samples"]
        if self._novatel:
            return [Send(self._set_up.begin(now.monotonic_ns))]
        return [Send(command.encode("ascii") + b"\r\n") for command in self._settings.commands]

    def _handle(self, message: GpsMessage, now: Now) -> list[Output[bytes]]:
        if isinstance(message, Answer):
            return self._answered(message, now)
        if isinstance(message, Prompt):
            return self._prompted(message, now)
        if isinstance(message, NovatelLog):
            return self._publish(self._fixes.log(message, self._arrival(message.start), now), now)
        return self._publish(self._fixes.epoch(message, self._arrival(message.start), now), now)

    def _arrival(self, start: int) -> int:
        """Return the host's time when the byte at `start` of the stream came in."""
        return next((utime for offset, utime in reversed(self._arrivals) if offset <= start), self._arrivals[0][1])

    def _publish(self, fixes: Sequence[GpsFix], now: Now) -> list[Output[bytes]]:
        out: list[Output[bytes]] = []
        for fix in fixes:
            header = SensorHeader(0, self._settings.source, self._sequence, fix.host_utime, fix.device_utime)
            self._sequence += 1
            self._counts["samples"] += 1
            self._patient_until_ns = now.monotonic_ns + self._silence_ns
            self._heard.forget(self._stream.counts)
            self._attempts = []
            delay = self._settings.delay + fix.delay
            out.append(Measured(fix.sample(header), delay, self._settings.delay_sigma))
            if self._set_up.progress is not SetupProgress.ASKING and (self._phase, self._origin) != (
                StationPhase.STREAMING,
                fix.origin,
            ):
                out += self._tell(StationPhase.STREAMING, f"{fix.origin} comes")
            self._origin = fix.origin
        for problem in self._fixes.problems():
            out += self._tell(self._phase, problem)
        return out

    def _answered(self, answer: Answer, now: Now) -> list[Output[bytes]]:
        asked = self._set_up.progress is SetupProgress.ASKING
        refused = len(self._set_up.refused)
        following = self._set_up.answered(answer, now.monotonic_ns)
        if not asked:
            return []
        out: list[Output[bytes]] = []
        if self._phase is not StationPhase.CONFIGURING:
            out += self._tell(StationPhase.CONFIGURING, "a NovAtel receiver answers, setting it up")
        if len(self._set_up.refused) > refused:
            command, words = self._set_up.refused[-1]
            text = (
                f"the receiver refused '{command}': {words}; check the settings `commands`, `device_port` and the logs"
            )
            out += self._tell(StationPhase.CONFIGURING, text, is_trouble=True)
        if following:
            return [*out, Send(following)]
        if self._set_up.progress is SetupProgress.ASKING:
            return out
        # set up: from now on its logs must come
        self._patient_until_ns = now.monotonic_ns + self._silence_ns
        if not self._set_up.refused:
            out += self._tell(StationPhase.CONFIGURING, f"set up, waiting for {self._settings.position_log}")
        return out

    def _prompted(self, prompt: Prompt, now: Now) -> list[Output[bytes]]:
        if not self._novatel or self._set_up.expects_prompt(now.monotonic_ns):
            return []
        self._counts["restarts"] += 1
        self._fixes.clear()
        text = f"the receiver has started anew (prompt [{prompt.port}] without a command), setting it up again"
        return [*self._tell(StationPhase.CONFIGURING, text), *self._begin(now)]

    def _unanswered(self, now: Now) -> list[Output[bytes]]:
        """No answer to a command. Stay with a receiver that speaks all the same, else try the next baud rate."""
        self._set_up.stop()
        if self._counts["samples"] > self._samples_before:
            return self._tell(
                StationPhase.STREAMING,
                "the receiver sends fixes but does not answer commands: using what it sends unasked; "
                "check that the line can send to it",
            )
        return self._next_baud(now)

    def _silent(self, now: Now) -> list[Output[bytes]]:
        """No fix for too long: it has stopped, or its logs were lost with a restart, or it is no receiver at all."""
        heard, counts = self._heard.words(self._stream.counts), self._stream.counts
        if self._phase is StationPhase.STREAMING or self._heard.good(counts) or self._heard.flaw(counts):
            if self._novatel:
                text = (
                    f"no {self._settings.position_log} for {self._settings.silence:g} s, heard {heard} since, setting "
                    "the receiver up again"
                )
            else:
                text = self._heard.no_epoch(counts, self._settings.silence)
            out = self._tell(StationPhase.SILENT, text)
            self._heard.forget(self._stream.counts)
            return [*out, *self._begin(now)]
        return self._next_baud(now)

    def _next_baud(self, now: Now) -> list[Output[bytes]]:
        heard = self._heard.words(self._stream.counts)
        self._patient_until_ns = now.monotonic_ns + self._silence_ns
        self._attempts.append((self._baud, heard))
        out: list[Output[bytes]] = []
        if len(self._attempts) >= max(1, len(self._settings.bauds)):
            wanted = "NovAtel receiver" if self._novatel else "NMEA receiver"
            # what noise looks like differs each time: not a new word for each round
            if self._phase is not StationPhase.SILENT or now.monotonic_ns >= self._say_again_ns:
                self._say_again_ns = now.monotonic_ns + _SAY_AGAIN_NS
                out += self._tell(StationPhase.SILENT, wrong_device(wanted, self._attempts))
            self._attempts = []
        self._heard.forget(self._stream.counts)
        if len(self._settings.bauds) < 2:
            return [*out, *self._begin(now)]
        before = self._baud
        self._baud_index = (self._baud_index + 1) % len(self._settings.bauds)
        return [*out, Reopen(f"no receiver at {before} baud, heard {heard}", self._baud)]
