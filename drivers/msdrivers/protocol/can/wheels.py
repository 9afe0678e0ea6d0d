"""Wheels as the mapping has them, bound to the signals of a DBC file: from frames, and to frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from modelserver.messages import NAN, Direction
from msdrivers.protocol.can.assembly import CanFrameSet
from msdrivers.protocol.can.counts import Odometer
from msdrivers.protocol.can.database import Binder, BoundSignal, CanDatabase
from msdrivers.protocol.can.mapping import SpeedMap, WheelMap


@dataclass(frozen=True, slots=True)
class BoundWheel:
    """One wheel: its mapping, and the signals that the mapping names; None for what it does not name."""

    name: str
    map: WheelMap
    count: BoundSignal | None
    speed: BoundSignal | None
    direction: BoundSignal | None
    steering: BoundSignal | None

    @property
    def signals(self) -> list[BoundSignal]:
        """The signals that there are."""
        return [each for each in (self.count, self.speed, self.direction, self.steering) if each is not None]

    def odometer(self, max_speed: float, delay: float) -> Odometer | None:
        """Return the counter's odometer at its beginning, m/s and seconds; None for a wheel without a counter."""
        if self.count is None or self.map.count is None:
            return None
        wrap = self.map.count.wrap or 1 << self.count.length
        return Odometer(wrap, self.map.count.metres_per_count, max_speed, delay, self.map.count.up_only)

    def turning(self, instant: CanFrameSet) -> Direction:
        """Return which way the wheel turns, as the encoder tells."""
        if self.map.is_unsigned:
            return Direction.UNSIGNED
        raw = instant.raw(self.direction)
        if raw is None or self.map.direction is None:
            return Direction.UNKNOWN
        numbers = {
            self.map.direction.stopped: Direction.STOPPED,
            self.map.direction.forward: Direction.FORWARD,
            self.map.direction.backward: Direction.BACKWARD,
        }
        return numbers.get(int(raw), Direction.UNKNOWN) if raw == raw and abs(raw) < 1e18 else Direction.UNKNOWN

    def speed_of(self, instant: CanFrameSet, direction: Direction) -> float:
        """Return the speed, m/s, forward positive (UNSIGNED: its size); nan where it or its sign did not come."""
        physical = instant.physical(self.speed)
        if physical is None or self.map.speed is None:
            return NAN
        speed = physical * self.map.speed.scale
        if not self.map.speed.is_magnitude or speed == 0.0:
            return speed
        if direction is Direction.UNSIGNED:
            return abs(speed)
        return {Direction.FORWARD: speed, Direction.BACKWARD: -speed}.get(direction, NAN)

    def steering_of(self, instant: CanFrameSet) -> float:
        """Return the steering angle, radians; 0 for a wheel that does not steer, nan where it is not measured."""
        if self.map.steering is None:
            return NAN if self.map.steers else 0.0
        physical = instant.physical(self.steering)
        return NAN if physical is None else physical * self.map.steering.scale + self.map.steering.offset


def bind_wheels(
    wheels: Mapping[str, WheelMap], database: CanDatabase, place: str, max_speed: float = 0.0, delay: float = 0.0
) -> tuple[BoundWheel, ...]:
    """Return the wheels with their signals. Raises ConfigError with every signal that is not in the DBC or unfit.

    `place` is where the mapping stands in the settings. Counters that are too small to be followed at `max_speed`, m/s,
    with frames held up by `delay`, seconds, are unfit.
    """
    binder = Binder(database, place)
    bound = []
    for name, wheel in wheels.items():
        count = binder.signal(wheel.count.signal, f"{name}.count", whole=True) if wheel.count else None
        speed = binder.signal(wheel.speed.signal, f"{name}.speed") if wheel.speed else None
        direction = binder.signal(wheel.direction.signal, f"{name}.direction", whole=True) if wheel.direction else None
        steering = binder.signal(wheel.steering.signal, f"{name}.steering") if wheel.steering else None
        if count is not None and wheel.count is not None:
            _check_count(binder, name, wheel.count.wrap, count)
        if speed is not None and wheel.speed is not None:
            _check_speed(binder, name, wheel.speed, speed)
        bound.append(BoundWheel(name, wheel, count, speed, direction, steering))
        odometer = bound[-1].odometer(max_speed, delay)
        if odometer is not None:
            _check_reach(binder, name, odometer)
    binder.finish()
    return tuple(bound)


def _check_count(binder: Binder, name: str, wrap: int, count: BoundSignal) -> None:
    path = f"{count.message}.{count.name}"
    if count.length < 2:
        binder.problem(f"{name}.count", f"{path} has {count.length} bit; a counter has two or more", "map the counter")
    elif wrap > 1 << count.length:
        fix = "leave wrap out, or write what the counter wraps at"
        binder.problem(f"{name}.count.wrap", f"{wrap} does not fit into the {count.length} bits of {path}", fix)


def _check_speed(binder: Binder, name: str, speed: SpeedMap, signal: BoundSignal) -> None:
    path = f"{signal.message}.{signal.name}"
    if speed.is_magnitude and signal.minimum is not None and signal.minimum < 0.0:
        fix = "leave is_magnitude out: the signal has a sign of its own"
        binder.problem(f"{name}.speed.is_magnitude", f"{path} goes down to {signal.minimum:g}", fix)


def _check_reach(binder: Binder, name: str, odometer: Odometer) -> None:
    if odometer.reach(0.0) < odometer.turn:
        return
    way = max(0.0, odometer.turn - 1.0) * abs(odometer.metres_per_count)
    fix = f"frame_delay below {way / odometer.max_speed:.3g} s"
    if odometer.delay:
        fix += f", or max_speed below {way / odometer.delay:.3g} m/s"
    said = (
        f"{odometer.wrap} counts of {abs(odometer.metres_per_count):g} m tell ways up to {way:g} m apart, "
        f"and frames held up by frame_delay {odometer.delay:g} s at max_speed {odometer.max_speed:g} m/s are "
        f"{odometer.max_speed * odometer.delay:g} m: no travel would be believed"
    )
    binder.problem(f"{name}.count", said, f"{fix}; the time between two frames comes on top")
