"""Service, drivers and emulated devices of a vehicle as processes, on lines of this machine.

For emulated devices, the processes use a copy of the vehicle file whose drivers are connected to them.
"""

from __future__ import annotations

import contextlib
import shlex
import socket
import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import yaml

from modelserver.wire.provider import make_route_command
from mstools.launch.processes import MODELSERVER, ChildProcesses, LaunchError
from mstools.terminal.output import write_file

BUS_GROUP = "239.255.76.67"
"""LCM's multicast group."""

CAN_GROUP = "239.74.163.2"
"""Multicast group of python-can's bus over UDP."""

STATE_FOLDER = "state"
"""Folder of the state, below that of the copied vehicle file."""

PROBE_TIMEOUT_S = 1.0
"""Timeout for a datagram over loopback, seconds."""


@dataclass(frozen=True, slots=True)
class EmulatedConnections:
    """LCM provider, vehicle file, and the options of `modelserver emulate` for each of its drivers.

    `url` is empty if the vehicle file has it.
    """

    url: str
    vehicle: Path
    devices: Mapping[str, tuple[str, ...]]


LEAD_S: Final = 1.5
LEAD_FACTOR: Final = 0.5
"""Time from the start of the emulated devices to the drive, plus this fraction of the loading time of the processes
before, which measures how slow the machine is. The vehicle is stationary at first, so a late device misses nothing."""

SERVICE: Final = "service"
"""Name of the daemon among the processes; a driver has its own, and its emulated device that name and " device"."""


def start_programs(
    children: ChildProcesses, vehicle: Path, drivers: Iterable[str], options: Sequence[str] = ()
) -> list[str]:
    """Start the service of a vehicle file and its drivers, a process each; return their command lines."""
    # a driver may be named as the service is
    programs = [(SERVICE, ("run",)), *((name, ("driver", name)) for name in drivers)]
    return [_start(children, name, (*words, "-c", str(vehicle), *options)) for name, words in programs]


def start_devices(
    children: ChildProcesses,
    lines: EmulatedConnections,
    start_utime: int,
    options: Sequence[str] = (),
    faults: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> list[str]:
    """Start an emulator for each device, a process each, on one drive; return their command lines.

    `start_utime` is that of the drive, `faults` has more options for some devices.
    """
    together = ("--start", str(start_utime), *options)
    words = {
        name: ("emulate", name, "-c", str(lines.vehicle), *line, *together, *faults.get(name, ()))
        for name, line in lines.devices.items()
    }
    return [_start(children, f"{name} device", each, is_last=True) for name, each in words.items()]


def get_start_utime(loading_time: float) -> int:
    """Return when a drive may begin, if the processes before its devices took so many seconds to load."""
    return round((time.time() + LEAD_S + LEAD_FACTOR * loading_time) * 10) * 100_000


def _start(children: ChildProcesses, name: str, words: tuple[str, ...], *, is_last: bool = False) -> str:
    children.start(name, *MODELSERVER, *words, is_last=is_last)
    return shlex.join(("modelserver", *words))


def make_connections(vehicle: Path, folder: Path, *, own_bus: bool) -> EmulatedConnections:
    """Write a copy of a vehicle file into `folder` whose drivers use free local connections.

    Serial ports become pseudo-terminals, CAN buses one bus over UDP, TCP servers those of loopback. Paths of files that
    are read become absolute; state and journal are below `folder`. `own_bus`: LCM on a free port of loopback, so that a
    running vehicle is not disturbed. Raises OSError, and LaunchError if multicast does not work.
    """
    content = yaml.safe_load(vehicle.read_text(encoding="utf-8"))

    def make_absolute(section: Any, key: str) -> None:
        if isinstance(section, dict) and section.get(key):
            section[key] = str((vehicle.parent / Path(section[key]).expanduser()).resolve())

    make_absolute(content, "geometry")
    make_absolute(content.get("commands"), "key_file")
    content["state_directory"] = STATE_FOLDER
    if isinstance(journal := content.get("journal"), dict) and journal.get("directory"):
        journal["directory"] = Path(journal["directory"]).name
    devices: dict[str, tuple[str, ...]] = {}
    with contextlib.ExitStack() as held:
        url = f"udpm://{BUS_GROUP}:{_find_multicast_port(BUS_GROUP, held)}?ttl=0" if own_bus else ""
        drivers = content.get("drivers") or {}
        bus = ""
        if any("can" in driver for driver in drivers.values()):
            bus = f"{CAN_GROUP}:{_find_multicast_port(CAN_GROUP, held)}"
        for name, driver in drivers.items():
            devices[name] = _redirect_driver(driver, (folder / name).resolve(), bus, held)
            make_absolute(driver, "dbc")
    path = folder / "vehicle.yaml"
    write_file(str(path), yaml.safe_dump(content, sort_keys=False), replace=True)
    return EmulatedConnections(url, path, devices)


def _redirect_driver(driver: dict[str, Any], port: Path, bus: str, held: contextlib.ExitStack) -> tuple[str, ...]:
    """Change a driver's connection; return the options of its emulator."""
    # no corrections from a network for an emulated receiver
    driver.pop("ntrip", None)
    if "can" in driver:
        driver |= {"can": bus, "interface": "udp_multicast"}
        return ("--can", bus)
    if "port" in driver:
        driver["port"] = str(port)
        return ("--pty", "--link", str(port))
    number = _reserve_port(socket.SOCK_STREAM, held)
    driver["address"] = f"127.0.0.1:{number}"
    return ("--tcp", str(number))


def _find_multicast_port(group: str, held: contextlib.ExitStack) -> int:
    """Return a free UDP port of a working multicast group. Raises LaunchError if it does not work."""
    port = _reserve_port(socket.SOCK_DGRAM, held)
    if not has_multicast_loopback(group, port):
        raise LaunchError(
            f"multicast does not work on this machine: a datagram to {group} is not received. LCM and CAN over UDP "
            "need it. Try: sudo ip link set lo up "
            f"multicast on && sudo {make_route_command(group)}"
        )
    return port


def _reserve_port(kind: socket.SocketKind, held: contextlib.ExitStack) -> int:
    """Return a free port, so that two demos, or a demo and a vehicle, do not share a bus.

    It is reserved until `held` is closed, so that the next call returns another.
    """
    probe = held.enter_context(socket.socket(socket.AF_INET, kind))
    # the multicast probe must be able to share it meanwhile
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    probe.bind(("127.0.0.1", 0))
    return int(probe.getsockname()[1])


def has_multicast_loopback(group: str, port: int) -> bool:
    """Return whether a datagram to a multicast group is received on this machine."""
    word = b"modelserver demo"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            receiver.bind(("", port))
            membership = struct.pack("=4sl", socket.inet_aton(group), socket.INADDR_ANY)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            receiver.settimeout(PROBE_TIMEOUT_S)
            receiver.sendto(word, (group, port))
            return receiver.recv(64) == word
    except OSError:
        return False
