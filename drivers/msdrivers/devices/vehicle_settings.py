"""Settings of the driver of the vehicle controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from msdrivers.protocol.can.mapping import STRICT, CommandMap, StatusMap


@dataclass(frozen=True, slots=True)
class CommandLimits:
    """Limits of commands; 0 forbids the motion."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    forward_speed: float = 2.0
    """Highest speed forward, m/s."""
    reverse_speed: float = 1.0
    """Highest speed backward, m/s, as a positive number."""
    steering_angle: float = 0.5
    """Greatest steering angle to either side, radians."""
    over_limit: Literal["clamp", "reject"] = "clamp"
    """What happens to a command above a limit: clamp it, or reject it."""

    def __post_init__(self) -> None:
        for key, value, high in (
            ("forward_speed", self.forward_speed, 100.0),
            ("reverse_speed", self.reverse_speed, 100.0),
            ("steering_angle", self.steering_angle, 1.6),
        ):
            if not 0.0 <= value <= high:
                raise ValueError(f"{key} is between 0 and {high:g}, got {value:g}")
        if self.over_limit not in ("clamp", "reject"):
            raise ValueError(f"over_limit is clamp or reject, got {self.over_limit!r}")


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """Settings of the vehicle controller. Raises ValueError with the key for an invalid value."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    source: str
    """Source of the samples."""
    dbc: str
    """Path of the DBC file, relative to the file that holds these settings."""
    status: StatusMap | None = None
    """Signals of the status; None: nothing is published."""
    command: CommandMap | None = None
    """Signals of the command; None: the vehicle is not commanded."""
    limits: CommandLimits = CommandLimits()
    """Limits of commands."""
    commander: str = ""
    """The only source whose commands are accepted; empty: any, but one at a time."""
    dead_man: float = 0.5
    """Dead-man timeout: seconds after its arrival until a command expires and stop is sent."""
    max_validity: float = 1.0
    """Longest validity of a command after its `utime`, whatever its `valid_for`, seconds."""
    command_period: float = 0.05
    """Period of the frames of a command, or of the stop after it, seconds."""
    clock_slack: float = 0.2
    """Seconds by which the clock of a command's source may be ahead of ours."""
    window: float = 0.02
    """Seconds to wait for the other frames of a status; shorter than the time between two."""
    silence: float = 1.0
    """Timeout for usable frames, seconds."""
    delay: float = 0.0
    """Seconds from the measurement to the frame's arrival, as far as known."""
    delay_sigma: float = 0.0
    """Standard deviation of `delay`, seconds."""

    def __post_init__(self) -> None:
        if not self.dbc:
            raise ValueError("dbc is the path of a DBC file, got nothing")
        if self.status is None and self.command is None:
            raise ValueError("status or command is needed: without both there is nothing to do")
        for key, value, low, high in (
            ("dead_man", self.dead_man, 0.05, 5.0),
            ("max_validity", self.max_validity, 0.05, 60.0),
            ("command_period", self.command_period, 0.005, 1.0),
            ("clock_slack", self.clock_slack, 0.0, 5.0),
            ("window", self.window, 0.0, 1.0),
            ("silence", self.silence, 0.05, 3600.0),
            ("delay", self.delay, 0.0, 5.0),
            ("delay_sigma", self.delay_sigma, 0.0, 5.0),
        ):
            if not low <= value <= high:
                raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")
        if self.max_validity < self.dead_man:
            raise ValueError(
                f"max_validity is at least dead_man, {self.dead_man:g}, got {self.max_validity:g}: a command would end "
                "before it"
            )
        if self.command_period > self.dead_man:
            raise ValueError(
                f"command_period is at most dead_man, {self.dead_man:g}, got {self.command_period:g}: the controller "
                "would stop between two frames"
            )
