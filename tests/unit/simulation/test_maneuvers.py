from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from support_maneuvers import reverse_eight, stop_and_go

from modelserver.simulation import Trajectory, city, figure_eight, stationary


def motions(drive: Trajectory, step: float = 0.05):
    return [drive.at(t) for t in np.arange(0.0, drive.duration, step).tolist()]


def test_the_eight_in_reverse_backs_all_the_way_and_closes():
    drive = Trajectory(reverse_eight(speed=2.0, radius=6.0))
    seen = motions(drive)
    assert all(motion.speed <= 1e-12 for motion in seen)
    assert min(motion.speed for motion in seen) == pytest.approx(-2.0)
    ahead = Trajectory(figure_eight(speed=2.0, radius=6.0))
    assert drive.duration == pytest.approx(ahead.duration)
    crossing, end = drive.at(7.0), drive.at(drive.duration - 7.0)
    np.testing.assert_allclose(end.position, crossing.position, atol=1e-9)


def test_stationary_is_stationary():
    drive = Trajectory(stationary(30.0))
    assert drive.duration == 30.0
    assert {motion.position for motion in motions(drive)} == {(0.0, 0.0, 0.0)}


def test_stop_and_go_stops_and_goes():
    drive = Trajectory(stop_and_go(times=4, curvature=0.05))
    stationary_phases = [motion.speed == 0.0 for motion in motions(drive)]
    assert sum(a and not b for a, b in pairwise(stationary_phases)) == 4
    rates = [motion.yaw_rate for motion in motions(drive)]
    assert min(rates) < -0.1 < 0.1 < max(rates)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [20.0, 60.0, 120.0])
def test_a_drive_in_town_takes_its_time_within_its_limits(seconds):
    for seed in range(20):
        drive = Trajectory(city(seed, seconds, speed=8.0, min_radius=5.0))
        assert drive.duration == pytest.approx(seconds, abs=1e-9)
        for motion in motions(drive, 0.2):
            assert -3.2 - 1e-9 <= motion.speed <= 8.0 + 1e-9
            assert abs(motion.speed * motion.yaw_rate) <= 2.1
            assert abs(motion.curvature) <= 0.2 + 1e-9
            assert abs(motion.forward_acceleration) < 4.5


def test_drives_in_town_have_everything_in_them_and_differ_by_seed():
    assert city(3) == city(3) != city(4)
    seen = [motion for seed in range(10) for motion in motions(Trajectory(city(seed)), 0.25)]
    share = len(seen)
    assert sum(motion.speed > 1.0 for motion in seen) > 0.3 * share
    assert sum(motion.speed < -0.5 for motion in seen) > 0.01 * share
    assert sum(motion.speed == 0.0 for motion in seen) > 0.05 * share
    assert sum(motion.yaw_rate > 0.1 for motion in seen) > 0.05 * share
    assert sum(motion.yaw_rate < -0.1 for motion in seen) > 0.05 * share
    for seed in range(10):
        turned = [motion.yaw for motion in motions(Trajectory(city(seed)), 0.5)]
        assert max(turned) - min(turned) > math.radians(60.0)


def test_an_invalid_drive_in_town_is_rejected():
    with pytest.raises(ValueError, match="at least 20"):
        city(1, 5.0)
