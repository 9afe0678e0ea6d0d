"""Who writes on a channel: tells a second writer from duplicates, disorder, losses and a driver that starts anew. Pure.

A sensor's channel has one writer. A second one, be it a driver that was started twice, a recording played onto the live
bus or a stranger, shows by another name (header.source), or by two rows of numbers (header.seq) side by side:

- another name while the first still speaks is a second writer at once;
- a number far off, or one already heard with another instant, may be the first of a driver that was started anew, of a
  log that begins again, or a stray. Where the old row is silent from then on it has ended, and the new one is the
  channel's. Where it goes on between such numbers, again and again, there are two writers.

The same number with the same instant is a message that came twice; a number a little lower that was not heard yet came
late; one a little higher says that some were lost. Sources that do not count have one number alone; whoever counts
beside such a one is another. The first writer keeps the channel until it has been silent for some of its own
intervals, and towards another name for `SILENCE_NS`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from modelserver.messages import SensorHeader

SILENCE_NS: Final = 3_000_000_000
"""After so long without a word a writer has left: three times the period of the slowest sensor."""

NEAR: Final = 64
"""Numbers this much lower may be late messages, and what was heard of them is remembered. A power of two."""

FAR: Final = 4096
"""Numbers this much higher may follow upon lost messages: more than the fastest sensor sends in the silence."""

RIVAL_NS: Final = 10_000_000_000
"""A second writer that was not heard for so long is gone."""

QUIET_NS: Final = 200_000_000
QUIET_INTERVALS: Final = 5
"""A row that was silent for so long, and for so many of its intervals, has ended where another of its name speaks."""

STRAYS: Final = 2
"""So often numbers may be off the row while the row goes on, within `SILENCE_NS`; more are another writer's."""

LOST_FACTOR: Final = 8
"""Times the messages that are usual in a span may be lost in it; numbers that are farther ahead are off the row."""

MUTE: Final = 3
"""After so many samples with one number a source is known not to count."""


class Mark(NamedTuple):
    """The fields of a sample's header that its publisher is recognized by; they can be read without decoding it."""

    utime: int
    source: str
    seq: int


_MASK: Final = NEAR - 1
_NEVER: Final = -1 << 64
"""No number of a message."""
_NOBODY: Final = SensorHeader(0, seq=_NEVER)


class Writer:
    """Watches one channel. It changes as it is told of samples: a value for each would cost more than all the rest."""

    __slots__ = ("_counts", "_heard", "_interval_ns", "_last", "_last_ns", "_off_ns", "_same", "_strays", "_went_on",
                 "rival", "rival_ns", "source")  # fmt: skip

    def __init__(self) -> None:
        self.source = ""
        """Name of who keeps the channel."""
        self.rival = ""
        """Name of the second writer that was heard last, empty for none yet."""
        self.rival_ns = 0
        """When that was, monotonic nanoseconds."""
        self._heard: list[SensorHeader | Mark] = []
        self._last = self._last_ns = self._interval_ns = self._off_ns = self._same = self._strays = 0
        self._counts = self._went_on = False
        self._begin(_NOBODY, -SILENCE_NS - 1)

    def is_second(self, header: SensorHeader | Mark, now_ns: int) -> bool:
        """Return whether a sample is a second writer's."""
        seq = header.seq
        ahead = seq - self._last
        passed = now_ns - self._last_ns
        if header.source != self.source or passed > SILENCE_NS:
            if passed > SILENCE_NS:
                self._begin(header, now_ns)
                return False
            return self._is_rival(header.source, now_ns)
        if 0 < ahead <= FAR and self._same < MUTE:
            if ahead > NEAR and ahead * self._interval_ns > LOST_FACTOR * passed:
                # more numbers than can have been lost in that time
                return self._off_the_row(header, now_ns)
            self._counts = True
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
        else:
            self._same += 1
        self._last = seq
        self._last_ns = now_ns
        self._interval_ns += (passed - self._interval_ns) >> 3
        self._went_on = True
        self._heard[seq & _MASK] = header
        return False

    def _off_the_row(self, header: SensorHeader | Mark, now_ns: int) -> bool:
        """Return whether a number off the row is of a second writer, beside whom the row goes on."""
        if now_ns - self._last_ns > max(QUIET_NS, QUIET_INTERVALS * self._interval_ns):
            # whoever spoke before was started anew
            self._begin(header, now_ns)
            return False
        if now_ns - self._off_ns > SILENCE_NS:
            self._strays = 0
        # one that comes sooner than any driver's next, started again or not, is an extra one
        early = 2 * (now_ns - max(self._last_ns, self._off_ns)) < self._interval_ns
        self._off_ns = now_ns
        if self._went_on or early:
            self._strays += 1
            self._went_on = False
        return self._strays > STRAYS and self._is_rival(header.source, now_ns)

    def _is_rival(self, source: str, now_ns: int) -> bool:
        self.rival, self.rival_ns = source, now_ns
        return True

    def _begin(self, header: SensorHeader | Mark, now_ns: int) -> None:
        self.source, self._last, self._last_ns = header.source, header.seq, now_ns
        self._counts, self._same, self._strays, self._went_on = False, 0, 0, True
        self._interval_ns = self._off_ns = 0
        self._heard = [_NOBODY] * NEAR
        self._heard[header.seq & _MASK] = header
