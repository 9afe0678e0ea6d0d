"""Request scheduling: per-client queues, rate limiters, and the share of time that requests may take. Pure.

Each client (reply channel) has a bounded queue of requests, a second one for deferred requests (those whose answer
takes long), and two token buckets: requests per second, and bytes of deferred replies per second.

Priority: requests of clients within their rate come first, round robin over the clients; then those of clients beyond
their rate, round robin as well. The scheduler is work-conserving: work beyond the rates is done whenever there is time.
Only while something else needs the time (`set_contended`, see `contention`) is it confined to a share of the time, kept
by a third token bucket (`spend`). A rate is therefore guaranteed, never a cap on an idle service.

A stranger may be any number of clients, so everything is bounded for all of them together: the requests that wait, the
clients with a queue of their own, the rejections that get a reply. Beyond the bounds requests are dropped and counted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from modelserver.errors import shown
from modelserver.messages import Request

BURST_S: Final = 0.25
"""A client may send at once what its rate grants in so many seconds."""

RESERVE_S: Final = 0.05
"""How much of its share of time the request work saves up while idle, and how much it may overdraw, seconds."""

CLIENT_IDLE_NS: Final = 10_000_000_000
"""A client that has been silent for so long gives up its queue to another client."""

SWEEP_NS: Final = 100_000_000
"""Between two searches for silent clients: strangers with ever new names must not make it the main work."""

REPORT_NS: Final = 1_000_000_000

QUEUE_BEYOND: Final = 16
"""Requests that may wait of a client beyond its rate while there is no time for them; further ones are dropped. A
client that waits for each reply has one: it is answered less often, and nothing of it is dropped."""

DEFERRED_PER_CLIENT: Final = 2
DEFERRED_TOTAL: Final = 16
"""Deferred requests that may wait, of one client and of all; further ones are dropped."""

REJECTIONS_PER_CLIENT: Final = 64
REJECTIONS_TOTAL: Final = 256
"""Dropped requests that get a reply within a second, of one client and of all; further ones are only counted."""

LARGEST_REPLY: Final = 800_000
"""Bytes of the largest legal reply, rounded up: it always fits the burst of the byte limiter."""

SIGNED_CLIENT: Final = b"\0signed"
"""The client of envelopes: no reply channel can be called so, and no flood of questions keeps commands waiting."""

REPORTED_CLIENTS: Final = 3
"""Clients that the report names: those that send the most."""


class QueuedRequest(NamedTuple):
    """A request that waits: its client, its channel, wire type and bytes."""

    client: bytes
    channel: str
    type_name: str
    data: bytes


class DeferredRequest(NamedTuple):
    """A request that waits for its answer to be worked out in steps.

    reply_bytes: upper bound of the size of its reply. effort: its work in units of a usual request.
    """

    queued: QueuedRequest
    request: Request
    reply_bytes: int
    effort: float


@dataclass(frozen=True, slots=True)
class RequestLimits:
    """Bounds of the request work; see `modelserver.config.LimitsConfig`.

    queued: requests that wait. client_hz: requests per second and client that are guaranteed. share: of the time, for
    work beyond the rates while something else needs the time. client_reply_bytes: of deferred replies per second and
    client. clients: with a queue of their own; further ones share one.
    """

    queued: int = 256
    client_hz: float = 500.0
    share: float = 0.25
    client_reply_bytes: float = 5e6
    clients: int = 64


class ClientQueue:
    """The requests of one client, and its token buckets."""

    __slots__ = (
        "charged_ns",
        "deferred",
        "name",
        "received",
        "rejected",
        "rejections",
        "reply_bytes",
        "requests",
        "seen_ns",
        "tokens",
    )

    def __init__(self, name: bytes, tokens: float, reply_bytes: float, now_ns: int):
        self.name = name
        self.requests: deque[QueuedRequest] = deque()
        self.deferred: deque[DeferredRequest] = deque()
        self.tokens = tokens
        self.reply_bytes = reply_bytes
        self.seen_ns = self.charged_ns = now_ns
        self.received = self.rejected = self.rejections = 0


class RequestScheduler:
    """Queues requests and hands them out by priority; `report` says once a second who sends too much."""

    def __init__(self, limits: RequestLimits, now_ns: int):
        self._limits = limits
        self._burst = max(1.0, limits.client_hz * BURST_S)
        self._burst_bytes = max(float(LARGEST_REPLY), limits.client_reply_bytes)
        self._clients: dict[bytes, ClientQueue] = {}
        self._others = ClientQueue(b"", self._burst, self._burst_bytes, now_ns)
        self._within: deque[ClientQueue] = deque()
        self._beyond: deque[ClientQueue] = deque()
        self._deferring: deque[ClientQueue] = deque()
        self._contended = False
        self._spare_s = RESERVE_S
        self._spare_ns = now_ns
        self._sweep_ns = now_ns
        self._report_ns = now_ns
        self._rejections = 0
        self.queued = 0
        """Requests that wait, without the deferred ones."""
        self.deferred = 0
        """Deferred requests that wait."""

    @property
    def may_exceed(self) -> bool:
        """Whether there is time for work beyond the clients' rates."""
        return not self._contended or self._spare_s > 0.0

    @property
    def is_ready(self) -> bool:
        """Whether a request waits that may be answered now."""
        return bool(self._within) or (bool(self._beyond) and self.may_exceed)

    def set_contended(self, contended: bool, now_ns: int) -> None:
        """Begin a slice: state whether something else needs the time, and find the clients whose tokens have come."""
        self._contended = contended
        beyond = self._beyond
        for _ in range(len(beyond)):
            client = beyond.popleft()
            self._refill(client, now_ns)
            self._append(client)

    def client(self, name: bytes, now_ns: int) -> ClientQueue:
        """Return the queue of a client that sends a request, and count the request."""
        client = self._clients.get(name) or self._add_client(name, now_ns)
        client.received += 1
        client.seen_ns = now_ns
        return client

    def admit(self, client: ClientQueue, now_ns: int) -> bool:
        """Return whether a request that has just come may be answered without queueing, and charge its client."""
        if self.queued:
            return False
        self._refill(client, now_ns)
        if client.tokens < 1.0 and not self.may_exceed:
            return False
        client.tokens = max(min(client.tokens, 0.0), client.tokens - 1.0)
        return True

    def enqueue(self, client: ClientQueue, request: QueuedRequest, now_ns: int) -> QueuedRequest | None:
        """Queue a request; return the one that is dropped for it where too many wait: of the longest queue."""
        requests = client.requests
        count = len(requests)
        if not count:
            self._refill(client, now_ns)
        elif count >= QUEUE_BEYOND and count > client.tokens and not self.may_exceed:
            return request
        if self.queued < self._limits.queued:
            self.queued += 1
            requests.append(request)
            if not count:
                self._append(client)
            return None
        # the usual case in a flood, without a look at the others: a queue of at least the average length
        if count * (len(self._within) + len(self._beyond)) >= self.queued:
            return request
        longest = max((*self._within, *self._beyond), key=lambda each: len(each.requests))
        if len(longest.requests) <= count + 1:
            return request
        dropped = longest.requests.pop()
        requests.append(request)
        if not count:
            self._append(client)
        return dropped

    def next(self, now_ns: int) -> QueuedRequest | None:
        """Return the request to answer next and charge its client; None where none may be answered now."""
        if self._within:
            client = self._within.popleft()
        elif self._beyond and self.may_exceed:
            client = self._beyond.popleft()
        else:
            return None
        request = client.requests.popleft()
        self.queued -= 1
        self._refill(client, now_ns)
        client.tokens = max(min(client.tokens, 0.0), client.tokens - 1.0)
        if client.requests:
            self._append(client)
        return request

    def charge(self, name: bytes, effort: float, now_ns: int) -> None:
        """Charge a client for work beyond that of a usual request.

        It may leave a debt, so that what follows is beyond the rate for as long as usual requests would have been.
        """
        client = self._find(name)
        self._refill(client, now_ns)
        client.tokens = max(client.tokens - effort, -self._burst)

    def enqueue_deferred(self, deferred: DeferredRequest) -> bool:
        """Queue a request whose answer takes long; return whether there was room for it."""
        client = self._find(deferred.queued.client)
        if len(client.deferred) >= DEFERRED_PER_CLIENT or self.deferred >= DEFERRED_TOTAL:
            return False
        if not client.deferred:
            self._deferring.append(client)
        client.deferred.append(deferred)
        self.deferred += 1
        return True

    def next_deferred(self, now_ns: int) -> DeferredRequest | None:
        """Return the deferred request to begin with, its cost charged to its client; None where none may begin now."""
        ring = self._deferring
        for _ in range(len(ring)):
            client = ring.popleft()
            deferred = client.deferred[0]
            self._refill(client, now_ns)
            if client.reply_bytes < min(deferred.reply_bytes, self._burst_bytes):
                ring.append(client)
                continue
            del client.deferred[0]
            self.deferred -= 1
            client.reply_bytes -= deferred.reply_bytes
            client.tokens = max(client.tokens - deferred.effort, -self._burst)
            if client.deferred:
                ring.append(client)
            return deferred
        return None

    def reject(self, name: bytes) -> bool:
        """Count a request that is dropped; return whether its client gets a reply that says so."""
        client = self._find(name)
        client.rejected += 1
        if client.rejections >= REJECTIONS_PER_CLIENT or self._rejections >= REJECTIONS_TOTAL:
            return False
        client.rejections += 1
        self._rejections += 1
        return True

    def spend(self, seconds: float, now_ns: int) -> None:
        """Account for time that went into requests, against the share of the time that has passed."""
        earned = (now_ns - self._spare_ns) * 1e-9 * self._limits.share
        self._spare_ns = now_ns
        self._spare_s = max(-RESERVE_S, min(RESERVE_S, self._spare_s + earned - seconds))

    def report(self, now_ns: int) -> str | None:
        """Return who sent too much in the last second, empty for nobody; None before the second is over."""
        elapsed = (now_ns - self._report_ns) * 1e-9
        if now_ns - self._report_ns < REPORT_NS:
            return None
        self._report_ns = now_ns
        clients = [*self._clients.values(), self._others]
        worst = sorted((client for client in clients if client.rejected), key=lambda client: -client.rejected)
        texts = [
            f"{self._describe(client)} asks {client.received / elapsed:,.0f}/s; "
            f"{client.rejected / elapsed:,.0f}/s refused"
            for client in worst[:REPORTED_CLIENTS]
        ]
        if len(worst) > REPORTED_CLIENTS:
            texts.append(f"and {len(worst) - REPORTED_CLIENTS} more")
        for client in clients:
            client.received = client.rejected = client.rejections = 0
        self._rejections = 0
        return "; ".join(texts)

    def _refill(self, client: ClientQueue, now_ns: int) -> None:
        seconds = (now_ns - client.charged_ns) * 1e-9
        client.charged_ns = now_ns
        client.tokens = min(self._burst, client.tokens + seconds * self._limits.client_hz)
        client.reply_bytes = min(self._burst_bytes, client.reply_bytes + seconds * self._limits.client_reply_bytes)

    def _append(self, client: ClientQueue) -> None:
        (self._within if client.tokens >= 1.0 else self._beyond).append(client)

    def _find(self, name: bytes) -> ClientQueue:
        return self._clients.get(name) or self._others

    def _add_client(self, name: bytes, now_ns: int) -> ClientQueue:
        if len(self._clients) >= self._limits.clients:
            if now_ns < self._sweep_ns:
                return self._others
            self._sweep_ns = now_ns + SWEEP_NS
            silent = [
                each
                for each, client in self._clients.items()
                if not (client.requests or client.deferred) and now_ns - client.seen_ns > CLIENT_IDLE_NS
            ]
            for each in silent:
                del self._clients[each]
            if not silent:
                return self._others
        client = self._clients[name] = ClientQueue(name, self._burst, self._burst_bytes, now_ns)
        return client

    def _describe(self, client: ClientQueue) -> str:
        if client is self._others:
            return f"all beyond the first {self._limits.clients} clients together"
        if client.name == SIGNED_CLIENT:
            return "the channel of signed commands"
        if not client.name:
            return "whoever names no reply channel"
        name = client.name.decode("utf-8", "replace")
        return f"client {name if name.isidentifier() else shown(name, 40)}"
