"""The lines of `modelserver demo`: a vehicle file whose drivers are led to emulated devices on this machine."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from modelserver.wire.multicast import route
from mstools.demo.children import DemoError

BUS_GROUP = "239.255.76.67"
"""LCM's multicast group."""

CAN_GROUP = "239.74.163.2"
"""That of python-can's bus over UDP."""

PROBE_SECONDS = 1.0
"""How long a datagram of one's own may take over loopback."""


@dataclass(frozen=True, slots=True)
class Lines:
    """LCM's provider, a vehicle file, and for each of its drivers what its emulator is told of the line."""

    url: str
    vehicle: Path
    devices: Mapping[str, tuple[str, ...]]


def lay_lines(vehicle: Path, folder: Path) -> Lines:
    """Write a copy of a vehicle file into `folder` whose drivers have lines on this machine alone, none of them in use.

    Serial ports become pseudo-terminals, CAN buses one bus over UDP, servers those of loopback. Raises OSError, and
    DemoError where multicast does not work.
    """
    content = yaml.safe_load(vehicle.read_text(encoding="utf-8"))
    content["geometry"] = str(vehicle.parent / content["geometry"])
    devices: dict[str, tuple[str, ...]] = {}
    with contextlib.ExitStack() as held:
        url = f"udpm://{BUS_GROUP}:{_checked(BUS_GROUP, held)}?ttl=0"
        bus = f"{CAN_GROUP}:{_checked(CAN_GROUP, held)}"
        for name, driver in content["drivers"].items():
            devices[name] = _led(driver, folder / name, bus, held)
            if "dbc" in driver:
                driver["dbc"] = str(vehicle.parent / driver["dbc"])
    path = folder / "vehicle.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return Lines(url, path, devices)


def _led(driver: dict[str, Any], port: Path, bus: str, held: contextlib.ExitStack) -> tuple[str, ...]:
    """Change a driver's line; return what its emulator is told of it."""
    if "can" in driver:
        driver |= {"can": bus, "interface": "udp_multicast"}
        return ("--can", bus)
    if "port" in driver:
        driver["port"] = str(port)
        return ("--pty", "--link", str(port))
    number = _free(socket.SOCK_STREAM, held)
    driver["address"] = f"127.0.0.1:{number}"
    return ("--tcp", str(number))


def _checked(group: str, held: contextlib.ExitStack) -> int:
    """Return a free UDP port on which a multicast group is heard. Raises DemoError where it is not."""
    port = _free(socket.SOCK_DGRAM, held)
    if not hears_itself(group, port):
        raise DemoError(
            f"multicast does not work on this machine: what is sent to {group} does not come back. The demo cannot do "
            "without: LCM needs it, and so does CAN over UDP. Try: sudo ip link set lo up "
            f"multicast on && sudo {route(group)}"
        )
    return port


def _free(kind: socket.SocketKind, held: contextlib.ExitStack) -> int:
    """Return a port that nobody uses, so that two demos, or a demo and a vehicle, do not hear each other.

    It is held until `held` is closed, so that the next call gives another.
    """
    probe = held.enter_context(socket.socket(socket.AF_INET, kind))
    # one that hears itself must be able to share it meanwhile
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    probe.bind(("127.0.0.1", 0))
    return int(probe.getsockname()[1])


def hears_itself(group: str, port: int) -> bool:
    """Return whether what is sent to a multicast group comes back on this machine."""
    word = b"modelserver demo"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
            ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            ear.bind(("", port))
            everywhere = struct.pack("=4sl", socket.inet_aton(group), socket.INADDR_ANY)
            ear.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, everywhere)
            ear.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            ear.settimeout(PROBE_SECONDS)
            ear.sendto(word, (group, port))
            return ear.recv(64) == word
    except OSError:
        return False
