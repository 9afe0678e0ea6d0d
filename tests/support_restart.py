"""A drive that is broken off and begun again by a localizer that recalls the first one's state."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

from modelserver.localization.filter.localizer import FilterLocalizer
from modelserver.localization.filter.setup import Setup
from modelserver.messages import Kept, Mode, Recalled, WheelsSample
from modelserver.simulation import DrivePhase, Event, Simulation, Trajectory
from tests.support_filter import IMU, ORIGIN, PLAIN_GPS, RIG, WHEELS, WHEELS_MODEL, Run, drive, simulation

FIRST, GAP = 40.0, 4.0
"""Seconds of the first run, and until the second one hears its first sample."""

TO_A_STOP = (DrivePhase(4.0), DrivePhase(2.0, 2.0, 0.0), DrivePhase(20.0, 2.0, 0.1), DrivePhase(2.0, 0.0))
"""28 s: a vehicle that drove and stands; it stands on until what follows."""

DRIVES_OFF = (DrivePhase(2.0, 2.0, 0.0), DrivePhase(20.0, 2.0, 0.1), DrivePhase(2.0, 0.0))


def first_run(after: Sequence[DrivePhase] = (), seed: int = 1, seconds: float = FIRST) -> tuple[Run, Kept]:
    """The run that is broken off, and what it kept."""
    run, kept = _first_run(tuple(after), seed, seconds)
    return replace(run, simulation=_fork(run.simulation)), kept


@cache
def _first_run(after: tuple[DrivePhase, ...], seed: int, seconds: float) -> tuple[Run, Kept]:
    """Simulate a first run once for all tests of it; nobody may draw from its simulation but through `_fork`."""
    sim = simulation((*TO_A_STOP, *after, DrivePhase(200.0)), seed=seed)
    (sim._arrivals,) = itertools.tee(sim._arrivals, 1)
    run = drive(sim, seconds)
    kept = run.localizer.kept()
    assert kept is not None
    return run, kept


def _fork(sim: Simulation) -> Simulation:
    """Return a simulation that continues like `sim`, which stays where it is."""
    fork = copy.copy(sim)
    fork._arrivals = copy.copy(sim._arrivals)
    return fork


def second_run(
    sim: Simulation, kept: Kept | None, gap: float, seconds: float, transform=None, age: float | None = None, **more
) -> Run:
    """The run that comes after; without `kept` it starts cold."""
    recalled = None if kept is None else Recalled(kept, gap if age is None else age)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, recalled)
    passed = {} if transform is None else {"transform": transform}
    return drive(sim, seconds, localizer=localizer, every=0.1, **passed, **more)


def lose(sim: Simulation, seconds: float) -> None:
    """Let samples pass that nobody hears."""
    for _ in sim.events(seconds):
        pass


def elsewhere(
    run: Run, gap: float, east: float, turn: float, phases: Sequence[DrivePhase], seed: int = 1
) -> Simulation:
    """The vehicle of a run again, `east` metres away and turned by `turn` radians when the gap is over."""
    true = run.simulation.truth(run.simulation.start_utime + round(FIRST * 1e6))
    x, y, _ = true.enu.xyz
    start = run.simulation.start_utime + round((FIRST + gap) * 1e6)
    return Simulation(
        RIG.model,
        "Car:Base",
        Trajectory(phases, (x + east, y), math.remainder(true.yaw + turn, math.tau)),
        ORIGIN,
        seed=seed,
        start_utime=start,
        gps_frame="Car:Antenna",
        imu_frame="Car:Imu",
        wheel_frames=WHEELS,
        gps_model=PLAIN_GPS,
        imu_model=IMU,
        wheels_model=WHEELS_MODEL,
    )


def counters_go_on(kept: Kept, rolled: tuple[float, float]):
    """The wheels' driver has run on: numbers and ways go on from what was kept, and have rolled meanwhile."""
    assert kept.pose is not None
    ways = dict(kept.pose.wheels)
    more = {"left": ways["left"] + rolled[0], "right": ways["right"] + rolled[1]}

    def transform(events: Iterable[Event]) -> Iterable[Event]:
        for event in events:
            if isinstance(event, WheelsSample):
                header = replace(event.header, seq=event.header.seq + kept.pose.wheels_seq + 40)
                wheels = tuple(replace(each, travel=each.travel + more[each.name]) for each in event.wheels)
                yield replace(event, header=header, wheels=wheels)
            else:
                yield event

    return transform


def first_valid(run: Run) -> float:
    """Seconds from the first sample of the second run to its first valid pose, infinite where there is none."""
    begin = run.rows[0].t
    return next((row.t - begin for row in run.rows if row.valid), math.inf)


def longest_wrong(run: Run) -> float:
    """The longest time, seconds, that a valid pose was off by more than its bound."""
    longest, since = 0.0, None
    for row in run.rows:
        estimate = row.estimate
        wrong = row.valid and (row.off > estimate.horizontal_bound or abs(row.heading) > estimate.heading_bound)
        since = (row.t if since is None else since) if wrong else None
        if since is not None:
            longest = max(longest, row.t - since)
    return longest


def words(run: Run) -> list[str]:
    """What the ledger says of what was kept."""
    return [word.reason for word in run.said("kept")]
