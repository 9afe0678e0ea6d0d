"""GNSS position and height: heading alignment before the heading is known, then the logic around the update.

The quality of a fix is checked, the origin captured from the first good ones, and the fix compared with the path of
dead reckoning. What becomes of a fix at its gate (use, drift, rejection, position reset) is decided here, on the
values of the GNSS monitor.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

from modelserver.earth.geodesy import LocalFrame, ecef_from_geodetic, origin_at
from modelserver.estimation.filter import (
    bank_step,
    eskf,
    fusion,
    gnss_monitor,
    heading_alignment,
    heading_step,
    leveling,
)
from modelserver.estimation.filter.eskf import Earth, Innovation, NavState
from modelserver.estimation.filter.fusion import (
    NOTHING,
    Fused,
    Item,
    accept_fix,
    create_context,
    fuse_measurement,
    hold_latency,
    reject,
    report_event,
    report_reset,
)
from modelserver.estimation.filter.gnss_monitor import MOVING_TIME, TurnMonitor, TurnNode, find_turn
from modelserver.estimation.filter.heading_alignment import PathFix, Rotation, to_horizontal
from modelserver.estimation.filter.measurements.gnss import (
    GpsPosition,
    locate_fix,
    read_velocity,
    split_variance,
)
from modelserver.estimation.filter.measurements.measurement import wrap_angle
from modelserver.estimation.filter.state import (
    Aligned,
    FilterState,
    Leveling,
    Navigating,
    PendingDecision,
    S,
    Setup,
    Unaligned,
    is_speed_known,
)
from modelserver.estimation.inputs import AcceptedFix
from modelserver.messages import Decision, FixType, GpsSample, Verdict
from modelserver.transforms import so3

# --- quality and origin -------------------------------------------------------------------------------------


def _capture_origin(setup: Setup, state: S, fix: AcceptedFix, utime: int) -> S:
    """Return the state with a fix more for the origin, which is set once no delayed sample can change it."""
    common, settings = state.common, setup.settings
    if common.geodesy is not None or any(each.origin is not None for each in common.pending):
        return state
    height = 0.0 if math.isnan(fix.height) else fix.height
    ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
    capture, origin = common.capture.add_fix(utime, ecef, fix.sigma, settings)
    if origin is None and isinstance(state, Aligned) and state.gnss.num_confirmed >= settings.origin_fixes:
        # fixes that agree with the motion are as good as fixes along a straight line
        origin = origin_at(fix.latitude_deg, fix.longitude_deg, height)
    state = state._replace(common=common._replace(capture=capture))
    if origin is None:
        return state
    return _wait_horizon(setup, state, PendingDecision(utime, origin=origin))


def _wait_horizon(setup: Setup, state: S, decision: PendingDecision) -> S:
    """Return the state with a decision of this instant pending until no delayed sample can change it."""
    due = decision._replace(utime=decision.utime + round(setup.settings.horizon * 1e6))
    return state._replace(common=state.common._replace(pending=(*state.common.pending, due)))


# --- position and height ------------------------------------------------------------------------------------


MOTION_SPAN_US: Final = 6_000_000
"""Microseconds over which fixes show that a vehicle moves whose heading is unknown."""


def fuse_fix(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after the position of a fix."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsPosition)
    receiver = state.common.receiver.update(sample)
    if receiver is not state.common.receiver:
        state = state._replace(common=state.common._replace(receiver=receiver))
    fix = accept_fix(setup, state, sample)
    if isinstance(fix, str):
        return state, (reject(item, fix),)
    is_used = setup.uses_gnss(state.common.mode)
    if is_used:
        state = _capture_origin(setup, state, fix, item.utime)
    if isinstance(state, Leveling):
        if not setup.uses_imu(state.common.mode) and setup.wheels is None:
            return leveling.start_level(setup, state, item.utime), NOTHING
        if _shows_motion(setup, state, sample):
            return _set_moving(state, item.utime), NOTHING
        return state, NOTHING
    state = fusion.advance(setup, state, item.utime)
    if isinstance(state, Unaligned):
        return _fuse_unaligned(setup, state, item, sample, fix, is_used)
    return _fuse_aligned(setup, state, item, sample, measurement, fix, is_used)


def _fuse_unaligned(
    setup: Setup, state: Unaligned, item: Item, sample: GpsSample, fix: AcceptedFix, is_used: bool
) -> Fused:
    """Return the state after a fix before the heading is known."""
    site, earth = state.site, state.earth
    if site is None:
        height = 0.0 if math.isnan(fix.height) else fix.height
        site = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, height)
        earth = Earth.at(fix.latitude_deg, height).without_heading()
    newest = _compare_with_path(setup, state, site, fix, sample.fix_type)
    # a smooth drive at a walk shows in the fixes of some seconds only
    since = newest.utime - MOTION_SPAN_US
    earlier = next((each for each in state.alignment.fixes if each.utime >= since), None)
    for each in (state.alignment.last_fix, earlier):
        if each is not None and gnss_monitor.shows_motion(each, newest, setup.settings):
            if state.is_stationary and not state.common.measures_wheel_speed(newest.utime):
                # it has set off so smoothly that it seemed stationary
                speed = abs(newest.position - each.position) / ((newest.utime - each.utime) * 1e-6)
                state = state._replace(nav=state.nav.widen({3: speed**2, 4: speed**2}))
            state = _set_moving(state, newest.utime)
            break
    state = state._replace(site=site, earth=earth, alignment=state.alignment._replace(last_fix=newest))
    if not is_used:
        return state, NOTHING
    is_known = is_speed_known(state)
    state, fit = heading_step.align_by_fixes(setup, state, newest)
    if fit is None:
        return state, NOTHING
    nav = state.nav if is_known else heading_alignment.set_speed(state.nav, fit.travel * fit.factor, fit.factor_sigma)
    aligned = heading_step.initialize(setup, state, nav, fit.rotation, newest)
    aligned = _allow_start(aligned, newest, fit.distance)
    text = f"heading to {math.degrees(fit.rotation.sigma):.1f} deg by {fit.distance:.1f} m driven"
    return aligned, (report_reset(item, text),)


def _fuse_aligned(
    setup: Setup,
    state: Aligned,
    item: Item,
    sample: GpsSample,
    measurement: GpsPosition,
    fix: AcceptedFix,
    is_used: bool,
) -> Fused:
    """Return the state after a fix, with the logic of the GNSS monitor around the update."""
    settings, layout, nav = setup.settings, setup.layout, state.nav
    newest = _compare_with_path(setup, state, state.site, fix, sample.fix_type)
    before = state.gnss.last_fix
    is_continuous = gnss_monitor.is_continuous(before, newest, settings)
    since = 0.0 if before is None else (newest.utime - before.utime) * 1e-6
    if gnss_monitor.shows_motion(before, newest, settings):
        state = _set_moving(state, newest.utime)
    state = state._replace(gnss=state.gnss._replace(last_fix=newest))
    if state.heading_check is not None and is_used:
        state, decisions = _check_heading(setup, state, newest)
        if decisions:
            return state, decisions
    bank = state.bank
    if is_used and bank is None and heading_step.is_heading_lost(setup, state):
        lost, decisions = _fuse_unaligned(setup, heading_step.lose_heading(state), item, sample, fix, is_used)
        return lost, (report_reset(item, "the heading is lost"), *decisions)
    adds_nothing = _adds_nothing(setup, state, fix)
    decisions = NOTHING
    # a restored heading has its own check
    if is_used and state.bank is not None:
        state, decisions = bank_step.advance(setup, state, newest)
        if state.bank is not None and state.bank.excludes_fixes:
            return state, (*decisions, reject(item, "inconsistent"))
    if is_used and not (adds_nothing and not state.turns.is_transported):
        # a stationary vehicle does not follow the fixes
        state, more = _compare_turns(setup, state, newest)
        decisions += more
    nav = state.nav
    if not adds_nothing:
        inflated = gnss_monitor.inflate_correlated_error(nav, state.gnss.noise_inflation, since, layout, settings)
        state = state._replace(nav=inflated)
    innovation = measurement.evaluate(create_context(setup, state), sample)
    if isinstance(innovation, str):
        return state, decisions
    if not is_used or adds_nothing:
        innovation = innovation._replace(monitored="at_rest" if is_used else "mode")
    if not is_used:
        _, decision = eskf.update(nav, innovation, settings, item.utime, item.source, item.seq, item.kind)
        return state, (decision,)
    uncorrected = state.nav
    state, decision = _gate_fix(setup, state, innovation, newest, item, is_continuous=is_continuous)
    if decision.verdict is Verdict.USED:
        state = state._replace(nav=hold_latency(uncorrected, state.nav, layout))
    if not adds_nothing and decision.verdict is Verdict.USED:
        gnss = state.gnss.learn_inflation(decision, since, settings)
        sigma = (newest.correlated, newest.correlated, 0.0)
        offset = gnss.offset.update(state.nav, sigma, since, slice(0, 2), layout, settings)
        state = state._replace(gnss=gnss._replace(offset=offset))
    if state.heading_check is None:
        settled, more = bank_step.settle(setup, state, bank)
        return settled, (*decisions, decision, *more)
    return state, (*decisions, decision)


def _compare_with_path(
    setup: Setup, state: Navigating, site: LocalFrame, fix: AcceptedFix, fix_type: FixType
) -> PathFix:
    settings, rig, nav = setup.settings, setup.rig, state.nav
    lever = rig.lever_arm(rig.gps_frame)
    x, y, z = nav.point(lever)
    east, north, up = locate_fix(fix, site, z)
    if isinstance(state, Unaligned):
        # a heading is found once, and lasts: no receiver is believed more than its type then
        fix = dataclasses.replace(fix, is_stated=False)
    white_e, correlated_e = split_variance(fix.east_variance, fix, fix_type, settings)
    white_n, correlated_n = split_variance(fix.north_variance, fix, fix_type, settings)
    arm = so3.rotate(nav.attitude, rig.pose(rig.gps_frame).xyz)
    unit_path, accelerated_path, is_known = 0j, 0j, True
    if isinstance(state, Unaligned):
        unit_path = state.alignment.unit_path
        accelerated_path = state.alignment.accelerated_path + to_horizontal(so3.rotate(nav.attitude, lever))
        is_known = is_speed_known(state)
    return PathFix(
        nav.utime,
        complex(east, north),
        up,
        complex(x, y),
        to_horizontal(arm),
        unit_path,
        math.sqrt(0.5 * (white_e + white_n)),
        math.sqrt(0.5 * (correlated_e**2 + correlated_n**2)),
        split_variance(fix.up_variance, fix, fix_type, settings)[1],
        accelerated_path,
        is_known,
    )


def _shows_motion(setup: Setup, state: Leveling, sample: GpsSample) -> bool:
    """Return whether fixes show, before leveling, that the vehicle moves: by velocity, or by their positions."""
    stated = None if state.common.receiver.is_unfilled(sample) else read_velocity(sample, setup.settings)
    if stated is not None:
        velocity, R = stated
        return math.hypot(velocity[0], velocity[1]) > 4.0 * math.sqrt(max(R[0, 0], R[1, 1])) + 0.2
    fixes = state.common.capture.fixes
    return len(fixes) > 1 and math.dist(fixes[0][1], fixes[-1][1]) > 4.0 * (fixes[0][2] + fixes[-1][2])


def _set_moving(state: S, utime: int) -> S:
    return state._replace(common=state.common._replace(moving_until=utime + round(MOVING_TIME * 1e6)))


def _adds_nothing(setup: Setup, state: Aligned, fix: AcceptedFix) -> bool:
    """Return whether the vehicle is stationary, and known as well as the fix.

    The time-correlated error would otherwise move a stationary vehicle about (report 7: erratic when stationary).
    """
    P = state.nav.covariance
    return state.is_stationary and max(P[0, 0], P[1, 1]) <= max(fix.sigma, setup.settings.gps_sigma_floor) ** 2 * 1.1


def _gate_fix(
    setup: Setup, state: Aligned, innovation: Innovation, newest: PathFix, item: Item, *, is_continuous: bool
) -> tuple[Aligned, Decision]:
    """Return the state after a fix, with what follows from its gate: drift, rejection, reset of the position."""
    settings, nav, gnss = setup.settings, state.nav, state.gnss
    utime = nav.utime
    after, decision = eskf.update(nav, innovation, settings, utime, item.source, item.seq, "gps_position")
    is_within = decision.statistic <= decision.limit or decision.verdict is Verdict.USED
    if decision.dof and not decision.statistic <= decision.limit and is_continuous and not gnss.num_rejected:
        drifted = _fuse_drifted(setup, nav, innovation, item, decision)
        if drifted is not None:
            nav, after, decision = drifted
            is_within = True
    if decision.verdict is Verdict.MONITORED and is_within:
        return _confirm(state, utime), decision
    if decision.verdict is Verdict.USED:
        shift = math.hypot(after.position[0] - nav.position[0], after.position[1] - nav.position[1])
        state = _confirm(state, utime)
        common, gnss = state.common, state.gnss.allow_outlier(nav, innovation, decision)
        if shift > settings.jump_epoch:
            common = common._replace(epoch=common.epoch + 1)
        return state._replace(nav=after, common=common, gnss=gnss), decision
    if decision.verdict is Verdict.MONITORED:
        decision = decision._replace(verdict=Verdict.REJECTED, reason="gate")
    is_measured = state.common.measures_wheel_speed(nav.utime)
    gnss = gnss.reject(newest, settings, is_speed_measured=is_measured)
    state = state._replace(nav=nav, gnss=gnss)
    pending = state.common.pending
    is_due = state.bank is None and not any(each.resets_position for each in pending)
    if is_due and state.gnss.fit_rejected(nav, settings) is not None:
        state = _wait_horizon(setup, state, PendingDecision(utime, resets_position=True))
    return state, decision


def _fuse_drifted(
    setup: Setup, nav: NavState, innovation: Innovation, item: Item, decision: Decision
) -> tuple[NavState, NavState, Decision] | None:
    """Return the state with the time-correlated error inflated until a fix that drifted passes, the state after the
    fix, and the decision; None if it does not pass.
    """
    settings, layout = setup.settings, setup.layout
    excess = decision.statistic / decision.dof
    first = 1.0 + excess * settings.gps_correlation_time / 2.0 * 0.01
    inflated = gnss_monitor.inflate_correlated_error(nav, first, 1.0, layout, settings)
    for _ in range(12):
        after, again = eskf.update(inflated, innovation, settings, nav.utime, item.source, item.seq, "gps_position")
        if again.statistic <= 2.0 * again.dof:
            break
        more = 1.0 + settings.gps_correlation_time * 0.01 * excess
        inflated = gnss_monitor.inflate_correlated_error(inflated, more, 1.0, layout, settings)
    if again.verdict is not Verdict.USED:
        return None
    return inflated, after, again._replace(reason="drift")


def _confirm(state: Aligned, utime: int) -> Aligned:
    """Return the state after a fix that agrees: rejected ones before it were outliers."""
    common = state.common
    if common.pending:
        common = common._replace(pending=tuple(each for each in common.pending if not each.resets_position))
    return state._replace(common=common, gnss=state.gnss.confirm(utime))


def fuse_height(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after the height of a fix; one that drifts shows that the whole fix does."""
    if isinstance(state, Aligned) and state.gnss.num_rejected:
        return state, NOTHING  # the decision on the position is that on the fix
    previous = state.common.previous.get((item.source, item.kind))
    state, decisions = fuse_measurement(setup, state, item)
    if isinstance(state, Aligned) and decisions and decisions[0].residual and previous is not None:
        since = (item.utime - previous.utime) * 1e-6
        gnss = state.gnss.learn_inflation(decisions[0], since, setup.settings)
        if gnss.last_fix is not None and not state.is_stationary:
            sigma = (0.0, 0.0, gnss.last_fix.up_sigma)
            offset = gnss.offset.update(state.nav, sigma, since, slice(2, 3), setup.layout, setup.settings)
            gnss = gnss._replace(offset=offset)
        state = state._replace(gnss=gnss)
    return state, decisions


def _compare_turns(setup: Setup, state: Aligned, newest: PathFix) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after the comparison of its heading with its gyro at a fix, where there is no bank.

    Where there is one, its headings are what those after it are compared with.
    """
    nav, reckoning, settings = state.nav, state.reckoning, setup.settings
    if nav.utime - reckoning.gyro_utime > settings.rate_hold * 1e6:
        return state, NOTHING
    P = nav.covariance
    if not math.isfinite(P[0, 0] + P[8, 8] + P[11, 11]):
        return state, NOTHING  # it has diverged
    node = TurnNode(
        nav.utime,
        newest.position,
        newest.white,
        nav.yaw,
        reckoning.predict_turn(nav.utime),
        nav.gyro_bias[2],
        float(P[8, 8]),
        float(P[11, 11]),
        reckoning.turn_variance,
    )
    before = state.turns
    if state.common.measures_wheel_speed(nav.utime):
        return state._replace(turns=before.append(node)), NOTHING
    noise = fusion.select_noise(setup, state, nav).yaw
    is_at_rest = state.common.wheels.is_suspect
    speed = math.hypot(*nav.velocity)
    turns = before.compare(node, noise, settings.gyro_bias_walk**2, speed, is_at_rest=is_at_rest)
    state = state._replace(turns=turns)
    if turns.suspect is None:
        if not before.is_transported:
            return state, NOTHING
        text = "the vehicle drives by itself: its heading turns as the gyro does"
        return state, (report_event(state, bank_step.KIND, Verdict.USED, text),)
    if not before.is_transported:
        turned = math.degrees(abs(find_turn(turns.suspect, node)))
        text = f"the vehicle moves {turned:.0f} deg beside its own axis"
        return state, (report_event(state, bank_step.KIND, Verdict.RESET, text),)
    shown = turns.find_own_course()
    if shown is None or is_at_rest:
        return state, NOTHING
    heading, sigma = shown
    angle = wrap_angle(heading - nav.yaw)
    if abs(angle) > 0.5 * math.pi:
        return state, NOTHING  # it may drive in reverse
    if abs(angle) > 2.0 * math.hypot(sigma, math.sqrt(float(P[8, 8]))):
        turned_nav = heading_alignment.rotate(nav.forget([8]), Rotation(angle, sigma), setup.layout)
        # fixes show the velocity, whatever the heading
        state = state._replace(nav=turned_nav._replace(position=nav.position, velocity=nav.velocity))
    common = state.common._replace(epoch=state.common.epoch + 1)
    state = state._replace(common=common, turns=TurnMonitor())
    text = "the vehicle drives by itself: its course turns as it does"
    return state, (report_event(state, bank_step.KIND, Verdict.RESET, text),)


def _check_heading(setup: Setup, state: Aligned, newest: PathFix) -> tuple[Aligned, tuple[Decision, ...]]:
    """Return the state after a fix more for the check of a restored heading: confirmed, corrected, or still neither."""
    check, rotation, decision = heading_step.check_heading(setup, state, newest)
    state = state._replace(heading_check=check)
    if rotation is not None:
        state = heading_step.start_epoch(heading_step.initialize(setup, state, state.nav, rotation, newest))
    return state, () if decision is None else (decision,)


def reset_position(setup: Setup, state: Aligned) -> tuple[Aligned, Decision | None]:
    """Return the state with its position, and if it was wrong its heading, re-initialized from the rejected fixes.

    A heading that only a course contradicts is not trusted any more, nor is the course.
    """
    nav = state.nav
    fit = state.gnss.fit_rejected(nav, setup.settings)
    if fit is None:
        return state, None
    sigma = math.hypot(fit.rotation.sigma, math.sqrt(nav.covariance[8, 8]))
    rotation = fit.rotation if abs(fit.rotation.angle) > 3.0 * sigma else Rotation(0.0, 0.0)
    newest = state.gnss.rejected[-1]
    if rotation is fit.rotation and not state.common.measures_wheel_speed(nav.utime) and state.turns.newest:
        # fixes show a course alone, which is not the heading of a vehicle that is transported
        text = f"fixes move {math.degrees(abs(rotation.angle)):.0f} deg beside the vehicle's own axis"
        decision = Decision(nav.utime, "filter", 0, "gps_position", Verdict.RESET, text)
        return heading_step.place(setup, state._replace(turns=state.turns.transport()), newest), decision
    state = heading_step.initialize(setup, state, nav, rotation, newest)
    if rotation is fit.rotation:
        state = _allow_start(state, newest, fit.distance)
    decision = Decision(
        nav.utime, "filter", 0, "gps_position", Verdict.RESET, "fixes agree with the path driven, the state does not"
    )
    return heading_step.start_epoch(state), decision


def _allow_start(state: Aligned, newest: PathFix, distance: float) -> Aligned:
    """Return the state after fixes along a path of some length, m, have shown its heading."""
    fix_sigma = math.hypot(newest.white, newest.correlated)
    is_measured = state.common.measures_wheel_speed(newest.utime)
    return state._replace(turns=state.turns.start_heading(fix_sigma, distance, is_measured=is_measured))
