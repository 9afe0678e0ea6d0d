"""Consistency of fixes and path: what follows from the consistency monitor's findings.

Drifting fixes are excluded until they agree again: the state goes back to dead reckoning from before the drift. A gyro
or wheels that err are corrected by the fit, and then by the fixes.
"""

from __future__ import annotations

import cmath
import math
from typing import Final

import numpy as np

from modelserver.estimation.filter import eskf, heading_alignment, protection_levels
from modelserver.estimation.filter.consistency_monitor import CONFIRMATIONS, ConsistencyMonitor
from modelserver.estimation.filter.error_layout import ErrorLayout
from modelserver.estimation.filter.eskf import NavState
from modelserver.estimation.filter.fusion import correct_path, report_event
from modelserver.estimation.filter.heading_alignment import PathFix, Rotation, to_horizontal
from modelserver.estimation.filter.latency_estimator import compute_heading_variance, is_separate
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, LARGEST_CORRELATED, LATENCY
from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.measurements.wheels import SCALE
from modelserver.estimation.filter.path_fits import Cause, Inconsistency, fit_drift
from modelserver.estimation.filter.path_windows import PathNode, PathNoise
from modelserver.estimation.filter.propagation import select_noise
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import Aligned
from modelserver.messages import Decision, Verdict

KIND: Final = "consistency"

FIT_SHARE: Final = 0.3
"""Sigma of a correction by a fit, as a share of it: the fit takes the change for one at the start of the window."""

EXCLUSION: Final = 1.5
"""Times `recovery_time` for which fixes that have jumped are not used: then the pose follows them, and is not valid."""


def _create_node(setup: Setup, state: Aligned, newest: PathFix) -> PathNode:
    """Return a fix beside the path and the state. Wheels alone do not measure turns well enough to judge fixes by."""
    nav, monitor, layout = state.nav, state.consistency, setup.layout
    P = nav.covariance
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    velocity = to_horizontal(nav.point_velocity(lever))
    has_gyro = setup.uses_imu(state.common.mode)
    return PathNode(
        nav.utime,
        newest.position - cmath.rect(1.0, nav.yaw) * monitor.lever_arm,
        newest.path,
        velocity,
        nav.angular_rate[2],
        monitor.path,
        monitor.moment,
        (nav.utime - monitor.begin) * 1e-6,
        monitor.rotation,
        monitor.distance,
        nav.gyro_bias[2],
        nav.extras[layout.extra_index(SCALE)] if SCALE in layout else 0.0,
        float(P[8, 8]),
        float(P[11, 11]),
        float(P[layout.index(SCALE), layout.index(SCALE)]) if SCALE in layout else 1e-4,
        has_gyro,
        has_gyro and state.common.measures_wheel_speed(nav.utime),
        wrap_angle(nav.yaw - monitor.rotation),
        monitor.bias_turn,
        nav.extras[layout.extra_index(LATENCY)],
        float(P[layout.index(LATENCY), layout.index(LATENCY)]),
        is_separate(P, layout.index(LATENCY)),
        monitor.lost,
        monitor.unmeasured,
        newest.white,
        newest.correlated,
        (float(P[0, 0]), float(P[1, 1]), float(P[0, 1])),
    )


def compare_path(
    setup: Setup, state: Aligned, newest: PathFix, *, is_compared: bool
) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after the comparison of a fix with the path until then, and what follows from it.

    Where the state does not follow the fix (`is_compared` is false), only the path continues.
    """
    settings, P = setup.settings, state.nav.covariance
    if not math.isfinite(P[0, 0] + P[8, 8] + P[11, 11]):
        return state, ()  # it has diverged
    is_measured = state.common.measures_wheel_speed(newest.utime)
    monitor = state.consistency.extend(newest.utime, newest.path, state.nav.gyro_bias[2], is_measured=is_measured)
    is_gap = setup.uses_imu(state.common.mode) and newest.utime - state.imu.used_utime > 1e6 * settings.rate_hold
    if is_gap or not is_compared:
        return state._replace(consistency=monitor), ()
    node = _create_node(setup, state._replace(consistency=monitor), newest)
    noise = PathNoise(select_noise(setup, state, state.nav).yaw, settings.gyro_bias_walk**2, state.gnss.noise_inflation)
    monitor = monitor.compare(node, noise, settings)
    found = monitor.find_cause(node, noise, settings)
    monitor = monitor.append(node)
    if found is not None:
        return _handle(setup, state._replace(consistency=monitor), found, newest)
    if monitor.cause is Cause.HEADING and monitor.suspect is not None:
        return _drive_by_itself(setup, state._replace(consistency=monitor))
    if monitor.suspect is not None:
        monitor, agrees = monitor.check_trust(node, noise, settings)
        state = state._replace(consistency=monitor)
        if agrees:
            return _trust(setup, state, newest, node, noise)
        alike = monitor.select_moved_alike(node)
        if alike and (realigned := _realign(setup, state, newest, alike, noise)) is not None:
            text = "fixes are trusted again: they move as dead reckoning does"
            return realigned, (report_event(realigned, KIND, Verdict.RESET, text),)
        if monitor.excludes_fixes and (node.utime - monitor.since) * 1e-6 > EXCLUSION * settings.recovery_time:
            state = _place(setup, state._replace(consistency=monitor.end_exclusion()), newest)
            text = "dead reckoning has lasted too long: the pose follows fixes that are not trusted"
            return state, (report_event(state, KIND, Verdict.RESET, text),)
        return state, ()
    return state._replace(consistency=monitor), ()


def _handle(
    setup: Setup, state: Aligned, found: Inconsistency, newest: PathFix
) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after an inconsistency."""
    monitor, gnss, common, nav = state.consistency, state.gnss, state.common, state.nav
    after = state._replace(consistency=monitor.resolve(found, nav.utime))
    nav, text = _resolve(setup, state, found)
    if nav is not state.nav:
        common = common._replace(epoch=common.epoch + 1)
    if found.is_jump:
        gnss = gnss._replace(rejected=())
    after = after._replace(nav=nav, gnss=gnss, common=common)
    if monitor.excludes_fixes and not after.consistency.excludes_fixes:
        # the path was wrong, and the state has followed it
        after = _place(setup, after, newest)
    return after, (report_event(after, KIND, Verdict.RESET, text),)


def _trust(
    setup: Setup, state: Aligned, newest: PathFix, node: PathNode, noise: PathNoise
) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after fixes that agree with dead reckoning since the suspect node again."""
    monitor = state.consistency
    assert monitor.suspect is not None
    text = "fixes are trusted again: they agree with dead reckoning"
    turned = monitor.rotation - monitor.suspect.rotation
    if monitor.excludes_fixes:
        trusting = monitor.trust(node, noise, setup.settings)
        after = state._replace(consistency=trusting, gnss=state.gnss.restart(newest.utime))
        return after, (report_event(after, KIND, Verdict.USED, text),)
    after = state._replace(consistency=hold_heading(setup, state, state.nav).trust(node, noise, setup.settings))
    # the fixes have turned the state since
    P = state.nav.covariance.copy()
    P[8, 8] += turned**2
    after = _start_epoch(setup, after._replace(nav=state.nav._replace(covariance=P)), newest)
    return after, (report_event(after, KIND, Verdict.RESET, text),)


def hold_heading(setup: Setup, state: Aligned, nav: NavState) -> ConsistencyMonitor:
    """Return the monitor with the bound of the heading of `nav`, the state before a correction, as `held`."""
    variance = float(nav.covariance[8, 8]) + compute_heading_variance(nav, setup.layout)
    level = protection_levels.compute_heading(variance, setup.settings)
    return state.consistency.hold_heading(level, nav.utime)


def _realign(
    setup: Setup, state: Aligned, newest: PathFix, alike: tuple[PathNode, ...], noise: PathNoise
) -> Aligned | None:
    """Return the state in a new epoch with the heading that fixes and path show; None if they do not show it."""
    nav, held = state.nav, hold_heading(setup, state, state.nav)
    fit = fit_drift(alike, state.consistency.rotation, noise, setup.settings)
    if not (fit.is_steady and fit.excludes(state.consistency.drift_rate)):
        return None
    if fit.turn_sigma > setup.settings.align_sigma:
        return None
    nav = _follow_turn(nav, fit.turn, fit.turn_sigma, setup.layout)
    monitor = held.restart()._replace(suspicion=fit.largest, horizontal_allowance=fit.largest)
    return _start_epoch(setup, state._replace(nav=nav), newest)._replace(consistency=monitor)


def _drive_by_itself(setup: Setup, state: Aligned) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state of a vehicle that was transported, with the heading that its own turns show, if they do."""
    monitor, nav = state.consistency, state.nav
    shown = monitor.find_own_course()
    if shown is None:
        return state, ()
    rotation, sigma = shown
    turn = wrap_angle(rotation - monitor.rotation)
    if abs(turn) > 0.5 * math.pi:
        return state, ()  # it may drive in reverse
    # fixes show the velocity, whatever the heading
    turned = _follow_turn(nav, turn, sigma, setup.layout)._replace(velocity=nav.velocity)
    common = state.common._replace(epoch=state.common.epoch + 1)
    state = state._replace(nav=turned, common=common, consistency=hold_heading(setup, state, turned).restart())
    return state, (
        report_event(state, KIND, Verdict.RESET, "the vehicle drives by itself: its course turns as it does"),
    )


def follow_transport(setup: Setup, state: Aligned, newest: PathFix) -> Aligned:
    """Return the state at a fix that moves beside the vehicle's own axis, with its heading, which is not trusted."""
    monitor = state.consistency
    if monitor.suspect is None:
        monitor = monitor._replace(cause=Cause.HEADING, since=state.nav.utime, suspect=monitor.last, num_exceeded=0)
    return _place(setup, state._replace(consistency=monitor), newest)


def _start_epoch(setup: Setup, state: Aligned, newest: PathFix) -> Aligned:
    """Return the state in a new epoch; at the fix, if the state has not followed the fixes."""
    at = setup.layout.extra_index(CORRELATED_ERROR[0])
    has_followed = abs(complex(*state.nav.extras[at : at + 2])) < LARGEST_CORRELATED
    if has_followed and not state.gnss.num_rejected:
        return state._replace(common=state.common._replace(epoch=state.common.epoch + 1))
    return _place(setup, state, newest)


def _place(setup: Setup, state: Aligned, newest: PathFix) -> Aligned:
    """Return the state at a fix, in a new epoch."""
    before = state.nav
    nav = heading_alignment.place(before, newest, 0j, setup.rig.lever_arm(setup.rig.gps_frame), setup.layout)
    gnss = state.gnss.place(newest.utime)._replace(outlier_allowance=0.0)
    state = state._replace(nav=nav, gnss=gnss, common=state.common._replace(epoch=state.common.epoch + 1))
    return correct_path(setup, state, before)


def _resolve(setup: Setup, state: Aligned, found: Inconsistency) -> tuple[NavState, str]:
    """Return the state without the error that was found, and the finding in words."""
    layout, nav, start = setup.layout, state.nav, found.discrepancy.node
    seconds = (nav.utime - start.utime) * 1e-6
    text = f"fixes are {abs(found.discrepancy.error):.1f} m off the path of the last {seconds:.0f} s: "
    # the state has followed the fixes by a part of it already
    if found.cause is Cause.GYRO:
        whole = found.change * seconds
        nav = _turn(nav, whole - found.turned, FIT_SHARE * abs(whole), layout)
        nav = _release_roll(nav, found.change)
        nav = _correct(nav, 11, start.rate_bias - found.change - nav.gyro_bias[2], layout)
        return nav, text + f"the gyro's bias has changed by {math.degrees(found.change):.2f} deg/s"
    if found.cause is Cause.WHEELS and SCALE in layout:
        followed = nav.extras[layout.extra_index(SCALE)] - start.scale
        nav = _correct(nav, layout.index(SCALE), -found.change - followed, layout)
        return nav, text + f"the wheels' scale has changed by {-100.0 * found.change:.1f} %"
    if found.cause is Cause.LATENCY:
        followed = nav.extras[layout.extra_index(LATENCY)] - start.latency
        nav = _correct(nav, layout.index(LATENCY), found.change - followed, layout)
        return nav, text + f"they are {found.change:.2f} s later than before"
    if found.cause is Cause.LEVER_ARM:
        x, y = found.lever_arm.real, found.lever_arm.imag
        return nav, text + f"the antenna is {x:.2f} m forward and {y:.2f} m left of where the geometry states it"
    if found.cause is Cause.HEADING:
        return nav, f"the vehicle moves {math.degrees(abs(found.change)):.0f} deg beside its own axis"
    if found.is_jump:
        # where the gate has rejected them the state has not followed
        has_followed = state.gnss.num_rejected < CONFIRMATIONS - 1
        return _go_back(setup, state, found) if has_followed else nav, text + "they jumped"
    return nav, text + "they drift"


def _correct(nav: NavState, index: int, change: float, layout: ErrorLayout) -> NavState:
    """Return the state with one element changed by what a fit has found."""
    P = nav.covariance.copy()
    variance = (FIT_SHARE * change) ** 2
    P[index, index] += change * change
    H = np.zeros((1, layout.size))
    H[0, index] = 1.0
    error, P = eskf.correct(P, np.array((change,)), H, np.array(((variance,),)))
    return nav.inject(error, P)


def _release_roll(nav: NavState, change: float) -> NavState:
    """Return the state with the uncertainty of a roll that has explained a change of the gyro's bias, rad/s.

    The constraint has tilted the vehicle until gravity alone explained an acceleration sideways, speed times `change`.
    """
    x, y, _ = nav.velocity
    ahead = math.hypot(x, y) * change / eskf.STANDARD_GRAVITY * np.array((math.cos(nav.yaw), math.sin(nav.yaw)))
    P = nav.covariance.copy()
    P[6:8, 6:8] += np.outer(ahead, ahead)
    return nav._replace(covariance=P)


def _turn(nav: NavState, angle: float, sigma: float, layout: ErrorLayout) -> NavState:
    """Return the state turned about where it is, with its velocity."""
    return heading_alignment.rotate(nav, Rotation(angle, sigma), layout)._replace(position=nav.position)


def _follow_turn(nav: NavState, angle: float, sigma: float, layout: ErrorLayout) -> NavState:
    """Return the state turned by an angle that is shown to `sigma`, rad, unless its heading agrees with that."""
    if abs(angle) <= 2.0 * math.hypot(sigma, math.sqrt(float(nav.covariance[8, 8]))):
        return nav
    P = nav.covariance.copy()
    P[8, :] = P[:, 8] = 0.0
    return _turn(nav._replace(covariance=P), angle, sigma, layout)


def _turn_back(setup: Setup, state: Aligned, start: PathNode) -> NavState:
    """Return the state with the heading that it had at a node and the turns since, where it is."""
    nav = state.nav
    seconds = (nav.utime - start.utime) * 1e-6
    variance = start.heading_variance + setup.driving.yaw * seconds + start.rate_variance * seconds**2
    sigma = math.sqrt(max(variance - float(nav.covariance[8, 8]), 0.0))
    return _turn(nav, start.rotation - state.consistency.rotation, sigma, setup.layout)


def _go_back(setup: Setup, state: Aligned, found: Inconsistency) -> NavState:
    """Return the state at dead reckoning since the start of the window, without the corrections by fixes since."""
    layout = setup.layout
    worst = found.discrepancy
    start = worst.node
    nav = _turn_back(setup, state, start)
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    shift = start.antenna + worst.displacement - to_horizontal(nav.point(lever))
    x, y, z = nav.position
    P = nav.covariance.copy()
    at = layout.index(CORRELATED_ERROR[0])
    extras = list(nav.extras)
    for axis in (0, 1, at, at + 1):
        P[axis, :] = 0.0
        P[:, axis] = 0.0
    a, b, c = (float(p + q) for p, q in zip(start.position_covariance, worst.covariance, strict=True))
    P[0, 0], P[1, 1], P[0, 1], P[1, 0] = a, b, c, c
    P[at, at] = P[at + 1, at + 1] = 1.0
    for name in CORRELATED_ERROR[:2]:
        extras[layout.extra_index(name)] = 0.0
    return nav._replace(position=(x + shift.real, y + shift.imag, z), covariance=P, extras=tuple(extras))
