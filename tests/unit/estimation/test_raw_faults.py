"""Raw mode under faults: while a pose is valid, its protection levels hold."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support_localization import MOUNTS, ORIGIN, START, Drive, Sensors, angle_error, constant, final, stepwise

from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.messages import GpsSample, ImuSample, Invalid, OrientationReference, Rejected, SensorHeader
from modelserver.transforms.pose import Pose


def seconds(sample):
    return (sample.header.utime - START) * 1e-6


def delay_stamp(sample, by):
    return replace(sample, header=replace(sample.header, utime=sample.header.utime + round(by * 1e6)))


def is_gps(sample):
    return isinstance(sample, GpsSample)


def follow(drive, arrivals, offset=lambda t: 0.0, origin=ORIGIN):
    """Process samples by (arrival, sample); return (t, estimate, position ratio, yaw ratio) at each arrival.

    `offset` is by how much the clock of the sensors is ahead of the truth's. A ratio is of an error to its
    protection level.
    """
    localizer, rows, reasons = RawLocalizer.start(MOUNTS, None, origin), [], []
    for t, sample in arrivals:
        localizer, events = localizer.process(sample)
        reasons += [(sample.header.source, event.reason) for event in events if isinstance(event, Rejected)]
        estimate = localizer.estimate(START + round((t + offset(t)) * 1e6))
        if estimate.enu is None:
            continue
        truth = drive.pose(t)
        rows.append(
            (
                t,
                estimate,
                math.dist(estimate.enu.xyz[:2], truth.xyz[:2]) / estimate.horizontal_protection_level,
                angle_error(estimate.enu.rpy[2], truth.rpy[2]) / estimate.heading_protection_level,
            )
        )
    return rows, reasons, localizer


def worst(rows, which, after=0.0):
    return max((row[which] for row in rows if row[1].invalid == 0 and row[0] > after), default=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("step", [-0.6, -0.95, -3.0])
def test_a_clock_step_of_any_size_in_a_turn_loses_no_heading(step):
    drive = Drive(50.0, speed=stepwise((3.0, 2.0)), yaw_rate=stepwise((15.0, 0.6)))

    def offset(t):
        return step if t > 25.0 else 0.0

    arrivals = [(seconds(s), delay_stamp(s, offset(seconds(s)))) for s in Sensors().events(drive)]
    rows, _, localizer = follow(drive, arrivals, offset)
    # the two samples until the step is confirmed are within one fix
    assert worst(rows, 3, after=25.05) < 1.1
    assert worst(rows, 2, after=25.05) < 1.3
    assert localizer.pose_epoch >= 1
    assert rows[-1][1].invalid == 0


def test_delayed_samples_are_not_a_clock_step():
    drive = Drive(30.0, speed=stepwise((3.0, 2.0)), yaw_rate=lambda t: 0.3 * math.sin(t / 3))
    arrivals = sorted(
        ((seconds(s) + (0.05 * (i * 7 % 10) / 10), s) for i, s in enumerate(Sensors(imu_hz=50.0).events(drive))),
        key=lambda each: each[0],
    )
    rows, reasons, localizer = follow(drive, arrivals)
    assert ("imu", "out_of_sequence") in reasons
    assert localizer.pose_epoch == 0
    assert worst(rows, 3, after=10.0) < 1.3


def test_a_pose_requested_by_a_clock_that_is_behind_is_invalid():
    drive = Drive(20.0, speed=constant(2.0))
    localizer = final(RawLocalizer.start(MOUNTS, None, ORIGIN), Sensors().events(drive))
    assert localizer.estimate(localizer.utime).invalid == 0
    assert localizer.estimate(localizer.utime - 100_000).invalid == 0
    for back in (1.0, 3.0, 100.0):
        assert Invalid.CLOCK_STEPPED in localizer.estimate(localizer.utime - round(back * 1e6)).invalid


def test_height_above_mean_sea_level_alone_is_used_with_its_uncertainty():
    drive = Drive(15.0, speed=constant(2.0))
    samples = [
        replace(s, height_msl=s.height_ellipsoidal + 20.0, height_ellipsoidal=math.nan) if is_gps(s) else s
        for s in Sensors().events(drive)
    ]
    localizer = final(RawLocalizer.start(MOUNTS), samples)
    assert localizer.origin.height == pytest.approx(720.0, abs=10.0)
    assert localizer.estimate(localizer.utime).covariance[14] == pytest.approx(100.0**2, rel=0.01)


def test_unknown_height_has_a_large_sigma():
    drive = Drive(15.0, speed=constant(2.0))
    samples = [replace(s, height_ellipsoidal=math.nan) if is_gps(s) else s for s in Sensors().events(drive)]
    localizer = final(RawLocalizer.start(MOUNTS), samples)
    assert math.sqrt(localizer.estimate(localizer.utime).covariance[14]) > 4000.0


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.3, 0.45])
def test_imu_samples_that_lag_behind_the_fixes_turn_the_heading(lag):
    drive = Drive(40.0, speed=stepwise((3.0, 2.0)), yaw_rate=lambda t: 0.4 * math.sin(t / 2))
    arrivals = [(seconds(s) + (0.0 if is_gps(s) else lag), s) for s in Sensors(gps_hz=2.0).events(drive)]
    arrivals = sorted((each for each in arrivals if each[0] < 40.0), key=lambda each: each[0])
    rows, _, _ = follow(drive, arrivals)
    settled = [row for row in rows if row[0] > 10.0]
    assert sum(row[1].invalid == 0 for row in settled) > 0.95 * len(settled)
    assert worst(rows, 3) < 1.1
    assert worst(rows, 2) < 1.1


@pytest.mark.parametrize(("roll", "tilted"), [(0.0, False), (0.6, False), (1.5, True), (math.pi, True)])
def test_a_vehicle_on_its_side_is_invalid(roll, tilted):
    # a level vehicle whose geometry has the IMU rotated about the forward axis by `roll`
    level = RawLocalizer.start(replace(MOUNTS, X_base_imu=Pose.from_rpy((0.0, 0.0, 0.0), roll)), None, ORIGIN)
    for n in range(200):
        header = SensorHeader(START + n * 10_000, "imu")
        level, _ = level.process(ImuSample(header, (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665)))
    assert (Invalid.TILTED in level.estimate(level.utime).invalid) == tilted


def test_an_orientation_with_the_wrong_reference_is_tilted():
    # the right orientation of a level vehicle in ENU, stated as one in NED: upside down
    q = MOUNTS.X_base_imu.wxyz
    for reference in (OrientationReference.ENU, OrientationReference.NED):
        localizer = RawLocalizer.start(MOUNTS, None, ORIGIN)
        for n in range(10):
            header = SensorHeader(START + n * 10_000, "imu")
            sample = ImuSample(header, (0.0, 0.0, 0.0), orientation=q, orientation_reference=reference)
            localizer, _ = localizer.process(sample)
        tilted = Invalid.TILTED in localizer.estimate(localizer.utime).invalid
        assert tilted == (reference is OrientationReference.NED)
