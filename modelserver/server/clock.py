"""Clocks and the tick timer: the only module of the server that reads the time.

A tick computes the pose for its deadline and publishes it at the deadline. It therefore begins a lead time earlier. The
lead is a stochastic approximation of a quantile of the computing time of ticks (Robbins and Monro 1951): up by
`UP_STEPS` steps after a tick that was not ready in time, down by one step after one that was. It settles where one tick
in `UP_STEPS + 1` is not ready, so most poses are ready early. Until the deadline nothing is passed to the core,
whose time never goes back; only cached replies are sent.

Ticks that take no time keep the lead at 0. A tick that is later than any lead could compensate was delayed by something
else (a paused process, a busy processor) and is no measurement. Missed ticks are skipped and counted: catching up would
publish a burst of old poses.
"""

from __future__ import annotations

import time
from typing import Final, NamedTuple

from modelserver.core import Instant
from modelserver.named_tuples import new_tuple


class Clock:
    """The host's clocks, the time source of the loop."""

    def monotonic_ns(self) -> int:
        """Return nanoseconds on a clock that never steps."""
        return time.monotonic_ns()

    def utime(self) -> int:
        """Return microseconds since the Unix epoch."""
        return time.time_ns() // 1000

    def now(self) -> Instant:
        """Return both times: monotonic, and microseconds since the Unix epoch."""
        return new_tuple(Instant, (time.monotonic_ns(), time.time_ns() // 1000))

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


class FakeClock(Clock):
    """A clock for replays and tests, which moves only by `set`, `advance`, `sleep` and `step_utime`."""

    def __init__(self, utime: int = 1_700_000_000_000_000, monotonic_ns: int = 1_000_000_000):
        self._utime_ns = utime * 1000
        self._monotonic_ns = monotonic_ns

    def set(self, now: Instant) -> None:
        self._monotonic_ns, self._utime_ns = now.monotonic_ns, now.utime * 1000

    def monotonic_ns(self) -> int:
        return self._monotonic_ns

    def utime(self) -> int:
        return self._utime_ns // 1000

    def now(self) -> Instant:
        return Instant(self._monotonic_ns, self._utime_ns // 1000)

    def advance(self, seconds: float) -> None:
        self._monotonic_ns += round(seconds * 1e9)
        self._utime_ns += round(seconds * 1e9)

    def sleep(self, seconds: float) -> None:
        self.advance(seconds)

    def step_utime(self, seconds: float) -> None:
        """Step the time of day; monotonic time is not affected."""
        self._utime_ns += round(seconds * 1e9)


MAX_LEAD_NS: Final = 2_000_000
LEAD_STEP_NS: Final = 4_000
UP_STEPS: Final = 12


class TickLead:
    """Lead time, nanoseconds, estimated from the computing times of ticks."""

    def __init__(self) -> None:
        self.ns = 0

    def update(self, computing_ns: int) -> None:
        """Process the time from when a tick should have begun to when its pose was ready."""
        if computing_ns > self.ns + 2 * MAX_LEAD_NS:
            return
        if computing_ns > self.ns:
            self.ns = min(self.ns + UP_STEPS * LEAD_STEP_NS, MAX_LEAD_NS)
        else:
            self.ns = max(self.ns - LEAD_STEP_NS, 0)


class StartedTick(NamedTuple):
    """A tick that has begun: its instant, the ticks missed before it, and a latency in nanoseconds.

    A tick that begins early has its deadline as instant, and the latency of the last published pose.
    """

    now: Instant
    missed: int
    latency_ns: int


class TickTimer:
    """Deadlines of ticks every `period_ns`: `start_tick`, `set_ready` if there is a pose, `finish_tick`."""

    def __init__(self, clock: Clock, period_ns: int):
        self._clock = clock
        self._period_ns = period_ns
        self.lead = TickLead()
        self.due_ns = clock.monotonic_ns()
        self.publish_ns = 0
        """Deadline of the tick in progress, monotonic nanoseconds; without one the last deadline."""
        self._latency_ns = 0

    @property
    def begin_ns(self) -> int:
        """When the next tick begins, monotonic nanoseconds."""
        return self.due_ns - self.lead.ns

    def start_tick(self) -> StartedTick | None:
        """Begin a tick if it is due; None if not."""
        due = self.due_ns
        if self.begin_ns > self._clock.monotonic_ns():
            return None
        now = self._clock.now()
        late_ns = now.monotonic_ns - due
        missed = max(late_ns, 0) // self._period_ns
        self.due_ns += (missed + 1) * self._period_ns
        self.publish_ns = due
        if late_ns < 0:
            return StartedTick(Instant(due, now.utime - late_ns // 1000), missed, self._latency_ns)
        return StartedTick(now, missed, late_ns)

    def set_ready(self) -> None:
        """Update the lead: the pose of the tick in progress is ready."""
        self.lead.update(self._clock.monotonic_ns() - (self.publish_ns - self.lead.ns))

    def finish_tick(self) -> None:
        """Wait for the deadline of the tick in progress: its pose is published next."""
        now_ns = self._clock.monotonic_ns()
        if now_ns < self.publish_ns:
            self._clock.sleep((self.publish_ns - now_ns) * 1e-9)
            now_ns = self._clock.monotonic_ns()
        self._latency_ns = now_ns - self.publish_ns
