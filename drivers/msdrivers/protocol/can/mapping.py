"""Mapping of a DBC file's signals to measurements and commands: what another vehicle configures instead of coding.

A signal is named `Message.Signal` as in the DBC. Its value is the DBC's physical one, with the DBC's own scale and
offset; `scale` here brings it to SI units and our signs, e.g. 0.2778 for km/h, -1 for a sign that is the other way.
Values outside the DBC's range count as missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


class Strict:
    """Base of settings that pydantic reads without conversions and without further keys."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, object]] = STRICT


def check_signal(signal: str, key: str = "signal") -> None:
    """Raise ValueError unless the text is a signal path."""
    message, dot, name = signal.partition(".")
    if not (message and dot and name) or "." in name:
        raise ValueError(f"{key} is written Message.Signal as the DBC file names them, got {signal!r}")


def check_factor(value: float, key: str) -> None:
    """Raise ValueError for a factor that is 0 or not finite."""
    if not math.isfinite(value) or value == 0.0:
        raise ValueError(f"{key} is a number and not 0, got {value:g}")


@dataclass(frozen=True, slots=True)
class SignalMap(Strict):
    """A number: `signal` times `scale` plus `offset`, in SI units and radians."""

    signal: str
    """Message.Signal in the DBC file."""
    scale: float = 1.0
    """Factor of the signal's physical value."""
    offset: float = 0.0
    """Offset after scaling."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.scale, "scale")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset is a number, got {self.offset:g}")

    def to_si(self, physical: float) -> float:
        """Return the number in SI units of the signal's physical value."""
        return physical * self.scale + self.offset

    def from_si(self, value: float) -> float:
        """Return the signal's physical value of a number in SI units."""
        return (value - self.offset) / self.scale


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

    def __post_init__(self) -> None:
        check_signal(self.signal)
        if len({self.stopped, self.forward, self.backward}) < 3:
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
class StatusMap(Strict):
    """Signals of the vehicle controller's status; omitted ones are published as missing."""

    mode: str = ""
    """Message.Signal of the driving mode; empty: the controller has none."""
    modes: Mapping[str, int] = field(default_factory=dict)
    """The mode signal's number, without the DBC's scale, for each of manual, autonomous, emergency_stop, fault."""
    forward_speed: SignalMap | None = None
    """m/s, forward positive."""
    steering_angle: SignalMap | None = None
    """Radians, to the left positive."""
    supply_voltage: SignalMap | None = None
    """Volts."""
    engine_speed: SignalMap | None = None
    """rad/s; scale 0.10472 for revolutions a minute."""
    fault_bits: str = ""
    """Message.Signal of the controller's fault word, at most 32 bits."""
    commands_rejected: str = ""
    """Message.Signal of the controller's count of rejected commands."""

    def __post_init__(self) -> None:
        for key in ("mode", "fault_bits", "commands_rejected"):
            if getattr(self, key):
                check_signal(getattr(self, key), key)
        known = ("manual", "autonomous", "emergency_stop", "fault")
        for name in self.modes:
            if name not in known:
                raise ValueError(f"modes knows {', '.join(known)}, got {name!r}")
        if bool(self.mode) != bool(self.modes):
            raise ValueError("mode and modes are given together: the signal, and its number for each mode")
        if len(set(self.modes.values())) < len(self.modes):
            raise ValueError("modes has a number of its own for each mode")


@dataclass(frozen=True, slots=True)
class CommandMap(Strict):
    """Signals of a command to the vehicle controller."""

    forward_speed: SignalMap
    """m/s, forward positive, is `scale` times the signal plus `offset`."""
    steering_angle: SignalMap
    """Radians, to the left positive; a signal of the same message."""
    alive: str = ""
    """Message.Signal of the alive counter, which wraps by its bits; empty: none."""
    drive_signals: Mapping[str, float] = field(default_factory=dict)
    """Other signals of the message while driving, by name without the message, in physical units: an enable bit, a
    gear."""
    stop_signals: Mapping[str, float] = field(default_factory=dict)
    """The same in the stop command; omitted ones are as in `drive_signals`."""

    def __post_init__(self) -> None:
        message = self.message
        others = [self.steering_angle.signal, *([self.alive] if self.alive else [])]
        if self.alive:
            check_signal(self.alive, "alive")
        for other in others:
            if other.partition(".")[0] != message:
                raise ValueError(f"a command is one message, {message}; {other} is of another")

    @property
    def message(self) -> str:
        """Name of the message in the DBC file."""
        return self.forward_speed.signal.partition(".")[0]
