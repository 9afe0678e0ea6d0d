"""Make drivers, emulators, links and unit codecs from the settings of drivers, and find what is wrong with these."""

from __future__ import annotations

import dataclasses
import json
import os
import struct
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

from modelserver.config.reader import get_adapter
from modelserver.errors import ConfigError, Problem, Severity, find_suggestion, quote, suggest_name
from msdrivers import line_settings as lines
from msdrivers.emulate.faults import InjectedFault
from msdrivers.endpoint import Endpoint
from msdrivers.links import Link
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.modbus.registers import ModbusUnit
from msdrivers.raw_log import BYTES_CODEC, UnitCodec
from msdrivers.registry import EmulatorInputs
from msdrivers.settings import BAUDS_FIELD, DriverSettings

_CAN_HEADER = struct.Struct(">IB")

_EXTENDED_FLAG, _ERROR_FLAG = 1, 2


def _pack_frame(frame: CanFrame) -> bytes:
    flags = _EXTENDED_FLAG * frame.is_extended + _ERROR_FLAG * frame.is_error
    return _CAN_HEADER.pack(frame.arbitration_id, flags) + frame.data


def _unpack_frame(data: bytes) -> CanFrame:
    if len(data) < _CAN_HEADER.size:
        raise ValueError(f"{len(data)} bytes are no CAN frame")
    identifier, flags = _CAN_HEADER.unpack_from(data)
    return CanFrame(identifier, data[_CAN_HEADER.size :], bool(flags & _EXTENDED_FLAG), bool(flags & _ERROR_FLAG))


def _pack_modbus(unit: ModbusUnit) -> bytes:
    fields = {each.name: getattr(unit, each.name) for each in dataclasses.fields(unit)}
    return json.dumps([type(unit).__name__, fields], default=lambda each: each.value).encode()


def _unpack_modbus(data: bytes) -> ModbusUnit:
    try:
        name, fields = json.loads(data)
        unit: ModbusUnit = get_adapter(_MODBUS_TYPES[name]).validate_python(fields)
    except (TypeError, KeyError) as error:
        raise ValueError(f"no Modbus unit: {error}") from None
    return unit


_MODBUS_TYPES: Mapping[str, Any] = {kind.__name__: kind for kind in get_args(ModbusUnit)}

CAN_CODEC = UnitCodec("can", _pack_frame, _unpack_frame)
"""The identifier, 4 bytes, most significant first; flags, 1 byte (1 extended, 2 error); the data."""

MODBUS_CODEC = UnitCodec("modbus", _pack_modbus, _unpack_modbus)
"""JSON of the unit's kind and fields."""


def make_codec(settings: DriverSettings) -> UnitCodec[Any]:
    """Return how the units of a driver's line are recorded."""
    if isinstance(settings.line, lines.CanSettings):
        return CAN_CODEC
    return MODBUS_CODEC if isinstance(settings.line, lines.ModbusSettings) else BYTES_CODEC


def make_link(settings: DriverSettings) -> Link[Any]:
    """Return a driver's line, not opened yet."""
    line = settings.line
    # each kind of line needs another library, and some of them are slow to load
    if isinstance(line, lines.SerialSettings):
        from msdrivers.links.serial_port import SerialLink

        return SerialLink(line.port, choose_first_baud(settings))
    if isinstance(line, lines.CanSettings):
        from msdrivers.links.can_bus import CanLink

        return CanLink(line.can, line.interface, line.bitrate)
    from msdrivers.links.tcp import TcpLink

    link = TcpLink(*lines.split_address(line.address))
    if isinstance(line, lines.TcpSettings):
        return link
    from msdrivers.links.modbus import ModbusLink

    return ModbusLink(link, line.unit_id)


def choose_first_baud(settings: DriverSettings) -> int:
    """Return the rate to open a serial port at: the first to be tried, the port's, or the maker's."""
    bauds = getattr(settings.device_settings, BAUDS_FIELD, ())
    given = settings.line.baud if isinstance(settings.line, lines.SerialSettings) else 0
    return bauds[0] if bauds else given or settings.kind.baud


def make_driver(driver: DriverSettings, folder: Path) -> Endpoint[Any]:
    """Return a driver's station; paths in its settings start from `folder`. Raises ConfigError."""
    with _locate_errors(driver):
        return driver.kind.load().make_driver(driver.device_settings, folder)


def make_emulator(
    driver: DriverSettings,
    folder: Path,
    samples: Iterable[Any],
    faults: tuple[InjectedFault, ...] = (),
) -> Endpoint[Any]:
    """Return the endpoint of the emulated device; see `EmulatorInputs`. Raises ConfigError."""
    with _locate_errors(driver):
        return driver.kind.make_emulator(EmulatorInputs(driver.device_settings, folder, samples, faults))


@contextmanager
def _locate_errors(driver: DriverSettings) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        raise ConfigError(driver.source_map.locate_problems(driver.name, error.problems)) from None


def find_unbuildable_drivers(drivers: Iterable[DriverSettings], folder: Path) -> Iterator[Problem]:
    """Yield the problems of drivers that cannot be made: a missing DBC file, an unknown signal; and of their files."""
    for driver in drivers:
        try:
            yield from getattr(make_driver(driver, folder), "problems", ())
        except ConfigError as error:
            yield from error.problems


def find_shared_lines(drivers: Iterable[DriverSettings]) -> Iterator[Problem]:
    """Yield lines that several drivers use exclusively; a CAN bus can be shared."""
    owners: dict[Hashable, str] = {}
    for driver in drivers:
        owned = _exclusive_resource(driver.line)
        owner = driver.name if owned is None else owners.setdefault(owned, driver.name)
        if owner != driver.name:
            source = driver.source_map.locate("drivers", driver.name, lines.get_line_key(type(driver.line)))
            message = f"drivers {owner} and {driver.name} have one line, {driver.line}: only one of them can use it"
            yield Problem(Severity.WARNING, message, source, "give each a line of its own, or start only one of them")


def _exclusive_resource(line: lines.LineSettings) -> Hashable | None:
    if isinstance(line, lines.CanSettings):
        return None
    if isinstance(line, lines.SerialSettings):
        # a port has several names, e.g. below /dev/serial/by-id/
        return os.path.realpath(line.port)
    return (line.address, line.unit_id) if isinstance(line, lines.ModbusSettings) else line.address


def find_unknown_wheels(driver: DriverSettings, frames: Collection[str]) -> Iterator[Problem]:
    """Yield wheels that are not in `sensors.wheels.frames`; none if that is empty."""
    wheels = tuple(getattr(driver.device_settings, "wheels", ()))
    for name in wheels if frames else ():
        if name in frames:
            continue
        what = f"sensors.wheels.frames has no {quote(name)}: what is measured of this wheel is not used"
        # a wheel there that this driver does not measure is meant: but which of the two names is the misspelled one?
        left = [frame for frame in frames if frame not in wheels]
        near = find_suggestion(name, left)
        if near:
            fix = f"write one name in both places: here it is {quote(name)}, in sensors.wheels.frames {quote(near)}"
        else:
            fix = f"known: {', '.join(list(frames)[:10])}"
        yield Problem(Severity.WARNING, what, driver.source_map.locate("drivers", driver.name, "wheels", name), fix)


def find_backward_counters(driver: DriverSettings) -> Iterator[Problem]:
    """Yield the wheels whose count falls as they roll forward."""
    for name, wheel in getattr(driver.device_settings, "wheels", {}).items():
        if wheel.count is not None and wheel.count.meters_per_count < 0.0:
            why = (
                f"wheel {name} rolls backward as its count rises: meters_per_count is {wheel.count.meters_per_count:g}"
            )
            source = driver.source_map.locate("drivers", driver.name, "wheels", name)
            yield Problem(
                Severity.WARNING, why, source, "right for an encoder that is mounted mirrored, else drop the sign"
            )


def find_unknown_joint(driver: DriverSettings, constraints: Collection[str]) -> Iterator[Problem]:
    """Yield the joints that are no constraints of the geometry."""
    settings = driver.device_settings
    places = {joint: ("joint",) for joint in [getattr(settings, "joint", "")] if joint}
    places |= {joint: ("joints", joint) for joint in getattr(settings, "joints", ())}
    for joint, place in places.items():
        if joint in constraints:
            continue
        what = f"the geometry has no constraint {quote(joint)}: what is measured of this joint moves nothing"
        near = suggest_name(joint, constraints)
        fix = f"write {near[0]}" if near else f"known: {', '.join(list(constraints)[:10]) or 'none'}"
        yield Problem(Severity.WARNING, what, driver.source_map.locate("drivers", driver.name, *place), fix, near)
