"""The filter and sensors that fail: non-finite numbers, clocks that step, wheels that slip, magnetic disturbances."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import support_stream_faults as faults
from support_filter import IMU, ORIGIN, RIG, WHEELS_TIMING, Run, drive, rig, simulation

from benchmarks.rough_simulation import EncoderModel
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Setup
from modelserver.estimation.sensor_rig import magnetic_field
from modelserver.messages import ImuSample, Invalid, Phase, Verdict, WheelsSample, YawSource
from modelserver.simulation import (
    START_UTIME,
    DrivePhase,
    Event,
    MagnetometerModel,
    WheelsModel,
    figure_eight,
    stationary,
)
from modelserver.transforms.pose import Pose

pytestmark = pytest.mark.slow

EIGHT = figure_eight(speed=2.5, radius=8.0, stationary=4.0, laps=2)
FIELD = magnetic_field(50.27, -111.18, 700.0, START_UTIME)
ODD = (math.nan, math.inf, -math.inf)


def _check_all(found: Run, begin: float, most: float = 1.2) -> None:
    rows = found.between(begin)
    assert all(row.valid for row in rows)
    assert max(row.off for row in rows) < most
    assert max(abs(row.heading) for row in rows) < math.radians(6.0)
    assert all(row.off < row.estimate.horizontal_protection_level for row in rows)


def _check_finite(found: Run) -> None:
    for row in found.rows:
        numbers = (*row.estimate.odom.xyz, *row.estimate.odom.wxyz)
        if row.estimate.enu is not None:
            numbers += (*row.estimate.enu.xyz, *row.estimate.enu.wxyz, *row.estimate.covariance)
        assert all(map(math.isfinite, numbers))


def _replace_number(sample: Event, field: str, value: float) -> Event:
    """Return the sample with a number, the second number of a vector, or a wheel's number replaced."""
    if isinstance(sample, WheelsSample):
        first, *others = sample.wheels
        return replace(sample, wheels=(replace(first, **{field: value}), *others))
    before = getattr(sample, field)
    if isinstance(before, tuple):
        # the fifth number of nine is a variance too
        at = 4 if len(before) == 9 else 1
        return replace(sample, **{field: (*before[:at], value, *before[at + 1 :])})
    return replace(sample, **{field: value})


FIELDS = {
    "gps": (
        *("latitude_deg", "longitude_deg", "height_ellipsoidal", "height_msl", "undulation", "hdop", "vdop"),
        *("position_covariance", "velocity", "velocity_covariance", "velocity_latency"),
        *("speed", "speed_sigma", "course", "course_sigma", "baseline_yaw", "baseline_yaw_sigma"),
    ),
    "imu": ("angular_velocity", "specific_force", "orientation", "magnetic_field", "angular_velocity_covariance"),
    "wheels": ("travel", "travel_sigma", "speed", "speed_sigma", "steering"),
}
SPREADS = ("position_covariance", "velocity_covariance", "speed_sigma", "course_sigma", "baseline_yaw_sigma")
SPREADS += ("travel_sigma", "angular_velocity_covariance")


def _corrupt(events, source: str) -> Iterator[Event]:
    """Yield samples; those of a source after the 20th second have an odd number in one field after the other."""
    odd = [(field, value) for field in FIELDS[source] for value in ODD]
    odd += [(field, value) for field in FIELDS[source] if field in SPREADS for value in (0.0, -1.0)]
    every = 1 if source == "gps" else 3
    count = 0
    for event in events:
        if event.header.source == source and event.header.utime > START_UTIME + 20_000_000:
            count += 1
            if count % every == 0:
                yield _replace_number(event, *odd[(count // every) % len(odd)])
                continue
        yield event


@pytest.mark.parametrize("source", list(FIELDS))
def test_given_non_finite_numbers_in_every_field_then_the_pose_stays_right(source):
    run = simulation(
        EIGHT, second_gps_frame="Car:Second", imu_model=replace(IMU, magnetometer=MagnetometerModel(FIELD))
    )

    found = drive(run, 45.0, transform=lambda events: _corrupt(events, source))

    _check_finite(found)
    _check_all(found, 20.0)


def test_given_messages_twice_then_each_is_used_once():
    once = drive(simulation(EIGHT), 35.0)
    twice = drive(simulation(EIGHT), 35.0, transform=lambda events: faults.duplicate(events, 3, 0.3, max_delay=0.05))

    assert twice.last.estimate.enu == once.last.estimate.enu
    assert twice.last.estimate.covariance == once.last.estimate.covariance
    assert {word.reason for word in twice.ledger if word.verdict is Verdict.REJECTED} <= {"duplicate"}


def test_given_the_clock_of_the_receiver_set_back_then_only_its_fixes_are_rejected():
    back_at = START_UTIME + 30_000_000

    found = drive(simulation(EIGHT), 50.0, transform=lambda events: faults.step_clock_back(events, back_at, 5.0, "gps"))

    rejected = [word for word in found.decisions("gps_position", Verdict.REJECTED) if word.utime >= back_at - 5_000_000]
    assert {word.reason for word in rejected} <= {"out_of_sequence", "too_old"}
    assert rejected
    assert len({row.estimate.pose_epoch for row in found.between(20.0)}) == 1
    _check_all(found, 20.0)


@pytest.mark.parametrize("seconds", [100.0, -3600.0], ids=["back", "ahead"])
def test_given_the_clock_of_the_computer_set_then_the_pose_is_valid_again_and_odom_continues(seconds):
    at = START_UTIME + 30_000_000
    run = simulation(EIGHT)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN)
    poses, later, epochs = [], [], []
    true = list(run.events(75.0))
    for original, event in zip(true, faults.step_clock_back(true, at, seconds), strict=True):
        localizer, _ = localizer.process(event)
        estimate = localizer.estimate(localizer.utime)
        poses.append((estimate.utime, estimate.odom.xyz))
        if original.header.utime < at - 100_000:
            epochs.append(estimate.pose_epoch)
        if original.header.utime > at + 30_000_000:
            later.append((estimate, run.truth(estimate.utime + round(seconds * 1e6)).enu))

    for (before, a), (after, b) in pairwise(poses):
        # over an unobserved time Odom continues as before for half a second at most
        assert math.dist(a, b) < 0.05 + 2.6 * min(max((after - before) * 1e-6, 0.02), 0.5)
    assert all(estimate.enu is not None and not estimate.invalid for estimate, _ in later)
    assert max(math.dist(estimate.enu.xyz[:2], true.xyz[:2]) for estimate, true in later) < 1.5
    if seconds > 0.0:
        assert later[-1][0].pose_epoch > epochs[-1]


def test_given_one_stamp_far_ahead_then_that_sample_alone_is_rejected():
    def set_ahead(events):
        for event in events:
            odd = event.header.source == "gps" and event.header.seq == 100
            yield replace(event, header=replace(event.header, utime=event.header.utime + 10**10)) if odd else event

    found = drive(simulation(EIGHT), 40.0, transform=set_ahead)

    assert [word.seq for word in found.ledger if word.reason == "future"][:1] == [100]
    assert len([word for word in found.decisions("gps_position") if word.reason == "future"]) == 1
    _check_all(found, 20.0)


def test_given_an_imu_that_freezes_then_it_is_rejected_and_the_pose_is_not_valid():
    found = drive(simulation(EIGHT, imu_model=replace(IMU, frozen_from=25.0)), 40.0)

    assert found.decisions("inertial", Verdict.REJECTED, "frozen")
    assert all(Invalid.STALE_IMU in row.estimate.invalid for row in found.between(27.0))
    assert found.at(24.0).valid


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_given_an_axis_of_the_gyro_that_is_dead_then_the_imu_is_rejected_and_the_wheels_turn_the_heading(axis):
    def stop(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and 25.0 <= (event.header.utime - START_UTIME) * 1e-6 < 45.0:
                rate = [*event.angular_velocity]
                rate[axis] = 0.0
                event = replace(event, angular_velocity=tuple(rate))
            yield event

    found = drive(simulation(EIGHT), 50.0, transform=stop)

    words = found.decisions("inertial", Verdict.REJECTED, "axis")
    assert found.seconds(words[0]) < 25.5
    assert all(abs(row.heading) < row.estimate.heading_level for row in found.between(20.0))
    assert all(row.off < 1.5 for row in found.between(20.0))
    assert all(row.valid for row in found.between(46.0))


def test_given_a_gyro_of_coarse_steps_then_no_axis_is_dead():
    def round_rates(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample):
                rate = tuple(0.02 * round(each / 0.02) for each in event.angular_velocity)
                event = replace(event, angular_velocity=rate)
            yield event

    found = drive(simulation(EIGHT), 50.0, transform=round_rates)

    assert not found.decisions("inertial", Verdict.REJECTED)
    assert all(row.valid for row in found.between(20.0))


def test_given_an_imu_that_fails_at_rest_when_the_vehicle_sets_off_then_the_pose_follows_the_wheels():
    phases = (*EIGHT, DrivePhase(8.0, 0.0), DrivePhase(3.0, 2.5), DrivePhase(30.0, 2.5), DrivePhase(3.0, 0.0))
    at = sum(each.duration for each in EIGHT) + 4.0

    found = drive(simulation(phases, imu_model=replace(IMU, outages=((at, at + 60.0),))), at + 30.0)

    assert found.last.speed > 2.0
    assert all(row.off < 1.5 for row in found.between(at))


def test_given_gaps_of_the_imu_then_they_are_bridged_and_the_protection_level_covers_the_error():
    model = replace(IMU, outages=((25.0, 25.4), (30.0, 32.0)))

    found = drive(simulation(EIGHT, imu_model=model), 45.0)

    assert len(found.decisions("inertial", Verdict.MONITORED, "gap")) == 2
    assert Invalid.STALE_IMU in found.at(31.2).estimate.invalid
    assert found.last.valid
    assert found.last.off < 1.2
    assert all(row.off < row.estimate.horizontal_protection_level for row in found.between(20.0) if row.valid)


@pytest.mark.parametrize(
    "encoder",
    [
        EncoderModel(stuck=(("left", 25.0),)),
        EncoderModel(stuck=(("left", 25.0), ("right", 25.0))),
        EncoderModel(swapped=frozenset({"left"})),
        EncoderModel(burst_rate=0.1, burst_excess=0.5),
    ],
    ids=["one_stuck", "all_stuck", "one_swapped", "bursts"],
)
def test_given_wheels_that_fail_with_fixes_then_the_pose_stays_right(encoder):
    found = drive(simulation(EIGHT, wheels_model=WheelsModel(WHEELS_TIMING, encoder=encoder)), 50.0)

    rows = found.between(22.0)
    assert all(row.off < min(1.5, row.estimate.horizontal_level) for row in rows)
    assert all(abs(row.heading) < math.radians(6.0) for row in rows)
    # wheels that contradict fixes and gyro are a path of unknown length
    assert sum(row.valid for row in rows) > 0.75 * len(rows)


def test_given_gravity_along_another_axis_than_by_the_mount_then_the_pose_is_never_valid_and_the_reason_is_reported():
    wrong = rig(imu=Pose.from_rpy((0.3, -0.3, 0.5), 0.0, 0.0, 0.0))

    found = drive(simulation(EIGHT), 40.0, on=wrong)

    assert all(Invalid.TILTED in row.estimate.invalid for row in found.between(8.0))
    assert found.decisions("inertial", Verdict.REJECTED, "mount")
    assert found.localizer.head.phase is Phase.LEVELING


PULLED = ((30.0, 40.0, (3e-5, 0.0, 5e-5)),)


def test_given_iron_beside_the_path_when_magnetic_headings_are_used_then_the_field_is_rejected():
    model = replace(IMU, magnetometer=MagnetometerModel(FIELD, noise=2e-7, disturbances=PULLED))

    found = drive(simulation(EIGHT, imu_model=model), 45.0, settings=FilterSettings(use_magnetometer=True))

    rejected = [found.seconds(word) for word in found.decisions("magnetometer", Verdict.REJECTED)]
    assert len([t for t in rejected if 30.0 <= t < 40.0]) >= 15
    assert found.decisions("magnetometer", Verdict.USED)
    _check_all(found, 20.0)


def test_given_a_field_that_is_always_wrong_in_vertical_gyro_mode_then_it_is_monitored_and_changes_nothing():
    turned = (FIELD[1], -FIELD[0], FIELD[2])
    without = drive(simulation(EIGHT), 35.0)
    beside = drive(simulation(EIGHT, imu_model=replace(IMU, magnetometer=MagnetometerModel(turned))), 35.0)

    monitored = beside.decisions("magnetometer", Verdict.MONITORED, "vertical_gyro")
    assert monitored
    assert not beside.decisions("magnetometer", Verdict.USED)
    assert abs(np.mean([word.residual[0] for word in monitored if beside.seconds(word) > 20.0])) > 0.5
    # its samples propagate the state to the same instants by other steps: rounding remains
    assert math.dist(beside.last.estimate.enu.xyz, without.last.estimate.enu.xyz) < 1e-2


def test_given_a_stationary_imu_with_a_magnetic_yaw_in_magnetometer_mode_then_the_heading_is_known():
    model = replace(IMU, yaw_source=YawSource.MAGNETIC, yaw_noise=0.01, magnetometer=MagnetometerModel(FIELD))

    found = drive(simulation(stationary(30.0), imu_model=model), 30.0, settings=FilterSettings(use_magnetometer=True))

    assert all(row.valid for row in found.between(15.0))
    assert max(abs(row.heading) for row in found.between(15.0)) < math.radians(3.0)
