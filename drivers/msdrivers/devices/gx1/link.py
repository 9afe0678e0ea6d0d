"""What a host knows of the line to a 3DM-GX1: replies with their ticks unwrapped, and what was heard besides."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from msdrivers.protocol.gx1 import DATA, LAYOUTS, CommandByte, Gx1Parser, Packet, TickWatch
from msdrivers.protocol.gx1.scaling import QUARTER_TURN, is_unit
from msdrivers.station import Now

KEPT = 32
"""Bytes of what was heard that are kept to be shown."""


class Reply(NamedTuple):
    """A reply that counts, and its ticks unwrapped; -1 where it has none."""

    packet: Packet
    ticks: int


class Gx1Link:
    """Bytes in, replies that count out: asked for, checksum right, ticks after those before, content possible."""

    def __init__(self) -> None:
        self.parser = Gx1Parser(self._judge)
        self.watch = TickWatch()
        self.now = Now(0, 0)
        self.messages: Counter[str] = Counter()
        self._counts: list[int] = []
        self._newest: dict[int, int] = {}
        self._streamed = 0
        self._heard = b""
        self.heard_bytes = 0
        """Heard since `mark`, whether they made sense or not."""

    def feed(self, data: bytes, now: Now) -> list[Reply]:
        """Return the replies that are complete now."""
        self.now = now
        self.heard_bytes += len(data)
        if len(self._heard) < KEPT:
            self._heard = (self._heard + data)[:KEPT]
        packets = self.parser.feed(data)
        replies = [Reply(packet, count) for packet, count in zip(packets, self._counts, strict=True)]
        self._counts.clear()
        for packet in packets:
            self.messages[f"message.{CommandByte(packet.command).name.lower()}"] += 1
        return replies

    def stream(self, command: int) -> None:
        """Tell which measurement is streamed from now on; 0 for none."""
        self._streamed = command
        self.parser.stream(*((command,) if command else ()))

    def begin_anew(self) -> None:
        """Forget what was expected and how the ticks stood."""
        self.stream(0)
        self.parser.clear()
        self.watch.forget()
        self._newest.clear()
        self.mark()

    def mark(self) -> None:
        """Begin to note what is heard."""
        self._heard, self.heard_bytes = b"", 0

    def heard(self) -> str:
        """Return in words what was heard since `mark`, whether it made sense or not."""
        if not self.heard_bytes:
            return "nothing"
        shown = self._heard
        if sum(32 <= byte < 127 or byte in b"\r\n" for byte in shown) > 0.9 * len(shown):
            return f"{self.heard_bytes} bytes of text, beginning {shown.decode('ascii', 'replace')!r}"
        return f"{self.heard_bytes} bytes, beginning {shown.hex(' ')}"

    @property
    def rejected(self) -> Counter[str]:
        """How many replies were rejected, by reason."""
        return Counter(
            {key.removeprefix("rejected."): count for key, count in self.parser.counts.items() if "." in key}
        )

    def _judge(self, packet: Packet) -> str:
        if not _possible(packet):
            return "content"
        if packet.ticks is None:
            self._counts.append(-1)
            return ""
        command = packet.command
        count = self.watch.take(packet.ticks, self.now.monotonic_ns, command == self._streamed)
        if count is None:
            return "ticks"
        if command in DATA:
            if count <= self._newest.get(command, -1):
                return "repeated"
            self._newest[command] = count
        self._counts.append(count)
        return ""


def _possible(packet: Packet) -> bool:
    """Return whether the device can have meant it: pitch within a right angle, a quaternion of length one."""
    if packet.has("euler"):
        return abs(packet.field("euler")[1]) <= QUARTER_TURN
    if packet.has("quaternion"):
        return is_unit(packet.field("quaternion"))
    if packet.command == CommandByte.CONTINUOUS:
        # a command byte behind a zero
        return packet.words[0] == 0 or packet.words[0] in LAYOUTS
    return True
