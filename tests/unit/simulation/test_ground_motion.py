"""Uneven ground and side slip: every rate is the derivative of its quantity."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.rough_simulation import SideSlip, Terrain, Wave, make_motion
from modelserver.simulation import DrivePhase, Trajectory, figure_eight
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose

PLAN = Trajectory(
    (
        *figure_eight(speed=3.0, radius=6.0, stationary=2.0, stop=1.0, reverse=4.0),
        DrivePhase(2.0, -2.0, 0.1),
        DrivePhase(3.0, 0.0),
    ),
    start=(20.0, -10.0),
    yaw=0.4,
)
HILLS = Terrain(0.05, -0.08, (Wave(0.6, 25.0, 0.3, 1.0), Wave(0.3, 14.0, 2.0), Wave(1.0, 60.0, -1.2, 0.5)))
SLIDING = SideSlip(cornering=0.02, random_sigma=0.1)
LEVER = (1.1, -0.4, 1.3)
RIDES = {
    "plane": (Terrain(0.1, -0.2), None),
    "hills": (HILLS, None),
    "sliding in turns": (None, SideSlip(cornering=0.02)),
    "sliding at random": (None, SideSlip(random_sigma=0.2)),
    "sliding on hills": (HILLS, SLIDING),
}


@pytest.fixture(params=RIDES, ids=list(RIDES))
def drive(request):
    terrain, slip = RIDES[request.param]
    return make_motion(PLAN, terrain, slip, seed=5)


def times(count: int = 300) -> list[float]:
    return np.linspace(-0.5, PLAN.duration + 0.5, count).tolist()


@pytest.mark.slow
def test_each_quantity_is_the_derivative_of_the_one_before(drive):
    h = 1e-4
    X = Pose(LEVER)
    for t in times():
        before, here, after = drive.at(t - h), drive.at(t), drive.at(t + h)

        def slope(name, before=before, after=after):
            return (np.array(getattr(after, name)) - np.array(getattr(before, name))) / (2 * h)

        np.testing.assert_allclose(slope("position"), here.velocity, atol=2e-7)
        np.testing.assert_allclose(slope("velocity"), here.acceleration, atol=2e-6)
        assert slope("yaw") == pytest.approx(here.yaw_rate, abs=1e-6)
        assert slope("yaw_rate") == pytest.approx(here.yaw_acceleration, abs=5e-6)
        assert slope("speed") == pytest.approx(here.forward_acceleration, abs=2e-6)
        # a point off the middle: its place, its velocity, its acceleration
        place = (after.pose_of(X).position - before.pose_of(X).position) / (2 * h)
        np.testing.assert_allclose(place, here.velocity_at(LEVER), atol=2e-6)
        velocity = np.subtract(after.velocity_at(LEVER), before.velocity_at(LEVER)) / (2 * h)
        np.testing.assert_allclose(velocity, here.acceleration_at(LEVER), atol=1e-5)
        # the attitude turns by the angular rate, and the rate by its acceleration
        turned = so3.multiply(after.orientation(), so3.conjugate(before.orientation()))
        np.testing.assert_allclose(np.array(so3.logarithm(turned)) / (2 * h), here.angular_rate(), atol=1e-6)
        if here.attitude is not None:
            rate = np.subtract(after.attitude.rate, before.attitude.rate) / (2 * h)
            np.testing.assert_allclose(rate, here.attitude.acceleration, atol=1e-5)


def test_up_is_the_grounds_normal_and_forward_points_along_the_yaw(drive):
    for t in times():
        motion = drive.at(t)
        R = np.array(so3.matrix_rows(motion.orientation()))
        assert math.remainder(math.atan2(R[1, 0], R[0, 0]) - motion.yaw, math.tau) == pytest.approx(0.0, abs=1e-12)
        along, left, up = R.T @ motion.velocity
        assert along == pytest.approx(motion.speed, abs=1e-12)
        assert left == pytest.approx(motion.lateral_speed, abs=1e-12)
        assert up == pytest.approx(0.0, abs=1e-12)  # a vehicle does not take off
        if motion.attitude is None:
            assert motion.position[2] == 0.0
        else:
            terrain = drive._terrain
            x, y, z = motion.position
            assert z == terrain.height(x, y)
            h = 1e-5
            slopes = (
                (terrain.height(x + h, y) - terrain.height(x - h, y)) / (2 * h),
                (terrain.height(x, y + h) - terrain.height(x, y - h)) / (2 * h),
            )
            np.testing.assert_allclose(-R[:2, 2] / R[2, 2], slopes, atol=1e-8)


def test_ground_that_is_level_is_as_without_ground():
    level = make_motion(PLAN, Terrain())
    assert make_motion(PLAN) is PLAN
    for t in times(50):
        one, other = level.at(t), PLAN.at(t)
        np.testing.assert_allclose(one.position + one.velocity, other.position + other.velocity, atol=1e-15)
        np.testing.assert_allclose(one.orientation(), so3.normalize(other.orientation()), atol=1e-15)
        np.testing.assert_allclose(one.acceleration_at(LEVER), other.acceleration_at(LEVER), atol=1e-12)
        assert one.speed == pytest.approx(other.speed, abs=1e-12)


def test_slip_keeps_the_path_and_fades_where_the_vehicle_is_stationary():
    sliding = make_motion(PLAN, None, SLIDING)
    moved = 0
    for t in times():
        one, other = sliding.at(t), PLAN.at(t)
        assert one.position == other.position
        if abs(other.speed) < 1e-9:
            assert one.yaw == pytest.approx(other.yaw, abs=1e-9)
            assert one.lateral_speed == pytest.approx(0.0, abs=1e-12)
        moved += abs(one.lateral_speed) > 0.02
    assert moved > 100


@pytest.mark.parametrize(("speed", "curvature"), [(3.0, 0.15), (3.0, -0.15), (-3.0, 0.15), (-3.0, -0.15)])
def test_a_vehicle_slides_out_of_its_turn(speed, curvature):
    turn = Trajectory((DrivePhase(2.0, speed, curvature), DrivePhase(6.0), DrivePhase(2.0, 0.0)))
    motion = make_motion(turn, None, SideSlip(cornering=0.02)).at(5.0)
    lateral_acceleration = curvature * speed**2
    assert motion.lateral_speed * curvature < 0
    beta = motion.lateral_speed / abs(speed)
    assert beta == pytest.approx(-0.02 * lateral_acceleration, rel=1e-3)


def test_the_random_lateral_velocity_is_as_large_as_stated_and_of_the_seed():
    long = Trajectory((DrivePhase(2.0, 5.0), DrivePhase(600.0), DrivePhase(2.0, 0.0)))

    def lateral(seed):
        drive = make_motion(long, None, SideSlip(random_sigma=0.1), seed)
        return np.array([drive.at(t).lateral_speed for t in range(5, 600)])

    one, same, other = lateral(1), lateral(1), lateral(2)
    np.testing.assert_array_equal(one, same)
    assert abs(one - other).max() > 0.01
    assert np.sqrt((one**2).mean()) == pytest.approx(0.1, rel=0.1)


def test_hills_are_as_steep_as_stated_and_of_the_seed():
    assert Terrain.hills(3) == Terrain.hills(3) != Terrain.hills(4)
    places = np.random.default_rng(1).uniform(-2000.0, 2000.0, (3000, 2)).tolist()
    hills = Terrain.hills(3, steepness=0.05)
    rises = [hills.evaluate((x, y, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for x, y in places]
    steep = np.array([rise.east[0] ** 2 + rise.north[0] ** 2 for rise in rises])
    assert math.sqrt(steep.mean()) == pytest.approx(0.05, rel=0.1)


def test_invalid_models_are_rejected():
    with pytest.raises(ValueError, match="length"):
        Wave(1.0, 0.0)
    with pytest.raises(ValueError, match="periods"):
        SideSlip(periods=(0.0, 1.0))
