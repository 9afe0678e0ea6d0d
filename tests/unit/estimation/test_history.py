"""History: estimates by time, appended without copying, with older ones unchanged."""

from __future__ import annotations

import random
import tracemalloc

import numpy as np
import pytest
from support_samples import ORIGIN, START

from modelserver.errors import TooNewError, TooOldError
from modelserver.estimation.history import History, interpolate, restamp
from modelserver.messages import Estimate, Invalid, Quality
from modelserver.transforms import Pose

S = 1_000_000


def estimate(seconds: float, x: float = 0.0, epoch: int = 0, **more: object) -> Estimate:
    return Estimate(START + round(seconds * S), Pose((x, 0, 0)), pose_epoch=epoch, **more)  # type: ignore[arg-type]


def history(*seconds: float, horizon: float = 60.0) -> History:
    held = History(horizon)
    for each in seconds:
        held = held.append(estimate(each, each))
    return held


def times(held: History) -> list[float]:
    """The times held, in seconds from START, as they are found by asking."""
    found, at = [], held.last
    while True:
        found.append((at - START) / S)
        if at == held.first:
            return found[::-1]
        at = held.hold(at - 1).utime


def test_given_no_estimate_then_it_is_empty() -> None:
    assert len(History(60.0)) == 0


def test_given_estimates_in_order_then_all_are_held_and_the_newest_is_last() -> None:
    held = history(0, 1, 2.5)
    assert times(held) == [0, 1, 2.5]
    assert len(held) == 3
    assert held.newest.odom.xyz[0] == 2.5


def test_given_a_history_that_was_extended_then_the_old_one_is_unchanged() -> None:
    old = history(0, 1)
    new = old.append(estimate(2))
    assert times(old) == [0, 1]
    assert times(new) == [0, 1, 2]
    with pytest.raises(TooNewError):
        old.at(START + 2 * S)


def test_given_a_history_when_only_the_recent_is_wanted_then_that_is_held_apart_and_can_be_extended() -> None:
    old = history(0, 1, 2, 3, 4, horizon=3.0)
    recent = old.copy_recent(1.5)
    assert times(recent) == [3, 4]
    longer = old.append(estimate(5))
    assert times(recent.append(estimate(4.5))) == [3, 4, 4.5]
    assert times(longer) == [2, 3, 4, 5]
    assert times(recent) == [3, 4]
    # and it forgets as the other does
    assert times(recent.append(estimate(7))) == [4, 7]
    assert times(old.copy_recent(60.0)) == times(old)
    assert len(History(60.0).copy_recent(1.0)) == 0


def test_given_two_histories_extended_from_one_then_neither_sees_the_other() -> None:
    root = history(0, 1)
    left = root.append(estimate(2, -2.0))
    right = root.append(estimate(2, +2.0))
    left = left.append(estimate(3, -3.0))
    right = right.append(estimate(4, +4.0))
    assert (times(root), times(left), times(right)) == ([0, 1], [0, 1, 2, 3], [0, 1, 2, 4])
    assert left.at(START + 2 * S).odom.xyz[0] == -2.0
    assert right.at(START + 2 * S).odom.xyz[0] == +2.0


def test_given_any_forks_and_orders_then_each_history_equals_a_plain_list() -> None:
    rng = random.Random(1)
    for _ in range(20):
        forks: list[tuple[History, list[float]]] = [(History(10.0), [])]
        for _ in range(200):
            held, plain = rng.choice(forks[-8:])
            step = rng.choice((0.0, 0.1, 0.5, 3.0, -0.7, -5.0, 30.0))
            at = round((plain[-1] if plain else 0.0) + step, 3)
            plain = [each for each in plain if at - 10.0 <= each < at] + [at]
            forks.append((held.append(estimate(at)), plain))
        for held, plain in forks[1:]:
            assert times(held) == plain


def test_given_an_estimate_at_a_time_held_then_it_takes_the_place_of_the_old_one() -> None:
    held = history(0, 1, 2)
    newer = held.append(estimate(2, 99.0))
    assert times(newer) == [0, 1, 2]
    assert newer.newest.odom.xyz[0] == 99.0
    assert held.newest.odom.xyz[0] == 2.0


def test_given_a_clock_that_steps_back_then_what_was_after_is_dropped() -> None:
    assert times(history(0, 1, 2, 3).append(estimate(1.5))) == [0, 1, 1.5]
    assert times(history(0, 1, 2, 3).append(estimate(-3600))) == [-3600]


def test_given_a_clock_that_steps_forward_then_what_is_beyond_the_horizon_is_dropped() -> None:
    assert times(history(0, 1, 2).append(estimate(3600))) == [3600]
    assert times(history(0, 1, 2).append(estimate(61.5))) == [2, 61.5]


@pytest.mark.slow
def test_given_more_than_the_horizon_then_only_that_much_is_held_and_memory_stays_bounded() -> None:
    held = History(2.0)
    tracemalloc.start()
    try:
        for n in range(20_000):
            held = held.append(estimate(n * 0.01))
        # some 300 bytes for each of the 201 and of a block
        assert tracemalloc.get_traced_memory()[0] < 600_000
    finally:
        tracemalloc.stop()
    assert len(held) == 201
    assert held.first == held.last - 2 * S


@pytest.mark.slow
def test_given_a_long_history_when_its_last_estimate_is_replaced_then_little_is_copied() -> None:
    held = History(1e6)
    for n in range(100_000):
        held = held.append(estimate(n))
    again = estimate(99_999)
    tracemalloc.start()
    try:
        replaced = held.append(again)
        assert tracemalloc.get_traced_memory()[0] < 30_000
    finally:
        tracemalloc.stop()
    assert replaced.newest is again
    assert held.newest is not again


@pytest.mark.parametrize("seed", range(5))
def test_given_any_order_and_branches_then_each_history_is_what_a_list_would_be(seed: int) -> None:
    source, horizon = random.Random(seed), 700.0
    known: list[tuple[History, list[int]]] = [(History(horizon), [])]
    for _ in range(3000):
        held, listed = known[-1] if source.random() < 0.97 else source.choice(known)
        newest = listed[-1] if listed else 0
        at = newest + (1 if source.random() < 0.9 else source.randint(-400, 3))
        listed = [each for each in listed if at - horizon <= each < at] + [at]
        known = [*known[-20:], (held.append(estimate(at)), listed)]
    for held, listed in known[1:]:
        stored = [START + each * S for each in listed]
        assert (len(held), held.first, held.last) == (len(stored), stored[0], stored[-1])
        for _ in range(20):
            utime = source.randint(stored[0], stored[-1])
            before = max(each for each in stored if each <= utime)
            assert held.hold(utime).utime == before
            after = held.next_after(utime)
            assert (after and after.utime) == min((each for each in stored if each > utime), default=None)
            found, indices = held.bracket(np.array([utime], dtype=np.int64))
            assert found[indices[0]].utime == before
        recent = held.copy_recent(50.0)
        assert (recent.first, recent.last) == (min(each for each in stored if each >= stored[-1] - 50 * S), stored[-1])


def test_given_a_time_between_two_then_position_and_rotation_lie_between() -> None:
    held = History(60.0)
    covariance = tuple(float(n) for n in range(36))
    held = held.append(Estimate(START, Pose.from_rpy((0, 0, 0), 0, 0, 0.2), invalid=Invalid.STALE_GPS))
    held = held.append(
        Estimate(
            START + 4 * S, Pose.from_rpy((4, 8, 0), 0, 0, 0.6), odom_covariance=covariance, quality=Quality.REVERSING
        )
    )
    found = held.at(START + S)
    assert found.utime == START + S
    assert found.odom.is_close(Pose.from_rpy((1, 2, 0), 0, 0, 0.3))
    assert found.invalid == Invalid.STALE_GPS
    assert found.quality == Quality.REVERSING | Quality.INTERPOLATED
    assert found.odom_covariance == covariance


def test_given_a_time_that_is_held_exactly_then_it_is_that_estimate() -> None:
    held = history(0, 1, 2)
    for each in (0, 1, 2):
        assert held.at(START + each * S).odom.xyz[0] == each
        assert held.at(START + each * S).quality == Quality(0)


@pytest.mark.parametrize("change", [{"pose_epoch": 1}, {"origin": ORIGIN}])
def test_given_a_new_epoch_or_origin_between_then_the_earlier_pose_is_held(change: dict[str, object]) -> None:
    before = Estimate(START, Pose((1, 0, 0)))
    after = Estimate(START + S, Pose((9, 0, 0)), **change)  # type: ignore[arg-type]
    held = History(60.0).append(before).append(after)
    found = held.at(START + 999_999)
    assert found.odom.xyz[0] == 1.0
    assert found.quality == Quality.HELD
    assert (found.utime, found.pose_epoch, found.origin) == (START + 999_999, 0, None)
    assert held.at(START + S).odom.xyz[0] == 9.0


def test_given_a_world_pose_known_at_one_end_only_then_there_is_none_between() -> None:
    found = interpolate(estimate(0), estimate(1, utm=Pose((1, 2, 3)), enu=Pose((1, 2, 3))), START + S // 2)
    assert found.utm is None
    assert found.enu is None


@pytest.mark.parametrize("method", ["at", "check_span"])
def test_given_a_time_before_all_then_it_is_too_old_and_both_times_are_reported(method: str) -> None:
    held = history(10, 12)
    with pytest.raises(TooOldError) as caught:
        getattr(held, method)(START + 9 * S)
    text = str(caught.value)
    assert f"{START + 9 * S} is 1.000 s before" in text
    assert f"{START + 10 * S} to {START + 12 * S} (2.0 s)" in text


@pytest.mark.parametrize("method", ["at", "check_span"])
def test_given_a_time_after_all_then_it_is_too_new_and_the_remedies_are_reported(method: str) -> None:
    held = history(10, 12)
    with pytest.raises(TooNewError) as caught:
        getattr(held, method)(START + 12 * S + 1500)
    text = str(caught.value)
    assert f"{START + 12 * S + 1500} is 0.002 s after" in text
    assert f"{START + 10 * S} to {START + 12 * S}" in text
    assert "PREDICTED" in text
    assert "wait_ms" in text


def test_given_held_then_the_newest_not_after_is_returned_however_far() -> None:
    held = history(0, 1, 2)
    assert held.hold(START + S + 1).odom.xyz[0] == 1
    assert held.hold(START + 10**15).odom.xyz[0] == 2
    assert held.hold(START).odom.xyz[0] == 0
    with pytest.raises(TooOldError):
        held.hold(START - 1)


def test_given_an_estimate_restamped_then_reasons_and_flags_are_added_not_replaced() -> None:
    restamped = restamp(
        estimate(0, invalid=Invalid.NO_FIX, quality=Quality.REVERSING), START + 5, Quality.HELD, Invalid.STALE_IMU
    )
    assert restamped.utime == START + 5
    assert restamped.invalid == Invalid.NO_FIX | Invalid.STALE_IMU
    assert restamped.quality == Quality.REVERSING | Quality.HELD
