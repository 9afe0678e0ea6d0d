"""When the daemon tells its service manager that it is ready, how it is, and that it lives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from support_samples import START, Scripted, cart, gps, imu, started

from modelserver.core import CoreState
from modelserver.core.reload import ModelLoaded
from modelserver.messages import Estimate, Invalid, LoadModel, Noticed, ReloadModel, RequestHeader
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.heard import SensorChannel
from modelserver.service.hooks import Hooks
from modelserver.service.loop import Loop, LoopSettings
from modelserver.service.supervision.notify import Notifier
from modelserver.service.supervision.progress import PATIENCE_S
from modelserver.service.supervision.supervised import Supervision
from modelserver.wire.codec import encode

HZ = 50


@dataclass(frozen=True)
class Throwing(Scripted):
    """A localizer that cannot say where it is after an instant: the ticks ask it."""

    last: int = START

    def estimate(self, utime: int) -> Estimate:
        if utime > self.last:
            raise ZeroDivisionError("poisoned")
        return super().estimate(utime)


class Watched:
    """A loop under a service manager that writes down what it is told."""

    def __init__(self, localizer: Scripted | None = Scripted()):  # noqa: B008
        self.clock = FakeClock(START, 10_000_000_000)
        self.bus = FakeBus(self.clock)
        self.told: list[str] = []
        notifier = Notifier(self._take, 2_000_000_000, self.clock.monotonic_ns)
        self.supervision = Supervision(notifier, self.clock, lambda channel: self.loop.hears(channel))
        settings = LoopSettings(10**9 // HZ, {"GPS": SensorChannel("gps_t"), "IMU": SensorChannel("imu_t")})
        self.loop = Loop(
            self.bus,
            self.clock,
            started(localizer),
            settings,
            Hooks(on_load=self.supervision.loading(self._load), on_tick=self.supervision.ticked),
        )
        self.answer = ModelLoaded(None, why="the file is empty")

    def _take(self, datagram: bytes) -> None:
        self.told.append(datagram.decode())

    def _load(self, wish: LoadModel, state: CoreState) -> ModelLoaded:
        assert self.told[-1].startswith("RELOADING=1")
        return self.answer

    def runs(self, seconds: float, *sources: str) -> list[str]:
        """Run on, with a sample of each source at 10 Hz, and return what was told."""
        self.told.clear()
        for n in range(round(seconds * 10)):
            for source in sources:
                sample: Any = gps if source.startswith("gps") else imu
                channel = "GPS" if source.startswith("gps") else "IMU"
                word = source.partition("/")[2] or source
                self.bus.publish(channel, encode(sample(self.clock.utime(), source=word)))
            until = self.clock.monotonic_ns() + 10**8
            while self.clock.monotonic_ns() < until:
                self.loop.turn()
            del n
        return list(self.told)

    def status(self) -> str:
        """Return the newest status."""
        lines = [line for told in self.told for line in told.splitlines() if line.startswith("STATUS=")]
        return lines[-1].removeprefix("STATUS=")


def pings(told: list[str]) -> int:
    return sum(datagram == "WATCHDOG=1" for datagram in told)


def test_given_a_start_then_it_is_ready_after_a_whole_turn_and_once() -> None:
    watched = Watched()
    watched.loop.turn()
    assert watched.told == []
    watched.loop.turn()
    assert watched.told[0].startswith("READY=1\nSTATUS=serving model ")
    assert not any(told.startswith("READY") for told in watched.runs(5.0))


def test_given_silent_sensors_then_it_lives() -> None:
    watched = Watched()
    watched.runs(2.0, "gps", "imu")
    assert pings(watched.runs(60.0)) >= 60
    assert "0 sensors heard, silent: 'gps', 'imu'" in watched.status()


def test_given_a_vehicle_without_sensors_then_it_lives() -> None:
    watched = Watched(None)
    assert pings(watched.runs(20.0)) >= 20
    assert "no sensor to localize by" in watched.told[0]


@pytest.mark.parametrize("source", ["gps/refuse:stale", "gps/late", "gps/ignore", "gps/reject:gate"])
def test_given_samples_that_are_refused_then_it_lives_for_a_restart_would_not_help(source: str) -> None:
    assert pings(Watched().runs(30.0, source)) >= 30


def test_given_a_localization_that_throws_on_every_sample_then_signs_of_life_end() -> None:
    watched = Watched()
    watched.runs(1.0)
    assert pings(watched.runs(PATIENCE_S - 1.0, "gps/break", "imu/break")) > 0
    watched.runs(1.5, "gps/break")
    assert pings(watched.runs(10.0, "gps/break", "imu/break")) == 0


def test_given_one_sensor_that_always_fails_and_one_that_does_not_then_it_lives() -> None:
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


def test_given_a_reload_that_is_refused_then_the_status_says_so_until_one_is_not() -> None:
    watched = Watched()
    watched.runs(1.0, "gps", "imu")
    watched.loop.reload()
    told = watched.runs(2.0)
    assert [line.splitlines()[0] for line in told if "=1" in line and line != "WATCHDOG=1"][:2] == [
        "RELOADING=1",
        "READY=1",
    ]
    assert "reload refused, the old model stays: the file is empty" in watched.status()
    watched.answer = ModelLoaded(None, cart())
    watched.loop.reload()
    watched.runs(2.0)
    assert "refused" not in watched.status()


def test_given_a_dry_run_that_is_refused_then_the_status_stays() -> None:
    watched = Watched()
    load = watched.supervision.loading(lambda wish, state: ModelLoaded(wish.request, why="no"))
    load(LoadModel(ReloadModel(RequestHeader(1, "REPLY_TEST"), True)), watched.loop.state)
    watched.runs(2.0)
    assert "refused" not in watched.status()


def test_given_what_the_service_has_to_say_of_itself_then_the_status_has_it() -> None:
    watched = Watched()
    watched.runs(1.0, "imu")
    assert "1 sensor heard" in watched.status()
    watched.loop.step(Noticed("journal", "the disk is full\nREADY=0"), watched.clock.now())
    watched.runs(2.0, "imu")
    assert "journal: the disk is full\\nREADY=0" in watched.status()


def test_given_a_pose_that_is_not_valid_then_the_status_says_why() -> None:
    watched = Watched(Scripted(invalid=Invalid.TILTED))
    watched.runs(2.0, "gps", "imu")
    assert "no valid pose: gravity says" in watched.status()


def test_given_an_end_of_any_kind_then_it_is_told() -> None:
    watched = Watched()

    def end() -> None:
        with watched.supervision.ending():
            raise LookupError

    with pytest.raises(LookupError):
        end()
    assert watched.told == ["STOPPING=1\nSTATUS=ending"]


def test_given_nobody_to_tell_then_nothing_is_worked_out() -> None:
    supervision = Supervision(Notifier(None), FakeClock(), lambda channel: pytest.fail("nobody asked"))
    supervision.ticked(started(Throwing(last=0)))
