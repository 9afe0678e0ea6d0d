"""Emulator of a VectorNav VN-100: applies commands, sends its binary output, or text as it does from its maker."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from modelserver.messages import ImuSample
from msdrivers.emulate.sample_emulator import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol import vectornav as vn
from msdrivers.protocol.vectornav import FIELD_BYTES, VnStream, VnText


@dataclass(frozen=True, slots=True)
class VectornavUnit:
    """A unit. baud: of its line, by which it rejects too much output. celsius: its temperature.

    start_ns: its clock at its first sample.
    """

    baud: int = 115200
    celsius: float = 31.5
    start_ns: int = 5_000_000_000


class VectornavEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that speaks as the unit does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], unit: VectornavUnit | None = None) -> None:
        self._unit = VectornavUnit() if unit is None else unit
        super().__init__(samples)
        self._first_utime: int | None = None
        self._stream = VnStream()
        self._text_hz = {1: 40, 2: 0}
        self._keys: tuple[tuple[int, int], ...] = ()
        self._divisor = 0
        self._sent_us: int | None = None

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process commands."""
        self._now = now
        out: list[Output[bytes]] = []
        # a command ends with its line; a following byte completes it here
        for message in self._stream.feed(unit):
            if isinstance(message, VnText):
                error = self._execute(message.words)
                self.counts["rejected" if error else "accepted"] += 1
                out.append(Send(vn.encode_text(f"ERR,{error:02X}" if error else self._answer(message.words))))
        return out

    def _send_sample(self, sample: ImuSample) -> list[Output[bytes]]:
        data = self._encode(sample)
        return [Send(data)] if data else []

    def _answer(self, words: tuple[str, ...]) -> str:
        return "RRG,01,VN-100T-CR" if words[0] == "RRG" else ",".join(words)

    def _execute(self, words: tuple[str, ...]) -> int:
        """Apply a command; return the code of an error, 0 for none."""
        try:
            numbers = [int(word) for word in words[1:4]]
        except ValueError:
            return 0x07
        if words[0] == "RRG":
            return 0 if numbers[:1] == [1] else 0x08
        if words[0] != "WRG" or len(numbers) < 2:
            return 0x04
        register, value, *rest = numbers
        if register == 6:
            port = rest[0] if rest else 1
            before, self._text_hz[port] = self._text_hz.get(port, 0), 40 if value else 0
            if self._compute_load() > self._unit.baud:
                self._text_hz[port] = before
                return 0x0C
            return 0
        return self._set_binary(value, rest, words) if register == 75 else 0x08

    def _set_binary(self, port: int, rest: list[int], words: tuple[str, ...]) -> int:
        try:
            groups, masks = int(words[4], 16), [int(word, 16) for word in words[5:]]
        except (ValueError, IndexError):
            return 0x05
        present = [bit + 1 for bit in range(8) if groups >> bit & 1]
        if len(masks) != len(present) or any(group not in FIELD_BYTES for group in present):
            return 0x07
        before = self._keys, self._divisor
        self._keys = tuple(
            (group, bit)
            for group, mask in zip(present, masks, strict=True)
            for bit in range(len(FIELD_BYTES[group]))
            if mask >> bit & 1
        )
        self._divisor = rest[0] if port else 0
        if self._compute_load() > self._unit.baud:
            self._keys, self._divisor = before
            return 0x0C
        return 0

    def _compute_load(self) -> float:
        """Return the bits a second of all outputs together; a line of text has 122 bytes."""
        text = sum(self._text_hz.values()) * 122 * 10
        return text + (vn.compute_size(self._keys) * 10 * vn.BASE_RATE_HZ / self._divisor if self._divisor else 0.0)

    def _encode(self, sample: ImuSample) -> bytes:
        utime = sample.header.utime
        self._first_utime = utime if self._first_utime is None else self._first_utime
        rate_hz = vn.BASE_RATE_HZ / self._divisor if self._divisor else self._text_hz[1]
        if not rate_hz or (self._sent_us is not None and utime - self._sent_us < 1e6 / rate_hz - 500):
            return b""
        self._sent_us = utime
        self.counts["messages"] += 1
        if not self._divisor:
            field, force, rate = sample.magnetic_field, sample.specific_force, sample.angular_velocity
            values = ((0.0,) * 3, [x / vn.GAUSS for x in field or (0.0,) * 3], force or (0.0,) * 3, rate or (0.0,) * 3)
            return vn.encode_text("YMR," + ",".join(f"{number:+.4f}" for each in values for number in each))
        time_ns = self._unit.start_ns + (utime - self._first_utime) * 1000
        return vn.encode_binary({key: self._encode_field(key, sample, time_ns) for key in self._keys})

    def _encode_field(self, key: tuple[int, int], sample: ImuSample, time_ns: int) -> bytes:
        if key == vn.TIME:
            return time_ns.to_bytes(8, "little")
        numbers: Sequence[float] | None = None
        if key == vn.QUATERNION and sample.orientation is not None:
            w, x, y, z = sample.orientation
            numbers = (x, y, z, w)
        elif key == vn.RATE:
            numbers = sample.angular_velocity
        elif key == vn.ACCELERATION:
            numbers = sample.specific_force
        elif key == vn.MAGNETIC and sample.magnetic_field is not None:
            numbers = [each / vn.GAUSS for each in sample.magnetic_field]
        elif key == vn.TEMPERATURE:
            numbers = (self._unit.celsius,)
        size = FIELD_BYTES[key[0]][key[1]]
        return (
            bytes(size) if numbers is None else struct.pack(f"<{size // 4}f", *(_to_finite(each) for each in numbers))
        )


def _to_finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
