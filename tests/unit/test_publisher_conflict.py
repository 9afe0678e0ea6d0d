"""Publisher conflicts: two publishers on a channel, against duplicates, reordering, losses and restarts."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_samples import START

from modelserver.messages import SensorHeader
from modelserver.server.ingress import (
    LOSS_WINDOW,
    PUBLISHER_TIMEOUT_NS,
    REORDER_WINDOW,
    PublisherConflictDetector,
)

MS = 1_000_000
"""Nanoseconds in a millisecond."""


def make_sequence(
    first: int, count: int, source: str = "imu", at_ms: float = 0.0, every_ms: float = 5.0
) -> list[tuple[float, SensorHeader]]:
    """Samples of one publisher: arrival, milliseconds, and header."""
    times = [at_ms + n * every_ms for n in range(count)]
    return [(t, SensorHeader(START + round(t * 1000), source, first + n)) for n, t in enumerate(times)]


def find_conflicts(
    samples: list[tuple[float, SensorHeader]], detector: PublisherConflictDetector | None = None
) -> list[bool]:
    """Return which samples, in order of arrival, are conflicts."""
    detector = detector or PublisherConflictDetector()
    return [detector.is_conflicting(header, round(t * MS)) for t, header in sorted(samples, key=lambda each: each[0])]


def merge(*rows: list[tuple[float, SensorHeader]]) -> list[tuple[float, SensorHeader]]:
    return sorted(itertools.chain(*rows), key=lambda each: each[0])


@pytest.mark.parametrize("first", [0, 5, 1_000_000, (1 << 62)])
def test_given_one_publisher_then_there_is_no_conflict(first: int) -> None:
    assert not any(find_conflicts(make_sequence(first, 500)))


def test_given_another_source_while_the_first_publishes_then_each_of_its_samples_is_a_conflict() -> None:
    samples = merge(make_sequence(0, 100), make_sequence(0, 50, "fake", 101.0))
    assert [
        found for found, (_, header) in zip(find_conflicts(samples), samples, strict=True) if header.source == "fake"
    ] == [True] * 50


@pytest.mark.parametrize("first", [-5000, 50_000, 10_000_000, 0])
@pytest.mark.parametrize("every_ms", [5.0, 3.7, 50.0])
def test_given_one_source_and_two_sequences_side_by_side_then_the_second_one_is_a_conflict(
    first: int, every_ms: float
) -> None:
    mine, other = make_sequence(1_000, 400), make_sequence(first, 40, at_ms=201.3, every_ms=every_ms)
    samples = merge(mine, other)
    found = find_conflicts(samples)
    theirs = [each for each, sample in zip(found, samples, strict=True) if sample in other]
    assert not any(each for each, sample in zip(found, samples, strict=True) if sample in mine)
    # the first two may be from a restarted driver
    speaking = [n for n, (t, _) in enumerate(other) if t < mine[-1][0]]
    assert all(theirs[n] for n in speaking[3:])


@pytest.mark.parametrize("ahead", range(1, 8))
def test_given_a_driver_started_twice_then_it_is_a_conflict_though_the_counts_are_close(ahead: int) -> None:
    detector = PublisherConflictDetector()
    found = find_conflicts(merge(make_sequence(0, 200), make_sequence(ahead, 200, at_ms=2.5)), detector)
    assert detector.other_source == "imu"
    # one of two publishers with one source is left
    assert 150 < sum(found) <= 200


def test_given_messages_that_come_twice_late_or_not_then_there_is_no_second() -> None:
    rng = random.Random(3)
    samples = []
    for n, (t, header) in enumerate(make_sequence(100, 1000)):
        if n == 0 or rng.random() > 0.1:
            samples.append((t + rng.random() * 40.0 * (n > 0), header))
        if rng.random() < 0.2:
            samples.append((t + rng.random() * 60.0 * (n > 0) + 0.01, header))
    assert not any(find_conflicts(samples))


@given(st.lists(st.integers(0, 30), min_size=2, max_size=60))
def test_given_any_disorder_within_reach_then_there_is_no_second(delays: list[int]) -> None:
    samples = [(n * 5.0 + 5.0 * delay * (n > 0), SensorHeader(START + n, "imu", n)) for n, delay in enumerate(delays)]
    assert not any(find_conflicts(samples))


@pytest.mark.parametrize("pause_ms", [5.0, 400.0, 2900.0, 10_000.0])
@pytest.mark.parametrize("spoken", [3, 30, 300, 5000])
def test_given_a_restarted_driver_then_all_its_samples_are_used(pause_ms: float, spoken: int) -> None:
    before = make_sequence(0, spoken, every_ms=1.0)
    assert not any(find_conflicts(before + make_sequence(0, 300, at_ms=before[-1][0] + pause_ms, every_ms=5.0)))


def test_given_a_looped_log_then_it_is_one_publisher() -> None:
    times = [n * 5.0 for n in range(900)]
    samples = [(t, SensorHeader(START - 3_600_000_000 + (n % 300) * 5000, "imu", n % 300)) for n, t in enumerate(times)]
    assert not any(find_conflicts(samples))


def test_given_sources_that_do_not_count_then_only_their_names_distinguish_them() -> None:
    mute = [(t, SensorHeader(header.utime, "imu", 0)) for t, header in make_sequence(0, 100)]
    assert not any(find_conflicts(mute))
    assert sum(find_conflicts(merge(mute, make_sequence(0, 10, "other", 101.0)))) == 10


def test_given_silence_then_another_may_take_the_channel_over() -> None:
    quiet_ms = PUBLISHER_TIMEOUT_NS / MS + 1.0
    assert not any(find_conflicts(make_sequence(0, 10) + make_sequence(0, 10, "other", at_ms=50.0 + quiet_ms)))
    assert all(find_conflicts(make_sequence(0, 10) + make_sequence(0, 10, "other", at_ms=1000.0))[10:])


def test_given_lost_messages_then_there_is_no_second() -> None:
    assert not any(find_conflicts(make_sequence(0, 10) + make_sequence(10 + LOSS_WINDOW - 1, 100, at_ms=60.0)))
    assert not any(find_conflicts([each for n, each in enumerate(make_sequence(0, 2000)) if n % 7 == 0]))


def test_given_one_stray_number_then_there_is_no_conflict() -> None:
    samples = merge(
        make_sequence(1000, 200),
        make_sequence(9_999_999, 1, at_ms=301.0),
        make_sequence(-REORDER_WINDOW * 100, 1, at_ms=401.0),
    )
    assert not any(find_conflicts(samples))


def count_used(samples: list[tuple[float, SensorHeader]], of: list[tuple[float, SensorHeader]]) -> int:
    """Count the count_used samples of one publisher."""
    found = zip(find_conflicts(samples), sorted(samples, key=lambda each: each[0]), strict=True)
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
def test_given_an_intruder_of_the_same_source_then_the_first_owns_the_channel(
    numbers: Callable[[int], int], burst: int
) -> None:
    mine = make_sequence(500, 600)
    times = [301.0 + 0.1 * n for n in range(burst)] + [310.2 + 5.0 * n for n in range(400)]
    theirs = [(t, SensorHeader(START + round(t * 1000) + 1, "imu", numbers(n))) for n, t in enumerate(times)]
    samples = merge(mine, theirs)
    assert count_used(samples, mine) == len(mine)
    assert count_used(samples, theirs) <= burst + 4


def test_given_a_source_that_does_not_count_and_another_of_its_name_that_does_then_that_one_is_the_second() -> None:
    mute = [(t, SensorHeader(header.utime, "gps", 0)) for t, header in make_sequence(0, 400)]
    counting = make_sequence(1, 200, "gps", at_ms=501.0)
    samples = merge(mute, counting)
    assert count_used(samples, mute) == len(mute)
    assert count_used(samples, counting) <= 4


def test_given_a_slow_driver_that_restarts_then_its_new_sequence_is_used() -> None:
    before = make_sequence(40, 30, every_ms=250.0)
    after = make_sequence(0, 30, at_ms=before[-1][0] + 700.0, every_ms=250.0)
    assert not any(find_conflicts(before + after))


def test_given_a_first_one_that_is_slower_than_any_sensor_then_a_steady_one_takes_the_channel() -> None:
    stranger = make_sequence(0, 10, "stranger", every_ms=2000.0)
    driver = make_sequence(100, 80, "gps", at_ms=1.0, every_ms=200.0)
    samples = merge(stranger, driver)
    found = find_conflicts(samples)
    used = [t for second, (t, header) in zip(found, samples, strict=True) if header.source == "gps" and not second]
    assert 5000.0 <= used[0] < 6500.0
    assert len(used) == sum(t >= used[0] for t, _ in driver)
    late = [
        second for second, (t, header) in zip(found, samples, strict=True) if header.source == "stranger" and t > 7000.0
    ]
    assert all(late)


def test_given_a_receiver_of_one_fix_a_second_then_a_quick_stranger_does_not_take_its_channel() -> None:
    driver = make_sequence(0, 30, "gps", every_ms=1000.0)
    samples = merge(driver, make_sequence(0, 2000, "stranger", at_ms=500.0, every_ms=10.0))
    assert count_used(samples, driver) == len(driver)


@pytest.mark.parametrize("first", ["named", "stranger"])
def test_given_a_named_source_then_it_has_the_channel_also_as_the_second(first: str) -> None:
    detector = PublisherConflictDetector({"named"})
    begins = {"named": 0.0 if first == "named" else 1000.0, "stranger": 1000.0 if first == "named" else 0.0}
    samples = merge(*(make_sequence(0, 400, source, at_ms) for source, at_ms in begins.items()))
    found = find_conflicts(samples, detector)
    assert not any(second for second, (_, header) in zip(found, samples, strict=True) if header.source == "named")
    strangers = [second for second, (t, header) in zip(found, samples, strict=True) if header.source != "named"]
    assert sum(strangers) == (400 if first == "named" else 200)


def test_given_two_senders_of_one_source_then_the_first_one_has_the_channel_whatever_their_numbers() -> None:
    detector = PublisherConflictDetector()
    found = {1: [], 2: []}
    for n in range(400):
        for sender in (1, 2):
            header = SensorHeader(START + 5000 * n + sender, "imu", n + sender)
            found[sender].append(detector.is_conflicting(header, n * 5 * MS + sender, sender))
    assert not any(found[1])
    assert all(found[2])
