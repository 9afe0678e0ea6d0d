"""The kinds of devices there are: what each wants to know, on which lines it speaks, and what is made of it.

A kind's own modules are imported when they are needed, so that the driver of one device does not pay for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from modelserver.errors import ConfigError, Location, Problem, Severity, Suggested, shown, suggestions
from modelserver.messages import GpsSample, ImuSample, JointsSample, Sample, VehicleStatusSample, WheelsSample
from modelserver.regular_files import read_regular
from msdrivers.faults import FAULTS, InjectedFault
from msdrivers.line_settings import CanSettings, LineSettings, ModbusSettings, SerialSettings, TcpSettings
from msdrivers.station import Station

if TYPE_CHECKING:
    from msdrivers.protocol.can.database import CanDatabase

CHANNELS: Mapping[type[Sample], str] = {
    GpsSample: "GPS",
    ImuSample: "IMU",
    WheelsSample: "WHEELS",
    JointsSample: "JOINTS",
    VehicleStatusSample: "VEHICLE_STATUS",
}
"""The customary channel of what a device says."""


class DeviceModules(NamedTuple):
    """What a kind's modules hold.

    settings: the dataclass of its settings; a field `source` takes the driver's name, a field `bauds` the rates to try;
        a field `joint` names a constraint of the geometry, a field `wheels` has the wheels by their names.
    station: makes the driver from them and the folder that paths in them start from; raises ConfigError.
    """

    settings: type
    station: Callable[[Any, Path], Station[Any]]


class Emulation(NamedTuple):
    """What drives a device in software: its driver's settings, their folder, samples in the order of their stamps.

    faults: what is to go wrong, of the kinds that `DeviceKind.faults` names. memory: where a device that
    `DeviceKind.remembers` keeps what it was told to keep; None: nowhere.
    """

    settings: Any
    folder: Path
    samples: Iterable[Any]
    faults: tuple[InjectedFault, ...] = ()
    memory: Path | None = None


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A kind of device.

    sample: what it says in the main, and what its emulator is driven by. lines: what it may hang on, the usual one
    first. load, emulate: import its modules. baud: what its maker sets. presets: settings that the kind itself gives.
    commands: the channel whose messages it takes, empty for none. faults: what can go wrong with its emulator, and what
    the amount of each is. follows: its emulator is where the samples say, and not where it was commanded to go.
    remembers: its emulator can keep its memory in a file. hard_iron: it has a procedure by which it finds the vehicle's
    own magnetic field.
    """

    name: str
    about: str
    sample: type[Sample]
    lines: tuple[type[LineSettings], ...]
    load: Callable[[], DeviceModules]
    emulate: Callable[[Emulation], Station[Any]]
    baud: int = 0
    presets: Mapping[str, Any] = field(default_factory=dict)
    commands: str = ""
    faults: Mapping[str, str] = field(default_factory=lambda: FAULTS)
    follows: bool = True
    remembers: bool = False
    hard_iron: bool = False


def _gps() -> DeviceModules:
    from msdrivers.devices.gps import GpsDriver, GpsSettings

    return DeviceModules(GpsSettings, lambda settings, _: GpsDriver(settings))


def _gps_unit(wanted: Emulation) -> Station[Any]:
    from msdrivers.emulate.gps import GpsEmulator, GpsUnit
    from msdrivers.faulty import FaultyStation

    unit = GpsUnit()
    if wanted.settings.protocol == "nmea":
        period = 1.0 / wanted.settings.rate_hz
        saved = tuple(f"log com1 {sentence} ontime {period:g}" for sentence in ("gpgga", "gprmc", "gpgst"))
        unit = GpsUnit(saved=saved, answers=False)
    # one series for the receiver before and after a restart
    samples = iter(wanted.samples)
    return FaultyStation(lambda: GpsEmulator(samples, unit), wanted.faults)


def _gx1() -> DeviceModules:
    from msdrivers.devices.gx1 import Gx1Driver, Gx1Settings

    return DeviceModules(Gx1Settings, lambda settings, _: Gx1Driver(settings))


def _gx1_unit(wanted: Emulation) -> Station[Any]:
    from msdrivers.emulate.gx1 import Gx1Emulator
    from msdrivers.emulate.gx1_unit import Gx1Unit
    from msdrivers.emulate.gx1_unit import UnitFault as UnitFault
    from msdrivers.gx1_memory import read_eeprom, write_eeprom

    unit = Gx1Unit(faults=tuple(UnitFault(*each) for each in wanted.faults))
    if wanted.memory is None:
        return Gx1Emulator(wanted.samples, unit=unit)
    memory = wanted.memory
    return Gx1Emulator(wanted.samples, read_eeprom(memory), unit, lambda eeprom: write_eeprom(memory, eeprom))


def _wheels() -> DeviceModules:
    from msdrivers.devices.wheels import WheelsDriver, WheelsSettings

    return DeviceModules(WheelsSettings, lambda settings, folder: WheelsDriver(settings, _dbc(settings, folder)))


def _wheels_unit(wanted: Emulation) -> Station[Any]:
    from msdrivers.emulate.can_line import CanFault
    from msdrivers.emulate.wheels import WheelsEmulator

    faults = [CanFault(*each) for each in wanted.faults]  # type: ignore[arg-type]
    database = _dbc(wanted.settings, wanted.folder)
    return WheelsEmulator(wanted.settings.wheels, database, wanted.samples, faults)


def _vehicle() -> DeviceModules:
    from msdrivers.devices.vehicle import VehicleDriver
    from msdrivers.devices.vehicle_settings import VehicleSettings

    return DeviceModules(VehicleSettings, lambda settings, folder: VehicleDriver(settings, _dbc(settings, folder)))


def _vehicle_unit(wanted: Emulation) -> Station[Any]:
    from msdrivers.emulate.can_line import CanFault
    from msdrivers.emulate.vehicle import VehicleEmulator

    faults = [CanFault(*each) for each in wanted.faults]  # type: ignore[arg-type]
    settings, database = wanted.settings, _dbc(wanted.settings, wanted.folder)
    return VehicleEmulator(database, settings.status, settings.command, samples=wanted.samples, faults=faults)


def _axis() -> DeviceModules:
    from msdrivers.devices.axis import AxisDriver
    from msdrivers.devices.axis_settings import AxisSettings

    return DeviceModules(AxisSettings, lambda settings, _: AxisDriver(settings))


def _axis_unit(wanted: Emulation) -> Station[Any]:
    from msdrivers.emulate.axis import AxisEmulator, AxisFault

    faults = [AxisFault(*each) for each in wanted.faults]  # type: ignore[arg-type]
    return AxisEmulator(wanted.settings.registers, faults=faults)


def _dbc(settings: Any, folder: Path) -> CanDatabase:
    """Return what the DBC file of a driver's settings says. Raises ConfigError."""
    from msdrivers.protocol.can.database import MAX_TEXT, parse_dbc

    path = Path(settings.dbc)
    file = folder / path.expanduser()
    try:
        # some tools write the degree sign in Latin-1
        text = read_regular(file, MAX_TEXT).decode("latin-1")
    except (OSError, ValueError) as error:
        # the name nearest to that of a file which is there is its own
        there = [each.name for each in file.parent.glob("*")] if isinstance(error, FileNotFoundError) else []
        near = Suggested.of(settings.dbc, *(str(path.with_name(name)) for name in suggestions(path.name, there)))
        fix = f"write {near[0]}" if near else "the path of a DBC file, relative to the vehicle file"
        said = f"the DBC file {shown(str(file), 200)} cannot be read: {getattr(error, 'strerror', None) or error}"
        place = Location(element=f"drivers.{settings.source}.dbc")
        raise ConfigError([Problem(Severity.ERROR, said, place, fix, near)]) from None
    return parse_dbc(text, str(file))


_CAN_FAULTS = {**FAULTS, "jump": "counts by which counters jump", "bus_off": "seconds for which the bus is left"}

_BYTES: tuple[type[LineSettings], ...] = (SerialSettings, TcpSettings)

_ALL = (
    DeviceKind(
        "novatel", "NovAtel OEM4 and heirs", GpsSample, _BYTES, _gps, _gps_unit, 9600, presets={"protocol": "novatel"}
    ),
    DeviceKind(
        "nmea", "receiver that speaks NMEA 0183", GpsSample, _BYTES, _gps, _gps_unit, 4800, presets={"protocol": "nmea"}
    ),
    DeviceKind(
        "gx1",
        "MicroStrain 3DM-GX1 inertial unit",
        ImuSample,
        _BYTES,
        _gx1,
        _gx1_unit,
        38400,
        faults={**FAULTS, "restart": "has none", "jump": "ticks by which its time jumps"},
        remembers=True,
        hard_iron=True,
    ),
    DeviceKind(
        "wheels",
        "wheels on a CAN bus, by a DBC file",
        WheelsSample,
        (CanSettings,),
        _wheels,
        _wheels_unit,
        faults=_CAN_FAULTS,
    ),
    DeviceKind(
        "vehicle",
        "vehicle controller on a CAN bus, by a DBC file",
        VehicleStatusSample,
        (CanSettings,),
        _vehicle,
        _vehicle_unit,
        commands="VEHICLE_COMMAND",
        faults=_CAN_FAULTS,
    ),
    DeviceKind(
        "axis",
        "nodding axis behind Modbus/TCP",
        JointsSample,
        (ModbusSettings,),
        _axis,
        _axis_unit,
        follows=False,
        faults={**FAULTS, "jump": "degrees by which its angle jumps", "exception": "the code that a request gets"},
    ),
)

KINDS: Mapping[str, DeviceKind] = {kind.name: kind for kind in _ALL}
"""Kinds of devices by the name that a vehicle file gives as `device`."""
