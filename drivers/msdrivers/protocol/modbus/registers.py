"""Modbus requests, replies and failures as values, numbers in registers, and the register map of an axis.

Addresses are those of the protocol, from 0; manuals that number holding registers from 40001 mean address 0 by it.
`transaction` ties a reply to its request, as the header of Modbus/TCP does. Source: MODBUS Application Protocol
Specification V1.1b3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Literal, TypeAlias

STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

MAX_READ = 125
MAX_WRITE = 123
"""Registers in one request."""

LAST_ADDRESS = 0xFFFF


class RegisterTable(Enum):
    """Table of a register; each table has its own addresses."""

    HOLDING = "holding"
    """Read and written (functions 3 and 16)."""
    INPUT = "input"
    """Only read (function 4)."""


class FailureKind(Enum):
    """Why there is no reply."""

    EXCEPTION = "exception"
    """The device rejected the request; see `code`."""
    TIMEOUT = "silence"
    """No reply in time."""
    LINE = "line"
    """The line failed, or the data was not Modbus."""


@dataclass(frozen=True, slots=True)
class ReadRegisters:
    """Read `count` registers from `address` on."""

    address: int
    count: int
    table: RegisterTable = RegisterTable.HOLDING
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Write registers from `address` on: numbers 0..65535."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class Registers:
    """The requested registers: numbers 0..65535 from `address` on."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class RegistersWritten:
    """`count` registers were written from `address` on."""

    address: int
    count: int
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class ModbusFailure:
    """A request without reply; `code` is the device's for an EXCEPTION."""

    kind: FailureKind
    text: str = ""
    code: int = 0
    transaction: int = 0


ModbusUnit: TypeAlias = ReadRegisters | WriteRegisters | Registers | RegistersWritten | ModbusFailure

EXCEPTION_TEXTS = {
    1: "it does not know the function: use the other table (holding, input)",
    2: "it has no such register: check the addresses in the settings against its manual, which may count from 1",
    3: "it does not take the value or the count of registers: check limits and rate against its manual",
    4: "it failed at the task: look at the device itself",
    5: "it needs time for the task",
    6: "it is busy",
    8: "its memory is damaged: look at the device itself",
    10: "the gateway has no path to it: check the device's number (unit id)",
    11: "the gateway gets no reply from it: check its power and its number (unit id)",
}
"""Meaning of the exception codes (MODBUS Application Protocol V1.1b3, 7)."""


def explain_exception(code: int) -> str:
    return f"exception {code}: {EXCEPTION_TEXTS.get(code, 'a code that the standard does not have; see its manual')}"


def is_reply_to(unit: ModbusUnit, request: ReadRegisters | WriteRegisters) -> bool:
    """Return whether a unit is a reply to a request: of its kind, with its address and number of registers."""
    if isinstance(request, ReadRegisters):
        return (
            isinstance(unit, Registers)
            and (unit.address, len(unit.values)) == (request.address, request.count)
            and all(0 <= value <= 0xFFFF for value in unit.values)
        )
    return isinstance(unit, RegistersWritten) and (unit.address, unit.count) == (request.address, len(request.values))


def describe_request(request: ReadRegisters | WriteRegisters) -> str:
    if isinstance(request, ReadRegisters):
        return f"reading {request.count} {request.table.value} registers from {request.address}"
    return f"writing {len(request.values)} registers from {request.address}"


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """A number in degrees or degrees a second: the registers' whole number times `scale_deg` plus `offset_deg`."""

    __pydantic_config__: ClassVar[dict[str, object]] = STRICT

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

    def to_number(self, values: Sequence[int]) -> int:
        """Return the integer of `registers` registers."""
        words = values if self.high_word_first else values[::-1]
        number = 0
        for word in words:
            number = number << 16 | word
        return number - (1 << 16 * self.registers) if number > self.highest else number

    def to_words(self, number: int) -> tuple[int, ...]:
        """Return the registers of a whole number. Raises ValueError for one that they do not hold."""
        if not self.lowest <= number <= self.highest:
            raise ValueError(f"{number} is not within {self.lowest} to {self.highest}")
        words = tuple(number >> shift & 0xFFFF for shift in range(16 * (self.registers - 1), -1, -16))
        return words if self.high_word_first else words[::-1]

    def to_degrees(self, values: Sequence[int]) -> float:
        """Return the value of registers in degrees (a second)."""
        return self.to_number(values) * self.scale_deg + self.offset_deg

    def from_degrees(self, degrees: float) -> tuple[int, ...]:
        """Return the registers nearest to a value. Raises ValueError for one that they do not hold."""
        return self.to_words(round((degrees - self.offset_deg) / self.scale_deg))

    def can_hold(self, degrees: float) -> bool:
        return self.lowest <= round((degrees - self.offset_deg) / self.scale_deg) <= self.highest


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
        if len(self.commanded) not in (0, 3):
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
        return self._get_given("angle", "rate", "sequence")

    @property
    def begin(self) -> int:
        """The first address that is read at each poll."""
        return min(each.address for each in self.measured.values())

    @property
    def commanded(self) -> Mapping[str, RegisterMap]:
        """Registers written to set the nodding motion, by name; empty for a read-only axis."""
        return self._get_given("lower_limit", "upper_limit", "nod_rate")

    def _get_given(self, *names: str) -> dict[str, RegisterMap]:
        return {name: each for name in names if (each := getattr(self, name)) is not None}
