"""Binary log bodies (little-endian, packed) and the CRC-32 of NovAtel logs.

The CRC has the reflected polynomial 0xEDB88320, starts from 0 and has no final inversion.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from struct import Struct

from msdrivers.protocol.novatel.logs import Body, HeadingLog, Position, UtmPosition, Velocity

LONG_HEADER = Struct("<3sBHBBHHBBHIIHH")
"""Sync, header length, id, type, port, body length, sequence, idle, time status, week, ms, receiver status, reserved,
software build."""
SHORT_HEADER = Struct("<3sBHHI")
"""Sync, body length, id, week, ms."""
POSITION = Struct("<IIdddfIfff4sffBB6x")
VELOCITY = Struct("<IIffdddf")
UTM = Struct("<IIIIdddfIfff4sffBB6x")
HEADING = Struct("<IIfff4xff4sBB6x")
HEADING2 = Struct("<IIfff4xff4s4xBB6x")


def _decode_station(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "replace")


def _decode_position(body: bytes | bytearray) -> Position | None:
    f = POSITION.unpack(body)
    # an infinity makes the sum infinite, a nan makes it nan
    if not math.isfinite(f[2] + f[3] + f[4] + f[5] + f[7] + f[8] + f[9] + f[11] + f[12]):
        return None
    if not (-90.0 <= f[2] <= 90.0 and -180.0 <= f[3] <= 360.0):
        return None
    return Position._make((*f[:10], _decode_station(f[10]), *f[11:]))


def _decode_velocity(body: bytes | bytearray) -> Velocity | None:
    f = VELOCITY.unpack(body)
    if not math.isfinite(f[2] + f[3] + f[4] + f[5] + f[6]) or f[4] < 0.0:
        return None
    return Velocity(*f[:7])


def _decode_utm(body: bytes | bytearray) -> UtmPosition | None:
    f = UTM.unpack(body)
    if not math.isfinite(sum(f[4:8]) + sum(f[9:12]) + f[13] + f[14]) or not 65 <= f[3] <= 90:
        return None
    return UtmPosition._make((*f[:3], chr(f[3]), *f[4:12], _decode_station(f[12]), *f[13:]))


def _make_heading_decoder(layout: Struct) -> Callable[[bytes | bytearray], HeadingLog | None]:
    def read(body: bytes | bytearray) -> HeadingLog | None:
        f = layout.unpack(body)
        if not math.isfinite(sum(f[2:7])) or not 0.0 <= f[3] <= 360.0:
            return None
        return HeadingLog._make((*f[:7], _decode_station(f[7]), *f[8:]))

    return read


READERS: dict[int, tuple[int, Callable[[bytes | bytearray], Body | None]]] = {
    42: (POSITION.size, _decode_position),
    47: (POSITION.size, _decode_position),
    141: (POSITION.size, _decode_position),
    99: (VELOCITY.size, _decode_velocity),
    726: (UTM.size, _decode_utm),
    971: (HEADING.size, _make_heading_decoder(HEADING)),
    1335: (HEADING2.size, _make_heading_decoder(HEADING2)),
}
"""Message id -> length of the body, and its reader: None for values that no receiver should give."""


def crc32(data: bytes | bytearray | memoryview) -> int:
    """Return the checksum of a log: from its sync bytes to the end of its body, or between '#' and '*'."""
    # zlib inverts before and after; both are undone
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
