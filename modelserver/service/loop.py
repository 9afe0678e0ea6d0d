"""The loop: one thread that hands what comes from the bus to the core, and what the core says to the bus."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from modelserver import core
from modelserver.core import CoreState, Instant
from modelserver.errors import WireError
from modelserver.geometry import names
from modelserver.messages import (
    CHANNEL_OF,
    Event,
    GetHistory,
    GetTransformations,
    LoadModel,
    OriginLatched,
    Output,
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    PublishSnapshot,
    Rejected,
    Request,
    SendReply,
    SwitchMode,
    Tick,
)
from modelserver.reload import ModelLoaded
from modelserver.service.bus import Bus
from modelserver.service.clock import Clock
from modelserver.service.heard import Heard
from modelserver.service.log import RateLimited
from modelserver.service.snapshots import SnapshotWriter
from modelserver.wire.channels import BY_NAME, REQUESTS
from modelserver.wire.codec import decode, encode
from modelserver.wire.navigation import MAX_DECISIONS
from modelserver.wire.requests import request_header
from modelserver.wire.timeless import TIMELESS_TYPE, TimelessReplies

log = logging.getLogger(__name__)

SENSORS_PER_PASS = 100
"""Samples taken before the clock is looked at again: a flood of samples must not stop the ticks."""

PAIR = 4
INSTANTS_FOR_ONE = 25
POSES_OF_HISTORY = 8
"""What a question for many instants takes of a pass's budget of requests: so many for each pair, and one for each so
many instants of it; and what one for a stretch of history takes."""

REFUSALS_PER_PASS = 64
"""Refusals that are answered in one pass; further ones are only counted."""


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the loop runs.

    period_ns: between ticks. sensors: for each channel that is heard, what it carries.
    channel_prefix, queued_requests, requests_per_pass: see `modelserver.config`.
    """

    period_ns: int
    sensors: Mapping[str, Heard] = field(default_factory=dict)
    channel_prefix: str = ""
    queued_requests: int = 256
    requests_per_pass: int = 16


class Loop:
    """Serves one core on one bus. `run` returns when it is told to `stop`.

    `on_origin` is told of an origin that was captured, `on_wish` of a wish for a mode and the states around it.
    `on_load` reads the geometry anew, `snapshot` gives its bytes for the bus, and `channels` which sensors are heard
    once another is in force: joints, where it has any.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        state: CoreState,
        settings: LoopSettings,
        on_origin: Callable[[OriginLatched], None] = lambda note: None,
        on_wish: Callable[[SwitchMode, CoreState, CoreState], None] = lambda wish, before, after: None,
        on_load: Callable[[LoadModel, CoreState], ModelLoaded] = lambda wish, state: ModelLoaded(
            wish.request, why="this service has no file to read its geometry from"
        ),
        snapshot: Callable[[CoreState], bytes] = lambda state: b"",
        channels: Callable[[CoreState], Mapping[str, Heard]] = lambda state: {},
    ):
        self.state = state
        self._bus = bus
        self._clock = clock
        self._settings = settings
        self._on_origin = on_origin
        self._on_wish = on_wish
        self._on_load = on_load
        self._snapshot = SnapshotWriter(snapshot)
        self._channels = channels
        self._hearing: set[str] = set()
        self._reloading = False
        self._log = RateLimited(log, clock)
        self._queue: deque[tuple[str, str, bytes]] = deque()
        self._refusals_left = REFUSALS_PER_PASS
        self._budget = 0
        self._timeless = TimelessReplies()
        self._answered = 0  # from `_timeless`, since the last tick
        self._told: set[tuple[str, str]] = set()
        self._asked = b""  # the request that the core is answering
        self._due_ns = clock.monotonic_ns()
        self._stopping = False
        prefix = settings.channel_prefix
        self._pose, self._pose_vector = f"{prefix}POSE", f"{prefix}POSE_VECTOR"
        self._odom, self._health = f"{prefix}POSE_ODOM", f"{prefix}MODELSERVER_HEALTH"
        self._model = f"{prefix}MODEL_SNAPSHOT"
        self._decisions, self._state = f"{prefix}LOCALIZATION_DECISIONS", f"{prefix}LOCALIZATION_STATE"
        self._hear(settings.sensors)
        for request in REQUESTS:
            bus.requests.subscribe(f"{prefix}{request.name}", self._request_handler(request.type_name))

    def run(self) -> None:
        """Serve until `stop` is called."""
        while not self._stopping:
            self.turn()

    def stop(self) -> None:
        """Make `run` return after the pass that is under way. May be called from a signal handler."""
        self._stopping = True

    def reload(self) -> None:
        """Have the geometry read anew in the next pass. May be called from a signal handler."""
        self._reloading = True

    def turn(self) -> None:
        """Make one pass: sensors, the tick when it is due, requests within their budget, then wait."""
        if self._reloading:
            self._reloading = False
            self._send((LoadModel(),))
        busy = self._bus.sensors.drain(SENSORS_PER_PASS) == SENSORS_PER_PASS
        self._tick_if_due()
        self._refusals_left = REFUSALS_PER_PASS
        self._budget = self._settings.requests_per_pass
        while self._queue and self._budget:
            self._budget -= 1
            self._answer(*self._queue.popleft())
        self._bus.requests.drain(self._settings.queued_requests)
        if not busy and not self._queue and not self._stopping:
            self._bus.wait(max(0.0, (self._due_ns - self._clock.monotonic_ns()) * 1e-9))

    def _tick_if_due(self) -> None:
        late_ns = self._clock.monotonic_ns() - self._due_ns
        if late_ns < 0:
            return
        # a tick that was missed is skipped and counted: catching up would burst old poses
        missed = late_ns // self._settings.period_ns
        self._due_ns += (missed + 1) * self._settings.period_ns
        answered, self._answered = self._answered, 0
        try:
            self._step(Tick(late_ns * 1e-9, missed, answered), self._clock.now())
        except Exception as error:
            self._failed("tick", error)

    def _hear(self, channels: Mapping[str, Heard]) -> None:
        for channel, heard in channels.items():
            if channel not in self._hearing:
                self._hearing.add(channel)
                self._bus.sensors.subscribe(channel, self._sensor_handler(heard))

    def _sensor_handler(self, heard: Heard) -> Callable[[str, bytes], None]:
        def handle(channel: str, data: bytes) -> None:
            try:
                event, before = heard.read(data), self.state
                self._step(event, self._clock.now())
                if isinstance(event, SwitchMode):
                    self._on_wish(event, before, self.state)
            except Exception as error:
                self._failed(channel, error)

        return handle

    def _request_handler(self, type_name: str) -> Callable[[str, bytes], None]:
        def handle(channel: str, data: bytes) -> None:
            if self._budget and not self._queue:
                self._budget -= 1
                self._answer(channel, type_name, data)
            elif len(self._queue) < self._settings.queued_requests:
                self._queue.append((channel, type_name, data))
            else:
                self._refuse(channel, type_name, data)

        return handle

    def _refuse(self, channel: str, type_name: str, data: bytes) -> None:
        now = self._clock.now()
        self._step(Rejected(channel, "load"), now)
        if self._refusals_left > 0:
            self._refusals_left -= 1
            try:
                request = decode(type_name, data)
            except Exception:
                return  # counted already: as refused
            self._send(core.refuse(self.state, request, now))

    def _answer(self, channel: str, type_name: str, data: bytes) -> None:
        """Answer a request, also one that makes no sense or that an error keeps from being answered."""
        try:
            if type_name == TIMELESS_TYPE:
                remembered = self._timeless.find(data, self._clock.utime(), self.state.view.model)
                if remembered is not None:
                    self._bus.publish(*remembered)
                    self._answered += 1
                    return
            request = decode(type_name, data)
        except Exception as error:
            self._failed(channel, error)
            header = request_header(data) if isinstance(error, WireError) and error.reason == "malformed" else None
            if header is not None:
                kind = _REQUEST_KINDS[type_name]
                self._send(core.turn_back(self.state, kind, header, str(error), self._clock.now()))
            return
        self._asked = data
        # one that asks for much leaves less of the pass for others: the next tick must not wait for them all
        self._budget = max(0, self._budget - effort(request))
        now = self._clock.now()
        try:
            self._step(request, now)
        except Exception as error:
            self._failed(channel, error)
            self._send(core.fail(self.state, request, now))
        self._asked = b""

    def _failed(self, channel: str, error: Exception) -> None:
        """Count and log what went wrong with a message or a tick: an exception never leaves the bus."""
        now = self._clock.now()
        if isinstance(error, WireError):
            self._step(Rejected(channel, error.reason), now)
            self._told.add((channel, error.reason))
            self._log.warning(f"{channel}:{error.reason}", "rejected a message on %s: %s", channel, error)
        else:
            self._step(Rejected(channel, "handler"), now)
            self._told.add((channel, "handler"))
            self._log.exception(f"{channel}:handler", "an error of the server's own while handling %s", channel)

    def _step(self, event: Event | ModelLoaded, now: Instant) -> None:
        self.state, outputs = core.step(self.state, event, now)
        if outputs:
            self._send(outputs)

    def _send(self, outputs: tuple[Output, ...]) -> None:
        for output in outputs:
            try:
                _SENDERS[type(output)](self, output)
            except Exception as error:
                # one that cannot be sent must not take the others with it
                self._failed(type(output).__name__, error)

    def _send_reply(self, output: SendReply) -> None:
        encoded = encode(output.reply)
        self._bus.publish(output.channel, encoded)
        if self._asked:
            self._timeless.learn(self._asked, output, encoded, self.state.model)

    def _send_pose(self, output: PublishPose) -> None:
        self._bus.publish(self._pose, encode(output.world))
        self._bus.publish(self._pose_vector, encode(output.world, "pose_vector_t"))
        self._bus.publish(self._odom, encode(output.odom))

    def _send_decisions(self, output: PublishDecisions) -> None:
        for start in range(0, len(output.decisions), MAX_DECISIONS):
            part = output.decisions[start : start + MAX_DECISIONS]
            self._bus.publish(self._decisions, encode(PublishDecisions(output.utime, part)))

    def _send_navigation(self, output: PublishNavigation) -> None:
        self._bus.publish(self._state, encode(output.state))

    def _send_health(self, output: PublishHealth) -> None:
        self._bus.publish(self._health, encode(output.health))
        for source, reason, count in output.health.rejected:
            if (source, reason) not in self._told:
                self._told.add((source, reason))
                log.warning(
                    "%s: %d refused so far, reason: %s; the counts go on in %s", source, count, reason, self._health
                )

    def _load(self, output: LoadModel) -> None:
        before = self.state.model.revision
        loaded = self._on_load(output, self.state)
        self._step(loaded, self._clock.now())
        dry = output.request is not None and output.request.dry_run
        if loaded.model is None:
            log.error("the geometry was read anew and is not used; that of revision %s stays: %s", before, loaded.why)
        elif not dry:
            self._hear(self._channels(self.state))
            log.info("the geometry was read anew: revision %s, it was %s", loaded.model.revision, before)

    def _send_snapshot(self, output: PublishSnapshot) -> None:
        for part in self._snapshot.parts(self.state, output.utime):
            self._bus.publish(self._model, encode(part))

    def _send_origin(self, output: OriginLatched) -> None:
        origin = output.origin
        log.info(
            "origin of %s set at %.3f E %.3f N %.3f m, zone %d%s",
            names.WORLD_UTM,
            *origin.initial_utm,
            origin.zone,
            "N" if origin.north else "S",
        )
        self._on_origin(output)


def effort(request: Request) -> int:
    """Return how many usual requests' time one takes beyond its own."""
    if isinstance(request, GetTransformations):
        return len(request.pairs) * (PAIR + len(request.at) // INSTANTS_FOR_ONE)
    if isinstance(request, GetHistory):
        return POSES_OF_HISTORY
    return 0


_REQUEST_KINDS: Mapping[str, type[Request]] = {BY_NAME[channel].type_name: kind for kind, channel in CHANNEL_OF.items()}

_SENDERS: Mapping[type, Callable[[Loop, Any], None]] = {
    SendReply: Loop._send_reply,
    PublishPose: Loop._send_pose,
    PublishHealth: Loop._send_health,
    OriginLatched: Loop._send_origin,
    PublishDecisions: Loop._send_decisions,
    PublishNavigation: Loop._send_navigation,
    LoadModel: Loop._load,
    PublishSnapshot: Loop._send_snapshot,
}
