"""The checksum of a 3DM-GX1 reply: the first byte plus every 16-bit word after it, modulo 65536."""

from __future__ import annotations

import struct


def checksum(body: bytes) -> int:
    """Return the checksum of a reply without its last word: a command byte and big-endian 16-bit words.

    Raises ValueError for a body whose length is not odd: it is no byte and whole words.
    """
    if len(body) % 2 == 0:
        raise ValueError(f"a reply is a byte and whole words before its checksum, got {len(body)} bytes")
    words: tuple[int, ...] = struct.unpack(f">B{len(body) // 2}H", body)
    return sum(words) & 0xFFFF


def sealed(body: bytes) -> bytes:
    """Return the reply with its checksum behind it."""
    return body + checksum(body).to_bytes(2, "big")
