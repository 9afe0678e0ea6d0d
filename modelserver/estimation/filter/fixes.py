"""GNSS monitor: heading alignment, rejected jumps, stationary fixes, and position reset (re-initialization).

2005's lesson: a Kalman filter needs logic around it. It stands here, and what it remembers is part of the state, so
that it is set back with it when a measurement comes late.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame, ecef_from_geodetic, geodetic_from_ecef, origin_at
from modelserver.estimation import fix_quality as gate
from modelserver.estimation.filter import alignment, motion, placing, updates
from modelserver.estimation.filter import latency as lateness
from modelserver.estimation.filter.alignment import Fit, Passed, Turn, horizontal
from modelserver.estimation.filter.measurements.aiding import AbsolutePose
from modelserver.estimation.filter.measurements.base import Compared, Scene, wrapped
from modelserver.estimation.filter.measurements.gps import WANDER, place_of, shares, stated_velocity
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState, Pending
from modelserver.estimation.filter.strapdown import Earth
from modelserver.estimation.fix_quality import AcceptedFix
from modelserver.messages import AbsolutePoseSample, Decision, FixType, GpsSample, Phase, Verdict
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

FRESH = 1.5
"""Seconds for which a fix still says where a vehicle is whose heading was just found."""

ANCHORED = 10.0
"""Seconds for which another source that tells the place keeps the pose from going with the fixes."""

COURSE_KNOWN = 0.05
"""Sigma of the course in N, rad, from which on the receiver's course tells how N is turned: about that of a course."""

CONFLICT_FADES = 20.0
"""Seconds after a fix from beyond its gate for which the bound allows for it in full."""

SAME_PLACE = 3.0
"""Seconds of fixes that tell whether the vehicle moves, where wheels do not."""


def good(setup: Setup, state: FilterState, sample: GpsSample) -> AcceptedFix | str:
    """Return the fix, or in one word why it is not good enough."""
    fix = gate.evaluate_fix(sample, setup.settings)
    if isinstance(fix, str):
        return fix
    if state.geodesy is not None:
        try:
            state.geodesy.utm_from_geodetic(fix.latitude_deg, fix.longitude_deg, 0.0)
        except GeodesyError:
            return "range"
    return fix


def captured(setup: Setup, state: FilterState, fix: AcceptedFix, utime: int) -> FilterState:
    """Return the state with a fix more towards the origin; it is set once nothing that comes late can change it."""
    if state.geodesy is not None or any(each.origin is not None for each in state.pending):
        return state
    height = 0.0 if math.isnan(fix.height) else fix.height
    ecef = ecef_from_geodetic(fix.latitude_deg, fix.longitude_deg, height)
    capture, origin = state.capture.add_fix(utime, ecef, fix.sigma, setup.settings)
    state = state._replace(capture=capture)
    if origin is None and state.confirmed >= setup.settings.origin_fixes and state.phase is Phase.ALIGNED:
        # fixes that agree with how the vehicle moved are as good as fixes along a straight line
        origin = origin_at(fix.latitude_deg, fix.longitude_deg, height)
    if origin is None:
        return state
    due = utime + round(setup.settings.horizon * 1e6)
    return state._replace(pending=(*state.pending, Pending(due, origin=origin)))


def passed(setup: Setup, state: FilterState, nav: Nav, fix: AcceptedFix, kind: FixType) -> tuple[FilterState, Passed]:
    """Return a fix beside what the state says at its instant; with the site, which the first fix sets."""
    site, earth = state.site, state.earth
    if site is None:
        height = 0.0 if math.isnan(fix.height) else fix.height
        site = LocalFrame.at(fix.latitude_deg, fix.longitude_deg, height)
        found = Earth.at(fix.latitude_deg, height)
        # before heading is known the horizontal part of the earth's rotation has no direction
        earth = Earth(found.gravity, (0.0, 0.0, found.rotation[2]))
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    x, y, z = nav.point(lever)
    east, north, up = place_of(fix, site, z)
    white_e, lingering_e = shares(fix.east_variance, kind, setup.settings)
    white_n, lingering_n = shares(fix.north_variance, kind, setup.settings)
    arm = so3.rotate(nav.attitude, setup.rig.pose(setup.rig.gps_frame).xyz)
    newest = Passed(
        nav.utime,
        complex(east, north),
        up,
        complex(x, y),
        horizontal(arm),
        state.unit,
        math.sqrt(0.5 * (white_e + white_n)),
        math.sqrt(0.5 * (lingering_e**2 + lingering_n**2)),
        shares(fix.up_variance, kind, setup.settings)[1],
        state.swept + horizontal(so3.rotate(nav.attitude, lever)),
        state.phase is Phase.ALIGNED or speed_known(setup, state, nav),
    )
    return state._replace(site=site, earth=earth), newest


def moving(setup: Setup, state: FilterState, sample: GpsSample) -> bool:
    """Return whether fixes say that a vehicle moves that is not levelled yet: by velocity, or by their places."""
    stated = stated_velocity(sample, setup.settings)
    if stated is not None:
        velocity, R = stated
        return math.hypot(velocity[0], velocity[1]) > 4.0 * math.sqrt(max(R[0, 0], R[1, 1])) + 0.2
    kept = state.capture.fixes
    return len(kept) > 1 and math.dist(kept[0][1], kept[-1][1]) > 4.0 * (kept[0][2] + kept[-1][2])


# --- finding heading ----------------------------------------------------------------------------------------


def speed_known(setup: Setup, state: FilterState, nav: Nav) -> bool:
    """Return whether the state knows how fast, and which way along its own axis, the vehicle goes."""
    if state.on_wheels(nav.utime):
        return True
    P = nav.covariance
    sigma = math.sqrt(max(P[3, 3], P[4, 4]))
    return sigma < max(0.3 * math.hypot(nav.velocity[0], nav.velocity[1]), 0.15)


def sought(setup: Setup, state: FilterState, newest: Passed) -> tuple[FilterState, Fit | None]:
    """Return the state with a fix more towards heading, and how the way lies over the fixes once that is sure."""
    settings, nav = setup.settings, state.nav
    assert nav is not None
    stretch = alignment.kept(state.passed, newest, settings.align_window)
    state = state._replace(passed=stretch, fixed=newest)
    rate_sigma = math.sqrt(nav.covariance[11, 11])
    known = speed_known(setup, state, nav)
    ways = alignment.measured(stretch) if known else stretch
    fit = alignment.fitted(ways, settings, by_unit=not known, rate_sigma=rate_sigma)
    state = state._replace(undirected=False)
    if fit is None or fit.turn.sigma > settings.align_sigma or not alignment.agrees(fit, newest):
        return state, None
    if known and not 0.6 < fit.factor < 1.6:
        # not the way that was driven: fixes that wander, or wheels that spin
        return state, None
    if not known:
        if fit.factor < settings.align_speed:
            return state, None
        travel = direction(setup, state, nav.yaw + fit.turn.angle, fit.factor)
        if not travel:
            return state._replace(undirected=True), None
        if travel < 0:
            fit = alignment.fitted(stretch, settings, by_unit=True, rate_sigma=rate_sigma, travel=-1.0)
    return state, fit


def direction(setup: Setup, state: FilterState, heading: float, speed: float) -> int:
    """Return 1 for a vehicle of unknown velocity that drives forward, -1 for backward, 0 where nothing tells.

    `heading` (rad, N once it is turned) and `speed` (m/s) are those of driving forward along the fixes. Backward the
    heading would be the opposite one; a wrong choice would be believed for long, so none is made without evidence.
    """
    if speed > setup.settings.reverse_speed:
        return 1
    nav = state.nav
    if nav is None or not motion.inertial(setup, state.mode):
        return 0
    return alignment.direction_of_travel(state.passed, heading - nav.yaw, setup.settings)


def aligned(setup: Setup, state: FilterState, fit: Fit, *, by_unit: bool) -> FilterState:
    """Return the state in the world, by a fit of its way and the newest fix."""
    nav, newest = state.nav, state.fixed
    assert nav is not None
    assert newest is not None
    if by_unit:
        nav = placing.at_speed(nav, fit.travel * fit.factor, fit.factor_sigma)
    return into_world(setup, state, nav, fit.turn, newest)


def into_world(setup: Setup, state: FilterState, nav: Nav, turn: Turn, newest: Passed) -> FilterState:
    """Return the state turned by a heading that was found, with its antenna at the newest fix.

    `nav` is the state's own, or that with a speed that was just found. Finding it shifted the place by all that was
    driven at an unknown speed: the way since the fix is at that speed then.
    """
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    if nav is state.nav:
        x, y, _ = nav.point(lever)
        way = complex(x, y) - newest.way
    else:
        way = horizontal(nav.point_velocity(lever)) * (nav.utime - newest.utime) * 1e-6
    moved = way * cmath.rect(1.0, turn.angle)
    nav = lateness.doubted(nav, lateness.told(alignment.measured(state.passed)), setup.layout)
    nav = placing.placed(placing.turned(nav, turn, setup.layout), newest, moved, lever, setup.layout)
    site = state.site
    assert site is not None
    latitude, _, height = geodetic_from_ecef(site.ecef)
    return state._replace(
        nav=nav,
        phase=Phase.ALIGNED,
        earth=Earth.at(latitude, height),
        passed=(),
        refused=(),
        refused_since=0,
        refused_count=0,
        fix_utime=nav.utime,
        stepped=False,
        undirected=False,
    )


def by_velocity(setup: Setup, state: FilterState, sample: GpsSample, utime: int) -> tuple[Turn, float] | None:
    """Return the turn by the receiver's velocity, and the speed (nan: known already); None where it does not tell.

    Where the speed is not known it is signed by the direction of travel; below twice `align_speed` nothing is returned.
    """
    settings, nav, newest = setup.settings, state.nav, state.fixed
    assert nav is not None
    stated = stated_velocity(sample, settings)
    if stated is None or newest is None or (utime - newest.utime) * 1e-6 > FRESH:
        return None
    velocity, R = stated
    z = complex(velocity[0], velocity[1])
    size = abs(z)
    sigma_v = math.sqrt(max(R[0, 0], R[1, 1]))
    if size < settings.align_speed or sigma_v > 0.3 * size:
        return None
    sigma = math.hypot(sigma_v / size, 0.03)
    if speed_known(setup, state, nav):
        v = horizontal(nav.point_velocity(setup.rig.lever_arm(setup.rig.gps_frame)))
        if not 0.6 * size < abs(v) < 1.6 * size:
            return None
        across = np.array((-v.imag, v.real)) / abs(v)
        if across @ nav.covariance[3:5, 3:5] @ across > (COURSE_KNOWN * abs(v)) ** 2:
            # wheels have measured how fast it goes, and nothing yet that it does not slide
            return None
        return Turn(wrapped(cmath.phase(z) - cmath.phase(v)), sigma, nav.turn_rate[2]), math.nan
    if size < 2.0 * settings.align_speed:
        return None
    travel = direction(setup, state, cmath.phase(z), size)
    if not travel:
        return None
    return Turn(wrapped(cmath.phase(travel * z) - nav.yaw), sigma, nav.turn_rate[2]), travel * size


# --- jumps --------------------------------------------------------------------------------------------------


def at_rest(setup: Setup, scene: Scene, fix: AcceptedFix) -> bool:
    """Return whether a fix can say nothing new: the vehicle stands, and is known as well as the fix.

    What lingers in fixes would else drag a standing vehicle about (report 7: erratic when stationary).
    """
    P = scene.nav.covariance
    return scene.standing and max(P[0, 0], P[1, 1]) <= max(fix.sigma, scene.settings.gps_sigma_floor) ** 2 * 1.1


def widened(setup: Setup, nav: Nav, restless: float, seconds: float) -> Nav:
    """Return the state with what lingers in fixes driven faster than the settings say, for the last `seconds`."""
    if restless <= 1.0 or seconds <= 0.0:
        return nav
    at = setup.layout.index(WANDER[0])
    P = nav.covariance.copy()
    more = (restless - 1.0) * 2.0 * min(seconds, 2.0) / setup.settings.gps_correlation_time
    for axis in (at, at + 1, at + 2):
        P[axis, axis] += more
    return nav._replace(covariance=P)


def shown(setup: Setup, state: FilterState, sigma: Vector3, seconds: float, axes: slice) -> FilterState:
    """Return the state with the pose gone along with what lingers in fixes, no faster than it may.

    Where another source tells the place, the pose has no need of it. What following adds to the position's variance is
    kept with it: sigma^2 less what is left unknown, and what it has still to go.
    """
    nav = state.nav
    assert nav is not None
    most = setup.settings.position_slew_rate * min(seconds, 2.0)
    at = setup.layout.extra(WANDER[0])
    first = setup.layout.index(WANDER[0])
    new, doubt = list(state.shown), list(state.doubt)
    for axis in range(3)[axes]:
        told = (nav.utime - state.anchored[axis]) * 1e-6 < ANCHORED
        off = (0.0 if told else sigma[axis] * nav.extras[at + axis]) - new[axis]
        moved = max(-most, min(off, most))
        new[axis] += moved
        left = float(nav.covariance[first + axis, first + axis])
        learnt_variance = 0.0 if told else sigma[axis] ** 2 * max(1.0 - left, 0.0)
        doubt[axis] = learnt_variance + (off - moved) ** 2
    return state._replace(shown=(new[0], new[1], new[2]), doubt=(doubt[0], doubt[1], doubt[2]))


def learnt(setup: Setup, restless: float, decision: Decision, seconds: float) -> float:
    """Return how restless fixes are after one more: its statistic should be its degrees of freedom in the mean."""
    settings = setup.settings
    if not decision.dof or not math.isfinite(decision.statistic):
        return restless
    gain = min(seconds, 2.0) / settings.gps_inflation_time
    ratio = min(decision.statistic / decision.dof, 20.0)
    return min(max(restless * (1.0 + gain * (ratio - 1.0)), 1.0), settings.gps_inflation_limit)


def follows(setup: Setup, before: Passed | None, newest: Passed) -> bool:
    """Return whether a fix lies where the one before and the way since lead to: fixes that drift do, a jump not."""
    if before is None:
        return True
    seconds = (newest.utime - before.utime) * 1e-6
    off = abs((newest.place - before.place) - (newest.way - before.way))
    wandered = newest.lingering * math.sqrt(2.0 * seconds / setup.settings.gps_correlation_time)
    return off <= 5.0 * math.hypot(1.5 * newest.white, wandered)


def put(
    setup: Setup, state: FilterState, compared: Compared, newest: Passed, source: str, seq: int, *, steady: bool
) -> tuple[FilterState, tuple[Decision, ...]]:
    """Return the state after a comparison of a fix, with the logic of jumps around it."""
    settings, nav = setup.settings, state.nav
    assert nav is not None
    utime = nav.utime
    after, decision = updates.used(nav, compared, settings, utime, source, seq, "gps_position")
    within = decision.statistic <= decision.limit or decision.verdict is Verdict.USED
    if decision.dof and not decision.statistic <= decision.limit and steady and not state.refused_count:
        # it drifted here, fix by fix, and did not jump: it is let wander as fast as it does
        excess = decision.statistic / decision.dof
        wide = widened(setup, nav, 1.0 + excess * settings.gps_correlation_time / 2.0 * 0.01, 1.0)
        for _ in range(12):
            after, again = updates.used(wide, compared, settings, utime, source, seq, "gps_position")
            if again.statistic <= 2.0 * again.dof:
                break
            wide = widened(setup, wide, 1.0 + settings.gps_correlation_time * 0.01 * excess, 1.0)
        if again.verdict is Verdict.USED:
            decision, within, nav = again._replace(reason="drift"), True, wide
    if decision.verdict is Verdict.MONITORED and within:
        return _confirmed(state, utime), (decision,)
    if decision.verdict is Verdict.USED:
        shift = math.hypot(after.position[0] - nav.position[0], after.position[1] - nav.position[1])
        epoch = state.epoch + (1 if shift > settings.jump_epoch else 0)
        state = _confirmed(state, utime)._replace(nav=after, epoch=epoch)
        return allowed(state, nav, compared, decision), (decision,)
    if decision.verdict is Verdict.MONITORED:
        decision = decision._replace(verdict=Verdict.REJECTED, reason="gate")
    since = (newest.utime - state.refused[-1].utime) * 1e-6 if state.refused else 0.0
    refused = alignment.kept(state.refused, newest, 2.0 * settings.recovery_time)
    state = state._replace(
        nav=lateness.tardy(setup, state, nav, compared.residual.tolist(), min(since, 2.0)),
        refused=refused,
        refused_since=state.refused_since or utime,
        refused_count=state.refused_count + 1,
    )
    # refused fixes that have agreed with the way driven for long enough are right, and the state is not
    if _recovery(setup, state) is not None:
        due = utime + round(settings.horizon * 1e6)
        if not any(each.take_up for each in state.pending):
            state = state._replace(pending=(*state.pending, Pending(due, take_up=True)))
    return state, (decision,)


def _confirmed(state: FilterState, utime: int) -> FilterState:
    pending = state.pending
    if pending:
        pending = tuple(each for each in pending if not each.take_up)
    return state._replace(
        fix_utime=utime,
        confirmed=min(state.confirmed + 1, 1000),
        refused=(),
        refused_since=0,
        refused_count=0,
        pending=pending,
    )


def allowed(state: FilterState, before: Nav, compared: Compared, decision: Decision) -> FilterState:
    """Return the state with what an outlier just within the gate would have moved the position by, metres.

    The gain's horizontal rows times the gate's radius; of a fix beyond the gate, which was eased in or drifted there,
    all that it is off: either it is wrong or the state was. It fades as newer fixes correct it, and of itself as slowly
    as such conflicts are resolved.
    """
    H, m = compared.jacobian, len(compared.residual)
    S = np.array(decision.innovation_covariance).reshape(m, m)
    gain = np.linalg.solve(S, H @ before.covariance[:, 0:2]).T
    radius = math.sqrt(decision.limit * float(np.trace(S)) / m)
    size = float(np.sqrt((gain * gain).sum()))
    one = size * radius
    weight = 1.0 - min(size, 1.0)
    if decision.reason:
        one = max(one, float(np.linalg.norm(compared.residual)))
    since = (before.utime - state.conflict_utime) * 1e-6
    if decision.reason or since < CONFLICT_FADES:
        weight = 1.0
    return state._replace(
        allowance=max(one, weight * state.allowance),
        conflict_utime=before.utime if decision.reason else state.conflict_utime,
    )


def _recovery(setup: Setup, state: FilterState) -> Fit | None:
    settings, refused, nav = setup.settings, state.refused, state.nav
    assert nav is not None
    if len(refused) < settings.recovery_fixes:
        return None
    seconds = (refused[-1].utime - refused[0].utime) * 1e-6
    if seconds < settings.recovery_time:
        return None
    fit = alignment.fitted(refused, settings, by_unit=False, rate_sigma=math.sqrt(nav.covariance[11, 11]))
    if fit is None or fit.distance < settings.recovery_distance or not alignment.agrees(fit, refused[-1]):
        return None
    if not 0.7 < fit.factor < 1.4 or fit.turn.sigma > settings.align_sigma:
        return None
    return fit


def taken_up(setup: Setup, state: FilterState) -> tuple[FilterState, Decision | None]:
    """Return the state with position, and where it was wrong heading, taken up anew from the refused fixes."""
    fit = _recovery(setup, state)
    nav = state.nav
    if fit is None or nav is None:
        return state, None
    sigma = math.hypot(fit.turn.sigma, math.sqrt(nav.covariance[8, 8]))
    turn = fit.turn if abs(fit.turn.angle) > 3.0 * sigma else Turn(0.0, 0.0)
    state = into_world(setup, state, nav, turn, state.refused[-1])
    decision = Decision(
        nav.utime, "filter", 0, "gps_position", Verdict.RESET, "fixes agree with the way driven, the state does not"
    )
    return state._replace(epoch=state.epoch + 1, allowance=0.0), decision


# --- set outright -------------------------------------------------------------------------------------------


def set_from(
    setup: Setup,
    state: FilterState,
    measurement: AbsolutePose,
    sample: AbsolutePoseSample,
    scene: Scene,
    source: str,
    seq: int,
) -> tuple[FilterState, tuple[Decision, ...]]:
    """Return the state in the world by a position and orientation that an operator or another source tells."""
    nav, geodesy = state.nav, state.geodesy
    assert nav is not None
    assert geodesy is not None
    site = state.site or geodesy.tangent
    scene = scene._replace(site=site)
    compared = measurement.compare(scene, sample)
    if isinstance(compared, str):
        reason = compared or "empty"
        return state, (updates.refused(nav.utime, source, seq, measurement.kind, reason),)
    # the turn outright, for it may be of any size
    turn = wrapped(float(compared.residual[5]))
    nav = placing.turned(nav, Turn(turn, math.sqrt(float(compared.noise[5, 5]))), setup.layout)
    again = measurement.compare(scene._replace(nav=nav), sample)
    assert not isinstance(again, str)
    x, y, z = nav.position
    a, b, c = again.residual[:3].tolist()
    P = nav.covariance.copy()
    P[0:3, :] = 0.0
    P[:, 0:3] = 0.0
    P[0:3, 0:3] = again.noise[:3, :3]
    latitude, _, height = geodetic_from_ecef(site.ecef)
    state = state._replace(
        nav=nav._replace(position=(x + a, y + b, z + c), covariance=P),
        phase=Phase.ALIGNED,
        site=site,
        earth=Earth.at(latitude, height),
        passed=(),
        fix_utime=nav.utime,
        stepped=False,
    )
    word = Decision(nav.utime, source, seq, measurement.kind, Verdict.RESET, "position and heading were set")
    return state, (word,)
