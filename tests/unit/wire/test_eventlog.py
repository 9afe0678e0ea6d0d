from __future__ import annotations

import os
import struct
from pathlib import Path

import lcm
import pytest

from modelserver.errors import RecordingError
from modelserver.wire.eventlog import LogDamage, LogEvent, LogFile, scan

SIZE = 28 + 2 + 20


def write_log(path: Path, count: int = 5) -> bytes:
    log = lcm.EventLog(str(path), "w", overwrite=True)
    for number in range(count):
        log.write_event(1000 + number, "CH", bytes([number]) * 20)
    log.close()
    return path.read_bytes()


def split(data: bytes) -> tuple[list[int], list[LogDamage]]:
    found = list(scan(data))
    return (
        [each.utime - 1000 for each in found if isinstance(each, LogEvent)],
        [each for each in found if isinstance(each, LogDamage)],
    )


@pytest.fixture
def good(tmp_path: Path) -> bytes:
    return write_log(tmp_path / "good.lcm")


def test_given_a_log_of_lcm_when_read_then_every_event_is_returned(tmp_path: Path, good: bytes) -> None:
    theirs = [(e.eventnum, e.timestamp, e.channel, e.data) for e in lcm.EventLog(str(tmp_path / "good.lcm"))]
    with LogFile(tmp_path / "good.lcm") as log:
        ours = [(e.number, e.utime, e.channel, e.data) for e in log]
    assert ours == theirs
    assert log.damage == []
    assert log.size == len(good) == 5 * SIZE


@pytest.mark.parametrize("cut", [1, 7, 22, 49])
def test_given_a_log_cut_short_when_read_then_the_whole_events_and_a_tail(good: bytes, cut: int) -> None:
    events, damage = split(good[:-cut])
    assert events == [0, 1, 2, 3]
    assert damage == [LogDamage(4 * SIZE, SIZE - cut, 4, tail=True)]
    assert "after event 4" in str(damage[0])


def test_given_junk_between_events_when_read_then_it_is_skipped_and_reported(good: bytes) -> None:
    events, damage = split(good[: 2 * SIZE] + b"junk" * 9 + good[2 * SIZE :])
    assert events == [0, 1, 2, 3, 4]
    assert damage == [LogDamage(2 * SIZE, 36, 2, tail=False)]
    assert "36 bytes after event 2" in str(damage[0])


@pytest.mark.parametrize(
    "lengths", [(2, -5), (900, 20), (0, 20), (-1, 20), (2, 0x7FFFFFFF), (2, 71), (2, 119), (2, 19)]
)
def test_given_overwritten_lengths_when_read_then_only_that_event_is_lost(
    good: bytes, lengths: tuple[int, int]
) -> None:
    head = struct.pack(">Iqqii", 0xEDA1DA01, 2, 1002, *lengths)
    events, damage = split(good[: 2 * SIZE] + head + good[2 * SIZE + 28 :])
    if lengths == (2, 19):  # a byte too few: the event is accepted, the excess byte reported
        assert events == [0, 1, 2, 3, 4]
        assert damage == [LogDamage(3 * SIZE - 1, 1, 3, tail=False)]
    else:
        assert events == [0, 1, 3, 4]
        assert damage == [LogDamage(2 * SIZE, SIZE, 2, tail=False)]


def test_given_a_message_that_holds_the_sync_word_when_read_then_it_is_whole(tmp_path: Path) -> None:
    log = lcm.EventLog(str(tmp_path / "a.lcm"), "w")
    inner = write_log(tmp_path / "b.lcm", 2)
    for number in range(3):
        log.write_event(1000 + number, "LOGS", inner)
    log.close()
    events, damage = split((tmp_path / "a.lcm").read_bytes())
    assert events == [0, 1, 2]
    assert damage == []


def test_given_a_channel_name_that_is_no_text_when_read_then_it_is_damage() -> None:
    head = struct.pack(">Iqqii", 0xEDA1DA01, 0, 1, 2, 1)
    assert list(scan(head + b"\xff\xfeA")) == [LogDamage(0, 31, 0, tail=True)]


@pytest.mark.parametrize(
    "content", [os.urandom(200_000), b"#ROSBAG V2.0\n", b"\x00" * 1000, b"\xed\xa1\xda\x01" * 5000]
)
def test_given_a_file_that_is_no_log_when_opened_then_a_clear_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "junk.lcm"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"junk\.lcm: not an LCM event log"), LogFile(path):
        pass


def test_given_an_empty_file_when_opened_then_the_error_names_it(tmp_path: Path) -> None:
    path = tmp_path / "empty.lcm"
    path.touch()
    with pytest.raises(RecordingError, match="is empty"), LogFile(path):
        pass


def test_given_a_torn_log_when_read_then_only_a_tail_is_not_torn(tmp_path: Path, good: bytes) -> None:
    for data, torn in ((good[:-3], False), (b"x" + good, True), (good, False)):
        path = tmp_path / "log.lcm"
        path.write_bytes(data)
        with LogFile(path) as log:
            list(log)
        assert log.is_corrupt is torn
