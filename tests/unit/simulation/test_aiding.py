"""Absolute poses, visual odometry and ranges: true up to the noise that they state."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.rough_simulation import AbsolutePoseModel, RangeModel, RelativePoseModel, SideSlip
from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.simulation import DrivePhase, GpsModel, ImuModel, Trajectory, WheelsModel
from modelserver.transforms import so3

BEACONS = {"mast": (30.0, 10.0, 8.0), "gate": (-20.0, -40.0, 3.0), "far": (900.0, 0.0, 0.0)}


@pytest.fixture
def camera(car):
    return car.get_transformation("Car:Camera", "Car:CG").pose


@pytest.mark.parametrize("world", ["World:ENU", "World:UTM"])
def test_poses_from_elsewhere_are_the_frame_itself(simulate, hills, camera, world):
    model = AbsolutePoseModel(position_sigma=0.0, orientation_sigma=0.0, frame_of_reference=world)
    run = simulate(terrain=hills, pose_frame="Car:Camera", pose_model=model)
    samples = list(run.events(30.0))
    assert len(samples) == 150
    for sample in samples:
        truth = run.truth(sample.header.utime)
        expected = (truth.enu if world == "World:ENU" else truth.utm) @ camera
        # the grid's scale, 0.9996, on the camera's lever
        np.testing.assert_allclose(sample.position, expected.position, atol=1e-9 if world == "World:ENU" else 1e-3)
        assert so3.logarithm(so3.multiply(so3.conjugate(sample.orientation), expected.wxyz)) == pytest.approx(
            (0.0, 0.0, 0.0), abs=1e-6
        )
        assert (sample.frame_of_interest, sample.frame_of_reference) == ("Car:Camera", world)


def test_the_noise_of_poses_is_along_the_world_and_as_stated(simulate, camera):
    model = AbsolutePoseModel(position_sigma=0.1, orientation_sigma=0.02)
    run = simulate(Trajectory([DrivePhase(1.0)]), pose_frame="Car:Camera", pose_model=model)
    true = run.truth(0).enu @ camera
    samples = list(run.events(300.0))
    moved = np.array([sample.position for sample in samples]) - true.position
    turned = [so3.logarithm(so3.multiply(each.orientation, so3.conjugate(true.wxyz))) for each in samples]
    np.testing.assert_allclose(moved.std(axis=0), 0.1, rtol=0.08)
    np.testing.assert_allclose(np.std(turned, axis=0), 0.02, rtol=0.08)
    np.testing.assert_allclose(
        np.array(samples[0].covariance).reshape(6, 6), np.diag([0.01] * 3 + [0.0004] * 3), atol=1e-15
    )


def test_a_source_of_poses_may_fail_for_a_while(simulate):
    model = AbsolutePoseModel(outages=((1.0, 2.0),))
    samples = list(simulate(pose_frame="Car:Camera", pose_model=model).events(4.0))
    assert [sample.header.seq for sample in samples] == [*range(5), *range(10, 20)]
    with pytest.raises(ValueError, match="World"):
        AbsolutePoseModel(frame_of_reference="Odom:Origin")


def test_odometry_chained_gives_the_path(simulate, hills, camera):
    model = RelativePoseModel(position_sigma=0.0, orientation_sigma=0.0)
    run = simulate(
        terrain=hills, side_slip=SideSlip(random_sigma=0.1), odometry_frame="Car:Camera", odometry_model=model
    )
    here = run.truth(run.start_utime).enu @ camera
    reached = run.start_utime
    for sample in run.events(30.0):
        assert sample.since_utime == reached
        reached = sample.header.utime
        here = here @ type(here)(sample.position, sample.orientation)
        assert here.is_close(run.truth(reached).enu @ camera, 1e-9, 1e-9)
    assert reached > run.start_utime


def test_odometry_errs_as_stated_and_in_its_scale(simulate):
    standing = simulate(
        Trajectory([DrivePhase(1.0)]), odometry_frame="Car:Camera", odometry_model=RelativePoseModel(scale_sigma=0.1)
    )
    samples = list(standing.events(300.0))
    np.testing.assert_allclose(np.std([each.position for each in samples], axis=0), 0.01, rtol=0.08)
    turned = [so3.logarithm(each.orientation) for each in samples]
    np.testing.assert_allclose(np.std(turned, axis=0), 0.002, rtol=0.08)
    exact = RelativePoseModel(position_sigma=0.0, orientation_sigma=0.0)
    one = list(simulate(odometry_frame="Car:CG", odometry_model=exact).events(20.0))
    other = list(simulate(odometry_frame="Car:CG", odometry_model=replace(exact, scale_sigma=0.1)).events(20.0))
    ways = [(math.hypot(*a.position), math.hypot(*b.position)) for a, b in zip(one, other, strict=True)]
    ratios = [measured / true for true, measured in ways if true > 0.01]
    assert len(ratios) > 50
    assert max(ratios) - min(ratios) < 1e-9
    assert abs(ratios[0] - 1.0) > 0.01


def test_ranges_are_distances_within_max_range(simulate, hills, camera):
    model = RangeModel(sigma=0.0, max_range=100.0)
    run = simulate(terrain=hills, range_frame="Car:Camera", beacons=BEACONS, range_model=model)
    samples = list(run.events(20.0))
    assert [sample.header.seq for sample in samples] == list(range(200))
    for sample in samples:
        assert sample.beacon in ("mast", "gate")
        assert sample.beacon_position == BEACONS[sample.beacon]
        assert (sample.frame, sample.frame_of_reference) == ("Car:Camera", "World:ENU")
        place = (run.truth(sample.header.utime).enu @ camera).xyz
        assert sample.distance == pytest.approx(math.dist(place, sample.beacon_position), abs=1e-9)


def test_ranges_err_as_stated(simulate):
    model = RangeModel(sigma=0.2)
    run = simulate(Trajectory([DrivePhase(1.0)]), range_frame="Car:CG", beacons=BEACONS, range_model=model)
    samples = list(run.events(200.0))
    for name, place in BEACONS.items():
        errors = [each.distance - math.dist(run.truth(0).enu.xyz, place) for each in samples if each.beacon == name]
        assert np.std(errors) == pytest.approx(0.2, rel=0.08)
        assert np.mean(errors) == pytest.approx(0.0, abs=0.03)
    assert samples[0].sigma == 0.2


def test_further_sources_do_not_change_the_others_and_come_in_order(simulate, hills):
    base = {"terrain": hills, "gps_model": GpsModel(), "imu_model": ImuModel(), "wheels_model": WheelsModel()}
    more = {
        "pose_frame": "Car:Camera",
        "odometry_frame": "Car:Camera",
        "range_frame": "Car:CG",
        "beacons": BEACONS,
    }
    samples = list(simulate(**base, **more).events(10.0))
    arrivals = [sample.header.host_utime for sample in samples]
    assert arrivals == sorted(arrivals)
    aided = (AbsolutePoseSample, RelativePoseSample, RangeSample)
    assert {type(sample) for sample in samples} >= set(aided)
    rest = [repr(sample) for sample in samples if not isinstance(sample, aided)]
    assert rest == list(map(repr, simulate(**base).events(10.0)))
    assert list(map(repr, samples)) == list(map(repr, simulate(**base, **more).events(10.0)))
