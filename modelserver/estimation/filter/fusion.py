"""What the handlers of items share: the state propagated to an item's instant, and updated with it.

Propagation is by the IMU, by the wheels' turn rate, or at constant velocity. Between IMU samples, and up to `rate_hold`
after the last one, the last sample holds. After that, or without an IMU, the speed is constant and the turn rate that
of a gyro that measures nothing else, or of the wheels, if they measure one; the process noise covers what is unknown. A
stationary vehicle does not turn: what its gyros measure is their bias and the earth rate.

An `Item` is one measurement of a sample at its instant. A handler is a pure function (setup, state, item) -> (state,
decisions); `fuse_measurement` is the one for every kind that needs no logic of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

from modelserver.earth.geodesy import GeodesyError
from modelserver.estimation.filter import eskf
from modelserver.estimation.filter.eskf import ZERO, ErrorLayout, Innovation, NavState, ProcessNoise
from modelserver.estimation.filter.hypothesis_bank import DeadReckoning
from modelserver.estimation.filter.measurements import Measurement, MeasurementContext
from modelserver.estimation.filter.measurements.gnss import LATENCY
from modelserver.estimation.filter.measurements.measurement import OwnMeasurement, wrap_angle
from modelserver.estimation.filter.measurements.wheels import NON_HOLONOMIC, TurnRate, non_holonomic, read_speedometer
from modelserver.estimation.filter.sensor_monitors import ImuMonitor, StationaryDetector
from modelserver.estimation.filter.state import (
    Aligned,
    Common,
    FilterState,
    Leveling,
    N,
    Navigating,
    PreviousSample,
    Setup,
)
from modelserver.estimation.inputs import AcceptedFix, evaluate_fix
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
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array, Vector3

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


# --- items --------------------------------------------------------------------------------------------------

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
        may_be = state.common.wheels.is_suspect and not is_outage(state, utime)
        if may_be or state.turns.is_transported:
            return state, NOTHING
    dt = (utime - state.constraints.non_holonomic_utime) * 1e-6
    state = propagate_covariance(setup, state)
    state = state._replace(constraints=state.constraints._replace(non_holonomic_utime=utime))
    innovation = non_holonomic(
        create_context(setup, state),
        max(dt, 1e-3),
        are_wheels_stationary=state.stationary.is_confirmed_by_wheels(utime),
    )
    before = state.nav
    state, decision = fuse_constraint(setup, state, NON_HOLONOMIC, innovation)
    nav = hold_latency(before, state.nav, setup.layout)
    is_measured = state.common.measures_wheel_speed(utime)
    if isinstance(state, Aligned) and is_outage(state, utime) and not is_measured:
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
    state = advance(setup, state, item.utime)
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
