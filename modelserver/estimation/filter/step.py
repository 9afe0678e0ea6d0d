"""Filter step: one item after another, in the order of their instants, from state to state.

`step(setup, state, item)` is a pure function. Nothing here depends on the order of arrival: see `timeline`.
Read top-down: `step` -> the handlers in `imu_step`, `wheel_step`, `gnss_step`, `heading_step` and `fusion` -> `eskf`.
"""

from __future__ import annotations

from modelserver.earth.geodesy import Geodesy
from modelserver.estimation.filter import eskf, gnss_step, heading_step, imu_step, propagation, warm_start, wheel_step
from modelserver.estimation.filter.fusion import (
    IMU,
    MODE,
    NOTHING,
    STEERING,
    Fused,
    Handler,
    Item,
    fuse_measurement,
    reject,
    report_reset,
)
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, Common, FilterState, Leveling, WarmStart
from modelserver.messages import Mode, RestoredState, SwitchMode


def start(mode: Mode, geodesy: Geodesy | None, restored: RestoredState | None = None) -> Leveling:
    """Return the state before the first sample; `restored` is the state of an earlier run, for a warm start."""
    waiting = None if restored is None or restored.state is None else WarmStart(restored)
    return Leveling(Common(mode=mode, geodesy=geodesy, warm_start=waiting))


def step(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after an item, and the decisions."""
    decisions = NOTHING
    pending = state.common.pending
    if pending and pending[0].utime <= item.utime:
        state, decisions = _apply_pending(setup, state, item.utime)
    state, more = _HANDLERS.get(item.kind, fuse_measurement)(setup, state, item)
    if not isinstance(state, Leveling):
        # the whole check after an update, its cheap part after a propagation
        if not (eskf.is_sound if more else eskf.is_plausible)(state.nav, setup.settings):
            state = Leveling(state.common.restart())
            more = (*more, report_reset(item, "the filter had diverged"))
        elif state.common.warm_start is not None:
            state, steps = warm_start.advance(setup, state, item.utime)
            more = (*more, *steps)
    return state, decisions + more


def _apply_pending(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with the pending decisions applied that no delayed sample can change any more."""
    decisions = NOTHING
    for each in state.common.pending:
        if each.utime > utime:
            break
        common = state.common._replace(pending=state.common.pending[1:])
        if each.origin is not None:
            common = common._replace(geodesy=Geodesy(each.origin))
        state = state._replace(common=common)
        if each.resets_position and isinstance(state, Aligned) and state.bank is None:
            state = propagation.propagate_covariance(setup, state)
            state, decision = gnss_step.reset_position(setup, state)
            decisions += () if decision is None else (decision,)
    return state, decisions


def _switch_mode(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, SwitchMode)
    if not isinstance(state, Leveling):
        state = propagation.advance(setup, state, item.utime)
    state = state._replace(common=state.common._replace(mode=sample.mode))
    return state, (report_reset(item, f"mode {sample.mode.name.lower()}"),)


def _fuse_gnss(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after a measurement of the receiver.

    It is not used while a driver fills a gap of the IMU: of a unit that measures both, it may have filled that of the
    receiver too, and a straight line between two fixes is off the path by meters in a turn.
    """
    imu, is_imu_used = state.imu, setup.uses_imu(state.common.mode)
    if imu.fills_gap and is_imu_used and (item.utime - imu.used_utime) * 1e-6 <= setup.settings.rate_hold:
        return state, (reject(item, "interpolated"),)
    return _GNSS_HANDLERS[item.kind](setup, state, item)


_GNSS_HANDLERS: dict[str, Handler] = {
    "gps_position": gnss_step.fuse_fix,
    "gps_height": gnss_step.fuse_height,
    "gps_velocity": heading_step.fuse_velocity,
    "gps_baseline": heading_step.fuse_baseline,
}

_HANDLERS: dict[str, Handler] = {
    IMU: imu_step.fuse_imu,
    MODE: _switch_mode,
    STEERING: wheel_step.fuse_steering,
    "wheel_speed": wheel_step.fuse_wheels,
    **dict.fromkeys(_GNSS_HANDLERS, _fuse_gnss),
    "imu_yaw": heading_step.fuse_imu_yaw,
    "absolute_pose": heading_step.fuse_absolute_pose,
}
