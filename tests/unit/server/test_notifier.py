"""Notifications of the service manager, datagram by datagram."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from modelserver.server.supervision import MAX_STATUS_LENGTH, Notifier, get_watchdog_ns, open_manager_socket

SECOND = 1_000_000_000


class RecordingManager:
    """A clock and a service manager that records its datagrams."""

    def __init__(self, watchdog_s: float = 3.0):
        self.now_ns = 5 * SECOND
        self.datagrams: list[str] = []
        self.notifier = Notifier(self._take, round(watchdog_s * SECOND), lambda: self.now_ns)

    def _take(self, datagram: bytes) -> None:
        self.datagrams.append(datagram.decode())

    def pop(self) -> list[str]:
        """Return the datagrams since the last call."""
        found, self.datagrams = self.datagrams, []
        return found


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    """A service manager's socket, and its NOTIFY_SOCKET."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        if request.param == "path":
            given = str(tmp_path / "notify")
            there.bind(given)
        else:
            there.bind("")  # the kernel gives an abstract name
            given = "@" + there.getsockname()[1:].decode()
        yield given, there


def test_given_a_manager_then_it_is_notified(manager: tuple[str, socket.socket]) -> None:
    given, there = manager
    send = open_manager_socket({"NOTIFY_SOCKET": given})
    assert send is not None
    Notifier(send).notify_ready("serving")
    assert there.recv(1000) == b"READY=1\nSTATUS=serving"


def test_given_a_manager_that_is_gone_or_does_not_read_then_nothing_happens(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    send = open_manager_socket({"NOTIFY_SOCKET": str(path)})
    assert send is not None
    send(b"READY=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.bind(str(path))
        for _ in range(1000):
            send(b"WATCHDOG=1")


@pytest.mark.parametrize("given", ["", "@", "relative/path", "vsock:2:9"])
def test_given_no_socket_to_send_to_then_nothing_is_sent(given: str) -> None:
    assert open_manager_socket({"NOTIFY_SOCKET": given}) is None
    notifier = Notifier(None)
    notifier.notify_starting("reading")
    notifier.notify_ready("serving")
    notifier.update_status(lambda: pytest.fail("nobody asks for it"))
    notifier.notify_reloading()
    notifier.notify_reloaded()
    notifier.notify_stopping()
    assert not notifier.is_active


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, 0),
        ({"WATCHDOG_USEC": "3000000"}, 3 * SECOND),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "7"}, 3 * SECOND),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "8"}, 0),
        ({"WATCHDOG_USEC": "soon"}, 0),
        ({"WATCHDOG_USEC": "-1"}, 0),
        ({"WATCHDOG_USEC": "²"}, 0),
    ],
)
def test_given_an_environment_then_the_watchdogs_time_is_read(environment: dict[str, str], expected: int) -> None:
    assert get_watchdog_ns(environment, pid=7) == expected


def test_given_a_start_then_each_step_is_reported_and_extends_the_timeout() -> None:
    recorder = RecordingManager()
    recorder.notifier.notify_starting("reading vehicle.yaml", 10.0)
    assert recorder.pop() == ["STATUS=reading vehicle.yaml\nEXTEND_TIMEOUT_USEC=10000000"]
    recorder.notifier.notify_ready("serving")
    recorder.notifier.notify_starting("late")
    assert recorder.pop() == ["READY=1\nSTATUS=serving"]


def test_given_signs_of_life_then_a_few_of_them_are_sent() -> None:
    recorder = RecordingManager(watchdog_s=4.0)
    for _ in range(200):
        recorder.notifier.ping_watchdog()
        recorder.now_ns += SECOND // 50
    assert recorder.pop() == ["WATCHDOG=1"] * 4


def test_given_no_watchdog_then_no_sign_of_life_is_sent() -> None:
    recorder = RecordingManager(watchdog_s=0.0)
    recorder.notifier.ping_watchdog()
    assert recorder.pop() == []


def test_given_a_status_then_it_is_sent_once_a_second_at_most_and_on_change_only() -> None:
    recorder = RecordingManager()
    recorder.notifier.notify_ready("a")
    recorder.notifier.update_status(lambda: "b")
    recorder.now_ns += SECOND
    recorder.notifier.update_status(lambda: "a")
    recorder.now_ns += SECOND
    recorder.notifier.update_status(lambda: "c")
    recorder.notifier.update_status(lambda: "d")
    assert recorder.pop() == ["READY=1\nSTATUS=a", "STATUS=c"]


def test_given_a_status_with_lines_of_its_own_then_it_is_one_line_and_not_too_long() -> None:
    recorder = RecordingManager()
    recorder.notifier.notify_ready("a\nWATCHDOG=trigger\x1b[2J" + "x" * 1000)
    (datagram,) = recorder.pop()
    assert datagram.startswith("READY=1\nSTATUS=a\\nWATCHDOG=trigger\\x1b[2Jxx")
    assert len(datagram.splitlines()) == 2
    assert len(datagram.splitlines()[1]) == MAX_STATUS_LENGTH + len("STATUS=")


def test_given_a_reload_then_its_begin_and_end_are_notified() -> None:
    recorder = RecordingManager()
    recorder.notifier.notify_ready("serving")
    recorder.pop()
    recorder.notifier.notify_reloading()
    assert recorder.pop() == ["RELOADING=1\nMONOTONIC_USEC=5000000\nSTATUS=reloading the geometry"]
    recorder.notifier.notify_reloaded()
    assert recorder.pop() == ["READY=1\nSTATUS=serving"]
