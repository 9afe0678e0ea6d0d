"""Puts the sentences of one instant together.

An epoch is complete when a sentence of another instant comes, when the caller says that the line has fallen silent,
or, once cycles have been alike for a second, when the sentence that ended the last one comes again (so that nobody
waits for the next instant). Sentences without a time (VTG, GSA, HDT) belong to the epoch they follow, or to the one
they lead: which, silence tells. Motion whose place is not known is left out, lest it be that of the next instant.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from modelserver.messages import FixType
from modelserver.messages.flags import NAN
from msdrivers.protocol.gps_time import DAY, SECOND
from msdrivers.protocol.nmea.fix import fix_type, satellites_used
from msdrivers.protocol.nmea.sentences import NmeaSentence

POSITION_KINDS = frozenset({"GGA", "GNS", "RMC", "GLL"})
_MOTION = frozenset({"VTG", "HDT"})
"""Sentences without a time that say how the receiver moves: what they say of another instant is wrong."""
_SURE = 2
"""Cycles that must have told the order of sentences."""
_TIMED = POSITION_KINDS | {"GST"}
"""Sentences whose time is that of the fix. ZDA's is the clock's, which in some receivers is seconds ahead."""
_MOST = 64
"""Sentences in an epoch; further ones of the same instant say nothing new."""
_ALIKE = SECOND
"""For so long cycles must have been alike; what comes less often than each instant mostly comes once a second."""


@dataclass(frozen=True, slots=True)
class NmeaEpoch:
    """What a receiver said of one instant; nan or -1 where it said nothing.

    start: bytes from the beginning of the stream to the epoch's first sentence. kinds: the sentences it was made of.
    utime: microseconds of UTC; 0 while the receiver has told no date. leap_second: the instant is within 23:59:60, and
    utime is that of the second after it. Units as in `NmeaSentence`; coordinates are kept where the fix is flagged
    invalid, with `fix_type` NONE.
    """

    start: int
    kinds: tuple[str, ...]
    utime: int
    time_of_day: int | None
    fix_type: FixType
    latitude: float = NAN
    longitude: float = NAN
    height_msl: float = NAN
    undulation: float = NAN
    satellites: int = -1
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
    def leap_second(self) -> bool:
        """Whether the instant lies in an inserted second."""
        return self.time_of_day is not None and self.time_of_day >= DAY


class EpochAssembler:
    """Sentences in, epochs out. Memory is bounded by one epoch."""

    def __init__(self) -> None:
        self._open: list[NmeaSentence] = []
        self._reference: int | None = None
        self._done: int | None = None
        self._cycle: Counter[str] = Counter()
        self._alike_since: int | None = None
        self._first = self._last = ""
        self._by_end = False
        self._regular = True
        self._still = self._begun_after_silence = False
        self._lessons: Counter[tuple[str, bool]] = Counter()
        """How often silence told that a sentence of motion leads, or that it does not."""
        self.late = 0
        """Sentences that came after their epoch was complete, or too many for it; they were not used."""

    def add(self, sentence: NmeaSentence) -> list[NmeaEpoch]:
        """Return the epochs that the sentence completes: at most the one before it, and its own."""
        closed = []
        timed = sentence.kind in _TIMED
        if self._starts_new(sentence) if timed else self._leads(sentence.kind) and self._instant()[0]:
            closed += self._close(by_end=False)
        if self._is_late(sentence, timed) or len(self._open) >= _MOST:
            self.late += 1
            return closed
        self._note_date(sentence)
        if not self._open:
            self._begun_after_silence, self._still = self._still, False
        elif timed and self._begun_after_silence and not self._instant()[0]:
            self._learn(self._open, leads=True)
        self._open.append(sentence)
        if self._is_end(sentence):
            closed += self._close(by_end=True)
        return closed

    def flush(self) -> list[NmeaEpoch]:
        """Return the epoch under way, if any: the line has been silent, so no more of it will come."""
        self._still = True
        begun = next((n for n, each in enumerate(self._open) if each.kind in _TIMED), len(self._open))
        self._learn(self._open[begun:], leads=False)
        return self._close(by_end=False, is_silent=True)

    def clear(self) -> None:
        """Forget the epoch under way, and the order of sentences: another receiver may speak."""
        self._open, self._still = [], False
        self._lessons.clear()

    def _learn(self, sentences: list[NmeaSentence], leads: bool) -> None:
        self._lessons.update((each.kind, leads) for each in sentences if each.kind in _MOTION)

    def _leads(self, kind: str) -> bool | None:
        """Whether a sentence of motion comes before those with the time; None where that is not known."""
        for leads in (True, False):
            # a pause amid a cycle tells the wrong thing
            if self._lessons[kind, leads] >= max(_SURE, 4 * self._lessons[kind, not leads]):
                return leads
        return None

    def _belonging(self, sentences: list[NmeaSentence], is_silent: bool) -> list[NmeaSentence]:
        """Leave out sentences of motion that are, or may be, another instant's."""
        begun = next(n for n, each in enumerate(sentences) if each.kind in _TIMED)

        def belongs(n: int, kind: str) -> bool:
            leads = self._leads(kind)
            return n > begun and is_silent if leads is None else (n < begun) is leads

        return [each for n, each in enumerate(sentences) if each.kind not in _MOTION or belongs(n, each.kind)]

    def _instant(self) -> tuple[bool, int | None]:
        """Whether the epoch under way has a sentence that has a time by its kind, and that time."""
        for each in self._open:
            if each.kind in _TIMED:
                return True, each.time_of_day
        return False, None

    def _starts_new(self, sentence: NmeaSentence) -> bool:
        begun, instant = self._instant()
        if not begun:
            return False
        if sentence.time_of_day != instant:
            return True
        return instant is None and any(each.kind == sentence.kind for each in self._open)

    def _is_late(self, sentence: NmeaSentence, timed: bool) -> bool:
        if timed:
            begun, _ = self._instant()
            late = not begun and sentence.time_of_day is not None and sentence.time_of_day == self._done
            self._regular = self._regular and not (late and self._by_end)
            return late
        if not self._open and self._by_end and sentence.kind != self._first:
            # it trails an epoch that was thought complete: this receiver's cycles differ, do not guess their end again
            self._regular = False
            return sentence.kind != "ZDA"
        return False

    def _is_end(self, sentence: NmeaSentence) -> bool:
        if not self._regular or sentence.kind != self._last:
            return False
        if self._alike_since is None or self._done is None or self._done - self._alike_since < _ALIKE:
            return False
        heard = Counter(each.kind for each in self._open)
        return all(heard[kind] >= number for kind, number in self._cycle.items())

    def _note_date(self, sentence: NmeaSentence) -> None:
        if sentence.day is not None and sentence.time_of_day is not None:
            self._reference = sentence.day * DAY + sentence.time_of_day

    def _close(self, by_end: bool, is_silent: bool = False) -> list[NmeaEpoch]:
        sentences, self._open = self._open, []
        if not any(each.kind in _TIMED for each in sentences):
            return []
        instant = next(each.time_of_day for each in sentences if each.kind in _TIMED)
        cycle = Counter(each.kind for each in sentences)
        if cycle != self._cycle or self._alike_since is None or instant is None or instant < self._alike_since:
            self._alike_since = instant
        self._by_end, self._cycle, self._done = by_end, cycle, instant
        self._first, self._last = sentences[0].kind, sentences[-1].kind
        if not any(each.kind in POSITION_KINDS for each in sentences):
            return []
        return [merged(self._belonging(sentences, is_silent), instant, self._utime(instant))]

    def _utime(self, instant: int | None) -> int:
        """Put a time of day on the day that brings it nearest to the last date heard."""
        if instant is None or self._reference is None:
            return 0
        day, clock = divmod(self._reference, DAY)
        if instant >= DAY and clock < SECOND:
            # within a leap second, whose own date names the day before
            day -= 1
        utime = day * DAY + instant
        utime += round((self._reference - utime) / DAY) * DAY
        self._reference = utime
        return utime


def merged(sentences: list[NmeaSentence], instant: int | None, utime: int) -> NmeaEpoch:
    """Return what sentences of one instant say together.

    Where several say the same thing the more telling comes first: GGA and GNS before RMC before GLL for the position,
    RMC before VTG for speed and course.
    """
    places = sorted(
        (each for each in sentences if each.has_position),
        key=lambda each: ("GGA", "GNS", "RMC", "GLL").index(each.kind),
    )
    motions = sorted(sentences, key=lambda each: each.kind != "RMC")
    last = list(reversed(sentences))

    def said(name: str, among: list[NmeaSentence]) -> float:
        return next((value for each in among if (value := float(getattr(each, name))) == value), NAN)

    # the height goes with its own place, not with another sentence's
    heights = [each for each in places if each.kind in ("GGA", "GNS")]
    return NmeaEpoch(
        start=sentences[0].start,
        kinds=tuple(each.kind for each in sentences),
        utime=utime,
        time_of_day=instant,
        fix_type=fix_type(sentences),
        latitude=said("latitude", places),
        longitude=said("longitude", places),
        height_msl=said("height_msl", heights),
        undulation=said("undulation", heights),
        satellites=satellites_used(sentences),
        hdop=said("hdop", last),
        vdop=said("vdop", last),
        pdop=said("pdop", last),
        speed=said("speed", motions),
        track=said("track", motions),
        heading=said("heading", last),
        sigma_latitude=said("sigma_latitude", last),
        sigma_longitude=said("sigma_longitude", last),
        sigma_height=said("sigma_height", last),
    )
