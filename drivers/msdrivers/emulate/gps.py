"""Emulator of a satellite receiver: sends logs and sentences of a series of samples.

It takes the commands of a NovAtel OEM4 that a driver needs (`log`, `unlog`, `unlogall`, and some without effect here),
and answers and prompts as it does. With `is_answering` off and `saved` logs it is a plain NMEA receiver.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from modelserver.messages import GpsSample
from msdrivers.emulate import gps_logs
from msdrivers.endpoint import HostTime, Output, Send

_PORT = "COM1"
_PROMPT = f"[{_PORT}]".encode()
_MAX_COMMAND_BYTES = 200
_NO_EFFECT_COMMANDS = frozenset({"fix", "com", "datum", "saveconfig", "undulationauto", "ecutoff", "dgpstimeout"})
"""Commands that are accepted and change nothing here."""


@dataclass(frozen=True, slots=True)
class GpsUnit:
    """Configuration of the receiver.

    saved: lines of its saved configuration, e.g. "log com1 gpgga ontime 0.25", carried out when it starts.
    latency: from the instant of a sample to the first byte of its logs, seconds. is_answering: whether it listens.
    """

    saved: tuple[str, ...] = ()
    latency: float = 0.02
    is_answering: bool = True


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
        self.counts: Counter[str] = Counter()
        """Commands accepted and rejected, logs by name."""
        for line in self._unit.saved:
            if error := self._execute(line):
                raise ValueError(f"saved configuration, '{line}': {error}")

    @property
    def logs(self) -> tuple[str, ...]:
        """The logs that are on, e.g. "bestposb"."""
        return tuple(self._logs)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open. A receiver does not notice, but greets when it was just switched on."""
        first = self._now is None
        self._now = now
        self._line.clear()
        return [Send(b"\r\n" + _PROMPT)] if first and self._unit.is_answering else []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process commands: lines that end with CR or LF."""
        self._now = now
        if not self._unit.is_answering:
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
                self.counts["rejected" if error else "accepted"] += 1
                answer = f"<ERROR:{error}" if error else "<OK"
                out.append(Send(f"\r\n{answer}\r\n".encode("ascii") + _PROMPT))
        return out

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send the logs of the samples up to now."""
        self._now = now
        out: list[Output[bytes]] = []
        while self._next is not None and self._get_send_utime(self._next) <= now.utime:
            logs = self._make_logs(self._next)
            if logs:
                out.append(Send(logs))
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        """Return when the next sample is due."""
        if self._now is None or self._next is None:
            return None
        return self._now.monotonic_ns + (self._get_send_utime(self._next) - self._now.utime) * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send nothing."""
        return []

    def _get_send_utime(self, sample: GpsSample) -> int:
        return sample.header.utime + round(self._unit.latency * 1e6)

    def _make_logs(self, sample: GpsSample) -> bytes:
        utime = sample.header.utime
        logs = b""
        for name, wanted in self._logs.items():
            # half a millisecond of grace: stamps are rounded
            if wanted.last is not None and utime - wanted.last < wanted.period - 500:
                continue
            wanted.last = utime
            logs += gps_logs.encode_sample(name, sample, utime, _PORT)
            self.counts[name] += 1
        return logs

    def _execute(self, line: str) -> str:
        """Carry a command out. Return what is wrong with it; empty if nothing is."""
        words = line.lower().split()
        command, fields = words[0], words[1:]
        if fields and command in ("log", "unlog", "unlogall") and fields[0] in ("thisport", _PORT.lower()):
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
        period = 0.0
        if trigger == "ontime" and len(fields) > 2:
            with suppress(ValueError):
                period = float(fields[2])
            if not 0.05 <= period <= 86_400.0:
                return "Invalid period"
        elif trigger not in ("onnew", "onchanged"):
            return "Invalid trigger"
        self._logs[fields[0]] = _LogRequest(round(period * 1e6))
        return ""
