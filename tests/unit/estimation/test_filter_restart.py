"""Warm start from the state of an earlier run: a valid pose sooner if it is right, and never a wrong one."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
from support_filter import ORIGIN, RIG, drive, simulation
from support_restart import (
    DRIVES_OFF,
    FIRST,
    GAP,
    continue_wheel_counters,
    find_first_valid,
    find_longest_misleading,
    list_reasons,
    simulate_elsewhere,
    simulate_first_run,
    simulate_second_run,
    skip_samples,
)

from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.state import Leveling, Setup
from modelserver.messages import Mode, RestoredState
from modelserver.messages import Phase as FilterPhase
from modelserver.simulation import DrivePhase

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [1, 3])
def test_given_a_kill_while_stationary_then_the_pose_is_valid_at_once_and_within_its_protection_levels(seed):
    first, persisted = simulate_first_run((DrivePhase(60.0), *DRIVES_OFF), seed)
    assert persisted.pose is not None
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, persisted, GAP, 70.0)

    assert find_first_valid(warm) < 4.0
    assert "3 fixes agree" in list_reasons(warm)[-2]
    assert list_reasons(warm)[-1].startswith("the restored heading is right: ")
    assert find_longest_misleading(warm) == 0.0
    assert all(row.valid for row in warm.rows if row.t > FIRST + GAP + 5.0)
    restored = next(row for row in warm.rows if row.valid)
    assert abs(restored.heading - first.last.heading) < math.radians(0.5)
    assert restored.estimate.heading_protection_level > first.last.estimate.heading_protection_level
    assert restored.estimate.pose_epoch == first.last.estimate.pose_epoch + 1


def test_given_a_kill_while_stationary_without_a_persisted_state_then_there_is_no_heading_before_it_drives():
    first, _ = simulate_first_run((DrivePhase(26.0), *DRIVES_OFF))
    skip_samples(first.simulation, GAP)
    cold = simulate_second_run(first.simulation, None, GAP, 30.0)
    assert find_first_valid(cold) > 5.0
    assert list_reasons(cold) == []


def test_given_a_kill_while_driving_then_only_biases_are_restored_and_the_pose_is_right():
    first, persisted = simulate_first_run((DrivePhase(8.0), *DRIVES_OFF), seconds=46.0)
    assert persisted.pose is None
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, persisted, GAP, 30.0)
    (word,) = list_reasons(warm)
    assert word.startswith(
        "warm start of the biases stored 9 s ago, cold start of the pose: the vehicle was not stationary"
    )
    assert find_first_valid(warm) < 20.0
    assert find_longest_misleading(warm) <= 1.0


@pytest.mark.parametrize("gap", [GAP, 8.0, 15.0])
def test_given_a_persisted_pose_when_the_vehicle_has_driven_off_then_the_pose_is_not_used(gap):
    first, persisted = simulate_first_run((DrivePhase(12.0), *DRIVES_OFF))
    assert persisted.pose is not None
    skip_samples(first.simulation, gap)
    warm = simulate_second_run(first.simulation, persisted, gap, 40.0)
    assert "cold start of the pose: the wheels have rolled" in list_reasons(warm)[-1]
    assert find_longest_misleading(warm) <= 1.0


TOWED = (DrivePhase(12.0), *DRIVES_OFF)


@pytest.mark.parametrize(
    ("east", "turn", "rolled", "gap", "reason"),
    [
        (50.0, 0.0, (50.0, 50.0), GAP, "the wheels have rolled 50.0"),
        (50.0, 0.0, (0.0, 0.0), GAP, "fixes are"),
        (50.0, 1.5708, (0.0, 0.0), GAP, "fixes are"),
        (0.0, 1.5708, (-0.47, 0.47), GAP, "the wheels have rolled 0.47"),
        (0.0, 1.5708, (-0.47, 0.47), 60.0, "the vehicle was unobserved for"),
        (0.0, 1.5708, (0.0, 0.0), 60.0, "the vehicle was unobserved for"),
        (0.0, 3.1416, None, GAP, "the wheels' driver was restarted"),
        (50.0, 1.5708, None, GAP, "the wheels' driver was restarted"),
    ],
)
def test_given_a_vehicle_that_was_towed_or_turned_meanwhile_then_no_wrong_pose_is_valid(
    east, turn, rolled, gap, reason
):
    first, persisted = simulate_first_run()
    sim = simulate_elsewhere(first, gap, east, turn, TOWED)
    transform = None if rolled is None else continue_wheel_counters(persisted, rolled)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(persisted, gap))
    passed = {} if transform is None else {"transform": transform}
    warm = drive(sim, 40.0, localizer=localizer, every=0.1, **passed)

    assert reason in list_reasons(warm)[-1]
    assert find_longest_misleading(warm) <= 1.0
    assert not any(row.valid for row in warm.rows if row.t < 12.0)
    assert warm.last.valid
    assert warm.localizer.head.phase is FilterPhase.ALIGNED


@pytest.mark.parametrize("turn", [1.5708, -0.5, 3.1416])
def test_given_a_vehicle_that_was_lifted_and_turned_on_the_spot_then_its_first_meters_correct_the_heading(turn):
    # no sensor can detect it while stationary: the wheels did not turn, position and tilt are the same
    first, persisted = simulate_first_run()
    sim = simulate_elsewhere(first, GAP, 0.0, turn, (DrivePhase(8.0), *DRIVES_OFF))
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(persisted, GAP))
    warm = drive(sim, 30.0, localizer=localizer, every=0.1, transform=continue_wheel_counters(persisted, (0.0, 0.0)))

    (off,) = re.findall(r"the restored heading was off by (\d+) deg", list_reasons(warm)[-1])
    assert float(off) == pytest.approx(abs(math.degrees(turn)), abs=4.0)
    put_right = warm.seconds(warm.decisions("warm_start")[-1])
    assert put_right < 8.0 + 4.0
    after = [row for row in warm.rows if row.t > put_right + 0.5]
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in after if row.valid)
    assert after[-1].valid
    assert after[-1].estimate.pose_epoch == persisted.pose.pose_epoch + 2


def test_given_wheels_that_spin_on_the_spot_then_a_restored_heading_is_neither_confirmed_nor_changed():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    travel = [0.0]

    def spin(events):
        for event in events:
            if event.header.source == "wheels" and event.header.utime > first.simulation.start_utime + 50_000_000:
                travel[0] += 0.1
                event = replace(
                    event, wheels=tuple(replace(each, travel=each.travel + travel[0]) for each in event.wheels)
                )
            yield event

    warm = simulate_second_run(first.simulation, persisted, GAP, 20.0, spin)
    assert "3 fixes agree" in list_reasons(warm)[-1]
    assert abs(warm.last.heading) < warm.last.estimate.heading_protection_level


def test_given_counters_that_had_measured_no_travel_yet_then_the_pose_is_not_used():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    fresh = persisted._replace(pose=persisted.pose._replace(wheels=(("left", 0.0), ("right", 0.01))))
    warm = simulate_second_run(first.simulation, fresh, GAP, 5.0)
    assert "had measured no travel yet" in list_reasons(warm)[-1]


def test_given_a_slope_where_the_ground_was_level_then_the_pose_is_not_used():
    first, persisted = simulate_first_run()
    assert persisted.pose is not None
    w, x, y, z = persisted.pose.attitude
    c, s = math.cos(0.05), math.sin(0.05)
    leaning = (w * c - x * s, w * s + x * c, y * c + z * s, z * c - y * s)
    persisted = persisted._replace(pose=persisted.pose._replace(attitude=leaning))
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, persisted, GAP, 10.0)
    assert "its tilt has changed by 5." in list_reasons(warm)[-1]
    assert not any(row.valid for row in warm.rows)


def test_given_no_fixes_after_the_restart_then_wheels_and_imu_are_enough():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(
        first.simulation,
        persisted,
        GAP,
        20.0,
        lambda events: (each for each in events if each.header.source != "gps"),
    )
    assert "there is no fix to compare with" in list_reasons(warm)[-1]
    assert warm.last.valid
    assert find_longest_misleading(warm) == 0.0


def test_given_silent_wheels_after_the_restart_then_the_pose_is_not_used():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(
        first.simulation,
        persisted,
        GAP,
        45.0,
        lambda events: (each for each in events if each.header.source != "wheels"),
    )
    assert "are not stationary together" in list_reasons(warm)[-1]
    assert not any(row.valid for row in warm.rows)


def test_given_gyro_biases_other_than_those_of_the_stationary_imu_then_nothing_is_used():
    first, persisted = simulate_first_run()
    x, y, z = persisted.gyro_bias
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, persisted._replace(gyro_bias=(x + 0.02, y, z)), GAP, 5.0)
    assert "its gyro biases are not those of the stationary IMU" in list_reasons(warm)[0]
    assert not any(row.valid for row in warm.rows)


def test_given_a_state_in_the_future_of_the_sensors_clock_then_nothing_is_used():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    later = persisted._replace(sensor_utime=persisted.sensor_utime + 3_600_000_000)
    warm = simulate_second_run(first.simulation, later, GAP, 5.0)
    assert "the sensors' clock is before the stored time" in list_reasons(warm)[0]


def test_given_biases_of_years_ago_then_they_are_worth_no_more_than_none():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(persisted, 3e8, max_age=1e9))
    cold = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL)
    events = list(first.simulation.events(2.5))
    for event in events:
        localizer, cold = localizer.process(event)[0], cold.process(event)[0]
    assert not isinstance(localizer.head, Leveling)
    assert not isinstance(cold.head, Leveling)
    ours, theirs = localizer.head.nav, cold.head.nav
    assert ours.gyro_bias == pytest.approx(theirs.gyro_bias, abs=5e-5)
    # the latency of fixes is a constant of the receiver
    assert ours.extras[4:] == pytest.approx(theirs.extras[4:], abs=1e-3)
    assert ours.attitude == pytest.approx(theirs.attitude, abs=2e-5)


def test_given_delayed_wheels_and_fixes_then_the_restored_state_is_the_same_to_the_bit():
    def delay(events):
        delays = {"wheels": 150_000, "gps": 300_000, "imu": 0}
        return sorted(events, key=lambda each: each.header.host_utime + delays[each.header.source])

    found = []
    for transform in (None, delay):
        first, persisted = simulate_first_run()
        skip_samples(first.simulation, GAP)
        found.append(simulate_second_run(first.simulation, persisted, GAP, 8.0, transform))
    prompt, delayed = (run.localizer.timeline.base for run in found)
    assert prompt.phase is delayed.phase is FilterPhase.ALIGNED
    assert list_reasons(found[0]) == list_reasons(found[1])
    assert [word.utime for word in found[0].decisions("warm_start")] == [
        word.utime for word in found[1].decisions("warm_start")
    ]


def test_given_nothing_restored_then_the_filter_is_the_same_to_the_bit():
    a = drive(simulation((DrivePhase(4.0), *DRIVES_OFF)), 20.0)
    start = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(reason="nothing is stored"))
    b = drive(simulation((DrivePhase(4.0), *DRIVES_OFF)), 20.0, localizer=start)
    assert [row.estimate.covariance for row in a.rows] == [row.estimate.covariance for row in b.rows]
    assert list_reasons(b) == []


def test_given_a_state_that_waits_for_evidence_then_nothing_is_persisted_in_its_place():
    first, persisted = simulate_first_run()
    skip_samples(first.simulation, GAP)
    waiting = simulate_second_run(first.simulation, persisted, GAP, 2.5)
    assert waiting.localizer.get_state_to_persist() is None
