"""Recordings: their time axes, playback onto the bus, and processing through the core without a bus.

The stamps of a recording and the times of their receipt have one axis, or two with known amounts between them. A
simulation stamps from 0 s and is recorded by the clock of the wall; a recorder may run an hour off. If all sources are
off by one amount the recording is sound: its receive times are moved to the axis of the stamps. If one is off alone, it
is that one's clock.

Processing (`OfflineRun`, `serve`): the same core as the daemon's, the same results bit for bit. The estimate for a time
t uses the events that precede, in the log, the first one whose arrival (the log's timestamp, not the sample's stamp) is
t or later. It is the answer to a client that asks at t with policy PREDICTED: predicted beyond the newest sample, or
interpolated if a sample with a later stamp has arrived.
"""

from __future__ import annotations

import gc
import math
import statistics
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import Final, get_args

from modelserver import core, messages
from modelserver.core import CoreState, Instant
from modelserver.core.state import SPREAD_S, format_offset
from modelserver.errors import NoPoseError, TooNewError, TooOldError, WireError
from modelserver.estimation.history import Localizer
from modelserver.geometry import names
from modelserver.messages import NAN, Decision, Envelope, Event, Policy, PublishDecisions, Rejected, TimeQuery
from modelserver.server.bus import FakeBus, Inboxes
from modelserver.server.clock import Clock, FakeClock
from modelserver.server.ingress import MODE_TYPE, SensorChannel, peek_sample_id
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.vehicle import Vehicle
from modelserver.transforms.so3 import Quaternion
from modelserver.wire.channels import SIGNED
from modelserver.wire.codec import decode, fingerprint_of, get_type_name, is_of_service, restamp
from modelserver.wire.eventlog import LogEvent

LARGEST_DELAY_S: Final = 5.0
"""Largest difference of stamp and receipt that buses and latencies explain, seconds."""

LOOKED_AT: Final = 4000
"""Events that are looked at: some ten seconds of a vehicle's sensors."""


SAMPLES: Final = frozenset(fingerprint_of(get_type_name(each)) for each in get_args(messages.Sample))
"""The first bytes of messages with samples."""


@dataclass(slots=True)
class StampAxis:
    """Offsets of stamps from receipt: of each channel, and of all together where they agree; seconds, 0 for none.

    received_s: the time of receipt, seconds since 1970.
    """

    by_channel: Mapping[str, float] = field(default_factory=dict)
    received_s: float = 0.0

    @property
    def common(self) -> float:
        """What all sources are off by; 0 if they are not, or not by one amount."""
        values = list(self.by_channel.values()) or [0.0]
        middle = statistics.median(values)
        return middle if max(values) - min(values) <= SPREAD_S and abs(middle) > LARGEST_DELAY_S else 0.0

    def describe(self) -> list[str]:
        """Describe what is off, a sentence for each; empty if nothing is."""
        if self.common:
            return [f"all stamps are {self.format(self.common)} their receipt: the axis of the stamps is used"]
        return [
            f"the stamps on {channel} are {self.format(offset)} their receipt: the clock of that source is off"
            for channel, offset in self.by_channel.items()
            if abs(offset) > LARGEST_DELAY_S
        ]

    def format(self, offset: float) -> str:
        """Format an offset with what it is known as, e.g. `3,600.0 s (1 h: a time zone?) behind`."""
        return format_offset(offset, self.received_s)


def measure(events: Iterable[LogEvent], channels: Container[str] | None = None) -> StampAxis:
    """Return the median offset of the stamps of each channel with samples; of some channels, or of all."""
    offsets: dict[str, list[float]] = {}
    received_s = 0.0
    for event in events:
        received_s = event.utime * 1e-6
        is_wanted = (channels is None or event.channel in channels) and event.data[:8] in SAMPLES
        if is_wanted and (found := peek_sample_id(event.data, event.data[:8])) is not None:
            offsets.setdefault(event.channel, []).append((found.utime - event.utime) * 1e-6)
    return StampAxis({name: statistics.median(values) for name, values in offsets.items()}, received_s)


def align(events: Iterable[LogEvent], channels: Container[str], axis: StampAxis) -> Iterator[LogEvent]:
    """Yield events with their receipt on the axis of the stamps; what is found is written to `axis`."""
    waiting = iter(events)
    first = list(islice(waiting, LOOKED_AT))
    found = measure(first, channels)
    axis.by_channel, axis.received_s = found.by_channel, found.received_s
    offset = round(axis.common * 1e6)
    for event in chain(first, waiting):
        yield event._replace(utime=event.utime + offset) if offset else event


@dataclass(slots=True)
class Player:
    """Publishes events `speed` times as fast as they were recorded (infinite: at once).

    Messages are published unchanged; with `restamp` the stamps of samples and mode commands are shifted by the age of
    the log, so that they are current for a daemon.

    Each event has an absolute deadline on the monotonic clock, relative to the first one, so delays do not accumulate.
    If the log's time steps back, playback continues at once from there. The counts are valid also after an interrupt;
    `max_delay` is the greatest delay of a message after its deadline, seconds.
    """

    publish: Callable[[str, bytes], object]
    speed: float
    clock: Clock
    sleep: Callable[[float], object]
    restamp: bool = False
    sent: int = 0
    max_delay: float = 0.0
    first_utime: int = 0
    last_utime: int = 0

    def play(self, events: Iterable[LogEvent], on_sent: Callable[[LogEvent], object] = lambda event: None) -> None:
        """Publish all events; call `on_sent` after each one."""
        start_ns, start_utime, shift = self.clock.monotonic_ns(), 0, 0
        for event in events:
            if not self.sent:
                self.first_utime = start_utime = event.utime
                shift = self.clock.now().utime - event.utime
            elif event.utime < self.last_utime:
                start_ns, start_utime = self.clock.monotonic_ns(), event.utime
            if not math.isinf(self.speed):
                due_ns = start_ns + round((event.utime - start_utime) * 1000 / self.speed)
                wait = (due_ns - self.clock.monotonic_ns()) * 1e-9
                if wait > 0:
                    self.sleep(wait)
                else:
                    self.max_delay = max(self.max_delay, -wait)
            self.publish(event.channel, restamp(event.data, shift) if self.restamp else event.data)
            self.sent += 1
            self.last_utime = event.utime
            on_sent(event)

    @property
    def duration(self) -> float:
        return (self.last_utime - self.first_utime) * 1e-6


# --- processing -------------------------------------------------------------------------------------------------------

CSV_HEADER: Final = (
    "utime,easting,northing,up,qw,qx,qy,qz,pose_valid,invalid_reasons,"
    "horizontal_bound,heading_bound,sigma_east,sigma_north,sigma_up,sigma_yaw,latitude_deg,longitude_deg,heading_deg,"
    "horizontal_level,heading_level,limit_risk"
)

_UNCERTAINTY: Final = "%.4f,%.6f,%.4f,%.4f,%.4f,%.6f,%.9f,%.9f,%.5f,%.4f,%.6f,%.3g"
"""Format of the last columns: to 0.1 mm, a microradian, a nanodegree."""


@dataclass(frozen=True, slots=True)
class TrackRow:
    """Estimated pose of a frame: UTM easting and northing, height above the ellipsoid, meters; nan = no pose.

    `rotation` maps from the frame to grid east, grid north, up (w, x, y, z). `invalid` are the reason bits. `bounds`
    are the protection levels, horizontal (m) and heading (rad), of the base frame only; `sigmas` the standard
    deviations along east, north, up (m) and of the yaw (rad); `place` is latitude, longitude and true
    heading, degrees. `levels` are those of an instant, m and rad, of the base frame only, and the probability of an
    error beyond a limit. nan = not known.
    """

    utime: int
    easting: float = NAN
    northing: float = NAN
    up: float = NAN
    rotation: Quaternion = (NAN, NAN, NAN, NAN)
    valid: bool = False
    invalid: int = 0
    bounds: tuple[float, float] = (NAN, NAN)
    sigmas: tuple[float, float, float, float] = (NAN, NAN, NAN, NAN)
    place: tuple[float, float, float] = (NAN, NAN, NAN)
    levels: tuple[float, float, float] = (NAN, NAN, NAN)

    def to_csv(self) -> str:
        """Format the row as a CSV line: positions to 0.01 mm, rotations to a nanoradian.

        An unknown bound, sigma, latitude, longitude or heading is empty.
        """
        quaternion = ",".join(f"{value:.9f}" for value in self.rotation)
        place = f"{self.easting:.5f},{self.northing:.5f},{self.up:.5f}"
        uncertainty = (_UNCERTAINTY % (*self.bounds, *self.sigmas, *self.place, *self.levels)).replace("nan", "")
        return f"{self.utime},{place},{quaternion},{int(self.valid)},{self.invalid},{uncertainty}"


@dataclass(slots=True)
class OfflineRun:
    """One pass through a recording. Iterate `rows`; the counts are updated meanwhile.

    Attributes
    ----------
    on_decision: gets each decision on a measurement, in the order of the decisions, also if the vehicle file does not
        publish them. Measurements that are undecided at the end of the log have none.
    on_sample: gets each decodable sample, and the localizer after it.
    events, samples: all events of the log, and those that were passed to the core.
    unconfigured_channels: channels of the log that the vehicle file does not name.
    rejected: rejected messages and samples by channel or source, and reason.
    position: bytes of the log read so far.
    axis: how the stamps are off the log's times.
    """

    vehicle: Vehicle
    log: Iterable[LogEvent]
    frame: str
    on_decision: Callable[[Decision], object] | None = None
    on_sample: Callable[[Event, Localizer], object] | None = None
    events: int = 0
    samples: int = 0
    unconfigured_channels: set[str] = field(default_factory=set)
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)
    first_utime: int = 0
    last_utime: int = 0
    position: int = 0
    axis: StampAxis = field(default_factory=StampAxis)
    _state: CoreState | None = None

    def __post_init__(self) -> None:
        self.vehicle.model.get_transformation(self.frame, self.vehicle.config.base_frame)

    def rows(self, times: Iterable[int] | None, rate_hz: float = 50.0) -> Iterator[TrackRow]:
        """Yield the estimate at each of `times`, which must not decrease; without them at a constant rate.

        The constant rate begins with the first event of the log and ends with the last one.
        """
        channels = self.vehicle.sensor_channels()
        ticks = iter(times) if times is not None else None
        due: int | None = None
        number = 0
        for event in align(self.log, channels, self.axis):
            if self._state is None:
                self.first_utime = event.utime
                state = self.vehicle.start_core(_instant(event.utime))
                settings = replace(state.settings, publish_decisions=self.on_decision is not None)
                self._state = state._replace(settings=settings)
                due = event.utime if ticks is None else next(ticks, None)
            while due is not None and due <= event.utime:
                yield self._estimate_row(due)
                number += 1
                due = next(ticks, None) if ticks else self.first_utime + round(number * 1e6 / rate_hz)
            if event.channel.endswith(SIGNED):
                event = _unwrap_mode_command(event, channels)
            self._process(event, channels.get(event.channel))
        while ticks and due is not None:
            yield self._estimate_row(due)
            due = next(ticks, None)

    def _process(self, event: LogEvent, channel: SensorChannel | None) -> None:
        assert self._state is not None
        self.events += 1
        self.position = event.end
        self.last_utime = max(self.last_utime, event.utime)
        if channel is None:
            self.unconfigured_channels.add(event.channel)
            return
        self.samples += 1
        sample: Event
        try:
            sample = channel.decode(event.data)
        except WireError as error:
            sample = Rejected(event.channel, error.reason)
        self._state, outputs = core.step(self._state, sample, _instant(event.utime))
        for output in outputs:
            if isinstance(output, PublishDecisions) and self.on_decision is not None:
                for decision in output.decisions:
                    self.on_decision(decision)
        self.rejected = self._state.rejected
        if self.on_sample is not None and self._state.localizer is not None:
            self.on_sample(sample, self._state.localizer)

    @property
    def localizer(self) -> Localizer | None:
        return None if self._state is None else self._state.localizer

    def _estimate_row(self, utime: int) -> TrackRow:
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
        easting, northing, up = origin.easting + x, origin.northing + y, origin.height + z
        P, geodetic = found.covariance_numbers, answer.geodetic
        x2, y2, z2, yaw2 = (NAN, NAN, NAN, NAN) if P is None else (P[0], P[7], P[14], P[35])
        return TrackRow(
            utime,
            easting,
            northing,
            up,
            found.pose.wxyz,
            found.is_valid,
            int(found.invalid_reasons),
            (answer.horizontal_protection_level, answer.heading_protection_level),
            (math.sqrt(x2), math.sqrt(y2), math.sqrt(z2), math.sqrt(yaw2)),
            (NAN, NAN, NAN)
            if geodetic is None
            else (geodetic.latitude_deg, geodetic.longitude_deg, geodetic.heading_deg),
            (answer.horizontal_level, answer.heading_level, answer.limit_risk),
        )


def relax_garbage_collector() -> None:
    """Search for cycles seldom: searching long-lived tuples for them costs a sixth of a replay's time."""
    gc.collect()
    if not gc.get_freeze_count():  # what a process of many replays has at the time of a later one would never be freed
        gc.freeze()
    gc.set_threshold(50_000, 20, 100)


class _OfflineBus(FakeBus):
    """A bus whose clock goes no further than the next event of a recording, at `limit_ns`."""

    limit_ns = 0

    def wait(self, seconds: float, inboxes: Inboxes = "both") -> None:
        super().wait(min(seconds, (self.limit_ns - self._clock.monotonic_ns()) * 1e-9), inboxes)


def serve(vehicle: Vehicle, log: Iterable[LogEvent], axis: StampAxis) -> Iterator[LogEvent]:
    """Yield what would be on the bus if the service ran while a recording is played: its messages, and the service's.

    The loop is the daemon's, on a fake bus and clock. What a service published in the recording is left out. `axis`
    gets how the stamps are off the log's times. A message of the service has number and end of the event that follows.
    """
    channels = vehicle.sensor_channels()
    clock = FakeClock()
    bus = _OfflineBus(clock)
    loop: Loop | None = None

    def pop_published(event: LogEvent) -> Iterator[LogEvent]:
        for channel, data in bus.published:
            yield event._replace(utime=clock.utime(), channel=channel, data=data)
        bus.published.clear()

    for event in align(log, channels, axis):
        if is_of_service(event.data) and not event.channel.endswith(SIGNED):
            continue
        now = _instant(event.utime)
        if loop is None:
            clock.set(now)
            hooks = Hooks(snapshot=vehicle.encode_snapshot, channels=lambda state: vehicle.sensor_channels(state.model))
            loop = Loop(bus, clock, vehicle.start_core(now), LoopSettings.of(vehicle), hooks)
        bus.limit_ns = now.monotonic_ns
        while clock.monotonic_ns() < now.monotonic_ns:
            loop.run_once()
            yield from pop_published(event)
        clock.set(now)
        yield event
        if event.channel.endswith(SIGNED):
            event = _unwrap_mode_command(event, channels)
        bus.sensors.put(event.channel, event.data)
        loop.run_once()
        yield from pop_published(event)


def _unwrap_mode_command(event: LogEvent, channels: Mapping[str, SensorChannel]) -> LogEvent:
    """Unwrap a mode command from its signed envelope; return any other event unchanged.

    The signature is not verified: a recording has no key.
    """
    try:
        envelope: Envelope = decode("signed_t", event.data)
    except WireError:
        return event
    channel = f"{event.channel.removesuffix(SIGNED)}{envelope.channel}"
    sensor = channels.get(channel)
    if sensor is None or sensor.type_name != MODE_TYPE:
        return event
    return event._replace(channel=channel, data=envelope.payload)


def _instant(utime: int) -> Instant:
    """Return the instant of an event: the log's time stands for both clocks of the host."""
    return Instant(utime * 1000, utime)
