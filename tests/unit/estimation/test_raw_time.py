"""Raw mode and time: out-of-sequence samples, clock steps, gaps; and samples that it ignores."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support_localization import MOUNTS, ORIGIN, START, Drive, Sensors, constant, final, run

from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.messages import (
    Invalid,
    JointSample,
    JointsSample,
    PersistOrigin,
    Quality,
    Rejected,
    SensorHeader,
    WheelSample,
    WheelsSample,
)

DRIVE = Drive(20.0, speed=constant(2.0), yaw_rate=constant(0.1))
SAMPLES = Sensors().events(DRIVE)
WARM = final(RawLocalizer.start(MOUNTS, None, ORIGIN), SAMPLES)


def shift_stamp(sample, seconds):
    header = sample.header
    return replace(sample, header=replace(header, utime=header.utime + round(seconds * 1e6)))


def test_before_any_sample_every_reason_is_set():
    estimate = RawLocalizer.start(MOUNTS).estimate(START)
    assert estimate.invalid == Invalid.NO_FIX | Invalid.NO_IMU | Invalid.NO_ORIGIN | Invalid.NOT_MOVED_YET
    assert (estimate.enu, estimate.utm, estimate.utime) == (None, None, START)
    assert RawLocalizer.start(MOUNTS).utime == 0


def test_the_origin_is_captured_once_and_published():
    events = [(sample, event) for sample, _, new in run(RawLocalizer.start(MOUNTS), SAMPLES) for event in new]
    captured = [event for _, event in events if isinstance(event, PersistOrigin)]
    assert len(captured) == 1
    assert math.dist(captured[0].origin.initial_utm[:2], ORIGIN.initial_utm[:2]) < 5.0


def test_a_configured_origin_is_used():
    localizer = RawLocalizer.start(MOUNTS, None, ORIGIN)
    assert all(not events for _, _, events in run(localizer, SAMPLES))
    assert WARM.origin == ORIGIN
    assert WARM.estimate(WARM.utime).origin == ORIGIN


def test_delayed_and_duplicate_samples_are_rejected_and_change_nothing():
    imu = [s for s in SAMPLES if s.header.source == "imu"]
    after, events = WARM.process(imu[-1])
    assert events == (Rejected("sensor:imu", "duplicate"),)
    after, events = after.process(imu[-3])
    assert events == (Rejected("sensor:imu", "out_of_sequence"),)
    assert after.estimate(WARM.utime).enu == WARM.estimate(WARM.utime).enu


def test_one_stamp_from_the_past_is_not_a_clock_step():
    imu = [s for s in SAMPLES if s.header.source == "imu"]
    after, events = WARM.process(imu[10])
    assert events == (Rejected("sensor:imu", "out_of_sequence"),)
    assert after.pose_epoch == 0


def test_a_clock_set_back_restarts_raw_mode_and_odom_continues():
    localizer, seen = WARM, []
    before = WARM.estimate(WARM.utime)
    first = True
    for sample in SAMPLES:
        localizer, _ = localizer.process(shift_stamp(sample, -100.0))
        estimate = localizer.estimate(localizer.utime)
        if localizer.pose_epoch == 1:
            if first:
                meters, radians = before.odom.distance(estimate.odom)
                assert meters < 0.2
                assert radians < 0.1
                first = False
            seen.append(Invalid.CLOCK_STEPPED in estimate.invalid)
    assert seen[0]
    assert not seen[-1]
    assert estimate.invalid == 0
    assert estimate.pose_epoch == 1
    assert localizer.origin == ORIGIN
    assert localizer.utime < WARM.utime


def test_a_clock_set_ahead_is_a_gap():
    localizer, reasons = WARM, []
    for sample in SAMPLES:
        localizer, events = localizer.process(shift_stamp(sample, 3600.0))
        reasons += [event.reason for event in events if isinstance(event, Rejected)]
    assert "future" in reasons
    assert localizer.estimate(localizer.utime).invalid == 0


def test_a_pose_requested_long_after_the_last_sample_is_stale():
    estimate = WARM.estimate(WARM.utime + 3_600_000_000)
    assert Invalid.STALE_GPS in estimate.invalid
    assert Invalid.STALE_IMU in estimate.invalid
    assert Quality.PREDICTED in estimate.quality
    assert math.dist(estimate.odom.xyz, WARM.estimate(WARM.utime).odom.xyz) < 20.0
    assert math.isnan(estimate.seconds_to_limit)


def test_the_recent_past_is_from_the_history():
    for back in (50_000, 500_000, 1_500_000):
        utime = WARM.utime - back
        estimate = WARM.estimate(utime)
        assert estimate.utime == utime
        assert math.dist(estimate.enu.xyz[:2], DRIVE.at(utime).xyz[:2]) < 2.0


def test_wheels_and_joints_are_ignored():
    for sample in (
        WheelsSample(SensorHeader(START + 10**9), (WheelSample("left", 1.0),)),
        JointsSample(SensorHeader(START + 10**9), (JointSample("pan", 1.0),)),
    ):
        assert WARM.process(sample) == (WARM, ())


def test_a_fix_beyond_the_range_of_the_pinned_zone_is_rejected():
    gps = next(s for s in reversed(SAMPLES) if s.header.source == "gps")
    far = shift_stamp(replace(gps, longitude_deg=10.0), 0.2)
    after, events = WARM.process(far)
    assert events == (Rejected("sensor:gps", "range"),)
    assert after.estimate(WARM.utime).enu == WARM.estimate(WARM.utime).enu


def test_a_fix_without_height_continues_the_height():
    localizer = RawLocalizer.start(MOUNTS, None, ORIGIN)
    for sample in SAMPLES:
        if sample.header.source == "gps" and sample.header.utime > START + 10_000_000:
            sample = replace(sample, height_ellipsoidal=math.nan)
        localizer, _ = localizer.process(sample)
    estimate = localizer.estimate(localizer.utime)
    assert estimate.enu.xyz[2] == pytest.approx(0.0, abs=3.0)
    assert estimate.covariance[14] > WARM.estimate(WARM.utime).covariance[14]


def test_fixes_alone_give_a_position_but_no_valid_pose():
    localizer = final(RawLocalizer.start(MOUNTS), [s for s in SAMPLES if s.header.source == "gps"])
    estimate = localizer.estimate(localizer.utime)
    assert estimate.invalid & Invalid.NO_IMU
    assert math.dist(estimate.enu.xyz[:2], DRIVE.at(localizer.utime).xyz[:2]) < 20.0
