"""The server loop: one thread between the bus and the core.

`run_once` makes one pass:

1. samples from the bus (`ingress`), up to the next tick and at most `MAX_SAMPLES_NS`;
2. the tick, if it is due (`clock.TickTimer`); its pose is published at its deadline, and until then requests are
   answered from the cache;
3. a slice of request work (`requests.handler`);
4. wait for a message or the next tick.

Everything that the core handles is first recorded in the journal, and so is every published message, so that a replay
of the journal can be compared with them. An exception while handling a message is counted, logged, and does not stop
the loop. What the loop needs beside bus and clock is in `Hooks`.
"""

from __future__ import annotations

import errno
import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from modelserver import core, messages
from modelserver.config.vehicle_file import LimitsConfig
from modelserver.core import AllOutputs, CoreState, Instant, ModelLoaded
from modelserver.errors import WireError
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.query.answers import DeferredAnswer
from modelserver.server.bus import Bus, Handler
from modelserver.server.clock import Clock, TickTimer
from modelserver.server.ingress import (
    MODE_TYPE,
    PUBLISHER_CONFLICT,
    CommandVerifier,
    PublisherConflictMonitor,
    RejectionCounter,
    SensorChannel,
    peek_sample_id,
)
from modelserver.server.journal import JournalQueue
from modelserver.server.log import RateLimitedLog, escape_lines, escape_text
from modelserver.server.reloading import PollReload
from modelserver.server.requests import LATE_TICK_NS, RequestHandler
from modelserver.wire.codec import encode, fingerprint_of, split_snapshot
from modelserver.wire.fields import MAX_DECISIONS
from modelserver.wire.journal import RecordKind
from modelserver.wire.provider import Sender

if TYPE_CHECKING:
    from modelserver.server.vehicle import Vehicle

log = logging.getLogger(__name__)

SAMPLES_PER_PASS = 100
MAX_SAMPLES_NS = 2_000_000
MIN_SAMPLES_NS = 500_000
"""Samples of a pass, and nanoseconds for them: up to the next tick within these limits, so that a flood of samples does
not delay ticks, nor a late tick samples."""

NETWORK_ERRORS = frozenset({errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENODEV, errno.ENOBUFS})
"""Errors of sending while the network is down: no error of the server."""

LAST_REQUEST_NS = 100_000
"""Requests are answered from the cache until so long before a pose is published: most take less."""

FLOOD_PAUSE_S = 0.002
"""How long requests wait for the next pass at most, seconds, in a flood or without time for them."""


MAX_RELOADS = 8
"""Reloads that wait for the one in progress; further ones are rejected."""


def _report_no_file(command: messages.LoadModel, state: CoreState) -> PollReload:
    return lambda state: ModelLoaded(command.request, why="this server has no geometry file to read")


@dataclass(frozen=True, slots=True)
class Hooks:
    """Callbacks of a loop; by default they do nothing.

    Attributes
    ----------
    on_origin: persists an origin that was captured.
    on_mode_switch: gets a mode command and the states before and after it.
    on_load: begins to read the geometry again.
    on_reload: gets None when a reload begins, and its result when it has ended.
    snapshot: encodes the snapshot of a model for the bus.
    channels: returns the sensor channels of a new geometry, which may have joints.
    on_persist: persists a state without waiting for the disk; returns a warning or an empty text.
    gauges: reads resources of the process for the health report, given the number of waiting requests.
    on_tick: called after each tick without error.
    verifier: verifies signed commands. Without one they are not received, and mode commands need no signature.
    journal: records everything that is handled and published; one that nothing begins records nothing.
    """

    on_origin: Callable[[messages.PersistOrigin], None] = lambda origin: None
    on_mode_switch: Callable[[messages.SwitchMode, CoreState, CoreState], None] = lambda command, before, after: None
    on_load: Callable[[messages.LoadModel, CoreState], PollReload] = _report_no_file
    on_reload: Callable[[ModelLoaded | None], None] = lambda loaded: None
    snapshot: Callable[[Model], bytes] = lambda model: b""
    channels: Callable[[CoreState], Mapping[str, SensorChannel]] = lambda state: {}
    on_persist: Callable[[messages.PersistedState], str] = lambda state: ""
    gauges: Callable[[int], messages.Gauges | None] = lambda waiting: None
    on_tick: Callable[[CoreState], None] = lambda state: None
    verifier: CommandVerifier | None = None
    journal: JournalQueue = field(default_factory=JournalQueue)


_NO_HOOKS = Hooks()


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Settings of a loop; see `modelserver.config.vehicle_file` for those not listed.

    Attributes
    ----------
    period_ns: between ticks.
    sensors: what each subscribed channel carries.
    publisher_conflict: what to do with samples of a second publisher; empty = no detection.
    shared_channels: those of joints, of which each has a publisher.
    publishers: the sources that the vehicle file names, by channel.
    """

    period_ns: int
    sensors: Mapping[str, SensorChannel] = field(default_factory=dict)
    channel_prefix: str = ""
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    publisher_conflict: Literal["", "ignore", "use"] = ""
    shared_channels: frozenset[str] = frozenset()
    publishers: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, vehicle: Vehicle) -> LoopSettings:
        """Return the settings of the loop that serves a vehicle."""
        config, prefix = vehicle.config, vehicle.config.lcm.channel_prefix
        return cls(
            round(1e9 / vehicle.tick_hz()),
            vehicle.sensor_channels(),
            prefix,
            config.limits,
            config.sensors.publisher_conflict,
            frozenset({f"{prefix}{config.sensors.joints.channel}"}),
            vehicle.list_publishers(),
        )


class Loop:
    """Serves one core on one bus. `run` returns after `stop`."""

    def __init__(self, bus: Bus, clock: Clock, state: CoreState, settings: LoopSettings, hooks: Hooks = _NO_HOOKS):
        self.state = state
        self._bus = bus
        self._clock = clock
        self._settings = settings
        self._hooks = hooks
        self._journal = hooks.journal
        self._snapshot: tuple[Model | None, list[messages.SnapshotPart]] = (None, [])
        self._log = RateLimitedLog(log, clock)
        self._logged: set[tuple[str, str]] = set()
        self._timer = TickTimer(clock, settings.period_ns)
        self._reload_requested = self._stop_requested = False
        self._reloads: deque[messages.LoadModel] = deque()  # the first is in progress
        self._poll_reload: PollReload | None = None
        self._waiting_poses: list[tuple[str, bytes]] | None = None  # for the deadline of the tick in progress, if any
        self._has_backlog = False  # whether samples remained after the samples of the last pass
        prefix = settings.channel_prefix
        self._pose, self._pose_vector = f"{prefix}POSE", f"{prefix}POSE_VECTOR"
        self._odom, self._health = f"{prefix}POSE_ODOM", f"{prefix}MODELSERVER_HEALTH"
        self._model, self._held = f"{prefix}MODEL_SNAPSHOT", f"{prefix}JOINTS_HELD"
        self._decisions, self._state = f"{prefix}LOCALIZATION_DECISIONS", f"{prefix}LOCALIZATION_STATE"
        self._rejections = RejectionCounter(self.step, self._journal)
        self._conflicts = PublisherConflictMonitor(
            self.step, self._rejections.count, self._log, settings.publisher_conflict, settings.publishers
        )
        self._sensor_channels: set[str] = set()
        self._subscribe(settings.sensors)
        self._requests = RequestHandler(
            self, bus, clock, self._log, self._journal, prefix, settings.limits, hooks.verifier
        )

    def run(self) -> None:
        """Serve until `stop` is called."""
        while not self._stop_requested:
            self.run_once()

    def stop(self) -> None:
        """Make `run` return after the current pass. May be called from a signal handler."""
        self._stop_requested = True

    def reload(self) -> None:
        """Reload the geometry in the next pass. May be called from a signal handler."""
        self._reload_requested = True

    def is_sensor_channel(self, channel: str) -> bool:
        """Return whether a subscribed channel carries samples."""
        return channel in self._sensor_channels

    def set_warning(self, subject: str, text: str = "") -> None:
        """Set a warning of the health report; an empty text clears it."""
        self.step(messages.HealthWarning(subject, text), self._clock.now())

    def run_once(self) -> None:
        """Make one pass: samples, the tick if it is due, a slice of request work, then wait."""
        requests, timer = self._requests, self._timer
        # a deferred reply in progress rests on an older state than the one that a segment would begin with
        if self._journal.wants_state and requests.deferred is None:
            self._journal.begin(self.state, self._clock.now())
        if self._reload_requested:
            self._reload_requested = False
            self.send((messages.LoadModel(),))
        elif self._reloads:
            self._continue_reload()
        now_ns = self._drain_sensors(self._clock.monotonic_ns())
        if now_ns >= timer.begin_ns:
            self._tick()
            now_ns = self._clock.monotonic_ns()
        begin_ns = timer.begin_ns
        now_ns = requests.serve(now_ns, begin_ns, may_defer=not self._journal.wants_state)
        if self._has_backlog or self._stop_requested:
            return
        seconds = max(0.0, (begin_ns - now_ns) * 1e-9)
        if requests.is_flooded:
            # waking for each request of a flood would be most of the work
            self._bus.wait(0.0 if requests.is_ready else min(seconds, FLOOD_PAUSE_S), "samples")
        elif not requests.is_ready:
            if requests.waiting:
                seconds = min(seconds, FLOOD_PAUSE_S)
            self._bus.wait(seconds)

    def _drain_sensors(self, begin_ns: int) -> int:
        """Handle the samples that have arrived, from `begin_ns` up to the next tick; return when that ended."""
        limit_ns = min(MAX_SAMPLES_NS, max(MIN_SAMPLES_NS, self._timer.begin_ns - begin_ns))
        count = self._bus.sensors.drain(SAMPLES_PER_PASS, limit_ns * 1e-9)
        if not count:
            self._has_backlog = False
            return begin_ns
        now_ns = self._clock.monotonic_ns()
        has_backlog = count == SAMPLES_PER_PASS or now_ns - begin_ns >= limit_ns
        if has_backlog and self._has_backlog:
            self._requests.report_backlog(now_ns)
        self._has_backlog = has_backlog
        return now_ns

    def _tick(self) -> None:
        tick = self._timer.start_tick()
        if tick is None:
            return
        now, missed, latency_ns = tick
        if max(missed * self._settings.period_ns, latency_ns) > LATE_TICK_NS:
            self._requests.report_late_tick(now.monotonic_ns)
        self._conflicts.clear_expired(now)
        is_report_due = now.monotonic_ns >= self.state.health_due_ns
        for inbox in (self._bus.sensors, self._bus.requests):
            for channel, count in inbox.pop_refused().items():
                self.step(messages.Rejected(channel, "too_long", count), now)
        self._rejections.flush(now, is_report_due)
        self._waiting_poses = []
        try:
            try:
                gauges = self._hooks.gauges(self._requests.waiting) if is_report_due else None
                self.step(messages.Tick(latency_ns * 1e-9, missed, self._requests.pop_answered(), gauges), now)
            finally:
                self._serve_cached(self._timer.publish_ns)
                self._timer.finish_tick()
                poses, self._waiting_poses = self._waiting_poses, None
                for channel, data in poses:
                    self._transmit(channel, data)
            self._hooks.on_tick(self.state)
        except Exception as error:
            self.handle_error("tick", error)
        for warning in self._journal.poll_warnings():
            self.step(warning, self._clock.now())

    def _serve_cached(self, end_ns: int) -> None:
        """Answer requests from the cache until shortly before `end_ns`; the others are queued."""
        while not self._requests.is_flooded:
            room_ns = end_ns - LAST_REQUEST_NS - self._clock.monotonic_ns()
            if room_ns <= 0:
                return
            self._bus.wait(room_ns * 1e-9, "requests")
            self._requests.serve_cached()

    def execute(self, command: messages.SignedCommand, now: Instant) -> None:
        """Execute a command whose signature is verified."""
        before = self.state
        self.step(command, now)
        if isinstance(command.command, messages.SwitchMode):
            self._hooks.on_mode_switch(command.command, before, self.state)

    def _subscribe(self, channels: Mapping[str, SensorChannel]) -> None:
        for name, channel in channels.items():
            if name not in self._sensor_channels:
                self._sensor_channels.add(name)
                self._bus.sensors.subscribe(name, self._make_sensor_handler(name, channel))

    def _make_sensor_handler(self, name: str, sensor: SensorChannel) -> Handler:
        is_shared = name in self._settings.shared_channels
        detector = self._conflicts.make_detector(name)
        # a channel of samples has one publisher; any client may command a mode
        is_monitored = sensor.type_name != MODE_TYPE and self._conflicts.is_enabled
        fingerprint = fingerprint_of(sensor.type_name)

        def handle(channel: str, data: bytes, sender: Sender) -> None:
            try:
                now = self._clock.now()
                # before decoding, so that a flood of ignored samples costs little
                sample_id = peek_sample_id(data, fingerprint) if is_monitored else None
                if sample_id is not None and not is_shared:
                    if self._conflicts.is_ignored(channel, detector, sample_id, now, sender):
                        self._rejections.drop(RecordKind.DROPPED, channel, PUBLISHER_CONFLICT, data, now)
                        return
                elif sample_id is not None:
                    left = self._conflicts.select_joints(channel, data, sample_id, now, sender)
                    if not left:
                        self._rejections.drop(RecordKind.DROPPED, channel, PUBLISHER_CONFLICT, data, now)
                        return
                    # what is left of it is what the journal replays
                    data = left
                event = sensor.decode(data)
                if isinstance(event, messages.SwitchMode):
                    self._handle_mode_command(channel, event, now)
                else:
                    self.step(event, now, (channel, data))
            except Exception as error:
                self.handle_error(channel, error, data)

        return handle

    def _handle_mode_command(self, channel: str, command: messages.SwitchMode, now: Instant) -> None:
        """Execute an unsigned mode command if no signature is required; else reject it."""
        if self._hooks.verifier is None:
            self.execute(messages.SignedCommand(command), now)
            return
        self._rejections.count(channel, "unsigned", now)
        self._logged.add((channel, "unsigned"))
        self._log.warning(
            f"{channel}:unsigned", "rejected a mode command on %s: it is not signed (commands.key_file)", channel
        )

    def handle_error(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Count and log an error while handling a message or a tick."""
        now = self._clock.now()
        if isinstance(error, WireError):
            reason = error.reason
            if data:
                self._rejections.record(RecordKind.UNDECODABLE, channel, data, now)
            self._rejections.count(channel, reason, now)
            self._log.warning(f"{channel}:{reason}", "rejected a message on %s: %s", channel, error)
        elif isinstance(error, OSError) and error.errno in NETWORK_ERRORS:
            reason = "network"
            self.step(messages.Rejected(channel, reason), now)
            self._log.warning(f"{channel}:{reason}", "%s could not be sent: %s", channel, error)
        else:
            reason = "handler"
            self.step(messages.Rejected(channel, reason), now)
            self._log.exception(f"{channel}:{reason}", "internal error while handling %s", channel)
        self._logged.add((channel, reason))

    def step(
        self, event: messages.Event | ModelLoaded, now: Instant, received: tuple[str, bytes] | None = None
    ) -> None:
        """Pass an event to the core and send its outputs; `received` is the message that it was decoded from."""
        self._journal.record_event(event, now, received)
        self.state, outputs = core.step(self.state, event, now)
        if outputs:
            self.send(outputs)

    def publish(self, channel: str, data: bytes) -> None:
        self._journal.record_published(channel, data)
        self._transmit(channel, data)

    def _transmit(self, channel: str, data: bytes) -> None:
        """Publish a message that is recorded: the only place that does."""
        try:
            self._bus.publish(channel, data)
        except Exception as error:
            self.handle_error(channel, error)

    def send(self, outputs: AllOutputs) -> None:
        """Send outputs of the core; an error in one does not affect the others."""
        for output in outputs:
            try:
                _SENDERS[type(output)](self, output)
            except Exception as error:
                self.handle_error(type(output).__name__, error)

    def _send_reply(self, output: messages.SendReply) -> None:
        encoded = encode(output.reply)
        self.publish(output.channel, encoded)
        self._requests.cache(output, encoded)

    def _send_pose(self, output: messages.PublishPose) -> None:
        encoded = (
            (self._pose, encode(output.world)),
            (self._pose_vector, encode(output.world, "pose_vector_t")),
            (self._odom, encode(output.odom)),
        )
        if self._waiting_poses is None:
            for channel, data in encoded:
                self.publish(channel, data)
            return
        if not self._waiting_poses:
            self._timer.set_ready()
        # in the journal they stand here, so that a replay publishes in the same order
        for channel, data in encoded:
            self._journal.record_published(channel, data)
        self._waiting_poses += encoded

    def _send_decisions(self, output: messages.PublishDecisions) -> None:
        for start in range(0, len(output.decisions), MAX_DECISIONS):
            part = output.decisions[start : start + MAX_DECISIONS]
            self.publish(self._decisions, encode(messages.PublishDecisions(output.utime, part)))

    def _send_health(self, output: messages.PublishHealth) -> None:
        self.publish(self._health, encode(output.health))
        for source, reason, count in output.health.rejected:
            if (source, reason) not in self._logged:
                self._logged.add((source, reason))
                log.warning(
                    "%s: %d rejected so far, reason: %s; later counts are published on %s",
                    escape_text(source),
                    count,
                    escape_text(reason),
                    self._health,
                )

    def _load(self, output: messages.LoadModel) -> None:
        """Reload the geometry after those in progress; old answers serve until then."""
        if len(self._reloads) > MAX_RELOADS:
            why = f"{MAX_RELOADS} reloads are waiting already; ask again when they have ended"
            self.step(ModelLoaded(output.request, why=why), self._clock.now())
            return
        self._reloads.append(output)
        self._continue_reload()

    def _continue_reload(self) -> None:
        """Begin the first reload, or take its geometry if it has been read."""
        command, before = self._reloads[0], self.state.model.revision
        try:
            if self._poll_reload is None:
                self._hooks.on_reload(None)
                self._poll_reload = self._hooks.on_load(command, self.state)
            loaded = self._poll_reload(self.state)
        except Exception as error:
            self.handle_error("LoadModel", error)
            loaded = ModelLoaded(command.request, why=f"internal error while reading it: {error}")
        if loaded is None:
            return
        self._reloads.popleft()
        self._poll_reload = None
        self._hooks.on_reload(loaded)
        self.step(loaded, self._clock.now())
        if loaded.model is None:
            log.error(
                "the geometry could not be changed, revision %s stays in use: %s", before, escape_lines(loaded.why)
            )
        elif not loaded.is_dry_run:
            self._subscribe(self._hooks.channels(self.state))
            after = loaded.model.revision
            log.info(
                "the geometry %s: revision %s, before %s",
                "was changed" if after != before else "is the same",
                after,
                before,
            )

    def _send_snapshot(self, output: messages.PublishSnapshot) -> None:
        model = self.state.model
        if self._snapshot[0] is not model:
            self._snapshot = (model, split_snapshot(self._hooks.snapshot(model), model.revision, output.utime))
        for part in self._snapshot[1]:
            self.publish(self._model, encode(replace(part, utime=output.utime)))
        for held in self.state.view.joints.get_newest_samples(output.utime):
            self.publish(self._held, encode(held))

    def _send_origin(self, output: messages.PersistOrigin) -> None:
        origin = output.origin
        log.info(
            "origin of %s set at %.3f E %.3f N %.3f m, zone %d%s",
            names.WORLD_UTM,
            *origin.initial_utm,
            origin.zone,
            "N" if origin.north else "S",
        )
        self._hooks.on_origin(output)

    def _persist(self, output: messages.PersistState) -> None:
        self.step(messages.HealthWarning("restart", self._hooks.on_persist(output.state)), self._clock.now())


_SENDERS: Mapping[type, Callable[[Loop, Any], None]] = {
    messages.SendReply: Loop._send_reply,
    DeferredAnswer: lambda loop, output: loop._requests.defer(output),
    messages.PublishPose: Loop._send_pose,
    messages.PublishHealth: Loop._send_health,
    messages.PersistOrigin: Loop._send_origin,
    messages.PublishDecisions: Loop._send_decisions,
    messages.PublishNavigation: lambda loop, output: loop.publish(loop._state, encode(output.state)),
    messages.LoadModel: Loop._load,
    messages.PublishSnapshot: Loop._send_snapshot,
    messages.PersistState: Loop._persist,
    messages.ReportStart: lambda loop, output: log.info("%s", output.text),
}
