"""Emulators of inertial units: VectorNav VN-100, Xsens MTi, lines of text, MicroStrain 3DM-GX1.

The VN-100 applies commands and sends its binary output. The MTi has a configuration
and a measurement mode and sends MTData2. Choices where the documents of the 3DM-GX1 are silent: it starts without
continuous mode, and reads its timer words at start.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from modelserver.messages import ImuSample, OrientationReference
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3
from msdrivers.devices import gx1, xsens
from msdrivers.devices import vectornav as vn
from msdrivers.devices.gx1 import MEASUREMENTS, CommandByte, EepromAddress, Gains, Gx1Packet
from msdrivers.devices.stream import FrameScanner
from msdrivers.devices.text import TextSettings, encode_line
from msdrivers.devices.vectornav import FIELD_BYTES, VnBinaryFormat, VnText, VnTextFormat
from msdrivers.devices.xsens import ItemId, MessageId, XbusFormat, XbusMessage
from msdrivers.emulate import InjectedFault, SampleEmulator
from msdrivers.endpoint import HostTime


class VectornavEmulator(SampleEmulator[ImuSample, bytes]):
    """An `Endpoint` of bytes that speaks as a VN-100 does. `samples` are in the order of their stamps."""

    CELSIUS = 31.5
    START_NS = 5_000_000_000
    """Its clock at its first sample."""

    def __init__(self, samples: Iterable[ImuSample], error: int = 0) -> None:
        """`error` is the code by which it rejects binary output; 0: it takes it."""
        super().__init__(samples)
        self._error = error
        self._stream = FrameScanner((VnBinaryFormat(), VnTextFormat()))
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
            register = int(words[1])
            if words[0] == "RRG":
                return 0 if register == 1 else 0x08
            if register != 75 or self._error:
                return 0 if register == 6 else self._error or 0x08
            groups, masks = int(words[4], 16), [int(word, 16) for word in words[5:]]
            present = [bit + 1 for bit in range(8) if groups >> bit & 1]
            self._keys = tuple(
                (group, bit)
                for group, mask in zip(present, masks, strict=True)
                for bit in range(len(FIELD_BYTES[group]))
                if mask >> bit & 1
            )
            self._divisor = int(words[3])
        except (ValueError, IndexError, KeyError):
            return 0x07
        return 0

    def _encode(self, sample: ImuSample) -> Iterable[bytes]:
        utime = sample.header.utime
        is_early = self._sent_us is not None and utime - self._sent_us < 1e6 * self._divisor / vn.BASE_RATE_HZ - 500
        if not self._divisor or is_early:
            return ()
        self._sent_us = utime
        self.counts["messages"] += 1
        time_ns = self.START_NS + (utime - self._first_utime) * 1000
        orientation, field = sample.orientation, sample.magnetic_field
        numbers: dict[tuple[int, int], Sequence[float] | None] = {
            vn.QUATERNION: orientation and (*orientation[1:], orientation[0]),
            vn.RATE: sample.angular_velocity,
            vn.ACCELERATION: sample.specific_force,
            vn.MAGNETIC: field and [each / vn.GAUSS for each in field],
            vn.TEMPERATURE: (self.CELSIUS,),
        }
        # what the sample does not have is zero
        fields = {(group, bit): bytes(FIELD_BYTES[group][bit]) for group, bit in self._keys}
        for key, values in numbers.items():
            if key in fields and values is not None:
                finite = (each if math.isfinite(each) else 0.0 for each in values)
                fields[key] = struct.pack(f"<{len(values)}f", *finite)
        if vn.TIME in fields:
            fields[vn.TIME] = time_ns.to_bytes(8, "little")
        return (vn.encode_binary(fields),)


class XsensEmulator(SampleEmulator[ImuSample, bytes]):
    """An `Endpoint` of bytes that speaks as an MTi does. `samples` are in the order of their stamps."""

    CELSIUS = 28.0
    FIRST_TICKS = 12_345
    """Its clock at its first sample."""

    def __init__(
        self,
        samples: Iterable[ImuSample],
        error: int = 0,
        has_orientation: bool = True,
        field_strength: float = 5e-5,
    ) -> None:
        """`error` is the code by which it rejects outputs; `field_strength` is what it reports as 1, tesla.

        has_orientation: it is more than an IMU. It starts in measurement, with outputs of an earlier configuration.
        """
        super().__init__(samples)
        self._error, self._has_orientation, self._field_strength = error, has_orientation, field_strength
        self._stream = FrameScanner((XbusFormat(),))
        self._outputs = {int(ItemId.PACKET_COUNTER): xsens.AS_SENT, int(ItemId.QUATERNION): 100}
        self._is_measuring = True
        self._counter = 0
        self._sent_us: int | None = None

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
        has_orientation = any(item == ItemId.QUATERNION for item, _ in pairs)
        error = 0x21 if has_orientation and not self._has_orientation else self._error
        self.counts["rejected" if error else "accepted"] += 1
        if error:
            return xsens.encode(MessageId.ERROR, bytes((error,)))
        self._outputs = dict(pairs)
        return xsens.encode(MessageId.SET_OUTPUT_ACK, message.data)

    def _encode(self, sample: ImuSample) -> Iterable[bytes]:
        utime = sample.header.utime
        hertz = max((rate for rate in self._outputs.values() if rate != xsens.AS_SENT), default=0)
        is_early = self._sent_us is not None and utime - self._sent_us < 1e6 / max(hertz, 1) - 500
        if not self._is_measuring or not hertz or is_early:
            return ()
        self._sent_us = utime
        self._counter = (self._counter + 1) & 0xFFFF
        self.counts["packets"] += 1
        ticks = (self.FIRST_TICKS + round((utime - self._first_utime) * 1e-6 / xsens.TICK)) % (1 << 32)
        field = sample.magnetic_field
        numbers: dict[int, Sequence[float] | None] = {
            ItemId.TEMPERATURE: (self.CELSIUS,),
            ItemId.ACCELERATION: sample.specific_force,
            ItemId.RATE_OF_TURN: sample.angular_velocity,
            ItemId.MAGNETIC_FIELD: field and [each / self._field_strength for each in field],
            ItemId.QUATERNION: sample.orientation,
        }
        items = {
            ItemId.PACKET_COUNTER: self._counter.to_bytes(2, "big"),
            ItemId.SAMPLE_TIME_FINE: ticks.to_bytes(4, "big"),
            ItemId.STATUS_WORD: (0x3).to_bytes(4, "big"),
            **{item: struct.pack(f">{len(each)}f", *each) for item, each in numbers.items() if each is not None},
        }
        return (xsens.encode_items((item, items[item]) for item in self._outputs if item in items),)


CELSIUS = 25.0


class TextImuEmulator(SampleEmulator[ImuSample, bytes]):
    """An `Endpoint` of bytes that sends a line for each sample. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], settings: TextSettings) -> None:
        super().__init__(samples)
        self._settings = settings

    def _encode(self, sample: ImuSample) -> Iterable[bytes]:
        self.counts["lines"] += 1
        values = {name: self._get_value(sample, name) for name in self._settings.mapped}
        return (encode_line(self._settings, values),)

    def _get_value(self, sample: ImuSample, name: str) -> float:
        if name == "time":
            return 1.0 + (sample.header.utime - self._first_utime) * 1e-6
        if name == "temperature":
            return CELSIUS
        vector = getattr(sample, name[:-2])
        return 0.0 if vector is None else float(vector["xyz".index(name[-1])])


GAINS = Gains(8500, 7000, 2000)

TICK_100_HZ, TICK_DEFAULT = (4, 10, 250, 10), (16, 16, 256, 1)
"""Timer words of 10 ms and of 6.5536 ms a tick."""


def make_eeprom(gains: Gains = GAINS, timer: tuple[int, ...] = TICK_100_HZ) -> dict[int, int]:
    """Return the words of a 3DM-GX1's memory by address; the others are 0."""
    addresses = (*EepromAddress.GAINS, *EepromAddress.TIMER)
    return dict(zip(addresses, (*gains, *timer), strict=True))


@dataclass(frozen=True, slots=True)
class Gx1Unit:
    """One device. SI units.

    tick_offset: its ticks at the first sample. drift: how much faster its clock runs than the host's, as a fraction.
    delay: from a measurement until it is sent. force_sign: 1 if it reports specific force, -1 for its opposite.
    streamed_at_start: the command that it streams when the line is opened, 0 for none.
    """

    tick_offset: int = 0
    drift: float = 0.0
    delay: float = 0.003
    force_sign: int = 1
    celsius: float = 23.0
    streamed_at_start: int = 0


_ZERO: Vector3 = (0.0, 0.0, 0.0)
_NED_FROM_ENU: Quaternion = (0.0, 0.5**0.5, 0.5**0.5, 0.0)
"""Rotation by 180 degrees about the axis between east and north."""


class Gx1Emulator(SampleEmulator[ImuSample, bytes]):
    """An `Endpoint` of bytes that answers as a 3DM-GX1 does. `samples` are in the order of their stamps.

    It streams one sample a tick at most; its time jumps by ticks. Missing vectors are zero, a missing orientation is
    level and north.
    """

    def __init__(
        self, samples: Iterable[ImuSample], eeprom: dict[int, int] | None = None, unit: Gx1Unit | None = None
    ) -> None:
        self.unit = unit or Gx1Unit()
        super().__init__(samples, self.unit.delay)
        self.eeprom = make_eeprom() if eeprom is None else eeprom
        self.streamed = self.unit.streamed_at_start
        """The command that is streamed now, 0 for none."""
        self._buffer = b""
        self._sent_ticks: int | None = None
        self._offset = self.unit.tick_offset
        # both are read when it is switched on; its own scales are in its firmware: a zero word affects only the host
        self._tick_s = gx1.tick_from_timer_words(self.eeprom.get(each, 0) for each in EepromAddress.TIMER) or 0.01
        self._gains = Gains(*(self.eeprom.get(each) or 1000 for each in EepromAddress.GAINS))

    def apply_fault(self, fault: InjectedFault, now: HostTime) -> bool:
        if fault.kind == "jump":
            self._offset += round(fault.amount)
        return fault.kind == "jump"

    def _count_ticks(self, utime: int) -> int:
        return (
            round((utime - self._first_utime) * 1e-6 * (1.0 + self.unit.drift) / self._tick_s) + self._offset
        ) % 65536

    def _encode(self, sample: ImuSample) -> Iterable[bytes]:
        ticks = self._count_ticks(sample.header.utime)
        if not self.streamed or ticks == self._sent_ticks:
            return ()
        self._sent_ticks = ticks
        self.counts["sent"] += 1
        return (self._measure(self.streamed, sample, ticks),)

    def _measure(self, command: int, sample: ImuSample, ticks: int) -> bytes:
        orientation = so3.IDENTITY if sample.orientation is None else sample.orientation
        if sample.orientation_reference is OrientationReference.ENU:
            orientation = so3.normalize(so3.multiply(_NED_FROM_ENU, orientation))
        force = so3.scale(self.unit.force_sign, sample.specific_force or _ZERO)
        values = {
            "euler": gx1.euler_to_words(orientation),
            "quaternion": gx1.quaternion_to_words(orientation),
            "field": gx1.vector_to_words(sample.magnetic_field or _ZERO, self._gains.magnetometer, gx1.TESLA),
            "acceleration": gx1.vector_to_words(force, self._gains.accelerometer, gx1.G0),
            "rate": gx1.vector_to_words(sample.angular_velocity or _ZERO, self._gains.gyro),
        }
        words = tuple(word for name, _ in gx1.LAYOUTS[command].fields for word in values[name])
        return Gx1Packet(command, words, ticks).to_bytes()

    def _answer(self, unit: bytes) -> Iterator[bytes]:
        self._buffer += unit
        while self._buffer:
            command = self._buffer[0]
            size = 3 if command in (CommandByte.CONTINUOUS, CommandByte.READ_EEPROM) else 1
            if len(self._buffer) < size:
                return
            data, is_request = self._buffer[1:size], command in gx1.LAYOUTS
            if command == CommandByte.CONTINUOUS and data[0]:
                # what is no request is skipped byte by byte
                size, is_request = 1, False
            self._buffer = self._buffer[size:]
            if is_request and (answer := self._execute(command, data)):
                self.counts[f"request.{CommandByte(command).name.lower()}"] += 1
                yield answer

    def _execute(self, command: int, data: bytes) -> bytes:
        assert self._now is not None
        ticks = self._count_ticks(self._now.utime)
        if command == CommandByte.CONTINUOUS:
            if data[1] and data[1] not in MEASUREMENTS:
                return b""
            self.streamed = data[1]
            return Gx1Packet(command, (data[1], ticks)).to_bytes()
        if command == CommandByte.READ_EEPROM:
            return Gx1Packet(command, (self.eeprom.get(int.from_bytes(data, "big"), 0),), ticks).to_bytes()
        words = {
            CommandByte.TEMPERATURE: gx1.temperature_to_word(self.unit.celsius),
            CommandByte.FIRMWARE: 3100,
            CommandByte.SERIAL: 1234,
        }
        # a measurement is only streamed here
        word = words.get(CommandByte(command))
        has_ticks = gx1.LAYOUTS[command].has_ticks
        return b"" if word is None else Gx1Packet(command, (word,), ticks if has_ticks else None).to_bytes()


EMULATORS: Mapping[str, Callable[[Any, Iterable[ImuSample]], SampleEmulator[ImuSample, bytes]]] = {
    "gx1": lambda settings, samples: Gx1Emulator(samples),
    "vectornav": lambda settings, samples: VectornavEmulator(samples),
    "xsens": lambda settings, samples: XsensEmulator(samples, field_strength=settings.field_strength or 5e-5),
    "text_imu": lambda settings, samples: TextImuEmulator(samples, settings),
}
"""By kind of device."""
