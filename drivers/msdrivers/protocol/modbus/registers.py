"""What goes over a Modbus line, without the bytes: requests, replies, failures.

Addresses are those of the protocol, from 0; manuals that number holding registers from 40001 mean address 0 by it.
`transaction` ties a reply to its request, as the header of Modbus/TCP does. Source: MODBUS Application Protocol
Specification V1.1b3.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

MAX_READ = 125
MAX_WRITE = 123
"""Registers in one request."""

LAST_ADDRESS = 0xFFFF


class Table(Enum):
    """Where a register is: each table has addresses of its own."""

    HOLDING = "holding"
    """Read and written (functions 3 and 16)."""
    INPUT = "input"
    """Only read (function 4)."""


class FailureKind(Enum):
    """Why there is no reply with data."""

    EXCEPTION = "exception"
    """The device refused; `code` says why."""
    SILENCE = "silence"
    """No reply came in time."""
    LINE = "line"
    """The line broke, or what came was no Modbus."""


@dataclass(frozen=True, slots=True)
class ReadRegisters:
    """Read `count` registers from `address` on."""

    address: int
    count: int
    table: Table = Table.HOLDING
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Write registers from `address` on: numbers 0..65535."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class Registers:
    """The registers that were asked for: numbers 0..65535 from `address` on."""

    address: int
    values: tuple[int, ...]
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class Written:
    """`count` registers were written from `address` on."""

    address: int
    count: int
    transaction: int = 0


@dataclass(frozen=True, slots=True)
class ModbusFailure:
    """There is no reply to a request; `text` is for a person, `code` the device's for an EXCEPTION."""

    kind: FailureKind
    text: str = ""
    code: int = 0
    transaction: int = 0


ModbusUnit: TypeAlias = ReadRegisters | WriteRegisters | Registers | Written | ModbusFailure

EXCEPTIONS = {
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
"""What an exception code means for a person."""


def explain(code: int) -> str:
    """Return the meaning of an exception code."""
    return f"exception {code}: {EXCEPTIONS.get(code, 'a code that the standard does not have; see its manual')}"


def fits(unit: ModbusUnit, request: ReadRegisters | WriteRegisters) -> bool:
    """Return whether a unit is a reply to a request: of its kind, with its address and number of registers."""
    if isinstance(request, ReadRegisters):
        return (
            isinstance(unit, Registers)
            and (unit.address, len(unit.values)) == (request.address, request.count)
            and all(0 <= value <= 0xFFFF for value in unit.values)
        )
    return isinstance(unit, Written) and (unit.address, unit.count) == (request.address, len(request.values))


def described(request: ReadRegisters | WriteRegisters) -> str:
    """Return a request in words, for a person."""
    if isinstance(request, ReadRegisters):
        return f"reading {request.count} {request.table.value} registers from {request.address}"
    return f"writing {len(request.values)} registers from {request.address}"
