"""The real daemon as a process of its own."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from support_lcm import MODELSERVER, PATIENCE_S, Listener, reserved_url, started, wait_until
from support_samples import GEOMETRY, VEHICLE, drive, write_vehicle
from support_signing import ALLOWED, write_test_key

from modelserver.client.remote import Platform
from modelserver.errors import TooNewError
from modelserver.messages import Health
from modelserver.signing import AHEAD_S
from modelserver.wire.codec import decode, encode

BRISK = VEHICLE + "publish: {rate_hz: 50, health_hz: 20}\n"
"""Health comes often, so that a test need not wait for it."""


@dataclass
class Daemon:
    """A daemon that has begun to speak, and a place on its bus."""

    url: str
    folder: Path
    process: subprocess.Popen[str]
    listener: Listener
    last_utime: int = 0
    """The stamp of the newest sample of `fed`."""
    _platforms: list[Platform] = field(default_factory=list)

    def platform(self, **options: Any) -> Platform:
        """A client with more patience than one outside tests needs."""
        options = dict[str, Any](timeout=PATIENCE_S, retries=0, name="test") | options
        self._platforms.append(Platform(self.url, **options))
        return self._platforms[-1]

    def publish(self, channel: str, data: bytes) -> None:
        self.listener.bus.publish(channel, data)

    def fed(self, seconds: float = 10.0) -> int:
        """Publish a drive that ends now, and return when the daemon knows it all.

        Levelling on the move takes the first five seconds of it.
        """
        begin = time.time_ns() // 1000 - round(seconds * 1e6)
        for sample in drive(seconds, begin):
            self.publish("GPS" if type(sample).__name__ == "GpsSample" else "IMU", encode(sample))
            self.last_utime = sample.header.utime
        deadline = time.monotonic() + PATIENCE_S
        with Platform(self.url, name="feeder", timeout=PATIENCE_S, retries=0) as platform:
            while True:
                try:
                    platform.get_state_vector(at=self.last_utime, wait_ms=2000)
                except TooNewError:
                    # the server waits for so long and no longer; a busy machine may need more
                    if time.monotonic() > deadline:
                        raise
                else:
                    return self.last_utime

    def health(self, enough: Callable[[Health], bool] = lambda health: True) -> Health:
        """Return the first health report from now on that is as wanted."""
        while self.listener.bus.handle_timeout(0):
            pass  # what waits there is of before
        self.listener.heard.clear()
        found: list[Health] = []

        def arrived() -> bool:
            found.extend(decode("health_t", data) for data in self.listener.heard)
            self.listener.heard.clear()
            return any(map(enough, found))

        assert wait_until(self.listener.bus, arrived), found[-1:]
        return next(filter(enough, found))

    def rejected(self, enough: Callable[[dict[tuple[str, str], int]], bool]) -> dict[tuple[str, str], int]:
        """Return what was rejected, by channel and reason, once it is as wanted."""
        health = self.health(lambda health: enough({(name, why): count for name, why, count in health.rejected}))
        return {(name, why): count for name, why, count in health.rejected}

    @property
    def log(self) -> str:
        return (self.folder / "daemon.log").read_text()

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Ask the daemon to end; return its exit code."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)


@contextmanager
def daemon_at(
    url: str, folder: Path, vehicle: str = BRISK, geometry: str = GEOMETRY, prefix: str = ""
) -> Iterator[Daemon]:
    """Run a daemon until the block ends. A state directory that is there is used again."""
    path = write_vehicle(folder, vehicle, geometry)
    listener = Listener(url, f"{prefix}MODELSERVER_HEALTH")
    with (
        (folder / "daemon.log").open("w") as errors,
        started([*MODELSERVER, "run", "-c", path], url, stderr=errors) as process,
    ):
        daemon = Daemon(url, folder, process, listener)
        # its own log too, for there may be another daemon on the bus
        assert wait_until(
            listener.bus, lambda: process.poll() is not None or (bool(listener.heard) and " serves " in daemon.log)
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
    """A function that starts a daemon on this test's bus; all end with the test."""
    with ExitStack() as stack:

        def start(vehicle: str = BRISK, folder: Path = tmp_path, **options: str) -> Daemon:
            folder.mkdir(exist_ok=True)
            return stack.enter_context(daemon_at(lcm_url, folder, vehicle, **options))

        yield start


@pytest.fixture
def start_signed(
    start_daemon: Callable[..., Daemon], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Daemon]:
    """A function that starts a daemon that obeys who signs; clients and tools of this test have the key."""

    def start(vehicle: str = BRISK + ALLOWED, folder: Path = tmp_path, **options: str) -> Daemon:
        folder.mkdir(exist_ok=True)
        monkeypatch.setenv("MODELSERVER_KEY_FILE", str(write_test_key(folder)))
        daemon = start_daemon(vehicle, folder, **options)
        # before, it takes nothing that it might have taken before it started
        daemon.health(lambda health: health.uptime > AHEAD_S + 0.1)
        return daemon

    return start


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon that has seen a drive; the tests of a module share it and leave it running."""
    with reserved_url() as url, daemon_at(url, tmp_path_factory.mktemp("daemon")) as daemon:
        daemon.fed()
        yield daemon
