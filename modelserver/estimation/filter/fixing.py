"""Update by GNSS position, velocity and dual-antenna heading; before heading is known they feed heading alignment."""

from __future__ import annotations

import math

from modelserver.estimation.filter import fixes, motion, placing, updates
from modelserver.estimation.filter import latency as lateness
from modelserver.estimation.filter.alignment import Passed, Turn
from modelserver.estimation.filter.handling import begun_level, measured, scene_of, without_gps
from modelserver.estimation.filter.heading_check import proved
from modelserver.estimation.filter.items import NOTHING, Fused, Item, refused, took_up
from modelserver.estimation.filter.measurements.base import wrapped
from modelserver.estimation.filter.measurements.gps import GpsBaseline, GpsPosition, baseline_sigma
from modelserver.estimation.filter.measurements.orientation import Yaw, yaw_told
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.messages import GpsSample, ImuSample, Mode, Phase, Verdict, YawSource
from modelserver.transforms import so3


def fix(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with the place of a fix: it seeks heading before there is one, and is measured afterwards."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsPosition)
    fix = fixes.good(setup, state, sample)
    if isinstance(fix, str):
        return state, (refused(item, fix),)
    unused = "mode" if without_gps(state.mode) else ""
    if not unused:
        state = fixes.captured(setup, state, fix, item.utime)
    if state.nav is None:
        if not motion.inertial(setup, state.mode) and setup.wheels is None:
            state = begun_level(setup, state, item.utime)
        elif fixes.moving(setup, state, sample):
            state = state._replace(moved=item.utime + round(fixes.SAME_PLACE * 1e6))
        return state, NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    nav = state.nav
    assert nav is not None
    state, newest = fixes.passed(setup, state, nav, fix, sample.fix_type)
    before = state.fixed
    steady = fixes.follows(setup, before, newest)
    since = 0.0 if before is None else (newest.utime - before.utime) * 1e-6
    state = _seen_moving(setup, state, newest)._replace(fixed=newest)
    if state.phase is not Phase.ALIGNED:
        if unused:
            return state, NOTHING
        by_unit = not fixes.speed_known(setup, state, nav)
        state, fit = fixes.sought(setup, state, newest)
        if fit is None:
            return state, NOTHING
        state = fixes.aligned(setup, state, fit, by_unit=by_unit)
        return state, (
            took_up(item, f"heading to {math.degrees(fit.turn.sigma):.1f} deg by {fit.distance:.1f} m driven"),
        )
    if state.proving is not None and not unused:
        state, proof = proved(setup, state, newest)
        if proof:
            return state, proof
    resting = fixes.at_rest(setup, scene_of(setup, state), fix)
    if not resting:
        state = state._replace(nav=fixes.widened(setup, nav, state.restless, since))
    scene = scene_of(setup, state)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        return state, NOTHING
    if unused or resting:
        compared = compared._replace(monitored=unused or "at_rest")
    if unused:
        _, decision = updates.used(nav, compared, setup.settings, item.utime, item.source, item.seq, item.kind)
        return state, (decision,)
    state, decisions = fixes.put(setup, state, compared, newest, item.source, item.seq, steady=steady)
    if not resting and decisions[0].verdict is Verdict.USED:
        restless = fixes.learnt(setup, state.restless, decisions[0], since)
        nav = state.nav
        assert nav is not None
        nav = lateness.restless(setup, state, nav, decisions[0].residual, restless, since)
        state = state._replace(restless=restless, nav=nav)
        state = fixes.shown(setup, state, (newest.lingering, newest.lingering, 0.0), since, slice(0, 2))
    return state, decisions


def height(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with a height; one that drifts says that the whole fix does."""
    if state.refused_count:
        return state, NOTHING  # what is said of the position is said of the fix
    last = state.last.get((item.source, item.kind))
    state, decisions = measured(setup, state, item)
    if decisions and decisions[0].residual and last is not None:
        since = (item.utime - last.utime) * 1e-6
        state = state._replace(restless=fixes.learnt(setup, state.restless, decisions[0], since))
        if state.fixed is not None and not state.standing:
            state = fixes.shown(setup, state, (0.0, 0.0, state.fixed.up_sigma), since, slice(2, 3))
    return state, decisions


def _seen_moving(setup: Setup, state: FilterState, newest: Passed) -> FilterState:
    """Return the state with whether fixes say that the vehicle moves: more than they can wander in that time."""
    last = state.fixed
    if last is None:
        return state
    dt = (newest.utime - last.utime) * 1e-6
    if dt <= 0.0:
        return state
    wandered = newest.lingering * math.sqrt(2.0 * (1.0 - math.exp(-dt / setup.settings.gps_correlation_time)))
    if abs(newest.place - last.place) > 4.0 * math.hypot(1.5 * newest.white, wandered) + 0.1:
        return state._replace(moved=newest.utime + round(fixes.SAME_PLACE * 1e6))
    return state


def velocity(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with a receiver's velocity, which tells heading where none is known yet."""
    sample = item.sample
    assert isinstance(sample, GpsSample)
    nav = state.nav
    if without_gps(state.mode) or nav is None:
        return state, NOTHING
    if state.phase is Phase.ALIGNED:
        return measured(setup, state, item)
    if isinstance(fixes.good(setup, state, sample), str):
        return state, NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    found = fixes.by_velocity(setup, state, sample, item.utime)
    nav, newest = state.nav, state.fixed
    if found is None or nav is None or newest is None:
        return state, NOTHING
    turn, speed = found
    if math.isfinite(speed):
        nav = placing.at_speed(nav, speed, setup.settings.velocity_sigma)
    state = fixes.into_world(setup, state, nav, turn, newest)
    return state, (took_up(item, f"heading, to {math.degrees(turn.sigma):.1f} deg, by the receiver's velocity"),)


def baseline(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with the direction of two antennas, which tells heading outright."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsBaseline)
    if without_gps(state.mode) or state.nav is None or isinstance(fixes.good(setup, state, sample), str):
        return state, NOTHING
    if state.phase is Phase.ALIGNED:
        return measured(setup, state, item)
    x, y, _ = so3.rotate(state.nav.attitude, measurement.baseline)
    return _by_azimuth(setup, state, item, wrapped(sample.baseline_yaw - math.atan2(y, x)), baseline_sigma(sample))


def yaw(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with the inertial unit's own yaw, which tells heading where it is magnetic."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, ImuSample)
    assert isinstance(measurement, Yaw)
    if state.mode in (Mode.NO_IMU, Mode.DEAD_RECKONING) or state.nav is None:
        return state, NOTHING
    if state.phase is Phase.ALIGNED:
        return measured(setup, state, item)
    magnetic = sample.yaw_source is YawSource.MAGNETIC
    if state.site is None or (magnetic and not setup.settings.use_magnetometer):
        return state, NOTHING
    told = yaw_told(scene_of(setup, state)._replace(site=state.site), sample, measurement.mount)
    if isinstance(told, str):
        return state, NOTHING
    turn = wrapped(told - state.nav.yaw)
    return _by_azimuth(setup, state, item, turn, setup.settings.magnetic_sigma)


def _by_azimuth(setup: Setup, state: FilterState, item: Item, turn: float, sigma: float) -> Fused:
    """Return the state in the world by a heading that something tells outright, once a fix is there."""
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    nav, newest = state.nav, state.fixed
    if nav is None or newest is None or (item.utime - newest.utime) * 1e-6 > fixes.FRESH:
        return state, NOTHING
    state = fixes.into_world(setup, state, nav, Turn(turn, sigma), newest)
    return state, (took_up(item, f"heading, to {math.degrees(sigma):.1f} deg"),)
