"""Probing the bus: from what was read off the machine to findings, each with the command that mends it.

What is judged are values; `machine` and `listening` read them. `probe_clock` and `probe_servers` do the same for the
clock, and for the daemons that are heard.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

from modelserver.errors import shown
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel
from modelserver.wire.multicast import GROUP, route
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES

SYSCTL_FILE = "/etc/sysctl.d/60-modelserver.conf"

MIB = 1 << 20

LOST = "lost packets"
"""What is said of packets that programs have lost so far."""


@dataclass(frozen=True, slots=True)
class UdpAddress:
    """An LCM provider over UDP multicast: group, port, how many routers its packets pass, buffer asked for (bytes)."""

    group: str = GROUP
    port: int = 7667
    ttl: int = 0
    buffer: int = 0


def udp_address(url: str) -> UdpAddress | None:
    """Return what an LCM URL names; None for another provider than udpm, and for what cannot be read."""
    default = UdpAddress()
    try:
        parts = urlsplit(url)
        known = dict(parse_qsl(parts.query))
        if parts.scheme != "udpm":
            return None
        return UdpAddress(
            parts.hostname or default.group,
            parts.port or default.port,
            int(known.get("ttl", default.ttl)),
            int(known.get("recv_buf_size", 0)),
        )
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class Interface:
    """A network interface, and what it says of itself."""

    name: str
    up: bool = True
    multicast: bool = True
    loopback: bool = False


@dataclass(frozen=True, slots=True)
class BusFacts:
    """What was read off the machine about the bus.

    `interface` is what the kernel sends the group's packets through, without a name where the kernel does not tell,
    None where it has no route. `interfaces` are all.
    `heard`: a message of our own came back; `heard_large`: so did one of several packets; None: not tried. `buffer` is
    what the kernel gave a receiver that asked for `RECEIVE_BUFFER_BYTES`; `buffer_default` what others get who do not
    ask (bytes, None: not known). `dropped`: packets that receivers on the bus's port have lost so far.
    """

    url: str
    address: UdpAddress | None
    interface: Interface | None = None
    interfaces: tuple[Interface, ...] = ()
    heard: bool | None = None
    heard_large: bool | None = None
    buffer: int | None = None
    buffer_default: int | None = None
    dropped: int | None = None


def bus_findings(facts: BusFacts) -> tuple[Diagnosis, ...]:
    """Return what is to be said of the bus."""
    if facts.address is None:
        seen = f"{shown(facts.url)} is no UDP multicast"
        return (Diagnosis(DiagnosisLevel.NOTE, "bus", seen, "only udpm:// is looked at"),)
    address = facts.address
    return (
        *_route(facts, address),
        *_delivery(facts, address),
        *_reach(facts, address),
        *_buffers(facts),
    )


def _route(facts: BusFacts, address: UdpAddress) -> tuple[Diagnosis, ...]:
    subject = "multicast route"
    lo = next((each.name for each in facts.interfaces if each.loopback), "lo")
    outward = next((each.name for each in facts.interfaces if each.up and each.multicast and not each.loopback), "")
    by_lo = f"sudo ip link set {lo} up multicast on && sudo {route(address.group, lo)}"
    interface = facts.interface
    if interface is None:
        command = by_lo if address.ttl == 0 or not outward else f"sudo {route(address.group, outward)}"
        why = "LCM cannot be joined, so nothing is heard or said"
        return (Diagnosis(DiagnosisLevel.ERROR, subject, f"there is none to {address.group}", why, command),)
    if not interface.name:
        return (Diagnosis(DiagnosisLevel.OK, subject, f"there is one to {address.group}"),)
    seen = f"{address.group} goes by {interface.name}"
    if not interface.up:
        why = "what is said goes nowhere"
        return (
            Diagnosis(
                DiagnosisLevel.ERROR, subject, f"{seen}, which is down", why, f"sudo ip link set {interface.name} up"
            ),
        )
    if interface.loopback and not interface.multicast:
        why = "some programs skip an interface that does not say it takes multicast"
        command = f"sudo ip link set {interface.name} multicast on"
        return (Diagnosis(DiagnosisLevel.NOTE, subject, f"{seen}, which is not marked for multicast", why, command),)
    if address.ttl == 0 and not interface.loopback:
        why = (
            f"nothing leaves the machine (ttl=0), and yet the bus is gone whenever {interface.name} goes down; a route "
            f"by {lo} stays"
        )
        return (Diagnosis(DiagnosisLevel.NOTE, subject, seen, why, by_lo),)
    if address.ttl > 0 and interface.loopback:
        why = f"the URL says ttl={address.ttl}, and yet no other machine hears anything"
        # whichever routes they are that lead the group there
        away = f"sudo ip route flush match {address.group} dev {lo}"
        command = f"sudo {route(address.group, outward)}" if outward else away
        return (Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, command),)
    return (Diagnosis(DiagnosisLevel.OK, subject, seen),)


def _delivery(facts: BusFacts, address: UdpAddress) -> tuple[Diagnosis, ...]:
    subject = "own message"
    if facts.heard is None:
        return ()
    if not facts.heard:
        why = "no program on this machine hears another: a firewall between them, or multicast that is not looped back"
        command = f"sudo nft list ruleset; sudo iptables -I INPUT -d {address.group} -p udp -j ACCEPT"
        return (Diagnosis(DiagnosisLevel.ERROR, subject, "it does not come back", why, command),)
    if facts.heard_large is False:
        why = "long replies (histories, lists) are cut into packets, and not all of them arrive"
        command = _sysctl("net.core.rmem_max", RECEIVE_BUFFER_BYTES)
        return (
            Diagnosis(DiagnosisLevel.WARNING, subject, "a short one comes back, one of 100 kB does not", why, command),
        )
    return (Diagnosis(DiagnosisLevel.OK, subject, "it comes back"),)


def _reach(facts: BusFacts, address: UdpAddress) -> tuple[Diagnosis, ...]:
    subject = "reach"
    if address.ttl == 0:
        return (Diagnosis(DiagnosisLevel.OK, subject, "nothing leaves the machine (ttl=0)"),)
    by = f" by {facts.interface.name}" if facts.interface is not None and facts.interface.name else ""
    hops = "its network" if address.ttl == 1 else f"and past {address.ttl - 1} routers"
    seen = f"what is said leaves the machine{by}, for {hops} (ttl={address.ttl})"
    why = "whoever is there hears everything, and may ask; write ttl=0 in lcm.url if that is not wanted"
    return (Diagnosis(DiagnosisLevel.NOTE, subject, seen, why),)


def _buffers(facts: BusFacts) -> tuple[Diagnosis, ...]:
    found = []
    subject = "receive buffer"
    if facts.buffer is not None and facts.buffer < RECEIVE_BUFFER_BYTES:
        seen = f"{_mib(facts.buffer)} of {_mib(RECEIVE_BUFFER_BYTES)} asked for (net.core.rmem_max)"
        why = "messages are lost in bursts"
        found.append(
            Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, _sysctl("net.core.rmem_max", RECEIVE_BUFFER_BYTES))
        )
    elif facts.buffer is not None:
        found.append(Diagnosis(DiagnosisLevel.OK, subject, f"{_mib(facts.buffer)}, as asked for"))
    if facts.buffer_default is not None and facts.buffer_default < MIB:
        seen = f"{_mib(facts.buffer_default)} for programs that ask for none (net.core.rmem_default)"
        why = "lcm-spy, lcm-logger and clients without recv_buf_size in their URL lose messages in bursts"
        found.append(
            Diagnosis(DiagnosisLevel.NOTE, subject, seen, why, _sysctl("net.core.rmem_default", RECEIVE_BUFFER_BYTES))
        )
    if facts.dropped:
        seen = f"{facts.dropped} packets were lost so far by programs on this bus that are running"
        why = (
            "one is slower than what it hears, or its buffer too small: recv_buf_size in its URL. The command tells "
            "which: d of its skmem"
        )
        command = f"sudo ss -uanmp 'sport = :{facts.address.port if facts.address else 0}'"
        found.append(Diagnosis(DiagnosisLevel.WARNING, LOST, seen, why, command))
    return tuple(found)


def _sysctl(name: str, value: int) -> str:
    return f"sudo sysctl -w {name}={value} && echo '{name} = {value}' | sudo tee -a {SYSCTL_FILE}"


def _mib(count: int) -> str:
    return f"{count / MIB:.1f} MiB" if count >= MIB / 10 else f"{count / 1024:.0f} KiB"
