"""The loop under request traffic: a clock that advances with each piece of work, and clients with a schedule."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from support_samples import ME, START, ScriptedLocalizer, imu, start_core

from modelserver.config.vehicle_file import LimitsConfig
from modelserver.errors import Status
from modelserver.messages import (
    GetBodyList,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    RequestHeader,
    TimeQuery,
)
from modelserver.server.bus import FakeBus, FakeInbox, Inboxes
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.requests import CONTENTION_NS
from modelserver.transforms import chain
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import Sender

pytestmark = pytest.mark.slow

MS = 1_000_000
S = 1_000 * MS
BEGIN_NS = 10 * S
RECEIVE_S = 5e-6
FRAMES = ("Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin")


class TimedInbox(FakeInbox):
    """An inbox whose messages arrive at their times; handling one takes time."""

    def __init__(self, clock: FakeClock):
        super().__init__(clock)
        self.arrivals: list[tuple[int, int, str, bytes, Sender]] = []

    def at(self, time_ns: int, channel: str, data: bytes, sender: Sender = None) -> None:
        heapq.heappush(self.arrivals, (time_ns, len(self.arrivals), channel, data, sender))

    def arrive(self) -> None:
        while self.arrivals and self.arrivals[0][0] <= self._clock.monotonic_ns():
            _, _, channel, data, sender = heapq.heappop(self.arrivals)
            self.put(channel, data, sender)

    def drain(self, limit: int, seconds: float = math.inf) -> int:
        count = 0
        while count < limit:
            self.arrive()
            if not super().drain(1):
                break
            self._clock.advance(RECEIVE_S)
            count += 1
        return count


class TimedBus(FakeBus):
    """A bus on which each reply takes `answer_s` and calls `on_reply`."""

    def __init__(self, clock: FakeClock, answer_s: float):
        super().__init__(clock)
        self.requests = TimedInbox(clock)
        self.answer_s = answer_s
        self.on_reply: Callable[[str, bytes], None] = lambda channel, data: None

    def publish(self, channel: str, data: bytes) -> None:
        self.published.append((channel, data))
        if channel.startswith("REPLY_"):
            self._clock.advance(self.answer_s)
            self.on_reply(channel, data)

    def wait(self, seconds: float, inboxes: Inboxes = "both") -> None:
        inbox = self.requests
        assert isinstance(inbox, TimedInbox)
        inbox.arrive()
        if inboxes == "samples" or not inbox.pending:
            next_ns = inbox.arrivals[0][0] if inboxes != "samples" and inbox.arrivals else 1 << 62
            until = min(next_ns, self._clock.monotonic_ns() + round(max(seconds, 0.0) * 1e9))
            self._clock.advance((until - self._clock.monotonic_ns()) * 1e-9)


class Rig:
    """A loop on a timed bus, with ticks at 100 Hz."""

    def __init__(self, answer_s: float = 200e-6, **limits: Any):
        self.clock = FakeClock(START, BEGIN_NS)
        self.bus = TimedBus(self.clock, answer_s)
        state = start_core(ScriptedLocalizer())
        loop_settings = LoopSettings(10 * MS, {"IMU": SensorChannel("imu_t")}, limits=LimitsConfig(**limits))
        self.loop = Loop(self.bus, self.clock, state, loop_settings, Hooks())
        for n in range(90):
            self.bus.sensors.put("IMU", encode(imu(START - 1_000_000 + n * 10_000)))

    @property
    def inbox(self) -> TimedInbox:
        return self.bus.requests  # type: ignore[return-value]

    @property
    def seconds(self) -> float:
        """Since the beginning."""
        return (self.clock.monotonic_ns() - BEGIN_NS) * 1e-9

    def send(
        self, seconds: float, request: Any, channel: str = "PLATFORM_GET_TRANSFORMATION", sender: Sender = None
    ) -> None:
        self.inbox.at(BEGIN_NS + round(seconds * 1e9), channel, encode(request), sender)

    def run(self, seconds: float) -> None:
        while self.seconds < seconds:
            self.loop.run_once()


def pairs(name: str) -> Iterable[GetTransformation]:
    number = 0
    while True:
        a, b = FRAMES[number % 5], FRAMES[number // 5 % 5]
        yield GetTransformation(RequestHeader(number, name), a, b)
        number += 1


@pytest.mark.parametrize("hz", [500, 2000])
@pytest.mark.parametrize("answer_s", [100e-6, 300e-6])
def test_given_five_clients_that_do_not_wait_then_a_polite_sixth_gets_each_reply_and_the_queues_empty(
    hz: int, answer_s: float
) -> None:
    rig = Rig(answer_s)
    for number in range(5):
        requests = iter(pairs(f"REPLY_FAST{number}"))
        for n in range(3 * hz):
            rig.send((n + number / 5) / hz, next(requests))
    asked: dict[int, float] = {}
    took: list[float] = []
    for n in range(30):
        asked[n] = n * 0.1 + 0.0037
        rig.send(asked[n], GetTransformation(RequestHeader(n, "REPLY_POLITE"), "Camera:Origin", "Cart:Base"))

    def reply(channel: str, data: bytes) -> None:
        if channel == "REPLY_POLITE":
            header = decode("get_transformation_reply_t", data).header
            assert header.status is Status.OK
            took.append(rig.seconds - asked.pop(header.request_id))

    rig.bus.on_reply = reply
    rig.run(3.0)
    assert len(took) == 30
    assert max(took) < 0.05
    assert rig.loop.state.ticks_missed == 0
    rig.run(4.0)
    assert rig.loop._requests.waiting == rig.inbox.pending == 0


def lone_client(rig: Rig, count: int) -> list[float]:
    """Return the latencies of replies to a client that sends the next request after each reply."""
    requests = iter(pairs("REPLY_LONE"))
    took: list[float] = []
    sent = 0.0

    def ask() -> None:
        nonlocal sent
        sent = rig.seconds
        rig.send(sent, next(requests))

    def reply(channel: str, data: bytes) -> None:
        took.append(rig.seconds - sent)
        ask()

    rig.bus.on_reply = reply
    ask()
    while len(took) < count:
        rig.loop.run_once()
    return took


def test_given_an_idle_service_then_one_client_is_never_held_back() -> None:
    # 0.2 ms a reply: all of the time goes into requests, twenty times the rate
    took = lone_client(Rig(client_hz=250.0, request_share=0.05), 5000)
    assert max(took) < 0.001


@pytest.mark.parametrize(("hz", "share", "rate"), [(250.0, 0.2, 1000.0), (250.0, 0.01, 250.0)])
def test_given_samples_that_wait_then_the_client_gets_the_share_of_the_time_and_its_rate_at_least(
    hz: float, share: float, rate: float
) -> None:
    # more samples wait in every pass than it handles; a reply takes 0.2 ms
    rig = Rig(client_hz=hz, request_share=share)
    run_once = rig.loop.run_once

    def run_with_backlog() -> None:
        rig.loop._requests.report_backlog(rig.clock.monotonic_ns())
        run_once()

    rig.loop.run_once = run_with_backlog  # type: ignore[method-assign]
    begin = rig.seconds
    count = len(lone_client(rig, 4000))
    assert count / (rig.seconds - begin) == pytest.approx(rate, rel=0.15)


def test_given_late_ticks_then_two_within_a_while_are_contention_and_that_ends() -> None:
    rig = Rig()
    requests = rig.loop._requests

    def is_contended(now_ns: int) -> bool:
        requests.serve(now_ns, now_ns)
        return requests._scheduler._contended

    assert not is_contended(BEGIN_NS)
    requests.report_late_tick(BEGIN_NS)
    # the machine may have been suspended
    assert not is_contended(BEGIN_NS)
    requests.report_late_tick(BEGIN_NS + CONTENTION_NS)
    assert not is_contended(BEGIN_NS + CONTENTION_NS)
    requests.report_late_tick(again := BEGIN_NS + CONTENTION_NS + 1)
    assert is_contended(again + CONTENTION_NS - 1)
    assert not is_contended(again + CONTENTION_NS)


def long_request(name: str = "REPLY_LONG", pairs: int = 64) -> GetTransformations:
    at = tuple(START - 900_000 + n * 10_000 for n in range(31))
    return GetTransformations(RequestHeader(9, name), (("Cart:Mast", "World:UTM"),) * pairs, at)


def test_given_a_long_answer_then_no_tick_is_lost_and_other_requests_overtake_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(20e-6)
    frame_pose_batch = chain.frame_pose_batch

    def costly(links: Any) -> Any:
        # once for each of the 64 pairs: 64 ms in all
        rig.clock.advance(0.001)
        return frame_pose_batch(links)

    replies: list[tuple[float, str]] = []
    rig.bus.on_reply = lambda channel, data: replies.append((rig.seconds, channel))
    rig.run(0.1)
    monkeypatch.setattr(chain, "frame_pose_batch", costly)
    rig.send(0.1, long_request(), "PLATFORM_GET_TRANSFORMATIONS")
    for n in range(10):
        rig.send(0.105 + 0.005 * n, GetStateVector(RequestHeader(n, "REPLY_SHORT")), "POSE_GET_STATE_VECTOR")
    rig.run(1.0)
    assert rig.loop.state.ticks_missed == 0
    assert max(rig.loop.state.tick_latencies) < 0.002
    short = [at for at, channel in replies if channel == "REPLY_SHORT"]
    long = [at for at, channel in replies if channel == "REPLY_LONG"]
    assert len(short) == 10
    assert all(at - (0.105 + 0.005 * n) < 0.004 for n, at in enumerate(short))
    assert len(long) == 64
    assert short[-1] < long[0] < 0.3


def test_given_long_answers_without_end_then_they_are_bounded_by_bytes_and_the_rest_is_dropped() -> None:
    rig = Rig(20e-6, client_reply_bytes=1_000_000.0)
    size = 0

    def reply(channel: str, data: bytes) -> None:
        nonlocal size
        if decode("get_transformations_reply_t", data).header.status is Status.OK:
            size += len(data)

    rig.bus.on_reply = reply
    for n in range(50):
        rig.send(n * 0.1, long_request(), "PLATFORM_GET_TRANSFORMATIONS")
    rig.run(5.0)
    # five seconds of a megabyte, and the burst
    assert 4e6 < size < 6e6
    assert dict(rig.loop.state.rejected)["PLATFORM_GET_TRANSFORMATIONS", "overload"] > 20
    assert rig.loop.state.ticks_missed == 0


def test_given_a_long_answer_that_fails_then_its_client_gets_an_error_and_the_next_is_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    rig.run(0.1)

    def fail(links: Any) -> Any:
        raise ArithmeticError("no number")

    statuses: list[Status] = []
    rig.bus.on_reply = lambda channel, data: statuses.append(decode("get_transformations_reply_t", data).header.status)
    with monkeypatch.context() as patched:
        patched.setattr(chain, "frame_pose_batch", fail)
        rig.send(0.1, long_request(pairs=2), "PLATFORM_GET_TRANSFORMATIONS")
        rig.run(0.2)
    assert statuses == [Status.INTERNAL]
    assert rig.loop.state.handler_errors == 1
    rig.send(0.2, long_request(pairs=2), "PLATFORM_GET_TRANSFORMATIONS")
    rig.run(0.3)
    assert statuses[1:] == [Status.OK] * 2


def test_given_a_reply_channel_that_may_not_be_used_then_a_long_request_is_counted_and_costs_nothing() -> None:
    rig = Rig()
    rig.send(0.0, long_request("POSE"), "PLATFORM_GET_TRANSFORMATIONS")
    rig.send(0.0, GetBodyList(ME), "PLATFORM_GET_BODY_LIST")
    rig.run(0.1)
    assert dict(rig.loop.state.rejected) == {("PLATFORM_GET_TRANSFORMATIONS", "reply_channel"): 1}
    assert [channel for channel, _ in rig.bus.published if channel.startswith("REPLY")] == ["REPLY_TEST"]
    assert rig.loop._requests.waiting == 0


def test_given_a_flood_under_the_reply_channel_of_another_client_then_that_one_gets_its_replies() -> None:
    rig = Rig()
    victim, stranger = ("10.0.0.1", 4000), ("10.0.0.9", 5000)
    replies: list[int] = []
    rig.bus.on_reply = lambda channel, data: replies.append(
        decode("get_transformation_reply_t", data).header.request_id
    )
    flood = GetTransformation(RequestHeader(7, "REPLY_A"), *FRAMES[:2], TimeQuery())
    mine = [GetTransformation(RequestHeader(1000 + n, "REPLY_A"), *FRAMES[:2], TimeQuery()) for n in range(20)]
    for n in range(20_000):
        rig.send(0.1 + n * 50e-6, flood, sender=stranger)
    for n, request in enumerate(mine):
        rig.send(0.2 + n * 0.04, request, sender=victim)
    rig.run(1.3)
    assert [each for each in replies if each >= 1000] == [1000 + n for n in range(20)]
