"""A driver of your own: a speed sensor that sends lines like `$SPD,1.23*hh`, m/s and the exclusive-or of the bytes.

Here the driver runs on a scripted connection and clock, and what it would publish is printed. docs/own-device.md
explains how to run it on a real port.

    python examples/python/own_device.py
"""

import re
from collections import Counter
from dataclasses import dataclass
from functools import reduce
from operator import xor

from modelserver.messages import NAN, Sample, SensorHeader, WheelSample, WheelsSample
from msdrivers.devices.stream import NO_FRAME, FrameScanner, ParsedFrame, RejectedFrame
from msdrivers.emulate import FaultInjector
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Send
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.registry import DeviceKind, DeviceModules, EmulatorInputs, SerialSettings, TcpSettings
from msdrivers.runner import Runner, RunnerSettings

MAX_FRAME_LENGTH = 32

CONTENT = re.compile(rb"SPD,(-?\d{1,3}\.\d\d)")
"""The content of a frame and nothing else: float() would also accept nan, 1e9 and 1_0."""


def encode_speed(speed: float) -> bytes:
    """Encode a frame."""
    body = f"SPD,{speed:.2f}".encode()
    return b"$%b*%02X\r\n" % (body, reduce(xor, body))


class SpeedFormat:
    """The parser: finds and decodes frames, without a clock or a port."""

    start_bytes = b"$"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[float] | RejectedFrame | None:
        end = buffer.find(b"\r\n", at, at + MAX_FRAME_LENGTH)
        if end < 0:
            return None if len(buffer) - at < MAX_FRAME_LENGTH else NO_FRAME
        body, _, given = bytes(buffer[at + 1 : end]).partition(b"*")
        if b"%02X" % reduce(xor, body, 0) != given:
            return RejectedFrame("checksum")
        content = CONTENT.fullmatch(body)
        return ParsedFrame(end + 2, "speed", float(content[1])) if content else RejectedFrame("content")


@dataclass(frozen=True, slots=True)
class SpeedSettings:
    """The keys of the driver's section in the vehicle file, in seconds and m/s."""

    source: str
    wheel: str = "speed"
    silence: float = 1.0
    sigma: float = 0.05
    delay: float = 0.03
    delay_sigma: float = 0.01


class EndpointDefaults:
    """Methods of an endpoint that neither end needs here."""

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        return []

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        return []


class SpeedDriver(EndpointDefaults):
    """The driver: the host's end of the connection."""

    def __init__(self, settings: SpeedSettings) -> None:
        self._settings, self._scanner = settings, FrameScanner[float]([SpeedFormat()])
        self._silent_ns: int | None = None
        self._seq = 0

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        outputs: list[Output[bytes]] = []
        for speed in self._scanner.feed(unit):
            if self._silent_ns is None:
                outputs.append(EndpointStatus(EndpointPhase.STREAMING, "receiving $SPD"))
            self._silent_ns = now.monotonic_ns + round(self._settings.silence * 1e9)
            # the device has no clock, so device_utime stays 0; the runner computes utime from `delay`
            header = SensorHeader(0, self._settings.source, self._seq, now.utime)
            wheel = WheelSample(self._settings.wheel, speed=speed, speed_sigma=self._settings.sigma, steering=NAN)
            sample = WheelsSample(header, (wheel,))
            outputs.append(MeasuredSample(sample, self._settings.delay, self._settings.delay_sigma))
            self._seq += 1
        return outputs

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        if self._silent_ns is None or now.monotonic_ns < self._silent_ns:
            return []
        self._silent_ns = None
        text = f"no $SPD for {self._settings.silence:g} s: check its power, cable and baud"
        return [EndpointStatus(EndpointPhase.SILENT, text)]

    def get_deadline(self) -> int | None:
        return self._silent_ns

    @property
    def counts(self) -> dict[str, int]:
        return self._scanner.counts


class SpeedEmulator(EndpointDefaults):
    """The emulator: the device's end, which sends the speed of each sample at its stamp."""

    def __init__(self, inputs: EmulatorInputs) -> None:
        self._samples, self.counts = iter(inputs.samples), Counter[str]()
        self._next, self._shift_ns = next(self._samples, None), 0

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        self._shift_ns = now.monotonic_ns - now.utime * 1000
        return []

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        sample, self._next = self._next, next(self._samples, None)
        self.counts["lines"] += 1
        return [] if sample is None else [Send(encode_speed(sample.wheels[0].speed))]

    def get_deadline(self) -> int | None:
        return None if self._next is None else self._next.header.utime * 1000 + self._shift_ns


KIND = DeviceKind(
    "speed",
    "speed sensor that sends $SPD",
    WheelsSample,
    (SerialSettings, TcpSettings),
    lambda: DeviceModules(SpeedSettings, lambda settings, _: SpeedDriver(settings)),
    lambda inputs: FaultInjector(lambda: SpeedEmulator(inputs), inputs.faults),
    baud=9600,
)

if __name__ == "__main__":
    time, published = FakeTimeSource(), list[Sample]()
    data = [(1.1, encode_speed(1.23)), (1.2, encode_speed(1.24).replace(b"4", b"5", 1)), (1.3, encode_speed(1.25))]
    driver, link, settings = SpeedDriver(SpeedSettings("radar")), FakeLink(time, data), RunnerSettings("radar", "speed")
    runner = Runner(driver, link, settings, time, published.append)
    while time.monotonic_ns < 3_000_000_000:
        runner.run_once()
    print(*published, runner.make_health(time.now()), sep="\n")
