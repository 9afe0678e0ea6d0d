"""The driver of a MicroStrain 3DM-GX1: finds it, sets it up, streams a measurement and polls others between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from modelserver.messages import NAN, SensorHeader
from msdrivers.devices.gx1.contact import RETRY_S, ContactState, Part, UnusableError, contact, read_gains, read_words
from msdrivers.devices.gx1.conversion import GravityCheck, imu_sample, saturated_fields
from msdrivers.devices.gx1.dialogue import Ask, Dialogue, NoReplyError, Pause, Script
from msdrivers.devices.gx1.link import Gx1Link, Reply
from msdrivers.devices.gx1.polls import Polls
from msdrivers.devices.gx1.settings import Gx1Settings
from msdrivers.devices.gx1.tick_rate import TickRate
from msdrivers.protocol.gx1 import DATA, LENGTHS, Address, CommandByte, Gains, requests
from msdrivers.protocol.gx1.scaling import DOCUMENTED_TIMERS, temperature_celsius, tick_seconds
from msdrivers.station import Measured, Now, Output, Send, StationPhase, StationStatus

BIAS_S = 9.0
"""How long a capture of the gyros' biases may take: less than until a line that brings nothing is opened anew."""

GRAVITY_POLL_S = 1.0
_POSTURE = (CommandByte.EULER_VECTORS, CommandByte.QUATERNION_VECTORS)
"""Messages that tell whether specific force points up: with it, rates and orientation."""


class Gx1Driver:
    """A `Station` of bytes; see `Gx1Settings`. The line is to be opened at the first baud rate of the settings.

    The times in the samples are the device's ticks, unwrapped: they never go back by more than two ticks, and go ahead
    by more than a turn of the counter when the device was set up anew.
    """

    def __init__(self, settings: Gx1Settings):
        """Take the settings."""
        self.settings = settings
        self.tick_s = settings.tick or 0.0
        """Seconds of a tick; 0 before that is known."""
        self._link = Gx1Link()
        self._dialogue = Dialogue(self._link, self._set_up)
        self._found = ContactState(list(settings.bauds))
        self._gains = Gains(1, 1, 1)
        self._device = "3DM-GX1"
        self._bias_pending = settings.capture_bias_at_start
        self._gravity = GravityCheck()
        self._rate = TickRate(1.0)
        self._polls = Polls()
        self._seq = 0
        self._celsius = NAN
        self._spoke_ns = 0
        self._streams = False
        self._counts: Counter[str] = Counter()

    def opened(self, now: Now) -> list[Output[bytes]]:
        """Begin, or go on at another baud rate."""
        return self._dialogue.opened(now)

    def received(self, unit: bytes, now: Now) -> list[Output[bytes]]:
        """Take bytes."""
        outputs: list[Output[bytes]] = []
        for reply in self._link.feed(unit, now):
            if self._dialogue.running:
                outputs += self._dialogue.take(reply, now)
            else:
                outputs += self._streamed(reply, now)
        return outputs

    def woken(self, now: Now) -> list[Output[bytes]]:
        """Ask for what is due, or see that nothing comes any more."""
        self._link.now = now
        if self._dialogue.running:
            return self._dialogue.woken(now)
        if now.monotonic_ns >= self._silent_ns():
            return self._restarted(now, self._why_silent())
        for command in self._polls.overdue(now.monotonic_ns):
            self._link.parser.give_up(command)
            self._counts[f"unanswered.{CommandByte(command).name.lower()}"] += 1
        outputs: list[Output[bytes]] = []
        for command in self._polls.take_due(now.monotonic_ns):
            self._link.parser.expect(command)
            outputs.append(Send(requests.poll(command)))
        return outputs

    def due(self) -> int | None:
        """Return when to be woken."""
        if self._dialogue.running:
            return self._dialogue.due
        return min(self._silent_ns(), self._polls.due)

    def leaving(self, now: Now) -> list[Output[bytes]]:
        """Leave the continuous mode as it was found: stopped, or with what was streamed then."""
        self._dialogue.stop()
        self._link.begin_anew()
        return [] if self._found.streamed is None else [Send(self._found.restored())]

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, bytes skipped, rejected and unanswered by reason, restarts, saturated vectors."""
        return self._link.messages + self._link.parser.counts + self._counts

    def _set_up(self) -> Script:
        while True:
            try:
                self._device = yield from contact(self._link, self._found)
                yield StationStatus(StationPhase.CONFIGURING, f"{self._device} answers{self._found.at}")
                self._gains = yield from read_gains()
                yield from self._read_timer()
                if self.settings.capture_bias_at_start:
                    yield from self._capture_bias()
                yield from self._start()
                return
            except NoReplyError as silence:
                why = f"{self._device} fell silent while it was set up: {silence}; check its cable and power"
            except UnusableError as unusable:
                why = f"{self._device} cannot be used: {unusable}"
            yield StationStatus(StationPhase.SILENT, f"{why}; nothing is published, trying again in {RETRY_S:g} s")
            yield Pause(RETRY_S)

    def _read_timer(self) -> Part[None]:
        if self.settings.tick is None:
            words = yield from read_words(Address.TIMER)
            self.tick_s = tick_seconds(words)
            if not 1e-3 <= self.tick_s <= 0.1:
                raise UnusableError(
                    f"its EEPROM gives a timer tick of {self.tick_s:g} s (words {list(words)} at addresses "
                    f"{list(Address.TIMER)}); write the defaults 16 16 256 1 to them, or set tick in the settings"
                )
            if words not in DOCUMENTED_TIMERS:
                yield StationStatus(
                    StationPhase.CONFIGURING,
                    f"the timer words {list(words)} are not documented; a tick of {self.tick_s * 1e3:g} ms is "
                    "inferred from them and will be compared with the host's clock",
                )
        self._link.watch.clock(self.tick_s)
        self._rate = TickRate(self.tick_s)

    def _capture_bias(self) -> Part[None]:
        if not self._bias_pending:
            yield StationStatus(
                StationPhase.CONFIGURING,
                "the gyro biases are not captured again, since the vehicle may be moving; for that restart the driver "
                "at rest",
            )
            return
        yield StationStatus(StationPhase.CONFIGURING, "capturing the gyro biases: keep the vehicle still")
        self._bias_pending = False
        try:
            yield Ask(requests.poll(CommandByte.CAPTURE_BIAS), timeout=BIAS_S, tries=1)
        except NoReplyError:
            text = (
                f"the capture of the gyro biases did not end within {BIAS_S:g} s; going on with the biases from before"
            )
        else:
            text = "the gyro biases are captured"
        yield StationStatus(StationPhase.CONFIGURING, text)

    def _start(self) -> Part[None]:
        message = self.settings.message
        self._link.stream(message)
        yield Ask(requests.stream(message), value=message)
        self._link.stream(message)
        now_ns = self._link.now.monotonic_ns
        self._link.mark()
        self._spoke_ns, self._streams = now_ns, False
        self._celsius = NAN
        self._gravity = GravityCheck()
        self._polls = Polls()
        if self.settings.temperature_period:
            self._polls.add(CommandByte.TEMPERATURE, self.settings.temperature_period, now_ns)
        if self.settings.polled is not None:
            self._polls.add(self.settings.polled, self.settings.poll_period, now_ns)
        if message not in _POSTURE and self.settings.polled not in _POSTURE:
            self._polls.add(CommandByte.EULER_VECTORS, GRAVITY_POLL_S, now_ns)

    def _streamed(self, reply: Reply, now: Now) -> list[Output[bytes]]:
        """Take a reply while the device streams."""
        if self._link.watch.jumped:
            return self._restarted(now, "its ticks jumped, so it has restarted or is another one")
        packet, count = reply
        command = packet.command
        self._polls.answered(command)
        if command == CommandByte.TEMPERATURE:
            self._celsius = temperature_celsius(packet.unsigned)
        if command not in DATA:
            return []
        outputs: list[Output[bytes]] = []
        if command == self.settings.message:
            self._spoke_ns = now.monotonic_ns
            self._link.mark()
            if not self._streams:
                self._streams = True
                outputs.append(StationStatus(StationPhase.STREAMING, f"{self._device} streams message {int(command)}"))
            if self._rate.take(count, now.monotonic_ns):
                outputs.append(StationStatus(StationPhase.STREAMING, self._rate.text()))
        device_utime = round(count * self.tick_s * 1e6) if self._rate.agrees else 0
        header = SensorHeader(0, self.settings.source, self._seq, now.utime, device_utime)
        sample = imu_sample(
            packet, self._gains, self.settings.specific_force_sign, self.settings.heading, header, self._celsius
        )
        if self._gravity.take(sample):
            outputs += self._gravity_found()
        if command not in (self.settings.message, self.settings.polled):
            return outputs
        for name in saturated_fields(packet):
            self._counts[f"saturated.{name}"] += 1
        self._seq += 1
        self._celsius = NAN
        # without the device's time the way over the line is part of the delay
        line = LENGTHS[command] * 10.0 / self._found.bauds[0] if self._found.bauds and not device_utime else 0.0
        return [*outputs, Measured(sample, self.settings.delay + line, self.settings.delay_sigma, self.tick_s)]

    def _gravity_found(self) -> list[Output[bytes]]:
        if CommandByte.EULER_VECTORS not in (self.settings.message, self.settings.polled):
            # it was polled for this only
            self._polls.remove(CommandByte.EULER_VECTORS)
            self._link.parser.give_up(CommandByte.EULER_VECTORS)
        if self._gravity.upwards:
            return []
        sign = self.settings.specific_force_sign
        return [
            StationStatus(
                StationPhase.STREAMING,
                "at rest the specific force points down by the device's own orientation, and must point up: this "
                f"device gives the opposite of specific force; set specific_force_sign to {-sign} (it is {sign})",
            )
        ]

    def _silent_ns(self) -> int:
        return self._spoke_ns + round(self.settings.silence * 1e9)

    def _why_silent(self) -> str:
        message = self.settings.message
        why = f"no message {int(message)} that can be used for {self.settings.silence:g} s, heard {self._link.heard()}"
        rejected = ", ".join(f"{reason} {count}" for reason, count in sorted(self._link.rejected.items()))
        return f"{why}" + (f", rejected since the start: {rejected}" if rejected else "")

    def _restarted(self, now: Now, why: str) -> list[Output[bytes]]:
        self._counts["restarts"] += 1
        told = StationStatus(StationPhase.SILENT, f"{self._device}: {why}; setting it up anew")
        return [told, *self._dialogue.start(now)]
