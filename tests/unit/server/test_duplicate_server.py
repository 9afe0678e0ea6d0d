"""Two servers on one bus: a warning on the other one until it is gone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_wire import EXAMPLES

from modelserver.messages import Health
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.diagnostics import DUPLICATE_TIMEOUT_S, MAX_REPORTS_PER_S, DuplicateServerMonitor
from modelserver.wire.codec import encode


class Rig:
    def __init__(self) -> None:
        self.clock = FakeClock()
        self.warnings: list[tuple[str, str]] = []
        self.monitor = DuplicateServerMonitor(
            "pc", 10, lambda subject, text: self.warnings.append((subject, text)), self.clock
        )

    def report(self, host: str = "pc", pid: int = 10, behind_s: float = 0.0) -> None:
        health: Health = EXAMPLES["health_t"][1]
        utime = self.clock.utime() - round(behind_s * 1e6)
        self.monitor.on_health("MODELSERVER_HEALTH", encode(replace(health, host=host, pid=pid, utime=utime)))


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_given_own_reports_then_there_is_no_warning(rig: Rig) -> None:
    for _ in range(10):
        rig.report()
        rig.clock.advance(1.0)
    assert rig.warnings == []


@pytest.mark.parametrize(("host", "pid"), [("pc", 11), ("other", 10)])
def test_given_another_server_then_there_is_one_warning_with_its_process_until_it_is_gone(
    rig: Rig, host: str, pid: int
) -> None:
    for _ in range(5):
        rig.report()
        rig.clock.advance(0.5)
        rig.report(host, pid)
        rig.clock.advance(0.5)
    ((subject, text),) = rig.warnings
    assert subject == "servers"
    assert f"process {pid} on '{host}'" in text
    assert f"kill {pid}" in text
    rig.clock.advance(DUPLICATE_TIMEOUT_S)
    rig.report()
    assert rig.warnings[1:] == [("servers", "")]


def test_given_a_recording_that_is_played_then_the_warning_distinguishes_it_from_a_server(rig: Rig) -> None:
    rig.report("pc", 3, behind_s=86_400.0)
    assert "recording" in rig.warnings[0][1]


def test_given_a_flood_then_only_so_many_are_read(rig: Rig) -> None:
    for n in range(1000):
        rig.report(pid=100 + n)
    assert len(rig.warnings) <= MAX_REPORTS_PER_S
    rig.clock.advance(1.0)
    rig.report(pid=7)
    assert "process 7" in rig.warnings[-1][1]


def test_given_names_of_another_program_then_they_are_escaped_and_cut(rig: Rig) -> None:
    rig.report(host="\x1b[2J\n" + "x" * 5000)
    assert rig.warnings[0][1].isprintable()
    assert len(rig.warnings[0][1]) < 600


@given(st.binary(max_size=200))
def test_given_any_bytes_then_there_is_no_warning(data: bytes) -> None:
    rig = Rig()
    rig.monitor.on_health("MODELSERVER_HEALTH", data)
    rig.monitor.on_health("MODELSERVER_HEALTH", encode(EXAMPLES["health_t"][0])[:8] + data)
    assert rig.warnings == []


def test_given_a_prefix_then_only_its_channel_is_received(rig: Rig) -> None:
    bus = FakeBus(rig.clock)
    rig.monitor.subscribe(bus.requests, "A_")
    health = encode(EXAMPLES["health_t"][1])
    for channel in ("MODELSERVER_HEALTH", "B_MODELSERVER_HEALTH", "A_MODELSERVER_HEALTH"):
        bus.publish(channel, health)
    assert bus.requests.drain(10) == 1
    assert len(rig.warnings) == 1
