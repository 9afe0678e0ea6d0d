"""Emulator of wheel encoders on a CAN bus: sends the frames of a series of samples."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from modelserver.messages import Direction, WheelSample, WheelsSample
from msdrivers.emulate.faults import CanEmulator, InjectedFault
from msdrivers.protocol.can.database import BoundSignal, CanDatabase
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import WheelMap
from msdrivers.protocol.can.wheels import BoundWheel, bind_wheels


class WheelsEmulator(CanEmulator[WheelsSample]):
    """An `Endpoint` of CAN frames. Missing values of a sample keep the last one; signals that are not mapped are 0."""

    def __init__(
        self,
        wheels: Mapping[str, WheelMap],
        database: CanDatabase,
        samples: Iterable[WheelsSample],
        faults: Iterable[InjectedFault] = (),
        first_count: int = 0,
    ):
        """`first_count` is the counters' value at travel 0. Raises ConfigError as `bind_wheels` does."""
        super().__init__(f"{len(wheels)} wheels emulated", samples, faults)
        self._database = database
        self._wheels = bind_wheels(wheels, database, "wheels")
        self._raw: dict[str, dict[str, float]] = {}
        for wheel in self._wheels:
            for signal in wheel.signals:
                self._raw.setdefault(signal.message, dict.fromkeys(database.bind_signals(signal.message), 0))
        self._offset = dict.fromkeys((wheel.name for wheel in self._wheels), first_count)
        self._counted = dict.fromkeys((wheel.name for wheel in self._wheels), 0)
        self._rolled = dict.fromkeys((wheel.name for wheel in self._wheels), 0)

    def _on_fault(self, fault: InjectedFault) -> None:
        for name in self._offset:
            if fault.kind == "jump":
                self._offset[name] += round(fault.amount)
            elif fault.kind == "restart":
                self._offset[name] = -self._counted[name]

    def _make_frames(self, sample: WheelsSample | None, at_ns: int) -> list[CanFrame]:
        if sample is None:
            return []
        wheels = {wheel.name: wheel for wheel in sample.wheels}
        for wheel in self._wheels:
            if wheel.name in wheels:
                self._set_wheel(wheel, wheels[wheel.name])
        self.counts["frames"] += len(self._raw)
        return [self._database.encode(message, raw) for message, raw in self._raw.items()]

    def _set_wheel(self, wheel: BoundWheel, sample: WheelSample) -> None:
        mapped = wheel.map
        if wheel.count is not None and mapped.count is not None and math.isfinite(sample.travel):
            rolled = round(sample.travel / mapped.count.meters_per_count)
            step = rolled - self._rolled[wheel.name]
            self._counted[wheel.name] += abs(step) if mapped.count.counts_up_only else step
            self._rolled[wheel.name] = rolled
            count = (self._counted[wheel.name] + self._offset[wheel.name]) % (
                mapped.count.wrap or 1 << wheel.count.length
            )
            signed = wheel.count.is_signed and count >= 1 << (wheel.count.length - 1)
            self._set_raw(wheel.count, count - (1 << wheel.count.length) if signed else count)
        if wheel.speed is not None and mapped.speed is not None and math.isfinite(sample.speed):
            speed = sample.speed / mapped.speed.scale
            self._set_physical(wheel.speed, abs(speed) if mapped.speed.is_magnitude else speed)
        if wheel.direction is not None and mapped.direction is not None:
            numbers = {
                Direction.STOPPED: mapped.direction.stopped,
                Direction.FORWARD: mapped.direction.forward,
                Direction.BACKWARD: mapped.direction.backward,
            }
            known = set(numbers.values())
            unknown = next((each for each in range(1 << wheel.direction.length) if each not in known), 0)
            self._set_raw(wheel.direction, numbers.get(sample.direction, unknown))
        if wheel.steering is not None and mapped.steering is not None and math.isfinite(sample.steering):
            self._set_physical(wheel.steering, (sample.steering - mapped.steering.offset) / mapped.steering.scale)

    def _set_raw(self, signal: BoundSignal, raw: float) -> None:
        self._raw[signal.message][signal.name] = raw

    def _set_physical(self, signal: BoundSignal, value: float) -> None:
        self._raw[signal.message][signal.name] = signal.to_bits(value)
