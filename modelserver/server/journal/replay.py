"""Replay of a run from its journal: the same loop and core process the records, on a fake bus and clock.

Outputs that are published are collected per record; the effects of others (a reloaded geometry, a persisted state) are
records of their own.
"""

from __future__ import annotations

from collections.abc import Container, Mapping

from modelserver import core, messages
from modelserver.core import AllOutputs, Instant
from modelserver.errors import RecordingError, Status, WireError
from modelserver.server.clock import FakeClock
from modelserver.server.fake_bus import FakeBus
from modelserver.server.ingress import SensorChannel
from modelserver.server.journal import state as journal_state
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.requests.handler import REQUEST_TYPES
from modelserver.server.vehicle import Vehicle
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode, read_request_header
from modelserver.wire.journal import JournalRecord, RecordKind

PublishedMessage = tuple[str, bytes]

UNPUBLISHED_OUTPUTS = (messages.LoadModel, messages.PersistOrigin, messages.PersistState, messages.ReportStart)


class _ContainsAll(Container[object]):
    def __contains__(self, thing: object) -> bool:
        return True


class ReplayLoop(Loop):
    """A loop that processes journal records and returns what it publishes."""

    def __init__(self, state: bytes):
        """Continue from the state of a segment. Raises RecordingError."""
        config, known = journal_state.decode_run(state)
        self.config = config
        self._fake_clock = FakeClock()
        self._fake_bus = FakeBus(self._fake_clock)
        vehicle = Vehicle(config, known.model, None)
        settings = LoopSettings(period_ns=1, channel_prefix=config.lcm.channel_prefix)
        super().__init__(self._fake_bus, self._fake_clock, known, settings, Hooks(snapshot=vehicle.encode_snapshot))
        joints = config.sensors.joints
        self._replayed_channels: Mapping[str, SensorChannel] = {
            # stays subscribed after a reload from a geometry with joints to one without
            f"{config.lcm.channel_prefix}{joints.channel}": SensorChannel("joints_t", round(joints.latency * 1e6)),
            **vehicle.sensor_channels(),
        }
        # errors were logged by the recorded run
        self._logged = _ContainsAll()  # type: ignore[assignment]

    def handle(self, record: JournalRecord) -> list[PublishedMessage]:
        """Process a record; return what is published. Raises RecordingError for an invalid record."""
        published = self._fake_bus.published = []
        now = Instant(record.monotonic_ns, record.utime)
        self._fake_clock.set(now)
        if record.kind is RecordKind.EVENT:
            self._replay_event(journal_state.decode_event(record.data), now)
        elif record.kind is RecordKind.SAMPLE:
            channel = self._replayed_channels.get(record.channel)
            if channel is None:
                raise RecordingError(f"{record.channel} is no sensor channel of the vehicle file")
            self._replay_event(channel.decode(record.data), now)
        elif record.kind is RecordKind.DEFERRED_PART:
            self._requests.send_deferred(int.from_bytes(record.data, "big"))
        elif record.kind not in (RecordKind.UNDECODABLE, RecordKind.DROPPED):
            self._replay_request(record, now)
        return published

    def _replay_request(self, record: JournalRecord, now: Instant) -> None:
        channel = BY_NAME.get(record.channel.removeprefix(self.config.lcm.channel_prefix))
        if channel is None:
            raise RecordingError(f"{record.channel} is no request channel")
        try:
            request: messages.Request = decode(channel.type_name, record.data)
        except WireError as error:
            header = read_request_header(record.data)
            if record.kind is RecordKind.MALFORMED and header is not None:
                self.send(
                    core.reply_error(
                        self.state, REQUEST_TYPES[channel.type_name], header, Status.MALFORMED, str(error), now
                    )
                )
                return
            raise RecordingError(f"a request on {record.channel} cannot be decoded: {error}") from error
        if record.kind is RecordKind.REQUEST:
            self._replay_event(request, now)
        elif record.kind is RecordKind.CACHED:
            # a static answer of the core equals the cached one; the state that counts it is discarded
            self.send(core.step(self.state, request, now)[1])
        elif record.kind is RecordKind.OVERLOAD:
            self.send(core.reply_overloaded(self.state, request, now))
        elif record.kind is RecordKind.FAILED:
            self._requests.drop_deferred()
            self.send(core.reply_internal_error(self.state, request, now))

    def _replay_event(self, event: object, now: Instant) -> None:
        try:
            self.step(event, now)  # type: ignore[arg-type]
        except Exception as error:
            self.handle_error("", error)

    def send(self, outputs: AllOutputs) -> None:
        """Publish outputs; ignore the others."""
        super().send(tuple(each for each in outputs if not isinstance(each, UNPUBLISHED_OUTPUTS)))

    def handle_error(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Do nothing: the error is the next record of the journal."""
