"""Static replies that are prepared while the server is idle, after a first request."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from support_samples import START, ScriptedLocalizer, imu, start_core

from modelserver.messages import GetTransformation, RequestHeader, TransformReply
from modelserver.server.clock import FakeClock
from modelserver.server.fake_bus import FakeBus
from modelserver.server.ingress import SensorChannel
from modelserver.server.journal.queue import JournalQueue
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.requests.scheduler import RunDelay
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import RecordKind

PERIOD_NS = 20_000_000
FRAMES = ("Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin")


class Noted(JournalQueue):
    """A journal that records the kinds of messages."""

    def __init__(self) -> None:
        super().__init__()
        self.kinds: list[RecordKind] = []

    def record_message(self, kind: RecordKind, received: tuple[str, bytes], now: object) -> None:
        """Record the kind."""
        self.kinds.append(kind)


class Rig:
    """A loop on a fake bus whose clock advances only while the loop waits."""

    def __init__(self, run_delay: Callable[[], RunDelay | None] = lambda: None) -> None:
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.journal = Noted()
        hooks = Hooks(journal=self.journal, run_delay=run_delay)
        settings = LoopSettings(PERIOD_NS, {"IMU": SensorChannel("imu_t")})
        self.loop = Loop(self.bus, self.clock, start_core(ScriptedLocalizer()), settings, hooks)

    def ask(self, interest: str, reference: str) -> TransformReply:
        """Return the reply to a request."""
        request = GetTransformation(RequestHeader(7, "REPLY_TEST"), interest, reference)
        self.bus.requests.put("PLATFORM_GET_TRANSFORMATION", encode(request))
        self.bus.published.clear()
        self.loop.run_once()
        (data,) = [data for channel, data in self.bus.published if channel == "REPLY_TEST"]
        reply: TransformReply = decode("get_transformation_reply_t", data)
        return reply

    def idle(self, turns: int = 100) -> None:
        """Run idle passes of the loop."""
        for _ in range(turns):
            self.loop.run_once()


def test_given_one_request_and_idle_time_then_other_pairs_are_answered_from_the_cache_as_the_core_answers() -> None:
    rig, plain = Rig(), Rig()
    rig.ask(*FRAMES[:2])
    rig.idle()
    rig.journal.kinds.clear()
    pairs = list(itertools.product(FRAMES, repeat=2))
    replies = [rig.ask(*pair).answer for pair in pairs]
    assert rig.journal.kinds == [RecordKind.CACHED] * len(pairs)
    for pair, found in zip(pairs, replies, strict=True):
        expected = plain.ask(*pair).answer
        assert found is not None
        assert expected is not None
        assert found.transformation.pose == expected.transformation.pose
        assert found.transformation.covariance_numbers == expected.transformation.covariance_numbers


def test_given_no_request_then_nothing_is_prepared() -> None:
    rig = Rig()
    rig.idle()
    rig.ask(*FRAMES[:2])
    assert rig.journal.kinds == []


def test_given_prepared_replies_then_none_is_counted_as_answered() -> None:
    rig = Rig()
    rig.ask(*FRAMES[:2])
    rig.idle()
    assert rig.loop.state.requests_answered == 1


def test_given_a_contended_processor_then_nothing_is_prepared() -> None:
    # half of the time the thread was ready to run and had no processor
    rig = Rig(lambda: RunDelay(rig.clock.monotonic_ns() // 2, 0))
    rig.bus.sensors.put("IMU", encode(imu(START)))
    rig.idle(20)
    rig.ask(*FRAMES[:2])
    rig.idle(20)
    rig.ask(*FRAMES[2:4])
    assert rig.journal.kinds == []


@pytest.mark.parametrize("ahead_us", [0, 150])
def test_given_a_tick_that_is_near_then_nothing_is_prepared_before_it(ahead_us: int) -> None:
    rig = Rig()
    rig.ask(*FRAMES[:2])
    requests, waits = rig.loop._requests, rig.loop._timer.due_ns
    before = len(requests._cache)
    assert not requests.prepare(rig.clock.monotonic_ns() + ahead_us * 1000)
    assert len(requests._cache) == before
    assert requests.prepare(waits + PERIOD_NS)
    assert len(requests._cache) > before
