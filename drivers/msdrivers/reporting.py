"""How a driver is: told to the log where it changes, and to the health channel then and in between."""

from __future__ import annotations

import logging
from collections.abc import Callable

from modelserver.messages import NAN, DriverPhase
from msdrivers.station import Now

log = logging.getLogger(__name__)


class Reporter:
    """Keeps what there is to say of one driver. `send` is called when a report is due; times in seconds."""

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
        self._phase, self._text = DriverPhase.CLOSED, "not opened yet"
        self._said: tuple[DriverPhase, str] = (DriverPhase.CLOSED, "")

    @property
    def state(self) -> tuple[DriverPhase, str]:
        """The phase, and what there is to say for a person."""
        # a station that has told silence itself knows more of it
        if self.is_silent and self._phase is not DriverPhase.SILENT:
            return DriverPhase.SILENT, f"nothing heard for {self._silence:g} s"
        return self._phase, self._text

    def age(self, now: Now) -> float:
        """Return the seconds since the last sample; nan before the first."""
        return NAN if self._sample_ns is None else (now.monotonic_ns - self._sample_ns) * 1e-9

    def measured(self, now: Now) -> None:
        """Count a sample."""
        self.samples += 1
        self._sample_ns = now.monotonic_ns

    def tell(self, phase: DriverPhase, text: str, now: Now) -> None:
        """Take what is new."""
        self._phase, self._text = phase, text
        self.announce(now)

    def announce(self, now: Now) -> None:
        """Log and report a change, if there is one."""
        state = self.state
        if state == self._said:
            return
        self._said = state
        phase, text = state
        trouble = phase is DriverPhase.SILENT or (phase is DriverPhase.CLOSED and not self.is_ending)
        level = logging.WARNING if trouble else logging.INFO
        log.log(level, "%s: %s%s", self._source, phase.name.lower(), f": {text}" if text else "")
        self._send(now)

    def woken(self, now: Now) -> None:
        """Report, where it is due."""
        if now.monotonic_ns < self.due_ns:
            return
        self.due_ns = now.monotonic_ns + self._period_ns
        since = (now.monotonic_ns - self._counted_ns) * 1e-9
        self.rate_hz = (self.samples - self._counted) / since if since > 0 else 0.0
        self._counted_ns, self._counted = now.monotonic_ns, self.samples
        self._send(now)
