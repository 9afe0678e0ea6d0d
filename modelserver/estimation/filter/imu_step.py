"""IMU sample: leveling, or propagation, with the updates of a stationary vehicle (ZUPT, ZARU) and a rolling one (NHC).

A quiet IMU shows a stationary vehicle only if nothing contradicts it: wheels, fixes that move, the state's own speed.
Stationary for `recapture_time`, the mean rate recalibrates the gyro biases (ZARU). After a gap that loses the vertical
the filter levels again.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from modelserver.estimation.filter import bank_step, eskf, imu_monitor, leveling, propagation
from modelserver.estimation.filter.eskf import ZERO, Innovation
from modelserver.estimation.filter.fusion import (
    CONSTRAINT_PERIOD,
    NOTHING,
    ZUPT_PERIOD,
    Fused,
    Item,
    create_context,
    fuse_constraint,
    fuse_non_holonomic,
    reject,
    report_event,
    report_reset,
)
from modelserver.estimation.filter.gnss_monitor import MOVING_TIME
from modelserver.estimation.filter.imu_monitor import ImuMonitor
from modelserver.estimation.filter.measurements import constraints
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, FilterState, GyroBiases, Leveling, N, Navigating
from modelserver.messages import Decision, ImuSample, Mode, Verdict
from modelserver.transforms.so3 import to_vector3

BIAS_AGE: Final = 600.0
"""Seconds for which gyro biases that a restart continues with may have drifted: few vehicles drive longer without a
stop."""

LARGEST_CONTRADICTION: Final = 0.4
CONTRADICTION_GAIN: Final = 0.1
"""Mean NIS of ZUPT, relative to its gate, of a vehicle that is not stationary, and the weight of one; usual is 0.1."""

LARGEST_RATIO: Final = 10.0
"""Largest share of one, relative to its gate."""

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
        return _fuse_turn_rate(setup, state, item, imu_monitor.read_turn_rate(sample, setup.yaw_gyro))
    values = imu_monitor.read_imu(sample, setup.mount)
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
            state = propagation.propagate_covariance(setup, state)
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
        state = propagation.advance(setup, state, utime)
        if max(np.diagonal(state.nav.covariance)[6:9]) > LOST_ATTITUDE_SIGMA**2:
            restarted = Leveling(state.common.restart())
            return restarted, (report_reset(item, "leveling again after a gap in the IMU samples"),)
        decisions += (reject(item, "gap")._replace(verdict=Verdict.MONITORED),)
    state = propagation.propagate_imu(setup, state, utime, rate, force, detector, imu)
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
    if propagation.measures_turn_rate(setup, state, utime):
        mean = (0.0, 0.0, 0.5 * (state.imu.rate[2] + rate))
        state = state._replace(imu=state.imu._replace(rate=mean))
    state = propagation.predict(setup, state, utime)
    nav = state.nav
    bias_sigma = math.sqrt(nav.covariance[11, 11])
    detector = state.stationary.update(utime, measured, ZERO, nav.gyro_bias, bias_sigma, settings)
    lag = nav.lag
    if lag >= eskf.COVARIANCE_STEP:
        nav = eskf.propagate_covariance(nav, propagation.select_noise(setup, state, nav), setup.layout)
        nav = nav.widen({11: settings.gyro_bias_walk**2 * lag})
    reckoning = propagation.follow_gyro(setup, state.reckoning, utime, rate)
    state = state._replace(nav=nav, imu=imu, stationary=detector, reckoning=reckoning)
    if not (
        state.is_stationary and detector.sum_time > 1.0 and detector.get_quiet_time(utime) >= settings.recapture_time
    ):
        return state, NOTHING
    state = propagation.propagate_covariance(setup, state)
    context, mean_rate = create_context(setup, state), detector.mean_stationary_rate
    whole = constraints.zero_rate(context, mean_rate, state.earth.rotation, detector.sum_time)
    turn = Innovation(whole.residual[2:], whole.jacobian[2:], whole.noise[2:, 2:])
    state, more = _check_biases(setup, state, whole, detector.sum_time)
    if more:
        return state._replace(stationary=detector.restart_mean()), more
    state, decision = fuse_constraint(setup, state, constraints.ZERO_RATE, turn)
    return state._replace(stationary=detector.restart_mean()), (decision,)


def _fuse_constraints(setup: Setup, state: N, utime: int) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after the updates without a sensor: those of a stationary vehicle, or of a rolling one."""
    settings, detector = setup.settings, state.stationary
    is_stationary = detector.get_quiet_time(utime) >= settings.stationary_time and _may_be_stationary(
        setup, state, utime
    )
    if is_stationary != state.constraints.is_stationary:
        state = propagation.propagate_covariance(setup, state)
        constraints_ = state.constraints._replace(
            is_stationary=is_stationary, zupt_utime=utime, rest_turn=ZERO, rest_time=0.0
        )
        state = state._replace(constraints=constraints_)
    if is_stationary:
        if (utime - state.constraints.zupt_utime) * 1e-6 < ZUPT_PERIOD:
            return state, NOTHING
        return _fuse_stationary(setup, state, utime)
    if (utime - state.constraints.non_holonomic_utime) * 1e-6 < CONSTRAINT_PERIOD:
        return state, NOTHING
    wheels_utime = state.common.wheels.used_utime
    if wheels_utime and (utime - wheels_utime) * 1e-6 < settings.wheel_period + CONSTRAINT_PERIOD:
        return state, NOTHING  # the next wheel sample brings it
    return fuse_non_holonomic(setup, state, utime)


def _fuse_stationary(setup: Setup, state: N, utime: int) -> tuple[N, tuple[Decision, ...]]:
    """Return the state of a stationary vehicle after ZUPT, and ZARU once it has been stationary for long enough."""
    dt = (utime - state.constraints.zupt_utime) * 1e-6
    state = propagation.propagate_covariance(setup, state)
    state = state._replace(constraints=state.constraints._replace(zupt_utime=utime))
    innovation = constraints.zero_velocity(create_context(setup, state), dt)
    state, decision = fuse_constraint(setup, state, constraints.ZERO_VELOCITY, innovation)
    decisions: tuple[Decision, ...] = (decision,)
    contradiction = state.constraints.contradiction
    contradiction += CONTRADICTION_GAIN * (min(decision.statistic / decision.limit, LARGEST_RATIO) - contradiction)
    state = state._replace(constraints=state.constraints._replace(contradiction=contradiction))
    if contradiction > LARGEST_CONTRADICTION and state.stationary.is_confirmed_by_wheels(utime):
        # wheels that are stuck, and it moves so smoothly that it seems stationary
        state = bank_step.suspect_wheels(setup, state)
        return state, (*decisions, report_event(state, constraints.ZERO_VELOCITY, Verdict.REJECTED, "it moves"))
    detector = state.stationary
    if detector.sum_time > 0.0:
        if detector.get_quiet_time(utime) >= setup.settings.recapture_time:
            context = create_context(setup, state)
            innovation = constraints.zero_rate(
                context, detector.mean_stationary_rate, state.earth.rotation, detector.sum_time
            )
            state, more = _check_biases(setup, state, innovation, detector.sum_time)
            if more:
                return state._replace(stationary=detector.restart_mean()), decisions + more
            state, decision = fuse_constraint(setup, state, constraints.ZERO_RATE, innovation)
            decisions = (*decisions, decision)
            if decision.verdict is Verdict.USED:
                state = _store_biases(setup, state)
        state = state._replace(stationary=detector.restart_mean())
    return state, decisions


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
    return state, (report_event(state, constraints.ZERO_RATE, Verdict.RESET, text),)


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
