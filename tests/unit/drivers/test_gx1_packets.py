"""Replies, requests and scales of the 3DM-GX1."""

from __future__ import annotations

import math

import pytest
from support_gx1 import DOCUMENTED_REPLIES

from modelserver.transforms import so3
from msdrivers.devices import gx1 as requests
from msdrivers.devices import gx1 as scaling
from msdrivers.devices.gx1 import LENGTHS, MEASUREMENTS, Gx1Packet, Gx1Stream


def only(data: bytes) -> Gx1Packet:
    (packet,) = Gx1Stream().feed(data)
    return packet


def test_given_the_worked_euler_vectors_when_decoded_then_every_number_is_the_sheets():
    packet = only(DOCUMENTED_REPLIES[0x31])
    assert packet.field("euler") == (182, -364, 16384)
    roll, pitch, yaw = so3.to_rpy(scaling.orientation_from_euler(packet.field("euler")))
    assert [math.degrees(angle) for angle in (roll, pitch, yaw)] == pytest.approx([0.99976, -1.99951, 90.0], abs=1e-5)
    force = scaling.vector_from_words(packet.field("acceleration"), 7000)
    assert force == pytest.approx((0.0, 0.0, -0.99997), abs=1e-5)
    rate = scaling.vector_from_words(packet.field("rate"), 8500)
    assert rate == pytest.approx((0.010117, -0.010117, 0.100128), abs=1e-6)
    assert packet.ticks == 1000


def test_given_the_worked_temperature_when_decoded_then_it_is_near_23_degrees():
    packet = only(DOCUMENTED_REPLIES[0x07])
    assert packet.ticks == 1000
    assert scaling.temperature_from_word(packet.unsigned) == pytest.approx(23.0, abs=0.01)


def test_given_the_worked_stabilized_euler_when_decoded_then_all_are_45_degrees_at_the_last_tick():
    packet = only(DOCUMENTED_REPLIES[0x0E])
    assert packet.words == (8192, 8192, 8192)
    assert packet.ticks == 65535
    angles = so3.to_rpy(scaling.orientation_from_euler(packet.words))
    assert angles == pytest.approx([math.pi / 4] * 3)


@pytest.mark.parametrize("raw", DOCUMENTED_REPLIES.values(), ids=map(hex, DOCUMENTED_REPLIES))
def test_given_a_worked_reply_when_decoded_and_written_then_the_bytes_are_the_same(raw):
    assert only(raw).to_bytes() == raw


def test_given_the_table_of_replies_then_their_lengths_are_the_sheets():
    assert LENGTHS == {
        0x02: 23, 0x03: 23, 0x07: 7, 0x0C: 31, 0x0D: 11, 0x0E: 11, 0x10: 7, 0x28: 7,
        0x31: 23, 0xF0: 5, 0xF1: 5,
    }  # fmt: skip


def test_given_a_quaternion_and_vectors_then_the_fields_stand_where_the_sheet_has_them():
    packet = only(Gx1Packet(0x0C, tuple(range(1, 14)), 77).to_bytes())
    raw = packet.to_bytes()
    assert packet.field("quaternion") == (1, 2, 3, 4)
    assert int.from_bytes(raw[9:11], "big") == packet.field("field")[0] == 5
    assert int.from_bytes(raw[15:17], "big") == packet.field("acceleration")[0] == 8
    assert int.from_bytes(raw[21:23], "big") == packet.field("rate")[0] == 11
    assert int.from_bytes(raw[27:29], "big") == packet.ticks == 77


def test_given_requests_then_their_bytes_are_the_sheets():
    assert bytes.fromhex("100000") == requests.STOP
    assert requests.make_stream(0x31) == bytes.fromhex("100031")
    assert requests.make_read_eeprom(130) == bytes.fromhex("280082")


def test_given_both_documented_timers_then_the_tick_is_as_documented():
    assert scaling.tick_from_timer_words((16, 16, 256, 1)) == pytest.approx(6.5536e-3)
    assert scaling.tick_from_timer_words((4, 10, 250, 10)) == pytest.approx(10e-3)


def test_given_vectors_beyond_the_range_when_written_then_they_saturate():
    words = scaling.vector_to_words((1e6, -1e6, 1.0), 8500)
    assert words == (32767, -32768, 3855)
    assert scaling.is_saturated(words)
    assert not scaling.is_saturated((32766, 0, -32767))


def test_given_a_version_word_then_its_text_is_the_sheets():
    assert scaling.format_version(3102) == "3.1.02"


def test_given_measurements_then_all_have_ticks():
    assert all(Gx1Packet(command, (0,) * ((LENGTHS[command] - 5) // 2), 1).to_bytes() for command in MEASUREMENTS)
