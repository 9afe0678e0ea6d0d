"""Log lines: one record is one entry, whatever its text."""

from __future__ import annotations

import io
import logging
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.server.clock import FakeClock
from modelserver.server.log import (
    LineFormatter,
    RateLimitedLog,
    get_priority,
    is_journal_stream,
    lines_of,
    make_handler,
)


def record(message: str, level: int = logging.WARNING, trace: bool = False, **extra: Any) -> logging.LogRecord:
    made = logging.LogRecord("modelserver.server.loop", level, "/x/loop.py", 7, message, None, None, "turn")
    if trace:
        try:
            raise ValueError("bad\x1b[2J\ncause=forged")
        except ValueError:
            made.exc_info = sys.exc_info()
    made.__dict__.update(extra)
    return made


def test_given_a_message_of_several_lines_then_those_after_the_first_are_indented() -> None:
    assert LineFormatter().format(record("one\ntwo\n    three")) == (
        "WARNING modelserver.server.loop: one\n    two\n    three"
    )


def test_given_a_trace_then_what_is_in_it_cannot_pass_for_a_line_of_its_own() -> None:
    text = LineFormatter().format(record("failed", logging.ERROR, trace=True))
    assert "\x1b" not in text
    assert all(line.startswith("    ") for line in text.splitlines()[1:])
    assert "\n    cause=forged" in text


@given(st.text())
def test_given_any_text_then_no_line_but_the_first_starts_at_the_margin(text: str) -> None:
    first, *rest = lines_of(record(text.replace("%", "%%")))
    assert all(line.startswith("    ") for line in rest)
    assert all(line.isprintable() for line in (first, *rest))


def test_given_a_journal_then_each_line_has_its_priority() -> None:
    assert LineFormatter(has_priority=True).format(record("rejected a message\nof two lines")) == (
        "<4>WARNING modelserver.server.loop: rejected a message\n<4>    of two lines"
    )


def test_given_a_message_that_is_too_long_then_it_is_cut() -> None:
    assert LineFormatter().format(record("x" * 1_000_000)).endswith("x... (1000000 characters)")


def test_given_the_environment_then_auto_is_the_journal_only_where_the_stream_leads_there(tmp_path: Path) -> None:
    with (tmp_path / "stderr").open("w") as stream:
        status = os.fstat(stream.fileno())
        there = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert is_journal_stream(stream, there)
        assert not is_journal_stream(stream, {"JOURNAL_STREAM": "1:1"})
        assert not is_journal_stream(io.StringIO(), there)
        for form, environment, expected in (
            ("auto", there, "<4>WARNING"),
            ("auto", {}, "WARNING"),
            ("plain", there, "WARNING"),
            ("journal", {}, "<4>WARNING"),
        ):
            handler = make_handler(form, environment=environment, stream=stream)
            assert handler.format(record("one")).startswith(expected)


@pytest.mark.parametrize(("level", "expected"), [(10, 7), (20, 6), (25, 6), (30, 4), (40, 3), (50, 2), (5, 7)])
def test_given_a_level_then_its_priority_is_syslogs(level: int, expected: int) -> None:
    assert get_priority(level) == expected


def test_given_a_cause_then_the_record_has_the_place_it_came_from(caplog: pytest.LogCaptureFixture) -> None:
    RateLimitedLog(logging.getLogger("modelserver.test"), FakeClock()).warning("GPS:malformed", "rejected %s", "a\nb")
    (made,) = caplog.records
    assert made.getMessage() == "rejected a\\nb"
    assert made.filename == Path(__file__).name
