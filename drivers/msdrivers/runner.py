"""The runner: carries between a station and a line, keeps the line open, stamps what was measured, and reports."""

from __future__ import annotations

import logging
import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from modelserver.messages import DriverHealth, DriverPhase, Sample, VehicleCommand
from msdrivers.device_clock import DeviceClock
from msdrivers.links import Link, LinkError, PlayedOutError
from msdrivers.links.guarded import GuardedLink
from msdrivers.raw_log import Time
from msdrivers.reporting import Reporter
from msdrivers.retries import Retries
from msdrivers.stamping import Stamper
from msdrivers.station import CommandableStation, Measured, Now, Output, Quiet, Reopen, Send, Station, StationStatus

log = logging.getLogger(__name__)

U = TypeVar("U")

MAX_COUNTERS = 200
"""Of a station that go out in a report; a report takes a few more."""


class SystemTime:
    """The host's clocks."""

    def now(self) -> Now:
        """Return the instant."""
        return Now(time.monotonic_ns(), time.time_ns() // 1000)

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


@dataclass(frozen=True, slots=True)
class RunnerSettings:
    """How a driver is run. Times in seconds.

    source, device: its name in the vehicle file and the kind of its device.
    first_wait, last_wait: before the line is tried again, growing. silence: after so long without a unit the device is
        called silent, and after `reopen` the line is opened anew; a station that is `Quiet` may be quiet for longer.
        report: between reports. look: so often it is looked whether to end, and for commands.
    """

    source: str
    device: str
    first_wait: float = 0.2
    last_wait: float = 0.5
    silence: float = 3.0
    reopen: float = 10.0
    report: float = 1.0
    look: float = 0.2


class Runner(Generic[U]):
    """Runs one station on one line. `publish` takes the stamped samples, `report` how the driver is."""

    def __init__(
        self,
        station: Station[U],
        link: Link[U],
        settings: RunnerSettings,
        clock: Time,
        publish: Callable[[Sample], object] = lambda sample: None,
        report: Callable[[DriverHealth], object] = lambda health: None,
        rng: random.Random | None = None,
    ):
        self.counts: Counter[str] = Counter()
        """Errors of the runner's own, by kind."""
        self.reconnects = 0
        self._station, self._settings, self._clock = station, settings, clock
        self._link = GuardedLink(link, self._failed)
        self._publish, self._report = publish, report
        self._retries = Retries(settings.first_wait, settings.last_wait, rng or random.Random())
        quiet = station.quiet if isinstance(station, Quiet) else 0.0
        # a line that is quiet twice as long as the device may be is opened anew
        self._silence, self._patience = max(settings.silence, quiet), max(settings.reopen, 2.0 * quiet)
        self._stamper = Stamper(DeviceClock())
        self._stopping, self._last_word = False, "ended"
        self._is_open = self._was_open = False
        self._baud: int | None = None
        now = clock.now()
        self._open_ns = self._heard_ns = now.monotonic_ns
        self._reporter = Reporter(settings.source, self._silence, settings.report, now, self._send_report)

    @property
    def samples(self) -> int:
        """How many samples have gone out."""
        return self._reporter.samples

    @property
    def state(self) -> tuple[DriverPhase, str]:
        """The phase that the driver is in, and what there is to say of it for a person."""
        return self._reporter.state

    def run(self, attend: Callable[[], object] = lambda: None) -> None:
        """Run until `stop` is called or a recording has ended, then leave the device as the station will have it.

        `attend` is called before each pass.
        """
        try:
            while not self._stopping:
                attend()
                self.turn()
        finally:
            self._finish()

    def stop(self) -> None:
        """Make `run` return. May be called from a signal handler."""
        self._stopping = self._reporter.is_ending = True

    def command(self, command: VehicleCommand) -> None:
        """Hand a command to a station that takes them; without an open line it goes nowhere and is counted."""
        self._commanded(lambda station, now: station.command(command, now))

    def refuse(self, reason: str, text: str) -> None:
        """Let the station count and tell what came as a command and cannot be one."""
        self._commanded(lambda station, now: station.refuse(reason, text, now))

    def _commanded(self, ask: Callable[[CommandableStation[U], Now], Sequence[Output[U]]]) -> None:
        station = self._station
        if not self._is_open or not isinstance(station, CommandableStation):
            self.counts["commands_lost"] += 1
            return
        now = self._clock.now()
        try:
            self._do(self._asked("command", lambda: ask(station, now)))
        except LinkError as error:
            self._lost(error)

    def turn(self) -> None:
        """Make one pass: open the line, or take what it brings; wake the station when it is due; report."""
        if not self._is_open:
            self._open_when_due()
        else:
            try:
                self._carry()
            except PlayedOutError as error:
                self._last_word = error.why
                self._link.close()
                self._is_open = self._reporter.is_silent = False
                self.stop()
            except LinkError as error:
                self._lost(error)
        self._reporter.woken(self._clock.now())

    # --- the line ---------------------------------------------------------------------------------------------

    def _open_when_due(self) -> None:
        now = self._clock.now()
        left = (self._open_ns - now.monotonic_ns) * 1e-9
        if left > 0:
            self._clock.sleep(min(left, self._settings.look))
            return
        try:
            self._link.open(self._baud)
        except LinkError as error:
            self._lost(error)
            return
        self.reconnects += self._was_open
        self._is_open = self._was_open = True
        now = self._clock.now()
        self._heard_ns = now.monotonic_ns
        self._retries.opened(now.monotonic_ns)
        self._tell(DriverPhase.WAITING, f"{self._link.description} is open")
        try:
            self._do(self._asked("opened", lambda: self._station.opened(now)))
        except LinkError as error:
            self._lost(error)

    def _lost(self, error: LinkError) -> None:
        self._close(str(error), lambda at_ns: self._retries.lost(at_ns))

    def _reopen(self, wish: Reopen) -> None:
        changes = wish.baud is not None and wish.baud != self._link.baud
        self._baud = wish.baud or self._baud

        def wait(at_ns: int) -> float:
            if not changes:
                return self._retries.lost(at_ns, in_order=True)
            self._retries.changed()
            return 0.0

        self._close(f"opening anew: {wish.why}", wait)

    def _close(self, why: str, wait: Callable[[int], float]) -> None:
        """Close the line, tell `why`, and open it again after `wait`, which takes the present instant."""
        self._link.close()
        self._is_open = self._reporter.is_silent = False
        at_ns = self._clock.now().monotonic_ns
        self._open_ns = at_ns + round(wait(at_ns) * 1e9)
        self._reporter.tell(DriverPhase.CLOSED, why, self._clock.now(), note=self._retries.note(at_ns))
        self._reporter.steady(False)

    # --- the station ------------------------------------------------------------------------------------------

    def _carry(self) -> None:
        due = self._station.due()
        now = self._clock.now()
        next_ns = min(self._reporter.due_ns, due) if due is not None else self._reporter.due_ns
        units = self._link.poll(min(max(0.0, (next_ns - now.monotonic_ns) * 1e-9), self._settings.look))
        now = self._clock.now()
        if units:
            self._heard_ns, self._reporter.is_silent = now.monotonic_ns, False
        for unit in units:
            self._do(self._asked("received", lambda unit=unit: self._station.received(unit, now)))  # type: ignore[misc]
            if not self._is_open:
                return
        due = self._station.due()
        if due is not None and now.monotonic_ns >= due:
            self._do(self._asked("woken", lambda: self._station.woken(now)))
        self._watch(now)

    def _asked(self, what: str, ask: Callable[[], Sequence[Output[U]]]) -> Sequence[Output[U]]:
        """Ask the station; an error of its own is counted and told, and the driver goes on."""
        try:
            return ask()
        except Exception:
            self._failed(what)
            return ()

    def _failed(self, what: str) -> None:
        self.counts[f"errors.{what}"] += 1
        count = self.counts[f"errors.{what}"]
        # the first, the tenth, the hundredth: a flood must not fill the log
        if str(count).strip("0") == "1":
            log.exception("%s: an error of the driver's own, number %d in %s", self._settings.source, count, what)

    def _do(self, outputs: Sequence[Output[U]]) -> None:
        for output in outputs:
            if isinstance(output, Send):
                self._link.send(output.unit)
            elif isinstance(output, Measured):
                self._measured(output)
            elif isinstance(output, StationStatus):
                self._tell(DriverPhase[output.phase.name], output.text, output.is_trouble)
            else:
                self._reopen(output)
                return

    def _measured(self, measured: Measured) -> None:
        now = self._clock.now()
        try:
            self._publish(self._stamper.stamp(measured, now))
        except Exception:
            self._failed("publish")
            return
        self._reporter.measured(now)

    def _watch(self, now: Now) -> None:
        self._reporter.steady(self._retries.is_steady(now.monotonic_ns))
        quiet = (now.monotonic_ns - self._heard_ns) * 1e-9
        if quiet >= self._silence and not self._reporter.is_silent:
            self._reporter.is_silent = True
            self._reporter.announce(now)
        if quiet >= self._patience:
            self._reopen(Reopen(f"nothing heard for {quiet:.0f} s"))

    # --- telling ----------------------------------------------------------------------------------------------

    def _tell(self, phase: DriverPhase, text: str, is_trouble: bool = False) -> None:
        self._reporter.tell(phase, text, self._clock.now(), is_trouble=is_trouble)

    def _send_report(self, now: Now) -> None:
        try:
            self._report(self.health(now))
        except Exception:
            self._failed("report")

    def health(self, now: Now) -> DriverHealth:
        """Return how the driver is."""
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
            age=self._reporter.age(now),
            clock_offset=self._stamper.offset,
            clock_drift=clock.drift,
            clock_sigma=self._stamper.sigma,
            clock_restarts=clock.restarts,
            counters=(*sorted(self._station.counts.items())[:MAX_COUNTERS], *sorted(self.counts.items())),
        )

    def _finish(self) -> None:
        if self._is_open:
            now = self._clock.now()
            try:
                self._do(self._asked("leaving", lambda: self._station.leaving(now)))
            except LinkError as error:
                log.warning("%s: the device could not be left as it was found: %s", self._settings.source, error)
            self._link.close()
            self._is_open = self._reporter.is_silent = False
        self._tell(DriverPhase.CLOSED, self._last_word)
