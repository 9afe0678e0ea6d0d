"""Settings of the driver of a nodding axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from msdrivers.protocol.modbus.axis_map import AxisRegisters

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

MIN_POLL_HZ = 50.0


@dataclass(frozen=True, slots=True)
class NodSettings:
    """Nodding motion. Degrees and degrees per second."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    lower_deg: float
    """Lower limit."""
    upper_deg: float
    """Upper limit."""
    rate_deg: float = 30.0
    """Rate between the limits; 0: stationary."""

    def __post_init__(self) -> None:
        if not self.lower_deg < self.upper_deg:
            raise ValueError(f"lower_deg is below upper_deg, {self.upper_deg:g}, got {self.lower_deg:g}")


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """Settings of an axis. Raises ValueError with the key for an invalid value."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    source: str
    """Source of the samples."""
    joint: str
    """Name of the constraint in the geometry file that the axis moves."""
    registers: AxisRegisters
    """Its register map."""
    nod: NodSettings | None = None
    """Nodding motion to set; None: the axis is only read."""
    step_deg: float = 0.072
    """Resolution of the angle, degrees."""
    lowest_deg: float = -90.0
    """Lowest possible angle, degrees; lower readings are rejected."""
    highest_deg: float = 90.0
    """Highest possible angle, degrees."""
    slowest_deg: float = 2.0
    """Lowest nodding rate, degrees per second."""
    fastest_deg: float = 90.0
    """Highest nodding rate, degrees per second; faster readings are rejected."""
    poll_hz: float = 100.0
    """Poll rate."""
    reply_timeout: float = 0.1
    """Reply timeout, seconds."""
    retry_delay: float = 0.5
    """Delay before a retry after an exception, seconds."""
    silence: float = 1.0
    """Seconds without a usable reply after which the driver is SILENT and reopens the line."""

    def __post_init__(self) -> None:
        if not (0 < len(self.joint) <= 200):
            raise ValueError("joint is the name of a constraint in the geometry file, got nothing or too long a text")
        for key, value, low, high in (
            ("poll_hz", self.poll_hz, MIN_POLL_HZ, 1000.0),
            ("step_deg", self.step_deg, 0.0, 10.0),
            ("lowest_deg", self.lowest_deg, -3600.0, 3600.0),
            ("highest_deg", self.highest_deg, -3600.0, 3600.0),
            ("slowest_deg", self.slowest_deg, 0.0, 3600.0),
            ("fastest_deg", self.fastest_deg, 0.01, 3600.0),
            ("reply_timeout", self.reply_timeout, 0.005, 10.0),
            ("retry_delay", self.retry_delay, 0.01, 60.0),
            ("silence", self.silence, 0.05, 3600.0),
        ):
            if not low <= value <= high:
                raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")
        if not self.lowest_deg < self.highest_deg:
            raise ValueError(f"lowest_deg is below highest_deg, {self.highest_deg:g}, got {self.lowest_deg:g}")
        if not self.slowest_deg <= self.fastest_deg:
            raise ValueError(f"slowest_deg is at most fastest_deg, {self.fastest_deg:g}, got {self.slowest_deg:g}")
        if self.nod is not None:
            why = self.find_nod_problem(self.nod)
            if why:
                raise ValueError(f"nod cannot be done: {why}")

    def find_nod_problem(self, nod: NodSettings) -> str:
        """Describe why the axis cannot do a nodding motion; empty if it can."""
        if not self.registers.commanded:
            return "registers names no lower_limit, upper_limit and nod_rate"
        if nod.rate_deg != 0.0 and not self.slowest_deg <= nod.rate_deg <= self.fastest_deg:
            allowed = f"{self.slowest_deg:g} to {self.fastest_deg:g} deg/s, or 0 (stationary)"
            return f"rate_deg {nod.rate_deg:g} is not {allowed}"
        if not (self.lowest_deg <= nod.lower_deg and nod.upper_deg <= self.highest_deg):
            allowed = f"{self.lowest_deg:g} to {self.highest_deg:g} degrees"
            return f"{nod.lower_deg:g} to {nod.upper_deg:g} degrees is not within {allowed}"
        for name, value in (("lower_limit", nod.lower_deg), ("upper_limit", nod.upper_deg), ("nod_rate", nod.rate_deg)):
            if not self.registers.commanded[name].can_hold(value):
                return f"the registers of {name} cannot hold {value:g}"
        return ""
