"""The loop's part of the health report: gauges, and warnings from outside."""

from __future__ import annotations

from dataclasses import replace

from support_samples import START, ScriptedLocalizer, start_core

from modelserver.messages import Gauges, Health
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.wire.codec import decode

PERIOD_NS = 20_000_000


class Rig:
    def __init__(self) -> None:
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.asked: list[int] = []
        self.loop = Loop(
            self.bus, self.clock, start_core(ScriptedLocalizer()), LoopSettings(PERIOD_NS), Hooks(gauges=self.gauges)
        )

    def gauges(self, queued: int) -> Gauges:
        self.asked.append(queued)
        return Gauges("pc", 12, queued, 5, 0.5 * len(self.asked))

    def turns(self, count: int) -> None:
        for _ in range(count):
            self.loop.run_once()

    @property
    def reports(self) -> list[Health]:
        return [decode("health_t", data) for data in self.bus.get_published("MODELSERVER_HEALTH")]


def test_given_ticks_then_gauges_are_read_and_published_once_a_report() -> None:
    rig = Rig()
    rig.turns(151)
    assert rig.asked == [0] * 4
    assert [(each.host, each.pid, each.memory) for each in rig.reports] == [("pc", 12, 5)] * 4
    assert rig.reports[-1].cpu_share == 0.5


def test_given_gauges_that_fail_then_the_ticks_go_on_and_it_is_counted() -> None:
    rig = Rig()

    def fail(queued: int) -> Gauges:
        raise OSError("no /proc")

    rig.loop._hooks = replace(rig.loop._hooks, gauges=fail)
    rig.turns(3)
    assert rig.loop.state.rejected[("tick", "handler")] == 3


def test_given_a_warning_then_it_is_published_within_a_tenth_of_a_second_and_cleared() -> None:
    rig = Rig()
    rig.turns(3)
    rig.loop.set_warning("bus", "the buffer is small")
    rig.turns(6)
    assert rig.reports[-1].warnings == (("bus", "the buffer is small"),)
    rig.loop.set_warning("bus")
    rig.turns(6)
    assert rig.reports[-1].warnings == ()
    assert len(rig.reports) == 3
