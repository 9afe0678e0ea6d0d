"""Driver of a MicroStrain 3DM-GX1: finds the device, configures it, streams one measurement and polls others.

Setup: a script (`ScriptRunner`) finds the device, stops what it streams, reads its gains and its timer, and starts the
stream.

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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from modelserver.messages import NAN, ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices import gx1
from msdrivers.devices.gx1 import (
    LENGTHS,
    MEASUREMENTS,
    QUARTER_TURN,
    CommandByte,
    EepromAddress,
    Gains,
    Gx1Packet,
    Gx1Parser,
    format_version,
    is_unit,
)
from msdrivers.devices.stream import (
    EXAMINED_BYTES,
    NoReplyError,
    PauseStep,
    RequestStep,
    Script,
    ScriptPart,
    ScriptRunner,
    recognize,
)
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send


class HeadingSource(Enum):
    """Source of the yaw of the device's own orientation."""

    VERTICAL_GYRO = "vertical_gyro"
    """From its gyros alone: it begins anywhere and drifts."""
    MAGNETIC = "magnetic"
    """From its magnetometers."""


@dataclass(frozen=True, slots=True)
class Gx1Settings:
    """Settings of the device. Seconds; raises ValueError with the key for an invalid value.

    message: the streamed message, one of `gx1.MEASUREMENTS`. polled: another of them, polled every
    `poll_period`.
    heading: what the yaw of a stabilized orientation is; an instantaneous one is always magnetic.
    temperature_period: between polls of the temperature, 0 for never.
    capture_bias_at_start: capture the gyro biases once, at the first setup; the vehicle must be stationary.
    bauds: the rates to try; the line is opened at the first. Empty: the line has none.
    silence: timeout for streamed messages, after which the setup is repeated.
    tick: of the device's timer; None to take it from the EEPROM.
    specific_force_sign: 1 if the device's acceleration is specific force, -1 if it is the opposite: documents differ,
    and the driver reports which it is while the device is stationary.
    delay, delay_sigma: from the measurement to the instant that its ticks name.
    """

    source: str
    message: int = CommandByte.EULER_VECTORS
    heading: HeadingSource = HeadingSource.VERTICAL_GYRO
    polled: int | None = None
    poll_period: float = 0.1
    temperature_period: float = 10.0
    capture_bias_at_start: bool = False
    bauds: tuple[int, ...] = (38400, 115200)
    silence: float = 0.5
    tick: float | None = None
    specific_force_sign: int = 1
    delay: float = 0.0
    delay_sigma: float = 0.0

    def __post_init__(self) -> None:
        known = ", ".join(str(int(command)) for command in sorted(MEASUREMENTS))
        for name, command in (("message", self.message), ("polled", self.polled)):
            if command is not None and command not in MEASUREMENTS:
                raise ValueError(f"{name}: {command} is no measurement of a 3DM-GX1; there are {known}")
        if self.polled == self.message:
            raise ValueError(f"polled: {int(self.message)} is streamed already; leave it out or choose another")
        if (
            CommandByte.INSTANTANEOUS_EULER in (self.message, self.polled)
            and self.heading is HeadingSource.VERTICAL_GYRO
        ):
            raise ValueError(
                "heading: the instantaneous orientation (13) has its yaw from the magnetometers, which a vertical "
                "gyro does not use; choose heading magnetic, or the stabilized orientation (14)"
            )
        if self.specific_force_sign not in (1, -1):
            raise ValueError(f"specific_force_sign: must be 1 or -1, got {self.specific_force_sign}")
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds: must be above 0, got {self.bauds}")
        for name, value, least in (
            ("poll_period", self.poll_period, 0.01),
            ("silence", self.silence, 0.05),
            ("tick", 0.01 if self.tick is None else self.tick, 1e-4),
            ("temperature_period", self.temperature_period, 0.0),
            ("delay_sigma", self.delay_sigma, 0.0),
        ):
            if not least <= value < 1e6:
                raise ValueError(f"{name}: must be at least {least:g} s, got {value:g}")


QUOTED_BYTES = 32
"""Number of received bytes that are quoted."""


class Gx1Reply(NamedTuple):
    """A valid reply and its unwrapped ticks; -1 without ticks."""

    packet: gx1.Gx1Packet
    ticks: int


class Gx1Receiver:
    """Parses bytes to valid replies: expected, with right checksum, plausible ticks and content."""

    def __init__(self) -> None:
        self.parser = Gx1Parser(self._validate)
        self.ticks = gx1.TickUnwrapper()
        self.now = HostTime(0, 0)
        self.messages: Counter[str] = Counter()
        self._tick_counts: list[int] = []
        self._newest: dict[int, int] = {}
        self._streamed = 0
        self._first_bytes = b""
        self.bytes_received = 0
        """Number of bytes received since `reset_input`."""

    def feed(self, data: bytes, now: HostTime) -> list[Gx1Reply]:
        """Return the replies that `data` completes."""
        self.now = now
        self.bytes_received += len(data)
        if len(self._first_bytes) < EXAMINED_BYTES:
            self._first_bytes = (self._first_bytes + data)[:EXAMINED_BYTES]
        packets = self.parser.feed(data)
        replies = [Gx1Reply(packet, count) for packet, count in zip(packets, self._tick_counts, strict=True)]
        self._tick_counts.clear()
        for packet in packets:
            self.messages[f"message.{gx1.CommandByte(packet.command).name.lower()}"] += 1
        return replies

    def set_streamed(self, command: int) -> None:
        self._streamed = command
        self.parser.set_streamed(*((command,) if command else ()))

    def reset(self) -> None:
        self.set_streamed(0)
        self.parser.clear()
        self.ticks.reset()
        self._newest.clear()
        self.reset_input()

    def reset_input(self) -> None:
        self._first_bytes, self.bytes_received = b"", 0

    def describe_input(self) -> str:
        if not self.bytes_received:
            return "nothing"
        if (protocol := recognize(self._first_bytes)) is not None:
            return f"{protocol.name} (write device: {protocol.device})"
        shown = self._first_bytes[:QUOTED_BYTES]
        if sum(32 <= byte < 127 or byte in b"\r\n" for byte in shown) > 0.9 * len(shown):
            return f"{self.bytes_received} bytes of text, beginning {shown.decode('ascii', 'replace')!r}"
        return f"{self.bytes_received} bytes, beginning {shown.hex(' ')}"

    def _validate(self, packet: gx1.Gx1Packet) -> str:
        if not _is_plausible(packet):
            return "content"
        if packet.ticks is None:
            self._tick_counts.append(-1)
            return ""
        command = packet.command
        count = self.ticks.unwrap(packet.ticks, self.now.monotonic_ns, command == self._streamed)
        if count is None:
            return "ticks"
        if command in gx1.MEASUREMENTS:
            if count <= self._newest.get(command, -1):
                return "repeated"
            self._newest[command] = count
        self._tick_counts.append(count)
        return ""


def _is_plausible(packet: gx1.Gx1Packet) -> bool:
    """Return whether the content is possible: pitch within 90 degrees, a unit quaternion, a known command."""
    if packet.has("euler"):
        return abs(packet.field("euler")[1]) <= QUARTER_TURN
    if packet.has("quaternion"):
        return is_unit(packet.field("quaternion"))
    if packet.command == gx1.CommandByte.CONTINUOUS:
        # a command byte behind a zero
        return packet.words[0] == 0 or packet.words[0] in gx1.LAYOUTS
    return True


@dataclass(frozen=True, slots=True)
class CommandStep(RequestStep):
    """A request and the first word of its reply, None for any."""

    value: int | None = None

    @property
    def command(self) -> int:
        return self.frame[0]

    @property
    def what(self) -> str:
        return f"the request '{CommandByte(self.command).name.lower().replace('_', ' ')}'"

    def is_answered_by(self, packet: Gx1Packet) -> bool:
        return packet.command == self.command and (self.value is None or packet.words[0] == self.value)


@dataclass(frozen=True, slots=True)
class CollectStep(PauseStep):
    """Collect the unrequested replies to some commands."""

    commands: frozenset[int]


def report(text: str) -> EndpointStatus:
    return EndpointStatus(EndpointPhase.CONFIGURING, text)


class Gx1ScriptRunner(ScriptRunner):
    """Executes a script and lets the parser expect the replies."""

    def __init__(self, parser: Gx1Parser):
        super().__init__()
        self._parser = parser

    def on_packet(self, packet: Gx1Packet, now: HostTime) -> list[Output[bytes]]:
        step = self.step
        if isinstance(step, CollectStep):
            self._reply.append(packet)
        elif isinstance(step, CommandStep) and step.is_answered_by(packet):
            return self.on_reply(packet, now)
        elif isinstance(step, CommandStep) and packet.command == step.command:
            self._parser.expect(packet.command)
        return []

    def _prepare(self, step: RequestStep | PauseStep) -> None:
        if isinstance(step, CommandStep):
            self._parser.cancel(step.command)
            self._parser.expect(step.command)
        else:
            self._parser.clear()
        if isinstance(step, CollectStep):
            self._reply = []
            self._parser.set_streamed(*step.commands)


LISTEN_S = 0.3
FLUSH_TIMEOUT_S = 1.0
"""How long a device may take to end its stream, as DUNE's driver allows."""

KNOWN_FLUSH_TIMEOUT_S = 0.2
"""The same for a device that has answered here before: if that was too short it is tried again."""

KNOWN_ATTEMPTS = 3
"""Attempts at the baud rate at which a device was found before."""

RETRY_DELAY_S = 5.0
"""Delay between failed attempts."""

GAIN_RANGE = (1000, 30_000)
"""The least and the greatest gain that is believed: a vector's full scale is a thousandth of it in gauss, g or rad/s.
Those that are known of are 2000 to 10000."""

GYRO_GAIN_3DMG = 64
"""Of the 3DM-G, the older model with the same protocol and other scales."""


class UnusableDeviceError(Exception):
    """The device answers, but its data cannot be used."""


def _read_identity() -> ScriptPart[str]:
    serial = yield CommandStep(gx1.make_poll(gx1.CommandByte.SERIAL))
    firmware = yield CommandStep(gx1.make_poll(gx1.CommandByte.FIRMWARE))
    return f"3DM-GX1 serial {serial.unsigned}, firmware {format_version(firmware.unsigned)}"


def _explain_no_device(bauds: Sequence[int], received: Sequence[str]) -> str:
    # after the attempts the list of rates is rotated by one
    order = [f"at {baud} baud " for baud in (*bauds[1:], *bauds[:1])] or [""]
    attempts = "; ".join(f"{at}received {what}" for at, what in zip(order, received, strict=True))
    if all(what == "nothing" for what in received):
        why = "check the device's power, the cable, and that the port is the right one"
    elif any("text" in what for what in received):
        why = "text is from another device: check which port the 3DM-GX1 is on"
    elif bauds:
        why = "another device, or a baud rate that was not tried: check the port, and the list of baud rates"
    else:
        why = "another device, or the baud rate of the device server is not the 3DM-GX1's: check both"
    return f"no 3DM-GX1 answers on this line: {attempts}; {why}; trying again in {RETRY_DELAY_S:g} s"


def read_words(addresses: Iterable[int]) -> ScriptPart[tuple[int, ...]]:
    """Read words of the EEPROM, unsigned."""
    words: tuple[int, ...] = ()
    for address in addresses:
        reply = yield CommandStep(gx1.make_read_eeprom(address))
        words = (*words, reply.unsigned)
    return words


def read_gains() -> ScriptPart[gx1.Gains]:
    """Read the gains. Raises UnusableError for those that no 3DM-GX1 can have.

    They are read twice: a reply does not contain its address, and a delayed one would pass for the next.
    """
    words = yield from read_words(gx1.EepromAddress.GAINS)
    again = yield from read_words(gx1.EepromAddress.GAINS)
    if words != again:
        raise UnusableDeviceError(
            f"the gains in its EEPROM were read twice, as {list(words)} and as {list(again)}: its replies come late or "
            "are damaged; check the cable, and the device server if there is one"
        )
    gains = gx1.Gains(*words)
    if gains.gyro == GYRO_GAIN_3DMG:
        raise UnusableDeviceError(
            f"the gyro gain in its EEPROM (address {gx1.EepromAddress.GYRO_GAIN}) is {gains.gyro}, that of the older "
            "3DM-G with other scales: connect a 3DM-GX1"
        )
    for name, address, gain in zip(gx1.Gains._fields, gx1.EepromAddress.GAINS, gains, strict=True):
        if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
            raise UnusableDeviceError(
                f"the {name} gain in its EEPROM (address {address}) is {gain}, and no 3DM-GX1 has one outside "
                f"{GAIN_RANGE[0]} to {GAIN_RANGE[1]}: the EEPROM is erased or damaged; write the gain "
                "from the device's calibration sheet to it"
            )
    return gains


_UP_NED: Vector3 = (0.0, 0.0, -1.0)
"""In north, east, down."""


def find_saturated_fields(packet: Gx1Packet) -> tuple[str, ...]:
    """Return the names of the saturated vectors."""
    return tuple(
        name for name in ("field", "acceleration", "rate") if packet.has(name) and gx1.is_saturated(packet.field(name))
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
            gx1.vector_from_words(packet.field(name), gain, unit) if packet.has(name) and name not in missing else None
        )

    orientation: Quaternion | None = None
    if packet.has("euler"):
        orientation = gx1.orientation_from_euler(packet.field("euler"))
    elif packet.has("quaternion"):
        orientation = gx1.orientation_from_quaternion(packet.field("quaternion"))
    return ImuSample(
        header,
        angular_velocity=convert("rate", gains.gyro),
        specific_force=convert("acceleration", gains.accelerometer, force_sign * gx1.G0),
        magnetic_field=convert("field", gains.magnetometer, gx1.TESLA),
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
        is_quiet = math.hypot(*rate) <= self.MAX_RATE and abs(math.hypot(*force) - gx1.G0) <= self.MAX_FORCE_ERROR
        # neither up nor down: not stationary
        if not is_quiet or abs(along) < 0.7 * gx1.G0:
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
        self._link = Gx1Receiver()
        self._script = Gx1ScriptRunner(self._link.parser)
        self._bauds = list(settings.bauds)
        """Those to try, in this order; empty for a line that has none."""
        self._is_known = False
        """A device has answered at the first baud rate."""
        self._found_stream: int | None = None
        """What the device streamed when it was found: None until known, 0 for nothing."""
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
        self._link.now = now
        outputs = self._script.reopen(now)
        return self._script.start(self._run_setup(), now) if outputs is None else outputs

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        outputs: list[Output[bytes]] = []
        for reply in self._link.feed(unit, now):
            if self._script.is_running:
                outputs += self._script.on_packet(reply.packet, now)
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
            outputs.append(Send(gx1.make_poll(command)))
        return outputs

    def get_deadline(self) -> int | None:
        if self._script.is_running:
            return self._script.deadline_ns
        return min(self._silence_deadline_ns(), self._polls.deadline_ns)

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        """Restore the continuous mode as it was found."""
        self._script.stop()
        self._link.reset()
        return [] if self._found_stream is None else [Send(gx1.make_stream(self._found_stream))]

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, bytes skipped, rejected and unanswered by reason, restarts, saturated vectors."""
        return self._link.messages + self._link.parser.counts + self._counts

    def _run_setup(self) -> Script:
        while True:
            try:
                self._device = yield from self._find_device()
                yield report(f"{self._device} answers" + (f" at {self._bauds[0]} baud" if self._bauds else ""))
                self._gains = yield from read_gains()
                yield from self._read_timer()
                if self.settings.capture_bias_at_start:
                    yield from self._capture_bias()
                yield from self._start_stream()
                return
            except NoReplyError as silence:
                why = f"{self._device} fell silent while it was set up: {silence}; check its cable and power"
            except UnusableDeviceError as unusable:
                why = f"{self._device} cannot be used: {unusable}"
            text = f"{why}; nothing is published, trying again in {RETRY_DELAY_S:g} s"
            yield EndpointStatus(EndpointPhase.SILENT, text)
            yield PauseStep(RETRY_DELAY_S)

    def _find_device(self) -> ScriptPart[str]:
        """Return serial number and firmware of the device: stop what it streams at one baud rate after the other.

        The line is taken to be open at the first of the baud rates.
        """
        while True:
            bauds, received = self._bauds, list[str]()
            for number in range(max(1, len(bauds))):
                if number:
                    bauds.append(bauds.pop(0))
                    yield Reopen(f"no 3DM-GX1 at {bauds[-1]} baud, received {received[-1]}", bauds[0])
                # a known device returns at its rate: try others only after several attempts
                for attempt in range(KNOWN_ATTEMPTS if self._is_known else 1):
                    self._link.reset()
                    try:
                        yield from self._stop_stream(
                            KNOWN_FLUSH_TIMEOUT_S if self._is_known and not attempt else FLUSH_TIMEOUT_S
                        )
                        device = yield from _read_identity()
                    except NoReplyError:
                        continue
                    self._is_known = True
                    return device
                self._is_known = False
                received.append(self._link.describe_input())
            yield EndpointStatus(EndpointPhase.SILENT, _explain_no_device(bauds, received))
            yield PauseStep(RETRY_DELAY_S)
            if len(bauds) > 1:
                bauds.append(bauds.pop(0))
                yield Reopen("no 3DM-GX1 found, trying again", bauds[0])

    def _stop_stream(self, flush: float) -> ScriptPart[None]:
        """Record what the device streams (two replies of one kind) and stop it, within `flush` seconds."""
        listened = yield CollectStep(LISTEN_S, frozenset(gx1.MEASUREMENTS))
        kinds = [packet.command for packet in listened]
        if self._found_stream is None:
            self._found_stream = next((kind for kind in kinds if kinds.count(kind) > 1), None)
        if self._link.bytes_received:
            # a stop command may be sent in the middle of a streamed reply: the second one is answered clearly
            yield Send(gx1.STOP)
            yield PauseStep(flush)
        yield CommandStep(gx1.STOP, value=0)
        if self._found_stream is None:
            self._found_stream = 0
        # what was listened to may have been noise that looked like replies
        self._link.ticks.reset()

    def _read_timer(self) -> ScriptPart[None]:
        if self.settings.tick is None:
            words = yield from read_words(EepromAddress.TIMER)
            self.tick_s = gx1.tick_from_timer_words(words)
            if not 1e-3 <= self.tick_s <= 0.1:
                raise UnusableDeviceError(
                    f"its EEPROM gives a timer tick of {self.tick_s:g} s (words {list(words)} at addresses "
                    f"{list(EepromAddress.TIMER)}); write the defaults 16 16 256 1 to them, or set tick in the settings"
                )
            if words not in gx1.DOCUMENTED_TIMERS:
                yield report(
                    f"the timer words {list(words)} are not documented; a tick of {self.tick_s * 1e3:g} ms is "
                    "inferred from them and will be compared with the host's clock",
                )
        self._link.ticks.set_tick(self.tick_s)
        self._tick_check = TickRateCheck(self.tick_s)

    def _capture_bias(self) -> ScriptPart[None]:
        if not self._bias_pending:
            yield report(
                "the gyro biases are not captured again, since the vehicle may be moving; for that restart the driver "
                "while the vehicle is stationary",
            )
            return
        yield report("capturing the gyro biases: keep the vehicle still")
        self._bias_pending = False
        try:
            yield CommandStep(gx1.make_poll(CommandByte.CAPTURE_BIAS), timeout=BIAS_CAPTURE_TIMEOUT_S, attempts=1)
        except NoReplyError:
            text = f"the gyro bias capture timed out after {BIAS_CAPTURE_TIMEOUT_S:g} s; using the previous biases"
        else:
            text = "the gyro biases are captured"
        yield report(text)

    def _start_stream(self) -> ScriptPart[None]:
        message = self.settings.message
        self._link.set_streamed(message)
        yield CommandStep(gx1.make_stream(message), value=message)
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

    def _on_streamed_reply(self, reply: Gx1Reply, now: HostTime) -> list[Output[bytes]]:
        """Process a reply while the device streams."""
        if self._link.ticks.has_jumped:
            return self._restart(now, "its ticks jumped, so it has restarted or is another one")
        packet, count = reply
        command = packet.command
        self._polls.on_reply(command)
        if command == CommandByte.TEMPERATURE:
            self._celsius = gx1.temperature_from_word(packet.unsigned)
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
        line = LENGTHS[command] * 10.0 / self._bauds[0] if self._bauds and not device_utime else 0.0
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
        return [status, *self._script.start(self._run_setup(), now)]
