"""The logic around the filter: clocks, standing, start-up, finding heading, and where the state is set."""

from __future__ import annotations

import cmath
import math
import random

import numpy as np
import pytest
from support_cart import ANTENNA, GEODESY, WHEELS, localizer, model, rig, some_nav
from support_cart import IMU as IMU_FRAME

from modelserver.estimation.filter import alignment, clocks, engine, inertial, placing, start
from modelserver.estimation.filter import latency as lateness
from modelserver.estimation.filter.heading_alignment import Passed, Turn
from modelserver.estimation.filter.clock_monitor import Clocks, Verdict
from modelserver.estimation.filter.latency_estimator import Lateness
from modelserver.estimation.filter.measurements.gnss import LATENCY, CORRELATED_ERROR
from modelserver.estimation.filter.measurements.wheels import (
    WheelSpeed,
    _mean,
    rolling,
    are_wheels_stationary,
    turn_rate,
)
from modelserver.estimation.filter.eskf import ZERO
from modelserver.estimation.filter.odometry import Odometry
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.setup import Setup
from modelserver.estimation.filter.state import FilterState
from modelserver.estimation.filter.stationary_detector import Stillness
from modelserver.estimation.filter.eskf import STANDARD_GRAVITY, level_attitude
from modelserver.estimation.sensor_rig import Mounts
from modelserver.messages import (
    Decision,
    Estimate,
    ImuSample,
    Invalid,
    Phase,
    SensorHeader,
    WheelSample,
    WheelsSample,
)
from modelserver.messages import Verdict as Became
from modelserver.simulation.scenario import START_UTIME
from modelserver.transforms import Pose, so3
from modelserver.transforms.so3 import Vector3

SETTINGS = FilterSettings()
SETUP = Setup(rig())
T0 = START_UTIME
MOUNT = Mounts.from_model(model(), "Cart:Base", ANTENNA, IMU_FRAME).X_base_imu.wxyz


# --- clocks -------------------------------------------------------------------------------------------------


def judged(known: Clocks, *stamps: tuple[str, int, float, int]) -> tuple[Clocks, list[str]]:
    """Take stamps (source, rank, seconds since T0, sequence number)."""
    words = []
    for name, rank, seconds, seq in stamps:
        known, verdict = known.take(("sample", name), rank, T0 + round(seconds * 1e6), seq, SETTINGS)
        words.append(verdict.value)
    return known, words


def running() -> Clocks:
    known, words = judged(
        Clocks(), *[("imu", 2, n * 0.02, n + 1) for n in range(500)], ("gps", 0, 9.0, 1), ("gps", 0, 9.9, 2)
    )
    assert words == ["good"] * 502
    return known


def test_given_stamps_that_are_late_within_the_horizon_then_they_are_good_and_beyond_not():
    _, words = judged(running(), ("wheels", 1, 9.5, 1), ("map", 0, 9.98 - 0.99, 1), ("other", 0, 9.98 - 1.01, 1))
    assert words == ["good", "good", "too_old"]


def test_given_a_source_that_goes_back_while_its_numbers_go_on_then_its_order_is_wrong_beyond_the_horizon():
    _, words = judged(running(), ("gps", 0, 8.5, 3), ("gps", 0, 9.95, 4))
    assert words == ["out_of_sequence", "good"]
    # within it the stamp alone decides, so that it does not matter what arrived first
    _, words = judged(running(), ("gps", 0, 9.5, 3), ("gps", 0, 9.95, 4))
    assert words == ["good", "good"]
    # numbers of few bits begin anew
    _, words = judged(running(), ("gps", 0, 9.96, 0), ("gps", 0, 9.5, 255), ("gps", 0, 9.6, 254), ("gps", 0, 9.7, 253))
    assert words == ["good"] * 4
    # one that merely comes late keeps its earlier number
    _, words = judged(running(), ("gps", 0, 9.5, 1))
    assert words == ["good"]


def test_given_the_lead_set_back_then_time_steps_when_a_run_of_samples_agrees():
    known, words = judged(running(), *[("imu", 2, 2.0 + n * 0.02, 501 + n) for n in range(4)])
    assert words == ["out_of_sequence", "out_of_sequence", "stepped_back", "good"]
    assert known.newest == T0 + 2_060_000
    # samples that come before what was odd do not make a run
    _, words = judged(running(), *[("imu", 2, 3.0 - n * 0.02, 501 + n) for n in range(6)])
    assert words == ["out_of_sequence"] * 6


def test_given_a_stamp_ahead_when_the_lead_goes_on_as_before_then_time_does_not_step_back():
    """One forged stamp that is 0.2 s ahead: the true ones after it seem to have gone back."""
    _, words = judged(running(), ("imu", 2, 10.18, 501), *[("imu", 2, 9.98 + n * 0.02, 501 + n) for n in range(1, 20)])
    assert set(words) == {"good"}
    # a clock that was set back by as much covers ground that was covered before
    _, words = judged(running(), *[("imu", 2, 9.78 + n * 0.02, 501 + n) for n in range(4)])
    assert words[2] == "stepped_back"


def test_given_another_kind_of_sample_by_the_leads_name_then_its_stamps_are_its_own():
    known = running()
    for n in range(10):
        known, _ = known.take(("range", "imu"), 0, T0 + 10_180_000 + n, 501 + n, SETTINGS)
        known, verdict = known.take(("sample", "imu"), 2, T0 + 10_000_000 + n * 10_000, 501 + n, SETTINGS)
        assert verdict is Verdict.GOOD


def test_given_another_source_set_back_then_time_does_not_step():
    _, words = judged(running(), *[("gps", 0, 2.0 + n * 0.2, 3 + n) for n in range(10)])
    assert words == ["out_of_sequence"] * 10


def test_given_a_stamp_from_the_future_then_it_is_believed_once_a_run_of_samples_agrees():
    _, words = judged(running(), ("imu", 2, 99.0, 501), ("imu", 2, 10.0, 502), ("imu", 2, 99.1, 503))
    assert words == ["future", "good", "future"]
    known, words = judged(running(), *[("imu", 2, 99.0 + n * 0.02, 501 + n) for n in range(3)])
    assert words == ["future", "future", "good"]
    assert known.newest == T0 + 99_040_000
    # another one cannot set time forward while the lead speaks
    _, words = judged(
        running(),
        *[pair for n in range(5) for pair in (("gps", 0, 99.0 + n, 3 + n), ("imu", 2, 10.0 + 0.02 * n, 501 + n))],
    )
    assert words == ["future", "good"] * 5


def test_given_a_flood_of_names_then_memory_is_bounded_and_the_known_sources_are_watched_on():
    known, _ = judged(running(), *[(f"evil{n}", 0, 9.9, 1) for n in range(2 * clocks.MOST_SOURCES)])
    assert len(known.sources) == clocks.MOST_SOURCES
    known, words = judged(known, *[("imu", 2, 10.0 + n * 0.02, 501 + n) for n in range(300)])
    assert set(words) == {"good"}
    assert known.sources["sample", "imu"].newest == T0 + 15_980_000
    _, words = judged(known, *[("imu", 2, 8.0 + n * 0.02, 801 + n) for n in range(3)])
    assert words[-1] == Verdict.STEPPED_BACK.value


# --- standing -----------------------------------------------------------------------------------------------


def felt_for(seconds: float, still: Stillness, noise: float, bias: Vector3 = ZERO, sigma: float = 0.01) -> Stillness:
    shaken = random.Random(3).gauss
    for n in range(round(seconds * 50)):
        rate = (shaken(0.01, noise), shaken(0.0, noise), shaken(-0.01, noise))
        force = (shaken(0.0, 10.0 * noise), 0.0, 9.8 + shaken(0.0, 10.0 * noise))
        still = still.felt(T0 + n * 20_000, rate, force, bias, sigma, SETTINGS)
    return still


def test_given_a_quiet_unit_then_all_is_still_and_its_mean_rate_is_its_bias():
    still = felt_for(4.0, Stillness(), 0.004)
    assert 2.5 < still.seconds(still.utime) < 4.0
    assert still.mean_rate == pytest.approx((0.01, 0.0, -0.01), abs=1e-3)
    assert still.used().summed == 0.0
    assert still.used().since == still.since


def test_given_a_shaken_unit_or_one_that_turns_evenly_then_nothing_is_still():
    assert felt_for(4.0, Stillness(), 0.05).seconds(T0 + 4_000_000) == 0.0
    # a bias that is known to 1e-4 rad/s cannot be 0.014
    turning = felt_for(4.0, Stillness(), 0.004, (0.05, 0.0, 0.0), 1e-4)
    assert turning.seconds(turning.utime) == 0.0


def test_given_wheels_that_roll_then_a_quiet_unit_is_not_still_until_they_have_stopped():
    still = felt_for(4.0, Stillness(), 0.004)
    assert still.rolled(still.utime, False).seconds(still.utime) == 0.0
    assert not still.rolled(still.utime, False).vouched(still.utime)
    assert still.rolled(still.utime, True).vouched(still.utime)
    assert not still.rolled(still.utime, True).vouched(still.utime + 2_000_000)
    assert still.rolled(still.utime, None) is still


# --- start-up -----------------------------------------------------------------------------------------------


def imu_at(seconds: float, rate: Vector3, force: Vector3, seq: int = 0) -> ImuSample:
    """A sample of what is felt along the body's axes."""
    back = so3.conjugate(MOUNT)
    header = SensorHeader(T0 + round(seconds * 1e6), "imu", seq)
    return ImuSample(header, so3.rotate(back, rate), so3.rotate(back, force))


def stood(seconds: float, roll: float = 0.0, pitch: float = 0.0, noise: float = 0.003, setup: Setup = SETUP):
    """The filter after standing on a slope with a bias of the gyros, and what it decided."""
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
        found, said = found.process(imu_at(n * 0.02, rate, force, n))
        notes += [note for note in said if isinstance(note, Decision)]
    return found, notes


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.15, -0.2), (-0.3, 0.1)])
def test_given_a_vehicle_that_stands_on_a_slope_then_it_is_levelled_and_its_gyros_biases_are_captured(roll, pitch):
    found, _ = stood(3.0, roll, pitch)
    nav = found.head.nav
    assert nav is not None
    assert (found.head.phase, found.head.tilt) == (Phase.UNALIGNED, 0.0)
    assert so3.to_rpy(nav.attitude)[:2] == pytest.approx((roll, pitch), abs=0.005)
    assert nav.gyro_bias == pytest.approx((0.01, -0.02, 0.005), abs=0.001)
    assert np.sqrt(np.diagonal(nav.covariance)[9:12]) == pytest.approx(SETTINGS.gyro_noise / math.sqrt(2.0), rel=0.3)
    assert math.hypot(*nav.velocity) < 0.01
    assert nav.point(SETUP.rig.base) == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
    # tilt and the accelerometers' bias are one unknown: gravity along the body stays explained
    P = nav.covariance
    R = np.array(so3.matrix_rows(nav.attitude))
    explained = np.hstack([STANDARD_GRAVITY * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), -R[:2]])
    both = np.r_[6:9, 12:15]
    assert np.sqrt(np.diagonal(explained @ P[np.ix_(both, both)] @ explained.T)).max() < 0.02


def test_given_a_vehicle_that_shakes_then_it_is_levelled_on_the_move_and_is_less_sure():
    found, _ = stood(4.5, 0.1, 0.0, noise=0.1)
    assert found.head.nav is None
    assert found.estimate(found.head.imu_utime).invalid & Invalid.NOT_MOVED_YET
    found, _ = stood(5.1, 0.1, 0.0, noise=0.1)
    nav = found.head.nav
    assert nav is not None
    assert so3.to_rpy(nav.attitude)[0] == pytest.approx(0.1, abs=0.1)
    assert max(map(abs, nav.gyro_bias)) < 0.003
    P = np.sqrt(np.diagonal(nav.covariance))
    assert P[3] > 10.0
    assert P[6] > 0.05
    assert P[9] == pytest.approx(SETTINGS.gyro_bias_sigma, rel=0.1)


def test_given_a_mount_that_is_wrong_then_it_stays_tilted_and_says_so_each_time():
    found, notes = stood(9.0, roll=1.5)
    assert found.head.nav is None
    assert found.head.tilt == pytest.approx(1.5, abs=0.01)
    assert found.estimate(found.head.imu_utime).invalid & Invalid.TILTED
    mount = [note for note in notes if note.reason == "mount"]
    assert len(mount) >= 2
    assert all(note.verdict is Became.REJECTED for note in mount)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.9), (-1.0, 0.5, 3.0)])
def test_given_what_is_felt_as_up_then_the_attitude_turns_it_up_and_has_no_yaw(up):
    q = level_attitude(up)
    x, y, z = so3.rotate(q, up)
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert z > 0.0
    assert so3.to_rpy(q)[2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("word", ["nan", "range"])
def test_given_inertial_samples_that_cannot_be_then_they_are_refused(word):
    wrong = math.nan if word == "nan" else 1e6
    for sample in (imu_at(0.0, (wrong, 0.0, 0.0), (0.0, 0.0, 9.8)), imu_at(0.0, ZERO, (0.0, 0.0, wrong))):
        assert inertial.read(SETUP, sample) == word
    assert inertial.read(SETUP, ImuSample(SensorHeader(T0), None, (0.0, 0.0, 9.8))) == "nan"
    found = inertial.read(SETUP, imu_at(0.0, (0.1, 0.2, 0.3), (0.0, 0.0, 9.8)))
    assert not isinstance(found, str)
    assert found[0] == pytest.approx((0.1, 0.2, 0.3))


def test_given_another_localizers_pose_then_the_filter_begins_where_it_was_and_as_sure():
    first = engine.first(SETUP, FilterState().mode, GEODESY)
    P = np.diag([0.04, 0.09, 0.16, 1e-3, 2e-3, 3e-3])
    X = Pose.from_rpy((10.0, 20.0, 1.0), 0.0, 0.1, 0.7)
    before = Estimate(T0 - 100_000, Pose((0.0, 0.0, 0.0)), X)
    last = Estimate(T0, Pose((0.3, 0.0, 0.0)), X, X, tuple(P.ravel().tolist()))
    state = start.start_from(SETUP, first, last, before)
    assert state is not None
    assert state.nav is not None
    assert state.phase is Phase.ALIGNED
    assert state.nav.point(SETUP.rig.base) == pytest.approx(X.xyz)
    assert so3.rotate(so3.conjugate(X.wxyz), state.nav.velocity) == pytest.approx((3.0, 0.0, 0.0))
    assert np.diagonal(state.nav.covariance)[[0, 1, 2, 6, 7, 8]] == pytest.approx(np.diagonal(P))
    for wrong in (Estimate(T0, Pose.identity()), Estimate(T0, X, X, X, last.covariance, invalid=Invalid.STALE_GPS)):
        assert start.start_from(SETUP, first, wrong, before) is None


# --- finding heading ----------------------------------------------------------------------------------------


def stretch(turn: float, speed: float = 2.0, noise: float = 0.02, arm: complex = 0.5 + 0.2j) -> tuple[Passed, ...]:
    """Twenty seconds through a bend, the filter's own way turned by `turn` against the world's."""
    shaken = random.Random(1).gauss
    at, unit, found = 0j, 0j, []
    for n in range(100):
        yaw = 0.05 * n * 0.2
        direction = cmath.rect(1.0, yaw)
        if n % 5 == 0:
            place = cmath.rect(1.0, turn) * (at + arm * direction) + complex(shaken(0.0, noise), shaken(0.0, noise))
            found.append(
                Passed(
                    T0 + n * 200_000, 100.0 + place, 0.0, at + arm * direction, arm * direction, unit, noise, 0.1, 0.1
                )
            )
        at += speed * 0.2 * direction * cmath.rect(1.0, 0.005)
        unit += 0.2 * direction * cmath.rect(1.0, 0.005)
    return tuple(found)


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.1, -2.5])
@pytest.mark.parametrize("speed", [2.0, -1.5])
def test_given_the_way_driven_forward_or_in_reverse_then_it_lies_on_the_fixes_turned_by_as_much(turn, speed):
    fit = alignment.fitted(stretch(turn, speed), SETTINGS, by_unit=False, rate_sigma=1e-3)
    assert fit is not None
    assert abs(math.remainder(fit.turn.angle - turn, math.tau)) < 4.0 * fit.turn.sigma
    assert fit.turn.sigma < 0.05
    assert fit.factor == pytest.approx(1.0, abs=0.02)
    assert fit.distance > 20.0
    assert alignment.agrees(fit, stretch(turn, speed)[-1])


def test_given_no_speed_then_the_way_at_speed_one_tells_it_with_heading():
    fit = alignment.fitted(stretch(1.0), SETTINGS, by_unit=True, rate_sigma=1e-3)
    assert fit is not None
    assert fit.turn.angle == pytest.approx(1.0, abs=0.02)
    assert fit.factor == pytest.approx(2.0, abs=0.02)


def test_given_fixes_that_are_not_the_way_then_they_do_not_agree_and_too_few_say_nothing():
    shaken = random.Random(1).gauss
    off = tuple(each._replace(place=each.place + complex(shaken(0.0, 9.0), shaken(0.0, 9.0))) for each in stretch(1.0))
    fit = alignment.fitted(off, SETTINGS, by_unit=False, rate_sigma=1e-3)
    assert fit is not None
    assert not alignment.agrees(fit, off[-1])
    assert alignment.fitted(off[:2], SETTINGS, by_unit=False, rate_sigma=1e-3) is None
    standing = tuple(each._replace(way=0j) for each in off)
    assert alignment.fitted(standing, SETTINGS, by_unit=False, rate_sigma=1e-3) is None


def test_given_a_long_stretch_then_it_is_thinned_and_cut():
    newest = stretch(0.0)[-1]
    kept: tuple[Passed, ...] = ()
    for n in range(500):
        kept = alignment.kept(kept, newest._replace(utime=T0 + n * 100_000), 60.0)
        assert len(kept) <= alignment.MOST + 1
    assert kept[-1].utime == T0 + 499 * 100_000
    assert kept[0].utime < T0 + 20_000_000
    assert alignment.kept(kept, newest._replace(utime=T0 + 90_000_000), 60.0)[0].utime >= T0 + 30_000_000


# --- setting the state --------------------------------------------------------------------------------------


def late_stretch(late: float, speed: str, rate: float = 0.0) -> tuple[Passed, ...]:
    """Eight seconds from rest to 3 m/s, or steadily at that; fixes tell where the vehicle was `late` seconds before."""
    turn, noise = 0.7, 0.02
    shaken = random.Random(2).gauss

    def way(t: float) -> complex:
        steps = 400
        dt = t / steps
        found = 0j
        for n in range(steps):
            at = (n + 0.5) * dt
            v = 3.0 if speed == "steady" else min(max(at - 2.0, 0.0), 3.0)
            found += v * dt * cmath.rect(1.0, rate * at)
        return found

    return tuple(
        Passed(
            T0 + n * 250_000,
            20.0 + cmath.rect(1.0, turn) * way(n * 0.25 - late) + complex(shaken(0.0, noise), shaken(0.0, noise)),
            0.0,
            way(n * 0.25),
            0j,
            0j,
            noise,
            0.1,
            0.1,
        )
        for n in range(33)
    )


@pytest.mark.parametrize("rate", [0.0, 0.3])
@pytest.mark.parametrize("late", [0.0, 0.1, 0.4])
def test_given_fixes_that_are_late_then_a_way_of_changing_speed_tells_by_how_much(late, rate):
    found = lateness.told(late_stretch(late, "from rest", rate=rate))
    assert found is not None
    assert found.sigma < 0.02
    # to the first order of lateness, and with corners that four fixes a second round off
    assert abs(found.seconds - late) < 4.0 * found.sigma + 0.15 * late + 0.01


@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_given_a_steady_way_then_it_does_not_tell_how_late_fixes_are(rate):
    found = lateness.told(late_stretch(0.4, "steady", rate=rate))
    assert found is None or found.sigma > 1.0


def test_given_too_few_fixes_then_they_do_not_tell_how_late_they_are():
    assert lateness.told(late_stretch(0.0, "from rest")[:5]) is None
    still = tuple(each._replace(way=0j) for each in late_stretch(0.0, "from rest"))
    assert lateness.told(still) is None


def test_given_late_fixes_in_a_circle_then_the_turn_says_how_much_of_it_is_their_lateness():
    rate, late = 0.5, 0.2
    prompt = alignment.fitted(late_stretch(0.0, "steady", rate=rate), SETTINGS, by_unit=False, rate_sigma=1e-3)
    tardy = alignment.fitted(late_stretch(late, "steady", rate=rate), SETTINGS, by_unit=False, rate_sigma=1e-3)
    assert prompt is not None
    assert tardy is not None
    assert prompt.turn.turning == pytest.approx(rate, rel=0.02)
    assert prompt.turn.angle - tardy.turn.angle == pytest.approx(rate * late, abs=0.01)


def test_given_a_turn_that_late_fixes_told_then_yaw_and_lateness_share_their_error():
    nav = some_nav(SETUP, 5)
    late_at, extra = SETUP.layout.index(LATENCY), SETUP.layout.extra(LATENCY)
    P = nav.covariance.copy()
    P[late_at, :] = P[:, late_at] = 0.0
    P[late_at, late_at] = 0.1**2
    extras = tuple(0.05 if n == extra else value for n, value in enumerate(nav.extras))
    nav = nav._replace(covariance=P, extras=extras)
    plain = placing.turned(nav, Turn(0.8 + 0.6 * 0.05, 0.02), SETUP.layout)
    after = placing.turned(nav, Turn(0.8, 0.02, turning=0.6), SETUP.layout)
    assert after.yaw == pytest.approx(plain.yaw)
    assert after.covariance[8, 8] == pytest.approx(plain.covariance[8, 8] + (0.6 * 0.1) ** 2)
    assert after.covariance[8, late_at] == pytest.approx(0.6 * 0.1**2)
    vx, vy, _ = after.velocity
    assert after.covariance[3:5, late_at] == pytest.approx(np.array((-vy, vx)) * 0.6 * 0.1**2)
    assert np.linalg.eigvalsh(after.covariance)[0] > -1e-12


def test_given_lateness_that_nobody_expected_then_it_is_unsure_between_what_was_expected_and_what_was_found():
    nav = some_nav(SETUP, 5)
    late_at, extra = SETUP.layout.index(LATENCY), SETUP.layout.extra(LATENCY)
    P = nav.covariance.copy()
    P[late_at, late_at] = 0.1**2
    extras = tuple(0.0 if n == extra else value for n, value in enumerate(nav.extras))
    nav = nav._replace(covariance=P, extras=extras)
    assert lateness.doubted(nav, Lateness(0.3, 0.01), SETUP.layout) is nav
    assert lateness.doubted(nav, Lateness(0.8, 5.0), SETUP.layout) is nav
    after = lateness.doubted(nav, Lateness(0.8, 0.01), SETUP.layout)
    assert after.extras[extra] == pytest.approx(0.4)
    assert after.covariance[late_at, late_at] == pytest.approx(0.8**2 + 0.01**2)
    assert np.count_nonzero(after.covariance[late_at]) == 1
    assert np.count_nonzero(after.covariance[:, late_at]) == 1


def test_given_a_heading_that_was_found_then_all_in_n_turns_with_it_and_only_yaw_is_less_sure():
    nav = some_nav(SETUP, 5)
    after = placing.turned(nav, Turn(0.8, 0.1), SETUP.layout)
    spin = so3.from_rpy(0.0, 0.0, 0.8)
    assert after.position == pytest.approx(so3.rotate(spin, nav.position))
    assert after.velocity == pytest.approx(so3.rotate(spin, nav.velocity))
    assert after.body_velocity(ZERO) == pytest.approx(nav.body_velocity(ZERO))
    assert math.remainder(after.yaw - nav.yaw - 0.8, math.tau) == pytest.approx(0.0, abs=1e-9)
    level = placing.turned(nav, Turn(0.8, 0.0), SETUP.layout).covariance
    assert after.covariance[8, 8] == pytest.approx(level[8, 8] + 0.01)
    # velocity turns with yaw: its error is that of yaw across it
    vx, vy, _ = after.velocity
    assert after.covariance[3, 8] - level[3, 8] == pytest.approx(-vy * 0.01)
    assert after.covariance[4, 8] - level[4, 8] == pytest.approx(vx * 0.01)
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


def test_given_a_fix_then_the_antenna_is_put_there_and_its_lingering_error_and_lateness_are_the_positions():
    nav = some_nav(SETUP, 6)
    late_at = SETUP.layout.index(LATENCY)
    prior = nav.covariance.copy()
    prior[late_at, :] = prior[:, late_at] = 0.0
    prior[late_at, late_at] = 0.1**2
    nav = nav._replace(
        covariance=prior,
        extras=tuple(0.2 if n == SETUP.layout.extra(LATENCY) else value for n, value in enumerate(nav.extras)),
    )
    lever = SETUP.rig.lever_arm(ANTENNA)
    fix = Passed(T0, 30.0 - 40.0j, 5.0, 0j, 0j, 0j, 0.05, 0.5, 0.8)
    after = placing.placed(nav, fix, 1.0 + 2.0j, lever, SETUP.layout)
    vx, vy, _ = nav.point_velocity(lever)
    v = np.array((vx, vy, 0.0))
    doubt = np.array((*(0.1**2 * np.diagonal(nav.covariance)[3:5]), 0.0))
    assert after.point(lever) == pytest.approx(np.array((31.0, -38.0, 5.0)) + 0.2 * v)
    P, at = after.covariance, SETUP.layout.index(CORRELATED_ERROR[0])
    assert np.linalg.eigvalsh(P)[0] > -1e-9
    assert (P == P.T).all()
    # the antenna's own error is the fix's alone, whatever attitude is off by
    H = np.zeros((3, SETUP.layout.size))
    H[:, :3] = np.eye(3)
    H[:, 6:9] = -so3.skew(so3.rotate(after.attitude, lever))
    assert np.diagonal(H @ P @ H.T) == pytest.approx(
        np.array((0.5**2 + 0.05**2, 0.5**2 + 0.05**2, 0.8**2 + 0.4**2)) + np.square(v * 0.1) + doubt
    )
    assert P[:3, late_at] == pytest.approx(v * 0.1**2)
    assert (P[0, at], P[1, at + 1], P[2, at + 2]) == pytest.approx((-0.5, -0.5, -0.8))
    assert [after.extras[SETUP.layout.extra(name)] for name in CORRELATED_ERROR] == [0.0, 0.0, 0.0]


def test_given_a_speed_then_the_velocity_along_the_body_is_drawn_to_it():
    nav = some_nav(SETUP, 7)
    P = nav.covariance.copy()
    P[3:6, 3:6] = np.eye(3) * 900.0
    after = placing.at_speed(nav._replace(covariance=P), 4.0, 0.1)
    assert after.body_velocity(ZERO)[0] == pytest.approx(4.0, abs=0.05)
    forward = np.array(so3.rotate(after.attitude, (1.0, 0.0, 0.0)))
    assert math.sqrt(forward @ after.covariance[3:6, 3:6] @ forward) < 0.5


# --- wheels -------------------------------------------------------------------------------------------------


def wheel_speed(kinematics: str, *names: str) -> WheelSpeed:
    found = WheelSpeed.of(rig(kinematics, names), SETTINGS)  # type: ignore[arg-type]
    assert found is not None
    return found


def said(seconds: float, *wheels: WheelSample) -> WheelsSample:
    return WheelsSample(SensorHeader(T0 + round(seconds * 1e6), "wheels"), wheels)


@pytest.mark.parametrize("rate", [0.4, -0.7, 0.0])
def test_given_wheels_of_a_turning_vehicle_then_its_turn_rate_comes_out(rate):
    v = 2.0
    pair = said(0.0, WheelSample("RL", speed=v - rate * 0.5), WheelSample("RR", speed=v + rate * 0.5))
    assert turn_rate(pair, None, wheel_speed("differential", "RL", "RR"), SETTINGS) == pytest.approx(rate)
    steered = []
    for name, y in (("FL", 0.5), ("FR", -0.5)):
        vx, vy = v - rate * y, rate * 1.2
        steered.append(WheelSample(name, speed=math.hypot(vx, vy), steering=math.atan2(vy, vx)))
    if rate:
        assert turn_rate(said(0.0, *steered), None, wheel_speed("ackermann", "FL", "FR"), SETTINGS) == pytest.approx(
            rate
        )
    one = said(0.0, WheelSample("RL", speed=2.0))
    assert turn_rate(one, None, wheel_speed("differential", "RL", "RR"), SETTINGS) == 0.0


def test_given_travel_then_it_tells_the_mean_speed_and_without_it_the_speed_counts():
    contacts = wheel_speed("differential", "RL", "RR").contacts
    before = said(0.0, WheelSample("RL", travel=1.0), WheelSample("RR", speed=9.0))
    now = said(0.4, WheelSample("RL", travel=1.8, speed=7.0), WheelSample("RR", travel=3.0, speed=2.1))
    left, right = rolling(now, before, contacts, SETTINGS)
    assert (left.speed, left.mean) == (pytest.approx(2.0), True)
    assert (right.speed, right.mean) == (2.1, False)
    # too long ago, or of another instant than before: the speed of now
    assert [each.mean for each in rolling(now, said(-0.7, WheelSample("RL", travel=1.0)), contacts, SETTINGS)] == [
        False
    ] * 2
    assert [each.mean for each in rolling(now, said(0.4, WheelSample("RL", travel=1.0)), contacts, SETTINGS)] == [
        False
    ] * 2
    kind = wheel_speed("differential", "RL", "RR")
    assert kind.by_travel(now, before)
    assert not kind.by_travel(now, None)
    strange = said(0.4, WheelSample("XX", speed=1.0), WheelSample("RR"))
    assert rolling(strange, None, contacts, SETTINGS) == []


def test_given_wheels_that_stand_or_roll_or_say_nothing_then_so_it_is():
    contacts = wheel_speed("differential", "RL", "RR").contacts
    assert are_wheels_stationary(said(0.0, WheelSample("RL", speed=0.01)), None, contacts, SETTINGS) is True
    moving = said(0.0, WheelSample("RL", speed=0.0), WheelSample("RR", speed=0.5))
    assert are_wheels_stationary(moving, None, contacts, SETTINGS) is False
    assert are_wheels_stationary(said(0.0, WheelSample("RL")), None, contacts, SETTINGS) is None


def test_given_a_vehicle_that_skids_with_a_wheel_missing_then_the_turn_still_falls_out():
    kind = wheel_speed("skid_steer", *WHEELS)
    assert kind.skid
    assert kind.half_track == 0.5
    v, w = 2.0, 0.6
    speeds = {"FL": v - 0.5 * w, "RL": v - 0.5 * w, "FR": v + 0.5 * w, "RR": v + 0.5 * w}
    for missing in (None, *WHEELS):
        sample = said(0.0, *(WheelSample(name, speed=s) for name, s in speeds.items() if name != missing))
        mean = _mean(rolling(sample, None, kind.contacts, SETTINGS))
        assert mean.speed == pytest.approx(v)
        assert mean.contact[1] == pytest.approx(0.0)


# --- Odom ---------------------------------------------------------------------------------------------------


def test_given_a_steady_turn_then_odom_draws_its_circle_and_says_how_far_it_may_be_off():
    nav = some_nav(SETUP, 1)._replace(
        attitude=so3.IDENTITY, gyro_bias=ZERO, rate=(0.0, 0.0, 0.5), velocity=(2.0, 0.0, 0.0), utime=T0
    )
    odom = Odometry().advanced(nav, ZERO, standing=False)
    for n in range(1, 629):
        yaw = 0.5 * n * 0.02
        turned = nav._replace(
            utime=T0 + n * 20_000,
            attitude=so3.from_rpy(0.0, 0.0, yaw),
            velocity=(2.0 * math.cos(yaw), 2.0 * math.sin(yaw), 0.0),
        )
        before, odom = odom, odom.advanced(turned, ZERO, standing=False)
        assert odom.drift > before.drift
    assert math.hypot(*odom.position) < 0.05
    assert odom.covariance()[0] == pytest.approx(odom.drift**2, rel=1e-3)
    assert odom.advanced(nav, ZERO, standing=False) is odom
    stopped = odom.stopped(odom.utime)
    assert stopped.pose(odom.utime + 400_000) == odom.pose(odom.utime)
    rested = odom.advanced(nav._replace(utime=odom.utime + 20_000), ZERO, standing=True)
    assert (rested.drift, rested.velocity) == (odom.drift, ZERO)
