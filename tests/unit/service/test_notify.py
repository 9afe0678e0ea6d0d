"""What a service manager is told, datagram for datagram."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from modelserver.service.supervision.notify import LONGEST_STATUS, Notifier, manager_socket, watchdog_ns

SECOND = 1_000_000_000


class Told:
    """A clock and a service manager that writes down what it is told."""

    def __init__(self, watchdog_s: float = 3.0):
        self.now_ns = 5 * SECOND
        self.datagrams: list[str] = []
        self.notifier = Notifier(self._take, round(watchdog_s * SECOND), lambda: self.now_ns)

    def _take(self, datagram: bytes) -> None:
        self.datagrams.append(datagram.decode())

    def taken(self) -> list[str]:
        """Return what was told since the last call."""
        found, self.datagrams = self.datagrams, []
        return found


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    """A service manager's socket, and what NOTIFY_SOCKET says of it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        if request.param == "path":
            given = str(tmp_path / "notify")
            there.bind(given)
        else:
            there.bind("")  # the kernel gives an abstract name
            given = "@" + there.getsockname()[1:].decode()
        yield given, there


def test_given_a_manager_then_it_is_told(manager: tuple[str, socket.socket]) -> None:
    given, there = manager
    send = manager_socket({"NOTIFY_SOCKET": given})
    assert send is not None
    Notifier(send).ready("serving")
    assert there.recv(1000) == b"READY=1\nSTATUS=serving"


def test_given_a_manager_that_is_gone_or_does_not_read_then_nothing_happens(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    send = manager_socket({"NOTIFY_SOCKET": str(path)})
    assert send is not None
    send(b"READY=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.bind(str(path))
        for _ in range(1000):
            send(b"WATCHDOG=1")


@pytest.mark.parametrize("given", ["", "@", "relative/path", "vsock:2:9"])
def test_given_no_socket_to_send_to_then_nobody_is_told(given: str) -> None:
    assert manager_socket({"NOTIFY_SOCKET": given}) is None
    notifier = Notifier(None)
    notifier.starting("reading")
    notifier.ready("serving")
    notifier.status(lambda: pytest.fail("nobody asks for it"))
    with notifier.reloading():
        pass
    notifier.stopping()
    assert not notifier.is_heard


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
    assert watchdog_ns(environment, pid=7) == expected


def test_given_a_start_then_each_step_is_told_and_may_take_long() -> None:
    told = Told()
    told.notifier.starting("reading vehicle.yaml", 10.0)
    assert told.taken() == ["STATUS=reading vehicle.yaml\nEXTEND_TIMEOUT_USEC=10000000"]
    told.notifier.ready("serving")
    told.notifier.starting("late")
    assert told.taken() == ["READY=1\nSTATUS=serving"]


def test_given_signs_of_life_then_a_few_of_them_are_sent() -> None:
    told = Told(watchdog_s=4.0)
    for _ in range(200):
        told.notifier.alive()
        told.now_ns += SECOND // 50
    assert told.taken() == ["WATCHDOG=1"] * 4


def test_given_no_watchdog_then_no_sign_of_life_is_sent() -> None:
    told = Told(watchdog_s=0.0)
    told.notifier.alive()
    assert told.taken() == []


def test_given_a_status_then_it_is_told_once_a_second_at_most_and_on_change_only() -> None:
    told = Told()
    told.notifier.ready("a")
    told.notifier.status(lambda: "b")
    told.now_ns += SECOND
    told.notifier.status(lambda: "a")
    told.now_ns += SECOND
    told.notifier.status(lambda: "c")
    told.notifier.status(lambda: "d")
    assert told.taken() == ["READY=1\nSTATUS=a", "STATUS=c"]


def test_given_a_status_with_lines_of_its_own_then_it_is_one_line_and_not_too_long() -> None:
    told = Told()
    told.notifier.ready("a\nWATCHDOG=trigger\x1b[2J" + "x" * 1000)
    (datagram,) = told.taken()
    assert datagram.startswith("READY=1\nSTATUS=a\\nWATCHDOG=trigger\\x1b[2Jxx")
    assert len(datagram.splitlines()) == 2
    assert len(datagram.splitlines()[1]) == LONGEST_STATUS + len("STATUS=")


def test_given_a_reload_then_it_is_told_and_has_a_watchdog_of_its_own() -> None:
    told = Told()
    told.notifier.ready("serving")
    told.taken()
    with told.notifier.reloading(60.0):
        (begun,) = told.taken()
        told.now_ns += 20 * SECOND
    (ended,) = told.taken()
    assert begun.splitlines() == [
        "RELOADING=1", "MONOTONIC_USEC=5000000", "STATUS=reading the geometry anew", "WATCHDOG_USEC=60000000",
        "WATCHDOG=1",
    ]  # fmt: skip
    assert ended.splitlines() == ["READY=1", "STATUS=serving", "WATCHDOG_USEC=3000000", "WATCHDOG=1"]


def test_given_a_reload_that_throws_then_it_is_over_all_the_same() -> None:
    told = Told()

    def reload() -> None:
        with told.notifier.reloading():
            raise LookupError

    with pytest.raises(LookupError):
        reload()
    assert told.taken()[-1].startswith("READY=1")
