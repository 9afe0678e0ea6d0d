"""Request handler: receives requests from the bus into per-client queues, and answers them as time permits.

One pass of the server loop gives it a slice of at most a millisecond:

1. Receive. The requests in the receive buffer go into the per-client queues, undecoded. So fairness begins there:
   in a queue shared by all clients a flood would delay everyone. Only the first request of a pass, if none waits, is
   answered before the next one is received: the latency of a single client.
2. Answer queued requests in the order of the scheduler (`scheduler`).
3. Work on the deferred reply in progress, one at a time: steps of about half a millisecond, begun only if they end
   before the next tick. Its messages are sent in portions that fit a receive buffer (`DeferredReply`).
4. Reply to some of the requests that were dropped.

Replies that do not depend on time are cached (`StaticReplyCache`), and answered without decoding the request.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, Protocol

from modelserver import core, messages
from modelserver.config.vehicle_file import LimitsConfig
from modelserver.core import CoreState, Instant
from modelserver.errors import Status, WireError
from modelserver.messages import GetDynamics, GetHistory, GetTransformations, Request
from modelserver.named_tuples import new_tuple
from modelserver.query.answers import COVARIANCES_IN_PART, DeferredAnswer, effort_of, is_deferred
from modelserver.query.view import HISTORY_LIMIT, Steps, complete
from modelserver.server.bus import Bus, Handler
from modelserver.server.clock import Clock
from modelserver.server.ingress import CommandVerifier
from modelserver.server.journal import JournalQueue
from modelserver.server.log import RateLimitedLog, escape_text
from modelserver.server.scheduler import (
    MAX_REPLY_BYTES,
    SIGNED_CLIENT,
    DeferredRequest,
    QueuedRequest,
    RequestScheduler,
)
from modelserver.wire.channels import BY_NAME, REQUESTS, SIGNED
from modelserver.wire.codec import CACHED_TYPE, StaticReplyCache, decode, encode, read_request_header
from modelserver.wire.journal import RecordKind
from modelserver.wire.receiver import Sender

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
