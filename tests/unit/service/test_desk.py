"""Who is served next: turns, budgets, bounds, and what is told of those who ask too much."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.service.requests.desk import HELD, IDLE_NS, REFUSALS_TOLD, SWEEP_NS, Desk, DeskLimits, Lane, Waiting
from modelserver.service.requests.reception import client_of
from modelserver.wire.packed import text

MS = 1_000_000
S = 1_000 * MS


def item(number: int) -> Waiting:
    return Waiting("CHANNEL", "type", str(number).encode())


def ask(desk: Desk, client: bytes, number: int = 0, now_ns: int = 0) -> bool:
    """Have a client ask; return whether nobody was refused for it."""
    refused = desk.queue(desk.lane(client, now_ns), item(number))
    if refused is not None:
        desk.refuse(refused[0])
    return refused is None


def served(desk: Desk, now_ns: int = 0) -> list[int]:
    found = []
    while (each := desk.next(now_ns)) is not None:
        found.append(int(each.data))
    return found


def test_given_several_clients_then_they_take_turns_and_each_is_served_in_its_order() -> None:
    desk = Desk(DeskLimits(), 0)
    for number in range(5):
        ask(desk, b"a", number)
    ask(desk, b"b", 10)
    ask(desk, b"c", 20)
    ask(desk, b"b", 11)
    assert served(desk) == [0, 10, 20, 1, 11, 2, 3, 4]
    assert desk.waiting == 0


def test_given_a_full_desk_then_who_has_the_most_gives_way_to_others() -> None:
    desk = Desk(DeskLimits(queued=10), 0)
    assert [ask(desk, b"flood", n) for n in range(12)] == [True] * 10 + [False] * 2
    assert [ask(desk, b"polite", 100 + n) for n in range(3)] == [False] * 3  # the flood's are refused for them
    found = served(desk)
    assert [n for n in found if n >= 100] == [100, 101, 102]
    assert [n for n in found if n < 100] == list(range(7))


@given(st.lists(st.sampled_from([b"a", b"b", b"c", b"d", b""]), max_size=200), st.integers(1, 20))
def test_given_any_requests_then_no_more_wait_than_may_and_each_is_served_or_refused_once(
    clients: list[bytes], queued: int
) -> None:
    desk = Desk(DeskLimits(queued=queued), 0)
    refused = []
    for number, client in enumerate(clients):
        out = desk.queue(desk.lane(client, 0), item(number))
        if out is not None:
            refused.append(int(out[1].data))
        assert desk.waiting <= queued
    found = served(desk)
    assert sorted(found + refused) == list(range(len(clients)))
    by_client: dict[bytes, list[int]] = {}
    for number in found:
        by_client.setdefault(clients[number], []).append(number)
    assert all(numbers == sorted(numbers) for numbers in by_client.values())


def test_given_no_time_to_spare_then_each_client_has_what_it_is_sure_of() -> None:
    desk = Desk(DeskLimits(client_hz=100.0, share=0.1), 0)
    desk.spent(1.0, 0)
    got = Counter[str]()
    for step in range(10_000):
        now = step * MS
        desk.spent(0.001, now)  # all the time goes into requests
        for _ in range(10):
            ask(desk, b"flood", 0, now)
        if step % 100 == 0:
            ask(desk, b"polite", 1, now)
        while (each := desk.next(now)) is not None:
            got["polite" if each.data == b"1" else "flood"] += 1
    # ten seconds: a hundred a second, and what may be asked at once at the begin
    assert got["flood"] == pytest.approx(1000, abs=60)
    assert got["polite"] == 100
    assert desk.waiting <= HELD


def test_given_time_to_spare_then_a_client_is_answered_beyond_what_it_is_sure_of() -> None:
    desk = Desk(DeskLimits(client_hz=1.0), 0)
    lane = desk.lane(b"a", 0)
    assert all(desk.grants(lane, 0) for _ in range(1000))
    desk.spent(1.0, 0)
    assert desk.grants(lane, 0)
    assert not desk.grants(lane, 0)
    # one that asks for its next only after the reply waits for it, and is not refused
    assert ask(desk, b"a")
    assert served(desk) == []
    assert served(desk, 2 * S) == [0]


def test_given_ever_new_names_then_the_clients_that_were_there_keep_their_turn() -> None:
    desk = Desk(DeskLimits(queued=50, clients=8), 0)
    assert ask(desk, b"polite", 0)
    for number in range(10_000):
        ask(desk, str(number).encode(), -1)
    assert len(desk._lanes) == 8
    ask(desk, b"polite", 1)
    found = served(desk)
    assert [n for n in found if n >= 0] == [0, 1]
    assert found.index(1) <= 9 + 9
    assert len(found) == 50


def test_given_clients_that_are_gone_then_others_take_their_places() -> None:
    desk = Desk(DeskLimits(clients=2), 0)
    a, b = desk.lane(b"a", 0), desk.lane(b"b", 0)
    other = desk.lane(b"c", 0)
    assert other not in (a, b)
    assert desk.lane(b"d", IDLE_NS) is other
    late = desk.lane(b"d", IDLE_NS + SWEEP_NS + 1)
    assert late is not other
    assert desk.lane(b"a", IDLE_NS + SWEEP_NS + 1) is not a


def test_given_refusals_then_they_are_told_up_to_a_bound_and_named_once_a_second() -> None:
    desk = Desk(DeskLimits(queued=1), 0)
    lanes: dict[bytes, Lane] = {}
    for name, count in ((b"REPLY_A", 9000), (b"REPLY_B", 20), (b"\x1b[31m\n" * 3, 10), (b"REPLY_C", 5), (b"", 1)):
        lanes[name] = desk.lane(name, 0)
        told = sum(desk.refuse(lanes[name]) for _ in range(count))
        assert told == min(count, REFUSALS_TOLD)
        for _ in range(count - 1):
            desk.lane(name, 0)
    assert desk.report(S - 1) is None
    text_ = desk.report(S)
    assert text_ is not None
    assert text_.startswith("client REPLY_A asks 9,000/s; 9,000/s refused; client REPLY_B asks 20/s")
    assert text_.endswith("and 2 more")
    assert text_.isprintable()
    assert desk.report(2 * S) == ""
    assert desk.refuse(lanes[b"REPLY_A"])


@pytest.mark.parametrize("name", ["REPLY_A", "R", "x" * 63])
def test_given_a_request_then_its_reply_channel_is_its_client(name: str) -> None:
    assert client_of(bytes(16) + text(name) + b"rest") == name.encode()
    assert client_of(bytes(16) + text(name)) == name.encode()


@pytest.mark.parametrize(
    "data", [b"", bytes(16), bytes(19), bytes(40), bytes(16) + b"\xff" * 8, bytes(16) + text("x" * 70) + b"rest"]
)
def test_given_bytes_without_a_reply_channel_then_they_have_one_client_together(data: bytes) -> None:
    assert client_of(data) == b""


def test_given_all_cuts_of_a_request_then_nothing_is_raised() -> None:
    whole = bytes(16) + text("REPLY_A") + b"rest"
    for start, end in itertools.combinations(range(len(whole)), 2):
        client_of(whole[start:end])
