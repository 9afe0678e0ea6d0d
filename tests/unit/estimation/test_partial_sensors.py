"""Sensors as they come: fields that nobody fills, wheels with travel or speed alone, one speed, a turn rate alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest
from support_filter import RIG, Run, Transform, drive, simulation

from modelserver.estimation.filter.gnss_monitor import (
    CARRIER_LIMIT,
    CLASS_FIXES,
    CORRECTED_LIMIT,
    MIN_UNFILLED,
    PLAIN_LIMIT,
    ReceiverMonitor,
)
from modelserver.estimation.filter.settings import SharedSettings
from modelserver.estimation.inputs import evaluate_fix
from modelserver.estimation.sensor_rig import SPEEDOMETER, SensorRig, SpeedometerSignal, find_unusable
from modelserver.messages import (
    FixType,
    GpsSample,
    ImuSample,
    Mode,
    Phase,
    SensorHeader,
    Verdict,
    WheelsSample,
)
from modelserver.simulation import DrivePhase, Event, Simulation, StatusModel
from modelserver.wire.codec import decode, encode

NAN = math.nan
SECONDS = 44.0
PHASES = (
    DrivePhase(4.0, 0.0, 0.0),
    DrivePhase(3.0, 4.0),
    DrivePhase(6.0),
    DrivePhase(2.0, curvature=0.1),
    DrivePhase(6.0),
    DrivePhase(2.0, curvature=-0.1),
    DrivePhase(10.0),
    DrivePhase(3.0, 0.0, 0.0),
    DrivePhase(5.0),
)
COVARIANCE = (0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.5)


def drive_with_wheels() -> Simulation:
    return simulation(PHASES)


def drive_with_status() -> Simulation:
    return simulation(PHASES, wheel_frames=None, status_model=StatusModel(1.5))


def change(kind: type, function: Callable[..., Event]) -> Transform:
    """Return a transform that changes the samples of a kind."""

    def transform(events: Iterable[Event]) -> Iterable[Event]:
        return (function(event) if isinstance(event, kind) else event for event in events)

    return transform


def change_wheels(**fields: float) -> Transform:
    return change(
        WheelsSample, lambda sample: replace(sample, wheels=tuple(replace(each, **fields) for each in sample.wheels))
    )


def list_findings(run: Run) -> list[str]:
    return [each.reason for each in run.localizer.summary(run.localizer.utime).findings if not each.is_choice]


LONGER, STOP = 24.0, 35.0


def assert_good(run: Run, heading_deg: float = 4.5, since: float = 9.0, until: float = 45.0) -> None:
    """Check that the pose is valid and right from some time on, s: without a vertical the heading takes longer."""
    rows = run.between(since, until)
    assert all(row.valid for row in rows)
    assert max(row.off for row in rows) < 2.5
    assert max(abs(math.degrees(row.heading)) for row in rows) < heading_deg


# --- wheels ---


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.FULL, Mode.NO_IMU])
@pytest.mark.parametrize("missing", ["speed", "travel"])
def test_given_travel_or_speed_alone_then_the_pose_is_that_of_both(mode, missing):
    transform = change_wheels(**{missing: NAN, f"{missing}_sigma": NAN})
    found = drive(drive_with_wheels(), SECONDS, transform=transform, mode=mode)
    assert_good(found, since=9.0 if mode is Mode.FULL else LONGER)
    assert found.decisions("wheel_speed", Verdict.REJECTED) == []


# --- one speed ---


SPEEDOMETER_RIG = replace(RIG, wheel_frames={SPEEDOMETER: "Car:Base"}, speedometer=SpeedometerSignal())


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "heading_deg"), [(Mode.FULL, 1.0), (Mode.NO_IMU, 14.0)])
def test_given_the_speed_of_the_controller_then_it_is_used_like_a_wheel(mode, heading_deg):
    found = drive(drive_with_status(), SECONDS, on=SPEEDOMETER_RIG, mode=mode)
    if mode is Mode.FULL:
        assert_good(found, heading_deg)
    else:
        assert_good(found, heading_deg, LONGER, STOP)
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in found.between(9.0))
    assert len(found.decisions("wheel_speed", Verdict.USED)) > 0.9 * len(found.decisions("wheel_speed")) > 0.0
    assert len(found.decisions("zero_velocity", Verdict.USED)) > 10


def test_given_one_speed_then_the_configuration_states_what_it_is_used_for():
    def find(rig: SensorRig, mode: Mode = Mode.FULL) -> list[tuple[str, str, bool]]:
        return [(each.sensor, each.reason, each.is_choice) for each in find_unusable(rig, mode)]

    assert find(SPEEDOMETER_RIG) == [("speedometer", "single", True)]
    without_imu = replace(SPEEDOMETER_RIG, imu_frame="")
    assert find(without_imu) == [("speedometer", "single", False)]
    one_wheel = replace(RIG, wheel_frames={"left": "Car:Left"})
    assert find(one_wheel) == [("wheels", "single", True)]
    assert find(one_wheel, Mode.NO_IMU) == [("imu", "mode", True), ("wheels", "single", False)]


# --- turn rate alone ---


YAW_RIG = replace(RIG, imu_frame="", yaw_gyro_frame="Car:Imu")


def keep_turn_rate(sample: ImuSample) -> ImuSample:
    """Return the sample of a gyro with the axis that is up in the vehicle, as it arrives on the bus."""
    assert sample.angular_velocity is not None
    rate = (NAN, sample.angular_velocity[1], NAN)
    received = decode("imu_t", encode(ImuSample(sample.header, rate)))
    assert isinstance(received, ImuSample)
    return received


@pytest.mark.slow
def test_given_a_turn_rate_alone_then_the_heading_is_better_than_without_it():
    transform = change(ImuSample, keep_turn_rate)
    found = drive(drive_with_wheels(), SECONDS, on=YAW_RIG, transform=transform)
    assert_good(found, 2.0, LONGER)
    without = drive(drive_with_wheels(), SECONDS, mode=Mode.NO_IMU)

    def worst(run: Run) -> float:
        return max(abs(row.heading) for row in run.between(9.0))

    assert worst(found) < 0.6 * worst(without)
    # its bias is found while the wheels are stationary
    assert len(found.decisions("zero_rate", Verdict.USED)) >= 2
    assert found.localizer.head.nav.covariance[11, 11] < 1e-6


@pytest.mark.slow
def test_given_a_turn_rate_and_one_speed_then_both_are_used():
    rig = replace(SPEEDOMETER_RIG, imu_frame="", yaw_gyro_frame="Car:Imu")
    found = drive(drive_with_status(), SECONDS, on=rig, transform=change(ImuSample, keep_turn_rate))
    assert_good(found, 2.0, LONGER)


@pytest.mark.slow
def test_given_a_turn_rate_alone_where_a_whole_imu_is_configured_then_the_reason_is_counted():
    found = drive(drive_with_wheels(), SECONDS, transform=change(ImuSample, keep_turn_rate))
    assert found.localizer.summary(0).phase is Phase.LEVELING
    assert {each.reason for each in found.ledger if each.kind == "inertial"} == {"no_force"}


def test_given_a_turn_rate_alone_then_the_configuration_states_what_it_is_used_for():
    def find(mode: Mode, rig: SensorRig = YAW_RIG) -> list[tuple[str, bool]]:
        return [(each.reason, each.is_choice) for each in find_unusable(rig, mode)]

    assert find(Mode.FULL) == [("yaw_rate", True)]
    assert ("mode", False) in find(Mode.RAW)
    assert YAW_RIG.yaw_gyro is not None
    assert (YAW_RIG.yaw_gyro.axis, YAW_RIG.yaw_gyro.share) == (1, pytest.approx(1.0))
    assert find(Mode.FULL, replace(YAW_RIG, yaw_gyro_frame="Car:Camera")) == [("yaw_rate", True)]


# --- fields of a fix that nobody fills ---


def zero_velocity(sample: GpsSample) -> GpsSample:
    return replace(sample, velocity=(0.0, 0.0, 0.0), velocity_covariance=(0.0,) * 9)


@pytest.mark.slow
def test_given_a_velocity_that_nobody_fills_then_it_is_not_used_and_reported():
    alone = change(GpsSample, lambda sample: replace(zero_velocity(sample), speed=NAN, course=NAN))
    # without wheels a heading must be known better, and fixes show it later
    for mode, known in ((Mode.FULL, 12.0), (Mode.NO_WHEELS, 28.0)):
        found = drive(drive_with_wheels(), SECONDS, mode=mode, transform=alone)
        assert {each.reason for each in found.decisions("gps_velocity")} == {"unfilled"}
        assert list_findings(found) == ["unfilled"]
        assert all(row.valid for row in found.between(known))
    # the course and speed beside it are used
    found = drive(drive_with_wheels(), SECONDS, transform=change(GpsSample, zero_velocity))
    assert found.decisions("gps_velocity", Verdict.REJECTED) == []
    assert len(found.decisions("gps_velocity", Verdict.USED)) > 80
    assert list_findings(found) == []


@pytest.mark.slow
def test_given_a_receiver_that_measures_velocity_then_its_zeros_at_rest_are_no_fault():
    def clamp(sample: GpsSample) -> GpsSample:
        assert sample.velocity is not None
        return zero_velocity(sample) if math.hypot(*sample.velocity) < 0.3 else sample

    found = drive(drive_with_wheels(), SECONDS, transform=change(GpsSample, clamp))
    assert_good(found, 1.0)
    assert found.decisions("gps_velocity", reason="unfilled") == []
    assert list_findings(found) == []


def create_fix(fix_type: FixType = FixType.NONE, **fields: object) -> GpsSample:
    return GpsSample(SensorHeader(1, "gps"), fix_type, 50.0, -111.0, satellites=0, **fields)  # type: ignore[arg-type]


def test_given_fixes_without_a_type_then_they_are_used_by_their_covariance_until_one_has_a_type():
    settings, stated = SharedSettings(), create_fix(position_covariance=COVARIANCE)
    assert evaluate_fix(stated, settings) == "no_fix"
    fix = evaluate_fix(stated, settings, True)
    assert not isinstance(fix, str)
    assert fix.east_variance == 0.25
    assert evaluate_fix(create_fix(), settings, True) == "no_fix"
    assert evaluate_fix(create_fix(position_covariance=(0.0,) * 9), settings, True) == "no_fix"
    assert evaluate_fix(stated, SharedSettings(minimum_fix_type=2), True) == "no_fix"
    monitor = ReceiverMonitor()
    assert monitor.update(stated) is monitor
    assert monitor.may_use(stated)
    typed = monitor.update(create_fix(FixType.FIX_3D))
    assert not typed.may_use(stated)


@pytest.mark.slow
def test_given_fixes_without_a_type_when_driven_then_the_pose_is_right():
    untyped = change(GpsSample, lambda sample: replace(sample, fix_type=FixType.NONE, satellites=0))
    assert_good(drive(drive_with_wheels(), SECONDS, transform=untyped), 1.0)


def test_given_zeros_of_a_velocity_then_they_are_unfilled_until_another_number_comes():
    zero, moving = create_fix(velocity=(0.0, 0.0, 0.0)), create_fix(velocity=(0.0, 0.1, 0.0))
    monitor = ReceiverMonitor().update(zero)
    assert monitor.is_unfilled(zero)
    assert not monitor.is_unfilled(moving)
    for _ in range(MIN_UNFILLED):
        assert not monitor.lacks_velocity
        monitor = monitor.count_unfilled()
    assert monitor.lacks_velocity
    monitor = monitor.update(moving)
    assert not monitor.lacks_velocity
    assert not monitor.is_unfilled(zero)


@pytest.mark.parametrize(
    ("fix_type", "limit"),
    [
        (FixType.FIX_3D, PLAIN_LIMIT),
        (FixType.DIFFERENTIAL, CORRECTED_LIMIT),
        (FixType.RTK_FLOAT, CARRIER_LIMIT),
        (FixType.RTK_FIXED, CARRIER_LIMIT),
        (FixType.DEAD_RECKONING, PLAIN_LIMIT),
    ],
)
def test_given_many_fixes_of_a_type_in_a_row_then_the_limit_is_that_of_the_class(fix_type, limit):
    monitor = ReceiverMonitor()
    for _ in range(CLASS_FIXES - 1):
        assert monitor.horizontal_limit == PLAIN_LIMIT
        monitor = monitor.update(create_fix(fix_type))
    interrupted = monitor.update(create_fix(FixType.FIX_3D)).update(create_fix(fix_type))
    assert interrupted.horizontal_limit == PLAIN_LIMIT
    monitor = monitor.update(create_fix(fix_type))
    assert monitor.horizontal_limit == limit
    assert monitor.update(create_fix(FixType.FIX_3D)).horizontal_limit == limit
