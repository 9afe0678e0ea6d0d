"""GPS weeks to UTC: leap seconds and rollovers."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from msdrivers.devices.gps import (
    DAY,
    GPS_EPOCH,
    ROLLOVER,
    SECOND,
    WEEK,
    count_leap_seconds,
    gps_of,
    resolve_rollover,
    utime_of,
)


def utc(*parts: int) -> int:
    return round(datetime(*parts, tzinfo=UTC).timestamp()) * SECOND  # type: ignore[misc]


NOW = utc(2026, 11, 21)


@pytest.mark.parametrize(
    ("at", "ahead"),
    [
        (utc(1980, 1, 6), 0),
        (utc(1981, 7, 1) - 1, 0),
        (utc(1981, 7, 1), 1),
        (utc(1999, 1, 1), 13),
        (utc(2005, 3, 12), 13),
        (utc(2006, 1, 1), 14),
        (utc(2016, 12, 31, 23, 59, 59), 17),
        (utc(2017, 1, 1), 18),
        (NOW, 18),
    ],
)
def test_given_a_date_when_asked_then_gps_is_ahead_by_the_leap_seconds(at: int, ahead: int):
    assert count_leap_seconds(at) == ahead


def test_given_a_real_log_when_converted_then_the_instant_is_that_of_the_sentence_beside_it():
    # BESTPOSA of week 1957, 339804.750 s stands beside GPGGA,222306.75 and a date of 2017-07-12
    assert utime_of(1957, 339_804_750_000, NOW) == utc(2017, 7, 12, 22, 23, 6) + 750_000


@pytest.mark.parametrize("rollovers", [0, 1, 2])
def test_given_a_week_that_rolled_over_when_the_host_knows_the_year_then_it_is_of_these_days(rollovers: int):
    week, microseconds = gps_of(NOW - DAY)
    assert utime_of(week - 1024 * rollovers, microseconds, NOW) == NOW - DAY


def test_given_a_host_without_a_date_when_converted_then_nothing_is_moved():
    week, microseconds = gps_of(NOW)
    assert utime_of(week, microseconds, 0) == NOW
    assert resolve_rollover(NOW, 0) == NOW


def test_given_a_time_that_is_ahead_when_unrolled_then_it_stays():
    assert resolve_rollover(NOW + ROLLOVER, NOW) == NOW + ROLLOVER
    assert resolve_rollover(NOW - ROLLOVER, NOW) == NOW
    assert resolve_rollover(NOW - ROLLOVER // 2, NOW) == NOW - ROLLOVER // 2


@given(st.integers(GPS_EPOCH, NOW + 100 * WEEK))
def test_given_an_instant_of_utc_when_there_and_back_then_it_is_the_same(utime: int):
    week, microseconds = gps_of(utime)
    assert 0 <= microseconds < WEEK
    assert utime_of(week, microseconds, utime) == utime
