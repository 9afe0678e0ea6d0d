"""Register map of an axis: what another axis configures instead of coding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from msdrivers.protocol.modbus.registers import MAX_READ, RegisterMap

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


@dataclass(frozen=True, slots=True)
class AxisRegisters:
    """Registers of the axis. Angles and rates are the joint's, in its positive direction."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    angle: RegisterMap
    """Angle of the axis."""
    rate: RegisterMap | None = None
    """Rate of the axis; None: no rate is published."""
    sequence: RegisterMap | None = None
    """Sequence number of the measurement; an unchanged one means that nothing new was measured."""
    table: Literal["holding", "input"] = "holding"
    """Table of angle, rate and sequence; the others are holding registers."""
    lower_limit: RegisterMap | None = None
    """Lower limit of the nodding motion, written."""
    upper_limit: RegisterMap | None = None
    """Upper limit of the nodding motion, written."""
    nod_rate: RegisterMap | None = None
    """Rate of the nodding motion, written; 0: stationary."""

    def __post_init__(self) -> None:
        if self.table not in ("holding", "input"):
            raise ValueError(f"table is holding or input, got {self.table!r}")
        given = [each is not None for each in (self.lower_limit, self.upper_limit, self.nod_rate)]
        if any(given) and not all(given):
            raise ValueError(
                "lower_limit, upper_limit and nod_rate are given together or not at all: nodding needs all"
            )
        spread = max(each.address + each.registers for each in self.measured.values()) - self.begin
        if spread > MAX_READ:
            raise ValueError(
                f"angle, rate and sequence lie {spread} registers apart; at most {MAX_READ} are read at one instant"
            )

    @property
    def measured(self) -> Mapping[str, RegisterMap]:
        """Registers read at each poll, by name."""
        given = {"angle": self.angle, "rate": self.rate, "sequence": self.sequence}
        return {name: each for name, each in given.items() if each is not None}

    @property
    def begin(self) -> int:
        """The first address that is read at each poll."""
        return min(each.address for each in self.measured.values())

    @property
    def commanded(self) -> Mapping[str, RegisterMap]:
        """Registers written to set the nodding motion, by name; empty for a read-only axis."""
        given = {"lower_limit": self.lower_limit, "upper_limit": self.upper_limit, "nod_rate": self.nod_rate}
        return {name: each for name, each in given.items() if each is not None}
