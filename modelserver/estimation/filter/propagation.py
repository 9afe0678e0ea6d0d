"""Propagation of the state to an instant: by the IMU, by the wheels' turn rate, or at constant velocity.

Between IMU samples, and up to `rate_hold` after the last one, the last sample holds. After that, or without an IMU, the
speed is constant and the turn rate that of a gyro that measures nothing else, or of the wheels, if they measure one;
the process noise covers what is unknown.
A stationary vehicle does not turn: what its gyros measure is their bias and the earth rate.
"""

from __future__ import annotations

from typing import Final

from modelserver.estimation.filter import eskf
from modelserver.estimation.filter.dead_reckoning import DeadReckoning
from modelserver.estimation.filter.eskf import ZERO, NavState, ProcessNoise
from modelserver.estimation.filter.imu_monitor import ImuMonitor
from modelserver.estimation.filter.measurements.wheels import TurnRate
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, N, Navigating
from modelserver.estimation.filter.stationary_detector import StationaryDetector
from modelserver.messages import Mode
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

SLOW_TURN: Final = 0.02
"""Turn rate, rad/s, below which the error of the gyro's scale does not count."""

OUTAGE_US: Final = 3_000_000
"""Microseconds without a fix after which it does."""

TURN_TIME: Final = 10.0
"""Seconds of a turn, in which the error of the gyro's scale adds up."""


def is_outage(state: Aligned, utime: int) -> bool:
    """Return whether no fix was used for a while."""
    return utime - state.gnss.used_utime >= OUTAGE_US


def select_noise(setup: Setup, state: Navigating, nav: NavState) -> ProcessNoise:
    """Return the process noise at an instant of the state."""
    if setup.uses_imu(state.common.mode):
        if is_imu_fresh(setup, state, nav.utime):
            return _select_imu_noise(setup, state)
    elif state.is_stationary:
        return setup.stationary
    elif measures_turn_rate(setup, state, nav.utime):
        return setup.turning
    wheels = state.common.wheels
    if not wheels.measures_speed(nav.utime):
        return setup.coasting
    return setup.coasting._replace(yaw=wheels.turn_rate.sigma**2 * setup.settings.slip_time)


def _select_imu_noise(setup: Setup, state: Navigating) -> ProcessNoise:
    if state.is_stationary:
        return setup.stationary
    noise = setup.interpolated if state.imu.is_interpolated else setup.driving
    rate, nav = state.nav.rate[2], state.nav
    if abs(rate) < SLOW_TURN or not isinstance(state, Aligned) or not is_outage(state, nav.utime):
        return noise
    if not state.common.measures_wheel_speed(nav.utime):
        return noise  # the non-holonomic constraint would turn the heading by it
    # an error of the gyro's scale lasts through a turn, and so does one of its axes; fixes correct it
    turning = TURN_TIME * (setup.settings.gyro_scale_sigma * rate) ** 2
    return noise._replace(tilt=noise.tilt + turning, yaw=noise.yaw + turning)


def measures_turn_rate(setup: Setup, state: Navigating, utime: int) -> bool:
    """Return whether a gyro of the turn rate alone measures it at an instant."""
    if setup.yaw_gyro is None or state.common.mode is Mode.NO_IMU:
        return False
    return is_imu_fresh(setup, state, utime)


def is_imu_fresh(setup: Setup, state: Navigating, utime: int) -> bool:
    """Return whether the last sample of the IMU, or of a gyro of the turn rate alone, holds at an instant."""
    return (utime - state.imu.used_utime) * 1e-6 <= setup.settings.rate_hold


def propagate_imu(
    setup: Setup, state: N, utime: int, rate: Vector3, force: Vector3, stationary: StationaryDetector, imu: ImuMonitor
) -> N:
    """Return the state at an IMU sample (`rate`, `force`: body axes); `stationary` and `imu` are those after it."""
    nav = state.nav
    if not is_imu_fresh(setup, state, utime):
        state = predict(setup, state, utime)
        nav = state.nav
        noise = select_noise(setup, state, nav)
        nav = eskf.propagate_covariance(nav, noise, setup.layout)._replace(rate=rate, force=force)
    else:
        if state.constraints.is_stationary:
            nav = _propagate_stationary(setup, state, nav, utime, force, rate)
        else:
            nav = eskf.propagate(nav, utime, rate, force, state.earth, setup.rig.base)
        if nav.lag >= eskf.COVARIANCE_STEP:
            nav = eskf.propagate_covariance(nav, _select_imu_noise(setup, state), setup.layout)
    return state.with_imu(nav, imu, stationary, _follow_gyros(setup, state, nav, utime, rate, imu))


def _follow_gyros(
    setup: Setup, state: Navigating, nav: NavState, utime: int, rate: Vector3, imu: ImuMonitor
) -> DeadReckoning:
    w, x, y, z = nav.attitude
    a, b, c = rate
    # the last row of the rotation: the rate about the vertical
    level = 2.0 * ((x * z - w * y) * a + (y * z + w * x) * b) + (1.0 - 2.0 * (x * x + y * y)) * c
    return follow_gyro(setup, state.reckoning, utime, level, is_interpolated=imu.is_interpolated)


def follow_gyro(
    setup: Setup, reckoning: DeadReckoning, utime: int, rate: float, *, is_interpolated: bool = False
) -> DeadReckoning:
    """Return dead reckoning after a rate about the vertical, rad/s, and what the gyro has missed before it."""
    settings = setup.settings
    gap = (utime - reckoning.gyro_utime) * 1e-6
    variance = 0.0
    if gap > settings.rate_hold:
        variance = (settings.gap_rate_sigma * gap) ** 2 / 3.0
    elif is_interpolated:
        variance = setup.interpolated.yaw * gap
    return reckoning.follow_gyro(utime, rate, variance)


def follow_wheels(setup: Setup, state: Navigating, utime: int, turn: TurnRate) -> DeadReckoning:
    """Return dead reckoning after the turn rate by wheels in place of a gyro that has gone silent."""
    reckoning, settings = state.reckoning, setup.settings
    if not reckoning.gyro_utime or is_imu_fresh(setup, state, utime):
        return reckoning
    # what a gyro with the present bias would measure; an error lasts `slip_time`
    rate, gap = turn.value + state.nav.gyro_bias[2], (utime - reckoning.gyro_utime) * 1e-6
    return reckoning.follow_gyro(utime, rate, turn.sigma**2 * max(settings.slip_time, gap) * gap)


def predict(setup: Setup, state: N, utime: int) -> N:
    """Return the state at an instant not before its own, by what is known until then."""
    if utime <= state.nav.utime:
        return state
    return state.with_nav(predict_nav(setup, state, utime))


def predict_nav(setup: Setup, state: Navigating, utime: int) -> NavState:
    """Return the nominal state at a later instant; its covariance is propagated where the process noise changes."""
    nav = state.nav
    base = setup.rig.base
    if setup.uses_imu(state.common.mode):
        held = state.imu.used_utime + round(setup.settings.rate_hold * 1e6)
        if nav.utime < held:
            until = min(utime, held)
            measured = nav.rate
            if state.is_stationary:
                nav = _propagate_stationary(setup, state, nav, until, nav.force, measured)
            else:
                nav = eskf.propagate(nav, until, measured, nav.force, state.earth, base)
            if until == utime:
                return nav
            nav = eskf.propagate_covariance(nav, _select_imu_noise(setup, state), setup.layout)
    wheels, turn = state.common.wheels, 0.0
    if not state.is_stationary:
        if measures_turn_rate(setup, state, nav.utime):
            turn = state.imu.rate[2] - nav.gyro_bias[2]
        elif wheels.measures_speed(nav.utime):
            turn = wheels.turn_rate.value
    return eskf.propagate_without_imu(nav, utime, (0.0, 0.0, turn), base)


def propagate_covariance(setup: Setup, state: N) -> N:
    """Return the state with its covariance at its instant."""
    nav = state.nav
    if nav.lag <= 0.0:
        return state
    return state._replace(nav=eskf.propagate_covariance(nav, select_noise(setup, state, nav), setup.layout))


def advance(setup: Setup, state: N, utime: int) -> N:
    """Return the state with its covariance at an instant not before its own."""
    return propagate_covariance(setup, predict(setup, state, utime))


def _propagate_stationary(
    setup: Setup, state: Navigating, nav: NavState, utime: int, force: Vector3, measured: Vector3
) -> NavState:
    """Return the nominal state of a stationary vehicle at a later instant: its place stays. `measured`: the rate."""
    rate = _get_stationary_rate(state, nav)
    after = eskf.propagate(nav._replace(rate=rate), utime, rate, force, state.earth, setup.rig.base)
    return after._replace(rate=measured, position=nav.position)


def _get_stationary_rate(state: Navigating, nav: NavState) -> Vector3:
    """Return the rate that the gyros of a stationary vehicle measure with the present bias."""
    a, b, c = nav.gyro_bias
    if state.earth.rotation == ZERO:
        return nav.gyro_bias
    x, y, z = so3.rotate_back(nav.attitude, state.earth.rotation)
    return (a + x, b + y, c + z)
