"""Assemble fixes from position logs with their velocity and heading, or from NMEA epochs; convert them to samples.

NMEA epochs are used only while the position log is missing. Missing values stay nan.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from modelserver.messages import FixType, GpsSample, SensorHeader
from modelserver.messages.flags import NAN
from modelserver.transforms.so3 import Matrix3, Vector3
from msdrivers.endpoint import HostTime
from msdrivers.protocol import gps_time
from msdrivers.protocol.nmea import NmeaEpoch
from msdrivers.protocol.novatel import (
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    Velocity,
)

USABLE_TIME = frozenset(TimeStatus) - {
    TimeStatus.UNKNOWN,
    TimeStatus.APPROXIMATE,
    TimeStatus.COARSEADJUSTING,
    TimeStatus.SATTIME,
}
"""With the other statuses the header's time may be wrong by seconds or years."""

FIX_TYPES: dict[int, FixType] = {
    PositionType[name]: fix_type
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


def course_from_track(track: float) -> float:
    """Convert degrees clockwise from true north to radians counter-clockwise from true east, -pi to pi."""
    return math.remainder(math.radians(90.0 - track), math.tau)


def sample_from_nmea(header: SensorHeader, epoch: NmeaEpoch) -> GpsSample:
    """Convert an NMEA epoch to a sample."""
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
    empty = position.type == PositionType.NONE and position.latitude == 0.0 and position.longitude == 0.0
    height, undulation = (NAN, NAN) if empty else (position.height, position.undulation)
    velocity = velocity if velocity is not None and _is_solved(velocity) else None
    heading = heading if heading is not None and _is_solved(heading) else None
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
        velocity=_to_enu(velocity) if velocity else None,
        velocity_latency=max(0.0, velocity.latency - position.solution_age) if velocity else NAN,
        speed=velocity.horizontal if velocity else NAN,
        course=course_from_track(velocity.track) if velocity else NAN,
        baseline_yaw=course_from_track(heading.heading) if heading else NAN,
        baseline_yaw_sigma=math.radians(heading.sigma_heading) if heading and heading.sigma_heading > 0.0 else NAN,
    )


def to_covariance(east: float, north: float, up: float) -> Matrix3 | None:
    """Return the covariance of standard deviations, m2; None if one is missing (nan or 0)."""
    if not (east > 0.0 and north > 0.0 and up > 0.0):
        return None
    return (east * east, 0.0, 0.0, 0.0, north * north, 0.0, 0.0, 0.0, up * up)


def _is_solved(log: Position | Velocity | HeadingLog) -> bool:
    return log.status == SolutionStatus.SOL_COMPUTED and log.type != PositionType.NONE


def _to_enu(velocity: Velocity) -> Vector3:
    track = math.radians(velocity.track)
    return velocity.horizontal * math.sin(track), velocity.horizontal * math.cos(track), velocity.vertical


WGS84_DATUM = 61


@dataclass(frozen=True, slots=True)
class GpsFix:
    """A fix to publish. device_utime: 0 if the receiver's time is not usable. delay: seconds by which the fix is older
    than that. origin: name of the log, or NMEA."""

    host_utime: int
    device_utime: int
    origin: str
    solution: NmeaEpoch | Position
    velocity: Velocity | None = None
    heading: HeadingLog | None = None
    delay: float = 0.0

    def to_sample(self, header: SensorHeader) -> GpsSample:
        if isinstance(self.solution, NmeaEpoch):
            return sample_from_nmea(header, self.solution)
        return sample_from_novatel(header, self.solution, self.velocity, self.heading)


class FixAssembler:
    """Assembles logs and epochs to fixes, each instant once.

    logs: the names of the position log and of what belongs to it; empty for NMEA only.
    """

    def __init__(self, logs: Sequence[str], hold_ns: int, silence_ns: int) -> None:
        self._logs, self._hold_ns, self._silence_ns = tuple(logs), hold_ns, silence_ns
        self._parts: dict[str, tuple[tuple[int, int], Velocity | HeadingLog]] = {}
        self._waiting: tuple[GpsFix, tuple[int, int], int] | None = None
        self._last_log: tuple[int, int] | None = None
        self._last_log_ns: int | None = None
        self._last_epoch: tuple[int, int | None] | None = None
        self._last_solution = -1
        self._problems: list[str] = []
        self._reported: set[str] = set()
        self.counts: Counter[str] = Counter()
        """`repeated`: duplicate instants. `superseded`: NMEA epochs beside the position log. `rejected.datum`:
        positions on another datum than WGS 84. `rejected.secondary_antenna`: logs of the secondary antenna.
        `unknown_type`: fixes published as none for their type."""

    def clear(self) -> None:
        """Discard pending data: the line was closed, or the receiver has restarted."""
        self._parts.clear()
        self._waiting = None
        self._last_log_ns = None

    def pop_problems(self) -> list[str]:
        found, self._problems = self._problems, []
        return found

    def _add_problem(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            self._problems.append(text)

    def get_deadline(self) -> int | None:
        """Return the release time of the pending position, monotonic nanoseconds."""
        return self._waiting[2] if self._waiting else None

    def on_timer(self, now: HostTime) -> list[GpsFix]:
        """Release a position whose hold time has passed."""
        return self._release() if self._waiting and now.monotonic_ns >= self._waiting[2] else []

    def add_epoch(self, epoch: NmeaEpoch, host_utime: int, now: HostTime) -> list[GpsFix]:
        """Process an NMEA epoch whose first byte was received at `host_utime`."""
        if self._last_log_ns is not None and now.monotonic_ns - self._last_log_ns < self._silence_ns:
            self.counts["superseded"] += 1
            return []
        instant = (epoch.utime, epoch.time_of_day)
        if epoch.time_of_day is not None and instant == self._last_epoch:
            self.counts["repeated"] += 1
            return []
        self._last_epoch = instant
        return [GpsFix(host_utime, _get_epoch_utime(epoch, now.utime), "NMEA", epoch)]

    def add_log(self, log: NovatelLog, host_utime: int, now: HostTime) -> list[GpsFix]:
        """Process a log whose first byte was received at `host_utime`."""
        if log.header.name not in self._logs or log.body is None:
            return []
        if log.header.is_secondary:
            self.counts["rejected.secondary_antenna"] += 1
            self._add_problem(
                f"{log.header.label} is of the secondary antenna and is not used: log {log.header.name} without _1"
            )
            return []
        instant = (log.header.week, log.header.milliseconds)
        if not isinstance(log.body, Position):
            assert isinstance(log.body, (Velocity, HeadingLog))
            self._parts[log.header.name] = (instant, log.body)
            return self._release_if_complete(instant)
        solution = instant[0] * gps_time.WEEK // 1000 + instant[1] - round(log.body.solution_age * 1000.0)
        if instant == self._last_log or (log.body.solution_age > 0.0 and solution == self._last_solution):
            self.counts["repeated"] += 1
            return []
        self._last_solution = solution
        if log.body.datum != WGS84_DATUM:
            self.counts["rejected.datum"] += 1
            self._add_problem('positions are not on WGS 84 and not used: add "datum wgs84" to the settings `commands`')
            return []
        if log.body.type not in PositionType.__members__.values():
            self.counts["unknown_type"] += 1
            self._add_problem(
                "the receiver names a position type that is not known here: its fixes are published as none"
            )
        fixes = self._release()
        self._last_log, self._last_log_ns = instant, now.monotonic_ns
        device = get_log_utime(log.header, now.utime)
        fix = GpsFix(host_utime, device, log.header.name, log.body, delay=max(0.0, log.body.solution_age))
        self._waiting = (fix, instant, now.monotonic_ns + self._hold_ns)
        return fixes + self._release_if_complete(instant)

    def _release_if_complete(self, instant: tuple[int, int]) -> list[GpsFix]:
        """Release the pending position if its velocity and heading are complete."""
        if self._waiting is None or self._waiting[1] != instant:
            return []
        here = {name for name, (when, _) in self._parts.items() if when == instant}
        return self._release() if here.issuperset(self._logs[1:]) else []

    def _release(self) -> list[GpsFix]:
        if self._waiting is None:
            return []
        fix, instant, _ = self._waiting
        self._waiting = None
        for when, part in self._parts.values():
            if when == instant:
                fix = replace(fix, velocity=part) if isinstance(part, Velocity) else replace(fix, heading=part)
        return [fix]


def get_log_utime(header: LogHeader, pivot: int) -> int:
    """Return the utime of a log; 0 if the receiver's time is not usable or within a leap second."""
    microseconds = header.milliseconds * 1000
    if header.time_status not in USABLE_TIME or gps_time.is_in_leap_second(header.week, microseconds, pivot):
        return 0
    return gps_time.utime_of(header.week, microseconds, pivot)


def _get_epoch_utime(epoch: NmeaEpoch, pivot: int) -> int:
    if epoch.time_of_day is None or epoch.is_leap_second:
        return 0
    if epoch.utime:
        return gps_time.resolve_rollover(epoch.utime, pivot)
    # without a date: the day that is nearest to the host's clock
    days = round((pivot - epoch.time_of_day) / gps_time.DAY)
    return max(0, days * gps_time.DAY + epoch.time_of_day)
