"""What the vehicle file says of a driver's line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from modelserver.errors import shown


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


LineSettings: TypeAlias = SerialSettings | TcpSettings | CanSettings | ModbusSettings


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT`. Raises ValueError."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"address is HOST:PORT, e.g. 192.168.1.10:3001, got {shown(address)}")
    return host.strip("[]"), int(port)
