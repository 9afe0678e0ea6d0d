"""Receive the messages of some channels within the thread that waits for them.

liblcm receives in a thread of its own, which copies each message into a queue and wakes the program by a pipe. A query
passes two such threads, and to wake a thread on an idle processor costs more than to answer (`python -m benchmarks
query_latency`). So service and `Platform` read the packets of LCM's UDP multicast themselves (`UdpReceiver`), from a
socket whose filter drops other channels. They publish by liblcm. Other providers than udpm:// are received by liblcm
(`LcmReceiver`).

Format (udp_lcm_protocol of the LCM manual), numbers big-endian:

- short message: "LC02", sequence number (4 bytes), channel, NUL, data;
- fragment of a long one: "LC03", sequence number (4), size of the data (4), offset of the fragment in it (4), number of
  the fragment (2), count of fragments (2); the first one has channel and NUL before its data.

As in liblcm, a sender's fragments count if the first comes first, and a message with a lost fragment is lost.

Filter: LCM has one multicast group for all channels, so every packet of the bus would wake every receiver. With a
classic BPF program on the socket (SO_ATTACH_FILTER, socket(7)) the kernel drops packets of other channels within the
sender's system call. The filter only saves work: the receiver compares the channel of what passes. Only the first
fragment names the channel, so all fragments pass. Filtered packets count as drops of the socket (ss -um) and as
InErrors of UDP (netstat -su), not as RcvbufErrors.
"""

from __future__ import annotations

import array
import socket
import struct
import weakref
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, Protocol, TypeAlias

import lcm

from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.provider import UdpAddress, handle_message, make_bus_error, open_lcm, parse_udp_address

Sender: TypeAlias = tuple[str, int] | None
"""Address of the socket that has sent a message, which identifies its program; None where liblcm receives."""

Message: TypeAlias = tuple[bytes, bytes, Sender]
"""Channel, data, and who has sent it."""


MAX_PARTIAL_BYTES: Final = 1 << 24
"""Received bytes of all messages of which fragments are missing. As in liblcm."""

MAX_PARTIAL: Final = 256
"""Messages of which fragments are missing. Beyond either limit the one that has waited longest for a fragment is
dropped."""


class Receiver(Protocol):
    """Queue of received messages. `fileno` is readable if one may have arrived."""

    fileno: int
    refused: Counter[bytes]
    """Messages that are too long, by channel."""

    def subscribe(self, channel: str) -> None:
        """Receive the messages of a channel too."""

    def receive(self) -> Message | None:
        """Return the next message that has arrived, None without one. It does not wait."""

    def close(self) -> None:
        """Leave the bus."""


def open_receiver(url: str, max_bytes: int = MAX_PARTIAL_BYTES) -> Receiver:
    """Join the bus to receive; longer messages than `max_bytes` are refused. Raises BusError with hints."""
    address = parse_udp_address(url)
    if address is None:
        return LcmReceiver(url, max_bytes)
    try:
        return UdpReceiver(address, max_bytes)
    except OSError as error:
        raise make_bus_error(url, error) from None


_SHORT, _FRAGMENT = b"LC02", b"LC03"
_CHANNEL_AT: Final = 8
"""Offset of the channel in a short message."""

_FRAGMENT_HEADER: Final = struct.Struct(">4sIIIHH")
"""Magic, sequence number, size, offset, number, count."""

MAX_PACKET: Final = 1 << 16
"""Bytes of the longest UDP packet, rounded up."""

MAX_IGNORED: Final = 64
"""Packets without a message that one call of `receive` reads, so that a flood of them does not hold it."""


@dataclass(slots=True)
class _PartialMessage:
    sequence: int
    size: int
    count: int
    channel: bytes
    parts: dict[int, tuple[int, bytes]] = field(default_factory=dict)
    """Offset and data of the fragments that have arrived, by number."""
    received: int = 0


class FragmentAssembler:
    """Assembles long messages from their fragments; one of each sender at a time.

    Memory is that of the fragments that have arrived: to begin a long message costs no more than its first one.
    """

    def __init__(self, max_bytes: int = MAX_PARTIAL_BYTES) -> None:
        self.channels: set[bytes] = set()
        """Channels whose messages are assembled."""
        self.refused: Counter[bytes] = Counter()
        """Messages longer than `max_bytes`, by channel."""
        self.partial_bytes = 0
        """Received bytes of all messages of which fragments are missing."""
        self._max_bytes = max_bytes
        self._partial: OrderedDict[Sender, _PartialMessage] = OrderedDict()

    def add(self, sender: Sender, packet: bytes) -> Message | None:
        """Process a fragment; return the message that it completes, None if it completes none."""
        if len(packet) < _FRAGMENT_HEADER.size:
            return None
        _, sequence, size, offset, number, count = _FRAGMENT_HEADER.unpack_from(packet)
        partial = self._partial.get(sender)
        if partial is not None and (partial.sequence, partial.size, partial.count) != (sequence, size, count):
            self._drop(sender)  # its other fragments are lost
            partial = None
        start = _FRAGMENT_HEADER.size
        if number == 0:
            end = packet.find(0, start)
            if partial is None and end > start:
                partial = self._begin(sender, packet[start:end], sequence, size, count)
            start = end + 1
        if partial is None:
            return None
        self._partial.move_to_end(sender)
        length = len(packet) - start
        if offset + length > size or number >= count:
            self._drop(sender)
            return None
        if number in partial.parts:
            return None
        partial.parts[number] = (offset, packet[start:])
        partial.received += length
        self.partial_bytes += length
        if len(partial.parts) == count:
            self._drop(sender)
            return _join(partial, sender)
        while len(self._partial) > MAX_PARTIAL or self.partial_bytes > MAX_PARTIAL_BYTES:
            self._drop(next(iter(self._partial)))
        return None

    def _begin(self, sender: Sender, channel: bytes, sequence: int, size: int, count: int) -> _PartialMessage | None:
        if channel not in self.channels:
            return None
        if size > self._max_bytes:
            self.refused[channel] += 1
            return None
        partial = self._partial[sender] = _PartialMessage(sequence, size, count, channel)
        return partial

    def _drop(self, sender: Sender) -> None:
        self.partial_bytes -= self._partial.pop(sender).received


def _join(partial: _PartialMessage, sender: Sender) -> Message | None:
    """Return a message of which all fragments are there; None if they leave a gap, or overlap."""
    at = 0
    for number in range(partial.count):
        offset, data = partial.parts[number]
        if offset != at:
            return None
        at += len(data)
    if at != partial.size:
        return None
    return partial.channel, b"".join(partial.parts[number][1] for number in range(partial.count)), sender


class UdpReceiver:
    """Receiver on a multicast group, whose queue is the socket's receive buffer. Raises OSError."""

    def __init__(self, address: UdpAddress, max_bytes: int = MAX_PARTIAL_BYTES):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        weakref.finalize(self, self._socket.close)
        self._assembler = FragmentAssembler(max_bytes)
        self.refused = self._assembler.refused
        try:
            set_channel_filter(self._socket, ())  # before the first packet
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            # Linux grants up to net.core.rmem_max of it
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, address.buffer)
            self._socket.bind((address.group, address.port))
            # the interface is that of the group's route, as for liblcm
            membership = socket.inet_aton(address.group) + socket.inet_aton("0.0.0.0")
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise
        self.fileno = self._socket.fileno()
        self._receive = self._socket.recvfrom

    def subscribe(self, channel: str) -> None:
        self._assembler.channels.add(channel.encode())
        set_channel_filter(self._socket, self._assembler.channels)

    def receive(self) -> Message | None:
        """See `Receiver`."""
        for _ in range(MAX_IGNORED):
            try:
                packet, sender = self._receive(MAX_PACKET)
            except BlockingIOError:
                return None
            magic = packet[:4]
            if magic == _SHORT:
                end = packet.find(0, _CHANNEL_AT)
                channel = packet[_CHANNEL_AT:end]
                if end > 0 and channel in self._assembler.channels:
                    return channel, packet[end + 1 :], sender
            elif magic == _FRAGMENT:
                message = self._assembler.add(sender, packet)
                if message is not None:
                    return message
        return None

    def close(self) -> None:
        self._socket.close()


MAX_QUEUED: Final = 1000
"""Messages that liblcm queues on a channel: at 100 Hz ten seconds, at 64 kB each 64 MB."""

MESSAGE_OVERHEAD_BYTES: Final = 128
"""Memory of a queued message beside its data, about: a record with pointers and the channel's name."""


class LcmReceiver:
    """Receiver by liblcm, for other providers. It queues `MAX_QUEUED` messages of a channel, and drops further ones."""

    def __init__(self, url: str, max_bytes: int = MAX_PARTIAL_BYTES):
        self._bus = open_lcm(url)
        self._max_bytes = max_bytes
        self.refused: Counter[bytes] = Counter()
        self._subscriptions: list[lcm.LCMSubscription] = []
        self.fileno = self._bus.fileno()
        self._received: deque[Message] = deque()

    def subscribe(self, channel: str) -> None:
        """See `Receiver`."""
        # the handler holds no reference to self, so that an object that is deleted without close() leaves the bus
        received, name, refused, max_bytes = self._received, channel.encode(), self.refused, self._max_bytes

        def handle(_: str, data: bytes) -> None:
            if len(data) > max_bytes:
                refused[name] += 1
            else:
                received.append((name, data, None))

        subscription = self._bus.subscribe(to_subscription_pattern(channel), handle)
        subscription.set_queue_capacity(MAX_QUEUED)
        self._subscriptions.append(subscription)

    def receive(self) -> Message | None:
        if not self._received and not handle_message(self._bus):
            return None
        return self._received.popleft() if self._received else None

    def close(self) -> None:
        # the subscriptions' handlers keep the instance in memory
        for each in self._subscriptions:
            self._bus.unsubscribe(each)
        self._subscriptions.clear()


# --- the socket filter ------------------------------------------------------------------------------------------------

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
"""Of Linux; the socket module has no names for them."""

_INSTRUCTION: Final = struct.Struct("=HBBI")
"""struct sock_filter: code, jump if true, jump if false, operand."""

_PROGRAM: Final = struct.Struct("@HP")
"""struct sock_fprog: number of instructions, their address."""

_LOAD_WORD, _LOAD_BYTE, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x30, 0x15, 0x06
_WHOLE_PACKET, _NO_PACKET = 0xFFFFFFFF, 0

_MAGIC_IN_PACKET, _CHANNEL_IN_PACKET = 8, 16
"""Offsets behind the UDP header."""


def make_program(channels: Iterable[bytes]) -> list[tuple[int, int, int, int]]:
    """Return the instructions that let short messages of these channels and all fragments pass.

    A load beyond the packet's end drops it. So shorter names are compared first: one that is longer than the packet
    comes after all that it could be.
    """
    program = [
        (_LOAD_WORD, 0, 0, _MAGIC_IN_PACKET),
        (_JUMP_IF_EQUAL, 3, 0, int.from_bytes(_SHORT, "big")),
        (_JUMP_IF_EQUAL, 0, 1, int.from_bytes(_FRAGMENT, "big")),
        (_RETURN, 0, 0, _WHOLE_PACKET),
        (_RETURN, 0, 0, _NO_PACKET),
    ]
    for name in sorted({channel + b"\0" for channel in channels}, key=len):
        size, load = (4, _LOAD_WORD) if len(name) >= 4 else (1, _LOAD_BYTE)
        # from the end, where the names of one server differ; the last comparison may overlap the one before
        starts = [*range(len(name) - size, 0, -size), 0]
        for number, start in enumerate(starts):
            to_next_name = 2 * (len(starts) - number) - 1
            program.append((load, 0, 0, _CHANNEL_IN_PACKET + start))
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
