"""Reading off the machine what `probe` judges: network interfaces, kernel buffers, clocks."""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import ClassVar, Final

from modelserver.errors import BusError
from modelserver.service.probing.clock import ClockFacts
from modelserver.service.probing.probe import BusFacts, Interface, UdpAddress, udp_address
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

_SIOCGIFFLAGS: Final = 0x8913
_IFF_UP, _IFF_LOOPBACK, _IFF_MULTICAST = 0x1, 0x8, 0x1000
"""netdevice(7)."""

_RTF_UP: Final = 0x1
"""route(8): the route counts."""

_STA_UNSYNC: Final = 0x40
_TIME_ERROR: Final = 5
"""adjtimex(2)."""

PROC: Final = Path("/proc")


def bus_facts(url: str, delivery: Callable[[str], tuple[bool, bool]] | None = None, proc: Path = PROC) -> BusFacts:
    """Return what the machine says of the bus at `url`.

    `delivery` sends messages to ourselves there: did a short and a long one come back?
    """
    address = udp_address(url)
    if address is None:
        return BusFacts(url, None)
    found = tuple(interfaces())
    way = route_to(address, proc)
    heard: bool | None = None
    heard_large: bool | None = None
    if way is not None and delivery is not None:
        try:
            heard, heard_large = delivery(url)
        except BusError:
            heard = False
    return BusFacts(
        url,
        address,
        None if way is None else next((each for each in found if each.name == way), Interface(way)),
        found,
        heard,
        heard_large,
        buffer_given(address.buffer or RECEIVE_BUFFER_BYTES),
        _number(proc / "sys/net/core/rmem_default"),
        dropped_at(address.port, proc),
    )


def interfaces() -> Iterator[Interface]:
    """Yield the network interfaces of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            try:
                flags = struct.unpack_from("16xH", _asked(asking, _SIOCGIFFLAGS, name))[0]
            except OSError:
                continue  # it went meanwhile
            yield Interface(name, bool(flags & _IFF_UP), bool(flags & _IFF_MULTICAST), bool(flags & _IFF_LOOPBACK))


def _asked(asking: socket.socket, what: int, name: str) -> bytes:
    return fcntl.ioctl(asking.fileno(), what, struct.pack("256s", name.encode()[:15]))


def route_to(address: UdpAddress, proc: Path = PROC) -> str | None:
    """Return the interface that packets to a group go through; empty: not known which, None: the kernel has no way."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            # connecting sends nothing: it has the kernel look for the way
            asking.connect((address.group, address.port))
            own = socket.inet_aton(asking.getpeername()[0])
        except OSError:
            return None
    try:
        lines = (proc / "net/route").read_text().splitlines()[1:]
    except OSError:
        return ""
    return _way(lines, int.from_bytes(own, sys.byteorder))


def _way(lines: Iterable[str], group: int) -> str:
    """Return the interface of the route that counts for an address, by /proc/net/route: numbers as in memory."""
    found = []
    for name, destination, _, flags, _, _, metric, mask, *_ in (line.split() for line in lines if line.count("\t") > 7):
        if int(flags, 16) & _RTF_UP and group & int(mask, 16) == int(destination, 16):
            # the longest mask counts, and of equals the least metric
            found.append((-int(mask, 16).bit_count(), int(metric), name))
    return min(found)[2] if found else ""


def buffer_given(asked: int) -> int:
    """Return how many bytes the kernel gives a socket that asks for so many."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trying:
        trying.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, asked)
        # the kernel doubles what it was asked for, for its own needs, and tells the double (socket(7))
        return trying.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def dropped_at(port: int, proc: Path = PROC) -> int | None:
    """Return how many packets the sockets on a port have lost; None where the kernel does not tell."""
    try:
        lines = (proc / "net/udp").read_text().splitlines()[1:]
    except OSError:
        return None
    rows = [line.split() for line in lines]
    return sum(int(row[-1]) for row in rows if len(row) > 12 and int(row[1].rpartition(":")[2], 16) == port)


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


class _Timeval(ctypes.Structure):
    _fields_: ClassVar = [("seconds", ctypes.c_long), ("fraction", ctypes.c_long)]


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2), as far as it is read; the rest of it is room."""

    _fields_: ClassVar = [
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("constant", ctypes.c_long),
        ("precision", ctypes.c_long),
        ("tolerance", ctypes.c_long),
        ("time", _Timeval),
        ("tick", ctypes.c_long),
        ("room", ctypes.c_byte * 256),
    ]


def kernel_clock() -> tuple[bool | None, float | None]:
    """Return whether the kernel takes the time of day for synchronised, and its bound on the error, seconds."""
    found = _Timex()
    try:
        said = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(found))
    except (OSError, AttributeError):
        return None, None
    if said < 0:
        return None, None
    if said == _TIME_ERROR or found.status & _STA_UNSYNC:
        return False, None
    return True, found.maxerror * 1e-6


def time_keeper() -> str:
    """Return what is installed to keep the time: chrony, ntp, timesyncd, else nothing."""
    folders = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
    if shutil.which("chronyd", path=folders):
        return "chrony"
    if shutil.which("ntpd", path=folders):
        return "ntp"
    if any(Path(place, "systemd-timesyncd").exists() for place in ("/lib/systemd", "/usr/lib/systemd")):
        return "timesyncd"
    return ""


class ClockWatch:
    """Watches the time of day beside the monotonic clock from when it is made until `facts`."""

    def __init__(self) -> None:
        self._began = self._now()

    def facts(self) -> ClockFacts:
        """Return what the clocks said."""
        (real, steady), (real_now, steady_now) = self._began, self._now()
        watched = steady_now - steady
        synchronised, error = kernel_clock()
        slewed = (real_now - real - watched) * 1e-9
        return ClockFacts(real_now // 1000, synchronised, error, slewed, watched * 1e-9, time_keeper())

    @staticmethod
    def _now() -> tuple[int, int]:
        return time.time_ns(), time.monotonic_ns()
