"""Requests to the 3DM-GX1, from the host's side and from the device's. They carry no checksum."""

from __future__ import annotations

from typing import NamedTuple

from msdrivers.protocol.gx1 import LAYOUTS, CommandByte

LAST_ADDRESS = 254

_FRAMES: dict[int, tuple[bytes, int]] = dict.fromkeys(LAYOUTS, (b"", 0)) | {
    CommandByte.CONTINUOUS: (b"\0", 1),
    CommandByte.READ_EEPROM: (b"", 2),
}
"""Command -> the key between it and its data, and the length of the data."""


class Gx1Request(NamedTuple):
    """A request of the host: the command and its data bytes without keys."""

    command: int
    data: bytes = b""

    def to_bytes(self) -> bytes:
        key, _ = _FRAMES[self.command]
        return bytes((self.command,)) + key + self.data


def make_poll(command: int) -> bytes:
    """Return the request for one reply of a command that takes no data."""
    return Gx1Request(command).to_bytes()


def make_stream(command: int) -> bytes:
    return Gx1Request(CommandByte.CONTINUOUS, bytes((command,))).to_bytes()


STOP = make_stream(0)
"""Stop the continuous mode."""


def make_read_eeprom(address: int) -> bytes:
    """Return the request for a word of the EEPROM, at an even address up to 254."""
    return Gx1Request(CommandByte.READ_EEPROM, _encode_address(address)).to_bytes()


def _encode_address(address: int) -> bytes:
    if not 0 <= address <= LAST_ADDRESS or address % 2:
        raise ValueError(f"an address of the EEPROM is even and 0..{LAST_ADDRESS}, got {address}")
    return address.to_bytes(2, "big")


class RequestParser:
    """Requests out of the bytes that come to a device. What fits no request is skipped, byte by byte."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Gx1Request]:
        """Return the requests that are complete; at most 2 bytes wait for more."""
        self._buffer += data
        buffer, at, found = self._buffer, 0, []
        while at < len(buffer):
            command = buffer[at]
            key, length = _FRAMES.get(command, (b"", 0))
            begin = at + 1 + len(key)
            after = begin + length
            if after > len(buffer):
                break
            if command in _FRAMES and buffer.startswith(key, at + 1):
                found.append(Gx1Request(command, bytes(buffer[begin:after])))
                at = after
            else:
                at += 1
                self.skipped += 1
        del buffer[:at]
        return found

    def clear(self) -> None:
        self._buffer.clear()
