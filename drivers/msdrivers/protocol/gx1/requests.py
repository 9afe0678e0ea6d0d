"""Requests to the 3DM-GX1, from the host's side and from the device's. They carry no checksum."""

from __future__ import annotations

from typing import NamedTuple

from msdrivers.protocol.gx1 import LAYOUTS, CommandByte

LAST_ADDRESS = 254

_FRAMES: dict[int, tuple[bytes, int, bytes]] = dict.fromkeys(LAYOUTS, (b"", 0, b"")) | {
    CommandByte.CONTINUOUS: (b"\0", 1, b""),
    CommandByte.READ_EEPROM: (b"", 2, b""),
    CommandByte.WRITE_EEPROM: (b"\x71", 4, b"\xaa"),
    CommandByte.HARD_IRON_START: (b"\x71\x3e", 0, b""),
    CommandByte.HARD_IRON_COMPUTE: (b"\x71\x3e", 3, b""),
}
"""Command -> the key between it and its data, the length of the data, and the bytes after them."""


class Gx1Request(NamedTuple):
    """A request of the host: the command and its data bytes without keys."""

    command: int
    data: bytes = b""

    def to_bytes(self) -> bytes:
        """Encode the request."""
        key, _, end = _FRAMES[self.command]
        return bytes((self.command,)) + key + self.data + end


def make_poll(command: int) -> bytes:
    """Return the request for one reply of a command that takes no data."""
    return Gx1Request(command).to_bytes()


def make_stream(command: int) -> bytes:
    """Return the request to stream a reply."""
    return Gx1Request(CommandByte.CONTINUOUS, bytes((command,))).to_bytes()


STOP = make_stream(0)
"""Stop the continuous mode."""


def make_read_eeprom(address: int) -> bytes:
    """Return the request for a word of the EEPROM, at an even address up to 254."""
    return Gx1Request(CommandByte.READ_EEPROM, _encode_address(address)).to_bytes()


def make_write_eeprom(address: int, value: int) -> bytes:
    """Return the request to write a word, signed or unsigned 16 bit, to the EEPROM."""
    return Gx1Request(CommandByte.WRITE_EEPROM, _encode_address(address) + _encode_word(value)).to_bytes()


def make_hard_iron_start() -> bytes:
    """Return the request to begin the collection of the magnetic field's extremes."""
    return Gx1Request(CommandByte.HARD_IRON_START).to_bytes()


def make_hard_iron_compute(two_dimensional: bool, magnitude_z: int) -> bytes:
    """Return the request to compute and store the hard-iron offsets.

    The type byte is 1 for two dimensions and 0 for three. `magnitude_z` is the raw value of the vertical
    field, which only the procedure in two dimensions uses.
    """
    return Gx1Request(CommandByte.HARD_IRON_COMPUTE, bytes((two_dimensional,)) + _encode_word(magnitude_z)).to_bytes()


def _encode_word(value: int) -> bytes:
    return (value & 0xFFFF).to_bytes(2, "big")


def _encode_address(address: int) -> bytes:
    if not 0 <= address <= LAST_ADDRESS or address % 2:
        raise ValueError(f"an address of the EEPROM is even and 0..{LAST_ADDRESS}, got {address}")
    return _encode_word(address)


class RequestParser:
    """Requests out of the bytes that come to a device. What fits no request is skipped, byte by byte."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Gx1Request]:
        """Return the requests that are complete; at most 6 bytes wait for more."""
        self._buffer += data
        buffer, at, found = self._buffer, 0, []
        while at < len(buffer):
            command = buffer[at]
            key, length, end = _FRAMES.get(command, (b"", 0, b""))
            begin = at + 1 + len(key)
            after = begin + length + len(end)
            if after > len(buffer):
                break
            if command in _FRAMES and buffer.startswith(key, at + 1) and buffer.startswith(end, begin + length):
                found.append(Gx1Request(command, bytes(buffer[begin : begin + length])))
                at = after
            else:
                at += 1
                self.skipped += 1
        del buffer[:at]
        return found

    def clear(self) -> None:
        """Forget a request that has begun."""
        self._buffer.clear()
