"""Replies of the 3DM-GX1 out of good and bad bytes."""

from __future__ import annotations

import math
import random
import tracemalloc

import pytest
from support_gx1 import DOCUMENTED_REPLIES

from msdrivers.devices.gx1 import MEASUREMENTS, Gx1Packet, Gx1Stream

EULER_VECTORS, TEMPERATURE = DOCUMENTED_REPLIES[0x31], DOCUMENTED_REPLIES[0x07]


def stream(count: int, first_tick: int = 0) -> list[bytes]:
    return [Gx1Packet(0x31, (k, 2, 3, 4, 5, 6, 7, 8, 9), first_tick + k).to_bytes() for k in range(count)]


def test_given_a_reply_that_nobody_asked_for_then_it_does_not_count():
    parser = Gx1Stream()
    parser.set_commands(0x31)
    assert parser.feed(TEMPERATURE) == []
    assert parser.counts["skipped"] == len(TEMPERATURE)


def test_given_a_poll_between_streamed_replies_then_all_come_in_order():
    parser = Gx1Stream()
    parser.set_commands(0x31, 0x07)
    found = parser.feed(EULER_VECTORS + TEMPERATURE + EULER_VECTORS)
    assert [packet.command for packet in found] == [0x31, 0x07, 0x31]
    assert not parser.counts["skipped"]


def test_given_a_corrupt_reply_then_the_one_behind_it_is_not_lost():
    parser = Gx1Stream()
    parser.set_commands(0x31)
    corrupt = bytearray(EULER_VECTORS)
    corrupt[5] ^= 1
    assert len(parser.feed(bytes(corrupt) + EULER_VECTORS)) == 1
    assert parser.counts["rejected.checksum"] == 1
    assert parser.counts["skipped"] == len(corrupt)


def test_given_a_false_first_byte_right_before_a_reply_then_the_reply_is_found():
    parser = Gx1Stream()
    parser.set_commands(0x31)
    assert len(parser.feed(b"\x31" + EULER_VECTORS)) == 1
    assert parser.counts["skipped"] == 1


def test_given_a_stream_cut_at_every_place_then_what_is_whole_comes():
    raw = b"".join(stream(3))
    for cut in range(len(raw)):
        parser = Gx1Stream()
        parser.set_commands(0x31)
        whole = len(raw[cut:]) // len(EULER_VECTORS)
        assert len(parser.feed(raw[cut:])) == whole


def test_given_bytes_one_by_one_then_the_replies_are_those_of_the_whole():
    raw = b"\x31\x07" + b"".join(stream(20)) + b"\x31\x31\x10" + b"".join(stream(5, 40))
    whole, single = Gx1Stream(), Gx1Stream()
    for parser in (whole, single):
        parser.set_commands(0x31, 0x07)
    found = whole.feed(raw)
    assert len(found) == 25
    assert [packet for k in range(len(raw)) for packet in single.feed(raw[k : k + 1])] == found
    assert single.counts == whole.counts


@pytest.mark.parametrize("seed", range(20))
def test_given_noise_before_a_good_stream_then_it_is_followed_within_three_messages(seed):
    rng = random.Random(seed)
    parser = Gx1Stream()
    parser.set_commands(*MEASUREMENTS, 0x07)
    parser.feed(rng.randbytes(rng.randrange(200)) + bytes(rng.choices(sorted(MEASUREMENTS), k=rng.randrange(1, 40))))
    found = parser.feed(b"".join(stream(10, 500)))
    ticks = [packet.ticks for packet in found if packet.command == 0x31]
    assert ticks[-8:] == list(range(502, 510))


def test_given_three_million_random_bytes_then_no_more_pass_than_the_checksum_lets_through():
    rng = random.Random(7)
    parser = Gx1Stream()
    parser.set_commands(*MEASUREMENTS)
    found = sum(len(parser.feed(rng.randbytes(50_000))) for _ in range(60))
    expected = 3e6 * len(MEASUREMENTS) / 256 / 65_536
    assert found <= expected + 4 * math.sqrt(expected) + 1


def test_given_random_bytes_for_long_then_memory_stays_flat():
    rng = random.Random(8)
    parser = Gx1Stream()
    parser.set_commands(*MEASUREMENTS)
    parser.feed(rng.randbytes(20_000))
    tracemalloc.start()
    try:
        parser.feed(rng.randbytes(20_000))
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(10):
            parser.feed(rng.randbytes(20_000))
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    # the counters' numbers grow, and no more
    assert grown < 2000


def test_given_nothing_that_was_asked_for_then_every_byte_is_skipped():
    parser = Gx1Stream()
    parser.set_commands()
    data = random.Random(1).randbytes(10_000)
    parser.feed(data)
    assert parser.counts == {"skipped": len(data) - data.count(b"\r") - data.count(b"\n")}


def test_given_clear_then_bytes_that_waited_are_skipped():
    parser = Gx1Stream()
    parser.set_commands(0x31)
    parser.feed(EULER_VECTORS[:-1])
    parser.clear()
    assert parser.feed(EULER_VECTORS[-1:]) == []
    assert parser.counts["skipped"] == len(EULER_VECTORS)
