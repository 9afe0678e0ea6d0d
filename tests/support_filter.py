"""A vehicle, its simulator and the filter for the scenario tests: modest rates, so that each takes a second or two."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from support_shared import SameObject, freeze, run_shared, share

from benchmarks.rough_simulation import RoughSimulation
from modelserver.earth.geodesy import origin_at
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.modes import ModeLocalizer
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.geometry import ModelBuilder
from modelserver.messages import Decision, Estimate, FixType, Mode, Sample, SwitchMode, Verdict
from modelserver.simulation import (
    DrivePhase,
    Event,
    GpsModel,
    ImuModel,
    Simulation,
    Timing,
    Trajectory,
    WheelsModel,
)
from modelserver.transforms.pose import Pose

ORIGIN = origin_at(50.27, -111.18, 700.0)
WHEELS = {"left": "Car:Left", "right": "Car:Right"}
IMU_HZ, WHEELS_HZ, GPS_HZ = 25.0, 10.0, 4.0
IMU_TIMING = Timing(IMU_HZ, 0.004, 0.001)
GPS_TIMING = Timing(GPS_HZ, 0.06, 0.01)
WHEELS_TIMING = Timing(WHEELS_HZ, 0.01, 0.002)

PLAIN_GPS = GpsModel(GPS_TIMING, correlated_sigma=0.3, white_sigma=0.05)
RTK_LIKE = GpsModel(GPS_TIMING, correlated_sigma=0.01, white_sigma=0.01, fix_type=FixType.RTK_FIXED)
IMU = ImuModel(IMU_TIMING)
QUICK_IMU = ImuModel(Timing(50.0, 0.004, 0.001))
"""For what needs more of the motion than the usual rate shows."""
WHEELS_MODEL = WheelsModel(WHEELS_TIMING)

MOUNT = Pose.from_rpy((0.3, -0.3, 0.5), math.pi / 2, 0.0, -math.pi / 2)

Transform = Callable[[Iterable[Event]], Iterable[Event]]


@cache
def rig(turned: float = 0.0, imu: Pose = MOUNT, kinematics: Any = "differential", *, wheels: bool = True) -> SensorRig:
    """The vehicle; `turned` is the yaw of its body on the ground: sensors stay where they are on the body."""
    builder = ModelBuilder("car")
    car = builder.add_body("Car")
    X = Pose.from_rpy((0.0, 0.0, 0.0), 0.0, 0.0, turned)
    car.add_frame("Base")
    for name, pose in (
        ("Imu", imu),
        ("Antenna", Pose((0.25, 0.1, 1.0))),
        ("Second", Pose((-0.75, 0.1, 1.0))),
        ("Left", Pose((0.0, 0.3, -0.1))),
        ("Right", Pose((0.0, -0.3, -0.1))),
        ("Camera", Pose.from_rpy((0.5, 0.0, 0.8), 0.0, 0.1, 0.2)),
    ):
        turned_pose = X @ pose if name not in ("Left", "Right") else pose
        car.add_frame(name, turned_pose)
    return SensorRig(
        builder.build(),
        "Car:Base",
        "Car:Imu",
        "Car:Antenna",
        "Car:Second",
        WHEELS if wheels else {},
        kinematics,
    )


RIG = rig()


def simulation(
    phases: Sequence[DrivePhase], on: SensorRig = RIG, *, yaw: float = 0.7, seed: int = 1, **more: Any
) -> Simulation:
    """A drive of the vehicle; `more` goes to the simulator, over what stands here."""
    arguments: dict[str, Any] = {
        "gps_frame": "Car:Antenna",
        "imu_frame": "Car:Imu",
        "wheel_frames": WHEELS,
        "gps_model": PLAIN_GPS,
        "imu_model": IMU,
        "wheels_model": WHEELS_MODEL,
        **more,
    }

    def simulate() -> Simulation:
        found = RoughSimulation(on.model, "Car:Base", Trajectory(phases, yaw=yaw), ORIGIN, seed=seed, **arguments)
        (found._arrivals,) = itertools.tee(found._arrivals, 1)
        found.truth = cache(found.truth)
        return found

    key = ("simulation", SameObject(on), freeze(phases), yaw, seed, freeze(arguments))
    return fork(share(key, simulate))


def fork(simulation: Simulation) -> Simulation:
    """Return a simulation that goes on like this one, which does not advance: their samples are computed once."""
    forked = copy.copy(simulation)
    forked._arrivals = copy.copy(simulation._arrivals)
    return forked


@dataclass
class Row:
    """An estimate beside the truth: seconds since the start, errors east, north (m) and of heading (rad)."""

    t: float
    estimate: Estimate
    east: float
    north: float
    heading: float
    speed: float

    @property
    def off(self) -> float:
        return math.hypot(self.east, self.north)

    @property
    def valid(self) -> bool:
        return self.estimate.enu is not None and not self.estimate.invalid


@dataclass
class Run:
    """What a drive showed: rows, the ledger, and the localizer at the end."""

    simulation: Simulation
    localizer: Any
    rows: list[Row] = field(default_factory=list)
    ledger: list[Decision] = field(default_factory=list)

    def between(self, begin: float, end: float = math.inf) -> list[Row]:
        return [row for row in self.rows if begin <= row.t < end]

    def at(self, t: float) -> Row:
        return next(row for row in self.rows if row.t >= t)

    @property
    def last(self) -> Row:
        return self.rows[-1]

    def decisions(self, kind: str, verdict: Verdict | None = None, reason: str | None = None) -> list[Decision]:
        return [
            word
            for word in self.ledger
            if word.kind == kind
            and (verdict is None or word.verdict is verdict)
            and (reason is None or word.reason == reason)
        ]

    def seconds(self, word: Decision) -> float:
        return (word.utime - self.simulation.start_utime) * 1e-6

    @property
    def odom_steps(self) -> list[float]:
        """By how much Odom moved between neighboring rows beyond what the true speed explains, meters."""
        steps = []
        for a, b in zip(self.rows, self.rows[1:], strict=False):
            moved = math.dist(a.estimate.odom.xyz, b.estimate.odom.xyz)
            way = max(abs(a.speed), abs(b.speed)) * (b.t - a.t)
            steps.append(max(moved - way, 0.0))
        return steps


def row(run: Simulation, estimate: Estimate) -> Row:
    true = run.truth(estimate.utime)
    east = north = heading = math.nan
    if estimate.enu is not None:
        east, north, _ = np.subtract(estimate.enu.xyz, true.enu.xyz).tolist()
        heading = math.remainder(estimate.enu.rpy[2] - true.enu.rpy[2], math.tau)
    return Row(
        (estimate.utime - run.start_utime) * 1e-6, estimate, east, north, heading, math.hypot(*true.velocity[:2])
    )


def leave_unchanged(events: Iterable[Event]) -> Iterable[Event]:
    return events


@dataclass
class Progress:
    """A drive so far."""

    localizer: Any
    every: float
    due: int = 0
    ledger: list[Decision] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)

    def update(self, event: Sample | SwitchMode) -> None:
        """Process a sample, and take an estimate every so often at the newest sample's instant."""
        self.localizer, notes = self.localizer.process(event)
        self.ledger += [note for note in notes if isinstance(note, Decision)]
        utime = self.localizer.utime
        if utime >= self.due and utime and not isinstance(event, SwitchMode):
            self.due = utime + round(self.every * 1e6)
            self.estimates.append(self.localizer.estimate(utime))

    def resume(self, at: Progress) -> Progress:
        return replace(at, ledger=at.ledger[:], estimates=at.estimates[:])


def drive(
    run: Simulation,
    seconds: float,
    *,
    settings: FilterSettings | None = None,
    on: SensorRig = RIG,
    every: float = 0.5,
    transform: Transform = leave_unchanged,
    mode: Mode = Mode.FULL,
    localizer: FilterLocalizer | ModeLocalizer | None = None,
    switches: Sequence[tuple[float, SwitchMode]] = (),
) -> Run:
    """Drive for some seconds, and take a row every so often at the newest sample's instant."""
    key = (SameObject(on), settings, mode) if localizer is None else SameObject(localizer)
    first: Any = localizer or FilterLocalizer.start(Setup(on, settings), ORIGIN, mode)
    events = _insert(switches, transform(run.events(seconds)), run.start_utime)
    done = run_shared(("drive", key, every), Progress(first, every), events)
    return Run(run, done.localizer, [row(run, each) for each in done.estimates], done.ledger)


def _insert(
    switches: Sequence[tuple[float, SwitchMode]], events: Iterable[Event], start_utime: int
) -> Iterator[Event | SwitchMode]:
    """Yield the events, before the first of each switch's second the switch."""
    waiting = list(switches)
    for event in events:
        if waiting and event.header.host_utime >= start_utime + round(waiting[0][0] * 1e6):
            yield waiting.pop(0)[1]
        yield event


def rms(values: Iterable[float]) -> float:
    return math.sqrt(float(np.mean(np.square(list(values)))))
