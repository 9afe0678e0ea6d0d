"""Which registers an axis has: the part of the settings that another axis writes instead of code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from msdrivers.protocol.modbus.numbers import RegisterMap
from msdrivers.protocol.modbus.registers import MAX_READ

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}


@dataclass(frozen=True, slots=True)
class AxisRegisters:
    """Which registers the axis has. Angles and rates are the joint's, in its positive sense."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

    angle: RegisterMap
    """Where the axis is."""
    rate: RegisterMap | None = None
    """How fast it turns; None: it does not say, and no rate is published."""
    number: RegisterMap | None = None
    """A number that the axis changes with each measurement: one that stays tells that nothing new was measured."""
    table: Literal["holding", "input"] = "holding"
    """In which table angle, rate and number are; the others are holding registers."""
    lower_limit: RegisterMap | None = None
    """Lowest angle of the nodding, written."""
    upper_limit: RegisterMap | None = None
    """Highest angle of the nodding, written."""
    nod_rate: RegisterMap | None = None
    """How fast to nod, written; 0 stands."""

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
                f"angle, rate and number lie {spread} registers apart; at most {MAX_READ} are read at one instant"
            )

    @property
    def measured(self) -> Mapping[str, RegisterMap]:
        """What is read at each poll, by name."""
        given = {"angle": self.angle, "rate": self.rate, "number": self.number}
        return {name: each for name, each in given.items() if each is not None}

    @property
    def begin(self) -> int:
        """The first address that is read at each poll."""
        return min(each.address for each in self.measured.values())

    @property
    def commanded(self) -> Mapping[str, RegisterMap]:
        """What is written for nodding, by name, in the order of writing; empty for an axis that cannot be told."""
        given = {"lower_limit": self.lower_limit, "upper_limit": self.upper_limit, "nod_rate": self.nod_rate}
        return {name: each for name, each in given.items() if each is not None}
