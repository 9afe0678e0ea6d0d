"""The engine: one measurement after the other, in the order of their instants, each leading from state to state.

`fused(setup, state, item)` is a pure function. Nothing here knows in which order things arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from modelserver.geodesy import Geodesy
from modelserver.localization.filter import fixes, motion, placing, start, updates
from modelserver.localization.filter.alignment import Passed
from modelserver.localization.filter.measurements import Compared, Measurement, Scene, constraints
from modelserver.localization.filter.measurements.aiding import AbsolutePose
from modelserver.localization.filter.measurements.base import wrapped
from modelserver.localization.filter.measurements.gps import GpsBaseline, GpsPosition, baseline_sigma
from modelserver.localization.filter.measurements.orientation import Yaw, yaw_told
from modelserver.localization.filter.measurements.wheels import WheelSpeed, standing_wheels, turn_rate
from modelserver.localization.filter.nav import ZERO, Nav
from modelserver.localization.filter.setup import Setup
from modelserver.localization.filter.state import FilterState, Last, Said
from modelserver.messages import (
    AbsolutePoseSample,
    Decision,
    GpsSample,
    ImuSample,
    Mode,
    Phase,
    RangeSample,
    Sample,
    SwitchMode,
    Verdict,
    WheelsSample,
    YawSource,
)
from modelserver.spatial import so3
from modelserver.spatial.so3 import Vector3

MOST_RATE = 35.0
"""rad/s: 2000 deg/s, the widest range of gyros on vehicles."""

MOST_FORCE = 500.0
"""m/s2: 50 g, the widest range of accelerometers on vehicles."""

CONSTRAINT_PERIOD = 0.1
"""Seconds between two uses of what is known of rolling vehicles, where no wheel sample brings it along."""

REST_PERIOD = 0.2
"""Seconds between two uses of standing."""

BIASES_AGE = 600.0
"""Seconds that gyro biases kept aside are taken to be old: few vehicles drive for longer without a stop."""

UNKNOWN_SPEED = 2.0
"""Sigma of the horizontal speed, m/s, from which on nothing is known of it: that of a walk."""

INERTIAL = "inertial"


class Item(NamedTuple):
    """One measurement of a sample, at its instant. Items are fused in the order of their first four fields.

    `measurement` is None for the inertial part of an inertial sample, and for an order to switch the mode.
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
        """What items are ordered by: instant, source, sequence, part of the sample."""
        return (self.utime, self.source, self.seq, self.part)


Fused: TypeAlias = tuple[FilterState, tuple[Decision, ...]]

_NOTHING: tuple[Decision, ...] = ()


def items(setup: Setup, sample: Sample | SwitchMode) -> list[Item]:
    """Return what a sample measured, each at its instant."""
    header = sample.header
    found: list[Item] = []
    if isinstance(sample, (ImuSample, SwitchMode)):
        kind = INERTIAL if isinstance(sample, ImuSample) else "mode"
        found.append(Item(header.utime, header.source, header.seq, 0, kind, None, sample))
    for part, measurement in enumerate(setup.measurements.get(type(sample), ()), start=1):
        instant = measurement.instant(sample)
        if instant is not None:
            found.append(Item(instant, header.source, header.seq, part, measurement.kind, measurement, sample))
    return found


def first(setup: Setup, mode: Mode, geodesy: Geodesy | None) -> FilterState:
    """Return the state that has seen nothing yet."""
    return FilterState(mode=mode, geodesy=geodesy)


def fused(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with one item more, and what became of it."""
    decisions = _NOTHING
    if state.pending and state.pending[0].utime <= item.utime:
        state, decisions = _latched(setup, state, item.utime)
    state, more = _HANDLERS.get(item.kind, _measured)(setup, state, item)
    nav = state.nav
    if nav is not None and not (updates.sound if more else updates.plausible)(nav, setup.settings):
        state, diverged = _diverged(setup, state, item)
        more = (*more, diverged)
    return state, decisions + more


# --- the inertial unit --------------------------------------------------------------------------------------


def _inertial(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, ImuSample)
    if state.mode is Mode.NO_IMU:
        return state, _NOTHING
    found = read(setup, sample)
    if isinstance(found, str):
        return state, (_refused(item, found),)
    rate, force = found
    said = Said(item.utime, rate, force, item.utime)
    if state.said is not None:
        said = state.said.followed(item.utime, rate, force)
    if (item.utime - said.since) * 1e-6 > setup.settings.frozen_time:
        return state._replace(said=said), (_refused(item, "frozen"),)
    decisions = _NOTHING
    if said.made_up != state.guessed:
        state = motion.caught_up(setup, state)._replace(guessed=said.made_up)
        if said.made_up:
            decisions = (_refused(item, "made_up")._replace(verdict=Verdict.MONITORED),)
    nav = state.nav
    bias = ZERO if nav is None else nav.gyro_bias
    sigma = setup.settings.gyro_bias_sigma
    if nav is not None:
        P = nav.covariance
        sigma = math.sqrt(max(P[9, 9], P[10, 10], P[11, 11]))
    stillness = state.stillness.felt(item.utime, rate, force, bias, sigma, setup.settings)
    if nav is None:
        was = state.tilt
        state = state._replace(stillness=stillness, said=said)
        state = start.levelled(setup, state, item.utime, rate, force)
        if state.tilt and state.tilt != was:
            return state, (_refused(item, "mount"),)
        return state, _NOTHING
    gap = (item.utime - state.imu_utime) * 1e-6 > setup.settings.rate_hold and state.imu_utime > 0
    state = motion.felt(setup, state, item.utime, rate, force, stillness, said)
    if gap:
        decisions += (_refused(item, "gap")._replace(verdict=Verdict.MONITORED),)
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
    standing = still.seconds(utime) >= settings.standing_time and _may_stand(setup, state, utime)
    if standing != state.standing:
        state = motion.caught_up(setup, state)._replace(standing=standing, rested_utime=utime)
    nav = state.nav
    assert nav is not None
    if standing:
        dt = (utime - state.rested_utime) * 1e-6
        if dt < REST_PERIOD:
            return state, _NOTHING
        state = motion.caught_up(setup, state)._replace(rested_utime=utime)
        state, decision = _known(
            setup, state, constraints.ZERO_VELOCITY, constraints.zero_velocity(_scene(setup, state), dt)
        )
        decisions: tuple[Decision, ...] = (decision,)
        if still.summed > 0.0:
            if still.seconds(utime) >= settings.recapture_time:
                scene = _scene(setup, state)
                compared = constraints.zero_rate(scene, still.mean_rate, state.earth.rotation, still.summed)
                state, decision = _known(setup, state, constraints.ZERO_RATE, compared)
                decisions = (*decisions, decision)
                state = _biases_kept(setup, state, decision)
            state = state._replace(stillness=still.used())
        return state, decisions
    if (utime - state.rolled_utime) * 1e-6 < CONSTRAINT_PERIOD:
        return state, _NOTHING
    if state.wheels_utime and (utime - state.wheels_utime) * 1e-6 < setup.settings.wheel_period + CONSTRAINT_PERIOD:
        return state, _NOTHING  # the next wheel sample brings it along
    return _rolled(setup, state, utime)


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


def _rolled(setup: Setup, state: FilterState, utime: int) -> Fused:
    dt = (utime - state.rolled_utime) * 1e-6
    state = motion.caught_up(setup, state)._replace(rolled_utime=utime)
    compared = constraints.non_holonomic(_scene(setup, state), max(dt, 1e-3))
    state, decision = _known(setup, state, constraints.NON_HOLONOMIC, compared)
    return state, (decision,)


def _may_stand(setup: Setup, state: FilterState, utime: int) -> bool:
    """Return whether nothing speaks against standing: wheels, fixes that move, the state's own speed."""
    settings, nav = setup.settings, state.nav
    assert nav is not None
    if state.mode is not Mode.NO_WHEELS and state.stillness.vouched(utime):
        return True
    if utime < state.moved:
        return False
    speed = math.hypot(*nav.velocity)
    if state.standing:
        return speed < 10.0 * settings.standing_speed
    P = nav.covariance
    sigma = math.sqrt(max(P[3, 3], P[4, 4]))
    if state.phase is not Phase.ALIGNED and sigma > 1.0:
        # nothing told the speed yet: quiet and with fixes that keep their place is all there is
        return state.fixed is not None and (utime - state.fixed.utime) * 1e-6 < fixes.SAME_PLACE
    return speed - 2.0 * sigma < settings.standing_speed and speed < 0.5


def _known(setup: Setup, state: FilterState, kind: str, compared: Compared) -> tuple[FilterState, Decision]:
    nav = state.nav
    assert nav is not None
    nav, decision = updates.used(nav, compared, setup.settings, nav.utime, "filter", 0, kind)
    return state._replace(nav=nav), decision


# --- wheels -------------------------------------------------------------------------------------------------


def _wheels(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, WheelsSample)
    assert isinstance(measurement, WheelSpeed)
    if state.mode is Mode.NO_WHEELS:
        return state, _NOTHING
    key = (item.source, item.kind)
    seen = (item.source, "seen")
    last, newest = state.last.get(key), state.last.get(seen)
    before = None if last is None else last.sample
    settings = setup.settings
    stands = standing_wheels(sample, None if newest is None else newest.sample, measurement.contacts, settings)
    state = _remembered(state._replace(stillness=state.stillness.rolled(item.utime, stands)), seen, item)
    if state.nav is None:
        if not motion.inertial(setup, state.mode):
            state = _begun_level(setup, state, item.utime)
        return state, _NOTHING
    age = math.inf if last is None else (item.utime - last.utime) * 1e-6
    bridged = motion.inertial(setup, state.mode) and measurement.by_travel(sample, before)
    if bridged and age < settings.wheel_period - 0.01:
        return state, _NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    scene = _scene(setup, state, age, before)
    compared = measurement.compare(scene, sample)
    decisions = _NOTHING
    if isinstance(compared, str):
        decisions = (_refused(item, compared),) if compared else _NOTHING
    else:
        if _speed_unknown(scene.nav):
            # the way wheels err is a share of speed: compared at the speed that they tell, not at 0
            rolling = updates.moving(scene.nav, compared, setup.rig.base, min(age, settings.wheel_period))
            again = measurement.compare(scene._replace(nav=rolling), sample)
            if not isinstance(again, str):
                scene, compared = scene._replace(nav=rolling), again
        nav, decision = updates.used(scene.nav, compared, settings, item.utime, item.source, item.seq, item.kind)
        gyro = motion.inertial(setup, state.mode) and (item.utime - state.imu_utime) * 1e-6 <= settings.rate_hold
        rate = 0.0 if gyro else turn_rate(sample, before, measurement, settings)
        state = state._replace(nav=nav, wheels_utime=item.utime, wheels_rate=rate)
        decisions = (decision,)
    now = state.nav
    assert now is not None
    state = _remembered(state._replace(nav=now._replace(rolled=ZERO, turned=ZERO)), key, item)
    if not motion.inertial(setup, state.mode):
        # without an inertial unit the wheels alone say when the vehicle stands
        state = state._replace(standing=stands is True)
        rested = (item.utime - state.rested_utime) * 1e-6
        if state.standing and rested >= REST_PERIOD:
            compared = constraints.zero_velocity(_scene(setup, state), rested)
            state, decision = _known(setup, state, constraints.ZERO_VELOCITY, compared)
            decisions += (decision,)
        if not state.standing or rested >= REST_PERIOD:
            state = state._replace(rested_utime=item.utime)
    if not state.standing and (item.utime - state.rolled_utime) * 1e-6 >= 0.5 * CONSTRAINT_PERIOD:
        state, more = _rolled(setup, state, item.utime)
        decisions += more
    return state, decisions


def _speed_unknown(nav: Nav) -> bool:
    P = nav.covariance
    return float(P[3, 3] + P[4, 4]) > UNKNOWN_SPEED**2


def _begun_level(setup: Setup, state: FilterState, utime: int) -> FilterState:
    """Return the state of a vehicle without inertial unit, which is taken to stand level."""
    nav = start.first_nav(setup, utime, so3.IDENTITY, start.LEVEL_SIGMA, 0.5 * setup.settings.maximum_speed, ZERO, 1e-6)
    return state._replace(nav=nav, phase=Phase.UNALIGNED, began=utime, rolled_utime=utime, rested_utime=utime)


def _remembered(state: FilterState, key: tuple[str, str], item: Item) -> FilterState:
    return state._replace(last=MappingProxyType({**state.last, key: Last(item.utime, item.sample)}))


# --- fixes --------------------------------------------------------------------------------------------------


def _without_gps(mode: Mode) -> bool:
    return mode in (Mode.NO_GPS, Mode.DEAD_RECKONING)


def _fix(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsPosition)
    fix = fixes.good(setup, state, sample)
    if isinstance(fix, str):
        return state, (_refused(item, fix),)
    unused = "mode" if _without_gps(state.mode) else ""
    if not unused:
        state = fixes.captured(setup, state, fix, item.utime)
    if state.nav is None:
        if not motion.inertial(setup, state.mode) and setup.wheels is None:
            state = _begun_level(setup, state, item.utime)
        elif fixes.moving(setup, state, sample):
            state = state._replace(moved=item.utime + round(fixes.SAME_PLACE * 1e6))
        return state, _NOTHING
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
            return state, _NOTHING
        by_unit = not fixes.speed_known(setup, state, nav)
        state, fit = fixes.sought(setup, state, newest)
        if fit is None:
            return state, _NOTHING
        state = fixes.aligned(setup, state, fit, by_unit=by_unit)
        return state, (_took_up(item, f"heading to {math.degrees(fit.sigma):.1f} deg by {fit.distance:.1f} m driven"),)
    resting = fixes.at_rest(setup, _scene(setup, state), fix)
    if not resting:
        state = state._replace(nav=fixes.widened(setup, nav, state.restless, since))
    scene = _scene(setup, state)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        return state, _NOTHING
    if unused or resting:
        compared = compared._replace(monitored=unused or "at_rest")
    if unused:
        _, decision = updates.used(nav, compared, setup.settings, item.utime, item.source, item.seq, item.kind)
        return state, (decision,)
    state, decisions = fixes.put(setup, state, compared, newest, item.source, item.seq, steady=steady)
    if not resting and decisions[0].verdict is Verdict.USED:
        state = state._replace(restless=fixes.learnt(setup, state.restless, decisions[0], since))
        state = fixes.shown(setup, state, (newest.lingering, newest.lingering, 0.0), since, slice(0, 2))
    return state, decisions


def _height(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with a height; one that drifts says that the whole fix does."""
    if state.refused_count:
        return state, _NOTHING  # what is said of the position is said of the fix
    last = state.last.get((item.source, item.kind))
    state, decisions = _measured(setup, state, item)
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
    wandered = newest.lingering * math.sqrt(2.0 * (1.0 - math.exp(-dt / setup.settings.gps_wander_time)))
    if abs(newest.place - last.place) > 4.0 * math.hypot(1.5 * newest.white, wandered) + 0.1:
        return state._replace(moved=newest.utime + round(fixes.SAME_PLACE * 1e6))
    return state


def _velocity(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, GpsSample)
    nav = state.nav
    if _without_gps(state.mode) or nav is None:
        return state, _NOTHING
    if state.phase is Phase.ALIGNED:
        return _measured(setup, state, item)
    if isinstance(fixes.good(setup, state, sample), str):
        return state, _NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    found = fixes.by_velocity(setup, state, sample, item.utime)
    nav, newest = state.nav, state.fixed
    if found is None or nav is None or newest is None:
        return state, _NOTHING
    turn, sigma, speed = found
    if math.isfinite(speed):
        nav = placing.at_speed(nav, speed, setup.settings.velocity_sigma)
    state = fixes.into_world(setup, state, nav, turn, sigma, newest)
    return state, (_took_up(item, f"heading, to {math.degrees(sigma):.1f} deg, by the receiver's velocity"),)


def _baseline(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsBaseline)
    if _without_gps(state.mode) or state.nav is None or isinstance(fixes.good(setup, state, sample), str):
        return state, _NOTHING
    if state.phase is Phase.ALIGNED:
        return _measured(setup, state, item)
    x, y, _ = so3.rotate(state.nav.attitude, measurement.baseline)
    return _by_azimuth(setup, state, item, wrapped(sample.baseline_yaw - math.atan2(y, x)), baseline_sigma(sample))


def _yaw(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, ImuSample)
    assert isinstance(measurement, Yaw)
    if state.mode in (Mode.NO_IMU, Mode.DEAD_RECKONING) or state.nav is None:
        return state, _NOTHING
    if state.phase is Phase.ALIGNED:
        return _measured(setup, state, item)
    magnetic = sample.yaw_source is YawSource.MAGNETIC
    if state.site is None or (magnetic and not setup.settings.use_magnetometer):
        return state, _NOTHING
    told = yaw_told(_scene(setup, state)._replace(site=state.site), sample, measurement.mount)
    if isinstance(told, str):
        return state, _NOTHING
    turn = wrapped(told - state.nav.yaw)
    return _by_azimuth(setup, state, item, turn, setup.settings.magnetic_sigma)


def _by_azimuth(setup: Setup, state: FilterState, item: Item, turn: float, sigma: float) -> Fused:
    """Return the state in the world by a heading that something tells outright, once a fix is there."""
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    nav, newest = state.nav, state.fixed
    if nav is None or newest is None or (item.utime - newest.utime) * 1e-6 > fixes.FRESH:
        return state, _NOTHING
    state = fixes.into_world(setup, state, nav, turn, sigma, newest)
    return state, (_took_up(item, f"heading, to {math.degrees(sigma):.1f} deg"),)


# --- all others ---------------------------------------------------------------------------------------------


def _measured(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with any measurement that needs no logic of its own."""
    sample, measurement = item.sample, item.measurement
    if state.nav is None or measurement is None or not _counts(state.mode, item):
        return state, _NOTHING
    key = (item.source, item.kind)
    last = state.last.get(key)
    age = math.inf if last is None else (item.utime - last.utime) * 1e-6
    if isinstance(sample, ImuSample) and age < 0.5:
        return state, _NOTHING
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    scene = _scene(setup, state, age, None if last is None else last.sample)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        return state, ((_refused(item, compared),) if compared else _NOTHING)
    nav, decision = updates.used(scene.nav, compared, setup.settings, item.utime, item.source, item.seq, item.kind)
    if decision.verdict is Verdict.USED and not isinstance(sample, GpsSample):
        tells = compared.jacobian[:, :3] != 0.0
        a, b, c = (item.utime if tells[:, axis].any() else state.anchored[axis] for axis in range(3))
        state = state._replace(anchored=(a, b, c))
    return _remembered(state._replace(nav=nav), key, item), (decision,)


def _absolute(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state with an absolute pose: before heading is known one with position and orientation sets it."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, AbsolutePoseSample)
    if state.nav is None and not motion.inertial(setup, state.mode):
        state = _begun_level(setup, state, item.utime)
    if state.phase is Phase.ALIGNED or state.nav is None or not _counts(state.mode, item):
        return _measured(setup, state, item)
    if sample.position is None or sample.orientation is None or state.geodesy is None:
        return state, _NOTHING
    assert isinstance(measurement, AbsolutePose)
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    return fixes.set_from(setup, state, measurement, sample, _scene(setup, state), item.source, item.seq)


_WORLDLY = (AbsolutePoseSample, RangeSample)


def _counts(mode: Mode, item: Item) -> bool:
    """Return whether a mode uses a measurement."""
    sample = item.sample
    if isinstance(sample, GpsSample):
        return not _without_gps(mode)
    if isinstance(sample, ImuSample):
        return mode is not Mode.NO_IMU and (mode is not Mode.DEAD_RECKONING or item.kind == "imu_tilt")
    return not (mode is Mode.DEAD_RECKONING and isinstance(sample, _WORLDLY))


def _mode(setup: Setup, state: FilterState, item: Item) -> Fused:
    sample = item.sample
    assert isinstance(sample, SwitchMode)
    state = motion.caught_up(setup, motion.at(setup, state, item.utime))
    return state._replace(mode=sample.mode), (_took_up(item, f"mode {sample.mode.name.lower()}"),)


# --- shared -------------------------------------------------------------------------------------------------


def _scene(setup: Setup, state: FilterState, age: float = math.inf, before: Any = None) -> Scene:
    assert state.nav is not None
    site = state.site if state.phase is Phase.ALIGNED else None
    return Scene(state.nav, setup.layout, setup.settings, setup.rig, site, state.geodesy, state.standing, age, before)


def _latched(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with the decisions in force whose time has come: nothing can change them any more."""
    decisions = _NOTHING
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
    """Return the state begun anew after it became absurd; origin, mode and good biases stay."""
    fresh = FilterState(
        mode=state.mode,
        geodesy=state.geodesy,
        capture=state.capture,
        epoch=state.epoch + 1,
        biases=state.biases,
    )
    word = Decision(item.utime, item.source, item.seq, item.kind, Verdict.TOOK_UP, "the filter had diverged")
    return fresh, word


def _refused(item: Item, reason: str) -> Decision:
    return updates.refused(item.utime, item.source, item.seq, item.kind, reason)


def _took_up(item: Item, reason: str) -> Decision:
    return Decision(item.utime, item.source, item.seq, item.kind, Verdict.TOOK_UP, reason)


Handler: TypeAlias = Callable[[Setup, FilterState, Item], Fused]

_HANDLERS: dict[str, Handler] = {
    INERTIAL: _inertial,
    "mode": _mode,
    "wheel_speed": _wheels,
    "gps_position": _fix,
    "gps_height": _height,
    "gps_velocity": _velocity,
    "gps_baseline": _baseline,
    "imu_yaw": _yaw,
    "absolute_pose": _absolute,
}
