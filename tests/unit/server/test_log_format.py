"""Log lines: one record is one entry, whatever its text."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.server.clock import FakeClock
from modelserver.server.log import (
    JournalHandler,
    PlainFormatter,
    RateLimitedLog,
    encode_journal_entry,
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


def parse(datagram: bytes) -> dict[str, str]:
    """Parse an entry as the journal does."""
    found: dict[str, str] = {}
    while datagram:
        line, _, rest = datagram.partition(b"\n")
        name, sign, value = line.partition(b"=")
        if sign:
            found[name.decode()], datagram = value.decode(), rest
        else:
            size = int.from_bytes(rest[:8], "little")
            found[name.decode()], datagram = rest[8 : 8 + size].decode(), rest[8 + size + 1 :]
    return found


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        path = str(tmp_path / "journal")
        there.bind(path)
        there.settimeout(5)
        yield there, path


def test_given_a_message_of_several_lines_then_those_after_the_first_are_indented() -> None:
    assert PlainFormatter().format(record("one\ntwo\n    three")) == (
        "WARNING modelserver.server.loop: one\n    two\n    three"
    )


def test_given_a_trace_then_what_is_in_it_cannot_pass_for_a_line_of_its_own() -> None:
    text = PlainFormatter().format(record("failed", logging.ERROR, trace=True))
    assert "\x1b" not in text
    assert all(line.startswith("    ") for line in text.splitlines()[1:])
    assert "\n    cause=forged" in text


@given(st.text())
def test_given_any_text_then_no_line_but_the_first_starts_at_the_margin(text: str) -> None:
    first, *rest = lines_of(record(text.replace("%", "%%")))
    assert all(line.startswith("    ") for line in rest)
    assert all(line.isprintable() for line in (first, *rest))


@given(st.dictionaries(st.from_regex(r"[A-Z]{1,8}", fullmatch=True), st.text(), max_size=5))
def test_given_any_fields_then_the_journal_reads_them_as_they_were(fields: dict[str, str]) -> None:
    clean = {name: value.encode("utf-8", "backslashreplace").decode() for name, value in fields.items()}
    assert parse(encode_journal_entry(fields.items())) == clean


def test_given_a_journal_then_a_record_is_one_entry_of_fields(journal: tuple[socket.socket, str]) -> None:
    there, path = journal
    handler = JournalHandler(io.StringIO(), "modelserver", path)
    handler.emit(record("rejected a message\nof two lines", cause="GPS:malformed"))
    handler.close()
    assert parse(there.recv(10_000)) == {
        "MESSAGE": "rejected a message\n    of two lines",
        "PRIORITY": "4",
        "SYSLOG_IDENTIFIER": "modelserver",
        "LOGGER": "modelserver.server.loop",
        "CODE_FILE": "/x/loop.py",
        "CODE_LINE": "7",
        "CODE_FUNC": "turn",
        "MODELSERVER_CAUSE": "GPS:malformed",
    }


def test_given_a_journal_that_does_not_keep_up_then_nothing_waits_and_the_loss_is_reported(
    journal: tuple[socket.socket, str],
) -> None:
    there, path = journal
    handler = JournalHandler(stream := io.StringIO(), "modelserver", path)
    for _ in range(5000):
        handler.emit(record("flood"))
    there.setblocking(False)
    entries = 0
    with contextlib.suppress(BlockingIOError):
        while there.recv(10_000):
            entries += 1
    handler.emit(record("after"))
    handler.close()
    assert 0 < entries < 5000
    text = parse(there.recv(10_000))["MESSAGE"]
    assert text == f"after ({5000 - entries} entries before this one were lost: the journal did not keep up)"
    assert stream.getvalue() == ""


def test_given_no_journal_then_the_lines_go_to_the_stream(tmp_path: Path) -> None:
    handler = JournalHandler(stream := io.StringIO(), "modelserver", str(tmp_path / "nothing"))
    handler.emit(record("one"))
    handler.close()
    assert stream.getvalue() == "WARNING modelserver.server.loop: one\n"


def test_given_a_message_that_is_too_long_then_it_is_cut(journal: tuple[socket.socket, str]) -> None:
    there, path = journal
    handler = JournalHandler(io.StringIO(), "modelserver", path)
    handler.emit(record("x" * 1_000_000))
    handler.close()
    assert parse(there.recv(300_000))["MESSAGE"].endswith("x... (1000000 characters)")


def test_given_the_environment_then_auto_is_the_journal_only_where_the_stream_leads_there(tmp_path: Path) -> None:
    with (tmp_path / "stderr").open("w") as stream:
        status = os.fstat(stream.fileno())
        there = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert is_journal_stream(stream, there)
        assert not is_journal_stream(stream, {"JOURNAL_STREAM": "1:1"})
        assert not is_journal_stream(io.StringIO(), there)
        for form, environment, expected in (
            ("auto", there, JournalHandler),
            ("auto", {}, logging.StreamHandler),
            ("plain", there, logging.StreamHandler),
            ("journal", {}, JournalHandler),
        ):
            handler = make_handler(form, environment=environment, stream=stream)
            handler.close()
            assert type(handler) is expected


@pytest.mark.parametrize(("level", "expected"), [(10, 7), (20, 6), (25, 6), (30, 4), (40, 3), (50, 2), (5, 7)])
def test_given_a_level_then_its_priority_is_syslogs(level: int, expected: int) -> None:
    assert get_priority(level) == expected


def test_given_a_cause_then_the_record_has_it_and_the_place_it_came_from(caplog: pytest.LogCaptureFixture) -> None:
    RateLimitedLog(logging.getLogger("modelserver.test"), FakeClock()).warning("GPS:malformed", "rejected %s", "a\nb")
    (made,) = caplog.records
    assert (made.getMessage(), made.__dict__["cause"]) == ("rejected a\\nb", "GPS:malformed")
    assert made.filename == Path(__file__).name
