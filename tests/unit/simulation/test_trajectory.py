from __future__ import annotations

import math

import numpy as np
import pytest
from support_maneuvers import there_and_back

from modelserver.simulation import DrivePhase, Trajectory, figure_eight, straight

DRIVES = {
    "straight": straight(),
    "eight": figure_eight(speed=2.0, radius=6.0),
    "eight with stop and reverse": figure_eight(speed=3.0, radius=8.0, stop=2.0, reverse=4.0, laps=2),
    "there and back": there_and_back(),
    "backing in a bend": (DrivePhase(1.0), DrivePhase(2.0, -1.0, 0.2), DrivePhase(5.0), DrivePhase(2.0, 0.0)),
}


@pytest.fixture(params=DRIVES, ids=list(DRIVES))
def drive(request) -> Trajectory:
    return Trajectory(DRIVES[request.param], start=(3.0, -2.0), yaw=0.7)


def times(drive: Trajectory, count: int = 400) -> np.ndarray:
    return np.linspace(-1.0, drive.duration + 1.0, count)


def test_each_quantity_is_the_derivative_of_the_one_before(drive):
    h = 1e-4
    for t in times(drive):
        before, here, after = drive.at(t - h), drive.at(t), drive.at(t + h)

        def slope(name, before=before, after=after):
            return (np.array(getattr(after, name)) - np.array(getattr(before, name))) / (2 * h)

        np.testing.assert_allclose(slope("position"), here.velocity, atol=1e-6)
        np.testing.assert_allclose(slope("velocity"), here.acceleration, atol=1e-6)
        assert slope("yaw") == pytest.approx(here.yaw_rate, abs=1e-6)
        assert slope("yaw_rate") == pytest.approx(here.yaw_acceleration, abs=1e-6)
        assert slope("distance") == pytest.approx(here.speed, abs=1e-6)
        assert slope("speed") == pytest.approx(here.forward_acceleration, abs=1e-6)


@pytest.mark.slow
def test_position_is_continuous_and_exact_across_knots_and_phases(drive):
    """Against Simpson's rule on ten thousand steps of the velocity."""
    n = 10_000
    dt = drive.duration / (2 * n)
    v = np.array([drive.at(k * dt).velocity for k in range(2 * n + 1)])
    steps = (v[:-2:2] + 4 * v[1:-1:2] + v[2::2]) * dt / 3
    end = np.array(drive.at(0.0).position) + steps.sum(axis=0)
    np.testing.assert_allclose(drive.at(drive.duration).position, end, atol=1e-9)


def test_the_vehicle_points_along_its_path_and_never_slides(drive):
    for t in times(drive):
        motion = drive.at(t)
        across = -motion.velocity[0] * math.sin(motion.yaw) + motion.velocity[1] * math.cos(motion.yaw)
        assert across == pytest.approx(0.0, abs=1e-12)
        assert motion.yaw_rate == pytest.approx(motion.curvature * motion.speed, abs=1e-12)


def test_it_is_stationary_before_and_after(drive):
    for t in (-10.0, 0.0, drive.duration, drive.duration + 10.0):
        motion = drive.at(t)
        assert motion.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        assert motion.acceleration == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert drive.at(-10.0).position == (3.0, -2.0, 0.0)


def test_an_eight_closes_and_turns_both_ways():
    drive = Trajectory(figure_eight(speed=2.0, radius=6.0, stationary=4.0, ramp=3.0, laps=2))
    # the crossing is where the run-up of 3 s at 1 m/s on average ends
    crossing, end = drive.at(7.0), drive.at(drive.duration - 7.0)
    np.testing.assert_allclose(end.position, crossing.position, atol=1e-9)
    assert end.yaw == pytest.approx(crossing.yaw, abs=1e-9)
    yaw = [drive.at(t).yaw for t in times(drive)]
    assert max(yaw) - min(yaw) == pytest.approx(math.radians(270.0), abs=1e-3)
    curvature = [drive.at(t).curvature for t in times(drive, 2000)]
    assert max(curvature) == pytest.approx(1 / 6)
    assert min(curvature) == pytest.approx(-1 / 6)


def test_there_and_back_comes_back():
    drive = Trajectory(there_and_back(length=20.0))
    np.testing.assert_allclose(drive.at(drive.duration).position, (0.0, 0.0, 0.0), atol=1e-9)
    assert max(drive.at(t).position[0] for t in times(drive)) == pytest.approx(20.0)


def test_an_eight_with_reverse_backs_up():
    drive = Trajectory(figure_eight(stop=2.0, reverse=4.0))
    assert min(drive.at(t).speed for t in times(drive)) == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([], "at least one phase"),
        ([DrivePhase(0.0, 1.0)], "positive duration"),
        ([DrivePhase(1.0, math.nan)], "finite"),
        ([DrivePhase(1.0, 1.0)], "must end stationary"),
    ],
)
def test_an_invalid_drive_is_rejected(phases, message):
    with pytest.raises(ValueError, match=message):
        Trajectory(phases)


@pytest.mark.parametrize(
    "figure",
    [
        lambda: straight(length=1.0),
        lambda: figure_eight(speed=0.0),
        lambda: figure_eight(laps=0),
        lambda: figure_eight(speed=5.0, radius=2.0),
    ],
)
def test_an_impossible_maneuver_is_rejected(figure):
    with pytest.raises(ValueError, match=r"m|lap"):
        figure()
