"""The line of a driver, made from what its settings say; and the forms in which its units are recorded."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Mapping
from typing import Any, get_args

from modelserver.config_reader import adapter_of
from msdrivers.line_settings import CanSettings, ModbusSettings, SerialSettings, TcpSettings, split_address
from msdrivers.links import Link
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.modbus.registers import ModbusUnit
from msdrivers.raw_log import BytesForm, Form
from msdrivers.settings import BAUDS, DriverSettings

_FRAME = struct.Struct(">IB")

_EXTENDED, _ERROR = 1, 2


class CanForm:
    """A CAN frame: its identifier, 4 bytes, most significant first; flags, 1 byte (1 extended, 2 error); its data."""

    name = "can"

    def pack(self, unit: CanFrame) -> bytes:
        """Return the bytes of a frame."""
        flags = _EXTENDED * unit.is_extended + _ERROR * unit.is_error
        return _FRAME.pack(unit.arbitration_id, flags) + unit.data

    def unpack(self, data: bytes) -> CanFrame:
        """Return the frame of bytes. Raises ValueError for fewer than a frame has."""
        if len(data) < _FRAME.size:
            raise ValueError(f"{len(data)} bytes are no CAN frame")
        identifier, flags = _FRAME.unpack_from(data)
        return CanFrame(identifier, data[_FRAME.size :], bool(flags & _EXTENDED), bool(flags & _ERROR))


class ModbusForm:
    """A Modbus request, reply or failure, as JSON: its kind and its fields."""

    name = "modbus"

    def pack(self, unit: ModbusUnit) -> bytes:
        """Return the bytes of a unit."""
        fields = {each.name: getattr(unit, each.name) for each in dataclasses.fields(unit)}
        return json.dumps([type(unit).__name__, fields], default=lambda each: each.value).encode()

    def unpack(self, data: bytes) -> ModbusUnit:
        """Return the unit of bytes. Raises ValueError for bytes that are none."""
        try:
            name, fields = json.loads(data)
            kind = _MODBUS[name]
            unit: ModbusUnit = adapter_of(kind).validate_python(fields)
        except (TypeError, KeyError) as error:
            raise ValueError(f"no Modbus unit: {error}") from None
        return unit


_MODBUS: Mapping[str, Any] = {kind.__name__: kind for kind in get_args(ModbusUnit)}


def form_of(settings: DriverSettings) -> Form[Any]:
    """Return how the units of a driver's line are recorded."""
    if isinstance(settings.line, CanSettings):
        return CanForm()
    return ModbusForm() if isinstance(settings.line, ModbusSettings) else BytesForm()


def link_of(settings: DriverSettings) -> Link[Any]:
    """Return a driver's line, not opened yet."""
    line = settings.line
    # each kind of line needs another library, and some of them are slow to load
    if isinstance(line, SerialSettings):
        from msdrivers.links.serial_line import SerialLink

        return SerialLink(line.port, first_baud(settings))
    if isinstance(line, TcpSettings):
        from msdrivers.links.tcp import TcpLink

        return TcpLink(*split_address(line.address))
    if isinstance(line, CanSettings):
        from msdrivers.links.can_bus import CanLink

        return CanLink(line.can, line.interface, line.bitrate)
    from msdrivers.links.modbus import modbus_link

    return modbus_link(*split_address(line.address), line.unit_id)


def first_baud(settings: DriverSettings) -> int:
    """Return the rate to open a serial port at: the first to be tried, the port's, or the maker's."""
    bauds = getattr(settings.station, BAUDS, ())
    given = settings.line.baud if isinstance(settings.line, SerialSettings) else 0
    return bauds[0] if bauds else given or settings.kind.baud
