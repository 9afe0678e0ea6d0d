"""Wheels: the mapping bound to the signals of a DBC file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from modelserver.messages import NAN, Direction
from msdrivers.protocol.can.database import BoundSignal, CanDatabase, CanFrameSet, SignalBinder
from msdrivers.protocol.can.mapping import SpeedMap, WheelMap
from msdrivers.protocol.can.odometer import Odometer


@dataclass(frozen=True, slots=True)
class BoundWheel:
    """Mapping and signals of one wheel; None for a signal that is not mapped."""

    name: str
    map: WheelMap
    count: BoundSignal | None
    speed: BoundSignal | None
    direction: BoundSignal | None
    steering: BoundSignal | None

    @property
    def signals(self) -> list[BoundSignal]:
        return [each for each in (self.count, self.speed, self.direction, self.steering) if each is not None]

    def make_odometer(self, max_speed: float, delay: float) -> Odometer | None:
        """Make the initial odometer of the counter, m/s and seconds; None for a wheel without a counter."""
        if self.count is None or self.map.count is None:
            return None
        wrap = self.map.count.wrap or 1 << self.count.length
        return Odometer(wrap, self.map.count.meters_per_count, max_speed, delay, self.map.count.counts_up_only)

    def get_direction(self, instant: CanFrameSet) -> Direction:
        """Return the direction of rotation that the encoder reports."""
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
        """Return the speed, m/s, forward positive (UNSIGNED: its magnitude); nan if it or its sign is missing."""
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
        """Return the steering angle, radians; 0 for a wheel that does not steer, nan if not measured."""
        if self.map.steering is None:
            return NAN if self.map.is_steered else 0.0
        physical = instant.physical(self.steering)
        return NAN if physical is None else self.map.steering.to_si(physical)


def bind_wheels(
    wheels: Mapping[str, WheelMap], database: CanDatabase, place: str, max_speed: float = 0.0, delay: float = 0.0
) -> tuple[BoundWheel, ...]:
    """Bind the wheel mappings. Raises ConfigError with every unknown or unsuitable signal.

    `place` is the mapping's key path in the settings. A counter whose wrap is ambiguous at `max_speed`, m/s, with
    frames delayed by `delay`, seconds, is unsuitable.
    """
    binder = SignalBinder(database, place)
    bound = []
    for name, wheel in wheels.items():
        parts = (
            ("count", wheel.count),
            ("speed", wheel.speed),
            ("direction", wheel.direction),
            ("steering", wheel.steering),
        )
        count, speed, direction, steering = (
            binder.bind_signal(part.signal, f"{name}.{key}", whole=key in ("count", "direction")) if part else None
            for key, part in parts
        )
        if count is not None and wheel.count is not None:
            _check_count(binder, name, wheel.count.wrap, count)
        if speed is not None and wheel.speed is not None:
            _check_speed(binder, name, wheel.speed, speed)
        bound.append(BoundWheel(name, wheel, count, speed, direction, steering))
        odometer = bound[-1].make_odometer(max_speed, delay)
        if odometer is not None:
            _check_ambiguity(binder, name, odometer)
    binder.finish()
    return tuple(bound)


def _check_count(binder: SignalBinder, name: str, wrap: int, count: BoundSignal) -> None:
    path = f"{count.message}.{count.name}"
    if count.length < 2:
        binder.add_problem(
            f"{name}.count", f"{path} has {count.length} bit; a counter has two or more", "map the counter"
        )
    elif wrap > 1 << count.length:
        fix = "leave wrap out, or write what the counter wraps at"
        binder.add_problem(f"{name}.count.wrap", f"{wrap} does not fit into the {count.length} bits of {path}", fix)


def _check_speed(binder: SignalBinder, name: str, speed: SpeedMap, signal: BoundSignal) -> None:
    path = f"{signal.message}.{signal.name}"
    if speed.is_magnitude and -math.inf < signal.minimum < 0.0:
        fix = "leave is_magnitude out: the signal has a sign of its own"
        binder.add_problem(f"{name}.speed.is_magnitude", f"{path} goes down to {signal.minimum:g}", fix)


def _check_ambiguity(binder: SignalBinder, name: str, odometer: Odometer) -> None:
    if odometer.max_step(0.0) < odometer.ambiguity:
        return
    distance = max(0.0, odometer.ambiguity - 1.0) * abs(odometer.meters_per_count)
    fix = f"frame_delay below {distance / odometer.max_speed:.3g} s"
    if odometer.delay:
        fix += f", or max_speed below {distance / odometer.delay:.3g} m/s"
    message = (
        f"{odometer.wrap} counts of {abs(odometer.meters_per_count):g} m are unambiguous up to {distance:g} m, and a "
        f"frame_delay of {odometer.delay:g} s at max_speed {odometer.max_speed:g} m/s is "
        f"{odometer.max_speed * odometer.delay:g} m: no travel would be accepted"
    )
    binder.add_problem(f"{name}.count", message, f"{fix}; the time between two frames comes on top")
