"""Wheels that steer: by their contact point's speed, by the vehicle controller's angle, and without a direction."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from support_cart import BASE, IMU, SITE, WHEELS, model, some_nav
from support_filter import ORIGIN, drive, simulation
from support_restart import TO_A_STOP, skip_samples

from modelserver.estimation.filter import localizer
from modelserver.estimation.filter.eskf import Earth, NavState
from modelserver.estimation.filter.fusion import get_steering_angle, split_sample
from modelserver.estimation.filter.hypothesis_bank import DeadReckoning
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.measurements import Innovation, MeasurementContext
from modelserver.estimation.filter.measurements.wheels import WheelSpeed, are_wheels_stationary, estimate_turn_rate
from modelserver.estimation.filter.sensor_monitors import ImuMonitor, StationaryDetector, SteeringAngle, WheelMonitor
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Aligned, Common, FilterState, MotionConstraints, Setup
from modelserver.estimation.sensor_rig import Kinematics, SensorRig, SteeringSignal, find_unusable
from modelserver.messages import (
    Direction,
    Mode,
    RestoredState,
    SensorHeader,
    VehicleStatusSample,
    Verdict,
    WheelSample,
    WheelsSample,
)
from modelserver.simulation import START_UTIME, DrivePhase
from modelserver.transforms import so3
from modelserver.transforms.so3 import cross

SETTINGS = FilterSettings()
FRONT = ("FL", "FR")
SIGNAL = SteeringSignal(FRONT)
CERTAIN, UNCERTAIN = 1e-9, 900.0


def cart(
    wheels: tuple[str, ...] = FRONT, signal: SteeringSignal | None = None, kinematics: Kinematics = "ackermann"
) -> SensorRig:
    return SensorRig(model(), BASE, IMU, "", "", {name: WHEELS[name] for name in wheels}, kinematics, steering=signal)


def create_moving_nav(setup: Setup, speed: float, turn: float, variance: float) -> NavState:
    """Return the cart at a speed (m/s) along x, turning (rad/s), tilted and with biases, with a variance."""
    nav = some_nav(setup, 5, extras=False)
    a, b, _ = nav.gyro_bias
    nav = nav._replace(rate=(a, b, turn + nav.gyro_bias[2]), covariance=np.eye(setup.layout.size) * variance)
    arm = cross(nav.angular_rate, setup.rig.base)
    velocity = so3.rotate(nav.attitude, (speed - arm[0], -arm[1], -arm[2]))
    return nav._replace(velocity=velocity)


def compute_contact_speeds(nav: NavState, rig: SensorRig, names: tuple[str, ...] = FRONT) -> dict[str, float]:
    """Return the speed of each contact point over the ground, with the sign of its forward part."""
    found = {}
    for name in names:
        x, y, _ = np.add(nav.body_velocity(rig.base), np.cross(nav.angular_rate, rig.pose(WHEELS[name]).xyz)).tolist()
        found[name] = math.copysign(math.hypot(x, y), x)
    return found


def create_sample(speeds: dict[str, float], utime: int = START_UTIME, **more: object) -> WheelsSample:
    wheels = tuple(
        WheelSample(name, speed=speed, **{"steering": math.nan, **more})  # type: ignore[arg-type]
        for name, speed in speeds.items()
    )
    return WheelsSample(SensorHeader(utime, "wheels"), wheels)


def evaluate(setup: Setup, nav: NavState, measured: WheelsSample, steering: float = math.nan) -> Innovation | str:
    assert setup.wheels is not None
    return setup.wheels.evaluate(
        MeasurementContext(nav, setup.layout, SETTINGS, setup.rig, steering=steering), measured
    )


def differentiate(setup: Setup, nav: NavState, measured: WheelsSample, steering: float = math.nan) -> np.ndarray:
    columns = []
    for k in range(setup.layout.size):
        error = np.zeros(setup.layout.size)
        error[k] = 1e-6
        ahead, behind = (
            evaluate(setup, nav.inject(sign * error, nav.covariance), measured, steering) for sign in (1, -1)
        )
        assert isinstance(ahead, Innovation)
        assert isinstance(behind, Innovation)
        columns.append((behind.residual - ahead.residual) / 2e-6)
    return np.array(columns).T


# --- the measurement ---


@pytest.mark.parametrize("speed", [3.0, -3.0, 0.8, -0.8])
@pytest.mark.parametrize("turn", [0.0, 0.25, -0.4])
def test_given_no_angle_and_a_known_course_then_the_wheel_measures_the_speed_of_the_contact_point(speed, turn):
    setup = Setup(cart(), SETTINGS)
    nav = create_moving_nav(setup, speed, turn * abs(speed), CERTAIN)
    measured = create_sample(compute_contact_speeds(nav, setup.rig))
    found = evaluate(setup, nav, measured)
    assert isinstance(found, Innovation)
    assert np.abs(found.residual).max() < 1e-6
    assert differentiate(setup, nav, measured) == pytest.approx(found.jacobian, abs=1e-4)
    assert np.linalg.eigvalsh(found.noise)[0] > 0.0
    # the sign is that of the encoder: rolling in the other direction contradicts the state
    other = evaluate(
        setup, nav, create_sample({name: -v for name, v in compute_contact_speeds(nav, setup.rig).items()})
    )
    assert isinstance(other, Innovation)
    assert np.abs(other.residual).min() > 1.5 * abs(speed)


@pytest.mark.parametrize("variance", [CERTAIN, 1e-4, 0.01, 1.0, UNCERTAIN])
def test_given_any_speed_through_zero_then_residual_and_jacobian_stay_finite_and_continuous(variance):
    setup = Setup(cart(), SETTINGS)
    rows = []
    for speed in (-0.02, -1e-3, -1e-5, 0.0, 1e-5, 1e-3, 0.02):
        nav = create_moving_nav(setup, speed, 0.0, variance)
        found = evaluate(setup, nav, create_sample({"FL": speed, "FR": speed}))
        assert isinstance(found, Innovation)
        assert np.isfinite(found.residual).all()
        assert np.isfinite(found.noise).all()
        assert np.abs(found.residual).max() < 0.02
        rows.append(found.jacobian)
    assert max(np.abs(a - b).max() for a, b in pairwise(rows)) < 0.05


def test_given_an_unknown_course_then_the_noise_covers_the_whole_range_of_the_steering():
    setup = Setup(cart(), SETTINGS)
    nav = create_moving_nav(setup, 2.0, 0.0, UNCERTAIN)
    found = evaluate(setup, nav, create_sample({"FL": 2.0, "FR": 2.0}))
    certain = evaluate(setup, create_moving_nav(setup, 2.0, 0.0, CERTAIN), create_sample({"FL": 2.0, "FR": 2.0}))
    assert isinstance(found, Innovation)
    assert isinstance(certain, Innovation)
    # at 30 degrees of lock a wheel rolls at 2 m/s while the vehicle moves at 1.73 m/s: within two sigmas
    assert 2.0 * math.sqrt(found.noise[0, 0]) > 0.27
    assert math.sqrt(certain.noise[0, 0]) < 0.05


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_given_an_encoder_without_a_direction_then_the_sign_is_that_of_the_state(speed):
    setup = Setup(cart(), SETTINGS)
    nav = create_moving_nav(setup, speed, 0.3, 0.01)
    sizes = {name: abs(v) for name, v in compute_contact_speeds(nav, setup.rig).items()}
    found = evaluate(setup, nav, create_sample(sizes, direction=Direction.UNSIGNED))
    assert isinstance(found, Innovation)
    assert np.abs(found.residual).max() < 0.02
    # they do not give the direction to a state that does not know it
    nav = create_moving_nav(setup, speed, 0.3, 1.0)
    assert evaluate(setup, nav, create_sample(sizes, direction=Direction.UNSIGNED)) == "direction"
    # that they are stationary is a measurement in either case
    stationary = evaluate(
        setup,
        create_moving_nav(setup, 0.0, 0.0, 1.0),
        create_sample({"FL": 0.01, "FR": 0.0}, direction=Direction.UNSIGNED),
    )
    assert isinstance(stationary, Innovation)


def test_given_a_skid_steered_vehicle_then_a_wheel_with_an_unknown_angle_is_dropped_with_the_reason():
    setup = Setup(cart(kinematics="skid_steer"), SETTINGS)
    assert (
        evaluate(setup, create_moving_nav(setup, 2.0, 0.0, CERTAIN), create_sample({"FL": 2.0, "FR": 2.0}))
        == "steering"
    )


def test_given_wheels_that_steer_then_they_measure_whether_the_vehicle_is_stationary():
    contacts = dict.fromkeys(FRONT, (1.2, 0.0, 0.0))
    assert are_wheels_stationary(create_sample({"FL": 0.0, "FR": 0.01}), None, contacts, SETTINGS) is True
    assert are_wheels_stationary(create_sample({"FL": 0.0, "FR": 0.3}), None, contacts, SETTINGS) is False
    sizes = create_sample({"FL": 0.3, "FR": 0.3}, direction=Direction.UNSIGNED)
    assert are_wheels_stationary(sizes, None, contacts, SETTINGS) is False


@pytest.mark.parametrize("speed", [2.0, -1.0])
@pytest.mark.parametrize("curvature", [0.0, 0.1, -0.3])
def test_given_two_wheels_without_angles_then_they_measure_the_turn_rate(speed, curvature):
    rig = cart()
    wheel_speed = WheelSpeed.create(rig, SETTINGS)
    assert wheel_speed is not None
    speeds = {}
    for name in FRONT:
        x, y, _ = rig.pose(WHEELS[name]).xyz
        speeds[name] = speed * math.hypot(1.0 - curvature * y, curvature * x)
    found = estimate_turn_rate(create_sample(speeds), None, wheel_speed, SETTINGS)
    assert found.value == pytest.approx(speed * curvature, abs=0.01)


# --- the controller's steering angle ---


def create_aligned(nav: NavState, steering: SteeringAngle) -> Aligned:
    """Return an aligned state with a steering angle."""
    common = Common(wheels=WheelMonitor(steering=steering))
    return Aligned(nav, ImuMonitor(), StationaryDetector(), DeadReckoning(), MotionConstraints(), common, Earth(), SITE)


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.5])
def test_given_the_axles_angle_then_each_wheel_points_along_its_own_circle(angle):
    contacts = {name: cart().pose(WHEELS[name]).xyz for name in FRONT}
    found = SIGNAL.wheel_angles(angle, contacts)
    for name, wheel_angle in found.items():
        x, y, _ = contacts[name]
        # perpendicular to the line from the turning center, which is on the line of the rear axle
        center = 1.2 / math.tan(angle) if angle else math.inf
        assert wheel_angle == pytest.approx(math.atan(x / (center - y)) if angle else 0.0)
    parallel = replace(SIGNAL, geometry="parallel").wheel_angles(angle, contacts)
    assert parallel == {"FL": angle, "FR": angle}


def test_given_the_angle_of_the_controller_then_the_wheels_measure_along_it_with_its_sigma():
    setup = Setup(cart(signal=SIGNAL), SETTINGS)
    speed, curvature = 2.0, 0.2
    nav = create_moving_nav(setup, speed, speed * curvature, CERTAIN)
    measured = create_sample(compute_contact_speeds(nav, setup.rig))
    angle = math.atan(1.2 * curvature)
    found = evaluate(setup, nav, measured, angle)
    assert isinstance(found, Innovation)
    assert np.abs(found.residual).max() < 0.02
    assert differentiate(setup, nav, measured, angle) == pytest.approx(found.jacobian, abs=1e-5)
    # a wheel that is steered against its course slides: the residual shows it, and the noise includes the sigma
    askew = evaluate(setup, nav, measured, angle + 0.3)
    assert isinstance(askew, Innovation)
    assert np.abs(askew.residual).min() > 0.05
    assert askew.noise[0, 0] > found.noise[0, 0]


def create_status(utime: int, angle: float) -> VehicleStatusSample:
    return VehicleStatusSample(SensorHeader(utime, "raptor"), steering_angle=angle)


def test_given_angles_that_are_stale_none_or_out_of_range_then_they_are_not_used():
    setup = Setup(cart(signal=SIGNAL), SETTINGS)
    state: FilterState = localizer.start(Mode.FULL, None)
    for angle, reason in ((0.2, ""), (math.nan, "nan"), (0.9, "range"), (-0.71, "range")):
        (item,) = split_sample(setup, create_status(START_UTIME, angle))
        state, decisions = localizer.step(setup, state, item)
        assert [each.reason for each in decisions] == ([reason] if reason else [])
        assert state.common.wheels.steering == SteeringAngle(START_UTIME, 0.2)
    assert split_sample(Setup(cart(), SETTINGS), create_status(START_UTIME, 0.2)) == []


def test_given_an_angle_that_becomes_stale_then_the_wheels_use_the_speed_of_their_contact_points():
    setup = Setup(cart(signal=SIGNAL), SETTINGS)
    nav = create_moving_nav(setup, 2.0, 0.0, CERTAIN)
    state = create_aligned(nav, SteeringAngle(nav.utime - 150_000, 0.2))
    assert get_steering_angle(setup, state) == 0.2
    state = create_aligned(nav, SteeringAngle(nav.utime - 250_000, 0.2))
    assert math.isnan(get_steering_angle(setup, state))


# --- what cannot be used ---


def test_given_configurations_that_cannot_be_used_then_each_is_reported_with_its_key():
    def list_findings(rig: SensorRig, mode: Mode = Mode.FULL) -> list[tuple[str, str]]:
        return [(each.reason, each.element) for each in find_unusable(rig, mode)]

    steering, frames = "sensors.wheels.steering", "sensors.wheels.frames"
    assert list_findings(cart(signal=SIGNAL)) == []
    assert list_findings(cart(signal=SIGNAL), Mode.NO_WHEELS) == [("mode", "localization.mode")]
    assert list_findings(cart(signal=SIGNAL, kinematics="skid_steer")) == [("kinematics", steering)]
    assert list_findings(cart(("FL", "RR"), SIGNAL)) == [("names", f"{steering}.wheels")]
    rear = cart(("RL", "RR"), SteeringSignal(("RL", "RR")))
    assert list_findings(rear) == [("wheelbase", steering)]
    assert list_findings(cart(("RL", "RR"), SteeringSignal(("RL", "RR"), "parallel"))) == []
    assert list_findings(cart(("FL",))) == [("single", frames)]
    assert list_findings(replace(cart(()), has_wheels=True)) == [("frames", frames)]
    assert list_findings(SensorRig(model(), BASE, "", "Cart:Antenna")) == [("alone", "sensors.gps")]
    assert list_findings(SensorRig(model(), BASE, IMU, "Cart:Antenna", "Cart:Antenna")) == [
        ("baseline", "sensors.gps.second_frame")
    ]
    assert all(each.text and each.fix for each in find_unusable(rear, Mode.FULL))


# --- warm start ---


@lru_cache(maxsize=1)
def _create_transform():
    def transform(events):
        for event in events:
            if isinstance(event, WheelsSample):
                event = replace(event, wheels=tuple(replace(each, steering=math.nan) for each in event.wheels))
            yield event

    return transform


@pytest.mark.slow
def test_given_wheels_that_steer_when_the_service_restarts_then_they_show_that_the_vehicle_did_not_move():
    run = drive(simulation((*TO_A_STOP, DrivePhase(200.0))), 40.0, transform=_create_transform())
    used = run.decisions("wheel_speed", Verdict.USED)
    assert len(used) == len(run.decisions("wheel_speed")) > 50
    persisted = run.localizer.get_state_to_persist()
    skip_samples(run.simulation, 4.0)
    restarted = FilterLocalizer.start(Setup(run.localizer.setup.rig), ORIGIN, Mode.FULL, RestoredState(persisted, 4.0))
    again = drive(run.simulation, 8.0, localizer=restarted, transform=_create_transform(), every=0.1)
    assert any(word.reason.startswith("warm start: the pose stored") for word in again.decisions("warm_start"))
    assert again.last.valid
    assert abs(again.last.heading) < math.radians(2.0)
