"""Recognition: which device speaks on a line, by frames with a valid checksum."""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import Any, Final, NamedTuple

from msdrivers.protocol.framing import FrameScanner
from msdrivers.protocol.xsens import XbusStream

MIN_FRAMES: Final = 2
"""Fewer valid frames may be chance."""


class KnownProtocol(NamedTuple):
    """A protocol: its name, the drivers that read it, and a function that counts valid frames."""

    name: str
    devices: tuple[str, ...]
    count: Callable[[bytes], int]


def _count_frames(scanner: FrameScanner[Any], data: bytes) -> int:
    """Return how many valid frames a scanner that is new finds."""
    scanner.feed(data)
    return sum(number for kind, number in scanner.counts.items() if not kind.startswith(("rejected.", "skipped")))


def _count_ubx(data: bytes) -> int:
    # loads pyubx2, which the drivers of other devices need for a line that is not theirs only
    from msdrivers.protocol.ublox import UbxStream

    return _count_frames(UbxStream(), data)


_SENTENCE: Final = re.compile(rb"\$([A-Z]{2,6}[^*\r\n]{0,200})\*([0-9A-Fa-f]{2})")
_VECTORNAV: Final = re.compile(rb"\$VN[A-Z]{3},[^*\r\n]{0,200}\*[0-9A-Fa-f]{2}")
_NOVATEL_ASCII: Final = re.compile(rb"#[A-Z0-9]{4,20}A,[^;\r\n]{10,120};")


def _count_nmea(data: bytes) -> int:
    return sum(
        reduce(xor, body, 0) == int(checksum, 16)
        for body, checksum in _SENTENCE.findall(data)
        if not body.startswith(b"VN")
    )


def _count_vectornav(data: bytes) -> int:
    # binary output: FA, groups, then fields of a length that the groups give; CRC-16 over all after FA is 0
    number, at = len(_VECTORNAV.findall(data)), 0
    while (at := data.find(b"\xfa", at)) >= 0:
        for size in range(8, min(200, len(data) - at)):
            if size > 20 and data[at + size : at + size + 1] == b"\xfa" and crc_hqx(data[at + 1 : at + size], 0) == 0:
                number += 1
                at += size - 1
                break
        at += 1
        if number >= MIN_FRAMES:
            break
    return number


def _count_xbus(data: bytes) -> int:
    return _count_frames(XbusStream(), data)


def _count_novatel(data: bytes) -> int:
    return data.count(b"\xaa\x44\x12\x1c") + len(_NOVATEL_ASCII.findall(data))


PROTOCOLS: Final = (
    KnownProtocol("UBX messages of a u-blox receiver", ("ublox",), _count_ubx),
    KnownProtocol("NovAtel logs", ("novatel",), _count_novatel),
    KnownProtocol("Xbus messages of an Xsens unit", ("xsens",), _count_xbus),
    KnownProtocol("messages of a VectorNav unit", ("vectornav",), _count_vectornav),
    KnownProtocol("NMEA sentences", ("nmea",), _count_nmea),
)


def recognize(data: bytes) -> KnownProtocol | None:
    """Return the protocol with the most valid frames; None if there is none beyond chance."""
    best = max(PROTOCOLS, key=lambda each: each.count(data))
    return best if best.count(data) >= MIN_FRAMES else None


def recognize_line(data: bytes, device: str) -> str:
    """Describe what a line carries for a driver of `device`, with what to write in the vehicle file."""
    if not data:
        return "received nothing: check power, cable and port"
    found = recognize(data)
    if found is None:
        return f"received {len(data)} bytes that no driver knows, beginning {data[:24]!r}: check port and baud rate"
    if device in found.devices:
        return f"received {found.name}"
    return f"received {found.name}: write device: {found.devices[0]}"
