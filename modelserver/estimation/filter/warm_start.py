"""Warm start: restore persisted biases at leveling, and the pose where the vehicle cannot have moved.

Nobody watched the vehicle between the two runs. Biases change slowly whatever was done with it, so they are taken
up with what they may have wandered. The pose is not: heading cannot be seen at rest. It is used only where the
vehicle stood when it was kept and stands now, the time between is short, the wheels' counters went on and did not
move, gravity stands as it stood, and fixes agree where there are any. Until all of this is told there is no pose,
and where any of it is missing the start is as cold as without a kept pose. What was resumed is held against the first
metres driven: see `proving`.
"""

from __future__ import annotations

import math

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame
from modelserver.estimation.filter import kalman, motion
from modelserver.estimation.filter.bias_inflation import aged, with_biases
from modelserver.estimation.filter.handling import without_gps
from modelserver.estimation.filter.items import NOTHING, Fused
from modelserver.estimation.filter.layout import STRAPDOWN
from modelserver.estimation.filter.measurements.gps import WANDER
from modelserver.estimation.filter.nav import ZERO, Nav, jacobian_of_point
from modelserver.estimation.filter.persistence import KEPT, ago, ways
from modelserver.estimation.filter.setup import ROCKING, Setup
from modelserver.estimation.filter.state import FilterState, Proving
from modelserver.estimation.filter.strapdown import Earth
from modelserver.messages import Decision, Mode, PersistedPose, PersistedState, Phase, Verdict, WheelsSample
from modelserver.transforms import so3

FIXES = 3
"""Fixes in a row that must agree with the kept pose, or disagree: one of them may be a stray."""

NO_FIX_FOR = 3.0
"""Seconds of standing without a fix after which a kept pose is used without asking any."""

SAME_WAY = 0.02
"""Metres by which a wheel's counter may differ and still have stood: two pulses of a coarse encoder."""

LEAST_TRACK = 0.2
"""Metres between the wheels on the left and those on the right, below which they do not tell a turn."""

SAME_TILT = 0.03
"""Radians by which gravity may lean otherwise: 1.7 deg, passengers and load on the springs."""

WAITS = 30.0
"""Seconds after which evidence that has not come is not waited for any more."""

LOOKED_US = 200_000
"""Microseconds between two looks at the evidence."""


# --- going on -----------------------------------------------------------------------------------------------


def gone_on(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with what was kept taken up as far as it may be, and a word for each step."""
    waiting, nav = state.warm_start, state.nav
    if waiting is None or nav is None or utime < waiting.looked + LOOKED_US:
        return state, NOTHING
    kept = waiting.recalled.state
    assert kept is not None
    age = max(waiting.recalled.age, (nav.utime - kept.sensor_utime) * 1e-6)
    if not waiting.since:
        return _begun(setup, state, nav, kept, age)
    state = state._replace(warm_start=waiting._replace(looked=utime))
    if state.phase is Phase.ALIGNED:
        return _pose_left(state, age, "something else told the heading first")
    why = _hopeless(setup, state, kept, 0.0)
    if why:
        return _pose_left(state, age, why)
    pose = kept.pose
    assert pose is not None
    moved = _moved(setup, state, pose, utime)
    if moved is None:
        return _waited(
            state, utime, age, f"wheels ({pose.wheels_source}) and inertial unit do not stand still together"
        )
    if moved:
        return _pose_left(state, age, moved)
    resumed = _resumed(setup, state, nav, kept, pose, age)
    if resumed is None:
        return _pose_left(state, age, "its place is out of reach of the origin")
    return _by_fixes(setup, state, resumed, age, utime)


def _begun(setup: Setup, state: FilterState, nav: Nav, kept: PersistedState, age: float) -> Fused:
    """Return the state that was just levelled, with the biases that were kept."""
    waiting = state.warm_start
    assert waiting is not None
    if nav.utime < kept.sensor_utime:
        why = "the sensors' clock stands before what was kept"
        return _without(state, f"cold start: what was kept {ago(age)} is not used: {why}")
    values, P = aged(setup, kept, age, waiting.recalled.max_pose_age)
    begun = with_biases(setup, state, nav, values, P)
    if begun is None:
        why = "its gyro biases are not those of the standing unit: another one, or one that changed its temperature"
        return _without(state, f"cold start: what was kept {ago(age)} is not used: {why}")
    state = state._replace(nav=begun)
    unwatched = max(waiting.recalled.age, ((state.began or nav.utime) - kept.sensor_utime) * 1e-6)
    why = _hopeless(setup, state, kept, unwatched)
    if why:
        return _pose_left(state, age, why)
    state = state._replace(warm_start=waiting._replace(since=nav.utime, looked=nav.utime))
    return state, (_word(state, f"warm start: biases kept {ago(age)}; the pose of then waits for evidence"),)


# --- the evidence -------------------------------------------------------------------------------------------


def _hopeless(setup: Setup, state: FilterState, kept: PersistedState, unwatched: float) -> str:
    """Return why the kept pose cannot be used, whatever comes; empty where it may be.

    `unwatched` is for how long, seconds, nobody felt the vehicle.
    """
    pose, waiting = kept.pose, state.warm_start
    assert waiting is not None
    if pose is None:
        return "the vehicle did not stand with a valid pose then"
    longest = waiting.recalled.max_pose_age
    if not motion.inertial(setup, state.mode) or state.mode in (Mode.NO_WHEELS, Mode.DEAD_RECKONING):
        return f"mode {state.mode.name.lower()} cannot tell that it is still right"
    if unwatched > longest:
        return f"nobody watched the vehicle for {unwatched:.0f} s, longer than warm_start.max_pose_age_s"
    wheels = setup.wheels
    sides = [wheels.contacts[name][1] for name, _ in pose.wheels if name in wheels.contacts] if wheels else []
    if not sides or max(sides) - min(sides) < LEAST_TRACK:
        return "no wheels on both sides tell ways, so nothing tells whether it was turned meanwhile"
    if max(abs(way) for _, way in pose.wheels) <= 2.0 * SAME_WAY:
        # such a counter cannot be told from one that was started anew
        return "the wheels' counters had told no way yet"
    return ""


def _moved(setup: Setup, state: FilterState, pose: PersistedPose, utime: int) -> str | None:
    """Return how the vehicle was moved since, empty where it was not; None while nothing says that it stands."""
    seen = state.last.get((pose.wheels_source, "seen"))
    if seen is None:
        return None
    sample = seen.sample
    assert isinstance(sample, WheelsSample)
    if sample.header.seq <= pose.wheels_seq:
        return "the wheels' driver was started anew, so nothing tells whether they rolled meanwhile"
    now = dict(ways(sample))
    if any(name not in now for name, _ in pose.wheels):
        return "the wheels do not tell the ways that they told then"
    rolled = max(abs(now[name] - way) for name, way in pose.wheels)
    if rolled > SAME_WAY:
        return f"the wheels have rolled {rolled:.2f} m since"
    if not (state.standing and state.stillness.vouched(utime)):
        return None
    nav = state.nav
    assert nav is not None
    lean = so3.rotate(so3.conjugate(pose.attitude), (0.0, 0.0, 1.0))
    tilt = math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(lean, nav.up, strict=True)))))
    if tilt > SAME_TILT:
        return f"it leans otherwise than then, by {math.degrees(tilt):.1f} deg"
    return ""


def _resumed(
    setup: Setup, state: FilterState, nav: Nav, kept: PersistedState, pose: PersistedPose, age: float
) -> FilterState | None:
    """Return the state in the world as it was kept, less sure by what nobody saw; None out of the origin's reach."""
    waiting = state.warm_start
    assert waiting is not None
    values, P = aged(setup, kept, age, waiting.recalled.max_pose_age)
    wheels = setup.wheels
    assert wheels is not None
    sides = [wheels.contacts[name][1] for name, _ in pose.wheels if name in wheels.contacts]
    P[3:6, :], P[:, 3:6] = 0.0, 0.0
    diagonal = P.reshape(-1)[:: len(P) + 1]
    diagonal[0:3] += SAME_WAY**2
    diagonal[3:6] = setup.settings.stationary_sigma**2
    diagonal[6:8] += (SAME_TILT / 3.0) ** 2
    diagonal[8] += (0.5 * SAME_WAY / (max(sides) - min(sides))) ** 2 + ROCKING**2 * age
    site = LocalFrame.at(pose.latitude_deg, pose.longitude_deg, pose.height)
    if state.geodesy is not None:
        try:
            state.geodesy.utm_from_ecef(site.to_ecef(pose.position))
        except GeodesyError:
            return None
    since = round(age * 1e6) + kept.sensor_utime - pose.fix_utime
    return state._replace(
        nav=nav._replace(
            position=pose.position,
            velocity=ZERO,
            attitude=so3.normalize(pose.attitude),
            gyro_bias=(values[0], values[1], values[2]),
            accelerometer_bias=(values[3], values[4], values[5]),
            extras=values[6:],
            covariance=P,
            lag=0.0,
            impulse=ZERO,
        ),
        phase=Phase.ALIGNED,
        site=site,
        earth=Earth.at(pose.latitude_deg, pose.height),
        passed=(),
        fixed=None,
        fix_utime=nav.utime - since if pose.fix_utime else 0,
        confirmed=pose.confirmed,
        shown=pose.correlated_error,
        doubt=pose.correlated_error_variance,
        allowance=pose.allowance,
        restless=pose.gnss_noise_inflation,
        epoch=pose.pose_epoch + 1,
        warm_start=None,
        proving=Proving(),
    )


def _by_fixes(setup: Setup, state: FilterState, resumed: FilterState, age: float, utime: int) -> Fused:
    """Return the resumed state once fixes agree with it, or where there are none; else the state that waits."""
    waiting, fix = state.warm_start, state.fixed
    assert waiting is not None
    stood = "the wheels and the inertial unit stood"
    if not setup.rig.gps_frame or without_gps(state.mode):
        return resumed, (_word(resumed, f"warm start: the pose kept {ago(age)}: {stood}"),)
    if fix is None:
        if (utime - waiting.since) * 1e-6 < NO_FIX_FOR:
            return state, NOTHING
        return resumed, (_word(resumed, f"warm start: the pose kept {ago(age)}: {stood}; there is no fix to ask"),)
    if fix.utime <= waiting.seen:
        return _waited(state, utime, age, "no more fixes came")
    nav, layout, site, tangent = resumed.nav, setup.layout, resumed.site, state.site
    assert nav is not None
    assert site is not None
    assert tangent is not None
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    east, north, _ = site.from_ecef(tangent.to_ecef((fix.place.real, fix.place.imag, fix.up)))
    x, y, _ = nav.point(lever)
    at = layout.extra(WANDER[0])
    residual = np.array((east - x - fix.lingering * nav.extras[at], north - y - fix.lingering * nav.extras[at + 1]))
    H = jacobian_of_point(nav, lever, layout.size)[:2]
    H[0, STRAPDOWN + at] = H[1, STRAPDOWN + at + 1] = fix.lingering
    S = kalman.innovation(nav.covariance, H, np.eye(2) * fix.white**2)
    agrees = kalman.statistic(residual, S) <= kalman.gate_limit(2, setup.settings.gate_risk)
    count = max(waiting.fixes, 0) + 1 if agrees else min(waiting.fixes, 0) - 1
    if count >= FIXES:
        resumed = resumed._replace(fix_utime=nav.utime)
        return resumed, (_word(resumed, f"warm start: the pose kept {ago(age)}: {stood}, and {FIXES} fixes agree"),)
    state = state._replace(warm_start=waiting._replace(fixes=count, seen=fix.utime))
    if count <= -FIXES:
        return _pose_left(state, age, f"fixes are {math.hypot(*residual.tolist()):.1f} m from it")
    return state, NOTHING


# --- words --------------------------------------------------------------------------------------------------


def _waited(state: FilterState, utime: int, age: float, why: str) -> Fused:
    waiting = state.warm_start
    assert waiting is not None
    return _pose_left(state, age, why) if (utime - waiting.since) * 1e-6 > WAITS else (state, NOTHING)


def _pose_left(state: FilterState, age: float, why: str) -> Fused:
    """Return the state that goes on with biases alone."""
    return _without(state, f"warm start of the biases kept {ago(age)}, cold start of the pose: {why}")


def _without(state: FilterState, text: str) -> Fused:
    state = state._replace(warm_start=None)
    return state, (_word(state, text)._replace(verdict=Verdict.MONITORED),)


def _word(state: FilterState, text: str) -> Decision:
    assert state.nav is not None
    return Decision(state.nav.utime, "filter", 0, KEPT, Verdict.RESET, text)
