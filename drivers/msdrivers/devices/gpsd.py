"""gpsd: its reports, one JSON object a line (gpsd_json(5)), and the driver, which publishes its receiver's fixes.

A TPV report is a fix. Its height `alt` is that above mean sea level in releases before 3.20, which have no other; later
ones leave open what it is, and have `altHAE` and `altMSL`. The standard deviations are those of a GST report of the
same instant, which gpsd passes on from the receiver; its own error estimates (epx, epy, epv) are of an unstated
certainty and are not used. Without GST the dilution of the last SKY report is published, from which the filter computes
the sigma.

Releases (gpsd's NEWS): before 3.22 SKY has no `uSat`, and the satellites with `used` are counted; 3.25 splits SKY into
one report with the dilution and one with the satellites. Before 3.18 numbers may be `nan` or `inf`, which are no JSON:
they are missing. Where gpsd does not know the end of a receiver's instant, there are several TPV reports of it, the
later ones with more.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from modelserver.errors import quote
from modelserver.messages import NAN, FixType, GpsSample
from msdrivers.devices.gps import course_from_track, to_covariance
from msdrivers.devices.stream import NO_FRAME, SECOND_NS, ByteSettings, ParsedFrame, RejectedFrame, StreamDriver
from msdrivers.endpoint import EndpointPhase, HostTime, Output

MAX_LINE: Final = 16_384
"""A longer line is noise: a SKY report has 200 bytes for each satellite."""

HOLD_NS: Final = SECOND_NS // 50
"""How long a fix waits for its GST report: gpsd writes both in one go."""

WATCH: Final = b'?WATCH={"enable":true,"json":true}\n'

USED: Final = frozenset({"TPV", "SKY", "GST", "VERSION", "DEVICE", "DEVICES", "WATCH", "ERROR"})

_NON_FINITE: Final = re.compile(rb":\s*-?(?:nan|inf)(?=\s*[,}])", re.IGNORECASE)
"""As printf writes it."""

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
        try:
            since = datetime.fromisoformat(str(self.fields.get("time"))) - datetime(1970, 1, 1, tzinfo=UTC)
        # TypeError: without a time zone
        except (ValueError, TypeError):
            return 0
        return max(0, since // timedelta(microseconds=1))

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


def count_satellites(sky: GpsdReport, before: int) -> int:
    """Return the number of satellites of the fix; `before` for a report that does not have it."""
    used = sky.get_number("uSat")
    if math.isfinite(used):
        return int(used)
    satellites = sky.fields.get("satellites")
    if not isinstance(satellites, list):
        return before
    return sum(isinstance(each, dict) and each.get("used") is True for each in satellites)


class GpsdFormat:
    """A `FrameFormat` of gpsd's lines."""

    start_bytes = b"{"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[GpsdReport] | RejectedFrame | None:
        end = buffer.find(b"\n", at, at + MAX_LINE)
        if end < 0:
            return None if len(buffer) - at < MAX_LINE else RejectedFrame("length")
        try:
            fields = json.loads(_NON_FINITE.sub(b":null", bytes(buffer[at:end])))
        except (ValueError, RecursionError):
            return RejectedFrame("json")
        name = fields.get("class") if isinstance(fields, dict) else None
        if not isinstance(name, str):
            return NO_FRAME
        report = GpsdReport(name, fields, start) if name in USED else None
        return ParsedFrame(end + 1, f"gpsd.{name[:16]}", report)


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
    formats = (GpsdFormat(),)
    identification = WATCH
    answer_timeout = 2.0
    attempts = 2

    def __init__(self, settings: GpsdSettings) -> None:
        super().__init__(settings)
        self._receiver = settings.receiver
        self._pending: tuple[GpsdReport, int, int] | None = None
        self._gst: GpsdReport | None = None
        self._dilution: dict[str, Any] = {}
        self._satellites = -1
        self._last_utime = 0
        self._receivers: dict[str, bool] | None = None
        """Paths of gpsd's receivers, and whether it reads them; None while unknown."""
        self._error = ""

    def _on_start(self) -> None:
        self._pending = self._gst = self._receivers = None
        self._dilution, self._satellites, self._error = {}, -1, ""

    def _get_extra_deadline(self) -> int | None:
        return None if self._pending is None else self._pending[2]

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        return self._release(now)

    def _on_message(self, message: GpsdReport, now: HostTime) -> list[Output[bytes]]:
        if message.name == "WATCH":
            return self._on_identity("gpsd", (), now)
        if message.name == "ERROR":
            self._error = str(message.fields.get("message"))
            self._counts["errors"] += 1
            return []
        if message.name in ("DEVICE", "DEVICES"):
            self._note_receivers(message)
            return []
        receiver = message.fields.get("device")
        if self._receiver and isinstance(receiver, str) and receiver != self._receiver:
            self._counts["other_receiver"] += 1
            return []
        if message.name == "SKY":
            self._satellites = count_satellites(message, self._satellites)
            # reports of some receivers have the satellites only
            if math.isfinite(message.get_number("hdop")):
                self._dilution = {name: message.get_number(name) for name in ("hdop", "vdop", "pdop")}
        elif message.name == "GST":
            self._gst = message
            if self._pending is not None and self._pending[0].utime == message.utime:
                return self._release(now)
        elif message.name == "TPV":
            utime = message.utime
            if self._pending is not None and utime and self._pending[0].utime == utime:
                # the later one of an instant has what the earlier ones had, and more
                (first, host_utime, deadline_ns) = self._pending
                merged = GpsdReport("TPV", {**first.fields, **message.fields}, first.start)
                self._pending = (merged, host_utime, deadline_ns)
                self._counts["repeated"] += 1
                return self._release(now) if self._gst is not None and self._gst.utime == utime else []
            out = self._release(now)
            if utime and utime == self._last_utime:
                self._counts["repeated"] += 1
                return out
            self._last_utime = utime
            self._pending = (message, self._find_arrival(message.start, now), now.monotonic_ns + HOLD_NS)
            return out + (self._release(now) if self._gst is not None and self._gst.utime == utime else [])
        return []

    def _note_receivers(self, message: GpsdReport) -> None:
        """Note the receivers of a DEVICES report, or of a DEVICE report, which gpsd sends when one comes or goes."""
        listed = message.fields.get("devices") if message.name == "DEVICES" else [message.fields]
        found = {
            each["path"]: each.get("activated") != 0
            for each in (listed if isinstance(listed, list) else [])
            if isinstance(each, dict) and isinstance(each.get("path"), str)
        }
        self._receivers = found if message.name == "DEVICES" else {**(self._receivers or {}), **found}

    def _on_silence(self, now: HostTime) -> list[Output[bytes]]:
        why = self._explain_receivers()
        if self._error:
            why = "; ".join(filter(None, (why, f"its last error: {quote(self._error)}")))
        if not why:
            return super()._on_silence(now)
        text = f"no usable TPV for {self._settings.silence:g} s: {why}"
        return [*self._set_status(EndpointPhase.SILENT, text), *self._setup.start(self._run_setup(), now)]

    def _explain_receivers(self) -> str:
        """Return what is wrong with gpsd's receivers; empty for nothing that is known."""
        receivers = self._receivers
        if receivers is None:
            return ""
        listed = ", ".join(quote(each) for each in list(receivers)[:10])
        if not receivers:
            return "gpsd has no receiver; name it in DEVICES of /etc/default/gpsd, or run sudo gpsdctl add PATH"
        if self._receiver and self._receiver not in receivers:
            return f"gpsd has no receiver {quote(self._receiver)}; it has {listed}: correct `receiver`, or leave it out"
        if not any(is_read for path, is_read in receivers.items() if self._receiver in ("", path)):
            return f"gpsd has closed {listed}: is it plugged in, and does another program read it?"
        return ""

    def _release(self, now: HostTime) -> list[Output[bytes]]:
        """Publish the pending fix."""
        if self._pending is None:
            return []
        (tpv, host_utime, _), self._pending = self._pending, None
        get, gst = tpv.get_number, self._gst
        latitude, longitude = get("lat"), get("lon")
        east, north, down = get("velE"), get("velN"), get("velD")
        covariance = None
        if gst is not None and gst.utime == tpv.utime:
            covariance = to_covariance(gst.get_number("lon"), gst.get_number("lat"), gst.get_number("alt"))
        sample = GpsSample(
            self._make_header(host_utime, tpv.utime),
            tpv.fix_type if math.isfinite(latitude + longitude) else FixType.NONE,
            latitude,
            longitude,
            height_ellipsoidal=get("altHAE"),
            height_msl=get("altMSL" if {"altMSL", "altHAE"} & tpv.fields.keys() else "alt"),
            undulation=get("geoidSep"),
            satellites=self._satellites,
            **self._dilution,
            position_covariance=covariance,
            velocity=(east, north, -down) if math.isfinite(east + north + down) else None,
            speed=get("speed"),
            course=course_from_track(get("track")),
        )
        return self._publish(sample, now)
