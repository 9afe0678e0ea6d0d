"""The logic around the filter: clocks, stationary detector, leveling, heading alignment, wheels, Odom."""

from __future__ import annotations

import cmath
import math
import random
from dataclasses import replace

import numpy as np
import pytest
from support_cart import ANTENNA, GEODESY, WHEELS, localizer, model, rig, some_nav
from support_cart import IMU as IMU_FRAME

from modelserver.estimation.filter import (
    fusion,
    heading_alignment,
    heading_step,
    leveling,
    output,
    sensor_monitors,
)
from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, ZERO, level_attitude
from modelserver.estimation.filter.gnss_monitor import GnssMonitor
from modelserver.estimation.filter.heading_alignment import LatencyFit, PathFix, Rotation
from modelserver.estimation.filter.localizer import FilterLocalizer, start
from modelserver.estimation.filter.measurements.gnss import CORRELATED_ERROR, LATENCY
from modelserver.estimation.filter.measurements.wheels import (
    WheelSpeed,
    _mean,
    are_wheels_stationary,
    estimate_turn_rate,
    read_wheels,
)
from modelserver.estimation.filter.output import Odometry
from modelserver.estimation.filter.sensor_monitors import StationaryDetector
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.state import Leveling, Setup, Unaligned
from modelserver.estimation.inputs import MAX_SOURCES, ClockMonitor, StampVerdict
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    Decision,
    Estimate,
    ImuSample,
    Invalid,
    Mode,
    Phase,
    SensorHeader,
    Verdict,
    WheelSample,
    WheelsSample,
)
from modelserver.simulation import START_UTIME
from modelserver.transforms import Pose, so3
from modelserver.transforms.so3 import Vector3

SETTINGS = FilterSettings()
SETUP = Setup(rig())
T0 = START_UTIME
MOUNT = Mounts.from_model(model(), "Cart:Base", ANTENNA, IMU_FRAME).X_base_imu.wxyz


# --- clocks -------------------------------------------------------------------------------------------------


def update(monitor: ClockMonitor, *stamps: tuple[str, int, float, int]) -> tuple[ClockMonitor, list[str]]:
    """Return the monitor after stamps (source, rank, seconds since T0, sequence number), and its verdicts."""
    words = []
    for name, rank, seconds, seq in stamps:
        monitor, verdict = monitor.update(
            ("sample", name), rank, T0 + round(seconds * 1e6), seq, SETTINGS, SETTINGS.horizon
        )
        words.append(verdict.value)
    return monitor, words


def create_running_monitor() -> ClockMonitor:
    monitor, words = update(
        ClockMonitor(), *[("imu", 2, n * 0.02, n + 1) for n in range(500)], ("gps", 0, 9.0, 1), ("gps", 0, 9.9, 2)
    )
    assert words == ["good"] * 502
    return monitor


def test_given_delayed_stamps_then_they_are_good_within_the_horizon_and_too_old_beyond():
    _, words = update(
        create_running_monitor(), ("wheels", 1, 9.5, 1), ("map", 0, 9.98 - 0.99, 1), ("other", 0, 9.98 - 1.01, 1)
    )
    assert words == ["good", "good", "too_old"]


def test_given_stamps_that_go_back_while_sequence_numbers_increase_then_they_are_out_of_sequence_beyond_the_horizon():
    _, words = update(create_running_monitor(), ("gps", 0, 8.5, 3), ("gps", 0, 9.95, 4))
    assert words == ["out_of_sequence", "good"]
    # within it the stamp alone decides, so that it does not matter what arrived first
    _, words = update(create_running_monitor(), ("gps", 0, 9.5, 3), ("gps", 0, 9.95, 4))
    assert words == ["good", "good"]
    # sequence numbers of few bits wrap around
    _, words = update(
        create_running_monitor(), ("gps", 0, 9.96, 0), ("gps", 0, 9.5, 255), ("gps", 0, 9.6, 254), ("gps", 0, 9.7, 253)
    )
    assert words == ["good"] * 4
    # a merely delayed sample has an earlier sequence number
    _, words = update(create_running_monitor(), ("gps", 0, 9.5, 1))
    assert words == ["good"]


def test_given_the_leading_clock_set_back_then_time_steps_back_once_a_run_of_samples_agrees():
    monitor, words = update(create_running_monitor(), *[("imu", 2, 2.0 + n * 0.02, 501 + n) for n in range(4)])
    assert words == ["out_of_sequence", "out_of_sequence", "stepped_back", "good"]
    assert monitor.newest == T0 + 2_060_000
    # samples before the odd ones do not make a run
    _, words = update(create_running_monitor(), *[("imu", 2, 3.0 - n * 0.02, 501 + n) for n in range(6)])
    assert words == ["out_of_sequence"] * 6


def test_given_one_stamp_ahead_when_the_lead_continues_then_time_does_not_step_back():
    """One forged stamp that is 0.2 s ahead: the true ones after it seem to have gone back."""
    _, words = update(
        create_running_monitor(), ("imu", 2, 10.18, 501), *[("imu", 2, 9.98 + n * 0.02, 501 + n) for n in range(1, 20)]
    )
    assert set(words) == {"good"}
    # a clock that was set back by as much covers a time that was covered before
    _, words = update(create_running_monitor(), *[("imu", 2, 9.78 + n * 0.02, 501 + n) for n in range(4)])
    assert words[2] == "stepped_back"


def test_given_another_type_of_sample_with_the_name_of_the_lead_then_its_stamps_are_separate():
    monitor = create_running_monitor()
    for n in range(10):
        monitor, _ = monitor.update(("range", "imu"), 0, T0 + 10_180_000 + n, 501 + n, SETTINGS, SETTINGS.horizon)
        monitor, verdict = monitor.update(
            ("sample", "imu"), 2, T0 + 10_000_000 + n * 10_000, 501 + n, SETTINGS, SETTINGS.horizon
        )
        assert verdict is StampVerdict.GOOD


def test_given_another_source_set_back_then_time_does_not_step():
    _, words = update(create_running_monitor(), *[("gps", 0, 2.0 + n * 0.2, 3 + n) for n in range(10)])
    assert words == ["out_of_sequence"] * 10


def test_given_a_stamp_in_the_future_then_it_is_accepted_once_a_run_of_samples_agrees():
    _, words = update(create_running_monitor(), ("imu", 2, 99.0, 501), ("imu", 2, 10.0, 502), ("imu", 2, 99.1, 503))
    assert words == ["future", "good", "future"]
    monitor, words = update(create_running_monitor(), *[("imu", 2, 99.0 + n * 0.02, 501 + n) for n in range(3)])
    assert words == ["future", "future", "good"]
    assert monitor.newest == T0 + 99_040_000
    # another source cannot set time forward while the lead publishes
    _, words = update(
        create_running_monitor(),
        *[pair for n in range(5) for pair in (("gps", 0, 99.0 + n, 3 + n), ("imu", 2, 10.0 + 0.02 * n, 501 + n))],
    )
    assert words == ["future", "good"] * 5


def test_given_a_flood_of_source_names_then_memory_is_bounded_and_known_sources_stay_monitored():
    monitor, _ = update(create_running_monitor(), *[(f"evil{n}", 0, 9.9, 1) for n in range(2 * MAX_SOURCES)])
    assert len(monitor.sources) == MAX_SOURCES
    monitor, words = update(monitor, *[("imu", 2, 10.0 + n * 0.02, 501 + n) for n in range(300)])
    assert set(words) == {"good"}
    assert monitor.sources["sample", "imu"].newest == T0 + 15_980_000
    _, words = update(monitor, *[("imu", 2, 8.0 + n * 0.02, 801 + n) for n in range(3)])
    assert words[-1] == StampVerdict.STEPPED_BACK.value


# --- stationary detector ------------------------------------------------------------------------------------


def run_detector(
    seconds: float, detector: StationaryDetector, noise: float, bias: Vector3 = ZERO, sigma: float = 0.01
) -> StationaryDetector:
    """Return the detector after IMU samples with a bias of 0.01 rad/s, the gyro bias being known as `bias`."""
    shaken = random.Random(3).gauss
    for n in range(round(seconds * 50)):
        rate = (shaken(0.01, noise), shaken(0.0, noise), shaken(-0.01, noise))
        force = (shaken(0.0, 10.0 * noise), 0.0, 9.8 + shaken(0.0, 10.0 * noise))
        detector = detector.update(T0 + n * 20_000, rate, force, bias, sigma, SETTINGS)
    return detector


def test_given_a_quiet_imu_then_it_is_stationary_and_its_mean_rate_is_its_bias():
    detector = run_detector(4.0, StationaryDetector(), 0.004)
    assert 2.5 < detector.get_quiet_time(detector.utime) < 4.0
    assert detector.mean_stationary_rate == pytest.approx((0.01, 0.0, -0.01), abs=1e-3)
    assert detector.restart_mean().sum_time == 0.0
    assert detector.restart_mean().since == detector.since


def test_given_an_imu_that_shakes_or_turns_steadily_then_it_is_not_stationary():
    assert run_detector(4.0, StationaryDetector(), 0.05).get_quiet_time(T0 + 4_000_000) == 0.0
    # a bias that is known to 1e-4 rad/s cannot be 0.014
    turning = run_detector(4.0, StationaryDetector(), 0.004, (0.05, 0.0, 0.0), 1e-4)
    assert turning.get_quiet_time(turning.utime) == 0.0


def test_given_an_engine_that_shakes_it_then_wheels_that_have_been_stationary_for_long_show_that_it_is():
    detector = StationaryDetector()
    shaken = random.Random(4).gauss
    quiet = {}
    for n in range(30 * 50):
        t, utime = n / 50.0, T0 + n * 20_000
        if n % 5 == 0:
            # they roll until 10 s
            detector = detector.update_wheels(utime, t >= 10.0)
        force = (shaken(0.0, 0.2), shaken(0.0, 0.2), 9.8 + shaken(0.0, 0.2))
        detector = detector.update(utime, (shaken(0.0, 0.006), 0.0, shaken(0.0, 0.006)), force, ZERO, 0.01, SETTINGS)
        quiet[round(t, 2)] = detector.get_quiet_time(utime)
    assert quiet[19.0] == 0.0
    assert quiet[29.0] > 8.0
    assert detector.update_wheels(detector.utime, False).get_quiet_time(detector.utime) == 0.0
    # a wheel that is silent for a while begins again
    late = detector.update_wheels(detector.utime + 2_000_000, True)
    assert late.wheels_since == detector.utime + 2_000_000


def test_given_rolling_wheels_then_a_quiet_imu_is_not_stationary_until_they_have_stopped():
    detector = run_detector(4.0, StationaryDetector(), 0.004)
    assert detector.update_wheels(detector.utime, False).get_quiet_time(detector.utime) == 0.0
    assert not detector.update_wheels(detector.utime, False).is_confirmed_by_wheels(detector.utime)
    assert detector.update_wheels(detector.utime, True).is_confirmed_by_wheels(detector.utime)
    assert not detector.update_wheels(detector.utime, True).is_confirmed_by_wheels(detector.utime + 2_000_000)
    assert detector.update_wheels(detector.utime, None) is detector


# --- leveling -----------------------------------------------------------------------------------------------


def create_imu_sample(seconds: float, rate: Vector3, force: Vector3, seq: int = 0) -> ImuSample:
    """Return a sample of an angular rate and a specific force along the body axes."""
    back = so3.conjugate(MOUNT)
    header = SensorHeader(T0 + round(seconds * 1e6), "imu", seq)
    return ImuSample(header, so3.rotate(back, rate), so3.rotate(back, force))


def level_on_slope(
    seconds: float, roll: float = 0.0, pitch: float = 0.0, noise: float = 0.003, setup: Setup = SETUP
) -> tuple[FilterLocalizer, list[Decision]]:
    """Return the filter after some seconds stationary on a slope with gyro biases, and its decisions."""
    shaken = random.Random(2).gauss
    found = localizer(the_rig=setup.rig)
    up = so3.rotate(so3.conjugate(so3.from_rpy(roll, pitch, 0.0)), (0.0, 0.0, STANDARD_GRAVITY))
    notes: list[Decision] = []
    for n in range(round(seconds * 50)):
        rate = (0.01 + shaken(0.0, noise), -0.02 + shaken(0.0, noise), 0.005 + shaken(0.0, noise))
        force = (
            up[0] + shaken(0.0, 10.0 * noise),
            up[1] + shaken(0.0, 10.0 * noise),
            up[2] + shaken(0.0, 10.0 * noise),
        )
        found, events = found.process(create_imu_sample(n * 0.02, rate, force, n))
        notes += [note for note in events if isinstance(note, Decision)]
    return found, notes


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.15, -0.2), (-0.3, 0.1)])
def test_given_a_stationary_vehicle_on_a_slope_then_it_is_leveled_and_its_gyro_biases_are_found(roll, pitch):
    found, _ = level_on_slope(3.0, roll, pitch)
    assert isinstance(found.head, Unaligned)
    assert found.head.phase is Phase.UNALIGNED
    assert not found.estimate(found.utime).invalid & Invalid.TILTED
    nav = found.head.nav
    assert so3.to_rpy(nav.attitude)[:2] == pytest.approx((roll, pitch), abs=0.005)
    assert nav.gyro_bias == pytest.approx((0.01, -0.02, 0.005), abs=0.001)
    assert np.sqrt(np.diagonal(nav.covariance)[9:12]) == pytest.approx(SETTINGS.gyro_noise / math.sqrt(2.0), rel=0.3)
    assert math.hypot(*nav.velocity) < 0.01
    assert nav.point(SETUP.rig.base) == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    # tilt and accelerometer bias are one unknown: gravity along the body stays explained
    P = nav.covariance
    R = np.array(so3.matrix_rows(nav.attitude))
    explained = np.hstack([STANDARD_GRAVITY * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), -R[:2]])
    both = np.r_[6:9, 12:15]
    assert np.sqrt(np.diagonal(explained @ P[np.ix_(both, both)] @ explained.T)).max() < 0.02


def test_given_a_vehicle_that_shakes_then_it_is_leveled_on_the_move_with_a_larger_uncertainty():
    found, _ = level_on_slope(4.5, 0.1, 0.0, noise=0.1)
    assert isinstance(found.head, Leveling)
    assert found.estimate(found.head.imu.used_utime).invalid & Invalid.NOT_MOVED_YET
    found, _ = level_on_slope(5.1, 0.1, 0.0, noise=0.1)
    assert isinstance(found.head, Unaligned)
    nav = found.head.nav
    assert so3.to_rpy(nav.attitude)[0] == pytest.approx(0.1, abs=0.1)
    assert max(map(abs, nav.gyro_bias)) < 0.003
    P = np.sqrt(np.diagonal(nav.covariance))
    assert P[3] > 10.0
    assert P[6] > 0.05
    assert P[9] == pytest.approx(SETTINGS.gyro_bias_sigma, rel=0.1)


def test_given_a_wrong_mount_then_it_stays_tilted_and_reports_it_each_time():
    found, notes = level_on_slope(9.0, roll=1.5)
    assert isinstance(found.head, Leveling)
    assert found.head.tilt == pytest.approx(1.5, abs=0.01)
    assert found.estimate(found.head.imu.used_utime).invalid & Invalid.TILTED
    mount = [note for note in notes if note.reason == "mount"]
    assert len(mount) >= 2
    assert all(note.verdict is Verdict.REJECTED for note in mount)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.9), (-1.0, 0.5, 3.0)])
def test_given_a_measured_up_then_the_attitude_rotates_it_up_and_has_no_yaw(up):
    q = level_attitude(up)
    x, y, z = so3.rotate(q, up)
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert z > 0.0
    assert so3.to_rpy(q)[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("word", ["nan", "range"])
def test_given_impossible_imu_samples_then_they_are_rejected(word):
    wrong = math.nan if word == "nan" else 1e6
    for sample in (
        create_imu_sample(0.0, (wrong, 0.0, 0.0), (0.0, 0.0, 9.8)),
        create_imu_sample(0.0, ZERO, (0.0, 0.0, wrong)),
    ):
        assert sensor_monitors.read_imu(sample, SETUP.mount) == word
    assert sensor_monitors.read_imu(ImuSample(SensorHeader(T0), None, (0.0, 0.0, 9.8)), SETUP.mount) == "nan"
    found = sensor_monitors.read_imu(create_imu_sample(0.0, (0.1, 0.2, 0.3), (0.0, 0.0, 9.8)), SETUP.mount)
    assert not isinstance(found, str)
    assert found[0] == pytest.approx((0.1, 0.2, 0.3))


def test_given_the_pose_of_another_localizer_then_the_filter_starts_there_with_the_same_covariance():
    first = start(Mode.FULL, GEODESY)
    P = np.diag([0.04, 0.09, 0.16, 1e-3, 2e-3, 3e-3])
    X = Pose.from_rpy((10.0, 20.0, 1.0), 0.0, 0.1, 0.7)
    before = Estimate(T0 - 100_000, Pose((0.0, 0.0, 0.0)), X)
    last = Estimate(T0, Pose((0.3, 0.0, 0.0)), X, X, tuple(P.ravel().tolist()))
    state = leveling.start_from(SETUP, first, last, before)
    assert state is not None
    assert state.phase is Phase.ALIGNED
    assert state.nav.point(SETUP.rig.base) == pytest.approx(X.xyz)
    assert so3.rotate(so3.conjugate(X.wxyz), state.nav.velocity) == pytest.approx((3.0, 0.0, 0.0))
    assert np.diagonal(state.nav.covariance)[[0, 1, 2, 6, 7, 8]] == pytest.approx(np.diagonal(P))
    for wrong in (Estimate(T0, Pose.identity()), Estimate(T0, X, X, X, last.covariance, invalid=Invalid.STALE_GPS)):
        assert leveling.start_from(SETUP, first, wrong, before) is None


@pytest.mark.parametrize(("gps", "expected"), [(True, Invalid.STALE_GPS), (False, Invalid(0))])
def test_given_no_fixes_for_long_then_they_are_stale_only_on_a_vehicle_with_an_antenna(
    gps: bool, expected: Invalid
) -> None:
    setup = Setup(rig(gps=gps))
    first = start(Mode.FULL, GEODESY)
    X = Pose.identity()
    last = Estimate(T0, X, X, X, tuple(np.diag([0.01] * 6).ravel().tolist()))
    state = leveling.start_from(setup, first, last, replace(last, utime=T0 - 100_000))
    assert state is not None
    late = T0 + round((setup.settings.gps_timeout + 1.0) * 1e6)
    assert output.find_stale_sensors(setup, state, late) & Invalid.STALE_GPS == expected


# --- heading alignment --------------------------------------------------------------------------------------


def create_segment(
    rotation: float, speed: float = 2.0, noise: float = 0.02, arm: complex = 0.5 + 0.2j
) -> tuple[PathFix, ...]:
    """Return the fixes of twenty seconds through a bend; the path in N is rotated by `rotation` in the world."""
    shaken = random.Random(1).gauss
    at, unit, found = 0j, 0j, []
    for n in range(100):
        yaw = 0.05 * n * 0.2
        direction = cmath.rect(1.0, yaw)
        if n % 5 == 0:
            position = cmath.rect(1.0, rotation) * (at + arm * direction) + complex(
                shaken(0.0, noise), shaken(0.0, noise)
            )
            found.append(
                PathFix(
                    T0 + n * 200_000,
                    100.0 + position,
                    0.0,
                    at + arm * direction,
                    arm * direction,
                    unit,
                    noise,
                    0.1,
                    0.1,
                )
            )
        at += speed * 0.2 * direction * cmath.rect(1.0, 0.005)
        unit += 0.2 * direction * cmath.rect(1.0, 0.005)
    return tuple(found)


@pytest.mark.parametrize("rotation", [0.0, 1.0, 3.1, -2.5])
@pytest.mark.parametrize("speed", [2.0, -1.5])
def test_given_a_path_driven_forward_or_in_reverse_then_its_rotation_onto_the_fixes_is_found(rotation, speed):
    fit = heading_alignment.fit_path(create_segment(rotation, speed), SETTINGS, is_unit_path=False, rate_sigma=1e-3)
    assert fit is not None
    assert abs(math.remainder(fit.rotation.angle - rotation, math.tau)) < 4.0 * fit.rotation.sigma
    assert fit.rotation.sigma < 0.05
    assert fit.factor == pytest.approx(1.0, abs=0.02)
    assert fit.distance > 20.0
    assert heading_alignment.is_consistent(fit, create_segment(rotation, speed)[-1])


def test_given_an_unknown_speed_then_the_path_at_speed_1_gives_speed_and_heading():
    fit = heading_alignment.fit_path(create_segment(1.0), SETTINGS, is_unit_path=True, rate_sigma=1e-3)
    assert fit is not None
    assert fit.rotation.angle == pytest.approx(1.0, abs=0.02)
    assert fit.factor == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize(
    ("factor", "speed_sigma", "is_found"), [(1.0, 0.2, True), (1.1, 0.32, False), (1.5, 0.2, False), (0.7, 0.2, False)]
)
def test_given_a_speed_that_the_state_has_made_up_then_it_shows_no_direction_of_travel(factor, speed_sigma, is_found):
    # the fixes move at 2 m/s, and nothing accelerates: a speed beside that, or a vague one, may have either sign
    *fixes, newest = (each._replace(path=factor * each.path) for each in create_segment(1.0))
    state = leveling.start_level(SETUP, Leveling(), newest.utime)
    P = state.nav.covariance.copy()
    P[3, 3] = P[4, 4] = speed_sigma**2
    state = state._replace(
        nav=state.nav._replace(velocity=(2.0 * factor, 0.0, 0.0), covariance=P),
        alignment=state.alignment._replace(fixes=tuple(fixes)),
    )
    _, fit = heading_step.align_by_fixes(SETUP, state, newest)
    assert (fit is not None) == is_found


def test_given_fixes_off_the_path_then_they_are_inconsistent_and_too_few_give_no_fit():
    shaken = random.Random(1).gauss
    off = tuple(
        each._replace(position=each.position + complex(shaken(0.0, 9.0), shaken(0.0, 9.0)))
        for each in create_segment(1.0)
    )
    fit = heading_alignment.fit_path(off, SETTINGS, is_unit_path=False, rate_sigma=1e-3)
    assert fit is not None
    assert not heading_alignment.is_consistent(fit, off[-1])
    assert heading_alignment.fit_path(off[:2], SETTINGS, is_unit_path=False, rate_sigma=1e-3) is None
    stationary = tuple(each._replace(path=0j) for each in off)
    assert heading_alignment.fit_path(stationary, SETTINGS, is_unit_path=False, rate_sigma=1e-3) is None


def test_given_a_long_segment_then_it_is_thinned_and_cut():
    newest = create_segment(0.0)[-1]
    fixes: tuple[PathFix, ...] = ()
    for n in range(500):
        fixes = heading_alignment.append_fix(fixes, newest._replace(utime=T0 + n * 100_000), 60.0)
        assert len(fixes) <= heading_alignment.MAX_FIXES + 1
    assert fixes[-1].utime == T0 + 499 * 100_000
    assert fixes[0].utime < T0 + 20_000_000
    assert heading_alignment.append_fix(fixes, newest._replace(utime=T0 + 90_000_000), 60.0)[0].utime >= T0 + 30_000_000


@pytest.mark.parametrize(("is_measured", "allowances"), [(True, [0.0] * 5), (False, [0.0, 0.0, 6.0, 8.0, 8.0])])
def test_given_fixes_that_are_rejected_again_and_again_then_the_bound_covers_them_unless_wheels_contradict(
    is_measured, allowances
):
    monitor, found = GnssMonitor(), []
    fix = create_segment(0.0)[0]
    for n, distance in enumerate((2.0, 4.0, 6.0, 8.0, 7.0)):
        away = fix._replace(utime=T0 + n * 500_000, position=fix.path + distance * 1j)
        monitor = monitor.reject(away, SETTINGS, is_speed_measured=is_measured)
        found.append(monitor.outlier_allowance)
    assert found == pytest.approx(allowances)


# --- initialization in the world ----------------------------------------------------------------------------


def create_delayed_segment(latency: float, speed: str, rate: float = 0.0) -> tuple[PathFix, ...]:
    """Return the fixes, `latency` seconds old, of eight seconds from rest to 3 m/s, or at that speed throughout."""
    rotation, noise = 0.7, 0.02
    shaken = random.Random(2).gauss

    def integrate_path(t: float) -> complex:
        steps = 400
        dt = t / steps
        found = 0j
        for n in range(steps):
            at = (n + 0.5) * dt
            v = 3.0 if speed == "steady" else min(max(at - 2.0, 0.0), 3.0)
            found += v * dt * cmath.rect(1.0, rate * at)
        return found

    return tuple(
        PathFix(
            T0 + n * 250_000,
            20.0
            + cmath.rect(1.0, rotation) * integrate_path(n * 0.25 - latency)
            + complex(shaken(0.0, noise), shaken(0.0, noise)),
            0.0,
            integrate_path(n * 0.25),
            0j,
            0j,
            noise,
            0.1,
            0.1,
        )
        for n in range(33)
    )


@pytest.mark.parametrize("rate", [0.0, 0.3])
@pytest.mark.parametrize("latency", [0.0, 0.1, 0.4])
def test_given_delayed_fixes_then_their_latency_is_found_on_a_path_of_changing_speed(latency, rate):
    found = heading_alignment.fit_latency(create_delayed_segment(latency, "from rest", rate=rate))
    assert found is not None
    assert found.sigma < 0.02
    # to first order in the latency, and with corners that four fixes a second round off
    assert abs(found.seconds - latency) < 4.0 * found.sigma + 0.15 * latency + 0.01


@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_given_a_path_at_constant_speed_then_it_does_not_show_the_latency_of_fixes(rate):
    found = heading_alignment.fit_latency(create_delayed_segment(0.4, "steady", rate=rate))
    assert found is None or found.sigma > 1.0


def test_given_too_few_fixes_then_they_do_not_show_their_latency():
    assert heading_alignment.fit_latency(create_delayed_segment(0.0, "from rest")[:5]) is None
    stationary = tuple(each._replace(path=0j) for each in create_delayed_segment(0.0, "from rest"))
    assert heading_alignment.fit_latency(stationary) is None


def test_given_delayed_fixes_on_a_circle_then_the_rotation_has_its_change_per_latency():
    rate, latency = 0.5, 0.2
    prompt = heading_alignment.fit_path(
        create_delayed_segment(0.0, "steady", rate=rate), SETTINGS, is_unit_path=False, rate_sigma=1e-3
    )
    delayed = heading_alignment.fit_path(
        create_delayed_segment(latency, "steady", rate=rate), SETTINGS, is_unit_path=False, rate_sigma=1e-3
    )
    assert prompt is not None
    assert delayed is not None
    assert prompt.rotation.per_latency == pytest.approx(rate, rel=0.02)
    assert prompt.rotation.angle - delayed.rotation.angle == pytest.approx(rate * latency, abs=0.01)


def test_given_a_rotation_by_delayed_fixes_then_yaw_and_latency_share_their_error():
    nav = some_nav(SETUP, 5)
    latency_at, extra = SETUP.layout.index(LATENCY), SETUP.layout.extra_index(LATENCY)
    P = nav.covariance.copy()
    P[latency_at, :] = P[:, latency_at] = 0.0
    P[latency_at, latency_at] = 0.1**2
    extras = tuple(0.05 if n == extra else value for n, value in enumerate(nav.extras))
    nav = nav._replace(covariance=P, extras=extras)
    plain = heading_alignment.rotate(nav, Rotation(0.8 + 0.6 * 0.05, 0.02), SETUP.layout)
    after = heading_alignment.rotate(nav, Rotation(0.8, 0.02, per_latency=0.6), SETUP.layout)
    assert after.yaw == pytest.approx(plain.yaw)
    assert after.covariance[8, 8] == pytest.approx(plain.covariance[8, 8] + (0.6 * 0.1) ** 2)
    assert after.covariance[8, latency_at] == pytest.approx(0.6 * 0.1**2)
    vx, vy, _ = after.velocity
    assert after.covariance[3:5, latency_at] == pytest.approx(np.array((-vy, vx)) * 0.6 * 0.1**2)
    assert np.linalg.eigvalsh(after.covariance)[0] > -1e-12


def test_given_a_fit_that_contradicts_the_latency_then_it_lies_halfway_with_the_difference_as_its_sigma():
    nav = some_nav(SETUP, 5)
    latency_at, extra = SETUP.layout.index(LATENCY), SETUP.layout.extra_index(LATENCY)
    P = nav.covariance.copy()
    P[latency_at, latency_at] = 0.1**2
    extras = tuple(0.0 if n == extra else value for n, value in enumerate(nav.extras))
    nav = nav._replace(covariance=P, extras=extras)
    assert heading_alignment.reconcile_latency(nav, LatencyFit(0.3, 0.01), SETUP.layout) is nav
    assert heading_alignment.reconcile_latency(nav, LatencyFit(0.8, 5.0), SETUP.layout) is nav
    after = heading_alignment.reconcile_latency(nav, LatencyFit(0.8, 0.01), SETUP.layout)
    assert after.extras[extra] == pytest.approx(0.4)
    assert after.covariance[latency_at, latency_at] == pytest.approx(0.8**2 + 0.01**2)
    assert np.count_nonzero(after.covariance[latency_at]) == 1
    assert np.count_nonzero(after.covariance[:, latency_at]) == 1


def test_given_a_found_heading_then_all_in_n_rotates_with_it_and_only_the_uncertainty_of_yaw_grows():
    nav = some_nav(SETUP, 5)
    after = heading_alignment.rotate(nav, Rotation(0.8, 0.1), SETUP.layout)
    spin = so3.from_rpy(0.0, 0.0, 0.8)
    assert after.position == pytest.approx(so3.rotate(spin, nav.position))
    assert after.velocity == pytest.approx(so3.rotate(spin, nav.velocity))
    assert after.body_velocity(ZERO) == pytest.approx(nav.body_velocity(ZERO))
    assert math.remainder(after.yaw - nav.yaw - 0.8, math.tau) == pytest.approx(0.0, abs=1e-9)
    level = heading_alignment.rotate(nav, Rotation(0.8, 0.0), SETUP.layout).covariance
    assert after.covariance[8, 8] == pytest.approx(level[8, 8] + 0.01)
    # the velocity rotates with yaw: its error is that of yaw, across it
    vx, vy, _ = after.velocity
    assert after.covariance[3, 8] - level[3, 8] == pytest.approx(-vy * 0.01)
    assert after.covariance[4, 8] - level[4, 8] == pytest.approx(vx * 0.01)
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_given_a_fix_then_the_antenna_is_placed_there_and_its_correlated_error_and_latency_are_those_of_the_position():
    nav = some_nav(SETUP, 6)
    latency_at = SETUP.layout.index(LATENCY)
    prior = nav.covariance.copy()
    prior[latency_at, :] = prior[:, latency_at] = 0.0
    prior[latency_at, latency_at] = 0.1**2
    nav = nav._replace(
        covariance=prior,
        extras=tuple(0.2 if n == SETUP.layout.extra_index(LATENCY) else value for n, value in enumerate(nav.extras)),
    )
    lever = SETUP.rig.lever_arm(ANTENNA)
    fix = PathFix(T0, 30.0 - 40.0j, 5.0, 0j, 0j, 0j, 0.05, 0.5, 0.8)
    after = heading_alignment.place(nav, fix, 1.0 + 2.0j, lever, SETUP.layout)
    vx, vy, _ = nav.point_velocity(lever)
    v = np.array((vx, vy, 0.0))
    second_order = np.array((*(0.1**2 * np.diagonal(nav.covariance)[3:5]), 0.0))
    assert after.point(lever) == pytest.approx(np.array((31.0, -38.0, 5.0)) + 0.2 * v)
    P, at = after.covariance, SETUP.layout.index(CORRELATED_ERROR[0])
    assert np.linalg.eigvalsh(P)[0] > -1e-9
    assert (P == P.T).all()
    # the error of the antenna is that of the fix alone, whatever the attitude error
    H = np.zeros((3, SETUP.layout.size))
    H[:, :3] = np.eye(3)
    H[:, 6:9] = -so3.skew(so3.rotate(after.attitude, lever))
    assert np.diagonal(H @ P @ H.T) == pytest.approx(
        np.array((0.5**2 + 0.05**2, 0.5**2 + 0.05**2, 0.8**2 + 0.4**2)) + np.square(v * 0.1) + second_order
    )
    assert P[:3, latency_at] == pytest.approx(v * 0.1**2)
    assert (P[0, at], P[1, at + 1], P[2, at + 2]) == pytest.approx((-0.5, -0.5, -0.8))
    assert [after.extras[SETUP.layout.extra_index(name)] for name in CORRELATED_ERROR] == [0.0, 0.0, 0.0]


def test_given_a_speed_then_the_velocity_along_the_body_is_set_to_it():
    nav = some_nav(SETUP, 7)
    P = nav.covariance.copy()
    P[3:6, 3:6] = np.eye(3) * 900.0
    after = heading_alignment.set_speed(nav._replace(covariance=P), 4.0, 0.1)
    assert after.body_velocity(ZERO)[0] == pytest.approx(4.0, abs=0.05)
    forward = np.array(so3.rotate(after.attitude, (1.0, 0.0, 0.0)))
    assert math.sqrt(forward @ after.covariance[3:6, 3:6] @ forward) < 0.5


# --- wheels -------------------------------------------------------------------------------------------------


def create_wheel_speed(kinematics: str, *names: str) -> WheelSpeed:
    found = WheelSpeed.create(rig(kinematics, names), SETTINGS)  # type: ignore[arg-type]
    assert found is not None
    return found


def create_wheels_sample(seconds: float, *wheels: WheelSample) -> WheelsSample:
    return WheelsSample(SensorHeader(T0 + round(seconds * 1e6), "wheels"), wheels)


@pytest.mark.parametrize("rate", [0.4, -0.7, 0.0])
def test_given_wheels_of_a_turning_vehicle_then_its_turn_rate_is_estimated(rate):
    v = 2.0
    pair = create_wheels_sample(0.0, WheelSample("RL", speed=v - rate * 0.5), WheelSample("RR", speed=v + rate * 0.5))
    found = estimate_turn_rate(pair, None, create_wheel_speed("differential", "RL", "RR"), SETTINGS)
    assert found.value == pytest.approx(rate)
    assert 0.02 < found.sigma < 0.1
    steered = []
    for name, y in (("FL", 0.5), ("FR", -0.5)):
        vx, vy = v - rate * y, rate * 1.2
        steered.append(WheelSample(name, speed=math.hypot(vx, vy), steering=math.atan2(vy, vx)))
    if rate:
        measurement = create_wheel_speed("ackermann", "FL", "FR")
        found = estimate_turn_rate(create_wheels_sample(0.0, *steered), None, measurement, SETTINGS)
        assert found.value == pytest.approx(rate)
    one = create_wheels_sample(0.0, WheelSample("RL", speed=2.0))
    unknown = estimate_turn_rate(one, None, create_wheel_speed("differential", "RL", "RR"), SETTINGS)
    assert (unknown.value, unknown.sigma) == (0.0, SETTINGS.gap_rate_sigma / 3.0)


def test_given_a_faster_or_a_skidding_vehicle_then_its_wheels_measure_the_turn_rate_less_well():
    def find(speed: float, rate: float, kinematics: str) -> float:
        wheels = (WheelSample("RL", speed=speed - rate * 0.5), WheelSample("RR", speed=speed + rate * 0.5))
        measurement = create_wheel_speed(kinematics, "RL", "RR")
        return estimate_turn_rate(create_wheels_sample(0.0, *wheels), None, measurement, SETTINGS).sigma

    # each of the two wheels, 1 m apart, slips by 1 % of the speed
    assert find(10.0, 0.0, "differential") == pytest.approx(0.1 * math.sqrt(2.0))
    assert find(0.0, 0.5, "skid_steer") == pytest.approx(math.hypot(0.05, 0.15))


def test_given_travel_then_the_mean_speed_is_used_and_without_it_the_present_speed():
    contacts = create_wheel_speed("differential", "RL", "RR").contacts
    before = create_wheels_sample(0.0, WheelSample("RL", travel=1.0), WheelSample("RR", speed=9.0))
    now = create_wheels_sample(0.4, WheelSample("RL", travel=1.8, speed=7.0), WheelSample("RR", travel=3.0, speed=2.1))
    left, right = read_wheels(now, before, contacts, SETTINGS)
    assert (left.speed, left.is_mean) == (pytest.approx(2.0), True)
    assert (right.speed, right.is_mean) == (2.1, False)
    # too long ago, or not after the previous one: the present speed
    assert [
        each.is_mean
        for each in read_wheels(now, create_wheels_sample(-0.7, WheelSample("RL", travel=1.0)), contacts, SETTINGS)
    ] == [False] * 2
    assert [
        each.is_mean
        for each in read_wheels(now, create_wheels_sample(0.4, WheelSample("RL", travel=1.0)), contacts, SETTINGS)
    ] == [False] * 2
    kind = create_wheel_speed("differential", "RL", "RR")
    assert kind.has_travel(now, before)
    assert not kind.has_travel(now, None)
    strange = create_wheels_sample(0.4, WheelSample("XX", speed=1.0), WheelSample("RR"))
    assert read_wheels(strange, None, contacts, SETTINGS) == []


def test_given_stationary_or_rolling_or_silent_wheels_then_that_is_found():
    contacts = create_wheel_speed("differential", "RL", "RR").contacts
    assert (
        are_wheels_stationary(create_wheels_sample(0.0, WheelSample("RL", speed=0.01)), None, contacts, SETTINGS)
        is True
    )
    moving = create_wheels_sample(0.0, WheelSample("RL", speed=0.0), WheelSample("RR", speed=0.5))
    assert are_wheels_stationary(moving, None, contacts, SETTINGS) is False
    assert are_wheels_stationary(create_wheels_sample(0.0, WheelSample("RL")), None, contacts, SETTINGS) is None


def test_given_a_skid_steered_vehicle_with_a_wheel_missing_then_the_turn_cancels_all_the_same():
    kind = create_wheel_speed("skid_steer", *WHEELS)
    assert kind.skid
    assert kind.half_track == 0.5
    v, w = 2.0, 0.6
    speeds = {"FL": v - 0.5 * w, "RL": v - 0.5 * w, "FR": v + 0.5 * w, "RR": v + 0.5 * w}
    for missing in (None, *WHEELS):
        sample = create_wheels_sample(
            0.0, *(WheelSample(name, speed=s) for name, s in speeds.items() if name != missing)
        )
        mean = _mean(read_wheels(sample, None, kind.contacts, SETTINGS))
        assert mean.speed == pytest.approx(v)
        assert mean.contact[1] == pytest.approx(0.0)


# --- Odom ---------------------------------------------------------------------------------------------------


def test_given_a_steady_turn_then_odom_follows_its_circle_and_its_uncertainty_grows():
    nav = some_nav(SETUP, 1)._replace(
        attitude=so3.IDENTITY, gyro_bias=ZERO, rate=(0.0, 0.0, 0.5), velocity=(2.0, 0.0, 0.0), utime=T0
    )
    odom = Odometry().advance(nav, ZERO, is_stationary=False)
    for n in range(1, 629):
        yaw = 0.5 * n * 0.02
        turned = nav._replace(
            utime=T0 + n * 20_000,
            attitude=so3.from_rpy(0.0, 0.0, yaw),
            velocity=(2.0 * math.cos(yaw), 2.0 * math.sin(yaw), 0.0),
        )
        before, odom = odom, odom.advance(turned, ZERO, is_stationary=False)
        assert odom.drift > before.drift
    assert math.hypot(*odom.position) < 0.05
    assert odom.covariance()[0] == pytest.approx(odom.drift**2, rel=1e-3)
    assert odom.advance(nav, ZERO, is_stationary=False) is odom
    stopped = odom.stop(odom.utime)
    assert stopped.pose(odom.utime + 400_000) == odom.pose(odom.utime)
    rested = odom.advance(nav._replace(utime=odom.utime + 20_000), ZERO, is_stationary=True)
    assert (rested.drift, rested.velocity) == (odom.drift, ZERO)


def correlate_heading_with_latency(correlation: float):
    nav = some_nav(SETUP, 5)
    at = SETUP.layout.index(LATENCY)
    P = nav.covariance.copy()
    P[at, :] = P[:, at] = 0.0
    P[at, at] = 0.05**2
    P[8, at] = P[at, 8] = correlation * 0.05 * math.sqrt(P[8, 8])
    rate = (0.0, 0.0, 0.4 + nav.gyro_bias[2])
    return nav._replace(covariance=P, rate=rate, velocity=(3.0, 0.0, 0.0))


@pytest.mark.parametrize(("correlation", "is_held"), [(0.0, False), (0.05, False), (0.5, True), (-0.5, True)])
def test_given_a_heading_that_goes_with_the_latency_then_fixes_correct_the_heading_alone(correlation, is_held):
    before = correlate_heading_with_latency(correlation)
    at, extra = SETUP.layout.index(LATENCY), SETUP.layout.extra_index(LATENCY)
    # as fixes correct it, along the line on which the covariance expects both
    error = before.covariance[:, at] * (0.2 / before.covariance[at, at])
    corrected = before.inject(error, before.covariance)
    assert corrected.extras[extra] == pytest.approx(before.extras[extra] + 0.2)
    after = fusion.hold_latency(before, corrected, SETUP.layout)
    if not is_held:
        assert after is corrected
        return
    assert after.extras[extra] == pytest.approx(before.extras[extra], abs=1e-12)
    assert after.yaw == pytest.approx(before.yaw, abs=1e-3)
    # what the latency does not explain stays in the heading
    turned = before.inject(np.eye(len(error))[8] * 0.05 + error, before.covariance)
    assert fusion.hold_latency(before, turned, SETUP.layout).yaw == pytest.approx(before.yaw + 0.05, abs=3e-3)
