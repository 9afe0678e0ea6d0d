"""The clock of each source: its stamps compared with their receipt, and what is known of some offsets. Pure.

A source whose stamps are off while those of others agree with their receipt is the one with the wrong clock. Where all
are off, as in the playback of a log, none is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from modelserver.core.host_clock import Instant
from modelserver.core.state import SourceTraffic
from modelserver.named_tuples import new_tuple

SAMPLE_FUTURE_LIMIT_S: Final = 0.25
"""A sample stamped this far ahead of the host's clock is rejected: synchronized clocks differ by less, and a fix that
is fused a quarter of a second late is off by what the vehicle travels in that time."""

LATE_LIMIT_S: Final = 12.0
"""A stamp this far behind is not that of a late sample: more than the longest `horizon`, 10 s."""

SPREAD_S: Final = 2.0
"""Within which the offsets of one clock agree, seconds."""

OFF_SAMPLES: Final = 3
"""Samples in a row with one offset until a clock is off: one alone is an outlier."""

ON_TIME_NS: Final = 5_000_000_000
"""How long the others count as on time after their last sample."""

SINCE_START_S: Final = 1e9
"""Seconds since 1970 that no clock has that was ever set: 2001."""

LEAP_S: Final = 18.0
"""GPS time less UTC since 2017."""


def note_offset(
    traffic: Mapping[str, SourceTraffic], source: str, utime: int, now: Instant
) -> Mapping[str, SourceTraffic]:
    """Record by how much a stamp of a source differs from its receipt."""
    known = traffic.get(source)
    if known is None:
        return traffic
    offset = (utime - now.utime) * 1e-6
    if -LATE_LIMIT_S <= offset <= SAMPLE_FUTURE_LIMIT_S:
        updated = (*known[:-2], 0.0, 0)
    else:
        num_off = known.num_off + 1 if abs(offset - known.offset) < SPREAD_S else 1
        updated = (*known[:-2], offset, num_off)
    return {**traffic, source: new_tuple(SourceTraffic, updated)}


def is_clock_off(traffic: Mapping[str, SourceTraffic], source: str, now: Instant) -> bool:
    """Return whether the clock of a source is off: it is ahead of the host's, or behind it while others are on time."""
    known = traffic.get(source)
    if known is None or known.num_off < OFF_SAMPLES:
        return False
    return known.offset > 0.0 or any(
        not each.num_off and name.startswith("sensor:") and now.monotonic_ns - each.last_received_ns < ON_TIME_NS
        for name, each in traffic.items()
    )


def format_offset(offset: float, received_s: float) -> str:
    """Format an offset with what it is known as, e.g. `3,600.0 s (1 h: a time zone?) behind`.

    offset: stamp less receipt, seconds. received_s: time of the receipt, seconds since 1970.
    """
    size, stamp_s = abs(offset), received_s + offset
    hours = round(size / 3600.0)
    known = ""
    if abs(size - LEAP_S) < 0.5:
        known = " (GPS time instead of UTC?)"
    elif 1 <= hours <= 14 and abs(size - 3600.0 * hours) < SPREAD_S:
        known = f" ({hours} h: a time zone?)"
    elif abs(1000.0 * stamp_s / max(received_s, 1.0) - 1.0) < 0.01:
        known = " (milliseconds instead of microseconds?)"
    elif abs(stamp_s / max(1000.0 * received_s, 1.0) - 1.0) < 0.01:
        known = " (nanoseconds instead of microseconds?)"
    elif stamp_s < SINCE_START_S < received_s:
        known = " (from 0 on, as of a simulation, or of a unit since its start?)"
    return f"{size:,.1f} s{known} {'ahead of' if offset > 0.0 else 'behind'}"
