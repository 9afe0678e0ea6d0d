"""Going on from what an earlier run kept: sooner where it is right, and never wrong where it is not."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.filter.setup import Setup
from modelserver.messages import Mode, RestoredState
from modelserver.messages import Phase as FilterPhase
from modelserver.simulation import DrivePhase
from tests.support_filter import ORIGIN, RIG, drive, simulation
from tests.support_restart import (
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

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_given_a_kill_while_standing_then_the_pose_is_valid_at_once_and_within_its_bounds(seed):
    first, kept = simulate_first_run((DrivePhase(60.0), *DRIVES_OFF), seed)
    assert kept.pose is not None
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, kept, GAP, 70.0)

    assert find_first_valid(warm) < 4.0
    assert "3 fixes agree" in list_reasons(warm)[-2]
    assert list_reasons(warm)[-1].startswith("the resumed heading is right: ")
    assert find_longest_misleading(warm) == 0.0
    assert all(row.valid for row in warm.rows if row.t > FIRST + GAP + 5.0)
    resumed = next(row for row in warm.rows if row.valid)
    assert abs(resumed.heading - first.last.heading) < math.radians(0.5)
    assert resumed.estimate.heading_protection_level > first.last.estimate.heading_protection_level
    assert resumed.estimate.pose_epoch == first.last.estimate.pose_epoch + 1


def test_given_a_kill_while_standing_when_nothing_is_kept_then_there_is_no_heading_before_it_drives():
    first, _ = simulate_first_run((DrivePhase(26.0), *DRIVES_OFF))
    skip_samples(first.simulation, GAP)
    cold = simulate_second_run(first.simulation, None, GAP, 30.0)
    assert find_first_valid(cold) > 5.0
    assert list_reasons(cold) == []


def test_given_a_kill_while_driving_then_only_biases_are_taken_up_and_the_pose_is_right():
    first, kept = simulate_first_run((DrivePhase(8.0), *DRIVES_OFF), seconds=46.0)
    assert kept.pose is None
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, kept, GAP, 30.0)
    (word,) = list_reasons(warm)
    assert word.startswith("warm start of the biases kept 9 s ago, cold start of the pose: the vehicle did not stand")
    assert find_first_valid(warm) < 20.0
    assert find_longest_misleading(warm) <= 1.0


@pytest.mark.parametrize("gap", [GAP, 8.0, 15.0])
def test_given_a_kept_pose_when_the_vehicle_has_driven_off_meanwhile_then_the_pose_is_not_used(gap):
    first, kept = simulate_first_run((DrivePhase(12.0), *DRIVES_OFF))
    assert kept.pose is not None
    skip_samples(first.simulation, gap)
    warm = simulate_second_run(first.simulation, kept, gap, 40.0)
    assert "cold start of the pose: the wheels have rolled" in list_reasons(warm)[-1]
    assert find_longest_misleading(warm) <= 1.0


TOWED = (DrivePhase(12.0), *DRIVES_OFF)


@pytest.mark.parametrize(
    ("east", "turn", "rolled", "gap", "why"),
    [
        (50.0, 0.0, (50.0, 50.0), GAP, "the wheels have rolled 50.0"),
        (50.0, 0.0, (0.0, 0.0), GAP, "fixes are"),
        (50.0, 1.5708, (0.0, 0.0), GAP, "fixes are"),
        (0.0, 1.5708, (-0.47, 0.47), GAP, "the wheels have rolled 0.47"),
        (0.0, 1.5708, (-0.47, 0.47), 60.0, "nobody watched the vehicle for"),
        (0.0, 1.5708, (0.0, 0.0), 60.0, "nobody watched the vehicle for"),
        (0.0, 3.1416, None, GAP, "the wheels' driver was started anew"),
        (50.0, 1.5708, None, GAP, "the wheels' driver was started anew"),
    ],
)
def test_given_a_vehicle_that_was_towed_or_turned_meanwhile_then_no_wrong_pose_is_valid(east, turn, rolled, gap, why):
    first, kept = simulate_first_run()
    sim = simulate_elsewhere(first, gap, east, turn, TOWED)
    transform = None if rolled is None else continue_wheel_counters(kept, rolled)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(kept, gap))
    passed = {} if transform is None else {"transform": transform}
    warm = drive(sim, 40.0, localizer=localizer, every=0.1, **passed)

    assert why in list_reasons(warm)[-1]
    assert find_longest_misleading(warm) <= 1.0
    assert not any(row.valid for row in warm.rows if row.t < 12.0)
    assert warm.last.valid
    assert warm.localizer.head.phase is FilterPhase.ALIGNED


@pytest.mark.parametrize("turn", [1.5708, -0.5, 3.1416])
def test_given_a_vehicle_that_was_lifted_and_turned_on_the_spot_then_its_first_metres_put_the_heading_right(turn):
    # no sensor can detect it while stationary: the wheels did not turn, position and tilt are the same
    first, kept = simulate_first_run()
    sim = simulate_elsewhere(first, GAP, 0.0, turn, (DrivePhase(8.0), *DRIVES_OFF))
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(kept, GAP))
    warm = drive(sim, 30.0, localizer=localizer, every=0.1, transform=continue_wheel_counters(kept, (0.0, 0.0)))

    (off,) = re.findall(r"the kept heading was off by (\d+) deg", list_reasons(warm)[-1])
    assert float(off) == pytest.approx(abs(math.degrees(turn)), abs=4.0)
    put_right = warm.seconds(warm.decisions("warm_start")[-1])
    assert put_right < 8.0 + 4.0
    after = [row for row in warm.rows if row.t > put_right + 0.5]
    assert all(abs(row.heading) < row.estimate.heading_protection_level for row in after if row.valid)
    assert after[-1].valid
    assert after[-1].estimate.pose_epoch == kept.pose.pose_epoch + 2


def test_given_wheels_that_spin_on_the_spot_then_a_resumed_heading_is_neither_proved_nor_changed():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    way = [0.0]

    def spinning(events):
        for event in events:
            if event.header.source == "wheels" and event.header.utime > first.simulation.start_utime + 50_000_000:
                way[0] += 0.1
                event = replace(
                    event, wheels=tuple(replace(each, travel=each.travel + way[0]) for each in event.wheels)
                )
            yield event

    warm = simulate_second_run(first.simulation, kept, GAP, 20.0, spinning)
    assert "3 fixes agree" in list_reasons(warm)[-1]
    assert abs(warm.last.heading) < warm.last.estimate.heading_protection_level


def test_given_counters_that_had_told_no_way_yet_then_the_pose_is_not_used():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    fresh = kept._replace(pose=kept.pose._replace(wheels=(("left", 0.0), ("right", 0.01))))
    warm = simulate_second_run(first.simulation, fresh, GAP, 5.0)
    assert "had told no way yet" in list_reasons(warm)[-1]


def test_given_a_slope_where_it_stood_level_then_the_pose_is_not_used():
    first, kept = simulate_first_run()
    assert kept.pose is not None
    w, x, y, z = kept.pose.attitude
    c, s = math.cos(0.05), math.sin(0.05)
    leaning = (w * c - x * s, w * s + x * c, y * c + z * s, z * c - y * s)
    kept = kept._replace(pose=kept.pose._replace(attitude=leaning))
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, kept, GAP, 10.0)
    assert "it leans otherwise than then, by 5." in list_reasons(warm)[-1]
    assert not any(row.valid for row in warm.rows)


def test_given_no_fixes_after_the_restart_then_wheels_and_inertial_unit_are_enough():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(
        first.simulation,
        kept,
        GAP,
        20.0,
        lambda events: (each for each in events if each.header.source != "gps"),
    )
    assert "there is no fix to ask" in list_reasons(warm)[-1]
    assert warm.last.valid
    assert find_longest_misleading(warm) == 0.0


def test_given_silent_wheels_after_the_restart_then_the_pose_is_not_used():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(
        first.simulation, kept, GAP, 45.0, lambda events: (each for each in events if each.header.source != "wheels")
    )
    assert "do not stand still together" in list_reasons(warm)[-1]
    assert not any(row.valid for row in warm.rows)


def test_given_other_gyro_biases_than_the_standing_unit_tells_then_nothing_is_used():
    first, kept = simulate_first_run()
    x, y, z = kept.gyro_bias
    skip_samples(first.simulation, GAP)
    warm = simulate_second_run(first.simulation, kept._replace(gyro_bias=(x + 0.02, y, z)), GAP, 5.0)
    assert "its gyro biases are not those of the standing unit" in list_reasons(warm)[0]
    assert not any(row.valid for row in warm.rows)


def test_given_a_state_of_the_sensors_own_future_then_nothing_is_used():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    later = kept._replace(sensor_utime=kept.sensor_utime + 3_600_000_000)
    warm = simulate_second_run(first.simulation, later, GAP, 5.0)
    assert "the sensors' clock stands before what was kept" in list_reasons(warm)[0]


def test_given_biases_of_years_ago_then_they_say_no_more_than_nothing_does():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    localizer = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(kept, 3e8, max_age=1e9))
    cold = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL)
    events = list(first.simulation.events(2.5))
    for event in events:
        localizer, cold = localizer.process(event)[0], cold.process(event)[0]
    ours, theirs = localizer.head.nav, cold.head.nav
    assert ours is not None
    assert theirs is not None
    assert ours.gyro_bias == pytest.approx(theirs.gyro_bias, abs=5e-5)
    # how late fixes are is the receiver's own, and does not wander
    assert ours.extras[4:] == pytest.approx(theirs.extras[4:], abs=1e-3)
    assert ours.attitude == pytest.approx(theirs.attitude, abs=2e-5)


def test_given_wheels_and_fixes_that_come_late_then_the_resumed_state_is_the_same_to_the_bit():
    def late(events):
        delays = {"wheels": 150_000, "gps": 300_000, "imu": 0}
        return sorted(events, key=lambda each: each.header.host_utime + delays[each.header.source])

    found = []
    for transform in (None, late):
        first, kept = simulate_first_run()
        skip_samples(first.simulation, GAP)
        found.append(simulate_second_run(first.simulation, kept, GAP, 8.0, transform))
    prompt, delayed = (run.localizer.timeline.base for run in found)
    assert prompt.phase is delayed.phase is FilterPhase.ALIGNED
    assert list_reasons(found[0]) == list_reasons(found[1])
    assert [word.utime for word in found[0].decisions("warm_start")] == [
        word.utime for word in found[1].decisions("warm_start")
    ]


def test_given_nothing_recalled_then_the_filter_is_as_it_was_to_the_bit():
    a = drive(simulation((DrivePhase(4.0), *DRIVES_OFF)), 20.0)
    start = FilterLocalizer.start(Setup(RIG), ORIGIN, Mode.FULL, RestoredState(reason="nothing is kept"))
    b = drive(simulation((DrivePhase(4.0), *DRIVES_OFF)), 20.0, localizer=start)
    assert [row.estimate.covariance for row in a.rows] == [row.estimate.covariance for row in b.rows]
    assert list_reasons(b) == []


def test_given_a_state_that_still_waits_then_nothing_is_kept_in_its_place():
    first, kept = simulate_first_run()
    skip_samples(first.simulation, GAP)
    waiting = simulate_second_run(first.simulation, kept, GAP, 2.5)
    assert waiting.localizer.get_state_to_persist() is None
