"""Modbus/TCP over a line of bytes, from both ends; pymodbus makes and reads the messages.

The header of Modbus/TCP is transaction, protocol (0), length and unit, 2, 2, 2 and 1 bytes (MODBUS Messaging on TCP/IP
Implementation Guide V1.0b).
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from msdrivers.links import Link, LinkError
from msdrivers.links.tcp import TcpLink, TcpServerLink
from msdrivers.protocol.modbus.registers import (
    FailureKind,
    ModbusFailure,
    ModbusUnit,
    ReadRegisters,
    Registers,
    Table,
    WriteRegisters,
    Written,
    explain,
)

_HEADER = struct.Struct(">HHHB")

LONGEST = 254
"""Bytes after the length field: a unit, and a message of 253 bytes at most."""

ANSWER_S = 1.0
"""How long a device may take for a reply before that is told as its silence."""

ILLEGAL_FUNCTION, ILLEGAL_VALUE = 1, 3

# a message that is none is told by us, with what to do
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

Request: TypeAlias = ReadRegisters | WriteRegisters


class _Frames:
    """Cuts a stream of bytes into messages, and makes bytes of messages."""

    def __init__(self, is_server: bool):
        self._framer = FramerSocket(DecodePDU(is_server))
        self._rest = b""

    def clear(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[int, int, bytes, ModbusPDU | None]]:
        """Return transaction, unit, bytes and message of each whole frame; None for a message that is none.

        Raises ValueError for a stream that is not Modbus/TCP.
        """
        self._rest += data
        found = []
        while len(self._rest) >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(self._rest)
            if protocol != 0 or not 2 <= length <= LONGEST:
                self.clear()
                raise ValueError("what came is not Modbus/TCP")
            if len(self._rest) < 6 + length:
                break
            frame, self._rest = self._rest[: 6 + length], self._rest[6 + length :]
            try:
                _, message = self._framer.handleFrame(frame, 0, 0)
            except ModbusException:
                message = None
            found.append((transaction, unit, frame[_HEADER.size :], message))
        return found

    def bytes_of(self, message: ModbusPDU, transaction: int, unit: int) -> bytes:
        message.transaction_id, message.dev_id = transaction, unit
        return self._framer.buildFrame(message)


class ModbusLink:
    """The driver's end: requests are sent, replies and failures come. Several requests may be under way."""

    baud = 0

    def __init__(self, link: Link[bytes], unit_id: int, clock_ns: Callable[[], int] = time.monotonic_ns):
        """Take the line of bytes, and the number of the device behind it."""
        self._link, self._unit_id, self._clock_ns = link, unit_id, clock_ns
        self._frames = _Frames(is_server=False)
        self._waiting: dict[int, tuple[Request, int]] = {}

    @property
    def description(self) -> str:
        """The address and the device's number."""
        return f"modbus {self._link.description.removeprefix('tcp ')} unit {self._unit_id}"

    def open(self, baud: int | None = None) -> None:
        """Call the server. Raises LinkError."""
        self._frames.clear()
        self._waiting.clear()
        self._link.open(baud)

    def close(self) -> None:
        """Hang up."""
        self._link.close()

    def send(self, unit: ModbusUnit) -> None:
        """Send a request. Raises LinkError."""
        number = unit.transaction & 0xFFFF
        if isinstance(unit, ReadRegisters):
            kind = ReadHoldingRegistersRequest if unit.table is Table.HOLDING else ReadInputRegistersRequest
            message: ModbusPDU = kind(address=unit.address, count=unit.count)
        elif isinstance(unit, WriteRegisters):
            values = list(unit.values)
            message = WriteMultipleRegistersRequest(address=unit.address, count=len(values), registers=values)
        else:
            raise TypeError(f"a driver sends requests, not {type(unit).__name__}")
        self._waiting[number] = (unit, self._clock_ns() + round(ANSWER_S * 1e9))
        self._link.send(self._frames.bytes_of(message, number, self._unit_id))

    def poll(self, timeout: float) -> Sequence[ModbusUnit]:
        """Return replies, and what has no reply for too long as silence. Raises LinkError."""
        units: list[ModbusUnit] = []
        for data in self._link.poll(timeout):
            try:
                frames = self._frames.feed(data)
            except ValueError as error:
                raise LinkError(self.description, str(error), "is address that of a Modbus/TCP server?") from None
            units += [self._reply(number, message) for number, _, _, message in frames if number in self._waiting]
        now = self._clock_ns()
        for number, (request, until) in list(self._waiting.items()):
            if now >= until:
                del self._waiting[number]
                text = f"no reply for {ANSWER_S:g} s"
                units.append(ModbusFailure(FailureKind.SILENCE, text, transaction=request.transaction))
        return units

    def _reply(self, number: int, message: ModbusPDU | None) -> ModbusUnit:
        request, _ = self._waiting.pop(number)
        if isinstance(message, ExceptionResponse):
            code = message.exception_code
            return ModbusFailure(FailureKind.EXCEPTION, explain(code), code, request.transaction)
        if isinstance(request, ReadRegisters) and isinstance(
            message, ReadHoldingRegistersResponse | ReadInputRegistersResponse
        ):
            return Registers(request.address, tuple(message.registers), request.transaction)
        if isinstance(request, WriteRegisters) and isinstance(message, WriteMultipleRegistersResponse):
            return Written(message.address, message.count, request.transaction)
        return ModbusFailure(FailureKind.LINE, "a reply that does not fit its request", transaction=request.transaction)


class ModbusServerLink:
    """The emulator's end: requests come, replies and exceptions are sent."""

    baud = 0

    def __init__(self, link: TcpServerLink):
        """Take the line of bytes."""
        self._link = link
        self._frames = _Frames(is_server=True)
        self._asked: dict[int, tuple[int, int]] = {}
        self._callers = 0

    @property
    def description(self) -> str:
        """The address to call."""
        return f"modbus {self._link.description.removeprefix('tcp ')}"

    def open(self, baud: int | None = None) -> None:
        """Listen. Raises LinkError."""
        self._link.open(baud)

    def close(self) -> None:
        """Listen no more."""
        self._link.close()

    def poll(self, timeout: float) -> Sequence[ModbusUnit]:
        """Return the requests that came; what is none is answered with an exception here. Raises LinkError."""
        units: list[ModbusUnit] = []
        for data in self._link.poll(timeout):
            if self._link.callers != self._callers:
                # what the one before left unfinished is not this one's
                self._callers = self._link.callers
                self._frames.clear()
                self._asked.clear()
            try:
                frames = self._frames.feed(data)
            except ValueError:
                self._link.hang_up()
                continue
            for number, unit_id, raw, message in frames:
                request = _request(message, number)
                self._asked[number] = (unit_id, raw[0])
                if request is not None:
                    units.append(request)
                else:
                    code = ILLEGAL_FUNCTION if message is None else ILLEGAL_VALUE
                    self.send(ModbusFailure(FailureKind.EXCEPTION, code=code, transaction=number))
        return units

    def send(self, unit: ModbusUnit) -> None:
        """Send a reply; to a request that nobody made, or a silence, nothing goes out. Raises LinkError."""
        number = unit.transaction & 0xFFFF
        if number not in self._asked:
            return
        unit_id, function = self._asked.pop(number)
        if isinstance(unit, Registers):
            holding = function == ReadHoldingRegistersResponse.function_code
            kind = ReadHoldingRegistersResponse if holding else ReadInputRegistersResponse
            message: ModbusPDU = kind(registers=list(unit.values))
        elif isinstance(unit, Written):
            message = WriteMultipleRegistersResponse(address=unit.address, count=unit.count)
        elif isinstance(unit, ModbusFailure) and unit.kind is FailureKind.EXCEPTION:
            message = ExceptionResponse(function, unit.code)
        else:
            return
        self._link.send(self._frames.bytes_of(message, number, unit_id))


def _request(message: ModbusPDU | None, number: int) -> Request | None:
    """Return the request in a message, None for what is not served here."""
    if isinstance(message, ReadHoldingRegistersRequest):
        # the class of input registers is made from that of holding ones
        table = Table.INPUT if isinstance(message, ReadInputRegistersRequest) else Table.HOLDING
        return ReadRegisters(message.address, message.count, table, number)
    if isinstance(message, ReadInputRegistersRequest):
        return ReadRegisters(message.address, message.count, Table.INPUT, number)
    if isinstance(message, WriteMultipleRegistersRequest) and len(message.registers) == message.count:
        return WriteRegisters(message.address, tuple(message.registers), number)
    return None


def modbus_link(host: str, port: int, unit_id: int) -> ModbusLink:
    """Return the driver's end of a Modbus/TCP line."""
    return ModbusLink(TcpLink(host, port), unit_id)
