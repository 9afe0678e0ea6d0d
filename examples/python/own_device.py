"""A device of your own: a speed sensor that sends lines like `$SPD,1.23*hh`, m/s and the exclusive-or of the bytes.

Here its driver runs on a line and a clock that do as they are told; printed is what would go onto the bus. How to run
it on a real port stands in docs/own-device.md.

    python examples/python/own_device.py
"""

# ruff: noqa: D102 - what each method of a station is for stands in msdrivers.station

import re
from collections import Counter
from dataclasses import dataclass
from functools import reduce
from operator import xor

from modelserver.messages import NAN, Sample, SensorHeader, WheelSample, WheelsSample
from msdrivers.faulty import FaultyStation
from msdrivers.line_settings import SerialSettings, TcpSettings
from msdrivers.links.fake import FakeLink, FakeTime
from msdrivers.protocol.framing import CHANCE, Refused, Scanner, Taken
from msdrivers.registry import DeviceKind, DeviceModules, Emulation
from msdrivers.runner import Runner, RunnerSettings
from msdrivers.station import Measured, Now, Output, Send, StationPhase, StationStatus

LONGEST = 32

SAID = re.compile(rb"SPD,(-?\d{1,3}\.\d\d)")
"""What the device says and nothing else: float() would take nan, 1e9 and 1_0 too."""


def line(speed: float) -> bytes:
    """Return what the device sends for a speed."""
    body = f"SPD,{speed:.2f}".encode()
    return b"$%b*%02X\r\n" % (body, reduce(xor, body))


class SpeedFormat:
    """The parser: where a frame begins, and what it says. It knows no clock and no port."""

    leads = b"$"

    def scan(self, buffer: bytearray, at: int, start: int) -> Taken[float] | Refused | None:
        end = buffer.find(b"\r\n", at, at + LONGEST)
        if end < 0:
            return None if len(buffer) - at < LONGEST else CHANCE
        body, _, given = bytes(buffer[at + 1 : end]).partition(b"*")
        if b"%02X" % reduce(xor, body, 0) != given:
            return Refused("checksum")
        said = SAID.fullmatch(body)
        return Taken(end + 2, "speed", float(said[1])) if said else Refused("content")


@dataclass(frozen=True, slots=True)
class SpeedSettings:
    """The keys of its section in the vehicle file. Seconds, m/s."""

    source: str
    wheel: str = "speed"
    silence: float = 1.0
    sigma: float = 0.05
    delay: float = 0.03
    delay_sigma: float = 0.01


class Quiet:
    """The parts of a station that neither end needs here."""

    def opened(self, now: Now) -> list[Output[bytes]]:
        return []

    def received(self, unit: bytes, now: Now) -> list[Output[bytes]]:
        return []

    def leaving(self, now: Now) -> list[Output[bytes]]:
        return []


class SpeedDriver(Quiet):
    """The host's end of the line."""

    def __init__(self, settings: SpeedSettings) -> None:
        self._settings, self._scanner = settings, Scanner[float]([SpeedFormat()])
        self._silent_ns: int | None = None
        self._seq = 0

    def received(self, unit: bytes, now: Now) -> list[Output[bytes]]:
        outputs: list[Output[bytes]] = []
        for speed in self._scanner.feed(unit):
            if self._silent_ns is None:
                outputs.append(StationStatus(StationPhase.STREAMING, "$SPD comes"))
            self._silent_ns = now.monotonic_ns + round(self._settings.silence * 1e9)
            # the device has no time, so device_utime stays 0; utime is for the runner to find from `delay`
            header = SensorHeader(0, self._settings.source, self._seq, now.utime)
            wheel = WheelSample(self._settings.wheel, speed=speed, speed_sigma=self._settings.sigma, steering=NAN)
            outputs.append(Measured(WheelsSample(header, (wheel,)), self._settings.delay, self._settings.delay_sigma))
            self._seq += 1
        return outputs

    def woken(self, now: Now) -> list[Output[bytes]]:
        if self._silent_ns is None or now.monotonic_ns < self._silent_ns:
            return []
        self._silent_ns = None
        return [
            StationStatus(
                StationPhase.SILENT, f"no $SPD for {self._settings.silence:g} s: check its power, cable and baud"
            )
        ]

    def due(self) -> int | None:
        return self._silent_ns

    @property
    def counts(self) -> dict[str, int]:
        return self._scanner.counts


class SpeedUnit(Quiet):
    """The device's end, in software: says the speed of each sample at its stamp."""

    def __init__(self, wanted: Emulation) -> None:
        self._samples, self.counts = iter(wanted.samples), Counter[str]()
        self._next, self._shift_ns = next(self._samples, None), 0

    def opened(self, now: Now) -> list[Output[bytes]]:
        self._shift_ns = now.monotonic_ns - now.utime * 1000
        return []

    def woken(self, now: Now) -> list[Output[bytes]]:
        said, self._next = self._next, next(self._samples, None)
        self.counts["lines"] += 1
        return [] if said is None else [Send(line(said.wheels[0].speed))]

    def due(self) -> int | None:
        return None if self._next is None else self._next.header.utime * 1000 + self._shift_ns


KIND = DeviceKind(
    "speed",
    "speed sensor that sends $SPD",
    WheelsSample,
    (SerialSettings, TcpSettings),
    lambda: DeviceModules(SpeedSettings, lambda settings, _: SpeedDriver(settings)),
    lambda wanted: FaultyStation(lambda: SpeedUnit(wanted), wanted.faults),
    baud=9600,
)

if __name__ == "__main__":
    time, published = FakeTime(), list[Sample]()
    coming = [(1.1, line(1.23)), (1.2, line(1.24).replace(b"4", b"5", 1)), (1.3, line(1.25))]
    how = RunnerSettings("radar", "speed")
    runner = Runner(SpeedDriver(SpeedSettings("radar")), FakeLink(time, coming), how, time, published.append)
    while time.monotonic_ns < 3_000_000_000:
        runner.turn()
    print(*published, runner.health(time.now()), sep="\n")
