"""Wheel monitor: wheel odometry, zero-velocity updates (ZUPT) by wheels, and wheels without an IMU."""

from __future__ import annotations

import math

from modelserver.estimation.filter import motion, updates
from modelserver.estimation.filter.handling import (
    CONSTRAINT_PERIOD,
    REST_PERIOD,
    begun_level,
    known,
    remembered,
    rolled,
    scene_of,
)
from modelserver.estimation.filter.items import NOTHING, Fused, Item, refused
from modelserver.estimation.filter.measurements import constraints
from modelserver.estimation.filter.measurements.wheels import WheelSpeed, standing_wheels, turn_rate
from modelserver.estimation.filter.nav import ZERO, Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Last
from modelserver.messages import Mode, Verdict, WheelsSample

OTHER_SILENT = 2.0
"""Seconds of silence after which another source of wheels is listened to: the way since a sample is one source's."""


UNKNOWN_SPEED = 2.0
"""Sigma of the horizontal speed, m/s, from which on nothing is known of it: that of a walk."""


def sample(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with a wheel sample: the way since the last one compared, or that the wheels stand."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, WheelsSample)
    assert isinstance(measurement, WheelSpeed)
    if state.mode is Mode.NO_WHEELS:
        return state, NOTHING
    spoke = state.last.get((state.wheels_source, "seen"))
    if state.wheels_source != item.source and spoke and (item.utime - spoke.utime) * 1e-6 < OTHER_SILENT:
        return state, (refused(item, "source"),)
    key = (item.source, item.kind)
    seen = (item.source, "seen")
    last = state.last.get(key)
    before, newest = _wheels_of(last), _wheels_of(state.last.get(seen))
    settings = setup.settings
    stands = standing_wheels(sample, newest, measurement.contacts, settings)
    state = remembered(state._replace(stillness=state.stillness.rolled(item.utime, stands)), seen, item)
    if state.nav is None:
        if not motion.inertial(setup, state.mode):
            state = begun_level(setup, state, item.utime)
        return state, NOTHING
    age = math.inf if last is None else (item.utime - last.utime) * 1e-6
    bridged = motion.inertial(setup, state.mode) and measurement.by_travel(sample, before)
    if bridged and age < settings.wheel_period - 0.01:
        return state, NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    scene = scene_of(setup, state, age, before)
    compared = measurement.compare(scene, sample)
    decisions = NOTHING
    begins = False
    if isinstance(compared, str):
        decisions = (refused(item, compared),) if compared else NOTHING
    else:
        begins = _speed_unknown(scene.nav)
        if begins:
            # the way wheels err is a share of speed: compared at the speed that they tell, not at 0
            rolling = updates.moving(scene.nav, compared, setup.rig.base, min(age, settings.wheel_period))
            again = measurement.compare(scene._replace(nav=rolling), sample)
            if not isinstance(again, str):
                scene, compared = scene._replace(nav=rolling), again
        nav, decision = updates.used(scene.nav, compared, settings, item.utime, item.source, item.seq, item.kind)
        gyro = motion.inertial(setup, state.mode) and (item.utime - state.imu_utime) * 1e-6 <= settings.rate_hold
        rate = 0.0 if gyro else turn_rate(sample, before, measurement, settings, scene.steering)
        state = state._replace(nav=nav, wheels_source=item.source)
        if decision.verdict is Verdict.USED:
            state = state._replace(wheels_utime=item.utime, wheels_rate=rate)
        decisions = (decision,)
    now = state.nav
    assert now is not None
    state = remembered(state._replace(nav=now._replace(rolled=ZERO, turned=ZERO)), key, item)
    if not motion.inertial(setup, state.mode):
        # without an inertial unit the wheels alone say when the vehicle stands
        state = state._replace(standing=stands is True)
        rested = (item.utime - state.rested_utime) * 1e-6
        if state.standing and rested >= REST_PERIOD:
            compared = constraints.zero_velocity(scene_of(setup, state), rested)
            state, decision = known(setup, state, constraints.ZERO_VELOCITY, compared)
            decisions += (decision,)
        if not state.standing or rested >= REST_PERIOD:
            state = state._replace(rested_utime=item.utime)
    # the first wheels that tell a speed leave the sideways speed to what is known of rolling vehicles
    if not state.standing and (begins or (item.utime - state.rolled_utime) * 1e-6 >= 0.5 * CONSTRAINT_PERIOD):
        state, more = rolled(setup, state, item.utime)
        decisions += more
    return state, decisions


def _speed_unknown(nav: Nav) -> bool:
    P = nav.covariance
    return float(P[3, 3] + P[4, 4]) > UNKNOWN_SPEED**2


def _wheels_of(last: Last | None) -> WheelsSample | None:
    return last.sample if last is not None and isinstance(last.sample, WheelsSample) else None
