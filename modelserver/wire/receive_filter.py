"""Socket filter of an LCM instance: the kernel delivers only the packets of its channels.

LCM has one multicast group for all channels. So every packet wakes a thread of every LCM instance on the machine, which
reads it, looks the channel up and usually discards it. On a machine with few processors these threads run before the
one that a client waits for (`python -m benchmarks query_latency`). With a classic BPF program on the socket
(SO_ATTACH_FILTER, socket(7)) the kernel discards packets of other channels within the sender's system call. The filter
only saves work: LCM compares the channel of what passes.

A packet (udp_lcm_protocol of the LCM manual): UDP header; "LC02", sequence number, channel, NUL, data; or "LC03" for a
fragment of a long message. Only the first fragment names the channel, so all fragments pass.

LCM does not return which descriptor is its socket. It is the only UDP socket that this process has gained while LCM set
up its receiver; by inodes, since other threads may close and open descriptors meanwhile. If there is not exactly one
(several threads open some, another provider, another system than Linux) there is no filter.

Filtered packets count as drops of the socket (ss -um) and as InErrors of UDP (netstat -su), not as RcvbufErrors.
"""

from __future__ import annotations

import array
import os
import socket
import stat
import struct
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Final

import lcm

from modelserver.wire.provider import open_lcm

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
"""Of Linux; the socket module has no names for them."""

_DESCRIPTORS: Final = "/proc/self/fd"

_INSTRUCTION: Final = struct.Struct("=HBBI")
"""struct sock_filter: code, jump if true, jump if false, operand."""

_PROGRAM: Final = struct.Struct("@HP")
"""struct sock_fprog: number of instructions, their address."""

_LOAD_WORD, _LOAD_BYTE, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x30, 0x15, 0x06
_WHOLE_PACKET, _NO_PACKET = 0xFFFFFFFF, 0

_MAGIC_AT, _CHANNEL_AT = 8, 16
"""Offsets behind the UDP header."""

_SHORT_MESSAGE: Final = int.from_bytes(b"LC02", "big")


def make_program(channels: Iterable[str]) -> list[tuple[int, int, int, int]]:
    """Return the instructions that let short messages of these channels and all fragments pass.

    A load beyond the packet's end drops it. So shorter names are compared first: one that is longer than the packet
    comes after all that it could be.
    """
    program = [
        (_LOAD_WORD, 0, 0, _MAGIC_AT),
        (_JUMP_IF_EQUAL, 1, 0, _SHORT_MESSAGE),
        (_RETURN, 0, 0, _WHOLE_PACKET),
    ]
    for name in sorted({channel.encode() + b"\0" for channel in channels}, key=len):
        size, load = (4, _LOAD_WORD) if len(name) >= 4 else (1, _LOAD_BYTE)
        # from the end, where the names of one server differ; the last comparison may overlap the one before
        starts = [*range(len(name) - size, 0, -size), 0]
        for number, start in enumerate(starts):
            to_next_name = 2 * (len(starts) - number) - 1
            program.append((load, 0, 0, _CHANNEL_AT + start))
            program.append((_JUMP_IF_EQUAL, 0, to_next_name, int.from_bytes(name[start : start + size], "big")))
        program.append((_RETURN, 0, 0, _WHOLE_PACKET))
    program.append((_RETURN, 0, 0, _NO_PACKET))
    return program


class ReceiveFilter:
    """Filter of the packets that an LCM instance receives; all pass before `pass_only`.

    `receiving` is a duplicate of the instance's socket; None if it is unknown: then there is no filter.
    """

    def __init__(self, receiving: socket.socket | None):
        self._socket = receiving

    def pass_only(self, channels: Iterable[str]) -> None:
        """Let only the packets of these channels pass, from now on; instead of those before."""
        if self._socket is None:
            return
        program = make_program(channels)
        code = array.array("B", b"".join(_INSTRUCTION.pack(*each) for each in program))
        try:
            self._socket.setsockopt(
                socket.SOL_SOCKET, _SO_ATTACH_FILTER, _PROGRAM.pack(len(program), code.buffer_info()[0])
            )
        except OSError:  # too long for the kernel, or forbidden: without one, LCM discards the other channels
            with suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)

    def close(self) -> None:
        """Close the duplicate, without which the socket would stay open after LCM has closed it; the filter stays."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


_opening: Final = threading.Lock()


def open_receiver(url: str) -> tuple[lcm.LCM, ReceiveFilter]:
    """Join the bus to receive some channels; return the instance, and its filter. Raises BusError with hints."""
    with _opening:
        bus = open_lcm(url)
        before = set(_find_sockets().values())
        bus.fileno()  # LCM opens its socket when it is first asked to receive
        if not url.startswith("udpm://"):
            return bus, ReceiveFilter(None)
        opened = [
            duplicate
            for descriptor, inode in _find_sockets().items()
            if inode not in before
            for duplicate in _duplicate(descriptor, inode)
        ]
    if len(opened) == 1:
        return bus, ReceiveFilter(opened[0])
    for each in opened:
        each.close()
    return bus, ReceiveFilter(None)


def _find_sockets() -> dict[int, int]:
    """Return the inode of each descriptor of this process that is a socket."""
    found = {}
    with suppress(OSError):
        for name in os.listdir(_DESCRIPTORS):
            with suppress(OSError):  # closed meanwhile
                status = os.fstat(int(name))
                if stat.S_ISSOCK(status.st_mode):
                    found[int(name)] = status.st_ino
    return found


def _duplicate(descriptor: int, inode: int) -> Iterator[socket.socket]:
    """Yield a duplicate of a descriptor if it is still the socket `inode`, and of UDP."""
    with suppress(OSError):
        found = socket.socket(fileno=os.dup(descriptor))
        if os.fstat(found.fileno()).st_ino == inode and found.type == socket.SOCK_DGRAM:
            yield found
        else:
            found.close()
