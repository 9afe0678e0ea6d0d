"""A driver under systemd: readiness, watchdog and status notifications of its loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from modelserver.server.supervision.systemd import Notifier, StallDetector
from msdrivers.runner import Runner

READY_PASSES = 2
"""A driver is ready after one complete pass: it has tried its connection and published its health."""


class DriverSupervision:
    """Notify systemd of one runner.

    A missing device does not stop readiness or watchdog: the driver waits for it and reports that. A pass that hangs
    and a driver with nothing but errors do.
    """

    def __init__(self, runner: Runner[Any], notifier: Notifier, monotonic_ns: Callable[[], int] = time.monotonic_ns):
        self._runner, self._notifier, self._monotonic_ns = runner, notifier, monotonic_ns
        self._progress = StallDetector()
        self._passes = 0

    def wrap_callback(self, attend: Callable[[], object]) -> Callable[[], object]:
        """Return the callback before each pass: `attend`, then the due notifications."""
        if not self._notifier.is_active:
            return attend

        def on_pass() -> None:
            attend()
            self._notify()

        return on_pass

    def _notify(self) -> None:
        self._passes += 1
        if not self._notifier.is_ready:
            if self._passes >= READY_PASSES:
                self._notifier.notify_ready(self._format_status())
            return
        self._notifier.update_status(self._format_status)
        runner = self._runner
        failures = sum(count for name, count in runner.counts.items() if name.startswith("errors."))
        if self._progress.is_progressing(runner.samples, failures, self._monotonic_ns()):
            self._notifier.ping_watchdog()

    def _format_status(self) -> str:
        phase, text = self._runner.state
        return f"{phase.name.lower()}: {text}" if text else phase.name.lower()
