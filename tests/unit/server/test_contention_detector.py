"""Contention: indications, their duration, and hysteresis."""

from __future__ import annotations

from pathlib import Path

import pytest

from modelserver.server.diagnostics.machine import read_run_delay
from modelserver.server.requests.scheduler import (
    CONTENTION_NS,
    DELAY_PERIOD_NS,
    ENTER_SHARE,
    LATE_TICK_NS,
    STAY_SHARE,
    ContentionDetector,
    RunDelay,
)

BEGIN = 10_000_000_000


def sample(detector: ContentionDetector, shares: list[float], slices: int = 50) -> list[bool]:
    """Add a reading of the run-queue delay for each share of the time; return whether it is contended after each."""
    found = []
    now, total = BEGIN, 5_000
    detector.add_delay(RunDelay(total, 0), now)
    for share in shares:
        now += DELAY_PERIOD_NS
        total += round(share * DELAY_PERIOD_NS)
        assert detector.wants_delay(now)
        detector.add_delay(RunDelay(total, slices * (len(found) + 1)), now)
        assert not detector.wants_delay(now)
        found.append(detector.is_contended(now))
    return found


def test_given_no_sign_then_it_is_not_contended() -> None:
    detector = ContentionDetector()
    assert not detector.is_contended(BEGIN)
    assert not any(sample(detector, [0.0, 0.05, ENTER_SHARE - 0.01, 0.0]))


def test_given_a_delay_beyond_the_share_then_it_is_contended_until_that_has_ended_for_a_while() -> None:
    held = CONTENTION_NS // DELAY_PERIOD_NS
    found = sample(ContentionDetector(), [0.0, ENTER_SHARE + 0.01] + [0.0] * (held + 2))
    assert found == [False] + [True] * held + [False] * 3


def test_given_a_share_between_both_thresholds_then_the_state_stays_what_it_is() -> None:
    between = (ENTER_SHARE + STAY_SHARE) / 2
    assert not any(sample(ContentionDetector(), [between] * 20))
    assert all(sample(ContentionDetector(), [ENTER_SHARE + 0.01] + [between] * 20))


def test_given_a_client_in_a_closed_loop_then_the_many_short_delays_are_no_contention() -> None:
    # 2,700 queries a second, of which each wakes the thread: 18 us each would be a fifth of the time
    often = DELAY_PERIOD_NS // 20_000
    assert not any(sample(ContentionDetector(), [0.3, 0.6, 0.9], often))
    assert all(sample(ContentionDetector(), [0.3, 0.6, 0.9], 200))


def test_given_a_system_without_run_queue_delays_then_late_ticks_alone_count() -> None:
    detector = ContentionDetector()
    for number in range(5):
        detector.add_delay(None, BEGIN + number * DELAY_PERIOD_NS)
    detector.add_tick(LATE_TICK_NS, BEGIN)
    assert not detector.is_contended(BEGIN)
    detector.add_tick(LATE_TICK_NS + 1, BEGIN)
    # the machine may have been suspended
    assert not detector.is_contended(BEGIN)
    detector.add_tick(LATE_TICK_NS + 1, BEGIN + CONTENTION_NS)
    assert not detector.is_contended(BEGIN + CONTENTION_NS)
    detector.add_tick(LATE_TICK_NS + 1, again := BEGIN + CONTENTION_NS + 1)
    assert detector.is_contended(again + CONTENTION_NS - 1)
    assert not detector.is_contended(again + CONTENTION_NS)


def test_given_samples_behind_samples_then_it_is_contended() -> None:
    detector = ContentionDetector()
    detector.add_sensor_backlog(BEGIN)
    assert detector.is_contended(BEGIN)


def test_given_the_kernels_file_then_delay_and_slices_are_its_last_numbers(tmp_path: Path) -> None:
    file = tmp_path / "schedstat"
    file.write_text("123456 7890 42\n")
    assert read_run_delay(file) == RunDelay(7890, 42)


@pytest.mark.parametrize("content", [None, "", "1\n", "1 2\n", "a b c\n"])
def test_given_a_file_that_does_not_have_it_then_the_delay_is_unknown(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "schedstat"
    if content is not None:
        file.write_text(content)
    assert read_run_delay(file) is None
