"""u-blox UBX: frames, the messages used here, and configuration, on pyubx2.

A frame is B5 62, class, identifier, length (2 bytes, least significant first), payload, and Fletcher's checksum of all
after B5 62 (u-blox, ZED-F9P interface description, UBX-22008968, 3.2 and 3.4). pyubx2 knows the payloads.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from pyubx2 import (
    GET,
    SET,
    UBX_CLASSES,
    UBX_MSGIDS,
    UBXMessage,
    UBXMessageError,
    UBXParseError,
    UBXReader,
    UBXTypeError,
)

from modelserver.messages import FixType
from msdrivers.protocol.framing import NO_FRAME, FrameScanner, ParsedFrame, RejectedFrame
from msdrivers.protocol.setup_step import SetupStep

SYNC: Final = b"\xb5\x62"
HEADER_BYTES: Final = 6
CHECKSUM_BYTES: Final = 2

MAX_PAYLOAD: Final = 4096
"""A longer payload is noise: the longest message is RXM-RAWX, 16 + 32 for each of some 100 signals."""

VALSET_VERSION: Final = 27.0
"""First protocol version with CFG-VALSET: generation 9 (ZED-F9, M9, M10, X20)."""

USED: Final = frozenset(
    {
        *("NAV-PVT", "NAV-COV", "NAV-HPPOSLLH", "NAV-DOP", "NAV-RELPOSNED", "NAV-EOE"),
        *("RXM-RTCM", "MON-VER", "ACK-ACK", "ACK-NAK"),
    }
)
"""Messages that are decoded; the others are counted."""

REQUIRED_OUTPUT: Final = ("NAV_PVT",)
OPTIONAL_OUTPUT: Final = ("NAV_EOE", "NAV_DOP", "NAV_COV", "NAV_HPPOSLLH", "NAV_RELPOSNED", "RXM_RTCM")
"""Messages that a receiver is asked for. Not every product has the optional ones."""

PORTS: Final = ("UART1", "USB")
"""Ports of the receiver that messages are switched on at: which one this line is, the receiver does not state."""

_RAM: Final = 1
_NO_TRANSACTION: Final = 0


@dataclass(frozen=True, slots=True)
class UbxMessage:
    """A decoded message: its name, pyubx2's attributes, and the offset of its first byte in the stream."""

    name: str
    values: Any
    start: int


class UbxFormat:
    """A `FrameFormat` of UBX messages."""

    start_bytes = SYNC[:1]

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[UbxMessage] | RejectedFrame | None:
        """Parse the frame at `at`."""
        if len(buffer) < at + HEADER_BYTES:
            return None if buffer[at : at + 2] == SYNC[: len(buffer) - at] else NO_FRAME
        if buffer[at : at + 2] != SYNC:
            return NO_FRAME
        size = int.from_bytes(buffer[at + 4 : at + 6], "little")
        if size > MAX_PAYLOAD:
            return RejectedFrame("ubx_length")
        end = at + HEADER_BYTES + size + CHECKSUM_BYTES
        if len(buffer) < end:
            return None
        frame = bytes(buffer[at:end])
        if compute_checksum(frame[2:-CHECKSUM_BYTES]) != frame[-CHECKSUM_BYTES:]:
            return RejectedFrame("checksum")
        name = UBX_MSGIDS.get(frame[2:4], "") or f"{UBX_CLASSES.get(frame[2:3], 'UBX')}-{frame[2]:02X}{frame[3]:02X}"
        if name not in USED:
            return ParsedFrame(end, f"ubx.{name}", None)
        try:
            values = UBXReader.parse(frame, msgmode=GET)
        except (UBXParseError, UBXMessageError, UBXTypeError, ValueError):
            return RejectedFrame("ubx_payload")
        return ParsedFrame(end, f"ubx.{name}", UbxMessage(name, values, start))


def compute_checksum(data: bytes) -> bytes:
    """Return Fletcher's checksum of class, identifier, length and payload (2 bytes)."""
    a = b = 0
    for byte in data:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


class UbxStream(FrameScanner[UbxMessage]):
    """Parses bytes to UBX messages. Never raises; memory is bounded."""

    def __init__(self) -> None:
        super().__init__((UbxFormat(),))


# --- values of messages ---------------------------------------------------------------------------------------


def get_fix_type(pvt: Any) -> FixType:
    """Return the type of a fix in NAV-PVT (UBX-22008968, 3.15.13)."""
    if not (pvt.gnssFixOk and has_place(pvt)):
        return FixType.NONE
    if pvt.fixType == 1:
        return FixType.DEAD_RECKONING
    if pvt.fixType == 2:
        return FixType.FIX_2D
    # 3: three-dimensional; 4: with the receiver's dead reckoning; 0 and 5: none, time only
    if pvt.fixType not in (3, 4):
        return FixType.NONE
    if pvt.carrSoln in (1, 2):
        return FixType.RTK_FLOAT if pvt.carrSoln == 1 else FixType.RTK_FIXED
    return FixType.DIFFERENTIAL if pvt.diffSoln else FixType.FIX_3D


def has_place(pvt: Any) -> bool:
    """Return whether a NAV-PVT states a position; receivers before generation 8 have no flag for that."""
    return not bool(vars(pvt).get("invalidLlh")) and pvt.fixType not in (0, 5)


def get_utime(pvt: Any) -> int:
    """Return the instant of a NAV-PVT, microseconds of UTC; 0 if the receiver does not know it well, or within a leap
    second."""
    if not (pvt.validDate and pvt.validTime and pvt.fullyResolved):
        return 0
    try:
        when = datetime(pvt.year, pvt.month, pvt.day, pvt.hour, pvt.min, pvt.second, tzinfo=UTC)
    except ValueError:
        return 0
    nanoseconds: int = pvt.nano
    return (when - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) + round(nanoseconds * 1e-3)


def get_protocol_version(version: Any) -> tuple[str, float]:
    """Return the product and the protocol version in MON-VER; 0 if it states none (before generation 8)."""
    texts = [
        value.decode("ascii", "replace").strip("\x00 ") if isinstance(value, bytes) else str(value).strip("\x00 ")
        for name, value in vars(version).items()
        if name.startswith(("extension", "swVersion", "hwVersion"))
    ]
    protocol, product = 0.0, ""
    for text in texts:
        key, _, value = text.replace("=", " ").partition(" ")
        if key == "PROTVER":
            try:
                protocol = float(value.split()[0])
            except (ValueError, IndexError):
                protocol = 0.0
        elif key == "MOD":
            product = value.strip()
    return product or "u-blox receiver", protocol


# --- configuration --------------------------------------------------------------------------------------------


def make_version_poll() -> bytes:
    """Return the request for MON-VER."""
    return _encode(UBXMessage("MON", "MON-VER", 2))


def make_setup(protocol: float, rate_hz: float) -> tuple[SetupStep, ...]:
    """Return what sets a receiver of a protocol version up, in its volatile memory only."""
    period_ms = round(1000.0 / rate_hz)
    if protocol >= VALSET_VERSION:
        return _make_valset(period_ms)
    rate = UBXMessage("CFG", "CFG-RATE", SET, measRate=period_ms, navRate=1, timeRef=1)
    return (
        SetupStep(_encode(rate), f"a rate of {rate_hz:g} Hz"),
        *(_make_message_rate(name, is_optional=False) for name in REQUIRED_OUTPUT),
        *(_make_message_rate(name, is_optional=True) for name in OPTIONAL_OUTPUT),
    )


def _make_valset(period_ms: int) -> tuple[SetupStep, ...]:
    def configure(values: list[tuple[str, int]], what: str, is_optional: bool = False) -> SetupStep:
        return SetupStep(_encode(UBXMessage.config_set(_RAM, _NO_TRANSACTION, values)), what, is_optional)

    setups = [
        configure([("CFG_RATE_MEAS", period_ms), ("CFG_RATE_NAV", 1)], f"a rate of {1000.0 / period_ms:g} Hz"),
        *(configure([(f"CFG_{port}OUTPROT_UBX", 1)], f"UBX at {port}", port == "USB") for port in PORTS),
        *(configure([(f"CFG_{port}OUTPROT_NMEA", 0)], f"no NMEA at {port}", True) for port in PORTS),
    ]
    for name in (*REQUIRED_OUTPUT, *OPTIONAL_OUTPUT):
        for port in PORTS:
            is_optional = name in OPTIONAL_OUTPUT or port == "USB"
            what = f"{name.replace('_', '-')} at {port}"
            setups.append(configure([(f"CFG_MSGOUT_UBX_{name}_{port}", 1)], what, is_optional))
    return tuple(setups)


_CODES: Final = {name.replace("-", "_"): code for code, name in UBX_MSGIDS.items()}


def _make_message_rate(name: str, *, is_optional: bool) -> SetupStep:
    """Return the CFG-MSG that switches a message on at this port."""
    frame = UBXMessage("CFG", "CFG-MSG", SET, payload=_CODES[name] + b"\x01")
    return SetupStep(_encode(frame), name.replace("_", "-"), is_optional)


def _encode(message: UBXMessage) -> bytes:
    data: bytes = message.serialize()
    return data
