"""Requests to the 3DM-GX1, from the host's side and from the device's. They carry no checksum."""

from __future__ import annotations

from typing import NamedTuple

from msdrivers.protocol.gx1.packets import LAYOUTS, CommandByte

STOP = bytes((CommandByte.CONTINUOUS, 0, 0))
"""Stop the continuous mode."""

HARD_IRON_KEY = b"\x71\x3e"
_WRITE_KEY, _WRITE_END = 0x71, 0xAA
LAST_ADDRESS = 254


def make_poll(command: int) -> bytes:
    """Return the request for one reply of a command that takes no data."""
    return bytes((command,))


def make_stream(command: int) -> bytes:
    """Return the request to stream a reply."""
    return bytes((CommandByte.CONTINUOUS, 0, command))


def make_read_eeprom(address: int) -> bytes:
    """Return the request for a word of the EEPROM, at an even address up to 254."""
    return bytes((CommandByte.READ_EEPROM, *_encode_address(address)))


def make_write_eeprom(address: int, value: int) -> bytes:
    """Return the request to write a word, signed or unsigned 16 bit, to the EEPROM."""
    word = (value & 0xFFFF).to_bytes(2, "big")
    return bytes((CommandByte.WRITE_EEPROM, _WRITE_KEY, *_encode_address(address), *word, _WRITE_END))


def make_hard_iron_start() -> bytes:
    """Return the request to begin the collection of the magnetic field's extremes."""
    return bytes((CommandByte.HARD_IRON_START,)) + HARD_IRON_KEY


def make_hard_iron_compute(two_dimensional: bool, magnitude_z: int) -> bytes:
    """Return the request to compute and store the hard-iron offsets.

    The type byte is 1 for two dimensions and 0 for three. `magnitude_z` is the raw value of the vertical
    field, which only the procedure in two dimensions uses.
    """
    kind = 1 if two_dimensional else 0
    word = (magnitude_z & 0xFFFF).to_bytes(2, "big")
    return bytes((CommandByte.HARD_IRON_COMPUTE,)) + HARD_IRON_KEY + bytes((kind,)) + word


def _encode_address(address: int) -> bytes:
    if not 0 <= address <= LAST_ADDRESS or address % 2:
        raise ValueError(f"an address of the EEPROM is even and 0..{LAST_ADDRESS}, got {address}")
    return address.to_bytes(2, "big")


class Gx1Request(NamedTuple):
    """A request of the host: the command and its data bytes without keys."""

    command: int
    data: bytes = b""


_LENGTHS = dict.fromkeys(LAYOUTS, 1) | {
    CommandByte.CONTINUOUS: 3,
    CommandByte.READ_EEPROM: 3,
    CommandByte.WRITE_EEPROM: 7,
    CommandByte.HARD_IRON_START: 3,
    CommandByte.HARD_IRON_COMPUTE: 6,
}


class RequestParser:
    """Requests out of the bytes that come to a device. What fits no request is skipped, byte by byte."""

    __slots__ = ("_buffer", "skipped")

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Gx1Request]:
        """Return the requests that are complete; at most 6 bytes wait for more."""
        self._buffer += data
        buffer, at, found = self._buffer, 0, []
        while at < len(buffer):
            length = _LENGTHS.get(buffer[at], 0)
            if length > len(buffer) - at:
                break
            request = _parse_request(bytes(buffer[at : at + length])) if length else None
            if request is None:
                at += 1
                self.skipped += 1
            else:
                at += length
                found.append(request)
        del buffer[:at]
        return found

    def clear(self) -> None:
        """Forget a request that has begun."""
        self._buffer.clear()


def _parse_request(raw: bytes) -> Gx1Request | None:
    """Return the request that the bytes are; None if a key or a fixed byte in it is wrong."""
    command = raw[0]
    if command == CommandByte.CONTINUOUS:
        return Gx1Request(command, raw[2:]) if raw[1] == 0 else None
    if command == CommandByte.READ_EEPROM:
        return Gx1Request(command, raw[1:])
    if command == CommandByte.WRITE_EEPROM:
        return Gx1Request(command, raw[2:6]) if (raw[1], raw[6]) == (_WRITE_KEY, _WRITE_END) else None
    if command in (CommandByte.HARD_IRON_START, CommandByte.HARD_IRON_COMPUTE):
        return Gx1Request(command, raw[3:]) if raw[1:3] == HARD_IRON_KEY else None
    return Gx1Request(command)
