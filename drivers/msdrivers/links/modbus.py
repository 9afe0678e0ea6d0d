"""Modbus/TCP over a byte link, client and server; pymodbus encodes and decodes the messages.

The header of Modbus/TCP is transaction, protocol (0), length and unit, 2, 2, 2 and 1 bytes (MODBUS Messaging on TCP/IP
Implementation Guide V1.0b).
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Sequence

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu import register_message as pdu

from msdrivers.endpoint import (
    ModbusFailure,
    ModbusRequest,
    ModbusUnit,
    ReadRegisters,
    Registers,
    RegistersWritten,
    RegisterTable,
    WriteRegisters,
    explain_exception,
)
from msdrivers.links import Link, LinkError, LinkWrapper, TcpServerLink

_HEADER = struct.Struct(">HHHB")

MAX_LENGTH = 254
"""Bytes after the length field: a unit, and a message of 253 bytes at most."""

MAX_PENDING = 64
"""Requests whose replies are awaited; the oldest ones were not answered."""

ILLEGAL_FUNCTION, ILLEGAL_VALUE = 1, 3

# malformed messages are reported by us
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class _TcpFramer:
    """Cuts a stream of bytes into messages, and makes bytes of messages."""

    def __init__(self, is_server: bool):
        self._framer = FramerSocket(DecodePDU(is_server))
        self._buffer = b""

    def clear(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[tuple[int, int, bytes, ModbusPDU | None]]:
        """Return transaction, unit, bytes and message of each whole frame; None for a message that is none.

        Raises ValueError for a stream that is not Modbus/TCP.
        """
        self._buffer += data
        found = []
        while len(self._buffer) >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(self._buffer)
            if protocol != 0 or not 2 <= length <= MAX_LENGTH:
                self.clear()
                raise ValueError("the received data is not Modbus/TCP")
            if len(self._buffer) < 6 + length:
                break
            frame, self._buffer = self._buffer[: 6 + length], self._buffer[6 + length :]
            try:
                _, message = self._framer.handleFrame(frame, 0, 0)
            except ModbusException:
                message = None
            found.append((transaction, unit, frame[_HEADER.size :], message))
        return found

    def encode(self, message: ModbusPDU, transaction: int, unit: int) -> bytes:
        message.transaction_id, message.dev_id = transaction, unit
        return self._framer.buildFrame(message)


class ModbusLink(LinkWrapper[bytes]):
    """The driver's end: requests are sent, replies and exceptions come. Several requests may be under way.

    unit_id: number of the device behind the server.
    """

    def __init__(self, link: Link[bytes], unit_id: int):
        super().__init__(link)
        self._unit_id = unit_id
        self._framer = _TcpFramer(is_server=False)
        self._pending: dict[int, ModbusRequest] = {}

    @property
    def description(self) -> str:
        return f"modbus {self._link.description.removeprefix('tcp ')} unit {self._unit_id}"

    def open(self, baud: int | None = None) -> None:
        self._framer.clear()
        self._pending.clear()
        super().open(baud)

    def send(self, unit: ModbusUnit) -> None:
        """Send a request. Raises LinkError."""
        number = unit.transaction & 0xFFFF
        if isinstance(unit, ReadRegisters):
            holding = unit.table == "holding"
            kind = pdu.ReadHoldingRegistersRequest if holding else pdu.ReadInputRegistersRequest
            message: ModbusPDU = kind(address=unit.address, count=unit.count)
        elif isinstance(unit, WriteRegisters):
            values = list(unit.values)
            message = pdu.WriteMultipleRegistersRequest(address=unit.address, count=len(values), registers=values)
        else:
            raise TypeError(f"a driver sends requests, not {type(unit).__name__}")
        if len(self._pending) >= MAX_PENDING:
            del self._pending[next(iter(self._pending))]
        self._pending[number] = unit
        self._link.send(self._framer.encode(message, number, self._unit_id))

    def poll(self, timeout: float) -> Sequence[ModbusUnit]:
        """Return replies to the requests under way. Raises LinkError."""
        units: list[ModbusUnit] = []
        for data in self._link.poll(timeout):
            try:
                frames = self._framer.feed(data)
            except ValueError as error:
                raise LinkError(self.description, str(error), "is address that of a Modbus/TCP server?") from None
            units += [
                self._convert_reply(number, message) for number, _, _, message in frames if number in self._pending
            ]
        return units

    def _convert_reply(self, number: int, message: ModbusPDU | None) -> ModbusUnit:
        request = self._pending.pop(number)
        if isinstance(message, ExceptionResponse):
            code = message.exception_code
            return ModbusFailure(explain_exception(code), code, request.transaction)
        if isinstance(request, ReadRegisters) and isinstance(
            message, pdu.ReadHoldingRegistersResponse | pdu.ReadInputRegistersResponse
        ):
            return Registers(request.address, tuple(message.registers), request.transaction)
        if isinstance(request, WriteRegisters) and isinstance(message, pdu.WriteMultipleRegistersResponse):
            return RegistersWritten(message.address, message.count, request.transaction)
        return ModbusFailure("a reply that does not fit its request", transaction=request.transaction)


class ModbusServerLink(LinkWrapper[bytes]):
    """The emulator's end: requests come, replies and exceptions are sent."""

    _link: TcpServerLink

    def __init__(self, link: TcpServerLink):
        super().__init__(link)
        self._framer = _TcpFramer(is_server=True)
        self._pending: dict[int, tuple[int, int]] = {}
        self._clients_seen = 0

    @property
    def description(self) -> str:
        return f"modbus {self._link.description.removeprefix('tcp ')}"

    def poll(self, timeout: float) -> Sequence[ModbusUnit]:
        """Return received requests; unsupported ones are answered with an exception. Raises LinkError."""
        units: list[ModbusUnit] = []
        for data in self._link.poll(timeout):
            if self._link.clients_accepted != self._clients_seen:
                # discard the unfinished input of the previous client
                self._clients_seen = self._link.clients_accepted
                self._framer.clear()
                self._pending.clear()
            try:
                frames = self._framer.feed(data)
            except ValueError:
                self._link.disconnect_client()
                continue
            for number, unit_id, raw, message in frames:
                request = _convert_request(message, number)
                self._pending[number] = (unit_id, raw[0])
                if request is not None:
                    units.append(request)
                else:
                    code = ILLEGAL_FUNCTION if message is None else ILLEGAL_VALUE
                    self.send(ModbusFailure(code=code, transaction=number))
        return units

    def send(self, unit: ModbusUnit) -> None:
        """Send a reply; nothing without a request. Raises LinkError."""
        number = unit.transaction & 0xFFFF
        if number not in self._pending:
            return
        unit_id, function = self._pending.pop(number)
        if isinstance(unit, Registers):
            holding = function == pdu.ReadHoldingRegistersResponse.function_code
            kind = pdu.ReadHoldingRegistersResponse if holding else pdu.ReadInputRegistersResponse
            message: ModbusPDU = kind(registers=list(unit.values))
        elif isinstance(unit, RegistersWritten):
            message = pdu.WriteMultipleRegistersResponse(address=unit.address, count=unit.count)
        elif isinstance(unit, ModbusFailure):
            message = ExceptionResponse(function, unit.code)
        else:
            return
        self._link.send(self._framer.encode(message, number, unit_id))


def _convert_request(message: ModbusPDU | None, number: int) -> ModbusRequest | None:
    """Return the request in a message, None for what is not served here."""
    if isinstance(message, pdu.ReadHoldingRegistersRequest | pdu.ReadInputRegistersRequest):
        # the class of input registers is made from that of holding ones
        table: RegisterTable = "input" if isinstance(message, pdu.ReadInputRegistersRequest) else "holding"
        return ReadRegisters(message.address, message.count, table, number)
    if isinstance(message, pdu.WriteMultipleRegistersRequest) and len(message.registers) == message.count:
        return WriteRegisters(message.address, tuple(message.registers), number)
    return None
