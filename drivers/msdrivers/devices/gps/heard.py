"""What came over the line, in words: for a person who has connected the wrong thing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

SHOWN = 24
"""Bytes of the beginning that are quoted."""


class Heard:
    """Remembers the beginning of what came, how much it was, and what counters said before."""

    def __init__(self) -> None:
        self.bytes = 0
        self._begin = b""
        self._before: dict[str, int] = {}

    def forget(self, counts: Mapping[str, int]) -> None:
        """Begin anew; `counts` are the parser's at this moment."""
        self.bytes = 0
        self._begin = b""
        self._before = dict(counts)

    def take(self, data: bytes) -> None:
        """Note what came in."""
        self.bytes += len(data)
        if len(self._begin) < SHOWN:
            self._begin = (self._begin + data)[:SHOWN]

    def good(self, counts: Mapping[str, int]) -> list[str]:
        """Return the kinds of good frames that came, e.g. "nmea.GPRMC"."""
        return [
            kind
            for kind, number in counts.items()
            if kind.startswith(("nmea.", "novatel.")) and kind != "nmea.late" and number > self._before.get(kind, 0)
        ]

    def words(self, counts: Mapping[str, int]) -> str:
        """Return what was heard, for a person."""
        if not self.bytes:
            return "nothing"
        kinds = self.good(counts)
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
