"""The socket filter passes what it should, and never touches a socket that may be another's."""

from __future__ import annotations

import socket
from collections.abc import Sequence

import lcm
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support_lcm import reserved_url, wait_until

from modelserver.wire import receive_filter
from modelserver.wire.receive_filter import make_program, open_receiver

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
    program = make_program(channels)
    assert all(passes(program, make_packet(each, data)) for each in channels)
    assert passes(program, make_packet(other, data)) == (other in channels)


def test_given_a_fragment_then_it_passes_since_only_the_first_names_the_channel() -> None:
    assert passes(make_program(["A"]), make_packet("\xff" * 30, b"", b"LC03"))


def receive(bus: lcm.LCM, url: str, last: str) -> list[str]:
    """Return the channels of A, B and C that the bus receives when each is sent; `last` is one that it receives."""
    received: list[str] = []
    bus.subscribe(".*", lambda channel, data: received.append(channel))
    sender = lcm.LCM(url)
    for channel in ("A", "B", "C", last):
        sender.publish(channel, b"data")
    assert wait_until(bus, lambda: received.count(last) == 1 + ("ABC".count(last)))
    return received


def test_given_a_filter_then_the_kernel_drops_the_other_channels() -> None:
    with reserved_url() as url:
        bus, filtered = open_receiver(url)
        filtered.pass_only(["A"])
        filtered.pass_only(["B", "LAST"])
        assert receive(bus, url, "LAST") == ["B", "LAST"]
        filtered.close()


def test_given_another_instance_beside_it_then_that_one_receives_all() -> None:
    with reserved_url() as url:
        before, (_, filtered), after = lcm.LCM(url), open_receiver(url), lcm.LCM(url)
        filtered.pass_only(["B"])
        for each in (before, after):
            assert receive(each, url, "LAST") == ["A", "B", "C", "LAST"]
        filtered.close()


def test_given_a_socket_that_another_thread_opens_meanwhile_then_there_is_no_filter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    foreign: list[socket.socket] = []
    find = receive_filter._find_sockets

    def find_and_open() -> dict[int, int]:
        found = find()
        foreign.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        return found

    monkeypatch.setattr(receive_filter, "_find_sockets", find_and_open)
    with reserved_url() as url:
        bus, filtered = open_receiver(url)
        filtered.pass_only(["B"])
        assert receive(bus, url, "LAST") == ["A", "B", "C", "LAST"]
    for each in foreign:
        each.close()


def test_given_more_channels_than_the_kernel_takes_then_all_messages_pass() -> None:
    with reserved_url() as url:
        bus, filtered = open_receiver(url)
        filtered.pass_only(["B"])
        filtered.pass_only([f"CHANNEL_{number}" for number in range(2000)])
        assert receive(bus, url, "LAST") == ["A", "B", "C", "LAST"]
        filtered.close()


def test_given_a_closed_instance_then_no_descriptor_stays_open() -> None:
    with reserved_url() as url:
        before = receive_filter._find_sockets()
        bus, filtered = open_receiver(url)
        assert len(receive_filter._find_sockets()) == len(before) + 3  # to send, to receive, its duplicate
        filtered.close()
        del bus
        assert receive_filter._find_sockets() == before
