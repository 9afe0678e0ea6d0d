"""The real daemon as a process of its own."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support_browser import start_browser
from support_command import run_command
from support_lcm import TIMEOUT_S, Listener, reserved_url, wait_until
from support_samples import GEOMETRY, VEHICLE, drive, write_vehicle
from support_signing import ALLOWED, write_test_key

from modelserver.client.remote import Platform
from modelserver.errors import TooNewError
from modelserver.messages import Health
from modelserver.signing import MAX_CLOCK_LEAD_S
from modelserver.wire.codec import decode, encode

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FAST_HEALTH = VEHICLE + "publish: {rate_hz: 50, health_hz: 20}\n"
"""Health comes often, so that a test need not wait for it."""


@dataclass
class Daemon:
    """A serving daemon process and a listener on its bus."""

    url: str
    folder: Path
    process: subprocess.Popen[str]
    listener: Listener
    last_utime: int = 0
    """The stamp of the newest sample of `feed`."""
    _platforms: list[Platform] = field(default_factory=list)

    def platform(self, **options: Any) -> Platform:
        """Return a client with a long timeout."""
        options = dict[str, Any](timeout=TIMEOUT_S, retries=0, name="test") | options
        self._platforms.append(Platform(self.url, **options))
        return self._platforms[-1]

    def publish(self, channel: str, data: bytes) -> None:
        self.listener.bus.publish(channel, data)

    def feed(self, seconds: float = 10.0) -> int:
        """Publish a drive that ends now, and return when the daemon has processed it.

        Leveling on the move takes its first five seconds.
        """
        begin = time.time_ns() // 1000 - round(seconds * 1e6)
        for sample in drive(seconds, begin):
            self.publish("GPS" if type(sample).__name__ == "GpsSample" else "IMU", encode(sample))
            self.last_utime = sample.header.utime
        deadline = time.monotonic() + TIMEOUT_S
        with Platform(self.url, name="feeder", timeout=TIMEOUT_S, retries=0) as platform:
            while True:
                try:
                    platform.get_state_vector(at=self.last_utime, wait_ms=2000)
                except TooNewError:
                    # the server bounds its wait; a busy machine may need more
                    if time.monotonic() > deadline:
                        raise
                else:
                    return self.last_utime

    def health(self, is_enough: Callable[[Health], bool] = lambda health: True) -> Health:
        """Return the first health report from now on for which `is_enough` holds."""
        while self.listener.bus.handle_timeout(0):
            pass  # discard queued reports
        self.listener.received.clear()
        found: list[Health] = []

        def is_found() -> bool:
            found.extend(decode("health_t", data) for data in self.listener.received)
            self.listener.received.clear()
            return any(map(is_enough, found))

        assert wait_until(self.listener.bus, is_found), found[-1:]
        return next(filter(is_enough, found))

    def wait_for_rejections(
        self, is_enough: Callable[[dict[tuple[str, str], int]], bool]
    ) -> dict[tuple[str, str], int]:
        """Return the rejection counts by channel and reason, once `is_enough` holds for them."""
        health = self.health(lambda health: is_enough({(name, why): count for name, why, count in health.rejected}))
        return {(name, why): count for name, why, count in health.rejected}

    @property
    def log(self) -> str:
        return (self.folder / "daemon.log").read_text()

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send the daemon a signal; return its exit code."""
        self.process.send_signal(number)
        return self.process.wait(TIMEOUT_S)


@contextmanager
def daemon_at(
    url: str, folder: Path, vehicle: str = FAST_HEALTH, geometry: str = GEOMETRY, prefix: str = ""
) -> Iterator[Daemon]:
    """Run a daemon until the block ends, with the state directory of an earlier run if there is one."""
    path = write_vehicle(folder, vehicle, geometry)
    listener = Listener(url, f"{prefix}MODELSERVER_HEALTH")
    with (
        (folder / "daemon.log").open("w") as errors,
        run_command(["run", "-c", path], url, stderr=errors) as process,
    ):
        daemon = Daemon(url, folder, process, listener)
        # its own log too: there may be another daemon on the bus
        assert wait_until(
            listener.bus, lambda: process.poll() is not None or (bool(listener.received) and " serves " in daemon.log)
        ), daemon.log
        assert process.poll() is None, daemon.log
        try:
            yield daemon
        finally:
            for platform in daemon._platforms:
                platform.close()
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)


@pytest.fixture
def start_daemon(lcm_url: str, tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    """Return a function that starts a daemon on this test's bus; all end with the test."""
    with ExitStack() as stack:

        def start(vehicle: str = FAST_HEALTH, folder: Path = tmp_path, **options: str) -> Daemon:
            folder.mkdir(exist_ok=True)
            return stack.enter_context(daemon_at(lcm_url, folder, vehicle, **options))

        yield start


@pytest.fixture
def start_signed(
    start_daemon: Callable[..., Daemon], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Daemon]:
    """Return a function that starts a daemon with signed commands; clients and tools of this test have the key."""

    def start(vehicle: str = FAST_HEALTH + ALLOWED, folder: Path = tmp_path, **options: str) -> Daemon:
        folder.mkdir(exist_ok=True)
        monkeypatch.setenv("MODELSERVER_KEY_FILE", str(write_test_key(folder)))
        daemon = start_daemon(vehicle, folder, **options)
        # replay protection: it accepts no command that may be older than its start
        daemon.health(lambda health: health.uptime > MAX_CLOCK_LEAD_S + 0.1)
        return daemon

    return start


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """Yield a daemon that has processed a drive; the tests of a module share it and leave it running."""
    with reserved_url() as url, daemon_at(url, tmp_path_factory.mktemp("daemon")) as daemon:
        daemon.feed()
        yield daemon


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with start_browser() as started:
        yield started
