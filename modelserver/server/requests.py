"""Request handler: receives requests from the bus into per-client queues, and answers them as time permits.

One pass of the server loop gives it a slice of at most a millisecond:

1. Receive. The requests in the receive buffer go into the per-client queues, undecoded. So fairness begins there:
   in a queue shared by all clients a flood would delay everyone. Only the first request of a pass, if none waits, is
   answered before the next one is received: the latency of a single client.
2. Answer queued requests in the order of the scheduler.
3. Work on the deferred reply in progress, one at a time: steps of about half a millisecond, begun only if they end
   before the next tick. Its messages are sent in portions that fit a receive buffer (`DeferredReply`).
4. Reply to some of the requests that were dropped.

Replies that do not depend on time are cached (`StaticReplyCache`), and answered without decoding the request.

The scheduler (`RequestScheduler`, pure) has per-client queues, rate limiters, and the share of time that requests may
take. Each client (the address that sends, or its reply channel where that is not known) has a bounded queue of
requests, a second one for deferred requests (long answers), and two token buckets: requests per second, and bytes of
deferred replies per second.

Priority: requests of clients within their rate come first, round robin over the clients; then those of clients beyond
their rate, round robin as well. The scheduler is work-conserving: work beyond the rates is done while there is time.
Under contention (`set_contended`) it is limited to a share of the time, by a third token bucket (`spend`). A rate is
therefore a guarantee, not a cap on an idle server. Contention is that ticks are late or that samples wait.

One program may have any number of clients, so the totals are bounded too: waiting requests, clients with a queue of
their own, rejections with a reply. Beyond these bounds requests are dropped and counted.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, NamedTuple, Protocol, TypeAlias

from modelserver import core, messages
from modelserver.config.vehicle_file import LimitsConfig
from modelserver.core import CoreState, Instant
from modelserver.errors import Status, WireError, quote
from modelserver.messages import GetDynamics, GetHistory, GetTransformations, Request
from modelserver.named_tuples import new_tuple
from modelserver.query.answers import COVARIANCES_IN_PART, DeferredAnswer, effort_of, is_deferred
from modelserver.query.view import HISTORY_LIMIT, Steps, complete
from modelserver.server.bus import Bus, Handler
from modelserver.server.clock import Clock
from modelserver.server.ingress import CommandVerifier
from modelserver.server.journal import JournalQueue
from modelserver.server.log import RateLimitedLog, escape_text
from modelserver.wire.channels import BY_NAME, REQUESTS, SIGNED
from modelserver.wire.codec import CACHED_TYPE, StaticReplyCache, decode, encode, read_request_header
from modelserver.wire.journal import RecordKind
from modelserver.wire.provider import Sender

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


# --- the request handler ----------------------------------------------------------------------------------------------

log = logging.getLogger(__name__)


PORTION_BYTES: Final = 100_000
"""Bytes of a portion: a receive buffer of the kernel's default size (212,992 bytes) holds it beside other messages."""

MESSAGE_BYTES: Final = 300
POSE_BYTES: Final = 74
COVARIANCE_BYTES: Final = 288
HISTORY_POSE_BYTES: Final = 500
DYNAMICS_BYTES: Final = 90_000
"""Bytes of a message without poses, of a pose, of its covariance, of a pose in a history, and of equations of motion
with as many coordinates as there may be."""


def estimate_reply_bytes(request: Request) -> int:
    """Return an upper bound of the size of the reply to a request, bytes; not valid for an error reply."""
    if isinstance(request, GetTransformations):
        instants = len(request.at)
        each = POSE_BYTES + COVARIANCE_BYTES * request.with_covariance
        messages = -(-instants // COVARIANCES_IN_PART)
        return min(len(request.pairs) * (MESSAGE_BYTES * messages + instants * each), MAX_REPLY_BYTES)
    if isinstance(request, GetHistory):
        poses = (request.end_utime - request.start_utime) * 1e-6 * request.rate_hz + 1.0
        return MESSAGE_BYTES + round(HISTORY_POSE_BYTES * poses) if 0.0 < poses <= HISTORY_LIMIT else MESSAGE_BYTES
    if isinstance(request, GetDynamics):
        return DYNAMICS_BYTES if request.with_equations else 2 * MESSAGE_BYTES
    return MESSAGE_BYTES


class DeferredReply:
    """The reply of a deferred answer: `step` until it is `ready`, then `pop` messages.

    `queued` is the request as received; None in a replay of the journal.
    """

    def __init__(self, answer: DeferredAnswer, queued: QueuedRequest | None = None):
        self.queued = queued
        self.request = answer.request
        self.channel = answer.request.header.reply_channel
        self.ready = False
        self._messages: deque[bytes] = deque()
        self._work = self._encode(answer)

    def step(self) -> None:
        self.ready = next(self._work, self) is self

    def complete(self) -> None:
        """Do the rest of the work."""
        if not self.ready:
            complete(self._work)
            self.ready = True

    @property
    def portion(self) -> int:
        """Number of messages of the next portion; 0 if all are sent."""
        count = size = 0
        for message in self._messages:
            size += len(message)
            if count and size > PORTION_BYTES:
                break
            count += 1
        return count

    def pop(self, count: int) -> list[bytes]:
        """Remove and return the next messages."""
        return [self._messages.popleft() for _ in range(min(count, len(self._messages)))]

    def _encode(self, answer: DeferredAnswer) -> Steps[None]:
        replies = yield from answer.work()
        for reply in replies:
            self._messages.append(encode(reply))
            yield


SLICE_NS: Final = 1_000_000
"""Time of a pass for requests; the last request is finished."""

RECEIVE_BATCH: Final = 16
"""Requests received between two readings of the clock."""

MAX_RECEIVED: Final = 1024
"""Requests received in one pass."""

STEP_ROOM_NS: Final = 1_500_000
"""A step of deferred work begins only this long before the next tick: most steps take less."""

STARVED_NS: Final = 50_000_000
"""Deferred work without a step for so long gets one in any case."""

LATE_TICK_NS: Final = 2_000_000
"""Two later ticks within `CONTENTION_NS` are contention: a single one may be a stall of the whole machine."""

CONTENTION_NS: Final = 500_000_000
"""How long it lasts after the last report."""

REJECTIONS_PER_PASS: Final = 2
REJECTIONS_WAITING: Final = 128

SIGNED_TYPE: Final = BY_NAME[SIGNED].type_name


class RequestContext(Protocol):
    """Services that the request handler gets from the server loop; see there."""

    state: CoreState

    def step(self, event: messages.Event, now: Instant, received: tuple[str, bytes] | None = None) -> None: ...

    def publish(self, channel: str, data: bytes) -> None: ...

    def send(self, outputs: tuple[messages.Output, ...]) -> None: ...

    def handle_error(self, channel: str, error: Exception, data: bytes = b"") -> None: ...

    def execute(self, command: messages.SignedCommand, now: Instant) -> None: ...


class RequestHandler:
    """Serves the request channels of one bus; `serve` makes one pass."""

    def __init__(
        self,
        loop: RequestContext,
        bus: Bus,
        clock: Clock,
        log: RateLimitedLog,
        journal: JournalQueue,
        prefix: str,
        limits: LimitsConfig,
        verifier: CommandVerifier | None = None,
    ):
        self._loop = loop
        self._bus = bus
        self._clock = clock
        self._log = log
        self._journal = journal
        self._prefix = prefix
        self._verifier = verifier
        self._per_pass = limits.requests_per_pass
        self._scheduler = RequestScheduler(limits, clock.monotonic_ns())
        self._cache = StaticReplyCache()
        self._contended_ns = self._late_ns = clock.monotonic_ns()
        self._answered = 0
        self._dropped: dict[str, int] = {}
        self._rejections: deque[QueuedRequest] = deque()
        self._report = ""
        self._current: QueuedRequest | None = None
        self.deferred: DeferredReply | None = None
        """The deferred reply in progress."""
        self._stepped_ns = 0
        self._is_first = self._only_cached = False
        self.is_flooded = False
        """Whether requests were dropped in the last pass."""
        self.is_ready = False
        """Whether there is something that can be done now."""
        for request in REQUESTS:
            bus.requests.subscribe(f"{prefix}{request.name}", self._receiver(request.type_name))
        if verifier is not None:
            bus.requests.subscribe(f"{prefix}{SIGNED}", self._receiver(SIGNED_TYPE))

    @property
    def waiting(self) -> int:
        """Requests that wait for a reply, also for one about being dropped."""
        scheduler = self._scheduler
        return scheduler.queued + scheduler.deferred + (self.deferred is not None) + len(self._rejections)

    def pop_answered(self) -> int:
        """Return how many requests were answered from the cache since the last call."""
        answered, self._answered = self._answered, 0
        return answered

    def serve(self, begin: int, due_ns: int, may_defer: bool = True) -> int:
        """Make one pass from `begin` on; return when it ended, nanoseconds as `due_ns`, when the next tick begins.

        Without `may_defer` no deferred reply is begun.
        """
        scheduler, clock = self._scheduler, self._clock
        scheduler.set_contended(begin < self._contended_ns, begin)
        self._is_first = True
        unread = self._receive(begin + SLICE_NS // 2)
        # the reply to a client that waits for it has been sent here: what follows is less urgent
        now = clock.monotonic_ns() if scheduler.queued else begin
        end = min(begin + SLICE_NS, max(due_ns, begin + SLICE_NS // 4))
        defers = self.deferred is not None or (may_defer and scheduler.deferred > 0)
        # each kind of work gets half if both wait
        until = end - SLICE_NS // 2 if defers else end
        budget = self._per_pass - (not self._is_first)
        while budget > 0 and (request := scheduler.next(now)) is not None:
            budget -= 1
            self._answer(request)
            now = clock.monotonic_ns()
            if now >= until:
                break
        stepped = defers and self._work_deferred(now, end, due_ns, may_defer)
        if self._rejections:
            for _ in range(min(REJECTIONS_PER_PASS, len(self._rejections))):
                self._send_rejection(self._rejections.popleft())
        now = clock.monotonic_ns()
        scheduler.spend((now - begin) * 1e-9, now)
        self.is_flooded = bool(self._dropped)
        self.is_ready = unread or scheduler.is_ready or stepped or bool(self._rejections)
        report = scheduler.report(now)
        if not self._dropped and report is None:
            return now
        if self._dropped:
            self._count_dropped()
        if report is not None and report != self._report:
            self._report = report
            self._loop.step(messages.HealthWarning("requests", report), clock.now())
        return clock.monotonic_ns()

    def report_late_tick(self, now_ns: int) -> None:
        """Process that a tick was more than `LATE_TICK_NS` late."""
        if now_ns < self._late_ns:
            self._contended_ns = now_ns + CONTENTION_NS
        self._late_ns = now_ns + CONTENTION_NS

    def report_backlog(self, now_ns: int) -> None:
        """Process that more samples wait than one pass of the loop handles."""
        self._contended_ns = now_ns + CONTENTION_NS

    def serve_cached(self) -> None:
        """Receive a request that has arrived: answer it from the cache, or queue it."""
        self._only_cached = True
        try:
            self._bus.requests.drain(1)
        finally:
            self._only_cached = False

    def cache(self, output: messages.SendReply, encoded: bytes) -> None:
        """Cache a reply that has just been sent, if it answers the current request and does not depend on time."""
        current = self._current
        if current is not None and current.type_name == CACHED_TYPE and current.reply_channel:
            self._model_cache().add(current.data, current.reply_channel, output.reply, encoded)

    def defer(self, answer: DeferredAnswer) -> None:
        """Begin a deferred answer; one is in progress at a time."""
        self.deferred = DeferredReply(answer, self._current)

    def send_deferred(self, count: int) -> None:
        """Send the next messages of the deferred reply in progress, also in a replay of the journal."""
        deferred = self.deferred
        if deferred is None:
            return
        deferred.complete()
        for message in deferred.pop(count):
            self._loop.publish(deferred.channel, message)
        if not deferred.portion:
            self.drop_deferred()

    def drop_deferred(self) -> None:
        """Abort the deferred reply in progress."""
        self.deferred = None

    def _receive(self, until_ns: int) -> bool:
        """Receive requests into their clients' queues; return whether more may wait in the receive buffer."""
        drain = self._bus.requests.drain
        for _ in range(MAX_RECEIVED // RECEIVE_BATCH):
            if drain(RECEIVE_BATCH) < RECEIVE_BATCH:
                return False
            if self._clock.monotonic_ns() >= until_ns:
                return True
        return True

    def _receiver(self, type_name: str) -> Handler:
        signed = type_name == SIGNED_TYPE
        scheduler, monotonic_ns = self._scheduler, self._clock.monotonic_ns

        def receive(channel: str, data: bytes, sender: Sender) -> None:
            now_ns = monotonic_ns()
            name = SIGNED_CLIENT if signed else client_of(data)
            # anyone may write another client's reply channel
            key = name if signed or sender is None else sender
            client = scheduler.client(key, name, now_ns)
            request = new_tuple(QueuedRequest, (key, name, channel, type_name, data))
            if self._only_cached:
                may_answer = type_name == CACHED_TYPE and scheduler.may_exceed and not scheduler.queued
                if may_answer and self._send_cached(name, channel, data):
                    scheduler.charge(key, 1.0, now_ns)
                    return
            elif self._is_first and scheduler.admit(client, now_ns):
                self._is_first = False
                self._answer(request)
                return
            dropped = scheduler.enqueue(client, request, now_ns)
            if dropped is not None:
                self._drop(dropped)

        return receive

    def _drop(self, request: QueuedRequest) -> None:
        channel = request.channel
        self._dropped[channel] = self._dropped.get(channel, 0) + 1
        if (
            self._scheduler.count_dropped(request.client)
            and request.type_name != SIGNED_TYPE
            and len(self._rejections) < REJECTIONS_WAITING
        ):
            self._rejections.append(request)

    def _send_rejection(self, dropped: QueuedRequest) -> None:
        """Reply to a dropped request that the server is overloaded."""
        try:
            request = decode(dropped.type_name, dropped.data)
        except Exception:
            return  # counted already: as dropped
        now = self._clock.now()
        self._journal.record_message(RecordKind.OVERLOAD, (dropped.channel, dropped.data), now)
        self._loop.send(core.reply_overloaded(self._loop.state, request, now))

    def _count_dropped(self) -> None:
        """Count the dropped requests in the core, together: counting each one costs more than dropping it."""
        dropped, self._dropped = self._dropped, {}
        now = self._clock.now()
        for channel, count in dropped.items():
            self._loop.step(messages.Rejected(channel, "overload", count), now)

    def _work_deferred(self, now_ns: int, end_ns: int, due_ns: int, may_defer: bool) -> bool:
        """Work on the deferred reply, or begin the next one; return whether the work can continue at once."""
        scheduler, monotonic_ns = self._scheduler, self._clock.monotonic_ns
        if self.deferred is None:
            deferred = scheduler.next_deferred(now_ns) if may_defer and scheduler.may_exceed else None
            if deferred is None:
                return False
            self._handle(deferred.queued, deferred.request)
        while self.deferred is not None and scheduler.may_exceed:
            now = monotonic_ns()
            if due_ns - now < STEP_ROOM_NS and now - self._stepped_ns < STARVED_NS:
                return False
            if now >= end_ns and self._stepped_ns >= now_ns:
                return True
            self._stepped_ns = now
            self._step_deferred(self.deferred)
        return self.deferred is None and scheduler.deferred > 0 and may_defer

    def _step_deferred(self, deferred: DeferredReply) -> None:
        """Do one step of the deferred work, or send a portion of its messages."""
        if not deferred.ready:
            try:
                deferred.step()
            except Exception as error:
                self.drop_deferred()
                assert deferred.queued is not None
                self._fail(deferred.queued, deferred.request, error)
                return
        if deferred.ready:
            count = deferred.portion
            # a record of its own, so that a replay of the journal sends the portion at the same place
            part = (deferred.channel, count.to_bytes(4, "big"))
            self._journal.record_message(RecordKind.DEFERRED_PART, part, self._clock.now())
            self.send_deferred(count)

    def _answer(self, queued: QueuedRequest) -> None:
        """Answer a request, also a malformed one or one whose handling fails."""
        _, client, channel, type_name, data = queued
        loop = self._loop
        try:
            if type_name == SIGNED_TYPE:
                self._execute_signed(channel, data)
                return
            if type_name == CACHED_TYPE and client and self._send_cached(client, channel, data):
                return
            request = decode(type_name, data)
        except Exception as error:
            loop.handle_error(channel, error, data)
            header = read_request_header(data) if isinstance(error, WireError) and error.reason == "malformed" else None
            kind = REQUEST_TYPES.get(type_name)
            if header is not None and kind is not None:
                now = self._clock.now()
                self._journal.record_message(RecordKind.MALFORMED, (channel, data), now)
                loop.send(core.reply_error(loop.state, kind, header, Status.MALFORMED, str(error), now))
            return
        effort = effort_of(request)
        if is_deferred(request):
            if not self._scheduler.enqueue_deferred(
                DeferredRequest(queued, request, estimate_reply_bytes(request), effort)
            ):
                self._drop(queued)
            return
        if effort > 1.0:
            self._scheduler.charge(client, effort - 1.0, self._clock.monotonic_ns())
        self._handle(queued, request)

    def _handle(self, queued: QueuedRequest, request: messages.Request) -> None:
        self._current = queued
        try:
            self._loop.step(request, self._clock.now(), (queued.channel, queued.data))
        except Exception as error:
            self._fail(queued, request, error)
        self._current = None

    def _send_cached(self, client: bytes, channel: str, data: bytes) -> bool:
        """Answer a request from the cache; return whether that was possible."""
        now = self._clock.now()
        loop = self._loop
        reply = self._model_cache().find(data, client, now.utime)
        if reply is None:
            return False
        reply_channel = _find_reply_channel(client, loop.state.settings.reply_prefix)
        if not reply_channel:
            return False
        self._journal.record_message(RecordKind.CACHED, (channel, data), now)
        loop.publish(reply_channel, reply)
        self._answered += 1
        return True

    def _model_cache(self) -> StaticReplyCache:
        """Return the cache, emptied after a change of model."""
        model = self._loop.state.view.model
        if not self._cache.is_of(model):
            self._cache.reset(model, sum(1 for body in model.bodies for _ in body))
        return self._cache

    def _fail(self, queued: QueuedRequest, request: messages.Request, error: Exception) -> None:
        loop, now = self._loop, self._clock.now()
        loop.handle_error(queued.channel, error)
        self._journal.record_message(RecordKind.FAILED, (queued.channel, queued.data), now)
        loop.send(core.reply_internal_error(loop.state, request, now))

    def _execute_signed(self, channel: str, data: bytes) -> None:
        """Execute the command in an envelope, or reply with the reason to a sender that knows the key."""
        if self._verifier is None:
            return
        now = self._clock.now()
        result = self._verifier.verify(data, now)
        if isinstance(result, messages.SignedCommand):
            log.info("%s, signed by %s", type(result.command).__name__, escape_text(result.sender))
            try:
                self._loop.execute(result, now)
            except Exception as error:
                self._loop.handle_error(channel, error)
                if not isinstance(result.command, messages.SwitchMode):
                    own = f"{self._prefix}{messages.CHANNEL_OF[type(result.command)]}"
                    self._journal.record_message(RecordKind.FAILED, (own, encode(result.command)), now)
                    self._loop.send(core.reply_internal_error(self._loop.state, result.command, now))
            return
        self._loop.step(result, now)
        self._log.warning(
            f"{channel}:{result.reason}",
            "denied a signed command (%s): %s",
            result.reason,
            result.message or "no detail",
        )


def client_of(data: bytes) -> bytes:
    """Return the reply channel in the bytes of a request; empty if no reply could be sent to it."""
    end = 19 + int.from_bytes(data[16:20], "big")
    # names that begin with a control character are reserved: `SIGNED_CLIENT`
    return data[20:end] if 20 < end <= 83 and end < len(data) and data[20] > 0x20 else b""


@lru_cache(maxsize=1024)
def _find_reply_channel(client: bytes, prefix: str) -> str:
    """Return the reply channel of a client, empty if the server may not reply on it."""
    header = messages.RequestHeader(0, client.decode("utf-8", "replace"))
    return header.reply_channel if core.is_answerable(header, prefix) else ""


REQUEST_TYPES: Mapping[str, type[messages.Request]] = {
    BY_NAME[channel].type_name: kind for kind, channel in messages.CHANNEL_OF.items()
}
"""Request class of each wire type."""
