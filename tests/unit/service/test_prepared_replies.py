"""Static replies that are worked out ahead while the service is idle, once somebody asks."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from support_samples import START, Scripted, imu, started

from modelserver.messages import GetTransformation, RequestHeader, TransformReply
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.journal.queue import NoJournal
from modelserver.service.loop import Loop, LoopSettings
from modelserver.wire.codec import decode, encode
from modelserver.wire.journal import RecordKind

PERIOD_NS = 20_000_000
FRAMES = ("Cart:Base", "Cart:Antenna", "Cart:Imu", "Cart:Mast", "Camera:Origin")


class Noted(NoJournal):
    """A journal that keeps the kinds of what is noted."""

    def __init__(self) -> None:
        self.kinds: list[RecordKind] = []

    def note(self, kind: RecordKind, heard: tuple[str, bytes], now: object) -> None:
        """Keep the kind."""
        self.kinds.append(kind)


class Rig:
    """A loop on a fake bus whose clock stands still but for what the loop waits."""

    def __init__(self, run_delay: Callable[[], int | None] = lambda: None) -> None:
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.journal = Noted()
        hooks = Hooks(journal=self.journal, run_delay=run_delay)
        settings = LoopSettings(PERIOD_NS, {"IMU": SensorChannel("imu_t")})
        self.loop = Loop(self.bus, self.clock, started(Scripted()), settings, hooks)

    def ask(self, interest: str, reference: str) -> TransformReply:
        """Return the reply to a question."""
        request = GetTransformation(RequestHeader(7, "REPLY_TEST"), interest, reference)
        self.bus.requests.put("PLATFORM_GET_TRANSFORMATION", encode(request))
        self.bus.published.clear()
        self.loop.turn()
        (data,) = [data for channel, data in self.bus.published if channel == "REPLY_TEST"]
        reply: TransformReply = decode("get_transformation_reply_t", data)
        return reply

    def idle(self, turns: int = 100) -> None:
        """Let the loop turn with nothing to do."""
        for _ in range(turns):
            self.loop.turn()


def test_given_one_question_and_idle_time_then_other_pairs_are_answered_from_the_cache_as_the_core_answers() -> None:
    rig, plain = Rig(), Rig()
    rig.ask(*FRAMES[:2])
    rig.idle()
    rig.journal.kinds.clear()
    pairs = list(itertools.product(FRAMES, repeat=2))
    replies = [rig.ask(*pair).answer for pair in pairs]
    assert rig.journal.kinds == [RecordKind.REMEMBERED] * len(pairs)
    for pair, found in zip(pairs, replies, strict=True):
        expected = plain.ask(*pair).answer
        assert found is not None
        assert expected is not None
        assert found.transformation.pose == expected.transformation.pose
        assert found.transformation.covariance_numbers == expected.transformation.covariance_numbers


def test_given_nobody_who_asks_then_nothing_is_worked_out() -> None:
    rig = Rig()
    rig.idle()
    rig.ask(*FRAMES[:2])
    assert rig.journal.kinds == []


def test_given_replies_worked_out_ahead_then_nobody_is_counted_as_answered() -> None:
    rig = Rig()
    rig.ask(*FRAMES[:2])
    rig.idle()
    assert rig.loop.state.requests_answered == 1


def test_given_a_processor_that_others_want_then_nothing_is_worked_out_ahead() -> None:
    # half of the time the thread was ready to run and had no processor
    rig = Rig(lambda: rig.clock.monotonic_ns() // 2)
    rig.bus.sensors.put("IMU", encode(imu(START)))
    rig.idle(20)
    rig.ask(*FRAMES[:2])
    rig.idle(20)
    rig.ask(*FRAMES[2:4])
    assert rig.journal.kinds == []


@pytest.mark.parametrize("ahead_us", [0, 150])
def test_given_a_tick_that_is_near_then_nothing_is_worked_out_before_it(ahead_us: int) -> None:
    rig = Rig()
    rig.ask(*FRAMES[:2])
    requests, waits = rig.loop._requests, rig.loop._due_ns
    before = len(requests._cache)
    assert not requests.prepare(rig.clock.monotonic_ns() + ahead_us * 1000)
    assert len(requests._cache) == before
    assert requests.prepare(waits + PERIOD_NS)
    assert len(requests._cache) > before
