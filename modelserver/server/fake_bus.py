"""A bus within one process, for replays and tests: it delivers at once, in order, without loss."""

from __future__ import annotations

import math
from collections import deque

from modelserver.server.bus import Handler, Inboxes
from modelserver.server.clock import FakeClock
from modelserver.wire.receiver import Sender


class FakeInbox:
    """One queue of a `FakeBus`."""

    def __init__(self, clock: FakeClock) -> None:
        self._clock = clock
        self._handlers: dict[str, list[Handler]] = {}
        self._queue: deque[tuple[str, bytes, Sender]] = deque()

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Call `handler` with every message of exactly `channel`."""
        self._handlers.setdefault(channel, []).append(handler)

    def put(self, channel: str, data: bytes, sender: Sender = None) -> None:
        """Queue a message for the subscribers of its channel."""
        if channel in self._handlers:
            self._queue.append((channel, data, sender))

    def pop_refused(self) -> dict[str, int]:
        """None is too long."""
        return {}

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Handle the queued messages, at most `limit` and for at most `seconds`; return how many."""
        count = 0
        end_ns = self._clock.monotonic_ns() + seconds * 1e9
        while self._queue and count < limit and (not count or self._clock.monotonic_ns() < end_ns):
            channel, data, sender = self._queue.popleft()
            count += 1
            for handler in self._handlers[channel]:
                handler(channel, data, sender)
        return count

    @property
    def pending(self) -> int:
        """Messages that wait to be drained."""
        return len(self._queue)


class FakeBus:
    """Both inboxes and all published messages; `wait` advances the fake clock to its deadline."""

    def __init__(self, clock: FakeClock):
        self._clock = clock
        self.sensors = FakeInbox(clock)
        self.requests = FakeInbox(clock)
        self.published: list[tuple[str, bytes]] = []

    def publish(self, channel: str, data: bytes) -> None:
        """Publish a message, also to the own inboxes."""
        self.published.append((channel, data))
        self.sensors.put(channel, data)
        self.requests.put(channel, data)

    def wait(self, seconds: float, inboxes: Inboxes = "both") -> None:
        """Advance the clock if no message is pending in an inbox."""
        has_samples = inboxes != "requests" and self.sensors.pending
        if not has_samples and (inboxes == "samples" or not self.requests.pending):
            self._clock.advance(max(seconds, 0.0))

    def get_published(self, channel: str) -> list[bytes]:
        return [data for name, data in self.published if name == channel]
