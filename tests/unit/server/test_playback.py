from __future__ import annotations

import math

import pytest

from modelserver.server.clock import FakeClock
from modelserver.server.recordings import Player
from modelserver.wire.eventlog import LogEvent


class Sent:
    """Published messages, with seconds of the fake clock from the start."""

    def __init__(self, speed: float, cost: float = 0.0):
        self.clock = FakeClock()
        self.start_ns = self.clock.monotonic_ns()
        self.cost = cost
        self.sent: list[tuple[float, str, bytes]] = []
        self.player = Player(self.publish, speed, self.clock, self.clock.advance)

    def publish(self, channel: str, data: bytes) -> None:
        self.sent.append(((self.clock.monotonic_ns() - self.start_ns) * 1e-9, channel, data))
        self.clock.advance(self.cost)

    @property
    def times(self) -> list[float]:
        return [time for time, _, _ in self.sent]


def log(*seconds: float) -> list[LogEvent]:
    return [LogEvent(n, 5_000_000 + round(s * 1e6), "C", bytes([n]), 0) for n, s in enumerate(seconds)]


@pytest.mark.parametrize(
    ("speed", "expected"), [(1.0, [0, 1, 1.5, 10]), (2.0, [0, 0.5, 0.75, 5]), (0.5, [0, 2, 3, 20])]
)
def test_given_a_speed_when_played_then_each_event_goes_out_at_its_time(speed: float, expected: list[float]) -> None:
    run = Sent(speed)
    run.player.play(log(0, 1, 1.5, 10))
    assert run.times == pytest.approx(expected, abs=1e-6)
    assert [data for _, _, data in run.sent] == [b"\0", b"\1", b"\2", b"\3"]
    assert (run.player.sent, run.player.duration) == (4, 10.0)


def test_given_costly_sending_when_played_then_delays_do_not_add_up() -> None:
    run = Sent(1.0, cost=0.03)
    run.player.play(log(*(n * 0.1 for n in range(101))))
    assert run.times[-1] == pytest.approx(10.0, abs=1e-6)
    assert run.player.max_delay == 0.0


def test_given_sending_slower_than_the_log_when_played_then_all_is_published_and_the_delay_is_reported() -> None:
    run = Sent(1.0, cost=0.2)
    run.player.play(log(*(n * 0.1 for n in range(11))))
    assert run.player.sent == 11
    assert run.times[-1] == pytest.approx(2.0)
    assert run.player.max_delay == pytest.approx(1.0)


def test_given_no_pace_when_played_then_nothing_waits() -> None:
    run = Sent(math.inf)
    run.player.play(log(0, 100, 200))
    assert run.times == [0.0, 0.0, 0.0]


def test_given_time_that_steps_back_when_played_then_it_goes_on_from_there() -> None:
    run = Sent(1.0)
    run.player.play(log(0, 10, 2, 3))
    assert run.times == pytest.approx([0, 10, 10, 11], abs=1e-6)


def test_given_an_interrupt_when_played_then_the_counts_hold_what_was_sent() -> None:
    run = Sent(1.0)

    def interrupt(event: LogEvent) -> None:
        if event.number == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run.player.play(log(0, 1, 2), interrupt)
    assert run.player.sent == 2
