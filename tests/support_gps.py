"""An emulated receiver and its driver on one line with scripted instants: no port, no clock."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from modelserver.messages import FixType, GpsSample, SensorHeader
from msdrivers.endpoint import Endpoint, EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send

START = 1_700_000_000_000_000
SECOND = 1_000_000
BOOT_NS = 5_000_000_000
"""Monotonic nanoseconds at START."""


def now_at(utime: int) -> HostTime:
    return HostTime(BOOT_NS + (utime - START) * 1000, utime)


def drive(seconds: float, rate: float = 20.0, fix_type: FixType = FixType.DIFFERENTIAL) -> Iterator[GpsSample]:
    """A drive to the north-east at 2 m/s, as a receiver measures it."""
    for n in range(round(seconds * rate)):
        t = n / rate
        yield GpsSample(
            SensorHeader(START + round(t * SECOND), "truth", n),
            fix_type,
            50.0 + t * 1e-5,
            -111.0 + t * 1e-5,
            height_ellipsoidal=680.0,
            height_msl=700.0,
            undulation=-20.0,
            satellites=9,
            hdop=0.9,
            vdop=1.2,
            pdop=1.5,
            position_covariance=(0.04, 0.0, 0.0, 0.0, 0.09, 0.0, 0.0, 0.0, 0.16),
            velocity=(math.sqrt(2.0), math.sqrt(2.0), 0.1),
            velocity_latency=0.15,
            speed=2.0,
            course=math.pi / 4.0,
        )


@dataclass
class Line:
    """Passes the output of one to the other.

    to_host: what the line makes of the bytes to the driver, e.g. noise between them; one chunk to any number.
    is_broken: nothing passes. device_baud: at another rate the driver receives garbage and the device nothing.
    """

    driver: Endpoint[bytes]
    device: Endpoint[bytes]
    to_host: Callable[[bytes], Sequence[bytes]] = lambda data: [data]
    utime: int = START
    is_broken: bool = False
    device_baud: int | None = None
    baud: int | None = None
    measured: list[MeasuredSample] = field(default_factory=list)
    statuses: list[EndpointStatus] = field(default_factory=list)
    reopens: list[Reopen] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)

    @property
    def now(self) -> HostTime:
        return now_at(self.utime)

    @property
    def samples(self) -> list[Any]:
        return [each.sample for each in self.measured]

    @property
    def status_text(self) -> str:
        return "\n".join(f"{each.phase.name.lower()}: {each.text}" for each in self.statuses)

    @property
    def phases(self) -> list[EndpointPhase]:
        phases = [each.phase for each in self.statuses]
        return [each for n, each in enumerate(phases) if n == 0 or each is not phases[n - 1]]

    def open(self) -> Line:
        self.from_driver(self.driver.on_open(self.now))
        self.from_device(self.device.on_open(self.now))
        return self

    def run(self, seconds: float) -> Line:
        """Let time pass; fire the timers of both at their deadlines."""
        end = self.utime + round(seconds * SECOND)
        for _ in range(1_000_000):
            due = min(
                (each for each in (self.driver.get_deadline(), self.device.get_deadline()) if each is not None),
                default=None,
            )
            wake = end if due is None else max(self.utime, START + -(-(due - BOOT_NS) // 1000))
            if wake >= end:
                self.utime = end
                return self
            self.utime = wake
            for station, carry in ((self.device, self.from_device), (self.driver, self.from_driver)):
                asked = station.get_deadline()
                if asked is not None and asked <= self.now.monotonic_ns:
                    carry(station.on_timer(self.now))
                    asked = station.get_deadline()
                    assert asked is None or asked > self.now.monotonic_ns, f"{station}: deadline does not advance"
        raise AssertionError("a million timer events")

    def from_device(self, outputs: Sequence[Output[bytes]]) -> None:
        for each in outputs:
            if isinstance(each, Send) and not self.is_broken:
                unit = each.unit
                if self.baud != self.device_baud:
                    unit = bytes((byte * 7 + 128) & 0xFF | 0x80 for byte in unit)
                for chunk in self.to_host(unit):
                    self.deliver(chunk)

    def deliver(self, data: bytes) -> None:
        """Deliver bytes to the driver."""
        self.from_driver(self.driver.on_receive(data, self.now))

    def from_driver(self, outputs: Sequence[Output[bytes]]) -> None:
        for each in outputs:
            match each:
                case Send(unit):
                    self.sent.append(unit)
                    if not self.is_broken and self.baud == self.device_baud:
                        self.from_device(self.device.on_receive(unit, self.now))
                case MeasuredSample():
                    self.measured.append(each)
                case EndpointStatus():
                    self.statuses.append(each)
                case Reopen():
                    self.reopens.append(each)
                    self.baud = each.baud
                    self.from_driver(self.driver.on_open(self.now))


def split_in_half(data: bytes) -> Sequence[bytes]:
    return [data[: len(data) // 2], data[len(data) // 2 :]]


def add_noise(seed: int, most: int = 40) -> Callable[[bytes], Sequence[bytes]]:
    """Noise between the chunks, and one byte in 2000 damaged."""
    chance = random.Random(seed)

    def line(data: bytes) -> Sequence[bytes]:
        damaged = bytes(byte ^ 0x55 if chance.random() < 0.0005 else byte for byte in data)
        return [chance.randbytes(chance.randrange(most)), damaged]

    return line


def split_randomly(data: bytes, seed: int) -> list[bytes]:
    chance = random.Random(seed)
    parts = []
    at = 0
    while at < len(data):
        size = chance.randrange(1, 200)
        parts.append(data[at : at + size])
        at += size
    return parts
