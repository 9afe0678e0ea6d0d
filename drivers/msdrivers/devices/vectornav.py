"""VectorNav VN-100: binary output, ASCII messages, commands; and the driver, which switches the binary output on.

A binary message is FA, the groups (one bit each), a 16-bit field mask for each group, the fields in the order of their
bits, little-endian, and CRC-16 (CCITT, initial 0), high byte first. It has no length: that follows from the masks. An
ASCII message is `$VN`, text, `*`, the exclusive-or of the characters between, in hexadecimal. Source: VectorNav, VN-100
user manual UM001, 4 and 5. Axes: x forward, y right, z down.
"""

from __future__ import annotations

import math
import re
import struct
from binascii import crc_hqx
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Final, TypeAlias

from modelserver.messages import NAN, ImuSample, OrientationReference, YawSource
from msdrivers.devices import check_choice, check_ranges, make_orientation
from msdrivers.devices.stream import NO_FRAME, ByteSettings, ParsedFrame, RejectedFrame, SetupStep, StreamDriver
from msdrivers.endpoint import HostTime, Output

SYNC: Final = 0xFA

FIELD_BYTES: Final[Mapping[int, tuple[int, ...]]] = {
    1: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    2: (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    3: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2),
    5: (2, 12, 16, 36, 12, 12, 12, 12, 12),
}
"""Bytes of the fields of each group, by bit. Groups 4, 6 and 7 (GNSS, INS) do not exist on a VN-100."""

TIME, QUATERNION = (1, 0), (1, 4)
MAGNETIC, ACCELERATION, RATE, TEMPERATURE = (3, 1), (3, 2), (3, 3), (3, 4)

WANTED: Final = (TIME, QUATERNION, MAGNETIC, ACCELERATION, RATE, TEMPERATURE)
"""Fields that are asked for: those of the sensors without the corrections of the unit's own filter, whose estimate of
the gyro bias would be a second one beside that of the localization."""

BASE_RATE_HZ: Final = 800
"""Rate of the unit, which is divided by a whole number."""

MAX_TEXT: Final = 256

GAUSS: Final = 1e-4
"""Tesla."""

_TEXT: Final = re.compile(rb"\$VN([^*\r\n$]{0,%d})\*([0-9A-Fa-f]{2})(?![0-9A-Fa-f])" % MAX_TEXT)


@dataclass(frozen=True, slots=True)
class VnBinary:
    """A binary message: its fields' bytes by (group, bit), and the offset of its first byte in the stream."""

    fields: Mapping[tuple[int, int], bytes]
    start: int

    def get_floats(self, key: tuple[int, int]) -> tuple[float, ...] | None:
        """Return the numbers of a field of float32; None if the message does not have it."""
        data = self.fields.get(key)
        return None if data is None else struct.unpack(f"<{len(data) // 4}f", data)

    @property
    def time_ns(self) -> int | None:
        """Nanoseconds since the unit started (TimeStartup); None if the message does not have it."""
        data = self.fields.get(TIME)
        return None if data is None else int.from_bytes(data, "little")


@dataclass(frozen=True, slots=True)
class VnText:
    """An ASCII message without `$VN` and checksum, e.g. RRG,01,VN-100, split at its commas."""

    words: tuple[str, ...]
    start: int = field(default=0, compare=False)


VnMessage: TypeAlias = VnBinary | VnText


class VnBinaryFormat:
    """A `FrameFormat` of binary messages."""

    start_bytes = bytes((SYNC,))

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[VnMessage] | RejectedFrame | None:
        if len(buffer) < at + 2:
            return None
        groups = [bit + 1 for bit in range(8) if buffer[at + 1] >> bit & 1]
        if not groups or any(group not in FIELD_BYTES for group in groups):
            return NO_FRAME
        begin = at + 2 + 2 * len(groups)
        if len(buffer) < begin:
            return None
        keys = []
        for number, group in enumerate(groups):
            mask = int.from_bytes(buffer[at + 2 + 2 * number : at + 4 + 2 * number], "little")
            if mask == 0 or mask >> len(FIELD_BYTES[group]):
                return NO_FRAME
            keys += [(group, bit) for bit in range(len(FIELD_BYTES[group])) if mask >> bit & 1]
        end = begin + sum(FIELD_BYTES[group][bit] for group, bit in keys) + 2
        if len(buffer) < end:
            return None
        if crc_hqx(bytes(buffer[at + 1 : end]), 0):
            return RejectedFrame("checksum")
        fields = {}
        for group, bit in keys:
            size = FIELD_BYTES[group][bit]
            fields[group, bit] = bytes(buffer[begin : begin + size])
            begin += size
        return ParsedFrame(end, "binary", VnBinary(fields, start))


class VnTextFormat:
    """A `FrameFormat` of ASCII messages."""

    start_bytes = b"$"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[VnMessage] | RejectedFrame | None:
        head = bytes(buffer[at : at + 3])
        if not b"$VN".startswith(head):
            return NO_FRAME
        found = _TEXT.match(buffer, at)
        if found is None:
            is_open = len(buffer) - at < MAX_TEXT and not any(each in buffer[at + 1 :] for each in b"\r\n$")
            return None if is_open else RejectedFrame("text")
        # a further digit would belong to a checksum of four
        if found.end() == len(buffer):
            return None
        if reduce(xor, b"VN" + found[1], 0) != int(found[2], 16):
            return RejectedFrame("checksum")
        words = tuple(found[1].decode("latin-1").split(","))
        return ParsedFrame(found.end(), f"text.{words[0][:3]}", VnText(words, start))


def encode_text(text: str) -> bytes:
    """Return an ASCII message, e.g. of RRG,01."""
    body = f"VN{text}"
    return f"${body}*{reduce(xor, body.encode('latin-1'), 0):02X}\r\n".encode("latin-1")


def _make_masks(keys: Iterable[tuple[int, int]]) -> tuple[int, list[int]]:
    """Return the byte of the groups, and the masks of their fields."""
    masks: dict[int, int] = {}
    for group, bit in keys:
        masks[group] = masks.get(group, 0) | 1 << bit
    return sum(1 << group - 1 for group in masks), [masks[group] for group in sorted(masks)]


def encode_binary(fields: Mapping[tuple[int, int], bytes]) -> bytes:
    """Return a binary message of fields' bytes by (group, bit)."""
    groups, masks = _make_masks(fields)
    body = bytes((groups,)) + b"".join(mask.to_bytes(2, "little") for mask in masks)
    body += b"".join(fields[key] for key in sorted(fields))
    return bytes((SYNC,)) + body + crc_hqx(body, 0).to_bytes(2, "big")


def make_setup(rate_hz: float, port: int) -> tuple[SetupStep, ...]:
    """Return what sets a unit up, in its volatile memory: ASCII output off on both ports, then the binary output.

    The ASCII output must be off first: together they may exceed the baud rate (error 0C).
    """
    groups, masks = _make_masks(WANTED)
    divisor = max(1, round(BASE_RATE_HZ / rate_hz))
    words = ",".join(f"{mask:04X}" for mask in masks)
    return (
        *(SetupStep(encode_text(f"WRG,06,0,{each}"), f"no text on port {each}", is_optional=True) for each in (1, 2)),
        SetupStep(
            encode_text(f"WRG,75,{port},{divisor},{groups:02X},{words}"), f"{BASE_RATE_HZ / divisor:g} Hz binary output"
        ),
    )


ERRORS: Final = {
    0x01: "hard fault",
    0x02: "its input buffer overflowed",
    0x03: "wrong checksum",
    0x04: "unknown command",
    0x05: "too few parameters",
    0x06: "too many parameters",
    0x07: "wrong parameter",
    0x08: "unknown register; is this a VN-100 with recent firmware?",
    0x09: "no access",
    0x0A: "watchdog",
    0x0B: "its output buffer overflowed: a lower rate_hz, or a higher baud rate",
    0x0C: "the baud rate is too low for this output: a lower rate_hz, or a higher baud rate of the unit (register 5)",
}
"""Meaning of the code in `$VNERR`."""

MAX_RATE, MAX_ACCELERATION = 40.0, 400.0
"""Beyond the ranges of the unit, 2000 deg/s and 16 g, with room: rad/s, m/s2."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VectornavSettings(ByteSettings):
    """Settings of a VN-100. Raises ValueError with the key for an invalid value."""

    rate_hz: float = 100.0
    """Samples per second: 800 divided by a whole number. 115200 baud carry 140 Hz."""
    unit_port: int = 1
    """Serial port of the unit that this line is at, 1 or 2."""
    heading: str = "magnetic"
    """What the yaw of its orientation is measured against: `magnetic`, or `none` where its magnetometers are off."""
    bauds: tuple[int, ...] = (115200, 921600, 460800, 230400)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_ranges(self, rate_hz=(1.0, 800.0), unit_port=(1, 2))
        check_choice(self, heading=("magnetic", "none"))


class VectornavDriver(StreamDriver[VnMessage]):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `VectornavSettings`.

    Further counts: `lost` samples, by the unit's clock; `rejected.range` vectors.
    """

    device = "vectornav"
    description = "VectorNav unit"
    awaited = "binary output"
    formats = (VnBinaryFormat(), VnTextFormat())
    identification = encode_text("RRG,01")
    answer_timeout = 0.3

    def __init__(self, settings: VectornavSettings) -> None:
        super().__init__(settings)
        self._rate_hz, self._port = settings.rate_hz, settings.unit_port
        self._yaw_source = YawSource.MAGNETIC if settings.heading == "magnetic" else YawSource.NONE
        self._last_ns: int | None = None

    def _on_start(self) -> None:
        self._last_ns = None

    def _on_message(self, message: VnMessage, now: HostTime) -> list[Output[bytes]]:
        if isinstance(message, VnBinary):
            return self._on_binary(message, now)
        words, step = message.words, self._step
        if words[0] == "RRG" and len(words) > 2 and words[1].lstrip("0") == "1":
            return self._on_identity(words[2].strip() or "VectorNav unit", make_setup(self._rate_hz, self._port), now)
        if words[0] == "ERR" and step is not None:
            return self._on_acknowledgement(now, _describe_error(words))
        if words[0] == "WRG" and step is not None and len(words) > 1 and words[1].isdecimal():
            # numbers may come padded or not
            register = int(step.frame.decode("ascii").split(",")[1])
            return self._on_acknowledgement(now) if int(words[1]) == register else []
        return []

    def _on_binary(self, message: VnBinary, now: HostTime) -> list[Output[bytes]]:
        time_ns = message.time_ns
        rate, force = message.get_floats(RATE), message.get_floats(ACCELERATION)
        if rate is None and force is None:
            self._counts["without_rate"] += 1
            return []
        if time_ns is not None and self._last_ns is not None:
            if time_ns == self._last_ns:
                self._counts["repeated"] += 1
                return []
            step = (time_ns - self._last_ns) * 1e-9 * self._rate_hz
            self._counts["lost"] += max(0, round(step) - 1) if step < 1000.0 else 0
        self._last_ns = time_ns
        magnetic, celsius = message.get_floats(MAGNETIC), message.get_floats(TEMPERATURE)
        quaternion = message.get_floats(QUATERNION)
        scalar_first = quaternion and (quaternion[3], *quaternion[:3])
        sample = ImuSample(
            self._make_header(
                self._find_arrival(message.start, now), 0 if time_ns is None else max(1, time_ns // 1000)
            ),
            angular_velocity=self._read_vector(rate, MAX_RATE),
            specific_force=self._read_vector(force, MAX_ACCELERATION),
            magnetic_field=self._read_vector(magnetic, MAX_ACCELERATION, GAUSS),
            temperature_celsius=celsius[0] if celsius is not None and math.isfinite(celsius[0]) else NAN,
            **make_orientation(scalar_first, OrientationReference.NED, self._yaw_source),
        )
        return self._publish(sample, now)


def _describe_error(words: tuple[str, ...]) -> str:
    try:
        code = int(words[1], 16)
    except (IndexError, ValueError):
        return "error without a code"
    return f"error {code:02X}, {ERRORS.get(code, 'unknown')}"
