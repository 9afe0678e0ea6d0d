"""Data of a replay for its report: states, fixes, decisions, samples of each source, and motion by each sensor alone.

The motion by a sensor alone, before any localization, is a series of means over one second, so that a long log needs
little memory: turn rates of gyro, wheels and fixes, and distances. A wheel's speed is its travel over time, however its
samples arrived; places are in the tangent plane, the same on all of Earth. Two series are compared by their correlation
sum(ab) / sqrt(sum(a^2) sum(b^2)) and by the ratio of their root mean squares: a ratio of 57 reveals degrees instead of
radians, a negative correlation a swapped sign. Fixes give a course from steps of at least COURSE_STEP_M. Limits:
without turns or straight driving there is nothing to compare, and the comparison is None.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from modelserver.earth.geodesy import Geodesy, GeodesyError, LocalFrame, ecef_from_geodetic
from modelserver.estimation import inputs as gate
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, split_variance
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.history import Localizer
from modelserver.messages import (
    Decision,
    Event,
    FixType,
    GpsSample,
    ImuSample,
    Invalid,
    Mode,
    Origin,
    Phase,
    SensorHeader,
    WheelsSample,
)
from modelserver.server.recordings import StampAxis
from modelserver.server.vehicle import Vehicle
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array, Vector3

MIN_TRAVEL_US = 50_000
"""Least time over which travel gives a speed, microseconds: one count of 1 mm is then 2 cm/s."""

MAX_TRAVEL_US = 5_000_000
"""Longest time over which travel gives a speed, microseconds."""

COURSE_STEP_M = 8.0
"""Distance between two fixes that give a course, meters: several times their noise."""

MAX_STEP_S = 30.0
"""Longest duration of such a step, seconds."""

DISTANCE_STEP_M = 10.0
"""Distance by the wheels over which it is compared with the fixes', meters."""

SNAPSHOT_PERIOD_US = 200_000
"""Shortest interval between two stored states, microseconds."""

PERIOD_SAMPLES = 20
"""Samples over which a period is taken: more than the bursts of recorders and buses have."""

HOLD_S = 1.0
"""Seconds for which a state holds without a newer one."""

FROZEN_S = 1.0
"""Seconds without change until an IMU counts as frozen."""


# --- motion by each sensor alone ---------------------------------------------------------------------------


class TurnRateComparison(NamedTuple):
    """Two turn rates compared: correlation, and ratio of the first's size to the second's."""

    correlation: float
    ratio: float


class DistanceComparison(NamedTuple):
    """Distance by wheels and by fixes over the same sections, meters."""

    wheels: float
    fixes: float


@dataclass(frozen=True)
class SensorMotion:
    """Rates and speeds per second, each second by its number since 1970.

    `gyro` is the measured turn rate about the vehicle's up axis, rad/s. `wheels` are the speeds of the wheels that the
    vehicle file names, m/s; `lateral_offsets` their positions to the left, meters. `fixes` are seconds since 1970, east
    and north, meters.
    """

    gyro: Mapping[int, float] = field(default_factory=dict)
    wheels: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    lateral_offsets: Mapping[str, float] = field(default_factory=dict)
    fixes: tuple[tuple[float, float, float], ...] = ()

    @property
    def wheel_turn_rate(self) -> dict[int, float]:
        """Turn rate by the wheels of both sides, rad/s; empty without two sides."""
        (left, y_left), (right, y_right) = self._side(1.0), self._side(-1.0)
        track = y_left - y_right
        return {second: (right[second] - left[second]) / track for second in left.keys() & right.keys()}

    def course_changes(self) -> list[tuple[float, float, float]]:
        """Return begin, end (s since 1970) and angle (rad) of each change of the fixes' course."""
        places = _thin_by_distance(self.fixes, COURSE_STEP_M)
        courses = [
            (0.5 * (a[0] + b[0]), math.atan2(b[2] - a[2], b[1] - a[1]))
            for a, b in pairwise(places)
            if 0.0 < b[0] - a[0] < MAX_STEP_S
        ]
        turns = []
        for (t, before), (u, after) in pairwise(courses):
            turn = math.remainder(after - before, 2.0 * math.pi)
            # reversing looks like a turn on the spot
            if 0.0 < u - t < MAX_STEP_S and abs(turn) < 2.0:
                turns.append((t, u, turn))
        return turns

    def compare_with_course(self, rates: Mapping[int, float]) -> TurnRateComparison | None:
        """Compare a turn rate with the fixes' course, integrated over the intervals of its changes."""
        found: dict[int, tuple[float, float]] = {}
        for t, u, turn in self.course_changes():
            mean = _mean_between(rates, t, u)
            if math.isfinite(mean):
                found[math.floor(t)] = (mean * (u - t), turn)
        return _compare(found.values(), 0.1)

    def count_opposed(self, turn: Mapping[int, float]) -> tuple[int, int]:
        """Return the seconds of straight driving in which the sides rolled against each other, and all of them."""
        (left, _), (right, _) = self._side(1.0), self._side(-1.0)
        moving = [
            second
            for second in left.keys() & right.keys()
            if min(abs(left[second]), abs(right[second])) > 0.3 and abs(turn.get(second, math.inf)) < 0.05
        ]
        return sum(left[second] * right[second] < 0.0 for second in moving), len(moving)

    def backward_wheels(self) -> list[str]:
        moving = {name: [each for each in speeds.values() if abs(each) > 0.3] for name, speeds in self.wheels.items()}
        return sorted(name for name, speeds in moving.items() if sum(speeds) < 0.0)

    def compare_distances(self) -> DistanceComparison:
        """Return the distances by wheels and by fixes, over sections of `DISTANCE_STEP_M` by the wheels."""
        speed = self._mean_speed()
        rolled = fixed = distance = 0.0
        anchor: tuple[float, float, float] | None = None
        before = -math.inf
        for each in self.fixes:
            if anchor is None or each[0] - before > 5.0:
                anchor, distance, before = each, 0.0, each[0]
                continue
            mean = _mean_between(speed, before, each[0])
            if math.isfinite(mean):
                distance += mean * (each[0] - before)
            before = each[0]
            if distance >= DISTANCE_STEP_M:
                rolled += distance
                fixed += math.dist(each[1:], anchor[1:])
                anchor, distance = each, 0.0
        return DistanceComparison(rolled, fixed)

    def _mean_speed(self) -> dict[int, float]:
        means = SecondMeans()
        for speeds in self.wheels.values():
            for second, value in speeds.items():
                means.add(second, abs(value))
        return means.finish()

    def _side(self, sign: float) -> tuple[dict[int, float], float]:
        """Return the mean speeds and the mean lateral offset of the wheels of a side, empty and nan without any."""
        offsets = {name: y for name, y in self.lateral_offsets.items() if y * sign > 0.05 and name in self.wheels}
        if not offsets:
            return {}, math.nan
        known = set.intersection(*(set(self.wheels[name]) for name in offsets))
        speeds = {second: fmean(self.wheels[name][second] for name in offsets) for second in known}
        return speeds, fmean(offsets.values())


def compare_turn_rates(first: Mapping[int, float], second: Mapping[int, float]) -> TurnRateComparison | None:
    """Compare two turn rates second by second; None without enough turns."""
    return _compare([(first[each], second[each]) for each in sorted(first.keys() & second.keys())], 0.02)


def _compare(turns: Collection[tuple[float, float]], least: float) -> TurnRateComparison | None:
    """Compare pairs of turns; None with fewer than 12, or where the second ones are smaller than `least` (rms)."""
    a, b = np.array([*turns]).reshape(-1, 2).T
    squares, others = float(a @ a), float(b @ b)
    if len(a) < 12 or not squares > 0.0 or others < len(b) * least * least:
        return None
    return TurnRateComparison(float(a @ b) / math.sqrt(squares * others), math.sqrt(squares / others))


class SecondMeans:
    """Weighted means of the values of each second since 1970."""

    def __init__(self) -> None:
        self._sums: defaultdict[int, tuple[float, float]] = defaultdict(lambda: (0.0, 0.0))

    def add(self, second: int, value: float, weight: float = 1.0) -> None:
        total, weights = self._sums[second]
        self._sums[second] = (total + value * weight, weights + weight)

    def finish(self) -> dict[int, float]:
        return {second: total / weights for second, (total, weights) in sorted(self._sums.items())}


class WheelTravel(NamedTuple):
    """Mean speed of a wheel from `begin` to `end`, utimes, m/s; equal for a speed that the wheel itself measured."""

    begin: int
    end: int
    name: str
    speed: float
    steering: float


def compute_wheel_travel(samples: Iterable[WheelsSample]) -> list[WheelTravel]:
    """Return the speeds of wheels by their travel, without travel the measured ones. Any order of samples will do.

    A driver that was started again, whose `seq` is smaller than before, counts its travel from another beginning.
    """
    found: list[WheelTravel] = []
    anchors: dict[tuple[str, str], tuple[int, float]] = {}
    last_seq: dict[str, int] = {}
    for sample in sorted(samples, key=lambda each: each.header.utime):
        utime, source = sample.header.utime, sample.header.source
        if sample.header.seq < last_seq.get(source, 0):
            anchors = {key: anchor for key, anchor in anchors.items() if key[0] != source}
        last_seq[source] = sample.header.seq
        for wheel in sample.wheels:
            if not math.isfinite(wheel.steering):
                continue
            if not math.isfinite(wheel.travel):
                if math.isfinite(wheel.speed):
                    found.append(WheelTravel(utime, utime, wheel.name, wheel.speed, wheel.steering))
                continue
            key = (source, wheel.name)
            begin, travel = anchors.get(key, (0, 0.0))
            if utime - begin >= MIN_TRAVEL_US:
                anchors[key] = (utime, wheel.travel)
                speed = (wheel.travel - travel) / (utime - begin) * 1e6
                if utime - begin <= MAX_TRAVEL_US:
                    found.append(WheelTravel(begin, utime, wheel.name, speed, wheel.steering))
    return found


def compute_sensor_motion(
    gyro: Mapping[int, float],
    fixes: Iterable[GpsSample],
    rolling: Iterable[WheelTravel],
    sides: Mapping[str, float],
) -> SensorMotion:
    """Return the motion by each sensor. `sides` are the lateral offsets of the wheels; steered speeds are left out."""
    wheels: defaultdict[str, SecondMeans] = defaultdict(SecondMeans)
    for begin, end, name, speed, steering in rolling:
        if name in sides and abs(steering) < 0.02:
            for second in range(begin // 1_000_000, end // 1_000_000 + 1):
                overlap = min(end, (second + 1) * 1_000_000) - max(begin, second * 1_000_000)
                if begin == end or overlap > 0:
                    wheels[name].add(second, speed, max(overlap, 1))
    speeds = {name: means.finish() for name, means in wheels.items()}
    places = [(each.header.utime * 1e-6, each) for each in fixes if each.fix_type is not FixType.NONE]
    return SensorMotion(gyro, speeds, dict(sides), tuple(_project_fixes(places)))


def _project_fixes(fixes: Iterable[tuple[float, GpsSample]]) -> Iterator[tuple[float, float, float]]:
    """Yield times, east and north of fixes, by time; those without a place are left out."""
    plane, height = None, 0.0
    for t, fix in sorted(fixes, key=lambda each: each[0]):
        with suppress(GeodesyError):
            if plane is None:
                height = fix.height_ellipsoidal if math.isfinite(fix.height_ellipsoidal) else 0.0
                plane = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, height)
            # of one height: its noise is none of the way
            ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
            yield (t, *plane.from_ecef(ecef)[:2])


def _mean_between(series: Mapping[int, float], begin: float, end: float) -> float:
    """Return the mean of a series of seconds over a time, s since 1970, as far as it is known; nan where it is not."""
    known = [
        (series[second], min(end, second + 1.0) - max(begin, second))
        for second in range(math.floor(begin), math.ceil(end))
        if second in series
    ]
    total = sum(weight for _, weight in known)
    return sum(value * weight for value, weight in known) / total if total > 0.0 else math.nan


def _thin_by_distance(places: Iterable[tuple[float, float, float]], least: float) -> list[tuple[float, float, float]]:
    found: list[tuple[float, float, float]] = []
    for each in places:
        if not found or math.dist(each[1:], found[-1][1:]) >= least:
            found.append(each)
    return found


# --- data of a report ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StateSample:
    """State at `t` seconds from the log's first event. Unknown values are nan, None or empty.

    Attributes
    ----------
    position : of the antenna (without a receiver of the rolling frame), east, north, up of the origin in World:UTM
    yaw : of the rolling frame from grid east
    velocity : of the rolling frame, true east and north, m/s
    sigma, yaw_sigma : longest axis of the horizontal position, m, and heading
    horizontal_protection_level, heading_protection_level, horizontal_level, heading_level : of the pose
    speed, yaw_rate : forward, m/s; rad/s
    values, sigmas : the filter's states by name
    """

    t: float
    invalid: Invalid
    epoch: int
    position: Vector3 | None = None
    yaw: float = math.nan
    sigma: float = math.nan
    yaw_sigma: float = math.nan
    horizontal_protection_level: float = math.nan
    heading_protection_level: float = math.nan
    horizontal_level: float = math.nan
    heading_level: float = math.nan
    speed: float = math.nan
    yaw_rate: float = math.nan
    velocity: tuple[float, float] | None = None
    is_stationary: bool = False
    phase: Phase | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FixRecord:
    """A fix and the decision on it. `position` as in `StateSample`; None without a position or origin.

    `residual` is fix minus antenna, true east and north, m, including the time-correlated error; `velocity` the
    vehicle's, m/s; None where the fix was not compared. `verdict` is empty where nothing was decided.
    """

    t: float
    position: Vector3 | None
    verdict: str
    reason: str
    residual: tuple[float, float] | None = None
    velocity: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class WheelComparison:
    """Measured speed of a wheel around `t` and the one expected from the state, m/s along its rolling direction."""

    t: float
    name: str
    measured: float
    expected: float


@dataclass(frozen=True, slots=True)
class SourceTimes:
    """Sorted times of the samples of one source, seconds from the log's first event."""

    name: str
    times: tuple[float, ...]

    @property
    def period(self) -> float:
        """Median interval between two samples, seconds; nan with fewer than two.

        The median is of the time for several samples: those that arrive in bursts have the period of their source.
        """
        several = max(1, min(PERIOD_SAMPLES, len(self.times) // 4))
        times = np.array(self.times)
        return float(np.median(times[several:] - times[:-several])) / several if len(times) > 1 else math.nan

    def find_gaps(self) -> list[tuple[float, float]]:
        """Return begin and end of the intervals longer than three periods and 0.2 s."""
        limit = max(3.0 * self.period, 0.2)
        return [(a, b) for a, b in pairwise(self.times) if b - a > limit]


@dataclass(frozen=True)
class ReplayData:
    """All data of a report. Times `t` are seconds from `first_utime`, the log's first event.

    Attributes
    ----------
    settings, mode : of the filter, at the start
    mean_force : mean specific force along the vehicle's axes, m/s2; None without IMU
    frozen : intervals in which the IMU repeated one sample
    missing_channels : sensors of the vehicle file without messages in the log: key under sensors, channel
    channels : those of the log
    sensor_keys : sensor of each source
    wheel_names : names of the wheels in the log
    sensor_motion : motion by each sensor alone
    axis : the stamps beside the log's times
    """

    vehicle: str
    log: str
    first_utime: int
    duration: float
    settings: FilterSettings
    snapshots: tuple[StateSample, ...] = ()
    fixes: tuple[FixRecord, ...] = ()
    decisions: tuple[Decision, ...] = ()
    wheels: tuple[WheelComparison, ...] = ()
    sensors: tuple[SourceTimes, ...] = ()
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)
    mean_force: Vector3 | None = None
    frozen: tuple[tuple[float, float], ...] = ()
    origin: Origin | None = None
    mode: Mode = Mode.FULL
    missing_channels: tuple[tuple[str, str], ...] = ()
    channels: tuple[str, ...] = ()
    sensor_keys: Mapping[str, str] = field(default_factory=dict)
    wheel_names: tuple[str, ...] = ()
    sensor_motion: SensorMotion = field(default_factory=SensorMotion)
    axis: StampAxis = field(default_factory=StampAxis)

    def count_samples(self, source: str) -> int:
        return next((len(each.times) for each in self.sensors if each.name == source), 0)

    def to_seconds(self, utime: int) -> float:
        return (utime - self.first_utime) * 1e-6


class ReplayCollector:
    """Collects `ReplayData`: pass `on_sample` and `on_decision` to the offline run, then call `finish`."""

    def __init__(self, vehicle: Vehicle):
        assert vehicle.rig is not None
        self._vehicle = vehicle
        self._rig = vehicle.rig
        gps = self._rig.gps_frame
        self._X_rolling_antenna = self._rig.pose(gps) if gps else Pose.identity()
        self._decisions: list[Decision] = []
        self._states: list[tuple[int, StateSample]] = []
        self._fixes: list[GpsSample] = []
        self._wheels: list[WheelsSample] = []
        self._times: dict[str, list[int]] = {}
        self._forces = np.zeros(3)
        self._force_count = 0
        self._imu: ImuSample | None = None
        self._same_since = 0
        self._frozen: list[tuple[int, int]] = []
        self._origin: Origin | None = None
        self._last_snapshot_utime = 0
        self._keys: dict[str, str] = {}
        self._yaw_rates = SecondMeans()
        self._q_rolling_imu = self._rig.pose(self._rig.imu_frame).wxyz if self._rig.imu_frame else None

    def on_decision(self, decision: Decision) -> None:
        self._decisions.append(decision)

    def on_sample(self, sample: Event, localizer: Localizer) -> None:
        """Store a sample, and every SNAPSHOT_PERIOD_US the state after it."""
        header = getattr(sample, "header", None)
        if not isinstance(header, SensorHeader):
            return
        name = type(sample).__name__.removesuffix("Sample").lower()
        self._times.setdefault(header.source or name, []).append(header.utime)
        if name in ("gps", "imu", "wheels"):
            self._keys[header.source] = name
        if isinstance(sample, GpsSample):
            self._fixes.append(sample)
        elif isinstance(sample, WheelsSample):
            self._wheels.append(sample)
        elif isinstance(sample, ImuSample):
            self._add_imu(sample)
        # before the first state, the estimate at the sample has the reasons why there is none
        utime = localizer.utime or header.utime
        if utime >= self._last_snapshot_utime + SNAPSHOT_PERIOD_US or 0 < utime < self._last_snapshot_utime:
            self._last_snapshot_utime = utime
            self._states.append((utime, self._snapshot(utime, localizer)))

    def finish(
        self,
        log: str,
        first_utime: int,
        last_utime: int,
        rejected: Mapping[tuple[str, str], int],
        channels: Collection[str] = (),
        axis: StampAxis | None = None,
    ) -> ReplayData:
        """Return the data. `channels`: those of the log."""

        def seconds(utime: int) -> float:
            return (utime - first_utime) * 1e-6

        snapshots = tuple(replace(each, t=seconds(utime)) for utime, each in self._states)
        config = self._vehicle.config
        self._close_frozen()
        rolling = compute_wheel_travel(self._wheels)
        return ReplayData(
            vehicle=config.vehicle,
            log=log,
            first_utime=first_utime,
            duration=max(seconds(last_utime), 0.0),
            settings=config.localization.filter,
            snapshots=snapshots,
            fixes=self._evaluate_fixes(first_utime, snapshots),
            decisions=tuple(self._decisions),
            wheels=self._compare_wheels(rolling, first_utime, snapshots),
            sensors=tuple(SourceTimes(n, tuple(sorted(map(seconds, t)))) for n, t in sorted(self._times.items())),
            rejected=dict(rejected),
            mean_force=self._mean_force(),
            frozen=tuple((seconds(a), seconds(b)) for a, b in self._frozen),
            origin=self._origin,
            mode=config.localization.initial_mode,
            missing_channels=self._find_missing_channels(channels),
            channels=tuple(sorted(channels)),
            axis=axis or StampAxis(),
            sensor_keys=dict(self._keys),
            wheel_names=tuple(dict.fromkeys(wheel.name for sample in self._wheels for wheel in sample.wheels)),
            sensor_motion=compute_sensor_motion(
                self._yaw_rates.finish(),
                self._fixes,
                rolling,
                {name: self._rig.pose(frame).xyz[1] for name, frame in self._rig.wheel_frames.items()},
            ),
        )

    def _find_missing_channels(self, channels: Collection[str]) -> tuple[tuple[str, str], ...]:
        sensors, prefix = self._vehicle.config.sensors, self._vehicle.config.lcm.channel_prefix
        named = (("gps", sensors.gps), ("imu", sensors.imu), ("wheels", sensors.wheels))
        aiding = ((f"aiding.{name}", each) for name, each in sensors.aiding.items())
        expected = [(key, f"{prefix}{each.channel}") for key, each in (*named, *aiding) if each is not None]
        return tuple(each for each in expected if each[1] not in channels)

    # --- during the replay ----------------------------------------------------------------------------------

    def _snapshot(self, utime: int, localizer: Localizer) -> StateSample:
        estimate = localizer.estimate(utime)
        if estimate.origin is not None:
            self._origin = estimate.origin
        known: dict[str, Any] = {}
        if estimate.utm is not None:
            known |= {"position": (estimate.utm @ self._X_rolling_antenna).xyz, "yaw": float(estimate.utm.rpy[2])}
            if estimate.covariance is not None:
                P = np.array(estimate.covariance).reshape(6, 6)
                known["sigma"] = math.sqrt(max(float(np.linalg.eigvalsh(P[:2, :2])[-1]), 0.0))
                known["yaw_sigma"] = math.sqrt(max(float(P[5, 5]), 0.0))
        state = localizer.navigation(utime)
        if state is not None:
            variances = np.diagonal(np.array(state.covariance).reshape(len(state.names), -1))
            known |= {
                "speed": state.linear_velocity[0],
                "yaw_rate": state.angular_velocity[2],
                "velocity": so3.rotate(state.pose.wxyz, state.linear_velocity)[:2],
                "is_stationary": state.stationary,
                "phase": state.phase,
                "values": dict(zip(state.names, state.values, strict=True)),
                "sigmas": dict(zip(state.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True)),
            }
        return StateSample(
            t=0.0,
            invalid=estimate.invalid,
            epoch=estimate.pose_epoch,
            horizontal_protection_level=estimate.horizontal_protection_level,
            heading_protection_level=estimate.heading_protection_level,
            horizontal_level=estimate.horizontal_level,
            heading_level=estimate.heading_level,
            **known,
        )

    def _add_imu(self, sample: ImuSample) -> None:
        if sample.specific_force is not None and all(map(math.isfinite, sample.specific_force)):
            self._forces += sample.specific_force
            self._force_count += 1
        rate = sample.angular_velocity
        if self._q_rolling_imu is not None and rate is not None and all(map(math.isfinite, rate)):
            self._yaw_rates.add(sample.header.utime // 1_000_000, so3.rotate(self._q_rolling_imu, rate)[2])
        measured = (sample.specific_force, rate)
        if self._imu is None or measured != (self._imu.specific_force, self._imu.angular_velocity):
            self._close_frozen()
            self._same_since = sample.header.utime
        self._imu = sample

    def _close_frozen(self) -> None:
        last = self._imu
        if last is not None and last.header.utime - self._same_since > FROZEN_S * 1e6:
            self._frozen.append((self._same_since, last.header.utime))
            self._same_since = last.header.utime

    def _mean_force(self) -> Vector3 | None:
        if not self._force_count or self._q_rolling_imu is None:
            return None
        x, y, z = (self._forces / self._force_count).tolist()
        return so3.rotate(self._q_rolling_imu, (x, y, z))

    # --- at the end -----------------------------------------------------------------------------------------

    def _evaluate_fixes(self, first_utime: int, snapshots: tuple[StateSample, ...]) -> tuple[FixRecord, ...]:
        settings = self._vehicle.config.localization.filter
        decided = {(d.source, d.utime, d.seq): d for d in self._decisions if d.kind == "gps_position"}
        geodesy = None if self._origin is None else Geodesy(self._origin)
        times = np.array([each.t for each in snapshots])
        found = []
        for sample in self._fixes:
            header = sample.header
            fix = gate.evaluate_fix(sample, settings, True)
            decision = decided.get((header.source, header.utime, header.seq))
            t = (header.utime - first_utime) * 1e-6
            verdict, reason = ("", "") if decision is None else (decision.verdict.name.lower(), decision.reason)
            if isinstance(fix, str):
                # without decisions, as in raw mode, the gate's own
                words = (verdict, reason) if decided else ("rejected", fix)
                found.append(FixRecord(t, None, *words))
                continue
            place = residual = velocity = None
            if geodesy is not None:
                height = 0.0 if math.isnan(fix.height) else fix.height
                with suppress(GeodesyError):
                    utm = geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
                    place = geodesy.to_relative_utm(utm)
            before = _latest(snapshots, times, t) if decision is not None and decision.dof == 2 else None
            if decision is not None and before is not None and before.velocity is not None:
                east = split_variance(fix.east_variance, fix, sample.fix_type, settings)[1]
                north = split_variance(fix.north_variance, fix, sample.fix_type, settings)[1]
                a, b = (before.values.get(name, 0.0) for name in CORRELATED_ERROR[:2])
                residual = (decision.residual[0] + east * a, decision.residual[1] + north * b)
                velocity = before.velocity
            found.append(FixRecord(t, place, verdict, reason, residual, velocity))
        return tuple(found)

    def _compare_wheels(
        self, rolling: Sequence[WheelTravel], first_utime: int, snapshots: tuple[StateSample, ...]
    ) -> tuple[WheelComparison, ...]:
        known = [each for each in snapshots if math.isfinite(each.speed)]
        if not known or not rolling:
            return ()
        begins, ends, names, measured, steering = zip(*rolling, strict=True)
        times = [each.t for each in known]
        at = (0.5 * (np.array(begins) + np.array(ends)) - first_utime) * 1e-6
        v, w = (np.interp(at, times, [getattr(each, name) for each in known]) for name in ("speed", "yaw_rate"))
        contacts = {name: self._rig.pose(frame).xyz for name, frame in self._rig.wheel_frames.items()}
        x, y, _ = np.array([contacts.get(name, (math.nan,) * 3) for name in names]).T
        expected = np.cos(steering) * (v - w * y) + np.sin(steering) * w * x
        return tuple(
            WheelComparison(*each)
            for each in zip(at.tolist(), names, measured, expected.tolist(), strict=True)
            if each[1] in contacts and times[0] <= each[0] <= times[-1]
        )


def integrate_distance(snapshots: Sequence[StateSample]) -> float:
    """Return the integral of the speed, meters: the noise of positions while stationary does not count."""
    return sum(
        abs(b.speed) * (b.t - a.t) for a, b in pairwise(snapshots) if math.isfinite(b.speed) and b.t - a.t < HOLD_S
    )


def count_reasons(counts: Mapping[int, int]) -> Counter[Invalid]:
    """Return the number of poses with each invalid reason, from the numbers by the bits of all their reasons."""
    reasons: Counter[Invalid] = Counter()
    for bits, count in counts.items():
        reasons.update({flag: count for flag in Invalid if bits & flag})
    return reasons


def _latest(snapshots: tuple[StateSample, ...], times: Array, t: float) -> StateSample | None:
    """Return the newest snapshot at or before `t` that is not older than a second."""
    index = int(np.searchsorted(times, t, side="right")) - 1
    return snapshots[index] if index >= 0 and t - times[index] < 1.0 else None
