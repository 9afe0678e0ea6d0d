"""Driver status: samples to their channels, health reports to DRIVER_HEALTH, changes of status to the log."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from modelserver.messages import NAN, DriverHealth, DriverPhase, Sample
from modelserver.wire.codec import encode
from msdrivers.endpoint import HostTime
from msdrivers.registry import CHANNELS

HEALTH_CHANNEL = "DRIVER_HEALTH"


@dataclass(frozen=True, slots=True)
class DriverPublisher:
    """Encodes and publishes messages. channels: by type of sample, without prefix; default `CHANNELS`."""

    send: Callable[[str, bytes], object]
    channels: Mapping[type, str]
    prefix: str = ""

    def publish_sample(self, sample: Sample) -> None:
        kind = type(sample)
        self.send(f"{self.prefix}{self.channels.get(kind) or CHANNELS[kind]}", encode(sample))

    def publish_health(self, health: DriverHealth) -> None:
        self.send(f"{self.prefix}{HEALTH_CHANNEL}", encode(health))


log = logging.getLogger(__name__)

MAX_CHANGES_PER_PERIOD = 10
"""Rate limit: changes that are logged and reported between two regular reports."""

MAX_COUNTED_STATES = 100
"""Different states of an unstable line whose repetitions are counted."""

WARNING_LIFETIME_NS = 60_000_000_000
"""How long a warning is shown as the likely cause of a silence."""


class HealthReporter:
    """Tracks the status of one driver and calls `send` when a report is due. Times in seconds.

    While the line is unstable, the same state is logged only at its 1st, 10th, 100th repetition.
    """

    def __init__(self, source: str, silence: float, period: float, now: HostTime, send: Callable[[HostTime], object]):
        self.samples = 0
        self.rate_hz = 0.0
        self.is_silent = False
        """Nothing was received for `silence` seconds on an open line."""
        self.is_ending = False
        """The driver is stopping: a closed line is no warning then."""
        self.next_report_ns = now.monotonic_ns
        """Deadline of the next report, monotonic nanoseconds."""
        self._source, self._silence, self._period_ns = source, silence, round(period * 1e9)
        self._send = send
        self._sample_ns: int | None = None
        self._counted_ns, self._counted = now.monotonic_ns, 0
        self._phase, self._text, self._suffix, self._is_warning = DriverPhase.CLOSED, "not opened yet", "", False
        self._last_warning, self._last_warning_ns = "", 0
        self._reported = self._logged = (DriverPhase.CLOSED, "")
        self._changes = 0
        self._is_stable = False
        self._repetitions: Counter[tuple[DriverPhase, str, bool]] = Counter()

    @property
    def state(self) -> tuple[DriverPhase, str]:
        """Phase and status text."""
        phase, text = self._phase, self._text
        # an endpoint that reports silence itself knows the cause better
        if self.is_silent and phase is not DriverPhase.SILENT:
            phase, text = DriverPhase.SILENT, f"nothing received for {self._silence:g} s"
        if phase is DriverPhase.SILENT and self._last_warning not in text:
            text += f"; before that: {self._last_warning}"
        return phase, text + self._suffix

    def sample_age(self, now: HostTime) -> float:
        """Return the seconds since the last sample; nan before the first."""
        return NAN if self._sample_ns is None else (now.monotonic_ns - self._sample_ns) * 1e-9

    def count_sample(self, now: HostTime) -> None:
        self.samples += 1
        self._sample_ns = now.monotonic_ns

    def set_status(
        self, phase: DriverPhase, text: str, now: HostTime, *, is_warning: bool = False, suffix: str = ""
    ) -> None:
        """Set phase and text and report a change.

        A warning is repeated with a silence that follows it, until data arrives or the line is reopened; a change of
        `suffix` alone is not reported as a change.
        """
        if is_warning:
            self._last_warning, self._last_warning_ns = text, now.monotonic_ns
        elif phase in (DriverPhase.WAITING, DriverPhase.STREAMING):
            self._last_warning = ""
        self._phase, self._text, self._suffix, self._is_warning = phase, text, suffix, is_warning
        self.report_change(now)

    def set_stable(self, is_stable: bool) -> None:
        """Set whether the line has been open for some time."""
        if is_stable is not self._is_stable:
            self._is_stable = is_stable
            self._repetitions.clear()
            if is_stable and self.state != self._logged:
                self._log()

    def report_change(self, now: HostTime) -> None:
        """Log and report a change, if there is one."""
        state = self.state
        if state == self._reported:
            return
        self._reported = state
        self._changes += 1
        if self._changes > MAX_CHANGES_PER_PERIOD and not self.is_ending:
            return
        if self._is_stable or self.is_ending or self._is_logged_repetition():
            self._log()
        self._send(now)

    def on_timer(self, now: HostTime) -> None:
        """Send the regular report if it is due."""
        if now.monotonic_ns - self._last_warning_ns > WARNING_LIFETIME_NS:
            self._last_warning = ""
        if now.monotonic_ns < self.next_report_ns:
            return
        if self._changes > MAX_CHANGES_PER_PERIOD and self._is_stable and self.state != self._logged:
            self._log()
        self._changes = 0
        self.next_report_ns = now.monotonic_ns + self._period_ns
        since = (now.monotonic_ns - self._counted_ns) * 1e-9
        self.rate_hz = (self.samples - self._counted) / since if since > 0 else 0.0
        self._counted_ns, self._counted = now.monotonic_ns, self.samples
        self._send(now)

    def _is_logged_repetition(self) -> bool:
        """Count the present state; return whether this is its 1st, 10th, 100th repetition."""
        if len(self._repetitions) >= MAX_COUNTED_STATES:
            self._repetitions.clear()
        state = (self.state[0], self._text, bool(self._suffix))
        self._repetitions[state] += 1
        return str(self._repetitions[state]).strip("0") == "1"

    def _log(self) -> None:
        self._logged = self.state
        phase, text = self._logged
        bad = phase is DriverPhase.SILENT or (phase is DriverPhase.CLOSED and not self.is_ending)
        level = logging.WARNING if bad or self._is_warning else logging.INFO
        log.log(level, "%s: %s%s", self._source, phase.name.lower(), f": {text}" if text else "")
