"""Registry of the kinds of devices: settings, lines, drivers, emulators.

A kind's modules are imported on demand, so that a driver does not load those of other devices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from modelserver.errors import ConfigError, Location, Problem, Severity, Suggestion, quote, suggest_name
from modelserver.files import read_regular
from modelserver.messages import GpsSample, ImuSample, JointsSample, Sample, VehicleStatusSample, WheelsSample
from modelserver.plugins import PluginRegistry
from msdrivers.emulate.faults import FAULT_AMOUNTS, FaultInjector, InjectedFault
from msdrivers.endpoint import Endpoint
from msdrivers.line_settings import CanSettings, LineSettings, ModbusSettings, SerialSettings, TcpSettings

if TYPE_CHECKING:
    from msdrivers.protocol.can.database import CanDatabase

CHANNELS: Mapping[type[Sample], str] = {
    GpsSample: "GPS",
    ImuSample: "IMU",
    WheelsSample: "WHEELS",
    JointsSample: "JOINTS",
    VehicleStatusSample: "VEHICLE_STATUS",
}
"""Default channel of each type of sample."""


class DeviceModules(NamedTuple):
    """Contents of a kind's modules.

    settings: dataclass of the device's settings. Its field `source` is the driver's name, `bauds` the rates to try,
    `joint` a constraint of the geometry, `wheels` the wheels by name.
    make_driver: makes the driver from the settings and the folder of relative paths; raises ConfigError.
    """

    settings: type
    make_driver: Callable[[Any, Path], Endpoint[Any]]


class EmulatorInputs(NamedTuple):
    """Inputs of an emulator: the driver's settings, their folder, samples in the order of their stamps.

    faults: of the kinds in `DeviceKind.faults`.
    """

    settings: Any
    folder: Path
    samples: Iterable[Any]
    faults: tuple[InjectedFault, ...] = ()


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A kind of device.

    sample: type of its main sample, which also drives its emulator. lines: types of line, the usual one first.
    load, make_emulator: import its modules. baud: factory setting. presets: settings that the kind implies.
    command_channel: channel of the commands that it accepts, empty for none. faults: kinds of faults of its emulator
    and the meaning of their amounts. follows_samples: the emulator's state comes from samples, not from commands.
    has_z_down: z of its own axes points down when it is mounted upright. example: further lines of its section, which
    it needs. takes_corrections: what it gets on its line may be corrections for it (RTCM).
    """

    name: str
    description: str
    sample: type[Sample]
    lines: tuple[type[LineSettings], ...]
    load: Callable[[], DeviceModules]
    make_emulator: Callable[[EmulatorInputs], Endpoint[Any]]
    baud: int = 0
    presets: Mapping[str, Any] = field(default_factory=dict)
    command_channel: str = ""
    faults: Mapping[str, str] = field(default_factory=lambda: FAULT_AMOUNTS)
    follows_samples: bool = True
    has_z_down: bool = False
    example: tuple[str, ...] = ()
    takes_corrections: bool = False


def _load(settings: str, driver: str, *, has_dbc: bool = False) -> DeviceModules:
    """Import the settings and the driver of a kind by their names below `msdrivers.devices`."""
    kind, make = (resolve_name(f"msdrivers.devices.{name}") for name in (settings, driver))
    return DeviceModules(kind, lambda values, folder: make(values, *([_load_dbc(values, folder)] if has_dbc else [])))


_load_gps = partial(_load, "gps.settings:GpsSettings", "gps.driver:GpsDriver")
_load_ublox = partial(_load, "ublox:UbloxSettings", "ublox:UbloxDriver")
_load_vectornav = partial(_load, "vectornav:VectornavSettings", "vectornav:VectornavDriver")
_load_xsens = partial(_load, "xsens:XsensSettings", "xsens:XsensDriver")
_load_gpsd = partial(_load, "gpsd:GpsdSettings", "gpsd:GpsdDriver")
_load_text_imu = partial(_load, "text_imu:TextImuSettings", "text_imu:TextImuDriver")
_load_text_joints = partial(_load, "text_joints:TextJointsSettings", "text_joints:TextJointsDriver")
_load_gx1 = partial(_load, "gx1.settings:Gx1Settings", "gx1.driver:Gx1Driver")
_load_wheels = partial(_load, "wheels:WheelsSettings", "wheels:WheelsDriver", has_dbc=True)
_load_vehicle = partial(_load, "vehicle:VehicleSettings", "vehicle:VehicleDriver", has_dbc=True)
_load_axis = partial(_load, "axis:AxisSettings", "axis:AxisDriver")


def _make_gps_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.gps import GpsEmulator, GpsUnit

    unit = GpsUnit()
    if wanted.settings.protocol == "nmea":
        period = 1.0 / wanted.settings.rate_hz
        saved = tuple(f"log com1 {sentence} ontime {period:g}" for sentence in ("gpgga", "gprmc", "gpgst"))
        unit = GpsUnit(saved=saved, is_answering=False)
    # one series for the receiver before and after a restart
    samples = iter(wanted.samples)
    return FaultInjector(lambda: GpsEmulator(samples, unit), wanted.faults)


def _make_ublox_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.ublox import UbloxEmulator, UbloxUnit

    unit = UbloxUnit()
    # one series for the receiver before and after a restart
    samples = iter(wanted.samples)
    return FaultInjector(lambda: UbloxEmulator(samples, unit), wanted.faults)


def _make_gpsd_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.gpsd import GpsdEmulator

    samples = iter(wanted.samples)
    return FaultInjector(lambda: GpsdEmulator(samples), wanted.faults)


def _make_text_imu_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.text_imu import TextImuEmulator

    samples = iter(wanted.samples)
    return FaultInjector(lambda: TextImuEmulator(samples, wanted.settings), wanted.faults)


def _make_text_joints_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.text_joints import TextJointsEmulator

    return FaultInjector(lambda: TextJointsEmulator(wanted.settings), wanted.faults)


def _make_vectornav_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.vectornav import VectornavEmulator

    samples = iter(wanted.samples)
    return FaultInjector(lambda: VectornavEmulator(samples), wanted.faults)


def _make_xsens_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.xsens import XsensEmulator, XsensUnit

    unit = XsensUnit(field_strength=wanted.settings.field_strength or 5e-5)
    samples = iter(wanted.samples)
    return FaultInjector(lambda: XsensEmulator(samples, unit), wanted.faults)


def _make_gx1_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.gx1 import Gx1Emulator, Gx1Unit

    return Gx1Emulator(wanted.samples, unit=Gx1Unit(faults=wanted.faults))


def _make_wheels_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.wheels import WheelsEmulator

    database = _load_dbc(wanted.settings, wanted.folder)
    return WheelsEmulator(wanted.settings.wheels, database, wanted.samples, wanted.faults)


def _make_vehicle_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.vehicle import VehicleEmulator

    settings, database = wanted.settings, _load_dbc(wanted.settings, wanted.folder)
    return VehicleEmulator(database, settings.status, settings.command, samples=wanted.samples, faults=wanted.faults)


def _make_axis_emulator(wanted: EmulatorInputs) -> Endpoint[Any]:
    from msdrivers.emulate.axis import AxisEmulator

    return AxisEmulator(wanted.settings.registers, faults=wanted.faults)


def _load_dbc(settings: Any, folder: Path) -> CanDatabase:
    """Load the DBC file of a driver's settings. Raises ConfigError."""
    from msdrivers.protocol.can.dbc_file import MAX_DBC_CHARS, parse_dbc

    path = Path(settings.dbc)
    file = folder / path.expanduser()
    try:
        # some tools write the degree sign in Latin-1
        text = read_regular(file, MAX_DBC_CHARS).decode("latin-1")
    except (OSError, ValueError) as error:
        # the name nearest to that of a file which is there is its own
        there = [each.name for each in file.parent.glob("*")] if isinstance(error, FileNotFoundError) else []
        near = Suggestion.of(settings.dbc, *(str(path.with_name(name)) for name in suggest_name(path.name, there)))
        fix = f"write {near[0]}" if near else "the path of a DBC file, relative to the vehicle file"
        message = f"the DBC file {quote(str(file), 200)} cannot be read: {getattr(error, 'strerror', None) or error}"
        place = Location(element=f"drivers.{settings.source}.dbc")
        raise ConfigError([Problem(Severity.ERROR, message, place, fix, near)]) from None
    return parse_dbc(text, str(file))


_CAN_FAULTS = {**FAULT_AMOUNTS, "jump": "counts by which counters jump", "bus_off": "seconds for which the bus is left"}

_BYTE_LINES: tuple[type[LineSettings], ...] = (SerialSettings, TcpSettings)

_KINDS = (
    DeviceKind(
        "ublox",
        "u-blox receiver, by its protocol UBX",
        GpsSample,
        _BYTE_LINES,
        _load_ublox,
        _make_ublox_emulator,
        38400,
        takes_corrections=True,
    ),
    *(
        DeviceKind(
            name,
            text,
            GpsSample,
            _BYTE_LINES,
            _load_gps,
            _make_gps_emulator,
            baud,
            presets={"protocol": name},
            takes_corrections=True,
        )
        for name, text, baud in (
            ("novatel", "NovAtel OEM4 and heirs", 9600),
            ("nmea", "receiver that speaks NMEA 0183", 4800),
        )
    ),
    DeviceKind("gpsd", "gpsd, by its JSON reports", GpsSample, (TcpSettings,), _load_gpsd, _make_gpsd_emulator),
    DeviceKind(
        "gx1",
        "MicroStrain 3DM-GX1 inertial unit",
        ImuSample,
        _BYTE_LINES,
        _load_gx1,
        _make_gx1_emulator,
        38400,
        faults={**FAULT_AMOUNTS, "restart": "has none", "jump": "ticks by which its time jumps"},
        has_z_down=True,
    ),
    DeviceKind(
        "vectornav",
        "VectorNav VN-100 inertial unit",
        ImuSample,
        _BYTE_LINES,
        _load_vectornav,
        _make_vectornav_emulator,
        115200,
        has_z_down=True,
    ),
    DeviceKind(
        "xsens",
        "Xsens MTi inertial unit",
        ImuSample,
        _BYTE_LINES,
        _load_xsens,
        _make_xsens_emulator,
        115200,
    ),
    DeviceKind(
        "text_imu",
        "inertial unit that sends lines of text",
        ImuSample,
        _BYTE_LINES,
        _load_text_imu,
        _make_text_imu_emulator,
        115200,
        example=(
            "columns: 7   # MEASURE: the columns of a line: time, force x y z, rate x y z",
            "fields:",
            "  time: {column: 0, scale: 0.001}   # milliseconds",
            "  specific_force_x: {column: 1, scale: 9.80665}   # g",
            "  specific_force_y: {column: 2, scale: 9.80665}",
            "  specific_force_z: {column: 3, scale: 9.80665}",
            "  angular_velocity_x: {column: 4, scale: 0.0174533}   # degrees per second",
            "  angular_velocity_y: {column: 5, scale: 0.0174533}",
            "  angular_velocity_z: {column: 6, scale: 0.0174533}",
        ),
    ),
    DeviceKind(
        "wheels",
        "wheels on a CAN bus, by a DBC file",
        WheelsSample,
        (CanSettings,),
        _load_wheels,
        _make_wheels_emulator,
        faults=_CAN_FAULTS,
    ),
    DeviceKind(
        "vehicle",
        "vehicle controller on a CAN bus, by a DBC file",
        VehicleStatusSample,
        (CanSettings,),
        _load_vehicle,
        _make_vehicle_emulator,
        command_channel="VEHICLE_COMMAND",
        faults=_CAN_FAULTS,
    ),
    DeviceKind(
        "text_joints",
        "pan-tilt head or other joints that send lines of text",
        JointsSample,
        _BYTE_LINES,
        _load_text_joints,
        _make_text_joints_emulator,
        115200,
        follows_samples=False,
    ),
    DeviceKind(
        "axis",
        "nodding axis behind Modbus/TCP",
        JointsSample,
        (ModbusSettings,),
        _load_axis,
        _make_axis_emulator,
        follows_samples=False,
        faults={
            **FAULT_AMOUNTS,
            "jump": "degrees by which its angle jumps",
            "exception": "the code that a request gets",
        },
    ),
)

PLUGIN_GROUP = "modelserver.drivers"
"""Group of the entry points by which an installed package adds kinds of devices."""


def _find_fault(name: str, loaded: Any) -> str:
    """Return why an object is not the kind of device of a name; empty if it is."""
    return "" if isinstance(loaded, DeviceKind) and loaded.name == name else f"is no DeviceKind of the name {name}"


def make_registry(
    own: Iterable[DeviceKind], find_entry_points: Callable[[], Iterable[Any]] | None = None
) -> PluginRegistry[DeviceKind]:
    """Make a registry of these kinds and of those of installed packages."""
    return PluginRegistry(PLUGIN_GROUP, _find_fault, {kind.name: kind for kind in own}, find_entry_points)


KINDS = make_registry(_KINDS)
"""Kinds of devices by the name that a vehicle file gives as `device`."""
