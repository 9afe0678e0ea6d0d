"""LCM providers: URLs, instances, and receivers within the thread that waits.

liblcm 1.5 accepts URLs that do not work: without a port udpm opens and waits forever, ttl=300 becomes 44, ttl=abc
becomes 0. These are rejected here with a hint; whatever liblcm interprets as written is accepted. lcm itself is
imported when an instance is opened: reading a vehicle file needs only the URL.

Receivers: liblcm receives in a thread of its own, which copies each message into a queue and wakes the program by a
pipe. A query passes two such threads, and to wake a thread on an idle processor costs more than to answer
(`python -m benchmarks query_latency`). So service and `Platform` read the packets of LCM's UDP multicast themselves
(`UdpReceiver`), from a socket whose filter drops other channels. They publish by liblcm. Other providers than udpm://
are received by liblcm (`LcmReceiver`).

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
import os
import re
import socket
import struct
import weakref
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias
from urllib.parse import parse_qsl, urlsplit

from modelserver.errors import BusError, quote
from modelserver.wire.channels import DEFAULT_URL, to_subscription_pattern

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

_MULTICAST: Final = ("udpm", "mpudpm")

_NUMBER: Final = re.compile(r"\s*[+-]?(0[xX][0-9a-fA-F]+|\d+)")


def find_url_problem(url: str) -> str:
    """Return what is wrong with an LCM URL and what to write instead, empty for a valid one."""
    scheme, found, rest = url.partition("://")
    place, _, options = rest.partition("?")
    if not found or scheme not in SCHEMES:
        return f"{quote(url, 40)} is no URL of LCM's, which has {', '.join(SCHEMES)}; write it like {DEFAULT_URL}"
    if scheme == "memq":
        return f"memq:// does not leave the process, so no other program receives it; write {DEFAULT_URL}"
    if scheme == "file" and not place:
        return "it names no log; write file:///path/of/log"
    if scheme in _MULTICAST and not (_is_multicast(place, scheme) and all(map(_is_valid_ttl, options.split("&")))):
        return (
            f"{quote(rest, 60)} is no multicast address: a group between 224.0.0.0 and 239.255.255.255, a port from 1 "
            f"to 65535, and a ttl from 0 (this machine) to 255; write it like {DEFAULT_URL}"
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


# --- receivers --------------------------------------------------------------------------------------------------------

Sender: TypeAlias = tuple[str, int] | None
"""Address of the socket that has sent a message, which identifies its program; None where liblcm receives."""

Message: TypeAlias = tuple[bytes, bytes, Sender]
"""Channel, data, and who has sent it."""


MAX_PARTIAL_BYTES: Final = 1 << 24
"""Received bytes of all messages of which fragments are missing. As in liblcm."""

MAX_PARTIAL: Final = 256
"""Messages of which fragments are missing. Beyond either limit the one that has waited longest for a fragment is
dropped."""


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
            channel = packet[start:end]
            if partial is None and end > start and channel in self.channels:
                if size <= self._max_bytes:
                    partial = self._partial[sender] = _PartialMessage(sequence, size, count, channel)
                else:
                    self.refused[channel] += 1
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

    def _drop(self, sender: Sender) -> None:
        self.partial_bytes -= self._partial.pop(sender).received


def _join(partial: _PartialMessage, sender: Sender) -> Message | None:
    """Return a message of which all fragments are there; None if they leave a gap, or overlap."""
    fragments = [partial.parts[number] for number in range(partial.count)]
    at = 0
    for offset, data in fragments:
        if offset != at:
            return None
        at += len(data)
    return (partial.channel, b"".join(data for _, data in fragments), sender) if at == partial.size else None


class UdpReceiver:
    """Receiver on a multicast group, whose queue is the socket's receive buffer. Raises OSError.

    `fileno` is readable if a message may have arrived; `refused` counts those that are too long, by channel.
    """

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
        """Return the next message that has arrived, None without one. It does not wait."""
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
    """As `UdpReceiver`, by liblcm: for other providers. It queues `MAX_QUEUED` messages of a channel, and no more."""

    def __init__(self, url: str, max_bytes: int = MAX_PARTIAL_BYTES):
        self._bus = open_lcm(url)
        self._max_bytes = max_bytes
        self.refused: Counter[bytes] = Counter()
        self._subscriptions: list[lcm.LCMSubscription] = []
        self.fileno = self._bus.fileno()
        self._received: deque[Message] = deque()

    def subscribe(self, channel: str) -> None:
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


Receiver: TypeAlias = UdpReceiver | LcmReceiver


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
