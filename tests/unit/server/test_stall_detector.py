"""Stall detection: lasting failures without success, and nothing else."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from modelserver.server.supervision import STALL_TIMEOUT_S, StallDetector

MS = 1_000_000
TIMEOUT_MS = round(STALL_TIMEOUT_S * 1000)


def test_given_silence_then_all_is_well_for_ever() -> None:
    progress = StallDetector()
    assert all(progress.is_progressing(7, 3, ms * MS) for ms in range(0, 100_000, 20))


def test_given_only_failures_then_it_is_stalled_after_the_timeout() -> None:
    progress = StallDetector()
    made = [progress.is_progressing(7, ms // 100, ms * MS) for ms in range(0, 10_000, 20)]
    first = made.index(False) * 20
    assert TIMEOUT_MS < first <= TIMEOUT_MS + 300
    assert not any(made[made.index(False) :])


def test_given_a_success_between_failures_then_it_is_not_stuck() -> None:
    progress = StallDetector()
    assert all(progress.is_progressing(ms // 4000, ms // 100, ms * MS) for ms in range(0, 60_000, 20))


def test_given_a_stray_failure_now_and_then_and_no_success_then_it_is_not_stuck() -> None:
    progress = StallDetector()
    assert all(progress.is_progressing(0, ms // 20_000, ms * MS) for ms in range(0, 200_000, 20))


@given(st.lists(st.tuples(st.integers(0, 2000), st.booleans(), st.integers(0, 3)), max_size=60))
def test_given_any_course_then_it_is_stalled_only_after_failures_beyond_the_timeout_without_success(
    course: list[tuple[int, bool, int]],
) -> None:
    progress, now, successes, failures, last_success = StallDetector(), 0, 0, 0, 0
    for wait_ms, succeeds, fails in course:
        now += wait_ms
        if succeeds:
            successes += 1
            last_success = now
        failures += fails
        made = progress.is_progressing(successes, failures, now * MS)
        assert made or (not succeeds and failures and now - last_success >= TIMEOUT_MS)
