"""What came over the line, in words: for a person who has connected the wrong thing."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from msdrivers.protocol.nmea.epochs import POSITION_KINDS

SHOWN = 24
"""Bytes of the beginning that are quoted."""
MOST_NAMES = 6
WHOLE = 2
"""So many flawed sentences are no chance."""
_ADDRESS = re.compile(rb"\$([A-Z]{2}[A-Z]{3}|P[A-Z]{3,5}),")
_FLAWS = {
    "rejected.nmea_unfinished": "without checksum",
    "rejected.nmea_field": "with a right checksum and a field that cannot be",
}
_REMEDIES = {
    _FLAWS["rejected.nmea_unfinished"]: "switch its checksums on",
    _FLAWS["rejected.nmea_field"]: "compare its sentences with NMEA 0183, it writes them otherwise",
}


class LineMonitor:
    """Remembers the beginning of what came, how much it was, and what counters said before."""

    def __init__(self) -> None:
        self.bytes = 0
        self._begin = b""
        self._names: set[str] = set()
        self._before: dict[str, int] = {}

    def forget(self, counts: Mapping[str, int]) -> None:
        """Begin anew; `counts` are the parser's at this moment."""
        self.bytes = 0
        self._begin = b""
        self._names.clear()
        self._before = dict(counts)

    def take(self, data: bytes) -> None:
        """Note what came in."""
        self.bytes += len(data)
        if len(self._begin) < SHOWN:
            self._begin = (self._begin + data)[:SHOWN]
        if len(self._names) < MOST_NAMES:
            self._names.update(each.decode("ascii") for each in _ADDRESS.findall(data)[:MOST_NAMES])

    def good(self, counts: Mapping[str, int]) -> list[str]:
        """Return the kinds of good frames that came, e.g. "nmea.GPRMC"."""
        return [
            kind
            for kind, number in counts.items()
            if kind.startswith(("nmea.", "novatel.")) and number > self._before.get(kind, 0)
        ]

    def flaw(self, counts: Mapping[str, int]) -> str:
        """Return what is wrong with whole sentences, at the right baud rate then; empty where nothing is."""
        if not self._names or self.good(counts):
            return ""
        for reason, words in _FLAWS.items():
            if counts.get(reason, 0) - self._before.get(reason, 0) >= WHOLE:
                return words
        return ""

    @property
    def names(self) -> str:
        """The addresses of the sentences that came, whether they were read or not."""
        return ", ".join(sorted(self._names))

    def no_epoch(self, counts: Mapping[str, int], seconds: float) -> str:
        """Return why there has been no fix for so long on a line with NMEA sentences, and what to do."""
        placed = [kind for kind in self.good(counts) if kind[-3:] in POSITION_KINDS]
        if placed:
            kinds = ", ".join(kind.partition(".")[2] for kind in placed)
            return f"{kinds} come, but their time stands still: no new fix for {seconds:g} s; look after the receiver"
        text = f"no GGA or RMC for {seconds:g} s, heard {self.words(counts)} since"
        if self.good(counts):
            return f"{text}; switch GGA or RMC on in the receiver"
        flaw = self.flaw(counts)
        return f"{text}; {_REMEDIES[flaw]}" if flaw else text

    def words(self, counts: Mapping[str, int]) -> str:
        """Return what was heard, for a person."""
        if not self.bytes:
            return "nothing"
        kinds = self.good(counts)
        if kinds == ["nmea.unused"] and self._names:
            return f"{self.names}, which are not used"
        flaw = self.flaw(counts)
        if flaw:
            return f"{self.names} {flaw}"
        if kinds:
            return f"{', '.join(kind.partition('.')[2] for kind in kinds[:6])}{' and more' if len(kinds) > 6 else ''}"
        refused = sum(
            number - self._before.get(kind, 0) for kind, number in counts.items() if kind.startswith("rejected.")
        )
        broken = f" ({refused} with a beginning like theirs, and broken)" if refused else ""
        return f"{self.bytes} bytes that are neither NovAtel logs nor NMEA sentences{broken}, beginning {self._begin!r}"


def wrong_device(wanted: str, attempts: Sequence[tuple[int | None, str]]) -> str:
    """Return what to tell where no receiver was found: what was tried, what was heard, what to do."""
    tried = "; ".join(f"{f'at {baud} baud ' if baud else ''}heard {what}" for baud, what in attempts)
    if all(what == "nothing" for _, what in attempts):
        advice = "check the receiver's power, the cable, and that the port is the right one"
    elif all("bytes that are neither" in what or what == "nothing" for _, what in attempts):
        advice = "another device is on this port, or its baud rate was not tried: check the port and `bauds`"
    else:
        advice = (
            "it speaks but does not answer: check that the line can send to it, that it is a NovAtel receiver "
            "(else set protocol: nmea), and `device_port`"
        )
    return f"no {wanted} on this line: {tried}; {advice}"
