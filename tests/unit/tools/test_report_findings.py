"""Findings of the replay report, each from data with just one fault."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from modelserver.errors import Severity
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.messages import VALID, Decision, Invalid, Phase, Verdict
from mstools.report.findings import (
    collect_findings,
    compute_consistency,
    compute_running_nis,
    estimate_fix_latency,
)
from mstools.report.replay_data import HOLD_S, FixRecord, ReplayData, SourceTimes, StateSample, WheelComparison
from mstools.report.replay_report import make_answer
from mstools.report.validity import REMEDIES, _find_holds

START = 1_700_000_000_000_000
STALE = Invalid.STALE_GPS | Invalid.LIMIT_EXCEEDED


def snapshot(t: float, **more: object) -> StateSample:
    given = StateSample(t, VALID, 0, (t, 0.0, 0.0), 0.0, 0.1, 0.01, speed=1.0, yaw_rate=0.0, phase=Phase.ALIGNED)
    return replace(given, **more)  # type: ignore[arg-type]


def make_data(**more: object) -> ReplayData:
    given = ReplayData("cart", "drive.lcm", START, 100.0, FilterSettings(), tuple(map(snapshot, range(100))))
    return replace(given, **more)  # type: ignore[arg-type]


def titles(given: ReplayData) -> list[str]:
    return [each.title for each in collect_findings(given)]


def turns(name: str, factor: float, stuck_from: float = math.inf) -> list[WheelComparison]:
    return [
        WheelComparison(t, name, 0.0 if t >= stuck_from else factor, 1.0) for t in np.arange(0.0, 40.0, 0.1).tolist()
    ]


def decisions(kind: str, nis: float, count: int = 100, source: str = "gps") -> tuple[Decision, ...]:
    residual = math.sqrt(nis)
    return tuple(
        Decision(START + n * 100_000, source, n, kind, Verdict.USED, "", (residual,), (1.0,), (1.0,), nis, 15.0)
        for n in range(count)
    )


def test_given_nothing_wrong_then_nothing_is_found() -> None:
    good = make_data(
        wheels=tuple(turns("left", 1.02)),
        mean_force=(0.1, -0.2, 9.8),
        decisions=decisions("gps_position", 0.9),
        sensors=(SourceTimes("imu", tuple(np.arange(0.0, 100.0, 0.02).tolist())),),
    )
    assert collect_findings(good) == []


def test_given_a_wheel_that_counts_backward_then_it_is_named_and_the_other_is_not() -> None:
    found = collect_findings(make_data(wheels=(*turns("left", -1.01), *turns("right", 1.0))))
    assert [each.title for each in found] == ["Wheel left counts backward"]
    assert found[0].level is Severity.ERROR
    assert "sign" in found[0].advice


def test_given_an_encoder_that_sticks_then_it_is_named_with_how_long() -> None:
    found = collect_findings(make_data(wheels=tuple(turns("left", 1.0, stuck_from=30.0))))
    assert [each.title for each in found] == ["Wheel left is stationary while the vehicle drives"]
    assert "up to 10 s" in found[0].observation


def test_given_wheels_of_a_stationary_vehicle_then_there_is_no_finding() -> None:
    stationary = tuple(replace(each, measured=0.0, expected=0.01) for each in turns("left", 1.0))
    assert titles(make_data(wheels=stationary)) == []


def test_given_a_frozen_unit_then_it_is_found() -> None:
    assert titles(make_data(frozen=((10.0, 14.0),))) == ["The IMU froze"]


def test_given_gravity_from_the_side_then_the_mount_is_found() -> None:
    found = collect_findings(make_data(mean_force=(0.0, 9.8, 0.0)))
    assert [each.title for each in found] == ["The IMU mount differs from the geometry"]
    assert "90 degrees" in found[0].observation


def test_given_acceleration_in_units_of_gravity_then_the_unit_is_found() -> None:
    assert titles(make_data(mean_force=(0.0, 0.0, 1.0))) == ["Specific force is in g, not in m/s2"]
    assert titles(make_data(mean_force=(0.0, 0.0, 7.0))) == ["The mean specific force is 7.00 m/s2"]


@pytest.mark.parametrize("tau", [0.5, -0.4, 0.0])
def test_given_fixes_with_a_latency_then_it_is_estimated(tau: float) -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.3, (400, 2))
    fixes = []
    for n in range(400):
        t = 0.25 * n
        v = (2.0 * math.cos(0.3 * t), 2.0 * math.sin(0.3 * t))
        residual = (-tau * v[0] + 3.0 + noise[n, 0], -tau * v[1] + noise[n, 1])
        fixes.append(FixRecord(t, (0.0, 0.0, 0.0), "used", "", residual, v))
    given = make_data(fixes=tuple(fixes))
    found = estimate_fix_latency(given)
    assert found is not None
    assert found[0] == pytest.approx(tau, abs=0.05)
    found_titles = [title for title in titles(given) if title.startswith("Fixes lie")]
    assert found_titles == (
        [] if tau == 0.0 else [f"Fixes lie {abs(found[0]):.2f} s {'behind' if tau > 0 else 'ahead of'} the vehicle"]
    )


def test_given_a_latency_that_the_filter_estimates_then_the_finding_has_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mstools.report.findings.estimate_fix_latency", lambda data: (-0.07, 0.02))
    states = tuple(snapshot(t, values={"gps_latency": 0.82}, sigmas={"gps_latency": 0.02}) for t in range(100))
    assert titles(make_data(snapshots=states)) == ["Fixes lie 0.75 s behind the vehicle"]


def test_given_a_straight_drive_then_no_latency_can_be_estimated() -> None:
    fixes = tuple(FixRecord(0.25 * n, None, "used", "", (-1.0, 0.0), (2.0, 0.0)) for n in range(400))
    assert estimate_fix_latency(make_data(fixes=fixes)) is None


def test_given_innovations_far_from_what_is_stated_then_the_kind_is_named() -> None:
    assert titles(make_data(decisions=decisions("gps_position", 6.0))) == ["gps_position: errors larger than its sigma"]
    assert titles(make_data(decisions=decisions("gps_position", 0.05))) == [
        "gps_position: errors smaller than its sigma"
    ]
    # the noise of constraints without a sensor is inflated on purpose
    assert titles(make_data(decisions=decisions("non_holonomic", 0.05, source="filter"))) == []


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("wheel_scale", 0.09, "The distance by the wheels is 9.0% too long"),
        ("wheel_yaw", 0.05, "The wheels roll 2.9 degrees to the left"),
        ("gyro_bias_z", -0.05, "Gyro bias about z is far outside its data sheet"),
        ("accelerometer_bias_x", 0.5, "Accelerometer bias along x is far outside its data sheet"),
    ],
)
def test_given_a_state_far_from_what_is_expected_then_it_is_named(name: str, value: float, words: str) -> None:
    given = tuple(snapshot(t, values={name: value}, sigmas={name: 0.001}) for t in range(100))
    assert titles(make_data(snapshots=given)) == [words]
    uncertain = tuple(snapshot(t, values={name: value}, sigmas={name: 1.0}) for t in range(100))
    assert titles(make_data(snapshots=uncertain)) == []


def test_given_poses_that_are_never_valid_then_the_reason_is_in_the_finding() -> None:
    given = tuple(snapshot(t, invalid=Invalid.NOT_MOVED_YET) for t in range(100))
    found = collect_findings(make_data(snapshots=given))
    assert [each.title for each in found] == ["The pose was never valid"]
    assert "before the vehicle moves" in found[0].observation
    assert titles(make_data(snapshots=())) == ["There was never a state"]


def test_given_nothing_wrong_then_the_answer_is_one_line() -> None:
    answer, found = make_answer(make_data())
    assert (answer.tone, answer.headline, answer.lines) == (
        "good",
        "Valid 100.0% of 1 min 40 s without interruption; no findings",
        (),
    )
    assert found == []


def test_given_interruptions_then_the_answer_has_their_main_reason_and_its_remedy() -> None:
    # after 10 s of start: 20 s beyond the limit alone, 15 with a stale fix, of which that is the consequence
    reasons = {Invalid.NO_FIX: (0, 10), Invalid.LIMIT_EXCEEDED: (30, 50), STALE: (60, 75)}
    given = [
        snapshot(t, invalid=next((flag for flag, (a, b) in reasons.items() if a <= t < b), VALID)) for t in range(100)
    ]
    answer, found = make_answer(make_data(snapshots=tuple(given)))
    assert (answer.tone, answer.headline) == ("warning", "Valid 55.0% of 1 min 40 s, from 10.0 s on")
    main, remedy = answer.lines
    assert "(LIMIT_EXCEEDED), 57% of the 35.0 s not valid after the first valid pose" in main
    assert remedy == f"Remedy: {REMEDIES[Invalid.LIMIT_EXCEEDED]}."
    # the answer has it, and what is listed does not repeat it
    assert found == []
    assert titles(make_data(snapshots=tuple(given))) == ["The pose was not valid in 39% of the time after it first was"]


def test_given_a_log_with_a_gap_then_its_time_is_not_valid_and_the_main_reason() -> None:
    given = tuple(each for each in map(snapshot, range(100)) if not 40 < each.t < 80)
    answer, _ = make_answer(make_data(snapshots=given))
    assert answer.headline == "Valid 61.0% of 1 min 40 s"
    assert answer.lines[0].startswith("Main reason: no sample, or none that could be used, 100% of the 39.0 s")


def test_given_no_state_and_a_missing_channel_then_the_answer_names_it_as_the_cause() -> None:
    answer, _ = make_answer(make_data(snapshots=(), missing_channels=(("imu", "IMU"),), channels=("GPS",)))
    assert (answer.tone, answer.headline) == ("error", "Never valid in 1 min 40 s")
    assert answer.lines[1].startswith("Probable cause: No messages on channel IMU (sensors.imu). Correct the channel")


def test_given_the_reasons_then_each_has_a_remedy() -> None:
    assert set(REMEDIES) == set(Invalid)


def test_given_a_vehicle_that_always_backs_up_then_swapped_front_and_rear_are_suspected() -> None:
    given = tuple(snapshot(t, speed=-1.0) for t in range(100))
    assert titles(make_data(snapshots=given)) == ["The vehicle drives backward nearly all the time"]


def test_given_rejected_and_delayed_samples_and_gaps_then_all_are_found_worst_first() -> None:
    fixes = tuple(FixRecord(n, None, "rejected" if n % 2 else "used", "gate") for n in range(40))
    found = collect_findings(
        make_data(
            fixes=fixes,
            frozen=((1.0, 3.0),),
            rejected={("sensor:imu", "too_old"): 7, ("sensor:gps", "duplicate"): 1},
            sensors=(
                SourceTimes("imu", (*np.arange(0.0, 40.0, 0.02).tolist(), *np.arange(45.0, 80.0, 0.02).tolist())),
            ),
        )
    )
    assert [each.title for each in found] == [
        "The IMU froze",
        "50% of the fixes were rejected",
        "sensor:imu: 7 samples too_old",
        "imu: 1 gap, the longest 5.0 s",
    ]
    assert [each.level for each in found] == sorted((each.level for each in found), key=list(Severity).index)


def test_given_fixes_without_numbers_then_only_that_reason_is_explained() -> None:
    fixes = tuple(FixRecord(n, None, "rejected" if n % 2 else "used", "nan" if n % 2 else "") for n in range(40))
    (found,) = collect_findings(make_data(fixes=fixes))
    assert found.observation == "Of 40 fixes as positions: 20 nan."
    assert "nan: " in found.advice
    assert "gate" not in found.advice


# --- consistency --------------------------------------------------------------------------------------------


def test_given_normal_residuals_then_nis_is_one_and_a_twentieth_is_beyond() -> None:
    draws = np.random.default_rng(2).normal(0.0, 1.0, 4000) ** 2
    made = [decisions("a", float(nis), 1)[0]._replace(utime=START + n * 1000) for n, nis in enumerate(draws)]
    (found,) = compute_consistency(made)
    assert found.mean == pytest.approx(1.0, abs=0.07)
    assert found.beyond == pytest.approx(0.05, abs=0.015)
    utimes, means = compute_running_nis(made, 1.0)
    assert len(utimes) == len(means) == 4000
    assert means[-1] == pytest.approx(float(draws[-1001:].mean()))


def test_given_what_was_set_aside_then_it_does_not_count() -> None:
    aside = decisions("a", 9.0, 1)[0]._replace(verdict=Verdict.MONITORED)
    rejected = Decision(START, "gps", 0, "a", Verdict.REJECTED, "satellites")
    assert compute_consistency([aside, rejected]) == []


@pytest.mark.parametrize(
    ("times", "held"),
    [
        ((0.0, 0.2, 0.19, 0.4, 1.0), (0.2, 0.0, 0.2, 0.6)),
        # a gap is no state
        ((0.0, 60.0, 60.5), (HOLD_S, 0.5)),
        # the clock is set back by 10 s
        ((20.0, 20.5, 10.5, 11.0), (0.5, 0.0, 0.5)),
    ],
)
def test_given_states_in_the_order_of_arrival_then_no_time_counts_twice(
    times: tuple[float, ...], held: tuple[float, ...]
) -> None:
    assert _find_holds(times) == pytest.approx(held)
