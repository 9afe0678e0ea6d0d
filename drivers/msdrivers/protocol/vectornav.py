"""VectorNav VN-100: binary output, ASCII messages, commands.

A binary message is FA, the groups (one bit each), a 16-bit field mask for each group, the fields in the order of their
bits, little-endian, and CRC-16 (CCITT, initial 0), high byte first. It has no length: that follows from the masks. An
ASCII message is `$VN`, text, `*`, the exclusive-or of the characters between, in hexadecimal. Source: VectorNav, VN-100
user manual UM001, 4 and 5. Axes: x forward, y right, z down.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Final, TypeAlias

from msdrivers.protocol.framing import NO_FRAME, FrameScanner, ParsedFrame, RejectedFrame
from msdrivers.protocol.setup_step import SetupStep

SYNC: Final = 0xFA

FIELD_BYTES: Final[Mapping[int, tuple[int, ...]]] = {
    1: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    2: (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    3: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2),
    5: (2, 12, 16, 36, 12, 12, 12, 12, 12),
}
"""Bytes of the fields of each group, by bit. Groups 4, 6 and 7 (GNSS, INS) do not exist on a VN-100."""

TIME, QUATERNION = (1, 0), (1, 4)
MAGNETIC, ACCELERATION, RATE, TEMPERATURE, SATURATION = (3, 1), (3, 2), (3, 3), (3, 4), (3, 11)
COMPENSATED_RATE, COMPENSATED_ACCELERATION = (1, 5), (1, 8)

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
        """Parse the message at `at`."""
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
        """Parse the message at `at`."""
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


class VnStream(FrameScanner[VnMessage]):
    """Parses bytes to binary and ASCII messages. Never raises; memory is bounded."""

    def __init__(self) -> None:
        super().__init__((VnBinaryFormat(), VnTextFormat()))


def encode_text(text: str) -> bytes:
    """Return an ASCII message, e.g. of RRG,01."""
    body = f"VN{text}"
    return f"${body}*{reduce(xor, body.encode('latin-1'), 0):02X}\r\n".encode("latin-1")


def encode_binary(fields: Mapping[tuple[int, int], bytes]) -> bytes:
    """Return a binary message of fields' bytes by (group, bit)."""
    masks: dict[int, int] = {}
    for group, bit in fields:
        masks[group] = masks.get(group, 0) | 1 << bit
    body = bytes((sum(1 << group - 1 for group in masks),))
    body += b"".join(masks[group].to_bytes(2, "little") for group in sorted(masks))
    body += b"".join(fields[key] for key in sorted(fields))
    return bytes((SYNC,)) + body + crc_hqx(body, 0).to_bytes(2, "big")


def compute_size(keys: tuple[tuple[int, int], ...]) -> int:
    """Return the bytes of a binary message with these fields."""
    return 1 + 1 + 2 * len({group for group, _ in keys}) + sum(FIELD_BYTES[group][bit] for group, bit in keys) + 2


def make_setup(rate_hz: float, port: int) -> tuple[SetupStep, ...]:
    """Return what sets a unit up, in its volatile memory: ASCII output off on both ports, then the binary output.

    The ASCII output must be off first: together they may exceed the baud rate (error 0C).
    """
    masks: dict[int, int] = {}
    for group, bit in WANTED:
        masks[group] = masks.get(group, 0) | 1 << bit
    groups = sum(1 << group - 1 for group in masks)
    divisor = max(1, round(BASE_RATE_HZ / rate_hz))
    words = ",".join(f"{masks[group]:04X}" for group in sorted(masks))
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
