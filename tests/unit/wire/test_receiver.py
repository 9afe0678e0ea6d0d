"""Receiving without liblcm's thread: what it sends is received, whatever else arrives."""

from __future__ import annotations

import random
import socket
import struct
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import closing

import lcm
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_lcm import TIMEOUT_S, reserved_url

from modelserver.errors import BusError
from modelserver.wire import provider as module
from modelserver.wire.provider import (
    MAX_IGNORED,
    MAX_PARTIAL,
    MAX_PARTIAL_BYTES,
    FragmentAssembler,
    LcmReceiver,
    Message,
    Receiver,
    Sender,
    UdpAddress,
    UdpReceiver,
    open_receiver,
    parse_udp_address,
    resolve_url,
)


def wait_for(receiver: Receiver) -> tuple[bytes, bytes]:
    """Return the channel and the data of the next message."""
    end = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end:
        message = receiver.receive()
        if message is not None:
            return message[:2]
    raise TimeoutError("no message")


@pytest.fixture(params=[UdpReceiver, LcmReceiver])
def pair(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Receiver, lcm.LCM]]:
    """A receiver of either kind, and a publisher."""
    if request.param is LcmReceiver:
        monkeypatch.setattr(module, "parse_udp_address", lambda url: None)
    with reserved_url() as url, closing(open_receiver(resolve_url(url))) as receiver:
        assert isinstance(receiver, request.param)
        yield receiver, lcm.LCM(resolve_url(url))


@pytest.fixture
def udp_pair() -> Iterator[tuple[UdpReceiver, UdpAddress, lcm.LCM]]:
    """A receiver that is subscribed to A, its address, and a publisher."""
    with reserved_url() as url:
        address = parse_udp_address(url)
        assert address is not None
        with closing(UdpReceiver(address)) as receiver:
            receiver.subscribe("A")
            yield receiver, address, lcm.LCM(url)


def test_given_messages_that_liblcm_sends_then_those_of_the_channels_are_received(
    pair: tuple[Receiver, lcm.LCM],
) -> None:
    receiver, publisher = pair
    receiver.subscribe("A")
    receiver.subscribe("LONG")
    assert receiver.receive() is None
    long = random.Random(1).randbytes(700_000)
    for channel, data in (("A", b""), ("OTHER", b"x"), ("LONG", long), ("OTHER", long), ("A", b"\0\xff")):
        publisher.publish(channel, data)
    assert [wait_for(receiver) for _ in range(3)] == [(b"A", b""), (b"LONG", long), (b"A", b"\0\xff")]
    assert receiver.receive() is None


def test_given_no_route_then_the_error_names_what_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def reject(*_: object) -> None:
        raise OSError(19, "No such device")

    monkeypatch.setattr(module, "UdpReceiver", reject)
    with pytest.raises(BusError, match=r"No such device.*sudo ip route replace 239\.1\.2\.3/32 dev lo"):
        open_receiver("udpm://239.1.2.3:7667?ttl=0")


def test_given_a_flood_of_packets_without_a_message_then_receive_returns_and_the_message_behind_is_received(
    udp_pair: tuple[UdpReceiver, UdpAddress, lcm.LCM],
) -> None:
    receiver, address, publisher = udp_pair
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for packet in (b"LC03", b"LC03" + bytes(30), b"LC02\0\0\0\1A", b"no LCM", b"") * MAX_IGNORED:
            sender.sendto(packet, (address.group, address.port))
        publisher.publish("A", b"data")
        assert receiver.receive() is None
        assert wait_for(receiver) == (b"A", b"data")


@pytest.fixture
def no_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "set_channel_filter", lambda receiving, channels: None)


@pytest.mark.usefixtures("no_filter")
def test_given_a_kernel_without_the_filter_then_messages_of_other_channels_are_not_received(
    udp_pair: tuple[UdpReceiver, UdpAddress, lcm.LCM],
) -> None:
    receiver, _, publisher = udp_pair
    for channel in ("OTHER", "AB", "A"):
        publisher.publish(channel, b"data")
    assert wait_for(receiver) == (b"A", b"data")


# --- fragments ------------------------------------------------------------------------------------------------


def split(channel: bytes, data: bytes, sequence: int = 1, length: int = 4) -> list[bytes]:
    """Return the fragments of a message."""
    starts = range(0, max(len(data), 1), length)
    return [
        struct.pack(">4sIIIHH", b"LC03", sequence, len(data), start, number, len(starts))
        + (b"" if number else channel + b"\0")
        + data[start : start + length]
        for number, start in enumerate(starts)
    ]


ONE = ("10.0.0.1", 1)


def make_assembler() -> FragmentAssembler:
    assembler = FragmentAssembler()
    assembler.channels = {b"A"}
    return assembler


@given(st.binary(max_size=50), st.binary(max_size=50), st.randoms(use_true_random=False))
def test_given_fragments_of_two_senders_then_both_messages_are_assembled(
    first: bytes, second: bytes, order: random.Random
) -> None:
    assembler = make_assembler()
    a, b = ("10.0.0.1", 1), ("10.0.0.1", 2)
    waiting = {a: split(b"A", first), b: split(b"A", second)}
    found: dict[Sender, Message] = {}
    while any(waiting.values()):
        sender = order.choice([each for each in waiting if waiting[each]])
        message = assembler.add(sender, waiting[sender].pop(0))
        if message is not None:
            found[sender] = message
    assert found == {a: (b"A", first, a), b: (b"A", second, b)}


def test_given_a_lost_fragment_then_only_its_message_is_lost() -> None:
    assembler = make_assembler()
    lost = [split(b"A", b"12345678", 1)[0], split(b"A", b"12345678", 2)[1]]
    assert [assembler.add(ONE, each) for each in (*lost, *split(b"A", b"abcdefgh", 3))] == [
        None,
        None,
        None,
        (b"A", b"abcdefgh", ONE),
    ]


def test_given_fragments_of_another_channel_then_none_is_assembled() -> None:
    assembler = make_assembler()
    assert [assembler.add(ONE, each) for each in split(b"B", b"12345678")] == [None, None]


@given(st.lists(st.binary(max_size=30).map(lambda data: b"LC03" + data) | st.sampled_from(split(b"A", b"12345678"))))
def test_given_any_fragments_then_each_message_has_the_length_in_its_header(packets: list[bytes]) -> None:
    assembler = make_assembler()
    for packet in packets:
        message = assembler.add(ONE, packet)
        assert message is None or len(message[1]) == int.from_bytes(packet[8:12], "big")


def test_given_the_beginnings_of_many_long_messages_then_they_take_no_memory_and_a_whole_one_is_received() -> None:
    assembler = make_assembler()
    tracemalloc.start()
    try:
        for port in range(1000):
            head = struct.pack(">4sIIIHH", b"LC03", 1, MAX_PARTIAL_BYTES - 1, 0, 0, 300)
            assert assembler.add(("10.0.0.2", port), head + b"A\0" + bytes(1000)) is None
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()
    assert assembler.partial_bytes <= MAX_PARTIAL * 1000
    *rest, last = [assembler.add(ONE, each) for each in split(b"A", b"12345678")]
    assert (rest, last) == ([None], (b"A", b"12345678", ONE))


def test_given_fragments_of_many_senders_in_turn_then_the_one_that_goes_on_is_received() -> None:
    assembler = make_assembler()
    mine = split(b"A", bytes(100), length=1)
    found = []
    for number, fragment in enumerate(mine):
        found.append(assembler.add(ONE, fragment))
        for port in range(100):
            assembler.add(("10.0.0.2", 100 * number + port), split(b"A", bytes(100), length=50)[0])
    assert found[-1] == (b"A", bytes(100), ONE)


def test_given_received_bytes_beyond_the_limit_then_the_messages_that_waited_longest_are_dropped() -> None:
    assembler = make_assembler()
    for port in range(400):
        assert assembler.add(("10.0.0.2", port), split(b"A", bytes(130_000), length=65_000)[0]) is None
    assert assembler.partial_bytes <= MAX_PARTIAL_BYTES


def test_given_a_message_that_is_too_long_then_it_is_refused_at_its_first_fragment_and_counted() -> None:
    assembler = FragmentAssembler(100)
    assembler.channels = {b"A"}
    assert [assembler.add(ONE, each) for each in split(b"A", bytes(101), length=50)] == [None] * 3
    assert assembler.refused == {b"A": 1}
    assert assembler.add(ONE, split(b"A", bytes(100), 2, length=100)[0]) == (b"A", bytes(100), ONE)


def test_given_a_fragment_twice_in_place_of_another_then_no_message_has_a_hole() -> None:
    assembler = make_assembler()
    first, second, third = split(b"A", b"1234567890AB")
    assert [assembler.add(ONE, each) for each in (first, second, second)] == [None] * 3
    assert assembler.add(ONE, third) == (b"A", b"1234567890AB", ONE)
    # fragments that overlap
    overlapping = third[:12] + (4).to_bytes(4, "big") + third[16:]
    assert [assembler.add(ONE, each) for each in (first, second, overlapping)] == [None] * 3


def test_given_two_programs_on_the_bus_then_each_message_has_its_sender() -> None:
    with reserved_url() as url:
        address = parse_udp_address(url)
        assert address is not None
        with closing(UdpReceiver(address)) as receiver:
            receiver.subscribe("A")
            senders = []
            for publisher in (lcm.LCM(url), lcm.LCM(url)):
                for _ in range(2):
                    publisher.publish("A", b"data")
                    end = time.monotonic() + TIMEOUT_S
                    while (message := receiver.receive()) is None:
                        assert time.monotonic() < end
                    senders.append(message[2])
        assert senders[0] == senders[1] != senders[2] == senders[3]
