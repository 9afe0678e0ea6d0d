"""What a fix rests on, by all that the sentences of one instant say of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from modelserver.messages import FixType
from msdrivers.protocol.nmea.sentences import NmeaSentence

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
    "A": FixType.FIX_3D,
    "P": FixType.FIX_3D,
    "D": FixType.DIFFERENTIAL,
    "R": FixType.RTK_FIXED,
    "F": FixType.RTK_FLOAT,
    "E": FixType.DEAD_RECKONING,
}
"""The mode indicator of NMEA 2.3 and later. M (by hand), S (simulated), N (not valid) are NONE."""


def fix_type(sentences: Sequence[NmeaSentence]) -> FixType:
    """Return the fix type; NONE if any sentence flags the fix invalid, or none has a position."""
    placed = [each for each in sentences if each.has_position]
    if not placed or any(_denies(each) for each in sentences) or _has_no_satellites(sentences):
        return FixType.NONE
    dimensions = [each.dimension for each in sentences if each.dimension is not None]
    dimension = max(dimensions, default=None)
    if dimension == 1:
        return FixType.NONE
    found = next(_statements(placed), FixType.FIX_3D)
    has_height = any(each.height_msl == each.height_msl for each in placed)
    flat = dimension == 2 if dimension is not None else not has_height
    return FixType.FIX_2D if flat and found is FixType.FIX_3D else found


def _denies(sentence: NmeaSentence) -> bool:
    """Whether a sentence says that there is no valid fix."""
    if sentence.kind == "GGA":
        return sentence.quality not in _QUALITY
    if sentence.kind == "GNS":
        return _best(sentence.mode) is None
    if sentence.kind in ("RMC", "GLL"):
        # status V with mode E is dead reckoning, a fix of its kind
        if sentence.mode and sentence.mode not in _MODE:
            return True
        return sentence.status != "A" and sentence.mode != "E"
    return False


def satellites_used(sentences: Sequence[NmeaSentence]) -> int:
    """Return how many satellites the fix of one instant uses; -1 where no sentence counts them.

    Some receivers (Furuno GL, Garmin 25) send a GGA with 0 in use while the GSA of the same instant lists them: then
    the list counts.
    """
    counted = max((each.satellites for each in sentences if each.satellites is not None), default=-1)
    return counted or sum(each.listed for each in sentences)


def _has_no_satellites(sentences: Sequence[NmeaSentence]) -> bool:
    """Return whether a GGA counts no satellites in use: some receivers keep the last quality when they lose all."""
    counts = any(each.kind == "GGA" and each.satellites == 0 for each in sentences)
    return counts and satellites_used(sentences) == 0


def _statements(placed: Iterable[NmeaSentence]) -> Iterator[FixType]:
    """Say what positions rest on, the most detailed statement first."""
    ordered = sorted(placed, key=lambda each: ("GGA", "GNS", "RMC", "GLL").index(each.kind))
    for each in ordered:
        found = _QUALITY.get(each.quality) if each.quality is not None else _best(each.mode)
        if found is not None:
            yield found


def _best(mode: str) -> FixType | None:
    """Return the best of a mode indicator's letters; satellite systems that are not used say N."""
    found = [_MODE[letter] for letter in mode if letter in _MODE]
    return max(found, key=_RANK.index, default=None)


_RANK = (
    FixType.DEAD_RECKONING,
    FixType.FIX_3D,
    FixType.DIFFERENTIAL,
    FixType.RTK_FLOAT,
    FixType.RTK_FIXED,
)
