"""Filter step: one measurement after the other, in the order of their instants, from state to state.

`fused(setup, state, item)` is a pure function. Nothing here knows in which order things arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.filter import fixes, fixing, inertial, motion, rolling, updates
from modelserver.estimation.filter.handling import begun_anew, begun_level, counts, measured, scene_of
from modelserver.estimation.filter.items import INERTIAL, NOTHING, STEERING, Fused, Item, refused, took_up
from modelserver.estimation.filter.measurements.aiding import AbsolutePose
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Resuming, Steering
from modelserver.estimation.filter.warm_start import gone_on
from modelserver.messages import (
    AbsolutePoseSample,
    Decision,
    Mode,
    Phase,
    RestoredState,
    SwitchMode,
    VehicleStatusSample,
)


def first(setup: Setup, mode: Mode, geodesy: Geodesy | None, recalled: RestoredState | None = None) -> FilterState:
    """Return the state that has seen nothing yet; `recalled` is what an earlier run kept, where that may be used."""
    warm_start = None if recalled is None or recalled.state is None else Resuming(recalled)
    return FilterState(mode=mode, geodesy=geodesy, warm_start=warm_start)


def fused(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with one item more, and what became of it."""
    decisions = NOTHING
    if state.pending and state.pending[0].utime <= item.utime:
        state, decisions = _latched(setup, state, item.utime)
    state, more = _HANDLERS.get(item.kind, measured)(setup, state, item)
    nav = state.nav
    if nav is not None and not (updates.sound if more else updates.plausible)(nav, setup.settings):
        state, diverged = _diverged(setup, state, item)
        more = (*more, diverged)
    if state.warm_start is not None:
        state, resumed = gone_on(setup, state, item.utime)
        more = (*more, *resumed)
    return state, decisions + more


def _absolute(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with an absolute pose: before heading is known one with position and orientation sets it."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, AbsolutePoseSample)
    if state.nav is None and not motion.inertial(setup, state.mode):
        state = begun_level(setup, state, item.utime)
    if state.phase is Phase.ALIGNED or state.nav is None or not counts(state.mode, item):
        return measured(setup, state, item)
    if sample.position is None or sample.orientation is None or state.geodesy is None:
        return state, NOTHING
    assert isinstance(measurement, AbsolutePose)
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    return fixes.set_from(setup, state, measurement, sample, scene_of(setup, state), item.source, item.seq)


def _mode(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, SwitchMode)
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    return state._replace(mode=sample.mode), (took_up(item, f"mode {sample.mode.name.lower()}"),)


def _steering(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with the vehicle controller's steering angle; an angle out of range is dropped."""
    sample, signal = item.sample, setup.rig.steering
    assert isinstance(sample, VehicleStatusSample)
    assert signal is not None
    angle = sample.steering_angle
    if not math.isfinite(angle):
        return state, (refused(item, "nan"),)
    if abs(angle) > signal.limit:
        return state, (refused(item, "range"),)
    return state._replace(steering=Steering(item.utime, angle)), NOTHING


def _latched(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with the decisions in force whose time has come: nothing can change them any more."""
    decisions = NOTHING
    for each in state.pending:
        if each.utime > utime:
            break
        state = state._replace(pending=state.pending[1:])
        if each.origin is not None:
            state = state._replace(geodesy=Geodesy(each.origin))
        elif each.take_up:
            state = motion.caught_up(setup, state)
            state, decision = fixes.taken_up(setup, state)
            decisions += () if decision is None else (decision,)
    return state, decisions


def _diverged(setup: Setup, state: FilterState, item: Item) -> tuple[FilterState, Decision]:
    return begun_anew(state), took_up(item, "the filter had diverged")


Handler: TypeAlias = Callable[[Setup, FilterState, Item], Fused]


_HANDLERS: dict[str, Handler] = {
    INERTIAL: inertial.sample,
    "mode": _mode,
    "wheel_speed": rolling.sample,
    STEERING: _steering,
    "gps_position": fixing.fix,
    "gps_height": fixing.height,
    "gps_velocity": fixing.velocity,
    "gps_baseline": fixing.baseline,
    "imu_yaw": fixing.yaw,
    "absolute_pose": _absolute,
}
