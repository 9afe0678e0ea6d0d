"""The loop: one thread that hands what comes from the bus to the core, and what the core says to the bus."""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from modelserver import core
from modelserver.core import AllOutputs, CoreState, Instant
from modelserver.core.answers import DeferredAnswer
from modelserver.core.reload import ModelLoaded
from modelserver.errors import WireError
from modelserver.geometry import names
from modelserver.messages import (
    Event,
    KeepState,
    LoadModel,
    Noticed,
    OriginLatched,
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    PublishSnapshot,
    Rejected,
    SendReply,
    SignedCommand,
    StartTold,
    SwitchMode,
    Tick,
)
from modelserver.service.ahead import Lead
from modelserver.service.bus import Bus
from modelserver.service.clock import Clock
from modelserver.service.heard import SensorChannel, peek
from modelserver.service.hooks import Hooks
from modelserver.service.log import RateLimited, plain, plain_lines
from modelserver.service.requests.handler import RequestHandler
from modelserver.service.requests.scheduler import RequestLimits
from modelserver.service.snapshots import SnapshotWriter
from modelserver.service.unused import Unused
from modelserver.service.watch import SECOND, PublisherMonitor
from modelserver.wire.codec import encode, fingerprint_of
from modelserver.wire.journal import RecordKind
from modelserver.wire.navigation import MAX_DECISIONS

log = logging.getLogger(__name__)

SENSORS_PER_PASS = 100
"""Samples taken before the clock is looked at again: a flood of samples must not stop the ticks."""

SENSORS_NS = 2_000_000
SENSORS_LEAST_NS = 500_000
"""Nanoseconds that samples may take of a pass: up to the next tick and no more than the first, but at least the second,
so that late ticks do not keep samples waiting."""


NO_NETWORK = frozenset({errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENODEV, errno.ENOBUFS})
"""What sending fails with while the network is away: no error of the service's own."""

FLOOD_PAUSE_S = 0.002
"""How long requests wait for the next pass, at most, seconds: in a flood, and where there is no time for them."""


_NO_HOOKS = Hooks()


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the loop runs.

    period_ns: between ticks. sensors: for each channel that is heard, what it carries.
    channel_prefix, queued_requests, requests_per_pass, client_hz, request_share, client_reply_bytes: see
    `modelserver.config`.
    second_writer: see `modelserver.config`; empty: nobody looks. shared: channels that several may write on.
    """

    period_ns: int
    sensors: Mapping[str, SensorChannel] = field(default_factory=dict)
    channel_prefix: str = ""
    queued_requests: int = 256
    requests_per_pass: int = 16
    client_hz: float = 500.0
    request_share: float = 0.25
    client_reply_bytes: float = 5e6
    second_writer: Literal["", "ignore", "use"] = ""
    shared: frozenset[str] = frozenset()


class Loop:
    """Serves one core on one bus. `run` returns when it is told to `stop`."""

    def __init__(self, bus: Bus, clock: Clock, state: CoreState, settings: LoopSettings, hooks: Hooks = _NO_HOOKS):
        self.state = state
        self._bus = bus
        self._clock = clock
        self._settings = settings
        self._on_origin = hooks.on_origin
        self._on_wish = hooks.on_wish
        self._on_load = hooks.on_load
        self._snapshot = SnapshotWriter(hooks.snapshot)
        self._channels = hooks.channels
        self._on_keep = hooks.on_keep
        self._on_tick = hooks.on_tick
        self._journal = hooks.journal
        self._hearing: set[str] = set()
        self._reloading = False
        self._gauges = hooks.gauges
        self._log = RateLimited(log, clock)
        self._gate = hooks.gate
        self._told: set[tuple[str, str]] = set()
        self._due_ns = clock.monotonic_ns()
        self._lead = Lead()
        self._hold_ns = 0  # the deadline that the tick's pose waits for
        self._late_ns = 0  # of the last pose that a tick published
        self._stopping = False
        self._was_busy = False  # whether samples waited behind samples in the last pass
        prefix = settings.channel_prefix
        self._pose, self._pose_vector = f"{prefix}POSE", f"{prefix}POSE_VECTOR"
        self._odom, self._health = f"{prefix}POSE_ODOM", f"{prefix}MODELSERVER_HEALTH"
        self._model, self._held = f"{prefix}MODEL_SNAPSHOT", f"{prefix}JOINTS_HELD"
        self._decisions, self._state = f"{prefix}LOCALIZATION_DECISIONS", f"{prefix}LOCALIZATION_STATE"
        self._unused = Unused(self.step, self._journal)
        self._watch = PublisherMonitor(
            self.step, self._unused.count, self._log, settings.second_writer, settings.shared
        )
        self._hear(settings.sensors)
        limits = RequestLimits(
            settings.queued_requests, settings.client_hz, settings.request_share, settings.client_reply_bytes
        )
        self._requests = RequestHandler(
            self, bus, clock, self._log, prefix, limits, settings.requests_per_pass, hooks.gate, hooks.run_delay
        )

    def run(self) -> None:
        """Serve until `stop` is called."""
        while not self._stopping:
            self.turn()

    def stop(self) -> None:
        """Make `run` return after the pass that is under way. May be called from a signal handler."""
        self._stopping = True

    def hears(self, channel: str) -> bool:
        """Return whether a channel is one of samples."""
        return channel in self._hearing

    def reload(self) -> None:
        """Have the geometry read anew in the next pass. May be called from a signal handler."""
        self._reloading = True

    def notice(self, subject: str, text: str = "") -> None:
        """Have the health report tell something of the service itself; an empty text takes it back."""
        self.step(Noticed(subject, text), self._clock.now())

    def turn(self) -> None:
        """Make one pass: sensors, the tick when it is due, a slice of request work, then wait."""
        requests = self._requests
        # a deferred reply in progress rests on an older state than the one that a segment would begin with
        if self._journal.wants_state and not requests.is_deferring:
            self._journal.begin(self.state, self._clock.now())
        if self._reloading:
            self._reloading = False
            self.send((LoadModel(),))
        busy = self._drain_sensors()
        if busy and self._was_busy:
            requests.contention.add_sensor_backlog(self._clock.monotonic_ns())
        self._was_busy = busy
        self._tick_if_due()
        begin_ns = self._due_ns - self._lead.ns
        requests.serve(begin_ns, may_defer=not self._journal.wants_state)
        if busy or self._stopping:
            return
        seconds = max(0.0, (begin_ns - self._clock.monotonic_ns()) * 1e-9)
        if requests.is_flooded:
            # waking for each request of a flood would be most of the work
            self._bus.wait(0.0 if requests.is_ready else min(seconds, FLOOD_PAUSE_S), requests=False)
        elif not requests.is_ready:
            if requests.waiting:
                seconds = min(seconds, FLOOD_PAUSE_S)
            elif requests.prepare(begin_ns):
                seconds = 0.0
            self._bus.wait(seconds)

    def _drain_sensors(self) -> bool:
        """Handle the samples that have come, up to the next tick; return whether more may wait."""
        now_ns = self._clock.monotonic_ns()
        until_tick = self._due_ns - self._lead.ns - now_ns
        most_ns = min(SENSORS_NS, max(SENSORS_LEAST_NS, until_tick))
        count = self._bus.sensors.drain(SENSORS_PER_PASS, most_ns * 1e-9)
        return count == SENSORS_PER_PASS or (count > 0 and self._clock.monotonic_ns() - now_ns >= most_ns)

    def _tick_if_due(self) -> None:
        due = self._due_ns
        if due - self._clock.monotonic_ns() > self._lead.ns:
            return
        now = self._clock.now()
        ahead = due - now.monotonic_ns
        # a tick that was missed is skipped and counted: catching up would burst old poses
        missed = max(-ahead, 0) // self._settings.period_ns
        self._due_ns += (missed + 1) * self._settings.period_ns
        late_ns = -ahead
        if ahead > 0:
            # what it says holds for the deadline, at which it is published; how late that was the next tick tells
            now, late_ns = Instant(due, now.utime + ahead // 1000), self._late_ns
        self._requests.contention.add_tick(
            late_ns if not missed else missed * self._settings.period_ns, now.monotonic_ns
        )
        self._watch.look(now)
        reports = now.monotonic_ns >= self.state.health_due_ns
        self._unused.tell(now, reports)
        self._hold_ns = due
        try:
            # gauges are read where they will be told
            gauges = self._gauges(self._requests.waiting) if reports else None
            self.step(Tick(late_ns * 1e-9, missed, self._requests.take_answered(), gauges), now)
            self._on_tick(self.state)
        except Exception as error:
            self._wait_for(due, ahead)
            self.failed("tick", error)
        else:
            self._wait_for(due, ahead)
        for notice in self._journal.news():
            self.step(notice, self._clock.now())

    def _wait_for(self, due: int, ahead: int) -> None:
        """Let nothing be handled before the instant of a tick that published nothing."""
        if self._hold_ns and ahead > 0:
            self._clock.sleep(max(0, due - self._clock.monotonic_ns()) * 1e-9)
        self._hold_ns = 0

    def _hold(self) -> None:
        """Wait for the deadline of the tick under way; learn from when all was ready how early to begin the next."""
        due, self._hold_ns = self._hold_ns, 0
        if not due:
            return
        ready = self._clock.monotonic_ns()
        self._lead.learn(ready - (due - self._lead.ns))
        if ready < due:
            self._clock.sleep((due - ready) * 1e-9)
            ready = self._clock.monotonic_ns()
        self._late_ns = ready - due

    @property
    def requests_waiting(self) -> int:
        """Requests that wait to be answered."""
        return self._requests.waiting

    def obey(self, command: SignedCommand, now: Instant) -> None:
        """Have a signed command obeyed."""
        before = self.state
        self.step(command, now)
        if isinstance(command.order, SwitchMode):
            self._on_wish(command.order, before, self.state)

    def _hear(self, channels: Mapping[str, SensorChannel]) -> None:
        for channel, heard in channels.items():
            if channel not in self._hearing:
                self._hearing.add(channel)
                self._bus.sensors.subscribe(channel, self._sensor_handler(channel, heard))

    def _sensor_handler(self, own: str, heard: SensorChannel) -> Callable[[str, bytes], None]:
        writer = self._watch.writer(own)
        watched, fingerprint = heard.has_publisher, fingerprint_of(heard.type_name)

        def handle(channel: str, data: bytes) -> None:
            try:
                now = self._clock.now()
                # what is ignored is recognized before it is decoded: a flood of it must cost little
                mark = peek(data, fingerprint) if watched else None
                if mark is not None:
                    if writer is None:
                        ignored = self._watch.refuses(channel, mark, now)
                    else:
                        ignored = writer.is_second(mark, now.monotonic_ns) and self._watch.told(
                            channel, writer, mark, now
                        )
                    if ignored:
                        self._unused.drop(RecordKind.IGNORED, channel, SECOND, data, now)
                        return
                event = heard.read(data)
                if isinstance(event, SwitchMode):
                    self._wished(channel, event, now)
                else:
                    self.step(event, now, (channel, data))
            except Exception as error:
                self.failed(channel, error, data)

        return handle

    def _wished(self, channel: str, wish: SwitchMode, now: Instant) -> None:
        """Take a wish for a mode that came without a signature, where none is asked for; else count it."""
        if self._gate is None:
            self.obey(SignedCommand(wish), now)
            return
        self._unused.count(channel, "unsigned", now)
        self._told.add((channel, "unsigned"))
        self._log.warning(
            f"{channel}:unsigned",
            "a wish for a mode on %s is not signed, so it does not count (commands.key_file)",
            channel,
        )

    def failed(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Count and log what went wrong with a message or a tick: an exception never leaves the bus."""
        now = self._clock.now()
        if isinstance(error, WireError):
            if data:
                self._unused.note(RecordKind.UNREAD, channel, data, now)
            self._unused.count(channel, error.reason, now)
            self._told.add((channel, error.reason))
            self._log.warning(f"{channel}:{error.reason}", "rejected a message on %s: %s", channel, error)
        elif isinstance(error, OSError) and error.errno in NO_NETWORK:
            self.step(Rejected(channel, "network"), now)
            self._told.add((channel, "network"))
            self._log.warning(f"{channel}:network", "%s could not be sent: %s", channel, error)
        else:
            self.step(Rejected(channel, "handler"), now)
            self._told.add((channel, "handler"))
            self._log.exception(f"{channel}:handler", "an error of the server's own while handling %s", channel)

    def step(self, event: Event | ModelLoaded, now: Instant, heard: tuple[str, bytes] | None = None) -> None:
        """Hand the core an event, and send what it says; `heard` is the message that the event was read from."""
        self._journal.step(event, now, heard)
        self.state, outputs = core.step(self.state, event, now)
        if outputs:
            self.send(outputs)

    def note(self, kind: RecordKind, channel: str, data: bytes, now: Instant) -> None:
        """Have the journal note a request with which something else is done than handing it to the core.

        All of it: what was said to it is to be said again.
        """
        self._journal.note(kind, (channel, data), now)

    def publish(self, channel: str, data: bytes) -> None:
        """Send a message to everyone: the only place where anything is said."""
        self._journal.said(channel, data)
        try:
            self._bus.publish(channel, data)
        except Exception as error:
            # what is said beside it is sent all the same
            self.failed(channel, error)

    def send(self, outputs: AllOutputs) -> None:
        """Send what the core says."""
        for output in outputs:
            try:
                _SENDERS[type(output)](self, output)
            except Exception as error:
                # one that cannot be sent must not take the others with it
                self.failed(type(output).__name__, error)

    def _send_reply(self, output: SendReply) -> None:
        encoded = encode(output.reply)
        self.publish(output.channel, encoded)
        self._requests.cache(output, encoded)

    def _defer(self, output: DeferredAnswer) -> None:
        self._requests.defer(output)

    def _send_pose(self, output: PublishPose) -> None:
        world, vector, odom = encode(output.world), encode(output.world, "pose_vector_t"), encode(output.odom)
        self._hold()
        self.publish(self._pose, world)
        self.publish(self._pose_vector, vector)
        self.publish(self._odom, odom)

    def _send_decisions(self, output: PublishDecisions) -> None:
        for start in range(0, len(output.decisions), MAX_DECISIONS):
            part = output.decisions[start : start + MAX_DECISIONS]
            self.publish(self._decisions, encode(PublishDecisions(output.utime, part)))

    def _send_navigation(self, output: PublishNavigation) -> None:
        self.publish(self._state, encode(output.state))

    def _send_health(self, output: PublishHealth) -> None:
        self.publish(self._health, encode(output.health))
        for source, reason, count in output.health.rejected:
            if (source, reason) not in self._told:
                self._told.add((source, reason))
                log.warning(
                    "%s: %d refused so far, reason: %s; the counts go on in %s",
                    plain(source),
                    count,
                    plain(reason),
                    self._health,
                )

    def _load(self, output: LoadModel) -> None:
        before = self.state.model.revision
        loaded = self._on_load(output, self.state)
        self.step(loaded, self._clock.now())
        dry = output.request is not None and output.request.dry_run
        if loaded.model is None:
            log.error(
                "the geometry was read anew and is not used; that of revision %s stays: %s",
                before,
                plain_lines(loaded.why),
            )
        elif not dry:
            self._hear(self._channels(self.state))
            log.info("the geometry was read anew: revision %s, it was %s", loaded.model.revision, before)

    def _send_snapshot(self, output: PublishSnapshot) -> None:
        for part in self._snapshot.parts(self.state, output.utime):
            self.publish(self._model, encode(part))
        for held in self.state.view.joints.newest(output.utime):
            self.publish(self._held, encode(held))

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

    def _keep(self, output: KeepState) -> None:
        self.step(Noticed("restart", self._on_keep(output.kept)), self._clock.now())

    def _tell_start(self, output: StartTold) -> None:
        log.info("%s", output.text)


_SENDERS: Mapping[type, Callable[[Loop, Any], None]] = {
    SendReply: Loop._send_reply,
    DeferredAnswer: Loop._defer,
    PublishPose: Loop._send_pose,
    PublishHealth: Loop._send_health,
    OriginLatched: Loop._send_origin,
    PublishDecisions: Loop._send_decisions,
    PublishNavigation: Loop._send_navigation,
    LoadModel: Loop._load,
    PublishSnapshot: Loop._send_snapshot,
    KeepState: Loop._keep,
    StartTold: Loop._tell_start,
}
