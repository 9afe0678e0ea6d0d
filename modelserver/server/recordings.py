"""Recordings: how their stamps are off their times of receipt, and playback onto the bus.

The stamps of a recording and the times of their receipt have one axis, or two with known amounts between them. A
simulation stamps from 0 s and is recorded by the clock of the wall; a recorder may run an hour off. If all sources are
off by one amount the recording is sound: its receive times are moved to the axis of the stamps. If one is off alone, it
is that one's clock.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Final, get_args

from modelserver import messages
from modelserver.core.state import SPREAD_S, format_offset
from modelserver.server.clock import Clock
from modelserver.server.ingress import peek_sample_id
from modelserver.wire.codec import fingerprint_of, get_type_name, restamp
from modelserver.wire.eventlog import LogEvent

LARGEST_DELAY_S: Final = 5.0
"""Largest difference of stamp and receipt that buses and latencies explain, seconds."""

LOOKED_AT: Final = 4000
"""Events that are looked at: some ten seconds of a vehicle's sensors."""


SAMPLES: Final = frozenset(fingerprint_of(get_type_name(each)) for each in get_args(messages.Sample))
"""The first bytes of messages with samples."""


@dataclass(slots=True)
class StampAxis:
    """Offsets of stamps from receipt: of each channel, and of all together where they agree; seconds, 0 for none.

    received_s: the time of receipt, seconds since 1970.
    """

    by_channel: Mapping[str, float] = field(default_factory=dict)
    received_s: float = 0.0

    @property
    def common(self) -> float:
        """What all sources are off by; 0 if they are not, or not by one amount."""
        values = list(self.by_channel.values())
        if not values or max(values) - min(values) > SPREAD_S:
            return 0.0
        middle = statistics.median(values)
        return middle if abs(middle) > LARGEST_DELAY_S else 0.0

    def describe(self) -> list[str]:
        """Describe what is off, a sentence for each; empty if nothing is."""
        if self.common:
            return [f"all stamps are {self.format(self.common)} their receipt: the axis of the stamps is used"]
        return [
            f"the stamps on {channel} are {self.format(offset)} their receipt: the clock of that source is off"
            for channel, offset in self.by_channel.items()
            if abs(offset) > LARGEST_DELAY_S
        ]

    def format(self, offset: float) -> str:
        """Format an offset with what it is known as, e.g. `3,600.0 s (1 h: a time zone?) behind`."""
        return format_offset(offset, self.received_s)


def measure(events: Iterable[LogEvent], channels: Container[str] | None = None) -> StampAxis:
    """Return the median offset of the stamps of each channel with samples; of some channels, or of all."""
    offsets: dict[str, list[float]] = {}
    received_s = 0.0
    for event in events:
        received_s = event.utime * 1e-6
        is_wanted = (channels is None or event.channel in channels) and event.data[:8] in SAMPLES
        if is_wanted and (found := peek_sample_id(event.data, event.data[:8])) is not None:
            offsets.setdefault(event.channel, []).append((found.utime - event.utime) * 1e-6)
    return StampAxis({name: statistics.median(values) for name, values in offsets.items()}, received_s)


def align(events: Iterable[LogEvent], channels: Container[str], axis: StampAxis) -> Iterator[LogEvent]:
    """Yield events with their receipt on the axis of the stamps; what is found is written to `axis`."""
    waiting = iter(events)
    first = list(islice(waiting, LOOKED_AT))
    found = measure(first, channels)
    axis.by_channel, axis.received_s = found.by_channel, found.received_s
    offset = round(axis.common * 1e6)
    for event in chain(first, waiting):
        yield event._replace(utime=event.utime + offset) if offset else event


@dataclass(slots=True)
class Player:
    """Publishes events `speed` times as fast as they were recorded (infinite: at once).

    Messages are published unchanged; with `restamp` the stamps of samples and mode commands are shifted by the age of
    the log, so that they are current for a daemon.

    Each event has an absolute deadline on the monotonic clock, relative to the first one, so delays do not accumulate.
    If the log's time steps back, playback continues at once from there. The counts are valid also after an interrupt;
    `max_delay` is the greatest delay of a message after its deadline, seconds.
    """

    publish: Callable[[str, bytes], object]
    speed: float
    clock: Clock
    sleep: Callable[[float], object]
    restamp: bool = False
    sent: int = 0
    max_delay: float = 0.0
    first_utime: int = 0
    last_utime: int = 0

    def play(self, events: Iterable[LogEvent], on_sent: Callable[[LogEvent], object] = lambda event: None) -> None:
        """Publish all events; call `on_sent` after each one."""
        start_ns, start_utime, shift = self.clock.monotonic_ns(), 0, 0
        for event in events:
            if not self.sent:
                self.first_utime = start_utime = event.utime
                shift = self.clock.now().utime - event.utime
            elif event.utime < self.last_utime:
                start_ns, start_utime = self.clock.monotonic_ns(), event.utime
            if not math.isinf(self.speed):
                due_ns = start_ns + round((event.utime - start_utime) * 1000 / self.speed)
                wait = (due_ns - self.clock.monotonic_ns()) * 1e-9
                if wait > 0:
                    self.sleep(wait)
                else:
                    self.max_delay = max(self.max_delay, -wait)
            self.publish(event.channel, restamp(event.data, shift) if self.restamp else event.data)
            self.sent += 1
            self.last_utime = event.utime
            on_sent(event)

    @property
    def duration(self) -> float:
        return (self.last_utime - self.first_utime) * 1e-6
