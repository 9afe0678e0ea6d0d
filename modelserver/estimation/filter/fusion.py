"""One item fused: what its handlers share.

An `Item` is one measurement of a sample at its instant. A handler is a pure function (setup, state, item) -> (state,
decisions); `fuse_measurement` is the one for every kind that needs no logic of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

from modelserver.earth.geodesy import GeodesyError
from modelserver.estimation.filter import eskf, propagation
from modelserver.estimation.filter.error_layout import ErrorLayout
from modelserver.estimation.filter.eskf import Innovation, NavState
from modelserver.estimation.filter.measurements import Measurement, MeasurementContext, constraints
from modelserver.estimation.filter.measurements.gnss import LATENCY
from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.measurements.own import OwnMeasurement
from modelserver.estimation.filter.measurements.wheels import read_speedometer
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned, Common, FilterState, Leveling, N, Navigating, PreviousSample
from modelserver.estimation.fix_quality import AcceptedFix, evaluate_fix
from modelserver.messages import (
    AbsolutePoseSample,
    Decision,
    GpsSample,
    ImuSample,
    MeasurementSample,
    Mode,
    RangeSample,
    Sample,
    SwitchMode,
    VehicleStatusSample,
    Verdict,
)
from modelserver.named_tuples import new_tuple
from modelserver.transforms.so3 import Array

CONSTRAINT_PERIOD: Final = 0.1
"""Seconds between two non-holonomic updates, if no wheel sample brings one."""

HELD_SPEED: Final = 1.5
HELD_TILT: Final = 0.05
HELD_TURN: Final = 0.05
HELD_RATE: Final = 0.01
"""Sigma of the speed (m/s), the tilt and the turn (rad) and the gyro's bias (rad/s) after a mistaken rest of seconds: a
tilt explains a speed that did not change."""

SEPARATE_CORRELATION: Final = 0.1
"""Correlation of heading and latency up to which fixes separate the two; on a steady circle it becomes 0.5."""

ZUPT_PERIOD: Final = 0.2
"""Seconds between two zero-velocity updates."""

IMU_ORIENTATION_PERIOD: Final = 0.5
"""Seconds between two updates by the IMU's own orientation or magnetometer."""

IMU, MODE, STEERING = "inertial", "mode", "steering"
"""Kinds of items that are not measurements of the registry."""


class Item(NamedTuple):
    """One measurement of a sample, at its instant. Items are fused in the order of their first four fields.

    `measurement` is None for the propagation by an IMU sample, the steering angle of a vehicle status, and a command to
    switch the mode.
    """

    utime: int
    source: str
    seq: int
    part: int
    kind: str
    measurement: Measurement | None
    sample: Sample | SwitchMode

    @property
    def key(self) -> tuple[int, str, int, int]:
        """The order of items: instant, source, sequence number, part of the sample."""
        return (self.utime, self.source, self.seq, self.part)


Fused: TypeAlias = tuple[FilterState, tuple[Decision, ...]]

Handler: TypeAlias = Callable[[Setup, FilterState, Item], Fused]

NOTHING: Final[tuple[Decision, ...]] = ()


def split_sample(setup: Setup, sample: Sample | SwitchMode) -> list[Item]:
    """Return the items of a sample."""
    header = sample.header
    utime, source, seq = header.utime, header.source, header.seq
    items: list[Item] = []
    if isinstance(sample, ImuSample):
        items.append(new_tuple(Item, (utime, source, seq, 0, IMU, None, sample)))
    elif isinstance(sample, SwitchMode):
        items.append(Item(utime, source, seq, 0, MODE, None, sample))
    elif isinstance(sample, VehicleStatusSample):
        if setup.rig.steering is not None:
            items.append(Item(utime, source, seq, 0, STEERING, None, sample))
        if setup.rig.speedometer is not None and setup.wheels is not None:
            wheels = read_speedometer(sample, setup.rig.speedometer)
            items.append(Item(utime, source, seq, 1, setup.wheels.kind, setup.wheels, wheels))
    elif isinstance(sample, MeasurementSample):
        own = OwnMeasurement(setup.own.get(source, ""))
        items.append(Item(utime, source, seq, 1, own.type or own.kind, own, sample))
    for part, measurement in enumerate(setup.measurements.get(type(sample), ()), start=1):
        instant = measurement.get_utime(sample)
        if instant is not None:
            items.append(Item(instant, source, seq, part, measurement.kind, measurement, sample))
    return items


# --- decisions ----------------------------------------------------------------------------------------------


def reject(item: Item, reason: str) -> Decision:
    return Decision(item.utime, item.source, item.seq, item.kind, Verdict.REJECTED, reason)


def report_reset(item: Item, reason: str) -> Decision:
    return Decision(item.utime, item.source, item.seq, item.kind, Verdict.RESET, reason)


def report_event(state: Navigating, kind: str, verdict: Verdict, text: str) -> Decision:
    return Decision(state.nav.utime, "filter", 0, kind, verdict, text)


# --- modes --------------------------------------------------------------------------------------------------

_WORLD_SAMPLES = (AbsolutePoseSample, RangeSample)


def uses_item(setup: Setup, mode: Mode, item: Item) -> bool:
    """Return whether a mode uses a measurement."""
    sample = item.sample
    if isinstance(sample, GpsSample):
        return setup.uses_gnss(mode)
    if isinstance(sample, ImuSample):
        return mode is not Mode.NO_IMU and (mode is not Mode.DEAD_RECKONING or item.kind == "imu_tilt")
    if isinstance(item.measurement, OwnMeasurement):
        return mode is not Mode.DEAD_RECKONING or not item.measurement.is_absolute
    return not (mode is Mode.DEAD_RECKONING and isinstance(sample, _WORLD_SAMPLES))


def accept_fix(setup: Setup, state: FilterState, sample: GpsSample) -> AcceptedFix | str:
    """Return the fix, or in one word why it is not good enough."""
    fix = evaluate_fix(sample, setup.settings, not state.common.receiver.states_type)
    geodesy = state.common.geodesy
    if isinstance(fix, str) or geodesy is None:
        return fix
    try:
        geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0)
    except GeodesyError:
        return "range"
    return fix


# --- updates ------------------------------------------------------------------------------------------------


def create_context(setup: Setup, state: Navigating, age: float = math.inf, previous: Any = None) -> MeasurementContext:
    """Return what a measurement is compared with, `age` seconds after the previous one of its source."""
    return MeasurementContext(
        state.nav,
        setup.layout,
        setup.settings,
        setup.rig,
        state.site if isinstance(state, Aligned) else None,
        state.common.geodesy,
        state.is_stationary,
        age,
        previous,
        get_steering_angle(setup, state),
    )


def get_steering_angle(setup: Setup, state: Navigating) -> float:
    """Return the steering angle that the vehicle controller measures now, rad; nan without a fresh one."""
    signal, steering = setup.rig.steering, state.common.wheels.steering
    if signal is None or (state.nav.utime - steering.utime) * 1e-6 > signal.max_age:
        return math.nan
    return steering.angle


def remember(common: Common, key: tuple[str, str], item: Item) -> Common:
    """Return the common state with an item as the previous one of its source and kind."""
    return common._replace(previous={**common.previous, key: PreviousSample(item.utime, item.sample)})


def fuse_constraint(setup: Setup, state: N, kind: str, innovation: Innovation) -> tuple[N, Decision]:
    """Return the state after an update without a sensor, and the decision."""
    nav = state.nav
    nav, decision = eskf.update(nav, innovation, setup.settings, nav.utime, "filter", 0, kind)
    return state._replace(nav=nav), decision


def fuse_non_holonomic(setup: Setup, state: N, utime: int) -> tuple[N, tuple[Decision, ...]]:
    """Return the state after the non-holonomic constraint, and the decision.

    There is none for a vehicle that is transported, or may be, since its wheels are at rest while fixes move: they show
    how.
    """
    if isinstance(state, Aligned):
        may_be = state.common.wheels.is_suspect and not propagation.is_outage(state, utime)
        if may_be or state.turns.is_transported:
            return state, NOTHING
    dt = (utime - state.constraints.non_holonomic_utime) * 1e-6
    state = propagation.propagate_covariance(setup, state)
    state = state._replace(constraints=state.constraints._replace(non_holonomic_utime=utime))
    innovation = constraints.non_holonomic(
        create_context(setup, state),
        max(dt, 1e-3),
        are_wheels_stationary=state.stationary.is_confirmed_by_wheels(utime),
    )
    before = state.nav
    state, decision = fuse_constraint(setup, state, constraints.NON_HOLONOMIC, innovation)
    nav = hold_latency(before, state.nav, setup.layout)
    is_measured = state.common.measures_wheel_speed(utime)
    if isinstance(state, Aligned) and propagation.is_outage(state, utime) and not is_measured:
        # a speed that nothing measures may be wrong by more than its uncertainty, and H leaves out the product of its
        # error and the heading's: by it the constraint would turn the heading and change the bias for good
        nav = hold_bias(before, nav, (8, 11))
    return state._replace(nav=nav), (decision,)


def hold_bias(before: NavState, after: NavState, axes: tuple[int, ...] = (11,)) -> NavState:
    """Return the state `after` an update with the yaw gyro's bias of `before`, and no less variance along `axes`.

    8 among them: with the heading of before too.
    """
    lost = {axis: max(before.covariance.item(axis, axis) - after.covariance.item(axis, axis), 0.0) for axis in axes}
    nav = after.change(8, wrap_angle(before.yaw - after.yaw)) if 8 in axes else after
    return nav.change(11, before.gyro_bias[2] - nav.gyro_bias[2]).widen(lost)


def hold_latency(before: NavState, after: NavState, layout: ErrorLayout) -> NavState:
    """Return the state `after` an update with the latency that it had `before`, where fixes cannot separate it.

    What turns the heading on a steady circle stays an error of heading and gyro, which fixes correct.
    """
    if LATENCY not in layout:
        return after
    at, extra = layout.index(LATENCY), layout.extra_index(LATENCY)
    if _is_separate(after.covariance, at):
        return after
    return after.change(at, before.extras[extra] - after.extras[extra])


def _is_separate(P: Array, at: int) -> bool:
    """Return whether fixes separate latency, at index `at`, and heading, by their covariance (n, n)."""
    return bool(P[8, at] ** 2 <= SEPARATE_CORRELATION**2 * P[8, 8] * P[at, at])


def release_motion(state: N) -> N:
    """Return the state with the uncertainty of a vehicle whose wheels are stationary, and that is not."""
    rate = HELD_RATE if state.is_stationary else 0.0  # ZARU
    held = ((3, HELD_SPEED), (4, HELD_SPEED), (6, HELD_TILT), (7, HELD_TILT), (8, HELD_TURN), (11, rate))
    return state._replace(nav=state.nav.widen({axis: sigma * sigma for axis, sigma in held}))


def fuse_measurement(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after a measurement of any kind, behind its gate."""
    sample, measurement = item.sample, item.measurement
    if isinstance(state, Leveling) or measurement is None or not uses_item(setup, state.common.mode, item):
        return state, NOTHING
    if isinstance(sample, GpsSample) and not state.common.receiver.may_use(sample):
        return state, NOTHING  # counted by the position
    key = (item.source, item.kind)
    previous = state.common.previous.get(key)
    age = math.inf if previous is None else (item.utime - previous.utime) * 1e-6
    if isinstance(sample, ImuSample) and age < IMU_ORIENTATION_PERIOD:
        return state, NOTHING
    state = propagation.advance(setup, state, item.utime)
    context = create_context(setup, state, age, None if previous is None else previous.sample)
    innovation = measurement.evaluate(context, sample)
    if isinstance(innovation, str):
        return state, ((reject(item, innovation),) if innovation else NOTHING)
    is_gnss = isinstance(sample, GpsSample)
    if is_gnss and isinstance(state, Aligned) and state.bank is not None and state.bank.excludes_fixes:
        innovation = innovation._replace(monitored="inconsistent")
    nav, decision = eskf.update(context.nav, innovation, setup.settings, item.utime, item.source, item.seq, item.kind)
    state = state._replace(nav=nav)
    if isinstance(state, Aligned) and decision.verdict is Verdict.USED and not is_gnss:
        measures = innovation.jacobian[:, :3] != 0.0
        offset = state.gnss.offset
        a, b, c = (item.utime if measures[:, axis].any() else offset.aided_utimes[axis] for axis in range(3))
        state = state._replace(gnss=state.gnss._replace(offset=offset._replace(aided_utimes=(a, b, c))))
    return state._replace(common=remember(state.common, key, item)), (decision,)
