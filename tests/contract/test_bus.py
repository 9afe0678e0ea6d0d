"""Contract of `Bus`, for LCM and for the fake bus."""

from __future__ import annotations

import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator

import lcm
import pytest
from support_lcm import TIMEOUT_S, reserved_url

from modelserver.errors import BusError
from modelserver.server.bus import SENSOR_QUEUE_BYTES, Bus, FakeBus, Inbox, LcmBus, ReceiverInbox
from modelserver.server.clock import Clock, FakeClock
from modelserver.wire.channels import CHANNELS
from modelserver.wire.provider import MAX_QUEUED, MESSAGE_OVERHEAD_BYTES, Message, Sender

ODD_CHANNELS = ["A.B", "A*", "A+", "(A)", "[A]", "A|B", "A-B", "^A$", "A{2}", "A?", "A\\B", "A/B", "#A", "A B", "."]


class Rig:
    """A bus and the clock of its waits."""

    def __init__(self, bus: Bus, clock: Clock):
        self.bus = bus
        self.clock = clock
        self.received: list[tuple[str, bytes]] = []

    def subscribe(self, channel: str, inbox: Inbox | None = None) -> None:
        (inbox or self.bus.sensors).subscribe(channel, lambda name, data, sender: self.received.append((name, data)))

    def drain_until(self, done: Callable[[], bool], inbox: Inbox | None = None) -> bool:
        """Drain and wait until `done` or a timeout."""
        inbox = inbox or self.bus.sensors
        end = time.monotonic() + TIMEOUT_S
        while not done():
            if time.monotonic() > end:
                return False
            if not inbox.drain(1000):
                self.bus.wait(0.05)
        return True

    def receive_all(self) -> list[tuple[str, bytes]]:
        """Return all received messages until a last one has arrived."""
        self.bus.publish("LAST", b"")
        assert self.drain_until(lambda: ("LAST", b"") in self.received)
        self.received.remove(("LAST", b""))
        return self.received


@pytest.fixture(params=["fake", "udp", "lcm"])
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    if request.param == "fake":
        clock = FakeClock()
        rig = Rig(FakeBus(clock), clock)
        rig.subscribe("LAST")
        yield rig
        return
    with reserved_url() as url:
        if request.param == "lcm":
            # as for other providers
            monkeypatch.setattr("modelserver.wire.provider.parse_udp_address", lambda url: None)
        bus = LcmBus(url)
        rig = Rig(bus, Clock())
        rig.subscribe("LAST")
        yield rig
        bus.close()


def test_given_a_message_then_its_subscribers_receive_channel_and_bytes(rig: Rig) -> None:
    rig.subscribe("A")
    rig.bus.publish("A", b"\x00\xffdata")
    assert rig.receive_all() == [("A", b"\x00\xffdata")]


def test_given_an_empty_and_a_large_message_then_both_come_whole(rig: Rig) -> None:
    large = bytes(range(256)) * 1000
    rig.subscribe("A")
    rig.bus.publish("A", b"")
    rig.bus.publish("A", large)
    assert rig.receive_all() == [("A", b""), ("A", large)]


def test_given_names_that_contain_a_channel_then_only_the_exact_one_is_received(rig: Rig) -> None:
    rig.subscribe("GPS")
    for name in ("GPS2", "XGPS", "GP", "gps", "GPS ", " GPS", "GPS\n", "\nGPS", "G.S", "GPS|A"):
        rig.bus.publish(name, b"wrong")
    rig.bus.publish("GPS", b"right")
    assert rig.receive_all() == [("GPS", b"right")]


@pytest.mark.parametrize("channel", ODD_CHANNELS)
def test_given_a_channel_of_characters_that_patterns_use_then_it_is_matched_literally(rig: Rig, channel: str) -> None:
    rig.subscribe(channel)
    others = [name for name in ("A", "AB", "AA", "B", "A1B", "AxB", *ODD_CHANNELS) if name != channel]
    for name in others:
        rig.bus.publish(name, b"wrong")
    rig.bus.publish(channel, b"right")
    assert rig.receive_all() == [(channel, b"right")]


def test_given_many_messages_then_their_order_is_preserved_across_channels(rig: Rig) -> None:
    rig.subscribe("A")
    rig.subscribe("B")
    sent = [("AB"[n % 3 == 0], str(n).encode()) for n in range(500)]
    for channel, data in sent:
        rig.bus.publish(channel, data)
    assert rig.receive_all() == sent


def test_given_a_limit_then_a_drain_handles_no_more_and_returns_how_many(rig: Rig) -> None:
    rig.subscribe("A")
    for n in range(10):
        rig.bus.publish("A", bytes([n]))
    counts: list[int] = []
    end = time.monotonic() + TIMEOUT_S
    while sum(counts) < 10 and time.monotonic() < end:
        before = len(rig.received)
        counts.append(rig.bus.sensors.drain(3))
        assert counts[-1] == len(rig.received) - before <= 3
        if not counts[-1]:
            rig.bus.wait(0.05)
    assert sum(counts) == 10
    assert rig.bus.sensors.drain(3) == 0
    assert rig.bus.sensors.drain(0) == 0


def test_given_nothing_sent_then_a_drain_returns_at_once(rig: Rig) -> None:
    rig.subscribe("A")
    begin = time.monotonic()
    assert rig.bus.sensors.drain(10) == 0
    assert rig.bus.requests.drain(10) == 0
    assert time.monotonic() - begin < 5.0


def test_given_handlers_then_they_run_within_drain_only(rig: Rig) -> None:
    rig.subscribe("A")
    rig.bus.publish("A", b"1")
    rig.bus.wait(0.2)
    assert rig.received == []
    assert rig.drain_until(lambda: bool(rig.received))


def test_given_both_inboxes_then_each_has_its_own_queue(rig: Rig) -> None:
    rig.subscribe("A", rig.bus.sensors)
    rig.bus.requests.subscribe("A", lambda name, data, sender: rig.received.append(("request", data)))
    rig.bus.publish("A", b"1")
    assert rig.drain_until(lambda: rig.received == [("A", b"1")])
    assert rig.drain_until(lambda: rig.received == [("A", b"1"), ("request", b"1")], rig.bus.requests)


def test_given_two_handlers_on_a_channel_then_both_receive_it(rig: Rig) -> None:
    rig.subscribe("A")
    rig.subscribe("A")
    rig.bus.publish("A", b"1")
    assert rig.receive_all() == [("A", b"1"), ("A", b"1")]


def test_given_a_handler_that_publishes_then_its_message_is_received_too(rig: Rig) -> None:
    rig.subscribe("ECHO")
    echoed = []

    def echo(channel: str, data: bytes, sender: Sender) -> None:
        rig.bus.publish("ECHO", data)
        echoed.append(data)

    rig.bus.requests.subscribe("A", echo)
    rig.bus.sensors.subscribe("A", echo)
    rig.bus.publish("A", b"1")
    assert rig.drain_until(lambda: len(echoed) == 1)
    assert rig.drain_until(lambda: len(echoed) == 2, rig.bus.requests)
    assert rig.drain_until(lambda: len(rig.received) == 2)
    assert rig.received == [("ECHO", b"1")] * 2


def test_given_a_handler_that_raises_then_the_messages_after_it_are_not_lost(rig: Rig) -> None:
    def failing(channel: str, data: bytes, sender: Sender) -> None:
        if data == b"1":
            raise RuntimeError("on purpose")
        rig.received.append((channel, data))

    rig.bus.sensors.subscribe("A", failing)
    for data in (b"0", b"1", b"2"):
        rig.bus.publish("A", data)
    with pytest.raises(RuntimeError, match="on purpose"):
        rig.drain_until(lambda: len(rig.received) == 2)
    assert rig.drain_until(lambda: rig.received == [("A", b"0"), ("A", b"2")])


def test_given_nothing_arrives_then_wait_returns_at_its_deadline(rig: Rig) -> None:
    for seconds in (0.0, 0.0004, 0.009, 0.02, 0.0305):
        # a rest of earlier messages may end one wait early
        rig.bus.sensors.drain(100)
        rig.bus.requests.drain(100)
        before = rig.clock.monotonic_ns()
        rig.bus.wait(seconds)
        waited = (rig.clock.monotonic_ns() - before) * 1e-9
        assert seconds - 1e-6 <= waited < seconds + 5.0


@pytest.mark.parametrize("inbox", ["sensors", "requests"])
def test_given_a_message_for_either_inbox_then_wait_returns_before_its_deadline(rig: Rig, inbox: str) -> None:
    rig.subscribe("A", getattr(rig.bus, inbox))
    rig.bus.publish("A", b"1")
    before = rig.clock.monotonic_ns()
    rig.bus.wait(TIMEOUT_S)
    assert (rig.clock.monotonic_ns() - before) * 1e-9 < TIMEOUT_S / 2
    assert rig.drain_until(lambda: bool(rig.received), getattr(rig.bus, inbox))


def test_given_messages_that_were_left_then_wait_returns_at_once(rig: Rig) -> None:
    rig.subscribe("A")
    for n in range(3):
        rig.bus.publish("A", bytes([n]))
    assert rig.drain_until(lambda: len(rig.received) == 3)
    for n in range(3):
        rig.bus.publish("A", bytes([n]))
    rig.bus.wait(TIMEOUT_S)
    end = time.monotonic() + TIMEOUT_S
    while len(rig.received) < 4 and time.monotonic() < end:
        rig.bus.sensors.drain(1)
    before = rig.clock.monotonic_ns()
    rig.bus.wait(TIMEOUT_S)
    assert (rig.clock.monotonic_ns() - before) * 1e-9 < TIMEOUT_S / 2
    assert rig.drain_until(lambda: len(rig.received) == 6)


def test_given_the_names_of_this_service_then_they_are_plain_and_short_enough_for_lcm_with_the_longest_prefix() -> None:
    assert all(re.fullmatch("[A-Z_]+", channel.name) and len(channel.name) <= 63 - 24 for channel in CHANNELS)


def test_given_a_bus_that_cannot_be_joined_then_the_error_names_what_to_check(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def reject(url: str) -> None:
        raise OSError("no way out")

    monkeypatch.setattr("lcm.LCM", reject)
    url = "udpm://239.1.2.3:7667?ttl=0"
    with pytest.raises(BusError, match=r"sudo ip route replace 239\.1\.2\.3/32 dev lo") as caught:
        LcmBus(url)
    assert url in str(caught.value)
    assert "no way out" in str(caught.value)


# --- queue limits ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rig", ["lcm"], indirect=True)
def test_given_long_messages_that_are_not_handled_then_few_of_them_are_queued(rig: Rig) -> None:
    bus = rig.bus
    assert isinstance(bus, LcmBus)
    taken: list[int] = []
    bus.sensors.subscribe("GPS", lambda channel, data, sender: taken.append(len(data)))
    publisher = lcm.LCM(bus.url)
    long, most = bytes(60_000), SENSOR_QUEUE_BYTES // 60_000
    end = time.monotonic() + TIMEOUT_S
    while len(taken) < 40 and time.monotonic() < end:
        publisher.publish("GPS", long)
        bus.wait(0.01)
        bus.sensors.drain(10)
    taken.clear()
    for _ in range(4 * most):
        publisher.publish("GPS", long)
        # so that none is lost before LCM
        time.sleep(0.0005)
    while bus.sensors.drain(1000):
        pass
    assert most // 4 < len(taken) <= MAX_QUEUED


class FullReceiver:
    """A receiver with a list of messages that have arrived."""

    fileno = 0

    def __init__(self, messages: list[Message]):
        self.messages = deque(messages)
        self.refused: Counter[bytes] = Counter()

    def subscribe(self, channel: str) -> None: ...

    def receive(self) -> Message | None:
        return self.messages.popleft() if self.messages else None

    def close(self) -> None: ...


def test_given_more_messages_than_a_drain_handles_then_the_rest_is_queued_in_order() -> None:
    receiver = FullReceiver([(b"A", bytes([n]), None) for n in range(10)])
    inbox = ReceiverInbox(receiver, 4 << 20)
    received: list[int] = []
    inbox.subscribe("A", lambda channel, data, sender: received.append(data[0]))
    assert inbox.drain(3) == 3
    assert (received, len(receiver.messages), inbox.is_queueing) == ([0, 1, 2], 0, True)
    receiver.messages.append((b"A", bytes([10]), None))
    assert inbox.drain(100) == 8
    assert (received, inbox.is_queueing) == (list(range(11)), False)


def test_given_a_flood_that_is_not_handled_then_its_channel_queues_so_many_bytes_and_displaces_no_other() -> None:
    flood: list[Message] = [(b"A", bytes(60_000), None)] * 200
    receiver = FullReceiver([*flood, (b"B", b"1", None)])
    inbox = ReceiverInbox(receiver, SENSOR_QUEUE_BYTES)
    received: list[tuple[str, int]] = []
    for channel in "AB":
        inbox.subscribe(channel, lambda name, data, sender: received.append((name, len(data))))
    assert inbox.drain(1) == 1
    assert not receiver.messages
    while inbox.drain(1000):
        pass
    assert received == [("A", 60_000)] * (1 + SENSOR_QUEUE_BYTES // (60_000 + MESSAGE_OVERHEAD_BYTES)) + [("B", 1)]


def test_given_an_inbox_without_a_queue_then_what_a_drain_leaves_stays_in_the_receiver() -> None:
    receiver = FullReceiver([(b"A", b"1", None)] * 5)
    inbox = ReceiverInbox(receiver)
    inbox.subscribe("A", lambda *_: None)
    assert inbox.drain(2) == 2
    assert (len(receiver.messages), inbox.is_queueing) == (3, False)
