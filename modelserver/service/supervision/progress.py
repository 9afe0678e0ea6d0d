"""Whether a service gets on with its work: what its signs of life to the watchdog depend on. No clock: time comes in.

A restart cures a program that is stuck or poisoned, and nothing else. So what counts is failures of the service's own
without any success between them, for some time; a sensor that is silent, or whose samples are refused for good reason,
is no failure, for after a restart it would be the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from modelserver.core import CoreState

PATIENCE_S: Final = 5.0
"""How long failures may follow one another, without a success, before no more signs of life are given."""


class Progress:
    """Judges by two numbers: one that changes with each success, one that counts failures."""

    def __init__(self, patience: float = PATIENCE_S):
        self._patience_ns = round(patience * 1e9)
        self._successes: int | None = None
        self._failures = 0
        self._first_ns: int | None = None
        self._last_ns = 0

    def is_made(self, successes: int, failures: int, now_ns: int) -> bool:
        """Return whether the service gets on, or has nothing to do; to be asked often. `now_ns` is monotonic time."""
        if successes != self._successes:
            self._successes, self._failures, self._first_ns = successes, failures, None
            return True
        if self._first_ns is not None and now_ns - self._last_ns >= self._patience_ns:
            # strays with long silences between them are no row of failures
            self._first_ns = None
        if failures != self._failures:
            self._failures, self._last_ns = failures, now_ns
            if self._first_ns is None:
                self._first_ns = now_ns
        return self._first_ns is None or self._last_ns - self._first_ns < self._patience_ns


class LocalizationProgress:
    """Whether a daemon's localization gets on, by the core's own counts."""

    def __init__(self, patience: float = PATIENCE_S):
        self._progress = Progress(patience)

    def is_made(self, state: CoreState, hears: Callable[[str], bool], now_ns: int) -> bool:
        """Return whether samples move time on, or at least do not fail. `hears`: whether a channel is one of samples.

        A sample that the localization throws on leaves no trace in the state but the count of errors on its channel.
        """
        localizer = state.localizer
        failures = sum(count for (name, why), count in state.rejected.items() if why == "handler" and hears(name))
        return self._progress.is_made(0 if localizer is None else localizer.utime, failures, now_ns)
