"""gpsd: its reports, one JSON object a line (gpsd_json(5)), and the driver, which publishes its receiver's fixes.

A TPV report is a fix. Its height `alt` is that above mean sea level in releases before 3.20, which have no other; later
ones leave open what it is, and have `altHAE` and `altMSL`. The standard deviations are those of a GST report of the
same instant, which gpsd passes on from the receiver; its own error estimates (epx, epy, epv) are of an unstated
certainty and are not used. Without GST the dilution of the last SKY report is published, from which the filter computes
the sigma.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from modelserver.messages import NAN, FixType, GpsSample
from msdrivers.devices.gps import course_from_track, to_covariance
from msdrivers.devices.stream import (
    NO_FRAME,
    SECOND_NS,
    ByteSettings,
    FrameScanner,
    ParsedFrame,
    RejectedFrame,
    StreamDriver,
)
from msdrivers.endpoint import HostTime, Output

MAX_LINE: Final = 16_384
"""A longer line is noise: a SKY report has 200 bytes for each satellite."""

HOLD_NS: Final = SECOND_NS // 50
"""How long a fix waits for its GST report: gpsd writes both in one go."""

WATCH: Final = b'?WATCH={"enable":true,"json":true}\n'

USED: Final = frozenset({"TPV", "SKY", "GST", "VERSION", "DEVICES", "WATCH", "ERROR"})

_STATUS: Final = {2: FixType.DIFFERENTIAL, 3: FixType.RTK_FIXED, 4: FixType.RTK_FLOAT}
_DEAD_RECKONING: Final = (5, 6)
_NO_MEASUREMENT: Final = (7, 8)
"""A surveyed position of a time receiver, and a simulation."""


@dataclass(frozen=True, slots=True)
class GpsdReport:
    """A report: its class, its fields, and the offset of its first byte in the stream."""

    name: str
    fields: Mapping[str, Any]
    start: int

    def get_number(self, key: str) -> float:
        """Return a finite number; nan if it is missing or something else."""
        value = self.fields.get(key)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return float(value) if is_number and value is not None else NAN

    @property
    def utime(self) -> int:
        """The instant of the report, microseconds of UTC; 0 if it has none."""
        text = self.fields.get("time")
        if not isinstance(text, str):
            return 0
        try:
            when = datetime.fromisoformat(text)
        except ValueError:
            return 0
        if when.tzinfo is None:
            return 0
        return max(0, (when - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1))

    @property
    def fix_type(self) -> FixType:
        """The type of the fix of a TPV report."""
        mode, status = self.fields.get("mode"), self.fields.get("status")
        if mode not in (2, 3) or status in _NO_MEASUREMENT:
            return FixType.NONE
        if status in _DEAD_RECKONING:
            return FixType.DEAD_RECKONING
        plain = FixType.FIX_3D if mode == 3 else FixType.FIX_2D
        return _STATUS.get(status, plain) if isinstance(status, int) else plain


class GpsdFormat:
    """A `FrameFormat` of gpsd's lines."""

    start_bytes = b"{"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[GpsdReport] | RejectedFrame | None:
        end = buffer.find(b"\n", at, at + MAX_LINE)
        if end < 0:
            return None if len(buffer) - at < MAX_LINE else RejectedFrame("length")
        try:
            fields = json.loads(bytes(buffer[at:end]))
        except (ValueError, RecursionError):
            return RejectedFrame("json")
        name = fields.get("class") if isinstance(fields, dict) else None
        if not isinstance(name, str):
            return NO_FRAME
        report = GpsdReport(name, fields, start) if name in USED else None
        return ParsedFrame(end + 1, f"gpsd.{name[:16]}", report)


class GpsdStream(FrameScanner[GpsdReport]):
    """Parses bytes to reports. Never raises; memory is bounded."""

    formats = (GpsdFormat(),)


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsdSettings(ByteSettings):
    """Settings of gpsd. Raises ValueError with the key for an invalid value."""

    receiver: str = ""
    """Path of the receiver at gpsd's machine, e.g. /dev/ttyACM0, where gpsd has several; empty: all."""
    silence: float = 5.0
    """Timeout for fixes, seconds, after which gpsd is asked again."""
    delay: float = 0.0
    """Shortest time from a fix to its report, seconds; it cannot be distinguished from the offset of the clocks."""
    delay_sigma: float = 0.05
    """Its standard deviation, seconds."""


class GpsdDriver(StreamDriver[GpsdReport]):
    """An `Endpoint` of bytes at gpsd's TCP port; see `GpsdSettings`.

    Further counts: `repeated` instants, `other_receiver`.
    """

    device = "gpsd"
    description = "gpsd"
    awaited = "TPV"
    answer_timeout = 2.0
    attempts = 2

    def __init__(self, settings: GpsdSettings) -> None:
        super().__init__(settings, GpsdStream())
        self._receiver = settings.receiver
        self._pending: tuple[GpsdReport, int, int] | None = None
        self._gst: GpsdReport | None = None
        self._sky: GpsdReport | None = None
        self._last_utime = 0

    def _make_identification(self) -> bytes:
        return WATCH

    def _on_start(self) -> None:
        self._pending = self._gst = self._sky = None

    def _get_extra_deadline(self) -> int | None:
        return None if self._pending is None else self._pending[2]

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        return self._release(now)

    def _on_message(self, message: GpsdReport, now: HostTime) -> list[Output[bytes]]:
        if message.name == "WATCH":
            return self._on_identity("gpsd", (), now)
        receiver = message.fields.get("device")
        if self._receiver and isinstance(receiver, str) and receiver != self._receiver:
            self._counts["other_receiver"] += 1
            return []
        if message.name == "SKY":
            # reports of some receivers have the satellites only
            if math.isfinite(message.get_number("hdop")):
                self._sky = message
        elif message.name == "GST":
            self._gst = message
            if self._pending is not None and self._pending[0].utime == message.utime:
                return self._release(now)
        elif message.name == "TPV":
            out = self._release(now)
            utime = message.utime
            if utime and utime == self._last_utime:
                self._counts["repeated"] += 1
                return out
            self._last_utime = utime
            self._pending = (message, self._find_arrival(message.start, now), now.monotonic_ns + HOLD_NS)
            return out + (self._release(now) if self._gst is not None and self._gst.utime == utime else [])
        return []

    def _release(self, now: HostTime) -> list[Output[bytes]]:
        """Publish the pending fix."""
        if self._pending is None:
            return []
        (tpv, host_utime, _), self._pending = self._pending, None
        fix_type, get = tpv.fix_type, tpv.get_number
        latitude, longitude = get("lat"), get("lon")
        has_place = math.isfinite(latitude) and math.isfinite(longitude)
        east, north, down = get("velE"), get("velN"), get("velD")
        has_velocity = math.isfinite(east + north + down)
        speed, track = get("speed"), get("track")
        sky, gst = self._sky, self._gst
        covariance = None
        if gst is not None and gst.utime == tpv.utime:
            covariance = to_covariance(gst.get_number("lon"), gst.get_number("lat"), gst.get_number("alt"))
        sample = GpsSample(
            self._make_header(host_utime, tpv.utime),
            fix_type if has_place else FixType.NONE,
            latitude,
            longitude,
            height_ellipsoidal=get("altHAE"),
            height_msl=get("altMSL" if {"altMSL", "altHAE"} & tpv.fields.keys() else "alt"),
            undulation=get("geoidSep"),
            satellites=-1 if sky is None or not math.isfinite(sky.get_number("uSat")) else int(sky.get_number("uSat")),
            hdop=NAN if sky is None else sky.get_number("hdop"),
            vdop=NAN if sky is None else sky.get_number("vdop"),
            pdop=NAN if sky is None else sky.get_number("pdop"),
            position_covariance=covariance,
            velocity=(east, north, -down) if has_velocity else None,
            speed=speed,
            course=course_from_track(track),
        )
        return self._publish(sample, now)
