"""Driver of wheel encoders on a CAN bus; a DBC file and a mapping define the frames and signals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from modelserver.errors import quote
from modelserver.messages import NAN, Direction, SensorHeader, WheelSample, WheelsSample
from msdrivers.devices.can_driver import CanDriver
from msdrivers.devices.ranges import check_ranges
from msdrivers.endpoint import EndpointStatus, HostTime, MeasuredSample, Output
from msdrivers.protocol.can.database import CanDatabase, CanFrameSet
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import STRICT, WheelMap
from msdrivers.protocol.can.wheels import BoundWheel, bind_wheels

MAX_WHEELS = 64


@dataclass(frozen=True, slots=True)
class WheelsSettings:
    """Settings of the wheels. Raises ValueError with the key for an invalid value."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    source: str
    """Source of the samples."""
    dbc: str
    """Path of the DBC file, relative to the file that holds these settings."""
    wheels: Mapping[str, WheelMap]
    """Signals of each wheel, by its name in `sensors.wheels.frames`."""
    max_speed: float = 15.0
    """Largest speed of a wheel, m/s; faster counts and speeds are rejected."""
    frame_delay: float = 0.1
    """Largest delay of a frame on the bus, seconds; tolerated in the plausibility check of counts."""
    window: float = 0.004
    """Seconds to wait for the other frames of an instant; shorter than the time between two instants."""
    silence: float = 1.0
    """Timeout for usable frames, seconds."""
    delay: float = 0.0
    """Seconds from the measurement to the frame's arrival, as far as known."""
    delay_sigma: float = 0.0
    """Standard deviation of `delay`, seconds."""

    def __post_init__(self) -> None:
        if not self.dbc:
            raise ValueError("dbc is the path of a DBC file, got nothing")
        if not 1 <= len(self.wheels) <= MAX_WHEELS:
            raise ValueError(f"wheels has 1 to {MAX_WHEELS} wheels, got {len(self.wheels)}")
        for name in self.wheels:
            if not (0 < len(name) <= 64 and name.isprintable()):
                raise ValueError(f"wheels names wheels with 1 to 64 printable characters, got {quote(name)}")
        check_ranges(self, max_speed=(0.1, 200.0), frame_delay=(0.0, 10.0))
        check_ranges(self, window=(0.0, 1.0), silence=(0.05, 3600.0), delay=(0.0, 5.0), delay_sigma=(0.0, 5.0))


class WheelsDriver(CanDriver):
    """An `Endpoint` of CAN frames; see `WheelsSettings`.

    A sample holds the frames of one instant; missing and implausible values are nan, a missing direction UNKNOWN. After
    an implausible count or a counter reset one sample or more has no travel; then the travel continues from where it
    was, without the distance travelled meanwhile (see `odometer`).
    """

    def __init__(self, settings: WheelsSettings, database: CanDatabase):
        """Bind the signals. Raises ConfigError for unknown or unsuitable ones."""
        self.settings = settings
        self.max_silence = settings.silence
        place = f"drivers.{settings.source}.wheels"
        self._wheels = bind_wheels(settings.wheels, database, place, settings.max_speed, settings.frame_delay)
        signals = (signal for wheel in self._wheels for signal in wheel.signals)
        needed = {signal.key: signal.message for signal in signals}
        super().__init__(database, needed, settings.silence, settings.window)
        odometers = {
            wheel.name: wheel.make_odometer(settings.max_speed, settings.frame_delay) for wheel in self._wheels
        }
        self._odometers = {name: odometer for name, odometer in odometers.items() if odometer is not None}
        self._measured = [signal for wheel in self._wheels for signal in (wheel.count, wheel.speed, wheel.steering)]
        self._warned: set[str] = set()

    def on_open(self, now: HostTime) -> list[Output[CanFrame]]:
        """Start; the odometers continue, since the counters may have."""
        self._warned.clear()
        return super().on_open(now)

    def _publish(self, instants: list[CanFrameSet], now: HostTime) -> list[Output[CanFrame]]:
        outputs: list[Output[CanFrame]] = []
        for instant in instants:
            warnings = self._check_values(self._measured, instant)
            wheels = tuple(self._make_wheel_sample(wheel, instant, warnings) for wheel in self._wheels)
            self.counts["incomplete"] += not instant.is_complete
            if all(_is_empty(wheel) for wheel in wheels):
                self._note_empty()
                outputs += warnings
                continue
            header = SensorHeader(instant.utime, self.settings.source, self._seq, instant.utime)
            self._seq += 1
            self.counts["samples"] += 1
            outputs += self._on_usable(now, f"{len(wheels)} wheels received")
            outputs.append(MeasuredSample(WheelsSample(header, wheels), self.settings.delay, self.settings.delay_sigma))
            outputs += warnings
        return outputs

    def _make_wheel_sample(
        self, wheel: BoundWheel, instant: CanFrameSet, warnings: list[Output[CanFrame]]
    ) -> WheelSample:
        direction = wheel.get_direction(instant)
        travel = travel_sigma = speed_sigma = NAN
        raw = instant.raw(wheel.count)
        if raw is not None and wheel.count is not None and wheel.map.count and not wheel.count.find_reserved(raw):
            sign = _SIGNS.get(direction)
            odometer = self._odometers[wheel.name]
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
        if f"{name} {reason}" in self._warned:
            return
        self._warned.add(f"{name} {reason}")
        text = f"wheel {name}: {_WARNINGS[reason].format(self.settings.max_speed)}"
        warnings.append(EndpointStatus(self.phase, text, is_warning=reason != "resumed"))


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


def _is_empty(wheel: WheelSample) -> bool:
    return wheel.travel != wheel.travel and wheel.speed != wheel.speed and wheel.direction not in _KNOWN_DIRECTIONS


_KNOWN_DIRECTIONS = frozenset((Direction.BACKWARD, Direction.STOPPED, Direction.FORWARD))

_SIGNS = {**{turn: int(turn) for turn in _KNOWN_DIRECTIONS}, Direction.UNSIGNED: 1}
"""Sign of the step of a counter that only counts up."""
