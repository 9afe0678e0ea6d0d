"""Who is served next: requests by client, in turns, and what is refused where there are too many. No clock, no bus.

A client is whoever names a reply channel, so a stranger may be any number of clients. Everything is bounded for all of
them together: the requests that wait, the clients that are told apart, the refusals that are answered.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from modelserver.errors import shown

BURST_S: Final = 0.25
"""A client may ask at once for what it is sure of in so many seconds."""

RESERVE_S: Final = 0.05
"""How much time for requests is saved up while nobody asks, and how much may be overdrawn, seconds."""

IDLE_NS: Final = 10_000_000_000
"""A client that has not asked for so long gives up its place to another."""

SWEEP_NS: Final = 100_000_000
"""Between two looks for clients that have gone: strangers with ever new names must not make it the main work."""

REPORT_NS: Final = 1_000_000_000

HELD: Final = 16
"""Requests that wait of a client that has asked for too much; further ones are refused. Who waits for each reply before
it asks again has one: it is answered less often, and not refused."""

REFUSALS_TOLD: Final = 64
"""Refusals that are answered, for each client in each second; further ones are only counted."""

SIGNED_CLIENT: Final = b"\0signed"
"""The lane of envelopes: no reply channel can be called so, and no flood of questions keeps commands waiting."""

NAMED: Final = 3
"""Clients that are named to who watches: those that ask the most."""


class Waiting(NamedTuple):
    """A request that waits: its channel, wire type and bytes."""

    channel: str
    type_name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class DeskLimits:
    """See `modelserver.config.LimitsConfig`; clients: how many are told apart, the rest count as one."""

    queued: int = 256
    client_hz: float = 500.0
    share: float = 0.25
    clients: int = 64


class Lane:
    """One client's requests, and its account."""

    __slots__ = ("allowance", "asked", "charged_ns", "name", "queue", "refused", "seen_ns", "told")

    def __init__(self, name: bytes, allowance: float, now_ns: int):
        self.name = name
        self.queue: deque[Waiting] = deque()
        self.allowance = allowance
        self.seen_ns = self.charged_ns = now_ns
        self.asked = self.refused = self.told = 0


class Desk:
    """Takes requests in, hands them out in turns; `report` says once a second who asked too much."""

    def __init__(self, limits: DeskLimits, now_ns: int):
        self._limits = limits
        self._burst = max(1.0, limits.client_hz * BURST_S)
        self._lanes: dict[bytes, Lane] = {}
        self._others = Lane(b"", self._burst, now_ns)
        self._turn: deque[Lane] = deque()
        self._spare_s = RESERVE_S
        self._spare_ns = now_ns
        self._sweep_ns = now_ns
        self._report_ns = now_ns
        self.waiting = 0

    def lane(self, client: bytes, now_ns: int) -> Lane:
        """Return the lane of a client that asks."""
        lane = self._lanes.get(client) or self._newcomer(client, now_ns)
        lane.asked += 1
        lane.seen_ns = now_ns
        return lane

    def grants(self, lane: Lane, now_ns: int) -> bool:
        """Return whether a client's next request may be answered now: it is charged where there is no time to spare."""
        if self._spare_s > 0.0:
            return True
        passed, lane.charged_ns = now_ns - lane.charged_ns, now_ns
        lane.allowance = min(self._burst, lane.allowance + passed * 1e-9 * self._limits.client_hz)
        if lane.allowance >= 1.0:
            lane.allowance -= 1.0
            return True
        return False

    def queue(self, lane: Lane, item: Waiting) -> tuple[Lane, Waiting] | None:
        """Have a request wait; return the one that is refused for it where too many wait: of who has the most."""
        if lane.allowance < 1.0 and self._spare_s <= 0.0 and len(lane.queue) >= HELD:
            return lane, item
        if self.waiting >= self._limits.queued:
            longest = max(self._turn, key=lambda each: len(each.queue))
            if len(longest.queue) <= len(lane.queue) + 1:
                return lane, item
            refused = longest, longest.queue.pop()
            self._append(lane, item)
            return refused
        self.waiting += 1
        self._append(lane, item)
        return None

    def next(self, now_ns: int) -> Waiting | None:
        """Return whose turn it is; None where nobody waits, or only such as have asked for too much."""
        turn = self._turn
        for _ in range(len(turn)):
            lane = turn.popleft()
            if self.grants(lane, now_ns):
                item = lane.queue.popleft()
                self.waiting -= 1
                if lane.queue:
                    turn.append(lane)
                return item
            turn.append(lane)
        return None

    def refuse(self, lane: Lane) -> bool:
        """Count a refusal; return whether the client is to be told."""
        lane.refused += 1
        lane.told += 1
        return lane.told <= REFUSALS_TOLD

    def spent(self, seconds: float, now_ns: int) -> None:
        """Take note of the time that went into requests."""
        earned = (now_ns - self._spare_ns) * 1e-9 * self._limits.share
        self._spare_ns = now_ns
        self._spare_s = max(-RESERVE_S, min(RESERVE_S, self._spare_s + earned - seconds))

    def report(self, now_ns: int) -> str | None:
        """Return who asked too much in the last second, empty for nobody; None before the second is over."""
        elapsed = (now_ns - self._report_ns) * 1e-9
        if now_ns - self._report_ns < REPORT_NS:
            return None
        self._report_ns = now_ns
        lanes = [*self._lanes.values(), self._others]
        worst = sorted((lane for lane in lanes if lane.refused), key=lambda lane: -lane.refused)
        texts = [
            f"{self._called(lane)} asks {lane.asked / elapsed:,.0f}/s; {lane.refused / elapsed:,.0f}/s refused"
            for lane in worst[:NAMED]
        ]
        if len(worst) > NAMED:
            texts.append(f"and {len(worst) - NAMED} more")
        for lane in lanes:
            lane.asked = lane.refused = lane.told = 0
        return "; ".join(texts)

    def _append(self, lane: Lane, item: Waiting) -> None:
        if not lane.queue:
            self._turn.append(lane)
        lane.queue.append(item)

    def _newcomer(self, client: bytes, now_ns: int) -> Lane:
        if len(self._lanes) >= self._limits.clients:
            if now_ns < self._sweep_ns:
                return self._others
            self._sweep_ns = now_ns + SWEEP_NS
            gone = [name for name, lane in self._lanes.items() if not lane.queue and now_ns - lane.seen_ns > IDLE_NS]
            for name in gone:
                del self._lanes[name]
            if not gone:
                return self._others
        lane = self._lanes[client] = Lane(client, self._burst, now_ns)
        return lane

    def _called(self, lane: Lane) -> str:
        if lane is self._others:
            return f"all beyond the first {self._limits.clients} clients together"
        if lane.name == SIGNED_CLIENT:
            return "the channel of signed commands"
        if not lane.name:
            return "whoever names no reply channel"
        name = lane.name.decode("utf-8", "replace")
        return f"client {name if name.isidentifier() else shown(name, 40)}"
