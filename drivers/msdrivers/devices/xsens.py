"""Xsens MTi units (1-, 10-, 100-, 600-series): Xbus messages, MTData2, and the driver, which configures MTData2.

A message is FA, FF, its identifier, the length of its data (FF: a 16-bit length follows), the data, and a byte that
makes the sum of all after FA 0. MTData2 is a list of items: identifier, size, big-endian data. The low nibble of the
identifier of an orientation is number format and frame. Source: Xsens, MT low-level communication protocol, MT0101P.
Axes: as on the label, z up when it is upright.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from modelserver.messages import NAN, ImuSample, OrientationReference, YawSource
from msdrivers.devices import check_choice, check_ranges, make_orientation
from msdrivers.devices.stream import NO_FRAME, ByteSettings, ParsedFrame, RejectedFrame, SetupStep, StreamDriver
from msdrivers.endpoint import HostTime, Output

PREAMBLE: Final = 0xFA
BUS_IDS: Final = (0xFF, 0x01)
MAX_DATA: Final = 2048


class MessageId(IntEnum):
    """Identifiers of messages; the acknowledgement of one is the next number."""

    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MT_DATA_2 = 0x36
    ERROR = 0x42
    SET_OUTPUT = 0xC0
    SET_OUTPUT_ACK = 0xC1


class ItemId(IntEnum):
    """Identifiers of items of MTData2, in float32 and against ENU, as they are asked for."""

    TEMPERATURE = 0x0810
    PACKET_COUNTER = 0x1020
    SAMPLE_TIME_FINE = 0x1060
    QUATERNION = 0x2010
    ACCELERATION = 0x4020
    RATE_OF_TURN = 0x8020
    MAGNETIC_FIELD = 0xC020
    STATUS_WORD = 0xE020


TICK: Final = 1e-4
"""Seconds of SampleTimeFine."""

DAY_TICKS: Final = 864_000_000
"""SampleTimeFine of the 10- and 100-series begins again after a day; that of the others after 2^32 ticks."""

WRAP_MARGIN: Final = 600_000
"""Ticks, a minute: a time that falls back from within this of a wrap to within this of 0 has wrapped."""

AS_SENT: Final = 0xFFFF
"""Rate of items that come with every packet."""

_CLIPPED: Final = 0x80000
"""Bit of the status word: a measurement was beyond its range."""


@dataclass(frozen=True, slots=True)
class XbusMessage:
    """A message: its identifier, its data, and the offset of its first byte in the stream."""

    id: int
    data: bytes
    start: int


class XbusFormat:
    """A `FrameFormat` of Xbus messages."""

    start_bytes = bytes((PREAMBLE,))

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[XbusMessage] | RejectedFrame | None:
        if len(buffer) < at + 4:
            return None if len(buffer) < at + 2 or buffer[at + 1] in BUS_IDS else NO_FRAME
        if buffer[at + 1] not in BUS_IDS:
            return NO_FRAME
        begin, size = at + 4, buffer[at + 3]
        if size == 0xFF:
            if len(buffer) < at + 6:
                return None
            begin, size = at + 6, int.from_bytes(buffer[at + 4 : at + 6], "big")
            if size > MAX_DATA:
                return RejectedFrame("xbus_length")
        end = begin + size + 1
        if len(buffer) < end:
            return None
        if sum(buffer[at + 1 : end]) & 0xFF:
            return RejectedFrame("checksum")
        identifier = buffer[at + 2]
        return ParsedFrame(
            end, f"xbus.{identifier:02X}", XbusMessage(identifier, bytes(buffer[begin : end - 1]), start)
        )


def encode(identifier: int, data: bytes = b"") -> bytes:
    size = bytes((len(data),)) if len(data) < 0xFF else b"\xff" + len(data).to_bytes(2, "big")
    body = bytes((BUS_IDS[0], identifier)) + size + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) & 0xFF,))


@dataclass(frozen=True, slots=True)
class MtData:
    """The items of an MTData2 packet: their bytes by identifier, with format and frame."""

    items: Mapping[int, bytes]

    @classmethod
    def parse(cls, data: bytes) -> MtData:
        """Return the items. Raises ValueError where the sizes do not fit."""
        items, at = {}, 0
        while at < len(data):
            if at + 3 > len(data) or at + 3 + data[at + 2] > len(data):
                raise ValueError(f"an item of MTData2 goes beyond its end, at byte {at}")
            end = at + 3 + data[at + 2]
            items[int.from_bytes(data[at : at + 2], "big")] = data[at + 3 : end]
            at = end
        return cls(items)

    def get_integer(self, item: ItemId) -> int | None:
        """Return an unsigned number; None if it is missing."""
        data = self.items.get(item)
        return None if data is None else int.from_bytes(data, "big")

    def get_numbers(self, item: int, count: int) -> tuple[float, ...] | None:
        """Return `count` numbers of float32, as they are asked for; None if they are missing, or of another size."""
        data = self.items.get(item)
        return struct.unpack(f">{count}f", data) if data is not None and len(data) == 4 * count else None


def encode_items(items: Iterable[tuple[int, bytes]]) -> bytes:
    data = b"".join(identifier.to_bytes(2, "big") + bytes((len(each),)) + each for identifier, each in items)
    return encode(MessageId.MT_DATA_2, data)


def make_setup(rate_hz: int, *, has_field: bool) -> tuple[SetupStep, ...]:
    """Return what sets a unit up: output with and, where it has one, its orientation; then measurement."""
    outputs = [
        (ItemId.PACKET_COUNTER, AS_SENT),
        (ItemId.SAMPLE_TIME_FINE, AS_SENT),
        (ItemId.ACCELERATION, rate_hz),
        (ItemId.RATE_OF_TURN, rate_hz),
        (ItemId.STATUS_WORD, AS_SENT),
        (ItemId.TEMPERATURE, 1),
    ]
    if has_field:
        outputs.append((ItemId.MAGNETIC_FIELD, min(rate_hz, 100)))
    oriented = [*outputs, (ItemId.QUATERNION, rate_hz)]
    return (
        SetupStep(_encode_outputs(outputs), f"{rate_hz} Hz of acceleration and rate of turn"),
        # a unit without orientation rejects this, and the first one remains
        SetupStep(_encode_outputs(oriented), "orientation", is_optional=True),
        SetupStep(encode(MessageId.GO_TO_MEASUREMENT), "measurement"),
    )


def _encode_outputs(outputs: Iterable[tuple[int, int]]) -> bytes:
    return encode(MessageId.SET_OUTPUT, b"".join(struct.pack(">HH", *each) for each in outputs))


ERRORS: Final = {
    0x03: "wrong period",
    0x04: "invalid message: this unit is older than MTData2",
    0x1E: "timer overflow: a lower rate_hz",
    0x20: "wrong baud rate",
    0x21: "wrong parameter: does this unit reach rate_hz?",
    0x28: "device error",
    0x29: "the data exceed the baud rate: a lower rate_hz, or a higher baud rate of the unit",
    0x2A: "buffer overflow: a lower rate_hz, or a higher baud rate of the unit",
}
"""Meaning of the code in an error message."""

MAX_RATE: Final = 60.0
MAX_ACCELERATION: Final = 400.0
"""Beyond the ranges of the units, with room: rad/s, m/s2."""


@dataclass(frozen=True, slots=True, kw_only=True)
class XsensSettings(ByteSettings):
    """Settings of an MTi. Raises ValueError with the key for an invalid value."""

    rate_hz: int = 100
    """Samples per second, 1 to 400; a 1-series unit reaches 100, and 115200 baud carry 130."""
    field_strength: float = 0.0
    """Magnetic field at its calibration, tesla: the unit reports multiples of it. 0: its field is not used."""
    heading: str = "magnetic"
    """What the yaw of its orientation is measured against: `magnetic`, `none` (VRU), or `true` (with declination)."""
    bauds: tuple[int, ...] = (115200, 921600, 460800, 230400, 2000000)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""

    def __post_init__(self) -> None:
        ByteSettings.__post_init__(self)
        check_ranges(self, rate_hz=(1, 400), field_strength=(0.0, 1e-3))
        check_choice(self, heading=_YAW_SOURCES)


_YAW_SOURCES: Final = {"magnetic": YawSource.MAGNETIC, "none": YawSource.NONE, "true": YawSource.TRUE}


class SampleTimeUnwrapper:
    """SampleTimeFine as a number that does not wrap."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._offset = 0

    def unwrap(self, ticks: int) -> int:
        """Return the ticks since the first wrap; a restart of the unit begins again from its own ticks."""
        last, self._last = self._last, ticks
        if last is not None and ticks < last and ticks < WRAP_MARGIN:
            for wrap in (DAY_TICKS, 1 << 32):
                if 0 <= wrap - last < WRAP_MARGIN:
                    self._offset += wrap
                    return self._offset + ticks
            self._offset = 0
        return self._offset + ticks


class XsensDriver(StreamDriver[XbusMessage]):
    """An `Endpoint` of bytes at the host's end of the unit's line; see `XsensSettings`.

    Further counts: `lost` packets, by the packet counter; `clipped` packets; `rejected.range` vectors.
    """

    device = "xsens"
    description = "Xsens MTi"
    awaited = "MTData2"
    formats = (XbusFormat(),)
    identification = encode(MessageId.GO_TO_CONFIG)
    attempts = 5
    """Some units do not answer after power-up."""

    def __init__(self, settings: XsensSettings) -> None:
        super().__init__(settings)
        self._own = settings
        self._ticks = SampleTimeUnwrapper()
        self._last_counter: int | None = None
        self._celsius = NAN

    def _on_start(self) -> None:
        self._last_counter = None

    def _on_message(self, message: XbusMessage, now: HostTime) -> list[Output[bytes]]:
        if message.id == MessageId.MT_DATA_2:
            return self._on_data(message, now)
        if message.id == MessageId.GO_TO_CONFIG_ACK:
            steps = make_setup(self._own.rate_hz, has_field=self._own.field_strength > 0.0)
            return self._on_identity("Xsens MTi", steps, now)
        step = self._step
        if step is None:
            return []
        if message.id == MessageId.ERROR:
            code = message.data[0] if message.data else 0
            return self._on_acknowledgement(now, f"error {code:02X}, {ERRORS.get(code, 'unknown')}")
        return self._on_acknowledgement(now) if message.id == step.frame[2] + 1 else []

    def _on_data(self, message: XbusMessage, now: HostTime) -> list[Output[bytes]]:
        try:
            data = MtData.parse(message.data)
        except ValueError:
            self._stream.reject("mtdata2")
            return []
        counter = data.get_integer(ItemId.PACKET_COUNTER)
        if counter is not None and self._last_counter is not None:
            step = (counter - self._last_counter) & 0xFFFF
            # half of its range or more: it began again
            self._counts["lost"] += step - 1 if 0 < step < 0x8000 else 0
        self._last_counter = counter
        if (celsius := data.get_numbers(ItemId.TEMPERATURE, 1)) is not None:
            self._celsius = celsius[0]
        rate, force = data.get_numbers(ItemId.RATE_OF_TURN, 3), data.get_numbers(ItemId.ACCELERATION, 3)
        if rate is None and force is None:
            # such as the packets of a receiver
            self._counts["without_rate"] += 1
            return []
        self._counts["clipped"] += bool((data.get_integer(ItemId.STATUS_WORD) or 0) & _CLIPPED)
        ticks = data.get_integer(ItemId.SAMPLE_TIME_FINE)
        device_utime = 0 if ticks is None else max(1, round(self._ticks.unwrap(ticks) * TICK * 1e6))
        field = data.get_numbers(ItemId.MAGNETIC_FIELD, 3)
        quaternion, yaw_source = data.get_numbers(ItemId.QUATERNION, 4), _YAW_SOURCES[self._own.heading]
        sample = ImuSample(
            self._make_header(self._find_arrival(message.start, now), device_utime),
            angular_velocity=self._read_vector(rate, MAX_RATE),
            specific_force=self._read_vector(force, MAX_ACCELERATION),
            magnetic_field=self._read_vector(field, 100.0, self._own.field_strength)
            if self._own.field_strength
            else None,
            temperature_celsius=self._celsius,
            **make_orientation(quaternion, OrientationReference.ENU, yaw_source),
        )
        return self._publish(sample, now, TICK)
