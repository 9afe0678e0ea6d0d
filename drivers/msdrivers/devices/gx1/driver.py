"""Driver of a MicroStrain 3DM-GX1: finds the device, configures it, streams one measurement and polls others.

Time: the samples carry the device's unwrapped ticks. The length of a tick comes from the EEPROM's timer words, which
take effect only after a power cycle, so `TickRateCheck` compares it with the host's clock and disables the device's
time while two consecutive windows of 5 s contradict it by more than 0.5 %. Smaller errors are drift, which
`device_clock` estimates.

Sign: documents differ on whether the device reports specific force or its opposite; `GravityCheck` decides it while
the device is stationary.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

from modelserver.messages import NAN, ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices.gx1 import script
from msdrivers.devices.gx1.settings import Gx1Settings, HeadingSource
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Send
from msdrivers.protocol.gx1 import (
    LENGTHS,
    MEASUREMENTS,
    CommandByte,
    EepromAddress,
    Gains,
    Gx1Packet,
    requests,
    scaling,
)

_UP_NED: Vector3 = (0.0, 0.0, -1.0)
"""In north, east, down."""


def find_saturated_fields(packet: Gx1Packet) -> tuple[str, ...]:
    """Return the names of the saturated vectors."""
    return tuple(
        name
        for name in ("field", "acceleration", "rate")
        if packet.has(name) and scaling.is_saturated(packet.field(name))
    )


def sample_from_packet(
    packet: Gx1Packet, gains: Gains, force_sign: int, heading: HeadingSource, header: SensorHeader, celsius: float = NAN
) -> ImuSample:
    """Convert a measurement; missing and saturated vectors are None.

    `force_sign`: of the device's acceleration as specific force. The orientation is that of the sensor's axes in
    north, east, down.
    """
    missing = find_saturated_fields(packet)

    def convert(name: str, gain: int, unit: float = 1.0) -> Vector3 | None:
        return (
            scaling.vector_from_words(packet.field(name), gain, unit)
            if packet.has(name) and name not in missing
            else None
        )

    orientation: Quaternion | None = None
    if packet.has("euler"):
        orientation = scaling.orientation_from_euler(packet.field("euler"))
    elif packet.has("quaternion"):
        orientation = scaling.orientation_from_quaternion(packet.field("quaternion"))
    return ImuSample(
        header,
        angular_velocity=convert("rate", gains.gyro),
        specific_force=convert("acceleration", gains.accelerometer, force_sign * scaling.G0),
        magnetic_field=convert("field", gains.magnetometer, scaling.TESLA),
        orientation=orientation,
        orientation_reference=OrientationReference.NED if orientation else OrientationReference.NONE,
        yaw_source=YawSource.MAGNETIC if orientation and heading is HeadingSource.MAGNETIC else YawSource.NONE,
        temperature_celsius=celsius,
    )


class GravityCheck:
    """Checks the sign of the specific force while stationary, by the device's own orientation."""

    MIN_SAMPLES = 5
    """Consecutive stationary samples."""
    MAX_RATE = 0.1
    """Largest angular rate of a stationary device, rad/s."""
    MAX_FORCE_ERROR = 1.0
    """Largest deviation of a stationary device's force from gravity, m/s2."""

    def __init__(self) -> None:
        self._count = 0
        self.is_upward = True
        """The specific force points up, as it must; decided once `update` has returned True."""

    def update(self, sample: ImuSample) -> bool:
        """Process a sample; return True once, when the sign is decided."""
        force, rate, orientation = sample.specific_force, sample.angular_velocity, sample.orientation
        if self._count >= self.MIN_SAMPLES or force is None or rate is None or orientation is None:
            return False
        up = so3.rotate(so3.conjugate(orientation), _UP_NED)
        along = sum(a * b for a, b in zip(force, up, strict=True))
        is_quiet = math.hypot(*rate) <= self.MAX_RATE and abs(math.hypot(*force) - scaling.G0) <= self.MAX_FORCE_ERROR
        # neither up nor down: not stationary
        if not is_quiet or abs(along) < 0.7 * scaling.G0:
            self._count = 0
            return False
        upwards = along > 0.0
        self._count = self._count + 1 if upwards == self.is_upward else 1
        self.is_upward = upwards
        return self._count >= self.MIN_SAMPLES


NEVER = 1 << 62
REPLY_TIMEOUT_NS = 500_000_000
"""Reply timeout."""


class PollSchedule:
    """Commands that are polled periodically. Instants are monotonic nanoseconds."""

    def __init__(self) -> None:
        self._periods: dict[int, int] = {}
        self._next: dict[int, int] = {}
        self._pending: dict[int, int] = {}

    def add(self, command: int, period_s: float, now_ns: int) -> None:
        self._periods[command] = round(period_s * 1e9)
        self._next[command] = now_ns

    def remove(self, command: int) -> None:
        for table in (self._periods, self._next, self._pending):
            table.pop(command, None)

    @property
    def deadline_ns(self) -> int:
        return min((*self._next.values(), *self._pending.values()), default=NEVER)

    def pop_due(self, now_ns: int) -> list[int]:
        """Return the commands to poll now, except those whose reply is pending."""
        asked = []
        for command in [command for command, at in self._next.items() if at <= now_ns]:
            self._next[command] = max(self._next[command] + self._periods[command], now_ns + 1)
            if command not in self._pending:
                self._pending[command] = now_ns + REPLY_TIMEOUT_NS
                asked.append(command)
        return asked

    def pop_timed_out(self, now_ns: int) -> list[int]:
        """Return the commands whose reply timed out."""
        late = [command for command, until in self._pending.items() if until <= now_ns]
        for command in late:
            del self._pending[command]
        return late

    def on_reply(self, command: int) -> None:
        self._pending.pop(command, None)


WINDOW_NS = 5_000_000_000
TOLERANCE = 0.005
"""Largest relative deviation of a tick within a window: 25 ms, a tick or two plus the variation of the delay."""


class TickRateCheck:
    """Compares ticks with the host's clock; `is_consistent` changes after two consecutive windows that agree.

    The earliest reply of each window is compared, because delays vary.
    """

    def __init__(self, tick_s: float):
        self._tick_s = tick_s
        self._begin_ns: int | None = None
        self._before: tuple[int, int] | None = None
        self._earliest = (0, 0)
        self._agreeing_windows = 0
        self._measured = tick_s
        self.is_consistent = True

    def update(self, count: int, at_ns: int) -> bool:
        """Process unwrapped ticks and their receive time, monotonic nanoseconds; return whether the result changed."""
        if self._begin_ns is None or at_ns - self._begin_ns < WINDOW_NS:
            if self._begin_ns is None or self._get_latency(count, at_ns) < self._get_latency(*self._earliest):
                self._earliest = (count, at_ns)
            self._begin_ns = self._begin_ns or at_ns
            return False
        before, self._before = self._before, self._earliest
        self._begin_ns, self._earliest = at_ns, (count, at_ns)
        return before is not None and self._compare(before, self._before)

    def _get_latency(self, count: int, at_ns: int) -> float:
        return at_ns - count * self._tick_s * 1e9

    def _compare(self, before: tuple[int, int], earliest: tuple[int, int]) -> bool:
        ticks, elapsed_ns = earliest[0] - before[0], earliest[1] - before[1]
        last, self._measured = self._measured, elapsed_ns * 1e-9 / max(ticks, 1)
        contradicts = _is_different(self._measured, self._tick_s)
        if contradicts != self.is_consistent:
            self._agreeing_windows = 0
            return False
        # a host that was late makes one window too long and the next too short
        self._agreeing_windows = 1 if _is_different(self._measured, last) else self._agreeing_windows + 1
        if self._agreeing_windows < 2:
            return False
        self._agreeing_windows = 0
        self.is_consistent = not self.is_consistent
        return True

    def describe(self) -> str:
        """Describe the result."""
        expected = f"{self._tick_s * 1e3:.4g} ms"
        if self.is_consistent:
            return f"the device's ticks take {expected} again, as they should: its time is used"
        return (
            f"the device's ticks take {self._measured * 1e3:.4g} ms by the host's clock, expected {expected}: its time "
            "is not used; switch its power off and on if its timer words were changed, or set tick in the settings"
        )


def _is_different(measured: float, expected: float) -> bool:
    return abs(measured / expected - 1.0) > TOLERANCE


BIAS_CAPTURE_TIMEOUT_S = 9.0
"""Timeout of the gyro bias capture: shorter than the runner's reopen timeout."""

GRAVITY_POLL_PERIOD_S = 1.0
_GRAVITY_MESSAGES = (CommandByte.EULER_VECTORS, CommandByte.QUATERNION_VECTORS)
"""Messages with specific force, rates and orientation, as `GravityCheck` needs."""


class Gx1Driver:
    """An `Endpoint` of bytes; see `Gx1Settings`. The line must be opened at the first baud rate of the settings.

    The device times of the samples go back by at most two ticks, and advance by more than the counter's range when the
    setup was repeated.
    """

    def __init__(self, settings: Gx1Settings):
        self.settings = settings
        self.tick_s = settings.tick or 0.0
        """Seconds of a tick; 0 before that is known."""
        self._link = script.Gx1Receiver()
        self._script = script.ScriptRunner(self._link, self._run_setup)
        self._line_state = script.LineState(list(settings.bauds))
        self._gains = Gains(1, 1, 1)
        self._device = "3DM-GX1"
        self._bias_pending = settings.capture_bias_at_start
        self._gravity_check = GravityCheck()
        self._tick_check = TickRateCheck(1.0)
        self._polls = PollSchedule()
        self._seq = 0
        self._celsius = NAN
        self._streamed_ns = 0
        self._is_streaming = False
        self._counts: Counter[str] = Counter()

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        """Begin, or go on at another baud rate."""
        return self._script.on_open(now)

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        """Process received bytes."""
        outputs: list[Output[bytes]] = []
        for reply in self._link.feed(unit, now):
            if self._script.is_running:
                outputs += self._script.on_reply(reply, now)
            else:
                outputs += self._on_streamed_reply(reply, now)
        return outputs

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        """Send due polls; restart the setup after a timeout."""
        self._link.now = now
        if self._script.is_running:
            return self._script.on_timer(now)
        if now.monotonic_ns >= self._silence_deadline_ns():
            return self._restart(now, self._explain_silence())
        for command in self._polls.pop_timed_out(now.monotonic_ns):
            self._link.parser.cancel(command)
            self._counts[f"unanswered.{CommandByte(command).name.lower()}"] += 1
        outputs: list[Output[bytes]] = []
        for command in self._polls.pop_due(now.monotonic_ns):
            self._link.parser.expect(command)
            outputs.append(Send(requests.make_poll(command)))
        return outputs

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        if self._script.is_running:
            return self._script.deadline_ns
        return min(self._silence_deadline_ns(), self._polls.deadline_ns)

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        """Restore the continuous mode as it was found."""
        self._script.stop()
        self._link.reset()
        return [] if self._line_state.found_stream is None else [Send(self._line_state.make_restore_request())]

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, bytes skipped, rejected and unanswered by reason, restarts, saturated vectors."""
        return self._link.messages + self._link.parser.counts + self._counts

    def _run_setup(self) -> script.Script:
        while True:
            try:
                self._device = yield from script.find_device(self._link, self._line_state)
                yield script.report(f"{self._device} answers{self._line_state.at_baud_text}")
                self._gains = yield from script.read_gains()
                yield from self._read_timer()
                if self.settings.capture_bias_at_start:
                    yield from self._capture_bias()
                yield from self._start_stream()
                return
            except script.NoReplyError as silence:
                why = f"{self._device} fell silent while it was set up: {silence}; check its cable and power"
            except script.UnusableDeviceError as unusable:
                why = f"{self._device} cannot be used: {unusable}"
            text = f"{why}; nothing is published, trying again in {script.RETRY_DELAY_S:g} s"
            yield EndpointStatus(EndpointPhase.SILENT, text)
            yield script.PauseStep(script.RETRY_DELAY_S)

    def _read_timer(self) -> script.ScriptPart[None]:
        if self.settings.tick is None:
            words = yield from script.read_words(EepromAddress.TIMER)
            self.tick_s = scaling.tick_from_timer_words(words)
            if not 1e-3 <= self.tick_s <= 0.1:
                raise script.UnusableDeviceError(
                    f"its EEPROM gives a timer tick of {self.tick_s:g} s (words {list(words)} at addresses "
                    f"{list(EepromAddress.TIMER)}); write the defaults 16 16 256 1 to them, or set tick in the settings"
                )
            if words not in scaling.DOCUMENTED_TIMERS:
                yield script.report(
                    f"the timer words {list(words)} are not documented; a tick of {self.tick_s * 1e3:g} ms is "
                    "inferred from them and will be compared with the host's clock",
                )
        self._link.ticks.set_tick(self.tick_s)
        self._tick_check = TickRateCheck(self.tick_s)

    def _capture_bias(self) -> script.ScriptPart[None]:
        if not self._bias_pending:
            yield script.report(
                "the gyro biases are not captured again, since the vehicle may be moving; for that restart the driver "
                "while the vehicle is stationary",
            )
            return
        yield script.report("capturing the gyro biases: keep the vehicle still")
        self._bias_pending = False
        try:
            yield script.RequestStep(
                requests.make_poll(CommandByte.CAPTURE_BIAS), timeout=BIAS_CAPTURE_TIMEOUT_S, attempts=1
            )
        except script.NoReplyError:
            text = f"the gyro bias capture timed out after {BIAS_CAPTURE_TIMEOUT_S:g} s; using the previous biases"
        else:
            text = "the gyro biases are captured"
        yield script.report(text)

    def _start_stream(self) -> script.ScriptPart[None]:
        message = self.settings.message
        self._link.set_streamed(message)
        yield script.RequestStep(requests.make_stream(message), value=message)
        self._link.set_streamed(message)
        now_ns = self._link.now.monotonic_ns
        self._link.reset_input()
        self._streamed_ns, self._is_streaming = now_ns, False
        self._celsius = NAN
        self._gravity_check = GravityCheck()
        self._polls = PollSchedule()
        if self.settings.temperature_period:
            self._polls.add(CommandByte.TEMPERATURE, self.settings.temperature_period, now_ns)
        if self.settings.polled is not None:
            self._polls.add(self.settings.polled, self.settings.poll_period, now_ns)
        if message not in _GRAVITY_MESSAGES and self.settings.polled not in _GRAVITY_MESSAGES:
            self._polls.add(CommandByte.EULER_VECTORS, GRAVITY_POLL_PERIOD_S, now_ns)

    def _on_streamed_reply(self, reply: script.Gx1Reply, now: HostTime) -> list[Output[bytes]]:
        """Process a reply while the device streams."""
        if self._link.ticks.has_jumped:
            return self._restart(now, "its ticks jumped, so it has restarted or is another one")
        packet, count = reply
        command = packet.command
        self._polls.on_reply(command)
        if command == CommandByte.TEMPERATURE:
            self._celsius = scaling.temperature_from_word(packet.unsigned)
        if command not in MEASUREMENTS:
            return []
        outputs: list[Output[bytes]] = []
        if command == self.settings.message:
            self._streamed_ns = now.monotonic_ns
            self._link.reset_input()
            if not self._is_streaming:
                self._is_streaming = True
                text = f"{self._device} streams message {int(command)}"
                outputs.append(EndpointStatus(EndpointPhase.STREAMING, text))
            if self._tick_check.update(count, now.monotonic_ns):
                outputs.append(EndpointStatus(EndpointPhase.STREAMING, self._tick_check.describe()))
        device_utime = round(count * self.tick_s * 1e6) if self._tick_check.is_consistent else 0
        header = SensorHeader(0, self.settings.source, self._seq, now.utime, device_utime)
        sample = sample_from_packet(
            packet, self._gains, self.settings.specific_force_sign, self.settings.heading, header, self._celsius
        )
        if self._gravity_check.update(sample):
            outputs += self._on_gravity_known()
        if command not in (self.settings.message, self.settings.polled):
            return outputs
        for name in find_saturated_fields(packet):
            self._counts[f"saturated.{name}"] += 1
        self._seq += 1
        self._celsius = NAN
        # without the device's time the way over the line is part of the delay
        bauds = self._line_state.bauds
        line = LENGTHS[command] * 10.0 / bauds[0] if bauds and not device_utime else 0.0
        return [*outputs, MeasuredSample(sample, self.settings.delay + line, self.settings.delay_sigma, self.tick_s)]

    def _on_gravity_known(self) -> list[Output[bytes]]:
        if CommandByte.EULER_VECTORS not in (self.settings.message, self.settings.polled):
            # it was polled for this only
            self._polls.remove(CommandByte.EULER_VECTORS)
            self._link.parser.cancel(CommandByte.EULER_VECTORS)
        if self._gravity_check.is_upward:
            return []
        sign = self.settings.specific_force_sign
        text = (
            "while stationary the specific force points down by the device's own orientation instead of up: this "
            f"device gives the opposite of specific force; set specific_force_sign to {-sign} (it is {sign})"
        )
        return [EndpointStatus(EndpointPhase.STREAMING, text)]

    def _silence_deadline_ns(self) -> int:
        return self._streamed_ns + round(self.settings.silence * 1e9)

    def _explain_silence(self) -> str:
        message = self.settings.message
        received = self._link.describe_input()
        why = f"no usable message {int(message)} for {self.settings.silence:g} s, received {received}"
        counts = sorted((key, count) for key, count in self._link.parser.counts.items() if "." in key)
        rejected = ", ".join(f"{key.removeprefix('rejected.')} {count}" for key, count in counts)
        return f"{why}" + (f", rejected since the start: {rejected}" if rejected else "")

    def _restart(self, now: HostTime, why: str) -> list[Output[bytes]]:
        self._counts["restarts"] += 1
        status = EndpointStatus(EndpointPhase.SILENT, f"{self._device}: {why}; repeating the setup")
        return [status, *self._script.start(now)]
