"""Propagation of the nominal state to an instant: by the IMU, by the wheels' yaw rate, or at constant velocity."""

from __future__ import annotations

import cmath

from modelserver.estimation.filter import strapdown
from modelserver.estimation.filter.nav import ZERO, Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Said
from modelserver.estimation.filter.stationary import Stillness
from modelserver.estimation.filter.strapdown import Noise
from modelserver.messages import Mode, Phase
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3


def inertial(setup: Setup, mode: Mode) -> bool:
    """Return whether the inertial unit carries the state."""
    return setup.has_imu and mode is not Mode.NO_IMU


def noise(setup: Setup, state: FilterState, nav: Nav) -> Noise:
    """Return what drives the errors now."""
    if not inertial(setup, state.mode):
        if state.standing:
            return setup.standing
        return setup.rolling if _wheels_tell(state, nav) else setup.coasting
    if (nav.utime - state.imu_utime) * 1e-6 > setup.settings.rate_hold:
        return setup.coasting
    return felt_noise(setup, state)


def felt_noise(setup: Setup, state: FilterState) -> Noise:
    """Return what drives the errors while the inertial unit tells."""
    return setup.standing if state.standing else setup.guessing if state.guessed else setup.driving


def felt(
    setup: Setup, state: FilterState, utime: int, rate: Vector3, force: Vector3, stillness: Stillness, said: Said
) -> FilterState:
    """Return the state at an inertial sample, which feels `rate` and `force` along the body's axes.

    `stillness` and `said` are those after the sample.
    """
    assert state.nav is not None
    settings = setup.settings
    gap = (utime - state.imu_utime) * 1e-6 > settings.rate_hold
    if gap:
        state = at(setup, state, utime)
        nav = state.nav
        assert nav is not None
        nav = strapdown.caught_up(nav, noise(setup, state, nav), setup.layout)._replace(rate=rate, force=force)
    else:
        nav = state.nav
        assert nav is not None
        if state.standing:
            # standing is not turning: what the gyros feel goes to their bias alone
            turning = _at_rest(state, nav)
            nav = strapdown.carried(nav._replace(rate=turning), utime, turning, force, state.earth, setup.rig.base)
            nav = nav._replace(rate=rate)
        else:
            nav = strapdown.carried(nav, utime, rate, force, state.earth, setup.rig.base)
        if nav.lag >= strapdown.COVARIANCE_STEP:
            nav = strapdown.caught_up(nav, felt_noise(setup, state), setup.layout)
    if state.phase is Phase.UNALIGNED:
        state = _moved(state, nav)
    return state.felt(nav, stillness, said, utime)


def at(setup: Setup, state: FilterState, utime: int) -> FilterState:
    """Return the state at an instant not before its own, by what is known until then."""
    nav = state.nav
    if nav is None or utime <= nav.utime:
        return state
    nav = predicted(setup, state, utime)
    return _moved(state, nav)


def predicted(setup: Setup, state: FilterState, utime: int) -> Nav:
    """Return the navigation state at a later instant, its covariance caught up where what drives it changes."""
    nav = state.nav
    assert nav is not None
    base = setup.rig.base
    if inertial(setup, state.mode):
        held = state.imu_utime + round(setup.settings.rate_hold * 1e6)
        if nav.utime < held:
            until = min(utime, held)
            rate = _at_rest(state, nav) if state.standing else nav.rate
            felt_rate = nav.rate
            nav = strapdown.carried(nav._replace(rate=rate), until, rate, nav.force, state.earth, base)
            nav = nav._replace(rate=felt_rate)
            if until == utime:
                return nav
            nav = strapdown.caught_up(nav, felt_noise(setup, state), setup.layout)
    turn = (0.0, 0.0, 0.0 if state.standing else _wheels_rate(state, nav))
    return strapdown.coasted(nav, utime, turn, base)


def caught_up(setup: Setup, state: FilterState) -> FilterState:
    """Return the state with its covariance at its instant."""
    nav = state.nav
    if nav is None or nav.lag <= 0.0:
        return state
    return state._replace(nav=strapdown.caught_up(nav, noise(setup, state, nav), setup.layout))


def _wheels_rate(state: FilterState, nav: Nav) -> float:
    return state.wheels_rate if _wheels_tell(state, nav) else 0.0


def _wheels_tell(state: FilterState, nav: Nav) -> bool:
    return state.wheels_utime > 0 and (nav.utime - state.wheels_utime) * 1e-6 < 1.0


def _at_rest(state: FilterState, nav: Nav) -> Vector3:
    """Return the rate that a standing vehicle's gyros would feel with the bias known so far."""
    a, b, c = nav.gyro_bias
    if state.earth.rotation == ZERO:
        return nav.gyro_bias
    x, y, z = so3.rotate(so3.conjugate(nav.attitude), state.earth.rotation)
    return (a + x, b + y, c + z)


def _moved(state: FilterState, nav: Nav) -> FilterState:
    """Return the state at a new navigation state; before heading is known the way at speed 1 is drawn with it.

    So is what the accelerations alone lead to: propagation is all that changes the velocity here.
    """
    before = state.nav
    if state.phase is Phase.UNALIGNED and before is not None and nav.utime > before.utime:
        step = (nav.utime - before.utime) * 1e-6
        middle = 0.5 * (cmath.rect(1.0, before.yaw) + cmath.rect(1.0, nav.yaw))
        (ax, ay, _), (bx, by, _) = before.velocity, nav.velocity
        change = complex(bx - ax, by - ay)
        return state._replace(
            nav=nav,
            unit=state.unit + step * middle,
            gained=state.gained + change,
            swept=state.swept + step * (state.gained + 0.5 * change),
        )
    return state._replace(nav=nav)
