"""Who writes on a channel: two at once, told apart from what looks alike."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_samples import START

from modelserver.core.writers import FAR, NEAR, SILENCE_NS, Writer
from modelserver.messages import SensorHeader

MS = 1_000_000
"""Nanoseconds in a millisecond."""


def row(
    first: int, count: int, source: str = "imu", at_ms: float = 0.0, every_ms: float = 5.0
) -> list[tuple[float, SensorHeader]]:
    """Samples of one writer: when each arrives, milliseconds, and its header."""
    times = [at_ms + n * every_ms for n in range(count)]
    return [(t, SensorHeader(START + round(t * 1000), source, first + n)) for n, t in enumerate(times)]


def seconds_of(samples: list[tuple[float, SensorHeader]], writer: Writer | None = None) -> list[bool]:
    """Which of the samples, in the order of arrival, are a second writer's."""
    writer = writer or Writer()
    return [writer.is_second(header, round(t * MS)) for t, header in sorted(samples, key=lambda each: each[0])]


def merged(*rows: list[tuple[float, SensorHeader]]) -> list[tuple[float, SensorHeader]]:
    return sorted(itertools.chain(*rows), key=lambda each: each[0])


@pytest.mark.parametrize("first", [0, 5, 1_000_000, (1 << 62)])
def test_given_one_writer_then_there_is_no_second(first: int) -> None:
    assert not any(seconds_of(row(first, 500)))


def test_given_another_name_while_the_first_speaks_then_each_of_its_samples_is_a_second_writers() -> None:
    samples = merged(row(0, 100), row(0, 50, "fake", 101.0))
    assert [
        found for found, (_, header) in zip(seconds_of(samples), samples, strict=True) if header.source == "fake"
    ] == [True] * 50


@pytest.mark.parametrize("first", [-5000, 50_000, 10_000_000, 0])
@pytest.mark.parametrize("every_ms", [5.0, 3.7, 50.0])
def test_given_the_same_name_and_other_numbers_side_by_side_then_the_second_row_is_told(
    first: int, every_ms: float
) -> None:
    mine, other = row(1_000, 400), row(first, 40, at_ms=201.3, every_ms=every_ms)
    samples = merged(mine, other)
    found = seconds_of(samples)
    theirs = [each for each, sample in zip(found, samples, strict=True) if sample in other]
    assert not any(each for each, sample in zip(found, samples, strict=True) if sample in mine)
    # the first two may be those of a driver that was started anew
    speaking = [n for n, (t, _) in enumerate(other) if t < mine[-1][0]]
    assert all(theirs[n] for n in speaking[3:])


@pytest.mark.parametrize("ahead", range(1, 8))
def test_given_a_driver_started_twice_then_it_is_told_though_they_count_nearly_the_same(ahead: int) -> None:
    writer = Writer()
    found = seconds_of(merged(row(0, 200), row(ahead, 200, at_ms=2.5)), writer)
    assert writer.rival == "imu"
    # of two that cannot be told apart by name one is left
    assert 150 < sum(found) <= 200


def test_given_messages_that_come_twice_late_or_not_then_there_is_no_second() -> None:
    rng = random.Random(3)
    samples = []
    for n, (t, header) in enumerate(row(100, 1000)):
        if n == 0 or rng.random() > 0.1:
            samples.append((t + rng.random() * 40.0 * (n > 0), header))
        if rng.random() < 0.2:
            samples.append((t + rng.random() * 60.0 * (n > 0) + 0.01, header))
    assert not any(seconds_of(samples))


@given(st.lists(st.integers(0, 30), min_size=2, max_size=60))
def test_given_any_disorder_within_reach_then_there_is_no_second(delays: list[int]) -> None:
    samples = [(n * 5.0 + 5.0 * delay * (n > 0), SensorHeader(START + n, "imu", n)) for n, delay in enumerate(delays)]
    assert not any(seconds_of(samples))


@pytest.mark.parametrize("pause_ms", [5.0, 400.0, 2900.0, 10_000.0])
@pytest.mark.parametrize("spoken", [3, 30, 300, 5000])
def test_given_a_driver_that_starts_anew_then_all_it_says_is_used(pause_ms: float, spoken: int) -> None:
    before = row(0, spoken, every_ms=1.0)
    assert not any(seconds_of(before + row(0, 300, at_ms=before[-1][0] + pause_ms, every_ms=5.0)))


def test_given_a_looped_log_then_it_is_one_writer() -> None:
    times = [n * 5.0 for n in range(900)]
    samples = [(t, SensorHeader(START - 3_600_000_000 + (n % 300) * 5000, "imu", n % 300)) for n, t in enumerate(times)]
    assert not any(seconds_of(samples))


def test_given_sources_that_do_not_count_then_they_are_told_apart_by_name_alone() -> None:
    mute = [(t, SensorHeader(header.utime, "imu", 0)) for t, header in row(0, 100)]
    assert not any(seconds_of(mute))
    assert sum(seconds_of(merged(mute, row(0, 10, "other", 101.0)))) == 10


def test_given_silence_then_another_may_take_the_channel_over() -> None:
    quiet_ms = SILENCE_NS / MS + 1.0
    assert not any(seconds_of(row(0, 10) + row(0, 10, "other", at_ms=50.0 + quiet_ms)))
    assert all(seconds_of(row(0, 10) + row(0, 10, "other", at_ms=1000.0))[10:])


def test_given_lost_messages_then_there_is_no_second() -> None:
    assert not any(seconds_of(row(0, 10) + row(10 + FAR - 1, 100, at_ms=60.0)))
    assert not any(seconds_of([each for n, each in enumerate(row(0, 2000)) if n % 7 == 0]))


def test_given_one_stray_number_then_nobody_is_accused() -> None:
    samples = merged(row(1000, 200), row(9_999_999, 1, at_ms=301.0), row(-NEAR * 100, 1, at_ms=401.0))
    assert not any(seconds_of(samples))


def used(samples: list[tuple[float, SensorHeader]], of: list[tuple[float, SensorHeader]]) -> int:
    """How many samples of one writer are used."""
    found = zip(seconds_of(samples), sorted(samples, key=lambda each: each[0]), strict=True)
    return sum(not second for second, sample in found if sample in of)


@pytest.mark.parametrize(
    "numbers",
    [
        lambda n: 1_000_000 + n,
        lambda n: 1_000_000 - n,
        lambda n: 1_000_000 + 5000 * n,
        lambda n: -7 - 3 * n,
    ],
    ids=["rising", "falling", "far apart", "below"],
)
@pytest.mark.parametrize("burst", [1, 2, 5])
def test_given_an_intruder_of_the_same_name_then_the_first_keeps_its_channel(
    numbers: Callable[[int], int], burst: int
) -> None:
    mine = row(500, 600)
    times = [301.0 + 0.1 * n for n in range(burst)] + [310.2 + 5.0 * n for n in range(400)]
    theirs = [(t, SensorHeader(START + round(t * 1000) + 1, "imu", numbers(n))) for n, t in enumerate(times)]
    samples = merged(mine, theirs)
    assert used(samples, mine) == len(mine)
    assert used(samples, theirs) <= burst + 4


def test_given_a_source_that_does_not_count_and_another_of_its_name_that_does_then_that_one_is_the_second() -> None:
    mute = [(t, SensorHeader(header.utime, "gps", 0)) for t, header in row(0, 400)]
    counting = row(1, 200, "gps", at_ms=501.0)
    samples = merged(mute, counting)
    assert used(samples, mute) == len(mute)
    assert used(samples, counting) <= 4


def test_given_a_slow_driver_that_starts_anew_then_its_row_is_taken_up() -> None:
    before = row(40, 30, every_ms=250.0)
    after = row(0, 30, at_ms=before[-1][0] + 700.0, every_ms=250.0)
    assert not any(seconds_of(before + after))
