"""Read facts off the machine: resources of the process, network interfaces, kernel buffers, clocks.

`checks` evaluates them.
"""

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
from typing import Final

from modelserver.errors import BusError
from modelserver.messages import Gauges
from modelserver.server.diagnostics.checks import BusFacts, ClockFacts, NetworkInterface
from modelserver.server.requests.scheduler import RunDelay
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, UdpAddress, parse_udp_address

STATM = Path("/proc/self/statm")
SCHEDSTAT = Path("/proc/thread-self/schedstat")


def read_gauges(queued: int, statm: Path = STATM) -> Gauges:
    """Read the resources of this process for the health report; `queued` requests wait. Takes some 20 us."""
    return Gauges(socket.gethostname(), os.getpid(), queued, read_resident_bytes(statm), time.process_time())


def read_resident_bytes(statm: Path = STATM) -> int:
    """Read the resident memory of this process, bytes; 0 if unknown."""
    return (_read_int(statm, 1) or 0) * os.sysconf("SC_PAGE_SIZE")


def read_run_delay(schedstat: Path = SCHEDSTAT) -> RunDelay | None:
    """Read the run-queue delay of this thread: how long it was ready without a processor; None if unknown."""
    delay, slices = _read_int(schedstat, 1), _read_int(schedstat, 2)
    return None if delay is None or slices is None else RunDelay(delay, slices)


_SIOCGIFFLAGS: Final = 0x8913
_IFF_UP, _IFF_LOOPBACK, _IFF_MULTICAST = 0x1, 0x8, 0x1000
"""netdevice(7)."""

_RTF_UP: Final = 0x1
"""route(8)."""

_STA_UNSYNC: Final = 0x40
_TIME_ERROR: Final = 5
"""adjtimex(2)."""

PROC: Final = Path("/proc")


def read_bus_facts(
    url: str, probe_delivery: Callable[[str], tuple[bool, bool]] | None = None, proc: Path = PROC
) -> BusFacts:
    """Read the facts about the bus at `url`.

    `probe_delivery` sends own messages and returns whether a short and a long one come back.
    """
    address = parse_udp_address(url)
    if address is None:
        return BusFacts(url, None)
    interfaces = tuple(list_interfaces())
    name = find_interface(address, proc)
    delivered: bool | None = None
    delivered_large: bool | None = None
    if name is not None and probe_delivery is not None:
        try:
            delivered, delivered_large = probe_delivery(url)
        except BusError:
            delivered = False
    return BusFacts(
        url,
        address,
        None if name is None else next((each for each in interfaces if each.name == name), NetworkInterface(name)),
        interfaces,
        delivered,
        delivered_large,
        get_granted_buffer(address.buffer or RECEIVE_BUFFER_BYTES),
        _read_int(proc / "sys/net/core/rmem_default"),
        count_dropped(address.port, proc),
    )


def list_interfaces() -> Iterator[NetworkInterface]:
    """Yield the network interfaces of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            try:
                request = struct.pack("256s", name.encode()[:15])
                flags = struct.unpack_from("16xH", fcntl.ioctl(probe.fileno(), _SIOCGIFFLAGS, request))[0]
            except OSError:
                continue  # removed meanwhile
            yield NetworkInterface(
                name, bool(flags & _IFF_UP), bool(flags & _IFF_MULTICAST), bool(flags & _IFF_LOOPBACK)
            )


def find_interface(address: UdpAddress, proc: Path = PROC) -> str | None:
    """Return the interface of the route to a group; empty if unknown, None without a route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # connecting sends nothing, but looks up the route
            probe.connect((address.group, address.port))
            own = socket.inet_aton(probe.getpeername()[0])
        except OSError:
            return None
    try:
        lines = (proc / "net/route").read_text().splitlines()[1:]
    except OSError:
        return ""
    return _match_route(lines, int.from_bytes(own, sys.byteorder))


def _match_route(lines: Iterable[str], group: int) -> str:
    """Return the interface of an address's route by /proc/net/route, whose numbers are in host byte order."""
    found = []
    for name, destination, _, flags, _, _, metric, mask, *_ in (line.split() for line in lines if line.count("\t") > 7):
        if int(flags, 16) & _RTF_UP and group & int(mask, 16) == int(destination, 16):
            # longest prefix, then least metric
            found.append((-int(mask, 16).bit_count(), int(metric), name))
    return min(found)[2] if found else ""


def get_granted_buffer(size: int) -> int:
    """Return the receive buffer that the kernel grants for a request, bytes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
        # the kernel doubles it for its own use, and reports the double (socket(7))
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def count_dropped(port: int, proc: Path = PROC) -> int | None:
    """Count the packets that the sockets on a port have lost, at most; None if unknown.

    The kernel counts packets that a socket filter drops (`wire.receiver`) as drops of the socket, too. Its count
    of full buffers has only lost ones, but those of all ports.
    """
    try:
        lines = (proc / "net/udp").read_text().splitlines()[1:]
        names, values = (line.split() for line in (proc / "net/snmp").read_text().splitlines() if line[:4] == "Udp:")
    except (OSError, ValueError):
        return None
    rows = [line.split() for line in lines]
    dropped = sum(int(row[-1]) for row in rows if len(row) > 12 and int(row[1].rpartition(":")[2], 16) == port)
    return min(dropped, int(dict(zip(names, values, strict=True)).get("RcvbufErrors", dropped)))


def _read_int(path: Path, word: int = 0) -> int | None:
    try:
        return int(path.read_bytes().split()[word])
    except (OSError, ValueError, IndexError):
        return None


_TIMEX: Final = struct.Struct("@I4li")
"""Start of struct timex (adjtimex(2)): modes, offset, freq, maxerror, esterror, status."""


def read_kernel_clock() -> tuple[bool | None, float | None]:
    """Read whether the kernel considers the time of day synchronized, and its bound of the error, s."""
    timex = ctypes.create_string_buffer(512)  # more than its size on any machine; modes 0: read only
    try:
        result = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        return None, None
    if result < 0:
        return None, None
    _, _, _, max_error_us, _, status = _TIMEX.unpack_from(timex)
    if result == _TIME_ERROR or status & _STA_UNSYNC:
        return False, None
    return True, max_error_us * 1e-6


def find_time_service() -> str:
    """Return the installed time service: chrony, ntp, timesyncd or empty."""
    folders = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
    if shutil.which("chronyd", path=folders):
        return "chrony"
    if shutil.which("ntpd", path=folders):
        return "ntp"
    if any(Path(place, "systemd-timesyncd").exists() for place in ("/lib/systemd", "/usr/lib/systemd")):
        return "timesyncd"
    return ""


class HostClockMonitor:
    """Compares the time of day with the monotonic clock from construction until `read_facts`."""

    def __init__(self) -> None:
        self._start = self._read_clocks()

    def read_facts(self) -> ClockFacts:
        """Return the readings of the clocks."""
        (utime, monotonic), (utime_now, monotonic_now) = self._start, self._read_clocks()
        elapsed = monotonic_now - monotonic
        slew = (utime_now - utime - elapsed) * 1e-9
        is_synchronized, error = read_kernel_clock()
        return ClockFacts(utime_now // 1000, is_synchronized, error, slew, elapsed * 1e-9, find_time_service())

    @staticmethod
    def _read_clocks() -> tuple[int, int]:
        return time.time_ns(), time.monotonic_ns()
