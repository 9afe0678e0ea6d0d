"""Start on the move: a vehicle that backs up is never taken for one that drives forward, with wheels or without.

The vehicle is the Raptor as its vehicle file ships: encoders without an angle on the front wheels, which steer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
from support_filter import GPS_TIMING, IMU_TIMING, ORIGIN, WHEELS_TIMING, Run, Transform, drive, leave_unchanged
from support_restart import find_longest_misleading

from modelserver.config.vehicle_file import load_config
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.messages import Direction, VehicleStatusSample, Verdict, WheelSample, WheelsSample
from modelserver.server.vehicle import Vehicle, load_vehicle
from modelserver.simulation import (
    START_UTIME,
    DrivePhase,
    Event,
    GpsModel,
    ImuModel,
    Simulation,
    StatusModel,
    Trajectory,
    WheelsModel,
)

pytestmark = pytest.mark.slow

RAPTOR = Path(__file__).parents[3] / "config" / "raptor" / "vehicle.yaml"
AT_ONCE = DrivePhase(1e-3, -2.0)
CURVES_BACK = (
    AT_ONCE,
    DrivePhase(10.0),
    DrivePhase(2.0, curvature=0.15),
    DrivePhase(15.0),
    DrivePhase(2.0, curvature=-0.1),
    DrivePhase(20.0),
)
BRAKES_BACK = (
    AT_ONCE,
    DrivePhase(15.0),
    DrivePhase(2.0, -0.8),
    DrivePhase(5.0),
    DrivePhase(2.0, -2.0),
    DrivePhase(20.0),
)
STOPS_BACK = (AT_ONCE, DrivePhase(15.0), DrivePhase(2.0, 0.0), DrivePhase(5.0), DrivePhase(2.0, -2.0), DrivePhase(20.0))


@lru_cache(maxsize=1)
def load_raptor() -> Vehicle:
    return load_vehicle(load_config(RAPTOR), str(RAPTOR))


def drive_raptor(
    phases: tuple[DrivePhase, ...],
    seconds: float,
    seed: int = 1,
    *,
    wheels: bool = True,
    status: bool = True,
    transform: Transform = leave_unchanged,
) -> Run:
    """Drive the shipped Raptor; without `wheels` there are no samples of them, without `status` no angle."""
    vehicle, config = load_raptor(), load_raptor().config
    assert config.sensors.gps is not None
    assert config.sensors.imu is not None
    assert config.sensors.wheels is not None
    frames = config.sensors.wheels.frames
    run = Simulation(
        vehicle.model,
        config.rolling_frame,
        Trajectory((*phases, DrivePhase(2.0, 0.0, 0.0)), yaw=0.7),
        ORIGIN,
        gps_frame=config.sensors.gps.frame,
        imu_frame=config.sensors.imu.frame,
        wheel_frames=frames if wheels else None,
        seed=seed,
        gps_model=GpsModel(GPS_TIMING, correlated_sigma=0.3, white_sigma=0.05),
        imu_model=ImuModel(IMU_TIMING),
        wheels_model=WheelsModel(WHEELS_TIMING, steered=frozenset(frames)),
        status_model=StatusModel(1.5) if status else None,
    )
    prepared = vehicle.make_localizer_setup()
    assert prepared is not None

    def drop_angles(events: Iterable[Event]) -> Iterable[Event]:
        for event in transform(events):
            if isinstance(event, WheelsSample):
                event = replace(event, wheels=tuple(replace(each, steering=math.nan) for each in event.wheels))
            yield event

    return drive(
        run, seconds, transform=drop_angles, every=0.1, localizer=FilterLocalizer.start(prepared.setup, ORIGIN)
    )


def drop_direction(events: Iterable[Event]) -> Iterable[Event]:
    """Yield samples of encoders that count up in both directions, and do not measure which."""
    counted: dict[str, tuple[float, float]] = {}
    for event in events:
        if isinstance(event, WheelsSample):
            wheels = []
            for each in event.wheels:
                last, travel = counted.get(each.name, (each.travel, 0.0))
                travel += abs(each.travel - last)
                counted[each.name] = (each.travel, travel)
                wheels.append(
                    WheelSample(
                        each.name, travel, each.travel_sigma, abs(each.speed), each.speed_sigma, Direction.UNSIGNED
                    )
                )
            event = replace(event, wheels=tuple(wheels))
        yield event


def find_first_valid(run: Run) -> float:
    return next((row.t for row in run.rows if row.valid), math.inf)


def count_used_wheels(run: Run) -> tuple[int, int]:
    return len(run.decisions("wheel_speed", Verdict.USED)), len(run.decisions("wheel_speed"))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("status", [True, False])
def test_given_the_raptors_wheels_when_it_starts_rolling_backward_then_the_heading_is_right_at_once(status, seed):
    run = drive_raptor(CURVES_BACK, 25.0, seed, status=status)
    assert find_first_valid(run) < 7.0
    assert find_longest_misleading(run) <= 1.0
    assert max(abs(row.heading) for row in run.rows if row.valid) < math.radians(10.0)
    used, measured = count_used_wheels(run)
    assert used == measured > 40


@pytest.mark.parametrize("transform", [leave_unchanged, drop_direction])
@pytest.mark.parametrize("phases", [CURVES_BACK, BRAKES_BACK, STOPS_BACK])
def test_given_no_direction_when_it_rolls_backward_then_heading_waits_for_accelerations_and_is_right(phases, transform):
    run = drive_raptor(phases, 40.0, wheels=transform is drop_direction, status=False, transform=transform)
    # nothing is decided on the straight before the bend, the brakes or the stop
    assert 10.0 < find_first_valid(run) < 32.0
    assert find_longest_misleading(run) <= 1.0
    assert max(abs(row.heading) for row in run.rows if row.valid) < math.radians(25.0)
    if transform is drop_direction:
        used, measured = count_used_wheels(run)
        assert 0 < used < measured
        assert run.decisions("wheel_speed", Verdict.REJECTED, "direction")


@pytest.mark.parametrize("speed", [2.0, -2.0, -9.0])
def test_given_a_straight_at_steady_speed_without_a_direction_then_no_heading_is_valid_and_the_reason_is_found(speed):
    phases = (DrivePhase(1e-3, speed), DrivePhase(60.0))
    run = drive_raptor(phases, 30.0, wheels=False, status=False)
    assert find_first_valid(run) == math.inf
    found = run.localizer.summary(run.localizer.utime).findings
    assert "direction" in [each.reason for each in found]


def test_given_a_speed_that_no_vehicle_backs_up_with_then_it_drives_forward():
    run = drive_raptor((DrivePhase(1e-3, 11.0), DrivePhase(60.0)), 12.0, wheels=False, status=False)
    assert find_first_valid(run) < 8.0
    assert find_longest_misleading(run) <= 1.0


def test_given_a_raptor_that_drives_then_a_lost_and_a_wrong_steering_angle_do_no_harm():
    phases = (
        DrivePhase(4.0),
        DrivePhase(2.0, 3.0),
        *(DrivePhase(4.0, curvature=c) for c in (0.25, -0.25, 0.2, 0.0)),
        DrivePhase(9.0),
    )

    def corrupt_angles(events: Iterable[Event]) -> Iterable[Event]:
        for event in events:
            t = (event.header.utime - START_UTIME) * 1e-6
            if isinstance(event, VehicleStatusSample):
                if 10.0 < t < 14.0:
                    continue
                if t > 18.0:
                    event = replace(event, steering_angle=1.2)
            yield event

    run = drive_raptor(phases, 28.0, transform=corrupt_angles)
    used, measured = count_used_wheels(run)
    assert used == measured
    assert find_longest_misleading(run) <= 0.5
    assert {each.reason for each in run.ledger if each.kind == "steering"} == {"range"}
    assert [each.reason for each in run.localizer.summary(run.localizer.utime).findings] == ["steering"]
