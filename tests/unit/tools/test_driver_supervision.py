"""A driver under a service manager: a device that is away is no reason to end it, a driver that only fails is."""

from __future__ import annotations

from collections import Counter
from typing import Any, cast

from modelserver.messages import DriverPhase
from modelserver.server.supervision import STALL_TIMEOUT_S, Notifier
from msdrivers.runner import Runner
from mstools.commands.driver import supervise


class Runs:
    """A runner's state, and a service manager that records its notifications."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.samples = 0
        self.state = (DriverPhase.CLOSED, "/dev/ttyUSB0: there is no such port")
        self.now_ns = 10**9
        self.datagrams: list[str] = []
        notifier = Notifier(lambda datagram: self.datagrams.append(datagram.decode()), 10**9, lambda: self.now_ns)
        self.attended = 0
        self.attend = supervise(cast(Runner[Any], self), notifier, self._count, lambda: self.now_ns)

    def _count(self) -> None:
        self.attended += 1

    def runs(self, seconds: float, *, samples: int = 0, errors: int = 0) -> int:
        """Make passes at 50 Hz; return how many signs of life were given."""
        self.datagrams.clear()
        for _ in range(round(seconds * 50)):
            self.samples += samples
            self.counts["errors.on_receive"] += errors
            self.attend()
            self.now_ns += 10**9 // 50
        return self.datagrams.count("WATCHDOG=1")


def test_given_a_device_that_is_away_then_the_driver_is_ready_and_lives() -> None:
    driver = Runs()
    driver.attend()
    assert driver.datagrams == []
    driver.attend()
    assert driver.datagrams == ["READY=1\nSTATUS=closed: /dev/ttyUSB0: there is no such port"]
    driver.counts["commands_dropped"] = 3
    assert driver.runs(60.0) >= 60
    assert driver.attended == 3002


def test_given_a_driver_that_measures_then_the_status_reports_it() -> None:
    driver = Runs()
    driver.runs(1.0)
    driver.state = (DriverPhase.STREAMING, "")
    driver.runs(2.0, samples=1, errors=1)
    assert "STATUS=streaming" in driver.datagrams


def test_given_a_driver_that_only_fails_then_signs_of_life_end() -> None:
    driver = Runs()
    driver.runs(1.0)
    driver.runs(STALL_TIMEOUT_S + 0.5, errors=1)
    assert driver.runs(10.0, errors=1) == 0


def test_given_nobody_to_report_then_only_what_was_to_be_done_is_done() -> None:
    def attend() -> None:
        """Do it."""

    assert supervise(cast(Runner[Any], None), Notifier(None), attend) is attend
