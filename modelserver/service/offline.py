"""A recording straight through the core, without a bus: the same core as the daemon's, the same bits every time.

Causality. The estimate for a time t is made from the events that stand in the log before the first one whose
arrival (the log's own timestamp, not the sample's stamp) is t or later. It is what a client would have been told
who asked at t with policy PREDICTED: predicted past the newest sample, or interpolated where a sample had come
whose stamp is later than t.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from modelserver import core
from modelserver.core import CoreState, Instant
from modelserver.errors import NoPoseError, TooNewError, TooOldError, WireError
from modelserver.geometry import names
from modelserver.localization.interface import Localizer
from modelserver.messages import NAN, Decision, Envelope, Event, Policy, PublishDecisions, Rejected, TimeQuery
from modelserver.service.daemon import Vehicle
from modelserver.service.heard import SensorChannel
from modelserver.service.requests.gate import MODE_TYPE
from modelserver.spatial.so3 import Quaternion
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent
from modelserver.wire.signed import SIGNED

CSV_HEADER: Final = "utime,easting,northing,up,qw,qx,qy,qz,pose_valid,invalid_reasons"

_NO_ROTATION: Final = (NAN, NAN, NAN, NAN)


@dataclass(frozen=True, slots=True)
class TrackRow:
    """Where a frame was estimated to be: UTM easting and northing, height above the ellipsoid, metres; nan = no pose.

    `rotation` turns the frame's axes to grid east, grid north, up. `invalid` are the reason bits.
    """

    utime: int
    easting: float = NAN
    northing: float = NAN
    up: float = NAN
    rotation: Quaternion = _NO_ROTATION
    valid: bool = False
    invalid: int = 0

    def csv(self) -> str:
        """Return the row as a line: positions to 0.01 mm, rotations to a nanoradian."""
        quaternion = ",".join(f"{value:.9f}" for value in self.rotation)
        place = f"{self.easting:.5f},{self.northing:.5f},{self.up:.5f}"
        return f"{self.utime},{place},{quaternion},{int(self.valid)},{self.invalid}"


@dataclass(slots=True)
class OfflineRun:
    """One pass through a recording. Iterate `rows`; the counts fill on the way.

    `events` counts all events of the log, `samples` those that the core was given, `unheard` the channels that the
    vehicle file does not name, `rejected` what was not used, by channel or source and reason. `position` is where
    the log has been read to, in bytes. `on_decision` is told what became of each measurement, in the order in which it
    was settled, whatever the vehicle file says of broadcasting it; what the log's end leaves open is not told.
    `on_taken` is shown each sample that could be read, and what was known right after it.
    """

    vehicle: Vehicle
    log: Iterable[LogEvent]
    frame: str
    on_decision: Callable[[Decision], object] | None = None
    on_taken: Callable[[Event, Localizer], object] | None = None
    events: int = 0
    samples: int = 0
    unheard: set[str] = field(default_factory=set)
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)
    first_utime: int = 0
    last_utime: int = 0
    position: int = 0
    _state: CoreState | None = None

    def __post_init__(self) -> None:
        self.vehicle.model.get_transformation(self.frame, self.vehicle.config.base_frame)

    def rows(self, times: Iterable[int] | None, rate_hz: float = 50.0) -> Iterator[TrackRow]:
        """Yield the estimate at each of `times`, in their order; without them at an even rate while the log lasts.

        Times must not fall. The even rate's first time is that of the log's first event.
        """
        channels = self.vehicle.sensor_channels()
        ticks = iter(times) if times is not None else None
        due: int | None = None
        number = 0
        for event in self.log:
            if self._state is None:
                self.first_utime = event.utime
                self._state = self._started(_instant(event.utime))
                due = event.utime if ticks is None else next(ticks, None)
            while due is not None and due <= event.utime:
                yield self._row(due)
                number += 1
                due = next(ticks, None) if ticks else self.first_utime + round(number * 1e6 / rate_hz)
            if event.channel.endswith(SIGNED):
                event = _unsealed(event, channels)
            self._take(event, channels.get(event.channel))
        while ticks and due is not None:
            yield self._row(due)
            due = next(ticks, None)

    def _started(self, now: Instant) -> CoreState:
        state = self.vehicle.core(now)
        return state._replace(settings=replace(state.settings, publish_decisions=self.on_decision is not None))

    def _take(self, event: LogEvent, heard: SensorChannel | None) -> None:
        assert self._state is not None
        self.events += 1
        self.position = event.end
        self.last_utime = max(self.last_utime, event.utime)
        if heard is None:
            self.unheard.add(event.channel)
            return
        self.samples += 1
        now = _instant(event.utime)
        sample: Event
        try:
            sample = heard.read(event.data)
        except WireError as error:
            sample = Rejected(event.channel, error.reason)
        self._state, outputs = core.step(self._state, sample, now)
        if self.on_decision is not None:
            for output in outputs:
                if isinstance(output, PublishDecisions):
                    for decision in output.decisions:
                        self.on_decision(decision)
        self.rejected = self._state.rejected
        if self.on_taken is not None and self._state.localizer is not None:
            self.on_taken(sample, self._state.localizer)

    @property
    def localizer(self) -> Localizer | None:
        """What is known after the events read so far; None before the first."""
        return None if self._state is None else self._state.localizer

    def _row(self, utime: int) -> TrackRow:
        assert self._state is not None
        try:
            answer = self._state.view.transformation(self.frame, names.WORLD_UTM, TimeQuery(utime, Policy.PREDICTED))
        except (NoPoseError, TooOldError, TooNewError):
            localizer = self._state.localizer
            return TrackRow(utime, invalid=0 if localizer is None else int(localizer.estimate(utime).invalid))
        found, origin = answer.transformation, answer.origin
        if origin is None:
            return TrackRow(utime, invalid=int(found.invalid_reasons))
        x, y, z = found.pose.xyz
        return TrackRow(
            utime,
            origin.easting + x,
            origin.northing + y,
            origin.height + z,
            found.pose.wxyz,
            found.valid,
            int(found.invalid_reasons),
        )


def _unsealed(event: LogEvent, channels: Mapping[str, SensorChannel]) -> LogEvent:
    """Return the wish for a mode in an envelope as if it had come by itself; any other event as it is.

    Whether it was signed well is not asked again: a recording has no key.
    """
    try:
        envelope: Envelope = decode("signed_t", event.data)
    except WireError:
        return event
    channel = f"{event.channel.removesuffix(SIGNED)}{envelope.channel}"
    heard = channels.get(channel)
    if heard is None or heard.type_name != MODE_TYPE:
        return event
    return replace(event, channel=channel, data=envelope.payload)


def _instant(utime: int) -> Instant:
    """Return the instant of an event: in a recording the host's only clock is the log's."""
    return Instant(utime * 1000, utime)
