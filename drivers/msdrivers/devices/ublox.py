"""u-blox receivers: UBX frames and messages on pyubx2, and the driver, which publishes fixes with their covariance.

A frame is B5 62, class, identifier, length (2 bytes, least significant first), payload, and Fletcher's checksum of all
after B5 62 (u-blox, ZED-F9P interface description, UBX-22008968, 3.2 and 3.4). pyubx2 knows the payloads.

The receiver is asked for its version (MON-VER). Generation 9 and later is configured by CFG-VALSET, earlier ones by
CFG-MSG and CFG-RATE, in volatile memory only; each message waits for its acknowledgement. An epoch is NAV-PVT with what
belongs to the same time of week: NAV-COV, NAV-HPPOSLLH, NAV-DOP and, of a moving base, NAV-RELPOSNED. It is published
at the end of the epoch (NAV-EOE), at the latest after `HOLD_NS`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import pyubx2

from modelserver.messages import NAN, FixType, GpsSample, SensorHeader
from modelserver.transforms.so3 import Matrix3
from msdrivers.devices import check_ranges
from msdrivers.devices.gps import course_from_track
from msdrivers.devices.stream import NO_FRAME, ByteSettings, ParsedFrame, RejectedFrame, SetupStep, StreamDriver
from msdrivers.endpoint import HostTime, Output

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
        if pyubx2.calc_checksum(frame[2:-CHECKSUM_BYTES]) != frame[-CHECKSUM_BYTES:]:
            return RejectedFrame("checksum")
        kind = pyubx2.UBX_CLASSES.get(frame[2:3], "UBX")
        name = pyubx2.UBX_MSGIDS.get(frame[2:4], "") or f"{kind}-{frame[2]:02X}{frame[3]:02X}"
        if name not in USED:
            return ParsedFrame(end, f"ubx.{name}", None)
        try:
            values = pyubx2.UBXReader.parse(frame, msgmode=pyubx2.GET)
        except (pyubx2.UBXParseError, pyubx2.UBXMessageError, pyubx2.UBXTypeError, ValueError):
            return RejectedFrame("ubx_payload")
        return ParsedFrame(end, f"ubx.{name}", UbxMessage(name, values, start))


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
    stated = dict(text.replace("=", " ").partition(" ")[::2] for text in texts)
    protocol = re.match(r"\s*(\d+(?:\.\d*)?)(?!\S)", stated.get("PROTVER", ""))
    return stated.get("MOD", "").strip() or "u-blox receiver", float(protocol[1]) if protocol else 0.0


def make_setup(protocol: float, rate_hz: float) -> tuple[SetupStep, ...]:
    """Return what sets a receiver of a protocol version up, in its volatile memory only."""
    period_ms = round(1000.0 / rate_hz)
    if protocol >= VALSET_VERSION:
        return _make_valset(period_ms)
    rate = pyubx2.UBXMessage("CFG", "CFG-RATE", pyubx2.SET, measRate=period_ms, navRate=1, timeRef=1)
    return (
        SetupStep(_encode(rate), f"a rate of {rate_hz:g} Hz"),
        *(_make_message_rate(name, is_optional=False) for name in REQUIRED_OUTPUT),
        *(_make_message_rate(name, is_optional=True) for name in OPTIONAL_OUTPUT),
    )


def _make_valset(period_ms: int) -> tuple[SetupStep, ...]:
    def configure(values: list[tuple[str, int]], what: str, is_optional: bool = False) -> SetupStep:
        return SetupStep(_encode(pyubx2.UBXMessage.config_set(_RAM, _NO_TRANSACTION, values)), what, is_optional)

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


_CODES: Final = {name.replace("-", "_"): code for code, name in pyubx2.UBX_MSGIDS.items()}


def _make_message_rate(name: str, *, is_optional: bool) -> SetupStep:
    """Return the CFG-MSG that switches a message on at this port."""
    frame = pyubx2.UBXMessage("CFG", "CFG-MSG", pyubx2.SET, payload=_CODES[name] + b"\x01")
    return SetupStep(_encode(frame), name.replace("_", "-"), is_optional)


def _encode(message: pyubx2.UBXMessage) -> bytes:
    data: bytes = message.serialize()
    return data


FIXED: Final = 2
"""carrSoln: ambiguities fixed."""

HOLD_NS: Final = 100_000_000
"""How long a position waits for the other messages of its epoch, where no NAV-EOE ends it: they are sent at once, 400
bytes in 0.1 s at 38400 baud."""

MOVING: Final = 0.3
"""Speed over ground above which a vehicle moves, m/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UbloxSettings(ByteSettings):
    """Settings of a u-blox receiver. Raises ValueError with the key for an invalid value."""

    rate_hz: float = 5.0
    """Fixes per second, 0.1 to 25; what a product reaches depends on its constellations."""
    bauds: tuple[int, ...] = (38400, 9600, 115200, 460800)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""
    silence: float = 2.0
    """Timeout for fixes, seconds, after which the setup is repeated."""
    delay: float = 0.0
    """Shortest time from a fix to its first byte, seconds; it cannot be distinguished from the offset of the clocks."""
    delay_sigma: float = 0.02
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_ranges(self, rate_hz=(0.1, 25.0))


def to_sample(header: SensorHeader, parts: Mapping[str, Any]) -> GpsSample:
    """Return the fix of the messages of one instant, which are in degrees, millimeters and millimeters per second."""
    pvt = parts["NAV-PVT"]
    fix_type = get_fix_type(pvt)
    is_placed = has_place(pvt)
    latitude, longitude, height, msl = pvt.lat, pvt.lon, pvt.height * 1e-3, pvt.hMSL * 1e-3
    precise = parts.get("NAV-HPPOSLLH")
    if precise is not None and not precise.invalidLlh:
        latitude, longitude = precise.lat, precise.lon
        height, msl = precise.height * 1e-3, precise.hMSL * 1e-3
    dop = parts.get("NAV-DOP")
    position, velocity = _find_covariances(pvt, parts.get("NAV-COV"))
    yaw, yaw_sigma = _find_baseline(parts.get("NAV-RELPOSNED"))
    return GpsSample(
        header,
        fix_type,
        latitude if is_placed else NAN,
        longitude if is_placed else NAN,
        height_ellipsoidal=height if is_placed else NAN,
        height_msl=msl if is_placed else NAN,
        undulation=height - msl if is_placed else NAN,
        satellites=pvt.numSV,
        hdop=NAN if dop is None else dop.hDOP,
        vdop=NAN if dop is None else dop.vDOP,
        pdop=pvt.pDOP,
        position_covariance=position if is_placed else None,
        velocity=(pvt.velE * 1e-3, pvt.velN * 1e-3, -pvt.velD * 1e-3) if is_placed else None,
        velocity_covariance=velocity if is_placed else None,
        velocity_latency=0.0 if is_placed else NAN,
        speed=pvt.gSpeed * 1e-3 if is_placed else NAN,
        course=course_from_track(pvt.headMot) if is_placed and pvt.gSpeed * 1e-3 > MOVING else NAN,
        baseline_yaw=yaw,
        baseline_yaw_sigma=yaw_sigma,
    )


def _find_covariances(pvt: Any, cov: Any) -> tuple[Matrix3 | None, Matrix3 | None]:
    """Return those of position (m2) and velocity (m2/s2) along east, north, up.

    Without NAV-COV the horizontal accuracy is shared by both axes, as the length of a circular error; that of the
    speed is taken for each pair of axes in the same way.
    """
    a, b, c = pvt.hAcc * 1e-3, pvt.vAcc * 1e-3, pvt.sAcc * 1e-3
    position: Matrix3 | None = (a * a / 2, 0.0, 0.0, 0.0, a * a / 2, 0.0, 0.0, 0.0, b * b)
    velocity: Matrix3 | None = (c * c / 2, 0.0, 0.0, 0.0, c * c / 2, 0.0, 0.0, 0.0, c * c / 2)
    if cov is not None and cov.posCovValid:
        position = _to_enu(*(getattr(cov, f"posCov{axes}") for axes in _AXES))
    if cov is not None and cov.velCovValid:
        velocity = _to_enu(*(getattr(cov, f"velCov{axes}") for axes in _AXES))
    return position if a > 0.0 else None, velocity if c > 0.0 else None


def _find_baseline(relative: Any) -> tuple[float, float]:
    """Return the direction to the moving base's antenna and its sigma, radians; nan if it is not known.

    NAV-RELPOSNED has the vector from the base to this antenna, whose position NAV-PVT gives.
    """
    if relative is None or not (relative.isMoving and relative.carrSoln == FIXED):
        return NAN, NAN
    if not (relative.relPosValid and getattr(relative, "relPosHeadingValid", 0)):
        return NAN, NAN
    return course_from_track(relative.relPosHeading + 180.0), math.radians(relative.accHeading)


_AXES: Final = ("NN", "NE", "ND", "EE", "ED", "DD")


def _to_enu(nn: float, ne: float, nd: float, ee: float, ed: float, dd: float) -> Matrix3:
    return (ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd)


class UbloxDriver(StreamDriver[UbxMessage]):
    """An `Endpoint` of bytes at the host's end of a receiver's line; see `UbloxSettings`.

    Further counts: `rtcm.used`, `rtcm.unused`, `rtcm.damaged`, and `repeated` instants.
    """

    device = "ublox"
    description = "u-blox receiver"
    awaited = "NAV-PVT"
    formats = (UbxFormat(),)
    identification = _encode(pyubx2.UBXMessage("MON", "MON-VER", pyubx2.POLL))

    def __init__(self, settings: UbloxSettings) -> None:
        super().__init__(settings)
        self._rate_hz = settings.rate_hz
        self._parts: dict[str, Any] = {}
        """The messages of the epoch under way, by name."""
        self._itow = self._host_utime = self._deadline_ns = 0
        self._last_itow: int | None = None

    def _on_start(self) -> None:
        self._parts.clear()

    def _get_extra_deadline(self) -> int | None:
        return self._deadline_ns if self._parts else None

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        return self._publish_epoch(now)

    def _on_message(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        if message.name == "MON-VER":
            product, protocol = get_protocol_version(message.values)
            steps = make_setup(protocol, self._rate_hz)
            return self._on_identity(f"{product} (protocol {protocol:g})", steps, now)
        if message.name.startswith("ACK"):
            return self._on_command_answer(message, now)
        if message.name == "RXM-RTCM":
            use = "damaged" if message.values.crcFailed else "used" if message.values.msgUsed == 2 else "unused"
            self._counts[f"rtcm.{use}"] += 1
            return []
        return self._on_epoch_part(message, now)

    def _on_command_answer(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        step = self._step
        if step is None or bytes((message.values.clsID, message.values.msgID)) != step.frame[2:4]:
            return []
        is_rejected = message.name == "ACK-NAK"
        return self._on_acknowledgement(now, "is `rate_hz` within what this product reaches?" if is_rejected else "")

    def _on_epoch_part(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        """Add a message to the epoch of its time of week; a later one, or NAV-EOE, completes the one before."""
        itow = message.values.iTOW
        out: list[Output[bytes]] = []
        if self._parts and self._itow != itow:
            out += self._publish_epoch(now)
        if not self._parts:
            if itow == self._last_itow:
                if message.name == "NAV-PVT":
                    self._counts["repeated"] += 1
                return out
            self._itow, self._host_utime = itow, self._find_arrival(message.start, now)
            self._deadline_ns = now.monotonic_ns + HOLD_NS
        self._parts[message.name] = message.values
        if message.name == "NAV-EOE":
            out += self._publish_epoch(now)
        return out

    def _publish_epoch(self, now: HostTime) -> list[Output[bytes]]:
        parts, self._parts = self._parts, {}
        self._last_itow = self._itow
        if "NAV-PVT" not in parts:
            return []
        header = self._make_header(self._host_utime, get_utime(parts["NAV-PVT"]))
        return self._publish(to_sample(header, parts), now)
