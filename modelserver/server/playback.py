"""Play a recording back onto the bus, at its own speed or another."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from modelserver.server.clock import Clock
from modelserver.wire.codec import restamp
from modelserver.wire.eventlog import LogEvent


@dataclass(slots=True)
class Player:
    """Publishes events `speed` times as fast as they were recorded (infinite: at once).

    Messages are published unchanged; with `restamp` the stamps of samples and mode commands are shifted by the age of
    the log, so that they are current for a daemon.

    Each event has an absolute deadline on the monotonic clock, relative to the first one, so delays do not accumulate.
    If the log's time steps back, playback continues at once from there. The counts are valid also after an interrupt;
    `max_delay` is the greatest delay of a message after its deadline, seconds.
    """

    publish: Callable[[str, bytes], object]
    speed: float
    clock: Clock
    sleep: Callable[[float], object]
    restamp: bool = False
    sent: int = 0
    max_delay: float = 0.0
    first_utime: int = 0
    last_utime: int = 0

    def play(self, events: Iterable[LogEvent], on_sent: Callable[[LogEvent], object] = lambda event: None) -> None:
        """Publish all events; call `on_sent` after each one."""
        start_ns, start_utime, shift = self.clock.monotonic_ns(), 0, 0
        for event in events:
            if not self.sent:
                self.first_utime = start_utime = event.utime
                shift = self.clock.now().utime - event.utime
            elif event.utime < self.last_utime:
                start_ns, start_utime = self.clock.monotonic_ns(), event.utime
            if not math.isinf(self.speed):
                due_ns = start_ns + round((event.utime - start_utime) * 1000 / self.speed)
                wait = (due_ns - self.clock.monotonic_ns()) * 1e-9
                if wait > 0:
                    self.sleep(wait)
                else:
                    self.max_delay = max(self.max_delay, -wait)
            self.publish(event.channel, restamp(event.data, shift) if self.restamp else event.data)
            self.sent += 1
            self.last_utime = event.utime
            on_sent(event)

    @property
    def duration(self) -> float:
        """Seconds of the recording between the first and the last published message."""
        return (self.last_utime - self.first_utime) * 1e-6
