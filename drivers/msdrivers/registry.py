"""The kinds of devices: one table of name, lines, settings, driver and emulator; and the settings of a line.

A kind's modules are named in the table and imported on demand, so that a driver does not load those of other devices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from modelserver.errors import ConfigError, Location, Problem, Severity, Suggestion, quote, suggest_name
from modelserver.files import read_regular
from modelserver.messages import GpsSample, ImuSample, JointsSample, Sample, VehicleStatusSample, WheelsSample
from modelserver.plugins import PluginRegistry
from msdrivers.emulate import FAULT_AMOUNTS, FaultInjector, InjectedFault
from msdrivers.endpoint import Endpoint

if TYPE_CHECKING:
    from msdrivers.devices.can import CanDatabase


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """A serial port: its path, and symbols a second; 0: what the device has from its maker."""

    port: str
    baud: int = 0

    def __post_init__(self) -> None:
        if not self.port:
            raise ValueError("port is the path of a serial port, e.g. /dev/ttyUSB0; modelserver driver --list")
        if self.baud and not 50 <= self.baud <= 4_000_000:
            raise ValueError(f"baud is between 50 and 4000000, got {self.baud}")

    def __str__(self) -> str:
        return f"{self.port}, {self.baud} baud" if self.baud else self.port


@dataclass(frozen=True, slots=True)
class TcpSettings:
    """A device server: `HOST:PORT`."""

    address: str

    def __post_init__(self) -> None:
        split_address(self.address)

    def __str__(self) -> str:
        return f"TCP {self.address}"


@dataclass(frozen=True, slots=True)
class CanSettings:
    """A CAN bus: its channel as its interface names it, python-can's name of the interface, bits a second.

    bitrate 0: the interface is set up already, as socketcan's are by `ip link`.
    """

    can: str
    interface: str = "socketcan"
    bitrate: int = 0

    def __post_init__(self) -> None:
        if why := find_interface_problem(self.interface):
            raise ValueError(f"interface {why}")
        if why := find_channel_problem(self.can, self.interface):
            raise ValueError(f"can {why}")
        if not 0 <= self.bitrate <= 10_000_000:
            raise ValueError(f"bitrate is 0 (set up already) to 10000000 bits a second, got {self.bitrate}")

    def __str__(self) -> str:
        return f"{self.interface} {self.can}" + (f", {self.bitrate} bit/s" if self.bitrate else "")


@dataclass(frozen=True, slots=True)
class ModbusSettings:
    """A Modbus/TCP server: `HOST:PORT`, the port customarily 502, and the number of the device behind it."""

    address: str
    unit_id: int = 1

    def __post_init__(self) -> None:
        split_address(self.address)
        if not 0 <= self.unit_id <= 255:
            raise ValueError(f"unit_id is between 0 and 255, got {self.unit_id}")

    def __str__(self) -> str:
        return f"Modbus {self.address}, unit {self.unit_id}"


@dataclass(frozen=True, slots=True)
class NtripSettings:
    """A caster and its mountpoint. Raises ValueError for an invalid value."""

    caster: str
    """`HOST:PORT` of the caster; the port is customarily 2101, with TLS 2102 or 443."""
    mountpoint: str
    """Name of the stream."""
    user: str = ""
    """User name; empty for none."""
    password: str = ""
    """Password."""
    gga_period: float | None = None
    """Seconds between positions that are sent to the caster, which networks of stations (VRS) need; None: 10 for a
    stream that sends nothing and needs them by the source table; 0: none."""
    tls: bool = False
    """Whether the caster's port is one with TLS; without it the password is sent readable."""

    def __post_init__(self) -> None:
        try:
            split_address(self.caster)
        except ValueError:
            raise ValueError(f"caster is HOST:PORT, e.g. rtk.example.org:2101, got {quote(self.caster)}") from None
        if not self.mountpoint or not self.mountpoint.isprintable() or set(self.mountpoint) & set(" /\r\n"):
            raise ValueError(f"mountpoint is the name of a stream, got {quote(self.mountpoint)}")
        if self.gga_period is not None and not (self.gga_period == 0.0 or 1.0 <= self.gga_period <= 3600.0):
            raise ValueError(f"gga_period is 0 or 1 to 3600 s, got {self.gga_period:g}")


LineSettings: TypeAlias = SerialSettings | TcpSettings | CanSettings | ModbusSettings


def get_line_key(kind: type[LineSettings]) -> str:
    return dataclasses.fields(kind)[0].name


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT`. Raises ValueError."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"address is HOST:PORT, e.g. 192.168.1.10:3001, got {quote(address)}")
    return host.strip("[]"), int(port)


MULTICAST = "udp_multicast"
"""The interface that carries frames over UDP, for trials without hardware: its channel is GROUP:PORT."""

MULTICAST_PORT = 43113
"""python-can's own, where a channel names none."""

MAX_INTERFACE_NAME = 15
"""Characters in the name of a network interface, IFNAMSIZ - 1 in linux/if.h."""


def find_interface_problem(interface: str) -> str:
    """Return why python-can has no interface of a name; empty where it has one."""
    from can import VALID_INTERFACES

    if interface in VALID_INTERFACES:
        return ""
    near = suggest_name(interface, VALID_INTERFACES)
    fix = f"write {near[0]}" if near else f"known: {', '.join(sorted(VALID_INTERFACES))}"
    return f"{quote(interface)} is no interface of python-can's; {fix}"


def find_channel_problem(channel: str, interface: str) -> str:
    """Return why a CAN interface cannot have a channel; empty where it can, or nothing is known of its channels."""
    try:
        split_group(channel)
        why = ""
    except ValueError as error:
        why = str(error)
    if interface == MULTICAST:
        return why
    if interface != "socketcan":
        return "" if channel else "is the channel as the interface names it, got nothing"
    if not why:
        fix = f"add interface: {MULTICAST}, or to modelserver emulate --interface {MULTICAST}"
        return f"{quote(channel)} is a group of IP multicast; {fix}"
    if not 0 < len(channel) <= MAX_INTERFACE_NAME or not channel.isprintable() or set(channel) & set("/: "):
        return f"is the name of a network interface, e.g. can0, got {quote(channel)}"
    return ""


def split_group(channel: str) -> tuple[str, int]:
    """Return group (IPv4) and port of `GROUP:PORT` or `GROUP`. Raises ValueError."""
    group, colon, number = channel.partition(":")
    try:
        port = int(number) if colon else MULTICAST_PORT
        is_group = ip_address(group).is_multicast and 0 < port < 65536
    except ValueError:
        is_group = False
    if not is_group:
        raise ValueError(f"is GROUP:PORT with {MULTICAST}, e.g. 239.74.163.2:{MULTICAST_PORT}, got {quote(channel)}")
    return group, port


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


def _make_kind(
    name: str,
    description: str,
    sample: type[Sample],
    lines: tuple[type[LineSettings], ...],
    driver: str,
    baud: int = 0,
    **more: Any,
) -> DeviceKind:
    """Return a kind of `msdrivers.devices`; its driver is given as MODULE.PREFIX, and imported on demand."""
    module, _, prefix = driver.rpartition(".")

    def load_databases(settings: Any, folder: Path) -> tuple[CanDatabase, ...]:
        return (_load_dbc(settings, folder),) if CanSettings in lines else ()

    def load() -> DeviceModules:
        device = import_module(f"msdrivers.devices.{module}")
        make = getattr(device, f"{prefix}Driver")
        return DeviceModules(
            getattr(device, f"{prefix}Settings"), lambda values, folder: make(values, *load_databases(values, folder))
        )

    def make_emulator(inputs: EmulatorInputs) -> Endpoint[Any]:
        emulators = import_module(f"msdrivers.emulate.{_EMULATORS.get(sample, 'vehicle')}").EMULATORS
        # one series for the device before and after a restart
        parts = (inputs.settings, iter(inputs.samples), *load_databases(inputs.settings, inputs.folder))
        return FaultInjector(lambda: emulators[name](*parts), inputs.faults)

    return DeviceKind(name, description, sample, lines, load, make_emulator, baud, **more)


def _load_dbc(settings: Any, folder: Path) -> CanDatabase:
    """Load the DBC file of a driver's settings. Raises ConfigError."""
    from msdrivers.devices.can import MAX_DBC_CHARS, parse_dbc

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


_EMULATORS: Mapping[type[Sample], str] = {GpsSample: "gps", ImuSample: "imu"}
"""Module of the emulators below `msdrivers.emulate`; the others are of the vehicle."""

_CAN_FAULTS = {**FAULT_AMOUNTS, "jump": "counts by which counters jump", "bus_off": "seconds for which the bus is left"}
_GX1_FAULTS = {**FAULT_AMOUNTS, "jump": "ticks by which its time jumps"}
_AXIS_FAULTS = {
    **FAULT_AMOUNTS,
    "jump": "degrees by which its angle jumps",
    "exception": "the code that a request gets",
}

_GPS, _NOVATEL, _NMEA = "gps.driver.Gps", {"protocol": "novatel"}, {"protocol": "nmea"}

_TEXT_IMU_EXAMPLE = (
    "columns: 7   # MEASURE: the columns of a line: time, force x y z, rate x y z",
    "fields:",
    "  time: {column: 0, scale: 0.001}   # milliseconds",
    "  specific_force_x: {column: 1, scale: 9.80665}   # g",
    "  specific_force_y: {column: 2, scale: 9.80665}",
    "  specific_force_z: {column: 3, scale: 9.80665}",
    "  angular_velocity_x: {column: 4, scale: 0.0174533}   # degrees per second",
    "  angular_velocity_y: {column: 5, scale: 0.0174533}",
    "  angular_velocity_z: {column: 6, scale: 0.0174533}",
)

_BYTES: tuple[type[LineSettings], ...] = (SerialSettings, TcpSettings)
_CAN = (CanSettings,)

_KINDS = (
    _make_kind(
        "ublox", "u-blox receiver, by its protocol UBX", GpsSample, _BYTES, "ublox.Ublox", 38400, takes_corrections=True
    ),
    _make_kind(
        "novatel", "NovAtel OEM4 and heirs", GpsSample, _BYTES, _GPS, 9600, presets=_NOVATEL, takes_corrections=True
    ),
    _make_kind(
        "nmea", "receiver that speaks NMEA 0183", GpsSample, _BYTES, _GPS, 4800, presets=_NMEA, takes_corrections=True
    ),
    _make_kind("gpsd", "gpsd, by its JSON reports", GpsSample, (TcpSettings,), "gpsd.Gpsd"),
    _make_kind(
        "gx1",
        "MicroStrain 3DM-GX1 inertial unit",
        ImuSample,
        _BYTES,
        "gx1.Gx1",
        38400,
        faults=_GX1_FAULTS,
        has_z_down=True,
    ),
    _make_kind(
        "vectornav", "VectorNav VN-100 inertial unit", ImuSample, _BYTES, "vectornav.Vectornav", 115200, has_z_down=True
    ),
    _make_kind("xsens", "Xsens MTi inertial unit", ImuSample, _BYTES, "xsens.Xsens", 115200),
    _make_kind(
        "text_imu",
        "inertial unit that sends lines of text",
        ImuSample,
        _BYTES,
        "text.TextImu",
        115200,
        example=_TEXT_IMU_EXAMPLE,
    ),
    _make_kind("wheels", "wheels on a CAN bus, by a DBC file", WheelsSample, _CAN, "wheels.Wheels", faults=_CAN_FAULTS),
    _make_kind(
        "vehicle",
        "vehicle controller on a CAN bus, by a DBC file",
        VehicleStatusSample,
        _CAN,
        "vehicle.Vehicle",
        command_channel="VEHICLE_COMMAND",
        faults=_CAN_FAULTS,
    ),
    _make_kind(
        "text_joints",
        "pan-tilt head or other joints that send lines of text",
        JointsSample,
        _BYTES,
        "text.TextJoints",
        115200,
        follows_samples=False,
    ),
    _make_kind(
        "axis",
        "nodding axis behind Modbus/TCP",
        JointsSample,
        (ModbusSettings,),
        "axis.Axis",
        follows_samples=False,
        faults=_AXIS_FAULTS,
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
