"""Propagation against a simulated drive, its transition matrix by differences, its covariance against many runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support_cart import GEODESY, IMU, MOUNTS, ORIGIN, SITE, model, rig, some_nav

from benchmarks.rough_simulation import RoughSimulation, Terrain, Wave, make_noise_free_imu
from modelserver.estimation.filter import eskf, fusion
from modelserver.estimation.filter.eskf import STRAPDOWN, ZERO, Earth, NavState, ProcessNoise
from modelserver.estimation.filter.hypothesis_bank import DeadReckoning
from modelserver.estimation.filter.sensor_monitors import ImuMonitor, StationaryDetector
from modelserver.estimation.filter.state import Aligned, Common, MotionConstraints, Setup
from modelserver.messages import ImuSample
from modelserver.simulation import START_UTIME, Timing, Trajectory, figure_eight
from modelserver.transforms import so3
from modelserver.transforms.so3 import cross

SETUP = Setup(rig())
N = SETUP.layout.size


def earth_here() -> Earth:
    latitude, _, height = GEODESY.geodetic_from_enu((0.0, 0.0, 0.0))
    return Earth.at(latitude, height)


# --- the nominal state --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_given_a_drive_on_hills_when_integrated_for_a_minute_then_the_position_is_right_to_a_centimeter(monkeypatch):
    # the simulator's vertical is that of the origin everywhere
    monkeypatch.setattr(eskf, "EARTH_RADIUS", 1e15)
    terrain = Terrain(0.05, -0.03, (Wave(0.8, 30.0, 0.4), Wave(0.3, 17.0, -1.0, 1.0)))
    simulation = RoughSimulation(
        model(), "Cart:Base", Trajectory(figure_eight(3.0, 8.0, stationary=1.0, ramp=2.0, laps=3), yaw=0.7), ORIGIN,
        imu_frame=IMU, imu_model=make_noise_free_imu(Timing(200.0)), terrain=terrain,
    )  # fmt: skip
    samples = [each for each in simulation.events(61.0) if isinstance(each, ImuSample)]
    mount, earth = MOUNTS.X_base_imu.wxyz, earth_here()
    truth = simulation.truth(samples[0].header.utime)
    lever = SETUP.rig.imu
    arm = so3.rotate(truth.enu.wxyz, cross(truth.twist[1], lever))

    def read_sample(sample: ImuSample) -> tuple[so3.Vector3, so3.Vector3]:
        assert sample.angular_velocity is not None
        assert sample.specific_force is not None
        return so3.rotate(mount, sample.angular_velocity), so3.rotate(mount, sample.specific_force)

    rate, force = read_sample(samples[0])
    vx, vy, vz = truth.velocity
    nav = some_nav(SETUP, 1)._replace(
        utime=samples[0].header.utime,
        position=(truth.enu @ MOUNTS.X_base_imu).xyz,
        velocity=(vx + arm[0], vy + arm[1], vz + arm[2]),
        attitude=truth.enu.wxyz,
        gyro_bias=ZERO,
        accelerometer_bias=ZERO,
        rate=rate,
        force=force,
    )
    for sample in samples[1:]:
        nav = eskf.propagate(nav, sample.header.utime, *read_sample(sample), earth, SETUP.rig.base)
    truth = simulation.truth(nav.utime)
    assert nav.utime - START_UTIME > 59_000_000
    assert math.dist(nav.point(SETUP.rig.base), truth.enu.xyz) < 0.01
    assert math.hypot(*so3.logarithm(so3.multiply(nav.attitude, so3.conjugate(truth.enu.wxyz)))) < 2e-5
    assert nav.body_velocity(SETUP.rig.base) == pytest.approx(truth.twist[0], abs=2e-3)
    # the distance travelled by the rolling frame along the body, which the wheels are compared with
    assert abs(nav.travel[1]) < 0.02
    assert nav.travel[0] > 100.0
    assert nav.rotation[2] == pytest.approx(truth.yaw - 0.7, abs=0.2)


def test_given_no_imu_when_coasting_in_a_turn_then_the_velocity_turns_with_the_body():
    nav = some_nav(SETUP, 2)._replace(velocity=(3.0, 0.0, 0.0), attitude=so3.IDENTITY, gyro_bias=(0.01, 0.0, 0.02))
    for n in range(100):
        nav = eskf.propagate_without_imu(nav, START_UTIME + (n + 1) * 10_000, (0.0, 0.0, 0.5), SETUP.rig.base)
    assert nav.velocity == pytest.approx((3.0 * math.cos(0.5), 3.0 * math.sin(0.5), 0.0))
    assert nav.yaw == pytest.approx(0.5)
    start = some_nav(SETUP, 2).position
    assert nav.position[0] - start[0] == pytest.approx(6.0 * math.sin(0.5), abs=1e-3)
    assert nav.position[1] - start[1] == pytest.approx(6.0 * (1.0 - math.cos(0.5)), abs=1e-3)
    assert nav.angular_rate == pytest.approx((0.0, 0.0, 0.5))
    assert nav.lag == pytest.approx(1.0)


# --- errors -------------------------------------------------------------------------------------------------


def find_error(a: NavState, b: NavState) -> np.ndarray:
    """Return the error that gives `b` when injected into `a`."""
    turn = so3.logarithm(so3.normalize(so3.multiply(b.attitude, so3.conjugate(a.attitude))))
    parts = [np.subtract(getattr(b, key), getattr(a, key)) for key in ("position", "velocity")]
    parts += [np.array(turn)]
    keys = ("gyro_bias", "accelerometer_bias", "extras")
    return np.concatenate(parts + [np.subtract(getattr(b, key), getattr(a, key)) for key in keys])


def find_largest_error(nav: NavState, dt: float) -> float:
    """Return the largest difference between the transition matrix over `dt` and propagated small errors."""
    utime, rate, force, earth = nav.utime + round(dt * 1e6), (0.2, -0.1, 0.4), (0.5, 0.3, 9.9), earth_here()

    def step(given: NavState) -> NavState:
        return eskf.propagate(given, utime, rate, force, earth, SETUP.rig.base)

    after = step(nav)
    F = eskf._transition_matrix(after, dt, SETUP.layout, np.ones(N - STRAPDOWN), SETUP.driving)
    h = 1e-6
    columns = []
    for k in range(N):
        error = np.zeros(N)
        error[k] = h
        ahead, behind = step(nav.inject(error, nav.covariance)), step(nav.inject(-error, nav.covariance))
        columns.append((find_error(after, ahead) - find_error(after, behind)) / (2.0 * h))
    return float(np.abs(np.array(columns).T - F).max())


@pytest.mark.parametrize("seed", range(3))
def test_given_small_errors_when_propagated_then_they_follow_the_transition_matrix_to_second_order(seed):
    nav = some_nav(SETUP, seed)
    whole, half = find_largest_error(nav, 0.04), find_largest_error(nav, 0.02)
    # left out: the gyro bias through the attitude within one step, g dt^2 / 2, and the earth rate
    assert whole < 0.6 * 10.0 * 0.04**2
    assert half < 0.27 * whole + 5e-6


def test_given_gauss_markov_states_when_propagated_then_they_decay_exactly_and_keep_their_steady_variance():
    nav = some_nav(SETUP, 1)
    P = nav.covariance.copy()
    at = SETUP.layout.index("gps_wander_east")
    P[at, at] = 1.0
    nav = nav._replace(covariance=P, lag=7.0)
    after = eskf.propagate_covariance(nav, SETUP.driving, SETUP.layout)
    keep = math.exp(-7.0 / SETUP.settings.gps_correlation_time)
    assert after.extras[at - STRAPDOWN] == pytest.approx(keep * nav.extras[at - STRAPDOWN])
    assert after.covariance[at, at] == pytest.approx(1.0)
    assert after.lag == 0.0
    assert eskf.propagate_covariance(after, SETUP.driving, SETUP.layout) is after


@pytest.mark.slow
def test_given_two_hundred_noisy_runs_then_their_covariance_is_that_of_the_filter():
    rng = np.random.default_rng(5)
    dt, steps, runs = 0.05, 160, 200
    noise = ProcessNoise(0.002**2, 0.002**2, 0.03**2, 0.0, 0.0)
    base = SETUP.rig.base
    P = np.zeros((N, N))
    sigmas = {0: 0.1, 3: 0.05, 6: 0.01, 9: 0.002, 12: 0.02}
    for at, sigma in sigmas.items():
        P[range(at, at + 3), range(at, at + 3)] = sigma**2
    start = some_nav(SETUP, 1)._replace(
        position=ZERO, velocity=(2.0, 0.0, 0.0), attitude=so3.from_rpy(0.05, -0.1, 0.3), gyro_bias=ZERO,
        accelerometer_bias=ZERO, covariance=P, rate=(0.0, 0.0, 0.1), force=(0.1, 0.2, 9.8),
    )  # fmt: skip

    def run(nav: NavState, errors: np.ndarray | None) -> NavState:
        for k in range(steps):
            rate, force = (0.0, 0.0, 0.1), (0.1, 0.2, 9.8)
            if errors is not None:
                # the measured value is the true one plus noise
                rate, force = tuple(np.add(rate, errors[k, :3])), tuple(np.add(force, errors[k, 3:]))
            nav = eskf.propagate(nav, START_UTIME + round((k + 1) * dt * 1e6), rate, force, Earth(), base)
            if errors is None:
                nav = eskf.propagate_covariance(nav, noise, SETUP.layout)
        return nav

    nominal = run(start, None)
    found = []
    for _ in range(runs):
        error = np.sqrt(np.diagonal(P)) * rng.normal(size=N)
        scale = np.repeat((0.002, 0.03), 3) / math.sqrt(dt)
        found.append(find_error(nominal, run(start.inject(error, P), rng.normal(size=(steps, 6)) * scale)))
    ratio = np.var(np.array(found)[:, :STRAPDOWN], axis=0) / np.diagonal(nominal.covariance)[:STRAPDOWN]
    assert ratio.min() > 0.65
    assert ratio.max() < 1.5
    # position correlates with velocity, and both with tilt: the correlations are as large
    correlation, expected = np.corrcoef(np.array(found)[:, :9].T), nominal.covariance[:9, :9]
    sigma = np.sqrt(np.diagonal(expected))
    assert np.abs(correlation - expected / np.outer(sigma, sigma)).max() < 0.3


# --- gaps ---------------------------------------------------------------------------------------------------


def test_given_a_gap_then_the_last_sample_is_held_for_a_while_and_then_the_state_coasts():
    setup = SETUP
    nav = some_nav(setup, 1)._replace(attitude=so3.IDENTITY, velocity=(2.0, 0.0, 0.0), gyro_bias=ZERO)
    nav = nav._replace(rate=(0.0, 0.0, 0.5), force=(0.0, 0.0, eskf.STANDARD_GRAVITY), accelerometer_bias=ZERO)
    state = Aligned(
        nav,
        ImuMonitor(used_utime=nav.utime),
        StationaryDetector(),
        DeadReckoning(),
        MotionConstraints(),
        Common(),
        Earth(),
        SITE,
    )
    held = fusion.predict_nav(setup, state, nav.utime + 150_000)
    assert held.yaw == pytest.approx(0.075)
    later = fusion.predict_nav(setup, state, nav.utime + 1_000_000)
    assert later.yaw == pytest.approx(0.5 * setup.settings.rate_hold)
    assert math.hypot(*later.velocity) == pytest.approx(2.0, abs=0.1)
    caught = fusion.propagate_covariance(setup, state._replace(nav=later)).nav
    # 0.8 s without a measurement
    assert caught.covariance[8, 8] > nav.covariance[8, 8] + 0.5 * setup.settings.gap_rate_sigma**2
    assert fusion.advance(setup, state, nav.utime) is state
