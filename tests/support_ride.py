"""A simulated drive of the Raptor as its bus hears it, and whether a pose is right or says that it is not."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from modelserver import core
from modelserver.config import load_config
from modelserver.core import CoreState, Instant
from modelserver.messages import GpsSample, ImuSample, Invalid, PoseAnswer, PublishPose, Tick, WheelsSample
from modelserver.service.daemon import Vehicle, load_vehicle
from modelserver.simulation import Event, Simulation
from modelserver.spatial.pose import Pose
from mstools.demo.drive import simulation

RAPTOR = Path(__file__).parents[1] / "config" / "raptor"
CHANNELS: dict[type, str] = {GpsSample: "GPS", ImuSample: "IMU", WheelsSample: "WHEELS"}
SENSORS = tuple(CHANNELS)

LONGEST_LIE_S = 1.0
"""So long a pose may be off by more than the bound it states and yet say that it is valid."""

Transform = Callable[[Iterable[Event]], Iterable[Event]]


@cache
def raptor() -> Vehicle:
    """Load the Raptor once for all drives of it."""
    return load_vehicle(load_config(RAPTOR / "vehicle.yaml"))


@dataclass
class Ride:
    """A drive: stands for three seconds, then drives eights at 3 m/s. Its truth, and what its sensors say."""

    start_utime: int
    seconds: float
    simulation: Simulation
    _truths: dict[int, Pose] = field(default_factory=dict)
    _events: tuple[Event, ...] | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    """Held while the simulation works: one thread may stream its events and another ask for its truth."""

    @classmethod
    def at(cls, start_utime: int, seconds: float, scenario: str = "eight", **models: Any) -> Ride:
        config = raptor().config
        return cls(start_utime, seconds, simulation(config, start_utime, seconds, scenario, sensors=SENSORS, **models))

    def events(self, transform: Transform = lambda events: events) -> list[Event]:
        """What arrives during the drive, in the order of arrival (host_utime)."""
        if self._events is None:
            self._events = tuple(self.stream())
        return list(transform(self._events))

    def stream(self, transform: Transform = lambda events: events) -> Iterator[Event]:
        """The same, each simulated when it is asked for."""
        events = iter(transform(self.simulation.events(self.seconds)))
        while True:
            with self._lock:
                event = next(events, None)
            if event is None:
                return
            yield event

    def truth(self, utime: int) -> Pose:
        """Where the base frame is in World:UTM: easting, northing and height themselves, not relative to an origin."""
        if utime not in self._truths:
            with self._lock:
                true = self.simulation.truth(utime).utm
            origin = self.simulation.geodesy.origin.initial_utm
            self._truths[utime] = Pose(tuple(a + b for a, b in zip(true.xyz, origin, strict=True)), true.wxyz)
        return self._truths[utime]


@dataclass(frozen=True)
class Judged:
    """A pose beside the truth: errors in metres and radians, and whether they are within what the pose states."""

    utime: int
    valid: bool
    off: float
    turned: float
    lies: bool


def judged(answer: PoseAnswer, truth: Pose) -> Judged:
    """Compare a pose with the truth. One that is valid and states no bound, or no number, lies."""
    found = answer.transformation
    if not found.valid or answer.origin is None:
        return Judged(found.utime, False, math.nan, math.nan, False)
    place = [a + b for a, b in zip(found.pose.xyz, answer.origin.initial_utm, strict=True)]
    off = math.hypot(place[0] - truth.xyz[0], place[1] - truth.xyz[1])
    turned = abs(math.remainder(float(found.rpy[2]) - float(truth.rpy[2]), math.tau))
    within = off <= answer.horizontal_bound and turned <= answer.heading_bound
    return Judged(found.utime, True, off, turned, not within)


@dataclass
class CoreRun:
    """What the core said of a drive that it was told of at full speed: poses at 50 Hz, and its state at the end."""

    ride: Ride
    state: CoreState
    poses: list[tuple[PoseAnswer, Judged]] = field(default_factory=list)

    def between(self, begin: float, end: float = math.inf) -> list[Judged]:
        first, last = self.ride.start_utime + begin * 1e6, self.ride.start_utime + end * 1e6
        return [found for _, found in self.poses if first <= found.utime < last]

    def reasons(self, begin: float, end: float = math.inf) -> set[str]:
        """The words of why poses were not valid."""
        first, last = self.ride.start_utime + begin * 1e6, self.ride.start_utime + end * 1e6
        return {
            reason.name or ""
            for pose, found in self.poses
            if first <= found.utime < last
            for reason in Invalid(pose.transformation.invalid_reasons)
        }

    def silence(self, begin: float, end: float = math.inf) -> float:
        """For how many seconds on end poses were not valid."""
        longest = 0.0
        for valid, group in itertools.groupby(self.between(begin, end), lambda each: each.valid):
            if not valid:
                utimes = [each.utime for each in group]
                longest = max(longest, (utimes[-1] - utimes[0]) * 1e-6 + PERIOD_US * 1e-6)
        return longest

    @property
    def lie(self) -> float:
        return longest_lie([found for _, found in self.poses])


PERIOD_US = 20_000


def told_to_core(ride: Ride, events: Iterable[Event], clock_step: tuple[float, float] = (math.inf, 0.0)) -> CoreRun:
    """Tell the core of a drive, each sample when it arrives, with ticks between. Clock and bus are not needed.

    `clock_step`: at so many seconds the time of day is set so many seconds ahead; the samples' stamps are as given.
    """
    begin = ride.start_utime

    def now(arrival: int) -> Instant:
        since = arrival - begin
        return Instant(
            1_000_000_000 + since * 1000, arrival + (round(clock_step[1] * 1e6) if since >= clock_step[0] * 1e6 else 0)
        )

    run = CoreRun(ride, raptor().core(now(begin)))
    due = begin
    for event in events:
        while event.header.host_utime >= due:
            at = now(due)
            run.state, outputs = core.step(run.state, Tick(0.0, 0, 0), at)
            truth = ride.truth(due)
            run.poses += [
                (each.world, replace(judged(each.world, truth), utime=due))
                for each in outputs
                if isinstance(each, PublishPose)
            ]
            due += PERIOD_US
        run.state, _ = core.step(run.state, event, now(event.header.host_utime))
    return run


def longest_lie(found: Sequence[Judged]) -> float:
    """Return for how many seconds on end poses were valid and off by more than they said."""
    longest = 0.0
    for lying, group in itertools.groupby(found, lambda each: each.lies):
        if lying:
            utimes = [each.utime for each in group]
            longest = max(longest, (utimes[-1] - utimes[0]) * 1e-6)
    return longest
