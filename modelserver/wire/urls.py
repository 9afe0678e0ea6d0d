"""Validation of LCM URLs, and the multicast group of a bus.

liblcm 1.5 accepts URLs that do not work: without a port udpm opens and waits forever, ttl=300 becomes 44, ttl=abc
becomes 0. These are rejected here with a hint; whatever liblcm interprets as written is accepted.
"""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from modelserver.errors import find_nearest_names, quote

SCHEMES: Final = ("udpm", "mpudpm", "tcpq", "file", "memq")
"""Providers that liblcm has."""

EXAMPLE: Final = "udpm://239.255.76.67:7667?ttl=0"

_MULTICAST: Final = ("udpm", "mpudpm")

_NUMBER: Final = re.compile(r"\s*[+-]?(0[xX][0-9a-fA-F]+|\d+)")


def find_url_problem(url: str) -> str:
    """Return what is wrong with an LCM URL and what to write instead, empty for a valid one."""
    scheme, found, rest = url.partition("://")
    if not found:
        return f"it has no scheme; write it like {EXAMPLE}"
    if scheme not in SCHEMES:
        near = find_nearest_names(scheme, SCHEMES, 1)
        known = ", ".join(f"{each}://" for each in SCHEMES if each != "memq")
        offer = f"did you mean {near[0]}://? There are" if near else "there are"
        return f"{quote(scheme, 40)} is no scheme of LCM's; {offer} {known}; for a start: {EXAMPLE}"
    if scheme == "memq":
        return f"memq:// does not leave the process, so no other program receives it; write {EXAMPLE}"
    place, _, options = rest.partition("?")
    if scheme == "file":
        return "" if place else "it names no log; write file:///path/of/log"
    if scheme not in _MULTICAST:
        return ""
    return (place and _find_address_problem(place, scheme)) or _find_ttl_problem(options)


def _find_address_problem(place: str, scheme: str) -> str:
    group, colon, port = place.partition(":")
    example = f"{scheme}://239.255.76.67:7667?ttl=0"
    if not group:
        return f"the address before the port is missing; write it like {example}"
    try:
        first = socket.inet_aton(group)[0]
    except (OSError, ValueError):
        return (
            f"{quote(group, 40)} is no IPv4 address; write one between 224.0.0.0 and 239.255.255.255, such as {example}"
        )
    if not 224 <= first <= 239:
        return (
            f"{quote(group, 40)} is no multicast address; write one between 224.0.0.0 and 239.255.255.255, the same on "
            f"all machines, such as {example}"
        )
    if not colon:
        # mpudpm has a default, udpm waits on port 0 forever
        return "" if scheme == "mpudpm" else f"the port is missing; write {scheme}://{group}:7667"
    match = _NUMBER.match(port)
    number = int(match[0], 0 if match[1][:2] in ("0x", "0X") else 10) if match else -1
    lowest = 0 if scheme == "mpudpm" else 1
    if not lowest <= number <= 65535:
        return f"the port is a number from {lowest} to 65535, got {quote(port, 40)}; such as {example}"
    return ""


def _find_ttl_problem(options: str) -> str:
    for each in options.split("&"):
        key, _, value = each.partition("=")
        if key == "ttl" and not (value.isascii() and value.isdigit() and len(value) <= 3 and int(value) <= 255):
            return (
                f"ttl is a whole number from 0 to 255, got {quote(value, 40)}; 0 stays on this machine, 1 goes to the "
                "network's other machines"
            )
    return ""


GROUP: Final = "239.255.76.67"
"""Default multicast group of LCM."""


def group_of(url: str) -> str:
    """Return the multicast group of an LCM URL, LCM's default where it has none."""
    try:
        named = urlsplit(url).hostname or ""
    except ValueError:
        return GROUP
    return named if re.fullmatch(r"2(2[4-9]|3[0-9])(\.[0-9]{1,3}){3}", named) else GROUP


@dataclass(frozen=True, slots=True)
class UdpAddress:
    """An LCM provider over UDP multicast: group, port, time to live (hops), requested receive buffer (bytes)."""

    group: str = GROUP
    port: int = 7667
    ttl: int = 0
    buffer: int = 0


def leaves_machine(url: str) -> bool:
    """Return whether messages on a bus reach other machines; empty: the default, which is local."""
    address = parse_udp_address(url) if url else None
    return address is not None and address.ttl > 0


def parse_udp_address(url: str) -> UdpAddress | None:
    """Parse an LCM URL; None for another provider than udpm, and for an invalid URL."""
    default = UdpAddress()
    try:
        parts = urlsplit(url)
        options = dict(parse_qsl(parts.query))
        if parts.scheme != "udpm":
            return None
        return UdpAddress(
            parts.hostname or default.group,
            parts.port or default.port,
            int(options.get("ttl", default.ttl)),
            int(options.get("recv_buf_size", 0)),
        )
    except ValueError:
        return None


def make_route_command(group: str, device: str = "lo") -> str:
    """Return the command, without sudo, that routes a multicast group through a network interface.

    Only this group: the multicast traffic of other programs keeps its routes.
    """
    return f"ip route replace {group}/32 dev {device}"
