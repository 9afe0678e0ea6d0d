"""A satellite receiver in software, from the device's side: it says what a series of samples lets it measure.

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
from msdrivers.station import Now, Output, Send, StationPhase, StationStatus

_LONGEST_COMMAND = 200
_EFFECTLESS = frozenset({"fix", "com", "datum", "saveconfig", "undulationauto", "ecutoff", "dgpstimeout"})
"""Commands that are accepted and change nothing here."""


@dataclass(frozen=True, slots=True)
class GpsUnit:
    """How the receiver is. Seconds; `shift`: microseconds added to the samples' stamps, which then are host time.

    saved: lines of its saved configuration, e.g. "log com1 gpgga ontime 0.25", carried out when it starts.
    latency: from the instant of a sample to the first byte of its logs. boot: from a restart to the prompt.
    answers: whether it listens at all.
    """

    port: str = "COM1"
    saved: tuple[str, ...] = ()
    latency: float = 0.02
    boot: float = 2.0
    answers: bool = True
    shift: int = 0


@dataclass(slots=True)
class _Wanted:
    """A log that was asked for: its period in microseconds, 0 for each sample, and when it was last written."""

    period: int
    last: int | None = None


class GpsEmulator:
    """A `Station` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: GpsUnit | None = None) -> None:
        self._unit = GpsUnit() if unit is None else unit
        self._samples: Iterator[GpsSample] = iter(samples)
        self._next = next(self._samples, None)
        self._logs: dict[str, _Wanted] = {}
        self._line = bytearray()
        self._now: Now | None = None
        self._boots_at_ns: int | None = None
        self._counts: Counter[str] = Counter()
        self._carry_out_saved()

    @property
    def counts(self) -> Mapping[str, int]:
        """Commands accepted and refused, logs by name, restarts."""
        return dict(self._counts)

    @property
    def logs(self) -> tuple[str, ...]:
        """The logs that are on, e.g. "bestposb"."""
        return tuple(self._logs)

    def opened(self, now: Now) -> Sequence[Output[bytes]]:
        """The host's end of the line is open. A receiver does not notice, but greets when it was just switched on."""
        first = self._now is None
        self._now = now
        self._line.clear()
        return self._greet() if first else []

    def restart(self, now: Now) -> Sequence[Output[bytes]]:
        """Lose power and start again: silent for `boot`, then the prompt, and only what is saved is on."""
        self._now = now
        self._counts["restarts"] += 1
        self._boots_at_ns = now.monotonic_ns + round(self._unit.boot * 1e9)
        self._logs.clear()
        self._line.clear()
        return [StationStatus(StationPhase.SILENT, "the emulated receiver restarts")]

    def received(self, unit: bytes, now: Now) -> Sequence[Output[bytes]]:
        """Take what the host sends: lines of commands, ended by CR or LF."""
        self._now = now
        if not self._unit.answers or self._boots_at_ns is not None:
            return []
        out: list[Output[bytes]] = []
        for byte in unit:
            if byte not in b"\r\n":
                if len(self._line) < _LONGEST_COMMAND:
                    self._line.append(byte)
                continue
            line = self._line.decode("latin-1").strip()
            self._line.clear()
            if line:
                error = self._obey(line)
                self._counts["refused" if error else "accepted"] += 1
                answer = f"<ERROR:{error}" if error else "<OK"
                out.append(Send(f"\r\n{answer}\r\n{self._prompt}".encode("ascii")))
        return out

    def woken(self, now: Now) -> Sequence[Output[bytes]]:
        """Start, if it is time, and say what the samples up to now let it say."""
        self._now = now
        out: list[Output[bytes]] = []
        if self._boots_at_ns is not None and now.monotonic_ns >= self._boots_at_ns:
            self._boots_at_ns = None
            self._carry_out_saved()
            out += self._greet()
        while self._next is not None and self._said_at(self._next) <= now.utime:
            if self._boots_at_ns is None:
                said = self._say(self._next)
                if said:
                    out.append(Send(said))
            self._next = next(self._samples, None)
        return out

    def due(self) -> int | None:
        """Return when the next sample is to be said, or the receiver has started."""
        if self._now is None:
            return None
        times = [] if self._boots_at_ns is None else [self._boots_at_ns]
        if self._next is not None:
            times.append(self._now.monotonic_ns + (self._said_at(self._next) - self._now.utime) * 1000)
        return min(times, default=None)

    def leaving(self, now: Now) -> Sequence[Output[bytes]]:
        """Nothing: a receiver does not say good-bye."""
        return []

    @property
    def _prompt(self) -> str:
        return f"[{self._unit.port}]"

    def _greet(self) -> list[Output[bytes]]:
        return [Send(f"\r\n{self._prompt}".encode("ascii"))] if self._unit.answers else []

    def _said_at(self, sample: GpsSample) -> int:
        return sample.header.utime + self._unit.shift + round(self._unit.latency * 1e6)

    def _say(self, sample: GpsSample) -> bytes:
        utime = sample.header.utime + self._unit.shift
        said = b""
        for name, wanted in self._logs.items():
            # half a millisecond of grace: stamps are rounded
            if wanted.last is not None and utime - wanted.last < wanted.period - 500:
                continue
            wanted.last = utime
            said += gps_logs.write(name, sample, utime, self._unit.port)
            self._counts[name] += 1
        return said

    def _carry_out_saved(self) -> None:
        for line in self._unit.saved:
            error = self._obey(line)
            if error:
                raise ValueError(f"saved configuration, '{line}': {error}")

    def _obey(self, line: str) -> str:
        """Carry a command out. Return what is wrong with it; empty if nothing is."""
        words = line.lower().split()
        command, fields = words[0], words[1:]
        if fields and command in ("log", "unlog", "unlogall") and self._is_port(fields[0]):
            fields = fields[1:]
        if command == "unlogall":
            self._logs.clear()
            return ""
        if command in _EFFECTLESS:
            return ""
        if command not in ("log", "unlog"):
            return f"Invalid Message. Field = {command}"
        if not fields or not gps_logs.known(fields[0]):
            return f"Invalid Message. Field = {fields[0] if fields else ''}"
        if command == "unlog":
            self._logs.pop(fields[0], None)
            return ""
        return self._log(fields)

    def _log(self, fields: Sequence[str]) -> str:
        trigger = fields[1] if len(fields) > 1 else "onchanged"
        if trigger in ("onnew", "onchanged"):
            self._logs[fields[0]] = _Wanted(0)
            return ""
        if trigger != "ontime" or len(fields) < 3:
            return "Invalid trigger"
        try:
            period = float(fields[2])
        except ValueError:
            period = 0.0
        if not 0.05 <= period <= 86_400.0:
            return "Invalid period"
        self._logs[fields[0]] = _Wanted(round(period * 1e6))
        return ""

    def _is_port(self, word: str) -> bool:
        return word in ("thisport", self._unit.port.lower())
