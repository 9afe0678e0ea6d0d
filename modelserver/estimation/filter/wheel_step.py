"""Wheel sample: odometry, the zero-velocity update of a vehicle without an IMU, and the non-holonomic constraint.

The IMU bridges `wheel_period` between two comparisons of travel: errors of an encoder, a pulse or an update missed,
average out over a longer distance.
"""

from __future__ import annotations

import cmath
import math
from typing import Final

import numpy as np

from modelserver.estimation.filter import bank_step, eskf, leveling, propagation
from modelserver.estimation.filter.eskf import ZERO, Innovation, NavState
from modelserver.estimation.filter.fusion import (
    CONSTRAINT_PERIOD,
    NOTHING,
    ZUPT_PERIOD,
    Fused,
    Item,
    create_context,
    fuse_constraint,
    fuse_non_holonomic,
    hold_bias,
    hold_latency,
    reject,
    release_motion,
    remember,
    report_event,
)
from modelserver.estimation.filter.measurements import constraints
from modelserver.estimation.filter.measurements.wheels import (
    TurnRate,
    WheelSpeed,
    are_wheels_stationary,
    estimate_turn_rate,
)
from modelserver.estimation.filter.mount_monitor import MountMonitor
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, FilterState, Leveling, N, PreviousSample, Unaligned
from modelserver.estimation.filter.wheel_monitor import RECEIVED, SteeringAngle
from modelserver.messages import Decision, Mode, VehicleStatusSample, Verdict, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

SOURCE_TIMEOUT: Final = 2.0
"""Seconds of silence after which another source of wheels is used: the travel since a sample is that of one source."""

FORCE_AGE_US: Final = 50_000
"""Microseconds for which a measured force is that of a wheel sample."""

UNKNOWN_SPEED_SIGMA: Final = 2.0
"""Sigma of the horizontal speed, m/s, beyond which the speed is unknown: that of a walk."""

VAGUE_SPEED_SIGMA: Final = 0.1
VAGUE_DIRECTION: Final = 0.2
"""The same, and that as a share of the speed, beyond which the velocity has no direction that shows the heading."""


def fuse_wheels(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after a wheel sample."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, WheelsSample)
    assert isinstance(measurement, WheelSpeed)
    common, settings = state.common, setup.settings
    if common.mode is Mode.NO_WHEELS:
        return state, NOTHING
    in_use = common.previous.get((common.wheels.source, RECEIVED))
    if common.wheels.source != item.source and in_use and (item.utime - in_use.utime) * 1e-6 < SOURCE_TIMEOUT:
        return state, (reject(item, "source"),)
    compared = common.previous.get((item.source, item.kind))
    previous = _get_wheels(compared)
    received = _get_wheels(common.previous.get((item.source, RECEIVED)))
    are_stationary = are_wheels_stationary(sample, received, measurement.contacts, settings)
    detector = state.stationary
    if not common.wheels.is_suspect:
        detector = detector.update_wheels(item.utime, are_stationary)
    state = state._replace(stationary=detector, common=remember(common, (item.source, RECEIVED), item))
    has_imu = setup.uses_imu(common.mode)
    if isinstance(state, Leveling):
        return (state if has_imu else leveling.start_level(setup, state, item.utime)), NOTHING
    age = math.inf if compared is None else (item.utime - compared.utime) * 1e-6
    if has_imu and measurement.has_travel(sample, previous) and age < settings.wheel_period - 0.01:
        return state, NOTHING
    state = propagation.advance(setup, state, item.utime)
    state, decisions, is_first_speed = _fuse_speed(
        setup, state, item, measurement, sample, age, previous, are_stationary=are_stationary is True
    )
    if decisions and decisions[0].limit > 0.0:
        state, more = _judge(setup, state, item, decisions[0], are_stationary=are_stationary is True)
        decisions += more
    if state.reckoning.utime != item.utime:
        state = state._replace(reckoning=bank_step.predict_path(setup, state))
    nav = state.nav._replace(travel=ZERO, rotation=ZERO)
    state = state._replace(nav=nav, common=remember(state.common, (item.source, item.kind), item))
    if not (has_imu and propagation.is_imu_fresh(setup, state, item.utime)):
        state, more = _fuse_stationary(setup, state, item.utime, are_stationary is True)
        decisions += more
    # the first wheels that measure a speed leave the sideways speed to the constraint
    since = (item.utime - state.constraints.non_holonomic_utime) * 1e-6
    if not state.is_stationary and (is_first_speed or since >= 0.5 * CONSTRAINT_PERIOD):
        state, more = fuse_non_holonomic(setup, state, item.utime)
        decisions += more
    if isinstance(state, Aligned) and state.bank is not None:
        state, more = bank_step.advance(setup, state)
        decisions += more
    return state, decisions


def _fuse_speed(
    setup: Setup,
    state: N,
    item: Item,
    measurement: WheelSpeed,
    sample: WheelsSample,
    age: float,
    previous: WheelsSample | None,
    *,
    are_stationary: bool,
) -> tuple[N, tuple[Decision, ...], bool]:
    """Return the state after the update by the wheels, the decisions, and whether the speed was unknown before."""
    settings = setup.settings
    context = create_context(setup, state, age, previous)
    innovation = measurement.evaluate(context, sample)
    if isinstance(innovation, str):
        return state, ((reject(item, innovation),) if innovation else NOTHING), False
    if state.common.wheels.is_suspect:
        innovation = innovation._replace(monitored="stuck")
    is_first_speed = not innovation.monitored and _has_speed_sigma(context.nav, UNKNOWN_SPEED_SIGMA)
    if is_first_speed:
        # the wheels' error is a share of speed: linearize at the speed that they measure, not at 0
        nav = _set_speed(context.nav, innovation, setup.rig.base, min(age, settings.wheel_period))
        again = measurement.evaluate(context._replace(nav=nav), sample)
        if not isinstance(again, str):
            context, innovation = context._replace(nav=nav), again
    elif are_stationary or _has_speed_sigma(
        context.nav, max(VAGUE_SPEED_SIGMA, VAGUE_DIRECTION * math.hypot(*context.nav.velocity))
    ):
        # an error of the velocity must change neither heading nor scale: linearize at the one that the wheels measure
        before = context.nav.body_velocity(setup.rig.base)[0]
        speed = 0.0 if are_stationary else before + float(innovation.residual.mean())
        ahead = context.nav._replace(
            velocity=so3.rotate(context.nav.attitude, (speed, 0.0, 0.0)),
            travel=(speed * age if math.isfinite(age) else 0.0, 0.0, 0.0),
        )
        again = measurement.evaluate(context._replace(nav=ahead), sample)
        if not isinstance(again, str) and again.jacobian.shape == innovation.jacobian.shape:
            innovation = innovation._replace(jacobian=again.jacobian)
    nav, decision = eskf.update(context.nav, innovation, settings, item.utime, item.source, item.seq, item.kind)
    nav = hold_latency(context.nav, nav, setup.layout)
    has_gyro = setup.uses_imu(state.common.mode) and propagation.is_imu_fresh(setup, state, item.utime)
    if has_gyro and not are_stationary and len(innovation.residual) > 1:
        # two sides roll differently for good, by more than a gyro's bias
        nav = hold_bias(context.nav, nav)
    wheels = state.common.wheels
    if wheels.source != item.source:
        wheels = wheels._replace(source=item.source)
    mount = state.common.mount
    if has_gyro and item.utime - state.imu.used_utime < FORCE_AGE_US:
        mount = _compare_force(setup, context.nav, innovation, mount, item.utime)
    if decision.verdict is Verdict.USED:
        turn_rate = TurnRate(nav.angular_rate[2], settings.wheel_rate_sigma)
        if not has_gyro:
            turn_rate = estimate_turn_rate(sample, previous, measurement, settings, context.steering)
            state = state._replace(reckoning=propagation.follow_wheels(setup, state, item.utime, turn_rate))
        wheels = wheels._replace(used_utime=item.utime, turn_rate=turn_rate)
        if age < math.inf:
            missed = float(innovation.residual.mean()) * age
            distance = bank_step.get_wheel_travel(setup, context.nav) + missed
            # beyond the gate either the wheels are wrong or the state is
            variance = missed**2 if decision.reason else 0.0
            state = state._replace(reckoning=state.reckoning.drive(item.utime, distance, variance))
    common = state.common._replace(wheels=wheels, mount=mount)
    return state._replace(nav=nav, common=common), (decision,), is_first_speed


def _judge(
    setup: Setup, state: N, item: Item, decision: Decision, *, are_stationary: bool
) -> tuple[N, tuple[Decision, ...]]:
    """Return the state with what a sample shows of the wheels themselves."""
    nav, wheels = state.nav, state.common.wheels
    P = nav.covariance
    sigma = math.sqrt(max(P[3, 3], P[4, 4]))
    is_moving = math.hypot(*nav.velocity[:2]) > 3.0 * sigma
    ratio = decision.statistic / decision.limit
    is_used = decision.verdict is Verdict.USED
    judged = wheels.compare(ratio, is_used=is_used, are_stationary=are_stationary, is_moving=is_moving)
    state = state._replace(common=state.common._replace(wheels=judged))
    if judged.is_suspect == wheels.is_suspect:
        return state, NOTHING
    if not judged.is_suspect:
        if isinstance(state, Unaligned):
            # what carried it may have turned it
            state = state._replace(alignment=state.alignment._replace(fixes=()))
        return state, (report_event(state, item.kind, Verdict.USED, "the wheels measure the speed again"),)
    if state.is_stationary or judged.has_held:
        state = release_motion(state)
    if isinstance(state, Aligned):
        state = bank_step.distrust_path(setup, state)
    state = state._replace(stationary=state.stationary._replace(wheels_stationary=None))
    return state, (report_event(state, item.kind, Verdict.REJECTED, "the wheels are stuck"),)


def _compare_force(
    setup: Setup, nav: NavState, innovation: Innovation, mount: MountMonitor, utime: int
) -> MountMonitor:
    """Return the mount monitor after a wheel sample and the force at that time."""
    speed = nav.body_velocity(setup.rig.base)[0] + float(innovation.residual.mean())
    (fx, fy, fz), (bx, by, bz) = nav.force, nav.accelerometer_bias
    east, north, _ = so3.rotate(nav.attitude, (fx - bx, fy - by, fz - bz))
    force = complex(east, north) * cmath.rect(1.0, -nav.yaw)
    return mount.update(utime, speed, nav.angular_rate[2], force)


def _fuse_stationary(setup: Setup, state: N, utime: int, is_stationary: bool) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after ZUPT by wheels that are stationary: without an IMU they alone show it."""
    dt = (utime - state.constraints.zupt_utime) * 1e-6
    state = state._replace(constraints=state.constraints._replace(is_stationary=is_stationary))
    decisions = NOTHING
    is_due = dt >= ZUPT_PERIOD
    if is_stationary and is_due:
        innovation = constraints.zero_velocity(create_context(setup, state), dt)
        state, decision = fuse_constraint(setup, state, constraints.ZERO_VELOCITY, innovation)
        decisions = (decision,)
    if not is_stationary or is_due:
        state = state._replace(constraints=state.constraints._replace(zupt_utime=utime))
    return state, decisions


def _set_speed(nav: NavState, innovation: Innovation, base: Vector3, seconds: float) -> NavState:
    """Return a state of unknown speed at the speed that the wheels measure; all else and the covariance stay.

    `seconds` is the time since the last wheel sample: that distance was travelled at that speed too.
    """
    residual, H, R = innovation.residual, innovation.jacobian, innovation.noise
    try:
        error, _ = eskf.correct(nav.covariance, residual, H, R)
    except np.linalg.LinAlgError:
        return nav
    x, y, z = error[3:6].tolist()
    if not math.isfinite(x + y + z):
        return nav
    before = nav.body_velocity(base)
    vx, vy, vz = nav.velocity
    nav = nav._replace(velocity=(vx + x, vy + y, vz + z))
    a, b, c = nav.travel
    dx, dy, dz = (seconds * (new - old) for new, old in zip(nav.body_velocity(base), before, strict=True))
    return nav._replace(travel=(a + dx, b + dy, c + dz))


def _has_speed_sigma(nav: NavState, sigma: float) -> bool:
    """Return whether the standard deviation of the horizontal velocity is larger, m/s."""
    P = nav.covariance
    return float(P[3, 3] + P[4, 4]) > sigma**2


def _get_wheels(previous: PreviousSample | None) -> WheelsSample | None:
    return previous.sample if previous is not None and isinstance(previous.sample, WheelsSample) else None


def fuse_steering(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with the vehicle controller's steering angle; an angle out of range is rejected."""
    sample, signal = item.sample, setup.rig.steering
    assert isinstance(sample, VehicleStatusSample)
    assert signal is not None
    angle = sample.steering_angle
    if not math.isfinite(angle):
        return state, (reject(item, "nan"),)
    if abs(angle) > signal.limit:
        return state, (reject(item, "range"),)
    wheels = state.common.wheels._replace(steering=SteeringAngle(item.utime, angle))
    return state._replace(common=state.common._replace(wheels=wheels)), NOTHING
