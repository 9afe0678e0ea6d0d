"""Socket filter of a receiver: the kernel delivers only the packets of its channels.

LCM has one multicast group for all channels, so every packet of the bus would wake every receiver. With a classic BPF
program on the socket (SO_ATTACH_FILTER, socket(7)) the kernel drops packets of other channels within the sender's
system call. The filter only saves work: the receiver compares the channel of what passes.

A packet begins with the UDP header; then "LC02", sequence number, channel, NUL, data; or "LC03" for a fragment of a
long message. Only the first fragment names the channel, so all fragments pass.

Filtered packets count as drops of the socket (ss -um) and as InErrors of UDP (netstat -su), not as RcvbufErrors.
"""

from __future__ import annotations

import array
import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import Final

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
"""Of Linux; the socket module has no names for them."""

_INSTRUCTION: Final = struct.Struct("=HBBI")
"""struct sock_filter: code, jump if true, jump if false, operand."""

_PROGRAM: Final = struct.Struct("@HP")
"""struct sock_fprog: number of instructions, their address."""

_LOAD_WORD, _LOAD_BYTE, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x30, 0x15, 0x06
_WHOLE_PACKET, _NO_PACKET = 0xFFFFFFFF, 0

_MAGIC_AT, _CHANNEL_AT = 8, 16
"""Offsets behind the UDP header."""

_SHORT, _FRAGMENT = (int.from_bytes(magic, "big") for magic in (b"LC02", b"LC03"))


def make_program(channels: Iterable[bytes]) -> list[tuple[int, int, int, int]]:
    """Return the instructions that let short messages of these channels and all fragments pass.

    A load beyond the packet's end drops it. So shorter names are compared first: one that is longer than the packet
    comes after all that it could be.
    """
    program = [
        (_LOAD_WORD, 0, 0, _MAGIC_AT),
        (_JUMP_IF_EQUAL, 3, 0, _SHORT),
        (_JUMP_IF_EQUAL, 0, 1, _FRAGMENT),
        (_RETURN, 0, 0, _WHOLE_PACKET),
        (_RETURN, 0, 0, _NO_PACKET),
    ]
    for name in sorted({channel + b"\0" for channel in channels}, key=len):
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


def set_channel_filter(receiving: socket.socket, channels: Iterable[bytes]) -> None:
    """Let only the packets of these channels pass, from now on; instead of those before.

    If the kernel rejects the program, because it is too long or not Linux, all packets pass.
    """
    program = make_program(channels)
    code = array.array("B", b"".join(_INSTRUCTION.pack(*each) for each in program))
    try:
        receiving.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, _PROGRAM.pack(len(program), code.buffer_info()[0]))
    except OSError:
        with suppress(OSError):
            receiving.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
