"""What was heard on a bus, channel by channel: counts, rates, sizes, ages. Time comes in with each message."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

WINDOW_S: Final = 5.0
"""Seconds over which rates are told."""

BUCKET_S: Final = 0.5
"""Seconds of messages that are counted together for it."""

JITTER_GAIN: Final = 0.05
"""By how much each interval counts for the usual one and for how far off it they are."""

MAX_CHANNELS: Final = 200
"""Channels that are told apart; what comes on further ones is counted together."""

CHECKED_PER_S: Final = 1000
"""Messages a second that are decoded to see whether they are whole; in a flood the rest is taken as it is."""


@dataclass(slots=True)
class Seen:
    """What was heard on one channel. `undecodable` counts messages of a known type that are damaged."""

    channel: str
    type_name: str = ""
    count: int = 0
    undecodable: int = 0
    size: int = 0
    last: bytes = b""
    last_s: float = 0.0
    interval: float = math.nan
    scatter: float = 0.0
    buckets: deque[tuple[int, int, int]] = field(default_factory=deque)
    """(number of the bucket, messages, bytes), of the last `WINDOW_S`."""

    @property
    def jitter(self) -> float:
        """Standard deviation of the intervals between messages, seconds; nan before there are two."""
        return math.sqrt(self.scatter) if not math.isnan(self.interval) else math.nan


class BusTraffic:
    """All that was heard since `began` (seconds, any clock); `heard` takes a message, the rest tells.

    `type_of` gives the type of a message, empty for a stranger's; `is_whole` whether one of a known type is sound.
    """

    def __init__(
        self,
        began: float,
        type_of: Callable[[bytes], str],
        is_whole: Callable[[str, bytes], bool] = lambda type_name, data: True,
    ):
        self.began = began
        self.channels: dict[str, Seen] = {}
        self.others = 0
        """Messages on channels beyond `MAX_CHANNELS`."""
        self._type_of = type_of
        self._is_whole = is_whole
        self._second = -1
        self._checked = 0

    def heard(self, channel: str, data: bytes, now: float) -> None:
        """Take a message."""
        seen = self.channels.get(channel)
        if seen is None:
            if len(self.channels) >= MAX_CHANNELS:
                self.others += 1
                return
            seen = self.channels[channel] = Seen(channel)
        if seen.count:
            _spread(seen, now - seen.last_s)
        seen.count += 1
        seen.size, seen.last, seen.last_s = len(data), data, now
        seen.type_name = self._type_of(data)
        number = int(now / BUCKET_S)
        if seen.buckets and seen.buckets[-1][0] == number:
            _, count, size = seen.buckets.pop()
            seen.buckets.append((number, count + 1, size + len(data)))
        else:
            seen.buckets.append((number, 1, len(data)))
            self._forget(seen, now)
        if seen.type_name and self._may_check(now) and not self._is_whole(seen.type_name, data):
            seen.undecodable += 1

    def _may_check(self, now: float) -> bool:
        if int(now) != self._second:
            self._second, self._checked = int(now), 0
        self._checked += 1
        return self._checked <= CHECKED_PER_S

    def _forget(self, seen: Seen, now: float) -> None:
        oldest = _oldest(now)
        while seen.buckets and seen.buckets[0][0] <= oldest:
            seen.buckets.popleft()

    def rates(self, seen: Seen, now: float) -> tuple[float, float]:
        """Return messages and bytes a second on a channel over the last seconds."""
        self._forget(seen, now)
        # whole buckets are forgotten: the time that the rest is of varies by one
        since = max(now - max(self.began, (_oldest(now) + 1) * BUCKET_S), BUCKET_S)
        count = sum(each for _, each, _ in seen.buckets)
        size = sum(each for _, _, each in seen.buckets)
        return count / since, size / since

    def ordered(self) -> list[Seen]:
        """Return the channels by name."""
        return [self.channels[name] for name in sorted(self.channels)]


def _oldest(now: float) -> int:
    """Return the number of the newest bucket that is forgotten."""
    return math.floor((now - WINDOW_S) / BUCKET_S)


def _spread(seen: Seen, interval: float) -> None:
    """Take one interval more into the usual one and its scatter (exponentially weighted)."""
    if math.isnan(seen.interval):
        seen.interval = interval
        return
    off = interval - seen.interval
    seen.interval += JITTER_GAIN * off
    seen.scatter = (1.0 - JITTER_GAIN) * (seen.scatter + JITTER_GAIN * off * off)
