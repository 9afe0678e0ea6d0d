"""What a satellite receiver in software says of a sample: one log or sentence at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime

from modelserver.messages import FixType, GpsSample
from msdrivers.protocol import gps_time
from msdrivers.protocol.nmea import encode as nmea
from msdrivers.protocol.nmea.fields import KMH, KNOT
from msdrivers.protocol.novatel import (
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    Velocity,
)
from msdrivers.protocol.novatel.encode import encode
from msdrivers.protocol.novatel.logs import Body

_TYPES = {
    FixType.FIX_2D: PositionType.FIXEDHEIGHT,
    FixType.FIX_3D: PositionType.SINGLE,
    FixType.DIFFERENTIAL: PositionType.PSRDIFF,
    FixType.RTK_FLOAT: PositionType.NARROW_FLOAT,
    FixType.RTK_FIXED: PositionType.NARROW_INT,
    FixType.DEAD_RECKONING: PositionType.PROPAGATED,
}
_QUALITY = {
    FixType.NONE: "0",
    FixType.FIX_2D: "1",
    FixType.FIX_3D: "1",
    FixType.DIFFERENTIAL: "2",
    FixType.RTK_FLOAT: "5",
    FixType.RTK_FIXED: "4",
    FixType.DEAD_RECKONING: "6",
}
_MODE = {
    FixType.NONE: "N",
    FixType.FIX_2D: "A",
    FixType.FIX_3D: "A",
    FixType.DIFFERENTIAL: "D",
    FixType.RTK_FLOAT: "F",
    FixType.RTK_FIXED: "R",
    FixType.DEAD_RECKONING: "E",
}
_WGS84 = 61


def known(name: str) -> bool:
    """Return whether a log or sentence is written here, e.g. "bestposb" or "gpgga"."""
    return name in NMEA or (name[:-1] in NOVATEL and name[-1] in "ab")


def write(name: str, sample: GpsSample, utime: int, port: str = "COM1") -> bytes:
    """Return the bytes of a log or sentence that says a sample at `utime`."""
    if name in NMEA:
        return NMEA[name](sample, utime)
    week, microseconds = gps_time.gps_of(utime)
    log_name = name[:-1].upper()
    binary = name[-1] == "b"
    header = LogHeader(log_name, week, microseconds // 1000, TimeStatus.FINESTEERING, port, 0, 0, binary)
    return encode(NovatelLog(header, NOVATEL[name[:-1]](sample)))


def _zero(value: float) -> float:
    return 0.0 if value != value else value


def _height(sample: GpsSample) -> float:
    """Above mean sea level; where the sample has only the ellipsoid's, the geoid is taken to lie on it."""
    if sample.height_msl == sample.height_msl:
        return sample.height_msl
    return sample.height_ellipsoidal - _zero(sample.undulation)


def _sigmas(sample: GpsSample) -> tuple[float, float, float]:
    """North, east, up."""
    if sample.position_covariance is None:
        return 0.0, 0.0, 0.0
    east, north, up = sample.position_covariance[::4]
    return math.sqrt(north), math.sqrt(east), math.sqrt(up)


def _track(course: float) -> float:
    """Return degrees clockwise from north, 0 to 360."""
    return (90.0 - math.degrees(course)) % 360.0


def _motion(sample: GpsSample) -> tuple[float, float, float]:
    """Speed, course and climb; nan where the sample does not tell."""
    if sample.velocity is not None:
        east, north, up = sample.velocity
        return math.hypot(east, north), math.atan2(north, east), up
    return sample.speed, sample.course, math.nan


def _position(sample: GpsSample) -> Position:
    if sample.fix_type is FixType.NONE:
        status, zeros = SolutionStatus.INSUFFICIENT_OBS, (0.0,) * 4
        return Position(status, PositionType.NONE, *zeros, _WGS84, 0.0, 0.0, 0.0, "", 0.0, 0.0, 0, 0)
    used = max(0, sample.satellites)
    place = (sample.latitude_deg, sample.longitude_deg, _zero(_height(sample)), _zero(sample.undulation))
    kind = _TYPES[sample.fix_type]
    return Position(SolutionStatus.SOL_COMPUTED, kind, *place, _WGS84, *_sigmas(sample), "", 0.0, 0.0, used, used)


def _velocity(sample: GpsSample) -> Velocity:
    speed, course, climb = _motion(sample)
    if sample.fix_type is FixType.NONE or speed != speed:
        return Velocity(SolutionStatus.INSUFFICIENT_OBS, PositionType.NONE, 0.0, 0.0, 0.0, 0.0, 0.0)
    kind = PositionType.DOPPLER_VELOCITY
    latency = _zero(sample.velocity_latency)
    return Velocity(SolutionStatus.SOL_COMPUTED, kind, latency, 0.0, speed, _track(_zero(course)), _zero(climb))


def _heading(sample: GpsSample) -> HeadingLog:
    if sample.baseline_yaw != sample.baseline_yaw:
        return HeadingLog(SolutionStatus.INSUFFICIENT_OBS, PositionType.NONE, -1.0, 0.0, 0.0, 0.0, 0.0, "", 0, 0)
    sigma = math.degrees(_zero(sample.baseline_yaw_sigma))
    used = max(0, sample.satellites)
    kind = PositionType.NARROW_INT
    heading = _track(sample.baseline_yaw)
    return HeadingLog(SolutionStatus.SOL_COMPUTED, kind, 1.0, heading, 0.0, sigma, sigma, "", used, used)


NOVATEL: dict[str, Callable[[GpsSample], Body]] = {
    "bestpos": _position,
    "psrpos": _position,
    "rtkpos": _position,
    "bestvel": _velocity,
    "heading": _heading,
    "heading2": _heading,
}
"""Log without its format's letter -> the body."""


def _clock(utime: int) -> str:
    return nmea.time_of_day(utime % gps_time.DAY)


def _date(utime: int) -> datetime:
    return datetime.fromtimestamp(utime // gps_time.SECOND, UTC)


def _place(sample: GpsSample) -> tuple[str, str, str, str]:
    return (*nmea.angle(sample.latitude_deg, "NS", 2), *nmea.angle(sample.longitude_deg, "EW", 3))


def _gga(sample: GpsSample, utime: int) -> bytes:
    count = str(sample.satellites) if sample.satellites >= 0 else ""
    heights = (nmea.number(_height(sample), 4), "M", nmea.number(sample.undulation, 4), "M")
    fields = (_clock(utime), *_place(sample), _QUALITY[sample.fix_type], count, nmea.number(sample.hdop, 2))
    return nmea.encode("GP", "GGA", (*fields, *heights, "", ""))


def _rmc(sample: GpsSample, utime: int) -> bytes:
    speed, course, _ = _motion(sample)
    status = "V" if sample.fix_type is FixType.NONE else "A"
    motion = (nmea.number(speed / KNOT, 4), nmea.number(_track(course), 4))
    date = _date(utime).strftime("%d%m%y")
    fields = (_clock(utime), status, *_place(sample), *motion, date, "", "", _MODE[sample.fix_type])
    return nmea.encode("GP", "RMC", fields)


def _vtg(sample: GpsSample, utime: int) -> bytes:
    speed, course, _ = _motion(sample)
    track = nmea.number(_track(course), 4)
    speeds = (nmea.number(speed / KNOT, 4), "N", nmea.number(speed / KMH, 4), "K")
    return nmea.encode("GP", "VTG", (track, "T", "", "M", *speeds, _MODE[sample.fix_type]))


def _gsa(sample: GpsSample, utime: int) -> bytes:
    dimension = {FixType.NONE: "1", FixType.FIX_2D: "2"}.get(sample.fix_type, "3")
    dilution = (nmea.number(each, 2) for each in (sample.pdop, sample.hdop, sample.vdop))
    return nmea.encode("GP", "GSA", ("A", dimension, *[""] * 12, *dilution))


def _gst(sample: GpsSample, utime: int) -> bytes:
    sigmas = _sigmas(sample) if sample.position_covariance else (math.nan,) * 3
    return nmea.encode("GP", "GST", (_clock(utime), *[""] * 4, *(nmea.number(each, 3) for each in sigmas)))


def _hdt(sample: GpsSample, utime: int) -> bytes:
    return nmea.encode("GP", "HDT", (nmea.number(_track(sample.baseline_yaw), 4), "T"))


def _zda(sample: GpsSample, utime: int) -> bytes:
    day = _date(utime)
    return nmea.encode("GP", "ZDA", (_clock(utime), f"{day:%d}", f"{day:%m}", f"{day:%Y}", "00", "00"))


NMEA: dict[str, Callable[[GpsSample, int], bytes]] = {
    "gpgga": _gga,
    "gprmc": _rmc,
    "gpvtg": _vtg,
    "gpgsa": _gsa,
    "gpgst": _gst,
    "gphdt": _hdt,
    "gpzda": _zda,
}
"""Sentence -> its bytes."""
