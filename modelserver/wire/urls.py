"""LCM URLs: what is wrong with one, told before liblcm refuses it, hangs on it or takes it for something else.

What it takes was tried with liblcm 1.5: a udpm URL without a port opens and then waits for ever, ttl=300 is ttl 44, and
ttl=abc is ttl 0. What it takes as it is meant is not refused here, strange as it may look.
"""

from __future__ import annotations

import re
import socket
from typing import Final

from modelserver.errors import nearest_names, shown

SCHEMES: Final = ("udpm", "mpudpm", "tcpq", "file", "memq")
"""Providers that liblcm has."""

EXAMPLE: Final = "udpm://239.255.76.67:7667?ttl=0"

_MULTICAST: Final = ("udpm", "mpudpm")

_NUMBER: Final = re.compile(r"\s*[+-]?(0[xX][0-9a-fA-F]+|\d+)")


def url_problem(url: str) -> str:
    """Return what is wrong with an LCM URL and what to write, empty where nothing is."""
    scheme, found, rest = url.partition("://")
    if not found:
        return f"it has no scheme; write it like {EXAMPLE}"
    if scheme not in SCHEMES:
        near = nearest_names(scheme, SCHEMES, 1)
        known = ", ".join(f"{each}://" for each in SCHEMES if each != "memq")
        offer = f"did you mean {near[0]}://? There are" if near else "there are"
        return f"{shown(scheme, 40)} is no scheme of LCM's; {offer} {known}; for a start: {EXAMPLE}"
    if scheme == "memq":
        return f"memq:// reaches nobody, for each of its users has a bus of its own; write {EXAMPLE}"
    place, _, options = rest.partition("?")
    if scheme == "file":
        return "" if place else "it names no log; write file:///path/of/log"
    if scheme not in _MULTICAST:
        return ""
    return (place and _place_problem(place, scheme)) or _ttl_problem(options)


def _place_problem(place: str, scheme: str) -> str:
    group, colon, port = place.partition(":")
    example = f"{scheme}://239.255.76.67:7667?ttl=0"
    if not group:
        return f"the address before the port is missing; write it like {example}"
    try:
        first = socket.inet_aton(group)[0]
    except (OSError, ValueError):
        return (
            f"{shown(group, 40)} is no IPv4 address; write one between 224.0.0.0 and 239.255.255.255, such as {example}"
        )
    if not 224 <= first <= 239:
        return (
            f"{shown(group, 40)} is no multicast address; write one between 224.0.0.0 and 239.255.255.255, the same on "
            f"all machines, such as {example}"
        )
    if not colon:
        # mpudpm has a default, udpm waits on port 0 for ever
        return "" if scheme == "mpudpm" else f"the port is missing; write {scheme}://{group}:7667"
    match = _NUMBER.match(port)
    number = int(match[0], 0 if match[1][:2] in ("0x", "0X") else 10) if match else -1
    lowest = 0 if scheme == "mpudpm" else 1
    if not lowest <= number <= 65535:
        return f"the port is a number from {lowest} to 65535, got {shown(port, 40)}; such as {example}"
    return ""


def _ttl_problem(options: str) -> str:
    for each in options.split("&"):
        key, _, value = each.partition("=")
        if key == "ttl" and not (value.isascii() and value.isdigit() and len(value) <= 3 and int(value) <= 255):
            return (
                f"ttl is a whole number from 0 to 255, got {shown(value, 40)}; 0 stays on this machine, 1 goes to the "
                "network's other machines"
            )
    return ""
