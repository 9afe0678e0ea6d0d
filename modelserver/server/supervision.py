"""Supervision by systemd: notification protocol (sd_notify(3)), watchdog, and the wait after a failed start.

The protocol is one datagram of `KEY=value` lines to the socket that NOTIFY_SOCKET names: READY, STATUS, RELOADING,
STOPPING and the watchdog. Without that variable, or if the socket is gone, nothing happens: a missing service manager
is no error.

The watchdog is pinged only while the service makes progress (`StallDetector`). A restart helps a program that hangs or
fails permanently, and nothing else. So only failures without any success in between count; a silent sensor or rejected
samples are no failure, since they would be the same after a restart.

A server loop calls `ServiceSupervisor.on_tick` after each tick without error: the watchdog is not pinged either if the
loop hangs or if ticks fail.

A service manager restarts a failed service at once and repeatedly. With the same files it would fail for the same
reason, at the cost of most of a processor and a full log. So after a failed start the service waits before it exits.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from modelserver.errors import quote
from modelserver.messages import SetFrame
from modelserver.server.log import escape_text

if TYPE_CHECKING:
    from modelserver.core import CoreState, Instant, ModelLoaded
    from modelserver.server.clock import Clock

MAX_STATUS_LENGTH: Final = 400
"""Characters of a status line."""

STATUS_PERIOD_NS: Final = 1_000_000_000
"""Least period of status lines."""

PINGS_PER_TIMEOUT: Final = 4
"""Watchdog pings per watchdog timeout."""

STEP_TIMEOUT_S: Final = 60.0
"""Timeout of one step of the start, or of a reload, for the service manager."""

Send = Callable[[bytes], object]


def open_manager_socket(environment: Mapping[str, str] = os.environ) -> Send | None:
    """Return a function that sends a datagram to the service manager; None without one.

    NOTIFY_SOCKET is a path, or with a leading @ a name in the abstract namespace; anything else is ignored.
    """
    address = environment.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@") or len(address) < 2:
        return None
    if address.startswith("@"):
        address = f"\0{address[1:]}"

    def send(datagram: bytes) -> None:
        # a few per second: a socket for each needs no close
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            # a manager that does not read must not block the service: the datagram is lost
            channel.setblocking(False)
            channel.sendto(datagram, address)

    return send


def get_watchdog_ns(environment: Mapping[str, str] = os.environ, pid: int | None = None) -> int:
    """Return the watchdog timeout of this process, nanoseconds; 0 without one."""
    meant_for = environment.get("WATCHDOG_PID", "")
    if meant_for and meant_for != str(os.getpid() if pid is None else pid):
        return 0
    given = environment.get("WATCHDOG_USEC", "")
    return int(given) * 1000 if given.isascii() and given.isdigit() else 0


class Notifier:
    """Notifies the service manager. `send` is None without one; `watchdog` is its timeout, nanoseconds, 0 for none."""

    def __init__(self, send: Send | None, watchdog: int = 0, monotonic_ns: Callable[[], int] = time.monotonic_ns):
        self._send, self._watchdog_ns, self._monotonic_ns = send, watchdog, monotonic_ns
        self._ping_due_ns = 0
        self._status, self._status_due_ns = "", 0
        self.is_active = send is not None
        """Whether there is a service manager."""
        self.is_ready = False
        """Whether READY was sent."""

    @classmethod
    def from_environment(cls) -> Notifier:
        return cls(open_manager_socket(), get_watchdog_ns())

    def send(self, *lines: str) -> None:
        if self._send is not None:
            self._send("\n".join(lines).encode("utf-8", "replace"))

    def notify_starting(self, what: str, seconds: float = STEP_TIMEOUT_S) -> None:
        """Report a step of the start and extend its timeout; without effect after READY."""
        if not self.is_ready:
            self._status = _truncate(what)
            self.send(f"STATUS={self._status}", f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def notify_ready(self, status: str) -> None:
        self.is_ready = True
        self._set_status(status)
        self.send("READY=1", f"STATUS={self._status}")

    def update_status(self, status: Callable[[], str]) -> None:
        """Report the status if it has changed; at most once a second `status` is called."""
        if self._send is None or self._monotonic_ns() < self._status_due_ns:
            return
        before = self._status
        self._set_status(status())
        if self._status != before:
            self.send(f"STATUS={self._status}")

    def ping_watchdog(self) -> None:
        """Ping the watchdog if there is one and the last ping is old enough."""
        now = self._monotonic_ns()
        if self._watchdog_ns and now >= self._ping_due_ns:
            self._ping_due_ns = now + self._watchdog_ns // PINGS_PER_TIMEOUT
            self.send("WATCHDOG=1")

    def notify_reloading(self) -> None:
        """Report that a reload begins. systemd 253 needs the monotonic time, to ignore the answer to an earlier one."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={self._monotonic_ns() // 1000}", "STATUS=reloading the geometry")

    def notify_reloaded(self) -> None:
        self.send("READY=1", f"STATUS={self._status}")
        self._status_due_ns = 0

    def notify_stopping(self) -> None:
        self.send("STOPPING=1", "STATUS=stopping")

    def _set_status(self, status: str) -> None:
        self._status = _truncate(status)
        self._status_due_ns = self._monotonic_ns() + STATUS_PERIOD_NS


def _truncate(text: str) -> str:
    text = escape_text(text)
    return text if len(text) <= MAX_STATUS_LENGTH else f"{text[: MAX_STATUS_LENGTH - 3]}..."


STALL_TIMEOUT_S: Final = 5.0
"""How long failures without success may last before the watchdog is no longer pinged."""


class StallDetector:
    """Detects permanent failure from two numbers: one that changes with each success, and a count of failures."""

    def __init__(self, timeout: float = STALL_TIMEOUT_S):
        self._timeout_ns = round(timeout * 1e9)
        self._successes: int | None = None
        self._failures = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    def is_progressing(self, successes: int, failures: int, now_ns: int) -> bool:
        """Return whether the service makes progress or is idle; to be called often. `now_ns` is monotonic time."""
        if successes != self._successes:
            self._successes, self._failures, self._first_ns = successes, failures, None
            return True
        if self._first_ns is not None and now_ns - self._last_ns >= self._timeout_ns:
            # rare failures are no permanent one
            self._first_ns = None
        if failures != self._failures:
            self._failures, self._last_ns = failures, now_ns
            if self._first_ns is None:
                self._first_ns = now_ns
        return self._first_ns is None or self._last_ns - self._first_ns < self._timeout_ns


READY_TICKS: Final = 2
"""At the second tick the loop has made a whole pass: sensors, tick, requests."""

SENSOR_PREFIX: Final = "sensor:"
"""Prefix of sensors in the core's traffic statistics."""

SILENT_S: Final = 3.0
"""A sensor without a message for so long is silent."""

MAX_SHOWN: Final = 4
"""Silent sensors named by a status line."""


class ServiceSupervisor:
    """Supervises one loop. `is_sensor_channel` returns whether a channel carries samples."""

    def __init__(self, notifier: Notifier, clock: Clock, is_sensor_channel: Callable[[str], bool]):
        self._notifier, self._clock, self._is_sensor_channel = notifier, clock, is_sensor_channel
        self._stall_detector = StallDetector()
        self._ticks = 0
        self._last_ticks: int | None = None
        self._reload_error = ""

    def on_tick(self, state: CoreState) -> None:
        """Send the notifications that are due after a tick without error."""
        notifier = self._notifier
        if not notifier.is_active:
            return
        self._ticks += state.ticks != self._last_ticks
        self._last_ticks = state.ticks
        now = self._clock.now()
        if not notifier.is_ready:
            if self._ticks >= READY_TICKS:
                notifier.notify_ready(format_status(state, now, self._reload_error))
            return
        notifier.update_status(lambda: format_status(state, now, self._reload_error))
        # an exception in localization leaves no other trace than the count of errors on its channel
        failures = sum(
            count
            for (channel, reason), count in state.rejected.items()
            if reason == "handler" and self._is_sensor_channel(channel)
        )
        successes = 0 if state.localizer is None else state.localizer.utime
        if self._stall_detector.is_progressing(successes, failures, now.monotonic_ns):
            notifier.ping_watchdog()

    def on_reload(self, loaded: ModelLoaded | None) -> None:
        """Notify that a reload of the geometry begins (None), or how it ended."""
        if loaded is None:
            self._notifier.notify_reloading()
            return
        self._notifier.notify_reloaded()
        if not loaded.is_dry_run and not isinstance(loaded.request, SetFrame):
            self._reload_error = "" if loaded.model is not None else loaded.why


def format_status(state: CoreState, now: Instant, reload_error: str = "") -> str:
    """Format the state of a server in one line for people, what matters most first."""
    parts = [f"serving model {state.model.revision}"]
    if reload_error:
        parts.append(f"reload failed, the old model stays: {reload_error}")
    parts += [f"{subject}: {text}" for subject, text in sorted(state.warnings.items())]
    if state.localizer is None:
        parts.append("no localization sensor")
    else:
        invalid = state.localizer.estimate(now.utime).invalid | state.view.invalid
        parts += [_format_sensors(state, now), f"no valid pose: {invalid.explain()}" if invalid else "pose valid"]
    return "; ".join(parts)


def _format_sensors(state: CoreState, now: Instant) -> str:
    ages = {
        name.removeprefix(SENSOR_PREFIX): (now.monotonic_ns - traffic.last_received_ns) * 1e-9
        for name, traffic in sorted(state.traffic.items())
        if name.startswith(SENSOR_PREFIX)
    }
    silent = [quote(name, 20) for name, age in ages.items() if age > SILENT_S]
    active = len(ages) - len(silent)
    text = f"{active} sensor{'s' * (active != 1)} active"
    return text + (f", silent: {', '.join(silent[:MAX_SHOWN])}{', ...' * (len(silent) > MAX_SHOWN)}" if silent else "")


FAILED_START_S: Final = 10.0
"""Wait after a failed start. A start takes a second of a processor, and its log states every problem again."""
