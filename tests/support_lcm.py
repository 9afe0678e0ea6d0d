"""The real bus and the real daemon for tests: a port of its own for each, waiting on events, ending by pid."""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import lcm
import pytest

from mstools.cli import main

TIMEOUT_S = 60.0
"""Seconds that a test waits for a message or process; only a failing test waits that long."""


@contextmanager
def reserved_url() -> Iterator[str]:
    """Yield an LCM provider on loopback whose port no other test on this machine uses.

    The port is held by a TCP socket of the same number: that leaves its UDP side to LCM. It lies below the ports
    that the kernel hands out by itself.
    """
    with socket.socket() as holder:
        for port in random.SystemRandom().sample(range(20_000, 32_000), 100):
            try:
                holder.bind(("127.0.0.1", port))
            except OSError:
                continue
            yield f"udpm://239.255.76.67:{port}?ttl=0"
            return
    raise RuntimeError("no free port")


def wait_until(bus: lcm.LCM, is_done: Callable[[], bool], seconds: float = TIMEOUT_S) -> bool:
    """Handle messages until `is_done`; return whether that was in time."""
    deadline = time.monotonic() + seconds
    while not is_done():
        left = deadline - time.monotonic()
        if left <= 0:
            return False
        bus.handle_timeout(int(min(left, 1.0) * 1000) + 1)
    return True


class Listener:
    """Subscriber of one channel; `received` fills while the bus is handled."""

    def __init__(self, url: str, channel: str):
        self.received: list[bytes] = []
        self.bus = lcm.LCM(url)
        received = self.received
        # not self: a handler that refers to its bus keeps it open
        self.bus.subscribe(re.escape(channel), lambda _, data: received.append(data))

    def wait(self, count: int = 1, seconds: float = TIMEOUT_S) -> bool:
        """Return whether `count` messages were received in time."""
        return wait_until(self.bus, lambda: len(self.received) >= count, seconds)


@contextmanager
def run_process(arguments: Sequence[str | Path], url: str, **options: object) -> Iterator[subprocess.Popen[str]]:
    """Run a program on the bus at `url` until the block ends, then end it by its pid."""
    environment = os.environ | {"LCM_DEFAULT_URL": url}
    process: subprocess.Popen[str] = subprocess.Popen(
        list(map(str, arguments)),
        env=environment,
        text=True,
        **options,  # type: ignore[call-overload]
    )
    try:
        yield process
    finally:
        end_process(process)


def end_process(process: subprocess.Popen[str]) -> None:
    """End a process by SIGTERM. One that does not end is killed, and raises subprocess.TimeoutExpired."""
    process.terminate()
    try:
        process.wait(TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


MODELSERVER = (sys.executable, "-c", "from mstools.cli import main; main()")
"""The `modelserver` command of the environment that runs the tests."""


def invoke(url: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a `modelserver` command on the bus at `url` within this process, where a process is not what is tested.

    That saves the imports, half a second of processor time each.
    """
    out, err = io.StringIO(), io.StringIO()
    words = list(map(str, arguments))
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setenv("LCM_DEFAULT_URL", url)
        patch.delenv("DISPLAY", raising=False)
        with pytest.raises(SystemExit) as ended:
            main(words)
    code = ended.value.code or 0
    assert isinstance(code, int), code
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


@contextmanager
def running_daemon(vehicle_file: Path, folder: Path) -> Iterator[str]:
    """Run the daemon for a vehicle file, its state and log in `folder`; yield the URL of its bus once it speaks."""
    log = folder / "daemon.log"
    with reserved_url() as url, log.open("w") as errors:
        listener = Listener(url, "MODELSERVER_HEALTH")
        arguments = ("env", f"XDG_STATE_HOME={folder}", *MODELSERVER, "run", "-c", vehicle_file)
        with run_process(arguments, url, stderr=errors) as process:
            assert wait_until(listener.bus, lambda: bool(listener.received) or process.poll() is not None), (
                log.read_text()
            )
            assert process.poll() is None, log.read_text()
            yield url
