"""Layouts of the 3DM-GX1's replies; decode and encode them.

A reply is the echo of the command byte, big-endian 16-bit words, mostly the timer ticks, and a checksum: the first byte
plus every 16-bit word after it, modulo 65536. There is no sync byte. Source: MicroStrain, "3DM-GX1 Data Communications
Protocol", and public drivers that follow it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple


def compute_checksum(body: bytes) -> int:
    """Return the checksum of a reply without its last word: a command byte and big-endian 16-bit words.

    Raises ValueError for a body of even length.
    """
    if len(body) % 2 == 0:
        raise ValueError(f"a reply is a byte and whole words before its checksum, got {len(body)} bytes")
    words: tuple[int, ...] = struct.unpack(f">B{len(body) // 2}H", body)
    return sum(words) & 0xFFFF


def append_checksum(body: bytes) -> bytes:
    """Return the reply with its checksum behind it."""
    return body + compute_checksum(body).to_bytes(2, "big")


class CommandByte(IntEnum):
    """The command byte of a request, and of the reply to it."""

    STABILIZED_VECTORS = 0x02
    INSTANTANEOUS_VECTORS = 0x03
    CAPTURE_BIAS = 0x06
    TEMPERATURE = 0x07
    QUATERNION_VECTORS = 0x0C
    INSTANTANEOUS_EULER = 0x0D
    STABILIZED_EULER = 0x0E
    CONTINUOUS = 0x10
    READ_EEPROM = 0x28
    WRITE_EEPROM = 0x29
    EULER_VECTORS = 0x31
    HARD_IRON_START = 0x40
    HARD_IRON_COLLECT = 0x41
    HARD_IRON_COMPUTE = 0x42
    FIRMWARE = 0xF0
    SERIAL = 0xF1


class ReplyLayout(NamedTuple):
    """Content of a reply between the command byte and the checksum: fields with their numbers of words, ticks."""

    fields: tuple[tuple[str, int], ...]
    has_ticks: bool = True

    @property
    def words(self) -> int:
        """Number of words in the fields."""
        return sum(count for _, count in self.fields)

    @property
    def length(self) -> int:
        """Length of the reply in bytes."""
        return 1 + 2 * self.words + 2 * self.has_ticks + 2


_VECTORS = (("field", 3), ("acceleration", 3), ("rate", 3))

LAYOUTS: dict[int, ReplyLayout] = {
    CommandByte.STABILIZED_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.INSTANTANEOUS_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.CAPTURE_BIAS: ReplyLayout(()),
    CommandByte.TEMPERATURE: ReplyLayout((("temperature", 1),)),
    CommandByte.QUATERNION_VECTORS: ReplyLayout((("quaternion", 4), *_VECTORS)),
    CommandByte.INSTANTANEOUS_EULER: ReplyLayout((("euler", 3),)),
    CommandByte.STABILIZED_EULER: ReplyLayout((("euler", 3),)),
    # a zero byte and the streamed command; the second word is zero or the ticks, sources differ: not read as ticks
    CommandByte.CONTINUOUS: ReplyLayout((("streamed", 1), ("unsettled", 1)), has_ticks=False),
    CommandByte.READ_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.WRITE_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.EULER_VECTORS: ReplyLayout((("euler", 3), ("acceleration", 3), ("rate", 3))),
    CommandByte.HARD_IRON_START: ReplyLayout(()),
    CommandByte.HARD_IRON_COLLECT: ReplyLayout((("field", 3), ("minimum", 3), ("maximum", 3))),
    CommandByte.HARD_IRON_COMPUTE: ReplyLayout((("offset", 3),)),
    CommandByte.FIRMWARE: ReplyLayout((("version", 1),), has_ticks=False),
    CommandByte.SERIAL: ReplyLayout((("serial", 1),), has_ticks=False),
}

LENGTHS: dict[int, int] = {command: layout.length for command, layout in LAYOUTS.items()}

MEASUREMENTS = frozenset(
    {
        CommandByte.STABILIZED_VECTORS,
        CommandByte.INSTANTANEOUS_VECTORS,
        CommandByte.QUATERNION_VECTORS,
        CommandByte.INSTANTANEOUS_EULER,
        CommandByte.STABILIZED_EULER,
        CommandByte.EULER_VECTORS,
    }
)
"""Measurements: what may be streamed."""

_SLICES: dict[int, dict[str, slice]] = {}
for _command, _layout in LAYOUTS.items():
    _at = 0
    _SLICES[_command] = {}
    for _name, _count in _layout.fields:
        _SLICES[_command][_name] = slice(_at, _at + _count)
        _at += _count

_STRUCTS = {command: struct.Struct(f">{layout.words}h") for command, layout in LAYOUTS.items()}
_UNSIGNED = {command: struct.Struct(f">B{(length - 3) // 2}HH") for command, length in LENGTHS.items()}


class Gx1Packet(NamedTuple):
    """A reply: its command, its words as signed numbers, and the timer's ticks, 0..65535, or None without."""

    command: int
    words: tuple[int, ...]
    ticks: int | None = None

    def field(self, name: str) -> tuple[int, ...]:
        """Return the words of a field of its layout, signed; KeyError for a field that it does not have."""
        return self.words[_SLICES[self.command][name]]

    def has(self, name: str) -> bool:
        """Return whether its layout has the field."""
        return name in _SLICES[self.command]

    @property
    def unsigned(self) -> int:
        """The first word as a number 0..65535: temperature, EEPROM value, version, serial number."""
        return self.words[0] & 0xFFFF

    def to_bytes(self) -> bytes:
        """Encode the reply. Raises ValueError for words that do not match its layout."""
        layout = LAYOUTS[self.command]
        if len(self.words) != layout.words or (self.ticks is None) == layout.has_ticks:
            raise ValueError(f"a reply 0x{self.command:02x} has {layout.words} words, ticks: {layout.has_ticks}")
        words: Sequence[int] = self.words if self.ticks is None else (*self.words, self.ticks)
        return append_checksum(struct.pack(f">B{len(words)}H", self.command, *(word & 0xFFFF for word in words)))


def decode_packet(data: bytes | bytearray, at: int, command: int) -> Gx1Packet | None:
    """Return the reply that begins at `at`, whose first byte is `command`; None if its checksum is wrong.

    The whole reply must be there: `LENGTHS[command]` bytes.
    """
    unsigned = _UNSIGNED[command].unpack_from(data, at)
    if (sum(unsigned) - 2 * unsigned[-1]) & 0xFFFF:
        return None
    words = _STRUCTS[command].unpack_from(data, at + 1)
    return Gx1Packet(command, words, unsigned[-2] if LAYOUTS[command].has_ticks else None)
