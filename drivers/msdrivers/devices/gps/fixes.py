"""Puts together what belongs to one fix: a position log with the velocity of its instant, or an NMEA epoch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from modelserver.messages import GpsSample, SensorHeader
from msdrivers.devices.gps.samples import USABLE_TIME, nmea_sample, novatel_sample
from msdrivers.protocol import gps_time
from msdrivers.protocol.nmea import NmeaEpoch
from msdrivers.protocol.novatel import HeadingLog, LogHeader, NovatelLog, Position, PositionType, Velocity
from msdrivers.station import Now

WGS84 = 61


@dataclass(frozen=True, slots=True)
class GpsFix:
    """A fix to publish. device_utime: 0 where the receiver's time cannot be used. delay: seconds by which the fix is
    older than that. origin: the log or sentences it is from, for people."""

    host_utime: int
    device_utime: int
    origin: str
    said: NmeaEpoch | Position
    velocity: Velocity | None = None
    heading: HeadingLog | None = None
    delay: float = 0.0

    def sample(self, header: SensorHeader) -> GpsSample:
        """Return the sample with its header."""
        if isinstance(self.said, NmeaEpoch):
            return nmea_sample(header, self.said)
        return novatel_sample(header, self.said, self.velocity, self.heading)


class FixAssembler:
    """Takes logs and epochs; gives fixes, each instant once.

    logs: the names of the position log and of what belongs to it; empty for NMEA only.
    """

    def __init__(self, logs: Sequence[str], hold_ns: int, silence_ns: int) -> None:
        self._logs = tuple(logs)
        self._hold_ns = hold_ns
        self._silence_ns = silence_ns
        self._parts: dict[str, tuple[tuple[int, int], Velocity | HeadingLog]] = {}
        self._waiting: tuple[GpsFix, tuple[int, int], int] | None = None
        self._last_log: tuple[int, int] | None = None
        self._last_log_ns: int | None = None
        self._last_epoch: tuple[int, int | None] | None = None
        self._last_solution = -1
        self._problems: list[str] = []
        self._told: set[str] = set()
        self.counts: Counter[str] = Counter()
        """`repeated`: instants that came again. `superseded`: NMEA epochs beside the position log. `rejected.datum`:
        positions on another datum than WGS 84. `rejected.secondary_antenna`: logs of the secondary antenna.
        `unknown_type`: fixes published as none for their type."""

    def clear(self) -> None:
        """Forget what waits: the line was closed, or the receiver has started anew."""
        self._parts.clear()
        self._waiting = None
        self._last_log_ns = None

    def problems(self) -> list[str]:
        """Return what a person should know, once."""
        found, self._problems = self._problems, []
        return found

    def _problem(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._problems.append(text)

    def due(self) -> int | None:
        """Return the monotonic nanoseconds at which a position has waited long enough."""
        return self._waiting[2] if self._waiting else None

    def woken(self, now: Now) -> list[GpsFix]:
        """Return the position that has waited long enough."""
        return self._release() if self._waiting and now.monotonic_ns >= self._waiting[2] else []

    def epoch(self, epoch: NmeaEpoch, host_utime: int, now: Now) -> list[GpsFix]:
        """Take an NMEA epoch that began to come in at `host_utime`."""
        if self._last_log_ns is not None and now.monotonic_ns - self._last_log_ns < self._silence_ns:
            self.counts["superseded"] += 1
            return []
        instant = (epoch.utime, epoch.time_of_day)
        if epoch.time_of_day is not None and instant == self._last_epoch:
            self.counts["repeated"] += 1
            return []
        self._last_epoch = instant
        return [GpsFix(host_utime, _device_utime(epoch, now.utime), "NMEA", epoch)]

    def log(self, log: NovatelLog, host_utime: int, now: Now) -> list[GpsFix]:
        """Take a log that began to come in at `host_utime`."""
        if log.header.name not in self._logs or log.body is None:
            return []
        if log.header.antenna:
            self.counts["rejected.secondary_antenna"] += 1
            self._problem(
                f"{log.header.label} is of the secondary antenna and is not used: log {log.header.name} without _1"
            )
            return []
        instant = (log.header.week, log.header.milliseconds)
        if not isinstance(log.body, Position):
            assert isinstance(log.body, (Velocity, HeadingLog))
            self._parts[log.header.name] = (instant, log.body)
            return self._complete(instant)
        solution = instant[0] * gps_time.WEEK // 1000 + instant[1] - round(log.body.solution_age * 1000.0)
        if instant == self._last_log or (log.body.solution_age > 0.0 and solution == self._last_solution):
            self.counts["repeated"] += 1
            return []
        self._last_solution = solution
        if log.body.datum != WGS84:
            self.counts["rejected.datum"] += 1
            self._problem('positions are not on WGS 84 and not used: add "datum wgs84" to the settings `commands`')
            return []
        if log.body.type not in PositionType.__members__.values():
            self.counts["unknown_type"] += 1
            self._problem("the receiver names a position type that is not known here: its fixes are published as none")
        fixes = self._release()
        self._last_log, self._last_log_ns = instant, now.monotonic_ns
        device = device_utime(log.header, now.utime)
        fix = GpsFix(host_utime, device, log.header.name, log.body, delay=max(0.0, log.body.solution_age))
        self._waiting = (fix, instant, now.monotonic_ns + self._hold_ns)
        return fixes + self._complete(instant)

    def _complete(self, instant: tuple[int, int]) -> list[GpsFix]:
        """Release the position that waits if all that belongs to it is there."""
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


def device_utime(header: LogHeader, pivot: int) -> int:
    """Return the utime of a log; 0 where the receiver does not know it well, or UTC has no name for it."""
    microseconds = header.milliseconds * 1000
    if header.time_status not in USABLE_TIME or gps_time.in_leap_second(header.week, microseconds, pivot):
        return 0
    return gps_time.utime_of(header.week, microseconds, pivot)


def _device_utime(epoch: NmeaEpoch, pivot: int) -> int:
    if epoch.time_of_day is None or epoch.leap_second:
        return 0
    if epoch.utime:
        return gps_time.unrolled(epoch.utime, pivot)
    # a receiver that never tells the date: the day that brings it nearest to the host's clock
    days = round((pivot - epoch.time_of_day) / gps_time.DAY)
    return max(0, days * gps_time.DAY + epoch.time_of_day)
