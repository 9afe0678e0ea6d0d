"""Parse one NMEA 0183 sentence: frame and content.

pynmea2 checks the checksum and names the fields; `fields` parses their text.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import pynmea2

from modelserver.messages.flags import NAN
from msdrivers.protocol.framing import NO_FRAME, ParsedFrame, RejectedFrame
from msdrivers.protocol.nmea import fields

MAX_SENTENCE_BYTES = 164
"""Characters from '$' to the checksum. The standard allows 82 with the end of line; receivers send more."""


@dataclass(frozen=True, slots=True)
class NmeaSentence:
    """Content of a sentence; nan, None or "" where missing.

    talker, kind: e.g. "GP" and "GGA". start: bytes from the beginning of the stream to its '$'.
    time_of_day: microseconds of UTC's day, 86,400 s and more inside a leap second. day: days since 1970-01-01.
    latitude, longitude: degrees on WGS 84, or the receiver's own datum. height_msl, undulation: meters.
    quality: GGA's indicator, 0 = no fix. status: "A" or "V" of RMC and GLL. mode: letters of the mode indicator, one
    per satellite system for GNS. dimension: 1 none, 2, 3, of GSA. satellites: the number in use, of GGA and GNS.
    listed: how many GSA names as in use.
    speed: m/s. track, heading: degrees clockwise from true north, of the motion and of the antenna baseline. Speed and
    track are nan where the sentence flags them invalid.
    sigma_*: standard deviations along latitude, longitude and height, meters.
    """

    talker: str
    kind: str
    start: int
    time_of_day: int | None = None
    day: int | None = None
    latitude: float = NAN
    longitude: float = NAN
    height_msl: float = NAN
    undulation: float = NAN
    quality: int | None = None
    status: str = ""
    mode: str = ""
    dimension: int | None = None
    satellites: int | None = None
    listed: int = 0
    hdop: float = NAN
    vdop: float = NAN
    pdop: float = NAN
    speed: float = NAN
    track: float = NAN
    heading: float = NAN
    sigma_latitude: float = NAN
    sigma_longitude: float = NAN
    sigma_height: float = NAN

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
        if int(text[-2:], 16) != pynmea2.NMEASentence.checksum(text[1:-3]):
            return RejectedFrame("nmea_checksum")
        try:
            sentence = parse_sentence(text, start)
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
    reader = _READERS.get(text[3:6])
    if reader is None or text[6:7] != "," or not text[1:3].isalnum() or text[1] == "P":
        return None
    return reader(_Fields(pynmea2.NMEASentence.parse(text, check=True)), start)


VALID_MODES = frozenset("APDRFE")
"""Letters of the mode indicator for measured data: M is manual input, S simulated, N not valid."""


def _is_valid_mode(mode: str) -> bool:
    """Whether speed and course are measured by the mode indicator; before NMEA 2.3 there was none."""
    return not mode or mode in VALID_MODES


class _Fields:
    """A sentence's fields by pynmea2's names, as they were written; an absent field is empty."""

    def __init__(self, sentence: pynmea2.TalkerSentence) -> None:
        self.talker: str = sentence.talker
        self._data: list[str] = sentence.data
        self._index: dict[str, int] = type(sentence).name_to_idx

    def __getitem__(self, name: str) -> str:
        index = self._index[name]
        return self._data[index] if index < len(self._data) else ""

    def parse_position(self, valid: bool) -> tuple[float, float]:
        """Latitude and longitude, degrees. Where there is no fix, receivers fill in what cannot be: nothing raw."""
        try:
            return (
                fields.parse_angle(self["lat"], self["lat_dir"], "NS", 90.0),
                fields.parse_angle(self["lon"], self["lon_dir"], "EW", 180.0),
            )
        except ValueError:
            if valid:
                raise
            return NAN, NAN


def _parse_gga(raw: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = raw.parse_position(valid=raw["gps_qual"] != "0")
    return NmeaSentence(
        raw.talker,
        "GGA",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        latitude=latitude,
        longitude=longitude,
        quality=fields.parse_integer(raw["gps_qual"], most=9),
        satellites=fields.parse_integer(raw["num_sats"], most=999),
        hdop=fields.parse_nonnegative(raw["horizontal_dil"]),
        height_msl=fields.parse_number(raw["altitude"]),
        undulation=fields.parse_number(raw["geo_sep"]),
    )


def _parse_gns(raw: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = raw.parse_position(valid=raw["mode_indicator"].strip("N") != "")
    return NmeaSentence(
        raw.talker,
        "GNS",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        latitude=latitude,
        longitude=longitude,
        mode=raw["mode_indicator"],
        satellites=fields.parse_integer(raw["num_sats"], most=999),
        hdop=fields.parse_nonnegative(raw["hdop"]),
        height_msl=fields.parse_number(raw["altitude"]),
        undulation=fields.parse_number(raw["geo_sep"]),
    )


def _parse_rmc(raw: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = raw.parse_position(valid=raw["status"] != "V")
    speed, track = (
        fields.parse_nonnegative(raw["spd_over_grnd"]) * fields.KNOT,
        fields.parse_direction(raw["true_course"]),
    )
    moves = (raw["status"] == "A" and _is_valid_mode(raw["mode_indicator"])) or raw["mode_indicator"] == "E"
    return NmeaSentence(
        raw.talker,
        "RMC",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        day=fields.parse_date(raw["datestamp"]),
        status=raw["status"],
        mode=raw["mode_indicator"],
        latitude=latitude,
        longitude=longitude,
        speed=speed if moves else NAN,
        track=track if moves else NAN,
    )


def _parse_gll(raw: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = raw.parse_position(valid=raw["status"] != "V")
    return NmeaSentence(
        raw.talker,
        "GLL",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        status=raw["status"],
        mode=raw["faa_mode"],
        latitude=latitude,
        longitude=longitude,
    )


def _parse_vtg(raw: _Fields, start: int) -> NmeaSentence:
    knots = fields.parse_nonnegative(raw["spd_over_grnd_kts"]) * fields.KNOT
    kmh = fields.parse_nonnegative(raw["spd_over_grnd_kmph"]) * fields.KMH
    speed, track = knots if knots == knots else kmh, fields.parse_direction(raw["true_track"])
    moves = _is_valid_mode(raw["faa_mode"])
    return NmeaSentence(
        raw.talker,
        "VTG",
        start,
        track=track if moves else NAN,
        speed=speed if moves else NAN,
        mode=raw["faa_mode"],
    )


def _parse_gsa(raw: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(
        raw.talker,
        "GSA",
        start,
        dimension=fields.parse_integer(raw["mode_fix_type"], 1, 3),
        listed=sum(bool(raw[name]) for name in _LISTED),
        pdop=fields.parse_nonnegative(raw["pdop"]),
        hdop=fields.parse_nonnegative(raw["hdop"]),
        vdop=fields.parse_nonnegative(raw["vdop"]),
    )


_LISTED = tuple(f"sv_id{number:02d}" for number in range(1, 13))
"""Fields of GSA with the satellites in use."""


def _parse_gst(raw: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(
        raw.talker,
        "GST",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        sigma_latitude=fields.parse_nonnegative(raw["std_dev_latitude"]),
        sigma_longitude=fields.parse_nonnegative(raw["std_dev_longitude"]),
        sigma_height=fields.parse_nonnegative(raw["std_dev_altitude"]),
    )


def _parse_hdt(raw: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(raw.talker, "HDT", start, heading=fields.parse_direction(raw["heading"]))


def _parse_zda(raw: _Fields, start: int) -> NmeaSentence:
    day = fields.parse_integer(raw["day"], 1, 31)
    month = fields.parse_integer(raw["month"], 1, 12)
    year = fields.parse_integer(raw["year"], 1980, 9999)
    known = None if day is None or month is None or year is None else fields.to_unix_days(day, month, year)
    return NmeaSentence(
        raw.talker,
        "ZDA",
        start,
        time_of_day=fields.parse_time_of_day(raw["timestamp"]),
        day=known,
    )


_READERS: dict[str, Callable[[_Fields, int], NmeaSentence]] = {
    "GGA": _parse_gga,
    "GNS": _parse_gns,
    "RMC": _parse_rmc,
    "GLL": _parse_gll,
    "VTG": _parse_vtg,
    "GSA": _parse_gsa,
    "GST": _parse_gst,
    "HDT": _parse_hdt,
    "ZDA": _parse_zda,
}
KINDS = frozenset(_READERS)
"""The sentences that are read."""
