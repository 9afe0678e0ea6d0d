"""Real processes under a service manager of the test's own: a start that is refused waits, then ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from support_lcm import MODELSERVER, TIMEOUT_S, Listener, run_process, wait_until
from support_samples import GEOMETRY, VEHICLE, write_vehicle

WRONG = f"{VEHICLE}sensers: {{}}\n"


class Manager:
    """A service manager's socket; `wait_for` reads until a text was received."""

    def __init__(self, there: socket.socket):
        self._there = there

    def wait_for(self, words: str) -> str:
        output = ""
        while words not in output:
            output = self._there.recv(4096).decode()
        return output


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.bind(str(tmp_path / "notify"))
        there.settimeout(TIMEOUT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield Manager(there)


Begin = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def begin(manager: Manager, lcm_url: str, tmp_path: Path) -> Iterator[Begin]:
    """A function that starts a command on the vehicle file; what it writes to stderr goes to the file log."""
    with ExitStack() as stack:

        def command(*words: str) -> subprocess.Popen[str]:
            log = stack.enter_context((tmp_path / "log").open("w"))
            arguments = [*MODELSERVER, *words, "-c", tmp_path / "vehicle.yaml"]
            return stack.enter_context(run_process(arguments, lcm_url, stderr=log))

        yield command


def fix_file(folder: Path, text: str) -> None:
    """Put a vehicle file in the place of one, whole."""
    (folder / "fresh").write_text(text)
    (folder / "fresh").replace(folder / "vehicle.yaml")


@pytest.mark.parametrize("words", [("run",), ("driver", "gps")], ids=["service", "driver"])
def test_given_a_wrong_vehicle_file_then_it_is_reported_once_and_the_start_ends_later(
    begin: Begin, manager: Manager, tmp_path: Path, words: tuple[str, ...]
) -> None:
    write_vehicle(tmp_path, WRONG, GEOMETRY)
    process = begin(*words)
    output = manager.wait_for("start failed")
    assert "sensers" in output
    assert "EXTEND_TIMEOUT_USEC" in output
    # what is wrong is in the log before the wait begins
    log = (tmp_path / "log").read_text()
    assert "sensers" in log
    assert process.poll() is None
    fix_file(tmp_path, VEHICLE)
    assert process.wait(TIMEOUT_S) == 1
    assert (tmp_path / "log").read_text() == log


def test_given_a_geometry_that_is_not_there_then_the_start_ends_later_and_the_next_one_serves(
    begin: Begin, manager: Manager, tmp_path: Path
) -> None:
    write_vehicle(tmp_path, VEHICLE, GEOMETRY)
    (tmp_path / "geometry.yaml").rename(tmp_path / "aside.yaml")
    process = begin("run")
    assert "geometry.yaml cannot be read" in manager.wait_for("start failed")
    (tmp_path / "aside.yaml").rename(tmp_path / "geometry.yaml")
    assert process.wait(TIMEOUT_S) == 1
    again = begin("run")
    manager.wait_for("READY=1")
    again.send_signal(signal.SIGTERM)
    assert again.wait(TIMEOUT_S) == 0


def test_given_sigterm_while_it_waits_then_it_ends_at_once(begin: Begin, manager: Manager, tmp_path: Path) -> None:
    write_vehicle(tmp_path, WRONG, GEOMETRY)
    process = begin("run")
    manager.wait_for("start failed")
    process.send_signal(signal.SIGTERM)
    assert process.wait(TIMEOUT_S) == -signal.SIGTERM


def test_given_closed_standard_streams_then_the_service_runs_and_no_socket_or_file_has_their_numbers(
    lcm_url: str, tmp_path: Path
) -> None:
    path = write_vehicle(tmp_path, VEHICLE)
    listener = Listener(lcm_url, "MODELSERVER_HEALTH")
    with run_process(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *MODELSERVER, "run", "-c", path], lcm_url) as process:
        assert wait_until(listener.bus, lambda: bool(listener.received) or process.poll() is not None)
        assert process.poll() is None
        streams = {os.readlink(f"/proc/{process.pid}/fd/{number}") for number in range(3)}
    assert streams == {"/dev/null"}
    assert process.returncode == 0
