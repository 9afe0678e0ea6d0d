"""Supervision of a loop: readiness, status, watchdog."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from support_samples import START, ScriptedLocalizer, cart, gps, imu, start_core

from modelserver.core import CoreState, ModelLoaded
from modelserver.messages import Estimate, HealthWarning, Invalid, LoadModel, ReloadModel, RequestHeader
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.reloading import PollReload
from modelserver.server.supervision import STALL_TIMEOUT_S, Notifier, ServiceSupervisor
from modelserver.wire.codec import encode

HZ = 50


@dataclass(frozen=True)
class Throwing(ScriptedLocalizer):
    """A localizer whose estimates raise after an instant."""

    last: int = START

    def estimate(self, utime: int) -> Estimate:
        if utime > self.last:
            raise ZeroDivisionError("poisoned")
        return super().estimate(utime)


class Watched:
    """A loop under a service manager that records its notifications."""

    def __init__(self, localizer: ScriptedLocalizer | None = ScriptedLocalizer()):  # noqa: B008
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.notifications: list[str] = []
        notifier = Notifier(self._take, 2_000_000_000, self.clock.monotonic_ns)
        self.supervisor = ServiceSupervisor(notifier, self.clock, lambda channel: self.loop.is_sensor_channel(channel))
        settings = LoopSettings(10**9 // HZ, {"GPS": SensorChannel("gps_t"), "IMU": SensorChannel("imu_t")})
        self.loop = Loop(
            self.bus,
            self.clock,
            start_core(localizer),
            settings,
            Hooks(on_load=self._load, on_reload=self.supervisor.on_reload, on_tick=self.supervisor.on_tick),
        )
        self.answer = ModelLoaded(None, why="the file is empty")

    def _take(self, datagram: bytes) -> None:
        self.notifications.append(datagram.decode())

    def _load(self, command: LoadModel, state: CoreState) -> PollReload:
        assert self.notifications[-1].startswith("RELOADING=1")
        return lambda state: self.answer

    def runs(self, seconds: float, *sources: str) -> list[str]:
        """Run with a sample of each source at 10 Hz, and return the notifications."""
        self.notifications.clear()
        for n in range(round(seconds * 10)):
            for source in sources:
                sample: Any = gps if source.startswith("gps") else imu
                channel = "GPS" if source.startswith("gps") else "IMU"
                word = source.partition("/")[2] or source
                self.bus.publish(channel, encode(sample(self.clock.utime(), source=word)))
            until = self.clock.monotonic_ns() + 10**8
            while self.clock.monotonic_ns() < until:
                self.loop.run_once()
            del n
        return list(self.notifications)

    def status(self) -> str:
        """Return the newest status."""
        lines = [
            line
            for notifications in self.notifications
            for line in notifications.splitlines()
            if line.startswith("STATUS=")
        ]
        return lines[-1].removeprefix("STATUS=")


def pings(notifications: list[str]) -> int:
    return sum(datagram == "WATCHDOG=1" for datagram in notifications)


def test_given_a_start_then_it_is_ready_after_a_whole_pass_and_once() -> None:
    watched = Watched()
    watched.loop.run_once()
    assert watched.notifications == []
    watched.loop.run_once()
    assert watched.notifications[0].startswith("READY=1\nSTATUS=serving model ")
    assert not any(notifications.startswith("READY") for notifications in watched.runs(5.0))


def test_given_silent_sensors_then_the_watchdog_is_pinged() -> None:
    watched = Watched()
    watched.runs(2.0, "gps", "imu")
    assert pings(watched.runs(60.0)) >= 60
    assert "0 sensors active, silent: 'gps', 'imu'" in watched.status()


def test_given_a_vehicle_without_sensors_then_the_watchdog_is_pinged() -> None:
    watched = Watched(None)
    assert pings(watched.runs(20.0)) >= 20
    assert "no localization sensor" in watched.notifications[0]


@pytest.mark.slow
@pytest.mark.parametrize("source", ["gps/refuse:stale", "gps/late", "gps/ignore", "gps/reject:gate"])
def test_given_rejected_samples_then_the_watchdog_is_pinged_since_a_restart_would_not_help(source: str) -> None:
    assert pings(Watched().runs(30.0, source)) >= 30


def test_given_a_localization_that_throws_on_every_sample_then_signs_of_life_end() -> None:
    watched = Watched()
    watched.runs(1.0)
    assert pings(watched.runs(STALL_TIMEOUT_S - 1.0, "gps/break", "imu/break")) > 0
    watched.runs(1.5, "gps/break")
    assert pings(watched.runs(10.0, "gps/break", "imu/break")) == 0


def test_given_one_sensor_that_always_fails_and_one_that_does_not_then_the_watchdog_is_pinged() -> None:
    watched = Watched()
    assert pings(watched.runs(30.0, "gps/break", "imu")) >= 30


def test_given_ticks_that_throw_then_it_is_never_ready_or_gives_no_more_signs_of_life() -> None:
    watched = Watched(Throwing(last=START + 2_000_000))
    assert pings(watched.runs(1.0)) > 0
    watched.runs(1.5)
    assert pings(watched.runs(10.0)) == 0
    watched = Watched(Throwing())
    assert watched.runs(5.0) == []


def test_given_ticks_that_throw_then_they_are_counted() -> None:
    watched = Watched(Throwing())
    watched.runs(0.5)
    assert watched.loop.state.rejected["tick", "handler"] > 0


def test_given_a_reload_that_fails_then_the_status_has_the_reason_until_one_succeeds() -> None:
    watched = Watched()
    watched.runs(1.0, "gps", "imu")
    watched.loop.reload()
    notifications = watched.runs(2.0)
    assert [line.splitlines()[0] for line in notifications if "=1" in line and line != "WATCHDOG=1"][:2] == [
        "RELOADING=1",
        "READY=1",
    ]
    assert "reload failed, the old model stays: the file is empty" in watched.status()
    watched.answer = ModelLoaded(None, cart())
    watched.loop.reload()
    watched.runs(2.0)
    assert "reload failed" not in watched.status()


def test_given_a_dry_run_that_fails_then_the_status_stays() -> None:
    watched = Watched()
    request = ReloadModel(RequestHeader(1, "REPLY_TEST"), True)
    watched.answer = ModelLoaded(request, why="no")
    watched.loop.send((LoadModel(request),))
    watched.runs(2.0)
    assert "reload failed" not in watched.status()


def test_given_a_warning_then_the_status_has_it() -> None:
    watched = Watched()
    watched.runs(1.0, "imu")
    assert "1 sensor active" in watched.status()
    watched.loop.step(HealthWarning("journal", "the disk is full\nREADY=0"), watched.clock.now())
    watched.runs(2.0, "imu")
    assert "journal: the disk is full\\nREADY=0" in watched.status()


def test_given_an_invalid_pose_then_the_status_has_the_reason() -> None:
    watched = Watched(ScriptedLocalizer(invalid=Invalid.TILTED))
    watched.runs(2.0, "gps", "imu")
    assert "no valid pose: gravity indicates" in watched.status()


def test_given_an_end_then_it_is_notified() -> None:
    watched = Watched()
    watched.supervisor._notifier.notify_stopping()
    assert watched.notifications == ["STOPPING=1\nSTATUS=stopping"]


def test_given_no_manager_then_no_status_is_formatted() -> None:
    supervision = ServiceSupervisor(Notifier(None), FakeClock(), lambda channel: pytest.fail("nobody asked"))
    supervision.on_tick(start_core(Throwing(last=0)))
