"""LCM instances: URL, receive buffer, error hints, and handling of one message.

liblcm 1.5 accepts URLs that do not work: without a port udpm opens and waits forever, ttl=300 becomes 44, ttl=abc
becomes 0. These are rejected here with a hint; whatever liblcm interprets as written is accepted. lcm itself is
imported when an instance is opened: reading a vehicle file needs only the URL.
"""

from __future__ import annotations

import os
import re
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl, urlsplit

from modelserver.errors import BusError, quote
from modelserver.wire.channels import DEFAULT_URL

if TYPE_CHECKING:
    import lcm

RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
"""Requested kernel buffer: the default loses an eighth of 20,000 messages a second (measured)."""


SELECT_LIMIT: Final = 1024
"""FD_SETSIZE, which select() of the C library can take."""

OWN_DESCRIPTORS: Final = 12
"""Descriptors that an LCM instance opens until it receives, 6 were seen, and a few beside."""


def resolve_url(url: str = "") -> str:
    """Return the URL to use: the given one, else $LCM_DEFAULT_URL, else loopback."""
    url = url or os.environ.get("LCM_DEFAULT_URL", "") or DEFAULT_URL
    if url.startswith("udpm://") and "recv_buf_size" not in url:
        url += f"{'&' if '?' in url else '?'}recv_buf_size={RECEIVE_BUFFER_BYTES}"
    return url


def open_lcm(url: str) -> lcm.LCM:
    """Join the bus. Raises BusError with hints.

    An instance stays in memory, and on the bus, as long as a subscription's handler refers to it: LCM's objects are
    unknown to Python's garbage collection.
    """
    wrong = find_url_problem(url)
    if wrong:
        raise BusError(f"cannot join the bus at {url}: {wrong}")
    import lcm

    _check_descriptors(url)
    try:
        return lcm.LCM(url)
    except (OSError, RuntimeError) as error:
        raise make_bus_error(url, error) from None


def make_bus_error(url: str, error: Exception) -> BusError:
    """Return an error for a bus that cannot be joined, with hints."""
    other = _PROVIDER_HINTS.get(url.partition("://")[0])
    if other is not None:
        return BusError(f"cannot join the bus at {url}: {error}. {other}")
    return BusError(
        f"cannot join the bus at {url}: {error}. Is the address right (udpm://239.255.76.67:7667?ttl=0), and has "
        f"the machine a route for multicast? On one machine: sudo ip link set lo up multicast on && sudo "
        f"{make_route_command(group_of(url))} (modelserver doctor checks it)"
    )


def _check_descriptors(url: str) -> None:
    """Raise BusError where LCM's descriptors would be too large for its select(), which overwrites memory then."""
    try:
        descriptor = os.open(os.devnull, os.O_RDONLY)
    except OSError as error:
        raise BusError(f"cannot join the bus at {url}: {error.strerror}; close files, or raise ulimit -n") from None
    os.close(descriptor)
    if descriptor + OWN_DESCRIPTORS > SELECT_LIMIT:
        raise BusError(
            f"cannot join the bus at {url}: this process has {descriptor} open files, and LCM works with descriptors "
            f"below {SELECT_LIMIT} only; join the bus before opening them, or close some"
        )


_PROVIDER_HINTS: Final = {
    "file": "Is there a log of that name, that may be read? To play one onto the bus: modelserver replay LOG",
    "tcpq": f"Does LCM's TCP service run there (java lcm.lcm.TCPService)? Without one, write {DEFAULT_URL}",
}
"""Hints for errors of providers other than multicast."""

_INTERRUPTED: Final = ("lcm_handle_timeout() returned -1",)
"""What `LCM.handle_timeout` raises OSError with, without an errno, when a signal interrupted it."""


def handle_message(bus: lcm.LCM, milliseconds: int = 0) -> bool:
    """Handle the next message, waiting at most `milliseconds`; return whether there was one.

    A signal ends the wait without an error: reloads, stops, window resizes and profilers send signals.
    """
    try:
        return bool(bus.handle_timeout(milliseconds))
    except OSError as error:
        if error.args != _INTERRUPTED:
            raise
        return False


# --- URLs -------------------------------------------------------------------------------------------------------------

SCHEMES: Final = ("udpm", "mpudpm", "tcpq", "file", "memq")
"""Providers that liblcm has."""

EXAMPLE: Final = "udpm://239.255.76.67:7667?ttl=0"

_MULTICAST: Final = ("udpm", "mpudpm")

_NUMBER: Final = re.compile(r"\s*[+-]?(0[xX][0-9a-fA-F]+|\d+)")


def find_url_problem(url: str) -> str:
    """Return what is wrong with an LCM URL and what to write instead, empty for a valid one."""
    scheme, found, rest = url.partition("://")
    place, _, options = rest.partition("?")
    if not found or scheme not in SCHEMES:
        return f"{quote(url, 40)} is no URL of LCM's, which has {', '.join(SCHEMES)}; write it like {EXAMPLE}"
    if scheme == "memq":
        return f"memq:// does not leave the process, so no other program receives it; write {EXAMPLE}"
    if scheme == "file" and not place:
        return "it names no log; write file:///path/of/log"
    if scheme in _MULTICAST and not (_is_multicast(place, scheme) and all(map(_is_valid_ttl, options.split("&")))):
        return (
            f"{quote(rest, 60)} is no multicast address: a group between 224.0.0.0 and 239.255.255.255, a port from 1 "
            f"to 65535, and a ttl from 0 (this machine) to 255; write it like {EXAMPLE}"
        )
    return ""


def _is_multicast(place: str, scheme: str) -> bool:
    """Return whether liblcm joins the group and port that stand there; it has defaults for none at all."""
    group, colon, port = place.partition(":")
    try:
        is_group = not place or 224 <= socket.inet_aton(group)[0] <= 239
    except (OSError, ValueError):
        return False
    if not colon:
        # mpudpm has a default, udpm waits on port 0 forever
        return is_group and (not place or scheme == "mpudpm")
    match = _NUMBER.match(port)
    number = int(match[0], 0 if match[1][:2] in ("0x", "0X") else 10) if match else -1
    return is_group and (0 if scheme == "mpudpm" else 1) <= number <= 65535


def _is_valid_ttl(option: str) -> bool:
    """Return whether an option is none about the ttl, or one that liblcm interprets as written."""
    key, _, value = option.partition("=")
    return key != "ttl" or (value.isascii() and value.isdigit() and len(value) <= 3 and int(value) <= 255)


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
    buffer: int = RECEIVE_BUFFER_BYTES


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
            int(options.get("recv_buf_size", 0)) or default.buffer,
        )
    except ValueError:
        return None


def make_route_command(group: str, device: str = "lo") -> str:
    """Return the command, without sudo, that routes a multicast group through a network interface.

    Only this group: the multicast traffic of other programs keeps its routes.
    """
    return f"ip route replace {group}/32 dev {device}"
