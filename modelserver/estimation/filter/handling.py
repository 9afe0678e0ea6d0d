"""Context of an update: predicted quantities, what is known without a sensor, and a state begun again."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any

from modelserver.estimation.filter import motion, start, updates
from modelserver.estimation.filter.items import NOTHING, Fused, Item, refused
from modelserver.estimation.filter.measurements import Compared, Scene, constraints
from modelserver.estimation.filter.nav import ZERO
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Last
from modelserver.messages import (
    AbsolutePoseSample,
    Decision,
    GpsSample,
    ImuSample,
    Mode,
    Phase,
    RangeSample,
    Verdict,
)
from modelserver.transforms import so3

CONSTRAINT_PERIOD = 0.1
"""Seconds between two uses of what is known of rolling vehicles, where no wheel sample brings it along."""


REST_PERIOD = 0.2
"""Seconds between two uses of standing."""


_WORLDLY = (AbsolutePoseSample, RangeSample)


def scene_of(setup: Setup, state: FilterState, age: float = math.inf, before: Any = None) -> Scene:
    """Return what a measurement is compared with, `age` seconds after the sample `before` of its source."""
    assert state.nav is not None
    site = state.site if state.phase is Phase.ALIGNED else None
    return Scene(
        state.nav,
        setup.layout,
        setup.settings,
        setup.rig,
        site,
        state.geodesy,
        state.standing,
        age,
        before,
        steering_angle(setup, state),
    )


def steering_angle(setup: Setup, state: FilterState) -> float:
    """Return the steering angle that the vehicle controller measures now, rad; nan where none is fresh."""
    signal, nav = setup.rig.steering, state.nav
    if signal is None or nav is None or (nav.utime - state.steering.utime) * 1e-6 > signal.max_age:
        return math.nan
    return state.steering.angle


def counts(mode: Mode, item: Item) -> bool:
    """Return whether a mode uses a measurement."""
    sample = item.sample
    if isinstance(sample, GpsSample):
        return not without_gps(mode)
    if isinstance(sample, ImuSample):
        return mode is not Mode.NO_IMU and (mode is not Mode.DEAD_RECKONING or item.kind == "imu_tilt")
    return not (mode is Mode.DEAD_RECKONING and isinstance(sample, _WORLDLY))


def without_gps(mode: Mode) -> bool:
    """Return whether a mode leaves the GPS out."""
    return mode in (Mode.NO_GPS, Mode.DEAD_RECKONING)


def remembered(state: FilterState, key: tuple[str, str], item: Item) -> FilterState:
    """Return the state that remembers an item as the last of its source and kind."""
    return state._replace(last=MappingProxyType({**state.last, key: Last(item.utime, item.sample)}))


def known(setup: Setup, state: FilterState, kind: str, compared: Compared) -> tuple[FilterState, Decision]:
    """Return the state with what is known without a sensor put into it, and what became of that."""
    nav = state.nav
    assert nav is not None
    nav, decision = updates.used(nav, compared, setup.settings, nav.utime, "filter", 0, kind)
    return state._replace(nav=nav), decision


def rolled(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state after what rolling vehicles do not do: slide sideways, or leave the ground."""
    dt = (utime - state.rolled_utime) * 1e-6
    state = motion.caught_up(setup, state)._replace(rolled_utime=utime)
    compared = constraints.non_holonomic(scene_of(setup, state), max(dt, 1e-3))
    state, decision = known(setup, state, constraints.NON_HOLONOMIC, compared)
    return state, (decision,)


def begun_level(setup: Setup, state: FilterState, utime: int) -> FilterState:
    """Return the state of a vehicle without inertial unit, which is taken to stand level."""
    nav = start.first_nav(setup, utime, so3.IDENTITY, start.LEVEL_SIGMA, 0.5 * setup.settings.maximum_speed, ZERO, 1e-6)
    return state._replace(nav=nav, phase=Phase.UNALIGNED, began=utime, rolled_utime=utime, rested_utime=utime)


def begun_anew(state: FilterState) -> FilterState:
    """Return the state begun anew; origin, mode and good biases stay."""
    return FilterState(
        mode=state.mode,
        geodesy=state.geodesy,
        capture=state.capture,
        epoch=state.epoch + 1,
        biases=state.biases,
    )


def measured(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with any measurement that needs no logic of its own."""
    sample, measurement = item.sample, item.measurement
    if state.nav is None or measurement is None or not counts(state.mode, item):
        return state, NOTHING
    key = (item.source, item.kind)
    last = state.last.get(key)
    age = math.inf if last is None else (item.utime - last.utime) * 1e-6
    if isinstance(sample, ImuSample) and age < 0.5:
        return state, NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    scene = scene_of(setup, state, age, None if last is None else last.sample)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        return state, ((refused(item, compared),) if compared else NOTHING)
    nav, decision = updates.used(scene.nav, compared, setup.settings, item.utime, item.source, item.seq, item.kind)
    if decision.verdict is Verdict.USED and not isinstance(sample, GpsSample):
        tells = compared.jacobian[:, :3] != 0.0
        a, b, c = (item.utime if tells[:, axis].any() else state.anchored[axis] for axis in range(3))
        state = state._replace(anchored=(a, b, c))
    return remembered(state._replace(nav=nav), key, item), (decision,)
