"""Samples written as an event log, in the order of their arrival."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

import lcm

from modelserver.messages import Sample
from modelserver.wire import codec

Arrival: TypeAlias = tuple[int, str, Sample]
"""When a sample arrived (utime), its channel, and the sample."""


def write_samples(path: Path, arrivals: Iterable[Arrival]) -> dict[str, int]:
    """Write samples as an event log, replacing it; return how many by channel.

    They are put in the order of arrival; of those that arrived together the order given stays.
    """
    counts: dict[str, int] = {}
    out = lcm.EventLog(str(path), "w", overwrite=True)
    try:
        for utime, channel, sample in sorted(arrivals, key=lambda each: each[0]):
            out.write_event(utime, channel, codec.encode(sample))
            counts[channel] = counts.get(channel, 0) + 1
    finally:
        out.close()
    return counts
