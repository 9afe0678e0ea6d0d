"""Raw mode on the Husky recording: the pose becomes valid and follows the fixes, those withheld from it as well."""

from __future__ import annotations

import math
from functools import cache, partial

import numpy as np
import pytest

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import FixType, GpsSample, ImuSample, OrientationReference, Quality, SensorHeader
from modelserver.transforms import Pose

pytestmark = pytest.mark.realdata

# The mount stated with the recording (gravity reads on the unit's +y); the antenna's is a sister robot's.
MOUNTS = Mounts(Pose.from_rpy((0.0, -0.3, 0.52), math.pi / 2, 0.0, -math.pi / 2), Pose((0.2475, 0.0, 0.2231)))


@pytest.fixture(scope="module")
def recording(data_dir):
    """Samples in order of arrival, with the index of the fix among the fixes, -1 for the others."""
    rosbags = pytest.importorskip("rosbags.highlevel")
    events, fixes = [], 0
    with rosbags.AnyReader([data_dir / "husky" / "test1.bag"]) as bag:
        for connection, arrival, raw in bag.messages():
            if connection.topic not in ("/fix", "/imu/data"):
                continue
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            utime = stamp.sec * 1_000_000 + stamp.nanosec // 1000
            if connection.topic == "/fix":
                sample = GpsSample(
                    SensorHeader(utime, "gps", fixes),
                    FixType.DIFFERENTIAL,
                    message.latitude,
                    message.longitude,
                    height_ellipsoidal=message.altitude,
                    position_covariance=tuple(message.position_covariance.tolist()),
                )
                events.append((arrival, sample, fixes))
                fixes += 1
            else:
                w, f, q = message.angular_velocity, message.linear_acceleration, message.orientation
                sample = ImuSample(
                    SensorHeader(utime, "imu"),
                    (w.x, w.y, w.z),
                    (f.x, f.y, f.z),
                    orientation=(q.w, q.x, q.y, q.z),
                    orientation_reference=OrientationReference.ENU,
                )
                events.append((arrival, sample, -1))
    return [(sample, index) for _, sample, index in sorted(events, key=lambda event: event[0])]


@pytest.fixture(scope="module")
def replay(recording):
    """Return the function that replays the recording, the same way once for all tests."""
    return cache(partial(replay_recording, recording))


def replay_recording(recording, withheld, orientation):
    """Return for each fix (its index, error of the antenna predicted to it, estimate, place of the fix)."""
    localizer, found = RawLocalizer.start(MOUNTS), []
    for sample, index in recording:
        if index >= 0 and localizer.origin is not None:
            estimate = localizer.estimate(sample.header.utime)
            geodesy = Geodesy(estimate.origin)
            place = geodesy.to_relative_utm(
                geodesy.utm_from_geodetic(sample.latitude_deg, sample.longitude_deg, sample.height_ellipsoidal)
            )
            antenna = (estimate.utm @ MOUNTS.X_base_antenna).xyz
            found.append((index, math.dist(antenna[:2], place[:2]), estimate, place))
        if index >= 0 and withheld and index % 2 == 1:
            continue
        if index < 0 and not orientation:
            sample = ImuSample(sample.header, sample.angular_velocity, sample.specific_force)
        localizer, _ = localizer.process(sample)
    return localizer, found


def test_the_pose_becomes_valid_and_follows_the_fixes_within_their_noise(replay):
    localizer, found = replay(withheld=False, orientation=True)
    valid = [each for each in found if each[2].invalid == 0]
    assert len(valid) > 0.95 * len(found)
    assert found[0][2].invalid  # it has not moved yet
    moving = [error for _, error, estimate, _ in valid if Quality.HEADING_FROM_GYRO not in estimate.quality]
    assert math.sqrt(np.mean(np.square(moving))) < 0.9  # the fixes' own sigma
    assert sum(error > estimate.horizontal_protection_level for _, error, estimate, _ in valid) <= 0.002 * len(valid)
    assert localizer.pose_epoch == 0


@pytest.mark.parametrize("orientation", [True, False])
def test_withheld_fixes_are_met_better_than_by_holding_the_last(replay, orientation):
    _, found = replay(withheld=True, orientation=orientation)
    places = {index: np.array(place[:2]) for index, _, _, place in found}
    odd = [each for each in found if each[0] % 2 == 1 and each[0] - 3 in places]
    rmse = math.sqrt(np.mean([error**2 for _, error, _, _ in odd]))
    hold = [places[i] - places[i - 1] for i, *_ in odd]
    line = [places[i] - places[i - 1] - (places[i - 1] - places[i - 3]) / 2 for i, *_ in odd]
    rmse_hold, rmse_line = (math.sqrt(np.mean(np.sum(np.square(each), axis=1))) for each in (hold, line))
    assert len(odd) > 450
    assert rmse < 0.75 * rmse_hold
    assert rmse < rmse_line


def test_both_sources_of_tilt_agree_on_the_vehicle_being_about_level(replay):
    for orientation in (True, False):
        _, found = replay(withheld=False, orientation=orientation)
        tilts = np.array([estimate.utm.rpy[:2] for *_, estimate, _ in found])
        assert np.abs(tilts.mean(axis=0)).max() < math.radians(3.0)
        assert np.abs(tilts).max() < math.radians(12.0)
