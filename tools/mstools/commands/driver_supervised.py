"""A driver under a service manager: ready when it is on the bus, alive while its passes go through."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from modelserver.service.supervision.notify import Notifier
from modelserver.service.supervision.progress import Progress
from msdrivers.runner import Runner

READY_PASSES = 2
"""Before its second pass a driver has gone through a whole one: it has tried its line, and has told how it is."""


class DriverSupervision:
    """Attends one runner for the service manager.

    A device that is away is no reason not to be ready, nor to be ended: the driver waits for it and says so. What is:
    a pass that hangs, and a station that does nothing but fail.
    """

    def __init__(self, runner: Runner[Any], notifier: Notifier, monotonic_ns: Callable[[], int] = time.monotonic_ns):
        self._runner, self._notifier, self._monotonic_ns = runner, notifier, monotonic_ns
        self._progress = Progress()
        self._passes = 0

    def attending(self, attend: Callable[[], object]) -> Callable[[], object]:
        """Return what is to be called before each pass: `attend`, and the signs that are due."""
        if not self._notifier.is_heard:
            return attend

        def attended() -> None:
            attend()
            self._sign()

        return attended

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Tell the service manager when the block ends, however it does."""
        try:
            yield
        finally:
            self._notifier.stopping()

    def _sign(self) -> None:
        self._passes += 1
        if not self._notifier.is_ready:
            if self._passes >= READY_PASSES:
                self._notifier.ready(self._status())
            return
        self._notifier.status(self._status)
        runner = self._runner
        failures = sum(count for name, count in runner.counts.items() if name.startswith("errors."))
        if self._progress.is_made(runner.samples, failures, self._monotonic_ns()):
            self._notifier.alive()

    def _status(self) -> str:
        phase, text = self._runner.state
        return f"{phase.name.lower()}: {text}" if text else phase.name.lower()
