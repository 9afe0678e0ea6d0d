"""MicroStrain 3DM-GX1: its serial protocol, ticks and scaling; and the driver, which streams one measurement.

A reply is the echo of the command byte, big-endian 16-bit words, mostly the timer ticks, and a checksum: the first byte
plus every 16-bit word after it, modulo 65536. There is no sync byte, so random bytes pass for a reply one time in
65,536. While it streams only the streamed message and the temperature are read. Requests carry no checksum. Source:
MicroStrain, "3DM-GX1 Data Communications Protocol", and public drivers that follow it.

Ticks (`TickUnwrapper`): 16 bits, unwrapped. They are plausible if they are ahead of the previous ones by no more than
the elapsed time (plus 0.5 s). They may be ahead by less: replies that a busy host reads late arrive all at once. After
a jump of the counter none is plausible, and the setup is repeated as after any silence.

Scaling: a vector's word times its gain (a word of the EEPROM) by 32768000 is gauss, g or rad/s.

Setup: stop the stream, read serial number, gains and timer, start the stream. The length of a tick comes from the
EEPROM's timer words, which take effect only after a power cycle, so it is compared with the host's clock once; smaller
errors are drift, which `device_clock` estimates.

Sign: documents differ on whether the device reports specific force or its opposite; `GravityCheck` decides it while
the device is stationary.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

from modelserver.messages import NAN, ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices import check_choice, check_ranges, stream
from msdrivers.devices.stream import NO_FRAME, ByteSettings, FrameScanner, ParsedFrame, RejectedFrame, StreamDriver
from msdrivers.endpoint import EndpointPhase, HostTime, Output, Send


class CommandByte(IntEnum):
    """The command byte of a request, and of the reply to it."""

    STABILIZED_VECTORS = 0x02
    INSTANTANEOUS_VECTORS = 0x03
    TEMPERATURE = 0x07
    QUATERNION_VECTORS = 0x0C
    INSTANTANEOUS_EULER = 0x0D
    STABILIZED_EULER = 0x0E
    CONTINUOUS = 0x10
    READ_EEPROM = 0x28
    EULER_VECTORS = 0x31
    FIRMWARE = 0xF0
    SERIAL = 0xF1


class ReplyLayout(NamedTuple):
    """Content of a reply between the command byte and the checksum: fields with their numbers of words, ticks."""

    fields: tuple[tuple[str, int], ...]
    has_ticks: bool = True

    @property
    def words(self) -> int:
        return sum(count for _, count in self.fields)


_VECTORS = (("field", 3), ("acceleration", 3), ("rate", 3))

LAYOUTS: dict[int, ReplyLayout] = {
    CommandByte.STABILIZED_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.INSTANTANEOUS_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.TEMPERATURE: ReplyLayout((("temperature", 1),)),
    CommandByte.QUATERNION_VECTORS: ReplyLayout((("quaternion", 4), *_VECTORS)),
    CommandByte.INSTANTANEOUS_EULER: ReplyLayout((("euler", 3),)),
    CommandByte.STABILIZED_EULER: ReplyLayout((("euler", 3),)),
    # a zero byte and the streamed command; the second word is zero or the ticks, sources differ: not read as ticks
    CommandByte.CONTINUOUS: ReplyLayout((("streamed", 1), ("unsettled", 1)), has_ticks=False),
    CommandByte.READ_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.EULER_VECTORS: ReplyLayout((("euler", 3), ("acceleration", 3), ("rate", 3))),
    CommandByte.FIRMWARE: ReplyLayout((("version", 1),), has_ticks=False),
    CommandByte.SERIAL: ReplyLayout((("serial", 1),), has_ticks=False),
}

_STRUCTS = {command: struct.Struct(f">B{each.words}h{'H' * each.has_ticks}H") for command, each in LAYOUTS.items()}
"""Command, words as signed numbers, ticks, checksum."""
LENGTHS: dict[int, int] = {command: each.size for command, each in _STRUCTS.items()}
"""Bytes of the replies."""

MEASUREMENTS = frozenset(command for command, layout in LAYOUTS.items() if layout.words >= 3)
"""Replies with vectors or angles: what may be streamed."""

_SLICES = {
    command: {
        name: slice(end - count, end)
        for (name, count), end in zip(layout.fields, accumulate(count for _, count in layout.fields), strict=True)
    }
    for command, layout in LAYOUTS.items()
}


class Gx1Packet(NamedTuple):
    """A reply: its command, its words as signed numbers, and the timer's ticks, 0..65535, or None without."""

    command: int
    words: tuple[int, ...]
    ticks: int | None = None

    def field(self, name: str) -> tuple[int, ...]:
        """Return the words of a field of its layout, signed; KeyError for a field that it does not have."""
        return self.words[_SLICES[self.command][name]]

    def has(self, name: str) -> bool:
        return name in _SLICES[self.command]

    @property
    def unsigned(self) -> int:
        """The first word as a number 0..65535: temperature, EEPROM value, version, serial number."""
        return self.words[0] & 0xFFFF

    def to_bytes(self) -> bytes:
        """Encode the reply, as a device does."""
        unsigned = [word & 0xFFFF for word in self.words] + ([] if self.ticks is None else [self.ticks])
        checksum = (self.command + sum(unsigned)) & 0xFFFF
        return struct.pack(f">B{len(unsigned) + 1}H", self.command, *unsigned, checksum)


def decode_packet(data: bytes | bytearray, at: int, command: int) -> Gx1Packet | None:
    """Return the reply that begins at `at`, whose first byte is `command`; None if its checksum is wrong.

    The whole reply must be there: `LENGTHS[command]` bytes.
    """
    _, *words, checksum = _STRUCTS[command].unpack_from(data, at)
    # modulo 65536 signed and unsigned words are the same
    if (command + sum(words) - checksum) & 0xFFFF:
        return None
    ticks = words.pop() if LAYOUTS[command].has_ticks else None
    return Gx1Packet(command, tuple(words), ticks)


class EepromAddress:
    """Even addresses of the EEPROM's words."""

    GYRO_GAIN = 130
    ACCELEROMETER_GAIN = 230
    MAGNETOMETER_GAIN = 232
    GAINS = (GYRO_GAIN, ACCELEROMETER_GAIN, MAGNETOMETER_GAIN)
    TIMER = (238, 240, 242, 246)


class Gains(NamedTuple):
    """The gain words of gyros, accelerometers and magnetometers."""

    gyro: int
    accelerometer: int
    magnetometer: int


class Gx1Stream(FrameScanner[Gx1Packet]):
    """Parses bytes to the replies to some commands, at first all; others are noise. At most 30 bytes are buffered."""

    start_bytes = bytes(LAYOUTS)

    def __init__(self) -> None:
        super().__init__((self,))
        self._commands = frozenset(LAYOUTS)

    def set_commands(self, *commands: int) -> None:
        self._commands = frozenset(commands)

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[Gx1Packet] | RejectedFrame | None:
        command = buffer[at]
        if command not in self._commands:
            return NO_FRAME
        if at + LENGTHS[command] > len(buffer):
            return None
        packet = decode_packet(buffer, at, command)
        kind = f"message.{CommandByte(command).name.lower()}"
        return ParsedFrame(at + LENGTHS[command], kind, packet) if packet else RejectedFrame("checksum")


COUNTER_RANGE = 65536
"""Ticks until the counter wraps."""

SLACK_NS = 500_000_000
"""Tolerance: the previous reply may have been read this much late."""

MIN_TICK_S = 0.005
"""Shortest possible tick, used while its length is unknown."""


class TickUnwrapper:
    """Unwraps ticks and checks their plausibility. Instants are the host's monotonic nanoseconds.

    The unwrapped count starts above zero, never goes back, and advances by more than `COUNTER_RANGE` when `reset` was
    called.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._at_ns = 0
        self._count = COUNTER_RANGE
        self._ticks_per_ns = 1e-9 / MIN_TICK_S

    def set_tick(self, tick_s: float) -> None:
        """Set the length of a tick; the device's clock and the host's may differ by 5 %."""
        self._ticks_per_ns = 1.05e-9 / tick_s

    def reset(self) -> None:
        """Accept any next count: the device may have restarted."""
        self._last = None
        self._count = (self._count // COUNTER_RANGE + 2) * COUNTER_RANGE

    def unwrap(self, ticks: int, at_ns: int) -> int | None:
        """Return the unwrapped ticks of a reply; None if they are implausible."""
        ahead = ticks if self._last is None else (ticks - self._last) % COUNTER_RANGE
        if self._last is not None and ahead > (at_ns - self._at_ns + SLACK_NS) * self._ticks_per_ns + 1.0:
            return None
        self._count += ahead
        self._last, self._at_ns = ticks, at_ns
        return self._count


def make_stream(command: int) -> bytes:
    """Return the request to stream the replies to a command, 0 for none."""
    return bytes((CommandByte.CONTINUOUS, 0, command))


STOP = make_stream(0)


def make_read_eeprom(address: int) -> bytes:
    """Return the request for a word of the EEPROM, at an even address up to 254."""
    return bytes((CommandByte.READ_EEPROM, *address.to_bytes(2, "big")))


G0 = 9.80665
"""Standard gravity, m/s2: the device's g."""

TESLA = 1e-4
"""A gauss."""

_FULL_SCALE = 32_768_000.0
_ANGLE_SCALE = 2.0 * math.pi / 65536.0
_QUATERNION_SCALE = 1.0 / 8192.0
MIN_WORD, MAX_WORD = -32768, 32767

QUARTER_TURN = 16384
"""A right angle in words of Euler angles."""


def vector_from_words(words: Iterable[int], gain: int, unit: float = 1.0) -> Vector3:
    """Return three words in rad/s, or in `unit` given in SI (G0, TESLA)."""
    factor = gain * unit / _FULL_SCALE
    x, y, z = words
    return so3.scale(factor, (x, y, z))


def vector_to_words(value: Vector3, gain: int, unit: float = 1.0) -> tuple[int, int, int]:
    """Return the words of a vector, saturated where it is too large."""
    x, y, z = so3.scale(_FULL_SCALE / (gain * unit), value)
    return (saturate(x), saturate(y), saturate(z))


def saturate(value: float) -> int:
    """Return the nearest signed 16-bit word."""
    return min(max(round(value), MIN_WORD), MAX_WORD)


def is_saturated(words: Iterable[int]) -> bool:
    return any(word in (MIN_WORD, MAX_WORD) for word in words)


def orientation_from_euler(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from the words of roll, pitch, yaw."""
    return so3.from_rpy(*(word * _ANGLE_SCALE for word in words))


def euler_to_words(orientation: Quaternion) -> tuple[int, int, int]:
    """Return roll, pitch, yaw as words, each turn within -32768..32767."""
    roll, pitch, yaw = ((round(angle / _ANGLE_SCALE) + 32768) % 65536 - 32768 for angle in so3.to_rpy(orientation))
    return (roll, pitch, yaw)


def quaternion_to_words(orientation: Quaternion) -> tuple[int, int, int, int]:
    w, x, y, z = (round(element / _QUATERNION_SCALE) for element in orientation)
    return (w, x, y, z)


def temperature_from_word(word: int) -> float:
    """Return degrees Celsius from an unsigned word."""
    return (word * 5.0 / 65536.0 - 0.5) * 100.0


def temperature_to_word(celsius: float) -> int:
    return min(max(round((celsius / 100.0 + 0.5) * 65536.0 / 5.0), 0), 65535)


def tick_from_timer_words(timer: Iterable[int]) -> float:
    """Return the seconds of a timer tick from the four timer words of the EEPROM: their product times 100 ns.

    Both documented settings agree with it, 16 16 256 1 with 6.5536 ms and 4 10 250 10 with 10 ms; for others it is
    inferred. Zero for a product of zero.
    """
    return math.prod(timer) * 1e-7


def format_version(word: int) -> str:
    """Return the firmware's version as people write it."""
    return f"{word // 1000}.{word % 1000 // 100}.{word % 100:02d}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Gx1Settings(ByteSettings):
    """Settings of a 3DM-GX1. Raises ValueError with the key for an invalid value."""

    message: int = CommandByte.EULER_VECTORS
    """The streamed message, a number of the table above."""
    heading: str = "vertical_gyro"
    """What the yaw of a stabilized orientation is: `vertical_gyro`, from anywhere with drift, or `magnetic`."""
    bauds: tuple[int, ...] = (38400, 115200)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""
    tick: float = 0.0
    """Seconds of a tick of the device's timer; 0: from the EEPROM."""
    specific_force_sign: int = 1
    """1 if the device's acceleration is specific force, -1 if it is the opposite: documents differ, and the driver
    reports which it is while the device is stationary."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_choice(self, message=sorted(MEASUREMENTS), heading=_YAW_SOURCES, specific_force_sign=(1, -1))
        if self.message == CommandByte.INSTANTANEOUS_EULER and self.heading == "vertical_gyro":
            raise ValueError("heading is magnetic with message 13, whose yaw is from the magnetometers")
        check_ranges(self, tick=(0.0, 1.0))


_YAW_SOURCES = {"vertical_gyro": YawSource.NONE, "magnetic": YawSource.MAGNETIC}


@dataclass(frozen=True, slots=True)
class CommandStep(stream.RequestStep):
    """A request and the first word of its reply, None for any."""

    value: int | None = None

    @property
    def what(self) -> str:
        return f"the request '{CommandByte(self.frame[0]).name.lower().replace('_', ' ')}'"

    def is_answered_by(self, packet: Gx1Packet) -> bool:
        return packet.command == self.frame[0] and (self.value is None or packet.words[0] == self.value)


LISTEN_S = 0.3
FLUSH_S = 1.0
"""How long a device may take to end its stream, as DUNE's driver allows."""

RETRY_DELAY_S = 5.0
"""Delay before a device that cannot be used is tried again."""

GAIN_RANGE = (1000, 30_000)
"""The least and the greatest gain that is believed: a vector's full scale is a thousandth of it in gauss, g or rad/s.
Those that are known of are 2000 to 10000."""

GYRO_GAIN_3DMG = 64
"""Of the 3DM-G, the older model with the same protocol and other scales."""


class UnusableDeviceError(Exception):
    """The device answers, but its data cannot be used."""


def read_words(addresses: Iterable[int]) -> stream.ScriptPart[tuple[int, ...]]:
    """Read words of the EEPROM, unsigned."""
    words: tuple[int, ...] = ()
    for address in addresses:
        reply = yield CommandStep(make_read_eeprom(address))
        words = (*words, reply.unsigned)
    return words


def read_gains() -> stream.ScriptPart[Gains]:
    """Read the gains. Raises UnusableError for those that no 3DM-GX1 can have.

    They are read twice: a reply does not contain its address, and a delayed one would pass for the next.
    """
    words = yield from read_words(EepromAddress.GAINS)
    again = yield from read_words(EepromAddress.GAINS)
    if words != again:
        raise UnusableDeviceError(
            f"the gains in its EEPROM were read twice, as {list(words)} and as {list(again)}: its replies come late or "
            "are damaged; check the cable, and the device server if there is one"
        )
    gains = Gains(*words)
    if gains.gyro == GYRO_GAIN_3DMG:
        raise UnusableDeviceError(
            f"the gyro gain in its EEPROM (address {EepromAddress.GYRO_GAIN}) is {gains.gyro}, that of the older "
            "3DM-G with other scales: connect a 3DM-GX1"
        )
    for name, address, gain in zip(Gains._fields, EepromAddress.GAINS, gains, strict=True):
        if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
            raise UnusableDeviceError(
                f"the {name} gain in its EEPROM (address {address}) is {gain}, and no 3DM-GX1 has one outside "
                f"{GAIN_RANGE[0]} to {GAIN_RANGE[1]}: the EEPROM is erased or damaged; write the gain "
                "from the device's calibration sheet to it"
            )
    return gains


def _read_tick() -> stream.ScriptPart[float]:
    words = yield from read_words(EepromAddress.TIMER)
    tick_s = tick_from_timer_words(words)
    if not 1e-3 <= tick_s <= 0.1:
        raise UnusableDeviceError(
            f"its EEPROM gives a timer tick of {tick_s:g} s (words {list(words)} at addresses "
            f"{list(EepromAddress.TIMER)}); write the defaults 16 16 256 1 to them, or set tick in the settings"
        )
    return tick_s


def find_saturated_fields(packet: Gx1Packet) -> tuple[str, ...]:
    return tuple(
        name for name in ("field", "acceleration", "rate") if packet.has(name) and is_saturated(packet.field(name))
    )


def sample_from_packet(
    packet: Gx1Packet, gains: Gains, force_sign: int, yaw_source: YawSource, header: SensorHeader, celsius: float = NAN
) -> ImuSample:
    """Convert a measurement; missing and saturated vectors are None.

    `force_sign`: of the device's acceleration as specific force. The orientation is that of the sensor's axes in
    north, east, down.
    """
    missing = find_saturated_fields(packet)

    def convert(name: str, gain: int, unit: float = 1.0) -> Vector3 | None:
        return vector_from_words(packet.field(name), gain, unit) if packet.has(name) and name not in missing else None

    orientation: Quaternion | None = None
    if packet.has("euler"):
        orientation = orientation_from_euler(packet.field("euler"))
    elif packet.has("quaternion"):
        w, x, y, z = (word * _QUATERNION_SCALE for word in packet.field("quaternion"))
        orientation = so3.normalize((w, x, y, z))
    return ImuSample(
        header,
        angular_velocity=convert("rate", gains.gyro),
        specific_force=convert("acceleration", gains.accelerometer, force_sign * G0),
        magnetic_field=convert("field", gains.magnetometer, TESLA),
        orientation=orientation,
        orientation_reference=OrientationReference.NED if orientation else OrientationReference.NONE,
        yaw_source=yaw_source if orientation else YawSource.NONE,
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
        up = so3.rotate(so3.conjugate(orientation), (0.0, 0.0, -1.0))
        along = sum(a * b for a, b in zip(force, up, strict=True))
        is_quiet = math.hypot(*rate) <= self.MAX_RATE and abs(math.hypot(*force) - G0) <= self.MAX_FORCE_ERROR
        # neither up nor down: not stationary
        if not is_quiet or abs(along) < 0.7 * G0:
            self._count = 0
            return False
        upwards = along > 0.0
        self._count = self._count + 1 if upwards == self.is_upward else 1
        self.is_upward = upwards
        return self._count >= self.MIN_SAMPLES


TEMPERATURE_PERIOD_NS = 10 * stream.SECOND_NS
"""Period of the polls of the temperature, which changes within minutes."""

TICK_CHECK_NS = 20 * stream.SECOND_NS
TICK_TOLERANCE = 0.05
"""Over 20 s a host that is late by a second seems to change a tick by this much; the device's own two settings of the
timer differ by 35 %, and `device_clock` follows a drift of 1 %."""


class Gx1Driver(StreamDriver[Gx1Packet]):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `Gx1Settings`.

    The device times of the samples advance by more than the counter's range when the setup was repeated. Further
    counts: `restarts`, `saturated.*` vectors.
    """

    device = "gx1"
    description = "3DM-GX1"
    _settings: Gx1Settings
    _stream: Gx1Stream

    def __init__(self, settings: Gx1Settings) -> None:
        super().__init__(settings, Gx1Stream())
        self.awaited = f"message {int(settings.message)}"
        self._ticks = TickUnwrapper()
        self._tick_s = settings.tick
        self._tick_origin: tuple[int, int] | None = None
        """Ticks and instant, monotonic nanoseconds, that the length of a tick is measured from."""
        self._is_tick_wrong = False
        self._gains = Gains(1, 1, 1)
        self._gravity_check = GravityCheck()
        self._newest = -1
        self._celsius = NAN
        self._poll_ns = 0
        self._is_found = False

    def _on_start(self) -> None:
        self._stream.set_commands(*LAYOUTS)

    def _get_extra_deadline(self) -> int | None:
        return None if self._setup.is_running else self._poll_ns

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        self._poll_ns = now.monotonic_ns + TEMPERATURE_PERIOD_NS
        return [Send(bytes((CommandByte.TEMPERATURE,)))]

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        """Stop the stream of a device that was found."""
        self._setup.stop()
        return [Send(STOP)] if self._is_found else []

    def _run_setup(self) -> stream.Script:
        while True:
            self._stream.set_commands(*LAYOUTS)
            self._first_bytes = b""
            try:
                self._product = yield from self._find_device()
            except stream.NoReplyError:
                yield from self._try_next_baud()
                continue
            self._tried, self._is_found = [], True
            bauds = self._settings.bauds
            where = f" at {bauds[self._baud_index]} baud" if bauds else ""
            yield from self._set_status(EndpointPhase.CONFIGURING, f"{self._product} answers{where}")
            try:
                self._gains = yield from read_gains()
                self._tick_s = self._settings.tick or (yield from _read_tick())
                yield CommandStep(make_stream(self._settings.message), value=self._settings.message)
                break
            except stream.NoReplyError as silence:
                why = f"{self._product} fell silent while it was set up: {silence}; check its cable and power"
            except UnusableDeviceError as unusable:
                why = f"{self._product} cannot be used: {unusable}"
            text = f"{why}; nothing is published, trying again in {RETRY_DELAY_S:g} s"
            yield from self._set_status(EndpointPhase.SILENT, text)
            yield stream.PauseStep(RETRY_DELAY_S)
        self._stream.set_commands(self._settings.message, CommandByte.TEMPERATURE)
        self._ticks.reset()
        self._ticks.set_tick(self._tick_s)
        self._tick_origin, self._is_tick_wrong = None, False
        self._gravity_check = GravityCheck()
        self._celsius, self._poll_ns = NAN, self._now.monotonic_ns
        self._restart_silence_timer()

    def _find_device(self) -> stream.ScriptPart[str]:
        """Stop what the device streams; return its serial number and firmware."""
        yield stream.PauseStep(LISTEN_S)
        if self._first_bytes:
            # a stop command may be sent in the middle of a streamed reply: the second one is answered clearly
            yield Send(STOP)
            yield stream.PauseStep(FLUSH_S)
        yield CommandStep(STOP, value=0)
        serial = yield CommandStep(bytes((CommandByte.SERIAL,)))
        firmware = yield CommandStep(bytes((CommandByte.FIRMWARE,)))
        return f"3DM-GX1 serial {serial.unsigned}, firmware {format_version(firmware.unsigned)}"

    def _on_message(self, message: Gx1Packet, now: HostTime) -> list[Output[bytes]]:
        step = self._setup.step
        if isinstance(step, CommandStep) and step.is_answered_by(message):
            # one that came together with the reply before it is a repetition of that
            sent_ns = (self._setup.deadline_ns or 0) - round(step.timeout * 1e9)
            return self._setup.on_reply(message, now) if now.monotonic_ns > sent_ns else []
        if self._setup.is_running:
            return []
        if message.command == CommandByte.TEMPERATURE:
            self._celsius = temperature_from_word(message.unsigned)
        return self._on_measurement(message, now) if message.command == self._settings.message else []

    def _on_measurement(self, packet: Gx1Packet, now: HostTime) -> list[Output[bytes]]:
        if not _is_plausible(packet):
            self._stream.reject("content")
            return []
        count = self._ticks.unwrap(packet.ticks or 0, now.monotonic_ns)
        if count is None or count == self._newest:
            self._stream.reject("ticks" if count is None else "repeated")
            return []
        self._newest = count
        warnings = self._check_tick(count, now)
        device_utime = 0 if self._is_tick_wrong else round(count * self._tick_s * 1e6)
        yaw_source = _YAW_SOURCES[self._settings.heading]
        sign, header = self._settings.specific_force_sign, self._make_header(now.utime, device_utime)
        sample = sample_from_packet(packet, self._gains, sign, yaw_source, header, self._celsius)
        self._celsius = NAN
        for name in find_saturated_fields(packet):
            self._counts[f"saturated.{name}"] += 1
        if self._gravity_check.update(sample) and not self._gravity_check.is_upward:
            text = (
                "while stationary the specific force points down by the device's own orientation instead of up: this "
                f"device gives the opposite of specific force; set specific_force_sign to {-sign} (it is {sign})"
            )
            warnings += self._set_status(EndpointPhase.STREAMING, text, is_warning=True)
        # without the device's time the transmission is part of the delay
        bauds = self._settings.bauds
        line = LENGTHS[packet.command] * 10.0 / bauds[self._baud_index] if bauds and not device_utime else 0.0
        return [*self._publish(sample, now, self._tick_s, line), *warnings]

    def _check_tick(self, count: int, now: HostTime) -> list[Output[bytes]]:
        begin, begin_ns = self._tick_origin = self._tick_origin or (count, now.monotonic_ns)
        if self._is_tick_wrong or now.monotonic_ns - begin_ns < TICK_CHECK_NS:
            return []
        self._tick_origin = (count, now.monotonic_ns)
        measured = (now.monotonic_ns - begin_ns) * 1e-9 / max(count - begin, 1)
        self._is_tick_wrong = abs(measured / self._tick_s - 1.0) > TICK_TOLERANCE
        text = (
            f"the device's ticks take {measured * 1e3:.3g} ms by the host's clock, expected {self._tick_s * 1e3:.3g} "
            "ms: its time is not used; switch its power off and on if its timer words were changed, or set tick"
        )
        return self._set_status(EndpointPhase.STREAMING, text, is_warning=True) if self._is_tick_wrong else []

    def _on_silence(self, now: HostTime) -> list[Output[bytes]]:
        self._counts["restarts"] += 1
        return super()._on_silence(now)


def _is_plausible(packet: Gx1Packet) -> bool:
    """Return whether the content is possible: pitch within 90 degrees, a unit quaternion within 1 %."""
    if packet.has("euler"):
        return abs(packet.field("euler")[1]) <= QUARTER_TURN
    if packet.has("quaternion"):
        return abs(math.hypot(*packet.field("quaternion")) * _QUATERNION_SCALE - 1.0) < 0.01
    return True
