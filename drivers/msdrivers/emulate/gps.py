"""Emulators of satellite receivers (NovAtel OEM4, plain NMEA, u-blox) and of gpsd.

The receiver takes the commands of a NovAtel OEM4 that a driver needs (`log`, `unlog`, `unlogall`, and some without
effect here), and answers and prompts as it does. With `is_answering` off and `saved` logs it is a plain NMEA receiver.
gpsd answers WATCH and sends TPV, GST and SKY reports. The u-blox receiver answers MON-VER, applies CFG-VALSET, or
CFG-MSG and CFG-RATE, and sends epochs.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

from pyubx2 import GET, SET, UBX_MSGIDS, UBXMessage, UBXMessageError, UBXParseError, UBXReader, UBXTypeError

from modelserver.messages import FixType, GpsSample
from msdrivers.devices.gps import DAY, SECOND, gps_of, nmea, novatel
from msdrivers.devices.gps.driver import GpsSettings
from msdrivers.devices.gps.novatel import HeadingLog, Position, PositionType, SolutionStatus, Velocity
from msdrivers.devices.gpsd import WATCH
from msdrivers.devices.stream import FrameScanner, ParsedFrame, RejectedFrame
from msdrivers.devices.ublox import VALSET_VERSION, UbxFormat
from msdrivers.emulate import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send


class _Codes(NamedTuple):
    """A type of fix: in NovAtel's logs, in GGA, in RMC, in gpsd's status, and in UBX (fixType, diffSoln, carrSoln)."""

    position: PositionType
    quality: str
    mode: str
    status: int
    ubx: tuple[int, int, int]


_FIXES = {
    FixType.NONE: _Codes(PositionType.NONE, "0", "N", 0, (0, 0, 0)),
    FixType.FIX_2D: _Codes(PositionType.FIXEDHEIGHT, "1", "A", 0, (2, 0, 0)),
    FixType.FIX_3D: _Codes(PositionType.SINGLE, "1", "A", 0, (3, 0, 0)),
    FixType.DIFFERENTIAL: _Codes(PositionType.PSRDIFF, "2", "D", 2, (3, 1, 0)),
    FixType.RTK_FLOAT: _Codes(PositionType.NARROW_FLOAT, "5", "F", 4, (3, 1, 1)),
    FixType.RTK_FIXED: _Codes(PositionType.NARROW_INT, "4", "R", 3, (3, 1, 2)),
    FixType.DEAD_RECKONING: _Codes(PositionType.PROPAGATED, "6", "E", 5, (1, 0, 0)),
}


def is_known(name: str) -> bool:
    """Return whether a log or sentence is written here, e.g. "bestposb" or "gpgga"."""
    return name in NMEA or (name[:-1] in NOVATEL and name[-1] == "b")


def encode_sample(name: str, sample: GpsSample, utime: int, port: str = "COM1") -> bytes:
    """Encode a sample at `utime` as a log or sentence."""
    if name in NMEA:
        return NMEA[name](sample, utime)
    week, microseconds = gps_of(utime)
    time = week, microseconds // 1000, novatel.TimeStatus.FINESTEERING
    header = novatel.LogHeader(name[:-1].upper(), *time, port, 0, 0, True)
    return novatel.encode(novatel.NovatelLog(header, NOVATEL[name[:-1]](sample)))


def _nan_to_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _get_height_msl(sample: GpsSample) -> float:
    """Return the height above mean sea level; without a geoid undulation the ellipsoidal height."""
    if sample.height_msl == sample.height_msl:
        return sample.height_msl
    return sample.height_ellipsoidal - _nan_to_zero(sample.undulation)


def _get_sigmas(sample: GpsSample) -> tuple[float, float, float]:
    """Return the standard deviations north, east, up."""
    if sample.position_covariance is None:
        return 0.0, 0.0, 0.0
    east, north, up = sample.position_covariance[::4]
    return math.sqrt(north), math.sqrt(east), math.sqrt(up)


def _track_from_course(course: float) -> float:
    """Return degrees clockwise from north, 0 to 360."""
    return (90.0 - math.degrees(course)) % 360.0


def _get_motion(sample: GpsSample) -> tuple[float, float, float]:
    """Return speed, course and climb; nan if missing."""
    if sample.velocity is not None:
        east, north, up = sample.velocity
        return math.hypot(east, north), math.atan2(north, east), up
    return sample.speed, sample.course, math.nan


def _make_position(sample: GpsSample) -> Position:
    if sample.fix_type is FixType.NONE:
        status, zeros = SolutionStatus.INSUFFICIENT_OBS, (0.0,) * 4
        return Position(status, PositionType.NONE, *zeros, novatel.WGS84_DATUM, 0.0, 0.0, 0.0, "", 0.0, 0.0, 0, 0)
    used, kind = max(0, sample.satellites), _FIXES[sample.fix_type].position
    heights = _nan_to_zero(_get_height_msl(sample)), _nan_to_zero(sample.undulation)
    place = (sample.latitude_deg, sample.longitude_deg, *heights)
    return Position(
        SolutionStatus.SOL_COMPUTED, kind, *place, novatel.WGS84_DATUM, *_get_sigmas(sample), "", 0.0, 0.0, used, used
    )


def _make_velocity(sample: GpsSample) -> Velocity:
    speed, course, climb = _get_motion(sample)
    if sample.fix_type is FixType.NONE or speed != speed:
        return Velocity(SolutionStatus.INSUFFICIENT_OBS, PositionType.NONE, 0.0, 0.0, 0.0, 0.0, 0.0)
    latency, track = _nan_to_zero(sample.velocity_latency), _track_from_course(_nan_to_zero(course))
    kind = PositionType.DOPPLER_VELOCITY
    return Velocity(SolutionStatus.SOL_COMPUTED, kind, latency, 0.0, speed, track, _nan_to_zero(climb))


def _make_heading(sample: GpsSample) -> HeadingLog:
    if sample.baseline_yaw != sample.baseline_yaw:
        return HeadingLog(SolutionStatus.INSUFFICIENT_OBS, PositionType.NONE, -1.0, 0.0, 0.0, 0.0, 0.0, "", 0, 0)
    sigma, used = math.degrees(_nan_to_zero(sample.baseline_yaw_sigma)), max(0, sample.satellites)
    kind, heading = PositionType.NARROW_INT, _track_from_course(sample.baseline_yaw)
    return HeadingLog(SolutionStatus.SOL_COMPUTED, kind, 1.0, heading, 0.0, sigma, sigma, "", used, used)


NOVATEL: dict[str, Callable[[GpsSample], novatel.Body]] = {
    "bestpos": _make_position,
    "bestvel": _make_velocity,
    "heading": _make_heading,
    "heading2": _make_heading,
}
"""Log without its format's letter -> the body."""


def _format_clock(utime: int) -> str:
    return nmea.format_time_of_day(utime % DAY)


def _format_position(sample: GpsSample) -> tuple[str, str, str, str]:
    return (*nmea.format_angle(sample.latitude_deg, "NS", 2), *nmea.format_angle(sample.longitude_deg, "EW", 3))


def _format_gga(sample: GpsSample, utime: int) -> bytes:
    count = str(sample.satellites) if sample.satellites >= 0 else ""
    heights = (nmea.format_number(_get_height_msl(sample), 4), "M", nmea.format_number(sample.undulation, 4), "M")
    quality = (_FIXES[sample.fix_type].quality, count, nmea.format_number(sample.hdop, 2))
    return nmea.encode("GP", "GGA", (_format_clock(utime), *_format_position(sample), *quality, *heights, "", ""))


def _format_rmc(sample: GpsSample, utime: int) -> bytes:
    speed, course, _ = _get_motion(sample)
    status, mode = "V" if sample.fix_type is FixType.NONE else "A", _FIXES[sample.fix_type].mode
    motion = (nmea.format_number(speed / nmea.KNOT, 4), nmea.format_number(_track_from_course(course), 4))
    date = datetime.fromtimestamp(utime // SECOND, UTC).strftime("%d%m%y")
    fields = (_format_clock(utime), status, *_format_position(sample), *motion, date, "", "", mode)
    return nmea.encode("GP", "RMC", fields)


def _format_gsa(sample: GpsSample, utime: int) -> bytes:
    dimension = {FixType.NONE: "1", FixType.FIX_2D: "2"}.get(sample.fix_type, "3")
    dilution = (nmea.format_number(each, 2) for each in (sample.pdop, sample.hdop, sample.vdop))
    return nmea.encode("GP", "GSA", ("A", dimension, *[""] * 12, *dilution))


def _format_gst(sample: GpsSample, utime: int) -> bytes:
    sigmas = _get_sigmas(sample) if sample.position_covariance else (math.nan,) * 3
    fields = (nmea.format_number(each, 3) for each in sigmas)
    return nmea.encode("GP", "GST", (_format_clock(utime), *[""] * 4, *fields))


def _format_zda(sample: GpsSample, utime: int) -> bytes:
    day = datetime.fromtimestamp(utime // SECOND, UTC)
    return nmea.encode("GP", "ZDA", (_format_clock(utime), f"{day:%d}", f"{day:%m}", f"{day:%Y}", "00", "00"))


NMEA: dict[str, Callable[[GpsSample, int], bytes]] = {
    "gpgga": _format_gga,
    "gprmc": _format_rmc,
    "gpgsa": _format_gsa,
    "gpgst": _format_gst,
    "gpzda": _format_zda,
}
"""Sentence -> its bytes."""

_PORT = "COM1"
_PROMPT = f"[{_PORT}]".encode()
_MAX_COMMAND_BYTES = 200
_NO_EFFECT_COMMANDS = frozenset({"fix", "com", "datum", "saveconfig", "undulationauto", "ecutoff", "dgpstimeout"})
"""Commands that are accepted and change nothing here."""


@dataclass(frozen=True, slots=True)
class GpsUnit:
    """Configuration of the receiver.

    saved: lines of its saved configuration, e.g. "log com1 gpgga ontime 0.25", carried out when it starts.
    latency: from the instant of a sample to the first byte of its logs, seconds. is_answering: whether it listens.
    """

    saved: tuple[str, ...] = ()
    latency: float = 0.02
    is_answering: bool = True


def make_gps_emulator(settings: GpsSettings, samples: Iterable[GpsSample]) -> GpsEmulator:
    """Return the receiver that a driver with these settings expects: NovAtel, or one that only sends NMEA."""
    if settings.protocol != "nmea":
        return GpsEmulator(samples)
    period = 1.0 / settings.rate_hz
    saved = tuple(f"log com1 {sentence} ontime {period:g}" for sentence in ("gpgga", "gprmc", "gpgst"))
    return GpsEmulator(samples, GpsUnit(saved=saved, is_answering=False))


class GpsEmulator(SampleEmulator[GpsSample, bytes]):
    """An `Endpoint` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: GpsUnit | None = None) -> None:
        self._unit = GpsUnit() if unit is None else unit
        super().__init__(samples, self._unit.latency)
        self.logs: dict[str, int] = {}
        """Periods of the logs that are on, e.g. of "bestposb", microseconds."""
        self._written: dict[str, int] = {}
        """When each log was written last."""
        self._line = bytearray()
        for line in self._unit.saved:
            self._execute(line)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open. A receiver does not notice, but greets when it was just switched on."""
        first = self._now is None
        self._now = now
        self._line.clear()
        return [Send(b"\r\n" + _PROMPT)] if first and self._unit.is_answering else []

    def _answer(self, unit: bytes) -> Iterator[bytes]:
        """Process commands: lines that end with CR or LF."""
        if not self._unit.is_answering:
            return
        for byte in unit:
            if byte not in b"\r\n":
                if len(self._line) < _MAX_COMMAND_BYTES:
                    self._line.append(byte)
                continue
            line = self._line.decode("latin-1").strip()
            self._line.clear()
            if line:
                error = self._execute(line)
                self.counts["rejected" if error else "accepted"] += 1
                answer = f"<ERROR:{error}" if error else "<OK"
                yield f"\r\n{answer}\r\n".encode("ascii") + _PROMPT

    def _encode(self, sample: GpsSample) -> Iterable[bytes]:
        utime = sample.header.utime
        logs = b""
        for name, period in self.logs.items():
            # half a millisecond of grace: stamps are rounded
            if utime - self._written.get(name, 0) < period - 500:
                continue
            self._written[name] = utime
            logs += encode_sample(name, sample, utime, _PORT)
            self.counts[name] += 1
        return (logs,)

    def _execute(self, line: str) -> str:
        """Carry a command out. Return what is wrong with it; empty if nothing is."""
        command, *fields = line.lower().split()
        try:
            if command == "unlogall":
                self.logs.clear()
            elif command == "unlog":
                self.logs.pop(fields[1], None)
            elif command == "log" and is_known(fields[1]):
                # log PORT NAME ontime SECONDS
                self.logs[fields[1]] = round(float(fields[3]) * 1e6)
            elif command not in _NO_EFFECT_COMMANDS:
                return f"Invalid Message. Field = {command}"
        except (IndexError, ValueError):
            return f"Invalid Message. Field = {line}"
        return ""


RECEIVER = "/dev/ttyACM0"

LATENCY = 0.03
"""From the instant of a sample to what gpsd or the u-blox receiver sends, seconds."""


class GpsdEmulator(SampleEmulator[GpsSample, bytes]):
    """An `Endpoint` of bytes that speaks as gpsd does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], *, has_gst: bool = True) -> None:
        super().__init__(samples, LATENCY)
        self._has_gst = has_gst
        self._line = b""
        self._is_watched = False

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self._now, self._line = now, b""
        return [Send(self._report(**{"class": "VERSION", "release": "3.25", "proto_major": 3, "proto_minor": 15}))]

    def _answer(self, unit: bytes) -> Iterator[bytes]:
        *lines, self._line = (self._line + unit).split(b"\n")
        self._line = self._line[-200:]
        for line in lines:
            if line.startswith(WATCH[:7]):
                self._is_watched = True
                device = {"class": "DEVICE", "path": RECEIVER, "driver": "u-blox"}
                yield self._report(**{"class": "DEVICES", "devices": [device]})
                yield self._report(**{"class": "WATCH", "enable": True, "json": True})

    def _report(self, **fields: Any) -> bytes:
        self.counts[fields["class"]] += 1
        known = {key: value for key, value in fields.items() if not (isinstance(value, float) and math.isnan(value))}
        return json.dumps(known, separators=(",", ":")).encode() + b"\r\n"

    def _encode(self, sample: GpsSample) -> Iterable[bytes]:
        if not self._is_watched:
            return ()
        when = datetime.fromtimestamp(sample.header.utime // 1000 / 1e3, UTC)
        head = {"device": RECEIVER, "time": when.isoformat(timespec="milliseconds").replace("+00:00", "Z")}
        dilution = {"hdop": sample.hdop, "vdop": sample.vdop, "pdop": sample.pdop}
        out = self._report(**{"class": "SKY"}, **head, **dilution, uSat=sample.satellites)
        if sample.fix_type is FixType.NONE:
            return (out + self._report(**{"class": "TPV"}, **head, mode=1),)
        east, north, up = sample.velocity or (math.nan,) * 3
        mode = 2 if sample.fix_type is FixType.FIX_2D else 3
        status = {"status": code} if (code := _FIXES[sample.fix_type].status) else {}
        motion = {"velN": north, "velE": east, "velD": -up, "speed": math.hypot(east, north)}
        track = {"track": math.degrees(math.atan2(east, north)) % 360.0 if east == east else math.nan}
        heights = {"altHAE": sample.height_ellipsoidal, "altMSL": sample.height_msl, "geoidSep": sample.undulation}
        place = {"lat": sample.latitude_deg, "lon": sample.longitude_deg}
        out += self._report(**{"class": "TPV"}, **head, mode=mode, **status, **place, **heights, **motion, **track)
        if self._has_gst and sample.position_covariance is not None:
            longitude, latitude, height = (math.sqrt(each) for each in sample.position_covariance[::4])
            out += self._report(**{"class": "GST"}, **head, lat=latitude, lon=longitude, alt=height)
        return (out,)


UBX_PORT: Final = "UART1"

_FACTORY_PERIOD_MS: Final = 1000

ORDER: Final = ("NAV-DOP", "NAV-PVT", "NAV-HPPOSLLH", "NAV-COV", "NAV-RELPOSNED", "NAV-EOE")
"""Messages of an epoch, in the order in which a receiver sends them."""


@dataclass(frozen=True, slots=True)
class UbloxUnit:
    """A receiver: protocol version (27 and above: CFG-VALSET), product, messages that it does not have."""

    protocol: float = 27.31
    product: str = "ZED-F9P"
    missing: frozenset[str] = frozenset()


class _CommandFormat(UbxFormat):
    """UBX messages as the receiver gets them: whole frames."""

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[Any] | RejectedFrame | None:
        found = super().scan(buffer, at, start)
        if isinstance(found, ParsedFrame):
            return ParsedFrame(found.end, found.kind, bytes(buffer[at : found.end]))
        return found


class UbloxEmulator(SampleEmulator[GpsSample, bytes]):
    """An `Endpoint` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: UbloxUnit | None = None) -> None:
        self._unit = UbloxUnit() if unit is None else unit
        super().__init__(samples, LATENCY)
        self._scanner: FrameScanner[bytes] = FrameScanner((_CommandFormat(),))
        self._period_ms = _FACTORY_PERIOD_MS
        self._last_ms: int | None = None
        self.messages: set[str] = set()
        """The messages that are on, e.g. "NAV-PVT"."""

    def _answer(self, unit: bytes) -> list[bytes]:
        return [self._execute(frame) for frame in self._scanner.feed(unit)]

    def _execute(self, frame: bytes) -> bytes:
        if UBX_MSGIDS.get(frame[2:4]) == "MON-VER":
            return self._make_version()
        if frame[2] != 0x06:
            return b""
        is_accepted = self._configure(frame)
        self.counts["accepted" if is_accepted else "rejected"] += 1
        name = "ACK-ACK" if is_accepted else "ACK-NAK"
        return _encode_ubx(name, clsID=frame[2], msgID=frame[3])

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
            return port != UBX_PORT or self._switch(message.replace("_", "-", 1), value > 0)
        return True

    def _switch(self, message: str, is_on: bool) -> bool:
        if message in self._unit.missing or message not in (*ORDER, "RXM-RTCM"):
            return False
        (self.messages.add if is_on else self.messages.discard)(message)
        return True

    def _make_version(self) -> bytes:
        texts = ("FWVER=HPG 1.32", f"PROTVER={self._unit.protocol:.2f}", f"MOD={self._unit.product}")
        payload = b"EXT CORE 1.00 (emulated)".ljust(30, b"\0") + b"00190000".ljust(10, b"\0")
        payload += b"".join(text.encode().ljust(30, b"\0") for text in texts)
        return _encode_ubx("MON-VER", payload=payload)

    def _encode(self, sample: GpsSample) -> Iterable[bytes]:
        milliseconds = sample.header.utime // 1000
        if self._last_ms is not None and milliseconds - self._last_ms < self._period_ms - 1:
            return ()
        self._last_ms = milliseconds
        names = [name for name in ORDER if name in self.messages]
        self.counts.update(names)
        return (b"".join(encode_ubx(name, sample) for name in names),)


def encode_ubx(name: str, sample: GpsSample) -> bytes:
    return _encode_ubx(name, **_FIELDS[name](sample))


def _encode_ubx(name: str, **values: Any) -> bytes:
    data: bytes = UBXMessage(name.partition("-")[0], name, GET, **values).serialize()
    return data


def _get_itow(sample: GpsSample) -> int:
    return gps_of(sample.header.utime)[1] // 1000


def _fill_pvt(sample: GpsSample) -> dict[str, Any]:
    # the second is the nearest one, nano what is missing to it
    second = (sample.header.utime + 500_000) // 1_000_000
    when = datetime.fromtimestamp(second, UTC)
    fix, is_differential, carrier = _FIXES[sample.fix_type].ubx
    east, north, up = sample.velocity or (0.0, 0.0, 0.0)
    P, V = sample.position_covariance, sample.velocity_covariance
    height, msl = _nan_to_zero(sample.height_ellipsoidal), _nan_to_zero(_get_height_msl(sample))
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
        "lat": _nan_to_zero(sample.latitude_deg),
        "lon": _nan_to_zero(sample.longitude_deg),
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
        "pDOP": min(_nan_to_zero(sample.pdop), 99.0),
        "invalidLlh": int(fix == 0),
    }


def _fill_precise(sample: GpsSample) -> dict[str, Any]:
    # each number is a coarse one and the hundredths, or tenths, that are missing to it
    height, msl = _nan_to_zero(sample.height_ellipsoidal), _nan_to_zero(_get_height_msl(sample))
    places = [_split(1e9 * _nan_to_zero(value), 100) for value in (sample.longitude_deg, sample.latitude_deg)]
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
    return {"iTOW": _get_itow(sample), **{name: min(_nan_to_zero(value), 99.0) for name, value in dops.items()}}


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
    yaw = _nan_to_zero(sample.baseline_yaw) + math.pi
    return {
        "version": 1,
        "iTOW": _get_itow(sample),
        "relPosHeading": (90.0 - math.degrees(yaw)) % 360.0,
        "accHeading": math.degrees(_nan_to_zero(sample.baseline_yaw_sigma)),
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

EMULATORS: Final[Mapping[str, Callable[[Any, Iterable[GpsSample]], SampleEmulator[GpsSample, bytes]]]] = {
    "ublox": lambda settings, samples: UbloxEmulator(samples),
    "novatel": make_gps_emulator,
    "nmea": make_gps_emulator,
    "gpsd": lambda settings, samples: GpsdEmulator(samples),
}
"""By kind of device."""
