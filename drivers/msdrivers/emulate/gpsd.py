"""Emulator of gpsd: answers WATCH, sends TPV, GST and SKY reports of samples."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from modelserver.messages import FixType, GpsSample
from msdrivers.emulate.sample_emulator import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol.gpsd import WATCH

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
