"""A drive that is interrupted and continued by a localizer with the persisted state of the first run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

from support_filter import IMU, ORIGIN, PLAIN_GPS, RIG, WHEELS, WHEELS_MODEL, Run, drive, fork, simulation

from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.state import Setup
from modelserver.messages import Mode, PersistedState, RestoredState, WheelsSample
from modelserver.simulation import DrivePhase, Event, Simulation, Trajectory

FIRST, GAP = 40.0, 4.0
"""Seconds of the first run, and until the second one receives its first sample."""

TO_A_STOP = (DrivePhase(4.0), DrivePhase(2.0, 2.0, 0.0), DrivePhase(20.0, 2.0, 0.1), DrivePhase(2.0, 0.0))
"""28 s: a vehicle that drove and stays stationary until what follows."""

DRIVES_OFF = (DrivePhase(2.0, 2.0, 0.0), DrivePhase(20.0, 2.0, 0.1), DrivePhase(2.0, 0.0))


def simulate_first_run(
    after: Sequence[DrivePhase] = (), seed: int = 1, seconds: float = FIRST
) -> tuple[Run, PersistedState]:
    """Return the interrupted run and its persisted state."""
    run, persisted = _simulate_first_run(tuple(after), seed, seconds)
    return replace(run, simulation=fork(run.simulation)), persisted


@cache
def _simulate_first_run(after: tuple[DrivePhase, ...], seed: int, seconds: float) -> tuple[Run, PersistedState]:
    """Simulate a first run once for all tests of it; draw from its simulation only through `fork`."""
    sim = simulation((*TO_A_STOP, *after, DrivePhase(200.0)), seed=seed)
    run = drive(sim, seconds)
    persisted = run.localizer.get_state_to_persist()
    assert persisted is not None
    return run, persisted


def simulate_second_run(
    sim: Simulation,
    persisted: PersistedState | None,
    gap: float,
    seconds: float,
    transform=None,
    age: float | None = None,
    **more,
) -> Run:
    """Simulate the next run; without `persisted` it starts cold."""
    restored = None if persisted is None else RestoredState(persisted, gap if age is None else age)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, restored)
    passed = {} if transform is None else {"transform": transform}
    return drive(sim, seconds, localizer=localizer, every=0.1, **passed, **more)


def skip_samples(sim: Simulation, seconds: float) -> None:
    """Skip the samples of some seconds."""
    for _ in sim.events(seconds):
        pass


def simulate_elsewhere(
    run: Run, gap: float, east: float, turn: float, phases: Sequence[DrivePhase], seed: int = 1
) -> Simulation:
    """Simulate the vehicle of a run, `east` meters away and turned by `turn` radians when the gap is over."""
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


def continue_wheel_counters(persisted: PersistedState, rolled: tuple[float, float]):
    """Continue sequence numbers and distances of the wheels' driver from the persisted ones, and roll meanwhile."""
    assert persisted.pose is not None
    distances = dict(persisted.pose.wheels)
    more = {"left": distances["left"] + rolled[0], "right": distances["right"] + rolled[1]}

    def transform(events: Iterable[Event]) -> Iterable[Event]:
        for event in events:
            if isinstance(event, WheelsSample):
                header = replace(event.header, seq=event.header.seq + persisted.pose.wheels_seq + 40)
                wheels = tuple(replace(each, travel=each.travel + more[each.name]) for each in event.wheels)
                yield replace(event, header=header, wheels=wheels)
            else:
                yield event

    return transform


def find_first_valid(run: Run) -> float:
    """Return the seconds from the first sample of the second run to its first valid pose, infinite without one."""
    begin = run.rows[0].t
    return next((row.t - begin for row in run.rows if row.valid), math.inf)


def find_longest_misleading(run: Run) -> float:
    """Return the longest time, seconds, that the error of a valid pose exceeded its protection level."""
    longest, since = 0.0, None
    for row in run.rows:
        estimate = row.estimate
        wrong = row.valid and (
            row.off > estimate.horizontal_protection_level or abs(row.heading) > estimate.heading_protection_level
        )
        since = (row.t if since is None else since) if wrong else None
        if since is not None:
            longest = max(longest, row.t - since)
    return longest


def list_reasons(run: Run) -> list[str]:
    """Return the reasons of the ledger entries about the warm start."""
    return [word.reason for word in run.decisions("warm_start")]
