"""Emulator of a u-blox receiver: answers MON-VER, applies CFG-VALSET, or CFG-MSG and CFG-RATE, and sends epochs."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from pyubx2 import GET, SET, UBX_MSGIDS, UBXMessage, UBXMessageError, UBXParseError, UBXReader, UBXTypeError

from modelserver.messages import FixType, GpsSample
from msdrivers.devices.gps import gps_of
from msdrivers.devices.stream import FrameScanner, ParsedFrame, RejectedFrame
from msdrivers.devices.ublox import VALSET_VERSION, UbxFormat
from msdrivers.emulate import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send

PORT: Final = "UART1"

_FIXES: Final = {
    FixType.NONE: (0, 0, 0),
    FixType.DEAD_RECKONING: (1, 0, 0),
    FixType.FIX_2D: (2, 0, 0),
    FixType.FIX_3D: (3, 0, 0),
    FixType.DIFFERENTIAL: (3, 1, 0),
    FixType.RTK_FLOAT: (3, 1, 1),
    FixType.RTK_FIXED: (3, 1, 2),
}
"""fixType, diffSoln, carrSoln."""

_FACTORY_PERIOD_MS: Final = 1000

ORDER: Final = ("NAV-DOP", "NAV-PVT", "NAV-HPPOSLLH", "NAV-COV", "NAV-RELPOSNED", "NAV-EOE")
"""Messages of an epoch, in the order in which a receiver sends them."""


@dataclass(frozen=True, slots=True)
class UbloxUnit:
    """A receiver: protocol version (27 and above: CFG-VALSET), product, messages that it does not have.

    latency: from the instant of a sample to the first byte of its messages, seconds.
    """

    protocol: float = 27.31
    product: str = "ZED-F9P"
    missing: frozenset[str] = frozenset()
    latency: float = 0.03


class _CommandFormat(UbxFormat):
    """UBX messages as the receiver gets them: whole frames."""

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[Any] | RejectedFrame | None:
        found = super().scan(buffer, at, start)
        if isinstance(found, ParsedFrame):
            return ParsedFrame(found.end, found.kind, bytes(buffer[at : found.end]))
        return found


class UbloxEmulator(SampleEmulator[GpsSample]):
    """An `Endpoint` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: UbloxUnit | None = None) -> None:
        self._unit = UbloxUnit() if unit is None else unit
        super().__init__(samples, self._unit.latency)
        self._scanner: FrameScanner[bytes] = FrameScanner((_CommandFormat(),))
        self._period_ms = _FACTORY_PERIOD_MS
        self._last_ms: int | None = None
        self._messages: set[str] = set()

    @property
    def messages(self) -> frozenset[str]:
        """The messages that are on, e.g. "NAV-PVT"."""
        return frozenset(self._messages)

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        return [output for frame in self._scanner.feed(unit) for output in self._execute(frame)]

    def _send_sample(self, sample: GpsSample) -> list[Output[bytes]]:
        data = self._make_epoch(sample)
        return [Send(data)] if data else []

    # --- commands ---

    def _execute(self, frame: bytes) -> list[Output[bytes]]:
        code = frame[2:4]
        if UBX_MSGIDS.get(code) == "MON-VER":
            return [Send(self._make_version())]
        if frame[2] != 0x06:
            return []
        is_accepted = self._configure(frame)
        self.counts["accepted" if is_accepted else "rejected"] += 1
        name = "ACK-ACK" if is_accepted else "ACK-NAK"
        return [Send(_encode(name, clsID=frame[2], msgID=frame[3]))]

    def _configure(self, frame: bytes) -> bool:
        """Apply a configuration message; return whether the receiver has what it configures."""
        name = UBX_MSGIDS.get(frame[2:4], "")
        has_valset = self._unit.protocol >= VALSET_VERSION
        try:
            message = UBXReader.parse(frame, msgmode=SET)
        except (UBXParseError, UBXMessageError, UBXTypeError, ValueError):
            return False
        if name == "CFG-VALSET" and has_valset:
            values = {key: value for key, value in vars(message).items() if key.startswith("CFG_")}
            return bool(values) and all(tuple(self._set_value(key, value) for key, value in values.items()))
        if name == "CFG-RATE" and not has_valset:
            self._period_ms = max(40, message.measRate)
            return True
        if name == "CFG-MSG" and not has_valset:
            wanted = UBX_MSGIDS.get(frame[6:8], "")
            return self._switch(wanted, frame[8] > 0)
        return False

    def _set_value(self, key: str, value: int) -> bool:
        if key == "CFG_RATE_MEAS":
            self._period_ms = max(40, value)
        elif key.startswith("CFG_MSGOUT_UBX_"):
            message, _, port = key.removeprefix("CFG_MSGOUT_UBX_").rpartition("_")
            return port != PORT or self._switch(message.replace("_", "-", 1), value > 0)
        return True

    def _switch(self, message: str, is_on: bool) -> bool:
        if message in self._unit.missing or message not in (*ORDER, "RXM-RTCM"):
            return False
        (self._messages.add if is_on else self._messages.discard)(message)
        return True

    def _make_version(self) -> bytes:
        texts = ("FWVER=HPG 1.32", f"PROTVER={self._unit.protocol:.2f}", f"MOD={self._unit.product}")
        payload = b"EXT CORE 1.00 (emulated)".ljust(30, b"\0") + b"00190000".ljust(10, b"\0")
        payload += b"".join(text.encode().ljust(30, b"\0") for text in texts)
        return _encode("MON-VER", payload=payload)

    # --- epochs ---

    def _make_epoch(self, sample: GpsSample) -> bytes:
        milliseconds = sample.header.utime // 1000
        if self._last_ms is not None and milliseconds - self._last_ms < self._period_ms - 1:
            return b""
        self._last_ms = milliseconds
        names = [name for name in ORDER if name in self._messages]
        self.counts.update(names)
        return b"".join(encode_sample(name, sample) for name in names)


def encode_sample(name: str, sample: GpsSample) -> bytes:
    return _encode(name, **_FIELDS[name](sample))


def _encode(name: str, **values: Any) -> bytes:
    data: bytes = UBXMessage(name.partition("-")[0], name, GET, **values).serialize()
    return data


def _get_itow(sample: GpsSample) -> int:
    return gps_of(sample.header.utime)[1] // 1000


def _zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _fill_pvt(sample: GpsSample) -> dict[str, Any]:
    # the second is the nearest one, nano what is missing to it
    second = (sample.header.utime + 500_000) // 1_000_000
    when = datetime.fromtimestamp(second, UTC)
    fix, is_differential, carrier = _FIXES[sample.fix_type]
    east, north, up = sample.velocity or (0.0, 0.0, 0.0)
    P, V = sample.position_covariance, sample.velocity_covariance
    height, msl = _get_heights(sample)
    return {
        "iTOW": _get_itow(sample),
        **{name: getattr(when, name) for name in ("year", "month", "day", "hour", "second")},
        "min": when.minute,
        "nano": (sample.header.utime - second * 1_000_000) * 1000,
        **dict.fromkeys(("validDate", "validTime", "fullyResolved"), 1),
        "fixType": fix,
        "gnssFixOk": int(fix > 0),
        "diffSoln": is_differential,
        "carrSoln": carrier,
        "numSV": max(sample.satellites, 0),
        "lat": _zero(sample.latitude_deg),
        "lon": _zero(sample.longitude_deg),
        "height": round(1e3 * height),
        "hMSL": round(1e3 * msl),
        "hAcc": 0 if P is None else round(1e3 * math.sqrt(P[0] + P[4])),
        "vAcc": 0 if P is None else round(1e3 * math.sqrt(P[8])),
        "velN": round(1e3 * north),
        "velE": round(1e3 * east),
        "velD": round(-1e3 * up),
        "gSpeed": round(1e3 * math.hypot(east, north)),
        "headMot": math.degrees(math.atan2(east, north)) % 360.0,
        "sAcc": 100 if V is None else round(1e3 * math.sqrt(V[0] + V[4])),
        "pDOP": min(_zero(sample.pdop), 99.0),
        "invalidLlh": int(fix == 0),
    }


def _get_heights(sample: GpsSample) -> tuple[float, float]:
    """Return the height above the ellipsoid and above mean sea level."""
    height = _zero(sample.height_ellipsoidal)
    return height, sample.height_msl if math.isfinite(sample.height_msl) else height - _zero(sample.undulation)


def _fill_precise(sample: GpsSample) -> dict[str, Any]:
    # each number is a coarse one and the hundredths, or tenths, that are missing to it
    height, msl = _get_heights(sample)
    places = [_split(1e9 * _zero(value), 100) for value in (sample.longitude_deg, sample.latitude_deg)]
    heights = [_split(1e4 * value, 10) for value in (height, msl)]
    coarse, fine = zip(*places, *heights, strict=True)
    is_invalid = int(sample.fix_type is FixType.NONE)
    return {"payload": _PRECISE.pack(0, 0, is_invalid, _get_itow(sample), *coarse, *fine, 0, 0)}


_PRECISE: Final = struct.Struct("<BHBIiiiibbbbII")


def _split(value: float, parts: int) -> tuple[int, int]:
    whole = round(value)
    coarse = round(whole / parts)
    return coarse, whole - coarse * parts


def _fill_dop(sample: GpsSample) -> dict[str, Any]:
    dops = {"pDOP": sample.pdop, "vDOP": sample.vdop, "hDOP": sample.hdop}
    return {"iTOW": _get_itow(sample), **{name: min(_zero(value), 99.0) for name, value in dops.items()}}


def _fill_cov(sample: GpsSample) -> dict[str, Any]:
    fields: dict[str, Any] = {"iTOW": _get_itow(sample)}
    for name, P in (("pos", sample.position_covariance), ("vel", sample.velocity_covariance)):
        fields[f"{name}CovValid"] = int(P is not None)
        if P is not None:
            ee, en, eu, _, nn, nu, _, _, uu = P
            values = {"NN": nn, "NE": en, "ND": -nu, "EE": ee, "ED": -eu, "DD": uu}
            fields |= {f"{name}Cov{axes}": value for axes, value in values.items()}
    return fields


def _fill_relative(sample: GpsSample) -> dict[str, Any]:
    """The vector from the moving base to this antenna: the baseline points the other way."""
    is_known = math.isfinite(sample.baseline_yaw)
    yaw = _zero(sample.baseline_yaw) + math.pi
    return {
        "version": 1,
        "iTOW": _get_itow(sample),
        "relPosHeading": (90.0 - math.degrees(yaw)) % 360.0,
        "accHeading": math.degrees(_zero(sample.baseline_yaw_sigma)),
        "carrSoln": 2 if is_known else 0,
        **dict.fromkeys(("gnssFixOK", "relPosValid", "relPosHeadingValid", "isMoving"), int(is_known)),
    }


_FIELDS: Final[Mapping[str, Callable[[GpsSample], dict[str, Any]]]] = {
    "NAV-PVT": _fill_pvt,
    "NAV-HPPOSLLH": _fill_precise,
    "NAV-DOP": _fill_dop,
    "NAV-COV": _fill_cov,
    "NAV-RELPOSNED": _fill_relative,
    "NAV-EOE": lambda sample: {"iTOW": _get_itow(sample)},
}
"""Fields of each message of a sample, as pyubx2 names and scales them."""
