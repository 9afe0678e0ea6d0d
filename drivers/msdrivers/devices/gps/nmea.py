"""NMEA 0183: the fields of a sentence, sentences of any talker, and epochs of the sentences of one instant.

Fields: an empty one is missing: nan or None, never zero. ValueError, with the field's text, for what no receiver should
write. pynmea2 computes the checksum and names the fields; its own conversions are not used: they give 0 for a missing
hemisphere, cut microseconds, reject 23:59:60 and return the text where they fail.

Epochs: one is complete when a sentence of another instant arrives, when the caller reports silence (`flush`), or, once
the cycles of sentences were equal for a second, when the sentence that ended the last cycle arrives again; so the last
fix does not wait for the next instant. Sentences without a time (VTG, GSA, HDT) belong to the epoch that they follow or
precede; the order is learned from the pauses of the line. Motion of unknown order is left out, because it could be
that of the next instant.

The fix type of an epoch is NONE if any sentence flags the fix invalid, else that of the most detailed sentence with a
position. Receivers with several satellite systems send some sentences once for each: a GNS of one system, which has
counts only, flags nothing, and the GSA with the best fix counts.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from math import inf
from typing import Any

import pynmea2

from modelserver.messages import FixType
from modelserver.messages.values import NAN
from msdrivers.devices.gps import DAY, SECOND
from msdrivers.devices.stream import NO_FRAME, ParsedFrame, RejectedFrame

KNOT = 1852.0 / 3600.0
"""Meters per second."""
KMH = 1.0 / 3.6

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")
_CLOCK = re.compile(r"(\d\d)(\d\d)(\d\d)(?:\.(\d*))?")
_ANGLE = re.compile(r"(\d{1,3}?)(\d\d(?:\.\d*)?)")
_UNIX_DAY = date(1970, 1, 1).toordinal()


def parse_number(text: str, least: float = -inf, most: float = inf) -> float:
    """Return a decimal number within bounds; nan for an empty field."""
    if not text:
        return NAN
    if not _NUMBER.fullmatch(text) or not least <= float(text) <= most:
        raise ValueError(f"'{text}' is no number from {least:g} to {most:g}")
    return float(text)


def parse_integer(text: str, least: int = 0, most: int = 1_000_000) -> int | None:
    """Return an integer within bounds; None for an empty field."""
    if not text:
        return None
    if not text.isdecimal() or not least <= int(text) <= most:
        raise ValueError(f"'{text}' is no integer from {least} to {most}")
    return int(text)


def parse_time_of_day(text: str) -> int | None:
    """Return microseconds since midnight of `hhmmss.ss`, up to 86401 s for 23:59:60.99; None for an empty field."""
    if not text:
        return None
    parts = _CLOCK.fullmatch(text)
    hours, minutes, seconds = (int(each) for each in parts.groups()[:3]) if parts else (24, 0, 0)
    leap = seconds == 60 and (hours, minutes) == (23, 59)
    if parts is None or hours > 23 or minutes > 59 or (seconds > 59 and not leap):
        raise ValueError(f"'{text}' is no time of day")
    return (hours * 3600 + minutes * 60 + seconds) * SECOND + int((parts[4] or "")[:6].ljust(6, "0"))


def to_unix_days(day: int, month: int, year: int) -> int:
    """Return days since 1970-01-01. ValueError for a day that does not exist."""
    return date(year, month, day).toordinal() - _UNIX_DAY


def parse_date(text: str) -> int | None:
    """Return days since 1970 of `ddmmyy`, years from 1980 on; None for an empty field."""
    if not text:
        return None
    if len(text) != 6 or not text.isdecimal():
        raise ValueError(f"'{text}' is no date")
    year = int(text[4:])
    return to_unix_days(int(text[:2]), int(text[2:4]), year + (1900 if year >= 80 else 2000))


def parse_angle(text: str, side: str, sides: str, most: float) -> float:
    """Return signed degrees of `dddmm.mmmm` and its hemisphere; nan where both are empty.

    sides: the letters of the positive and the negative hemisphere. most: the largest angle, degrees.
    """
    if not text and not side:
        return NAN
    parts = _ANGLE.fullmatch(text)
    minutes = float(parts[2]) if parts else 60.0
    if parts is None or len(side) != 1 or side not in sides or minutes >= 60.0:
        raise ValueError(f"'{text},{side}' is no angle")
    degrees = int(parts[1]) + minutes / 60.0
    if degrees > most:
        raise ValueError(f"'{text},{side}' is over {most:g} degrees")
    return degrees if side == sides[0] else -degrees


def encode(talker: str, kind: str, fields: Sequence[str]) -> bytes:
    """Return a sentence with its checksum and end of line."""
    return str(pynmea2.TalkerSentence(talker, kind, fields)).encode("ascii") + b"\r\n"


def format_angle(degrees: float, sides: str, digits: int) -> tuple[str, str]:
    """Return `dddmm.mmmmmmm` with as many digits of whole degrees, and the hemisphere's letter; empty for nan."""
    if degrees != degrees:
        return "", ""
    # whole ten-millionths of a minute, so that no 60 minutes come out of rounding
    whole, part = divmod(round(abs(degrees) * 60e7), 60 * 10_000_000)
    text = f"{whole:0{digits}d}{part // 10_000_000:02d}.{part % 10_000_000:07d}"
    return text, sides[0] if degrees >= 0.0 else sides[1]


def format_time_of_day(microseconds: int) -> str:
    """Return `hhmmss.sss`."""
    seconds, fraction = divmod(microseconds, 1_000_000)
    hours, rest = divmod(seconds, 3600)
    return f"{hours:02d}{rest // 60:02d}{rest % 60:02d}.{fraction // 1000:03d}"


def format_number(value: float, digits: int) -> str:
    """Return a decimal; empty for nan."""
    return "" if value != value else f"{value:.{digits}f}"


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
        return self.latitude == self.latitude and self.longitude == self.longitude


class SentenceFormat:
    """`$`, address, fields, `*` and two hexadecimal digits. Sentences without checksum are rejected."""

    start_bytes = b"$"
    _body = re.compile(rb"\$[ -#%-)+-~]*")
    _sum = re.compile("[0-9A-Fa-f]{2}")

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[NmeaSentence] | RejectedFrame | None:
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
            values["latitude"] = parse_angle(raw["lat"], raw["lat_dir"], "NS", 90.0)
            values["longitude"] = parse_angle(raw["lon"], raw["lon_dir"], "EW", 180.0)
        except ValueError:
            # where there is no fix, receivers fill in what cannot be
            if status != "V" and values.get("quality") != 0 and (kind != "GNS" or mode.strip("N")):
                raise
            values["latitude"] = values["longitude"] = NAN
    if kind == "VTG":
        kmh = _parse_nonnegative(raw["spd_over_grnd_kmph"]) * KMH
        values["speed"] = speed if (speed := values.get("speed", NAN)) == speed else kmh
    elif kind == "GSA":
        values["listed"] = sum(name.startswith("sv_id") and text != "" for name, text in raw.items())
    elif kind == "ZDA":
        day = parse_integer(raw["day"], 1, 31)
        month = parse_integer(raw["month"], 1, 12)
        year = parse_integer(raw["year"], 1980, 9999)
        values["day"] = to_unix_days(day, month, year) if day and month and year else None
    if not ((status == "A" and (not mode or mode in _MODE)) or mode == "E"):
        values |= {"speed": NAN, "track": NAN}
    return NmeaSentence(talker, kind, start, **values)


KINDS = frozenset({"GGA", "GNS", "RMC", "GLL", "VTG", "GSA", "GST", "HDT", "ZDA"})
"""The sentences that are read."""

_parse_nonnegative = partial(parse_number, least=0.0)

_parse_direction = partial(parse_number, least=0.0, most=360.0)


def _parse_knots(text: str) -> float:
    return _parse_nonnegative(text) * KNOT


_FIELDS: dict[str, tuple[str, Callable[[str], object]]] = {
    "timestamp": ("time_of_day", parse_time_of_day),
    "datestamp": ("day", parse_date),
    "status": ("status", str),
    "mode_indicator": ("mode", str),
    "faa_mode": ("mode", str),
    "gps_qual": ("quality", partial(parse_integer, most=9)),
    "num_sats": ("satellites", partial(parse_integer, most=999)),
    "mode_fix_type": ("dimension", partial(parse_integer, least=1, most=3)),
    "horizontal_dil": ("hdop", _parse_nonnegative),
    "hdop": ("hdop", _parse_nonnegative),
    "vdop": ("vdop", _parse_nonnegative),
    "pdop": ("pdop", _parse_nonnegative),
    "altitude": ("height_msl", parse_number),
    "geo_sep": ("undulation", parse_number),
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

_QUALITY = {
    1: FixType.FIX_3D,
    2: FixType.DIFFERENTIAL,
    3: FixType.FIX_3D,
    4: FixType.RTK_FIXED,
    5: FixType.RTK_FLOAT,
    6: FixType.DEAD_RECKONING,
    9: FixType.DIFFERENTIAL,
}
"""GGA's indicator. 7 (typed in by hand) and 8 (simulated) are no measurement: NONE, as 0. 9 is not in the
standard: NovAtel receivers send it for corrections by satellite (SBAS)."""

_MODE = {
    "R": FixType.RTK_FIXED,
    "F": FixType.RTK_FLOAT,
    "D": FixType.DIFFERENTIAL,
    "A": FixType.FIX_3D,
    "P": FixType.FIX_3D,
    "E": FixType.DEAD_RECKONING,
}
"""The mode indicator of NMEA 2.3 and later, the best first. M (by hand), S (simulated), N (not valid) are NONE."""


def determine_fix_type(sentences: Sequence[NmeaSentence]) -> FixType:
    """Return the fix type; NONE if any sentence flags the fix invalid, or none has a position."""
    placed = _list_places(sentences)
    if not placed or any(map(_is_invalid, sentences)) or _has_no_mode(sentences):
        return FixType.NONE
    # some receivers keep the last quality when they lose all satellites
    is_empty = any(each.kind == "GGA" and each.satellites == 0 for each in sentences)
    dimension = max((each.dimension for each in sentences if each.dimension is not None), default=None)
    if dimension == 1 or (is_empty and count_satellites(sentences) == 0):
        return FixType.NONE
    types = (_QUALITY.get(each.quality) if each.quality is not None else _best_mode(each.mode) for each in placed)
    found = next((each for each in types if each is not None), FixType.FIX_3D)
    has_height = any(each.height_msl == each.height_msl for each in placed)
    flat = dimension == 2 if dimension is not None else not has_height
    return FixType.FIX_2D if flat and found is FixType.FIX_3D else found


def _list_places(sentences: Iterable[NmeaSentence]) -> list[NmeaSentence]:
    """Return the sentences with a position, the most detailed first."""
    return sorted((each for each in sentences if each.has_position), key=lambda each: POSITION_KINDS.index(each.kind))


def _is_invalid(sentence: NmeaSentence) -> bool:
    if sentence.kind == "GGA":
        return sentence.quality not in _QUALITY
    if sentence.kind in ("RMC", "GLL"):
        # status V with mode E is dead reckoning, a fix of its kind
        return bool(sentence.mode and sentence.mode not in _MODE) or (sentence.status != "A" and sentence.mode != "E")
    return False


def _has_no_mode(sentences: Iterable[NmeaSentence]) -> bool:
    """Return whether every GNS that speaks of the fix flags it invalid.

    That of one system has neither a position nor a mode, or a mode of that system alone.
    """
    whole = [
        each for each in sentences if each.kind == "GNS" and (each.has_position or (each.talker == "GN" and each.mode))
    ]
    return bool(whole) and all(_best_mode(each.mode) is None for each in whole)


def _best_mode(mode: str) -> FixType | None:
    """Return the best of a mode indicator's letters; unused satellite systems have N."""
    return next((found for letter, found in _MODE.items() if letter in mode), None)


def count_satellites(sentences: Sequence[NmeaSentence]) -> int:
    """Return how many satellites the fix of one instant uses; -1 where no sentence counts them.

    Some receivers (Furuno GL, Garmin 25) send a GGA with 0 in use while the GSA of the same instant lists them: then
    the list counts.
    """
    counts = [each for each in sentences if each.satellites is not None]
    # a GNS of one system counts those of that system
    whole = [each for each in counts if each.has_position] or counts
    counted = max((each.satellites for each in whole if each.satellites is not None), default=-1)
    return counted or sum(each.listed for each in sentences)


POSITION_KINDS = ("GGA", "GNS", "RMC", "GLL")
"""Sentences with a position, the most detailed first."""
_MOTION = frozenset({"VTG", "HDT"})
"""Sentences with the receiver's motion but without a time: of another instant their content is wrong."""
_MIN_LESSONS = 2
"""Number of cycles that determine the order of sentences."""
_TIMED = frozenset({*POSITION_KINDS, "GST"})
"""Sentences whose time is that of the fix. ZDA's is the clock's, which in some receivers is seconds ahead."""
_MAX_SENTENCES = 64
"""Largest number of sentences in an epoch."""
_MIN_STABLE_US = SECOND
"""How long cycles must be equal; sentences that are not sent each instant are mostly sent once a second."""


@dataclass(frozen=True, slots=True)
class NmeaEpoch(NmeaValues):
    """Data of one instant; nan or -1 where missing.

    start: bytes from the beginning of the stream to the epoch's first sentence. kinds: the sentences it was made of.
    utime: microseconds of UTC; 0 before the first date. Units as in `NmeaSentence`; the coordinates stay where the fix
    is flagged invalid, with `fix_type` NONE.
    """

    start: int
    kinds: tuple[str, ...]
    utime: int
    time_of_day: int | None
    fix_type: FixType
    satellites: int = -1


class EpochAssembler:
    """Sentences in, epochs out. Memory is bounded by one epoch.

    reject: counts, as `late`, sentences that are not used: received after their epoch was complete, or too many.
    """

    def __init__(self, reject: Callable[[str], object]) -> None:
        self._reject = reject
        self._sentences: list[NmeaSentence] = []
        self._timed: NmeaSentence | None = None
        """The first of them with a time."""
        self._reference: int | None = None
        self._last_instant: int | None = None
        self._cycle: Counter[str] = Counter()
        self._stable_since: int | None = None
        self._first = self._last = ""
        self._is_closed_by_end = False
        self._is_regular = True
        self._is_line_silent = self._starts_after_silence = False
        self._order_counts: Counter[tuple[str, bool]] = Counter()
        """How often a pause showed that a kind of sentence comes first, or not."""

    def add(self, sentence: NmeaSentence) -> list[NmeaEpoch]:
        """Return the epochs that the sentence completes: at most the one before it, and its own."""
        closed = []
        timed = sentence.kind in _TIMED
        if self._starts_epoch(sentence) if timed else self._is_leading(sentence.kind) and self._timed:
            closed += self._close(by_end=False)
        if self._is_late(sentence, timed) or len(self._sentences) >= _MAX_SENTENCES:
            self._reject("late")
            return closed
        if sentence.day is not None and sentence.time_of_day is not None:
            self._reference = sentence.day * DAY + sentence.time_of_day
        if not self._sentences:
            self._starts_after_silence, self._is_line_silent = self._is_line_silent, False
        elif timed and self._starts_after_silence and self._timed is None:
            self._learn_order(self._sentences, leads=True)
        self._sentences.append(sentence)
        self._timed = self._timed or (sentence if timed else None)
        if self._is_end(sentence):
            closed += self._close(by_end=True)
        return closed

    def flush(self) -> list[NmeaEpoch]:
        """Return the epoch under way, if any: the line has been silent, so no more of it will come."""
        self._is_line_silent = True
        started = next((n for n, each in enumerate(self._sentences) if each.kind in _TIMED), len(self._sentences))
        self._learn_order(self._sentences[started:], leads=False)
        return self._close(by_end=False, is_silent=True)

    def clear(self) -> None:
        """Forget the epoch under way, and the order of sentences: another receiver may speak."""
        self._sentences, self._timed, self._is_line_silent = [], None, False
        self._order_counts.clear()

    def _learn_order(self, sentences: list[NmeaSentence], leads: bool) -> None:
        self._order_counts.update((each.kind, leads) for each in sentences if each.kind in _MOTION)

    def _is_leading(self, kind: str) -> bool | None:
        """Whether a kind of motion sentence precedes those with a time; None if unknown."""
        for leads in (True, False):
            # a pause within a cycle shows the wrong order
            if self._order_counts[kind, leads] >= max(_MIN_LESSONS, 4 * self._order_counts[kind, not leads]):
                return leads
        return None

    def _select_sentences(self, sentences: list[NmeaSentence], is_silent: bool) -> list[NmeaSentence]:
        """Return the sentences without those of motion that belong, or may belong, to another instant."""
        started = next(n for n, each in enumerate(sentences) if each.kind in _TIMED)

        def is_selected(n: int, kind: str) -> bool:
            leads = self._is_leading(kind)
            return n > started and is_silent if leads is None else (n < started) is leads

        return [each for n, each in enumerate(sentences) if each.kind not in _MOTION or is_selected(n, each.kind)]

    def _starts_epoch(self, sentence: NmeaSentence) -> bool:
        if self._timed is None or sentence.time_of_day != self._timed.time_of_day:
            return self._timed is not None
        return sentence.time_of_day is None and any(each.kind == sentence.kind for each in self._sentences)

    def _is_late(self, sentence: NmeaSentence, timed: bool) -> bool:
        if timed:
            is_same = sentence.time_of_day is not None and sentence.time_of_day == self._last_instant
            late = is_same and self._timed is None
            self._is_regular = self._is_regular and not (late and self._is_closed_by_end)
            return late
        if not self._sentences and self._is_closed_by_end and sentence.kind != self._first:
            # it trails an epoch that was thought complete: this receiver's cycles differ, do not guess their end again
            self._is_regular = False
            return sentence.kind != "ZDA"
        return False

    def _is_end(self, sentence: NmeaSentence) -> bool:
        if not self._is_regular or sentence.kind != self._last:
            return False
        last, since = self._last_instant, self._stable_since
        if last is None or since is None or last - since < _MIN_STABLE_US:
            return False
        received = Counter(each.kind for each in self._sentences)
        return all(received[kind] >= number for kind, number in self._cycle.items())

    def _close(self, by_end: bool, is_silent: bool = False) -> list[NmeaEpoch]:
        sentences, timed = self._sentences, self._timed
        self._sentences, self._timed = [], None
        if timed is None:
            return []
        instant = timed.time_of_day
        cycle = Counter(each.kind for each in sentences)
        if cycle != self._cycle or self._stable_since is None or instant is None or instant < self._stable_since:
            self._stable_since = instant
        self._is_closed_by_end, self._cycle, self._last_instant = by_end, cycle, instant
        self._first, self._last = sentences[0].kind, sentences[-1].kind
        if not any(each.kind in POSITION_KINDS for each in sentences):
            return []
        return [merge_sentences(self._select_sentences(sentences, is_silent), instant, self._to_utime(instant))]

    def _to_utime(self, instant: int | None) -> int:
        """Return the utime of a time of day on the day that is nearest to the last received date."""
        if instant is None or self._reference is None:
            return 0
        self._reference = instant + round((self._reference - instant) / DAY) * DAY
        return self._reference


def merge_sentences(sentences: list[NmeaSentence], instant: int | None, utime: int) -> NmeaEpoch:
    """Merge the sentences of one instant.

    The more detailed sentence takes precedence: GGA and GNS before RMC before GLL for the position, RMC before VTG for
    speed and course.
    """
    places = _list_places(sentences)

    def select(among: Sequence[NmeaSentence], *names: str) -> dict[str, float]:
        """Return the first value of each name that is not missing."""
        return {name: next((value for each in among if (value := getattr(each, name)) == value), NAN) for name in names}

    return NmeaEpoch(
        start=sentences[0].start,
        kinds=tuple(each.kind for each in sentences),
        utime=utime,
        time_of_day=instant,
        fix_type=determine_fix_type(sentences),
        satellites=count_satellites(sentences),
        **select(places, "latitude", "longitude"),
        # the height belongs to its own sentence's position
        **select([each for each in places if each.kind in ("GGA", "GNS")], "height_msl", "undulation"),
        **select(sorted(sentences, key=lambda each: each.kind != "RMC"), "speed", "track"),
        **select(
            sentences[::-1], "hdop", "vdop", "pdop", "heading", "sigma_latitude", "sigma_longitude", "sigma_height"
        ),
    )
