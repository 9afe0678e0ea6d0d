"""The bus: what the loop needs of LCM, and the real one."""

from __future__ import annotations

import math
import select
import time
from collections.abc import Callable
from enum import Enum
from typing import Final, Protocol, TypeAlias

from modelserver.service.membership import RENEW_S, Membership
from modelserver.wire.channels import literal
from modelserver.wire.provider import open_lcm, resolve_url, take_message

MOST_UNREAD: Final = 50_000
LEAST_UNREAD: Final = 16
"""Messages of a channel that LCM holds until they are taken, at most; and where they are long, at least."""

SENSOR_BYTES: Final = 4 << 20
REQUEST_BYTES: Final = 1 << 20
"""Bytes of the messages of one channel that LCM holds: 20,000 samples of wheels, 4,000 requests.

LCM counts messages, which may have 64 kB and more each, and what it has allocated for them once it keeps. So the number
of messages is set by how long they are.
"""

HEAD_BYTES: Final = 128
"""What LCM keeps for a message beside its data, about: a record with pointers and the name of its channel."""


class QueueLimit:
    """How many messages of a channel LCM may hold, by how long they have been lately: `limit_bytes` in all."""

    __slots__ = ("_limit_bytes", "_mean", "capacity")

    def __init__(self, limit_bytes: int):
        self._limit_bytes = limit_bytes
        self._mean = 256.0
        self.capacity = self._wanted()

    def changes(self, length: int) -> bool:
        """Take the length of a message into account; return whether `capacity` is another one now."""
        # long ones count at once, since many more may follow; short ones are believed slowly
        off = length - self._mean
        if -0.1 * self._mean < off < 0.1 * self._mean:
            return False
        self._mean += off * (0.125 if off > 0.0 else 0.015625)
        wanted = self._wanted()
        if 0.8 * self.capacity <= wanted <= 1.25 * self.capacity:
            return False
        self.capacity = wanted
        return True

    def _wanted(self) -> int:
        return max(LEAST_UNREAD, min(MOST_UNREAD, int(self._limit_bytes / (self._mean + HEAD_BYTES))))


Handler: TypeAlias = Callable[[str, bytes], None]


class Inbox(Protocol):
    """One queue of incoming messages. Messages are handed to their handlers only within `drain`."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Hand every message of exactly `channel` to `handler`."""
        ...

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Hand over what has come, at most `limit` messages and for so many seconds, without waiting; return how many.

        The message that is being handled when the time is up is the last.
        """
        ...


class Bus(Protocol):
    """Two inboxes, so that a flood of requests cannot hold up a sensor, and a way out."""

    @property
    def sensors(self) -> Inbox:
        """Where samples come in."""
        ...

    @property
    def requests(self) -> Inbox:
        """Where requests come in."""
        ...

    def publish(self, channel: str, data: bytes) -> None:
        """Send a message to everyone."""
        ...

    def wait(self, seconds: float, requests: bool = True) -> None:
        """Return when something has come or the time is up; without `requests` only samples count."""
        ...


class InboxState(Enum):
    """What `LcmBus.wait` has just seen of an inbox."""

    NOTHING = 0
    ONE = 1
    """It was empty until now, and a message has come. There may be more by now, which the next wait finds."""
    ANY = 2
    """Not known."""


SLEPT_S: Final = 20e-6
"""A wait that took longer had to wait."""


class LcmInbox:
    """An inbox on an LCM instance of its own."""

    def __init__(self, url: str, queue_bytes: int):
        self._queue_bytes = queue_bytes
        self.lcm = open_lcm(url)
        self.fileno = self.lcm.fileno()
        self.expected = InboxState.ANY

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Hand every message of exactly `channel` to `handler`."""
        limit = QueueLimit(self._queue_bytes)

        def handle(name: str, data: bytes) -> None:
            if limit.changes(len(data)):
                subscription.set_queue_capacity(limit.capacity)
            handler(name, data)

        subscription = self.lcm.subscribe(literal(channel), handle)
        # LCM drops silently what comes beyond it, so the loop refuses and counts long before; a flood that is faster
        # than the loop can refuse must not fill the memory
        subscription.set_queue_capacity(limit.capacity)

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Hand over what has come, at most `limit` messages and for so many seconds, without waiting; return how many.

        The message that is being handled when the time is up is the last.
        """
        expected, self.expected = self.expected, InboxState.ANY
        if expected is InboxState.NOTHING or not limit:
            return 0
        if expected is InboxState.ONE:
            # without asking whether there is one: a call to the kernel less, while a client waits for its reply
            self.lcm.handle()
            return 1
        end = time.monotonic() + seconds
        for count in range(limit):
            if not take_message(self.lcm):
                return count
            if time.monotonic() >= end:
                return count + 1
        return limit


class LcmBus:
    """The real bus. Make it after forking, never before: LCM has a thread of its own."""

    def __init__(self, url: str = ""):
        self.url = resolve_url(url)
        self.sensors: LcmInbox = LcmInbox(self.url, SENSOR_BYTES)
        self.requests: LcmInbox = LcmInbox(self.url, REQUEST_BYTES)
        self._poll = select.poll()
        for inbox in (self.sensors, self.requests):
            self._poll.register(inbox.fileno, select.POLLIN)
        self.publish = self.requests.lcm.publish
        self._membership = Membership(self.url)
        self._renew_at = time.monotonic() + RENEW_S

    def wait(self, seconds: float, requests: bool = True) -> None:
        """Return when something has come or the time is up; without `requests` only samples count."""
        begin = time.monotonic()
        if begin >= self._renew_at:
            self._renew_at = begin + RENEW_S
            self._membership.renew()
        if not requests:
            readable, _, _ = select.select((self.sensors.fileno,), (), (), max(0.0, seconds))
            self.sensors.expected = InboxState.ANY if readable else InboxState.NOTHING
            return
        # poll is the cheaper call but counts in milliseconds; select keeps the deadline to the microsecond
        milliseconds = int(seconds * 1e3)
        ready = [file for file, _ in self._poll.poll(milliseconds)]
        if not ready:
            files = (self.sensors.fileno, self.requests.fileno)
            ready, _, _ = select.select(files, (), (), max(0.0, seconds - milliseconds * 1e-3))
        some = InboxState.ONE if time.monotonic() - begin > SLEPT_S else InboxState.ANY
        for inbox in (self.sensors, self.requests):
            inbox.expected = some if inbox.fileno in ready else InboxState.NOTHING
