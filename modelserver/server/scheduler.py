"""Request scheduling: per-client queues, rate limiters, and the share of time that requests may take. Pure.

Each client (the address that sends, or its reply channel where that is not known) has a bounded queue of requests, a
second one for deferred requests (long answers), and two token buckets: requests per second, and bytes of deferred
replies per second.

Priority: requests of clients within their rate come first, round robin over the clients; then those of clients beyond
their rate, round robin as well. The scheduler is work-conserving: work beyond the rates is done while there is time.
Under contention (`set_contended`) it is limited to a share of the time, by a third token bucket (`spend`). A rate is
therefore a guarantee, not a cap on an idle server. Contention is that ticks are late or that samples wait.

One program may have any number of clients, so the totals are bounded too: waiting requests, clients with a queue of
their own, rejections with a reply. Beyond these bounds requests are dropped and counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from modelserver.config.vehicle_file import LimitsConfig
from modelserver.errors import quote
from modelserver.messages import Request

BURST_S: Final = 0.25
"""Burst of a client: what its rate permits in so many seconds."""

RESERVE_S: Final = 0.05
"""Capacity of the bucket of request time, and how far it may be overdrawn, seconds."""

MAX_CLIENTS: Final = 64
"""Clients with a queue of their own."""

CLIENT_IDLE_NS: Final = 10_000_000_000
"""A client that is silent for so long loses its queue to a new client."""

SWEEP_NS: Final = 100_000_000
"""Period of searching for silent clients: a flood of new names must not make it the main work."""

REPORT_NS: Final = 1_000_000_000

MAX_QUEUED_BEYOND_RATE: Final = 16
"""Requests that may wait of a client beyond its rate under contention; further ones are dropped. A client that waits
for each reply has only one: it is answered less often, and none is dropped."""

DEFERRED_PER_CLIENT: Final = 2
DEFERRED_TOTAL: Final = 16
"""Deferred requests that may wait, of one client and of all; further ones are dropped."""

REJECTIONS_PER_CLIENT: Final = 64
REJECTIONS_TOTAL: Final = 256
"""Dropped requests that get a reply within a second, of one client and of all; further ones are only counted."""

MAX_REPLY_BYTES: Final = 800_000
"""Bytes of the largest legal reply, rounded up: it always fits the burst of the byte limiter."""

ClientKey: TypeAlias = Hashable
"""What identifies a client: the address of its socket, or its reply channel."""

SIGNED_CLIENT: Final = b"\0signed"
"""The client of signed envelopes: no reply channel can have this name, so no flood of requests delays commands."""

REPORTED_CLIENTS: Final = 3
"""Clients named by the report: those with most dropped requests."""


class QueuedRequest(NamedTuple):
    """A waiting request: its client, reply channel, channel, wire type and bytes."""

    client: ClientKey
    reply_channel: bytes
    channel: str
    type_name: str
    data: bytes


class DeferredRequest(NamedTuple):
    """A waiting request with a deferred answer.

    reply_bytes: upper bound of the size of its reply. effort: computing effort in units of a typical request.
    """

    queued: QueuedRequest
    request: Request
    reply_bytes: int
    effort: float


@dataclass(slots=True, eq=False)
class ClientQueue:
    """The requests of one client, and its token buckets. name: its last reply channel."""

    name: bytes
    tokens: float
    reply_bytes: float
    seen_ns: int
    charged_ns: int
    bytes_charged_ns: int
    requests: deque[QueuedRequest] = field(default_factory=deque)
    deferred: deque[DeferredRequest] = field(default_factory=deque)
    received: int = 0
    dropped: int = 0
    rejections: int = 0


class RequestScheduler:
    """Queues requests and returns them by priority; `report` names overloading clients once a second.

    Beyond `max_clients`, further clients share one queue.
    """

    def __init__(self, limits: LimitsConfig, now_ns: int, max_clients: int = MAX_CLIENTS):
        self._limits = limits
        self._max_clients = max_clients
        self._burst = max(1.0, limits.client_hz * BURST_S)
        self._tokens_per_ns = limits.client_hz * 1e-9
        self._burst_bytes = max(float(MAX_REPLY_BYTES), limits.client_reply_bytes)
        self._clients: dict[ClientKey, ClientQueue] = {}
        self._others = ClientQueue(b"", self._burst, self._burst_bytes, now_ns, now_ns, now_ns)
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
        """Waiting requests, without the deferred ones."""
        self.deferred = 0
        """Waiting deferred requests."""

    @property
    def may_exceed(self) -> bool:
        """Whether there is time for work beyond the clients' rates."""
        return not self._contended or self._spare_s > 0.0

    @property
    def is_ready(self) -> bool:
        """Whether a waiting request may be answered now."""
        return bool(self._within) or (bool(self._beyond) and self.may_exceed)

    def set_contended(self, contended: bool, now_ns: int) -> None:
        """Begin a slice: set contention, and refill the clients beyond their rate."""
        self._contended = contended
        beyond = self._beyond
        for _ in range(len(beyond)):
            client = beyond.popleft()
            self._refill(client, now_ns)
            self._append(client)

    def client(self, key: ClientKey, name: bytes, now_ns: int) -> ClientQueue:
        """Return the queue of a client that sends a request with reply channel `name`, and count the request."""
        client = self._clients.get(key) or self._add_client(key, name, now_ns)
        if client.name != name and client is not self._others:
            client.name = name
        client.received += 1
        client.seen_ns = now_ns
        return client

    def admit(self, client: ClientQueue, now_ns: int) -> bool:
        """Return whether a new request may be answered without queueing, and charge its client."""
        if self.queued:
            return False
        tokens = self._refill(client, now_ns)
        if tokens >= 1.0:
            client.tokens = tokens - 1.0
        elif self.may_exceed:
            client.tokens = min(tokens, 0.0)
        else:
            return False
        return True

    def enqueue(self, client: ClientQueue, request: QueuedRequest, now_ns: int) -> QueuedRequest | None:
        """Queue a request; return the dropped one if too many wait: the last of the longest queue."""
        requests = client.requests
        count = len(requests)
        if not count:
            self._refill(client, now_ns)
        elif count >= MAX_QUEUED_BEYOND_RATE and count > client.tokens and not self.may_exceed:
            return request
        dropped = None
        if self.queued < self._limits.queued_requests:
            self.queued += 1
        else:
            # the usual case in a flood, without searching the others: a queue of at least the mean length
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
        """Return the next request and charge its client; None if none may be answered now."""
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

    def charge(self, key: ClientKey, effort: float, now_ns: int) -> None:
        """Charge a client for effort beyond that of a typical request.

        Its tokens may become negative, so that its next requests are beyond the rate.
        """
        client = self._find(key)
        self._refill(client, now_ns)
        client.tokens = max(client.tokens - effort, -self._burst)

    def enqueue_deferred(self, deferred: DeferredRequest) -> bool:
        """Queue a deferred request; return whether there was room for it."""
        client = self._find(deferred.queued.client)
        if len(client.deferred) >= DEFERRED_PER_CLIENT or self.deferred >= DEFERRED_TOTAL:
            return False
        if not client.deferred:
            self._deferring.append(client)
        client.deferred.append(deferred)
        self.deferred += 1
        return True

    def next_deferred(self, now_ns: int) -> DeferredRequest | None:
        """Return the next deferred request and charge its client; None if none may begin now."""
        ring = self._deferring
        for _ in range(len(ring)):
            client = ring.popleft()
            deferred = client.deferred[0]
            self._refill(client, now_ns)
            seconds, client.bytes_charged_ns = (now_ns - client.bytes_charged_ns) * 1e-9, now_ns
            refilled = client.reply_bytes + seconds * self._limits.client_reply_bytes
            client.reply_bytes = min(self._burst_bytes, refilled)
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

    def count_dropped(self, key: ClientKey) -> bool:
        """Count a dropped request; return whether its client gets an error reply."""
        client = self._find(key)
        client.dropped += 1
        if client.rejections >= REJECTIONS_PER_CLIENT or self._rejections >= REJECTIONS_TOTAL:
            return False
        client.rejections += 1
        self._rejections += 1
        return True

    def spend(self, seconds: float, now_ns: int) -> None:
        """Account for time spent on requests, against their share of the elapsed time."""
        earned = (now_ns - self._spare_ns) * 1e-9 * self._limits.request_share
        self._spare_ns = now_ns
        self._spare_s = max(-RESERVE_S, min(RESERVE_S, self._spare_s + earned - seconds))

    def report(self, now_ns: int) -> str | None:
        """Describe the clients with dropped requests in the last second, empty without any; None within the second."""
        elapsed = (now_ns - self._report_ns) * 1e-9
        if now_ns - self._report_ns < REPORT_NS:
            return None
        self._report_ns = now_ns
        clients = [*self._clients.values(), self._others]
        worst = sorted((client for client in clients if client.dropped), key=lambda client: -client.dropped)
        texts = [
            f"{self._describe(client)} sends {client.received / elapsed:,.0f}/s; "
            f"{client.dropped / elapsed:,.0f}/s dropped"
            for client in worst[:REPORTED_CLIENTS]
        ]
        if len(worst) > REPORTED_CLIENTS:
            texts.append(f"and {len(worst) - REPORTED_CLIENTS} more")
        for client in clients:
            client.received = client.dropped = client.rejections = 0
        self._rejections = 0
        return "; ".join(texts)

    def _refill(self, client: ClientQueue, now_ns: int) -> float:
        tokens = client.tokens + (now_ns - client.charged_ns) * self._tokens_per_ns
        client.charged_ns = now_ns
        if tokens > self._burst:  # cheaper than min()
            tokens = self._burst
        client.tokens = tokens
        return tokens

    def _append(self, client: ClientQueue) -> None:
        (self._within if client.tokens >= 1.0 else self._beyond).append(client)

    def _find(self, key: ClientKey) -> ClientQueue:
        return self._clients.get(key) or self._others

    def _add_client(self, key: ClientKey, name: bytes, now_ns: int) -> ClientQueue:
        if len(self._clients) >= self._max_clients:
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
        client = self._clients[key] = ClientQueue(name, self._burst, self._burst_bytes, now_ns, now_ns, now_ns)
        return client

    def _describe(self, client: ClientQueue) -> str:
        if client is self._others:
            return f"all beyond the first {self._max_clients} clients together"
        if client.name == SIGNED_CLIENT:
            return "the channel of signed commands"
        if not client.name:
            return "clients without reply channel"
        name = client.name.decode("utf-8", "replace")
        return f"client {name if name.isidentifier() else quote(name, 40)}"
