"""Supervisor: connects a server loop to systemd: readiness, status line, watchdog.

The loop calls `ServiceSupervisor.on_tick` after each tick without error. The watchdog is therefore not pinged if the
loop hangs, if ticks fail, or if localization fails permanently (`StallDetector`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from modelserver.core import CoreState, Instant
from modelserver.core.commands import ModelLoaded
from modelserver.errors import quote
from modelserver.messages import LoadModel
from modelserver.server.clock import Clock
from modelserver.server.supervision.systemd import Notifier, StallDetector

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
        now = Instant(self._clock.monotonic_ns(), self._clock.utime())
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

    def wrap_load(
        self, load: Callable[[LoadModel, CoreState], ModelLoaded]
    ) -> Callable[[LoadModel, CoreState], ModelLoaded]:
        """Wrap a function that reloads the geometry, so that the service manager is notified."""

        def load_and_notify(command: LoadModel, state: CoreState) -> ModelLoaded:
            with self._notifier.reloading():
                result = load(command, state)
            if command.request is None or not command.request.dry_run:
                self._reload_error = "" if result.model is not None else result.why
            return result

        return load_and_notify

    @contextmanager
    def notify_at_exit(self) -> Iterator[None]:
        """Notify the service manager when the block ends, also by an exception."""
        try:
            yield
        finally:
            self._notifier.notify_stopping()


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
