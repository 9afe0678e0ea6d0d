"""Detect a duplicate publisher on a sensor's channel. Pure of clocks; one mutable detector per channel.

A channel has one publisher, named by header.source and counting its messages in header.seq. A conflict (a driver that
was started twice, a recording played onto the live bus, a stranger) shows as

- another source, or another sender's address, while the first one still publishes: a conflict at once;
- outliers of the sequence: a seq far off the last one, or one already received with another utime. A single outlier may
  be a restarted driver, a log that starts again, or a stray message. If the old sequence stays silent after it, the new
  one owns the channel (restart). If the old sequence continues between outliers more than `MAX_OUTLIERS` times, two
  publishers have the same source.

Not a conflict: the same seq with the same utime (duplicate), a slightly lower seq not received yet (reordering), a
slightly higher one (loss). A source with a constant seq does not count; a counting one beside it is a conflict. The
first publisher keeps the channel until it has been silent for `PUBLISHER_TIMEOUT_NS`, and against its own source for
`RESTART_GAP_INTERVALS` of its intervals. Two exceptions: a source named in the vehicle file takes the channel from one
that is not; and a first one that is slower than any sensor loses it to a steady one (`CONTEST_NS`).

Limits: without addresses, two publishers of the same source that count in step within the reordering window look like
one. A stranger with the source of the sensor, that is first and as fast as one, keeps the channel.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Final, NamedTuple

from modelserver.messages import SensorHeader

PUBLISHER_TIMEOUT_NS: Final = 3_000_000_000
"""A publisher that is silent for so long has left: three times the period of the slowest sensor."""

REORDER_WINDOW: Final = 64
"""How far below the last seq a message may be out of sequence; so many headers are stored. A power of two."""

LOSS_WINDOW: Final = 4096
"""How far above the last seq a message may be after losses: more than the fastest sensor sends in the timeout."""

CONFLICT_TIMEOUT_NS: Final = 10_000_000_000
"""A conflict without another sample for so long has ended."""

RESTART_GAP_NS: Final = 200_000_000
RESTART_GAP_INTERVALS: Final = 5
"""A sequence that is silent for so long, and for so many of its intervals, is replaced by another of its source."""

MAX_OUTLIERS: Final = 2
"""Outliers within `PUBLISHER_TIMEOUT_NS` between which the sequence may continue; more are another publisher's."""

MAX_LOSS_FACTOR: Final = 8
"""A seq that is ahead by more than this multiple of the messages expected in the elapsed time is an outlier."""

SLOWEST_PERIOD_NS: Final = 1_500_000_000
"""A longer gap has no sensor that works: receivers send once a second."""

CONTEST_NS: Final = 5_000_000_000
"""A publisher that has sent for so long without such a gap takes the channel from one with such gaps."""

CONSTANT_SEQ_SAMPLES: Final = 3
"""After so many samples with a constant seq a source does not count."""


class SampleId(NamedTuple):
    """The header fields that identify a sample and its publisher; they can be read without decoding the message."""

    utime: int
    source: str
    seq: int


_MASK: Final = REORDER_WINDOW - 1
_NO_SAMPLE: Final = SensorHeader(0, seq=-1 << 64)


class PublisherConflictDetector:
    """Detects a second publisher on one channel. Mutable: a new value per sample would cost more than the detection."""

    __slots__ = (
        "_continued", "_interval_ns", "_is_counting", "_last", "_last_ns", "_names", "_outlier_ns", "_outliers",
        "_received", "_repeats", "_second", "_second_ns", "_second_since_ns", "_sender", "_slow_ns", "conflict_ns",
        "other_source", "source",
    )  # fmt: skip

    def __init__(self, names: Container[str] = ()) -> None:
        """`names`: the sources that the vehicle file names."""
        self._names = names
        self._sender: object = None
        self._second: object = None
        self._second_ns = self._second_since_ns = 0
        self._slow_ns = -CONTEST_NS
        self.source = ""
        """Source that owns the channel."""
        self.other_source = ""
        """Source of the last conflicting sample; empty without one."""
        self.conflict_ns = 0
        """Receipt of the last conflicting sample, monotonic nanoseconds."""
        self._received: list[SensorHeader | SampleId] = []
        self._last = self._last_ns = self._interval_ns = self._outlier_ns = self._repeats = self._outliers = 0
        self._is_counting = self._continued = False
        self._restart(_NO_SAMPLE, -PUBLISHER_TIMEOUT_NS - 1, None)

    def is_conflicting(self, header: SensorHeader | SampleId, now_ns: int, sender: object = None) -> bool:
        """Process a sample; return whether it is from a second publisher. `sender`: its address, where it is known."""
        seq = header.seq
        ahead = seq - self._last
        passed = now_ns - self._last_ns
        if passed > PUBLISHER_TIMEOUT_NS:
            self._restart(header, now_ns, sender)
            return False
        if header.source != self.source or sender != self._sender:
            return self._check_other(header, now_ns, sender)
        if passed > SLOWEST_PERIOD_NS:
            self._slow_ns = now_ns
        if 0 < ahead <= LOSS_WINDOW and self._repeats < CONSTANT_SEQ_SAMPLES:
            if ahead > REORDER_WINDOW and ahead * self._interval_ns > MAX_LOSS_FACTOR * passed:
                return self._check_outlier(header, now_ns)
            self._is_counting = True
        elif -REORDER_WINDOW < ahead <= 0 and self._is_counting:
            known = self._received[seq & _MASK]
            if known.seq == seq:
                return known.utime != header.utime and self._check_outlier(header, now_ns)
            # out of sequence: the last one stays the last
            self._received[seq & _MASK] = header
            return False
        elif ahead:
            return self._check_outlier(header, now_ns)
        else:
            self._repeats += 1
        self._last = seq
        self._last_ns = now_ns
        self._interval_ns += (passed - self._interval_ns) >> 3
        self._continued = True
        self._received[seq & _MASK] = header
        return False

    def _check_outlier(self, header: SensorHeader | SampleId, now_ns: int) -> bool:
        """Process a sample that does not continue the sequence; return whether it is from a second publisher."""
        if self._may_be_restarted(now_ns):
            self._restart(header, now_ns, self._sender)
            return False
        if now_ns - self._outlier_ns > PUBLISHER_TIMEOUT_NS:
            self._outliers = 0
        # sooner than the next sample of any driver, restarted or not
        early = 2 * (now_ns - max(self._last_ns, self._outlier_ns)) < self._interval_ns
        self._outlier_ns = now_ns
        if self._continued or early:
            self._outliers += 1
            self._continued = False
        return self._outliers > MAX_OUTLIERS and self._set_conflict(header.source, now_ns)

    def _check_other(self, header: SensorHeader | SampleId, now_ns: int, sender: object) -> bool:
        """Process a sample of another publisher; return whether it stays the second one."""
        is_restarted = header.source == self.source and self._may_be_restarted(now_ns)
        is_named = header.source in self._names and self.source not in self._names
        if is_restarted or is_named or self._wins_contest((header.source, sender), now_ns):
            if not is_restarted:
                self._set_conflict(self.source, now_ns)
            self._restart(header, now_ns, sender)
            return False
        return self._set_conflict(header.source, now_ns)

    def _may_be_restarted(self, now_ns: int) -> bool:
        """Return whether the owner has been silent for so long that its source was restarted."""
        return now_ns - self._last_ns > max(RESTART_GAP_NS, RESTART_GAP_INTERVALS * self._interval_ns)

    def _wins_contest(self, second: object, now_ns: int) -> bool:
        """Return whether a second publisher is steady where the first one is not."""
        if second != self._second or now_ns - self._second_ns > SLOWEST_PERIOD_NS:
            if self._second is not None and now_ns - self._second_ns <= SLOWEST_PERIOD_NS:
                return False  # a third one
            self._second, self._second_since_ns = second, now_ns
        self._second_ns = now_ns
        if now_ns - self._last_ns > SLOWEST_PERIOD_NS:
            self._slow_ns = now_ns
        return now_ns - self._second_since_ns >= CONTEST_NS and now_ns - self._slow_ns < CONTEST_NS

    def _set_conflict(self, source: str, now_ns: int) -> bool:
        self.other_source, self.conflict_ns = source, now_ns
        return True

    def _restart(self, header: SensorHeader | SampleId, now_ns: int, sender: object) -> None:
        self._sender, self._second, self._slow_ns = sender, None, now_ns - CONTEST_NS
        self.source, self._last, self._last_ns = header.source, header.seq, now_ns
        self._is_counting, self._repeats, self._outliers, self._continued = False, 0, 0, True
        self._interval_ns = self._outlier_ns = 0
        self._received = [_NO_SAMPLE] * REORDER_WINDOW
        self._received[header.seq & _MASK] = header
