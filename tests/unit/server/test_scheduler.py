"""Request scheduling: round robin, rates, share of time, bounds, report of overloading clients."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.config.vehicle_file import LimitsConfig
from modelserver.messages import GetBodyList, RequestHeader
from modelserver.server.requests import (
    CLIENT_IDLE_NS,
    DEFERRED_PER_CLIENT,
    DEFERRED_TOTAL,
    MAX_QUEUED_BEYOND_RATE,
    MAX_REPLY_BYTES,
    REJECTIONS_PER_CLIENT,
    REJECTIONS_TOTAL,
    SWEEP_NS,
    DeferredRequest,
    QueuedRequest,
    RequestScheduler,
    client_of,
)
from modelserver.wire.fields import pack_text

MS = 1_000_000
S = 1_000 * MS


def item(number: int, client: bytes = b"") -> QueuedRequest:
    return QueuedRequest(client, client, "CHANNEL", "type", str(number).encode())


def send(scheduler: RequestScheduler, client: bytes, number: int = 0, now_ns: int = 0) -> bool:
    """Enqueue a request of a client; return whether none was dropped."""
    dropped = scheduler.enqueue(scheduler.client(client, client, now_ns), item(number, client), now_ns)
    if dropped is not None:
        scheduler.count_dropped(dropped.client)
    return dropped is None


def serve(scheduler: RequestScheduler, now_ns: int = 0) -> list[int]:
    found = []
    while (each := scheduler.next(now_ns)) is not None:
        found.append(int(each.data))
    return found


def make_contended(limits: LimitsConfig) -> RequestScheduler:
    """Make a make_contended scheduler whose share of the time is used up."""
    scheduler = RequestScheduler(limits, 0)
    scheduler.spend(1.0, 0)
    scheduler.set_contended(True, 0)
    return scheduler


def test_given_several_clients_then_they_are_served_round_robin_each_in_its_order() -> None:
    scheduler = RequestScheduler(LimitsConfig(), 0)
    for number in range(5):
        send(scheduler, b"a", number)
    send(scheduler, b"b", 10)
    send(scheduler, b"c", 20)
    send(scheduler, b"b", 11)
    assert serve(scheduler) == [0, 10, 20, 1, 11, 2, 3, 4]
    assert scheduler.queued == 0


def test_given_full_queues_then_the_longest_gives_way_to_others() -> None:
    scheduler = RequestScheduler(LimitsConfig(queued_requests=10), 0)
    assert [send(scheduler, b"flood", n) for n in range(12)] == [True] * 10 + [False] * 2
    # the flood's are dropped for them
    assert [send(scheduler, b"polite", 100 + n) for n in range(3)] == [False] * 3
    found = serve(scheduler)
    assert [n for n in found if n >= 100] == [100, 101, 102]
    assert [n for n in found if n < 100] == list(range(7))


@given(st.lists(st.sampled_from([b"a", b"b", b"c", b"d", b""]), max_size=200), st.integers(1, 20))
def test_given_any_requests_then_the_queues_are_bounded_and_each_is_served_or_dropped_once(
    clients: list[bytes], queued: int
) -> None:
    scheduler = RequestScheduler(LimitsConfig(queued_requests=queued), 0)
    dropped = []
    for number, client in enumerate(clients):
        out = scheduler.enqueue(scheduler.client(client, client, 0), item(number), 0)
        if out is not None:
            dropped.append(int(out.data))
        assert scheduler.queued <= queued
    found = serve(scheduler)
    assert sorted(found + dropped) == list(range(len(clients)))
    by_client: dict[bytes, list[int]] = {}
    for number in found:
        by_client.setdefault(clients[number], []).append(number)
    assert all(numbers == sorted(numbers) for numbers in by_client.values())


def test_given_full_queues_then_each_client_that_comes_gets_its_part() -> None:
    scheduler = RequestScheduler(LimitsConfig(queued_requests=60), 0)
    for _ in range(1000):
        for client in (b"a", b"b", b"c", b"d", b"e"):
            send(scheduler, client)
    lengths = [len(scheduler.client(client, client, 0).requests) for client in (b"a", b"b", b"c", b"d", b"e")]
    assert lengths == [12] * 5


def test_given_an_idle_service_then_no_rate_holds_a_client_back() -> None:
    scheduler = RequestScheduler(LimitsConfig(client_hz=1.0, request_share=0.01), 0)
    for number in range(1000):
        # far more than the rate and the share: a second for each millisecond
        scheduler.spend(1.0, number * MS)
        scheduler.set_contended(False, number * MS)
        assert send(scheduler, b"a", number, number * MS)
        assert serve(scheduler, number * MS) == [number]


def test_given_contention_then_each_client_has_its_rate() -> None:
    scheduler = make_contended(LimitsConfig(client_hz=100.0, request_share=0.1))
    got = Counter[str]()
    for step in range(10_000):
        now = step * MS
        scheduler.spend(0.001, now)  # all the time goes into requests
        scheduler.set_contended(True, now)
        for _ in range(10):
            send(scheduler, b"flood", 0, now)
        if step % 100 == 0:
            send(scheduler, b"polite", 1, now)
        while (each := scheduler.next(now)) is not None:
            got["polite" if each.data == b"1" else "flood"] += 1
    # ten seconds: a hundred a second, and the burst at the beginning
    assert got["flood"] == pytest.approx(1000, abs=60)
    assert got["polite"] == 100
    assert scheduler.queued <= MAX_QUEUED_BEYOND_RATE


def test_given_contention_then_work_beyond_the_rates_gets_its_share_of_the_time() -> None:
    scheduler = RequestScheduler(LimitsConfig(client_hz=1.0, request_share=0.25), 0)
    count = 0
    for step in range(10_000):
        now = step * MS
        scheduler.set_contended(True, now)
        send(scheduler, b"a", 0, now)
        if scheduler.next(now) is not None:
            count += 1
            scheduler.spend(0.001, now + MS)
        else:
            scheduler.spend(0.0, now + MS)
    assert count == pytest.approx(2500, rel=0.05)


def test_given_contention_that_ends_then_what_waits_is_answered() -> None:
    scheduler = make_contended(LimitsConfig(client_hz=1.0))
    assert all(send(scheduler, b"a", number) for number in range(3))
    assert serve(scheduler) == [0]  # the burst of a rate of one a second
    assert not scheduler.is_ready
    scheduler.set_contended(False, 0)
    assert scheduler.is_ready
    assert serve(scheduler) == [1, 2]


def test_given_a_client_beyond_its_rate_then_those_within_go_first() -> None:
    scheduler = RequestScheduler(LimitsConfig(client_hz=4.0), 0)
    for number in range(6):
        send(scheduler, b"fast", number)
    assert scheduler.next(0) is not None
    for number in range(3):
        send(scheduler, b"slow", 10 + number, 2 * S)
    # the burst of a rate of 4 a second is one
    assert serve(scheduler, 0) == [10, 1, 11, 2, 12, 3, 4, 5]


def test_given_tokens_that_have_come_then_a_waiting_client_is_within_its_rate_again() -> None:
    scheduler = make_contended(LimitsConfig(client_hz=10.0))
    for number in range(4):
        send(scheduler, b"a", number)
    assert serve(scheduler) == [0, 1]  # a burst of 2.5
    scheduler.set_contended(True, 100 * MS)
    assert serve(scheduler, 100 * MS) == [2]


def test_given_ever_new_names_then_the_earlier_clients_keep_their_queues() -> None:
    scheduler = RequestScheduler(LimitsConfig(queued_requests=50), 0, max_clients=8)
    assert send(scheduler, b"polite", 0)
    for number in range(10_000):
        send(scheduler, str(number).encode(), -1)
    assert len(scheduler._clients) == 8
    send(scheduler, b"polite", 1)
    found = serve(scheduler)
    assert [n for n in found if n >= 0] == [0, 1]
    assert found.index(1) <= 9 + 9
    assert len(found) == 50


def test_given_silent_clients_then_others_take_their_places() -> None:
    scheduler = RequestScheduler(LimitsConfig(), 0, max_clients=2)
    a, b = scheduler.client(b"a", b"a", 0), scheduler.client(b"b", b"b", 0)
    other = scheduler.client(b"c", b"c", 0)
    assert other not in (a, b)
    assert scheduler.client(b"d", b"d", CLIENT_IDLE_NS) is other
    late = scheduler.client(b"d", b"d", CLIENT_IDLE_NS + SWEEP_NS + 1)
    assert late is not other
    assert scheduler.client(b"a", b"a", CLIENT_IDLE_NS + SWEEP_NS + 1) is not a


def test_given_dropped_requests_then_a_bounded_number_gets_a_reply_and_their_clients_are_reported() -> None:
    scheduler = RequestScheduler(LimitsConfig(queued_requests=1), 0)
    for name, count in ((b"REPLY_A", 9000), (b"REPLY_B", 20), (b"\x1b[31m\n" * 3, 10), (b"REPLY_C", 5), (b"", 1)):
        scheduler.client(name, name, 0)
        replies = sum(scheduler.count_dropped(name) for _ in range(count))
        assert replies == min(count, REJECTIONS_PER_CLIENT)
        for _ in range(count - 1):
            scheduler.client(name, name, 0)
    assert scheduler.report(S - 1) is None
    report = scheduler.report(S)
    assert report is not None
    assert report.startswith("client REPLY_A sends 9,000/s; 9,000/s dropped; client REPLY_B sends 20/s")
    assert report.endswith("and 2 more")
    assert report.isprintable()
    assert scheduler.report(2 * S) == ""
    assert scheduler.count_dropped(b"REPLY_A")


def test_given_dropped_requests_of_many_clients_then_the_replies_are_bounded_for_all_together() -> None:
    scheduler = RequestScheduler(LimitsConfig(), 0)
    replies = 0
    for number in range(60):
        name = str(number).encode()
        scheduler.client(name, name, 0)
        replies += sum(scheduler.count_dropped(name) for _ in range(100))
    assert replies == REJECTIONS_TOTAL


# --- deferred requests ----------------------------------------------------------------------------------------


def make_deferred(number: int, client: bytes, reply_bytes: int = 1, effort: float = 0.0) -> DeferredRequest:
    return DeferredRequest(item(number, client), GetBodyList(RequestHeader(number, "REPLY")), reply_bytes, effort)


def begin_deferred(scheduler: RequestScheduler, now_ns: int = 0) -> list[int]:
    found = []
    while (each := scheduler.next_deferred(now_ns)) is not None:
        found.append(int(each.queued.data))
    return found


def test_given_deferred_requests_then_clients_are_served_round_robin_and_their_queues_are_bounded() -> None:
    scheduler = RequestScheduler(LimitsConfig(), 0)
    for name in (b"a", b"b"):
        scheduler.client(name, name, 0)
    assert [scheduler.enqueue_deferred(make_deferred(n, b"a")) for n in range(3)] == [True] * DEFERRED_PER_CLIENT + [
        False
    ]
    assert scheduler.enqueue_deferred(make_deferred(10, b"b"))
    assert begin_deferred(scheduler) == [0, 10, 1]
    count = 0
    for number in range(40):
        name = str(number).encode()
        scheduler.client(name, name, 0)
        count += scheduler.enqueue_deferred(make_deferred(number, name))
    assert count == DEFERRED_TOTAL == scheduler.deferred


def test_given_replies_beyond_the_bytes_a_second_then_they_wait_and_others_do_not() -> None:
    scheduler = RequestScheduler(LimitsConfig(client_reply_bytes=1e6), 0)
    for name in (b"large", b"small"):
        scheduler.client(name, name, 0)
    sent = 0
    for step in range(10_000):
        now = step * MS
        scheduler.enqueue_deferred(make_deferred(1, b"large", 500_000))
        if step % 100 == 0:
            assert scheduler.enqueue_deferred(make_deferred(2, b"small", 100))
        found = begin_deferred(scheduler, now)
        sent += found.count(1)
        assert found.count(2) == (step % 100 == 0)
    # the burst of two, and one more each half second before the tenth second ends
    assert sent == 2 + 19


def test_given_the_largest_reply_and_the_least_rate_then_it_fits() -> None:
    scheduler = RequestScheduler(LimitsConfig(client_reply_bytes=1e4), 0)
    scheduler.client(b"a", b"a", 0)
    scheduler.enqueue_deferred(make_deferred(1, b"a", MAX_REPLY_BYTES))
    assert begin_deferred(scheduler) == [1]


def test_given_deferred_work_then_it_is_charged_before_it_begins() -> None:
    scheduler = make_contended(LimitsConfig(client_hz=100.0))
    scheduler.client(b"a", b"a", 0)
    scheduler.enqueue_deferred(make_deferred(1, b"a", 100, 30.0))
    assert begin_deferred(scheduler) == [1]
    send(scheduler, b"a", 2)
    # 25 tokens less 30: the next comes after 60 ms
    scheduler.set_contended(True, 55 * MS)
    assert serve(scheduler, 55 * MS) == []
    scheduler.set_contended(True, 61 * MS)
    assert serve(scheduler, 61 * MS) == [2]


# --- clients --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["REPLY_A", "R", "x" * 63])
def test_given_a_request_then_its_reply_channel_is_its_client(name: str) -> None:
    assert client_of(bytes(16) + pack_text(name) + b"rest") == name.encode()
    assert client_of(bytes(16) + pack_text(name)) == name.encode()


@pytest.mark.parametrize(
    "data", [b"", bytes(16), bytes(19), bytes(40), bytes(16) + b"\xff" * 8, bytes(16) + pack_text("x" * 70) + b"rest"]
)
def test_given_bytes_without_a_reply_channel_then_they_have_one_client_together(data: bytes) -> None:
    assert client_of(data) == b""


def test_given_all_cuts_of_a_request_then_nothing_is_raised() -> None:
    whole = bytes(16) + pack_text("REPLY_A") + b"rest"
    for start, end in itertools.combinations(range(len(whole)), 2):
        client_of(whole[start:end])
