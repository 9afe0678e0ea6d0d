"""What the report says is wrong with sensors and vehicle file, each from a replay that shows just that."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import pytest

from modelserver.localization.filter.settings import FilterSettings
from modelserver.messages import VALID, Decision, FixType, GpsSample, ImuSample, Mode, Phase, SensorHeader, Verdict
from mstools.report.data import Replayed, Sensor, StateSample
from mstools.report.finding import FindingLevel, ReportFinding
from mstools.report.findings import findings
from mstools.report.raw import RawCollector, RawMotion

START = 1_700_000_000
SECONDS = 120
TRACK = 0.6
RADIUS = 6_371_000.0


def driven(
    left: float = 1.0,
    right: float = 1.0,
    gyro: float = 1.0,
    degrees: float = 1.0,
    with_gyro: bool = True,
    swapped: bool = False,
) -> RawMotion:
    """What a drive says: straight on for 20 s, round a wide bend for 20 s, and so on; factors spoil the sensors."""
    collector = RawCollector((1.0, 0.0, 0.0, 0.0) if with_gyro else None)
    turns = []
    x = y = yaw = 0.0
    for n in range(SECONDS):
        rate = (0.0, 0.1, 0.0, -0.1)[n // 20 % 4]
        yaw += rate
        x, y = x + 2.0 * math.cos(yaw), y + 2.0 * math.sin(yaw)
        header = SensorHeader((START + n) * 1_000_000, "any")
        if with_gyro:
            collector.on_imu(ImuSample(header, angular_velocity=(0.0, 0.0, gyro * rate)))
        north, east = (math.degrees(each / RADIUS) * degrees for each in (y, x))
        collector.on_fix(GpsSample(header, FixType.FIX_3D, north, east))
        speeds = {"left": left * (2.0 - rate * TRACK / 2.0), "right": right * (2.0 + rate * TRACK / 2.0)}
        if swapped:
            speeds = {"left": speeds["right"], "right": speeds["left"]}
        turns += [(header.utime, name, speed, 0.0) for name, speed in speeds.items()]
    return collector.motion(turns, {"left": TRACK / 2.0, "right": -TRACK / 2.0})


def replayed(**more: object) -> Replayed:
    states = tuple(
        StateSample(t, VALID, 0, (t, 0.0, 0.0), 0.0, 0.1, 0.01, speed=1.0, side=0.0, turn=0.0, phase=Phase.ALIGNED)
        for t in range(100)
    )
    given = Replayed("cart", "drive.lcm", START * 1_000_000, 100.0, FilterSettings(), states, raw=driven())
    return replace(given, **more)  # type: ignore[arg-type]


def refused(reason: str, source: str = "wheels", kind: str = "wheel_speed") -> tuple[Decision, ...]:
    return tuple(Decision(START + n, source, n, kind, Verdict.REJECTED, reason) for n in range(100))


def only(given: Replayed) -> ReportFinding:
    (found,) = findings(given)
    return found


def titles(found: Iterable[ReportFinding]) -> list[str]:
    return [each.title for each in found]


def test_given_a_good_drive_then_nothing_is_found() -> None:
    assert findings(replayed()) == []
    assert findings(replayed(raw=driven(with_gyro=False))) == []


@pytest.mark.parametrize("with_gyro", [True, False])
@pytest.mark.parametrize("name", ["left", "right"])
def test_given_one_wheel_whose_sign_is_swapped_then_it_is_named(name: str, with_gyro: bool) -> None:
    found = only(replayed(raw=driven(**{name: -1.0}, with_gyro=with_gyro)))  # type: ignore[arg-type]
    assert (found.grade, found.title) == (FindingLevel.WRONG, f"Wheel {name} counts backward")
    assert ("gyro" if with_gyro else "course") in found.seen


@pytest.mark.parametrize("with_gyro", [True, False])
def test_given_wheels_whose_names_are_swapped_then_that_is_told(with_gyro: bool) -> None:
    found = only(replayed(raw=driven(swapped=True, with_gyro=with_gyro)))
    assert (found.grade, found.title) == (FindingLevel.WRONG, "Left and right wheels are swapped")


def test_given_a_gyro_that_turns_against_wheels_and_fixes_then_it_is_the_gyro() -> None:
    assert only(replayed(raw=driven(gyro=-1.0))).title == "The gyro turns against the wheels and the fixes"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_given_a_gyro_in_degrees_then_that_is_told_first(sign: float) -> None:
    found = findings(replayed(raw=driven(gyro=sign * math.degrees(1.0)), felt_up=(0.0, 0.1, 9.8)))
    assert found[0].title == "The gyro is in degrees a second"
    assert not any("mounted" in each.title for each in found)


def test_given_places_in_radians_then_the_ways_differ_by_57() -> None:
    found = only(replayed(raw=driven(degrees=math.radians(1.0))))
    assert found.title.startswith("Fixes moved 4.")
    assert "m while the wheels rolled" in found.title
    assert "radians" in found.advice


def test_given_wheels_in_millimetres_then_the_unit_is_named_once_for_each_thing_seen() -> None:
    given = replayed(raw=driven(1000.0, 1000.0), decisions=refused("range"), keys={"wheels": "wheels"})
    found = findings(given)
    assert titles(found)[0] == "Nothing of sensors.wheels is used: range"
    assert "mm" in found[0].advice
    assert "The fastest second is 2030 m/s" in found[0].seen
    assert "mm for m" in found[1].advice


@pytest.mark.parametrize("reason", ["names", "nan"])
def test_given_wheels_of_other_names_then_both_lists_are_told(reason: str) -> None:
    found = only(replayed(decisions=refused(reason), keys={"wheels": "wheels"}, wheel_names=("l", "r")))
    assert found.title == f"Nothing of sensors.wheels is used: {reason}"
    assert "Its wheels are called l, r; sensors.wheels.frames has left, right." in found.seen
    assert "sensors.wheels.frames" in found.advice


def test_given_an_inertial_unit_without_numbers_then_it_is_not_used() -> None:
    given = replayed(
        decisions=refused("nan", "imu", "inertial"), keys={"imu": "imu"}, sensors=(Sensor("imu", tuple(range(102))),)
    )
    assert titles(findings(given))[0] == "Nothing of sensors.imu is used: nan"
    # a tenth of them may be bad without that
    many = replace(given, sensors=(Sensor("imu", tuple(range(1000))),))
    assert findings(many) == []


def test_given_a_sensor_that_is_used_then_refused_ones_do_not_make_it_unused() -> None:
    used = tuple(each._replace(verdict=Verdict.USED, seq=each.seq + 1000) for each in refused(""))
    given = replayed(decisions=(*refused("nan"), *used), keys={"wheels": "wheels"})
    assert findings(given) == []


def test_given_a_sensor_of_which_the_log_has_nothing_then_channel_and_remedies_are_told_first() -> None:
    given = replayed(snapshots=(), silent=(("imu", "IMU"),), channels=("GPS", "WHEELS"))
    found = findings(given)
    assert titles(found) == ["Nothing on channel IMU (sensors.imu)", "There was never a state"]
    assert found[0].seen == "The log has GPS, WHEELS."
    assert "localization.mode: no_imu" in found[0].advice
    assert "may follow from what stands above" in found[1].seen
    # a mode that does without it wants none
    assert findings(replayed(silent=(("imu", "IMU"),), mode=Mode.NO_IMU)) == []


def test_given_a_filter_that_began_anew_then_what_rests_on_its_state_is_left_out() -> None:
    values = {"gyro_bias_x": 1.0}
    states = tuple(replace(each, values=values, sigmas={"gyro_bias_x": 0.001}) for each in replayed().snapshots)
    assert titles(findings(replayed(snapshots=states))) == ["Gyro bias about x is far outside its data sheet"]
    anew = tuple(
        Decision(START * 1_000_000 + n, "filter", n, "state", Verdict.TOOK_UP, "diverged: too fast") for n in (1, 2, 3)
    )
    (found,) = findings(replayed(snapshots=states, decisions=anew))
    assert found.title == "The state was begun anew"
    assert "first of 3 times" in found.seen


def test_given_a_drive_then_its_way_is_known_without_any_state() -> None:
    assert driven().driven() == pytest.approx(2.0 * SECONDS, rel=0.05)
    assert RawMotion().driven() != RawMotion().driven()  # not known
    ways = driven().ways()
    assert ways.fixes == pytest.approx(ways.wheels, rel=0.1)
