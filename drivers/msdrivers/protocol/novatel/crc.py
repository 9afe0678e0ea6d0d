"""The CRC-32 of NovAtel logs: reflected polynomial 0xEDB88320 from 0, without a final inversion."""

from __future__ import annotations

import zlib


def crc32(data: bytes | bytearray | memoryview) -> int:
    """Return the checksum of a log: from its sync bytes to the end of its body, or between '#' and '*'."""
    # zlib inverts before and after; both are undone
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
