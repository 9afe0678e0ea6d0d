"""The runner: connects an endpoint to a link, reconnects, stamps samples, and reports health.

One thread, one pass at a time (`run_once`): open the line when the backoff allows, else poll it until the next
deadline of the endpoint or of the health report, pass on received units, fire the timer, check for silence.

Reconnect: the wait doubles from `min_backoff` to `max_backoff` with 20 % jitter and is reset once the line was open for
5 s. Errors of the endpoint are counted and logged and the driver continues; errors of the link close the line.

Health (`HealthReporter`): regular reports to DRIVER_HEALTH, and changes of status to the log, both rate limited.

Signed commands (`DriveVerifier`) are verified before they reach the endpoint: a stranger on the bus cannot drive.
"""

from __future__ import annotations

import contextlib
import logging
import random
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

from modelserver.errors import WireError, quote
from modelserver.messages import NAN, DriverHealth, DriverPhase, Envelope, Sample, VehicleCommand
from modelserver.signing import Freshness, Key, check_freshness, has_valid_signature
from modelserver.wire.codec import decode, encode
from msdrivers.device_clock import DeviceClock, Stamper
from msdrivers.endpoint import (
    CommandableEndpoint,
    Endpoint,
    EndpointStatus,
    HostTime,
    MeasuredSample,
    Output,
    Reopen,
    Send,
    TimeSource,
    U,
)
from msdrivers.links import EndOfRecordingError, Link, LinkError
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

LOG_INTERVAL_NS = 60_000_000_000
"""The same state is logged once in this time, unless it has lasted for `STABLE_NS`."""

MAX_LOGGED_STATES = 100
"""Different states that are remembered for that."""


class HealthReporter:
    """Tracks the status of one driver and calls `send` when a report is due. Times in seconds."""

    def __init__(self, source: str, silence: float, period: float, time: TimeSource, send: Callable[[], object]):
        now = time.now()
        self.samples = 0
        self.rate_hz = 0.0
        self.is_silent = False
        """Nothing was received for `silence` seconds on an open line."""
        self.is_ending = False
        """The driver is stopping: a closed line is no warning then."""
        self.next_report_ns = now.monotonic_ns
        """Deadline of the next report, monotonic nanoseconds."""
        self._source, self._silence, self._period_ns = source, silence, round(period * 1e9)
        self._time_source, self._send = time, send
        self.sample_ns: int | None = None
        """When the last sample was published, monotonic nanoseconds."""
        self._counted_ns, self._counted = now.monotonic_ns, 0
        self._phase, self._text, self._is_warning = DriverPhase.CLOSED, "not opened yet", False
        self._last_warning = ""
        self._reported = self._logged = (DriverPhase.CLOSED, "")
        self._changes, self._changed_ns = 0, now.monotonic_ns
        self._logged_ns: dict[tuple[DriverPhase, str], int] = {}
        self._started_ns = now.monotonic_ns

    @property
    def state(self) -> tuple[DriverPhase, str]:
        phase, text = self._phase, self._text
        # an endpoint that reports silence itself knows the cause better
        if self.is_silent and phase is not DriverPhase.SILENT:
            phase, text = DriverPhase.SILENT, f"nothing received for {self._silence:g} s"
        if phase is DriverPhase.SILENT and self._last_warning not in text:
            text += f"; before that: {self._last_warning}"
        return phase, text

    def set_status(self, phase: DriverPhase, text: str, is_warning: bool = False) -> None:
        """Set phase and text and report a change.

        A warning is repeated with a silence that follows it, until data arrives or the line is reopened.
        """
        if is_warning:
            self._last_warning = text
        elif phase in (DriverPhase.WAITING, DriverPhase.STREAMING):
            self._last_warning = ""
        self._phase, self._text, self._is_warning = phase, text, is_warning
        self.report_change()

    def report_change(self) -> None:
        now, state = self._time_source.now(), self.state
        if state == self._reported:
            return
        self._reported, self._changed_ns = state, now.monotonic_ns
        self._changes += 1
        if self._changes > MAX_CHANGES_PER_PERIOD and not self.is_ending:
            return
        # at a start the device may appear after its driver: what is wrong then is logged once it lasts (`on_timer`)
        is_starting = self.sample_ns is None and now.monotonic_ns - self._started_ns < STABLE_NS
        is_new = now.monotonic_ns - self._logged_ns.get(state, -LOG_INTERVAL_NS) >= LOG_INTERVAL_NS
        if self.is_ending or (is_new and not (is_starting and self._is_bad)):
            self._log(now)
        self._send()

    def on_timer(self) -> None:
        now = self._time_source.now()
        if now.monotonic_ns < self.next_report_ns:
            return
        if self.state != self._logged and now.monotonic_ns - self._changed_ns >= STABLE_NS:
            self._log(now)
        self._changes = 0
        self.next_report_ns = now.monotonic_ns + self._period_ns
        since = (now.monotonic_ns - self._counted_ns) * 1e-9
        self.rate_hz = (self.samples - self._counted) / since if since > 0 else 0.0
        self._counted_ns, self._counted = now.monotonic_ns, self.samples
        self._send()

    @property
    def _is_bad(self) -> bool:
        phase, _ = self.state
        is_lost = phase is DriverPhase.CLOSED and not self.is_ending
        return phase is DriverPhase.SILENT or is_lost or self._is_warning

    def _log(self, now: HostTime) -> None:
        self._logged = self.state
        if len(self._logged_ns) >= MAX_LOGGED_STATES:
            self._logged_ns.clear()
        self._logged_ns[self._logged] = now.monotonic_ns
        phase, text = self._logged
        level = logging.WARNING if self._is_bad else logging.INFO
        log.log(level, "%s: %s%s", self._source, phase.name.lower(), f": {text}" if text else "")


STABLE_NS = 5_000_000_000
"""A line that was open for this long is stable; one that is lost earlier counts as a failed attempt."""

MIN_FAILURES_REPORTED = 3
"""Consecutive failed attempts from which on the status text mentions them."""


MAX_COUNTERS = 200
"""Largest number of the endpoint's counters in a health report; the runner's own come on top."""

MAX_READ_NS, READ_ATTEMPTS = 20_000, 5
"""Both clocks are read within this time, unless the process is interrupted in each attempt."""


class SystemTimeSource:
    """The host's clocks."""

    def now(self) -> HostTime:
        """Return the instant: both clocks again, where the process was interrupted between them.

        Otherwise the stamps made from the device's clock would be later than their samples by the interruption.
        """
        for _ in range(READ_ATTEMPTS):
            monotonic_ns, time_ns = time.monotonic_ns(), time.time_ns()
            if time.monotonic_ns() - monotonic_ns <= MAX_READ_NS:
                break
        return HostTime(monotonic_ns, time_ns // 1000)

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


@dataclass(frozen=True, slots=True)
class RunnerSettings:
    """Settings of a runner. Times in seconds.

    source, device: the driver's name in the vehicle file and its kind of device. min_backoff, max_backoff: wait before
    the line is opened again. silence: without data for this long the device is SILENT, and after `reopen_timeout` the
    line is reopened; both grow with the endpoint's `max_silence`. report_period: between health reports. poll_timeout:
    longest wait for data, and so the latency of `stop` and of commands.
    """

    source: str
    device: str
    min_backoff: float = 0.2
    max_backoff: float = 0.5
    silence: float = 3.0
    reopen_timeout: float = 10.0
    report_period: float = 1.0
    poll_timeout: float = 0.2


class Runner(Generic[U]):
    """Runs one endpoint on one link; `publish` gets the stamped samples, `publish_health` the health reports."""

    def __init__(
        self,
        endpoint: Endpoint[U],
        link: Link[U],
        settings: RunnerSettings,
        time_source: TimeSource,
        publish: Callable[[Sample], object] = lambda sample: None,
        publish_health: Callable[[DriverHealth], object] = lambda health: None,
        rng: random.Random | None = None,
    ):
        self.counts: Counter[str] = Counter()
        """Errors and dropped commands, by kind."""
        self.reconnects = 0
        self._endpoint, self._settings, self._time_source = endpoint, settings, time_source
        self._link = link
        self._publish, self._publish_health = publish, publish_health
        self._rng = rng or random.Random()
        self._wait_s, self._failures = settings.min_backoff, 0
        self._opened_ns: int | None = None
        max_silence = getattr(endpoint, "max_silence", 0.0)
        self._silence = max(settings.silence, max_silence)
        self._reopen_timeout = max(settings.reopen_timeout, 2.0 * max_silence)
        self._stamper = Stamper(DeviceClock())
        self._is_stopping, self._close_reason = False, "ended"
        self._is_open = self._was_open = False
        self._baud: int | None = None
        self._open_ns = self._received_ns = time_source.now().monotonic_ns
        period, send = settings.report_period, self._send_report
        self._reporter = HealthReporter(settings.source, self._silence, period, time_source, send)

    @property
    def samples(self) -> int:
        return self._reporter.samples

    @property
    def state(self) -> tuple[DriverPhase, str]:
        return self._reporter.state

    def run(self, before_pass: Callable[[], object] = lambda: None) -> None:
        """Run until `stop` is called or a recording ends, then close in order; `before_pass` runs before each pass."""
        try:
            while not self._is_stopping:
                before_pass()
                self.run_once()
        finally:
            self._finish()

    def stop(self) -> None:
        """Make `run` return; safe in a signal handler."""
        self._is_stopping = self._reporter.is_ending = True

    def send_command(self, command: VehicleCommand) -> None:
        """Pass a command to the endpoint; it is dropped and counted if the line is closed or takes no commands."""
        self._dispatch_command(lambda endpoint, now: endpoint.on_command(command, now))

    def reject_command(self, reason: str, text: str) -> None:
        """Let the endpoint count and report a malformed command."""
        self._dispatch_command(lambda endpoint, now: endpoint.reject_command(reason, text, now))

    def send_unit(self, unit: U) -> None:
        """Send a unit to the device, such as corrections; it is dropped and counted if the line is closed."""
        if not self._is_open:
            self.counts["units_dropped"] += 1
            return
        self._call_guarded("send", lambda: [Send(unit)])

    def _dispatch_command(self, call: Callable[[CommandableEndpoint[U], HostTime], Sequence[Output[U]]]) -> None:
        endpoint = self._endpoint
        if not self._is_open or not isinstance(endpoint, CommandableEndpoint):
            self.counts["commands_dropped"] += 1
            return
        now = self._time_source.now()
        self._call_guarded("on_command", lambda: call(endpoint, now))

    def run_once(self) -> None:
        """Make one pass: open the line or process its input, fire the endpoint's timer, report health."""
        if not self._is_open:
            self._open_when_due()
        else:
            try:
                self._transfer()
            except EndOfRecordingError as error:
                self._close_reason = error.reason
                self._close_line()
                self.stop()
            except LinkError as error:
                self._close(str(error))
        self._reporter.on_timer()

    def _open_when_due(self) -> None:
        now = self._time_source.now()
        wait = (self._open_ns - now.monotonic_ns) * 1e-9
        if wait > 0:
            self._time_source.sleep(min(wait, self._settings.poll_timeout))
            return
        try:
            with self._guard_link("open"):
                self._link.open(self._baud)
        except LinkError as error:
            self._close(str(error))
            return
        if self._was_open:
            self.reconnects += 1
            self._stamper.reconnect()
        self._is_open = self._was_open = True
        now = self._time_source.now()
        self._received_ns = now.monotonic_ns
        self._opened_ns = now.monotonic_ns
        self._reporter.set_status(DriverPhase.WAITING, f"{self._link.description} is open")
        self._call_guarded("on_open", lambda: self._endpoint.on_open(now))

    def _call_guarded(self, what: str, call: Callable[[], Sequence[Output[U]]]) -> None:
        """Call the endpoint; an error of the link closes the line."""
        try:
            self._call(what, call)
        except LinkError as error:
            self._close(str(error))

    def _reopen(self, request: Reopen) -> None:
        changes_baud = request.baud is not None and request.baud != self._link.baud
        self._baud = request.baud or self._baud
        self._close(f"reopening: {request.reason}", is_orderly=True, changes_baud=changes_baud)

    def _close(self, reason: str, *, is_orderly: bool = False, changes_baud: bool = False) -> None:
        """Close the line and schedule its reopening: at once to change the baud rate, else when the backoff allows."""
        self._close_line()
        at_ns = self._time_source.now().monotonic_ns
        is_stable = self._check_stability(at_ns)
        # a change of the baud rate is neither failure nor success
        self._failures += self._opened_ns is not None and not is_stable and not changes_baud
        self._opened_ns = None
        wait = 0.0
        # a lost line always waits: a program that competes for it must not cause a busy loop
        if not changes_baud and not (is_orderly and is_stable):
            wait = self._wait_s * self._rng.uniform(0.8, 1.2)
            self._wait_s = min(self._wait_s * 2.0, self._settings.max_backoff)
        self._open_ns = at_ns + round(wait * 1e9)
        if self._failures >= MIN_FAILURES_REPORTED:
            reason += "; it is opened and closed again and again: does another program use it?"
        self._reporter.set_status(DriverPhase.CLOSED, reason)

    def _check_stability(self, at_ns: int) -> bool:
        """Return whether the line is stable; if so, reset the backoff."""
        if self._opened_ns is None or at_ns - self._opened_ns < STABLE_NS:
            return False
        self._wait_s, self._failures = self._settings.min_backoff, 0
        return True

    def _close_line(self) -> None:
        with contextlib.suppress(LinkError), self._guard_link("close"):
            self._link.close()
        self._is_open = self._reporter.is_silent = False

    def _transfer(self) -> None:
        due = self._endpoint.get_deadline()
        now = self._time_source.now()
        next_ns = min(self._reporter.next_report_ns, due) if due is not None else self._reporter.next_report_ns
        with self._guard_link("poll"):
            units = self._link.poll(min(max(0.0, (next_ns - now.monotonic_ns) * 1e-9), self._settings.poll_timeout))
        now = self._time_source.now()
        if units:
            self._received_ns, self._reporter.is_silent = now.monotonic_ns, False
        for unit in units:
            self._call("on_receive", lambda unit=unit: self._endpoint.on_receive(unit, now))  # type: ignore[misc]
            if not self._is_open:
                return
        due = self._endpoint.get_deadline()
        if due is not None and now.monotonic_ns >= due:
            self._call("on_timer", lambda: self._endpoint.on_timer(now))
        self._check_silence(now)

    @contextlib.contextmanager
    def _continue_on_error(self, what: str) -> Iterator[None]:
        """Count and log an exception; the driver continues."""
        try:
            yield
        except Exception:
            self._count_error(what)

    @contextlib.contextmanager
    def _guard_link(self, what: str) -> Iterator[None]:
        """Turn any other exception of the link into a LinkError; it is counted and logged."""
        try:
            yield
        except LinkError:
            raise
        except Exception as error:
            self._count_error(f"link.{what}")
            why = f"{type(error).__name__}: {quote(str(error), 100)}"
            fix = "an error of the line's own, with its place in the log"
            raise LinkError(self._link.description, why, fix) from error

    def _count_error(self, what: str) -> None:
        self.counts[f"errors.{what}"] += 1
        count = self.counts[f"errors.{what}"]
        # log the 1st, 10th, 100th: a flood must not fill the log
        if str(count).strip("0") == "1":
            log.exception("%s: internal error number %d in %s", self._settings.source, count, what)

    def _call(self, what: str, call: Callable[[], Sequence[Output[U]]]) -> None:
        """Call the endpoint and execute its outputs. Raises LinkError."""
        outputs: Sequence[Output[U]] = ()
        with self._continue_on_error(what):
            outputs = call()
        for output in outputs:
            if isinstance(output, Send):
                with self._guard_link("send"):
                    self._link.send(output.unit)
            elif isinstance(output, MeasuredSample):
                self._publish_sample(output)
            elif isinstance(output, EndpointStatus):
                self._reporter.set_status(output.phase, output.text, output.is_warning)
            else:
                self._reopen(output)
                return

    def _publish_sample(self, measured: MeasuredSample) -> None:
        now = self._time_source.now()
        with self._continue_on_error("publish"):
            self._publish(self._stamper.stamp(measured, now))
            self._reporter.samples += 1
            self._reporter.sample_ns = now.monotonic_ns

    def _check_silence(self, now: HostTime) -> None:
        self._check_stability(now.monotonic_ns)
        quiet = (now.monotonic_ns - self._received_ns) * 1e-9
        if quiet >= self._silence and not self._reporter.is_silent:
            self._reporter.is_silent = True
            self._reporter.report_change()
        if quiet >= self._reopen_timeout:
            self._reopen(Reopen(f"nothing received for {quiet:.0f} s"))

    def _send_report(self) -> None:
        with self._continue_on_error("report"):
            self._publish_health(self.make_health(self._time_source.now()))

    def make_health(self, now: HostTime) -> DriverHealth:
        phase, text = self._reporter.state
        clock = self._stamper.clock
        return DriverHealth(
            utime=now.utime,
            source=self._settings.source,
            device=self._settings.device,
            phase=phase,
            text=text,
            link=self._link.description,
            baud=self._link.baud,
            reconnects=self.reconnects,
            samples=self.samples,
            rate_hz=self._reporter.rate_hz,
            age=NAN if self._reporter.sample_ns is None else (now.monotonic_ns - self._reporter.sample_ns) * 1e-9,
            clock_offset=self._stamper.offset,
            clock_drift=clock.drift,
            clock_sigma=self._stamper.sigma,
            clock_restarts=clock.restarts,
            counters=(*sorted(self._endpoint.counts.items())[:MAX_COUNTERS], *sorted(self.counts.items())),
        )

    def _finish(self) -> None:
        if self._is_open:
            now = self._time_source.now()
            try:
                self._call("on_close", lambda: self._endpoint.on_close(now))
            except LinkError as error:
                log.warning("%s: the device's state could not be restored: %s", self._settings.source, error)
            self._close_line()
        self._reporter.set_status(DriverPhase.CLOSED, self._close_reason)


COMMAND_TYPE = "vehicle_command_t"


class CommandDeniedError(Exception):
    """A denied command: the name of its counter, and why."""

    def __init__(self, reason: str, text: str):
        super().__init__(text)
        self.reason = reason


class DriveVerifier:
    """Verifies envelopes with commands for `channel` (without the vehicle's `prefix`).

    `started_ns`: when the driver started, monotonic; a command that an earlier run could have accepted is denied.
    """

    def __init__(self, keys: Iterable[Key], prefix: str, channel: str, window_s: float, started_ns: int):
        self._keys = {key.name: key for key in keys}
        self._prefix, self._channel = prefix, channel
        self._window_us = round(window_s * 1e6)
        self._started_ns = started_ns
        self._freshness = Freshness()

    def verify(self, data: bytes, now: HostTime) -> VehicleCommand:
        """Return the command in an envelope. Raises CommandDeniedError."""
        try:
            envelope: Envelope = decode("signed_t", data)
        except WireError as error:
            raise CommandDeniedError(error.reason, f"no signed message: {error}") from None
        key = self._keys.get(envelope.key_name)
        if key is None:
            raise CommandDeniedError("unknown_key", "signed with a key that is not in the vehicle's key file")
        if not has_valid_signature(key, self._prefix, envelope):
            raise CommandDeniedError("bad_signature", "its signature is wrong: another key, or another vehicle")
        if envelope.channel != self._channel:
            raise CommandDeniedError("channel", f"it was signed for another channel than {self._channel}")
        uptime_us = (now.monotonic_ns - self._started_ns) // 1000
        check = check_freshness(self._freshness, envelope, now.utime, uptime_us, self._window_us)
        self._freshness = check.freshness
        if check.reason:
            raise CommandDeniedError(check.reason, check.message)
        try:
            command: VehicleCommand = decode(COMMAND_TYPE, envelope.payload)
        except WireError as error:
            raise CommandDeniedError(error.reason, str(error)) from None
        return command
