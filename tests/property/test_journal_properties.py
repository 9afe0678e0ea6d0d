"""Byte format of the journal: any record survives, and no damage changes one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.wire.journal import CHANNEL, CorruptRegion, JournalRecord, RecordKind, encode_batch, read_segment

CHANNELS = st.one_of(
    st.sampled_from(["IMU", "POSE", "REPLY_1", CHANNEL, ""]), st.text(max_size=70).filter(lambda t: t.isprintable())
)
INT64 = st.integers(-(1 << 63), (1 << 63) - 1)


@st.composite
def a_record(draw: st.DrawFn) -> JournalRecord:
    kind = draw(st.sampled_from(RecordKind))
    is_published = kind is RecordKind.PUBLISHED
    return JournalRecord(
        kind,
        0 if is_published else draw(INT64),
        draw(st.one_of(INT64, st.just(5))),
        draw(CHANNELS),
        draw(st.binary(max_size=60)),
    )


BATCHES = st.lists(st.lists(a_record(), min_size=1, max_size=5), min_size=1, max_size=4)


def back(data: bytes) -> list[JournalRecord]:
    return [each._replace(at=0) for each in read_segment(data) if isinstance(each, JournalRecord)]


@given(BATCHES)
def test_given_any_records_then_they_come_back(batches: list[list[JournalRecord]]) -> None:
    data = b"".join(encode_batch(number, batch) for number, batch in enumerate(batches))
    found = list(read_segment(data))
    assert not [each for each in found if isinstance(each, CorruptRegion)]
    assert back(data) == [each for batch in batches for each in batch]


@pytest.mark.slow
@given(BATCHES)
def test_given_a_cut_at_every_byte_then_the_batches_before_it_come_back(batches: list[list[JournalRecord]]) -> None:
    written = [encode_batch(number, batch) for number, batch in enumerate(batches)]
    data = b"".join(written)
    for cut in range(len(data)):
        whole, end = 0, 0
        while end + len(written[whole]) <= cut:
            end += len(written[whole])
            whole += 1
        assert back(data[:cut]) == [each for batch in batches[:whole] for each in batch]
        if cut > end:
            *_, last = read_segment(data[:cut])
            assert isinstance(last, CorruptRegion)
            assert (last.tail, last.start, last.length) == (True, end, cut - end)


@given(BATCHES, st.data())
def test_given_bytes_that_were_changed_then_no_record_is_changed(
    batches: list[list[JournalRecord]], data: st.DataObject
) -> None:
    written = bytearray(b"".join(encode_batch(number, batch) for number, batch in enumerate(batches)))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(written) - 1))
        written[at] ^= data.draw(st.integers(1, 255))
    originals = [each for batch in batches for each in batch]
    found = back(bytes(written))
    remaining = iter(originals)
    # in order, some missing
    assert all(any(each == other for other in remaining) for each in found)


@given(st.binary(max_size=300))
def test_given_any_bytes_then_nothing_is_raised(data: bytes) -> None:
    assert sum(isinstance(each, JournalRecord) for each in read_segment(data)) == 0
