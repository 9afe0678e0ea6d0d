"""Detect a duplicate publisher on a sensor's channel. Pure of clocks; one mutable detector per channel.

A channel has one publisher: a source (header.source), and the address of its socket where that is known. Another source
or address while the first one still publishes is a conflict: a driver that was started twice, a recording played onto
the live bus, a stranger. The first publisher keeps the channel until it has been silent for `PUBLISHER_TIMEOUT_NS`, and
against its own source, which is a restart, for `RESTART_GAP_INTERVALS` of its intervals. A source named in the vehicle
file takes the channel from one that is not.

Limits: without addresses, two publishers of the same source look like one. A stranger that is first keeps the channel
from a source that the vehicle file does not name.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Final, NamedTuple

from modelserver.messages import SensorHeader

PUBLISHER_TIMEOUT_NS: Final = 3_000_000_000
"""A publisher that is silent for so long has left: three times the period of the slowest sensor."""

CONFLICT_TIMEOUT_NS: Final = 10_000_000_000
"""A conflict without another sample for so long has ended."""

RESTART_GAP_NS: Final = 200_000_000
RESTART_GAP_INTERVALS: Final = 5
"""A publisher that is silent for so long, and for so many of its intervals, is replaced by another of its source."""


class SampleId(NamedTuple):
    """Header fields of a sample that can be read without decoding the message."""

    utime: int
    source: str


class PublisherConflictDetector:
    """Detects a second publisher on one channel. Mutable: a new value per sample would cost more than the detection."""

    __slots__ = ("_interval_ns", "_last_ns", "_names", "_sender", "conflict_ns", "other_source", "source")

    def __init__(self, names: Container[str] = ()) -> None:
        """`names`: the sources that the vehicle file names."""
        self._names = names
        self._sender: object = None
        self._last_ns = -PUBLISHER_TIMEOUT_NS - 1
        self._interval_ns = 0
        self.source = ""
        """Source that owns the channel."""
        self.other_source = ""
        """Source of the last conflicting sample; empty without one."""
        self.conflict_ns = 0
        """Receipt of the last conflicting sample, monotonic nanoseconds."""

    def is_conflicting(self, header: SensorHeader | SampleId, now_ns: int, sender: object = None) -> bool:
        """Process a sample; return whether it is from a second publisher. `sender`: its address, where it is known."""
        source = header.source
        passed = now_ns - self._last_ns
        if source == self.source and sender == self._sender and passed <= PUBLISHER_TIMEOUT_NS:
            self._last_ns = now_ns
            self._interval_ns += (passed - self._interval_ns) >> 3
            return False
        is_restarted = source == self.source and passed > max(RESTART_GAP_NS, RESTART_GAP_INTERVALS * self._interval_ns)
        if passed > PUBLISHER_TIMEOUT_NS or is_restarted or (source in self._names and self.source not in self._names):
            if passed <= PUBLISHER_TIMEOUT_NS and not is_restarted:
                self.other_source, self.conflict_ns = self.source, now_ns
            self.source, self._sender, self._last_ns, self._interval_ns = source, sender, now_ns, 0
            return False
        self.other_source, self.conflict_ns = source, now_ns
        return True
