"""IMU and wheel samples: they move the state, and show whether the vehicle is stationary.

IMU sample: leveling, or propagation, with the updates of a stationary vehicle (ZUPT, ZARU) and a rolling one (NHC). A
quiet IMU shows a stationary vehicle only if nothing contradicts it: wheels, fixes that move, the state's own speed.
Stationary for `recapture_time`, the mean rate recalibrates the gyro biases (ZARU). After a gap that loses the vertical
the filter levels again.

Wheel sample: odometry, the zero-velocity update of a vehicle without an IMU, and the non-holonomic constraint. The
IMU bridges `wheel_period` between two comparisons of travel: errors of an encoder, a pulse or an update missed,
average out over a longer distance.
"""

from __future__ import annotations

import cmath
import math
from typing import Final

import numpy as np

from modelserver.estimation.filter import bank_step, eskf, fusion, leveling, sensor_monitors
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
    report_reset,
)
from modelserver.estimation.filter.gnss_monitor import MOVING_TIME
from modelserver.estimation.filter.measurements.wheels import (
    ZERO_RATE,
    ZERO_VELOCITY,
    TurnRate,
    WheelSpeed,
    are_wheels_stationary,
    estimate_turn_rate,
    zero_rate,
    zero_velocity,
)
from modelserver.estimation.filter.sensor_monitors import (
    LARGEST_RATIO,
    RECEIVED,
    ImuMonitor,
    MountMonitor,
    SteeringAngle,
)
from modelserver.estimation.filter.state import (
    Aligned,
    FilterState,
    GyroBiases,
    Leveling,
    N,
    Navigating,
    PreviousSample,
    Setup,
    Unaligned,
)
from modelserver.messages import Decision, ImuSample, Mode, VehicleStatusSample, Verdict, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3, to_vector3

BIAS_AGE: Final = 600.0
"""Seconds for which gyro biases that a restart continues with may have drifted: few vehicles drive longer without a
stop."""

LARGEST_CONTRADICTION: Final = 0.4
CONTRADICTION_GAIN: Final = 0.1
"""Mean NIS of ZUPT, relative to its gate, of a vehicle that is not stationary, and the weight of one; usual is 0.1."""

CHANGED_SIGMAS: Final = 5.0
"""Standard deviations by which the mean rate of a stationary vehicle shows that a gyro's bias has changed."""

CHANGED_TIME: Final = 2.0
"""Seconds of that mean, at least."""

REST_SPEED_SIGMA: Final = 0.3
LONG_REST_TIME: Final = 5.0
"""Sigma of the speed, m/s, beyond which only seconds of a quiet IMU show a rest: braking may be as smooth."""

UNNOTICED_TIME: Final = 10.0
"""Seconds for which the heading may have turned by that change unnoticed: then fixes hold it."""

LOST_ATTITUDE_SIGMA: Final = 0.7
"""Sigma of the attitude, rad, beyond which a gap in the IMU makes the filter level again."""


def fuse_imu(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after an IMU sample."""
    sample = item.sample
    assert isinstance(sample, ImuSample)
    if state.common.mode is Mode.NO_IMU:
        return state, NOTHING
    if setup.yaw_gyro is not None:
        return _fuse_turn_rate(setup, state, item, sensor_monitors.read_turn_rate(sample, setup.yaw_gyro))
    values = sensor_monitors.read_imu(sample, setup.mount)
    if isinstance(values, str):
        return state, (reject(item, values),)
    rate, force = values
    utime, settings = item.utime, setup.settings
    assert sample.angular_velocity is not None
    imu = state.imu.update(utime, rate, force, state.imu.axes.update(sample.angular_velocity))
    if not state.stationary.since and imu.axes.is_dead(settings.gyro_noise, (utime - state.imu.utime) * 1e-6):
        imu = imu._replace(used_utime=state.imu.used_utime)
        return state._replace(imu=imu), (reject(item, "axis"),)
    # a sample that is like the one before it changed before
    if imu.changed_utime != utime and imu.get_frozen_time(utime) > settings.frozen_time:
        imu = imu._replace(used_utime=state.imu.used_utime)
        return state._replace(imu=imu), (reject(item, "frozen"),)
    decisions = NOTHING
    if (imu.num_collinear or imu.is_interpolated) and imu.seems_interpolated != imu.is_interpolated:
        imu = imu._replace(is_interpolated=imu.seems_interpolated)
        if not isinstance(state, Leveling):
            # the process noise changes from here on
            state = fusion.propagate_covariance(setup, state)
            state = state._replace(imu=state.imu._replace(is_interpolated=imu.is_interpolated))
        if imu.is_interpolated:
            decisions = (reject(item, "interpolated")._replace(verdict=Verdict.MONITORED),)
    if isinstance(state, Leveling):
        detector = state.stationary.update(utime, rate, force, ZERO, settings.gyro_bias_sigma, settings)
        leveled = leveling.level(setup, state._replace(imu=imu, stationary=detector), utime, rate, force)
        if isinstance(leveled, Leveling) and leveled.tilt and not leveled.num_samples:
            return leveled, (reject(item, "gravity" if math.isinf(leveled.tilt) else "mount"),)
        return leveled, NOTHING
    nav, used_utime = state.nav, state.imu.used_utime
    variance_of = nav.covariance.item
    bias_sigma = math.sqrt(max(variance_of(9, 9), variance_of(10, 10), variance_of(11, 11)))
    detector = state.stationary.update(utime, rate, force, nav.gyro_bias, bias_sigma, settings)
    if (utime - used_utime) * 1e-6 > settings.rate_hold and used_utime > 0:
        state = fusion.advance(setup, state, utime)
        if max(np.diagonal(state.nav.covariance)[6:9]) > LOST_ATTITUDE_SIGMA**2:
            restarted = Leveling(state.common.restart())
            return restarted, (report_reset(item, "leveling again after a gap in the IMU samples"),)
        decisions += (reject(item, "gap")._replace(verdict=Verdict.MONITORED),)
    state = fusion.propagate_imu(setup, state, utime, rate, force, detector, imu)
    state, more = _fuse_constraints(setup, state, utime)
    return state, decisions + more if more else decisions


def _fuse_turn_rate(setup: Setup, state: FilterState, item: Item, rate: float | str) -> Fused:
    """Return the state of a level vehicle after the turn rate of a gyro that measures nothing else.

    Roll and pitch follow the ground as without an IMU. While wheels are stationary the mean rate is the bias (ZARU).
    """
    if isinstance(rate, str):
        return state, (reject(item, rate),)
    utime, settings = item.utime, setup.settings
    measured = (0.0, 0.0, rate)
    imu = ImuMonitor(utime, measured, changed_utime=utime, used_utime=utime)
    if isinstance(state, Leveling):
        return leveling.start_level(setup, state, utime)._replace(imu=imu), NOTHING
    if fusion.measures_turn_rate(setup, state, utime):
        mean = (0.0, 0.0, 0.5 * (state.imu.rate[2] + rate))
        state = state._replace(imu=state.imu._replace(rate=mean))
    state = fusion.predict(setup, state, utime)
    nav = state.nav
    bias_sigma = math.sqrt(nav.covariance[11, 11])
    detector = state.stationary.update(utime, measured, ZERO, nav.gyro_bias, bias_sigma, settings)
    lag = nav.lag
    if lag >= eskf.COVARIANCE_STEP:
        nav = eskf.propagate_covariance(nav, fusion.select_noise(setup, state, nav), setup.layout)
        nav = nav.widen({11: settings.gyro_bias_walk**2 * lag})
    reckoning = fusion.follow_gyro(setup, state.reckoning, utime, rate)
    state = state._replace(nav=nav, imu=imu, stationary=detector, reckoning=reckoning)
    if not (
        state.is_stationary and detector.sum_time > 1.0 and detector.get_quiet_time(utime) >= settings.recapture_time
    ):
        return state, NOTHING
    state = fusion.propagate_covariance(setup, state)
    return _fuse_zero_rate(setup, state, slice(2, 3))


def _fuse_constraints(setup: Setup, state: N, utime: int) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after the updates without a sensor: those of a stationary vehicle, or of a rolling one."""
    settings, detector = setup.settings, state.stationary
    is_stationary = detector.get_quiet_time(utime) >= settings.stationary_time and _may_be_stationary(
        setup, state, utime
    )
    if is_stationary != state.constraints.is_stationary:
        state = fusion.propagate_covariance(setup, state)
        constraints_ = state.constraints._replace(
            is_stationary=is_stationary, zupt_utime=utime, rest_turn=ZERO, rest_time=0.0
        )
        state = state._replace(constraints=constraints_)
    if is_stationary:
        if (utime - state.constraints.zupt_utime) * 1e-6 < ZUPT_PERIOD:
            return state, NOTHING
        return _fuse_rest(setup, state, utime)
    if (utime - state.constraints.non_holonomic_utime) * 1e-6 < CONSTRAINT_PERIOD:
        return state, NOTHING
    wheels_utime = state.common.wheels.used_utime
    if wheels_utime and (utime - wheels_utime) * 1e-6 < settings.wheel_period + CONSTRAINT_PERIOD:
        return state, NOTHING  # the next wheel sample brings it
    return fuse_non_holonomic(setup, state, utime)


def _fuse_rest(setup: Setup, state: N, utime: int) -> tuple[N, tuple[Decision, ...]]:
    """Return the state of a stationary vehicle after ZUPT, and ZARU once it has been stationary for long enough."""
    dt = (utime - state.constraints.zupt_utime) * 1e-6
    state = fusion.propagate_covariance(setup, state)
    state = state._replace(constraints=state.constraints._replace(zupt_utime=utime))
    innovation = zero_velocity(create_context(setup, state), dt)
    state, decision = fuse_constraint(setup, state, ZERO_VELOCITY, innovation)
    decisions: tuple[Decision, ...] = (decision,)
    contradiction = state.constraints.contradiction
    contradiction += CONTRADICTION_GAIN * (min(decision.statistic / decision.limit, LARGEST_RATIO) - contradiction)
    state = state._replace(constraints=state.constraints._replace(contradiction=contradiction))
    if contradiction > LARGEST_CONTRADICTION and state.stationary.is_confirmed_by_wheels(utime):
        # wheels that are stuck, and it moves so smoothly that it seems stationary
        state = bank_step.suspect_wheels(setup, state)
        return state, (*decisions, report_event(state, ZERO_VELOCITY, Verdict.REJECTED, "it moves"))
    detector = state.stationary
    if detector.sum_time > 0.0:
        if detector.get_quiet_time(utime) >= setup.settings.recapture_time:
            state, more = _fuse_zero_rate(setup, state)
            if more[0].verdict is Verdict.USED:
                state = _store_biases(setup, state)
            return state, decisions + more
        state = state._replace(stationary=detector.restart_mean())
    return state, decisions


def _fuse_zero_rate(setup: Setup, state: N, axes: slice = slice(0, 3)) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after ZARU along the axes that the gyro measures, or with gyro biases that have changed."""
    detector = state.stationary
    mean_rate, seconds = detector.mean_stationary_rate, detector.sum_time
    whole = zero_rate(create_context(setup, state), mean_rate, state.earth.rotation, seconds)
    state, decisions = _check_biases(setup, state, whole, seconds)
    if not decisions:
        measured = Innovation(whole.residual[axes], whole.jacobian[axes], whole.noise[axes, axes])
        state, decision = fuse_constraint(setup, state, ZERO_RATE, measured)
        decisions = (decision,)
    return state._replace(stationary=detector.restart_mean()), decisions


def _check_biases(setup: Setup, state: N, innovation: Innovation, seconds: float) -> tuple[N, tuple[Decision, ...]]:
    """Return the state with new gyro biases where the mean rate at rest shows that they have changed.

    `innovation` is that of ZARU over the last `seconds`. The gate refuses a large change and follows a small one too
    slowly; wheels that are stationary exclude a ship that turns.
    """
    nav, rest = state.nav, state.constraints
    if not state.stationary.is_confirmed_by_wheels(nav.utime):
        return state._replace(constraints=rest._replace(rest_turn=ZERO, rest_time=0.0)), NOTHING
    rate = innovation.residual + np.array(nav.gyro_bias)
    turn, time = rest.rest_turn + rate * seconds, rest.rest_time + seconds
    state = state._replace(constraints=rest._replace(rest_turn=to_vector3(turn), rest_time=time))
    change = turn / time - np.array(nav.gyro_bias)
    variance = setup.settings.gyro_noise**2 / time
    P = nav.covariance
    if time < CHANGED_TIME or np.all(change**2 < CHANGED_SIGMAS**2 * (np.diagonal(P)[9:12] + variance)):
        return state, NOTHING
    # the mean may be from before it too
    nav = nav.forget(slice(9, 12), change**2 + variance)._replace(gyro_bias=to_vector3(turn / time))
    if isinstance(state, Aligned):
        nav = nav.widen({8: max(UNNOTICED_TIME * abs(change[2]), state.turns.allowance) ** 2})
    state = state._replace(nav=nav, constraints=rest._replace(rest_turn=ZERO, rest_time=0.0))
    text = f"the bias of a gyro has changed by {math.degrees(np.abs(change).max()):.2f} deg/s"
    return state, (report_event(state, ZERO_RATE, Verdict.RESET, text),)


def _store_biases(setup: Setup, state: N) -> N:
    """Return the state with its gyro biases stored for a restart, with the variance that they may drift by until then.

    Only biases found while stationary: they depend on nothing else in the state.
    """
    nav = state.nav
    variance = max(nav.covariance[k, k] for k in (9, 10, 11)) + setup.settings.gyro_bias_walk**2 * BIAS_AGE
    biases = GyroBiases(nav.gyro_bias, math.sqrt(variance))
    return state._replace(common=state.common._replace(gyro_biases=biases))


def _may_be_stationary(setup: Setup, state: Navigating, utime: int) -> bool:
    """Return whether nothing contradicts a stationary vehicle: wheels, fixes that move, the state's own speed."""
    settings, nav, common = setup.settings, state.nav, state.common
    speed = math.hypot(*nav.velocity)
    P = nav.covariance
    sigma = math.sqrt(max(P.item(3, 3), P.item(4, 4)))
    if common.mode is not Mode.NO_WHEELS and state.stationary.is_confirmed_by_wheels(utime):
        # stuck wheels on a smooth road look the same: then fixes have kept the speed
        return not isinstance(state, Aligned) or speed - 4.0 * sigma < 10.0 * settings.stationary_speed
    if utime < common.moving_until:
        return False
    if state.is_stationary:
        return speed < 10.0 * settings.stationary_speed
    if not isinstance(state, Aligned) and sigma > 1.0:
        # the speed is unknown: a quiet IMU and fixes that stay in place are all there is
        fix = state.alignment.last_fix
        return fix is not None and (utime - fix.utime) * 1e-6 < MOVING_TIME
    if sigma > REST_SPEED_SIGMA and state.stationary.get_quiet_time(utime) < LONG_REST_TIME:
        return False
    return speed - 2.0 * sigma < settings.stationary_speed and speed < 0.5


# --- wheels -------------------------------------------------------------------------------------------------

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
    state = fusion.advance(setup, state, item.utime)
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
    if not (has_imu and fusion.is_imu_fresh(setup, state, item.utime)):
        state, more = _fuse_wheels_at_rest(setup, state, item.utime, are_stationary is True)
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
    has_gyro = setup.uses_imu(state.common.mode) and fusion.is_imu_fresh(setup, state, item.utime)
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
            state = state._replace(reckoning=fusion.follow_wheels(setup, state, item.utime, turn_rate))
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


def _fuse_wheels_at_rest(setup: Setup, state: N, utime: int, is_stationary: bool) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after ZUPT by wheels that are stationary: without an IMU they alone show it."""
    dt = (utime - state.constraints.zupt_utime) * 1e-6
    state = state._replace(constraints=state.constraints._replace(is_stationary=is_stationary))
    decisions = NOTHING
    is_due = dt >= ZUPT_PERIOD
    if is_stationary and is_due:
        innovation = zero_velocity(create_context(setup, state), dt)
        state, decision = fuse_constraint(setup, state, ZERO_VELOCITY, innovation)
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
