"""What a replay showed, gathered for its report: states, fixes, decisions, what each sensor sent."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from modelserver.earth.geodesy import Geodesy, GeodesyError
from modelserver.localization import gate
from modelserver.localization.filter.measurements.gps import WANDER, shares
from modelserver.localization.filter.settings import FilterSettings
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    Decision,
    Event,
    GpsSample,
    ImuSample,
    Invalid,
    Mode,
    NavigationState,
    Origin,
    Phase,
    SensorHeader,
    WheelsSample,
)
from modelserver.service.daemon import Vehicle
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Vector3
from mstools.report.raw import RawCollector, RawMotion

STEP_US = 200_000
"""Microseconds between two states that are kept, at least."""

FROZEN_S = 1.0
"""Seconds for which an inertial unit repeats one value until it counts as frozen."""


@dataclass(frozen=True, slots=True)
class StateSample:
    """What was known at an instant, `t` seconds from the log's first event. What is not known is nan, None or empty.

    `place` is the antenna's (without a receiver the rolling frame's) east, north, up of the origin in World:UTM, `yaw`
    the rolling frame's from grid east. `speed` is forward, `side` to the left, m/s, `turn` the yaw rate. `sigma` is the
    longest axis of the horizontal position, metres, `yaw_sigma` heading's, and the bounds are those of the pose.
    `values` and `sigmas` are the filter's states by name.
    """

    t: float
    invalid: Invalid
    epoch: int
    place: Vector3 | None = None
    yaw: float = math.nan
    sigma: float = math.nan
    yaw_sigma: float = math.nan
    horizontal_bound: float = math.nan
    heading_bound: float = math.nan
    speed: float = math.nan
    side: float = math.nan
    turn: float = math.nan
    standing: bool = False
    mode: Mode | None = None
    phase: Phase | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FixRecord:
    """A fix beside what became of it. `place` as a snapshot's; None: no place, or no origin.

    `off` is how far it lay from the antenna, east and north, metres, what lingers in fixes left in; `velocity` the
    antenna's then, m/s; both None where it was not compared. `verdict` is empty where nothing was decided.
    """

    t: float
    place: Vector3 | None
    sigma: float
    verdict: str
    reason: str
    off: tuple[float, float] | None = None
    velocity: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class WheelTurn:
    """What a wheel told at `t` beside what the state expected of it, m/s along the way that it rolls."""

    t: float
    name: str
    measured: float
    expected: float


@dataclass(frozen=True, slots=True)
class Sensor:
    """What came from one source: its samples' instants, seconds from the log's first event, rising."""

    name: str
    times: tuple[float, ...]

    @property
    def period(self) -> float:
        """The middle of the times between two samples, seconds; nan with fewer than two."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else math.nan

    def gaps(self, factor: float = 3.0, least: float = 0.2) -> list[tuple[float, float]]:
        """Return from when to when there was nothing for longer than `factor` periods and `least` seconds."""
        limit = max(factor * self.period, least)
        return [(a, b) for a, b in pairwise(self.times) if b - a > limit]


@dataclass(frozen=True)
class Replayed:
    """All that a report is made of. Times `t` are seconds from `first_utime`, the log's first event.

    `felt_up` is the mean specific force along the vehicle's axes, None without inertial unit. `frozen` are stretches in
    which the inertial unit repeated one value. `settings` are the filter's, `mode` the one from the start.

    `silent` are the sensors of the vehicle file, by key under sensors and channel, of which the log has nothing;
    `channels` is what it has. `keys` says of each source which sensor it is, `wheel_names` what the log calls its
    wheels, `raw` what the sensors said by themselves.
    """

    vehicle: str
    log: str
    first_utime: int
    seconds: float
    settings: FilterSettings
    snapshots: tuple[StateSample, ...] = ()
    fixes: tuple[FixRecord, ...] = ()
    decisions: tuple[Decision, ...] = ()
    wheels: tuple[WheelTurn, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    rejected: Mapping[tuple[str, str], int] = field(default_factory=dict)
    felt_up: Vector3 | None = None
    frozen: tuple[tuple[float, float], ...] = ()
    origin: Origin | None = None
    mode: Mode = Mode.FULL
    silent: tuple[tuple[str, str], ...] = ()
    channels: tuple[str, ...] = ()
    keys: Mapping[str, str] = field(default_factory=dict)
    wheel_names: tuple[str, ...] = ()
    raw: RawMotion = field(default_factory=RawMotion)

    def samples_of(self, source: str) -> int:
        """Return how many samples came from a source."""
        return next((len(each.times) for each in self.sensors if each.name == source), 0)

    def t(self, utime: int) -> float:
        """Return an instant as seconds from the log's first event."""
        return (utime - self.first_utime) * 1e-6


class Collector:
    """Watches a replay. Give `on_taken` and `on_decision` to `offline.Run`, and ask for `replayed` at its end."""

    def __init__(self, vehicle: Vehicle):
        """Take the vehicle; it must have a rig."""
        assert vehicle.rig is not None
        self._vehicle = vehicle
        self._rig = vehicle.rig
        gps = self._rig.gps_frame
        self._X_rolling_antenna = self._rig.pose(gps) if gps else Pose.identity()
        self._decisions: list[Decision] = []
        self._states: list[tuple[int, StateSample]] = []
        self._fixes: list[GpsSample] = []
        self._turns: list[tuple[int, str, float, float]] = []
        self._before: dict[str, WheelsSample] = {}
        self._times: dict[str, list[int]] = {}
        self._forces = np.zeros(3)
        self._felt = 0
        self._imu: ImuSample | None = None
        self._same_since = 0
        self._frozen: list[tuple[int, int]] = []
        self._origin: Origin | None = None
        self._taken = 0
        self._keys: dict[str, str] = {}
        self._wheel_names: dict[str, None] = {}
        self._raw = RawCollector(self._rig.pose(self._rig.imu_frame).wxyz if self._rig.imu_frame else None)

    def on_decision(self, decision: Decision) -> None:
        """Note what became of a measurement."""
        self._decisions.append(decision)

    def on_taken(self, sample: Event, localizer: Localizer) -> None:
        """Note a sample, and now and then what is known after it."""
        header = getattr(sample, "header", None)
        if not isinstance(header, SensorHeader):
            return
        name = type(sample).__name__.removesuffix("Sample").lower()
        self._times.setdefault(header.source or name, []).append(header.utime)
        if name in ("gps", "imu", "wheels"):
            self._keys[header.source] = name
        if isinstance(sample, GpsSample):
            self._fixes.append(sample)
            self._raw.on_fix(sample)
        elif isinstance(sample, WheelsSample):
            self._turned(sample)
        elif isinstance(sample, ImuSample):
            self._felt_by(sample)
            self._raw.on_imu(sample)
        # before the first that the state could be carried to, the pose at the sample says why there is none
        utime = localizer.utime or header.utime
        if utime >= self._taken + STEP_US or 0 < utime < self._taken:
            self._taken = utime
            self._states.append((utime, self._snapshot(utime, localizer)))

    def replayed(
        self,
        log: str,
        first_utime: int,
        last_utime: int,
        rejected: Mapping[tuple[str, str], int],
        channels: Collection[str] = (),
    ) -> Replayed:
        """Return all of it. `channels`: those that the log has."""

        def seconds(utime: int) -> float:
            return (utime - first_utime) * 1e-6

        snapshots = tuple(replace(each, t=seconds(utime)) for utime, each in self._states)
        self._end_of_frozen()
        return Replayed(
            vehicle=self._vehicle.config.vehicle,
            log=log,
            first_utime=first_utime,
            seconds=max(seconds(last_utime), 0.0),
            settings=self._vehicle.config.localization.filter,
            snapshots=snapshots,
            fixes=self._judged(first_utime, snapshots),
            decisions=tuple(self._decisions),
            wheels=self._wheel_turns(first_utime, snapshots),
            sensors=tuple(
                Sensor(name, tuple(sorted(map(seconds, times)))) for name, times in sorted(self._times.items())
            ),
            rejected=dict(rejected),
            felt_up=self._felt_up(),
            frozen=tuple((seconds(a), seconds(b)) for a, b in self._frozen),
            origin=self._origin,
            mode=self._vehicle.config.localization.first_mode,
            silent=self._silent(channels),
            channels=tuple(sorted(channels)),
            keys=dict(self._keys),
            wheel_names=tuple(self._wheel_names),
            raw=self._raw.motion(self._turns, self._sides()),
        )

    def _silent(self, channels: Collection[str]) -> tuple[tuple[str, str], ...]:
        config = self._vehicle.config
        sensors = config.sensors
        named = [("gps", sensors.gps), ("imu", sensors.imu), ("wheels", sensors.wheels)]
        return tuple(
            (key, f"{config.lcm.channel_prefix}{each.channel}")
            for key, each in (*named, *((f"aiding.{name}", each) for name, each in sensors.aiding.items()))
            if each is not None and f"{config.lcm.channel_prefix}{each.channel}" not in channels
        )

    def _sides(self) -> dict[str, float]:
        return {name: self._rig.pose(frame).xyz[1] for name, frame in self._rig.wheel_frames.items()}

    # --- what is noted --------------------------------------------------------------------------------------

    def _snapshot(self, utime: int, localizer: Localizer) -> StateSample:
        estimate = localizer.estimate(utime)
        if estimate.origin is not None:
            self._origin = estimate.origin
        place, yaw, sigma, yaw_sigma = None, math.nan, math.nan, math.nan
        if estimate.utm is not None:
            place = (estimate.utm @ self._X_rolling_antenna).xyz
            yaw = _yaw(estimate.utm)
            if estimate.covariance is not None:
                P = np.array(estimate.covariance).reshape(6, 6)
                sigma = math.sqrt(max(float(np.linalg.eigvalsh(P[:2, :2])[-1]), 0.0))
                yaw_sigma = math.sqrt(max(float(P[5, 5]), 0.0))
        known = StateSample(
            t=0.0,
            invalid=estimate.invalid,
            epoch=estimate.pose_epoch,
            place=place,
            yaw=yaw,
            sigma=sigma,
            yaw_sigma=yaw_sigma,
            horizontal_bound=estimate.horizontal_bound,
            heading_bound=estimate.heading_bound,
        )
        state = localizer.navigation(utime)
        return known if state is None else _with_state(known, state)

    def _turned(self, sample: WheelsSample) -> None:
        before = self._before.get(sample.header.source)
        self._before[sample.header.source] = sample
        earlier = {wheel.name: wheel.travel for wheel in before.wheels} if before is not None else {}
        dt = (sample.header.utime - before.header.utime) * 1e-6 if before is not None else 0.0
        for wheel in sample.wheels:
            self._wheel_names[wheel.name] = None
            way = wheel.travel - earlier.get(wheel.name, math.nan)
            speed = way / dt if 0.0 < dt < 1.0 and math.isfinite(way) else wheel.speed
            if math.isfinite(speed) and math.isfinite(wheel.steering):
                middle = sample.header.utime - round(0.5e6 * min(dt, 1.0))
                self._turns.append((middle, wheel.name, speed, wheel.steering))

    def _felt_by(self, sample: ImuSample) -> None:
        if sample.specific_force is not None and all(map(math.isfinite, sample.specific_force)):
            self._forces += sample.specific_force
            self._felt += 1
        before = self._imu
        same = (
            before is not None
            and before.specific_force == sample.specific_force
            and before.angular_velocity == sample.angular_velocity
        )
        if not same:
            self._end_of_frozen()
            self._same_since = sample.header.utime
        self._imu = sample

    def _end_of_frozen(self) -> None:
        last = self._imu
        if last is not None and last.header.utime - self._same_since > FROZEN_S * 1e6:
            self._frozen.append((self._same_since, last.header.utime))
            self._same_since = last.header.utime

    def _felt_up(self) -> Vector3 | None:
        if not self._felt or not self._rig.imu_frame:
            return None
        x, y, z = (self._forces / self._felt).tolist()
        return so3.rotate(self._rig.pose(self._rig.imu_frame).wxyz, (x, y, z))

    # --- put together at the end ----------------------------------------------------------------------------

    def _judged(self, first_utime: int, snapshots: tuple[StateSample, ...]) -> tuple[FixRecord, ...]:
        settings = self._vehicle.config.localization.filter
        decided = {(d.source, d.utime, d.seq): d for d in self._decisions if d.kind == "gps_position"}
        geodesy = None if self._origin is None else Geodesy(self._origin)
        times = np.array([each.t for each in snapshots])
        found = []
        for sample in self._fixes:
            header = sample.header
            fix = gate.judge(sample, settings)
            place = None
            if geodesy is not None and not isinstance(fix, str):
                height = 0.0 if math.isnan(fix.height) else fix.height
                try:
                    utm = geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
                    place = geodesy.relative(utm)
                except GeodesyError:
                    place = None
            decision = decided.get((header.source, header.utime, header.seq))
            t = (header.utime - first_utime) * 1e-6
            off = velocity = None
            if decision is not None and decision.dof == 2 and not isinstance(fix, str):
                before = _latest(snapshots, times, t)
                if before is not None and math.isfinite(before.speed):
                    east = shares(fix.east_variance, sample.fix_type, settings)[1]
                    north = shares(fix.north_variance, sample.fix_type, settings)[1]
                    a, b = (before.values.get(name, 0.0) for name in WANDER[:2])
                    off = (decision.residual[0] + east * a, decision.residual[1] + north * b)
                    velocity = _velocity(before)
            sigma = math.nan if isinstance(fix, str) else fix.sigma
            verdict, reason = ("", "") if decision is None else (decision.verdict.name.lower(), decision.reason)
            # where nothing is decided, as in raw mode, it is the gate that tells
            if not decided and isinstance(fix, str):
                verdict, reason = "rejected", fix
            found.append(FixRecord(t, place, sigma, verdict, reason, off, velocity))
        return tuple(found)

    def _wheel_turns(self, first_utime: int, snapshots: tuple[StateSample, ...]) -> tuple[WheelTurn, ...]:
        known = [each for each in snapshots if math.isfinite(each.speed)]
        if not known or not self._turns:
            return ()
        times = [each.t for each in known]
        speeds, turns = [each.speed for each in known], [each.turn for each in known]
        contacts = {name: self._rig.pose(frame).xyz for name, frame in self._rig.wheel_frames.items()}
        at = (np.array([utime for utime, _, _, _ in self._turns]) - first_utime) * 1e-6
        found = []
        for t, v, w, (_, name, measured, steering) in zip(
            at.tolist(),
            np.interp(at, times, speeds).tolist(),
            np.interp(at, times, turns).tolist(),
            self._turns,
            strict=True,
        ):
            if name in contacts and times[0] <= t <= times[-1]:
                x, y, _ = contacts[name]
                expected = math.cos(steering) * (v - w * y) + math.sin(steering) * w * x
                found.append(WheelTurn(t, name, measured, expected))
        return tuple(found)


def _with_state(snapshot: StateSample, state: NavigationState) -> StateSample:
    variances = np.diagonal(np.array(state.covariance).reshape(len(state.names), -1))
    return replace(
        snapshot,
        speed=state.linear_velocity[0],
        side=state.linear_velocity[1],
        turn=state.angular_velocity[2],
        standing=state.standing,
        mode=state.mode,
        phase=state.phase,
        values=dict(zip(state.names, state.values, strict=True)),
        sigmas=dict(zip(state.names, np.sqrt(np.maximum(variances, 0.0)).tolist(), strict=True)),
    )


def _velocity(snapshot: StateSample) -> tuple[float, float]:
    c, s = math.cos(snapshot.yaw), math.sin(snapshot.yaw)
    return (c * snapshot.speed - s * snapshot.side, s * snapshot.speed + c * snapshot.side)


def _latest(snapshots: tuple[StateSample, ...], times: Array, t: float) -> StateSample | None:
    """Return the newest snapshot that is not newer than `t`, and not older than a second."""
    index = int(np.searchsorted(times, t, side="right")) - 1
    return snapshots[index] if index >= 0 and t - times[index] < 1.0 else None


def _yaw(pose: Pose) -> float:
    x, y, _ = so3.rotate(pose.wxyz, (1.0, 0.0, 0.0))
    return math.atan2(y, x)


__all__ = ["Collector", "FixRecord", "Replayed", "Sensor", "StateSample", "WheelTurn"]
