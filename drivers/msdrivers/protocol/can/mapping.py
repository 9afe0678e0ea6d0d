"""Which signal of a DBC file is what: the part of the settings that another vehicle writes instead of code.

A signal is named `Message.Signal` as in the DBC. Its value is the DBC's physical one, with the DBC's own scale and
offset; `scale` here brings it to SI units and our signs, e.g. 0.2778 for km/h, -1 for a sign that is the other way.
Values beyond the range that the DBC gives count as not said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


def check_signal(signal: str, key: str = "signal") -> None:
    """Raise ValueError for a text that names no signal."""
    message, dot, name = signal.partition(".")
    if not (message and dot and name) or "." in name:
        raise ValueError(f"{key} is written Message.Signal as the DBC file names them, got {signal!r}")


def check_factor(value: float, key: str) -> None:
    """Raise ValueError for a factor that makes every value 0 or none."""
    if not math.isfinite(value) or value == 0.0:
        raise ValueError(f"{key} is a number and not 0, got {value:g}")


@dataclass(frozen=True, slots=True)
class SignalMap:
    """A number: `signal` times `scale` plus `offset`, in SI units and radians."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    signal: str
    """Message.Signal in the DBC file."""
    scale: float = 1.0
    """What the signal's physical value is multiplied by."""
    offset: float = 0.0
    """What is added afterwards."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.scale, "scale")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset is a number, got {self.offset:g}")


@dataclass(frozen=True, slots=True)
class CountMap:
    """A counter of an encoder's edges. It counts up and down, and wraps."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    signal: str
    """Message.Signal in the DBC file. Its bits are read without the DBC's scale, since they are what wraps."""
    metres_per_count: float
    """Way of the wheel's contact point from one count to the next, metres: circumference by edges of a turn; negative
    for an encoder that counts down when the wheel rolls forward."""
    wrap: int = 0
    """The counter goes from wrap - 1 to 0; 0: as many as its bits hold."""
    up_only: bool = False
    """The encoder counts up whichever way the wheel turns; the sign is the direction signal's, or not known."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.metres_per_count, "metres_per_count")
        if self.wrap and not 4 <= self.wrap <= 1 << 64:
            raise ValueError(f"wrap is 0 (by the signal's bits) or 4 to 2^64, got {self.wrap}")


@dataclass(frozen=True, slots=True)
class SpeedMap:
    """The speed of a wheel's contact point."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    signal: str
    """Message.Signal in the DBC file."""
    scale: float = 1.0
    """m/s for each unit of the signal: 0.2778 for km/h, the wheel's radius for rad/s."""
    is_magnitude: bool = False
    """The signal has no sign, as from a frequency-to-voltage divider; it comes from the direction signal, or is not
    known."""
    sigma: float = 0.0
    """Standard deviation, m/s; 0: not known."""

    def __post_init__(self) -> None:
        check_signal(self.signal)
        check_factor(self.scale, "scale")
        if not 0.0 <= self.sigma < math.inf:
            raise ValueError(f"sigma is not negative, got {self.sigma:g}")


@dataclass(frozen=True, slots=True)
class DirectionMap:
    """Which way a wheel turns: the numbers that the signal has for each. Any other number tells nothing."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

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
class WheelMap:
    """What the bus tells of one wheel. What is left out is published as not measured."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    count: CountMap | None = None
    """Where its travel comes from."""
    speed: SpeedMap | None = None
    """Where its speed comes from."""
    direction: DirectionMap | None = None
    """Where the direction of turning comes from."""
    steers: bool = False
    """The wheel turns about the vehicle's up axis: its steering angle is published as not measured, or as `steering`
    tells, and not as 0."""
    steering: SignalMap | None = None
    """Where its steering angle comes from; radians, to the left positive."""

    def __post_init__(self) -> None:
        if self.count is None and self.speed is None:
            raise ValueError("count or speed is needed: of a wheel of which neither is told nothing can be said")
        signs = self._signs()
        if self.direction is None and len(set(signs.values())) > 1:
            without = next(key for key, has_sign in signs.items() if not has_sign)
            raise ValueError(f"direction is needed with {without}: the other signal of the wheel has a sign")

    def _signs(self) -> dict[str, bool]:
        """Return for each mapped signal, by its key, whether it has a sign of its own."""
        signs = {}
        if self.count is not None:
            signs["count.up_only"] = not self.count.up_only
        if self.speed is not None:
            signs["speed.is_magnitude"] = not self.speed.is_magnitude
        return signs

    @property
    def is_unsigned(self) -> bool:
        """Whether nothing says which way the wheel turns."""
        return self.direction is None and not any(self._signs().values())


@dataclass(frozen=True, slots=True)
class StatusMap:
    """What the bus tells of the vehicle controller. What is left out is published as not said."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    mode: str = ""
    """Message.Signal that tells who drives; empty: the controller does not say."""
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
    commands_refused: str = ""
    """Message.Signal of the controller's own count of commands that it refused."""

    def __post_init__(self) -> None:
        for key in ("mode", "fault_bits", "commands_refused"):
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
class CommandMap:
    """How a command is said to the vehicle controller."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    forward_speed: SignalMap
    """m/s, forward positive, is `scale` times the signal plus `offset`."""
    steering_angle: SignalMap
    """Radians, to the left positive; a signal of the same message."""
    alive: str = ""
    """Message.Signal that counts the frames and wraps by its bits; empty: there is none."""
    driving: Mapping[str, float] = field(default_factory=dict)
    """Signals of the message that stand beside a command, by name without the message, in physical units: an enable
    bit, a gear."""
    stopping: Mapping[str, float] = field(default_factory=dict)
    """The same beside the command to stop; what is left out is as in `driving`."""

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
