"""Sensors that tell what is not so, told to the whole core at full speed: the pose is right or says that it is not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import pytest
from support_faults import FAULTS, FROM_S, INERTIAL
from support_ride import LONGEST_LIE_S, CoreRun, Ride, told_to_core

from modelserver.messages import GpsSample
from modelserver.simulation import Event, GpsModel

pytestmark = pytest.mark.slow

START = 1_700_000_000_000_000
SECONDS = 36.0
ENOUGH = 24.0
AROUND = 2.0
"""Seconds after the start of a fault that takes the validity away by which it must have done so."""


@cache
def plain() -> tuple[Ride, tuple[Event, ...]]:
    """Simulate the drive without faults once for all tests that only change its messages."""
    ride = Ride.at(START, SECONDS, imu_model=INERTIAL)
    return ride, tuple(ride.events())


def run(name: str) -> CoreRun:
    fault = FAULTS[name]
    ride = Ride.at(START, ENOUGH, **{"imu_model": INERTIAL, **fault.models})
    return told_to_core(ride, ride.events(lambda events: fault.transform(events, START)))


@pytest.mark.parametrize("name", FAULTS)
def test_given_a_sensor_that_fails_then_the_pose_is_right_or_says_that_it_is_not(name: str) -> None:
    fault, found = FAULTS[name], run(name)
    assert found.lie <= LONGEST_LIE_S
    assert all(each.valid for each in found.between(FROM_S - 4.0, FROM_S))
    after = [each.valid for each in found.between(FROM_S + AROUND)]
    assert all(after) if fault.stays_valid else not any(after)
    assert fault.counted <= found.state.rejected.keys()
    assert all(each.off < 2.0 for each in found.between(FROM_S) if each.valid)


def test_given_fixes_that_stay_700_m_away_then_they_are_refused_until_they_have_agreed_with_the_way_for_20_s() -> None:
    ride = Ride.at(START, SECONDS, imu_model=INERTIAL, gps_model=GpsModel(jumps=((FROM_S, 1e9, 700.0, 0.0),)))
    found = told_to_core(ride, ride.events())
    epochs = {pose.transformation.pose_epoch for pose, each in found.poses if each.utime > START + 34e6}
    first = next(pose for pose, each in found.poses if each.utime > START + FROM_S * 1e6)
    assert all(each.off < 2.0 for each in found.between(FROM_S, FROM_S + 20.0) if each.valid)
    # who looks at the epoch sees that it was taken up anew; which of the two places was the right one nobody can tell
    assert epochs == {first.transformation.pose_epoch + 1}


def older(events: Iterable[Event], seconds: float, since: float) -> list[Event]:
    """What arrives where fixes are older than their stamps from an instant on."""

    def aged(event: Event) -> Event:
        header = event.header
        if not isinstance(event, GpsSample) or header.utime < START + since * 1e6:
            return event
        late = round(seconds * 1e6)
        return replace(event, header=replace(header, utime=header.utime + late, host_utime=header.host_utime + late))

    return sorted(map(aged, events), key=lambda event: event.header.host_utime)


@pytest.mark.parametrize("since", [0.0, FROM_S], ids=["from the start", "while driving"])
@pytest.mark.parametrize("seconds", [0.2, 0.3, 0.5, 1.0])
def test_given_fixes_older_than_their_stamps_by_what_nobody_told_then_the_pose_stays_within_its_bounds(
    seconds: float, since: float
) -> None:
    ride, events = plain()
    found = told_to_core(ride, older(events, seconds, since))
    assert found.lie <= LONGEST_LIE_S
    assert all(each.valid for each in found.between(8.0, SECONDS))
    # at 3 m/s what nobody told is 3 m at most; turns tell it, so it is less in the end
    assert all(each.off < 3.0 * seconds + 0.3 for each in found.between(0.0) if each.valid)
    assert all(each.off < 0.5 * 3.0 * seconds for each in found.between(SECONDS - 2.0, SECONDS))


def test_given_late_fixes_in_a_circle_from_the_start_then_the_heading_that_they_tell_is_as_unsure_as_they_are() -> None:
    ride = Ride.at(START, ENOUGH, "circle", imu_model=INERTIAL, gps_model=GpsModel(unstated_latency=0.15))
    found = told_to_core(ride, ride.events())
    assert found.lie <= LONGEST_LIE_S
    assert all(each.off < 1.5 for each in found.between(0.0) if each.valid)


@pytest.mark.parametrize("hours", [-1.0, 1.0], ids=["back", "ahead"])
def test_given_the_computers_clock_set_by_an_hour_then_the_pose_is_not_valid_until_it_is_right_again(
    hours: float,
) -> None:
    ride, events = plain()
    step = round(hours * 3600e6)

    def stepped(event):
        header = event.header
        if header.host_utime < START + FROM_S * 1e6:
            return event
        return replace(event, header=replace(header, utime=header.utime + step))

    found = told_to_core(ride, [stepped(each) for each in events], clock_step=(FROM_S, hours * 3600.0))
    assert found.lie <= LONGEST_LIE_S
    assert found.between(SECONDS - 1.0)[-1].valid
    assert all(each.off < 2.0 for each in found.between(FROM_S) if each.valid)
