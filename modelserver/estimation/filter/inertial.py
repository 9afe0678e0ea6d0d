"""IMU monitor and propagation: interpolated samples, saturation, stationary detection, zero-velocity update (ZUPT)."""

from __future__ import annotations

import math

import numpy as np

from modelserver.estimation.filter import fixes, motion, start
from modelserver.estimation.filter.handling import CONSTRAINT_PERIOD, REST_PERIOD, begun_anew, known, rolled, scene_of
from modelserver.estimation.filter.items import NOTHING, Fused, Item, refused, took_up
from modelserver.estimation.filter.measurements import constraints
from modelserver.estimation.filter.nav import ZERO
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Said
from modelserver.messages import Decision, ImuSample, Mode, Phase, Verdict
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

MOST_RATE = 35.0
"""rad/s: 2000 deg/s, the widest range of gyros on vehicles."""


MOST_FORCE = 500.0
"""m/s2: 50 g, the widest range of accelerometers on vehicles."""


BIASES_AGE = 600.0
"""Seconds that gyro biases kept aside are taken to be old: few vehicles drive for longer without a stop."""


LOST = 0.7
"""Sigma of attitude, rad, from which on an inertial unit that speaks again is levelled anew."""


def sample(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state carried on by an inertial sample, with what standing and rolling tell."""
    sample = item.sample
    assert isinstance(sample, ImuSample)
    if state.mode is Mode.NO_IMU:
        return state, NOTHING
    found = read(setup, sample)
    if isinstance(found, str):
        return state, (refused(item, found),)
    rate, force = found
    said = Said(item.utime, rate, force, item.utime)
    if state.said is not None:
        said = state.said.followed(item.utime, rate, force)
    if (item.utime - said.since) * 1e-6 > setup.settings.frozen_time:
        return state._replace(said=said), (refused(item, "frozen"),)
    decisions = NOTHING
    if said.made_up != state.guessed:
        state = motion.caught_up(setup, state)._replace(guessed=said.made_up)
        if said.made_up:
            decisions = (refused(item, "interpolated")._replace(verdict=Verdict.MONITORED),)
    nav = state.nav
    bias = ZERO if nav is None else nav.gyro_bias
    sigma = setup.settings.gyro_bias_sigma
    if nav is not None:
        P = nav.covariance
        sigma = math.sqrt(max(P[9, 9], P[10, 10], P[11, 11]))
    stillness = state.stillness.felt(item.utime, rate, force, bias, sigma, setup.settings)
    if nav is None:
        state = state._replace(stillness=stillness, said=said)
        state = start.levelled(setup, state, item.utime, rate, force)
        if state.tilt and state.level_count == 0 and state.nav is None:
            return state, (refused(item, "gravity" if math.isinf(state.tilt) else "mount"),)
        return state, NOTHING
    gap = (item.utime - state.imu_utime) * 1e-6 > setup.settings.rate_hold and state.imu_utime > 0
    if gap:
        state = motion.caught_up(setup, motion.at(setup, state, item.utime))
        assert state.nav is not None
        if max(np.diagonal(state.nav.covariance)[6:9]) > LOST**2:
            return begun_anew(state), (took_up(item, "the inertial unit was silent: levelled anew"),)
    state = motion.felt(setup, state, item.utime, rate, force, stillness, said)
    if gap:
        decisions += (refused(item, "gap")._replace(verdict=Verdict.MONITORED),)
    state, more = _constrained(setup, state, item.utime)
    return state, decisions + more if more else decisions


def read(setup: Setup, sample: ImuSample) -> tuple[Vector3, Vector3] | str:
    """Return rate and specific force along the body's axes, or in one word why not."""
    rate, force = sample.angular_velocity, sample.specific_force
    if rate is None or force is None:
        return "nan"
    if not (math.isfinite(sum(rate)) and math.isfinite(sum(force))):
        return "nan"
    if max(map(abs, rate)) > MOST_RATE or max(map(abs, force)) > MOST_FORCE:
        return "range"
    mount = setup.mount
    return so3.rotate(mount, rate), so3.rotate(mount, force)


def _constrained(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state after what is known without a sensor: that a standing vehicle stands, a rolling one rolls."""
    settings, still = setup.settings, state.stillness
    standing = still.seconds(utime) >= settings.stationary_time and _may_stand(setup, state, utime)
    if standing != state.standing:
        state = motion.caught_up(setup, state)._replace(standing=standing, rested_utime=utime)
    nav = state.nav
    assert nav is not None
    if standing:
        dt = (utime - state.rested_utime) * 1e-6
        if dt < REST_PERIOD:
            return state, NOTHING
        state = motion.caught_up(setup, state)._replace(rested_utime=utime)
        state, decision = known(
            setup, state, constraints.ZERO_VELOCITY, constraints.zero_velocity(scene_of(setup, state), dt)
        )
        decisions: tuple[Decision, ...] = (decision,)
        if still.summed > 0.0:
            if still.seconds(utime) >= settings.recapture_time:
                scene = scene_of(setup, state)
                compared = constraints.zero_rate(scene, still.mean_rate, state.earth.rotation, still.summed)
                state, decision = known(setup, state, constraints.ZERO_RATE, compared)
                decisions = (*decisions, decision)
                state = _biases_kept(setup, state, decision)
            state = state._replace(stillness=still.used())
        return state, decisions
    if (utime - state.rolled_utime) * 1e-6 < CONSTRAINT_PERIOD:
        return state, NOTHING
    if state.wheels_utime and (utime - state.wheels_utime) * 1e-6 < setup.settings.wheel_period + CONSTRAINT_PERIOD:
        return state, NOTHING  # the next wheel sample brings it along
    return rolled(setup, state, utime)


def _biases_kept(setup: Setup, state: FilterState, decision: Decision) -> FilterState:
    """Return the state with the gyros' biases kept aside: a filter that diverges later begins anew with them.

    Only what standing told is kept, for that rests on nothing else in the state; less sure by what it may have wandered
    when it is needed.
    """
    nav = state.nav
    if decision.verdict is not Verdict.USED or nav is None:
        return state
    variance = max(nav.covariance[k, k] for k in (9, 10, 11)) + setup.settings.gyro_bias_walk**2 * BIASES_AGE
    return state._replace(biases=(nav.gyro_bias, math.sqrt(variance)))


def _may_stand(setup: Setup, state: FilterState, utime: int) -> bool:
    """Return whether nothing speaks against standing: wheels, fixes that move, the state's own speed."""
    settings, nav = setup.settings, state.nav
    assert nav is not None
    speed = math.hypot(*nav.velocity)
    P = nav.covariance
    sigma = math.sqrt(max(P[3, 3], P[4, 4]))
    if state.mode is not Mode.NO_WHEELS and state.stillness.vouched(utime):
        # wheels that are stuck on a smooth road say so too: fixes have kept the speed then
        return state.phase is not Phase.ALIGNED or speed - 4.0 * sigma < 10.0 * settings.stationary_speed
    if utime < state.moved:
        return False
    if state.standing:
        return speed < 10.0 * settings.stationary_speed
    if state.phase is not Phase.ALIGNED and sigma > 1.0:
        # nothing told the speed yet: quiet and with fixes that keep their place is all there is
        return state.fixed is not None and (utime - state.fixed.utime) * 1e-6 < fixes.SAME_PLACE
    return speed - 2.0 * sigma < settings.stationary_speed and speed < 0.5
