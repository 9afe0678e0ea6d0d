"""A simulated drive of the Raptor as its bus carries it, and the comparison of published poses with the truth."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from support_shared import run_shared

from modelserver import core
from modelserver.config.vehicle_file import load_config
from modelserver.core import CoreState, Instant
from modelserver.messages import GpsSample, ImuSample, Invalid, PoseAnswer, PublishPose, Tick, WheelsSample
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.simulation import Event, Simulation
from modelserver.transforms.pose import Pose
from mstools.launch.drive import make_simulation

RAPTOR = Path(__file__).parents[1] / "config" / "raptor"
CHANNELS: dict[type, str] = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
SENSORS = tuple(CHANNELS)

MAX_MISLEADING_S = 1.0
"""Seconds for which a valid pose may be wrong by more than its protection level (misleading information)."""

Transform = Callable[[Iterable[Event]], Iterable[Event]]


@cache
def raptor() -> Vehicle:
    """Load the Raptor once for all drives of it."""
    return load_vehicle(load_config(RAPTOR / "vehicle.yaml"))


@dataclass
class SimulatedDrive:
    """A drive of figure eights at 3 m/s after three stationary seconds: its truth and its samples."""

    start_utime: int
    seconds: float
    simulation: Simulation
    _truths: dict[int, Pose] = field(default_factory=dict)
    _events: tuple[Event, ...] | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    """Held while the simulation runs: one thread may stream its events while another reads its truth."""

    @classmethod
    def create(cls, start_utime: int, seconds: float, scenario: str = "eight", **models: Any) -> SimulatedDrive:
        config = raptor().config
        return cls(
            start_utime, seconds, make_simulation(config, start_utime, seconds, scenario, sensors=SENSORS, **models)
        )

    def events(self, transform: Transform = lambda events: events) -> list[Event]:
        """Return the samples of the drive in order of arrival (host_utime)."""
        if self._events is None:
            self._events = tuple(self.stream())
        return list(transform(self._events))

    def stream(self, transform: Transform = lambda events: events) -> Iterator[Event]:
        """Yield the same samples, each simulated on demand."""
        events = iter(transform(self.simulation.events(self.seconds)))
        while True:
            with self._lock:
                event = next(events, None)
            if event is None:
                return
            yield event

    def truth(self, utime: int) -> Pose:
        """Return the pose of the base frame in World:UTM, absolute and not relative to an origin."""
        if utime not in self._truths:
            with self._lock:
                true = self.simulation.truth(utime).utm
            origin = self.simulation.geodesy.origin.initial_utm
            self._truths[utime] = Pose(tuple(a + b for a, b in zip(true.xyz, origin, strict=True)), true.wxyz)
        return self._truths[utime]


@dataclass(frozen=True)
class ComparedPose:
    """A pose and its errors in meters and radians; `is_misleading` where one exceeds its protection level."""

    utime: int
    is_valid: bool
    position_error: float
    heading_error: float
    is_misleading: bool


def compare_pose(answer: PoseAnswer, truth: Pose) -> ComparedPose:
    """Compare a pose with the truth. A valid pose with a non-finite protection level is misleading."""
    found = answer.transformation
    if not found.is_valid or answer.origin is None:
        return ComparedPose(found.utime, False, math.nan, math.nan, False)
    position = [a + b for a, b in zip(found.pose.xyz, answer.origin.initial_utm, strict=True)]
    horizontal = math.hypot(position[0] - truth.xyz[0], position[1] - truth.xyz[1])
    heading = abs(math.remainder(float(found.rpy[2]) - float(truth.rpy[2]), math.tau))
    is_within = horizontal <= answer.horizontal_protection_level and heading <= answer.heading_protection_level
    return ComparedPose(found.utime, True, horizontal, heading, not is_within)


@dataclass
class CoreRun:
    """The poses that the core published during a drive, at 20 Hz, and its final state."""

    drive: SimulatedDrive
    state: CoreState
    poses: list[tuple[PoseAnswer, ComparedPose]] = field(default_factory=list)

    def between(self, begin: float, end: float = math.inf) -> list[ComparedPose]:
        first, last = self.drive.start_utime + begin * 1e6, self.drive.start_utime + end * 1e6
        return [found for _, found in self.poses if first <= found.utime < last]

    def reasons(self, begin: float, end: float = math.inf) -> set[str]:
        """Return the names of the invalid reasons."""
        first, last = self.drive.start_utime + begin * 1e6, self.drive.start_utime + end * 1e6
        return {
            reason.name or ""
            for pose, found in self.poses
            if first <= found.utime < last
            for reason in Invalid(pose.transformation.invalid_reasons)
        }

    def longest_invalid(self, begin: float, end: float = math.inf) -> float:
        """Return the longest time without a valid pose, seconds."""
        longest = 0.0
        for valid, group in itertools.groupby(self.between(begin, end), lambda each: each.is_valid):
            if not valid:
                utimes = [each.utime for each in group]
                longest = max(longest, (utimes[-1] - utimes[0]) * 1e-6 + PERIOD_US * 1e-6)
        return longest

    @property
    def longest_misleading(self) -> float:
        return longest_misleading([found for _, found in self.poses])


PERIOD_US = 50_000


@dataclass
class Progress:
    """The core so far in a drive, with ticks between the samples."""

    drive: SimulatedDrive
    clock_step: tuple[float, float]
    state: CoreState
    due: int
    poses: list[tuple[PoseAnswer, ComparedPose]] = field(default_factory=list)

    def update(self, event: Event) -> None:
        arrival = event.header.host_utime
        while arrival >= self.due:
            self.state, outputs = core.step(self.state, Tick(0.0, 0, 0), self.now(self.due))
            truth = self.drive.truth(self.due)
            self.poses += [
                (each.world, replace(compare_pose(each.world, truth), utime=self.due))
                for each in outputs
                if isinstance(each, PublishPose)
            ]
            self.due += PERIOD_US
        self.state, _ = core.step(self.state, event, self.now(arrival))

    def now(self, arrival: int) -> Instant:
        since, (second, ahead) = arrival - self.drive.start_utime, self.clock_step
        return Instant(1_000_000_000 + since * 1000, arrival + (round(ahead * 1e6) if since >= second * 1e6 else 0))

    def resume(self, at: Progress) -> Progress:
        # what is compared with the truth later is that of this drive
        return replace(at, drive=self.drive, poses=at.poses[:])


def run_core(
    drive: SimulatedDrive, events: Iterable[Event], clock_step: tuple[float, float] = (math.inf, 0.0)
) -> CoreRun:
    """Step the core through a drive at full speed, each sample at its arrival, with ticks between; no clock, no bus.

    `clock_step`: the second at which the time of day is set ahead, and by how many seconds; stamps stay as given.
    """
    begin = drive.start_utime
    at_start = Instant(1_000_000_000, begin)
    # the events that two drives share come from the same truth
    done = run_shared(
        ("core", begin, clock_step), Progress(drive, clock_step, raptor().start_core(at_start), begin), events
    )
    return CoreRun(drive, done.state, done.poses)


def longest_misleading(found: Sequence[ComparedPose]) -> float:
    """Return the longest time for which poses were misleading, seconds."""
    longest = 0.0
    for is_misleading, group in itertools.groupby(found, lambda each: each.is_misleading):
        if is_misleading:
            utimes = [each.utime for each in group]
            longest = max(longest, (utimes[-1] - utimes[0]) * 1e-6)
    return longest
