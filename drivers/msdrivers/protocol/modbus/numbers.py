"""Numbers in one or two 16-bit registers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from msdrivers.protocol.modbus.registers import LAST_ADDRESS


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """A number in degrees or degrees a second: the registers' whole number times `scale_deg` plus `offset_deg`."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    address: int
    """Address of the protocol, from 0: what manuals call 40001 is 0."""
    registers: int = 1
    """1 for a number of 16 bits, 2 for 32."""
    is_signed: bool = True
    """Two's complement; False: from 0 up."""
    high_word_first: bool = True
    """Of two registers the first holds the higher 16 bits, as the standard has bytes; False: the lower."""
    scale_deg: float = 1.0
    """Degrees (a second) for each unit; negative turns the sense."""
    offset_deg: float = 0.0
    """Degrees (a second) at 0."""

    def __post_init__(self) -> None:
        if self.registers not in (1, 2):
            raise ValueError(f"registers is 1 (16 bits) or 2 (32 bits), got {self.registers}")
        if not 0 <= self.address <= LAST_ADDRESS + 1 - self.registers:
            raise ValueError(
                f"address is 0 to {LAST_ADDRESS + 1 - self.registers}, got {self.address}; a manual's 40001 is 0"
            )
        if not math.isfinite(self.scale_deg) or self.scale_deg == 0.0:
            raise ValueError(f"scale_deg is a number and not 0, got {self.scale_deg:g}")
        if not math.isfinite(self.offset_deg):
            raise ValueError(f"offset_deg is a number, got {self.offset_deg:g}")

    @property
    def lowest(self) -> int:
        """The lowest whole number that the registers hold."""
        return -(1 << (16 * self.registers - 1)) if self.is_signed else 0

    @property
    def highest(self) -> int:
        """The highest whole number that the registers hold."""
        return self.lowest + (1 << (16 * self.registers)) - 1

    def number(self, values: Sequence[int]) -> int:
        """Return the whole number of as many registers as `registers` says."""
        words = values if self.high_word_first else values[::-1]
        number = 0
        for word in words:
            number = number << 16 | word
        return number - (1 << 16 * self.registers) if number > self.highest else number

    def words(self, number: int) -> tuple[int, ...]:
        """Return the registers of a whole number. Raises ValueError for one that they do not hold."""
        if not self.lowest <= number <= self.highest:
            raise ValueError(f"{number} is not within {self.lowest} to {self.highest}")
        words = tuple(number >> shift & 0xFFFF for shift in range(16 * (self.registers - 1), -1, -16))
        return words if self.high_word_first else words[::-1]

    def degrees(self, values: Sequence[int]) -> float:
        """Return the value of registers in degrees (a second)."""
        return self.number(values) * self.scale_deg + self.offset_deg

    def of_degrees(self, degrees: float) -> tuple[int, ...]:
        """Return the registers nearest to a value. Raises ValueError for one that they do not hold."""
        return self.words(round((degrees - self.offset_deg) / self.scale_deg))

    def holds(self, degrees: float) -> bool:
        """Return whether the registers can hold a value."""
        return self.lowest <= round((degrees - self.offset_deg) / self.scale_deg) <= self.highest
