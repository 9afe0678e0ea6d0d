"""Description of the received data, to diagnose a wrong device, baud rate or configuration."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from msdrivers.protocol.nmea.epochs import POSITION_KINDS

QUOTED_BYTES = 24
"""Quoted bytes of the beginning."""
MAX_NAMES = 6
MIN_FLAWED_SENTENCES = 2
"""Fewer flawed sentences may be chance."""
_ADDRESS = re.compile(rb"\$([A-Z]{2}[A-Z]{3}|P[A-Z]{3,5}),")
_FLAWS = {
    "rejected.nmea_incomplete": "without checksum",
    "rejected.nmea_field": "with a right checksum and a field that cannot be",
}
_REMEDIES = {
    _FLAWS["rejected.nmea_incomplete"]: "switch its checksums on",
    _FLAWS["rejected.nmea_field"]: "compare its sentences with NMEA 0183, it writes them otherwise",
}


class LineMonitor:
    """Records the first bytes, the amount of data and the sentence names since the last `reset`."""

    def __init__(self) -> None:
        self.bytes_received = 0
        self._first_bytes = b""
        self._names: set[str] = set()
        self._counts_at_reset: dict[str, int] = {}

    def reset(self, counts: Mapping[str, int]) -> None:
        """Start over; `counts` are the parser's present counters."""
        self.bytes_received = 0
        self._first_bytes = b""
        self._names.clear()
        self._counts_at_reset = dict(counts)

    def add(self, data: bytes) -> None:
        """Record received data."""
        self.bytes_received += len(data)
        if len(self._first_bytes) < QUOTED_BYTES:
            self._first_bytes = (self._first_bytes + data)[:QUOTED_BYTES]
        if len(self._names) < MAX_NAMES:
            self._names.update(each.decode("ascii") for each in _ADDRESS.findall(data)[:MAX_NAMES])

    def list_valid_kinds(self, counts: Mapping[str, int]) -> list[str]:
        """Return the kinds of valid frames since the reset, e.g. "nmea.GPRMC"."""
        return [
            kind
            for kind, number in counts.items()
            if kind.startswith(("nmea.", "novatel.")) and number > self._counts_at_reset.get(kind, 0)
        ]

    def find_flaw(self, counts: Mapping[str, int]) -> str:
        """Describe a flaw common to complete sentences (the baud rate is right then); empty if there is none."""
        if not self._names or self.list_valid_kinds(counts):
            return ""
        for reason, words in _FLAWS.items():
            if counts.get(reason, 0) - self._counts_at_reset.get(reason, 0) >= MIN_FLAWED_SENTENCES:
                return words
        return ""

    @property
    def names(self) -> str:
        """Addresses of the received sentences, parsed or not."""
        return ", ".join(sorted(self._names))

    def explain_missing_fix(self, counts: Mapping[str, int], seconds: float) -> str:
        """Explain a missing fix on a line with NMEA sentences, with a remedy."""
        placed = [kind for kind in self.list_valid_kinds(counts) if kind[-3:] in POSITION_KINDS]
        if placed:
            kinds = ", ".join(kind.partition(".")[2] for kind in placed)
            return f"{kinds} arrive, but their time does not advance: no new fix for {seconds:g} s; check the receiver"
        text = f"no GGA or RMC for {seconds:g} s, received {self.describe(counts)} since"
        if self.list_valid_kinds(counts):
            return f"{text}; switch GGA or RMC on in the receiver"
        flaw = self.find_flaw(counts)
        return f"{text}; {_REMEDIES[flaw]}" if flaw else text

    def describe(self, counts: Mapping[str, int]) -> str:
        """Describe the received data."""
        if not self.bytes_received:
            return "nothing"
        kinds = self.list_valid_kinds(counts)
        if kinds == ["nmea.unsupported"] and self._names:
            return f"{self.names}, which are not used"
        flaw = self.find_flaw(counts)
        if flaw:
            return f"{self.names} {flaw}"
        if kinds:
            return f"{', '.join(kind.partition('.')[2] for kind in kinds[:6])}{' and more' if len(kinds) > 6 else ''}"
        rejected = sum(
            number - self._counts_at_reset.get(kind, 0)
            for kind, number in counts.items()
            if kind.startswith("rejected.")
        )
        broken = f" ({rejected} damaged ones)" if rejected else ""
        text = f"{self.bytes_received} bytes that are neither NovAtel logs nor NMEA sentences"
        return f"{text}{broken}, beginning {self._first_bytes!r}"


def explain_missing_receiver(wanted: str, attempts: Sequence[tuple[int | None, str]]) -> str:
    """Explain that no receiver was found: attempts, received data, remedy."""
    tried = "; ".join(f"{f'at {baud} baud ' if baud else ''}received {what}" for baud, what in attempts)
    if all(what == "nothing" for _, what in attempts):
        advice = "check the receiver's power, the cable, and that the port is the right one"
    elif all("bytes that are neither" in what or what == "nothing" for _, what in attempts):
        advice = "another device is on this port, or its baud rate was not tried: check the port and `bauds`"
    else:
        advice = (
            "it sends data but does not answer: check that the line can send to it, that it is a NovAtel receiver "
            "(else set protocol: nmea), and `device_port`"
        )
    return f"no {wanted} on this line: {tried}; {advice}"
