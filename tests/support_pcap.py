"""What was sent over TCP and UDP, from captures in pcap and pcapng."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

_ETHERNET, _LINUX_COOKED = 1, 113
_TCP, _UDP = 6, 17
_IP_AT = {_ETHERNET: 14, _LINUX_COOKED: 16, 0: 4}


def streams(path: Path) -> list[bytes]:
    """Return the payload of each direction of each connection, in the order of the capture; repeats are left out."""
    found: dict[tuple[bytes, bytes], bytearray] = {}
    seen: set[tuple[bytes, bytes]] = set()
    for link, frame in _frames(path.read_bytes()):
        ip = _IP_AT[link]
        if frame[ip] >> 4 != 4 or frame[ip + 9] not in (_TCP, _UDP):
            continue
        transport = ip + (frame[ip] & 15) * 4
        head = (frame[transport + 12] >> 4) * 4 if frame[ip + 9] == _TCP else 8
        payload = frame[transport + head : ip + struct.unpack_from(">H", frame, ip + 2)[0]]
        if frame[ip + 9] == _TCP:
            segment = (frame[transport + 4 : transport + 8], payload)
            if segment in seen:
                continue
            seen.add(segment)
        if payload:
            found.setdefault((frame[ip + 12 : ip + 20], frame[transport : transport + 4]), bytearray()).extend(payload)
    return [bytes(each) for each in found.values()]


def _frames(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield link type and bytes of each captured frame; captures of little-endian machines."""
    if data[:4] == b"\xd4\xc3\xb2\xa1":
        (link,) = struct.unpack_from("<I", data, 20)
        at = 24
        while at + 16 <= len(data):
            (length,) = struct.unpack_from("<I", data, at + 8)
            yield link, data[at + 16 : at + 16 + length]
            at += 16 + length
        return
    links: list[int] = []
    at = 0
    while at + 12 <= len(data):
        kind, length = struct.unpack_from("<II", data, at)
        if kind == 1:
            links.append(struct.unpack_from("<H", data, at + 8)[0])
        elif kind == 6:
            interface, captured = struct.unpack_from("<I8xI", data, at + 8)
            yield links[interface], data[at + 28 : at + 28 + captured]
        at += length
