"""Emulators of inertial units: VectorNav VN-100, Xsens MTi, lines of text, MicroStrain 3DM-GX1.

The VN-100 applies commands and sends its binary output, or text as it does from its maker. The MTi has a configuration
and a measurement mode and sends MTData2. The 3DM-GX1 measures the linear interpolation of a series of samples. Choices
where its documents are silent: it starts without continuous mode, sends nothing while it starts and while it captures
its gyro biases, and reads its timer words at start.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices import gx1, xsens
from msdrivers.devices import vectornav as vn
from msdrivers.devices.gx1 import MEASUREMENTS, CommandByte, EepromAddress, Gains, Gx1Packet, Gx1Request, RequestParser
from msdrivers.devices.text import TextSettings, encode_line
from msdrivers.devices.vectornav import FIELD_BYTES, VnStream, VnText
from msdrivers.devices.xsens import ItemId, MessageId, XbusMessage, XbusStream
from msdrivers.emulate import InjectedFault, SampleEmulator, corrupt_unit
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Send


class VectornavEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that speaks as a VN-100 does. `samples` are in the order of their stamps."""

    CELSIUS = 31.5
    START_NS = 5_000_000_000
    """Its clock at its first sample."""

    def __init__(self, samples: Iterable[ImuSample], baud: int = 115200) -> None:
        """`baud` is that of its line, by which it rejects too much output."""
        super().__init__(samples)
        self._baud = baud
        self._stream = VnStream()
        self._text_hz = {1: 40, 2: 0}
        self._keys: tuple[tuple[int, int], ...] = ()
        self._divisor = 0
        self._sent_us: int | None = None

    def _answer(self, unit: bytes) -> Iterator[bytes]:
        # a command ends with its line; a following byte completes it here
        for message in self._stream.feed(unit):
            if isinstance(message, VnText):
                error = self._execute(message.words)
                self.counts["rejected" if error else "accepted"] += 1
                answer = "RRG,01,VN-100T-CR" if message.words[0] == "RRG" else ",".join(message.words)
                yield vn.encode_text(f"ERR,{error:02X}" if error else answer)

    def _execute(self, words: tuple[str, ...]) -> int:
        """Apply a command; return the code of an error, 0 for none."""
        try:
            numbers = [int(word) for word in words[1:4]]
        except ValueError:
            return 0x07
        if words[0] == "RRG":
            return 0 if numbers[:1] == [1] else 0x08
        if words[0] != "WRG" or len(numbers) < 2:
            return 0x04
        register, value, *rest = numbers
        if register == 6:
            port = rest[0] if rest else 1
            before, self._text_hz[port] = self._text_hz.get(port, 0), 40 if value else 0
            if self._compute_load() > self._baud:
                self._text_hz[port] = before
                return 0x0C
            return 0
        return self._set_binary(value, rest, words) if register == 75 else 0x08

    def _set_binary(self, port: int, rest: list[int], words: tuple[str, ...]) -> int:
        try:
            groups, masks = int(words[4], 16), [int(word, 16) for word in words[5:]]
        except (ValueError, IndexError):
            return 0x05
        present = [bit + 1 for bit in range(8) if groups >> bit & 1]
        if len(masks) != len(present) or any(group not in FIELD_BYTES for group in present):
            return 0x07
        before = self._keys, self._divisor
        self._keys = tuple(
            (group, bit)
            for group, mask in zip(present, masks, strict=True)
            for bit in range(len(FIELD_BYTES[group]))
            if mask >> bit & 1
        )
        self._divisor = rest[0] if port else 0
        if self._compute_load() > self._baud:
            self._keys, self._divisor = before
            return 0x0C
        return 0

    def _compute_load(self) -> float:
        """Return the bits a second of all outputs together; a line of text has 122 bytes."""
        text = sum(self._text_hz.values()) * 122 * 10
        return text + (vn.compute_size(self._keys) * 10 * vn.BASE_RATE_HZ / self._divisor if self._divisor else 0.0)

    def _encode(self, sample: ImuSample) -> bytes:
        utime = sample.header.utime
        rate_hz = vn.BASE_RATE_HZ / self._divisor if self._divisor else self._text_hz[1]
        if not rate_hz or (self._sent_us is not None and utime - self._sent_us < 1e6 / rate_hz - 500):
            return b""
        self._sent_us = utime
        self.counts["messages"] += 1
        if not self._divisor:
            field, force, rate = sample.magnetic_field, sample.specific_force, sample.angular_velocity
            values = ((0.0,) * 3, [x / vn.GAUSS for x in field or (0.0,) * 3], force or (0.0,) * 3, rate or (0.0,) * 3)
            return vn.encode_text("YMR," + ",".join(f"{number:+.4f}" for each in values for number in each))
        time_ns = self.START_NS + (utime - self._first_utime) * 1000
        return vn.encode_binary({key: self._encode_field(key, sample, time_ns) for key in self._keys})

    def _encode_field(self, key: tuple[int, int], sample: ImuSample, time_ns: int) -> bytes:
        if key == vn.TIME:
            return time_ns.to_bytes(8, "little")
        numbers: Sequence[float] | None = None
        if key == vn.QUATERNION and sample.orientation is not None:
            w, x, y, z = sample.orientation
            numbers = (x, y, z, w)
        elif key == vn.RATE:
            numbers = sample.angular_velocity
        elif key == vn.ACCELERATION:
            numbers = sample.specific_force
        elif key == vn.MAGNETIC and sample.magnetic_field is not None:
            numbers = [each / vn.GAUSS for each in sample.magnetic_field]
        elif key == vn.TEMPERATURE:
            numbers = (self.CELSIUS,)
        size = FIELD_BYTES[key[0]][key[1]]
        return (
            bytes(size) if numbers is None else struct.pack(f"<{size // 4}f", *(_to_finite(each) for each in numbers))
        )


def _to_finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


class XsensEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that speaks as an MTi does. `samples` are in the order of their stamps."""

    MAX_HZ = 400
    CELSIUS = 28.0
    FIRST_TICKS = 12_345
    """Its clock at its first sample."""

    def __init__(
        self,
        samples: Iterable[ImuSample],
        baud: int = 921600,
        has_orientation: bool = True,
        field_strength: float = 5e-5,
    ) -> None:
        """`baud` is that of its line; has_orientation: it is more than an IMU; `field_strength` it reports as 1, tesla.

        It starts in measurement, with the outputs of an earlier configuration.
        """
        super().__init__(samples)
        self._baud, self._has_orientation, self._field_strength = baud, has_orientation, field_strength
        self._stream = XbusStream()
        self._outputs = {int(ItemId.PACKET_COUNTER): xsens.AS_SENT, int(ItemId.QUATERNION): 100}
        self._is_measuring = True
        self._counter = 0
        self._sent: dict[int, int] = {}

    def _answer(self, unit: bytes) -> list[bytes]:
        return [self._execute(message) for message in self._stream.feed(unit)]

    def _execute(self, message: XbusMessage) -> bytes:
        if message.id == MessageId.GO_TO_CONFIG:
            self._is_measuring = False
            return xsens.encode(MessageId.GO_TO_CONFIG_ACK)
        if self._is_measuring:
            return b""
        if message.id == MessageId.GO_TO_MEASUREMENT:
            self._is_measuring = True
            return xsens.encode(MessageId.GO_TO_MEASUREMENT_ACK)
        if message.id != MessageId.SET_OUTPUT:
            return xsens.encode(MessageId.ERROR, b"\x04")
        pairs = [struct.unpack_from(">HH", message.data, at) for at in range(0, len(message.data) - 3, 4)]
        error = self._find_error(pairs)
        self.counts["rejected" if error else "accepted"] += 1
        if error:
            return xsens.encode(MessageId.ERROR, bytes((error,)))
        self._outputs = dict(pairs)
        return xsens.encode(MessageId.SET_OUTPUT_ACK, message.data)

    def _find_error(self, pairs: Sequence[tuple[int, int]]) -> int:
        """Return the code of what is wrong with outputs and their rates, 0 for nothing."""
        for item, rate in pairs:
            if item == ItemId.QUATERNION and not self._has_orientation:
                return 0x21
            if rate != xsens.AS_SENT and rate > self.MAX_HZ:
                return 0x21
        hertz = max((rate for _, rate in pairs if rate != xsens.AS_SENT), default=0)
        size = 5 + sum(3 + _SIZES.get(item, 4) for item, _ in pairs)
        return 0x29 if size * 10 * hertz > self._baud else 0

    def _encode(self, sample: ImuSample) -> bytes:
        utime = sample.header.utime
        if not self._is_measuring:
            return b""
        due = [
            item for item, rate in self._outputs.items() if rate != xsens.AS_SENT and self._is_due(item, rate, utime)
        ]
        if not due:
            return b""
        self._sent.update(dict.fromkeys(due, utime))
        self._counter = (self._counter + 1) & 0xFFFF
        self.counts["packets"] += 1
        ticks = (self.FIRST_TICKS + round((utime - self._first_utime) * 1e-6 / xsens.TICK)) % (1 << 32)
        items: list[tuple[int, bytes]] = []
        for item, rate in self._outputs.items():
            if rate == xsens.AS_SENT or item in due:
                data = self._encode_item(item, sample, ticks)
                if data is not None:
                    items.append((item, data))
        return xsens.encode_items(items)

    def _is_due(self, item: int, rate: int, utime: int) -> bool:
        sent = self._sent.get(item)
        return rate > 0 and (sent is None or utime - sent >= 1e6 / rate - 500)

    def _encode_item(self, item: int, sample: ImuSample, ticks: int) -> bytes | None:
        numbers: Sequence[float] | None = None
        if item == ItemId.PACKET_COUNTER:
            return self._counter.to_bytes(2, "big")
        if item == ItemId.SAMPLE_TIME_FINE:
            return ticks.to_bytes(4, "big")
        if item == ItemId.STATUS_WORD:
            return (0x3).to_bytes(4, "big")
        if item == ItemId.TEMPERATURE:
            numbers = (self.CELSIUS,)
        elif item == ItemId.ACCELERATION:
            numbers = sample.specific_force
        elif item == ItemId.RATE_OF_TURN:
            numbers = sample.angular_velocity
        elif item == ItemId.MAGNETIC_FIELD and sample.magnetic_field is not None:
            numbers = [each / self._field_strength for each in sample.magnetic_field]
        elif item == ItemId.QUATERNION:
            numbers = sample.orientation
        return None if numbers is None else struct.pack(f">{len(numbers)}f", *numbers)


_SIZES: Mapping[int, int] = {
    ItemId.QUATERNION: 16,
    ItemId.ACCELERATION: 12,
    ItemId.RATE_OF_TURN: 12,
    ItemId.MAGNETIC_FIELD: 12,
}

CELSIUS = 25.0


class TextImuEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that sends a line for each sample. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], settings: TextSettings) -> None:
        super().__init__(samples)
        self._settings = settings

    def _encode(self, sample: ImuSample) -> bytes:
        self.counts["lines"] += 1
        values = {name: self._get_value(sample, name) for name in self._settings.mapped}
        return encode_line(self._settings, values)

    def _get_value(self, sample: ImuSample, name: str) -> float:
        if name == "time":
            return 1.0 + (sample.header.utime - self._first_utime) * 1e-6
        if name == "temperature":
            return CELSIUS
        vector = getattr(sample, name[:-2])
        return 0.0 if vector is None else float(vector["xyz".index(name[-1])])


GAINS = Gains(8500, 7000, 2000)


@dataclass(frozen=True, slots=True)
class Eeprom:
    """The device's memory: it outlives restarts. 128 words, unsigned, at even addresses 0..254."""

    words: tuple[int, ...] = (0,) * 128

    @classmethod
    def make_factory(cls, gains: Gains = GAINS, hundred_hertz: bool = True) -> Eeprom:
        """Return one with gains, and the timer words of 100 Hz or those of 6.5536 ms a tick."""
        timer = (4, 10, 250, 10) if hundred_hertz else (16, 16, 256, 1)
        words = dict(zip(EepromAddress.TIMER, timer, strict=True))
        return cls().write(words | dict(zip(EepromAddress.GAINS, gains, strict=True)))

    def read_word(self, address: int) -> int:
        return self.words[address // 2] if 0 <= address < 256 and address % 2 == 0 else 0

    def write(self, changes: Mapping[int, int]) -> Eeprom:
        """Return the memory with words changed."""
        words = list(self.words)
        for address, value in changes.items():
            words[address // 2] = value & 0xFFFF
        return Eeprom(tuple(words))


@dataclass(frozen=True, slots=True)
class Gx1Unit:
    """One device. SI units.

    cycle_ticks: ticks from one streamed reply to the next. tick_offset: its ticks when it starts. drift: how much
    faster its clock runs than the host's, as a fraction. delay: from a measurement until it is sent. gyro_bias: bias of
    its gyros. force_sign: 1 if it reports specific force, -1 for its opposite. celsius: its temperature.
    streamed_at_start: the command that it streams when the line is opened, 0 for none. Its time jumps by ticks.
    """

    serial: int = 1234
    firmware: int = 3100
    cycle_ticks: int = 1
    tick_offset: int = 0
    drift: float = 0.0
    delay: float = 0.003
    bias_capture: float = 3.0
    gyro_bias: Vector3 = (0.0, 0.0, 0.0)
    force_sign: int = 1
    celsius: float = 23.0
    streamed_at_start: int = 0


@dataclass(frozen=True, slots=True)
class UnitClock:
    """The device's clock since it was switched on at `started_ns`, monotonic nanoseconds of the host.

    tick_s: seconds of a tick by the device. drift: how much faster it runs than the host's clock. offset: ticks that
    it began with.
    """

    started_ns: int
    tick_s: float
    drift: float
    offset: int

    @classmethod
    def make(cls, eeprom: Eeprom, unit: Gx1Unit, started_ns: int, offset: int) -> UnitClock:
        """Return the clock as the timer words have it; 10 ms a tick where they are zero."""
        tick_s = gx1.tick_from_timer_words(map(eeprom.read_word, EepromAddress.TIMER))
        return cls(started_ns, tick_s or 0.01, unit.drift, offset)

    def instant_of(self, tick: int) -> int:
        """Return when a tick since the start begins."""
        return self.started_ns + round(tick * self.tick_s / (1.0 + self.drift) * 1e9)

    def ticks_at(self, at_ns: int) -> int:
        # a nanosecond more, lest the instant of a tick rounds to the one before
        seconds = ((at_ns - self.started_ns) * 1e-9 + 1e-9) * (1.0 + self.drift)
        return (int(seconds / self.tick_s) + self.offset) % 65536


_ZERO: Vector3 = (0.0, 0.0, 0.0)
_NED_FROM_ENU: Quaternion = (0.0, 0.5**0.5, 0.5**0.5, 0.0)
"""Rotation by 180 degrees about the axis between east and north."""


class SensedState(NamedTuple):
    """True state along the sensor's axes, SI units; orientation in north, east, down."""

    rate: Vector3
    force: Vector3
    field: Vector3
    orientation: Quaternion


class SampleInterpolator:
    """Interpolates samples linearly by their stamps; the first before it, nothing after the last.

    Missing vectors are zero, a missing orientation is level and north.
    """

    def __init__(self, samples: Iterable[ImuSample]):
        self._remaining: Iterator[ImuSample] = iter(samples)
        self._before: tuple[int, SensedState] | None = None
        self._after = self._next()

    def sense_at(self, utime: int) -> SensedState | None:
        """Return the state at an instant, None after the last sample; instants must not decrease."""
        while self._after is not None and self._after[0] <= utime:
            self._before, self._after = self._after, self._next()
        if self._after is None:
            return self._before[1] if self._before is not None and self._before[0] == utime else None
        if self._before is None:
            return self._after[1]
        (begin, a), (end, b) = self._before, self._after
        return _interpolate(a, b, (utime - begin) / (end - begin)) if utime > begin else a

    def _next(self) -> tuple[int, SensedState] | None:
        sample = next(self._remaining, None)
        return None if sample is None else (sample.header.utime, _sense(sample))


def _sense(sample: ImuSample) -> SensedState:
    orientation = so3.IDENTITY if sample.orientation is None else sample.orientation
    if sample.orientation_reference is OrientationReference.ENU:
        orientation = so3.normalize(so3.multiply(_NED_FROM_ENU, orientation))
    return SensedState(
        sample.angular_velocity or _ZERO, sample.specific_force or _ZERO, sample.magnetic_field or _ZERO, orientation
    )


def _interpolate(a: SensedState, b: SensedState, share: float) -> SensedState:
    rate, force, field = (
        so3.add(so3.scale(1.0 - share, x), so3.scale(share, y)) for x, y in zip(a[:3], b[:3], strict=True)
    )
    return SensedState(rate, force, field, so3.slerp(a.orientation, b.orientation, share))


MAX_BACKLOG_CYCLES = 100
"""Largest number of cycles to catch up after a late timer."""


class Gx1Emulator:
    """An `Endpoint` of bytes that answers as the device does. `samples` are in the order of their stamps.

    After the last sample it measures nothing any more: it streams no longer and answers no poll for a measurement.
    """

    def __init__(
        self,
        samples: Iterable[ImuSample],
        eeprom: Eeprom | None = None,
        unit: Gx1Unit | None = None,
    ):
        self.eeprom = Eeprom.make_factory() if eeprom is None else eeprom
        self.unit = Gx1Unit() if unit is None else unit
        self.streamed = self.unit.streamed_at_start
        """The command that is streamed now, 0 for none."""
        self._samples = SampleInterpolator(samples)
        self._requests = RequestParser()
        self._outbox: deque[tuple[int, bytes]] = deque()
        self._opened_ns: int | None = None
        self._clock = UnitClock.make(self.eeprom, self.unit, 0, 0)
        self._tick = 0
        self._gains = GAINS
        self._bias: Vector3 = (0.0, 0.0, 0.0)
        self._capture: tuple[int, list[Vector3]] | None = None
        self._utime_offset_us = 0
        self.counts: Counter[str] = Counter()

    def on_open(self, now: HostTime) -> list[Output[bytes]]:
        """Switch on at the first time; later the device has run on."""
        if self._opened_ns is None:
            self._opened_ns = now.monotonic_ns
            self._switch_on(now.monotonic_ns, self.unit.tick_offset)
        phase = EndpointPhase.STREAMING if self.streamed else EndpointPhase.WAITING
        return [EndpointStatus(phase, f"3DM-GX1 {self.unit.serial} emulated")]

    def on_receive(self, unit: bytes, now: HostTime) -> list[Output[bytes]]:
        outputs = self.on_timer(now)
        if now.monotonic_ns < self._clock.started_ns:
            return outputs
        for request in self._requests.feed(unit):
            self.counts[f"request.{CommandByte(request.command).name.lower()}"] += 1
            self._on_request(request, now)
        return outputs + self._pop_sent(now.monotonic_ns)

    def on_timer(self, now: HostTime) -> list[Output[bytes]]:
        if self._opened_ns is None:
            return []
        self._utime_offset_us = now.utime - now.monotonic_ns // 1000
        self._run_cycles(now.monotonic_ns)
        return self._pop_sent(now.monotonic_ns)

    def get_deadline(self) -> int | None:
        if self._opened_ns is None:
            return None
        instants = [self._clock.instant_of(self._tick)]
        if self._outbox:
            instants.append(self._outbox[0][0])
        return min(instants)

    def on_close(self, now: HostTime) -> list[Output[bytes]]:
        return []

    def apply_fault(self, fault: InjectedFault, now: HostTime) -> bool:
        if fault.kind == "jump":
            self._clock = replace(self._clock, offset=self._clock.offset + round(fault.amount))
        elif fault.kind == "restart":
            self._switch_on(now.monotonic_ns + round(fault.amount * 1e9), 0)
            self.streamed, self._bias = 0, (0.0, 0.0, 0.0)
        return fault.kind in ("jump", "restart")

    def corrupt(self, unit: bytes) -> bytes:
        return bytes(corrupt_unit(unit))

    def _switch_on(self, at_ns: int, ticks: int) -> None:
        self._clock = UnitClock.make(self.eeprom, self.unit, at_ns, ticks)
        self._tick, self._capture = 0, None
        self._outbox.clear()
        self._requests.clear()
        # its own scales are in its firmware: a zero word affects only the host
        self._gains = Gains(*(self.eeprom.read_word(address) or 1000 for address in EepromAddress.GAINS))

    def _run_cycles(self, now_ns: int) -> None:
        clock, step = self._clock, self.unit.cycle_ticks
        period_ns = clock.instant_of(step) - clock.instant_of(0)
        behind = (now_ns - clock.instant_of(self._tick)) // period_ns - MAX_BACKLOG_CYCLES
        self._tick += max(behind, 0) * step
        while (at_ns := clock.instant_of(self._tick)) <= now_ns:
            self._tick += step
            if self._capture is not None:
                self._capture_bias(at_ns)
            elif self.streamed:
                self._send_measurement(self.streamed, at_ns)

    def _sense(self, at_ns: int) -> SensedState | None:
        return self._samples.sense_at(at_ns // 1000 + self._utime_offset_us)

    def _send_measurement(self, command: int, at_ns: int) -> None:
        instant = self._sense(at_ns)
        if instant is None:
            return
        unit, gains = self.unit, self._gains
        words: tuple[int, ...]
        field = gx1.vector_to_words(instant.field, gains.magnetometer, gx1.TESLA)
        force = gx1.vector_to_words(so3.scale(unit.force_sign, instant.force), gains.accelerometer, gx1.G0)
        rate = gx1.vector_to_words(_subtract(so3.add(instant.rate, unit.gyro_bias), self._bias), gains.gyro)
        if command == CommandByte.EULER_VECTORS:
            words = (*gx1.euler_to_words(instant.orientation), *force, *rate)
        elif command in (CommandByte.INSTANTANEOUS_EULER, CommandByte.STABILIZED_EULER):
            words = gx1.euler_to_words(instant.orientation)
        else:
            words = (*field, *force, *rate)
            if command == CommandByte.QUATERNION_VECTORS:
                words = (*gx1.quaternion_to_words(instant.orientation), *words)
        self._queue_reply(command, words, at_ns)

    def _capture_bias(self, at_ns: int) -> None:
        assert self._capture is not None
        until_ns, rates = self._capture
        instant = self._sense(at_ns)
        if instant is not None:
            rates.append(so3.add(instant.rate, self.unit.gyro_bias))
        if at_ns < until_ns:
            return
        if rates:
            self._bias = so3.scale(1.0 / len(rates), so3.add(*rates))
        self._capture = None
        self._queue_reply(CommandByte.CAPTURE_BIAS, (), at_ns)

    def _on_request(self, request: Gx1Request, now: HostTime) -> None:
        command, data, at_ns = request.command, request.data, now.monotonic_ns
        constants = {
            CommandByte.TEMPERATURE: gx1.temperature_to_word(self.unit.celsius),
            CommandByte.FIRMWARE: self.unit.firmware,
            CommandByte.SERIAL: self.unit.serial,
        }
        if self._capture is not None:
            return
        if command in MEASUREMENTS:
            self._send_measurement(command, at_ns)
        elif (word := constants.get(CommandByte(command))) is not None:
            self._queue_reply(command, (word,), at_ns)
        elif command == CommandByte.CAPTURE_BIAS:
            self._capture = (at_ns + round(self.unit.bias_capture * 1e9), [])
        elif command == CommandByte.CONTINUOUS:
            if data[0] == 0 or data[0] in MEASUREMENTS:
                self.streamed = data[0]
                self._queue_reply(command, (data[0], self._clock.ticks_at(at_ns)), at_ns)
        else:
            self._queue_reply(command, (self.eeprom.read_word(int.from_bytes(data, "big")),), at_ns)

    def _queue_reply(self, command: int, words: tuple[int, ...], at_ns: int) -> None:
        has_ticks = command not in (CommandByte.CONTINUOUS, CommandByte.FIRMWARE, CommandByte.SERIAL)
        ticks = self._clock.ticks_at(at_ns) if has_ticks else None
        send_ns = at_ns + round(self.unit.delay * 1e9)
        if self._outbox:
            send_ns = max(send_ns, self._outbox[-1][0])
        self._outbox.append((send_ns, Gx1Packet(command, words, ticks).to_bytes()))

    def _pop_sent(self, now_ns: int) -> list[Output[bytes]]:
        outputs: list[Output[bytes]] = []
        while self._outbox and self._outbox[0][0] <= now_ns:
            self.counts["sent"] += 1
            outputs.append(Send(self._outbox.popleft()[1]))
        return outputs


def _subtract(value: Vector3, less: Vector3) -> Vector3:
    return so3.add(value, so3.scale(-1.0, less))
