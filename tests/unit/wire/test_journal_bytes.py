"""Byte format of the journal: round trip, readable by any LCM tool, damage distinguished from the end."""

from __future__ import annotations

import hashlib
from pathlib import Path

import lcm
import pytest

from modelserver.wire.codec import is_of_service
from modelserver.wire.journal import (
    CHANNEL,
    MAGIC,
    CorruptRegion,
    Item,
    JournalRecord,
    RecordKind,
    SegmentEnd,
    SegmentHead,
    SegmentState,
    encode_batch,
    encode_end,
    encode_head,
    encode_state,
    read_end,
    read_segment,
)

RECORDS = (
    JournalRecord(RecordKind.SAMPLE, 7_000_000_001, 1_700_000_000_000_001, "IMU", b"\x01\x02"),
    JournalRecord(RecordKind.EVENT, 7_000_000_002, 1_700_000_000_000_002, "", b'["Tick", 0.25, 0, 0]'),
    JournalRecord(RecordKind.PUBLISHED, 0, 1_700_000_000_000_002, "POSE", b"\x03" * 40),
    JournalRecord(RecordKind.REQUEST, 7_000_000_003, 1_700_000_000_000_003, "PLATFORM_GET_BODY_LIST", b""),
    JournalRecord(RecordKind.PUBLISHED, 0, 1_700_000_000_000_003, "REPLY_ME", b"\x04" * 9),
)


def segment(*batches: tuple[JournalRecord, ...]) -> bytes:
    """Return the bytes of a segment."""
    data = encode_head({"format": 1, "run": "x"}, 5) + encode_state(b"known", 5)
    data += b"".join(encode_batch(number, batch) for number, batch in enumerate(batches))
    return data + encode_end(hashlib.sha256(data).digest(), 6)


def records(items: list[Item]) -> list[JournalRecord]:
    return [each._replace(at=0) for each in items if isinstance(each, JournalRecord)]


def test_given_a_segment_when_read_then_everything_is_returned_in_order() -> None:
    found = list(read_segment(segment(RECORDS[:3], RECORDS[3:])))
    assert found[:2] == [SegmentHead({"format": 1, "run": "x"}), SegmentState(b"known")]
    assert records(found) == list(RECORDS)
    assert isinstance(found[-1], SegmentEnd)
    assert found[-1].is_intact
    assert len(found) == 8


def test_given_a_segment_when_read_by_lcm_then_the_bus_messages_are_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "segment.lcm"
    path.write_bytes(segment(RECORDS[:3], RECORDS[3:]))
    log = lcm.EventLog(str(path))
    theirs = [(e.timestamp, e.channel, e.data) for e in log]
    log.close()
    assert [each for each in theirs if each[1] != CHANNEL] == [
        (each.utime, each.channel, each.data) for each in RECORDS if each.channel
    ]
    assert all(is_of_service(data) for _, channel, data in theirs if channel == CHANNEL)
    # each record is at its reported offset
    data = path.read_bytes()
    for each in read_segment(data):
        if isinstance(each, JournalRecord) and each.kind is not RecordKind.EVENT:
            assert data[each.at + 28 :].startswith(each.channel.encode() + each.data)


@pytest.mark.parametrize("channel", ["", CHANNEL, "Ä", "X" * 64, "\0"], ids=["none", "own", "umlaut", "long", "nul"])
def test_given_a_channel_that_a_log_cannot_hold_when_read_then_the_record_survives(channel: str) -> None:
    record = JournalRecord(RecordKind.SAMPLE, 1, 2, channel, MAGIC + bytes(20))
    assert records(list(read_segment(encode_batch(0, [record])))) == [record]


def test_given_a_time_before_1970_when_read_then_the_record_survives() -> None:
    record = JournalRecord(RecordKind.SAMPLE, 1, -2, "IMU", b"x")
    assert records(list(read_segment(encode_batch(0, [record])))) == [record]


def test_given_a_batch_that_is_missing_when_read_then_what_follows_is_not_accepted_as_its_continuation() -> None:
    first, second, third = (encode_batch(n, [RECORDS[0]]) for n in range(3))
    found = list(read_segment(first + third))
    assert len(records(found)) == 1
    (broken,) = [each for each in found if isinstance(each, CorruptRegion)]
    assert (broken.start, broken.length, broken.tail) == (len(first), len(third), False)
    assert "missing" in broken.reason
    # the records behind it are read
    assert len(records(list(read_segment(first + third + encode_batch(3, [RECORDS[0]]))))) == 2
    assert [each for each in read_segment(first + second + third) if isinstance(each, CorruptRegion)] == []


@pytest.mark.parametrize("tail", [bytes(5000), b"\xff" * 700, b"\xed\xa1\xda\x01" * 50], ids=["zeros", "ones", "words"])
def test_given_a_tail_of_a_power_cut_when_read_then_the_sealed_records_are_returned(tail: bytes) -> None:
    batch = encode_batch(0, RECORDS)
    *found, last = read_segment(batch + tail)
    assert records(found) == list(RECORDS)
    assert isinstance(last, CorruptRegion)
    assert (last.start, last.length, last.tail) == (len(batch), len(tail), True)


def test_given_an_inserted_record_when_read_then_the_batch_is_rejected() -> None:
    from modelserver.wire.eventlog import encode_event

    batch = encode_batch(0, RECORDS)
    (broken,) = read_segment(encode_event(0, 1, b"POSE", b"forged") + batch)
    assert isinstance(broken, CorruptRegion)
    assert "checksum" in broken.reason


def test_given_an_end_that_does_not_fit_when_read_then_the_segment_is_not_intact() -> None:
    found = list(read_segment(encode_batch(0, RECORDS) + encode_end(bytes(32), 6)))
    assert found[-1] == SegmentEnd(is_intact=False, digest=bytes(32))


@pytest.mark.parametrize("mac", [b"", bytes(range(32))], ids=["plain", "keyed"])
def test_given_a_segment_then_its_end_is_read_from_its_last_bytes_alone(mac: bytes) -> None:
    data = encode_batch(0, RECORDS) + encode_end(bytes(31) + b"!", 6, mac)
    assert read_end(data) == SegmentEnd(True, bytes(31) + b"!", mac)
    assert read_end(data[:-1]) is None
    assert read_end(data + b"\0") is None
    assert read_end(b"") is None


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"\xff", b"[" * 100_000])
def test_given_an_invalid_head_when_read_then_it_is_a_corrupt_region(body: bytes) -> None:
    from modelserver.wire.journal import SectionType, _encode_section

    (broken,) = read_segment(_encode_section(SectionType.HEAD, 5, body))
    assert isinstance(broken, CorruptRegion)
    assert not broken.tail
