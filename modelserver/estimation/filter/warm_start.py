"""Warm start: restore persisted biases at leveling, and the pose if the vehicle cannot have moved.

What is persisted (`get_persisted_state`) has a hash of all that it depends on: elsewhere it is not used.

Nobody observed the vehicle between the two runs. Biases change slowly whatever happens, so they are restored, after
covariance inflation by their age (`age_biases`). The pose is not: a heading cannot be observed while stationary. It is
used only if the vehicle was stationary when it was stored and is now, the time between is short, the wheels' counters
continue and have not moved, gravity points the same way, and fixes agree if there are any. Until all of this is known
there is no pose, and if any of it is missing the start is as cold as without a stored pose. A restored heading is then
checked against the first meters driven (`heading_step.check_heading`).
"""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from typing import Final

import numpy as np

from modelserver.earth.geodesy import GeodesyError, LocalFrame, geodetic_from_ecef
from modelserver.errors import quote
from modelserver.estimation.filter import eskf, fusion, output, protection_levels
from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, STRAPDOWN, ZERO, Earth, NavState, level_attitude
from modelserver.estimation.filter.fusion import NOTHING, Fused, report_event
from modelserver.estimation.filter.gnss_monitor import GnssMonitor, OutputOffset
from modelserver.estimation.filter.leveling import get_tilt_by_bias
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR
from modelserver.estimation.filter.measurements.measurement import point_jacobian
from modelserver.estimation.filter.sensor_monitors import RECEIVED
from modelserver.estimation.filter.state import (
    STATIONARY_ANGLE_WALK,
    Aligned,
    FilterState,
    HeadingCheck,
    Leveling,
    Navigating,
    Setup,
    Unaligned,
    WarmStart,
)
from modelserver.messages import Decision, Mode, PersistedPose, PersistedState, RestoredState, Verdict, WheelsSample
from modelserver.transforms import so3
from modelserver.transforms.so3 import Array

WARM_START: Final = "warm_start"
"""Kind of the ledger's decisions on a warm start."""


@lru_cache(maxsize=8)
def get_setup_hash(setup: Setup) -> str:
    """Return a hash of all that a stored state depends on: equal where it may be used."""
    rig = setup.rig
    words = repr((rig.geometry_key(), rig.kinematics, rig.steering, setup.layout.names))
    return hashlib.sha256(words.encode()).hexdigest()[:16]


def get_persisted_state(setup: Setup, state: FilterState, invalid: int) -> PersistedState | None:
    """Return what to store of a state; None if what was stored before is better.

    `invalid` are the reasons of the present pose: an invalid pose is not stored, its biases are.
    """
    if isinstance(state, Leveling) or state.common.warm_start is not None:
        return None
    state = fusion.propagate_covariance(setup, state)
    nav = state.nav
    P = nav.covariance
    if isinstance(state, Aligned):
        # neither bank nor monitor are stored: their level of the heading is
        bound = output.get_heading_protection(setup, state)
        P = P.copy()
        P[8, 8] = max(float(P[8, 8]), protection_levels.invert_heading(bound, setup.settings))
    numbers = tuple(P.ravel().tolist())
    if not all(map(math.isfinite, (*numbers, *nav.gyro_bias, *nav.accelerometer_bias, *nav.extras))):
        return None
    pose = None
    if isinstance(state, Aligned) and state.is_stationary and not invalid:
        pose = _get_persisted_pose(state, nav)
    return PersistedState(
        "",
        0,
        0,
        "",
        get_setup_hash(setup),
        nav.utime,
        setup.layout.names,
        nav.gyro_bias,
        nav.accelerometer_bias,
        tuple(map(float, nav.extras)),
        numbers,
        pose,
    )


def _get_persisted_pose(state: Aligned, nav: NavState) -> PersistedPose | None:
    gnss, common = state.gnss, state.common
    offset = gnss.offset
    numbers = (*offset.value, *offset.variance, gnss.outlier_allowance, gnss.noise_inflation)
    if not all(map(math.isfinite, (*nav.position, *nav.attitude, *numbers))):
        return None
    source, seq = "", 0
    travel: tuple[tuple[str, float], ...] = ()
    received = common.previous.get((common.wheels.source, RECEIVED))
    if received is not None and isinstance(received.sample, WheelsSample):
        source, seq = common.wheels.source, received.sample.header.seq
        travel = get_travel(received.sample)
    return PersistedPose(
        *geodetic_from_ecef(state.site.ecef),
        nav.position,
        nav.attitude,
        offset.value,
        offset.variance,
        gnss.outlier_allowance,
        gnss.noise_inflation,
        gnss.used_utime,
        gnss.num_confirmed,
        common.epoch,
        source,
        seq,
        travel,
    )


def get_travel(sample: WheelsSample) -> tuple[tuple[str, float], ...]:
    """Return the travel of each wheel that measures it, by name, m."""
    return tuple((wheel.name, wheel.travel) for wheel in sample.wheels if math.isfinite(wheel.travel))


def check_restored(restored: RestoredState, vehicle: str, setup: Setup) -> RestoredState:
    """Return what was restored, without a state of another vehicle, of other mounts, or too old; with the reason."""
    state = restored.state
    if state is None:
        return restored
    reason = ""
    if state.vehicle != vehicle:
        reason = f"it is of vehicle {quote(state.vehicle)}, not of {quote(vehicle)}"
    elif state.setup != get_setup_hash(setup):
        reason = "mounts, wheels or measurements of the vehicle have changed since"
    elif state.names != setup.layout.names or len(state.covariance) != setup.layout.size**2:
        reason = "its error states are others"
    elif restored.age > restored.max_age:
        reason = "it is older than warm_start.max_age_s"
    if not reason:
        return restored
    text = f"the state stored {format_age(restored.age)} is not used: {reason}"
    return restored._replace(state=None, reason=text)


def prepare_warm_start(
    restored: RestoredState | None, vehicle: str, setup: Setup, mode: Mode
) -> tuple[RestoredState | None, str]:
    """Return the state to start from, None for a cold start; and the message, empty if no state was asked for."""
    if restored is None:
        return None, ""
    if mode is Mode.RAW:
        restored = restored._replace(state=None, reason="raw mode restores only the origin")
    restored = check_restored(restored, vehicle, setup)
    if restored.state is None:
        return None, f"cold start: {restored.reason}"
    return restored, f"warm start: the state stored {format_age(restored.age)} waits for the sensors"


def format_age(seconds: float) -> str:
    """Return an age in words, e.g. `5 min ago`."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"


# --- warm start ---------------------------------------------------------------------------------------------

NUM_FIXES: Final = 3
"""Fixes in a row that must agree with the persisted pose, or disagree: one of them may be an outlier."""

FIX_TIMEOUT: Final = 3.0
"""Seconds stationary without a fix after which a persisted pose is used without one."""

TRAVEL_TOLERANCE: Final = 0.02
"""Meters by which a stationary wheel's counter may differ: two pulses of a coarse encoder."""

MIN_TRACK: Final = 0.2
"""Meters between the left and the right wheels, below which they do not show a turn."""

TILT_TOLERANCE: Final = 0.03
"""Radians by which gravity may differ: 1.7 deg, passengers and load on the springs."""

EVIDENCE_TIMEOUT: Final = 30.0
"""Seconds to wait for evidence."""

CHECK_PERIOD_US: Final = 200_000
"""Microseconds between two looks at the evidence."""

BIAS_GATE: Final = 5.0
"""Sigmas by which the persisted gyro biases may differ from the mean rate of a stationary IMU."""

SWITCHED_SHARE: Final = 0.25
"""Share of its initial sigma by which a bias may change when its unit is switched off and on."""


def advance(setup: Setup, state: FilterState, utime: int) -> Fused:
    """Return the state with the warm start continued as far as the evidence allows, and a decision for each step."""
    waiting = state.common.warm_start
    if waiting is None or isinstance(state, Leveling) or utime < waiting.checked_utime + CHECK_PERIOD_US:
        return state, NOTHING
    persisted = waiting.restored.state
    assert persisted is not None
    age = max(waiting.restored.age, (state.nav.utime - persisted.sensor_utime) * 1e-6)
    if not waiting.since:
        return _restore_biases(setup, state, waiting, persisted, age)
    waiting = waiting._replace(checked_utime=utime)
    state = _with_warm_start(state, waiting)
    if isinstance(state, Aligned):
        return _drop_pose(state, age, "another source measured the heading first")
    reason = _find_obstacle(setup, state, persisted, 0.0)
    if reason:
        return _drop_pose(state, age, reason)
    pose = persisted.pose
    assert pose is not None
    motion = _find_motion(setup, state, pose, utime)
    if motion is None:
        text = f"wheels ({pose.wheels_source}) and IMU are not stationary together"
        return _wait(state, waiting, utime, age, text)
    if motion:
        return _drop_pose(state, age, motion)
    restored = _restore_pose(setup, state, persisted, pose, age)
    if restored is None:
        return _drop_pose(state, age, "its position is out of range of the origin")
    return _check_fixes(setup, state, restored, age, utime)


# --- biases -------------------------------------------------------------------------------------------------


def _restore_biases(
    setup: Setup, state: Navigating, waiting: WarmStart, persisted: PersistedState, age: float
) -> Fused:
    nav = state.nav
    if nav.utime < persisted.sensor_utime:
        reason = "the sensors' clock is before the stored time"
        return _drop(state, f"cold start: the state stored {format_age(age)} is not used: {reason}")
    values, P = age_biases(setup, persisted, age, waiting.restored.max_pose_age)
    with_biases = apply_biases(setup, state, values, P)
    if with_biases is None:
        reason = "its gyro biases are not those of the stationary IMU: another unit, or another temperature"
        return _drop(state, f"cold start: the state stored {format_age(age)} is not used: {reason}")
    state = state._replace(nav=with_biases)
    leveled_since = state.leveled_since if isinstance(state, Unaligned) else 0
    unobserved = max(waiting.restored.age, ((leveled_since or nav.utime) - persisted.sensor_utime) * 1e-6)
    reason = _find_obstacle(setup, state, persisted, unobserved)
    if reason:
        return _drop_pose(state, age, reason)
    state = _with_warm_start(state, waiting._replace(since=nav.utime, checked_utime=nav.utime))
    return state, (_report(state, f"warm start: biases stored {format_age(age)}; the stored pose waits for evidence"),)


def age_biases(
    setup: Setup, persisted: PersistedState, age: float, max_pose_age: float
) -> tuple[tuple[float, ...], Array]:
    """Return biases and additional states (6 + m) as expected after `age` seconds, and the covariance (n, n).

    A random walk of density q^2 that has reached its initial sigma is taken for a Gauss-Markov process with that sigma:
    its time constant is 2 sigma^2 / q^2, so an old enough value is worth no more than none. After more than
    `max_pose_age` seconds units may have been switched off and on.
    """
    settings, n = setup.settings, setup.layout.size
    keep, add = np.ones(n), np.zeros(n)
    switched = SWITCHED_SHARE**2 if age > max_pose_age else 0.0

    def add_walk(at: slice, sigma: float, walk: float) -> None:
        share = math.exp(-age * walk * walk / (2.0 * sigma * sigma)) if walk > 0.0 else 1.0
        keep[at] = share
        add[at] = sigma * sigma * (1.0 - share * share + switched)

    add_walk(slice(9, 12), settings.gyro_bias_sigma, settings.gyro_bias_walk)
    add_walk(slice(12, 15), settings.accelerometer_bias_sigma, settings.accelerometer_bias_walk)
    switched, at = 0.0, STRAPDOWN
    for extra in setup.layout.extras:
        where = slice(at, at + len(extra.names))
        if math.isfinite(extra.time_constant):
            keep[where] = math.exp(-age / extra.time_constant)
            add[where] = extra.sigma**2 * (1.0 - keep[at] ** 2)
        else:
            add_walk(where, extra.sigma, extra.walk)
        at = where.stop
    P = np.array(persisted.covariance).reshape(n, n) * np.outer(keep, keep)
    P.reshape(-1)[:: n + 1] += add
    values = np.array((*persisted.gyro_bias, *persisted.accelerometer_bias, *persisted.extras)) * keep[9:]
    return tuple(values.tolist()), 0.5 * (P + P.T)


def apply_biases(setup: Setup, state: Navigating, values: tuple[float, ...], P: Array) -> NavState | None:
    """Return the leveled state with persisted biases; None if the gyros of a stationary IMU contradict them.

    Up was found without an accelerometer bias: it is computed again with the persisted one, and correlated with it. The
    mean rate of a stationary IMU and the persisted gyro biases are combined.
    """
    nav = state.nav
    n, after = setup.layout.size, nav.covariance.copy()
    rates, mean = np.array(values[:3]), np.array(nav.gyro_bias)
    Pg, Pn = P[9:12, 9:12], nav.covariance[9:12, 9:12]
    is_stationary_level = state.is_stationary and bool(nav.covariance[6:9, 12:15].any())
    uses_imu = setup.uses_imu(state.common.mode)
    attitude = nav.attitude
    if is_stationary_level:
        S = Pg + Pn
        if (np.abs(mean - rates) > BIAS_GATE * np.sqrt(np.diagonal(S))).any():
            return None
        gain = np.linalg.solve(S, Pg).T
        rates, Pg = rates + gain @ (mean - rates), Pg - gain @ Pg
    if uses_imu:
        after[9:12, :], after[:, 9:12] = 0.0, 0.0
        after[9:12, 9:12] = 0.5 * (Pg + Pg.T)
        after[12:15, :], after[:, 12:15] = 0.0, 0.0
        Pa = after[12:15, 12:15] = P[12:15, 12:15]
    if is_stationary_level:
        g = STANDARD_GRAVITY
        x, y, z = nav.up
        attitude = level_attitude((x * g - values[3], y * g - values[4], z * g - values[5]))
        M = get_tilt_by_bias(attitude)
        after[6:9, :], after[:, 6:9] = 0.0, 0.0
        after[6:9, 6:9] = M @ Pa @ M.T + np.diag((1e-6, 1e-6, 0.0))
        after[6:9, 12:15] = M @ Pa
        after[12:15, 6:9] = after[6:9, 12:15].T
    extras = list(nav.extras)
    for at in range(STRAPDOWN, n):
        # a Gauss-Markov state decays within a minute
        if not setup.layout.decay_rates[at - STRAPDOWN]:
            extras[at - STRAPDOWN] = values[at - 9]
            after[at, :], after[:, at] = 0.0, 0.0
            after[at, at] = P[at, at]
    nav = nav._replace(extras=tuple(extras), covariance=after)
    if not uses_imu:
        return nav
    a, b, c = rates.tolist()
    return nav._replace(
        attitude=attitude,
        position=so3.rotate(attitude, setup.rig.imu),
        gyro_bias=(a, b, c),
        accelerometer_bias=(values[3], values[4], values[5]),
    )


# --- evidence -----------------------------------------------------------------------------------------------


def _find_obstacle(setup: Setup, state: Navigating, persisted: PersistedState, unobserved: float) -> str:
    """Return why the persisted pose cannot be used whatever comes, empty if it may be.

    `unobserved` is for how long, seconds, nobody observed the vehicle.
    """
    pose, waiting, mode = persisted.pose, state.common.warm_start, state.common.mode
    assert waiting is not None
    if pose is None:
        return "the vehicle was not stationary with a valid pose then"
    if not setup.uses_imu(mode) or mode in (Mode.NO_WHEELS, Mode.DEAD_RECKONING):
        return f"mode {mode.name.lower()} cannot verify it"
    if unobserved > waiting.restored.max_pose_age:
        return f"the vehicle was unobserved for {unobserved:.0f} s, longer than warm_start.max_pose_age_s"
    if _get_track(setup, pose) < MIN_TRACK:
        return "no wheels on both sides measure travel, so a turn meanwhile would not show"
    if max(abs(travel) for _, travel in pose.wheels) <= 2.0 * TRAVEL_TOLERANCE:
        # a counter near 0 looks the same as one that was restarted
        return "the wheels' counters had measured no travel yet"
    return ""


def _get_track(setup: Setup, pose: PersistedPose) -> float:
    """Return the distance between the leftmost and the rightmost wheel of a persisted pose, m; 0 without wheels."""
    contacts = setup.wheels.contacts if setup.wheels is not None else {}
    sides = [contacts[name][1] for name, _ in pose.wheels if name in contacts]
    return max(sides) - min(sides) if sides else 0.0


def _find_motion(setup: Setup, state: Navigating, pose: PersistedPose, utime: int) -> str | None:
    """Return how the vehicle has moved since, empty if it has not; None while nothing shows that it is stationary."""
    received = state.common.previous.get((pose.wheels_source, RECEIVED))
    if received is None:
        return None
    sample = received.sample
    assert isinstance(sample, WheelsSample)
    if sample.header.seq <= pose.wheels_seq:
        return "the wheels' driver was restarted, so travel meanwhile would not show"
    now = dict(get_travel(sample))
    if any(name not in now for name, _ in pose.wheels):
        return "the wheels do not measure the travel that they measured then"
    rolled = max(abs(now[name] - travel) for name, travel in pose.wheels)
    if rolled > TRAVEL_TOLERANCE:
        return f"the wheels have rolled {rolled:.2f} m since"
    if not (state.is_stationary and state.stationary.is_confirmed_by_wheels(utime)):
        return None
    up = so3.rotate(so3.conjugate(pose.attitude), (0.0, 0.0, 1.0))
    tilt = math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(up, state.nav.up, strict=True)))))
    if tilt > TILT_TOLERANCE:
        return f"its tilt has changed by {math.degrees(tilt):.1f} deg"
    return ""


def _restore_pose(
    setup: Setup, state: Unaligned, persisted: PersistedState, pose: PersistedPose, age: float
) -> Aligned | None:
    """Return the state at the persisted pose, inflated by what nobody observed; None out of the origin's range."""
    common, nav = state.common, state.nav
    assert common.warm_start is not None
    values, P = age_biases(setup, persisted, age, common.warm_start.restored.max_pose_age)
    P[3:6, :], P[:, 3:6] = 0.0, 0.0
    diagonal = P.reshape(-1)[:: len(P) + 1]
    diagonal[0:3] += TRAVEL_TOLERANCE**2
    diagonal[3:6] = setup.settings.stationary_sigma**2
    diagonal[6:8] += (TILT_TOLERANCE / 3.0) ** 2
    diagonal[8] += (0.5 * TRAVEL_TOLERANCE / _get_track(setup, pose)) ** 2 + STATIONARY_ANGLE_WALK**2 * age
    site = LocalFrame.at(pose.latitude_deg, pose.longitude_deg, pose.height)
    if common.geodesy is not None:
        try:
            common.geodesy.utm_from_ecef(site.to_ecef(pose.position))
        except GeodesyError:
            return None
    since = round(age * 1e6) + persisted.sensor_utime - pose.fix_utime
    return Aligned(
        nav._replace(
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
        state.imu,
        state.stationary,
        state.reckoning,
        state.constraints,
        common._replace(epoch=pose.pose_epoch + 1, warm_start=None),
        Earth.at(pose.latitude_deg, pose.height),
        site,
        GnssMonitor(
            used_utime=nav.utime - since if pose.fix_utime else 0,
            num_confirmed=pose.confirmed,
            noise_inflation=pose.gnss_noise_inflation,
            offset=OutputOffset(pose.correlated_error, pose.correlated_error_variance),
            outlier_allowance=pose.allowance,
        ),
        heading_check=HeadingCheck(),
    )


def _check_fixes(setup: Setup, state: Unaligned, restored: Aligned, age: float, utime: int) -> Fused:
    """Return the restored state once fixes agree with it, or if there are none; else the state that waits."""
    waiting, fix = state.common.warm_start, state.alignment.last_fix
    assert waiting is not None
    text = f"warm start: the pose stored {format_age(age)}: the wheels and the IMU were stationary"
    if not setup.uses_gnss(state.common.mode):
        return restored, (_report(restored, text),)
    if fix is None:
        if (utime - waiting.since) * 1e-6 < FIX_TIMEOUT:
            return state, NOTHING
        return restored, (_report(restored, f"{text}; there is no fix to compare with"),)
    if fix.utime <= waiting.fix_utime:
        return _wait(state, waiting, utime, age, "no more fixes came")
    nav, layout, site = restored.nav, setup.layout, state.site
    assert site is not None
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    east, north, _ = restored.site.from_ecef(site.to_ecef((fix.position.real, fix.position.imag, fix.up)))
    x, y, _ = nav.point(lever)
    at = layout.extra_index(CORRELATED_ERROR[0])
    residual = np.array((east - x - fix.correlated * nav.extras[at], north - y - fix.correlated * nav.extras[at + 1]))
    H = point_jacobian(nav, lever, layout.size)[:2]
    H[0, STRAPDOWN + at] = H[1, STRAPDOWN + at + 1] = fix.correlated
    S = eskf.innovation_covariance(nav.covariance, H, np.eye(2) * fix.white**2)
    gate = eskf.chi_square_gate(2, setup.settings.gate_risk)
    agrees = eskf.normalized_innovation_squared(residual, S) <= gate
    count = max(waiting.num_fixes, 0) + 1 if agrees else min(waiting.num_fixes, 0) - 1
    if count >= NUM_FIXES:
        restored = restored._replace(gnss=restored.gnss._replace(used_utime=nav.utime))
        return restored, (_report(restored, f"{text}, and {NUM_FIXES} fixes agree"),)
    if count <= -NUM_FIXES:
        return _drop_pose(state, age, f"fixes are {math.hypot(*residual.tolist()):.1f} m from it")
    return _with_warm_start(state, waiting._replace(num_fixes=count, fix_utime=fix.utime)), NOTHING


# --- steps --------------------------------------------------------------------------------------------------


def _wait(state: Navigating, waiting: WarmStart, utime: int, age: float, reason: str) -> Fused:
    """Return the state that waits for evidence, without the persisted pose after EVIDENCE_TIMEOUT."""
    is_late = (utime - waiting.since) * 1e-6 > EVIDENCE_TIMEOUT
    return _drop_pose(state, age, reason) if is_late else (state, NOTHING)


def _drop_pose(state: Navigating, age: float, reason: str) -> Fused:
    """Return the state that continues with the biases alone."""
    return _drop(state, f"warm start of the biases stored {format_age(age)}, cold start of the pose: {reason}")


def _drop(state: Navigating, text: str) -> Fused:
    """Return the state without the warm start."""
    return _with_warm_start(state, None), (_report(state, text)._replace(verdict=Verdict.MONITORED),)


def _with_warm_start(state: Navigating, waiting: WarmStart | None) -> Navigating:
    return state._replace(common=state.common._replace(warm_start=waiting))


def _report(state: Navigating, text: str) -> Decision:
    return report_event(state, WARM_START, Verdict.RESET, text)
