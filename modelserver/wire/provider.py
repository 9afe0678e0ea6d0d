"""LCM instances: URL, receive buffer, error hints, and handling of one message."""

from __future__ import annotations

import os
from typing import Final

import lcm

from modelserver.errors import BusError
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.urls import find_url_problem, group_of, make_route_command

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
