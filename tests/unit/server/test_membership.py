"""Membership in the multicast group: join, loss, rejoin."""

from __future__ import annotations

import errno
import logging

import pytest

from modelserver.server import bus as membership
from modelserver.server.bus import MulticastMembership


class Kernel:
    """A socket whose joins return a list of errors; 0 is success."""

    def __init__(self, *answers: int):
        self.answers = list(answers)
        self.open = 0

    def __call__(self, *_: object) -> Kernel:
        self.open += 1
        return self

    def setsockopt(self, *_: object) -> None:
        answer = self.answers.pop(0)
        if answer:
            raise OSError(answer, "kernel error")

    def close(self) -> None:
        self.open -= 1


def test_given_an_interface_that_goes_and_comes_then_it_is_rejoined_and_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel = Kernel(0, errno.EADDRINUSE, errno.ENODEV, errno.ENODEV, 0, errno.EADDRINUSE)
    monkeypatch.setattr(membership.socket, "socket", kernel)
    found = MulticastMembership("udpm://239.255.76.67:7667?ttl=0&recv_buf_size=1")
    with caplog.at_level(logging.WARNING):
        assert [found.renew() for _ in range(5)] == [True, False, False, True, True]
    assert [record.message.partition(":")[0] for record in caplog.records] == [
        "the bus is unreachable",
        "the bus is reachable again",
    ]
    assert "ip route get 239.255.76.67" in caplog.records[0].message
    assert kernel.open == 1
    found.close()
    assert kernel.open == 0


@pytest.mark.parametrize("url", ["", "memq://", "udpm://", "udpm://nowhere:7667", "udpm://999.1.1.1:7", "file:///x"])
def test_given_a_provider_without_a_group_then_nothing_is_joined(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership.socket, "socket", Kernel())
    assert MulticastMembership(url).renew()
