"""What a reading of the axis says, and whether an axis can do that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from modelserver.messages import NAN, JointSample
from msdrivers.devices.axis_settings import AxisSettings

RATE_MARGIN = 1.1
"""An axis at its highest rate overshoots a little where it turns back."""


class _Place(NamedTuple):
    degrees: float
    at_ns: int
    doubt_ns: int


class Readings:
    """Readings one after the other.

    An angle is believed when an axis of at most the highest rate can have come there from the last one believed, or
    from the last one that was not: then it was the one before that was wrong.
    """

    def __init__(self, settings: AxisSettings):
        """Take the settings."""
        self._settings = settings
        self.clear()

    def clear(self) -> None:
        """Forget what came before."""
        self._last: _Place | None = None
        self._doubt: _Place | None = None
        self._number: int | None = None

    def take(self, values: Sequence[int], at_ns: int, doubt_ns: int) -> tuple[JointSample | None, str]:
        """Return what the registers say, or None and why not in one word; a word beside a sample tells of its rate.

        `at_ns` is when they were read, give or take `doubt_ns`. Words: `repeated`, `range`, `jump`, `rate`.
        """
        settings, registers = self._settings, self._settings.registers

        def words(name: str) -> Sequence[int]:
            mapped = registers.measured[name]
            begin = mapped.address - registers.begin
            return values[begin : begin + mapped.registers]

        if registers.number is not None:
            number = registers.number.number(words("number"))
            if number == self._number:
                return None, "repeated"
            self._number = number
        degrees = registers.angle.degrees(words("angle"))
        if not settings.lowest_deg - settings.step_deg <= degrees <= settings.highest_deg + settings.step_deg:
            return None, "range"
        place = _Place(degrees, at_ns, doubt_ns)
        believed = self._last is None or self._reaches(self._last, place)
        if not believed and not (self._doubt is not None and self._reaches(self._doubt, place)):
            self._doubt = place
            return None, "jump"
        self._last, self._doubt = place, None
        rate, word = NAN, ""
        if registers.rate is not None:
            rate = registers.rate.degrees(words("rate"))
            if abs(rate) > RATE_MARGIN * settings.fastest_deg:
                rate, word = NAN, "rate"
        sigma = settings.step_deg / math.sqrt(12.0)
        return JointSample(settings.joint, math.radians(degrees), math.radians(sigma), math.radians(rate)), word

    def _reaches(self, before: _Place, after: _Place) -> bool:
        seconds = (after.at_ns - before.at_ns + before.doubt_ns + after.doubt_ns) * 1e-9
        reach = RATE_MARGIN * self._settings.fastest_deg * seconds + 2.0 * self._settings.step_deg
        return abs(after.degrees - before.degrees) <= reach
