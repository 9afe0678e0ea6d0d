"""Evaluate facts about bus, host clock and servers to diagnoses, each with the command that fixes it. Pure.

`machine` and `bus_probe` read the facts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

from modelserver.errors import quote
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, UdpAddress, make_route_command


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
    """Return the highest level among findings; OK without any."""
    return max((each.level for each in findings), default=DiagnosisLevel.OK)


def filter_by_level(
    findings: Iterable[Diagnosis], min_level: DiagnosisLevel = DiagnosisLevel.WARNING
) -> tuple[Diagnosis, ...]:
    return tuple(each for each in findings if each.level >= min_level)


MAX_SLEW_RATE = 500e-6
"""The kernel's limit of slewing (ntp_adjtime(2)), s/s; more between two readings is a step."""

MIN_TIME_S = 1_672_531_200
"""Start of 2023: a clock before it was never set since power-on."""


@dataclass(frozen=True, slots=True)
class ClockFacts:
    """Readings of the host's clocks.

    Attributes
    ----------
    synchronized: the kernel's state; None = unknown.
    error: the kernel's bound of the error, s.
    slew, duration: how far the time of day has advanced beyond the monotonic clock over a duration, s.
    tool: installed time service: chrony, ntp, timesyncd or empty.
    """

    utime: int
    synchronized: bool | None = None
    error: float | None = None
    slew: float = 0.0
    duration: float = 0.0
    tool: str = ""


_SYNC_COMMANDS = {
    "chrony": "sudo systemctl enable --now chrony && chronyc tracking",
    "ntp": "sudo systemctl enable --now ntp && ntpq -p",
    "timesyncd": "sudo timedatectl set-ntp true && timedatectl timesync-status",
    "": "sudo apt install chrony",
}


def evaluate_clock(facts: ClockFacts, shared: bool) -> tuple[Diagnosis, ...]:
    """Check the clock. On a `shared` bus, which leaves the machine, other machines' clocks matter."""
    return tuple(_check_clock(facts, shared))


def _check_clock(facts: ClockFacts, shared: bool) -> Iterator[Diagnosis]:
    subject = "clock"
    command = _SYNC_COMMANDS[facts.tool]
    if facts.utime < MIN_TIME_S * 1_000_000:
        why = "time stamps, the magnetic field model and logs depend on it; is the clock's battery empty?"
        yield Diagnosis(ERROR, subject, "it was never set: its year is before 2023", why, command)
        return
    if abs(facts.slew) > MAX_SLEW_RATE * facts.duration + 1e-3:
        observed = f"it was stepped by {facts.slew:+.3f} s during the check"
        why = "poses are invalid until localization has samples of the new time; permit steps only at boot"
        yield Diagnosis(WARNING, subject, observed, why, _SYNC_COMMANDS["chrony"] if facts.tool else command)
    if facts.synchronized is None:
        yield Diagnosis(NOTE, subject, "its synchronization state cannot be read on this system")
    elif facts.synchronized:
        error = "" if facts.error is None else f", to {facts.error * 1e3:.1f} ms or better"
        yield Diagnosis(OK, subject, f"synchronized{error}")
    elif shared:
        why = "time stamps of several machines are not comparable"
        yield Diagnosis(WARNING, subject, "not synchronized", why, command)
    else:
        why = "time stamps are consistent on this machine, but not true time"
        yield Diagnosis(NOTE, subject, "not synchronized", why, command)


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
    buffer_default: receive buffer of programs that request none, bytes.
    dropped: packets that receivers on the bus's port have lost so far, at most.
    """

    url: str
    address: UdpAddress | None
    interface: NetworkInterface | None = None
    interfaces: tuple[NetworkInterface, ...] = ()
    delivered: bool | None = None
    delivered_large: bool | None = None
    buffer: int | None = None
    buffer_default: int | None = None
    dropped: int | None = None


def evaluate_bus(facts: BusFacts) -> tuple[Diagnosis, ...]:
    """Check route, delivery, reach and buffers of the bus."""
    address = facts.address
    if address is None:
        return (Diagnosis(NOTE, "bus", f"{quote(facts.url)} is no UDP multicast", "only udpm:// is checked"),)
    return (
        _check_route(facts, address),
        *_check_delivery(facts, address),
        _check_reach(facts, address),
        *_check_buffers(facts, address),
    )


def _check_route(facts: BusFacts, address: UdpAddress) -> Diagnosis:
    subject = "multicast route"
    group, interface = address.group, facts.interface
    lo = next((each.name for each in facts.interfaces if each.loopback), "lo")
    outward = next((each.name for each in facts.interfaces if each.up and each.multicast and not each.loopback), "")
    by_lo = f"sudo ip link set {lo} up multicast on && sudo {make_route_command(group, lo)}"
    if interface is None:
        command = by_lo if address.ttl == 0 or not outward else f"sudo {make_route_command(group, outward)}"
        why = "LCM cannot be joined, so nothing is received or published"
        return Diagnosis(ERROR, subject, f"there is none to {group}", why, command)
    if not interface.name:
        return Diagnosis(OK, subject, f"there is one to {group}")
    observed = f"{group} is routed through {interface.name}"
    if not interface.up:
        command = f"sudo ip link set {interface.name} up"
        return Diagnosis(ERROR, subject, f"{observed}, which is down", "published messages are lost", command)
    if interface.loopback and not interface.multicast:
        why = "some programs skip an interface without the multicast flag"
        command = f"sudo ip link set {interface.name} multicast on"
        return Diagnosis(NOTE, subject, f"{observed}, which lacks the multicast flag", why, command)
    if address.ttl == 0 and not interface.loopback:
        why = (
            f"nothing leaves the machine (ttl=0), but the bus fails whenever {interface.name} goes down; a route "
            f"through {lo} stays"
        )
        return Diagnosis(NOTE, subject, observed, why, by_lo)
    if address.ttl > 0 and interface.loopback:
        why = f"the URL has ttl={address.ttl}, but no other machine receives anything"
        flush = f"sudo ip route flush match {group} dev {lo}"
        command = f"sudo {make_route_command(group, outward)}" if outward else flush
        return Diagnosis(WARNING, subject, observed, why, command)
    return Diagnosis(OK, subject, observed)


def _check_delivery(facts: BusFacts, address: UdpAddress) -> Iterator[Diagnosis]:
    subject = "own message"
    if facts.delivered is None:
        return
    if not facts.delivered:
        why = "programs on this machine do not receive each other: a firewall, or multicast without loopback"
        command = f"sudo nft list ruleset; sudo iptables -I INPUT -d {address.group} -p udp -j ACCEPT"
        yield Diagnosis(ERROR, subject, "it does not come back", why, command)
    elif facts.delivered_large is False:
        why = "long replies (histories, lists) are split into packets, and some of them are lost"
        command = _sysctl_command("net.core.rmem_max", RECEIVE_BUFFER_BYTES)
        yield Diagnosis(WARNING, subject, "a short one comes back, one of 100 kB does not", why, command)
    else:
        yield Diagnosis(OK, subject, "it comes back")


def _check_reach(facts: BusFacts, address: UdpAddress) -> Diagnosis:
    if address.ttl == 0:
        return Diagnosis(OK, "reach", "nothing leaves the machine (ttl=0)")
    through = f" through {facts.interface.name}" if facts.interface is not None and facts.interface.name else ""
    hops = "its network" if address.ttl == 1 else f"and past {address.ttl - 1} routers"
    observed = f"messages leave the machine{through}, for {hops} (ttl={address.ttl})"
    why = "every host there receives all messages and may send requests; write ttl=0 in lcm.url to prevent that"
    return Diagnosis(NOTE, "reach", observed, why)


def _check_buffers(facts: BusFacts, address: UdpAddress) -> Iterator[Diagnosis]:
    subject = "receive buffer"
    if facts.buffer is not None and facts.buffer < RECEIVE_BUFFER_BYTES:
        observed = f"{_format_mib(facts.buffer)} of {_format_mib(RECEIVE_BUFFER_BYTES)} requested (net.core.rmem_max)"
        command = _sysctl_command("net.core.rmem_max", RECEIVE_BUFFER_BYTES)
        yield Diagnosis(WARNING, subject, observed, "messages are lost in bursts", command)
    elif facts.buffer is not None:
        yield Diagnosis(OK, subject, f"{_format_mib(facts.buffer)}, as requested")
    if facts.buffer_default is not None and facts.buffer_default < MIB:
        observed = f"{_format_mib(facts.buffer_default)} for programs that request none (net.core.rmem_default)"
        why = "lcm-spy, lcm-logger and clients without recv_buf_size in their URL lose messages in bursts"
        yield Diagnosis(NOTE, subject, observed, why, _sysctl_command("net.core.rmem_default", RECEIVE_BUFFER_BYTES))
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


@dataclass(frozen=True, slots=True)
class Server:
    """A server that published a health report. `prefix` is that of its channels."""

    host: str
    pid: int
    vehicle: str = ""
    version: str = ""
    prefix: str = ""

    def __str__(self) -> str:
        return f"process {self.pid} on {quote(self.host, 64)}"


@dataclass(frozen=True, slots=True)
class DiscoveredServers:
    """Servers by their health reports, and the number of replies to one request; None = no request was sent."""

    servers: tuple[Server, ...] = ()
    replies: int | None = None


def evaluate_servers(discovered: DiscoveredServers, prefix: str, version: str) -> tuple[Diagnosis, ...]:
    """Check which servers are on the bus; `prefix` is that of the checked vehicle."""
    return tuple(_check_servers(discovered, prefix, version))


def _check_servers(discovered: DiscoveredServers, prefix: str, version: str) -> Iterator[Diagnosis]:
    subject = "daemon"
    own = [each for each in discovered.servers if each.prefix == prefix]
    replies = discovered.replies or 0
    if len(own) > 1 or replies > 1:
        who = f": {', '.join(map(str, own))}" if len(own) > 1 else ""
        observed = f"{max(len(own), replies)} answer at once{who}"
        why = "clients get the replies of either, and POSE is from both; stop all but one, or give each its own prefix"
        command = f"kill {own[-1].pid}" if own else "systemctl stop modelserver, on each machine but one"
        yield Diagnosis(ERROR, subject, observed, why, command)
    elif own or replies:
        yield Diagnosis(OK, subject, f"one answers{f': {own[0]}' if own else ''}")
    else:
        observed = f"none answers{f' with prefix {prefix}' if prefix else ''}"
        yield Diagnosis(NOTE, subject, observed, "start one if it should run", "modelserver run -c vehicle.yaml")
    for each in own:
        if each.version != version:
            observed = f"{each} is version {quote(each.version, 40)}, this command {version}"
            why = "messages of one version may be undecodable for the other"
            yield Diagnosis(WARNING, subject, observed, why, "sudo systemctl restart modelserver")
    others = sorted({each.prefix for each in discovered.servers} - {prefix})
    if others:
        names = ", ".join(quote(each, 40) if each else "none" for each in others)
        yield Diagnosis(NOTE, "other vehicles", f"daemons with these prefixes are on the bus: {names}")
