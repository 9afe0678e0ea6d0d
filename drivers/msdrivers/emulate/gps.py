"""Emulators of satellite receivers (NovAtel OEM4, plain NMEA) and of gpsd: logs, sentences, reports of samples.

The receiver takes the commands of a NovAtel OEM4 that a driver needs (`log`, `unlog`, `unlogall`, and some without
effect here), and answers and prompts as it does. With `is_answering` off and `saved` logs it is a plain NMEA receiver.
gpsd answers WATCH and sends TPV, GST and SKY reports.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from modelserver.messages import FixType, GpsSample
from msdrivers.devices.gps import DAY, SECOND, gps_of, nmea
from msdrivers.devices.gps.novatel import (
    Body,
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    Velocity,
    encode,
)
from msdrivers.devices.gpsd import WATCH
from msdrivers.emulate import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send

_FIXES = {
    FixType.NONE: (PositionType.NONE, "0", "N"),
    FixType.FIX_2D: (PositionType.FIXEDHEIGHT, "1", "A"),
    FixType.FIX_3D: (PositionType.SINGLE, "1", "A"),
    FixType.DIFFERENTIAL: (PositionType.PSRDIFF, "2", "D"),
    FixType.RTK_FLOAT: (PositionType.NARROW_FLOAT, "5", "F"),
    FixType.RTK_FIXED: (PositionType.NARROW_INT, "4", "R"),
    FixType.DEAD_RECKONING: (PositionType.PROPAGATED, "6", "E"),
}
"""Position type, quality in GGA, mode in RMC and VTG."""

_WGS84 = 61


def is_known(name: str) -> bool:
    """Return whether a log or sentence is written here, e.g. "bestposb" or "gpgga"."""
    return name in NMEA or (name[:-1] in NOVATEL and name[-1] in "ab")


def encode_sample(name: str, sample: GpsSample, utime: int, port: str = "COM1") -> bytes:
    """Encode a sample at `utime` as a log or sentence."""
    if name in NMEA:
        return NMEA[name](sample, utime)
    week, microseconds = gps_of(utime)
    status, binary = TimeStatus.FINESTEERING, name[-1] == "b"
    header = LogHeader(name[:-1].upper(), week, microseconds // 1000, status, port, 0, 0, binary)
    return encode(NovatelLog(header, NOVATEL[name[:-1]](sample)))


def _nan_to_zero(value: float) -> float:
    return 0.0 if value != value else value


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
        return Position(status, PositionType.NONE, *zeros, _WGS84, 0.0, 0.0, 0.0, "", 0.0, 0.0, 0, 0)
    used, kind = max(0, sample.satellites), _FIXES[sample.fix_type][0]
    heights = _nan_to_zero(_get_height_msl(sample)), _nan_to_zero(sample.undulation)
    place = (sample.latitude_deg, sample.longitude_deg, *heights)
    return Position(SolutionStatus.SOL_COMPUTED, kind, *place, _WGS84, *_get_sigmas(sample), "", 0.0, 0.0, used, used)


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


NOVATEL: dict[str, Callable[[GpsSample], Body]] = {
    "bestpos": _make_position,
    "psrpos": _make_position,
    "rtkpos": _make_position,
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
    quality = (_FIXES[sample.fix_type][1], count, nmea.format_number(sample.hdop, 2))
    return nmea.encode("GP", "GGA", (_format_clock(utime), *_format_position(sample), *quality, *heights, "", ""))


def _format_rmc(sample: GpsSample, utime: int) -> bytes:
    speed, course, _ = _get_motion(sample)
    status, mode = "V" if sample.fix_type is FixType.NONE else "A", _FIXES[sample.fix_type][2]
    motion = (nmea.format_number(speed / nmea.KNOT, 4), nmea.format_number(_track_from_course(course), 4))
    date = datetime.fromtimestamp(utime // SECOND, UTC).strftime("%d%m%y")
    fields = (_format_clock(utime), status, *_format_position(sample), *motion, date, "", "", mode)
    return nmea.encode("GP", "RMC", fields)


def _format_vtg(sample: GpsSample, utime: int) -> bytes:
    speed, course, _ = _get_motion(sample)
    track = nmea.format_number(_track_from_course(course), 4)
    speeds = (nmea.format_number(speed / nmea.KNOT, 4), "N", nmea.format_number(speed / nmea.KMH, 4), "K")
    return nmea.encode("GP", "VTG", (track, "T", "", "M", *speeds, _FIXES[sample.fix_type][2]))


def _format_gsa(sample: GpsSample, utime: int) -> bytes:
    dimension = {FixType.NONE: "1", FixType.FIX_2D: "2"}.get(sample.fix_type, "3")
    dilution = (nmea.format_number(each, 2) for each in (sample.pdop, sample.hdop, sample.vdop))
    return nmea.encode("GP", "GSA", ("A", dimension, *[""] * 12, *dilution))


def _format_gst(sample: GpsSample, utime: int) -> bytes:
    sigmas = _get_sigmas(sample) if sample.position_covariance else (math.nan,) * 3
    fields = (nmea.format_number(each, 3) for each in sigmas)
    return nmea.encode("GP", "GST", (_format_clock(utime), *[""] * 4, *fields))


def _format_hdt(sample: GpsSample, utime: int) -> bytes:
    return nmea.encode("GP", "HDT", (nmea.format_number(_track_from_course(sample.baseline_yaw), 4), "T"))


def _format_zda(sample: GpsSample, utime: int) -> bytes:
    day = datetime.fromtimestamp(utime // SECOND, UTC)
    return nmea.encode("GP", "ZDA", (_format_clock(utime), f"{day:%d}", f"{day:%m}", f"{day:%Y}", "00", "00"))


NMEA: dict[str, Callable[[GpsSample, int], bytes]] = {
    "gpgga": _format_gga,
    "gprmc": _format_rmc,
    "gpvtg": _format_vtg,
    "gpgsa": _format_gsa,
    "gpgst": _format_gst,
    "gphdt": _format_hdt,
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


@dataclass(slots=True)
class _LogRequest:
    """A log that was asked for: its period in microseconds, 0 for each sample, and when it was last written."""

    period: int
    last: int | None = None


class GpsEmulator(SampleEmulator[GpsSample]):
    """An `Endpoint` of bytes that speaks as the receiver does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], unit: GpsUnit | None = None) -> None:
        self._unit = GpsUnit() if unit is None else unit
        super().__init__(samples, self._unit.latency)
        self._logs: dict[str, _LogRequest] = {}
        self._line = bytearray()
        for line in self._unit.saved:
            if error := self._execute(line):
                raise ValueError(f"saved configuration, '{line}': {error}")

    @property
    def logs(self) -> tuple[str, ...]:
        """The logs that are on, e.g. "bestposb"."""
        return tuple(self._logs)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """The host's end of the line is open. A receiver does not notice, but greets when it was just switched on."""
        first = self._now is None
        self._now = now
        self._line.clear()
        return [Send(b"\r\n" + _PROMPT)] if first and self._unit.is_answering else []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process commands: lines that end with CR or LF."""
        self._now = now
        if not self._unit.is_answering:
            return []
        out: list[Output[bytes]] = []
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
                out.append(Send(f"\r\n{answer}\r\n".encode("ascii") + _PROMPT))
        return out

    def _send_sample(self, sample: GpsSample) -> list[Output[bytes]]:
        data = self._make_logs(sample)
        return [Send(data)] if data else []

    def _make_logs(self, sample: GpsSample) -> bytes:
        utime = sample.header.utime
        logs = b""
        for name, wanted in self._logs.items():
            # half a millisecond of grace: stamps are rounded
            if wanted.last is not None and utime - wanted.last < wanted.period - 500:
                continue
            wanted.last = utime
            logs += encode_sample(name, sample, utime, _PORT)
            self.counts[name] += 1
        return logs

    def _execute(self, line: str) -> str:
        """Carry a command out. Return what is wrong with it; empty if nothing is."""
        words = line.lower().split()
        command, fields = words[0], words[1:]
        if fields and command in ("log", "unlog", "unlogall") and fields[0] in ("thisport", _PORT.lower()):
            fields = fields[1:]
        if command == "unlogall":
            self._logs.clear()
            return ""
        if command in _NO_EFFECT_COMMANDS:
            return ""
        if command not in ("log", "unlog"):
            return f"Invalid Message. Field = {command}"
        if not fields or not is_known(fields[0]):
            return f"Invalid Message. Field = {fields[0] if fields else ''}"
        if command == "unlog":
            self._logs.pop(fields[0], None)
            return ""
        return self._execute_log(fields)

    def _execute_log(self, fields: Sequence[str]) -> str:
        trigger = fields[1] if len(fields) > 1 else "onchanged"
        period = 0.0
        if trigger == "ontime" and len(fields) > 2:
            with suppress(ValueError):
                period = float(fields[2])
            if not 0.05 <= period <= 86_400.0:
                return "Invalid period"
        elif trigger not in ("onnew", "onchanged"):
            return "Invalid trigger"
        self._logs[fields[0]] = _LogRequest(round(period * 1e6))
        return ""


RECEIVER = "/dev/ttyACM0"

LATENCY = 0.03
"""From the instant of a sample to its reports, seconds."""

_STATUS = {FixType.DIFFERENTIAL: 2, FixType.RTK_FIXED: 3, FixType.RTK_FLOAT: 4, FixType.DEAD_RECKONING: 5}


class GpsdEmulator(SampleEmulator[GpsSample]):
    """An `Endpoint` of bytes that speaks as gpsd does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[GpsSample], *, has_gst: bool = True) -> None:
        super().__init__(samples, LATENCY)
        self._has_gst = has_gst
        self._line = b""
        self._is_watched = False

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self._now, self._line = now, b""
        return [self._report(**{"class": "VERSION", "release": "3.25", "proto_major": 3, "proto_minor": 15})]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process commands."""
        self._now = now
        *lines, self._line = (self._line + unit).split(b"\n")
        self._line = self._line[-200:]
        out: list[Output[bytes]] = []
        for line in lines:
            if line.startswith(WATCH[:7]):
                self._is_watched = True
                device = {"class": "DEVICE", "path": RECEIVER, "driver": "u-blox"}
                out.append(self._report(**{"class": "DEVICES", "devices": [device]}))
                out.append(self._report(**{"class": "WATCH", "enable": True, "json": True}))
        return out

    def _send_sample(self, sample: GpsSample) -> list[Output[bytes]]:
        return self._report_sample(sample) if self._is_watched else []

    def _report(self, **fields: Any) -> Send[bytes]:
        self.counts[fields["class"]] += 1
        known = {key: value for key, value in fields.items() if not (isinstance(value, float) and math.isnan(value))}
        return Send(json.dumps(known, separators=(",", ":")).encode() + b"\r\n")

    def _report_sample(self, sample: GpsSample) -> list[Output[bytes]]:
        when = datetime.fromtimestamp(sample.header.utime // 1000 / 1e3, UTC)
        head = {"device": RECEIVER, "time": when.isoformat(timespec="milliseconds").replace("+00:00", "Z")}
        out: list[Output[bytes]] = [
            self._report(
                **{"class": "SKY"}, **head, hdop=sample.hdop, vdop=sample.vdop, pdop=sample.pdop, uSat=sample.satellites
            )
        ]
        if sample.fix_type is FixType.NONE:
            return [*out, self._report(**{"class": "TPV"}, **head, mode=1)]
        east, north, up = sample.velocity or (math.nan,) * 3
        mode = 2 if sample.fix_type is FixType.FIX_2D else 3
        status = {"status": _STATUS[sample.fix_type]} if sample.fix_type in _STATUS else {}
        motion = {"velN": north, "velE": east, "velD": -up, "speed": math.hypot(east, north)}
        track = {"track": math.degrees(math.atan2(east, north)) % 360.0 if east == east else math.nan}
        heights = {"altHAE": sample.height_ellipsoidal, "altMSL": sample.height_msl, "geoidSep": sample.undulation}
        place = {"lat": sample.latitude_deg, "lon": sample.longitude_deg}
        out.append(self._report(**{"class": "TPV"}, **head, mode=mode, **status, **place, **heights, **motion, **track))
        if self._has_gst and sample.position_covariance is not None:
            longitude, latitude, height = (math.sqrt(each) for each in sample.position_covariance[::4])
            out.append(self._report(**{"class": "GST"}, **head, lat=latitude, lon=longitude, alt=height))
        return out
