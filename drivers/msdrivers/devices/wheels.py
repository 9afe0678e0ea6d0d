"""Wheel encoders on a CAN bus: their mapping to the signals of a DBC file, the odometer, and the driver.

Odometer: signed travel of a wheel from its encoder counter: wraps, implausible jumps, counter resets. A count n at time
t is plausible if a wheel of at most `max_speed` could have reached it from the last plausible one:
|dn| <= max_speed * (dt + delay) / meters_per_count + 1. `delay` covers frames that were held up on the bus: two frames
that arrive together need not have been measured together. dn is unwrapped to the nearest value, which is unambiguous
while the bound is below half of `wrap` (all of it for a counter that only counts up); after a longer gap it is not.

An implausible count becomes the suspect. If the next count is plausible from the suspect, the counter was reset: the
travel continues from where it was, without the distance travelled meanwhile. A reset to a plausible count cannot be
detected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from modelserver.errors import quote
from modelserver.messages import NAN, Direction, WheelSample, WheelsSample
from msdrivers.devices import Strict, check_factor, check_ranges, check_signal
from msdrivers.devices.can import BoundSignal, BusSettings, CanDatabase, CanDriver, CanFrameSet, SignalBinder, SignalMap
from msdrivers.endpoint import CanFrame, HostTime, Output


@dataclass(frozen=True, slots=True)
class CountMap(Strict):
    """Encoder counter that wraps."""

    signal: str
    """Message.Signal in the DBC file; the raw bits are read, since they are what wraps."""
    meters_per_count: float
    """Distance of the wheel's contact point per count, meters: circumference / edges per turn; negative for an
    encoder that counts down when the wheel rolls forward."""
    wrap: int = 0
    """The counter goes from wrap - 1 to 0; 0: 2 to the number of its bits."""
    counts_up_only: bool = False
    """The encoder counts up in both directions; the sign is that of the direction signal, or unknown."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.meters_per_count, "meters_per_count")
        if self.wrap and not 4 <= self.wrap <= 1 << 64:
            raise ValueError(f"wrap is 0 (by the signal's bits) or 4 to 2^64, got {self.wrap}")


@dataclass(frozen=True, slots=True)
class SpeedMap(Strict):
    """Speed of a wheel's contact point."""

    signal: str
    """Message.Signal in the DBC file."""
    scale: float = 1.0
    """m/s per unit of the signal: 0.2778 for km/h, the wheel's radius for rad/s."""
    is_magnitude: bool = False
    """The signal has no sign, e.g. from a frequency-to-voltage converter; the sign is that of the direction signal, or
    unknown."""
    sigma: float = 0.0
    """Standard deviation, m/s; 0: unknown."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.scale, "scale")
        if not 0.0 <= self.sigma < math.inf:
            raise ValueError(f"sigma is not negative, got {self.sigma:g}")


@dataclass(frozen=True, slots=True)
class DirectionMap(Strict):
    """Direction of a wheel's rotation: the signal's number for each; any other number means unknown."""

    signal: str
    """Message.Signal in the DBC file."""
    stopped: int = 0
    """The signal's number, without the DBC's scale, when the wheel does not turn."""
    forward: int = 1
    """The same for a wheel that rolls forward."""
    backward: int = 2
    """The same for a wheel that rolls backward."""

    @property
    def numbers(self) -> dict[Direction, int]:
        return {Direction.STOPPED: self.stopped, Direction.FORWARD: self.forward, Direction.BACKWARD: self.backward}

    def __post_init__(self) -> None:
        check_signal(self.signal)
        if len(set(self.numbers.values())) < 3:
            raise ValueError("stopped, forward and backward have three different numbers")


@dataclass(frozen=True, slots=True)
class WheelMap(Strict):
    """Signals of one wheel; omitted ones are published as not measured."""

    count: CountMap | None = None
    """Source of its travel."""
    speed: SpeedMap | None = None
    """Source of its speed."""
    direction: DirectionMap | None = None
    """Source of its direction of rotation."""
    is_steered: bool = False
    """The wheel steers: its steering angle is published from `steering`, or as not measured, instead of 0."""
    steering: SignalMap | None = None
    """Source of its steering angle; radians, positive to the left."""

    def __post_init__(self) -> None:
        if self.count is None and self.speed is None:
            raise ValueError("count or speed is missing: a wheel needs at least one of them")
        signs = self._get_signs()
        if self.direction is None and len(set(signs.values())) > 1:
            without = next(key for key, has_sign in signs.items() if not has_sign)
            raise ValueError(f"direction is needed with {without}: the other signal of the wheel has a sign")

    def _get_signs(self) -> dict[str, bool]:
        """Return for each mapped signal, by its key, whether it has a sign."""
        signs = {}
        if self.count is not None:
            signs["count.counts_up_only"] = not self.count.counts_up_only
        if self.speed is not None:
            signs["speed.is_magnitude"] = not self.speed.is_magnitude
        return signs

    @property
    def is_unsigned(self) -> bool:
        """Whether no signal gives the direction of rotation."""
        return self.direction is None and not any(self._get_signs().values())


@dataclass(frozen=True, slots=True)
class Odometer:
    """Immutable state of one wheel's odometer; `update` returns the next one. Meters, m/s, seconds."""

    wrap: int
    meters_per_count: float
    max_speed: float
    delay: float
    counts_up_only: bool = False
    travel_counts: int = 0
    """Signed counts since the first one."""
    sign: int = 0
    """Last known direction of a counter that only counts up; 0: unknown."""
    count: int | None = None
    at_ns: int = 0
    suspect: int | None = None
    suspect_ns: int = 0

    def update(self, raw: float, at_ns: int, direction: int | None = None) -> tuple[Odometer, float, str]:
        """Process a count: return the new odometer, the travel in meters, and a reason.

        The travel is nan for the reasons `range`, `jump`, `gap` and `direction`; `resumed` (after a counter reset)
        comes with a travel. `raw`: the counter's raw bits. `at_ns`: time of the count on any clock without jumps.
        `direction`: -1, 0 or 1 as the encoder reports, None if unknown.
        """
        count = int(raw)
        if count < 0:
            count += self.wrap
        if not 0 <= count < self.wrap:
            return self, math.nan, "range"
        sign = direction or self.sign
        if direction is None and self.counts_up_only:
            sign = 0
        after = replace(self, sign=sign) if sign else self
        if self.count is None:
            return replace(after, count=count, at_ns=at_ns), 0.0, ""
        step, is_unambiguous = self._find_step(self.count, self.at_ns, count, at_ns)
        if step is not None:
            return after._advance(step, count, at_ns, sign, "")
        if self.suspect is not None:
            step, _ = self._find_step(self.suspect, self.suspect_ns, count, at_ns)
            if step is not None:
                return after._advance(step, count, at_ns, sign, "resumed")
        return replace(after, suspect=count, suspect_ns=at_ns), math.nan, "jump" if is_unambiguous else "gap"

    def max_step(self, seconds: float) -> float:
        """Return the largest plausible number of counts within a time, including frame delay and rounding."""
        return self.max_speed * (max(0.0, seconds) + self.delay) / abs(self.meters_per_count) + 1.0

    @property
    def ambiguity(self) -> float:
        """Number of counts from which on a step is ambiguous because of the wrap."""
        return self.wrap if self.counts_up_only else self.wrap / 2

    def _advance(self, step: int, count: int, at_ns: int, sign: int, reason: str) -> tuple[Odometer, float, str]:
        known = replace(self, count=count, at_ns=at_ns, suspect=None)
        if self.counts_up_only and step:
            if not sign:
                return known, math.nan, "direction"
            step *= sign
        moved = replace(known, travel_counts=self.travel_counts + step)
        return moved, moved.travel_counts * self.meters_per_count, reason

    def _find_step(self, before: int, before_ns: int, count: int, at_ns: int) -> tuple[int | None, bool]:
        """Return the step between two counts (None: implausible), and whether it is unambiguous."""
        reach = self.max_step((at_ns - before_ns) * 1e-9)
        if reach >= self.ambiguity:
            return None, False
        step = (count - before) % self.wrap
        if not self.counts_up_only and step >= self.wrap / 2:
            step -= self.wrap
        return (step if abs(step) <= reach else None), True


@dataclass(frozen=True, slots=True)
class BoundWheel:
    """Mapping and signals of one wheel: those of count, speed, direction and steering that are mapped."""

    name: str
    map: WheelMap
    signals: Mapping[str, BoundSignal]

    def make_odometer(self, max_speed: float, delay: float) -> Odometer | None:
        """Make the initial odometer of the counter, m/s and seconds; None for a wheel without a counter."""
        if self.map.count is None or "count" not in self.signals:
            return None
        wrap = self.map.count.wrap or 1 << self.signals["count"].length
        return Odometer(wrap, self.map.count.meters_per_count, max_speed, delay, self.map.count.counts_up_only)

    def get_direction(self, instant: CanFrameSet) -> Direction:
        """Return the direction of rotation that the encoder reports."""
        if self.map.is_unsigned:
            return Direction.UNSIGNED
        raw, known = instant.raw(self.signals.get("direction")), self.map.direction
        found = known.numbers.items() if known is not None else ()
        return next((direction for direction, number in found if number == raw), Direction.UNKNOWN)

    def speed_of(self, instant: CanFrameSet, direction: Direction) -> float:
        """Return the speed, m/s, forward positive (UNSIGNED: its magnitude); nan if it or its sign is missing."""
        physical = instant.physical(self.signals.get("speed"))
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
        physical = instant.physical(self.signals.get("steering"))
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
        signals = binder.bind_mapped(wheel, f"{name}.", count=64, speed=0, direction=64, steering=0)
        if wheel.count is not None and "count" in signals:
            _check_count(binder, name, wheel.count.wrap, signals["count"])
        if wheel.speed is not None and "speed" in signals:
            _check_speed(binder, name, wheel.speed, signals["speed"])
        bound.append(BoundWheel(name, wheel, signals))
        odometer = bound[-1].make_odometer(max_speed, delay)
        if odometer is not None:
            _check_ambiguity(binder, name, odometer)
    binder.finish()
    return tuple(bound)


def _check_count(binder: SignalBinder, name: str, wrap: int, count: BoundSignal) -> None:
    if count.length < 2:
        what = f"{count.path} has {count.length} bit; a counter has two or more"
        binder.add_problem(f"{name}.count", what, "map the counter")
    elif wrap > 1 << count.length:
        what = f"{wrap} does not fit into the {count.length} bits of {count.path}"
        binder.add_problem(f"{name}.count.wrap", what, "leave wrap out, or write what the counter wraps at")


def _check_speed(binder: SignalBinder, name: str, speed: SpeedMap, signal: BoundSignal) -> None:
    if speed.is_magnitude and -math.inf < signal.minimum < 0.0:
        fix = "leave is_magnitude out: the signal has a sign of its own"
        binder.add_problem(f"{name}.speed.is_magnitude", f"{signal.path} goes down to {signal.minimum:g}", fix)


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


MAX_WHEELS = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelsSettings(BusSettings):
    """Settings of the wheels. Raises ValueError with the key for an invalid value."""

    wheels: Mapping[str, WheelMap]
    """Signals of each wheel, by its name in `sensors.wheels.frames`."""
    max_speed: float = 15.0
    """Largest speed of a wheel, m/s; faster counts and speeds are rejected."""
    frame_delay: float = 0.1
    """Largest delay of a frame on the bus, seconds; tolerated in the plausibility check of counts."""
    window: float = 0.004
    """Seconds to wait for the other frames of an instant; shorter than the time between two instants."""

    def __post_init__(self) -> None:
        BusSettings.__post_init__(self)
        if not 1 <= len(self.wheels) <= MAX_WHEELS:
            raise ValueError(f"wheels has 1 to {MAX_WHEELS} wheels, got {len(self.wheels)}")
        for name in self.wheels:
            if not (0 < len(name) <= 64 and name.isprintable()):
                raise ValueError(f"wheels names wheels with 1 to 64 printable characters, got {quote(name)}")
        check_ranges(self, max_speed=(0.1, 200.0), frame_delay=(0.0, 10.0))


class WheelsDriver(CanDriver):
    """An `Endpoint` of CAN frames; see `WheelsSettings`.

    A sample holds the frames of one instant; missing and implausible values are nan, a missing direction UNKNOWN. After
    an implausible count or a counter reset one sample or more has no travel; then the travel continues from where it
    was, without the distance travelled meanwhile (see `odometer`). The odometers continue when the line was opened
    again, since the counters may have.
    """

    settings: WheelsSettings

    def __init__(self, settings: WheelsSettings, database: CanDatabase):
        """Bind the signals. Raises ConfigError for unknown or unsuitable ones."""
        place = f"drivers.{settings.source}.wheels"
        self._wheels = bind_wheels(settings.wheels, database, place, settings.max_speed, settings.frame_delay)
        super().__init__(database, (signal for wheel in self._wheels for signal in wheel.signals.values()), settings)
        odometers = {
            wheel.name: wheel.make_odometer(settings.max_speed, settings.frame_delay) for wheel in self._wheels
        }
        self._odometers = {name: odometer for name, odometer in odometers.items() if odometer is not None}
        measured = ("count", "speed", "steering")
        self._measured = [wheel.signals[key] for wheel in self._wheels for key in measured if key in wheel.signals]

    def _publish_instant(self, instant: CanFrameSet, now: HostTime) -> list[Output[CanFrame]]:
        warnings = self._check_values(self._measured, instant)
        wheels = tuple(self._make_wheel_sample(wheel, instant, warnings) for wheel in self._wheels)
        if all(w.travel != w.travel and w.speed != w.speed and w.direction >= Direction.UNKNOWN for w in wheels):
            self._note_empty()
            return warnings
        sample = WheelsSample(self._make_header(instant), wheels)
        return [*self._publish_sample(sample, f"{len(wheels)} wheels received", now), *warnings]

    def _make_wheel_sample(
        self, wheel: BoundWheel, instant: CanFrameSet, warnings: list[Output[CanFrame]]
    ) -> WheelSample:
        direction = wheel.get_direction(instant)
        travel = travel_sigma = speed_sigma = NAN
        count = wheel.signals.get("count")
        raw = instant.raw(count)
        if raw is not None and count is not None and wheel.map.count and not count.find_reserved(raw):
            odometer, sign = self._odometers[wheel.name], _SIGNS.get(direction)
            self._odometers[wheel.name], travel, reason = odometer.update(raw, instant.monotonic_ns, sign)
            if reason:
                self._warn(wheel.name, reason, warnings)
            if travel == travel:
                # the travel is rounded to whole counts
                travel_sigma = abs(wheel.map.count.meters_per_count) / math.sqrt(12.0)
        speed = wheel.speed_of(instant, direction)
        if abs(speed) > self.settings.max_speed:
            self._warn(wheel.name, "speed", warnings)
            speed = NAN
        if speed == speed and wheel.map.speed is not None:
            speed_sigma = wheel.map.speed.sigma or NAN
        steering = wheel.steering_of(instant)
        return WheelSample(wheel.name, travel, travel_sigma, speed, speed_sigma, direction, steering)

    def _warn(self, name: str, reason: str, warnings: list[Output[CanFrame]]) -> None:
        key = reason if reason == "resumed" else f"rejected.{reason}"
        self.counts[key] += 1
        self._reasons[reason] = None
        text = f"wheel {name}: {_WARNINGS[reason].format(self.settings.max_speed)}"
        warnings += self._report_once(("wheel", name, reason), text, is_warning=reason != "resumed")


_WARNINGS = {
    "range": "a count above its wrap; is `wrap` right?",
    "jump": "a count that no wheel of at most {:g} m/s can have reached; is meters_per_count right, is the cable "
    "sound? that sample has no travel",
    "gap": "no count for so long that the counter may have wrapped, at {:g} m/s and `frame_delay`; one sample has "
    "no travel",
    "direction": "counts up only without a direction; that sample has no travel",
    "resumed": "its counts are plausible again; travel continues from where it was, without the distance meanwhile",
    "speed": "a speed above {:g} m/s, which this vehicle does not reach; is scale right? It is not published",
}


_SIGNS = {Direction.BACKWARD: -1, Direction.STOPPED: 0, Direction.FORWARD: 1, Direction.UNSIGNED: 1}
"""Sign of the step of a counter that only counts up."""
