"""Membership in the bus's multicast group, kept when a network interface goes away and comes again.

LCM joins the group once, when it is made. Of an interface that is taken away - an adapter pulled out, a virtual network
begun anew - the kernel forgets the membership, and nothing is heard on the one that comes in its place. It hands a
group's messages to every socket that is bound to their port, though, as long as any socket of the machine is a member
there (IP_MULTICAST_ALL, ip(7)): so a socket that joins again is enough for LCM's, and for those of other programs.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import re
import socket
import struct
from typing import Final

log = logging.getLogger(__name__)

RENEW_S: Final = 1.0
"""How often membership is looked after: a call to the kernel each time."""

_GROUP: Final = re.compile(r"udpm://(\d{1,3}(?:\.\d{1,3}){3})(?::\d+)?(?:\?.*)?\Z")


class Membership:
    """The membership of one LCM provider's group; none where the provider is another than multicast."""

    def __init__(self, url: str):
        found = _GROUP.match(url)
        self._request = b""
        if found:
            # the interface is left to the kernel, as LCM does: that which the group's route names
            with contextlib.suppress(OSError):  # no address: LCM has said so
                self._request = struct.pack("=4s4s", socket.inet_aton(found[1]), socket.inet_aton("0.0.0.0"))
        self._socket: socket.socket | None = None
        self._joined = False
        self._told = False
        self.renew()

    def renew(self) -> bool:
        """Join where no membership is; return whether there is one now, True also where none is needed."""
        if not self._request:
            return True
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, self._request)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return True  # a member already, on the interface that the route names now
            self.close()
            if not self._told:
                self._told = True
                log.warning(
                    "the bus has no way: no network interface takes its multicast group (%s). It is tried again every "
                    "%g s; see: ip route get %s",
                    error.strerror,
                    RENEW_S,
                    socket.inet_ntoa(self._request[:4]),
                )
            return False
        if self._joined:
            log.warning("the bus has a way again: its multicast group was joined anew")
        self._joined, self._told = True, False
        return True

    def close(self) -> None:
        """Leave the group."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
