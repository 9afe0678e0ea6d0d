"""The reception: takes requests from the bus, has them wait or refuses them, and answers as far as there is time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from modelserver import core
from modelserver.core import CoreState, Instant
from modelserver.errors import WireError
from modelserver.messages import (
    CHANNEL_OF,
    Commanded,
    Event,
    GetHistory,
    GetTransformations,
    Noticed,
    Output,
    Rejected,
    Request,
    SendReply,
    SwitchMode,
)
from modelserver.service.bus import Bus
from modelserver.service.clock import Clock
from modelserver.service.log import RateLimited, plain
from modelserver.service.requests.desk import SIGNED_CLIENT, Desk, DeskLimits, Lane, Waiting
from modelserver.service.requests.gate import Gate
from modelserver.wire.channels import BY_NAME, REQUESTS
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import Kind
from modelserver.wire.requests import request_header
from modelserver.wire.signed import SIGNED
from modelserver.wire.timeless import TIMELESS_TYPE, TimelessReplies

log = logging.getLogger(__name__)

PAIR: Final = 4
INSTANTS_FOR_ONE: Final = 25
POSES_OF_HISTORY: Final = 8
"""What a question for many instants takes of a pass's budget of requests: so many for each pair, and one for each so
many instants of it; and what one for a stretch of history takes."""

PASS_NS: Final = 1_000_000
"""How long a pass takes requests in and answers them before it looks at sensors again; the last one is finished."""

AT_ONCE: Final = 8
"""Requests taken from the bus between two looks at the clock."""

SIGNED_TYPE: Final = BY_NAME[SIGNED].type_name


class House(Protocol):
    """What the reception needs of the loop."""

    state: CoreState

    def step(self, event: Event, now: Instant, heard: tuple[str, bytes] | None = None) -> None:
        """Have the core handle an event, and send what follows; `heard` is the message that it was read from."""
        ...

    def note(self, kind: Kind, channel: str, data: bytes, now: Instant) -> None:
        """Have the journal note a message with which something else is done."""
        ...

    def publish(self, channel: str, data: bytes) -> None:
        """Send a message to everyone."""
        ...

    def send(self, outputs: tuple[Output, ...]) -> None:
        """Send what the core says."""
        ...

    def failed(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Count and log what went wrong with a message."""
        ...

    def obey(self, command: Commanded, now: Instant) -> None:
        """Have a signed command obeyed."""
        ...


class Reception:
    """Serves the request channels of one bus; `serve` makes one pass."""

    def __init__(
        self,
        house: House,
        bus: Bus,
        clock: Clock,
        log: RateLimited,
        prefix: str,
        limits: DeskLimits,
        per_pass: int,
        gate: Gate | None = None,
    ):
        self._house = house
        self._bus = bus
        self._clock = clock
        self._log = log
        self._prefix = prefix
        self._gate = gate
        self._per_pass = per_pass
        self._queued = limits.queued
        self._desk = Desk(limits, clock.monotonic_ns())
        self._budget = 0
        self._until_ns = 0
        self._refused: dict[tuple[str, str], int] = {}
        self._timeless = TimelessReplies()
        self._answered = 0
        self._asked = b""  # the request that the core is answering
        self._said = ""
        self._held = False  # those that wait have asked for too much
        self.pressing = False
        """Whether requests wait that may be answered at once."""
        self.flooded = False
        """Whether in the last pass more was asked than may be."""
        for request in REQUESTS:
            bus.requests.subscribe(f"{prefix}{request.name}", self._handler(request.type_name))
        if gate is not None:
            bus.requests.subscribe(f"{prefix}{SIGNED}", self._handler(SIGNED_TYPE))

    @property
    def waiting(self) -> int:
        """Requests that wait to be answered."""
        return self._desk.waiting

    def taken_answered(self) -> int:
        """Return how many requests were answered from what is remembered since this was last asked."""
        answered, self._answered = self._answered, 0
        return answered

    def serve(self, due_ns: int) -> None:
        """Make one pass: answer who waits, then take in what has come, until the time is up or the tick is due."""
        desk, clock = self._desk, self._clock
        begin = clock.monotonic_ns()
        self._until_ns = min(begin + PASS_NS, max(due_ns, begin + PASS_NS // 4))
        self._budget = self._per_pass
        self._held = False
        now = begin
        while desk.waiting and self._budget > 0:
            item = desk.next(now)
            if item is None:
                self._held = True
                break
            self._budget -= 1
            self._answer(*item)
            now = clock.monotonic_ns()
            if now >= self._until_ns:
                break
        left = self._queued
        drain = self._bus.requests.drain
        while left > 0 and now < self._until_ns:
            count = min(AT_ONCE, left)
            left -= count
            if drain(count) < count:
                break
            now = clock.monotonic_ns()
        end = clock.monotonic_ns()
        desk.spent((end - begin) * 1e-9, end)
        self.pressing = desk.waiting > 0 and not self._held
        self.flooded = bool(self._refused) or self._held
        if self._refused:
            self._tell_refusals()
        said = desk.report(end)
        if said is not None and said != self._said:
            self._said = said
            self._house.step(Noticed("requests", said), clock.now())

    def learn(self, output: SendReply, encoded: bytes) -> None:
        """Remember a reply that has just been sent, where it answers the request at hand and holds for good."""
        if self._asked:
            self._timeless.learn(self._asked, output, encoded, self._house.state.model)

    def _handler(self, type_name: str) -> Callable[[str, bytes], None]:
        signed = type_name == SIGNED_TYPE
        desk, monotonic_ns = self._desk, self._clock.monotonic_ns

        def handle(channel: str, data: bytes) -> None:
            now_ns = monotonic_ns()
            lane = desk.lane(SIGNED_CLIENT if signed else client_of(data), now_ns)
            free = self._budget > 0 and now_ns < self._until_ns and (self._held or not desk.waiting)
            if free and not lane.queue and desk.grants(lane, now_ns):
                self._budget -= 1
                self._answer(channel, type_name, data)
                return
            refused = desk.queue(lane, Waiting(channel, type_name, data))
            if refused is not None:
                self._refuse(*refused)

        return handle

    def _refuse(self, lane: Lane, item: Waiting) -> None:
        channel, type_name, data = item
        key = (channel, "load")
        self._refused[key] = self._refused.get(key, 0) + 1
        if self._desk.refuse(lane) and type_name != SIGNED_TYPE:
            try:
                request = decode(type_name, data)
            except Exception:
                return  # counted already: as refused
            now = self._clock.now()
            self._house.note(Kind.REFUSED, channel, data, now)
            self._house.send(core.refuse(self._house.state, request, now))

    def _tell_refusals(self) -> None:
        """Have the core count what was refused: together, for counting one by one would be more work than refusing."""
        refused, self._refused = self._refused, {}
        now = self._clock.now()
        for (channel, reason), count in refused.items():
            self._house.step(Rejected(channel, reason, count), now)

    def _answer(self, channel: str, type_name: str, data: bytes) -> None:
        """Answer a request, also one that makes no sense or that an error keeps from being answered."""
        house = self._house
        try:
            if type_name == SIGNED_TYPE:
                self._open(channel, data)
                return
            if type_name == TIMELESS_TYPE:
                now = self._clock.now()
                remembered = self._timeless.find(data, now.utime, house.state.view.model)
                if remembered is not None:
                    house.note(Kind.REMEMBERED, channel, data, now)
                    house.publish(*remembered)
                    self._answered += 1
                    return
            request = decode(type_name, data)
        except Exception as error:
            house.failed(channel, error, data)
            header = request_header(data) if isinstance(error, WireError) and error.reason == "malformed" else None
            kind = request_kind(type_name)
            if header is not None and kind is not None:
                now = self._clock.now()
                house.note(Kind.MALFORMED, channel, data, now)
                house.send(core.turn_back(house.state, kind, header, str(error), now))
            return
        self._asked = data
        # one that asks for much leaves less of the pass for others: the next tick must not wait for them all
        self._budget = max(0, self._budget - effort(request))
        now = self._clock.now()
        try:
            house.step(request, now, (channel, data))
        except Exception as error:
            house.failed(channel, error)
            house.note(Kind.FAILED, channel, data, now)
            house.send(core.fail(house.state, request, now))
        self._asked = b""

    def _open(self, channel: str, data: bytes) -> None:
        """Have what an envelope orders done, or say why not to who has proved to know the key."""
        if self._gate is None:
            return
        now = self._clock.now()
        found = self._gate.opened(data, now)
        if isinstance(found, Commanded):
            # each one, however many: whoever signs is no stranger
            log.info("%s, signed by %s", type(found.order).__name__, plain(found.sender))
            try:
                self._house.obey(found, now)
            except Exception as error:
                self._house.failed(channel, error)
                if not isinstance(found.order, SwitchMode):
                    own = f"{self._prefix}{CHANNEL_OF[type(found.order)]}"
                    self._house.note(Kind.FAILED, own, encode(found.order), now)
                    self._house.send(core.fail(self._house.state, found.order, now))
            return
        self._house.step(found, now)
        self._log.warning(
            f"{channel}:{found.reason}", "a signed command is refused (%s): %s", found.reason, found.why or "not told"
        )


def client_of(data: bytes) -> bytes:
    """Return the reply channel in the bytes of a request, empty where there is none that could be answered on."""
    end = 19 + int.from_bytes(data[16:20], "big")
    # a name that begins with what cannot stand in one is no client's: `SIGNED_CLIENT` is the desk's own
    return data[20:end] if 20 < end <= 83 and end < len(data) and data[20] > 0x20 else b""


def effort(request: Request) -> int:
    """Return how many usual requests' time one takes beyond its own."""
    if isinstance(request, GetTransformations):
        return len(request.pairs) * (PAIR + len(request.at) // INSTANTS_FOR_ONE)
    if isinstance(request, GetHistory):
        return POSES_OF_HISTORY
    return 0


def request_kind(type_name: str) -> type[Request] | None:
    """Return the request that a wire type carries."""
    return _REQUEST_KINDS.get(type_name)


_REQUEST_KINDS: Mapping[str, type[Request]] = {BY_NAME[channel].type_name: kind for kind, channel in CHANNEL_OF.items()}
