"""Findings on sensors and vehicle file, each from data with just one fault."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from dataclasses import replace

import pytest

from modelserver.earth.geodesy import LocalFrame, geodetic_from_ecef
from modelserver.errors import Severity
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.messages import (
    VALID,
    Decision,
    FixType,
    GpsSample,
    Mode,
    Phase,
    SensorHeader,
    Verdict,
    WheelSample,
    WheelsSample,
)
from modelserver.server.recordings import StampAxis
from mstools.report.findings import ReportFinding, collect_findings
from mstools.report.replay_data import (
    ReplayData,
    SecondMeans,
    SensorMotion,
    SourceTimes,
    StateSample,
    compare_turn_rates,
    compute_sensor_motion,
    compute_wheel_travel,
)

START = 1_700_000_000
SECONDS = 120
TRACK = 0.6


RATE = 20
"""Wheel samples a second."""

EVEN, BURSTS, SHUFFLED = "even", "bursts", "shuffled"


def make_motion(
    left: float = 1.0,
    right: float = 1.0,
    gyro: float = 1.0,
    degrees: float = 1.0,
    with_gyro: bool = True,
    swapped: bool = False,
    arrival: str = EVEN,
    place: tuple[float, float] = (50.0, -111.0),
) -> SensorMotion:
    """Return the motion of a drive, alternately 20 s straight and 20 s in a wide turn; factors corrupt the sensors.

    `arrival`: bursts are stamped 9 us apart, four together; shuffled ones come in any order.
    """
    rates = SecondMeans()
    fixes, wheels = [], []
    x = y = yaw = 0.0
    travel = {"left": 0.0, "right": 0.0}
    plane = LocalFrame.at(*place, 0.0)
    for n in range(SECONDS):
        rate = (0.0, 0.1, 0.0, -0.1)[n // 20 % 4]
        yaw += rate
        x, y = x + 2.0 * math.cos(yaw), y + 2.0 * math.sin(yaw)
        if with_gyro:
            rates.add(START + n, gyro * rate)
        latitude, longitude, _ = geodetic_from_ecef(plane.to_ecef((x, y, 0.0)))
        latitude, longitude = (degrees * (latitude - place[0]) + place[0], degrees * (longitude - place[1]) + place[1])
        fixes.append(GpsSample(SensorHeader((START + n) * 1_000_000, "gps"), FixType.FIX_3D, latitude, longitude))
        speeds = {"left": left * (2.0 - rate * TRACK / 2.0), "right": right * (2.0 + rate * TRACK / 2.0)}
        if swapped:
            speeds = {"left": speeds["right"], "right": speeds["left"]}
        for k in range(RATE):
            travel = {name: travel[name] + speed / RATE for name, speed in speeds.items()}
            utime = (START + n) * 1_000_000 + (k + 1) * 1_000_000 // RATE
            if arrival == BURSTS:
                utime += 9 * (k % 4) - (k % 4) * 1_000_000 // RATE
            counts = tuple(WheelSample(name, round(meters, 3)) for name, meters in travel.items())
            wheels.append(WheelsSample(SensorHeader(utime, "wheels", n * RATE + k), counts))
    if arrival == SHUFFLED:
        random.Random(1).shuffle(wheels)
        random.Random(2).shuffle(fixes)
    sides = {"left": TRACK / 2.0, "right": -TRACK / 2.0}
    return compute_sensor_motion(rates.finish(), fixes, compute_wheel_travel(wheels), sides)


@pytest.mark.parametrize("arrival", [EVEN, BURSTS, SHUFFLED])
@pytest.mark.parametrize("place", [(0.0, 0.0), (50.0, -111.0), (89.999, 10.0), (-77.0, 180.0), (-33.0, -179.9999)])
def test_given_a_drive_anywhere_then_no_figure_depends_on_place_or_arrival(
    place: tuple[float, float], arrival: str
) -> None:
    found = make_motion(arrival=arrival, place=place)
    # straight lines between fixes are a little shorter than the way
    assert found.compare_distances() == pytest.approx((230.0, 230.0), rel=0.03)
    wheels, fixes = found.compare_distances()
    assert wheels / fixes == pytest.approx(1.0, abs=0.02)
    compared = compare_turn_rates(found.gyro, found.wheel_turn_rate)
    assert compared == pytest.approx((1.0, 1.0), abs=0.1)
    assert found.compare_with_course(found.gyro) == pytest.approx((1.0, 1.0), abs=0.1)
    assert collect_findings(make_data(sensor_motion=found)) == []
    swapped = make_motion(arrival=arrival, place=place, swapped=True)
    assert only(make_data(sensor_motion=swapped)).title == "Left and right wheels are swapped"


def test_given_quick_turns_of_a_slow_vehicle_then_the_gyro_is_compared_over_the_steps_of_the_fixes() -> None:
    plane, gyro, fixes = LocalFrame.at(50.0, -111.0, 0.0), {}, []
    x = y = yaw = 0.0
    for n in range(600):
        # a quarter turn within two seconds every half minute, left and right in turns
        gyro[START + n] = rate = (math.pi / 4.0 if n % 30 < 2 else 0.0) * (-1) ** (n // 60)
        yaw += rate
        x, y = x + math.cos(yaw), y + math.sin(yaw)
        latitude, longitude, _ = geodetic_from_ecef(plane.to_ecef((x, y, 0.0)))
        fixes.append(GpsSample(SensorHeader((START + n) * 1_000_000, "gps"), FixType.FIX_3D, latitude, longitude))
    found = compute_sensor_motion(gyro, fixes, [], {})
    assert found.compare_with_course(gyro) == pytest.approx((1.0, 1.0), abs=0.2)


def test_given_speeds_without_travel_then_they_are_means_of_their_seconds() -> None:
    speed = [0.5, 1.5]
    samples = [
        WheelsSample(SensorHeader(START * 1_000_000 + 9 * n, "wheels", n), (WheelSample("left", speed=speed[n]),))
        for n in range(2)
    ]
    found = compute_sensor_motion({}, [], compute_wheel_travel(samples), {"left": 0.3})
    assert found.wheels == {"left": {START: 1.0}}


def test_given_travel_that_begins_again_then_it_is_no_distance() -> None:
    samples = [
        WheelsSample(SensorHeader((START + n) * 1_000_000, "wheels", n % 2), (WheelSample("left", travel),))
        for n, travel in enumerate([5000.0, 5001.0, 0.0, 1.0])
    ]
    assert [each.speed for each in compute_wheel_travel(samples)] == [1.0, 1.0]


@pytest.mark.parametrize("burst", [1, 4, 10])
def test_given_samples_in_bursts_then_their_period_is_that_of_the_source(burst: int) -> None:
    times = tuple(0.1 * (n - n % burst) + 9e-6 * (n % burst) for n in range(200))
    assert SourceTimes("wheels", times).period == pytest.approx(0.1, rel=0.1)


def make_data(**more: object) -> ReplayData:
    states = tuple(
        StateSample(t, VALID, 0, (t, 0.0, 0.0), 0.0, 0.1, 0.01, speed=1.0, yaw_rate=0.0, phase=Phase.ALIGNED)
        for t in range(100)
    )
    given = ReplayData(
        "cart", "drive.lcm", START * 1_000_000, 100.0, FilterSettings(), states, sensor_motion=make_motion()
    )
    return replace(given, **more)  # type: ignore[arg-type]


def make_rejections(reason: str, source: str = "wheels", kind: str = "wheel_speed") -> tuple[Decision, ...]:
    return tuple(Decision(START + n, source, n, kind, Verdict.REJECTED, reason) for n in range(100))


def only(given: ReplayData) -> ReportFinding:
    (found,) = collect_findings(given)
    return found


def titles(found: Iterable[ReportFinding]) -> list[str]:
    return [each.title for each in found]


def test_given_a_good_drive_then_nothing_is_found() -> None:
    assert collect_findings(make_data()) == []
    assert collect_findings(make_data(sensor_motion=make_motion(with_gyro=False))) == []


@pytest.mark.parametrize("name", ["left", "right"])
def test_given_one_wheel_whose_sign_is_swapped_then_it_is_named(name: str) -> None:
    found = only(make_data(sensor_motion=make_motion(**{name: -1.0})))  # type: ignore[arg-type]
    assert (found.level, found.title) == (Severity.ERROR, f"Wheel {name} counts backward")
    assert "gyro" in found.observation


@pytest.mark.parametrize("with_gyro", [True, False])
def test_given_wheels_whose_names_are_swapped_then_they_are_named(with_gyro: bool) -> None:
    found = only(make_data(sensor_motion=make_motion(swapped=True, with_gyro=with_gyro)))
    assert (found.level, found.title) == (Severity.ERROR, "Left and right wheels are swapped")


def test_given_a_gyro_that_turns_against_wheels_and_fixes_then_it_is_the_gyro() -> None:
    assert (
        only(make_data(sensor_motion=make_motion(gyro=-1.0))).title
        == "The gyro's rate has the opposite sign of wheels and fixes"
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_given_a_gyro_in_degrees_then_that_is_found_first(sign: float) -> None:
    found = collect_findings(
        make_data(sensor_motion=make_motion(gyro=sign * math.degrees(1.0)), mean_force=(0.0, 0.1, 9.8))
    )
    assert found[0].title == "The gyro is in degrees per second"
    assert not any("mount" in each.title for each in found)


def test_given_positions_in_radians_then_the_distances_differ_by_57() -> None:
    found = only(make_data(sensor_motion=make_motion(degrees=math.radians(1.0))))
    assert found.title.startswith("Fixes moved 4.")
    assert "m while the wheels rolled" in found.title
    assert "radians" in found.advice


def test_given_wheels_in_millimeters_then_the_unit_is_named_once_for_each_finding() -> None:
    given = make_data(
        sensor_motion=make_motion(1000.0, 1000.0), decisions=make_rejections("range"), sensor_keys={"wheels": "wheels"}
    )
    found = collect_findings(given)
    assert titles(found)[0] == "No sample of sensors.wheels is used: range"
    assert "mm" in found[0].advice
    assert "mm per m" in found[1].advice


@pytest.mark.parametrize("reason", ["names", "nan"])
def test_given_wheels_of_other_names_then_both_lists_are_named(reason: str) -> None:
    found = only(make_data(decisions=make_rejections(reason), sensor_keys={"wheels": "wheels"}, wheel_names=("l", "r")))
    assert found.title == f"No sample of sensors.wheels is used: {reason}"
    assert "The log's wheels are l, r; sensors.wheels.frames has left, right." in found.observation
    assert "sensors.wheels.frames" in found.advice


def test_given_an_inertial_unit_without_numbers_then_it_is_not_used() -> None:
    given = make_data(
        decisions=make_rejections("nan", "imu", "inertial"),
        sensor_keys={"imu": "imu"},
        sensors=(SourceTimes("imu", tuple(range(102))),),
    )
    assert titles(collect_findings(given))[0] == "No sample of sensors.imu is used: nan"
    # a tenth of them may be bad without that
    many = replace(given, sensors=(SourceTimes("imu", tuple(range(1000))),))
    assert collect_findings(many) == []


def test_given_a_sensor_that_is_used_then_rejected_samples_do_not_make_it_unused() -> None:
    used = tuple(each._replace(verdict=Verdict.USED, seq=each.seq + 1000) for each in make_rejections(""))
    given = make_data(decisions=(*make_rejections("nan"), *used), sensor_keys={"wheels": "wheels"})
    assert collect_findings(given) == []


def test_given_a_sensor_of_which_the_log_has_nothing_then_channel_and_remedies_come_first() -> None:
    given = make_data(snapshots=(), missing_channels=(("imu", "IMU"),), channels=("GPS", "WHEELS"))
    found = collect_findings(given)
    assert titles(found) == ["No messages on channel IMU (sensors.imu)", "There was never a state"]
    assert found[0].observation == "The log has GPS, WHEELS."
    assert "localization.mode: no_imu" in found[0].advice
    # a mode without it needs none
    assert collect_findings(make_data(missing_channels=(("imu", "IMU"),), mode=Mode.NO_IMU)) == []


def test_given_a_filter_that_was_restarted_then_checks_of_its_state_are_left_out() -> None:
    values = {"gyro_bias_x": 1.0}
    states = tuple(replace(each, values=values, sigmas={"gyro_bias_x": 0.001}) for each in make_data().snapshots)
    assert titles(collect_findings(make_data(snapshots=states))) == ["Gyro bias about x is far outside its data sheet"]
    restarts = tuple(
        Decision(START * 1_000_000 + n, "filter", n, "state", Verdict.RESET, "diverged: too fast") for n in (1, 2, 3)
    )
    (found,) = collect_findings(make_data(snapshots=states, decisions=restarts))
    assert found.title == "The filter was restarted"
    assert "first of 3 times" in found.observation


@pytest.mark.parametrize(
    ("offsets", "level", "title"),
    [
        (
            {"GPS": -3600.0, "IMU": -3600.0},
            Severity.NOTE,
            "All stamps are 3,600.0 s (1 h: a time zone?) behind their receipt",
        ),
        (
            {"GPS": -18.0, "IMU": 0.0},
            Severity.ERROR,
            "The stamps on GPS are 18.0 s (GPS time instead of UTC?) behind",
        ),
    ],
)
def test_given_stamps_on_another_axis_then_the_amount_is_reported(
    offsets: dict[str, float], level: Severity, title: str
) -> None:
    found = only(make_data(axis=StampAxis(offsets, float(START))))
    assert found.level is level
    assert found.title.startswith(title)
