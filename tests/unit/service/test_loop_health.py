"""The loop's part of the health report: gauges are read when they will be told, notices come from outside."""

from __future__ import annotations

from support_samples import START, Scripted, started

from modelserver.messages import Gauges, Health
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.hooks import Hooks
from modelserver.service.loop import Loop, LoopSettings
from modelserver.wire.codec import decode

PERIOD_NS = 20_000_000


class Rig:
    def __init__(self) -> None:
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.asked: list[int] = []
        self.loop = Loop(self.bus, self.clock, started(Scripted()), LoopSettings(PERIOD_NS), Hooks(gauges=self.gauges))

    def gauges(self, queued: int) -> Gauges:
        self.asked.append(queued)
        return Gauges("pc", 12, queued, 5, 0.5 * len(self.asked))

    def turns(self, count: int) -> None:
        for _ in range(count):
            self.loop.turn()

    @property
    def reports(self) -> list[Health]:
        return [decode("health_t", data) for data in self.bus.said("MODELSERVER_HEALTH")]


def test_given_ticks_then_gauges_are_read_once_a_report_and_told_with_it() -> None:
    rig = Rig()
    rig.turns(151)
    assert rig.asked == [0] * 4
    assert [(each.host, each.pid, each.memory) for each in rig.reports] == [("pc", 12, 5)] * 4
    assert rig.reports[-1].cpu_share == 0.5


def test_given_gauges_that_fail_then_the_ticks_go_on_and_it_is_counted() -> None:
    rig = Rig()

    def broken(queued: int) -> Gauges:
        raise OSError("no /proc")

    rig.loop._gauges = broken
    rig.turns(3)
    assert rig.loop.state.rejected[("tick", "handler")] == 3


def test_given_a_notice_then_it_is_told_within_a_tenth_of_a_second_and_taken_back() -> None:
    rig = Rig()
    rig.turns(3)
    rig.loop.notice("bus", "the buffer is small")
    rig.turns(6)
    assert rig.reports[-1].notices == (("bus", "the buffer is small"),)
    rig.loop.notice("bus")
    rig.turns(6)
    assert rig.reports[-1].notices == ()
    assert len(rig.reports) == 3
