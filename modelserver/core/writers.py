"""Who writes on a channel: tells a second writer from duplicates, disorder, losses and a driver that starts anew. Pure.

A sensor's channel has one writer. A second one, be it a driver that was started twice, a recording played onto the live
bus or a stranger, shows by another name (header.source), or by two rows of numbers (header.seq) side by side:

- another name while the first still speaks is a second writer at once;
- a number far off, or one already heard with another instant, may be the first of a driver that was started anew, or of
  a log that begins again: then the old row has ended. Where the old row goes on, and then the new one again, there are
  two writers.

The same number with the same instant is a message that came twice; a number a little lower that was not heard yet came
late; one a little higher says that some were lost. Sources that do not count (all numbers alike) are told apart by name
alone. The first writer keeps the channel until it has been silent for `SILENCE_NS`.
"""

from __future__ import annotations

from typing import Final

from modelserver.messages import SensorHeader

SILENCE_NS: Final = 3_000_000_000
"""After so long without a word a writer has left: three times the period of the slowest sensor."""

NEAR: Final = 64
"""Numbers this much lower may be late messages, and what was heard of them is remembered. A power of two."""

FAR: Final = 4096
"""Numbers this much higher may follow upon lost messages: more than the fastest sensor sends in the silence."""

RIVAL_NS: Final = 10_000_000_000
"""A second writer that was not heard for so long is gone."""

_MASK: Final = NEAR - 1
_NEVER: Final = -1 << 64
"""No number of a message."""
_NOBODY: Final = SensorHeader(0, seq=_NEVER)


class Writer:
    """Watches one channel. It changes as it is told of samples: a value for each would cost more than all the rest."""

    __slots__ = ("_counts", "_heard", "_last", "_last_ns", "_old_went_on", "_other", "rival", "rival_ns",
                 "source")  # fmt: skip

    def __init__(self) -> None:
        self.source = ""
        """Name of who keeps the channel."""
        self.rival = ""
        """Name of the second writer that was heard last, empty for none yet."""
        self.rival_ns = 0
        """When that was, monotonic nanoseconds."""
        self._last_ns = -SILENCE_NS - 1
        self._last = 0
        self._counts = False
        self._heard = [_NOBODY] * NEAR
        self._other = _NEVER  # the newest number of what may be a second row
        self._old_went_on = False

    def is_second(self, header: SensorHeader, now_ns: int) -> bool:
        """Return whether a sample is a second writer's."""
        seq = header.seq
        ahead = seq - self._last
        if header.source != self.source or now_ns - self._last_ns > SILENCE_NS:
            if now_ns - self._last_ns > SILENCE_NS:
                self._begin(header, now_ns)
                return False
            return self._is_rival(header.source, now_ns)
        if 0 < ahead <= FAR:
            self._counts = True
            if self._other is not _NEVER:
                self._old_went_on = True
        elif -NEAR < ahead <= 0 and self._counts:
            known = self._heard[seq & _MASK]
            if known.seq == seq:
                # twice the same, or another's that has the same number
                return known.utime != header.utime and self._off_the_row(header, now_ns)
            # late: the newest stays the newest
            self._heard[seq & _MASK] = header
            return False
        elif ahead:
            return self._off_the_row(header, now_ns)
        self._last = seq
        self._last_ns = now_ns
        self._heard[seq & _MASK] = header
        return False

    def _off_the_row(self, header: SensorHeader, now_ns: int) -> bool:
        """Return whether a number off the row is of a second row that goes on beside it."""
        other, self._other = self._other, header.seq
        if other is _NEVER or not 0 < header.seq - other <= FAR:
            self._old_went_on = False
            return False
        if self._old_went_on:
            return self._is_rival(header.source, now_ns)
        # two of the new row and none of the old between them: whoever spoke before was started anew
        self._begin(header, now_ns)
        return False

    def _is_rival(self, source: str, now_ns: int) -> bool:
        self.rival, self.rival_ns = source, now_ns
        return True

    def _begin(self, header: SensorHeader, now_ns: int) -> None:
        self.source, self._last, self._last_ns = header.source, header.seq, now_ns
        self._counts, self._other, self._old_went_on = False, _NEVER, False
        self._heard = [_NOBODY] * NEAR
        self._heard[header.seq & _MASK] = header
