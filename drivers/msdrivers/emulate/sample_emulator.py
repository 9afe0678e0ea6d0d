"""Common part of the emulators of devices that measure a series of samples: what is due, and when."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Generic, TypeVar

from modelserver.messages import GpsSample, ImuSample
from msdrivers.endpoint import HostTime, Output

S = TypeVar("S", GpsSample, ImuSample)


class SampleEmulator(ABC, Generic[S]):
    """An `Endpoint` of bytes at the device's end of a line. `samples` are in the order of their stamps.

    `latency` is the time from the instant of a sample to its first byte, seconds.
    """

    def __init__(self, samples: Iterable[S], latency: float = 0.0) -> None:
        self._samples: Iterator[S] = iter(samples)
        self._next: S | None = next(self._samples, None)
        self._latency_us = round(latency * 1e6)
        self._now: HostTime | None = None
        self.counts: Counter[str] = Counter()
        """What was sent and received, by kind."""

    @abstractmethod
    def _send_sample(self, sample: S) -> Sequence[Output[bytes]]:
        """Return what the device sends for a sample."""

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open; a device does not notice."""
        self._now = now
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        return []

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send the samples up to now."""
        self._now = now
        out: list[Output[bytes]] = []
        while self._next is not None and self._next.header.utime + self._latency_us <= now.utime:
            out += self._send_sample(self._next)
            self._next = next(self._samples, None)
        return out

    def get_deadline(self) -> int | None:
        """Return when the next sample is due."""
        if self._now is None or self._next is None:
            return None
        return self._now.monotonic_ns + (self._next.header.utime + self._latency_us - self._now.utime) * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []
