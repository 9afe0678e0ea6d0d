"""RTCM 3: corrections for a receiver, frame by frame.

A frame is D3, six zero bits and a length of ten, the message, and CRC-24Q of all before (RTCM 10403.3, 4). The first
twelve bits of a message are its number; in observations and station messages the reference station follows, also twelve
bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from msdrivers.protocol.framing import NO_FRAME, FrameScanner, ParsedFrame, RejectedFrame

PREAMBLE: Final = 0xD3
HEADER_BYTES: Final = 3
CRC_BYTES: Final = 3

_POLYNOMIAL: Final = 0x1864CFB


def _make_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (_POLYNOMIAL if crc & 0x800000 else 0)
        table.append(crc & 0xFFFFFF)
    return tuple(table)


_TABLE: Final = _make_table()


def compute_crc(data: bytes) -> int:
    """Return CRC-24Q (Qualcomm) of some bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFFFF) ^ _TABLE[crc >> 16 ^ byte]
    return crc


@dataclass(frozen=True, slots=True)
class RtcmFrame:
    """A frame as it was received, the number of its message, and its reference station; -1 where it has none."""

    data: bytes
    number: int
    station: int


class RtcmFormat:
    """A `FrameFormat` of RTCM 3."""

    start_bytes = bytes((PREAMBLE,))

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[RtcmFrame] | RejectedFrame | None:
        """Parse the frame at `at`."""
        if len(buffer) < at + HEADER_BYTES:
            return None
        if buffer[at + 1] & 0xFC:
            return NO_FRAME
        end = at + HEADER_BYTES + (buffer[at + 1] << 8 | buffer[at + 2]) + CRC_BYTES
        if len(buffer) < end:
            return None
        data = bytes(buffer[at:end])
        if compute_crc(data[:-CRC_BYTES]) != int.from_bytes(data[-CRC_BYTES:], "big"):
            return RejectedFrame("crc")
        message = data[HEADER_BYTES:-CRC_BYTES]
        number = message[0] << 4 | message[1] >> 4 if len(message) >= 2 else 0
        station = (message[1] & 0x0F) << 8 | message[2] if len(message) >= 3 and _has_station(number) else -1
        return ParsedFrame(end, f"rtcm.{number}", RtcmFrame(data, number, station))


def _has_station(number: int) -> bool:
    """Return whether the station follows the number: observations, station coordinates and antennas, MSM."""
    return 1001 <= number <= 1012 or number in (1033, 1230) or 1071 <= number <= 1137


class RtcmStream(FrameScanner[RtcmFrame]):
    """Parses bytes to frames. Never raises; memory is bounded."""

    def __init__(self) -> None:
        super().__init__((RtcmFormat(),))
