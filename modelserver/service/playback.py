"""A recording back onto the bus, at its own pace or another."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from modelserver.service.clock import Clock
from modelserver.wire.eventlog import LogEvent
from modelserver.wire.restamp import restamped


@dataclass(slots=True)
class Player:
    """Publishes events `speed` times as fast as they were recorded (infinite: at once).

    Bytes go out unchanged; with `restamp` the stamps of samples, and of wishes for another mode, are moved by what the
    log is older than now, so that to a daemon the sensors speak now.

    Each event has an absolute deadline on the monotonic clock, counted from the first, so delays do not add up.
    Where the log's time steps back, it goes on at once from there. The counts hold what was done so far, also
    after an interrupt; `late` is the most that a message was behind its time, seconds.
    """

    publish: Callable[[str, bytes], object]
    speed: float
    clock: Clock
    sleep: Callable[[float], object]
    restamp: bool = False
    sent: int = 0
    late: float = 0.0
    first_utime: int = 0
    last_utime: int = 0

    def play(self, events: Iterable[LogEvent], seen: Callable[[LogEvent], object] = lambda event: None) -> None:
        """Publish all events; `seen` is told of each that was sent."""
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
                    self.late = max(self.late, -wait)
            self.publish(event.channel, restamped(event.data, shift) if self.restamp else event.data)
            self.sent += 1
            self.last_utime = event.utime
            seen(event)

    @property
    def span(self) -> float:
        """Seconds of the recording between the first and the last message sent."""
        return (self.last_utime - self.first_utime) * 1e-6
