"""The driver of wheel encoders on a CAN bus: which frames and signals they are stands in a DBC file and a mapping."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from modelserver.errors import shown
from modelserver.messages import NAN, Direction, SensorHeader, WheelSample, WheelsSample
from msdrivers.devices.can_watch import CanWatch, arrival
from msdrivers.protocol.can.assembly import CanFrameAssembler, CanFrameSet
from msdrivers.protocol.can.database import CanDatabase, FrameError
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.can.mapping import STRICT, WheelMap
from msdrivers.protocol.can.wheels import BoundWheel, bind_wheels
from msdrivers.station import Measured, Now, Output, StationStatus

MAX_WHEELS = 64


@dataclass(frozen=True, slots=True)
class WheelsSettings:
    """How to read the wheels. Raises ValueError for what cannot be, naming the key."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    source: str
    """Name that the samples give as theirs."""
    dbc: str
    """Path of the DBC file, relative to the file that holds these settings."""
    wheels: Mapping[str, WheelMap]
    """What the bus tells of each wheel, by the wheel's name as `sensors.wheels.frames` has it."""
    max_speed: float = 15.0
    """What no wheel of this vehicle exceeds, m/s: faster counts and speeds are taken for damage."""
    frame_delay: float = 0.1
    """Seconds by which frames may be held up on their way to this driver before counts look like a jump."""
    window: float = 0.004
    """Seconds to wait for the other frames of an instant; shorter than the time between two instants."""
    silence: float = 1.0
    """Seconds without a usable frame after which the driver says so."""
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
                raise ValueError(f"wheels names wheels with 1 to 64 printable characters, got {shown(name)}")
        for key, value, low, high in (
            ("max_speed", self.max_speed, 0.1, 200.0),
            ("frame_delay", self.frame_delay, 0.0, 10.0),
            ("window", self.window, 0.0, 1.0),
            ("silence", self.silence, 0.05, 3600.0),
            ("delay", self.delay, 0.0, 5.0),
            ("delay_sigma", self.delay_sigma, 0.0, 5.0),
        ):
            if not low <= value <= high:
                raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")


class WheelsDriver:
    """A `Station` of CAN frames; see `WheelsSettings`.

    A sample holds what came at one instant. What did not come, or what no wheel can do, is not measured in it: nan,
    UNKNOWN. Counts that do not follow from those before give one sample or more without travel, after which travel
    goes on from where it was: a difference of travel across such a sample misses the way rolled unseen.
    """

    def __init__(self, settings: WheelsSettings, database: CanDatabase):
        """Take the settings and the DBC file's content. Raises ConfigError for signals that it does not have."""
        self.settings = settings
        self._database = database
        place = f"drivers.{settings.source}.wheels"
        self._wheels = bind_wheels(settings.wheels, database, place, settings.max_speed, settings.frame_delay)
        needed = {signal.key: signal.message for wheel in self._wheels for signal in wheel.signals}
        self._counts: Counter[str] = Counter()
        self._watch = CanWatch(needed, settings.silence, self._counts)
        self._needed = frozenset(needed)
        self._assembler = CanFrameAssembler(self._needed, round(settings.window * 1e9))
        odometers = {wheel.name: wheel.odometer(settings.max_speed, settings.frame_delay) for wheel in self._wheels}
        self._odometers = {name: odometer for name, odometer in odometers.items() if odometer is not None}
        self._told: set[str] = set()
        self._seq = 0

    def opened(self, now: Now) -> list[Output[CanFrame]]:
        """Begin: what was half received is forgotten; travel goes on, since the counters may have."""
        self._assembler.clear()
        self._told.clear()
        return self._watch.opened(now)

    def received(self, unit: CanFrame, now: Now) -> list[Output[CanFrame]]:
        """Take a frame."""
        if unit.is_error:
            return self._watch.error_frame(unit)
        if unit.key not in self._needed:
            self._watch.other(unit)
            return []
        try:
            values = self._database.decode(unit)
        except FrameError as error:
            return self._watch.wrong(unit, error)
        self._counts["frames"] += 1
        came = arrival(unit, now)
        return self._published(self._assembler.add(unit.key, values, came.monotonic_ns, came.utime), now)

    def woken(self, now: Now) -> list[Output[CanFrame]]:
        """Publish what has waited long enough, or tell silence."""
        outputs = self._published(self._assembler.expired(now.monotonic_ns), now)
        return outputs + self._watch.woken(now)

    def due(self) -> int | None:
        """Return when to be woken."""
        return min((due for due in (self._assembler.due(), self._watch.due()) if due is not None), default=None)

    def leaving(self, now: Now) -> list[Output[CanFrame]]:
        """Leave; this driver sends nothing."""
        return []

    @property
    def quiet(self) -> float:
        """Seconds for which nothing need come."""
        return self.settings.silence

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames, samples, incomplete ones, silences, and what was rejected by reason."""
        return self._counts

    def _published(self, instants: list[CanFrameSet], now: Now) -> list[Output[CanFrame]]:
        outputs: list[Output[CanFrame]] = []
        for instant in instants:
            told: list[Output[CanFrame]] = []
            wheels = tuple(self._wheel(wheel, instant, told) for wheel in self._wheels)
            self._counts["incomplete"] += not instant.is_complete
            if all(_says_nothing(wheel) for wheel in wheels):
                self._counts["rejected.empty"] += 1
                outputs += told
                continue
            header = SensorHeader(instant.utime, self.settings.source, self._seq, instant.utime)
            self._seq += 1
            self._counts["samples"] += 1
            outputs += self._watch.usable(now, f"{len(wheels)} wheels are heard")
            outputs.append(Measured(WheelsSample(header, wheels), self.settings.delay, self.settings.delay_sigma))
            outputs += told
        return outputs

    def _wheel(self, wheel: BoundWheel, instant: CanFrameSet, told: list[Output[CanFrame]]) -> WheelSample:
        direction = wheel.turning(instant)
        travel = travel_sigma = speed_sigma = NAN
        raw = instant.raw(wheel.count)
        if raw is not None and wheel.map.count is not None:
            sign = _SIGNS.get(direction)
            odometer = self._odometers[wheel.name]
            self._odometers[wheel.name], travel, reason = odometer.taken(raw, instant.monotonic_ns, sign)
            if reason:
                self._doubt(wheel.name, reason, told)
            if travel == travel:
                # the count is the way rounded to whole counts
                travel_sigma = abs(wheel.map.count.metres_per_count) / math.sqrt(12.0)
        speed = wheel.speed_of(instant, direction)
        if abs(speed) > self.settings.max_speed:
            self._doubt(wheel.name, "speed", told)
            speed = NAN
        if speed == speed and wheel.map.speed is not None:
            speed_sigma = wheel.map.speed.sigma or NAN
        steering = wheel.steering_of(instant)
        return WheelSample(wheel.name, travel, travel_sigma, speed, speed_sigma, direction, steering)

    def _doubt(self, name: str, reason: str, told: list[Output[CanFrame]]) -> None:
        key = reason if reason == "resumed" else f"rejected.{reason}"
        self._counts[key] += 1
        if f"{name} {reason}" in self._told:
            return
        self._told.add(f"{name} {reason}")
        text = f"wheel {name}: {_DOUBTS[reason].format(self.settings.max_speed)}"
        told.append(StationStatus(self._watch.phase, text, is_trouble=reason != "resumed"))


_DOUBTS = {
    "range": "a count beyond its wrap; is `wrap` right?",
    "jump": "a count that no wheel of at most {:g} m/s can have come to; is metres_per_count right, is the cable "
    "sound? That sample says no travel",
    "gap": "no count for so long that the counter may have gone round, at {:g} m/s and `frame_delay`; one sample says "
    "no travel",
    "direction": "counts up only and does not say which way; that sample says no travel",
    "resumed": "its counts are believed again; travel goes on from where it was, without what was rolled unseen",
    "speed": "a speed above {:g} m/s, which this vehicle does not reach; is scale right? It is not published",
}


def _says_nothing(wheel: WheelSample) -> bool:
    return wheel.travel != wheel.travel and wheel.speed != wheel.speed and wheel.direction not in _TURNS


_TURNS = frozenset((Direction.BACKWARD, Direction.STOPPED, Direction.FORWARD))

_SIGNS = {**{turn: int(turn) for turn in _TURNS}, Direction.UNSIGNED: 1}
"""What a counter that counts up only is multiplied by."""
