"""The bus: what the loop needs of LCM (`Bus`), and its implementation (`LcmBus`).

- Samples and requests have an LCM instance each, so that a flood of requests cannot delay samples in a shared queue.
- LCM limits a channel's queue by messages, which may have 64 kB and more; `QueueLimit` turns a limit in bytes into one
  in messages by a moving average of their length.
- Multicast membership survives a network interface that goes down and up again. LCM joins the group once; the kernel
  drops the membership with the interface. It delivers a group's packets to every socket bound to their port as long as
  any socket of the machine is a member (IP_MULTICAST_ALL, ip(7)), so `MulticastMembership` joins again on a socket of
  its own.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import re
import select
import socket
import struct
import time
from collections.abc import Callable
from typing import Final, Protocol, TypeAlias

import lcm

from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.provider import handle_message, resolve_url
from modelserver.wire.receive_filter import open_receiver

log = logging.getLogger(__name__)

RENEW_S: Final = 1.0
"""Period of renewing the membership: one system call."""

_GROUP: Final = re.compile(r"udpm://(\d{1,3}(?:\.\d{1,3}){3})(?::\d+)?(?:\?.*)?\Z")


class MulticastMembership:
    """Membership in the multicast group of an LCM URL; without effect for other providers."""

    def __init__(self, url: str):
        found = _GROUP.match(url)
        self._request = b""
        if found:
            # the interface is that of the group's route, as for LCM
            with contextlib.suppress(OSError):  # no address: LCM reports it
                self._request = struct.pack("=4s4s", socket.inet_aton(found[1]), socket.inet_aton("0.0.0.0"))
        self._socket: socket.socket | None = None
        self._joined = False
        self._has_warned = False
        self.renew()

    def renew(self) -> bool:
        """Join the group if necessary; return whether a membership exists or none is needed."""
        if not self._request:
            return True
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, self._request)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return True  # a member already, on the interface that the route names now
            self.close()
            if not self._has_warned:
                self._has_warned = True
                log.warning(
                    "the bus is unreachable: no network interface has a route for its multicast group (%s); retrying "
                    "every %g s; see: ip route get %s",
                    error.strerror,
                    RENEW_S,
                    socket.inet_ntoa(self._request[:4]),
                )
            return False
        if self._joined:
            log.warning("the bus is reachable again: its multicast group was rejoined")
        self._joined, self._has_warned = True, False
        return True

    def close(self) -> None:
        """Leave the group."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


MAX_QUEUED: Final = 50_000
MIN_QUEUED: Final = 16
"""Limits of the messages that LCM queues on a channel."""

SENSOR_QUEUE_BYTES: Final = 4 << 20
REQUEST_QUEUE_BYTES: Final = 1 << 20
"""Bytes that LCM queues on a channel: 20,000 samples of wheels, 4,000 requests."""

MESSAGE_OVERHEAD_BYTES: Final = 128
"""Memory of LCM per message beside its data, about: a record with pointers and the channel's name."""


class QueueLimit:
    """Capacity of a channel's queue in messages for `limit_bytes`, by a moving average of the message length."""

    __slots__ = ("_limit_bytes", "_mean", "capacity")

    def __init__(self, limit_bytes: int):
        self._limit_bytes = limit_bytes
        self._mean = 256.0
        self.capacity = self._compute_capacity()

    def update(self, length: int) -> bool:
        """Process the length of a message; return whether `capacity` has changed."""
        # up fast, since many long messages may follow; down slowly
        off = length - self._mean
        if -0.1 * self._mean < off < 0.1 * self._mean:
            return False
        self._mean += off * (0.125 if off > 0.0 else 0.015625)
        capacity = self._compute_capacity()
        if 0.8 * self.capacity <= capacity <= 1.25 * self.capacity:
            return False
        self.capacity = capacity
        return True

    def _compute_capacity(self) -> int:
        return max(MIN_QUEUED, min(MAX_QUEUED, int(self._limit_bytes / (self._mean + MESSAGE_OVERHEAD_BYTES))))


Handler: TypeAlias = Callable[[str, bytes], None]


class Inbox(Protocol):
    """A queue of received messages. Handlers run only within `drain`."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Call `handler` with every message of exactly `channel`."""

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Handle the messages that have arrived, at most `limit` and for at most `seconds`, without waiting.

        Returns the number of handled messages. One that is in progress when the time is up is the last.
        """


class Bus(Protocol):
    """An inbox for samples, one for requests, and `publish`."""

    @property
    def sensors(self) -> Inbox:
        """Received samples."""

    @property
    def requests(self) -> Inbox:
        """Received requests."""

    def publish(self, channel: str, data: bytes) -> None:
        """Publish a message."""

    def wait(self, seconds: float, requests: bool = True) -> None:
        """Wait until a message has arrived or the time is up; without `requests` for samples only."""


MIN_SLEEP_S: Final = 20e-6
"""A wait that took longer has found the inboxes empty at first."""


class LcmInbox:
    """An inbox with its own LCM instance."""

    def __init__(self, url: str, queue_bytes: int):
        self._queue_bytes = queue_bytes
        self.lcm, self._filter = open_receiver(url)
        self._channels: list[str] = []
        self._subscriptions: list[lcm.LCMSubscription] = []
        self.fileno = self.lcm.fileno()
        self.expected: int | None = None
        """Messages that `LcmBus.wait` has found: 0, 1 (later ones are found by the next wait), None = unknown."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Call `handler` with every message of exactly `channel`."""
        limit, index = QueueLimit(self._queue_bytes), len(self._subscriptions)

        def handle(name: str, data: bytes) -> None:
            handler(name, data)  # first: a client may wait for its reply
            if limit.update(len(data)):
                self._subscriptions[index].set_queue_capacity(limit.capacity)

        self._channels.append(channel)
        self._filter.pass_only(self._channels)
        subscription = self.lcm.subscribe(to_subscription_pattern(channel), handle)
        # LCM drops silently beyond it; the loop drops and counts long before, unless a flood is faster than that
        subscription.set_queue_capacity(limit.capacity)
        self._subscriptions.append(subscription)

    def close(self) -> None:
        """End all subscriptions, whose handlers keep the instance in memory."""
        for each in self._subscriptions:
            self.lcm.unsubscribe(each)
        self._subscriptions.clear()
        self._filter.close()

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """See `Inbox`."""
        expected, self.expected = self.expected, None
        if expected == 0 or not limit:
            return 0
        if expected == 1:
            # saves a system call while a client waits for its reply
            self.lcm.handle()
            return 1
        end = time.monotonic() + seconds
        for count in range(limit):
            if not handle_message(self.lcm):
                return count
            if time.monotonic() >= end:
                return count + 1
        return limit


class LcmBus:
    """Bus on LCM. Make it after forking, never before: LCM has a thread of its own."""

    def __init__(self, url: str = ""):
        self.url = resolve_url(url)
        self.sensors: LcmInbox = LcmInbox(self.url, SENSOR_QUEUE_BYTES)
        self.requests: LcmInbox = LcmInbox(self.url, REQUEST_QUEUE_BYTES)
        self._poll = select.poll()
        for inbox in (self.sensors, self.requests):
            self._poll.register(inbox.fileno, select.POLLIN)
        self.publish = self.requests.lcm.publish
        self._membership = MulticastMembership(self.url)
        self._renew_at = time.monotonic() + RENEW_S

    def wait(self, seconds: float, requests: bool = True) -> None:
        """Wait until a message has arrived or the time is up; without `requests` for samples only."""
        begin = time.monotonic()
        if begin >= self._renew_at:
            self._renew_at = begin + RENEW_S
            self._membership.renew()
        if not requests:
            readable, _, _ = select.select((self.sensors.fileno,), (), (), max(0.0, seconds))
            self.sensors.expected = None if readable else 0
            return
        # poll is cheaper but counts in milliseconds; select meets the deadline to the microsecond
        milliseconds = int(seconds * 1e3)
        ready = [file for file, _ in self._poll.poll(milliseconds)]
        if not ready:
            files = (self.sensors.fileno, self.requests.fileno)
            ready, _, _ = select.select(files, (), (), max(0.0, seconds - milliseconds * 1e-3))
        some = 1 if time.monotonic() - begin > MIN_SLEEP_S else None
        for inbox in (self.sensors, self.requests):
            inbox.expected = some if inbox.fileno in ready else 0

    def close(self) -> None:
        """Leave the bus: no handler is called any more, and nothing keeps the instances in memory."""
        self._membership.close()
        for inbox in (self.sensors, self.requests):
            inbox.close()
