"""The filter on ordinary drives: stationary for long, in reverse, on slopes, with the body turned."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from support_filter import IMU, MOUNT, PLAIN_GPS, drive, rig, simulation
from support_maneuvers import reverse_eight

from benchmarks.rough_simulation import SideSlip, Terrain, make_noise_free_gps, make_noise_free_wheels
from modelserver.messages import ImuSample, Invalid, Quality, Verdict
from modelserver.simulation import START_UTIME, Event, GpsModel, Timing, WheelsModel, figure_eight, stationary
from modelserver.transforms import so3

pytestmark = pytest.mark.slow

SLOW_IMU = replace(IMU, timing=Timing(12.5))
SLOW_WHEELS = WheelsModel(Timing(2.5))
DRIFTING = GpsModel(Timing(1.0), correlated_sigma=1.0, white_sigma=0.15, time_constant=60.0)
TEN_MINUTES = 600.0


def test_given_drifting_fixes_when_stationary_for_ten_minutes_after_a_drive_then_the_pose_stays():
    eight = figure_eight(speed=2.5, radius=8.0, stationary=4.0, ramp=3.0)
    driven = sum(phase.duration for phase in eight)
    run = simulation(
        (*eight, *stationary(TEN_MINUTES)), gps_model=DRIFTING, imu_model=SLOW_IMU, wheels_model=SLOW_WHEELS, seed=4
    )

    found = drive(run, driven + TEN_MINUTES, every=2.0)

    rest = found.between(driven + 1.0)
    places = np.array([row.estimate.enu.xyz[:2] for row in rest])
    headings = np.array([row.heading for row in rest])
    assert np.ptp(places, axis=0).max() < 0.3
    assert np.ptp(headings) < math.radians(1.0)
    assert all(row.valid for row in rest)
    assert all(row.off < row.estimate.horizontal_protection_level for row in rest)
    assert math.dist(rest[0].estimate.odom.xyz, rest[-1].estimate.odom.xyz) < 0.01


@pytest.mark.parametrize("step", [0.004, -0.02, 0.04])
def test_given_a_gyro_whose_bias_changes_at_rest_then_it_is_measured_again_and_the_next_drive_is_good(step):
    eight = figure_eight(speed=2.5, radius=8.0, stationary=4.0, ramp=3.0)
    driven = sum(phase.duration for phase in eight)
    changed = START_UTIME + round(1e6 * (driven + 5.0))

    def add_bias(events: Iterable[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, ImuSample) and event.header.utime >= changed:
                turn = so3.rotate(so3.conjugate(MOUNT.wxyz), (0.0, 0.0, step))
                event = replace(event, angular_velocity=so3.add(event.angular_velocity, turn))
            yield event

    run = simulation((*eight, *stationary(30.0), *eight))
    found = drive(run, 2.0 * driven + 30.0, transform=add_bias)

    # the sensor's own bias is 0.002
    assert found.localizer.head.nav.gyro_bias[2] == pytest.approx(step, abs=0.004)
    if abs(step) > 0.01:
        resets = found.decisions("zero_rate", Verdict.RESET)
        assert 1 <= len(resets) <= 2
        assert all("bias of a gyro has changed" in each.reason for each in resets)
        assert found.seconds(resets[-1]) < driven + 10.0
    after = found.between(driven + 5.0)
    assert all(row.off < row.estimate.horizontal_protection_level for row in after)
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in after)
    assert max(abs(row.heading) for row in found.between(driven + 50.0)) < math.radians(5.0)


def test_given_two_antennas_when_stationary_for_five_minutes_from_the_start_then_pose_and_heading_are_known_and_stay():
    run = simulation(
        stationary(0.5 * TEN_MINUTES),
        gps_model=DRIFTING,
        imu_model=SLOW_IMU,
        wheels_model=SLOW_WHEELS,
        second_gps_frame="Car:Second",
    )

    found = drive(run, 0.5 * TEN_MINUTES, every=2.0)

    rest = found.between(10.0)
    places = np.array([row.estimate.enu.xyz[:2] for row in rest])
    assert all(row.valid for row in rest)
    assert max(abs(row.heading) for row in rest) < math.radians(1.0)
    assert np.ptp(places, axis=0).max() < 0.3


def test_given_one_antenna_when_stationary_from_the_start_then_the_pose_is_not_valid_without_a_heading():
    found = drive(simulation(stationary(30.0)), 30.0)

    assert all(Invalid.NOT_MOVED_YET in row.estimate.invalid for row in found.rows)
    assert not found.decisions("gps_position", Verdict.RESET)


REVERSE = reverse_eight(speed=2.0, radius=6.0, stationary=4.0)


@pytest.mark.parametrize("turned", [0.0, math.pi], ids=["body_ahead", "body_turned"])
def test_given_a_drive_in_reverse_from_the_start_when_an_eight_is_driven_then_heading_is_not_half_a_turn_off(turned):
    on = rig(turned)
    seconds = sum(phase.duration for phase in REVERSE)

    found = drive(simulation(REVERSE, on), seconds, on=on)

    known = found.between(20.0)
    assert all(row.valid for row in known)
    assert max(abs(row.heading) for row in known) < math.radians(5.0)
    assert max(row.off for row in known) < 1.5
    assert all(row.off < row.estimate.horizontal_protection_level for row in known)
    assert any(Quality.REVERSING in row.estimate.quality for row in known)


def test_given_the_body_turned_by_half_a_turn_on_the_same_drive_then_the_poses_are_the_same():
    phases = figure_eight(speed=2.0, radius=6.0)
    seconds = sum(phase.duration for phase in phases)
    exact = {"gps_model": make_noise_free_gps(), "wheels_model": make_noise_free_wheels(Timing(10.0))}

    ahead = drive(simulation(phases, **exact), seconds)
    turned = drive(simulation(phases, rig(math.pi), **exact), seconds, on=rig(math.pi))

    for a, b in zip(ahead.between(20.0), turned.between(20.0), strict=True):
        assert math.dist(a.estimate.enu.xyz[:2], b.estimate.enu.xyz[:2]) < 0.1
        assert abs(math.remainder(a.heading - b.heading, math.tau)) < math.radians(1.0)


def test_given_hills_and_a_vehicle_that_slides_when_driven_then_pose_tilt_and_height_are_right():
    phases = figure_eight(speed=3.0, radius=8.0, laps=2)
    run = simulation(
        phases, terrain=Terrain.hills(3, steepness=0.1), side_slip=SideSlip(cornering=0.006, random_sigma=0.02)
    )

    found = drive(run, 90.0)

    for row in found.between(25.0):
        true = run.truth(row.estimate.utime).enu
        up = [pose.rpy[:2] for pose in (row.estimate.enu, true)]
        assert row.valid
        assert row.off < 1.5
        assert abs(row.heading) < math.radians(4.0)
        assert math.dist(*up) < math.radians(2.0)
        assert abs(row.estimate.enu.xyz[2] - true.xyz[2]) < 2.5


def test_given_a_course_and_a_speed_only_when_driven_then_heading_is_found():
    phases = figure_eight(speed=2.5, radius=8.0)
    run = simulation(phases, gps_model=PLAIN_GPS)

    found = drive(run, 45.0, transform=lambda events: (_drop_velocity(event) for event in events))

    assert all(row.valid for row in found.between(20.0))
    assert max(abs(row.heading) for row in found.between(20.0)) < math.radians(4.0)
    assert all(len(word.residual) == 2 for word in found.decisions("gps_velocity", Verdict.USED))
    assert found.decisions("gps_velocity", Verdict.USED)


def _drop_velocity(event):
    return replace(event, velocity=None, velocity_covariance=None) if event.header.source == "gps" else event
