"""Properties of liblcm and of the provider on it."""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

import lcm
import pytest
from support_lcm import TIMEOUT_S, reserved_url

from modelserver import Platform, PlatformMirror, SensorPublisher
from modelserver.errors import BusError
from modelserver.server.bus import LcmBus
from modelserver.wire.provider import SELECT_LIMIT, find_url_problem, handle_message, open_lcm
from mstools.commands.status import DaemonListener

WAIT_MS = 1000


@contextmanager
def alarms(period: float = 0.005) -> Iterator[list[int]]:
    """Interrupt this process repeatedly; yield the received signals."""
    came: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: came.append(number))
    signal.setitimer(signal.ITIMER_REAL, period, period)
    try:
        yield came
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def bus() -> Iterator[lcm.LCM]:
    with reserved_url() as url:
        yield lcm.LCM(url)


def wait_again_and_again(bus: lcm.LCM) -> None:
    """Wait several times: a self-test message of a new LCM instance may end the first wait."""
    for _ in range(5):
        bus.handle_timeout(WAIT_MS)


def test_given_a_signal_while_liblcm_waits_then_it_raises_without_an_errno(bus: lcm.LCM) -> None:
    with alarms(), pytest.raises(OSError, match=r"^lcm_handle_timeout\(\) returned -1$") as raised:
        wait_again_and_again(bus)
    assert raised.value.errno is None


def test_given_a_signal_while_a_message_is_waited_for_then_nothing_has_come_and_nothing_raises(bus: lcm.LCM) -> None:
    with alarms() as came:
        # LCM's self-test message may come first
        assert not all(handle_message(bus, WAIT_MS) for _ in range(5))
    assert came
    received: list[bytes] = []
    bus.subscribe("A", lambda _, data: received.append(data))
    bus.publish("A", b"data")
    assert handle_message(bus, WAIT_MS)
    assert received == [b"data"]


def test_given_a_handler_that_raises_then_its_error_comes_out(bus: lcm.LCM) -> None:
    def fail(_: str, data: bytes) -> None:
        raise OSError(5, data.decode())

    bus.subscribe("A", fail)
    bus.publish("A", b"disk")
    with pytest.raises(OSError, match="disk"):
        handle_message(bus, WAIT_MS)


@pytest.mark.parametrize(
    "url",
    [
        "nonsense",
        "nonsense://",
        "UDPM://239.255.76.67:7667",
        "udpm:239.255.76.67:7667",
        "udpm://nonsense",
        "udpm://:7667",
        "udpm://10.0.0.1:7667",
        "udpm://239.255.76.300:7667",
        "udpm://239.255.76.67:",
        "udpm://239.255.76.67:port",
        "udpm://239.255.76.67:99999",
        "udpm://239.255.76.67:-5",
        "mpudpm://10.0.0.1:7667",
        "mpudpm://239.255.76.67:99999",
        "file://",
    ],
)
def test_given_a_url_that_liblcm_rejects_then_the_error_names_the_fault_without_advice_on_routes(url: str) -> None:
    with pytest.raises(RuntimeError):
        lcm.LCM(url)
    with pytest.raises(BusError, match="cannot join the bus at ") as raised:
        open_lcm(url)
    assert "route" not in str(raised.value)


@pytest.mark.parametrize(
    ("url", "words"),
    [("file:///none/of/that/name", "Is there a log of that name"), ("tcpq://127.0.0.1:1", "TCP service")],
)
def test_given_another_provider_that_fails_then_the_error_names_what_to_check(url: str, words: str) -> None:
    assert not find_url_problem(url)
    with pytest.raises(BusError, match=words) as raised:
        open_lcm(url)
    assert "route" not in str(raised.value)


def test_given_two_users_of_memq_then_neither_receives_the_other() -> None:
    one, other, received = lcm.LCM("memq://"), lcm.LCM("memq://"), []
    other.subscribe("A", lambda _, data: received.append(data))
    one.publish("A", b"data")
    assert not handle_message(other)
    assert not received
    assert "does not leave the process" in find_url_problem("memq://")


@pytest.mark.parametrize("ttl", ["0", "00", "0&recv_buf_size=100000", "0&other=1"])
def test_given_a_valid_url_then_it_is_not_rejected(ttl: str) -> None:
    with reserved_url() as url:
        other = url.replace("ttl=0", f"ttl={ttl}")
        assert not find_url_problem(other)
        assert open_lcm(other)


def test_given_too_many_open_files_then_the_bus_is_refused_instead_of_memory_overwritten() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard if hard == resource.RLIM_INFINITY else max(soft, hard), hard))
    opened: list[int] = []
    try:
        with contextlib.suppress(OSError):
            while not opened or opened[-1] < SELECT_LIMIT:
                opened.append(os.open(os.devnull, os.O_RDONLY))
        with pytest.raises(BusError, match=r"open files|ulimit -n"):
            open_lcm("udpm://239.255.76.67:7667?ttl=0")
    finally:
        for each in opened:
            os.close(each)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def count_descriptors() -> int:
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


class OwnListener(DaemonListener):
    """A listener whose handler refers to itself."""

    def __init__(self, url: str):
        super().__init__(open_lcm(url), "", {"POSE": self.on_pose})

    def on_pose(self, _: object) -> None:
        pass


def test_given_what_has_left_the_bus_then_its_descriptors_are_closed(lcm_url: str) -> None:
    def use_all() -> None:
        bus = LcmBus(lcm_url)
        bus.sensors.subscribe("GPS", lambda *_: bus.wait(0.0))
        bus.close()
        with Platform(lcm_url) as platform:
            platform.subscribe_pose(print).close()
        with PlatformMirror(lcm_url), SensorPublisher("imu", url=lcm_url):
            pass
        OwnListener(lcm_url).listen(0.0, lambda: True)

    use_all()
    before = count_descriptors()
    for _ in range(3):
        use_all()
    # LCM closes some in a thread of its own
    deadline = time.monotonic() + TIMEOUT_S
    while count_descriptors() > before:
        assert time.monotonic() < deadline
