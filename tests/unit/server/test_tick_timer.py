"""Lead time of ticks: a quantile of their computing time, without delays from outside."""

from __future__ import annotations

import math
import random
from dataclasses import replace

from support_samples import START, ScriptedLocalizer
from test_loop import PERIOD_NS, Rig

from modelserver.core import CoreState
from modelserver.messages import CHANNEL_OF, GetStateVector, GetTransformation, RequestHeader
from modelserver.server.bus import Inboxes
from modelserver.server.clock import MAX_LEAD_NS, TickLead
from modelserver.wire.codec import encode

MS = 1_000_000


def test_given_ticks_that_take_time_when_learnt_then_nine_in_ten_are_ready_in_time() -> None:
    chance, lead = random.Random(1), TickLead()
    took = [round(chance.gauss(400_000, 50_000)) for _ in range(3000)]
    ready = []
    for each in took:
        ready.append(each <= lead.ns)
        lead.update(each)
    assert 0.88 < sum(ready[500:]) / len(ready[500:]) < 0.97
    assert 400_000 < lead.ns < 700_000


def test_given_ticks_held_up_by_something_else_then_nothing_is_learnt() -> None:
    lead = TickLead()
    for _ in range(100):
        lead.update(13 * MS)
    assert lead.ns == 0


def test_given_ticks_that_take_long_then_the_lead_is_bounded_and_comes_down_again() -> None:
    lead = TickLead()
    for _ in range(1000):
        lead.update(3 * MS)
    assert lead.ns == MAX_LEAD_NS
    for _ in range(1000):
        lead.update(0)
    assert lead.ns == 0


def test_given_a_lead_then_poses_hold_for_the_deadline_and_are_published_at_it() -> None:
    rig = Rig()
    rig.turns(3)
    rig.loop._timer.lead.ns = 500_000
    published = []
    publish = rig.bus.publish
    rig.bus.publish = lambda channel, data: (  # type: ignore[method-assign]
        published.append((channel, rig.clock.monotonic_ns())),
        publish(channel, data),
    )[1]
    rig.turns(20)
    times = [at for channel, at in published if channel == "POSE"]
    assert len(times) >= 15
    assert {(at - 10_000_000_000) % PERIOD_NS for at in times} == {0}
    assert {(pose.transformation.utime - START) % 20_000 for pose in rig.poses} == {0}
    assert rig.loop.state.ticks_missed == 0


def test_given_a_vehicle_without_poses_then_ticks_go_on_and_no_lead_is_learnt() -> None:
    rig = Rig(localizer=None)
    rig.turns(30)
    assert rig.loop.state.ticks >= 29
    assert rig.loop._timer.lead.ns == 0


def test_given_a_lead_and_a_localizer_that_breaks_then_the_loop_goes_on() -> None:
    class Broken(ScriptedLocalizer):
        def estimate(self, utime: int):  # type: ignore[no-untyped-def]
            raise RuntimeError("broken")

    rig = Rig(localizer=Broken())
    rig.loop._timer.lead.ns = 500_000
    rig.turns(10)
    assert rig.loop.state.handler_errors >= 1
    assert rig.loop._waiting_poses is None


def test_given_a_lead_and_a_tick_without_pose_then_what_is_handled_next_comes_after_the_deadline() -> None:
    rig = Rig(publish="event")
    rig.turns(2)
    for _ in range(5):
        rig.loop._timer.lead.ns = 500_000
        due = rig.loop._timer.due_ns
        rig.turns(2)
        assert rig.now.monotonic_ns >= due


def test_given_requests_while_a_pose_waits_for_its_deadline_then_only_the_cached_reply_is_sent_before() -> None:
    rig = Rig()
    fixed = GetTransformation(RequestHeader(1, "REPLY_FIXED"), "Cart:Mast", "Cart:Base")
    rig.send(fixed)
    rig.turns(3)
    assert rig.bus.get_published("REPLY_FIXED")
    rig.loop._timer.lead.ns = 1_500_000
    rig.turns(1)
    due = rig.loop._timer.due_ns
    sent: list[tuple[str, int]] = []
    publish, wait = rig.bus.publish, rig.bus.wait

    def wait_for_requests(seconds: float, inboxes: Inboxes = "both") -> None:
        if inboxes == "requests" and not sent:
            rig.clock.advance(0.0005)
            for request in (fixed, GetStateVector(RequestHeader(2, "REPLY_OF_CORE"))):
                rig.bus.requests.put(CHANNEL_OF[type(request)], encode(request))
        wait(seconds, inboxes)

    rig.bus.wait = wait_for_requests  # type: ignore[method-assign]
    rig.bus.publish = lambda channel, data: (  # type: ignore[method-assign]
        sent.append((channel, rig.clock.monotonic_ns())),
        publish(channel, data),
    )[1]
    rig.turns(1)
    assert sent == [
        ("REPLY_FIXED", due - 996_000),
        ("POSE", due),
        ("POSE_VECTOR", due),
        ("POSE_ODOM", due),
        ("REPLY_OF_CORE", due),
    ]
    assert rig.loop.state.ticks_missed == 0


def test_given_a_flood_while_a_pose_waits_for_its_deadline_then_the_pose_is_on_time() -> None:
    rig = Rig()
    rig.turns(3)
    rig.loop._timer.lead.ns = 1_500_000
    rig.turns(1)
    due = rig.loop._timer.due_ns
    request = encode(GetStateVector(RequestHeader(2, "REPLY_OF_CORE")))
    drain = rig.bus.requests.drain

    def drain_flood(limit: int, seconds: float = math.inf) -> int:
        for _ in range(limit):
            rig.bus.requests.put(CHANNEL_OF[GetStateVector], request)
        rig.clock.advance(2e-6 * limit)
        return drain(limit, seconds)

    rig.bus.requests.drain = drain_flood  # type: ignore[method-assign]
    published: list[int] = []
    publish = rig.bus.publish
    rig.bus.publish = lambda channel, data: (  # type: ignore[method-assign]
        published.append(rig.clock.monotonic_ns()) if channel == "POSE" else None,
        publish(channel, data),
    )[1]
    rig.turns(1)
    assert published == [due]


def test_given_a_tick_that_fails_then_the_watchdog_is_not_notified() -> None:
    class Broken(ScriptedLocalizer):
        def estimate(self, utime: int):  # type: ignore[no-untyped-def]
            raise RuntimeError("broken")

    for localizer, is_notified in ((ScriptedLocalizer(), True), (Broken(), False)):
        rig = Rig(localizer=localizer)
        notified: list[CoreState] = []
        rig.loop._hooks = replace(rig.loop._hooks, on_tick=notified.append)
        rig.turns(6)
        assert bool(notified) is is_notified
