"""When a line that was lost is opened again, and whether it goes and comes."""

from __future__ import annotations

import random

STEADY_NS = 5_000_000_000
"""A line that has been open for so long is steady; one that is lost earlier was opened in vain."""

MANY = 3
"""Openings in vain, one after the other, of which a person is told."""


class Retries:
    """Counts openings in vain, and lets the waits grow with them. Seconds, and nanoseconds of the monotonic clock."""

    def __init__(self, first_wait: float, last_wait: float, rng: random.Random):
        """Take the bounds of the wait; each is varied by a fifth, so that many drivers do not knock at once."""
        self._first, self._last, self._rng = first_wait, last_wait, rng
        self._wait = first_wait
        self._opened_ns: int | None = None
        self._vain = 0
        self._vain_ns = 0

    def opened(self, at_ns: int) -> None:
        """Note that the line is open."""
        self._opened_ns = at_ns
        if not self._vain:
            self._vain_ns = at_ns

    def is_steady(self, at_ns: int) -> bool:
        """Return whether the line has been open for some time; then what was before is forgotten."""
        if self._opened_ns is None or at_ns - self._opened_ns < STEADY_NS:
            return False
        self._wait, self._vain = self._first, 0
        return True

    def lost(self, at_ns: int, *, in_order: bool = False) -> float:
        """Return how long to wait, the line being lost, or not there; closed `in_order` after a good time not at all.

        One that is lost waits in any case: another who takes its place must not make a busy loop.
        """
        was_steady = self.is_steady(at_ns)
        if self._opened_ns is not None and not was_steady:
            self._vain += 1
        self._opened_ns = None
        if in_order and was_steady:
            return 0.0
        wait, self._wait = self._wait, min(self._wait * 2.0, self._last)
        return wait * self._rng.uniform(0.8, 1.2)

    def changed(self) -> None:
        """Note that the line was closed to be opened otherwise, at another rate: that is neither loss nor success."""
        self._opened_ns = None

    def note(self, at_ns: int) -> str:
        """Return what there is to say of a line that goes and comes; empty where it does not."""
        if self._vain < MANY:
            return ""
        seconds = (at_ns - self._vain_ns) * 1e-9
        return f"; opened and closed {self._vain} times in {seconds:.0f} s: does another program use it?"
