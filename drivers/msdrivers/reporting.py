"""How a driver is: told to the log where it changes, and to the health channel then and in between."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable

from modelserver.messages import NAN, DriverPhase
from msdrivers.station import Now

log = logging.getLogger(__name__)

MAX_CHANGES = 10
"""Changes that are logged and reported between two regular reports; the next regular one has the last."""

MAX_STATES = 100
"""States of an unsteady line that are counted."""

TROUBLE_NS = 60_000_000_000
"""How long a trouble may be the cause of a silence."""


class Reporter:
    """Keeps what there is to say of one driver. `send` is called when a report is due; times in seconds.

    A line that goes and comes repeats itself: while it is not steady, the same is logged at the first, tenth and
    hundredth time.
    """

    def __init__(self, source: str, silence: float, period: float, now: Now, send: Callable[[Now], object]):
        self.samples = 0
        self.rate_hz = 0.0
        self.is_silent = False
        """Nothing has been heard for `silence` seconds on a line that is open."""
        self.is_ending = False
        """The driver was told to end: that its line is closed then is no trouble."""
        self.due_ns = now.monotonic_ns
        """When the next report is due."""
        self._source, self._silence, self._period_ns = source, silence, round(period * 1e9)
        self._send = send
        self._sample_ns: int | None = None
        self._counted_ns, self._counted = now.monotonic_ns, 0
        self._phase, self._text, self._note, self._is_trouble = DriverPhase.CLOSED, "not opened yet", "", False
        self._trouble, self._trouble_ns = "", 0
        self._said = self._logged = (DriverPhase.CLOSED, "")
        self._changes = 0
        self._is_steady = False
        self._times: Counter[tuple[DriverPhase, str, bool]] = Counter()

    @property
    def state(self) -> tuple[DriverPhase, str]:
        """The phase, and what there is to say for a person."""
        phase, text = self._phase, self._text
        # a station that has told silence itself knows more of it
        if self.is_silent and phase is not DriverPhase.SILENT:
            phase, text = DriverPhase.SILENT, f"nothing heard for {self._silence:g} s"
        if phase is DriverPhase.SILENT and self._trouble not in text:
            text += f"; before that: {self._trouble}"
        return phase, text + self._note

    def age(self, now: Now) -> float:
        """Return the seconds since the last sample; nan before the first."""
        return NAN if self._sample_ns is None else (now.monotonic_ns - self._sample_ns) * 1e-9

    def measured(self, now: Now) -> None:
        """Count a sample."""
        self.samples += 1
        self._sample_ns = now.monotonic_ns

    def tell(self, phase: DriverPhase, text: str, now: Now, *, is_trouble: bool = False, note: str = "") -> None:
        """Take what is new. What is trouble stands beside a silence that follows; `note` is no news where it changes.

        A driver that measures, or begins anew, has left its troubles behind.
        """
        if is_trouble:
            self._trouble, self._trouble_ns = text, now.monotonic_ns
        elif phase in (DriverPhase.WAITING, DriverPhase.STREAMING):
            self._trouble = ""
        self._phase, self._text, self._note, self._is_trouble = phase, text, note, is_trouble
        self.announce(now)

    def steady(self, is_steady: bool) -> None:
        """Take whether the line has been open for some time."""
        if is_steady is not self._is_steady:
            self._is_steady = is_steady
            self._times.clear()
            if is_steady and self.state != self._logged:
                self._log()

    def announce(self, now: Now) -> None:
        """Log and report a change, if there is one."""
        state = self.state
        if state == self._said:
            return
        self._said = state
        self._changes += 1
        if self._changes > MAX_CHANGES and not self.is_ending:
            return
        if self._is_steady or self.is_ending or self._is_new():
            self._log()
        self._send(now)

    def woken(self, now: Now) -> None:
        """Report, where it is due."""
        if now.monotonic_ns - self._trouble_ns > TROUBLE_NS:
            self._trouble = ""
        if now.monotonic_ns < self.due_ns:
            return
        if self._changes > MAX_CHANGES and self._is_steady and self.state != self._logged:
            self._log()
        self._changes = 0
        self.due_ns = now.monotonic_ns + self._period_ns
        since = (now.monotonic_ns - self._counted_ns) * 1e-9
        self.rate_hz = (self.samples - self._counted) / since if since > 0 else 0.0
        self._counted_ns, self._counted = now.monotonic_ns, self.samples
        self._send(now)

    def _is_new(self) -> bool:
        """Return whether what is told is told for the first, tenth, hundredth time."""
        if len(self._times) >= MAX_STATES:
            self._times.clear()
        state = (self.state[0], self._text, bool(self._note))
        self._times[state] += 1
        return str(self._times[state]).strip("0") == "1"

    def _log(self) -> None:
        self._logged = self.state
        phase, text = self._logged
        bad = phase is DriverPhase.SILENT or (phase is DriverPhase.CLOSED and not self.is_ending)
        level = logging.WARNING if bad or self._is_trouble else logging.INFO
        log.log(level, "%s: %s%s", self._source, phase.name.lower(), f": {text}" if text else "")
