"""Units of raw mode: settings, clock monitor, fix quality, motion, heading, track, origin, protection levels."""

from __future__ import annotations

import cmath
import dataclasses
import inspect
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support_localization import GEODESY, MOUNTS, START

from modelserver.earth.geodesy import LocalFrame
from modelserver.errors import UnknownFrameError
from modelserver.estimation.filter.protection_levels import compute_factors, compute_longest_axis
from modelserver.estimation.filter.settings import SharedSettings
from modelserver.estimation.inputs import OriginCapture, evaluate_fix
from modelserver.estimation.raw.localizer import (
    MAX_TRACK_FIXES,
    CourseResult,
    Heading,
    RawLocalizer,
    RawMotion,
    TrackFix,
    append_fix,
    compute_attitude,
    compute_covariance,
    compute_roll_pitch,
    measure_velocity,
    read_raw_imu,
)
from modelserver.estimation.raw.settings import RawSettings
from modelserver.estimation.sensor_rig import Mounts
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Body, BodyFrame, Constraint
from modelserver.messages import FixType, GpsSample, ImuSample, OrientationReference, SensorHeader
from modelserver.transforms import Pose, so3

S = RawSettings()
SECOND = 1_000_000


# --- settings -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"gps_timeout": 0.0},
        {"gps_timeout": -1.0},
        {"uere": math.nan},
        {"uere": math.inf},
        {"minimum_fix_type": 6},
        {"risk": 0.9},
        {"fix_noise_share": 1.5},
        {"origin_fixes": 5000},
    ],
)
def test_the_error_of_an_invalid_setting_has_its_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RawSettings(**wrong)


def test_every_setting_is_a_number_with_a_docstring():
    source = dataclasses.fields(RawSettings)
    text = inspect.getsource(SharedSettings) + inspect.getsource(RawSettings)
    for field in source:
        assert field.type in ("int", "float")
        after = text.split(f"    {field.name}: ", 1)[1].split("\n", 2)[1]
        assert after.strip().startswith('"""'), field.name


# --- mounts -------------------------------------------------------------------------------------------------


def model():
    car = Body(
        "Car",
        (
            BodyFrame("CG", Pose((1.0, 0.0, 0.5))),
            BodyFrame("Antenna", Pose((0.2, 0.1, 1.5))),
            BodyFrame("Bolt", Pose.from_rpy((1.5, 0.0, 0.6), 0.0, 0.0, 0.3)),
        ),
    )
    imu = Body(
        "Imu",
        (BodyFrame("Sensor", Pose.from_rpy((0.0, 0.0, 0.02), math.pi, 0.0, 0.0)), BodyFrame("Base", Pose.identity())),
    )
    return Model((car, imu), (Constraint("bolted", "Car:Bolt", "Imu:Base", Pose.identity()),))


def test_mounts_are_those_of_the_model():
    mounts = Mounts.from_model(model(), "Car:CG", "Car:Antenna", "Imu:Sensor")
    assert mounts.X_base_antenna.xyz == pytest.approx((-0.8, 0.1, 1.0))
    assert mounts.X_base_imu.xyz == pytest.approx((0.5, 0.0, 0.12))
    assert mounts.X_base_imu.is_close(Pose.from_rpy((0.5, 0.0, 0.12), math.pi, 0.0, 0.3))


def test_a_mount_that_is_not_in_the_model_raises():
    with pytest.raises(UnknownFrameError):
        Mounts.from_model(model(), "Car:CG", "Car:Antena", "Imu:Sensor")


# --- clock monitor ------------------------------------------------------------------------------------------


def judge_stamps(*seconds):
    localizer, found = RawLocalizer.start(MOUNTS), []
    for t in seconds:
        epoch = localizer.pose_epoch
        sample = imu_sample(header=SensorHeader(round(t * SECOND), "imu"))
        localizer, events = localizer.process(sample)
        reasons = [event.reason for event in events if event.reason != "gap"]
        found.append("stepped_back" if localizer.pose_epoch > epoch else reasons[0] if reasons else "good")
    return found


def test_stamps_in_order_duplicate_and_out_of_sequence():
    good, duplicate, past = "good", "duplicate", "out_of_sequence"
    assert judge_stamps(5.0, 5.1, 5.1, 5.05, 5.2, 14.9) == [good, good, duplicate, past, good, good]


def test_one_odd_stamp_is_an_outlier_three_in_a_row_a_clock_step():
    good, past, future = "good", "out_of_sequence", "future"
    assert judge_stamps(100.0, 50.0, 100.1) == [good, past, good]
    assert judge_stamps(100.0, 50.0, 50.1, 50.2, 50.3) == [good, past, past, "stepped_back", good]
    assert judge_stamps(100.0, 50.0, 40.0, 30.0) == [good, past, past, past]
    assert judge_stamps(100.0, 500.0, 100.1, 100.2) == [good, future, good, good]
    assert judge_stamps(100.0, 500.0, 500.1, 500.2, 500.3) == [good, future, future, good, good]


# --- fix quality --------------------------------------------------------------------------------------------


def fix(**changes):
    base = GpsSample(
        SensorHeader(START, "gps"), FixType.FIX_3D, 50.27, -111.1, height_ellipsoidal=700.0, satellites=8, hdop=1.0
    )
    return replace(base, **changes)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"fix_type": FixType.NONE}, "no_fix"),
        ({"fix_type": FixType.DEAD_RECKONING}, "no_fix"),
        ({"latitude_deg": math.nan}, "nan"),
        ({"longitude_deg": math.inf}, "nan"),
        ({"latitude_deg": 0.0, "longitude_deg": 0.0}, "range"),
        ({"latitude_deg": 84.5}, "range"),
        ({"latitude_deg": 500.0}, "range"),
        ({"height_ellipsoidal": math.inf}, "range"),
        ({"satellites": 3}, "satellites"),
        ({"hdop": 9.0}, "dilution"),
        ({"hdop": math.inf}, "dilution"),
        ({"position_covariance": (900.0, 0, 0, 0, 900.0, 0, 0, 0, 900.0)}, "sigma"),
    ],
)
def test_a_bad_fix_is_rejected_with_a_reason(changes, reason):
    assert evaluate_fix(fix(**changes), S) == reason


def test_sigma_is_stated_by_the_receiver_or_follows_from_the_fix_type():
    stated = evaluate_fix(fix(position_covariance=(0.81, 0.1, 0, 0.1, 1.21, 0, 0, 0, 3.24)), S)
    assert (stated.east_variance, stated.north_variance, stated.cross, stated.up_variance) == (0.81, 1.21, 0.1, 3.24)
    # HDOP 1: horizontal radius is the range error
    assert evaluate_fix(fix(), S).sigma * math.sqrt(2) == pytest.approx(S.uere)
    assert evaluate_fix(fix(fix_type=FixType.RTK_FIXED, hdop=2.0), S).sigma == pytest.approx(0.04 / math.sqrt(2))
    unknown = evaluate_fix(fix(hdop=math.nan, satellites=-1, position_covariance=(0.0,) * 9), S)
    assert unknown.sigma == pytest.approx(S.uere * S.assumed_hdop / math.sqrt(2))


def test_height_is_ellipsoidal_above_mean_sea_level_or_unknown():
    assert evaluate_fix(fix(height_ellipsoidal=math.nan, height_msl=720.0, undulation=-18.0), S).height == 702.0
    above_sea = evaluate_fix(fix(height_ellipsoidal=math.nan, height_msl=720.0), S)
    assert above_sea.height == 720.0
    assert above_sea.up_variance == S.assumed_height_sigma**2
    assert math.isnan(evaluate_fix(fix(height_ellipsoidal=math.nan), S).height)


# --- attitude and motion ------------------------------------------------------------------------------------

angles = st.floats(-1.4, 1.4)


@given(angles, angles, st.floats(-3, 3))
def test_the_vertical_gives_roll_and_pitch(roll, pitch, yaw):
    R = Rotation.from_euler("xyz", [roll, pitch, yaw])
    up = tuple(R.inv().apply([0.0, 0.0, 1.0]))
    assert compute_roll_pitch(up) == pytest.approx((roll, pitch), abs=1e-9)
    assert compute_attitude(up, yaw) == pytest.approx(so3.from_rpy(roll, pitch, yaw), abs=1e-9)


@given(angles, angles, st.tuples(*[st.floats(-1, 1)] * 3))
def test_motion_rotates_as_a_rotation_vector_does(roll, pitch, rate):
    R = Rotation.from_euler("xyz", [roll, pitch, 0.4])
    motion = RawMotion(0, yaw=0.4, up=tuple(R.inv().apply([0.0, 0.0, 1.0])))
    for i in range(1, 21):
        motion = motion.propagate(i * 1000, rate, S)
    expected = R * Rotation.from_rotvec([each * 0.02 for each in rate])
    got = Rotation.from_quat(motion.pose.wxyz, scalar_first=True)
    assert (expected.inv() * got).magnitude() < 2e-3  # 1 ms Euler steps of yaw


@given(st.floats(-5, 5), st.floats(-0.5, 0.5), st.floats(0.3, 8.0), st.integers(1, 50))
def test_one_long_propagation_ends_where_many_short_ones_do(speed, turn, seconds, n):
    motion = RawMotion(START, rate=(0.0, 0.0, turn), speed=speed, speed_utime=START)
    whole = motion.propagate(START + round(seconds * 1e6), motion.rate, S)
    parts = motion.propagate(START + round(S.rate_hold * 1e6), motion.rate, S)
    for i in range(1, n + 1):
        t = START + round((S.rate_hold + (seconds - S.rate_hold) * i / n) * 1e6)
        parts = parts.propagate(t, (0.0, 0.0, 0.0), S)
    assert (parts.x, parts.y, parts.yaw) == pytest.approx((whole.x, whole.y, whole.yaw), abs=1e-6)
    assert math.hypot(whole.x, whole.y) <= abs(speed) * 2.0 * S.gps_timeout + 1e-9


def imu_sample(**changes):
    base = ImuSample(SensorHeader(START, "imu"), angular_velocity=(0.1, 0.2, 0.3), specific_force=(0.0, 0.0, 9.8))
    return replace(base, **changes)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"angular_velocity": None}, "nan"),
        ({"angular_velocity": (0.0, math.nan, 0.0)}, "nan"),
        ({"angular_velocity": (0.0, 100.0, 0.0)}, "range"),
        ({"specific_force": (0.0, 0.0, math.inf)}, "nan"),
        ({"specific_force": (0.0, 0.0, 1e9)}, "range"),
    ],
)
def test_a_bad_imu_sample_is_rejected_with_a_reason(changes, reason):
    assert read_raw_imu(imu_sample(**changes), MOUNTS.X_base_imu) == reason


@given(angles, angles, st.floats(-3, 3), st.sampled_from((OrientationReference.ENU, OrientationReference.NED)))
def test_the_vertical_of_the_unit_is_read_with_any_reference_and_mount(roll, pitch, yaw, reference):
    R_world_base = Rotation.from_euler("xyz", [roll, pitch, yaw])
    R_base_imu = Rotation.from_quat(MOUNTS.X_base_imu.wxyz, scalar_first=True)
    R = R_world_base * R_base_imu
    force = tuple(R.inv().apply([0.0, 0.0, 9.8]))
    if reference == OrientationReference.NED:
        R = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) * R
    sample = imu_sample(
        orientation=tuple(R.as_quat(scalar_first=True)), orientation_reference=reference, specific_force=force
    )
    found = read_raw_imu(sample, MOUNTS.X_base_imu)
    assert found.up == pytest.approx(tuple(R_world_base.inv().apply([0, 0, 1])), abs=1e-9)
    assert found.rate == pytest.approx(tuple(R_base_imu.apply([0.1, 0.2, 0.3])), abs=1e-12)


@pytest.mark.parametrize("q", [(0.0,) * 4, (math.nan,) * 4, (2.0, 0.0, 0.0, 0.0)])
def test_an_orientation_that_is_not_a_rotation_is_ignored(q):
    sample = imu_sample(orientation=q, orientation_reference=OrientationReference.ENU)
    assert read_raw_imu(sample, MOUNTS.X_base_imu).up is None


# --- heading ------------------------------------------------------------------------------------------------

KNOWN = Heading(True, 0.5, 0.01, 0.0, 1e-6)


def test_the_first_course_sets_the_heading():
    heading, result = Heading().update_course(2.0, 0.02, S)
    assert result is CourseResult.RESET
    assert (heading.is_known, heading.offset, heading.variance) == (True, 2.0, 0.02)


def test_courses_are_weighted_by_variance_across_the_wrap():
    heading, result = KNOWN._replace(offset=math.pi - 0.05).update_course(-math.pi + 0.05, 0.01, S)
    assert result is CourseResult.USED
    assert abs(heading.offset) == pytest.approx(math.pi)
    assert heading.variance == pytest.approx(0.005)


def test_a_course_half_a_turn_off_is_reverse():
    heading, result = KNOWN.update_course(0.5 + math.pi + 0.1, 0.01, S)
    assert result is CourseResult.BACKWARDS
    assert heading.offset == pytest.approx(0.55)


def test_a_course_that_fits_neither_is_rejected_until_a_run_of_them_agrees():
    heading = KNOWN
    for i in range(S.course_rejections - 1):
        heading, result = heading.update_course(0.5 + math.pi / 2, 0.001, S)
        assert (result, heading.num_rejected, heading.offset) == (CourseResult.REJECTED, i + 1, 0.5)
    heading, result = heading.update_course(0.5 + math.pi / 2, 0.001, S)
    assert result is CourseResult.RESET
    assert heading.offset == pytest.approx(0.5 + math.pi / 2)


def test_rejected_courses_that_disagree_are_not_a_run():
    heading = KNOWN
    for i in range(20):
        heading, result = heading.update_course(0.5 + (1 if i % 2 else -1) * math.pi / 2, 0.001, S)
        assert result is CourseResult.REJECTED


def test_a_stationary_vehicle_measures_the_bias_and_so_limits_the_drift():
    heading = KNOWN._replace(bias_variance=S.gyro_bias_sigma**2)
    true_bias = 0.01
    for _ in range(1000):  # 20 s
        heading = heading.propagate(0.02, S).update_stationary(true_bias - heading.bias, S.gyro_noise**2 / 0.02)
    assert heading.bias == pytest.approx(true_bias, abs=1e-4)
    settled = heading
    grown = settled
    for _ in range(600):
        grown = grown.propagate(0.1, S)
    assert (
        math.degrees(math.sqrt(grown.variance) - math.sqrt(settled.variance)) < 2.0
    )  # the report: 1 to 2 deg per minute


def test_unmeasured_turns_inflate_the_heading_up_to_unknown():
    measured = KNOWN.propagate(1.0, RawSettings(rate_hold=2.0))
    assert KNOWN.propagate(1.0, S).variance > measured.variance
    assert KNOWN.propagate(1e12, S).variance == pytest.approx(math.pi**2 / 3)


# --- track --------------------------------------------------------------------------------------------------


WORK = LocalFrame.at(50.27, -111.1, 700.0)


def path_fixes(speed, turn, offset, n=12, dt=0.5, lever=0.4 - 0.3j):
    """Return fixes of an antenna on a vehicle at constant speed and yaw rate: the closed form of an arc."""
    direction = cmath.rect(1.0, offset)
    made = []
    for i in range(n):
        t = i * dt
        path = t if turn == 0 else (cmath.exp(1j * turn * t) - 1) / (1j * turn)
        arm = lever * cmath.rect(1.0, turn * t)
        p = speed * direction * path + direction * arm
        ecef = WORK.to_ecef((p.real, p.imag, 0.0))
        made.append(TrackFix(START + round(t * 1e6), ecef, 0.02, path, arm, turn * t))
    return tuple(made)


def measure(made, heading, since=0):
    east, north, _ = WORK.from_ecef(made[-1].ecef)
    return measure_velocity(made, since, replace(WORK, ecef=WORK.to_ecef((east, north, 0.0))), heading, S)


@given(st.floats(0.5, 10), st.floats(-0.4, 0.4).filter(lambda w: abs(w) > 1e-3) | st.just(0.0), st.floats(-3, 3))
def test_speed_and_course_of_an_arc_are_exact(speed, turn, offset):
    made = path_fixes(speed, turn, offset)
    unknown = measure(made, Heading())
    error = abs(math.remainder(cmath.phase(unknown.c) - offset, math.tau))
    assert error < 0.05 or error < unknown.course_sigma  # the turn of the lever arm is part of the sigma
    found = measure(made, KNOWN._replace(offset=offset))
    assert math.remainder(cmath.phase(found.c) - offset, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert abs(found.c) == pytest.approx(speed, abs=1e-6)


def test_a_velocity_is_measured_since_the_first_fix_in_time_and_at_least_since_the_last():
    made = path_fixes(2.0, 0.0, 0.0)
    sigmas = [measure(made, KNOWN, since).sigma for since in (0, made[-3].utime, made[-1].utime)]
    assert sigmas == pytest.approx([math.sqrt(2.0) * 0.02 / seconds for seconds in (5.5, 1.0, 0.5)])
    assert measure(made[:1], KNOWN) is None


def test_a_segment_is_limited_in_fixes_and_time():
    fixes = ()
    for i in range(500):
        fixes = append_fix(fixes, TrackFix(START + i * 50_000, WORK.ecef, 1.0, 0j, 0j, 0.0), 30.0)
        assert len(fixes) <= MAX_TRACK_FIXES
        assert fixes[-1].utime - fixes[0].utime <= 30 * SECOND


# --- origin -------------------------------------------------------------------------------------------------


def capture_origin(positions, sigma=0.5):
    capture, origin = OriginCapture(), None
    for i, (east, north) in enumerate(positions):
        ecef = GEODESY.tangent.to_ecef((east, north, 0.0))
        capture, origin = capture.add_fix(START + i * SECOND, ecef, sigma, S)
        if origin is not None:
            return i, origin
    return None


def test_the_origin_is_the_mean_of_the_first_good_fixes():
    i, origin = capture_origin([(1.0, 0.0), (-1.0, 0.5), (0.0, -0.5), (0.5, 0.5), (-0.5, -0.5)])
    assert i == S.origin_fixes - 1
    assert math.dist(origin.initial_utm, GEODESY.origin.initial_utm) < 1e-3


def test_an_origin_is_found_while_moving_but_not_from_scattered_fixes():
    assert capture_origin([(20.0 * i, -10.0 * i) for i in range(5)]) is not None
    scattered = [(30.0 * (i % 2), 0.0) for i in range(20)]
    assert capture_origin(scattered) is None
    assert capture_origin(scattered + [(0.0, 0.0)] * 5)[0] == 24


# --- covariance and protection levels -----------------------------------------------------------------------


def test_protection_levels_are_exceeded_with_the_stated_probability():
    horizontal, heading = compute_factors(1e-3)
    assert math.exp(-(horizontal**2) / 2) == pytest.approx(1e-3)
    assert math.erfc(heading / math.sqrt(2)) == pytest.approx(1e-3)


def test_an_error_of_yaw_moves_the_base_about_the_antenna():
    good = evaluate_fix(fix(), S)
    cov = compute_covariance((good.east_variance, good.north_variance, good.cross), 1.0, 3.0 - 4.0j, 0.01, S)
    assert cov[0] == pytest.approx(good.east_variance + 0.16)
    assert cov[7] == pytest.approx(good.north_variance + 0.09)
    assert cov[1] == cov[6] == pytest.approx(0.12)
    assert (cov[5], cov[11]) == pytest.approx((0.04, 0.03))
    assert compute_longest_axis(cov[0], cov[7], cov[1]) == pytest.approx(good.east_variance + 0.25)
