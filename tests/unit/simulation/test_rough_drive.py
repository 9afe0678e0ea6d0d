"""On hills and with side slip, samples without noise equal the truth, compared with its positions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.rough_simulation import SideSlip, make_noise_free_gps, make_noise_free_imu, make_noise_free_wheels
from modelserver import earth
from modelserver.earth.geodesy import Geodesy
from modelserver.simulation import Timing
from modelserver.transforms import so3

SLIDING = SideSlip(cornering=0.02, random_sigma=0.1)


@pytest.mark.slow
def test_integrating_the_inertial_unit_gives_the_drive_back(simulate, hills, car, origin):
    """Strapdown navigation by Runge-Kutta from the first instant on; see test_sensors for the source."""
    rate = 400.0
    run = simulate(terrain=hills, side_slip=SLIDING, imu_model=make_noise_free_imu(Timing(rate)), seed=3)
    samples = list(run.events(run.trajectory.duration))
    latitude, _, height = Geodesy(origin).geodetic_from_enu((0.0, 0.0, 0.0))
    turning = so3.skew(earth.earth_rate(latitude))
    g = np.array((0.0, 0.0, earth.gravity(latitude, height)))
    X_BS = car.get_transformation("Car:Imu", "Car:CG").pose

    def derivative(state, sample):
        R, v = state[0:9].reshape(3, 3), state[9:12]
        w, f = sample.angular_velocity, sample.specific_force
        return np.concatenate([(R @ so3.skew(w) - turning @ R).ravel(), R @ f - g - 2.0 * turning @ v, v])

    start = run.truth(run.start_utime).enu @ X_BS
    state = np.concatenate([start.rotation.ravel(), np.zeros(3), start.position])
    h = 2.0 / rate
    steps = zip(samples[0:-2:2], samples[1:-1:2], samples[2::2], strict=True)
    for number, (first, middle, last) in enumerate(steps):
        k1 = derivative(state, first)
        k2 = derivative(state + h / 2 * k1, middle)
        k3 = derivative(state + h / 2 * k2, middle)
        k4 = derivative(state + h * k3, last)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if number % 100 == 0:
            truth = run.truth(last.header.utime).enu @ X_BS
            np.testing.assert_allclose(state[12:15], truth.position, atol=2e-5)
            np.testing.assert_allclose(state[0:9].reshape(3, 3), truth.rotation, atol=1e-7)


def test_truth_is_whole(simulate, hills):
    run = simulate(terrain=hills, side_slip=SLIDING)
    steep = 0.0
    for t in np.linspace(0.5, run.trajectory.duration - 0.5, 200).tolist():
        utime = run.start_utime + round(t * 1e6)
        before, here, after = (run.truth(utime + dt) for dt in (-500, 0, 500))
        velocity = (after.enu.position - before.enu.position) * 1e3
        np.testing.assert_allclose(velocity, here.velocity, atol=1e-5)
        acceleration = np.subtract(after.velocity, before.velocity) * 1e3
        np.testing.assert_allclose(acceleration, here.acceleration, atol=1e-4)
        linear, angular = here.twist
        np.testing.assert_allclose(here.enu.rotation @ linear, here.velocity, atol=1e-12)
        turned = so3.multiply(so3.conjugate(before.enu.wxyz), after.enu.wxyz)
        np.testing.assert_allclose(np.array(so3.logarithm(turned)) * 1e3, angular, atol=1e-5)
        assert math.remainder(here.enu.rpy[2] - here.yaw, math.tau) == pytest.approx(0.0, abs=1e-9)
        steep = max(steep, *map(abs, here.enu.rpy[:2]))
    assert steep > 0.1


def test_fixes_are_the_antenna_itself(simulate, hills, car, origin):
    run = simulate(terrain=hills, side_slip=SLIDING, gps_model=make_noise_free_gps(), second_gps_frame="Car:Second")
    geodesy = Geodesy(origin)
    X_BA, X_BS = (car.get_transformation(frame, "Car:CG").position for frame in ("Car:Antenna", "Car:Second"))
    for fix in run.events(run.trajectory.duration):
        truth = run.truth(fix.header.utime)
        antenna = geodesy.enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal)
        np.testing.assert_allclose(antenna, truth.enu.transform(X_BA), atol=1e-7)
        linear, angular = truth.twist
        expected = truth.enu.rotation @ (np.array(linear) + np.cross(angular, X_BA))
        np.testing.assert_allclose(fix.velocity, expected, atol=1e-4)  # true north turns with the place
        east, north, _ = truth.enu.transform(X_BS) - truth.enu.transform(X_BA)
        apart = math.remainder(fix.baseline_yaw - math.atan2(north, east), math.tau)
        assert apart == pytest.approx(0.0, abs=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("slip", [None, SLIDING])
def test_wheels_roll_what_their_contact_points_move_ahead(simulate, hills, car, slip):
    """A steered wheel moves along itself where nothing slides; the others see nothing of what is across."""
    steered = frozenset(("front_left", "front_right"))
    run = simulate(terrain=hills, side_slip=slip, wheels_model=make_noise_free_wheels(Timing(50.0), steered))
    frames = {"front_left": "Car:FL", "front_right": "Car:FR", "rear_left": "Car:RL", "rear_right": "Car:RR"}
    levers = {name: car.get_transformation(frame, "Car:CG").position for name, frame in frames.items()}
    samples = list(run.events(run.trajectory.duration))
    twists = np.array([run.truth(sample.header.utime).twist for sample in samples])
    for number, wheel in enumerate(samples[0].wheels):
        rows = [
            (each.wheels[number].speed, each.wheels[number].travel, each.wheels[number].steering) for each in samples
        ]
        assert {each.wheels[number].name for each in samples} == {wheel.name}
        speed, travel, steering = np.array(rows).T
        vx, vy, _ = (twists[:, 0] + np.cross(twists[:, 1], levers[wheel.name])).T
        expected = vx * np.cos(steering) + vy * np.sin(steering)
        np.testing.assert_allclose(speed, expected, rtol=0, atol=1e-9)
        before = np.concatenate(([0.0], expected[:-1]))
        np.testing.assert_allclose(travel, np.cumsum(0.02 * (expected + before) / 2.0), rtol=0, atol=1e-3)
    assert len(samples[0].wheels) == len(levers)
    assert run.drive.at(10.0).attitude is not None
