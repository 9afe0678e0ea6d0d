"""Ticks of the 3DM-GX1: unwrapped, and judged."""

from __future__ import annotations

import pytest

from msdrivers.devices.gx1 import TickUnwrapper
from msdrivers.devices.gx1.driver import NEVER, PollSchedule, TickRateCheck

MS = 1_000_000
S = 1_000_000_000


@pytest.fixture
def watch() -> TickUnwrapper:
    made = TickUnwrapper()
    made.set_tick(0.01)
    assert made.unwrap(65_000, 0, True) == 65_536 + 65_000
    return made


def test_given_ticks_past_the_wrap_then_the_count_goes_on(watch):
    counts = [watch.unwrap((65_000 + k) % 65_536, k * 10 * MS, True) for k in range(1, 1000)]
    assert counts == [65_536 + 65_000 + k for k in range(1, 1000)]


def test_given_a_wrap_to_zero_then_it_is_one_tick_on(watch):
    watch.unwrap(65_535, 5350 * MS, True)
    assert watch.unwrap(0, 5360 * MS, True) == 2 * 65_536


def test_given_ticks_going_backwards_then_none_fits(watch):
    assert [watch.unwrap(65_000 - k, k * 10 * MS, True) for k in range(1, 200)] == [None] * 199


def test_given_ticks_further_ahead_than_the_time_passed_then_they_do_not_fit(watch):
    assert watch.unwrap(65_000 + 54 + 1, 10 * MS, True) is None
    assert watch.unwrap(65_000 + 52, 10 * MS, True) is not None


def test_given_ticks_further_ahead_than_the_time_since_the_last_ones_then_they_do_not_fit(watch):
    assert watch.unwrap(65_100, 1 * S, True) == 65_536 + 65_100
    assert watch.unwrap(65_100 + 54 + 50, 1 * S + 10 * MS, True) is None


def test_given_a_host_that_read_late_then_replies_that_come_all_at_once_fit(watch):
    assert all(watch.unwrap(65_000 + k, 3 * S, True) is not None for k in range(1, 300))


def test_given_a_poll_answered_behind_a_streamed_reply_then_it_keeps_its_own_tick(watch):
    assert watch.unwrap(65_010, 100 * MS, True) == 65_536 + 65_010
    assert watch.unwrap(65_009, 101 * MS, False) == 65_536 + 65_009
    assert watch.unwrap(65_009, 102 * MS, True) is None
    assert watch.unwrap(65_011, 110 * MS, True) == 65_536 + 65_011


def test_given_a_counter_that_jumped_then_the_third_reply_that_agrees_counts_and_lies_ahead_of_all(watch):
    counts = [watch.unwrap(100 + k, (k + 1) * 10 * MS, True) for k in range(4)]
    assert counts[:2] == [None, None]
    assert counts[2] is not None
    assert counts[2] > 65_536 + 65_000 + 65_536
    assert counts[3] == counts[2] + 1
    assert watch.has_jumped


def test_given_strays_that_do_not_agree_then_the_counter_has_not_jumped(watch):
    for k, ticks in enumerate((100, 30_000, 99, 20_000, 5)):
        assert watch.unwrap(ticks, (k + 1) * 10 * MS, True) is None
    assert watch.unwrap(65_006, 60 * MS, True) == 65_536 + 65_006
    assert not watch.has_jumped


def test_given_ticks_as_long_as_configured_then_the_rate_agrees():
    rate = TickRateCheck(0.01)
    assert not any(rate.update(k, k * 10 * MS) for k in range(3000))
    assert rate.is_consistent


def test_given_ticks_of_another_length_then_it_is_found_out_and_taken_back_when_it_ends():
    rate = TickRateCheck(0.01)
    changes = [k for k in range(3000) if rate.update(k, round(k * 6.5536 * MS))]
    assert len(changes) == 1
    assert not rate.is_consistent
    assert "6.554 ms" in rate.describe()
    assert "10 ms" in rate.describe()
    begin = round(3000 * 6.5536 * MS)
    assert [rate.update(3000 + k, begin + k * 10 * MS) for k in range(1500)].count(True) == 1
    assert rate.is_consistent


def test_given_a_host_that_was_late_by_two_seconds_then_the_rate_agrees_nevertheless():
    for stall in range(1, 700, 10):
        rate = TickRateCheck(0.01)
        instants = [k * 10 * MS if k < stall else max(k * 10 * MS, (stall + 200) * 10 * MS) for k in range(2000)]
        assert not any(rate.update(k, at) for k, at in enumerate(instants))


def test_given_a_poll_that_is_not_answered_then_it_is_asked_again_only_when_it_was_given_up():
    polls = PollSchedule()
    assert polls.deadline_ns == NEVER
    polls.add(7, 0.1, 0)
    assert polls.pop_due(0) == [7]
    assert polls.pop_due(100 * MS) == []
    assert polls.pop_timed_out(499 * MS) == []
    assert polls.pop_timed_out(500 * MS) == [7]
    assert polls.pop_due(500 * MS) == [7]
    polls.on_reply(7)
    assert polls.pop_timed_out(2 * S) == []
    polls.remove(7)
    assert polls.deadline_ns == NEVER
