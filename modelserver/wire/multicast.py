"""The multicast group of a bus, and the command that gives it a way."""

from __future__ import annotations

import re
from typing import Final
from urllib.parse import urlsplit

GROUP: Final = "239.255.76.67"
"""LCM's own multicast group, which counts where a URL names none."""


def group_of(url: str) -> str:
    """Return the multicast group that an LCM URL names; LCM's own where it names nothing that could be one."""
    try:
        named = urlsplit(url).hostname or ""
    except ValueError:
        return GROUP
    return named if re.fullmatch(r"2(2[4-9]|3[0-9])(\.[0-9]{1,3}){3}", named) else GROUP


def route(group: str, device: str = "lo") -> str:
    """Return the command, without sudo, that has a network interface carry a group's packets.

    The route is of the bus's own group, so that the multicast of other programs goes where it went before.
    """
    return f"ip route replace {group}/32 dev {device}"
