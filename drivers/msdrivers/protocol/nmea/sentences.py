"""Parse one NMEA 0183 sentence: frame and content.

pynmea2 computes the checksum and names the fields; `fields` parses their text.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import pynmea2

from modelserver.messages.flags import NAN
from msdrivers.protocol.framing import NO_FRAME, ParsedFrame, RejectedFrame
from msdrivers.protocol.nmea import fields

MAX_SENTENCE_BYTES = 164
"""Characters from '$' to the checksum. The standard allows 82 with the end of line; receivers send more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NmeaValues:
    """Measured values; nan where missing.

    latitude, longitude: degrees on WGS 84, or the receiver's own datum. height_msl, undulation: meters. speed: m/s.
    track, heading: degrees clockwise from true north, of the motion and of the antenna baseline. Speed and track are
    nan where the sentence flags them invalid. sigma_*: standard deviations along latitude, longitude, height, meters.
    """

    latitude: float = NAN
    longitude: float = NAN
    height_msl: float = NAN
    undulation: float = NAN
    hdop: float = NAN
    vdop: float = NAN
    pdop: float = NAN
    speed: float = NAN
    track: float = NAN
    heading: float = NAN
    sigma_latitude: float = NAN
    sigma_longitude: float = NAN
    sigma_height: float = NAN


@dataclass(frozen=True, slots=True)
class NmeaSentence(NmeaValues):
    """Content of a sentence; None or "" where missing.

    talker, kind: e.g. "GP" and "GGA". start: bytes from the beginning of the stream to its '$'.
    time_of_day: microseconds of UTC's day, 86,400 s and more inside a leap second. day: days since 1970-01-01.
    quality: GGA's indicator, 0 = no fix. status: "A" or "V" of RMC and GLL. mode: letters of the mode indicator, one
    per satellite system for GNS. dimension: 1 none, 2, 3, of GSA. satellites: the number in use, of GGA and GNS.
    listed: how many GSA names as in use.
    """

    talker: str
    kind: str
    start: int
    time_of_day: int | None = None
    day: int | None = None
    quality: int | None = None
    status: str = ""
    mode: str = ""
    dimension: int | None = None
    satellites: int | None = None
    listed: int = 0

    @property
    def has_position(self) -> bool:
        """Whether there are coordinates, valid or not."""
        return self.latitude == self.latitude and self.longitude == self.longitude


class SentenceFormat:
    """`$`, address, fields, `*` and two hexadecimal digits. Sentences without checksum are rejected."""

    start_bytes = b"$"
    _body = re.compile(rb"\$[ -#%-)+-~]*")
    _sum = re.compile("[0-9A-Fa-f]{2}")

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NmeaSentence] | RejectedFrame | None:
        """See `framing.FrameFormat`."""
        body = self._body.match(buffer, at, at + MAX_SENTENCE_BYTES)
        assert body is not None
        end = body.end()
        if end - at >= MAX_SENTENCE_BYTES:
            return RejectedFrame("nmea_length")
        if len(buffer) < end + 3 and (end == len(buffer) or buffer[end] == 0x2A):
            return None
        if buffer[end] != 0x2A or end - at < 6:
            return RejectedFrame("nmea_incomplete") if buffer[end] in b"\r\n" and end - at > 6 else NO_FRAME
        text = buffer[at : end + 3].decode("latin-1")
        if not self._sum.fullmatch(text, end + 1 - at):
            return RejectedFrame("nmea_checksum")
        try:
            sentence = parse_sentence(text, start)
        except pynmea2.ChecksumError:
            return RejectedFrame("nmea_checksum")
        except ValueError:
            return RejectedFrame("nmea_field")
        return ParsedFrame(
            end + 3, f"nmea.{text[1:-3].partition(',')[0]}" if sentence else "nmea.unsupported", sentence
        )


def parse_sentence(text: str, start: int = 0) -> NmeaSentence | None:
    """Parse `$...*hh`; None for a sentence that is not supported.

    Raises:
        ValueError: a field is not what it should be, or the checksum is wrong.
    """
    if int(text[-2:], 16) != pynmea2.NMEASentence.checksum(text[1:-3]):
        raise pynmea2.ChecksumError("wrong checksum", text)
    talker, kind = text[1:3], text[3:6]
    if kind not in KINDS or text[6] != "," or not talker.isalnum() or talker[0] == "P":
        return None
    raw = defaultdict(str, zip(getattr(pynmea2, kind).name_to_idx, text[7:-3].split(","), strict=False))
    values: dict[str, Any] = {}
    for field, content in raw.items():
        if field in _FIELDS:
            name, parse = _FIELDS[field]
            values[name] = parse(content)
    status, mode = values.get("status", "A"), values.get("mode", "")
    if "lat" in raw:
        try:
            values["latitude"] = fields.parse_angle(raw["lat"], raw["lat_dir"], "NS", 90.0)
            values["longitude"] = fields.parse_angle(raw["lon"], raw["lon_dir"], "EW", 180.0)
        except ValueError:
            # where there is no fix, receivers fill in what cannot be
            if status != "V" and values.get("quality") != 0 and (kind != "GNS" or mode.strip("N")):
                raise
            values["latitude"] = values["longitude"] = NAN
    if kind == "VTG":
        kmh = _parse_nonnegative(raw["spd_over_grnd_kmph"]) * fields.KMH
        values["speed"] = speed if (speed := values.get("speed", NAN)) == speed else kmh
    elif kind == "GSA":
        values["listed"] = sum(name.startswith("sv_id") and text != "" for name, text in raw.items())
    elif kind == "ZDA":
        day = fields.parse_integer(raw["day"], 1, 31)
        month = fields.parse_integer(raw["month"], 1, 12)
        year = fields.parse_integer(raw["year"], 1980, 9999)
        values["day"] = fields.to_unix_days(day, month, year) if day and month and year else None
    if not ((status == "A" and (not mode or mode in MODES)) or mode == "E"):
        values |= {"speed": NAN, "track": NAN}
    return NmeaSentence(talker, kind, start, **values)


KINDS = frozenset({"GGA", "GNS", "RMC", "GLL", "VTG", "GSA", "GST", "HDT", "ZDA"})
"""The sentences that are read."""

MODES = frozenset("APDRFE")
"""Letters of the mode indicator, which NMEA 2.3 added, for measured data. M is manual input, S simulated, N invalid."""


_parse_nonnegative = partial(fields.parse_number, least=0.0)
_parse_direction = partial(fields.parse_number, least=0.0, most=360.0)


def _parse_knots(text: str) -> float:
    return _parse_nonnegative(text) * fields.KNOT


_FIELDS: dict[str, tuple[str, Callable[[str], object]]] = {
    "timestamp": ("time_of_day", fields.parse_time_of_day),
    "datestamp": ("day", fields.parse_date),
    "status": ("status", str),
    "mode_indicator": ("mode", str),
    "faa_mode": ("mode", str),
    "gps_qual": ("quality", partial(fields.parse_integer, most=9)),
    "num_sats": ("satellites", partial(fields.parse_integer, most=999)),
    "mode_fix_type": ("dimension", partial(fields.parse_integer, least=1, most=3)),
    "horizontal_dil": ("hdop", _parse_nonnegative),
    "hdop": ("hdop", _parse_nonnegative),
    "vdop": ("vdop", _parse_nonnegative),
    "pdop": ("pdop", _parse_nonnegative),
    "altitude": ("height_msl", fields.parse_number),
    "geo_sep": ("undulation", fields.parse_number),
    "spd_over_grnd": ("speed", _parse_knots),
    "spd_over_grnd_kts": ("speed", _parse_knots),
    "true_course": ("track", _parse_direction),
    "true_track": ("track", _parse_direction),
    "heading": ("heading", _parse_direction),
    "std_dev_latitude": ("sigma_latitude", _parse_nonnegative),
    "std_dev_longitude": ("sigma_longitude", _parse_nonnegative),
    "std_dev_altitude": ("sigma_height", _parse_nonnegative),
}
"""pynmea2's name of a field -> the name here, and how its text is parsed."""
