"""Driver of a satellite receiver, NovAtel or NMEA 0183: configures it, publishes its fixes, diagnoses errors.

Both protocols are read interleaved on one port (`GpsStream`). A fix is a position log with its velocity and heading
of one instant, or an NMEA epoch of a receiver that has no logs. Missing values stay nan.

A NovAtel receiver is configured by commands (`StreamDriver`); without an answer the next baud rate is tried. Without
a fix for `silence` the setup is repeated, because a restarted receiver forgets its logs. A plain NMEA receiver is only
read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from modelserver.messages import FixType, GpsSample, SensorHeader
from modelserver.messages.values import NAN
from msdrivers.devices import check_choice, check_ranges
from msdrivers.devices.gps import DAY, WEEK, course_from_track, novatel, resolve_rollover, to_covariance, utime_of
from msdrivers.devices.gps.nmea import EpochAssembler, NmeaEpoch, NmeaSentence, SentenceFormat
from msdrivers.devices.gps.novatel import CommandResponse, HeadingLog, LogHeader, NovatelLog, Position, Prompt, Velocity
from msdrivers.devices.stream import SECOND_NS, ByteSettings, FrameScanner, Script, SetupStep, StreamDriver
from msdrivers.endpoint import EndpointPhase, HostTime, Output, Send

POSITION_LOG = "BESTPOS"

HOLD_NS = SECOND_NS // 10
"""How long a position waits for the velocity of its instant: logs of one instant follow each other at once, and
BESTVEL takes 0.1 s at 9600 baud."""

GAP_NS = SECOND_NS // 25
"""Pause of the line after which the sentences of an instant are complete: receivers send those of one instant without
pauses, and USB adapters hold bytes up to 16 ms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsSettings(ByteSettings):
    """Settings of the receiver. Raises ValueError with the key for an invalid value."""

    protocol: str = "novatel"
    """`novatel` configures the receiver by commands; `nmea` only sends `commands` and reads."""
    rate_hz: float = 4.0
    """Of the logs that a NovAtel receiver is asked for, 0.1 to 20."""
    heading_log: str = ""
    """`HEADING` or `HEADING2` of a dual-antenna receiver, empty for none."""
    commands: tuple[str, ...] = ()
    """Lines sent before the logs are asked for, e.g. "fix none"; with `nmea` they are not acknowledged."""
    bauds: tuple[int, ...] = ()
    """The rates to try; the line is opened at the first. Empty: the line has none, or one that is right."""
    silence: float = 2.0
    """Timeout for fixes, seconds, after which the setup is repeated."""
    delay_sigma: float = 0.02
    """Standard deviation of `delay`, seconds."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_choice(self, protocol=("novatel", "nmea"), heading_log=("", "HEADING", "HEADING2"))
        check_ranges(self, rate_hz=(0.1, 20.0))
        for command in self.commands:
            if not command.strip() or not command.isprintable() or not command.isascii():
                raise ValueError(f"commands: {command!r} is no line of text")

    @property
    def logs(self) -> tuple[str, ...]:
        """The names of the logs that a NovAtel receiver is asked for."""
        return (POSITION_LOG, "BESTVEL", *filter(None, [self.heading_log])) if self.protocol == "novatel" else ()


GpsMessage: TypeAlias = NmeaEpoch | NovatelLog | CommandResponse | Prompt
"""Each has `start`: offset of its first byte in the stream, to find its receive time."""


class GpsStream(FrameScanner[Any]):
    """Parses bytes to messages in the order of their completion. Never raises; memory is bounded.

    The messages do not depend on how the bytes are split, except for calls of `flush`.
    """

    def __init__(self) -> None:
        super().__init__((SentenceFormat(), *novatel.FORMATS))
        self._epochs = EpochAssembler(self.reject)

    def feed(self, data: bytes) -> list[GpsMessage]:
        messages: list[GpsMessage] = []
        for each in super().feed(data):
            messages += self._epochs.add(each) if isinstance(each, NmeaSentence) else [each]
        return messages

    def flush(self) -> list[NmeaEpoch]:
        """Return the pending epoch: the line has been silent long enough for it to be complete."""
        return self._epochs.flush()

    def clear(self) -> None:
        super().clear()
        self._epochs.clear()


USABLE_TIME = {each for each in novatel.TimeStatus if novatel.TimeStatus.COARSE <= each < novatel.TimeStatus.SATTIME}
"""With the other statuses the header's time may be wrong by seconds or years."""

FIX_TYPES: dict[int, FixType] = {
    novatel.PositionType[name]: fix_type
    for fix_type, names in {
        FixType.FIX_2D: "FIXEDHEIGHT",
        FixType.FIX_3D: "SINGLE INS_PSRSP",
        FixType.DEAD_RECKONING: "PROPAGATED",
        FixType.DIFFERENTIAL: "PSRDIFF WAAS OMNISTAR INS_SBAS INS_PSRDIFF OMNISTAR_HP OMNISTAR_XP CDGPS PPP_CONVERGING "
        "PPP INS_PPP_CONVERGING INS_PPP PPP_BASIC_CONVERGING PPP_BASIC INS_PPP_BASIC_CONVERGING INS_PPP_BASIC",
        FixType.RTK_FLOAT: "FLOATCONV L1_FLOAT IONOFREE_FLOAT NARROW_FLOAT INS_RTKFLOAT",
        FixType.RTK_FIXED: "WIDELANE NARROWLANE L1_INT WIDE_INT NARROW_INT RTK_DIRECT_INS INS_RTKFIXED",
    }.items()
    for name in names.split()
}
"""The others are no satellite positions: none, entered by hand (FIXEDPOS), velocity only, or unknown."""


def sample_from_nmea(header: SensorHeader, epoch: NmeaEpoch) -> GpsSample:
    return GpsSample(
        header,
        epoch.fix_type,
        epoch.latitude,
        epoch.longitude,
        height_ellipsoidal=epoch.height_msl + epoch.undulation,
        height_msl=epoch.height_msl,
        undulation=epoch.undulation,
        satellites=epoch.satellites,
        hdop=epoch.hdop,
        vdop=epoch.vdop,
        pdop=epoch.pdop,
        position_covariance=to_covariance(epoch.sigma_longitude, epoch.sigma_latitude, epoch.sigma_height),
        speed=epoch.speed,
        course=course_from_track(epoch.track),
        baseline_yaw=course_from_track(epoch.heading),
    )


def sample_from_novatel(
    header: SensorHeader, position: Position, velocity: Velocity | None = None, heading: HeadingLog | None = None
) -> GpsSample:
    """Convert a position log, with velocity and heading of the same instant if available, to a sample."""
    # without a solution the receiver sends zeros
    empty = position.type == novatel.PositionType.NONE and position.latitude == 0.0 and position.longitude == 0.0
    height, undulation = (NAN, NAN) if empty else (position.height, position.undulation)
    velocity = velocity if velocity is not None and _is_solved(velocity) else None
    heading = heading if heading is not None and _is_solved(heading) else None
    track = math.radians(velocity.track) if velocity else NAN
    return GpsSample(
        header,
        FIX_TYPES.get(position.type, FixType.NONE) if _is_solved(position) else FixType.NONE,
        NAN if empty else position.latitude,
        NAN if empty else math.remainder(position.longitude, 360.0),
        height_ellipsoidal=height + undulation,
        height_msl=height,
        undulation=undulation,
        satellites=position.used,
        position_covariance=to_covariance(position.sigma_longitude, position.sigma_latitude, position.sigma_height),
        velocity=(velocity.horizontal * math.sin(track), velocity.horizontal * math.cos(track), velocity.vertical)
        if velocity
        else None,
        velocity_latency=max(0.0, velocity.latency - position.solution_age) if velocity else NAN,
        speed=velocity.horizontal if velocity else NAN,
        course=course_from_track(velocity.track) if velocity else NAN,
        baseline_yaw=course_from_track(heading.heading) if heading else NAN,
        baseline_yaw_sigma=math.radians(heading.sigma_heading) if heading and heading.sigma_heading > 0.0 else NAN,
    )


def _is_solved(log: Position | Velocity | HeadingLog) -> bool:
    return log.status == novatel.SolutionStatus.SOL_COMPUTED and log.type != novatel.PositionType.NONE


def _get_epoch_utime(epoch: NmeaEpoch, pivot: int) -> int:
    if epoch.time_of_day is None:
        return 0
    if epoch.utime:
        return resolve_rollover(epoch.utime, pivot)
    # without a date: the day that is nearest to the host's clock
    days = round((pivot - epoch.time_of_day) / DAY)
    return max(0, days * DAY + epoch.time_of_day)


_PROBLEMS = {
    "rejected.secondary_antenna": "logs of the secondary antenna, such as BESTPOSB_1, are not used",
    "rejected.datum": 'positions are not on WGS 84 and not used: add "datum wgs84" to the settings `commands`',
    "unknown_type": "the receiver names a position type that is not known here: its fixes are published as none",
}
"""What is reported once, by its counter."""

_EVIDENCE = ("nmea.", "novatel.", "rejected.nmea_incomplete", "rejected.nmea_field")
"""Counters by which the baud rate is right."""


class GpsDriver(StreamDriver[GpsMessage]):
    """An `Endpoint` of bytes at the host's end of a receiver's line; see `GpsSettings`.

    Further counts: `repeated`: duplicate instants. `superseded`: NMEA epochs of a receiver with logs. `rejected.datum`:
    positions on another datum than WGS 84. `rejected.secondary_antenna`: logs of the secondary antenna. `unknown_type`:
    fixes published as none for their type. `restarts`.
    """

    # an end of line first, to flush partial input
    identification = b"\r\nunlogall thisport\r\n"
    answer_timeout = 1.0
    _settings: GpsSettings
    _stream: GpsStream

    def __init__(self, settings: GpsSettings) -> None:
        super().__init__(settings, GpsStream())
        self._is_novatel = settings.protocol == "novatel"
        self.device = settings.protocol
        self.description = "NovAtel receiver" if self._is_novatel else "NMEA receiver"
        self.awaited = POSITION_LOG if self._is_novatel else "NMEA"
        self._waiting: tuple[LogHeader, Position, int, int] | None = None
        """The position that waits for its velocity, when it was received, utime, and until when, monotonic."""
        self._parts: dict[str, tuple[tuple[int, int], Velocity | HeadingLog]] = {}
        self._last_log: tuple[int, int] | None = None
        self._last_epoch: tuple[int, int | None] | None = None
        self._last_solution = -1
        self._counts_before: Mapping[str, int] = {}
        """Those of the stream at the last fix or search."""
        self._gap_ns: int | None = None
        """When the line has paused long enough."""
        self._prompt_until_ns = 0
        """Until then a prompt belongs to a response."""

    def _on_start(self) -> None:
        self._forget_logs()
        self._gap_ns = None
        self._counts_before = self._stream.counts

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._gap_ns = now.monotonic_ns + GAP_NS
        return super().on_receive(unit, now)

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        self._setup.stop()
        return [Send(_encode_command(f"unlog thisport {log.lower()}b")) for log in self._settings.logs]

    def _get_extra_deadline(self) -> int | None:
        deadlines = self._gap_ns, self._waiting[-1] if self._waiting else None
        return min((each for each in deadlines if each is not None), default=None)

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        out: list[Output[bytes]] = []
        if self._gap_ns is not None and now.monotonic_ns >= self._gap_ns:
            self._gap_ns = None
            for epoch in self._stream.flush():
                out += self._on_message(epoch, now)
        return out + (self._release(now) if self._waiting and now.monotonic_ns >= self._waiting[-1] else [])

    def _on_message(self, message: GpsMessage, now: HostTime) -> list[Output[bytes]]:
        if isinstance(message, CommandResponse):
            return self._on_command_response(message, now)
        if isinstance(message, Prompt):
            return self._on_prompt(message, now)
        arrival = self._find_arrival(message.start, now)
        if isinstance(message, NovatelLog):
            return self._on_log(message, arrival, now)
        return self._on_epoch(message, arrival, now)

    def _on_epoch(self, epoch: NmeaEpoch, host_utime: int, now: HostTime) -> list[Output[bytes]]:
        if self._is_novatel:
            return self._leave_out("superseded")
        instant = (epoch.utime, epoch.time_of_day)
        if epoch.time_of_day is not None and instant == self._last_epoch:
            return self._leave_out("repeated")
        self._last_epoch = instant
        header = self._make_header(host_utime, _get_epoch_utime(epoch, now.utime))
        return self._publish_fix(sample_from_nmea(header, epoch), now)

    def _on_log(self, log: NovatelLog, host_utime: int, now: HostTime) -> list[Output[bytes]]:
        header, body = log.header, log.body
        if header.name not in self._settings.logs or body is None:
            return []
        if header.is_secondary:
            return self._leave_out("rejected.secondary_antenna")
        instant = (header.week, header.milliseconds)
        if not isinstance(body, Position):
            self._parts[header.name] = (instant, body)
            return self._release_if_complete(now)
        solution = instant[0] * WEEK // 1000 + instant[1] - round(body.solution_age * 1000.0)
        if instant == self._last_log or (body.solution_age > 0.0 and solution == self._last_solution):
            return self._leave_out("repeated")
        self._last_solution = solution
        if body.datum != novatel.WGS84_DATUM:
            return self._leave_out("rejected.datum")
        out = self._release(now)
        if body.type not in novatel.PositionType.__members__.values():
            out += self._leave_out("unknown_type")
        self._last_log = instant
        self._waiting = (header, body, host_utime, now.monotonic_ns + HOLD_NS)
        return out + self._release_if_complete(now)

    def _release_if_complete(self, now: HostTime) -> list[Output[bytes]]:
        """Publish the waiting position if its velocity and heading are there."""
        if self._waiting is None:
            return []
        header = self._waiting[0]
        here = {name for name, (when, _) in self._parts.items() if when == (header.week, header.milliseconds)}
        return self._release(now) if here.issuperset(self._settings.logs[1:]) else []

    def _release(self, now: HostTime) -> list[Output[bytes]]:
        """Publish the waiting position with what there is of its instant."""
        if self._waiting is None:
            return []
        (log, position, host_utime, _), self._waiting = self._waiting, None
        parts = [part for when, part in self._parts.values() if when == (log.week, log.milliseconds)]
        velocity = next((part for part in parts if isinstance(part, Velocity)), None)
        heading = next((part for part in parts if isinstance(part, HeadingLog)), None)
        is_usable = log.time_status in USABLE_TIME
        device_utime = utime_of(log.week, log.milliseconds * 1000, now.utime) if is_usable else 0
        sample = sample_from_novatel(self._make_header(host_utime, device_utime), position, velocity, heading)
        return self._publish_fix(sample, now, max(0.0, position.solution_age))

    def _publish_fix(self, sample: GpsSample, now: HostTime, delay: float = 0.0) -> list[Output[bytes]]:
        self._counts_before = self._stream.counts
        return self._publish(sample, now, delay=delay)

    def _leave_out(self, name: str) -> list[Output[bytes]]:
        """Count what is not used, and report it once."""
        self._counts[name] += 1
        is_first = self._counts[name] == 1 and name in _PROBLEMS
        return self._set_status(self._phase, _PROBLEMS[name]) if is_first else []

    def _forget_logs(self) -> None:
        self._waiting = None
        self._parts.clear()

    def _on_command_response(self, answer: CommandResponse, now: HostTime) -> list[Output[bytes]]:
        self._prompt_until_ns = now.monotonic_ns + round(self.answer_timeout * SECOND_NS)
        if self._setup_step is None:
            interval = f"{1.0 / self._settings.rate_hz:.6g}"
            wanted = (f"log thisport {log.lower()}b ontime {interval}" for log in self._settings.logs)
            steps = [SetupStep(_encode_command(each), f"'{each}'") for each in (*self._settings.commands, *wanted)]
            return self._on_identity("a NovAtel receiver", steps, now)
        fix = "check the settings `commands` and the logs"
        return self._on_acknowledgement(now, f"{answer.error}; {fix}" if answer.error else "")

    def _on_prompt(self, prompt: Prompt, now: HostTime) -> list[Output[bytes]]:
        """Set up again after a restart: a prompt that belongs to no response."""
        if not self._is_novatel or self._setup.is_running or now.monotonic_ns < self._prompt_until_ns:
            return []
        self._counts["restarts"] += 1
        self._forget_logs()
        text = f"the receiver has restarted (prompt [{prompt.port}] without a command), setting it up again"
        return [*self._set_status(EndpointPhase.CONFIGURING, text), *self._setup.start(self._run_setup(), now)]

    def _run_setup(self) -> Script:
        """Configure the receiver; a plain NMEA receiver only gets the commands of the settings."""
        if self._is_novatel:
            yield from super()._run_setup()
            return
        self._first_bytes = b""
        for command in self._settings.commands:
            yield Send(_encode_command(command))
        self._restart_silence_timer()

    def _on_silence(self, now: HostTime) -> list[Output[bytes]]:
        """Repeat the setup if data arrives (a restart loses the logs), else try the next baud rate."""
        before, self._counts_before = self._counts_before, self._stream.counts
        # a single flawed sentence may be chance
        seen = [
            f"{number} {name}"
            for name, count in self._counts_before.items()
            if name.startswith(_EVIDENCE) and (number := count - before.get(name, 0)) > name.startswith("rejected")
        ]
        if self._phase is not EndpointPhase.STREAMING and not seen:
            return self._setup.start(self._run_search(), now)
        what, fix = "new fix", "are GGA or RMC on, with checksums, and does their time advance?"
        if self._is_novatel:
            what, fix = POSITION_LOG, "setting the receiver up again"
        text = f"no {what} for {self._settings.silence:g} s, received {', '.join(seen) or 'nothing'}; {fix}"
        return [*self._set_status(EndpointPhase.SILENT, text), *self._setup.start(self._run_setup(), now)]

    def _run_search(self) -> Script:
        yield from self._try_next_baud()
        yield from self._run_setup()


def _encode_command(command: str) -> bytes:
    return command.encode("ascii") + b"\r\n"
