"""The drives of the integrity benchmark: their sensors belong to their truth, and a fault is run and judged."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import integrity
from benchmarks.integrity_drives import (
    EARTH_RADIUS,
    HEIGHT,
    LATITUDE,
    ORIGIN,
    RATE,
    START,
    VEHICLES,
    Scenario,
    compute_imu,
    compute_truth,
    measure,
)
from modelserver.earth import earth_rate, gravity
from modelserver.earth.geodesy import Geodesy
from modelserver.messages import GpsSample, ImuSample, WheelsSample
from modelserver.transforms import so3


def create_scenario(vehicle: str, seconds: float, seed: int = 3) -> Scenario:
    scenario = Scenario(VEHICLES[vehicle], seconds, np.random.default_rng(seed))
    scenario.has_errors = False
    return scenario


@pytest.mark.parametrize("name", VEHICLES)
def test_strapdown_integration_of_the_imu_reproduces_the_path(name: str) -> None:
    scenario = create_scenario(name, 60.0)
    scenario.platform_rate += 0.1 * np.sin(scenario.t)
    scenario.platform_velocity += np.sin(0.5 * scenario.t)[:, None]
    scenario.tilt += 0.02 * np.sin(scenario.t)[:, None]
    truth = compute_truth(scenario)
    lever = scenario.vehicle.imu.xyz
    rates, forces = compute_imu(truth, lever)
    places = truth.locate(lever)
    earth, g, dt = earth_rate(LATITUDE), gravity(LATITUDE, HEIGHT), 1.0 / RATE
    coriolis = 2.0 * so3.skew(earth)
    turns = 0.5 * dt * (rates[:-1] + rates[1:])
    turned_back = so3.exponential(so3.scale(-dt, earth))
    place = places[0]
    velocity = truth.velocity[0] + truth.rotation[0] @ np.cross(truth.rate[0], lever)
    attitude = so3.from_matrix(truth.rotation[0])
    before = np.array(so3.rotate(attitude, tuple(forces[0])))
    for k in range(1, len(rates)):
        turn = so3.exponential(tuple(turns[k - 1].tolist()))
        attitude = so3.multiply(turned_back, so3.multiply(attitude, turn))
        force = np.array(so3.rotate(attitude, tuple(forces[k].tolist())))
        down = np.array((-place[0] / EARTH_RADIUS, -place[1] / EARTH_RADIUS, -1.0))
        acceleration = 0.5 * (before + force) - coriolis @ velocity + g * down
        place = place + dt * velocity + 0.5 * dt * dt * acceleration
        velocity, before = velocity + dt * acceleration, force
    assert np.ptp(places[:, :2], axis=0).max() > 10.0
    assert np.linalg.norm(place - places[-1]) < 0.01
    assert abs(math.remainder(so3.to_rpy(attitude)[2] - truth.yaw[-1], math.tau)) < 1e-4


@pytest.mark.parametrize("name", VEHICLES)
def test_sensors_without_errors_measure_the_truth(name: str) -> None:
    scenario = create_scenario(name, 120.0)
    truth = compute_truth(scenario)
    received = list(measure(scenario, truth))
    assert all(a[0] <= b[0] for a, b in itertools.pairwise(received))
    samples = [sample for _, sample in received]
    fix = [each for each in samples if isinstance(each, GpsSample)][-1]
    enu = Geodesy(ORIGIN).enu_from_geodetic(fix.latitude_deg, fix.longitude_deg, fix.height_ellipsoidal)
    at = (fix.header.utime - START) * 1e-6
    place = [np.interp(at, scenario.t, column) for column in truth.locate(scenario.vehicle.antenna).T]
    assert math.dist(enu, place) < 1e-3
    wheels = [each for each in samples if isinstance(each, WheelsSample)][-1]
    at = (wheels.header.utime - START) * 1e-6
    travel = np.concatenate(([0.0], np.cumsum(truth.speed[1:] + truth.speed[:-1]) / (2.0 * RATE)))
    mean = sum(wheel.travel for wheel in wheels.wheels) / 2.0
    assert mean == pytest.approx(np.interp(at, scenario.t, travel), abs=1e-3)
    imu = next(each for each in samples if isinstance(each, ImuSample))
    # stationary at the start: only the earth turns, and the specific force is gravity along the vehicle's up
    assert imu.angular_velocity is not None
    assert imu.specific_force is not None
    assert math.hypot(*imu.angular_velocity) == pytest.approx(math.hypot(*earth_rate(LATITUDE)))
    assert math.hypot(*imu.specific_force) == pytest.approx(gravity(LATITUDE, HEIGHT), rel=1e-6)


def test_a_seed_gives_the_same_samples() -> None:
    runs = []
    for _ in range(2):
        scenario = Scenario(VEHICLES["skid"], 20.0, np.random.default_rng(7))
        runs.append(list(measure(scenario, compute_truth(scenario))))
    # nan is not equal to itself
    assert repr(runs[0]) == repr(runs[1])


@pytest.mark.parametrize("fault", integrity.FAULTS, ids=lambda fault: fault.name)
def test_every_fault_changes_its_drive(fault: integrity.Fault) -> None:
    changed, healthy = (Scenario(VEHICLES["rover"], fault.session or 900.0, np.random.default_rng(1)) for _ in range(2))
    fault.inject(changed)
    same = all(np.array_equal(value, getattr(healthy, name)) for name, value in vars(changed).items() if name != "rng")
    assert same == (fault.name == "none")


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["none", "gps_age"])
def test_some_minutes_with_a_small_fault_have_no_wrong_pose(
    fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "--faults",
        fault,
        "--vehicles",
        "rover",
        "--seeds",
        "1",
        "--minutes",
        "2.5",
        "--jobs",
        "1",
        "--events",
    ]
    code = integrity.main([*arguments, "--json", str(tmp_path / "figures.json")])
    (figures,) = json.loads((tmp_path / "figures.json").read_text())["faults"]
    assert (figures["fault"], figures["hmi"], figures["healed"]) == (fault, 0.0, None)
    # the start takes a tenth of the time, which a healthy drive may not
    assert 0.8 < figures["valid"] < 0.97
    assert (code, figures["missed"] != []) == ((1, True) if fault == "none" else (0, False))
    assert figures["rmse_ratio"] == pytest.approx(1.0, abs=0.3)
    output = capsys.readouterr().out
    assert "rover: 0.0 s/h" in output
    assert ("OUT OF BOUNDS: valid" in output) == (code == 1)


@pytest.mark.slow
def test_on_a_steady_circle_with_an_unknown_latency_the_bound_covers_the_heading() -> None:
    fault = integrity.BY_NAME["steady_circle"]
    # the gyro's scale turns the heading there, which fixes cannot separate from a latency that grows
    scenario = Scenario(VEHICLES["rover"], 450.0, np.random.default_rng((51, 23, 0, 2)), has_velocity=False)
    fault.inject(scenario)
    looks = integrity.observe(scenario)
    assert looks.valid.mean() > 0.7
    error, bound = looks.errors["heading"][looks.valid], looks.protection["heading"][looks.valid]
    assert np.all(error < bound)
    assert error.max() < 0.4


@pytest.mark.slow
def test_a_parked_vehicle_that_its_engine_shakes_neither_moves_nor_turns() -> None:
    scenario = Scenario(VEHICLES["car"], 400.0, np.random.default_rng((52, 22, 1, 1)), has_velocity=False)
    scenario.receiver = integrity.Receiver.UNSTATED
    scenario.stops.append((150.0, 410.0))
    scenario.idling = 0.4
    looks = integrity.observe(scenario)
    parked = looks.pose[looks.t > 180.0] - looks.pose[looks.t > 180.0][0]
    assert np.hypot(parked[:, 0], parked[:, 1]).max() < 0.3
    assert np.abs(parked[:, 2]).max() < math.radians(1.0)


@pytest.mark.slow
def test_a_silent_imu_makes_the_pose_neither_wrong_nor_invalid_for_long() -> None:
    scenario = Scenario(VEHICLES["rover"], 300.0, np.random.default_rng(8), has_velocity=False)
    scenario.silent = [(180.0, 183.0), (240.0, 243.0)]
    looks = integrity.observe(scenario)
    for key in ("horizontal", "heading"):
        assert np.all(looks.errors[key][looks.valid] < looks.protection[key][looks.valid])
    late = looks.valid[(looks.t > 215.0) & (looks.t < 240.0) | (looks.t > 275.0)]
    assert late.mean() > 0.9


def test_an_error_beyond_the_limit_while_valid_is_wrong_and_one_beyond_a_level_is_counted() -> None:
    scenario = create_scenario("rover", 60.0)
    scenario.events = [(20.0, 30.0)]
    t = np.arange(1, 251) * integrity.LOOK_PERIOD
    errors = np.where((t > 22.0) & (t < 25.0), 3.0, 0.5)
    valid = ~((t > 24.0) & (t < 27.0))
    ones, zeros = np.ones(250), np.zeros(250)
    looks = integrity.Looks(
        t,
        valid,
        {"horizontal": errors, "heading": 0.1 * ones},
        {"horizontal": ones, "heading": 0.2 * ones},
        {"horizontal": 2.0 * ones, "heading": 0.2 * ones},
        {"horizontal": 4.0 * ones, "heading": 0.2 * ones},
        np.stack((zeros, zeros, zeros), axis=1),
        [integrity.Invalid(0 if each else 256) for each in valid],
        [],
        0,
        2.0 * ones,
    )
    result = integrity.Result(integrity.Task("none", "rover", 1, 60.0))
    integrity._evaluate(result, 0, scenario, looks)
    assert result.wrong == pytest.approx(2.0, abs=0.21)
    (breach,) = result.breaches
    assert (breach.what, breach.error, breach.limit) == ("horizontal", 3.0, 1.0)
    assert breach.since_fault == pytest.approx(2.0, abs=0.21)
    assert (result.beyond_level, result.beyond_protection) == (pytest.approx(3.0, abs=0.21), 0.0)
    (event,) = result.events
    assert event.detected == pytest.approx(4.0, abs=0.21)
    assert event.healed == pytest.approx(5.0, abs=0.21)
    fault = integrity.BY_NAME["none"]
    allowed = integrity.Required(hmi=200.0, valid=0.9, beyond_level=0.1, rmse_ratio=0.5)
    summary = integrity.summarize(replace(fault, required=allowed), [result])
    assert (summary.holds, summary.rmse) == (True, pytest.approx(math.sqrt((14 * 9.0 + 236 * 0.25) / 250)))
    for name, bar in (("hmi", 100.0), ("valid", 0.96), ("beyond_level", 0.05), ("rmse_ratio", 0.4)):
        summary = integrity.summarize(replace(fault, required=replace(allowed, **{name: bar})), [result])
        assert len(summary.missed) == 1
