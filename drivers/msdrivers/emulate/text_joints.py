"""Emulator of a pan-tilt head that sends lines of text: its joints sweep to and fro."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol.text_lines import LineDescription, encode_line

PERIOD_US: Final = 20_000
"""Microseconds between lines."""

AMPLITUDE: Final = 0.5
"""Radians or meters to either side."""

SWEEP_S: Final = 8.0
"""Period of the first joint, seconds; that of each further one is a third shorter."""


class TextJointsEmulator:
    """An `Endpoint` of bytes that sends a line every `PERIOD_US`."""

    def __init__(self, settings: LineDescription) -> None:
        self._settings = settings
        self._first: HostTime | None = None
        self._sent = 0
        self.counts: Counter[str] = Counter()
        """Lines sent."""

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self._first = self._first or now
        return []

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        return []

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Send the lines that are due, the newest only after a pause."""
        assert self._first is not None
        due = (now.monotonic_ns - self._first.monotonic_ns) // (1000 * PERIOD_US)
        if due < self._sent:
            return []
        self._sent = due + 1
        self.counts["lines"] += 1
        return [Send(encode_line(self._settings, self.get_values(due * PERIOD_US * 1e-6)))]

    def get_deadline(self) -> int | None:
        """Return when the next line is due."""
        return None if self._first is None else self._first.monotonic_ns + self._sent * PERIOD_US * 1000

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        return []

    def get_values(self, seconds: float) -> dict[str, float]:
        """Return the fields of a line, `seconds` after the first."""
        values = {}
        for number, name in enumerate(self._settings.fields):
            period = SWEEP_S * (2.0 / 3.0) ** number
            values[name] = 1.0 + seconds if name == "time" else AMPLITUDE * math.sin(math.tau * seconds / period)
        return values
