"""Statistics of each channel of a bus: count, rate, size, age, jitter. The receive time comes with each message.

Rates are averages over the last `WINDOW_S`, counted in buckets of `BUCKET_S`. Jitter is the exponentially weighted
standard deviation of the intervals between messages.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

WINDOW_S: Final = 5.0
"""Window of the rates, seconds."""

BUCKET_S: Final = 0.5
"""Bucket of the window, seconds."""

JITTER_GAIN: Final = 0.05
"""Weight of a new interval in mean and variance."""

MAX_CHANNELS: Final = 200
"""Channels with statistics of their own; messages on further ones are counted together."""

MAX_CHECKS_PER_S: Final = 1000
"""Messages per second that are decoded to find damaged ones; the rest of a flood is only counted."""


@dataclass(slots=True)
class ChannelStatistics:
    """Statistics of one channel. `undecodable` counts damaged messages of a known type."""

    channel: str
    type_name: str = ""
    count: int = 0
    undecodable: int = 0
    size: int = 0
    last: bytes = b""
    last_s: float = 0.0
    mean_interval: float = math.nan
    interval_variance: float = 0.0
    buckets: deque[tuple[int, int, int]] = field(default_factory=deque)
    """(bucket number, messages, bytes) of the last `WINDOW_S`."""

    @property
    def jitter(self) -> float:
        """Standard deviation of the intervals between messages, seconds; nan for fewer than two messages."""
        return math.sqrt(self.interval_variance) if not math.isnan(self.mean_interval) else math.nan


class BusTraffic:
    """Statistics of a bus since `start` (seconds, any clock).

    `type_of` returns the type of a message, empty for an unknown one; `is_decodable` whether one of a known type is.
    """

    def __init__(
        self,
        start: float,
        type_of: Callable[[bytes], str],
        is_decodable: Callable[[str, bytes], bool] = lambda type_name, data: True,
    ):
        self.start = start
        self.channels: dict[str, ChannelStatistics] = {}
        self.others = 0
        """Messages on channels beyond `MAX_CHANNELS`."""
        self._type_of = type_of
        self._is_decodable = is_decodable
        self._second = -1
        self._checked = 0

    def add(self, channel: str, data: bytes, now: float) -> None:
        """Count a message."""
        stats = self.channels.get(channel)
        if stats is None:
            if len(self.channels) >= MAX_CHANNELS:
                self.others += 1
                return
            stats = self.channels[channel] = ChannelStatistics(channel)
        if stats.count:
            _update_jitter(stats, now - stats.last_s)
        stats.count += 1
        stats.size, stats.last, stats.last_s = len(data), data, now
        stats.type_name = self._type_of(data)
        number, count, size = int(now / BUCKET_S), 0, 0
        if stats.buckets and stats.buckets[-1][0] == number:
            _, count, size = stats.buckets.pop()
        stats.buckets.append((number, count + 1, size + len(data)))
        if not count:
            self._drop_old_buckets(stats, now)
        if stats.type_name and self._may_check(now) and not self._is_decodable(stats.type_name, data):
            stats.undecodable += 1

    def _may_check(self, now: float) -> bool:
        if int(now) != self._second:
            self._second, self._checked = int(now), 0
        self._checked += 1
        return self._checked <= MAX_CHECKS_PER_S

    def _drop_old_buckets(self, stats: ChannelStatistics, now: float) -> None:
        oldest = _get_oldest_bucket(now)
        while stats.buckets and stats.buckets[0][0] <= oldest:
            stats.buckets.popleft()

    def get_rates(self, stats: ChannelStatistics, now: float) -> tuple[float, float]:
        """Return messages and bytes per second of a channel."""
        self._drop_old_buckets(stats, now)
        # whole buckets are dropped, so the duration of the rest varies by one bucket
        since = max(now - max(self.start, (_get_oldest_bucket(now) + 1) * BUCKET_S), BUCKET_S)
        count = sum(each for _, each, _ in stats.buckets)
        size = sum(each for _, _, each in stats.buckets)
        return count / since, size / since

    def list_channels(self) -> list[ChannelStatistics]:
        """Return the channels, sorted by name."""
        return [self.channels[name] for name in sorted(self.channels)]


def _get_oldest_bucket(now: float) -> int:
    """Return the number of the newest bucket outside the window."""
    return math.floor((now - WINDOW_S) / BUCKET_S)


def _update_jitter(stats: ChannelStatistics, interval: float) -> None:
    """Update mean and variance of the intervals (exponentially weighted)."""
    if math.isnan(stats.mean_interval):
        stats.mean_interval = interval
        return
    off = interval - stats.mean_interval
    stats.mean_interval += JITTER_GAIN * off
    stats.interval_variance = (1.0 - JITTER_GAIN) * (stats.interval_variance + JITTER_GAIN * off * off)
