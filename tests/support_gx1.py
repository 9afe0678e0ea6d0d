"""A driver and an emulated 3DM-GX1 on one line, with scripted instants instead of clocks and ports."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from modelserver.messages import ImuSample, OrientationReference, SensorHeader
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3
from msdrivers.emulate.imu import Gx1Emulator
from msdrivers.endpoint import Endpoint, EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send

START_UTIME = 1_700_000_000_000_000
FIELD_NED: Vector3 = (18e-6, 0.0, 50e-6)
GRAVITY = 9.80665

DOCUMENTED_REPLIES = {
    0x31: bytes.fromhex("31 00b6 fe94 4000 0000 0000 edb7 0027 ffd9 0182 03e8 329c"),
    0x07: bytes.fromhex("07 2560 03e8 294f"),
    0x0E: bytes.fromhex("0e 2000 2000 2000 ffff 600d"),
}
"""Worked replies of the protocol's description."""


def rotating_samples(rate: Vector3 = (0.0, 0.0, 0.2), seconds: float = 60.0, hz: float = 100.0) -> Iterator[ImuSample]:
    """Yield samples of a unit that turns at a constant rate about its own axes, where it begins level and north."""
    for k in range(round(seconds * hz) + 1):
        t = k / hz
        q = so3.exponential((rate[0] * t, rate[1] * t, rate[2] * t))
        back = so3.conjugate(q)
        yield ImuSample(
            SensorHeader(START_UTIME + round(t * 1e6), "truth", k),
            angular_velocity=rate,
            specific_force=so3.rotate(back, (0.0, 0.0, -GRAVITY)),
            magnetic_field=so3.rotate(back, FIELD_NED),
            orientation=q,
            orientation_reference=OrientationReference.NED,
        )


def stationary_samples(seconds: float = 60.0) -> Iterator[ImuSample]:
    """Yield samples of a unit at rest."""
    return rotating_samples((0.0, 0.0, 0.0), seconds)


@dataclass
class Line:
    """Carries bytes between a host's and a device's station. Units come after `flight_s`, to the host in pieces.

    `baud`: the device's; at another one it is not understood. `spoil` changes what comes to the host.
    """

    host: Endpoint[bytes]
    device: Endpoint[bytes]
    baud: int = 38400
    flight_s: float = 0.002
    pieces: random.Random | None = None
    corrupt: Callable[[bytes], bytes] = bytes
    now_ns: int = 5_000_000_000
    samples: list[MeasuredSample] = field(default_factory=list)
    statuses: list[EndpointStatus] = field(default_factory=list)
    reopens: list[Reopen] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    host_baud: int = 38400
    _to_host: list[tuple[int, bytes]] = field(default_factory=list)
    _to_device: list[tuple[int, bytes]] = field(default_factory=list)
    _is_started: bool = False

    def now(self) -> HostTime:
        return HostTime(self.now_ns, START_UTIME + (self.now_ns - 5_000_000_000) // 1000)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        until = self.now_ns + round(seconds * 1e9)
        if not self._is_started:
            self._is_started = True
            self._from_device(self.device.on_open(self.now()))
            self._from_host(self.host.on_open(self.now()))
        turns = 0
        while (at := self._next()) <= until:
            turns = turns + 1 if at <= self.now_ns else 0
            assert turns < 1000, "a station is due again and again at the same instant"
            self.now_ns = max(at, self.now_ns)
            self._step()
        self.now_ns = until

    def close(self) -> None:
        """Close the line in order."""
        self._from_host(self.host.on_close(self.now()))
        for _, unit in self._to_device:
            self.device.on_receive(unit, self.now())
        self._to_device.clear()

    def status_texts(self, phase: EndpointPhase | None = None) -> list[str]:
        return [status.text for status in self.statuses if phase in (None, status.phase)]

    def _next(self) -> int:
        instants = [due for due in (self.host.get_deadline(), self.device.get_deadline()) if due is not None]
        return min([*instants, *(at for at, _ in self._to_host[:1] + self._to_device[:1])], default=1 << 62)

    def _step(self) -> None:
        now = self.now()
        while self._to_device and self._to_device[0][0] <= self.now_ns:
            unit = self._to_device.pop(0)[1]
            self._from_device(self.device.on_receive(unit, now))
        while self._to_host and self._to_host[0][0] <= self.now_ns:
            self._from_host(self.host.on_receive(self._to_host.pop(0)[1], now))
        for station, take in ((self.device, self._from_device), (self.host, self._from_host)):
            due = station.get_deadline()
            if due is not None and due <= self.now_ns:
                take(station.on_timer(now))

    def _from_device(self, outputs: object) -> None:
        for output in outputs:  # type: ignore[attr-defined]
            if not isinstance(output, Send):
                continue
            unit = self.corrupt(output.unit)
            if self.host_baud != self.baud:
                unit = bytes(byte ^ 0xA5 for byte in unit[::3])
            for piece in self._cut(unit):
                self._to_host.append((self.now_ns + round(self.flight_s * 1e9), piece))

    def _from_host(self, outputs: object) -> None:
        pending: list[Output[bytes]] = list(outputs)  # type: ignore[call-overload]
        while pending:
            output = pending.pop(0)
            if isinstance(output, Send):
                self.sent.append(output.unit)
                if self.host_baud == self.baud:
                    self._to_device.append((self.now_ns + round(self.flight_s * 1e9), output.unit))
            elif isinstance(output, MeasuredSample):
                self.samples.append(output)
            elif isinstance(output, EndpointStatus):
                self.statuses.append(output)
            else:
                self.reopens.append(output)
                self.host_baud = output.baud or self.host_baud
                self._to_host.clear()
                pending += self.host.on_open(self.now())

    def _cut(self, unit: bytes) -> list[bytes]:
        if self.pieces is None or len(unit) < 2:
            return [unit] if unit else []
        at = self.pieces.randrange(1, len(unit))
        return [unit[:at], unit[at:]]


class RepeatingDevice:
    """Another device on the line: repeats one text, whatever it receives."""

    def __init__(self, unit: bytes, period_s: float = 0.1):
        self.unit, self.period_ns, self.next_ns = unit, round(period_s * 1e9), 0
        self.counts: dict[str, int] = {}

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        self.next_ns = now.monotonic_ns
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        return []

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        self.next_ns += self.period_ns
        return [Send(self.unit)] if self.unit else []

    def get_deadline(self) -> int | None:
        return self.next_ns

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        return []


def angle_between(a: so3.Quaternion, b: so3.Quaternion) -> float:
    return math.hypot(*so3.logarithm(so3.multiply(so3.conjugate(a), b)))


__all__ = [
    "DOCUMENTED_REPLIES",
    "FIELD_NED",
    "GRAVITY",
    "Gx1Emulator",
    "Line",
    "RepeatingDevice",
    "angle_between",
    "rotating_samples",
    "stationary_samples",
]
