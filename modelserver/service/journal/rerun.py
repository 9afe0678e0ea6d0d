"""A service's run once more, from its journal: the same loop and core, and what they say now."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

from modelserver import core
from modelserver.core import AllOutputs, Instant
from modelserver.core.answers import DeferredAnswer
from modelserver.errors import RecordingError, WireError
from modelserver.messages import (
    PublishDecisions,
    PublishHealth,
    PublishNavigation,
    PublishPose,
    PublishSnapshot,
    Request,
    SendReply,
)
from modelserver.service.bus import Handler
from modelserver.service.daemon import Vehicle
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.journal import state as journal_state
from modelserver.service.loop import Loop, LoopSettings
from modelserver.service.requests.handler import request_kind
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode
from modelserver.wire.journal import JournalRecord, RecordKind
from modelserver.wire.requests import request_header

Said = tuple[str, bytes]


SAYING = (SendReply, DeferredAnswer, PublishPose, PublishHealth, PublishDecisions, PublishNavigation, PublishSnapshot)
"""Outputs that are said; what comes of the others (a geometry read anew, a state kept) is a record of its own."""


class _Nowhere:
    """A bus on which nothing comes."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Do nothing."""

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        """Return that nothing has come."""
        return 0


class _Everything(Container[object]):
    def __contains__(self, thing: object) -> bool:
        return True


class _Ear:
    """A bus that keeps what is said."""

    def __init__(self) -> None:
        self.sensors = self.requests = _Nowhere()
        self.said: list[Said] = []

    def publish(self, channel: str, data: bytes) -> None:
        """Keep a message."""
        self.said.append((channel, data))

    def wait(self, seconds: float, requests: bool = True) -> None:
        """Do nothing."""


class _Standing:
    """A clock that shows the instant of the record that is run again."""

    def __init__(self) -> None:
        self.instant = Instant(0, 0)

    def monotonic_ns(self) -> int:
        return self.instant.monotonic_ns

    def utime(self) -> int:
        return self.instant.utime

    def now(self) -> Instant:
        return self.instant

    def sleep(self, seconds: float) -> None:
        """Do nothing."""


class Rerun(Loop):
    """A loop that is handed records instead of a bus, and says nothing but to whoever asks `handle`."""

    def __init__(self, state: bytes):
        """Go on from the state that a segment begins with. Raises RecordingError."""
        config, known = journal_state.decode_run(state)
        self.config = config
        self._ear, self._standing = _Ear(), _Standing()
        vehicle = Vehicle(config, known.model, None)
        settings = LoopSettings(period_ns=1, channel_prefix=config.lcm.channel_prefix)
        super().__init__(self._ear, self._standing, known, settings, Hooks(snapshot=vehicle.snapshot))
        joints = config.sensors.joints
        self._heard: Mapping[str, SensorChannel] = {
            # heard on and on where a geometry without joints has taken the place of one that had some
            f"{config.lcm.channel_prefix}{joints.channel}": SensorChannel("joints_t", round(joints.latency * 1e6)),
            **vehicle.sensor_channels(),
        }
        # what went wrong then was logged then
        self._told = _Everything()  # type: ignore[assignment]

    def handle(self, record: JournalRecord) -> list[Said]:
        """Do again what a record tells of; return what is said to it. Raises RecordingError where it makes no sense."""
        self._ear.said = []
        now = self._standing.instant = Instant(record.monotonic_ns, record.utime)
        if record.kind is RecordKind.EVENT:
            self._taken(journal_state.decode_event(record.data), now)
        elif record.kind is RecordKind.SAMPLE:
            heard = self._heard.get(record.channel)
            if heard is None:
                raise RecordingError(f"{record.channel} is no channel that the vehicle file names")
            self._taken(heard.read(record.data), now)
        elif record.kind is RecordKind.PORTION:
            self._requests.send_deferred(int.from_bytes(record.data, "big"))
        elif record.kind not in (RecordKind.UNREAD, RecordKind.IGNORED):
            self._asked_again(record, now)
        return self._ear.said

    def _asked_again(self, record: JournalRecord, now: Instant) -> None:
        channel = BY_NAME.get(record.channel.removeprefix(self.config.lcm.channel_prefix))
        if channel is None:
            raise RecordingError(f"{record.channel} is no channel for requests")
        try:
            request: Request = decode(channel.type_name, record.data)
        except WireError as error:
            header = request_header(record.data)
            if record.kind is RecordKind.MALFORMED and header is not None:
                kind = request_kind(channel.type_name)
                assert kind is not None
                self.send(core.turn_back(self.state, kind, header, str(error), now))
                return
            raise RecordingError(f"a request on {record.channel} cannot be read: {error}") from error
        if record.kind is RecordKind.REQUEST:
            self._taken(request, now)
        elif record.kind is RecordKind.REMEMBERED:
            # an answer that holds for good is the same from the core; it is not to be counted there
            self.send(core.step(self.state, request, now)[1])
        elif record.kind is RecordKind.REFUSED:
            self.send(core.refuse(self.state, request, now))
        elif record.kind is RecordKind.FAILED:
            self._requests.drop_deferred()
            self.send(core.fail(self.state, request, now))

    def _taken(self, event: object, now: Instant) -> None:
        try:
            self.step(event, now)  # type: ignore[arg-type]
        except Exception as error:
            self.failed("", error)

    def send(self, outputs: AllOutputs) -> None:
        """Say what the core says; whatever else it wants was seen to then."""
        super().send(tuple(each for each in outputs if isinstance(each, SAYING)))

    def failed(self, channel: str, error: Exception, data: bytes = b"") -> None:
        """Do nothing: that it failed then too stands in the journal as the next record."""
