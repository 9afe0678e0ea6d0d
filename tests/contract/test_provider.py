"""What holds of liblcm itself and what we make of it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import lcm
import pytest
from support_lcm import reserved_url

from modelserver.wire.provider import take_message

WAIT_MS = 1000


@contextmanager
def alarms(period: float = 0.005) -> Iterator[list[int]]:
    """Have this process interrupted again and again; yields the signals that came."""
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


def test_given_a_signal_while_liblcm_waits_then_it_raises_without_an_errno(bus: lcm.LCM) -> None:
    with alarms(), pytest.raises(OSError, match=r"^lcm_handle_timeout\(\) returned -1$") as raised:
        bus.handle_timeout(WAIT_MS)
    assert raised.value.errno is None


def test_given_a_signal_while_a_message_is_waited_for_then_nothing_has_come_and_nothing_raises(bus: lcm.LCM) -> None:
    with alarms() as came:
        assert not take_message(bus, WAIT_MS)
    assert came
    heard: list[bytes] = []
    bus.subscribe("A", lambda _, data: heard.append(data))
    bus.publish("A", b"data")
    assert take_message(bus, WAIT_MS)
    assert heard == [b"data"]


def test_given_a_handler_that_raises_then_its_error_comes_out(bus: lcm.LCM) -> None:
    def fail(_: str, data: bytes) -> None:
        raise OSError(5, data.decode())

    bus.subscribe("A", fail)
    bus.publish("A", b"disk")
    with pytest.raises(OSError, match="disk"):
        take_message(bus, WAIT_MS)
