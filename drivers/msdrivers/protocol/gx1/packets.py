"""Replies of the 3DM-GX1: which there are, how long they are, which words they hold; from bytes and to bytes.

A reply is the echo of the command byte, big-endian 16-bit words, in most of them the timer ticks, and a checksum. There
is no sync byte. Source: MicroStrain, "3DM-GX1 Data Communications Protocol", and public drivers that follow it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from msdrivers.protocol.gx1.checksum import sealed


class CommandByte(IntEnum):
    """The command byte of a request, and of the reply to it."""

    STABILISED_VECTORS = 0x02
    INSTANTANEOUS_VECTORS = 0x03
    CAPTURE_BIAS = 0x06
    TEMPERATURE = 0x07
    QUATERNION_VECTORS = 0x0C
    INSTANTANEOUS_EULER = 0x0D
    STABILISED_EULER = 0x0E
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
    """What stands in a reply between the command byte and the checksum, in order.

    `fields` are names and numbers of words; `ticks`: whether the timer's ticks follow them.
    """

    fields: tuple[tuple[str, int], ...]
    ticks: bool = True

    @property
    def words(self) -> int:
        """Number of words in the fields."""
        return sum(count for _, count in self.fields)

    @property
    def length(self) -> int:
        """Length of the reply in bytes."""
        return 1 + 2 * self.words + 2 * self.ticks + 2


_VECTORS = (("field", 3), ("acceleration", 3), ("rate", 3))

LAYOUTS: dict[int, ReplyLayout] = {
    CommandByte.STABILISED_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.INSTANTANEOUS_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.CAPTURE_BIAS: ReplyLayout(()),
    CommandByte.TEMPERATURE: ReplyLayout((("temperature", 1),)),
    CommandByte.QUATERNION_VECTORS: ReplyLayout((("quaternion", 4), *_VECTORS)),
    CommandByte.INSTANTANEOUS_EULER: ReplyLayout((("euler", 3),)),
    CommandByte.STABILISED_EULER: ReplyLayout((("euler", 3),)),
    # a zero byte and the command now streamed; the second word is zero or the ticks, sources differ: not read as ticks
    CommandByte.CONTINUOUS: ReplyLayout((("streamed", 1), ("unsettled", 1)), ticks=False),
    CommandByte.READ_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.WRITE_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.EULER_VECTORS: ReplyLayout((("euler", 3), ("acceleration", 3), ("rate", 3))),
    CommandByte.HARD_IRON_START: ReplyLayout(()),
    CommandByte.HARD_IRON_COLLECT: ReplyLayout((("field", 3), ("minimum", 3), ("maximum", 3))),
    CommandByte.HARD_IRON_COMPUTE: ReplyLayout((("offset", 3),)),
    CommandByte.FIRMWARE: ReplyLayout((("version", 1),), ticks=False),
    CommandByte.SERIAL: ReplyLayout((("serial", 1),), ticks=False),
}

LENGTHS: dict[int, int] = {command: layout.length for command, layout in LAYOUTS.items()}

DATA = frozenset(
    {
        CommandByte.STABILISED_VECTORS,
        CommandByte.INSTANTANEOUS_VECTORS,
        CommandByte.QUATERNION_VECTORS,
        CommandByte.INSTANTANEOUS_EULER,
        CommandByte.STABILISED_EULER,
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


class Packet(NamedTuple):
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
        """Return the reply as it goes over the line. Raises ValueError for words that its layout does not have."""
        layout = LAYOUTS[self.command]
        if len(self.words) != layout.words or (self.ticks is None) == layout.ticks:
            raise ValueError(f"a reply 0x{self.command:02x} has {layout.words} words, ticks: {layout.ticks}")
        words: Sequence[int] = self.words if self.ticks is None else (*self.words, self.ticks)
        return sealed(struct.pack(f">B{len(words)}H", self.command, *(word & 0xFFFF for word in words)))


def decoded(data: bytes | bytearray, at: int, command: int) -> Packet | None:
    """Return the reply that begins at `at`, whose first byte is `command`; None if its checksum is wrong.

    The whole reply must be there: `LENGTHS[command]` bytes.
    """
    unsigned = _UNSIGNED[command].unpack_from(data, at)
    if (sum(unsigned) - 2 * unsigned[-1]) & 0xFFFF:
        return None
    words = _STRUCTS[command].unpack_from(data, at + 1)
    return Packet(command, words, unsigned[-2] if LAYOUTS[command].ticks else None)
