"""The journal's bytes: what is written comes back, any LCM tool reads it, and damage is told from the end."""

from __future__ import annotations

import hashlib
from pathlib import Path

import lcm
import pytest

from modelserver.wire.journal import (
    CHANNEL,
    MAGIC,
    Broken,
    End,
    File,
    Head,
    Item,
    JournalRecord,
    RecordKind,
    State,
    batch_written,
    end_written,
    file_written,
    head_written,
    read,
    read_end,
    state_written,
)
from modelserver.wire.kinds import is_of_service

RECORDS = (
    JournalRecord(RecordKind.SAMPLE, 7_000_000_001, 1_700_000_000_000_001, "IMU", b"\x01\x02"),
    JournalRecord(RecordKind.EVENT, 7_000_000_002, 1_700_000_000_000_002, "", b'["Tick", 0.25, 0, 0]'),
    JournalRecord(RecordKind.SAID, 0, 1_700_000_000_000_002, "POSE", b"\x03" * 40),
    JournalRecord(RecordKind.REQUEST, 7_000_000_003, 1_700_000_000_000_003, "PLATFORM_GET_BODY_LIST", b""),
    JournalRecord(RecordKind.SAID, 0, 1_700_000_000_000_003, "REPLY_ME", b"\x04" * 9),
)


def segment(*batches: tuple[JournalRecord, ...]) -> bytes:
    """A whole segment."""
    data = head_written({"format": 1, "run": "x"}, 5) + file_written("a.yaml", b"a\0b", 5) + state_written(b"known", 5)
    data += b"".join(batch_written(number, batch) for number, batch in enumerate(batches))
    return data + end_written(hashlib.sha256(data).digest(), 6)


def records(items: list[Item]) -> list[JournalRecord]:
    return [each._replace(at=0) for each in items if isinstance(each, JournalRecord)]


def test_given_a_segment_when_read_then_everything_comes_back_in_order() -> None:
    found = list(read(segment(RECORDS[:3], RECORDS[3:])))
    assert found[:3] == [Head({"format": 1, "run": "x"}), File("a.yaml", b"a\0b"), State(b"known")]
    assert records(found) == list(RECORDS)
    assert isinstance(found[-1], End)
    assert found[-1].intact
    assert len(found) == 9


def test_given_a_segment_when_read_by_lcm_then_what_was_on_the_bus_stands_there_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "segment.lcm"
    path.write_bytes(segment(RECORDS[:3], RECORDS[3:]))
    log = lcm.EventLog(str(path))
    theirs = [(e.timestamp, e.channel, e.data) for e in log]
    log.close()
    assert [each for each in theirs if each[1] != CHANNEL] == [
        (each.utime, each.channel, each.data) for each in RECORDS if each.channel
    ]
    assert all(is_of_service(data) for _, channel, data in theirs if channel == CHANNEL)
    # each record is found at the place that is told of it
    data = path.read_bytes()
    for each in read(data):
        if isinstance(each, JournalRecord) and each.kind is not RecordKind.EVENT:
            assert data[each.at + 28 :].startswith(each.channel.encode() + each.data)


@pytest.mark.parametrize("channel", ["", CHANNEL, "Ä", "X" * 64, "\0"], ids=["none", "own", "umlaut", "long", "nul"])
def test_given_a_channel_that_a_log_cannot_hold_when_read_then_the_record_comes_back(channel: str) -> None:
    record = JournalRecord(RecordKind.SAMPLE, 1, 2, channel, MAGIC + bytes(20))
    assert records(list(read(batch_written(0, [record])))) == [record]


def test_given_a_time_before_1970_when_read_then_the_record_comes_back() -> None:
    record = JournalRecord(RecordKind.SAMPLE, 1, -2, "IMU", b"x")
    assert records(list(read(batch_written(0, [record])))) == [record]


def test_given_a_batch_that_is_missing_when_read_then_what_follows_is_not_taken_for_its_sequel() -> None:
    first, second, third = (batch_written(n, [RECORDS[0]]) for n in range(3))
    found = list(read(first + third))
    assert len(records(found)) == 1
    (broken,) = [each for each in found if isinstance(each, Broken)]
    assert (broken.start, broken.length, broken.tail) == (len(first), len(third), False)
    assert "missing" in broken.why
    # and behind it things go on
    assert len(records(list(read(first + third + batch_written(3, [RECORDS[0]]))))) == 2
    assert [each for each in read(first + second + third) if isinstance(each, Broken)] == []


@pytest.mark.parametrize("tail", [bytes(5000), b"\xff" * 700, b"\xed\xa1\xda\x01" * 50], ids=["zeros", "ones", "words"])
def test_given_a_tail_that_power_left_behind_when_read_then_what_was_sealed_before_comes_back(tail: bytes) -> None:
    batch = batch_written(0, RECORDS)
    *found, last = read(batch + tail)
    assert records(found) == list(RECORDS)
    assert isinstance(last, Broken)
    assert (last.start, last.length, last.tail) == (len(batch), len(tail), True)


def test_given_a_record_that_was_put_between_when_read_then_the_batch_is_refused() -> None:
    from modelserver.wire.eventlog import written

    batch = batch_written(0, RECORDS)
    (broken,) = read(written(0, 1, b"POSE", b"forged") + batch)
    assert isinstance(broken, Broken)
    assert "checksum" in broken.why


def test_given_an_end_that_does_not_fit_when_read_then_the_segment_is_not_intact() -> None:
    found = list(read(batch_written(0, RECORDS) + end_written(bytes(32), 6)))
    assert found[-1] == End(intact=False, digest=bytes(32))


@pytest.mark.parametrize("mac", [b"", bytes(range(32))], ids=["plain", "keyed"])
def test_given_a_segment_then_its_end_is_read_from_its_last_bytes_alone(mac: bytes) -> None:
    data = batch_written(0, RECORDS) + end_written(bytes(31) + b"!", 6, mac)
    assert read_end(data) == End(True, bytes(31) + b"!", mac)
    assert read_end(data[:-1]) is None
    assert read_end(data + b"\0") is None
    assert read_end(b"") is None


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"\xff", b"[" * 100_000])
def test_given_a_head_that_is_none_when_read_then_it_is_told_as_broken(body: bytes) -> None:
    from modelserver.wire.journal import Part, _own

    (broken,) = read(_own(Part.HEAD, 5, body))
    assert isinstance(broken, Broken)
    assert not broken.tail
