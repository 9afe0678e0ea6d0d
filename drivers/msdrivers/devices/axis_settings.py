"""How a nodding axis is to be read and moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from msdrivers.protocol.modbus.axis_map import AxisRegisters

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

LEAST_POLL_HZ = 50.0


@dataclass(frozen=True, slots=True)
class NodMap:
    """How to nod. Degrees and degrees a second."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    lower_deg: float
    """Where it turns back below."""
    upper_deg: float
    """Where it turns back above."""
    rate_deg: float = 30.0
    """How fast it turns between them; 0 stands."""

    def __post_init__(self) -> None:
        if not self.lower_deg < self.upper_deg:
            raise ValueError(f"lower_deg is below upper_deg, {self.upper_deg:g}, got {self.lower_deg:g}")


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """How to use the axis. Raises ValueError for what cannot be, naming the key."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    source: str
    """Name that the samples give as theirs."""
    joint: str
    """Name of the constraint in the geometry file that the axis moves."""
    registers: AxisRegisters
    """Which registers it has."""
    nod: NodMap | None = None
    """How to nod; None: the axis is only watched."""
    step_deg: float = 0.072
    """Degrees from one angle that the axis can tell to the next."""
    lowest_deg: float = -90.0
    """Angle below which the axis cannot be, degrees: what is lower is damage."""
    highest_deg: float = 90.0
    """Angle above which the axis cannot be, degrees."""
    slowest_deg: float = 2.0
    """Lowest rate that the axis nods at, degrees a second."""
    fastest_deg: float = 90.0
    """Highest rate that the axis nods at, degrees a second: what turns faster is damage."""
    poll_hz: float = 100.0
    """Readings a second."""
    reply: float = 0.1
    """Seconds to wait for a reply."""
    retry: float = 0.5
    """Seconds to wait before trying again after the device has refused."""
    silence: float = 1.0
    """Seconds without a usable reply after which the driver says so, and opens the line anew."""

    def __post_init__(self) -> None:
        if not (0 < len(self.joint) <= 200):
            raise ValueError("joint is the name of a constraint in the geometry file, got nothing or too long a text")
        for key, value, low, high in (
            ("poll_hz", self.poll_hz, LEAST_POLL_HZ, 1000.0),
            ("step_deg", self.step_deg, 0.0, 10.0),
            ("lowest_deg", self.lowest_deg, -3600.0, 3600.0),
            ("highest_deg", self.highest_deg, -3600.0, 3600.0),
            ("slowest_deg", self.slowest_deg, 0.0, 3600.0),
            ("fastest_deg", self.fastest_deg, 0.01, 3600.0),
            ("reply", self.reply, 0.005, 10.0),
            ("retry", self.retry, 0.01, 60.0),
            ("silence", self.silence, 0.05, 3600.0),
        ):
            if not low <= value <= high:
                raise ValueError(f"{key} is between {low:g} and {high:g}, got {value:g}")
        if not self.lowest_deg < self.highest_deg:
            raise ValueError(f"lowest_deg is below highest_deg, {self.highest_deg:g}, got {self.lowest_deg:g}")
        if not self.slowest_deg <= self.fastest_deg:
            raise ValueError(f"slowest_deg is at most fastest_deg, {self.fastest_deg:g}, got {self.slowest_deg:g}")
        if self.nod is not None:
            why = self.against(self.nod)
            if why:
                raise ValueError(f"nod cannot be done: {why}")

    def against(self, nod: NodMap) -> str:
        """Return why the axis cannot nod so; empty where it can."""
        if not self.registers.commanded:
            return "registers names no lower_limit, upper_limit and nod_rate"
        if nod.rate_deg != 0.0 and not self.slowest_deg <= nod.rate_deg <= self.fastest_deg:
            allowed = f"{self.slowest_deg:g} to {self.fastest_deg:g} deg/s, or 0 to stand"
            return f"rate_deg {nod.rate_deg:g} is not {allowed}"
        if not (self.lowest_deg <= nod.lower_deg and nod.upper_deg <= self.highest_deg):
            allowed = f"{self.lowest_deg:g} to {self.highest_deg:g} degrees"
            return f"{nod.lower_deg:g} to {nod.upper_deg:g} degrees is not within {allowed}"
        for name, value in (("lower_limit", nod.lower_deg), ("upper_limit", nod.upper_deg), ("nod_rate", nod.rate_deg)):
            if not self.registers.commanded[name].holds(value):
                return f"the registers of {name} cannot hold {value:g}"
        return ""
