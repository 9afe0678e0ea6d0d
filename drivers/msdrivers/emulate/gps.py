"""Emulator of a satellite receiver: sends logs and sentences of a series of samples.

It takes the commands of a NovAtel OEM4 that a driver needs (`log`, `unlog`, `unlogall`, and some without effect here),
answers and prompts as it does, and forgets what was asked for when it restarts. With `answers` off and `saved` logs it
is a plain NMEA receiver.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from modelserver.messages import GpsSample
from msdrivers.emulate import gps_logs
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Send

_MAX_COMMAND_BYTES = 200
_NO_EFFECT_COMMANDS = frozenset({"fix", "com", "datum", "saveconfig", "undulationauto", "ecutoff", "dgpstimeout"})
"""Commands that are accepted and change nothing here."""


@dataclass(frozen=True, slots=True)
class GpsUnit:
    """Configuration of the receiver. Seconds; `shift`: microseconds added to the samples' stamps to get host time.

    saved: lines of its saved configuration, e.g. "log com1 gpgga ontime 0.25", carried out when it starts.
    latency: from the instant of a sample to the first byte of its logs. boot: from a restart to the prompt.
    answers: whether it listens at all.
    """

    port: str = "COM1"
    saved: tuple[str, ...] = ()
    latency: float = 0.02
    boot_time: float = 2.0
    is_answering: bool = True
    shift: int = 0


@dataclass(slots=True)
class _LogRequest:
    """A log that was asked for: its period in microseconds, 0 for each sample, and when it was last written."""

    period: int
    last: int | None = None


class GpsEmulator:
    """An `Endpoint` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: GpsUnit | None = None) -> None:
        self._unit = GpsUnit() if unit is None else unit
        self._samples: Iterator[GpsSample] = iter(samples)
        self._next = next(self._samples, None)
        self._logs: dict[str, _LogRequest] = {}
        self._line = bytearray()
        self._now: HostTime | None = None
        self._boot_done_ns: int | None = None
        self._counts: Counter[str] = Counter()
        self._run_saved_commands()

    @property
    def counts(self) -> Mapping[str, int]:
        """Commands accepted and rejected, logs by name, restarts."""
        return dict(self._counts)

    @property
    def logs(self) -> tuple[str, ...]:
        """The logs that are on, e.g. "bestposb"."""
        return tuple(self._logs)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open. A receiver does not notice, but greets when it was just switched on."""
        first = self._now is None
        self._now = now
        self._line.clear()
        return self._make_prompt() if first else []

    def restart(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Lose power and start again: silent for `boot`, then the prompt, and only what is saved is on."""
        self._now = now
        self._counts["restarts"] += 1
        self._boot_done_ns = now.monotonic_ns + round(self._unit.boot_time * 1e9)
        self._logs.clear()
        self._line.clear()
        return [EndpointStatus(EndpointPhase.SILENT, "the emulated receiver restarts")]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process commands: lines that end with CR or LF."""
        self._now = now
        if not self._unit.is_answering or self._boot_done_ns is not None:
            return []
        out: list[Output[bytes]] = []
        for byte in unit:
            if byte not in b"\r\n":
                if len(self._line) < _MAX_COMMAND_BYTES:
                    self._line.append(byte)
                continue
            line = self._line.decode("latin-1").strip()
            self._line.clear()
            if line:
                error = self._execute(line)
                self._counts["rejected" if error else "accepted"] += 1
                answer = f"<ERROR:{error}" if error else "<OK"
                out.append(Send(f"\r\n{answer}\r\n{self._prompt}".encode("ascii")))
        return out

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Finish a restart that is due; send the logs of the samples up to now."""
        self._now = now
        out: list[Output[bytes]] = []
        if self._boot_done_ns is not None and now.monotonic_ns >= self._boot_done_ns:
            self._boot_done_ns = None
            self._run_saved_commands()
            out += self._make_prompt()
        while self._next is not None and self._get_send_utime(self._next) <= now.utime:
            if self._boot_done_ns is None:
                logs = self._make_logs(self._next)
                if logs:
                    out.append(Send(logs))
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        """Return when the next sample is due, or the restart is complete."""
        if self._now is None:
            return None
        times = [] if self._boot_done_ns is None else [self._boot_done_ns]
        if self._next is not None:
            times.append(self._now.monotonic_ns + (self._get_send_utime(self._next) - self._now.utime) * 1000)
        return min(times, default=None)

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send nothing."""
        return []

    @property
    def _prompt(self) -> str:
        return f"[{self._unit.port}]"

    def _make_prompt(self) -> list[Output[bytes]]:
        return [Send(f"\r\n{self._prompt}".encode("ascii"))] if self._unit.is_answering else []

    def _get_send_utime(self, sample: GpsSample) -> int:
        return sample.header.utime + self._unit.shift + round(self._unit.latency * 1e6)

    def _make_logs(self, sample: GpsSample) -> bytes:
        utime = sample.header.utime + self._unit.shift
        logs = b""
        for name, wanted in self._logs.items():
            # half a millisecond of grace: stamps are rounded
            if wanted.last is not None and utime - wanted.last < wanted.period - 500:
                continue
            wanted.last = utime
            logs += gps_logs.encode_sample(name, sample, utime, self._unit.port)
            self._counts[name] += 1
        return logs

    def _run_saved_commands(self) -> None:
        for line in self._unit.saved:
            error = self._execute(line)
            if error:
                raise ValueError(f"saved configuration, '{line}': {error}")

    def _execute(self, line: str) -> str:
        """Carry a command out. Return what is wrong with it; empty if nothing is."""
        words = line.lower().split()
        command, fields = words[0], words[1:]
        if fields and command in ("log", "unlog", "unlogall") and self._is_port(fields[0]):
            fields = fields[1:]
        if command == "unlogall":
            self._logs.clear()
            return ""
        if command in _NO_EFFECT_COMMANDS:
            return ""
        if command not in ("log", "unlog"):
            return f"Invalid Message. Field = {command}"
        if not fields or not gps_logs.is_known(fields[0]):
            return f"Invalid Message. Field = {fields[0] if fields else ''}"
        if command == "unlog":
            self._logs.pop(fields[0], None)
            return ""
        return self._execute_log(fields)

    def _execute_log(self, fields: Sequence[str]) -> str:
        trigger = fields[1] if len(fields) > 1 else "onchanged"
        if trigger in ("onnew", "onchanged"):
            self._logs[fields[0]] = _LogRequest(0)
            return ""
        if trigger != "ontime" or len(fields) < 3:
            return "Invalid trigger"
        try:
            period = float(fields[2])
        except ValueError:
            period = 0.0
        if not 0.05 <= period <= 86_400.0:
            return "Invalid period"
        self._logs[fields[0]] = _LogRequest(round(period * 1e6))
        return ""

    def _is_port(self, word: str) -> bool:
        return word in ("thisport", self._unit.port.lower())
