"""Faults of receivers, IMUs and wheels on request; off by default."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.rough_simulation import (
    EncoderModel,
    TriadModel,
    make_noise_free_gps,
    make_noise_free_imu,
    make_noise_free_wheels,
)
from modelserver.earth.geodesy import Geodesy
from modelserver.messages import Direction, OrientationReference, YawSource
from modelserver.simulation import (
    DrivePhase,
    GpsModel,
    ImuModel,
    MagnetometerModel,
    Timing,
    Trajectory,
    WheelsModel,
    straight,
)
from modelserver.transforms import so3

STANDING = Trajectory([DrivePhase(1.0)])
RUN = Trajectory(straight(speed=3.0, length=60.0, stationary=2.0))


def enu(fix, origin):
    return np.array(Geodesy(origin).enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal))


# --- the receiver -------------------------------------------------------------------------------------------


def test_an_unstated_latency_makes_old_fixes_look_new(simulate, origin):
    quiet = make_noise_free_gps()
    prompt = list(simulate(gps_model=quiet).events(40.0))
    late = list(simulate(gps_model=replace(quiet, unstated_latency=0.5)).events(40.0))
    for old, new in zip(late[2:], prompt[:-2], strict=True):
        assert old.header.utime - new.header.utime == 500_000
        np.testing.assert_allclose(enu(old, origin), enu(new, origin), atol=1e-7)
        np.testing.assert_allclose(old.velocity, new.velocity, atol=1e-9)


def test_jumps_shift_fixes_for_a_while(simulate, origin):
    sound = list(simulate(gps_model=GpsModel()).events(20.0))
    jumping = list(simulate(gps_model=GpsModel(jumps=((5.0, 8.0, 3.0, -4.0), (7.0, 9.0, 1.0, 0.0)))).events(20.0))
    for one, other in zip(sound, jumping, strict=True):
        t = one.header.seq / 4.0
        east = 3.0 * (5 <= t < 8) + 1.0 * (7 <= t < 9)
        np.testing.assert_allclose(enu(other, origin) - enu(one, origin), (east, -4.0 * (5 <= t < 8), 0.0), atol=1e-6)


def test_what_is_stated_can_be_wrong_or_missing(simulate):
    def first(**more):
        return next(simulate(gps_model=GpsModel(**more), second_gps_frame="Car:Second").events(1.0))

    sound, proud = first(), first(sigma_factor=0.5)
    np.testing.assert_allclose(proud.position_covariance, np.array(sound.position_covariance) / 4.0)
    np.testing.assert_allclose(proud.velocity_covariance, np.array(sound.velocity_covariance) / 4.0)
    assert proud.speed_sigma == sound.speed_sigma / 2.0
    assert proud.baseline_yaw_sigma == sound.baseline_yaw_sigma / 2.0
    assert proud.latitude_deg == sound.latitude_deg
    mute = first(has_velocity=False)
    assert mute.velocity is None
    assert mute.velocity_covariance is None
    assert all(map(math.isnan, (mute.speed, mute.course, mute.speed_sigma, mute.course_sigma, mute.velocity_latency)))
    assert mute.position_covariance == sound.position_covariance


def test_the_baseline_is_as_good_as_stated_and_only_there_with_two_antennas(simulate):
    model = GpsModel(baseline_sigma=0.01)
    assert math.isnan(next(simulate(gps_model=model).events(1.0)).baseline_yaw)
    fixes = list(simulate(STANDING, gps_model=model, second_gps_frame="Car:Second").events(300.0))
    yaw = np.array([fix.baseline_yaw for fix in fixes])
    assert yaw.std() == pytest.approx(0.01, rel=0.1)
    assert yaw.mean() == pytest.approx(math.atan2(1.0, -0.1), abs=0.002)
    assert fixes[0].baseline_yaw_sigma == 0.01


# --- the inertial unit --------------------------------------------------------------------------------------

QUIET = make_noise_free_imu(earth_rotation=False)


def vectors(run, seconds, name):
    return np.array([getattr(sample, name) for sample in run.events(seconds)])


@pytest.mark.slow
def test_scale_and_misalignment_are_one_matrix_of_the_stated_size(simulate):
    model = replace(QUIET, accelerometer=TriadModel(scale_sigma=0.01, misalignment_sigma=0.003))
    true = vectors(simulate(imu_model=QUIET), 20.0, "specific_force")
    seen = vectors(simulate(imu_model=model), 20.0, "specific_force")
    _, rest, _, _ = np.linalg.lstsq(true, seen, rcond=None)
    assert rest.max() < 1e-15
    # over many units
    found, timing = [], Timing(25.0)
    true = vectors(simulate(imu_model=replace(QUIET, timing=timing)), 9.0, "specific_force")
    for seed in range(30):
        seen = vectors(simulate(imu_model=replace(model, timing=timing), seed=seed), 9.0, "specific_force")
        found.append(np.linalg.lstsq(true, seen, rcond=None)[0] - np.eye(3))
    sigma = np.sqrt((np.array(found) ** 2).mean(axis=0))
    np.testing.assert_allclose(sigma.diagonal(), 0.01, rtol=0.4)
    np.testing.assert_allclose(sigma[~np.eye(3, dtype=bool)], 0.003, rtol=0.45)


@pytest.mark.slow
def test_a_bias_that_is_unstable_stays_within_its_size_and_one_that_walks_does_not(simulate):
    timing = Timing(10.0)
    unstable = replace(QUIET, timing=timing, gyro=TriadModel(instability=1e-3, instability_time=5.0))
    drift = vectors(simulate(STANDING, imu_model=unstable), 2000.0, "angular_velocity")
    np.testing.assert_allclose(drift.std(axis=0), 1e-3, rtol=0.15)
    shifted = (drift[50:] * drift[:-50]).mean() / (drift**2).mean()
    assert shifted == pytest.approx(math.exp(-1.0), abs=0.1)
    walking = replace(QUIET, timing=Timing(2.0), accelerometer=TriadModel(walk=1e-3))
    ends = []
    for seed in range(30):
        force = vectors(simulate(STANDING, imu_model=walking, seed=seed), 100.1, "specific_force")
        ends.append(force[-1] - force[0])
    assert np.std(ends) == pytest.approx(1e-3 * math.sqrt(100.0), rel=0.2)


def test_it_vibrates_while_it_moves(simulate):
    model = replace(QUIET, gyro=TriadModel(vibration=0.02), accelerometer=TriadModel(vibration=0.5))
    for name, sigma in (("angular_velocity", 0.02), ("specific_force", 0.5)):
        shake = vectors(simulate(RUN, imu_model=model), 26.0, name) - vectors(
            simulate(RUN, imu_model=QUIET), 26.0, name
        )
        np.testing.assert_array_equal(shake[:190], 0.0)
        np.testing.assert_allclose(shake[400:1700].std(axis=0), sigma, rtol=0.1)


def test_a_frozen_unit_repeats_itself_under_new_stamps(simulate):
    samples = list(simulate(imu_model=replace(ImuModel(), frozen_from=3.0)).events(6.0))
    sound = list(simulate(imu_model=ImuModel()).events(6.0))
    assert [sample.header for sample in samples] == [sample.header for sample in sound]
    # compared as text: since Python 3.13 a dataclass that holds a nan is not equal to itself
    steady = [replace(each, temperature_celsius=samples[0].temperature_celsius) for each in sound[:300]]
    assert list(map(repr, samples[:300])) == list(map(repr, steady))
    assert {sample.specific_force for sample in samples[299:]} == {sound[299].specific_force}
    assert samples[-1].orientation == sound[299].orientation


def test_an_outage_leaves_the_other_samples_as_they_were(simulate):
    holed = list(simulate(imu_model=ImuModel(outages=((2.0, 4.0),))).events(6.0))
    sound = list(simulate(imu_model=ImuModel()).events(6.0))
    assert list(map(repr, holed)) == [repr(each) for each in sound if not 200 <= each.header.seq < 400]


@pytest.mark.slow
def test_the_magnetometer_measures_the_earth_the_vehicle_and_disturbances(simulate, car):
    field, pull = (3e-6, 17e-6, -51e-6), (5e-6, -2e-6, 1e-6)
    soft = ((1.1, 0.02, 0.0), (0.01, 0.9, 0.03), (0.0, -0.02, 1.05))
    sound = replace(QUIET, magnetometer=MagnetometerModel(field))
    bent = replace(
        QUIET,
        magnetometer=MagnetometerModel(field, (4e-6, 0.0, -1e-6), soft, disturbances=((10.0, 12.0, pull),)),
    )
    run = simulate(imu_model=sound)
    X_BS = car.get_transformation("Car:Imu", "Car:CG").pose
    for clean, sample in zip(run.events(20.0), simulate(imu_model=bent).events(20.0), strict=True):
        R_SE = (run.truth(sample.header.utime).enu @ X_BS).rotation.T
        np.testing.assert_allclose(clean.magnetic_field, R_SE @ field, atol=1e-18)
        near = 10.0 <= sample.header.seq / 100.0 < 12.0
        around = R_SE @ (np.add(field, pull) if near else field)
        np.testing.assert_allclose(sample.magnetic_field, np.array(soft) @ around + (4e-6, 0.0, -1e-6), atol=1e-18)
    noisy = replace(QUIET, magnetometer=MagnetometerModel(noise=2e-7))
    np.testing.assert_allclose(
        vectors(simulate(STANDING, imu_model=noisy), 50.0, "magnetic_field").std(axis=0), 2e-7, rtol=0.06
    )
    assert next(simulate(imu_model=ImuModel()).events(1.0)).magnetic_field is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "expected"), [(YawSource.TRUE, 0.1), (YawSource.MAGNETIC, 0.1 + math.atan2(3.0, 17.0))]
)
def test_a_yaw_with_a_source_does_not_drift(simulate, car, source, expected):
    model = replace(
        ImuModel(),
        reference=OrientationReference.ENU,
        tilt_sigma=0.0,
        tilt_noise=0.0,
        yaw_offset=0.1,
        yaw_noise=0.02,
        yaw_source=source,
        magnetometer=MagnetometerModel((3e-6, 17e-6, -50e-6)),
    )
    run = simulate(imu_model=model)
    X_BS = car.get_transformation("Car:Imu", "Car:CG").pose
    errors = []
    for sample in run.events(60.0):
        assert sample.yaw_source is source
        X_ES = run.truth(sample.header.utime).enu @ X_BS
        error = so3.logarithm(so3.multiply(sample.orientation, so3.conjugate(X_ES.wxyz)))
        errors.append((*error, sample.orientation_covariance[8]))
    tilt_x, tilt_y, yaw, variance = np.array(errors).T
    np.testing.assert_allclose((tilt_x, tilt_y), 0.0, atol=1e-9)
    np.testing.assert_allclose(variance, 0.02**2)
    assert yaw.mean() == pytest.approx(expected, abs=0.002)
    assert yaw.std() == pytest.approx(0.02, rel=0.05)


# --- the wheels ---------------------------------------------------------------------------------------------


def wheel(run, name, seconds):
    return [next(each for each in sample.wheels if each.name == name) for sample in run.events(seconds)]


def with_faults(**faults) -> WheelsModel:
    return replace(make_noise_free_wheels(), encoder=EncoderModel(**faults))


def test_wheels_spin_in_bursts_each_for_itself(simulate):
    run = simulate(RUN, wheels_model=with_faults(burst_rate=0.2, burst_seconds=1.0, burst_excess=0.5))
    spins = {"rear_left": [], "rear_right": []}
    for sample in run.events(20.0):
        speed = RUN.at((sample.header.utime - run.start_utime) * 1e-6).speed
        for each in sample.wheels:
            if each.name in spins and speed > 0.1:
                assert min(abs(each.speed / speed - factor) for factor in (1.0, 1.5)) < 1e-9
                spins[each.name].append(each.speed / speed > 1.25)
    left, right = spins.values()
    assert 0 < sum(left) < len(left)
    assert left != right


def test_a_stuck_encoder_and_one_that_counts_backward(simulate):
    model = with_faults(stuck=(("rear_left", 8.0),), swapped=frozenset(("front_right",)))
    run = simulate(RUN, wheels_model=model)
    sound = simulate(RUN, wheels_model=make_noise_free_wheels())
    reached = None
    for sample, true in zip(run.events(25.0), sound.events(25.0), strict=True):
        each, right = ({wheel.name: wheel for wheel in both.wheels} for both in (sample, true))
        assert each["front_left"] == right["front_left"]
        assert each["front_right"].travel == -right["front_right"].travel
        assert each["front_right"].speed == -right["front_right"].speed
        if right["front_right"].speed > 0.1:
            assert each["front_right"].direction is Direction.BACKWARD
        if sample.header.seq / 20.0 < 8.0:
            reached = right["rear_left"].travel
            assert each["rear_left"] == right["rear_left"]
        else:
            assert (each["rear_left"].travel, each["rear_left"].speed) == (reached, 0.0)
            assert each["rear_left"].direction is Direction.STOPPED


def test_wheels_can_have_unstated_latency(simulate):
    prompt = wheel(simulate(wheels_model=make_noise_free_wheels()), "rear_left", 20.0)
    late = wheel(simulate(wheels_model=replace(make_noise_free_wheels(), unstated_latency=0.2)), "rear_left", 20.0)
    for old, new in zip(late[4:], prompt[:-4], strict=True):
        assert old.speed == pytest.approx(new.speed, abs=1e-9)
        assert old.travel == pytest.approx(new.travel, abs=1e-9)
