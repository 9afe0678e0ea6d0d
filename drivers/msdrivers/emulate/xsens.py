"""Emulator of an Xsens MTi: configuration and measurement mode, MTData2."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from modelserver.messages import ImuSample
from msdrivers.emulate.sample_emulator import SampleEmulator
from msdrivers.endpoint import HostTime, Output, Send
from msdrivers.protocol import xsens
from msdrivers.protocol.xsens import ItemId, MessageId, XbusMessage, XbusStream


@dataclass(frozen=True, slots=True)
class XsensUnit:
    """A unit. has_orientation: whether it is more than an IMU. most_hz: its greatest rate. baud: of its line.

    field_strength: the field that it reports as 1, tesla. ticks: its clock at its first sample. stored: outputs that it
    has from an earlier configuration, with which it starts in measurement.
    """

    has_orientation: bool = True
    most_hz: int = 400
    baud: int = 921600
    field_strength: float = 5e-5
    ticks: int = 12_345
    wrap: int = 1 << 32
    celsius: float = 28.0
    stored: tuple[tuple[int, int], ...] = ((ItemId.PACKET_COUNTER, 0xFFFF), (ItemId.QUATERNION, 100))


class XsensEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that speaks as the unit does. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], unit: XsensUnit | None = None) -> None:
        self._unit = XsensUnit() if unit is None else unit
        super().__init__(samples)
        self._stream = XbusStream()
        self._outputs = dict(self._unit.stored)
        self._is_measuring = True
        self._counter = 0
        self._first_utime: int | None = None
        self._sent: dict[int, int] = {}

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        self._now = now
        return [Send(each) for message in self._stream.feed(unit) if (each := self._execute(message))]

    def _send_sample(self, sample: ImuSample) -> list[Output[bytes]]:
        data = self._encode(sample)
        return [Send(data)] if data else []

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
            if item == ItemId.QUATERNION and not self._unit.has_orientation:
                return 0x21
            if rate != xsens.AS_SENT and rate > self._unit.most_hz:
                return 0x21
        hertz = max((rate for _, rate in pairs if rate != xsens.AS_SENT), default=0)
        size = 5 + sum(3 + _SIZES.get(item, 4) for item, _ in pairs)
        return 0x29 if size * 10 * hertz > self._unit.baud else 0

    def _encode(self, sample: ImuSample) -> bytes:
        utime = sample.header.utime
        self._first_utime = utime if self._first_utime is None else self._first_utime
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
        ticks = (self._unit.ticks + round((utime - self._first_utime) * 1e-6 / xsens.TICK)) % self._unit.wrap
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
            numbers = (self._unit.celsius,)
        elif item == ItemId.ACCELERATION:
            numbers = sample.specific_force
        elif item == ItemId.RATE_OF_TURN:
            numbers = sample.angular_velocity
        elif item == ItemId.MAGNETIC_FIELD and sample.magnetic_field is not None:
            numbers = [each / self._unit.field_strength for each in sample.magnetic_field]
        elif item == ItemId.QUATERNION:
            numbers = sample.orientation
        return None if numbers is None else struct.pack(f">{len(numbers)}f", *numbers)


_SIZES: Mapping[int, int] = {
    ItemId.QUATERNION: 16,
    ItemId.ACCELERATION: 12,
    ItemId.RATE_OF_TURN: 12,
    ItemId.MAGNETIC_FIELD: 12,
}
