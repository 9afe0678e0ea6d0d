"""The bus: that of LCM (`LcmBus`), and one within a process (`FakeBus`).

A bus has an inbox for samples, one for requests, `publish` and `wait`. Handlers run only while an inbox is drained.

- Samples and requests have a receiver each (`wire.provider`), so that a flood of requests cannot delay samples in a
  shared queue.
- Multicast membership survives a network interface that goes down and up again. LCM joins the group once; the kernel
  drops the membership with the interface. It delivers a group's packets to every socket bound to their port as long as
  any socket of the machine is a member (IP_MULTICAST_ALL, ip(7)), so `MulticastMembership` joins again on a socket of
  its own.
- `FakeBus` is for replays and tests: it delivers at once, in order, without loss.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Literal, TypeAlias

from modelserver.server.clock import FakeClock
from modelserver.wire import provider

log = logging.getLogger(__name__)

RENEW_S: Final = 1.0
"""Period of renewing the membership: one system call."""


class MulticastMembership:
    """Membership in the multicast group of an LCM URL; without effect for other providers."""

    def __init__(self, url: str):
        self._request = b""
        address = provider.parse_udp_address(url)
        if address is not None and address.group in url:
            # the interface is that of the group's route, as for LCM
            with contextlib.suppress(OSError):  # no address: LCM reports it
                self._request = socket.inet_aton(address.group) + socket.inet_aton("0.0.0.0")
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
        if self._socket is not None:
            self._socket.close()
            self._socket = None


SENSOR_QUEUE_BYTES: Final = 4 << 20
"""Bytes that wait on a channel at most: 20,000 samples of wheels. Requests wait in the receive buffer, or in liblcm."""

MAX_SAMPLE_BYTES: Final = 1 << 20
MAX_REQUEST_BYTES: Final = 4 << 20
"""Longest messages that are received: a message of 15 MB would cost several ticks before it is rejected."""

Handler: TypeAlias = Callable[[str, bytes, provider.Sender], None]
"""Channel, data, and who has sent it."""

Inboxes: TypeAlias = Literal["samples", "requests", "both"]


MAX_READ_AHEAD: Final = 1000
"""Messages that a drain queues at most; some two milliseconds."""

MIN_SLEEP_S: Final = 20e-6
"""A wait that took longer has found the inboxes empty at first."""


class ReceiverInbox:
    """An inbox with a receiver of its own.

    Messages that a `drain` leaves wait in a queue of `queue_bytes` per channel: the socket's receive buffer is often
    short, and all channels share it. Beyond these bytes they are dropped. 0: they wait in the receive buffer.
    """

    def __init__(self, receiver: provider.Receiver, queue_bytes: int = 0):
        self._receiver = receiver
        self._queue_bytes = queue_bytes
        self._handlers: dict[bytes, tuple[str, list[Handler]]] = {}
        self._queue: deque[provider.Message] = deque()
        self._queued_bytes: dict[bytes, int] = {}
        self.fileno = receiver.fileno
        self.expected: int | None = None
        """Messages that `LcmBus.wait` has found: 0, 1 (later ones are found by the next wait), None = unknown."""

    @property
    def is_queueing(self) -> bool:
        return bool(self._queue)

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Call `handler` with every message of exactly `channel`."""
        known = self._handlers.get(channel.encode())
        if known is not None:
            known[1].append(handler)
            return
        self._handlers[channel.encode()] = (channel, [handler])
        self._receiver.subscribe(channel)

    def close(self) -> None:
        """Leave the bus: no handler is called any more."""
        self._handlers.clear()
        self._queue.clear()
        self.expected = 0
        self._receiver.close()

    def pop_refused(self) -> dict[str, int]:
        """Return how many messages were too long since the last call, by channel."""
        refused = self._receiver.refused
        if not refused:
            return {}
        found = {channel.decode("utf-8", "replace"): count for channel, count in refused.items()}
        refused.clear()
        return found

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Handle the messages that have arrived, at most `limit` and for at most `seconds`, without waiting.

        Returns the number of handled messages. One that is in progress when the time is up is the last.
        """
        expected, self.expected = self.expected, None
        if expected == 0 or not limit or not self._handlers:
            return 0
        if expected == 1:
            # saves a system call while a client waits for its reply
            return self._handle(self._receiver.receive())
        end = time.monotonic() + seconds
        for count in range(limit):
            if not self._handle(self._pop() if self._queue else self._receiver.receive()):
                return count
            if time.monotonic() >= end:
                limit = count + 1
                break
        self._read_ahead()
        return limit

    def _handle(self, message: provider.Message | None) -> int:
        if message is None:
            return 0
        known = self._handlers.get(message[0])
        if known is not None:
            channel, handlers = known
            for handler in handlers:
                handler(channel, message[1], message[2])
        return 1

    def _pop(self) -> provider.Message:
        message = self._queue.popleft()
        self._queued_bytes[message[0]] -= len(message[1]) + provider.MESSAGE_OVERHEAD_BYTES
        return message

    def _read_ahead(self) -> None:
        """Move messages from the receive buffer into the queue."""
        for _ in range(MAX_READ_AHEAD if self._queue_bytes else 0):
            message = self._receiver.receive()
            if message is None:
                return
            size = self._queued_bytes.get(message[0], 0) + len(message[1]) + provider.MESSAGE_OVERHEAD_BYTES
            if size <= self._queue_bytes:
                self._queued_bytes[message[0]] = size
                self._queue.append(message)


class LcmBus:
    """Bus on LCM. Make it after forking, never before: liblcm may have a thread of its own."""

    def __init__(self, url: str = ""):
        self.url = provider.resolve_url(url)
        self.publish = provider.open_lcm(self.url).publish
        self.sensors = ReceiverInbox(provider.open_receiver(self.url, MAX_SAMPLE_BYTES), SENSOR_QUEUE_BYTES)
        self.requests = ReceiverInbox(provider.open_receiver(self.url, MAX_REQUEST_BYTES))
        self._poll = select.poll()
        for inbox in (self.sensors, self.requests):
            self._poll.register(inbox.fileno, select.POLLIN)
        self._membership = MulticastMembership(self.url)
        self._renew_at = time.monotonic() + RENEW_S

    def wait(self, seconds: float, inboxes: Inboxes = "both") -> None:
        """Wait until a message has arrived in an inbox, or the time is up."""
        begin = time.monotonic()
        if begin >= self._renew_at:
            self._renew_at = begin + RENEW_S
            self._membership.renew()
        if inboxes != "both":
            inbox = self.sensors if inboxes == "samples" else self.requests
            readable = inbox.is_queueing or select.select((inbox.fileno,), (), (), max(0.0, seconds))[0]
            inbox.expected = None if readable else 0
            return
        if self.sensors.is_queueing:
            self.sensors.expected = self.requests.expected = None
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


class FakeInbox:
    """One queue of a `FakeBus`."""

    def __init__(self, clock: FakeClock) -> None:
        self._clock = clock
        self._handlers: dict[str, list[Handler]] = {}
        self._queue: deque[tuple[str, bytes, provider.Sender]] = deque()

    def subscribe(self, channel: str, handler: Handler) -> None:
        self._handlers.setdefault(channel, []).append(handler)

    def put(self, channel: str, data: bytes, sender: provider.Sender = None) -> None:
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


Inbox: TypeAlias = ReceiverInbox | FakeInbox
Bus: TypeAlias = LcmBus | FakeBus
