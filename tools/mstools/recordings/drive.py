"""A drive as a viewer shows it: geometry, poses, joints, fixes and events over time, from a log or a running service.

`Drive.feed` processes one message and stores what a picture needs; `Drive.get_picture` returns the picture of an
instant, and `FramePoses` where the bodies of the model are in it. Poses and joints are stored at most once per
`PICTURE_PERIOD_US`, more than a screen shows, so an hour of them takes some 20 MB, and is read without decoding the
rest. Neither has a clock or a socket; `follow_bus` has.
"""

from __future__ import annotations

import math
import re
import struct
import time
from bisect import bisect_right
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import lru_cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.earth import Origin
from modelserver.earth.geodesy import GeodesyError, geodesy_of, origin_at
from modelserver.errors import QueryError, WireError
from modelserver.formats.yaml_geometry import decode_snapshot
from modelserver.geometry.joint import Coordinates, coordinate_names
from modelserver.geometry.kinematic_path import KinematicPath
from modelserver.geometry.model import Model
from modelserver.messages import (
    VALID,
    Decision,
    DriverHealth,
    FixType,
    GpsSample,
    Invalid,
    JointsSample,
    Mode,
    PoseAnswer,
    SnapshotPart,
    Verdict,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import SnapshotAssembler, decode, fingerprint_of
from modelserver.wire.fields import read_text
from modelserver.wire.provider import handle_message

if TYPE_CHECKING:
    import lcm

PICTURE_PERIOD_US: Final = 30_000
"""Least time between two stored poses, and two stored messages of joints of one source, microseconds."""

MAX_ROWS: Final = 150_000
"""Rows of a table: an hour and more of pictures. More are thinned."""

MAX_DELAY_US: Final = 1_000_000
"""A row may come later than its successors by this time."""

MAX_STAMP: Final = (1 << 32) * 1_000_000
"""Stamps are below this, in the year 2106; more is no stamp."""

MAX_EVENTS: Final = 2_000
MAX_CHANNELS: Final = 500
MAX_GEOMETRIES: Final = 100
SILENCE_US: Final = 3_000_000
"""Time without a message after which the service counts as silent, microseconds; health is published each second."""

MAX_REPORT_PERIOD_US: Final = 900_000
"""Reports of health and of the filter's state are stored about once a second, as bytes."""

REPEATED_EVENT_US: Final = 1_000_000
"""Events of one kind and text are one event while they follow each other within this time."""

SOURCE_OFFSET: Final = 48
"""Offset of the source in the bytes of a sample, behind fingerprint and the numbers of sensor_header_t."""

POSITION_KIND: Final = "gps_position"
"""The kind of decisions that are about the position of a fix."""


class FixColor(IntEnum):
    """What became of a fix, by which it is colored."""

    USED = 0
    REJECTED = 1
    MONITORED = 2
    NO_DECISION = 3


class EventKind(StrEnum):
    """Kinds of events that the viewer jumps to."""

    INVALID = "invalid"
    VALID = "valid"
    REJECTION = "rejection"
    RESET = "reset"
    MODE = "mode"
    GEOMETRY = "geometry"


@dataclass(slots=True)
class DriveEvent:
    """Something that happened at `utime`, `count` times until `last`."""

    utime: int
    kind: EventKind
    text: str
    last: int = 0
    count: int = 1


class Table:
    """Rows of numbers in the order of their times. Appending is cheap.

    At `MAX_ROWS` every second row is dropped, and rows that follow are no denser than those: a table has all of a drive
    however long it is, and always the last row.
    """

    def __init__(self, columns: int):
        self._utimes = np.zeros(1024, np.int64)
        self._rows = np.zeros((1024, columns))
        self._earlier = 0
        self._period = 0
        self.count = 0

    @property
    def utimes(self) -> npt.NDArray[np.int64]:
        return self._utimes[: self.count]

    @property
    def rows(self) -> Array:
        return self._rows[: self.count]

    @property
    def last(self) -> int:
        """The time of the last row, 0 without any."""
        return int(self._utimes[self.count - 1]) if self.count else 0

    def append(self, utime: int, *values: float) -> None:
        """Append a row. One that is not later than the last row is ignored.

        Where two rows in succession are earlier by more than `MAX_DELAY_US`, the clock was set back, or the last row's
        time was wrong: the rows after them are dropped.
        """
        if utime <= self.last and self.count:
            is_second = 0 < utime - self._earlier < MAX_DELAY_US
            self._earlier = utime
            if not is_second or utime > self.last - MAX_DELAY_US:
                return
            self.count = self.find(utime - 1) + 1
        if self._period and utime - self._utimes[self.count - 2] < self._period:
            # in place of the last row
            self.count -= 1
        if self.count >= MAX_ROWS:
            retained = len(self.utimes[::2])
            self._utimes[:retained], self._rows[:retained] = self.utimes[::2].copy(), self.rows[::2].copy()
            self.count = retained
            self._period = int(np.median(np.diff(self.utimes)))
        if self.count == len(self._utimes):
            self._utimes = np.concatenate([self._utimes, np.zeros_like(self._utimes)])
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._utimes[self.count] = utime
        self._rows[self.count] = values
        self.count += 1

    def find(self, utime: int) -> int:
        """Return the number of the last row at or before a time, -1 where there is none."""
        return int(np.searchsorted(self.utimes, utime, side="right")) - 1


@dataclass(slots=True)
class ChannelCount:
    """Messages of a channel: their number, receive time of the last, and rate in Hz over the last seconds.

    `course` has the rate of each second, and the longest time from a stamp to the receipt in it, seconds.
    """

    count: int = 0
    last: int = 0
    rate: float = math.nan
    course: Table = field(default_factory=lambda: Table(2))
    _first: int = 0
    _since: int = 0
    _counted: int = 1
    _latency: float = math.nan

    def add(self, now: int, stamp: int = 0) -> None:
        if not self.count:
            self._first = self._since = now
        self.count += 1
        self.last = now
        # also in place of nan
        if stamp and not (latency := (now - stamp) * 1e-6) <= self._latency:
            self._latency = latency
        if now - self._since >= 1_000_000:
            self.rate = (self.count - self._counted) / ((now - self._since) * 1e-6)
            self.course.append(now, self.rate, self._latency)
            self._since, self._counted, self._latency = now, self.count, math.nan

    @property
    def mean_rate(self) -> float:
        """Rate over all messages, Hz; nan for fewer than two."""
        seconds = (self.last - self._first) * 1e-6
        return (self.count - 1) / seconds if seconds > 0.0 else math.nan


class Picture(NamedTuple):
    """The vehicle at `utime`: pose of the base frame in World:UTM, None where it is unknown, and what is known of it.

    `covariance` is that of the position (3, 3), m2; `joints` gives the position of each coordinate that was received.
    """

    utime: int
    pose: Pose | None = None
    invalid: Invalid = VALID
    covariance: Array | None = None
    horizontal_protection_level: float = math.nan
    heading_protection_level: float = math.nan
    joints: Mapping[str, float] = {}


# columns of the table of poses
POSITION, QUATERNION, COVARIANCE = slice(0, 3), slice(3, 7), slice(7, 13)
HORIZONTAL, HEADING, INVALID, EPOCH = range(13, 17)
_POSE_COLUMNS: Final = 17
_UPPER: Final = np.triu_indices(3)
FIX_POSITION, FIX_COLOR, FIX_COLUMNS = slice(3, 6), 6, 10

ODOMETRY_PERIOD_US: Final = 100_000
"""Least time between two stored poses of odometry, microseconds: a quarter of the time that a speed is of."""

MAX_INTERPOLATION_US: Final = 1_000_000
"""Longest time between two poses that is interpolated."""


@dataclass
class Drive:
    """What is known of a drive. Channels have the prefix `prefix`; `model` is the geometry, from a snapshot or given.

    `poses` is a table, `origin` that of the newest pose, without any the place of the first fix; `channels` counts all
    messages by channel; `nis` has a measurement's normalized innovation squared per degree of freedom, by source and
    kind. `on_event` is called with each new event.
    """

    prefix: str = ""
    model: Model | None = None
    base_frame: str = ""
    keep_geometry: bool = False
    origin: Origin | None = None
    poses: Table = field(default_factory=lambda: Table(_POSE_COLUMNS))
    odometry: Table = field(default_factory=lambda: Table(_POSE_COLUMNS))
    joints: dict[str, Table] = field(default_factory=dict)
    events: list[DriveEvent] = field(default_factory=list)
    channels: dict[str, ChannelCount] = field(default_factory=dict)
    drivers: dict[str, DriverHealth] = field(default_factory=dict)
    nis: dict[str, Table] = field(default_factory=dict)
    damaged: int = 0
    on_event: Callable[[DriveEvent], None] | None = None

    def __post_init__(self) -> None:
        self._coordinates = _list_coordinates(self.model)
        self._fixes: dict[str, Table] = {}
        self._assembler = SnapshotAssembler()
        self._geometries: list[tuple[int, Model, str]] = []
        self.joints_channel = f"{self.prefix}JOINTS"
        self._sources: dict[str, int] = {}
        self._last_pose = self._last_odometry = 0
        self._reports: dict[str, list[tuple[int, bytes]]] = {}
        self._invalid: Invalid | None = None
        self._mode: Mode | None = None
        self._epoch = -1
        self._gps = fingerprint_of("gps_t")
        self._handlers = {
            f"{self.prefix}POSE": self._process_pose,
            f"{self.prefix}POSE_ODOM": self._process_odometry,
            f"{self.prefix}MODEL_SNAPSHOT": self._process_snapshot,
            f"{self.prefix}JOINTS_HELD": self._process_joints,
            f"{self.prefix}LOCALIZATION_DECISIONS": self._process_decisions,
            f"{self.prefix}LOCALIZATION_STATE": self._store_report,
            f"{self.prefix}MODELSERVER_HEALTH": self._store_report,
            f"{self.prefix}DRIVER_HEALTH": self._process_driver,
        }

    # --- messages

    def feed(self, channel: str, data: bytes, now: int) -> None:
        """Process a message received at `now`, microseconds. Raises nothing; `damaged` counts what is malformed."""
        counted = self.channels.get(channel)
        if counted is None:
            if len(self.channels) >= MAX_CHANNELS or not channel.startswith(self.prefix):
                return
            counted = self.channels[channel] = ChannelCount()
        stamp = read_stamp(data)
        handler = self._handlers.get(channel)
        if not 0 < stamp < MAX_STAMP:
            # every message of this project begins with its stamp; what does not is of no use here
            counted.add(now)
            self.damaged += handler is not None
            return
        counted.add(now, stamp)
        try:
            if handler is not None:
                handler(channel[len(self.prefix) :], stamp, data)
            elif data[:8] == self._gps:
                self._process_gps(decode("gps_t", data))
            elif channel == self.joints_channel:
                self._process_joints(channel[len(self.prefix) :], stamp, data)
        except (WireError, GeodesyError, struct.error):
            self.damaged += 1

    def _process_snapshot(self, name: str, stamp: int, data: bytes) -> None:
        part: SnapshotPart = decode("model_snapshot_t", data)
        if self.model is not None and part.model_revision == self.model.revision:
            return
        whole = self._assembler.add(part)
        if whole is None:
            return
        snapshot = decode_snapshot(whole)
        self.joints_channel = snapshot.joints_channel
        self.base_frame = snapshot.base_frame
        if self.keep_geometry:
            return
        if self.model is not None:
            self._add_event(part.utime, EventKind.GEOMETRY, f"geometry revision {snapshot.model.revision}")
        self._geometries = [*self._geometries[-MAX_GEOMETRIES:], (part.utime, snapshot.model, snapshot.base_frame)]
        self.set_model(snapshot.model)

    def set_model(self, model: Model) -> None:
        self.model = model
        self._coordinates = _list_coordinates(model)

    def _process_pose(self, name: str, stamp: int, data: bytes) -> None:
        # the stamp alone decides whether the rest is read
        if 0 <= stamp - self._last_pose < PICTURE_PERIOD_US and self.poses.count:
            return
        answer: PoseAnswer = decode("pose_transform_t", data)
        found = answer.transformation
        self._last_pose = stamp
        if answer.origin is not None and answer.origin != self.origin:
            self.origin = answer.origin
            self._place_fixes()
        self.poses.append(stamp, *_make_row(answer))
        invalid, epoch = Invalid(found.invalid_reasons), found.pose_epoch
        if self._invalid is not None and invalid != self._invalid:
            kind = EventKind.INVALID if invalid else EventKind.VALID
            self._add_event(stamp, kind, invalid.explain() if invalid else "the pose is valid")
        if self._epoch >= 0 and epoch != self._epoch:
            self._add_event(stamp, EventKind.RESET, f"the position was reset: epoch {epoch}")
        self._invalid, self._epoch = invalid, epoch

    def _process_odometry(self, name: str, stamp: int, data: bytes) -> None:
        if not 0 <= stamp - self._last_odometry < ODOMETRY_PERIOD_US:
            self._last_odometry = stamp
            self.odometry.append(stamp, *_make_row(decode("pose_transform_t", data)))

    @property
    def motion(self) -> Table:
        """The poses that speeds are derived from: of odometry, which no fix corrects, where there are some."""
        return self.odometry if self.odometry.count else self.poses

    def _process_joints(self, name: str, stamp: int, data: bytes) -> None:
        # stamp and source alone decide whether the rest is read
        source = f"{name} {read_text(data, SOURCE_OFFSET)[0]}"
        if 0 <= stamp - self._sources.get(source, 0) < PICTURE_PERIOD_US:
            return
        sample: JointsSample = decode("joints_t", data)
        if source in self._sources or len(self._sources) < MAX_CHANNELS:
            self._sources[source] = stamp
        for joint in sample.joints:
            if joint.name in self._coordinates and math.isfinite(joint.position):
                self.set_joint(joint.name, sample.header.utime, joint.position)

    def set_joint(self, name: str, utime: int, position: float) -> None:
        self.joints.setdefault(name, Table(1)).append(utime, position)

    def _process_gps(self, sample: GpsSample) -> None:
        place = (sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
        if sample.fix_type is FixType.NONE or not all(map(math.isfinite, place[:2])):
            return
        source, height = sample.header.source, place[2] if math.isfinite(place[2]) else sample.height_msl
        known = (place[0], place[1], height if math.isfinite(height) else 0.0)
        if source not in self._fixes and len(self._fixes) >= MAX_CHANNELS:
            return
        if self.origin is None:
            # until the service publishes its own
            self.origin = origin_at(*known)
        covariance = sample.position_covariance
        east, north, east_north = (covariance[0], covariance[4], covariance[1]) if covariance else (math.nan,) * 3
        table = self._fixes.setdefault(source, Table(FIX_COLUMNS))
        table.append(sample.header.utime, *known, *self._place(known), FixColor.NO_DECISION, east, north, east_north)

    def _place(self, place: Vector3) -> Vector3:
        assert self.origin is not None
        geodesy = geodesy_of(self.origin)
        return geodesy.to_relative_utm(geodesy.utm_from_geodetic(*place))

    def _place_fixes(self) -> None:
        """Place the fixes in World:UTM of another origin."""
        for table in self._fixes.values():
            for row in table.rows:
                row[FIX_POSITION] = self._place((row[0], row[1], row[2]))

    def _process_decisions(self, name: str, stamp: int, data: bytes) -> None:
        for decision in decode("decisions_t", data).decisions:
            self._process_decision(decision)

    def _process_decision(self, decision: Decision) -> None:
        if not 0 < decision.utime < MAX_STAMP:
            raise WireError("malformed", f"{decision.utime} is no stamp")
        table, is_reset = self._fixes.get(decision.source), decision.verdict is Verdict.RESET
        if decision.kind == POSITION_KIND and table is not None:
            row = table.find(decision.utime)
            if row >= 0 and table.utimes[row] == decision.utime:
                table.rows[row, FIX_COLOR] = FixColor.USED if is_reset else FixColor[decision.verdict.name]
        normalized = compute_nis(decision)
        if normalized is not None:
            name, value = normalized
            if name in self.nis or len(self.nis) < MAX_CHANNELS:
                self.nis.setdefault(name, Table(1)).append(decision.utime, value)
        if is_reset or decision.verdict is Verdict.REJECTED:
            verb = "reset by" if is_reset else "rejected"
            reason = f": {decision.reason}" if decision.reason else ""
            kind = EventKind.RESET if is_reset else EventKind.REJECTION
            self._add_event(decision.utime, kind, f"{verb} {decision.kind} of {decision.source}{reason}")

    def _process_driver(self, name: str, stamp: int, data: bytes) -> None:
        health: DriverHealth = decode("driver_health_t", data)
        if health.source in self.drivers or len(self.drivers) < MAX_CHANNELS:
            self.drivers[health.source] = health

    def _store_report(self, name: str, stamp: int, data: bytes) -> None:
        stored = self._reports.setdefault(name, [])
        if name == "LOCALIZATION_STATE":
            self._add_mode_event(stamp, data)
        if stored and 0 <= stamp - stored[-1][0] < MAX_REPORT_PERIOD_US:
            return
        stored.append((stamp, data))
        if len(stored) > MAX_ROWS // 30:
            del stored[1::2]

    def _add_mode_event(self, utime: int, data: bytes) -> None:
        try:
            mode = Mode(int.from_bytes(data[16:17], "big", signed=True))
        except ValueError:
            return
        if self._mode not in (None, mode):
            self._add_event(utime, EventKind.MODE, f"mode {mode.name.lower()}")
        self._mode = mode

    def _add_event(self, utime: int, kind: EventKind, text: str) -> None:
        for last in self.events[-5:]:
            if (last.kind, last.text) == (kind, text) and utime - (last.last or last.utime) < REPEATED_EVENT_US:
                last.last, last.count = utime, last.count + 1
                return
        self.events.append(DriveEvent(utime, kind, text, utime))
        if self.on_event is not None:
            self.on_event(self.events[-1])
        if len(self.events) > MAX_EVENTS:
            del self.events[: MAX_EVENTS // 2]

    # --- pictures

    @property
    def begin(self) -> int:
        """The time of the first stored pose or joint reading, without a pose of the first fix; 0 without any."""
        tables = [each for each in self._list_timed() if each.count]
        return min((int(each.utimes[0]) for each in tables), default=0)

    @property
    def end(self) -> int:
        """The time of the last stored pose or joint reading, without a pose of the last fix; 0 without any."""
        return max((each.last for each in self._list_timed()), default=0)

    def _list_timed(self) -> list[Table]:
        return [self.poses, *self.joints.values(), *([] if self.poses.count else self._fixes.values())]

    def get_geometry(self, utime: int = 0) -> tuple[Model | None, str]:
        """Return the model at a time, and the frame whose pose is published; the latest at 0.

        Before the first snapshot it is that of the first.
        """
        if not utime or not self._geometries:
            return self.model, self.base_frame
        earlier = [each for each in self._geometries if each[0] <= utime]
        _, model, base_frame = earlier[-1] if earlier else self._geometries[0]
        return model, base_frame

    def find_silence(self, now: int) -> str:
        """Return in words that the service publishes nothing, empty if it does. `now` is the time, microseconds."""
        published = [self.channels.get(f"{self.prefix}{name}") for name in ("POSE", "MODELSERVER_HEALTH")]
        last = max((each.last for each in published if each is not None), default=0)
        if now - last < SILENCE_US:
            return ""
        since = f"no message of the service for {(now - last) * 1e-6:.0f} s" if last else "no message of a service yet"
        return f"{since}; is it running (modelserver run -c vehicle.yaml), on this bus and with this channel prefix?"

    def get_fixes(self, utime: int) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the positions in World:UTM (n, 3) of the fixes until a time, and their `FixColor` (n,)."""
        found = np.concatenate([np.zeros((0, FIX_COLUMNS)), *self.get_fix_tables(utime).values()])
        return found[:, FIX_POSITION], found[:, FIX_COLOR].astype(np.int64)

    def get_fix_tables(self, utime: int) -> dict[str, Array]:
        """Return the fixes until a time by source (n, 10): latitude and longitude in degrees, height, position in
        World:UTM, `FixColor`, and the covariance of the position (east, north, east with north), m2.
        """
        return {source: table.rows[: table.find(utime) + 1] for source, table in self._fixes.items()}

    def get_track(self, utime: int, seconds: float = math.inf) -> tuple[npt.NDArray[np.int64], Array]:
        """Return times (n,) and positions in World:UTM (n, 3) of the last seconds before a time, after a reset."""
        end = self.poses.find(utime) + 1
        first = 0
        if math.isfinite(seconds):
            first = int(np.searchsorted(self.poses.utimes, utime - round(seconds * 1e6)))
        jumps = np.flatnonzero(np.diff(self.poses.rows[first:end, EPOCH]) != 0)
        if len(jumps):
            first += int(jumps[-1]) + 1
        return self.poses.utimes[first:end], self.poses.rows[first:end, POSITION]

    def get_picture(self, utime: int = 0) -> Picture:
        """Return the picture at a time, or the latest one at 0; poses in between are interpolated."""
        utime = utime or self.end
        joints = self.get_joints(utime)
        at = self.poses.find(utime)
        if at < 0:
            return Picture(utime, joints=joints)
        row = self.poses.rows[at]
        pose = _read_pose(row)
        if at + 1 < self.poses.count and self.poses.rows[at + 1, EPOCH] == row[EPOCH]:
            first, second = (int(each) for each in self.poses.utimes[at : at + 2])
            if second - first <= MAX_INTERPOLATION_US:
                pose = pose.interpolate(_read_pose(self.poses.rows[at + 1]), (utime - first) / (second - first))
        covariance = None
        if math.isfinite(row[COVARIANCE.start]):
            covariance = np.zeros((3, 3))
            covariance[_UPPER] = row[COVARIANCE]
            covariance = covariance + np.triu(covariance, 1).T
        levels = float(row[HORIZONTAL]), float(row[HEADING])
        return Picture(utime, pose, Invalid(int(row[INVALID])), covariance, *levels, joints)

    def get_joints(self, utime: int) -> dict[str, float]:
        found = {name: (table, table.find(utime)) for name, table in self.joints.items()}
        return {name: float(table.rows[row, 0]) for name, (table, row) in found.items() if row >= 0}

    def get_report(self, name: str, utime: int = 0) -> Any:
        """Return the last report on a channel at or before a time, None without one; the latest one at 0."""
        stored = self._reports.get(name, [])
        at = len(stored) if not utime else bisect_right(stored, utime, key=itemgetter(0))
        try:
            return decode(BY_NAME[name].type_name, stored[at - 1][1]) if at else None
        except WireError:
            return None

    def get_state_course(self, state: str, utime: int = 0, seconds: float = 60.0) -> tuple[Array, Array, Array]:
        """Return times (n,), values (n,) and standard deviations (n,) of a state of the filter before a time.

        Times are in seconds relative to that time; the latest at 0.
        """
        end = utime or self.end
        stored = self._reports.get("LOCALIZATION_STATE", [])
        rows = []
        for stamp, data in stored[bisect_right(stored, end - round(seconds * 1e6), key=itemgetter(0)) :]:
            if stamp > end:
                break
            with suppress(WireError, KeyError):
                rows.append(((stamp - end) * 1e-6, *_read_states(data)[state]))
        times, values, sigmas = np.array(rows, float).reshape(-1, 3).T
        return times, values, sigmas


@lru_cache(maxsize=MAX_ROWS // 30)
def _read_states(data: bytes) -> dict[str, tuple[float, float]]:
    """Return value and standard deviation of each state of the filter. A chart asks for all of them again and again."""
    navigation = decode("navigation_state_t", data)
    variances = navigation.covariance[:: len(navigation.names) + 1]
    sigmas = (math.sqrt(max(each, 0.0)) for each in variances)
    return dict(zip(navigation.names, zip(navigation.values, sigmas, strict=True), strict=True))


def compute_nis(decision: Decision) -> tuple[str, float] | None:
    """Return source and kind of a measurement, and its NIS per degree of freedom; None where it has none."""
    if decision.verdict is Verdict.RESET or decision.dof == 0 or not math.isfinite(decision.statistic):
        return None
    return f"{decision.source} {decision.kind}", decision.statistic / decision.dof


def read_stamp(data: bytes) -> int:
    """Return the stamp of a message, which is behind the fingerprint; 0 for one that is too short."""
    return int.from_bytes(data[8:16], "big", signed=True) if len(data) >= 16 else 0


def _make_row(answer: PoseAnswer) -> tuple[float, ...]:
    """Return a pose as a row of `Drive.poses`."""
    found = answer.transformation
    covariance = found.covariance
    upper = np.full(6, math.nan) if covariance is None else covariance[:3, :3][_UPPER]
    levels = (answer.horizontal_protection_level, answer.heading_protection_level)
    return (*found.pose.xyz, *found.pose.wxyz, *upper, *levels, found.invalid_reasons, found.pose_epoch)


def _list_coordinates(model: Model | None) -> frozenset[str]:
    joints = model.joints if model is not None else {}
    return frozenset(name for each in joints.values() for name in coordinate_names(each.name, each.joint))


def _read_pose(row: Array) -> Pose:
    return Pose(tuple(row[POSITION].tolist()), tuple(row[QUATERNION].tolist()))


class BodyPath(NamedTuple):
    """How a body is reached: the path to its first frame, the body's pose in that frame, and the coordinates passed."""

    path: KinematicPath
    from_frame: Pose
    coordinates: frozenset[str]


class FramePoses:
    """Where the bodies of a model are in `base_frame`, with joints where they were received.

    `paths` has the bodies that are joined to the base frame.
    """

    def __init__(self, model: Model, base_frame: str):
        self.model = model
        self.paths: dict[str, BodyPath] = {}
        self._joints: Mapping[str, float] = {}
        for body in model.bodies:
            if not body.frames:
                continue
            with suppress(QueryError):
                path = model.get_kinematic_path(body.frames[0].full_name, base_frame)
                coordinates = frozenset(name for joint in path.joints for name in model.drives[joint.name].names)
                self.paths[body.name] = BodyPath(path, body.frames[0].pose.inverse(), coordinates)

    def compute_bodies(self, moved: Collection[str] | None = None) -> dict[str, Pose]:
        """Return the poses of the bodies by name; with `moved` only of those behind these coordinates."""
        return {
            name: each.path.compute_pose([self._get_position(joint.name) for joint in each.path.joints])
            @ each.from_frame
            for name, each in self.paths.items()
            if moved is None or not each.coordinates.isdisjoint(moved)
        }

    def move_joints(self, joints: Mapping[str, float]) -> dict[str, Pose]:
        known, self._joints = self._joints, dict(joints)
        moved = {name for name in known.keys() | joints.keys() if known.get(name) != joints.get(name)}
        return self.compute_bodies(moved) if moved else {}

    def compute_frames(self, bodies: Mapping[str, Pose]) -> dict[str, Pose]:
        return {frame.full_name: pose @ frame.pose for name, pose in bodies.items() for frame in self.model.body(name)}

    def _get_position(self, joint: str) -> Coordinates:
        """Return a joint's position: received, else its default."""
        drive = self.model.drives[joint]
        leader = self.model.joints[drive.leader].joint
        found = tuple(
            [
                self._joints.get(name, default)
                for name, default in zip(drive.names, leader.default_position, strict=True)
            ]
        )
        if drive.leader == joint:
            return found
        return tuple([drive.multiplier * value + drive.offset for value in found])


# --- bus

POLL_S: Final = 0.2
"""Longest wait for a message, seconds: a signal may have ended it."""

QUEUE_CAPACITY: Final = 10_000
"""Queued messages of all channels together."""

MAX_BATCH: Final = 500


def follow_bus(
    bus: lcm.LCM,
    prefix: str,
    feed: Callable[[str, bytes, int], None],
    is_stopped: Callable[[], bool],
    lock: AbstractContextManager[object] | None = None,
    pause: float = 0.0,
) -> None:
    """Feed the messages of all channels with a prefix, in batches under the lock, until it is stopped.

    A `pause` between batches, seconds, saves a third of the time of the two threads, and adds to the time of receipt.
    """
    received: list[tuple[str, bytes]] = []
    subscription = bus.subscribe(f"{re.escape(prefix)}.*", lambda channel, data: received.append((channel, data)))
    subscription.set_queue_capacity(QUEUE_CAPACITY)
    while not is_stopped():
        handle_message(bus, int(POLL_S * 1e3))
        while len(received) < MAX_BATCH and handle_message(bus):
            pass
        now = time.time_ns() // 1000
        with lock or nullcontext():
            for channel, data in received:
                feed(channel, data, now)
        received.clear()
        time.sleep(pause)
    bus.unsubscribe(subscription)
