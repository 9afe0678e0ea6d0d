"""Diagnostics of bus, host clock, machine and duplicate servers: read facts, evaluate them, probe the bus.

- `evaluate_*` turn facts into diagnoses, each with the command that fixes it. Pure.
- `read_*` read the facts off the machine: resources of the process, network interfaces, kernel buffers, clocks.
- `probe_delivery` is an active probe, `probe_bus` the check that the daemon makes at its start.
- `DuplicateServerMonitor` watches the health reports while the daemon runs: two daemons on one bus receive each other's
  reports, and warn until the other one is gone.
"""

from __future__ import annotations

import ctypes
import fcntl
import logging
import os
import secrets
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from modelserver.errors import BusError, WireError, quote
from modelserver.messages import Gauges, Health
from modelserver.server.log import RateLimiter
from modelserver.wire import provider
from modelserver.wire.channels import PROBE_CHANNEL, to_subscription_pattern
from modelserver.wire.codec import decode

if TYPE_CHECKING:
    import lcm

    from modelserver.server.bus import Inbox
    from modelserver.server.clock import Clock
    from modelserver.wire.provider import Sender

log = logging.getLogger(__name__)


class DiagnosisLevel(IntEnum):
    """Severity. OK; NOTE: worth knowing, nothing to fix; WARNING: works, but may fail or lose data; ERROR: fails."""

    OK = 0
    NOTE = 1
    WARNING = 2
    ERROR = 3


OK, NOTE, WARNING, ERROR = DiagnosisLevel


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a check: its subject, the observation, why that matters, and the shell command that fixes it.

    `why` and `command` are empty if there is nothing to fix.
    """

    level: DiagnosisLevel
    subject: str
    observed: str
    why: str = ""
    command: str = ""

    def __str__(self) -> str:
        text = f"{self.subject}: {self.observed}"
        if self.why:
            text += f"; {self.why}"
        return f"{text}. Fix it with: {self.command}" if self.command else text


def get_worst_level(findings: Iterable[Diagnosis]) -> DiagnosisLevel:
    return max((each.level for each in findings), default=DiagnosisLevel.OK)


def filter_by_level(
    findings: Iterable[Diagnosis], min_level: DiagnosisLevel = DiagnosisLevel.WARNING
) -> tuple[Diagnosis, ...]:
    return tuple(each for each in findings if each.level >= min_level)


def evaluate_clock(synchronized: bool | None, shared: bool) -> Diagnosis:
    """Check whether the clock is synchronized, None: unknown. On a `shared` bus other machines' clocks matter."""
    if synchronized is None:
        return Diagnosis(NOTE, "clock", "its synchronization state cannot be read on this system")
    if synchronized:
        return Diagnosis(OK, "clock", "synchronized")
    command = "sudo timedatectl set-ntp true || sudo apt install chrony"
    if shared:
        why = "time stamps of several machines are not comparable"
        return Diagnosis(WARNING, "clock", "not synchronized", why, command)
    why = "time stamps are consistent on this machine, but not true time"
    return Diagnosis(NOTE, "clock", "not synchronized", why, command)


SYSCTL_FILE = "/etc/sysctl.d/60-modelserver.conf"

MIB = 1 << 20

LOST_PACKETS = "lost packets"
"""Subject of the diagnosis on dropped packets."""


@dataclass(frozen=True, slots=True)
class NetworkInterface:
    """A network interface and its flags."""

    name: str
    up: bool = True
    multicast: bool = True
    loopback: bool = False


@dataclass(frozen=True, slots=True)
class BusFacts:
    """Readings of the machine about the bus; None = unknown or not tried.

    Attributes
    ----------
    interface: interface of the group's route, without a name if the kernel does not report it; None without a route.
    interfaces: all interfaces.
    delivered, delivered_large: whether an own message came back, and one of several packets.
    buffer: receive buffer that the kernel granted for `RECEIVE_BUFFER_BYTES`, bytes.
    dropped: packets that receivers on the bus's port have lost so far, at most.
    """

    url: str
    address: provider.UdpAddress | None
    interface: NetworkInterface | None = None
    interfaces: tuple[NetworkInterface, ...] = ()
    delivered: bool | None = None
    delivered_large: bool | None = None
    buffer: int | None = None
    dropped: int | None = None


def evaluate_bus(facts: BusFacts) -> tuple[Diagnosis, ...]:
    """Check route, delivery and buffers of the bus."""
    address = facts.address
    if address is None:
        return (Diagnosis(NOTE, "bus", f"{quote(facts.url)} is no UDP multicast", "only udpm:// is checked"),)
    return (
        _check_route(facts, address),
        *_check_delivery(facts, address),
        *_check_buffers(facts, address),
    )


def _check_route(facts: BusFacts, address: provider.UdpAddress) -> Diagnosis:
    subject = "multicast route"
    group, interface = address.group, facts.interface
    lo = next((each.name for each in facts.interfaces if each.loopback), "lo")
    outward = next((each.name for each in facts.interfaces if each.up and each.multicast and not each.loopback), "")
    by_lo = f"sudo ip link set {lo} up multicast on && sudo {provider.make_route_command(group, lo)}"
    if interface is None:
        command = by_lo if address.ttl == 0 or not outward else f"sudo {provider.make_route_command(group, outward)}"
        why = "LCM cannot be joined, so nothing is received or published"
        return Diagnosis(ERROR, subject, f"there is none to {group}", why, command)
    if not interface.name:
        return Diagnosis(OK, subject, f"there is one to {group}")
    observed = f"{group} is routed through {interface.name}"
    if not interface.up:
        command = f"sudo ip link set {interface.name} up"
        return Diagnosis(ERROR, subject, f"{observed}, which is down", "published messages are lost", command)
    if address.ttl > 0 and interface.loopback:
        why = f"the URL has ttl={address.ttl}, but no other machine receives anything"
        flush = f"sudo ip route flush match {group} dev {lo}"
        command = f"sudo {provider.make_route_command(group, outward)}" if outward else flush
        return Diagnosis(WARNING, subject, observed, why, command)
    return Diagnosis(OK, subject, observed)


def _check_delivery(facts: BusFacts, address: provider.UdpAddress) -> Iterator[Diagnosis]:
    subject = "own message"
    if facts.delivered is None:
        return
    if not facts.delivered:
        why = "programs on this machine do not receive each other: a firewall, or multicast without loopback"
        command = f"sudo nft list ruleset; sudo iptables -I INPUT -d {address.group} -p udp -j ACCEPT"
        yield Diagnosis(ERROR, subject, "it does not come back", why, command)
    elif facts.delivered_large is False:
        why = "long replies (histories, lists) are split into packets, and some of them are lost"
        command = _sysctl_command("net.core.rmem_max", provider.RECEIVE_BUFFER_BYTES)
        yield Diagnosis(WARNING, subject, "a short one comes back, one of 100 kB does not", why, command)
    else:
        yield Diagnosis(OK, subject, "it comes back")


def _check_buffers(facts: BusFacts, address: provider.UdpAddress) -> Iterator[Diagnosis]:
    subject = "receive buffer"
    if facts.buffer is not None and facts.buffer < provider.RECEIVE_BUFFER_BYTES:
        observed = (
            f"{_format_mib(facts.buffer)} of {_format_mib(provider.RECEIVE_BUFFER_BYTES)} requested (net.core.rmem_max)"
        )
        command = _sysctl_command("net.core.rmem_max", provider.RECEIVE_BUFFER_BYTES)
        yield Diagnosis(WARNING, subject, observed, "messages are lost in bursts", command)
    elif facts.buffer is not None:
        yield Diagnosis(OK, subject, f"{_format_mib(facts.buffer)}, as requested")
    if facts.dropped:
        observed = f"running programs on this bus have lost up to {facts.dropped} packets so far"
        why = (
            "one of them is too slow for the traffic, or its buffer is too small (recv_buf_size in its URL); the "
            "command shows which: d of its skmem, which also counts packets that a socket filter drops"
        )
        yield Diagnosis(WARNING, LOST_PACKETS, observed, why, f"sudo ss -uanmp 'sport = :{address.port}'")


def _sysctl_command(name: str, value: int) -> str:
    return f"sudo sysctl -w {name}={value} && echo '{name} = {value}' | sudo tee -a {SYSCTL_FILE}"


def _format_mib(count: int) -> str:
    return f"{count / MIB:.1f} MiB" if count >= MIB / 10 else f"{count / 1024:.0f} KiB"


STATM = Path("/proc/self/statm")


def read_gauges(queued: int, statm: Path = STATM) -> Gauges:
    """Read the resources of this process for the health report; `queued` requests wait. Takes some 20 us."""
    return Gauges(socket.gethostname(), os.getpid(), queued, read_resident_bytes(statm), time.process_time())


def read_resident_bytes(statm: Path = STATM) -> int:
    """Read the resident memory of this process, bytes; 0 if unknown."""
    try:
        return int(statm.read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


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
    address = provider.parse_udp_address(url)
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
        get_granted_buffer(address.buffer),
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


def find_interface(address: provider.UdpAddress, proc: Path = PROC) -> str | None:
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

    The kernel counts packets that a socket filter drops (`wire.provider`) as drops of the socket, too. Its count
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


_TIMEX: Final = struct.Struct("@I4li")
"""Start of struct timex (adjtimex(2)): modes, offset, freq, maxerror, esterror, status."""


def is_clock_synchronized() -> bool | None:
    """Return whether the kernel considers the time of day synchronized, None if unknown."""
    timex = ctypes.create_string_buffer(512)  # more than its size on any machine; modes 0: read only
    try:
        result = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        return None
    return None if result < 0 else result != _TIME_ERROR and not _TIMEX.unpack_from(timex)[5] & _STA_UNSYNC


ECHO_TIMEOUT_S: Final = 2.0
"""Timeout of an own message, which takes less than a millisecond on a working bus."""

RESEND_S: Final = 0.1
"""Period of sending it again: a loaded machine may lose one."""

LARGE_BYTES: Final = 100_000
"""Size of a message that LCM splits into packets."""


def probe_delivery(url: str, seconds: float = ECHO_TIMEOUT_S) -> tuple[bool, bool]:
    """Return whether a short and a long own message come back. Raises BusError."""
    sender, receiver = provider.open_lcm(url), provider.open_lcm(url)
    is_short_echoed = _is_echoed(sender, receiver, 8, seconds)
    return is_short_echoed, is_short_echoed and _is_echoed(sender, receiver, LARGE_BYTES, seconds)


def _is_echoed(sender: lcm.LCM, receiver: lcm.LCM, size: int, seconds: float) -> bool:
    payload, matches = secrets.token_bytes(size), list[bool]()
    subscription = receiver.subscribe(
        to_subscription_pattern(PROBE_CHANNEL), lambda _, data: matches.append(data == payload)
    )
    send_at = time.monotonic()
    deadline = send_at + seconds
    try:
        while not any(matches) and (now := time.monotonic()) < deadline:
            if now >= send_at:
                sender.publish(PROBE_CHANNEL, payload)
                send_at = now + RESEND_S
            provider.handle_message(receiver, int((min(send_at, deadline) - now) * 1e3) + 1)
    finally:
        receiver.unsubscribe(subscription)
    return any(matches)


SERVERS_SUBJECT: Final = "servers"

DUPLICATE_TIMEOUT_S: Final = 5.0
"""Another server without a report for so long is gone."""

MAX_REPORTS_PER_S: Final = 40
"""Reports decoded per second; a server publishes at most ten. Further ones are dropped."""

RECORDING_AGE_S: Final = 30.0
"""A report whose stamp differs so much from now is from the playback of a recording."""


class DuplicateServerMonitor:
    """Warns about other servers on the bus by their health reports. `host` and `pid` are those of this process."""

    def __init__(self, host: str, pid: int, set_warning: Callable[[str, str], None], clock: Clock):
        self._own_process = (host, pid)
        self._set_warning = set_warning
        self._clock = clock
        self._received_ns = 0
        self._limiter = RateLimiter(MAX_REPORTS_PER_S)
        self._warning = ""

    def subscribe(self, inbox: Inbox, prefix: str) -> None:
        inbox.subscribe(f"{prefix}MODELSERVER_HEALTH", self.on_health)

    def on_health(self, channel: str, data: bytes, sender: Sender = None) -> None:
        now = self._clock.monotonic_ns()
        if not self._limiter.try_acquire(channel, now):
            return
        try:
            health: Health = decode("health_t", data)
        except WireError:
            return
        if (health.host, health.pid) != self._own_process:
            self._received_ns = now
            self._update_warning(_describe(health, self._clock.utime()))
        elif self._warning and now - self._received_ns > DUPLICATE_TIMEOUT_S * 1e9:
            self._update_warning("")

    def _update_warning(self, text: str) -> None:
        if text != self._warning:
            self._warning = text
            self._set_warning(SERVERS_SUBJECT, text)


def _describe(health: Health, utime: int) -> str:
    who = f"modelserver process {health.pid} on {quote(health.host, 64)}, vehicle {quote(health.vehicle, 64)}"
    if abs(health.utime - utime) > RECORDING_AGE_S * 1e6:
        return (
            f"a recording of {who}, is being played on this bus: clients cannot distinguish its poses from current "
            "ones; stop the player, or play without the server's own channels (modelserver replay)"
        )
    return (
        f"another server publishes on this bus: {who}; clients get the replies of either, and POSE is from both; stop "
        f"one (kill {health.pid} there), or give it its own lcm.channel_prefix or port"
    )


BUS_SUBJECT = "bus"


def probe_bus(
    url: str, read: Callable[[str], BusFacts] = lambda url: read_bus_facts(url, probe_delivery)
) -> tuple[Diagnosis, ...]:
    """Check the bus at `url`; takes a few milliseconds if it works.

    Raises BusError if it does not deliver an own message.
    """
    # packets that other programs lost before this one started are not reported
    findings = evaluate_bus(replace(read(url), dropped=None))
    errors = filter_by_level(findings, DiagnosisLevel.ERROR)
    if errors:
        raise BusError(f"the bus at {url} does not work: {'; '.join(map(str, errors))} (details: modelserver doctor)")
    return findings


def report_findings(findings: Iterable[Diagnosis], set_warning: Callable[[str, str], None]) -> None:
    """Log the findings, and set a health warning for those to be fixed."""
    findings = tuple(findings)
    for finding in findings:
        log.log(logging.WARNING if finding.level >= DiagnosisLevel.WARNING else logging.DEBUG, "%s", finding)
    warnings = filter_by_level(findings)
    if warnings:
        set_warning(BUS_SUBJECT, "; ".join(map(str, warnings)))
