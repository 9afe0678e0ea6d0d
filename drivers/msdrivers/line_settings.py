"""Settings of a driver's line in the vehicle file: serial port, TCP, CAN bus, Modbus/TCP."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from ipaddress import ip_address
from typing import ClassVar, TypeAlias

from modelserver.errors import quote, suggest_name


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """A serial port: its path, and symbols a second; 0: what the device has from its maker."""

    description: ClassVar[str] = "a serial port"
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

    description: ClassVar[str] = "a server"
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

    description: ClassVar[str] = "a CAN bus"
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

    description: ClassVar[str] = "a server"
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
    """`HOST:PORT` of the caster; the port is customarily 2101."""
    mountpoint: str
    """Name of the stream."""
    user: str = ""
    """User name; empty for none."""
    password: str = ""
    """Password."""
    gga_period: float = 0.0
    """Seconds between positions that are sent to the caster, which networks of stations (VRS) need; 0: none."""

    def __post_init__(self) -> None:
        try:
            split_address(self.caster)
        except ValueError:
            raise ValueError(f"caster is HOST:PORT, e.g. rtk.example.org:2101, got {quote(self.caster)}") from None
        if not self.mountpoint or not self.mountpoint.isprintable() or set(self.mountpoint) & set(" /\r\n"):
            raise ValueError(f"mountpoint is the name of a stream, got {quote(self.mountpoint)}")
        if not (self.gga_period == 0.0 or 1.0 <= self.gga_period <= 3600.0):
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
    """Return group and port of `GROUP:PORT` or `GROUP`; IPv6 with a port is `[GROUP]:PORT`. Raises ValueError."""
    found = _GROUP_PORT.fullmatch(channel)
    group, port = (found[1] or found[2], int(found[3] or MULTICAST_PORT)) if found else (channel, MULTICAST_PORT)
    try:
        is_group = ip_address(group).is_multicast
    except ValueError:
        is_group = False
    if not is_group or not 0 < port < 65536:
        raise ValueError(f"is GROUP:PORT with {MULTICAST}, e.g. 239.74.163.2:{MULTICAST_PORT}, got {quote(channel)}")
    return group, port


_GROUP_PORT = re.compile(r"(?:\[([^\]]+)\]|([^:\[\]]+))(?::([0-9]{1,5}))?")
"""IPv6 in brackets, or a group without a colon; an IPv6 group alone has none of either."""
