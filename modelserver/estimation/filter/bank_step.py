"""Hypothesis bank of an aligned vehicle: started, advanced by dead reckoning and fixes, and what follows from it.

The bank judges the state, and corrects it: it is set to the published hypothesis where that excludes fixes, has a
fault of gyro, wheels or latency that is certain, or another heading, or where the state's own pose is too likely beyond
its limits.
"""

from __future__ import annotations

import cmath
import math
from typing import Final

import numpy as np

from modelserver.estimation.filter import heading_alignment, heading_step, hypothesis_bank, output
from modelserver.estimation.filter.eskf import STRAPDOWN, NavState
from modelserver.estimation.filter.fusion import OUTAGE_US, release_motion, report_event
from modelserver.estimation.filter.gnss_monitor import AIDED_TIME, MOVING_TIME, START_ERROR
from modelserver.estimation.filter.heading_alignment import PathFix, Rotation, to_horizontal
from modelserver.estimation.filter.hypothesis_bank import (
    BIAS,
    DELAY,
    HEADING,
    SHARE_OF_LIMIT,
    SHARED,
    WHEEL_SCALE,
    DeadReckoning,
    Fault,
    HypothesisBank,
    PlanarFix,
)
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, LATENCY
from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.measurements.wheels import SCALE
from modelserver.estimation.filter.protection_levels import LIMIT_RISK, compute_longest_variance
from modelserver.estimation.filter.sensor_monitors import StationaryDetector
from modelserver.estimation.filter.state import Aligned, N, Navigating, Setup, Unaligned
from modelserver.messages import Decision, Verdict
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array

KIND: Final = "consistency"

STEP_US: Final = 400_000
"""Microseconds between two fixes that the bank uses, at least: those between show the same errors."""

LONGEST_STEP_US: Final = 1_500_000
"""Microseconds of a step without a fix."""

SILENT_US: Final = 5_000_000
"""Microseconds without wheels after which a moving vehicle has no path to judge fixes by."""

UNMEASURED_SPEED: Final = 1.0
UNMEASURED_SHARE: Final = 0.3
"""Standard deviation of a speed that wheels do not measure, m/s, or as a share of it; it lasts a second."""

MOVED, TURNED = 1.0, 0.1
"""Distance (m) and angle (rad) by which another hypothesis is another pose."""

CLEARLY_LESS: Final = 0.1
"""Risk of the hypothesis' pose, relative to that of the state's, with which it is another one."""

MOVED_RISK: Final = 0.5
"""Probability that a vehicle moves whose fixes move away at rest, as on a ferry: fixes that drift are alike."""

CERTAIN_SIGMAS: Final = 3.0
"""Standard deviations of a hypothesis' heading by which another one is wrong."""

SKID_SLIP: Final = 3.0
"""Slip of the wheels of a skid-steered vehicle beside that of others: they slide in every turn."""


def can_judge(setup: Setup, state: Aligned, utime: int) -> bool:
    """Return whether wheels and a gyro measure a path to judge fixes by."""
    mode = state.common.mode
    if setup.wheels is None or not setup.uses_gnss(mode) or not state.reckoning.gyro_utime:
        return False
    if not (setup.uses_imu(mode) or setup.yaw_gyro is not None):
        return False
    if utime - max(state.gnss.offset.aided_utimes) < AIDED_TIME * 1e6:
        return False  # another source measures the position, and the bank does not know it
    return state.is_stationary or utime - state.reckoning.utime < SILENT_US


def predict_path(setup: Setup, state: Navigating) -> DeadReckoning:
    """Return dead reckoning at the instant of the state, after the way that it has travelled since the last wheels.

    Where wheels do not measure the speed, the state's own is as good as there is.
    """
    nav, reckoning = state.nav, state.reckoning
    variance = 0.0
    if not state.common.measures_wheel_speed(nav.utime):
        seconds = (nav.utime - reckoning.utime) * 1e-6
        speed = nav.body_velocity(setup.rig.base)[0]
        sigma = max(UNMEASURED_SPEED, UNMEASURED_SHARE * abs(speed))
        variance = sigma**2 * seconds * max(seconds, 1.0)
    return reckoning.drive(nav.utime, get_wheel_travel(setup, nav), variance)


def get_wheel_travel(setup: Setup, nav: NavState) -> float:
    """Return the way since the last wheel sample as wheels measure it: with their scale, m."""
    scale = nav.extras[setup.layout.extra_index(SCALE)] if SCALE in setup.layout else 0.0
    return (1.0 + scale) * nav.travel[0]


def advance(setup: Setup, state: Aligned, newest: PathFix | None = None) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state with its bank at its instant, after a fix or none, and set to a hypothesis that excludes fixes.

    A bank without a path any more ends.
    """
    bank, utime = state.bank, state.nav.utime
    if bank is None:
        return state, ()
    if not can_judge(setup, state, utime):
        return state.end_bank(), ()
    if utime - bank.utime < (STEP_US if newest is not None else LONGEST_STEP_US):
        return state, ()
    now = predict_path(setup, state)
    step = now.since(
        bank.reckoning,
        is_stationary=state.is_stationary,
        are_wheels_stationary=state.stationary.is_confirmed_by_wheels(utime),
    )
    fix = None if newest is None else _read_fix(setup, state, newest)
    after = bank.advance(utime, step, fix, setup.settings, _get_slip(setup))._replace(reckoning=now)
    after = after.judge_fixes(output.get_limits(setup, state)[0])
    state = state._replace(bank=after)
    if after.may_be_transported and abs(after.rest_turn) > TURNED:
        state = suspect_wheels(setup, state)
        state = state._replace(turns=state.turns.transport())
        text = "the vehicle moves and turns, and its wheels do not: it is transported"
        return state, (report_event(state, KIND, Verdict.RESET, text),)
    if newest is None:
        return _judge(setup, state), ()
    if not after.excludes_fixes:
        if not bank.excludes_fixes:
            return state, ()
        state = state._replace(gnss=state.gnss.restart(utime))
        text = "fixes are trusted again: they agree with dead reckoning"
        return state, (report_event(state, KIND, Verdict.USED, text),)
    assert fix is not None
    if not bank.excludes_fixes and _ends_outage(state):
        after = after.suspect_path(utime, fix, setup.settings)
    return _correct(setup, state._replace(bank=after), bank)


def _ends_outage(state: Aligned) -> bool:
    """Return whether fixes are the first ones after a while."""
    rejected = state.gnss.rejected
    first = rejected[0].utime if rejected else state.nav.utime
    return first - state.gnss.used_utime >= OUTAGE_US


def distrust_path(setup: Setup, state: Aligned) -> Aligned:
    """Return the state without its bank, whose path was that of wheels that do not measure: fixes are right."""
    newest = state.gnss.last_fix
    if state.bank is not None and state.bank.excludes_fixes and newest is not None:
        state = heading_step.place(setup, state, newest)
    return state.end_bank()


def suspect_wheels(setup: Setup, state: N) -> N:
    """Return the state of a vehicle that moves with its wheels at rest: they are stuck, or it is transported."""
    until = state.nav.utime + round(MOVING_TIME * 1e6)
    common = state.common._replace(moving_until=until, wheels=state.common.wheels.suspect())
    constraints = state.constraints._replace(is_stationary=False, contradiction=0.0)
    state = release_motion(state)._replace(stationary=StationaryDetector(), common=common, constraints=constraints)
    return distrust_path(setup, state) if isinstance(state, Aligned) else state


def settle(
    setup: Setup, state: Aligned, before: HypothesisBank | None
) -> tuple[Aligned | Unaligned, tuple[Decision, ...]]:
    """Return the state after a fix was used, judged by its bank, and set to its hypothesis where it must be.

    `before`: the bank before the fix. A bank begins with a fix that the state agrees with.
    """
    bank, utime = state.bank, state.nav.utime
    if bank is None:
        if not (can_judge(setup, state, utime) and state.common.measures_wheel_speed(utime)):
            return state, ()
        if state.gnss.used_utime != utime or state.gnss.last_fix is None or state.is_stationary:
            return state, ()
        if state.turns.is_transported:
            text = "the wheels roll again after the vehicle was transported: its heading is lost"
            return heading_step.lose_heading(state), (report_event(state, KIND, Verdict.RESET, text),)
        return _judge(setup, _start(setup, state, state.gnss.last_fix)), ()
    if bank is before:
        return state, ()
    assert before is not None
    return _correct(setup, state, before)


def _correct(setup: Setup, state: Aligned, before: HypothesisBank) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after a fix, used or not, judged by its bank, and set to its hypothesis where it must be.

    `before`: the bank before the fix.
    """
    state = _judge(setup, state)
    reason = _find_reason(setup, state, before)
    if not reason:
        return state, ()
    bank, (limit, _) = state.bank, output.get_limits(setup, state)
    assert bank is not None
    # fixes that are off by the hypothesis that the state is set to would move it away again
    bank = bank.judge_fixes(limit, least=0.0)
    state = _judge(setup, _follow(setup, state._replace(bank=bank)))
    return state, (report_event(state, KIND, Verdict.RESET, reason),)


def _find_reason(setup: Setup, state: Aligned, before: HypothesisBank) -> str:
    """Return in words why the state must be set to the published hypothesis; empty: it need not."""
    bank, bounds, limits = state.bank, state.bounds, output.get_limits(setup, state)
    assert bank is not None
    assert bounds is not None
    if bank.excludes_fixes and not before.excludes_fixes:
        what = "they jumped" if bank.jumped[bank.published] else "they drift"
        return f"fixes are {abs(bank.offset):.1f} m off dead reckoning: {what}"
    if settled := _describe(bank):
        return settled
    if _is_turned(setup, state):
        return "the heading is not that of dead reckoning which fixes agree with"
    if bank.excludes_fixes and _get_distance(setup, state) > SHARE_OF_LIMIT * limits[0]:
        return "fixes that drift show another path than dead reckoning"
    is_other = before.excludes_fixes and not bank.excludes_fixes and _has_moved(setup, state)
    if not is_other and bounds.risk > LIMIT_RISK:
        own = bank.compute_bounds(bank.pose, limits, setup.settings)
        is_other = own.risk < CLEARLY_LESS * bounds.risk
    return "fixes agree with dead reckoning, the pose does not" if is_other else ""


def _start(setup: Setup, state: Aligned, newest: PathFix) -> Aligned:
    nav, settings = state.nav, setup.settings
    values, rows = _share(setup, nav, newest)
    covariance = rows @ nav.covariance @ rows.T
    # fixes have shown the heading, and the allowance for their error decays as others confirm it
    covariance[2, 2] += (state.turns.allowance / START_ERROR) ** 2
    sigma = math.hypot(newest.white, newest.correlated)
    bank = hypothesis_bank.start_bank(nav.utime, sigma, settings, values, covariance)
    return state._replace(bank=bank._replace(reckoning=predict_path(setup, state)))


def _read_fix(setup: Setup, state: Aligned, newest: PathFix) -> PlanarFix:
    nav = state.nav
    back = cmath.rect(1.0, -nav.yaw)
    velocity = to_horizontal(nav.point_velocity(setup.rig.lever_arm(setup.rig.gps_frame)))
    sigma = math.hypot(newest.white, newest.correlated)
    return PlanarFix(newest.position, sigma, newest.arm * back, velocity * back, nav.angular_rate[2])


def _get_slip(setup: Setup) -> float:
    assert setup.wheels is not None
    return setup.settings.slip_ratio * (SKID_SLIP if setup.wheels.skid else 1.0)


def _share(setup: Setup, nav: NavState, newest: PathFix) -> tuple[Array, Array]:
    """Return those states by the filter: values (8), and their rows of its error state (8, n)."""
    layout, n = setup.layout, setup.layout.size
    base = nav.point(setup.rig.base)
    x, y, z = so3.rotate(nav.attitude, setup.rig.base)
    rows = np.zeros((len(SHARED), n))
    rows[0, (0, 7, 8)] = 1.0, z, -y
    rows[1, (1, 6, 8)] = 1.0, -z, x
    rows[2, 8] = rows[3, 11] = 1.0
    values = [base[0], base[1], nav.yaw, nav.gyro_bias[2], 0.0, 0.0, 0.0, 0.0]
    named = ((4, SCALE, 1.0), (5, LATENCY, 1.0), *((6 + k, CORRELATED_ERROR[k], newest.correlated) for k in (0, 1)))
    for row, name, unit in named:
        if name in layout:
            at = layout.index(name)
            rows[row, at] = unit
            values[row] = unit * nav.extras[at - STRAPDOWN]
    return np.array(values), rows


def _follow(setup: Setup, state: Aligned) -> Aligned:
    """Return the state set to the published hypothesis, with its values and covariance; in a new epoch if it moves.

    What else the state knows stays as it is, and is independent of that: its correlations were those of another
    explanation. Only the velocity errs with the heading.
    """
    bank, newest, nav = state.bank, state.gnss.last_fix, state.nav
    assert bank is not None
    assert newest is not None
    has_moved = _has_moved(setup, state)
    mean = bank.means[bank.published]
    turn = wrap_angle(float(mean[HEADING]) - nav.yaw)
    place = nav.position
    nav = heading_alignment.rotate(nav, Rotation(turn, 0.0), setup.layout)._replace(position=place)
    values, rows = _share(setup, nav, newest)
    change = mean[list(SHARED)] - values
    # each is one element of the error state, in a unit of its own
    used = [row for row in range(len(SHARED)) if rows[row].any()]
    at = [int(np.flatnonzero(rows[row])[0]) for row in used]
    units = np.array([rows[row, n] for row, n in zip(used, at, strict=True)])
    error = np.zeros(setup.layout.size)
    error[at] = change[used] / units
    error[8] = 0.0
    target = bank.covariances[bank.published][np.ix_(SHARED, SHARED)]
    T = np.eye(setup.layout.size)
    T[3, 8], T[4, 8] = -nav.velocity[1], nav.velocity[0]
    nav = nav.forget(at, target[np.ix_(used, used)] / np.outer(units, units)).transform(T)
    nav = nav.inject(error, nav.covariance)
    common = state.common._replace(epoch=state.common.epoch + 1) if has_moved else state.common
    gnss = state.gnss.place(state.gnss.used_utime)
    sigma = (newest.correlated, newest.correlated, 0.0)
    offset = gnss.offset.update(nav, sigma, math.inf, slice(0, 2), setup.layout, setup.settings)
    return state._replace(nav=nav, gnss=gnss._replace(offset=offset, outlier_allowance=0.0), common=common)


def _get_pose(setup: Setup, state: Aligned) -> tuple[float, float, float]:
    """Return the pose that is published: east, north (m) and heading (rad) of the rolling frame."""
    x, y, _ = state.nav.point(setup.rig.base)
    a, b, _ = state.gnss.offset.value
    return x + a, y + b, state.nav.yaw


def _get_distance(setup: Setup, state: Aligned) -> float:
    """Return how far the published hypothesis is from the state's position, m."""
    assert state.bank is not None
    (x, y, _), (a, b, _) = state.bank.pose, state.nav.point(setup.rig.base)
    return math.hypot(x - a, y - b)


def _has_moved(setup: Setup, state: Aligned) -> bool:
    """Return whether the published hypothesis is another pose than the state's."""
    assert state.bank is not None
    return _get_distance(setup, state) > MOVED or abs(wrap_angle(state.bank.pose[2] - state.nav.yaw)) > TURNED


def _is_turned(setup: Setup, state: Aligned) -> bool:
    """Return whether the published hypothesis has another heading, by what matters and for certain."""
    bank = state.bank
    assert bank is not None
    _, limit = output.get_limits(setup, state)
    sigma = math.sqrt(float(bank.covariances[bank.published, HEADING, HEADING]))
    turned = abs(wrap_angle(bank.pose[2] - state.nav.yaw))
    return turned > max(SHARE_OF_LIMIT * limit, CERTAIN_SIGMAS * sigma)


def _judge(setup: Setup, state: Aligned) -> Aligned:
    """Return the state with the error by its bank of its pose."""
    assert state.bank is not None
    P = output.compute_covariance(setup, state)
    variances = compute_longest_variance(P), float(P[5, 5])
    limits = output.get_limits(setup, state)
    bounds = state.bank.compute_bounds(_get_pose(setup, state), limits, setup.settings, variances)
    if state.bank.may_be_transported:
        # it is where fixes are, or has stayed
        off = abs(state.bank.offset)
        bounds = bounds._replace(horizontal_level=bounds.horizontal_level + off, horizontal_risk=MOVED_RISK)
    return state._replace(bounds=bounds)


def _describe(bank: HypothesisBank) -> str:
    """Return in words what has become certain, and is corrected."""
    mean = bank.means[bank.published]
    if bank.settled is Fault.GYRO:
        return f"fixes disagree with dead reckoning: the gyro's bias is {math.degrees(mean[BIAS]):.2f} deg/s now"
    if bank.settled is Fault.WHEELS:
        return f"fixes disagree with dead reckoning: the wheels' scale is {100.0 * mean[WHEEL_SCALE]:.1f} % off now"
    if bank.settled is Fault.LATENCY:
        return f"fixes disagree with dead reckoning: they are {mean[DELAY]:.2f} s late now"
    return ""
