"""A MicroStrain 3DM-GX1 in software, from the device's side: it says what a series of samples lets it measure.

What its documents leave open is chosen here: it starts without continuous mode, keeps silent while it starts and while
it captures its gyros' biases, and reads its timer words when it starts. The sample at an instant is interpolated
between those around it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from modelserver.messages import ImuSample
from modelserver.spatial.so3 import Vector3
from msdrivers.emulate.gx1_samples import Samples, SensedState
from msdrivers.emulate.gx1_unit import GAINS, Eeprom, Gx1Unit, UnitClock, UnitFault
from msdrivers.protocol.gx1 import DATA, Address, CommandByte, Gains, Packet, Request, RequestParser
from msdrivers.protocol.gx1.scaling import (
    G0,
    HIGHEST,
    LOWEST,
    TESLA,
    euler_words,
    quaternion_words,
    temperature_word,
    vector,
    vector_words,
)
from msdrivers.station import Now, Output, Send, StationPhase, StationStatus

BACKLOG = 100
"""Cycles that are made up for when the emulator was woken late."""


class Gx1Emulator:
    """A `Station` of bytes that answers as the device does. `samples` are in the order of their stamps.

    After the last sample it measures nothing any more: it streams no longer and answers no poll for a measurement.
    """

    def __init__(
        self,
        samples: Iterable[ImuSample],
        eeprom: Eeprom | None = None,
        unit: Gx1Unit | None = None,
        keep: Callable[[Eeprom], object] = lambda eeprom: None,
    ):
        """Take what is measured, the memory and the device. `keep` is called with the memory when it has changed."""
        self.eeprom = Eeprom.factory() if eeprom is None else eeprom
        self.unit = Gx1Unit() if unit is None else unit
        self.streamed = self.unit.streams
        """The command that is streamed now, 0 for none."""
        self._keep = keep
        self._samples = Samples(samples)
        self._requests = RequestParser()
        self._outbox: deque[tuple[int, bytes]] = deque()
        self._faults = deque(sorted(self.unit.faults, key=lambda fault: fault.at))
        self._opened_ns: int | None = None
        self._stalled_until_ns = 0
        self._clock = UnitClock.of(self.eeprom, self.unit, 0, 0)
        self._tick = 0
        self._gains = GAINS
        self._bias: Vector3 = (0.0, 0.0, 0.0)
        self._capture: tuple[int, list[Vector3]] | None = None
        self._extremes: tuple[list[int], list[int]] = ([HIGHEST] * 3, [LOWEST] * 3)
        self._pending = Counter[str]()
        self._utime_offset_us = 0
        self.counts: Counter[str] = Counter()

    def opened(self, now: Now) -> list[Output[bytes]]:
        """Switch on at the first time; later the device has run on."""
        if self._opened_ns is None:
            self._opened_ns = now.monotonic_ns
            self._switch_on(now.monotonic_ns, self.unit.tick_offset)
        return [
            StationStatus(
                StationPhase.STREAMING if self.streamed else StationPhase.WAITING,
                f"3DM-GX1 {self.unit.serial} emulated",
            )
        ]

    def received(self, unit: bytes, now: Now) -> list[Output[bytes]]:
        """Take bytes from the host."""
        outputs = self.woken(now)
        if now.monotonic_ns < max(self._clock.started_ns, self._stalled_until_ns):
            return outputs
        for request in self._requests.feed(unit):
            self.counts[f"request.{CommandByte(request.command).name.lower()}"] += 1
            self._handle(request, now)
        return outputs + self._sent(now.monotonic_ns)

    def woken(self, now: Now) -> list[Output[bytes]]:
        """Do what is due."""
        if self._opened_ns is None:
            return []
        self._utime_offset_us = now.utime - now.monotonic_ns // 1000
        while self._faults and self._opened_ns + round(self._faults[0].at * 1e9) <= now.monotonic_ns:
            self.strike(self._faults.popleft(), now)
        self._run(now.monotonic_ns)
        return self._sent(now.monotonic_ns)

    def due(self) -> int | None:
        """Return when to be woken."""
        if self._opened_ns is None:
            return None
        instants = [self._clock.instant(self._tick)]
        if self._outbox:
            instants.append(max(self._outbox[0][0], self._stalled_until_ns))
        if self._faults:
            instants.append(self._opened_ns + round(self._faults[0].at * 1e9))
        return min(instants)

    def leaving(self, now: Now) -> list[Output[bytes]]:
        """Leave: a device does nothing about it."""
        return []

    def strike(self, fault: UnitFault, now: Now) -> None:
        """Let something go wrong now."""
        if fault.kind == "stall":
            self._stalled_until_ns = now.monotonic_ns + round(fault.amount * 1e9)
        elif fault.kind == "jump":
            self._clock = replace(self._clock, offset=self._clock.offset + round(fault.amount))
        elif fault.kind == "restart":
            self._switch_on(now.monotonic_ns + round(self.unit.start * 1e9), 0)
            self.streamed, self._bias = 0, (0.0, 0.0, 0.0)
        else:
            self._pending[fault.kind] += round(fault.amount)

    def _switch_on(self, at_ns: int, ticks: int) -> None:
        self._clock = UnitClock.of(self.eeprom, self.unit, at_ns, ticks)
        self._tick, self._capture = 0, None
        self._outbox.clear()
        self._requests.clear()
        addresses = (Address.GYRO_GAIN, Address.ACCELEROMETER_GAIN, Address.MAGNETOMETER_GAIN)
        # its own scales are in its firmware: a zero word misleads the host, not the device
        gyro, accelerometer, magnetometer = (self.eeprom.word(address) or 1000 for address in addresses)
        self._gains = Gains(gyro, accelerometer, magnetometer)

    def _run(self, now_ns: int) -> None:
        """Go through the calculation cycles up to now."""
        clock, step = self._clock, self.unit.cycle_ticks
        period_ns = clock.instant(step) - clock.instant(0)
        behind = (now_ns - clock.instant(self._tick)) // period_ns - BACKLOG
        self._tick += max(behind, 0) * step
        while (at_ns := clock.instant(self._tick)) <= now_ns:
            self._tick += step
            if self._capture is not None:
                self._captured(at_ns)
            elif self.streamed:
                self._measure(self.streamed, at_ns)

    def _measured(self, at_ns: int) -> SensedState | None:
        return self._samples.at(at_ns // 1000 + self._utime_offset_us)

    def _measure(self, command: int, at_ns: int) -> None:
        """Send a measurement made at an instant."""
        instant = self._measured(at_ns)
        if instant is None:
            return
        words: tuple[int, ...]
        vectors = {
            "field": self._field_words(instant, self._offsets()),
            "acceleration": vector_words(_scaled(instant.force, self.unit.force_sign), self._gains.accelerometer, G0),
            "rate": vector_words(_difference(self._rate(instant), self._bias), self._gains.gyro),
        }
        if command == CommandByte.EULER_VECTORS:
            words = (*euler_words(instant.orientation), *vectors["acceleration"], *vectors["rate"])
        elif command in (CommandByte.INSTANTANEOUS_EULER, CommandByte.STABILISED_EULER):
            words = euler_words(instant.orientation)
        else:
            words = (*vectors["field"], *vectors["acceleration"], *vectors["rate"])
            if command == CommandByte.QUATERNION_VECTORS:
                words = (*quaternion_words(instant.orientation), *words)
        self._reply(command, words, at_ns)

    def _rate(self, instant: SensedState) -> Vector3:
        x, y, z = instant.rate
        a, b, c = self.unit.gyro_bias
        return (x + a, y + b, z + c)

    def _field_words(self, instant: SensedState, offsets: Vector3) -> tuple[int, int, int]:
        x, y, z = instant.field
        a, b, c = self.unit.field_offset
        return vector_words(_difference((x + a, y + b, z + c), offsets), self._gains.magnetometer, TESLA)

    def _offsets(self) -> Vector3:
        words = (_signed(self.eeprom.word(address)) for address in Address.HARD_IRON)
        return vector(words, self._gains.magnetometer, TESLA)

    def _captured(self, at_ns: int) -> None:
        assert self._capture is not None
        until_ns, rates = self._capture
        instant = self._measured(at_ns)
        if instant is not None:
            rates.append(self._rate(instant))
        if at_ns < until_ns:
            return
        if rates:
            x, y, z = (sum(axis) / len(rates) for axis in zip(*rates, strict=True))
            self._bias = (x, y, z)
        self._capture = None
        self._reply(CommandByte.CAPTURE_BIAS, (), at_ns)

    def _handle(self, request: Request, now: Now) -> None:
        command, data, at_ns = request.command, request.data, now.monotonic_ns
        if self._capture is not None:
            return
        if command in DATA:
            self._measure(command, at_ns)
        elif command == CommandByte.TEMPERATURE:
            self._reply(command, (temperature_word(self.unit.celsius),), at_ns)
        elif command == CommandByte.CAPTURE_BIAS:
            self._capture = (at_ns + round(self.unit.bias_capture * 1e9), [])
        elif command == CommandByte.CONTINUOUS:
            if data[0] == 0 or data[0] in DATA:
                self.streamed = data[0]
                self._reply(command, (data[0], self._clock.ticks(at_ns)), at_ns)
        elif command in (CommandByte.READ_EEPROM, CommandByte.WRITE_EEPROM):
            address = int.from_bytes(data[:2], "big")
            if command == CommandByte.WRITE_EEPROM and address % 2 == 0 and address < 256:
                self._write({address: int.from_bytes(data[2:], "big")})
            self._reply(command, (self.eeprom.word(address),), at_ns)
        elif command == CommandByte.FIRMWARE:
            self._reply(command, (self.unit.firmware,), at_ns)
        elif command == CommandByte.SERIAL:
            self._reply(command, (self.unit.serial,), at_ns)
        else:
            self._hard_iron(command, data, at_ns)

    def _hard_iron(self, command: int, data: bytes, at_ns: int) -> None:
        if command == CommandByte.HARD_IRON_START:
            self._extremes = ([HIGHEST] * 3, [LOWEST] * 3)
            self._store_offsets((0, 0, 0))
            self._reply(command, (), at_ns)
            return
        low, high = self._extremes
        if command == CommandByte.HARD_IRON_COLLECT:
            instant = self._measured(at_ns)
            if instant is None:
                return
            words = self._field_words(instant, (0.0, 0.0, 0.0))
            low = [min(pair) for pair in zip(low, words, strict=True)]
            high = [max(pair) for pair in zip(high, words, strict=True)]
            self._extremes = (low, high)
            self._reply(command, (*words, *low, *high), at_ns)
            return
        two_dimensional, magnitude_z = data[0] == 1, _signed(int.from_bytes(data[1:], "big"))
        x, y, z = ((a + b) // 2 for a, b in zip(low, high, strict=True))
        self._store_offsets((x, y, z - magnitude_z if two_dimensional else z))
        self._reply(command, tuple(_signed(self.eeprom.word(address)) for address in Address.HARD_IRON), at_ns)

    def _store_offsets(self, words: tuple[int, int, int]) -> None:
        self._write(dict(zip(Address.HARD_IRON, words, strict=True)))

    def _write(self, changes: Mapping[int, int]) -> None:
        self.eeprom = self.eeprom.written(changes)
        self._keep(self.eeprom)

    def _reply(self, command: int, words: tuple[int, ...], at_ns: int) -> None:
        ticks = (
            None
            if command in (CommandByte.CONTINUOUS, CommandByte.FIRMWARE, CommandByte.SERIAL)
            else self._clock.ticks(at_ns)
        )
        raw = Packet(command, words, ticks).to_bytes()
        if self._pending["drop"] > 0:
            self._pending["drop"] -= 1
            return
        if self._pending["corrupt"] > 0:
            self._pending["corrupt"] -= 1
            raw = raw[:-3] + bytes((raw[-3] ^ 0x10,)) + raw[-2:]
        send_ns = at_ns + round(self.unit.delay * 1e9)
        if self._outbox:
            send_ns = max(send_ns, self._outbox[-1][0])
        self._outbox.append((send_ns, raw))

    def _sent(self, now_ns: int) -> list[Output[bytes]]:
        outputs: list[Output[bytes]] = []
        if now_ns < self._stalled_until_ns:
            # what it would have said is lost
            self._outbox.clear()
        while self._outbox and self._outbox[0][0] <= now_ns:
            self.counts["sent"] += 1
            outputs.append(Send(self._outbox.popleft()[1]))
        return outputs


def _signed(word: int) -> int:
    return (word + 32768) % 65536 - 32768


def _scaled(value: Vector3, factor: float) -> Vector3:
    x, y, z = value
    return (x * factor, y * factor, z * factor)


def _difference(value: Vector3, less: Vector3) -> Vector3:
    return (value[0] - less[0], value[1] - less[1], value[2] - less[2])
