"""Emulator of an inertial unit that sends lines of text, as the settings of its driver describe them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from modelserver.messages import ImuSample
from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol.text_lines import LineDescription, encode_line

CELSIUS = 25.0


class TextImuEmulator:
    """An `Endpoint` of bytes that sends a line for each sample. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], settings: LineDescription) -> None:
        self._samples: Iterator[ImuSample] = iter(samples)
        self._next = next(self._samples, None)
        self._settings = settings
        self._first_utime: int | None = None
        self._now: HostTime | None = None
        self.counts: Counter[str] = Counter()
        """Lines sent."""

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open; a unit does not notice."""
        self._now = now
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Ignore what the host sends."""
        self._now = now
        return []

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send the lines of the samples up to now."""
        self._now = now
        out: list[Output[bytes]] = []
        while self._next is not None and self._next.header.utime <= now.utime:
            out.append(Send(self._encode(self._next)))
            self.counts["lines"] += 1
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        """Return when the next sample is due."""
        if self._now is None or self._next is None:
            return None
        return self._now.monotonic_ns + (self._next.header.utime - self._now.utime) * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send nothing."""
        return []

    def _encode(self, sample: ImuSample) -> bytes:
        self._first_utime = sample.header.utime if self._first_utime is None else self._first_utime
        values = {name: self._get_value(sample, name) for name in self._settings.fields}
        return encode_line(self._settings, values)

    def _get_value(self, sample: ImuSample, name: str) -> float:
        assert self._first_utime is not None
        if name == "time":
            return 1.0 + (sample.header.utime - self._first_utime) * 1e-6
        if name == "temperature":
            return CELSIUS
        vector = getattr(sample, name[:-2])
        return 0.0 if vector is None else float(vector["xyz".index(name[-1])])
