"""The daemon under a service manager: when it is ready, what its status line says, when it lives.

`Supervision.ticked` is called by the loop after each tick that went through. A tick that throws never gets there, a
loop that hangs neither, and where localization does nothing but fail it gives no sign of life (`progress`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from modelserver.core import CoreState, Instant
from modelserver.core.reload import ModelLoaded
from modelserver.errors import shown
from modelserver.messages import Invalid, LoadModel
from modelserver.service.clock import Clock
from modelserver.service.supervision.notify import Notifier
from modelserver.service.supervision.progress import LocalizationProgress

READY_TICKS: Final = 2
"""With the second tick a whole turn of the loop has gone through: sensors, tick, requests."""

SENSOR: Final = "sensor:"
"""What the core's traffic is called that comes from sensors."""

SILENT_S: Final = 3.0
"""After so long a sensor that was heard is called silent."""

SHOWN: Final = 4
"""Silent sensors that a status names."""


class Supervision:
    """Attends one loop for the service manager. `hears` says whether a channel is one of samples."""

    def __init__(self, notifier: Notifier, clock: Clock, hears: Callable[[str], bool]):
        self._notifier, self._clock, self._hears = notifier, clock, hears
        self._progress = LocalizationProgress()
        self._ticks = 0
        self._seen: int | None = None
        self._refused = ""  # why the last reload was

    def ticked(self, state: CoreState) -> None:
        """Give the signs that are due. `state` is the one after a tick that went through."""
        notifier = self._notifier
        if not notifier.is_heard:
            return
        self._ticks += state.ticks != self._seen
        self._seen = state.ticks
        now = Instant(self._clock.monotonic_ns(), self._clock.utime())
        if not notifier.is_ready:
            if self._ticks >= READY_TICKS:
                notifier.ready(status_of(state, now, self._refused))
            return
        notifier.status(lambda: status_of(state, now, self._refused))
        if self._progress.is_made(state, self._hears, now.monotonic_ns):
            notifier.alive()

    def loading(
        self, load: Callable[[LoadModel, CoreState], ModelLoaded]
    ) -> Callable[[LoadModel, CoreState], ModelLoaded]:
        """Return what reads the geometry anew as `load` does, and tells the service manager of it."""

        def loaded(wish: LoadModel, state: CoreState) -> ModelLoaded:
            with self._notifier.reloading():
                answer = load(wish, state)
            if wish.request is None or not wish.request.dry_run:
                self._refused = "" if answer.model is not None else answer.why
            return answer

        return loaded

    @contextmanager
    def ending(self) -> Iterator[None]:
        """Tell the service manager when the block ends, however it does."""
        try:
            yield
        finally:
            self._notifier.stopping()


def status_of(state: CoreState, now: Instant, refused: str = "") -> str:
    """Return a daemon's state in one line for people, what matters most first. `refused`: why the last reload was."""
    parts = [f"serving model {state.model.revision}"]
    if refused:
        parts.append(f"reload refused, the old model stays: {refused}")
    parts += [f"{subject}: {text}" for subject, text in sorted(state.notices.items())]
    if state.localizer is None:
        return "; ".join([*parts, "no sensor to localize by"])
    return "; ".join(
        [*parts, _sensors(state, now), _pose(state.localizer.estimate(now.utime).invalid | state.view.doubt)]
    )


def _sensors(state: CoreState, now: Instant) -> str:
    ages = {
        name.removeprefix(SENSOR): (now.monotonic_ns - traffic.last_ns) * 1e-9
        for name, traffic in sorted(state.traffic.items())
        if name.startswith(SENSOR)
    }
    silent = [shown(name, 20) for name, age in ages.items() if age > SILENT_S]
    heard = len(ages) - len(silent)
    told = f"{heard} sensor{'s' * (heard != 1)} heard"
    return told + (f", silent: {', '.join(silent[:SHOWN])}{', ...' * (len(silent) > SHOWN)}" if silent else "")


def _pose(invalid: Invalid) -> str:
    return f"no valid pose: {invalid.explain()}" if invalid else "pose valid"
