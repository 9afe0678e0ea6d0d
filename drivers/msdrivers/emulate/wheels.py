"""Wheel encoders on a CAN bus in software, from the controller's side: what a series of samples lets them say."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping

from modelserver.messages import Direction, WheelSample, WheelsSample
from msdrivers.emulate.can_line import CanFault, CanLine, said
from msdrivers.protocol.can.database import BoundSignal, CanDatabase
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import WheelMap
from msdrivers.protocol.can.wheels import BoundWheel, bind_wheels
from msdrivers.station import Now, Output, StationPhase, StationStatus


class WheelsEmulator:
    """A `Station` of CAN frames that says each sample at its stamp.

    Where the first is past when the line is first opened, it is said then, and all others as much later. What a sample
    does not tell stays as it was. Signals of a mapped message that are not mapped are 0.
    """

    def __init__(
        self,
        wheels: Mapping[str, WheelMap],
        database: CanDatabase,
        samples: Iterable[WheelsSample],
        faults: Iterable[CanFault] = (),
        first_count: int = 0,
    ):
        """Take the mapping and the DBC as the driver has them, samples in the order of their stamps, and the faults.

        `first_count` is what the counters hold where the travel is 0. Raises ConfigError as `bind_wheels` does.
        """
        self._database = database
        self._wheels = bind_wheels(wheels, database, "wheels")
        self._raw: dict[str, dict[str, float]] = {}
        for wheel in self._wheels:
            for signal in wheel.signals:
                self._raw.setdefault(signal.message, dict.fromkeys(database.signals(signal.message), 0))
        self._samples = iter(samples)
        self._next = next(self._samples, None)
        self._line = CanLine(faults)
        self._offset = dict.fromkeys((wheel.name for wheel in self._wheels), first_count)
        self._counted = dict.fromkeys((wheel.name for wheel in self._wheels), 0)
        self._rolled = dict.fromkeys((wheel.name for wheel in self._wheels), 0)
        self._begun: tuple[int, int] | None = None
        self.counts: Counter[str] = Counter()

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin at the first time; later the wheels have rolled on."""
        self._line.begin(now.monotonic_ns)
        if self._begun is None and self._next is not None:
            self._begun = (now.monotonic_ns, min(now.utime, self._next.header.utime))
        return [StationStatus(StationPhase.STREAMING, f"{len(self._wheels)} wheels emulated"), *self.woken(now)]

    def received(self, unit: CanFrame, now: Now) -> list[Output[CanFrame]]:
        """Take no notice: encoders are told nothing."""
        return []

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Say the samples whose time has come."""
        outputs: list[Output[CanFrame]] = []
        while True:
            due = self.due()
            if due is None or due > now.monotonic_ns:
                return outputs
            faults = self._line.come(due)
            outputs += said(faults)
            for fault in faults:
                for name in self._offset:
                    if fault.kind == "jump":
                        self._offset[name] += round(fault.amount)
                    elif fault.kind == "restart":
                        self._offset[name] = -self._counted[name]
            if self._next is not None and self._at(self._next) <= due:
                frames = self._frames(self._next)
                self.counts["frames"] += len(frames)
                outputs += self._line.passed(frames, due)
                self._next = next(self._samples, None)

    def due(self) -> int | None:
        """Return when the next sample, or fault, comes."""
        sample = None if self._next is None or self._begun is None else self._at(self._next)
        return min((due for due in (sample, self._line.due()) if due is not None), default=None)

    def leaving(self, now: Now) -> list[Output[CanFrame]]:
        """Leave."""
        return []

    def _at(self, sample: WheelsSample) -> int:
        assert self._begun is not None
        return self._begun[0] + (sample.header.utime - self._begun[1]) * 1000

    def _frames(self, sample: WheelsSample) -> list[CanFrame]:
        told = {wheel.name: wheel for wheel in sample.wheels}
        for wheel in self._wheels:
            if wheel.name in told:
                self._set(wheel, told[wheel.name])
        return [self._database.encode(message, raw) for message, raw in self._raw.items()]

    def _set(self, wheel: BoundWheel, sample: WheelSample) -> None:
        mapped = wheel.map
        if wheel.count is not None and mapped.count is not None and math.isfinite(sample.travel):
            rolled = round(sample.travel / mapped.count.metres_per_count)
            step = rolled - self._rolled[wheel.name]
            self._counted[wheel.name] += abs(step) if mapped.count.up_only else step
            self._rolled[wheel.name] = rolled
            count = (self._counted[wheel.name] + self._offset[wheel.name]) % (
                mapped.count.wrap or 1 << wheel.count.length
            )
            signed = wheel.count.is_signed and count >= 1 << (wheel.count.length - 1)
            self._put(wheel.count, count - (1 << wheel.count.length) if signed else count)
        if wheel.speed is not None and mapped.speed is not None and math.isfinite(sample.speed):
            speed = sample.speed / mapped.speed.scale
            self._put_physical(wheel.speed, abs(speed) if mapped.speed.is_magnitude else speed)
        if wheel.direction is not None and mapped.direction is not None:
            numbers = {
                Direction.STOPPED: mapped.direction.stopped,
                Direction.FORWARD: mapped.direction.forward,
                Direction.BACKWARD: mapped.direction.backward,
            }
            known = set(numbers.values())
            unknown = next((each for each in range(1 << wheel.direction.length) if each not in known), 0)
            self._put(wheel.direction, numbers.get(sample.direction, unknown))
        if wheel.steering is not None and mapped.steering is not None and math.isfinite(sample.steering):
            self._put_physical(wheel.steering, (sample.steering - mapped.steering.offset) / mapped.steering.scale)

    def _put(self, signal: BoundSignal, raw: float) -> None:
        self._raw[signal.message][signal.name] = raw

    def _put_physical(self, signal: BoundSignal, value: float) -> None:
        self._put(signal, signal.bits(value))
