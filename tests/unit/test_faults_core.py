"""Sensor faults through the whole core in a simulated drive: the pose is right, or it is reported invalid."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support_drive import MAX_MISLEADING_S, CoreRun, Progress, SimulatedDrive, raptor, run_core
from support_faults import FAULTS, FROM_S, INERTIAL

from modelserver import core
from modelserver.core import Instant
from modelserver.messages import VALID, GpsSample, ImuSample, PublishHealth, Tick, WheelsSample
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import Event, GpsModel

pytestmark = pytest.mark.slow

START = 1_700_000_000_000_000
SECONDS = 36.0
SHORT_SECONDS = 24.0
INVALID_WITHIN_S = 2.0
"""Time limit, seconds, for a fault to make the pose invalid."""


@cache
def make_drive() -> tuple[SimulatedDrive, tuple[Event, ...]]:
    """Simulate the drive without faults once for all tests that only change its messages."""
    drive = SimulatedDrive.create(START, SECONDS, imu_model=INERTIAL)
    return drive, tuple(drive.events())


def run(name: str) -> CoreRun:
    fault = FAULTS[name]
    drive = SimulatedDrive.create(START, SHORT_SECONDS, **{"imu_model": INERTIAL, **fault.models})
    return run_core(drive, drive.events(lambda events: fault.transform(events, START)))


@pytest.mark.parametrize("name", FAULTS)
def test_given_a_sensor_that_fails_then_the_pose_is_right_or_reported_invalid(name: str) -> None:
    fault, found = FAULTS[name], run(name)
    assert found.longest_misleading <= MAX_MISLEADING_S
    assert all(each.is_valid for each in found.between(FROM_S - 4.0, FROM_S))
    after = [each.is_valid for each in found.between(FROM_S + INVALID_WITHIN_S)]
    assert all(after) if fault.stays_valid else not any(after)
    assert fault.counted <= found.state.rejected.keys()
    assert all(each.position_error < 2.0 for each in found.between(FROM_S) if each.is_valid)


def test_given_fixes_that_stay_700_m_away_then_the_pose_is_that_of_dead_reckoning() -> None:
    drive = SimulatedDrive.create(
        START, SECONDS, imu_model=INERTIAL, gps_model=GpsModel(jumps=((FROM_S, 1e9, 700.0, 0.0),))
    )
    found = run_core(drive, drive.events())
    assert len({pose.transformation.pose_epoch for pose, each in found.poses if each.utime > START + 8e6}) == 1
    assert all(each.is_valid and each.position_error < 2.0 for each in found.between(FROM_S))


def delay_fixes(events: Iterable[Event], seconds: float, since: float) -> list[Event]:
    """Delay the fixes after an instant, without changing their stamps."""

    def delay(event: Event) -> Event:
        header = event.header
        if not isinstance(event, GpsSample) or header.utime < START + since * 1e6:
            return event
        late = round(seconds * 1e6)
        return replace(event, header=replace(header, utime=header.utime + late, host_utime=header.host_utime + late))

    return sorted(map(delay, events), key=lambda event: event.header.host_utime)


@pytest.mark.parametrize("since", [0.0, FROM_S], ids=["from the start", "while driving"])
@pytest.mark.parametrize("seconds", [0.2, 0.5, 1.0])
def test_given_fixes_with_unconfigured_latency_then_the_pose_stays_within_its_protection_levels(
    seconds: float, since: float
) -> None:
    drive, events = make_drive()
    found = run_core(drive, delay_fixes(events, seconds, since))
    assert found.longest_misleading <= MAX_MISLEADING_S
    # at 3 m/s the latency is 3 m at most; in turns it becomes observable, so it is less in the end
    assert all(each.position_error < 3.0 * seconds + 0.3 for each in found.between(0.0) if each.is_valid)
    if seconds < 0.5 or (seconds < 1.0 and not since):
        # a latency that jumps by more, or is more than that of any receiver, is one of fixes that contradict the path
        assert np.mean([each.is_valid for each in found.between(8.0, SECONDS)]) > 0.8
        assert all(each.position_error < 0.8 * 3.0 * seconds for each in found.between(SECONDS - 2.0, SECONDS))


def test_given_late_fixes_in_a_circle_from_the_start_then_the_heading_uncertainty_covers_their_latency() -> None:
    drive = SimulatedDrive.create(
        START, SHORT_SECONDS, "circle", imu_model=INERTIAL, gps_model=GpsModel(unstated_latency=0.15)
    )
    found = run_core(drive, drive.events())
    assert found.longest_misleading <= MAX_MISLEADING_S
    assert all(each.position_error < 1.5 for each in found.between(0.0) if each.is_valid)


@pytest.mark.parametrize("hours", [-1.0, 1.0], ids=["back", "ahead"])
def test_given_the_computers_clock_set_by_an_hour_then_the_pose_is_not_valid_until_it_is_right_again(
    hours: float,
) -> None:
    drive, events = make_drive()
    step = round(hours * 3600e6)

    def step_clock(event):
        header = event.header
        if header.host_utime < START + FROM_S * 1e6:
            return event
        return replace(event, header=replace(header, utime=header.utime + step))

    found = run_core(drive, [step_clock(each) for each in events], clock_step=(FROM_S, hours * 3600.0))
    assert found.longest_misleading <= MAX_MISLEADING_S
    assert found.between(SECONDS - 1.0)[-1].is_valid
    assert all(each.position_error < 2.0 for each in found.between(FROM_S) if each.is_valid)


OFFSETS = {
    "since its start": (60_000_000 - START, "from 0 on, as of a simulation, or of a unit since its start?"),
    "an hour behind": (-3_600_000_000, "s (1 h: a time zone?) behind their receipt"),
    "GPS time": (18_000_000, "s (GPS time instead of UTC?) ahead of their receipt"),
}


@pytest.mark.parametrize("kind", [GpsSample, ImuSample, WheelsSample])
@pytest.mark.parametrize("offset", OFFSETS)
def test_given_a_source_whose_clock_is_off_then_that_one_is_named_and_no_other(offset: str, kind: type[Event]) -> None:
    microseconds, known = OFFSETS[offset]

    def shift(event: Event) -> Event:
        utime = event.header.utime + microseconds
        return replace(event, header=replace(event.header, utime=utime)) if isinstance(event, kind) else event

    drive, events = make_drive()
    found = run_core(drive, list(map(shift, events))[: len(events) // 2])
    now = Instant(1_000_000_000 + found.poses[-1][1].utime * 1000 - START * 1000, found.poses[-1][1].utime)
    health = next(
        output.health
        for output in core.step(found.state._replace(health_due_ns=0), Tick(0.0, 0, 0), now)[1]
        if isinstance(output, PublishHealth)
    )
    warnings = dict(health.warnings)
    source = {GpsSample: "sensor:gps", ImuSample: "sensor:imu", WheelsSample: "sensor:wheels"}[kind]
    assert known in warnings[source]
    assert "its clock is off" in warnings[source]
    # the samples of the others are used, and none of them is blamed
    assert not {each for each in warnings if each.startswith("sensor:")} - {source}
    others = {name: each for name, each in found.state.traffic.items() if name != source}
    for name, each in others.items():
        rejected = sum(found.state.rejected.get((name, reason), 0) for reason in ("too_old", "future"))
        assert rejected < 0.1 * each.count
    assert found.longest_misleading == 0.0


@pytest.mark.parametrize("hours", [-1.0, -1000.0])
def test_given_a_log_that_is_played_back_then_no_clock_is_off(hours: float) -> None:
    def shift(event: Event) -> Event:
        return replace(event, header=replace(event.header, utime=event.header.utime + round(hours * 3600e6)))

    _, events = make_drive()
    state = raptor().start_core(Instant(1_000_000_000, START))
    for event in map(shift, events[: len(events) // 2]):
        state, _ = core.step(
            state, event, Instant(event.header.host_utime * 1000 - START * 1000 + 10**9, event.header.host_utime)
        )
    assert not {reason for _, reason in state.rejected} & {"too_old", "future"}
    assert state.localizer is not None
    assert state.localizer.estimate(state.localizer.utime).invalid == VALID


@pytest.mark.parametrize("mode", ["full", "no_imu", "raw"])
def test_given_two_receivers_on_one_channel_then_no_pose_is_valid_and_they_are_named(mode: str) -> None:
    count = 0

    def alternate(event: Event) -> Event:
        nonlocal count
        count += isinstance(event, GpsSample)
        if not isinstance(event, GpsSample) or count % 2:
            return event
        return replace(event, latitude_deg=event.latitude_deg + 30.0 / 111_000.0)

    drive, events = make_drive()
    config = raptor().config
    vehicle = load_vehicle(replace(config, localization=replace(config.localization, mode=mode)))
    progress = Progress(drive, (np.inf, 0.0), vehicle.start_core(Instant(1_000_000_000, START)), START)
    for event in map(alternate, events):
        progress.update(event)
    found = CoreRun(drive, progress.state, progress.poses)
    assert not any(each.is_valid for each in found.between(9.0))
    assert "GNSS_INCONSISTENT" in found.reasons(9.0)
    assert found.longest_misleading <= MAX_MISLEADING_S
    assert progress.state.localizer is not None
    texts = [each.text for each in progress.state.localizer.summary(progress.due).findings]
    assert any("two receivers on one channel: fixes alternate between places 30.0 m apart" in text for text in texts)
