"""One NMEA 0183 sentence: its frame, and what it says.

pynmea2 checks the sum, tells the talker and names the fields; their text is read by `fields`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import pynmea2

from modelserver.messages.flags import NAN
from msdrivers.protocol.framing import CHANCE, Refused, Taken
from msdrivers.protocol.nmea import fields

LONGEST = 164
"""Characters from '$' to the checksum. The standard says 82 with the end of line; makers take more."""


@dataclass(frozen=True, slots=True)
class NmeaSentence:
    """What a sentence says; nan, None or "" where it says nothing.

    talker, kind: e.g. "GP" and "GGA". start: bytes from the beginning of the stream to its '$'.
    time_of_day: microseconds of UTC's day, 86,400 s and more inside a leap second. day: days since 1970-01-01.
    latitude, longitude: degrees on WGS 84, or the receiver's own datum. height_msl, undulation: metres.
    quality: GGA's indicator, 0 = no fix. status: "A" or "V" of RMC and GLL. mode: letters of the mode indicator, one
    per satellite system for GNS. dimension: 1 none, 2, 3, of GSA. satellites: the number in use, of GGA and GNS.
    listed: how many GSA names as in use.
    speed: m/s. track, heading: degrees clockwise from true north, of the motion and of the antenna baseline. Speed and
    track are nan where the sentence says that they are not valid.
    sigma_*: standard deviations along latitude, longitude and height, metres.
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
    """`$`, address, fields, `*` and two hexadecimal digits. Sentences without checksum are refused."""

    leads = b"$"
    _body = re.compile(rb"\$[ -#%-)+-~]*")
    _sum = re.compile("[0-9A-Fa-f]{2}")

    def scan(self, buffer: bytearray, at: int, start: int) -> Taken[NmeaSentence] | Refused | None:
        """See `framing.Format`."""
        body = self._body.match(buffer, at, at + LONGEST)
        assert body is not None
        end = body.end()
        if end - at >= LONGEST:
            return Refused("nmea_length")
        if len(buffer) < end + 3 and (end == len(buffer) or buffer[end] == 0x2A):
            return None
        if buffer[end] != 0x2A or end - at < 6:
            return Refused("nmea_unfinished") if buffer[end] in b"\r\n" and end - at > 6 else CHANCE
        text = buffer[at : end + 3].decode("latin-1")
        if not self._sum.fullmatch(text, end + 1 - at):
            return Refused("nmea_checksum")
        if int(text[-2:], 16) != pynmea2.NMEASentence.checksum(text[1:-3]):
            return Refused("nmea_checksum")
        try:
            sentence = read(text, start)
        except ValueError:
            return Refused("nmea_field")
        return Taken(end + 3, f"nmea.{text[1:-3].partition(',')[0]}" if sentence else "nmea.unused", sentence)


def read(text: str, start: int = 0) -> NmeaSentence | None:
    """Return what `$...*hh` says; None for a sentence that is not used here.

    Raises:
        ValueError: a field is not what it should be, or the checksum is wrong.
    """
    reader = _READERS.get(text[3:6])
    if reader is None or text[6:7] != "," or not text[1:3].isalnum() or text[1] == "P":
        return None
    return reader(_Fields(pynmea2.NMEASentence.parse(text, check=True)), start)


VALID_MODES = frozenset("APDRFE")
"""Letters of the mode indicator that say measured: M is typed in, S simulated, N not valid."""


def _is_valid(mode: str) -> bool:
    """Whether a mode indicator says that speed and course are measured; before NMEA 2.3 there was none."""
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

    def place(self, valid: bool) -> tuple[float, float]:
        """Latitude and longitude, degrees. Where there is no fix, receivers fill in what cannot be: nothing said."""
        try:
            return (
                fields.angle(self["lat"], self["lat_dir"], "NS", 90.0),
                fields.angle(self["lon"], self["lon_dir"], "EW", 180.0),
            )
        except ValueError:
            if valid:
                raise
            return NAN, NAN


def _gga(said: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = said.place(valid=said["gps_qual"] != "0")
    return NmeaSentence(
        said.talker,
        "GGA",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        latitude=latitude,
        longitude=longitude,
        quality=fields.whole(said["gps_qual"], most=9),
        satellites=fields.whole(said["num_sats"], most=999),
        hdop=fields.amount(said["horizontal_dil"]),
        height_msl=fields.number(said["altitude"]),
        undulation=fields.number(said["geo_sep"]),
    )


def _gns(said: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = said.place(valid=said["mode_indicator"].strip("N") != "")
    return NmeaSentence(
        said.talker,
        "GNS",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        latitude=latitude,
        longitude=longitude,
        mode=said["mode_indicator"],
        satellites=fields.whole(said["num_sats"], most=999),
        hdop=fields.amount(said["hdop"]),
        height_msl=fields.number(said["altitude"]),
        undulation=fields.number(said["geo_sep"]),
    )


def _rmc(said: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = said.place(valid=said["status"] != "V")
    speed, track = fields.amount(said["spd_over_grnd"]) * fields.KNOT, fields.circle(said["true_course"])
    moves = (said["status"] == "A" and _is_valid(said["mode_indicator"])) or said["mode_indicator"] == "E"
    return NmeaSentence(
        said.talker,
        "RMC",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        day=fields.date_of(said["datestamp"]),
        status=said["status"],
        mode=said["mode_indicator"],
        latitude=latitude,
        longitude=longitude,
        speed=speed if moves else NAN,
        track=track if moves else NAN,
    )


def _gll(said: _Fields, start: int) -> NmeaSentence:
    latitude, longitude = said.place(valid=said["status"] != "V")
    return NmeaSentence(
        said.talker,
        "GLL",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        status=said["status"],
        mode=said["faa_mode"],
        latitude=latitude,
        longitude=longitude,
    )


def _vtg(said: _Fields, start: int) -> NmeaSentence:
    knots = fields.amount(said["spd_over_grnd_kts"]) * fields.KNOT
    kmh = fields.amount(said["spd_over_grnd_kmph"]) * fields.KMH
    speed, track = knots if knots == knots else kmh, fields.circle(said["true_track"])
    moves = _is_valid(said["faa_mode"])
    return NmeaSentence(
        said.talker,
        "VTG",
        start,
        track=track if moves else NAN,
        speed=speed if moves else NAN,
        mode=said["faa_mode"],
    )


def _gsa(said: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(
        said.talker,
        "GSA",
        start,
        dimension=fields.whole(said["mode_fix_type"], 1, 3),
        listed=sum(bool(said[name]) for name in _LISTED),
        pdop=fields.amount(said["pdop"]),
        hdop=fields.amount(said["hdop"]),
        vdop=fields.amount(said["vdop"]),
    )


_LISTED = tuple(f"sv_id{number:02d}" for number in range(1, 13))
"""Fields of GSA with the satellites in use."""


def _gst(said: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(
        said.talker,
        "GST",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        sigma_latitude=fields.amount(said["std_dev_latitude"]),
        sigma_longitude=fields.amount(said["std_dev_longitude"]),
        sigma_height=fields.amount(said["std_dev_altitude"]),
    )


def _hdt(said: _Fields, start: int) -> NmeaSentence:
    return NmeaSentence(said.talker, "HDT", start, heading=fields.circle(said["heading"]))


def _zda(said: _Fields, start: int) -> NmeaSentence:
    day = fields.whole(said["day"], 1, 31)
    month = fields.whole(said["month"], 1, 12)
    year = fields.whole(said["year"], 1980, 9999)
    known = None if day is None or month is None or year is None else fields.days(day, month, year)
    return NmeaSentence(
        said.talker,
        "ZDA",
        start,
        time_of_day=fields.time_of_day(said["timestamp"]),
        day=known,
    )


_READERS: dict[str, Callable[[_Fields, int], NmeaSentence]] = {
    "GGA": _gga,
    "GNS": _gns,
    "RMC": _rmc,
    "GLL": _gll,
    "VTG": _vtg,
    "GSA": _gsa,
    "GST": _gst,
    "HDT": _hdt,
    "ZDA": _zda,
}
KINDS = frozenset(_READERS)
"""The sentences that are read."""
