"""Whole drives through raw mode, compared with a truth that is computed independently."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support_localization import (
    GEODESY,
    MOUNTS,
    ORIGIN,
    START,
    Drive,
    Sensors,
    angle_error,
    constant,
    final,
    run,
    stepwise,
)

from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.raw.settings import RawSettings
from modelserver.messages import Invalid, OrientationReference, Quality, Rejected


def start(settings=None, origin=ORIGIN):
    return RawLocalizer.start(MOUNTS, settings, origin)


def figure_eight(seconds=60.0, speed=2.0, radius=8.0):
    lap = 2 * math.pi * radius / speed
    return Drive(
        seconds,
        speed=constant(speed),
        yaw_rate=lambda t: (speed / radius) * math.tanh(8 * math.sin(math.pi * t / lap)),
        roll=lambda t: 0.05 * math.sin(0.7 * t),
        pitch=lambda t: 0.04 * math.sin(0.5 * t),
    )


def errors(drive, samples, settings=None, after=10.0, origin=ORIGIN, ahead=20_000):
    """Return (time, position error, yaw error, tilt error, estimate) of each prediction after `after` seconds."""
    found = []
    for sample, localizer, _ in run(start(settings, origin), samples):
        utime = sample.header.utime + ahead
        if (utime - START) * 1e-6 < after:
            continue
        estimate = localizer.estimate(utime)
        truth = drive.at(utime)
        assert estimate.enu is not None
        error = math.dist(estimate.enu.xyz[:2], truth.xyz[:2])
        roll, pitch, yaw = estimate.enu.rpy
        roll_t, pitch_t, yaw_t = truth.rpy
        found.append(
            (
                (utime - START) * 1e-6,
                error,
                angle_error(yaw, yaw_t),
                math.hypot(roll - roll_t, pitch - pitch_t),
                estimate,
            )
        )
    return found


def rms(values):
    return math.sqrt(sum(v * v for v in values) / len(values))


@pytest.mark.slow
@pytest.mark.parametrize("velocity_sigma", [0.1, None])
@pytest.mark.parametrize("reference", list(OrientationReference))
def test_figure_eight_is_followed_within_the_noise(velocity_sigma, reference):
    drive = figure_eight()
    sensors = Sensors(velocity_sigma=velocity_sigma, orientation=reference, gps_sigma=0.5)
    found = errors(drive, sensors.events(drive), after=20.0)

    assert all(estimate.invalid == 0 for *_, estimate in found)
    assert rms([each[1] for each in found]) < 1.1  # white noise of 0.5 m an axis is 0.71 m
    assert rms([each[2] for each in found]) < (0.05 if velocity_sigma else 0.12)
    assert rms([each[3] for each in found]) < (1e-3 if reference else 0.03)
    assert sum(each[1] > each[4].horizontal_protection_level for each in found) <= 0.005 * len(found)
    assert sum(each[2] > each[4].heading_protection_level for each in found) <= 0.005 * len(found)


@pytest.mark.slow
def test_position_is_exact_with_exact_sensors_and_lever_arms():
    drive = figure_eight()
    sensors = Sensors(
        gps_sigma=0.02,
        gps_noise=0.0,
        velocity_sigma=0.005,
        gyro_noise=0.0,
        gyro_bias=(0, 0, 0),
        force_noise=0.0,
        orientation=OrientationReference.ENU,
    )
    found = errors(drive, sensors.events(drive), after=10.0)

    assert max(each[1] for each in found) < 0.05
    assert max(each[2] for each in found) < 0.02


def test_pose_is_invalid_until_the_vehicle_moves_and_valid_after():
    drive = Drive(30.0, speed=stepwise((10.0, 1.5)))
    first_valid = None
    for sample, localizer, _ in run(start(), Sensors().events(drive)):
        t = (sample.header.utime - START) * 1e-6
        invalid = localizer.estimate(sample.header.utime).invalid
        if 1.0 < t < 10.0:
            assert invalid == Invalid.NOT_MOVED_YET
        if first_valid is None and invalid == 0:
            first_valid = t
    assert first_valid is not None
    assert 10.0 < first_valid < 12.0


@pytest.mark.slow
@pytest.mark.parametrize("velocity_sigma", [0.1, None])
def test_ten_minutes_stationary_hold_the_heading_and_measure_the_bias(velocity_sigma):
    drive = Drive(680.0, speed=stepwise((0.0, 1.5), (60.0, 0.0)), yaw_rate=stepwise((10.0, 0.1), (50.0, 0.0)))
    sensors = Sensors(imu_hz=12.5, gps_hz=2.0, velocity_sigma=velocity_sigma, gyro_bias=(0.01, -0.01, 0.012))
    localizer = final(start(), sensors.events(drive))
    utime = START + 679_980_000
    estimate = localizer.estimate(utime)

    assert localizer.is_stationary(utime)
    assert localizer.heading.bias == pytest.approx(0.012, abs=5e-4)
    assert localizer.tilt_bias == pytest.approx((0.01, -0.01), abs=2e-3)
    assert estimate.invalid == 0
    assert Quality.HEADING_FROM_GYRO in estimate.quality
    assert estimate.enu is not None
    error = angle_error(estimate.enu.rpy[2], drive.at(utime).rpy[2])
    assert error < min(math.radians(10.0), estimate.heading_protection_level)  # the report: 1 to 2 deg/min
    assert localizer.motion.speed == 0.0


@pytest.mark.slow
def test_heading_of_a_vehicle_stationary_for_too_long_is_invalid():
    settings = RawSettings(gyro_noise=0.02)
    drive = Drive(200.0, speed=stepwise((0.0, 1.5), (30.0, 0.0)))
    seen = {
        localizer.estimate(sample.header.utime).invalid
        for sample, localizer, _ in run(start(settings), Sensors(imu_hz=25.0, gyro_noise=0.004).events(drive))
        if sample.header.utime > START + 150_000_000
    }
    assert Invalid.STATIONARY_HEADING in seen


@pytest.mark.slow
@pytest.mark.parametrize("velocity_sigma", [0.1, None])
def test_reverse_does_not_reset_the_heading(velocity_sigma):
    drive = Drive(
        60.0,
        speed=stepwise((0.0, 1.5), (20.0, 0.0), (24.0, -1.5), (44.0, 0.0), (46.0, 1.5)),
        yaw_rate=stepwise((28.0, 0.1), (40.0, 0.0)),
    )
    found = errors(drive, Sensors(velocity_sigma=velocity_sigma, gps_sigma=0.3, imu_hz=50.0).events(drive), after=15.0)

    assert max(each[2] for each in found) < 0.35
    assert {each[4].pose_epoch for each in found} == {0}
    backwards = [each for each in found if 30.0 < each[0] < 43.0]
    are_reversing = [Quality.REVERSING in each[4].quality for each in backwards]
    assert sum(are_reversing) > (0.99 if velocity_sigma else 0.9) * len(are_reversing)
    assert not any(Quality.REVERSING in each[4].quality for each in found if not 24.0 < each[0] < 50.0)
    assert rms([each[1] for each in backwards]) < 0.8


def test_gps_outage_is_bridged_by_gyro_and_speed_and_reported():
    drive = figure_eight()
    samples = [
        s
        for s in Sensors(gps_sigma=0.1).events(drive)
        if s.header.source == "imu" or not 30.0 < (s.header.utime - START) * 1e-6 < 34.0
    ]
    found = errors(drive, samples, after=20.0)

    stale = [each for each in found if 32.3 < each[0] < 34.0]
    assert stale
    assert all(each[4].invalid == Invalid.STALE_GPS for each in stale)
    assert max(each[1] for each in stale) < 2.0
    assert all(each[1] < each[4].horizontal_protection_level for each in found)
    levels = [each[4].horizontal_protection_level for each in stale]
    assert levels == sorted(levels)
    assert all(each[4].invalid == 0 for each in found if each[0] > 34.5)


def shift_north(sample, meters):
    return replace(sample, latitude_deg=sample.latitude_deg + meters / 111_200.0)


def test_an_imu_outage_is_reported_and_ends():
    drive = figure_eight(60.0)
    samples = [
        s
        for s in Sensors().events(drive)
        if s.header.source == "gps" or not 30.0 < (s.header.utime - START) * 1e-6 < 33.0
    ]
    events = []
    for sample, localizer, new in run(start(), samples):
        events += new
        t = (sample.header.utime - START) * 1e-6
        if 30.6 < t < 32.9:
            assert Invalid.STALE_IMU in localizer.estimate(sample.header.utime).invalid
    assert Rejected("sensor:imu", "gap") in events
    estimate = localizer.estimate(sample.header.utime)
    assert estimate.invalid == 0
    assert angle_error(estimate.enu.rpy[2], drive.at(sample.header.utime).rpy[2]) < 0.1


def test_odom_is_continuous_over_fixes_jumps_and_the_origin():
    drive = Drive(50.0, speed=constant(2.0), yaw_rate=constant(0.15))
    samples = [
        shift_north(s, 60.0) if s.header.source == "gps" and s.header.utime > START + 25_000_000 else s
        for s in Sensors(gps_sigma=0.5).events(drive)
    ]
    last = None
    for sample, localizer, _ in run(start(origin=None), samples):
        odom = localizer.estimate(sample.header.utime).odom
        if last is not None:
            moved, turned = last[1].distance(odom)
            dt = (sample.header.utime - last[0]) * 1e-6
            assert moved <= 4.0 * dt + 0.02
            assert turned <= 0.6 * dt + 0.02
        last = (sample.header.utime, odom)
    assert localizer.origin is not None


def test_a_delayed_fix_is_used_at_its_own_instant():
    drive = figure_eight(40.0)
    sensors = Sensors(gps_sigma=0.05, orientation=OrientationReference.ENU)
    samples = sorted(
        sensors.events(drive),
        key=lambda s: s.header.utime + (400_000 if s.header.source == "gps" else 0),
    )
    found = errors(drive, samples, after=15.0, ahead=0)
    newest = [each for each in found if each[4].quality & Quality.PREDICTED == 0]
    assert rms([each[1] for each in newest]) < 0.25


def test_utm_and_enu_agree_at_the_vehicle():
    drive = figure_eight(20.0)
    localizer = final(start(), Sensors(gps_sigma=0.1).events(drive))
    estimate = localizer.estimate(localizer.utime)
    assert estimate.enu is not None
    assert estimate.utm is not None
    expected = GEODESY.pose_in_utm(estimate.enu)
    assert expected.is_close(estimate.utm, meters=1e-6, radians=2e-5)


def test_the_same_samples_give_the_same_bits():
    drive = figure_eight(20.0)
    samples = Sensors().events(drive)
    assert final(start(origin=None), samples) == final(start(origin=None), samples)
