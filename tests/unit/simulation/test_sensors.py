"""Samples without noise equal the truth, and with noise have the errors of their models."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.rough_simulation import make_noise_free_gps, make_noise_free_imu, make_noise_free_wheels
from modelserver import earth
from modelserver.earth.geodesy import Geodesy, LocalFrame, origin_at
from modelserver.geometry import Model, ModelBuilder
from modelserver.messages import (
    Direction,
    FixType,
    GpsSample,
    ImuSample,
    OrientationReference,
    VehicleStatusSample,
    WheelsSample,
)
from modelserver.simulation import (
    DrivePhase,
    GpsModel,
    ImuModel,
    Simulation,
    StatusModel,
    Trajectory,
    WheelsModel,
    figure_eight,
    straight,
)
from modelserver.simulation.sensors import Timing
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose

ORIGIN = origin_at(50.27, -111.18, 700.0)
DRIVE = Trajectory(
    figure_eight(speed=3.0, radius=6.0, stationary=2.0, stop=1.0, reverse=3.0), start=(20.0, -10.0), yaw=0.4
)
WHEELS = {"front_left": "Car:FL", "front_right": "Car:FR", "rear_left": "Car:RL", "rear_right": "Car:RR"}
TRACK, BASE = 1.2, 1.6


def car() -> Model:
    """A vehicle with its sensors askew and far from its base frame."""
    builder = ModelBuilder("car")
    body = builder.add_body("Car")
    body.add_frame("CG", Pose((0.9, 0.0, 0.6)))
    body.add_frame("RearAxle")
    for name, x, y in (("FL", BASE, 1), ("FR", BASE, -1), ("RL", 0.0, 1), ("RR", 0.0, -1)):
        body.add_frame(name, Pose((x, y * TRACK / 2, 0.0)))
    body.add_frame("Mast", Pose((0.3, -0.4, 1.8)))
    body.add_frame("Shelf", Pose((1.1, 0.3, 1.2)))
    builder.add_body("Antenna").add_frame("Foot").add_frame("Phase", Pose((0.0, 0.0, 0.1)))
    builder.add_body("Imu").add_frame("Foot").add_frame("Sensor", Pose.from_rpy((0.01, 0.02, 0.03), math.pi, 0.1, 0.7))
    builder.add_constraint("AntennaFixed", "Car:Mast", "Antenna:Foot")
    builder.add_constraint("ImuFixed", "Car:Shelf", "Imu:Foot")
    return builder.build()


CAR = car()


def simulation(trajectory: Trajectory = DRIVE, **more) -> Simulation:
    settings = {
        "gps_frame": "Antenna:Phase",
        "imu_frame": "Imu:Sensor",
        "wheel_frames": WHEELS,
        "rolling_frame": "Car:RearAxle",
        "gps_model": make_noise_free_gps(),
        "imu_model": make_noise_free_imu(),
        "wheels_model": make_noise_free_wheels(),
    }
    return Simulation(CAR, "Car:CG", trajectory, ORIGIN, **(settings | more))


def of(kind, samples):
    return [sample for sample in samples if isinstance(sample, kind)]


# --- the inertial unit --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_integrating_the_inertial_unit_gives_the_drive_back():
    """Strapdown navigation by Runge-Kutta from the first instant on; nothing but the samples and the start.

    Attitude: R' = R [w]x - [W]x R; velocity: v' = R f - g - 2 W x v, of the unit along east, north, up, with W the
    earth's rotation (P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation", 2013, 5.3).
    """
    rate = 200.0
    run = simulation(imu_model=make_noise_free_imu(Timing(rate)), gps_frame=None, wheel_frames=None)
    samples = list(run.events(DRIVE.duration))
    latitude, _, height = Geodesy(ORIGIN).geodetic_from_enu((0.0, 0.0, 0.0))
    turning = so3.skew(earth.earth_rate(latitude))
    g = np.array((0.0, 0.0, earth.gravity(latitude, height)))
    X_BS = CAR.get_transformation("Imu:Sensor", "Car:CG").pose

    def derivative(state, w, f):
        R, v = state[0:9].reshape(3, 3), state[9:12]
        return np.concatenate([(R @ so3.skew(w) - turning @ R).ravel(), R @ f - g - 2.0 * turning @ v, v])

    start = run.truth(run.start_utime).enu @ X_BS
    state = np.concatenate([start.rotation.ravel(), np.zeros(3), start.position])
    h = 2.0 / rate
    # two samples a step, so that the one between serves Runge-Kutta's midpoint
    steps = zip(samples[0:-2:2], samples[1:-1:2], samples[2::2], strict=True)
    for number, (first, middle, last) in enumerate(steps):
        k1 = derivative(state, first.angular_velocity, first.specific_force)
        k2 = derivative(state + h / 2 * k1, middle.angular_velocity, middle.specific_force)
        k3 = derivative(state + h / 2 * k2, middle.angular_velocity, middle.specific_force)
        k4 = derivative(state + h * k3, last.angular_velocity, last.specific_force)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if number % 50:
            continue
        truth = run.truth(last.header.utime).enu @ X_BS
        np.testing.assert_allclose(state[12:15], truth.position, atol=2e-6)
        np.testing.assert_allclose(state[0:9].reshape(3, 3), truth.rotation, atol=1e-8)


def test_a_stationary_imu_measures_gravity_and_earth_rotation():
    run = simulation(Trajectory([DrivePhase(10.0)]), gps_frame=None, wheel_frames=None)
    sample = next(run.events(1.0))
    X_ES = run.truth(sample.header.utime).enu @ CAR.get_transformation("Imu:Sensor", "Car:CG").pose
    np.testing.assert_allclose(X_ES.rotation @ sample.specific_force, (0.0, 0.0, 9.8085), atol=1e-3)
    np.testing.assert_allclose(X_ES.rotation @ sample.angular_velocity, earth.earth_rate(50.27), atol=1e-15)


def test_gravity_is_that_of_the_ellipsoid():
    """WGS 84's own values at the equator, at 45 degrees and at the pole; free air falls by 0.3086 mGal a meter."""
    assert earth.gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert earth.gravity(45.0, 0.0) == pytest.approx(9.8061977694, abs=1e-9)
    assert earth.gravity(90.0, 0.0) == pytest.approx(9.8321849379, abs=1e-9)
    assert earth.gravity(45.0, 1000.0) - earth.gravity(45.0, 0.0) == pytest.approx(-3.086e-3, abs=2e-6)


@pytest.mark.parametrize(
    ("reference", "axes"),
    [
        (OrientationReference.ENU, np.eye(3)),
        (OrientationReference.NED, np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])),
    ],
)
def test_its_own_orientation_is_the_truth_rotated_by_its_initial_yaw(reference, axes):
    offset = 2.0
    imu = replace(make_noise_free_imu(yaw_offset=offset, earth_rotation=False), reference=reference)
    run = simulation(imu_model=imu, gps_frame=None, wheel_frames=None)
    turned = Pose.from_rpy((0.0, 0.0, 0.0), yaw=offset).rotation
    for sample in list(run.events(DRIVE.duration))[::10]:
        X_ES = run.truth(sample.header.utime).enu @ CAR.get_transformation("Imu:Sensor", "Car:CG").pose
        stated = Pose((0.0, 0.0, 0.0), sample.orientation).rotation
        np.testing.assert_allclose(stated, axes @ turned @ X_ES.rotation, atol=1e-9)


def test_its_yaw_drifts_by_the_gyro_error():
    """A vertical gyro: its yaw is the integral of its rates, bias and earth's rotation included."""
    run = simulation(
        Trajectory([DrivePhase(60.0)]), imu_model=ImuModel(gyro_walk=0.0), gps_frame=None, wheel_frames=None
    )
    samples = list(run.events(60.0))
    X_ES = run.truth(run.start_utime).enu @ CAR.get_transformation("Imu:Sensor", "Car:CG").pose

    def yaw(sample):
        x, y, z = (0.0, math.sqrt(0.5), math.sqrt(0.5))
        q_EN = (x, y, z, 0.0)
        q = so3.multiply(so3.multiply(so3.conjugate(q_EN), sample.orientation), so3.conjugate(X_ES.wxyz))
        return so3.to_rpy(so3.normalize(q))[2]

    rates = np.array([X_ES.rotation @ sample.angular_velocity for sample in samples])
    measured = rates[:-1, 2].sum() / 100.0
    assert math.remainder(yaw(samples[-1]) - yaw(samples[0]) - measured, math.tau) == pytest.approx(0.0, abs=0.01)
    assert abs(measured) > 0.02


def test_its_noise_is_that_of_the_model():
    imu = ImuModel(gyro_bias_sigma=0.0, gyro_walk=0.0, accelerometer_bias_sigma=0.0)
    run = simulation(Trajectory([DrivePhase(100.0)]), imu_model=imu, gps_frame=None, wheel_frames=None)
    samples = list(run.events(100.0))
    gyro = np.array([sample.angular_velocity for sample in samples])
    force = np.array([sample.specific_force for sample in samples])
    np.testing.assert_allclose(gyro.std(axis=0), imu.gyro_noise * 10.0, rtol=0.05)
    np.testing.assert_allclose(force.std(axis=0), imu.accelerometer_noise * 10.0, rtol=0.05)


# --- the receiver -------------------------------------------------------------------------------------------


def test_fixes_without_noise_are_the_antenna_itself():
    run = simulation(imu_frame=None, wheel_frames=None)
    geodesy = Geodesy(ORIGIN)
    X_BA = CAR.get_transformation("Antenna:Phase", "Car:CG").pose
    fixes = list(run.events(DRIVE.duration))
    assert len(fixes) == math.ceil(DRIVE.duration * 4)
    for fix in fixes:
        utime = fix.header.utime
        antenna = geodesy.enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal)
        np.testing.assert_allclose(antenna, (run.truth(utime).enu @ X_BA).position, atol=1e-7)
        # velocity: the difference of true positions, along the axes of the antenna's own place
        before, after = ((run.truth(utime + dt).enu @ X_BA).position for dt in (-1000, 1000))
        local = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal)
        expected = so3.rotate(local.rotation_of(geodesy.tangent), tuple((after - before) / 2e-3))
        np.testing.assert_allclose(fix.velocity, expected, atol=1e-5)
        assert fix.speed == pytest.approx(math.hypot(*fix.velocity[:2]))
        if fix.speed > 0.01:
            assert fix.course == pytest.approx(math.atan2(fix.velocity[1], fix.velocity[0]))


@pytest.mark.slow
def test_the_error_of_fixes_is_time_correlated_and_as_large_as_stated():
    run = simulation(
        Trajectory([DrivePhase(1.0)]), imu_frame=None, wheel_frames=None, gps_model=GpsModel(time_constant=5.0)
    )
    geodesy = Geodesy(ORIGIN)
    X_BA = CAR.get_transformation("Antenna:Phase", "Car:CG").pose
    truth = (run.truth(0).enu @ X_BA).position
    fixes = list(run.events(3000.0))
    error = np.array(
        [
            geodesy.enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal) - truth
            for fix in fixes
        ]
    )
    stated = np.sqrt(np.array(fixes[0].position_covariance).reshape(3, 3).diagonal())
    np.testing.assert_allclose(np.sqrt((error**2).mean(axis=0)), stated, rtol=0.1)
    assert stated[2] == pytest.approx(1.5 * stated[0])
    shift = round(5.0 * 4)
    correlation = (error[shift:] * error[:-shift]).mean() / (error**2).mean()
    assert correlation == pytest.approx(math.exp(-1.0) * 0.9, abs=0.1)
    velocity = np.array([fix.velocity for fix in fixes])
    np.testing.assert_allclose(velocity.std(axis=0), (0.03, 0.03, 0.045), rtol=0.05)


def test_a_delayed_velocity_is_that_of_its_instant():
    late = simulation(
        imu_frame=None, wheel_frames=None, gps_model=replace(make_noise_free_gps(), velocity_latency=0.25)
    )
    prompt = simulation(imu_frame=None, wheel_frames=None)
    for old, new in zip(list(late.events(60.0))[1:], list(prompt.events(60.0))[:-1], strict=True):
        assert old.velocity_latency == 0.25
        np.testing.assert_allclose(old.velocity, new.velocity, atol=1e-6)


def test_an_outage_has_no_fix_and_leaves_the_others_as_they_were():
    whole = list(simulation(imu_frame=None, wheel_frames=None, gps_model=GpsModel()).events(20.0))
    gap = GpsModel(outages=((5.0, 8.0),))
    holed = list(simulation(imu_frame=None, wheel_frames=None, gps_model=gap).events(20.0))
    lost = [fix for fix in holed if fix.fix_type is FixType.NONE]
    assert [fix.header.seq for fix in lost] == list(range(20, 32))
    assert all(math.isnan(fix.latitude_deg) for fix in lost)
    # compared by their text: missing values are nan, which equals nothing
    assert [repr(fix) for fix in holed if fix not in lost] == [
        repr(fix) for fix in whole if fix.header.seq not in range(20, 32)
    ]


# --- the wheels ---------------------------------------------------------------------------------------------


def travels(sample: WheelsSample) -> dict[str, float]:
    return {wheel.name: wheel.travel for wheel in sample.wheels}


def test_the_difference_of_the_wheels_travel_is_the_turn_times_the_track():
    run = simulation(gps_frame=None, imu_frame=None)
    start = run.truth(run.start_utime)
    for sample in run.events(DRIVE.duration):
        rolled = travels(sample)
        turned = run.truth(sample.header.utime).yaw - start.yaw
        assert rolled["rear_right"] - rolled["rear_left"] == pytest.approx(turned * TRACK, abs=1e-9)
        # wheels that do not steer roll the forward part of their way, at the front as at the rear
        assert rolled["front_left"] == pytest.approx(rolled["rear_left"], abs=1e-9)


def test_the_vehicle_controller_measures_the_speed_and_the_angle_of_the_equivalent_front_wheel():
    """The steered wheels' own angles lie on both sides of it, by Ackermann's geometry."""
    steered = frozenset(("front_left", "front_right"))
    run = simulation(
        gps_frame=None,
        imu_frame=None,
        wheels_model=make_noise_free_wheels(steered=steered),
        status_model=StatusModel(BASE, Timing(20.0), angle_sigma=0.0),
    )
    events = list(run.events(40.0))
    wheels = {each.header.utime: each.wheels for each in events if isinstance(each, WheelsSample)}
    statuses = [each for each in events if isinstance(each, VehicleStatusSample)]
    assert len(statuses) == len(wheels) == 800
    for status in statuses:
        left, right = (math.tan(each.steering) for each in wheels[status.header.utime] if each.name in steered)
        equivalent = math.tan(status.steering_angle)
        if abs(equivalent) > 0.05:
            assert 1.0 / equivalent == pytest.approx(0.5 * (1.0 / left + 1.0 / right))
        assert min(left, right) - 1e-9 <= equivalent <= max(left, right) + 1e-9
    assert min(each.forward_speed for each in statuses) < -1.0
    assert max(abs(each.steering_angle) for each in statuses) > 0.2


@pytest.mark.slow
def test_unsteered_and_steered_wheels_follow_the_path_of_their_contact_points():
    """Against positions: a steered wheel rolls the length of its contact point's way."""
    steered = frozenset(("front_left", "front_right"))
    run = simulation(gps_frame=None, imu_frame=None, wheels_model=make_noise_free_wheels(steered=steered))
    fine = 500
    previous = None
    ways = dict.fromkeys(steered, 0.0)
    for sample in run.events(30.0):
        utime = sample.header.utime
        if previous is not None:
            for name in steered:
                X = CAR.get_transformation(WHEELS[name], "Car:CG").pose
                points = [
                    (run.truth(u).enu @ X).position
                    for u in range(previous, utime + 1, (utime - previous) // fine * 100)
                ]
                ways[name] += sum(float(np.linalg.norm(b - a)) for a, b in pairwise(points))
        previous = utime
        for wheel in sample.wheels:
            if wheel.name in steered:
                assert wheel.travel == pytest.approx(ways[wheel.name], rel=1e-4, abs=1e-4)


def test_steered_wheels_point_along_the_velocity_of_their_contact_point():
    steered = frozenset(("front_left", "front_right"))
    run = simulation(gps_frame=None, imu_frame=None, wheels_model=make_noise_free_wheels(steered=steered))
    for sample in run.events(DRIVE.duration):
        truth = run.truth(sample.header.utime)
        for wheel in sample.wheels:
            if wheel.name not in steered or abs(wheel.speed) < 0.1:
                continue
            lever = truth.enu.rotation @ CAR.get_transformation(WHEELS[wheel.name], "Car:CG").position
            velocity = np.array(truth.velocity) + np.cross((0.0, 0.0, truth.yaw_rate), lever)
            expected = truth.yaw + wheel.steering + (math.pi if wheel.speed < 0 else 0.0)
            assert math.remainder(math.atan2(velocity[1], velocity[0]) - expected, math.tau) == pytest.approx(
                0, abs=1e-9
            )
            assert abs(wheel.speed) == pytest.approx(math.hypot(*velocity[:2]), abs=1e-9)


def test_directions_are_those_of_the_drive():
    run = simulation(gps_frame=None, imu_frame=None)
    seen = set()
    for sample in run.events(DRIVE.duration):
        speed = run.trajectory.at((sample.header.utime - run.start_utime) * 1e-6).speed
        for wheel in sample.wheels:
            seen.add(wheel.direction)
            if abs(speed) > 0.1:
                assert wheel.direction == (Direction.FORWARD if speed > 0 else Direction.BACKWARD)
            elif speed == 0:
                assert wheel.direction is Direction.STOPPED
                assert wheel.speed == 0.0
    assert seen == {Direction.FORWARD, Direction.STOPPED, Direction.BACKWARD}


def test_slip_makes_wheels_turn_too_much_when_speeding_up_and_scale_errs_all_the_way():
    def last(**more):
        model = replace(make_noise_free_wheels(), **more)
        run = simulation(Trajectory(straight()), gps_frame=None, imu_frame=None, wheels_model=model)
        return travels(list(run.events(6.0))[-1])["rear_left"]  # in the middle of the run-up

    assert last(slip=0.5) > last() * 1.01
    assert last(scale_sigma=0.05) != pytest.approx(last(), rel=1e-3)


# --- all of them --------------------------------------------------------------------------------------------


def noisy(seed: int = 7) -> Simulation:
    return simulation(seed=seed, gps_model=GpsModel(), imu_model=ImuModel(), wheels_model=WheelsModel(slip=0.1))


def test_the_same_seed_gives_the_same_samples_and_another_seed_others():
    one, same, other = (list(map(repr, noisy(seed).events(10.0))) for seed in (7, 7, 8))
    assert one == same
    assert one != other


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [0.003, 0.25, 3.7])
def test_samples_do_not_depend_on_the_chunks_requested(chunk):
    whole = noisy()
    run = noisy()
    samples = []
    for _ in range(math.ceil(10.0 / chunk)):
        samples += list(run.events(chunk))
        run.truth(whole.start_utime + 1_234_567)
    expected = list(whole.events(math.ceil(10.0 / chunk) * chunk))
    assert list(map(repr, samples)) == list(map(repr, expected))


def test_unread_samples_come_with_the_next_call():
    run = noisy()
    first = [next(run.events(1.0)) for _ in range(3)]
    rest = list(run.events(1.0))
    assert list(map(repr, first + rest)) == list(map(repr, noisy().events(4.0)))


def test_samples_come_in_order_of_arrival_and_none_is_lost():
    run = noisy()
    samples = list(run.events(20.0))
    arrivals = [sample.header.host_utime for sample in samples]
    assert arrivals == sorted(arrivals)
    for kind, rate in ((GpsSample, 4), (ImuSample, 100), (WheelsSample, 20)):
        mine = of(kind, samples)
        assert len(mine) == pytest.approx(20 * rate, abs=2)
        assert [sample.header.seq for sample in mine] == list(range(len(mine)))
        assert {sample.header.utime - run.start_utime for sample in mine} == {
            round(seq * 1e6 / rate) for seq in range(len(mine))
        }
        assert all(sample.header.host_utime >= sample.header.utime for sample in mine)


def test_an_absent_sensor_does_not_change_the_others():
    whole = of(ImuSample, noisy().events(5.0))
    alone = simulation(seed=7, imu_model=ImuModel(), gps_frame=None, wheel_frames=None).events(5.0)
    assert list(map(repr, whole)) == list(map(repr, alone))


def test_truth_in_the_grid_is_truth_in_the_plane_by_geodesy():
    run = simulation()
    for t in (0.0, 10.0, 20.0):
        truth = run.truth(run.start_utime + round(t * 1e6))
        lat, lon, height = truth.latitude_deg, truth.longitude_deg, truth.height
        geodesy = Geodesy(ORIGIN)
        np.testing.assert_allclose(geodesy.enu_from_geodetic(lat, lon, height), truth.enu.position, atol=1e-7)
        np.testing.assert_allclose(
            geodesy.to_relative_utm(geodesy.utm_from_geodetic(lat, lon, height)), truth.utm.position, atol=1e-7
        )
        # true north turns by 4 microradians in twenty meters of east
        assert truth.utm.rpy[2] == pytest.approx(truth.enu.rpy[2] + geodesy.convergence(lat, lon), abs=2e-5)
        linear, angular = truth.twist
        np.testing.assert_allclose(truth.enu.rotation @ linear, truth.velocity, atol=1e-12)
        np.testing.assert_allclose(angular, (0.0, 0.0, truth.yaw_rate), atol=1e-12)


@pytest.mark.parametrize("timing", [(0.0, 0.0, 0.0), (10.0, -1.0, 0.0), (math.nan, 0.0, 0.0)])
def test_an_invalid_timing_is_rejected(timing):
    with pytest.raises(ValueError, match="rate_hz"):
        Timing(*timing)
