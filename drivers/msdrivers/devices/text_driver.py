"""Common part of the drivers of devices that send lines of text, whose columns the vehicle file describes.

A line is used if it has as many columns as described, and each that is used is a number within its limit. The first
line after the port was opened is not used: it may be the end of one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import reduce
from operator import xor
from typing import ClassVar, Final, Protocol

from modelserver.errors import quote
from modelserver.messages import Sample, SensorHeader
from msdrivers.devices.ranges import check_ranges
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output
from msdrivers.protocol.recognition import recognize_line
from msdrivers.protocol.text_lines import MAX_LINE, LineDescription, LineReader

EXAMINED_BYTES: Final = 4096
_SECOND_NS: Final = 1_000_000_000


class TextSettings(LineDescription, Protocol):
    """Settings that these drivers have in common."""

    @property
    def source(self) -> str:
        """Source of the samples."""

    @property
    def silence(self) -> float:
        """Timeout for usable lines, seconds."""

    @property
    def delay(self) -> float:
        """From the measurement to the device's time, or to the arrival of the line's first byte, seconds."""

    @property
    def delay_sigma(self) -> float:
        """Its standard deviation, seconds."""


def check_text_settings(settings: TextSettings) -> None:
    """Raise ValueError with the key for a setting out of range."""
    check_ranges(settings, columns=(1, 256), silence=(0.05, 3600.0), delay=(-5.0, 5.0), delay_sigma=(0.0, 5.0))
    if settings.checksum not in ("none", "xor"):
        raise ValueError(f"checksum is none or xor, got {quote(settings.checksum)}")
    for name, column in settings.fields.items():
        if column.column >= settings.columns:
            raise ValueError(f"fields: {name} is in column {column.column}, but a line has {settings.columns}, from 0")


class TextDriver(ABC):
    """An `Endpoint` of bytes at the host's end of the device's line."""

    device: ClassVar[str]
    """Name in the vehicle file."""

    def __init__(self, settings: TextSettings) -> None:
        self._settings = settings
        self.max_silence = settings.silence
        self._reader = LineReader()
        self._phase, self._reported = EndpointPhase.WAITING, ""
        self._silence_deadline_ns: int | None = None
        self._first_bytes, self._last_line = b"", b""
        self._seq = 0
        self.counts: Counter[str] = Counter()
        """Lines, samples, `other_lines`, and `rejected.<reason>`: columns, number, checksum, range, length."""

    @abstractmethod
    def _make_sample(self, values: Mapping[str, float], header: SensorHeader) -> Sample:
        """Return the sample of a line's numbers in SI units."""

    @abstractmethod
    def _get_limit(self, name: str) -> float:
        """Return the largest magnitude of a field."""

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Wait for lines."""
        self._reader.clear()
        self._first_bytes = self._last_line = b""
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        return self._set_status(EndpointPhase.WAITING, "waiting for lines of text")

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process received bytes."""
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes += unit[: EXAMINED_BYTES - len(self._first_bytes)]
        out: list[Output[bytes]] = []
        for line, utime in self._reader.feed(unit, now.utime):
            out += self._on_line(line, utime, now)
        return out

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Report silence."""
        if self._silence_deadline_ns is None or now.monotonic_ns < self._silence_deadline_ns:
            return []
        self._silence_deadline_ns = None
        return self._set_status(EndpointPhase.SILENT, self._explain_silence())

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        return self._silence_deadline_ns

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []

    def _set_status(self, phase: EndpointPhase, text: str) -> list[Output[bytes]]:
        if (phase, text) == (self._phase, self._reported):
            return []
        self._phase, self._reported = phase, text
        return [EndpointStatus(phase, text)]

    def _explain_silence(self) -> str:
        head = f"no usable line for {self._settings.silence:g} s"
        if self._last_line:
            shown = quote(self._last_line.decode("ascii", "replace"), 80)
            wanted = f"{self._settings.columns} columns" + (
                f" beginning {quote(self._settings.starts_with)}" if self._settings.starts_with else ""
            )
            return f"{head}; the last one was {shown}, expected are {wanted}: check columns, separator and starts_with"
        return f"{head}; {recognize_line(self._first_bytes, self.device)}"

    def _on_line(self, line: bytes, utime: int, now: HostTime) -> list[Output[bytes]]:
        values = self._read(line)
        if values is None:
            return []
        device_utime = max(1, round(1e6 * values["time"])) if "time" in values else 0
        sample = self._make_sample(values, SensorHeader(0, self._settings.source, self._seq, utime, device_utime))
        self._seq += 1
        self.counts["samples"] += 1
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        status = self._set_status(EndpointPhase.STREAMING, f"receiving lines of {self._settings.columns} columns")
        return [MeasuredSample(sample, self._settings.delay, self._settings.delay_sigma, 1e-3), *status]

    def _read(self, line: bytes) -> dict[str, float] | None:
        """Return the numbers of a line in SI units; None, counted by reason, for one that is not used."""
        settings = self._settings
        self.counts["lines"] += 1
        self._last_line = line[:200]
        if len(line) > MAX_LINE:
            self.counts["rejected.length"] += 1
            return None
        text = line.decode("latin-1").strip()
        if settings.checksum == "xor":
            text, star, checksum = text.rpartition("*")
            body = text.removeprefix("$").encode("latin-1")
            if not star or checksum.upper() != f"{reduce(xor, body, 0):02X}":
                self.counts["rejected.checksum"] += 1
                return None
        if not text.startswith(settings.starts_with):
            self.counts["other_lines"] += 1
            return None
        columns = text.split(settings.separator) if settings.separator else text.split()
        if len(columns) != settings.columns:
            self.counts["rejected.columns"] += 1
            return None
        try:
            values = {
                name: float(columns[each.column]) * each.scale + each.offset for name, each in settings.fields.items()
            }
        except ValueError:
            self.counts["rejected.number"] += 1
            return None
        for name, value in values.items():
            if not abs(value) <= self._get_limit(name):
                self.counts["rejected.range"] += 1
                return None
        return values
