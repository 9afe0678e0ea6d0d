"""The socket filter passes the packets of its channels, and no others."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support_lcm import TIMEOUT_S

from modelserver.wire.provider import make_program, set_channel_filter

UDP_HEADER = bytes(8)
NAMES = st.text(st.characters(codec="ascii", exclude_characters="\0"), min_size=1, max_size=20)


def passes(program: Sequence[tuple[int, int, int, int]], packet: bytes) -> bool:
    """Run a program as the kernel does."""
    at = accumulator = 0
    while True:
        code, if_true, if_false, operand = program[at]
        at += 1
        if code in (0x20, 0x30):
            loaded = packet[operand : operand + (4 if code == 0x20 else 1)]
            if len(loaded) < (4 if code == 0x20 else 1):
                return False
            accumulator = int.from_bytes(loaded, "big")
        elif code == 0x15:
            at += if_true if accumulator == operand else if_false
        else:
            assert code == 0x06
            return operand > 0


def make_packet(channel: str, data: bytes, magic: bytes = b"LC02") -> bytes:
    return UDP_HEADER + magic + b"\0\0\0\1" + channel.encode() + b"\0" + data


@given(st.lists(NAMES, max_size=5), NAMES, st.binary(max_size=20))
@example(["ABCDEFGH"], "ABCD", b"EFGH\0")
@example(["AB", "ABCDEFGHIJ"], "AB", b"")
@example(["ABCDE"], "XBCDE", b"")
def test_given_any_channels_then_their_messages_pass_and_no_others(
    channels: list[str], other: str, data: bytes
) -> None:
    program = make_program(map(str.encode, channels))
    assert all(passes(program, make_packet(each, data)) for each in channels)
    assert passes(program, make_packet(other, data)) == (other in channels)


def test_given_packets_of_another_protocol_then_they_are_dropped() -> None:
    program = make_program([b"A"])
    assert not any(passes(program, UDP_HEADER + data) for data in (b"", b"LC", b"LC01\0\0\0\1A\0", b"LC02"))


def test_given_a_fragment_then_it_passes_since_only_the_first_names_the_channel() -> None:
    assert passes(make_program([b"A"]), make_packet("\xff" * 30, b"", b"LC03"))


def receive(receiving: socket.socket, port: int, channels: Sequence[str]) -> list[bytes]:
    """Return the packets that arrive of one message on each channel; the last one must."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for channel in channels:
            sender.sendto(make_packet(channel, b"")[len(UDP_HEADER) :], ("127.0.0.1", port))
    received = []
    while not received or not received[-1].endswith(channels[-1].encode() + b"\0"):
        received.append(receiving.recv(1000))
    return [each[8:-1] for each in received]


@pytest.fixture
def receiving() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(TIMEOUT_S)
        yield opened


def test_given_a_filter_then_the_kernel_drops_the_other_channels(receiving: socket.socket) -> None:
    set_channel_filter(receiving, [b"A"])
    set_channel_filter(receiving, [b"B", b"LAST"])
    assert receive(receiving, receiving.getsockname()[1], ["A", "B", "C", "LAST"]) == [b"B", b"LAST"]


def test_given_more_channels_than_the_kernel_takes_then_all_messages_pass(receiving: socket.socket) -> None:
    set_channel_filter(receiving, [b"B"])
    set_channel_filter(receiving, [b"CHANNEL_%d" % number for number in range(2000)])
    assert receive(receiving, receiving.getsockname()[1], ["A", "B", "LAST"]) == [b"A", b"B", b"LAST"]
