"""Ticks of the 3DM-GX1: unwrapped, and judged."""

from __future__ import annotations

import pytest

from msdrivers.devices.gx1 import TickUnwrapper

MS = 1_000_000
S = 1_000_000_000


@pytest.fixture
def watch() -> TickUnwrapper:
    made = TickUnwrapper()
    made.set_tick(0.01)
    assert made.unwrap(65_000, 0) == 65_536 + 65_000
    return made


def test_given_ticks_past_the_wrap_then_the_count_goes_on(watch):
    counts = [watch.unwrap((65_000 + k) % 65_536, k * 10 * MS) for k in range(1, 1000)]
    assert counts == [65_536 + 65_000 + k for k in range(1, 1000)]


def test_given_a_wrap_to_zero_then_it_is_one_tick_on(watch):
    watch.unwrap(65_535, 5350 * MS)
    assert watch.unwrap(0, 5360 * MS) == 2 * 65_536


def test_given_ticks_going_backwards_then_none_fits(watch):
    assert [watch.unwrap(65_000 - k, k * 10 * MS) for k in range(1, 200)] == [None] * 199


def test_given_ticks_further_ahead_than_the_time_passed_then_they_do_not_fit(watch):
    assert watch.unwrap(65_000 + 54 + 1, 10 * MS) is None
    assert watch.unwrap(65_000 + 52, 10 * MS) is not None


def test_given_ticks_further_ahead_than_the_time_since_the_last_ones_then_they_do_not_fit(watch):
    assert watch.unwrap(65_100, 1 * S) == 65_536 + 65_100
    assert watch.unwrap(65_100 + 54 + 50, 1 * S + 10 * MS) is None


def test_given_a_host_that_read_late_then_replies_that_come_all_at_once_fit(watch):
    assert all(watch.unwrap(65_000 + k, 3 * S) is not None for k in range(1, 300))


def test_given_strays_that_do_not_agree_then_the_counter_has_not_jumped(watch):
    for k, ticks in enumerate((100, 30_000, 99, 20_000, 5)):
        assert watch.unwrap(ticks, (k + 1) * 10 * MS) is None
    assert watch.unwrap(65_006, 60 * MS) == 65_536 + 65_006
