"""Heading: found by the path, by the receiver's velocity, or by anything that measures it outright.

Before the heading is known, N is rotated about up by an unknown angle. `align_by_fixes` fits the path of dead reckoning
to the fixes, `fuse_velocity` uses the receiver's velocity, `fuse_baseline` a second antenna, `fuse_imu_yaw` the IMU's
own yaw, `fuse_absolute_pose` a pose of an operator or another source; `initialize` then sets the state in the world.
Once the filter is aligned these are ordinary measurements.

A warm start's heading is checked against the first meters driven and the fixes there (`check_heading`). Stationary
wheels show that the vehicle did not turn by itself, not that nobody lifted it. A state with a wrong heading and a small
uncertainty would explain the fixes by their time-correlated error, and never find out.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from typing import Final

import numpy as np

from modelserver.earth.geodesy import LocalFrame, geodetic_from_ecef
from modelserver.estimation.filter import fusion, heading_alignment, leveling, protection_levels
from modelserver.estimation.filter.eskf import Earth, NavState
from modelserver.estimation.filter.fusion import (
    NOTHING,
    Fused,
    Item,
    accept_fix,
    create_context,
    fuse_measurement,
    reject,
    report_event,
    report_reset,
)
from modelserver.estimation.filter.gnss_monitor import GnssMonitor
from modelserver.estimation.filter.heading_alignment import HeadingAlignment, PathFit, PathFix, Rotation, to_horizontal
from modelserver.estimation.filter.measurements import MeasurementContext
from modelserver.estimation.filter.measurements.gnss import (
    GpsBaseline,
    get_baseline_sigma,
    read_velocity,
)
from modelserver.estimation.filter.measurements.measurement import AbsolutePose, ImuYaw, compute_yaw, wrap_angle
from modelserver.estimation.filter.state import (
    Aligned,
    FilterState,
    HeadingCheck,
    Leveling,
    Navigating,
    Setup,
    Unaligned,
    is_speed_known,
)
from modelserver.estimation.filter.warm_start import WARM_START
from modelserver.messages import AbsolutePoseSample, Decision, GpsSample, ImuSample, Mode, Verdict, YawSource
from modelserver.transforms import so3

MAX_FIX_AGE: Final = 1.5
"""Seconds for which a fix is the position of a vehicle whose heading was just found."""

COURSE_SIGMA: Final = 0.05
"""Sigma of the course in N, rad, below which the receiver's course measures the heading of N: about that of a course.
"""

LARGEST_SPEED_SIGMA: Final = 0.15
"""Sigma of the speed, or its distance from that of the fixes, as a share of that, beyond which a start by accelerations
alone needs the direction confirmed."""

MOVING_SPEED: Final = 0.5
"""Speed of the state, m/s, beyond its uncertainty, that shows that a velocity of 0 is none."""


# --- by fixes ------------------------------------------------------------------------------------------------


def align_by_fixes(setup: Setup, state: Unaligned, newest: PathFix) -> tuple[Unaligned, PathFit | None]:
    """Return the state with a fix more for the heading, and the fit of the path to the fixes once it is certain."""
    settings, nav = setup.settings, state.nav
    segment = heading_alignment.append_fix(state.alignment.fixes, newest, settings.align_window)
    alignment = state.alignment._replace(fixes=segment, last_fix=newest, is_direction_unknown=False)
    state = state._replace(alignment=alignment)
    rate_sigma = math.sqrt(nav.covariance[11, 11])
    is_known = is_speed_known(state)
    fixes = heading_alignment.select_known_speed(segment) if is_known else segment
    fit = heading_alignment.fit_path(fixes, settings, is_unit_path=not is_known, rate_sigma=rate_sigma)
    if fit is not None and is_known and not state.common.measures_wheel_speed(nav.utime):
        # a path by accelerations goes wrong with its speed: how fast it moved, fixes know
        speed = fit.distance * fit.factor / fit.seconds
        speed_sigma = math.sqrt(max(nav.covariance[3, 3], nav.covariance[4, 4]))
        rotation = fit.rotation._replace(sigma=math.hypot(fit.rotation.sigma, 0.5 * speed_sigma / speed))
        fit = fit._replace(rotation=rotation)
        off = abs(speed - fit.distance / fit.seconds)
        is_vague = max(speed_sigma, off) > LARGEST_SPEED_SIGMA * speed
        if is_vague and _compare_accelerations(setup, state, rotation.angle) <= 0:
            return state, None
    if fit is None or fit.rotation.sigma > settings.align_sigma:
        return state, None
    if not heading_alignment.is_consistent(fit, newest):
        return state, None
    if is_known and not 0.6 < fit.factor < 1.6:
        # not the distance that was driven: fixes that drift, or wheels that spin
        return state, None
    if not is_known:
        if fit.factor < settings.align_speed:
            return state, None
        travel = _find_direction(setup, state, nav.yaw + fit.rotation.angle, fit.factor)
        if not travel:
            return state._replace(alignment=alignment._replace(is_direction_unknown=True)), None
        if travel < 0:
            fit = heading_alignment.fit_path(segment, settings, is_unit_path=True, rate_sigma=rate_sigma, travel=-1.0)
    return state, fit


def _find_direction(setup: Setup, state: Unaligned, heading: float, speed: float) -> int:
    """Return 1 for a vehicle of unknown velocity that drives forward, -1 for backward, 0 without evidence.

    `heading` (rad, N once it is rotated) and `speed` (m/s) are those of driving forward along the fixes. Backward the
    heading would be the opposite one. A wrong choice would last, so none is made without evidence.
    """
    if speed > setup.settings.reverse_speed:
        return 1
    return _compare_accelerations(setup, state, heading - state.nav.yaw)


def _compare_accelerations(setup: Setup, state: Unaligned, angle: float) -> int:
    """Return 1 if the accelerations are those of N rotated by `angle`, -1 of the opposite, 0 without evidence."""
    if not setup.uses_imu(state.common.mode):
        return 0
    return heading_alignment.find_direction_of_travel(state.alignment.fixes, angle, setup.settings)


def initialize(setup: Setup, state: Navigating, nav: NavState, rotation: Rotation, newest: PathFix) -> Aligned:
    """Return the state with N rotated by a heading that was found, and the antenna at the newest fix.

    `nav` is the state's own, or that with a speed that was just found: finding it has displaced the position by all
    that was driven at an unknown speed, so the displacement since the fix is at that speed.
    """
    lever = setup.rig.lever_arm(setup.rig.gps_frame)
    if nav is state.nav:
        x, y, _ = nav.point(lever)
        displacement = complex(x, y) - newest.path
    else:
        displacement = to_horizontal(nav.point_velocity(lever)) * (nav.utime - newest.utime) * 1e-6
    displacement *= cmath.rect(1.0, rotation.angle)
    if isinstance(state, Unaligned):
        known = heading_alignment.select_known_speed(state.alignment.fixes)
        nav = heading_alignment.reconcile_latency(nav, heading_alignment.fit_latency(known), setup.layout)
        gnss = GnssMonitor(last_fix=state.alignment.last_fix)
    else:
        gnss = state.gnss
    nav = heading_alignment.rotate(nav, rotation, setup.layout)
    nav = heading_alignment.place(nav, newest, displacement, lever, setup.layout)
    assert state.site is not None
    check = state.heading_check if isinstance(state, Aligned) else None
    return _align(state, nav, state.site, gnss)._replace(heading_check=check)


def place(setup: Setup, state: Aligned, newest: PathFix) -> Aligned:
    nav = heading_alignment.place(state.nav, newest, 0j, setup.rig.lever_arm(setup.rig.gps_frame), setup.layout)
    return start_epoch(state._replace(nav=nav, gnss=state.gnss.place(newest.utime)))


def start_epoch(state: Aligned) -> Aligned:
    """Return the state in a new epoch, without an allowance for earlier outliers."""
    common = state.common._replace(epoch=state.common.epoch + 1)
    return state._replace(common=common, gnss=state.gnss._replace(outlier_allowance=0.0))


def _align(state: Navigating, nav: NavState, site: LocalFrame, gnss: GnssMonitor) -> Aligned:
    """Return the aligned state at a pose that was just found, in the tangent plane `site`."""
    latitude, _, height = geodetic_from_ecef(site.ecef)
    return Aligned(
        nav,
        state.imu,
        state.stationary,
        state.reckoning,
        state.constraints,
        state.common._replace(is_clock_stepped=False),
        Earth.at(latitude, height),
        site,
        gnss.place(nav.utime),
    )


def is_heading_lost(setup: Setup, state: Aligned) -> bool:
    """Return whether the heading may be any: then no measurement can be linearized at it.

    It is not lost while fixes are suspect: those that would show another one are the same.
    """
    if state.turns.is_transported:
        return False
    variance = float(state.nav.covariance[8, 8])
    return protection_levels.compute_heading(variance, setup.settings) >= math.pi


def lose_heading(state: Aligned) -> Unaligned:
    """Return the state of a vehicle whose heading is lost: from now on N is rotated about up by an unknown angle.

    In that N the yaw has no error, and the velocity that of the body's: its direction is as uncertain as the heading
    was, unless it was known along the body. The pose of a new heading is of a new epoch.
    """
    nav = state.nav
    T = np.eye(len(nav.covariance))
    T[3, 8], T[4, 8] = nav.velocity[1], -nav.velocity[0]
    return Unaligned(
        nav.transform(T).forget([8]),
        state.imu,
        state.stationary,
        state.reckoning,
        HeadingAlignment(last_fix=state.gnss.last_fix),
        state.constraints,
        state.common._replace(epoch=state.common.epoch + 1),
        state.earth.without_heading(),
        state.site,
    )


def fuse_velocity(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after the receiver's velocity, which gives the heading if it is unknown."""
    sample = item.sample
    assert isinstance(sample, GpsSample)
    if not setup.uses_gnss(state.common.mode) or isinstance(state, Leveling):
        return state, NOTHING
    receiver = state.common.receiver
    if receiver.is_unfilled(sample):
        if not sample.speed > 0.0:
            if not _moves(fusion.predict(setup, state, item.utime)):
                return state, NOTHING
            state = state._replace(common=state.common._replace(receiver=receiver.count_unfilled()))
            return state, (reject(item, "unfilled"),)
        sample = replace(sample, velocity=None)
        item = item._replace(sample=sample)
    if isinstance(state, Aligned):
        return fuse_measurement(setup, state, item)
    if isinstance(accept_fix(setup, state, sample), str):
        return state, NOTHING
    state = fusion.advance(setup, state, item.utime)
    newest = state.alignment.last_fix
    found = _align_by_velocity(setup, state, sample, item.utime)
    if found is None or newest is None:
        return state, NOTHING
    rotation, speed = found
    nav = state.nav
    if math.isfinite(speed):
        nav = heading_alignment.set_speed(nav, speed, setup.settings.velocity_sigma)
    text = f"heading, to {math.degrees(rotation.sigma):.1f} deg, by the receiver's velocity"
    return initialize(setup, state, nav, rotation, newest), (report_reset(item, text),)


def _moves(state: Navigating) -> bool:
    """Return whether fixes or the state's own speed show that the vehicle moves."""
    nav = state.nav
    if nav.utime < state.common.moving_until:
        return True
    P = nav.covariance
    least = MOVING_SPEED + 4.0 * math.sqrt(max(P[3, 3], P[4, 4]))
    return is_speed_known(state) and math.hypot(nav.velocity[0], nav.velocity[1]) > least


def _align_by_velocity(setup: Setup, state: Unaligned, sample: GpsSample, utime: int) -> tuple[Rotation, float] | None:
    """Return the rotation of N by the receiver's velocity, and the speed (nan: known already); None without evidence.

    An unknown speed is signed by the direction of travel; nothing is returned below twice `align_speed`.
    """
    settings, nav, newest = setup.settings, state.nav, state.alignment.last_fix
    stated = read_velocity(sample, settings)
    if stated is None or newest is None or (utime - newest.utime) * 1e-6 > MAX_FIX_AGE:
        return None
    velocity, R = stated
    z = complex(velocity[0], velocity[1])
    size = abs(z)
    sigma_v = math.sqrt(max(R[0, 0], R[1, 1]))
    if size < settings.align_speed or sigma_v > 0.3 * size:
        return None
    sigma = math.hypot(sigma_v / size, 0.03)
    if is_speed_known(state):
        v = to_horizontal(nav.point_velocity(setup.rig.lever_arm(setup.rig.gps_frame)))
        if not 0.6 * size < abs(v) < 1.6 * size:
            return None
        across = np.array((-v.imag, v.real)) / abs(v)
        if across @ nav.covariance[3:5, 3:5] @ across > (COURSE_SIGMA * abs(v)) ** 2:
            # wheels have measured the speed, and nothing yet that it does not slide
            return None
        return Rotation(wrap_angle(cmath.phase(z) - cmath.phase(v)), sigma, nav.angular_rate[2]), math.nan
    if size < 2.0 * settings.align_speed:
        return None
    travel = _find_direction(setup, state, cmath.phase(z), size)
    if not travel:
        return None
    return Rotation(wrap_angle(cmath.phase(travel * z) - nav.yaw), sigma, nav.angular_rate[2]), travel * size


def fuse_baseline(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after the direction between two antennas, which measures the heading outright."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, GpsSample)
    assert isinstance(measurement, GpsBaseline)
    if not setup.uses_gnss(state.common.mode) or isinstance(state, Leveling):
        return state, NOTHING
    if isinstance(accept_fix(setup, state, sample), str):
        return state, NOTHING
    if isinstance(state, Aligned):
        return fuse_measurement(setup, state, item)
    x, y, _ = so3.rotate(state.nav.attitude, measurement.baseline)
    angle = wrap_angle(sample.baseline_yaw - math.atan2(y, x))
    return _align_by_azimuth(setup, state, item, angle, get_baseline_sigma(sample))


def fuse_imu_yaw(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after the IMU's own yaw, which measures the heading if it is magnetic."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, ImuSample)
    assert isinstance(measurement, ImuYaw)
    if state.common.mode in (Mode.NO_IMU, Mode.DEAD_RECKONING) or isinstance(state, Leveling):
        return state, NOTHING
    if isinstance(state, Aligned):
        return fuse_measurement(setup, state, item)
    is_magnetic = sample.yaw_source is YawSource.MAGNETIC
    if state.site is None or (is_magnetic and not setup.settings.use_magnetometer):
        return state, NOTHING
    context = create_context(setup, state)._replace(site=state.site)
    measured = compute_yaw(context, sample, measurement.mount)
    if isinstance(measured, str):
        return state, NOTHING
    angle = wrap_angle(measured - state.nav.yaw)
    return _align_by_azimuth(setup, state, item, angle, setup.settings.magnetic_sigma)


def _align_by_azimuth(setup: Setup, state: Unaligned, item: Item, angle: float, sigma: float) -> Fused:
    """Return the state in the world by a measured heading, once there is a fix."""
    state = fusion.advance(setup, state, item.utime)
    newest = state.alignment.last_fix
    if newest is None or (item.utime - newest.utime) * 1e-6 > MAX_FIX_AGE:
        return state, NOTHING
    aligned = initialize(setup, state, state.nav, Rotation(angle, sigma), newest)
    return aligned, (report_reset(item, f"heading, to {math.degrees(sigma):.1f} deg"),)


# --- absolute pose ------------------------------------------------------------------------------------------


def fuse_absolute_pose(setup: Setup, state: FilterState, item: Item) -> Fused:
    """Return the state after an absolute pose; one with position and orientation sets an unaligned state."""
    sample, measurement = item.sample, item.measurement
    assert isinstance(sample, AbsolutePoseSample)
    if isinstance(state, Leveling) and not setup.uses_imu(state.common.mode):
        state = leveling.start_level(setup, state, item.utime)
    if not isinstance(state, Unaligned) or state.common.mode is Mode.DEAD_RECKONING:
        return fuse_measurement(setup, state, item)
    geodesy = state.common.geodesy
    if sample.position is None or sample.orientation is None or geodesy is None:
        return state, NOTHING
    assert isinstance(measurement, AbsolutePose)
    state = fusion.advance(setup, state, item.utime)
    site = state.site or geodesy.tangent
    context = create_context(setup, state)._replace(site=site)
    return _set_pose(setup, state, item, measurement, sample, context, site)


def _set_pose(
    setup: Setup,
    state: Unaligned,
    item: Item,
    measurement: AbsolutePose,
    sample: AbsolutePoseSample,
    context: MeasurementContext,
    site: LocalFrame,
) -> Fused:
    """Return the state at a position and orientation that an operator or another source measured."""
    nav = state.nav
    innovation = measurement.evaluate(context, sample)
    if isinstance(innovation, str):
        return state, (reject(item, innovation or "empty"),)
    # the rotation first, because it may be of any size
    rotation = Rotation(wrap_angle(float(innovation.residual[5])), math.sqrt(float(innovation.noise[5, 5])))
    nav = heading_alignment.rotate(nav, rotation, setup.layout)
    again = measurement.evaluate(context._replace(nav=nav), sample)
    assert not isinstance(again, str)
    x, y, z = nav.position
    a, b, c = again.residual[:3].tolist()
    nav = nav.forget(slice(0, 3), again.noise[:3, :3])._replace(position=(x + a, y + b, z + c))
    aligned = _align(state, nav, site, GnssMonitor(last_fix=state.alignment.last_fix))
    return aligned, (report_reset(item, "position and heading were set"),)


# --- heading check of a warm start --------------------------------------------------------------------------

MIN_DISTANCE: Final = 3.0
"""Meters from end to end that give a direction, and as many again per meter of the antenna from the middle."""

MAX_GAP: Final = 2.0
"""Seconds between two fixes beyond which the segment restarts."""

MOUNT_SIGMA: Final = 0.05
"""Radians by which path and heading may differ on a sound vehicle: side slip, and the survey of the frames."""


def check_heading(
    setup: Setup, state: Aligned, newest: PathFix
) -> tuple[HeadingCheck | None, Rotation | None, Decision | None]:
    """Return the check after a fix: None once it is decided, with the rotation of N if the heading is wrong."""
    check, nav = state.heading_check, state.nav
    assert check is not None
    velocity = cmath.rect(nav.body_velocity(setup.rig.base)[0], nav.yaw)
    position = newest.position - newest.arm
    dt = (newest.utime - check.utime) * 1e-6
    if not check.utime or dt > MAX_GAP:
        return HeadingCheck(newest.utime, newest.utime, position, 0j, velocity), None, None
    travel = check.travel + 0.5 * dt * (check.velocity + velocity)
    check = check._replace(utime=newest.utime, travel=travel, velocity=velocity)
    arm, moved = abs(newest.arm), position - check.position
    # wheels that spin, or fixes that jump, give no direction
    if abs(travel) < MIN_DISTANCE * (1.0 + arm) or not 0.5 < abs(moved) / abs(travel) < 2.0:
        return check, None, None
    seconds = (newest.utime - check.begin) * 1e-6
    changed = newest.correlated * math.sqrt(2.0 * (1.0 - math.exp(-seconds / setup.settings.gps_correlation_time)))
    sigma = math.hypot(1.5 * newest.white, changed, 0.2 * arm) / abs(travel)
    if sigma > setup.settings.align_sigma:
        return check, None, None
    angle = cmath.phase(moved / travel)
    if abs(angle) <= 4.0 * math.hypot(sigma, MOUNT_SIGMA, math.sqrt(max(nav.covariance[8, 8], 0.0))):
        text = f"the restored heading is right: {abs(travel):.1f} m driven agree with it"
        return None, None, report_event(state, WARM_START, Verdict.USED, text)
    degrees = abs(math.degrees(angle))
    text = (
        f"cold start of the pose: the restored heading was off by {degrees:.0f} deg, the vehicle was turned meanwhile"
    )
    return None, Rotation(angle, sigma), report_event(state, WARM_START, Verdict.RESET, text)
