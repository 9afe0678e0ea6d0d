"""Replies of the 3DM-GX1 out of the bytes of a line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable

from msdrivers.protocol.gx1.packets import LENGTHS, Packet, decoded

Judge = Callable[[Packet], str]
"""Says in one word why a reply whose checksum is right does not count; empty where it does."""


def _accept(_: Packet) -> str:
    return ""


class Gx1Parser:
    """Finds the replies that were asked for. Without a sync byte random bytes pass for a reply one time in 65,536.

    So a reply counts only if its command is streamed or expected, its checksum is right, and the judge has nothing
    against it; else one byte is skipped and the search goes on behind it. At most 30 bytes wait for more.
    """

    __slots__ = ("_buffer", "_expected", "_head", "_judge", "_streamed", "counts")

    def __init__(self, judge: Judge = _accept):
        """Take what judges replies beyond their checksum."""
        self._judge = judge
        self._buffer = bytearray()
        self._streamed: frozenset[int] = frozenset()
        self._expected: Counter[int] = Counter()
        self._head = _search(set())
        self.counts: Counter[str] = Counter()
        """`skipped` bytes that were part of no reply, and `rejected.` by reason."""

    def stream(self, *commands: int) -> None:
        """Tell which replies may come unasked from now on, any number of them."""
        self._streamed = frozenset(commands)
        self._look()

    def expect(self, command: int) -> None:
        """Tell that a reply was asked for: one more of it counts."""
        self._expected[command] += 1
        self._look()

    def give_up(self, command: int) -> None:
        """Tell that the replies to a command are not waited for any more."""
        self._expected.pop(command, None)
        self._look()

    def clear(self) -> None:
        """Skip the bytes that wait for more, and expect nothing."""
        self.counts["skipped"] += len(self._buffer)
        self._buffer.clear()
        self._expected.clear()
        self.stream()

    def feed(self, data: bytes) -> list[Packet]:
        """Return the replies that are complete now, in order."""
        buffer = self._buffer
        buffer += data
        found: list[Packet] = []
        at = 0
        while True:
            match = self._head.search(buffer, at)
            begin = len(buffer) if match is None else match.start()
            self.counts["skipped"] += begin - at
            at = begin
            if match is None:
                break
            command = buffer[at]
            if at + LENGTHS[command] > len(buffer):
                break
            packet = decoded(buffer, at, command)
            reason = "checksum" if packet is None else self._judge(packet)
            if packet is None or reason:
                self.counts[f"rejected.{reason}"] += 1
                self.counts["skipped"] += 1
                at += 1
                continue
            at += LENGTHS[command]
            found.append(packet)
            if command not in self._streamed:
                self._answered(command)
        # a match holds on to the buffer, which then cannot shrink
        del match
        del buffer[:at]
        return found

    def _answered(self, command: int) -> None:
        self._expected[command] -= 1
        if not self._expected[command]:
            self.give_up(command)

    def _look(self) -> None:
        self._head = _search(self._streamed | self._expected.keys())


def _search(commands: set[int] | frozenset[int]) -> re.Pattern[bytes]:
    """Return the pattern of a reply's first byte; of nothing where no reply is expected."""
    if not commands:
        return re.compile(b"(?!)")
    return re.compile(b"[" + b"".join(re.escape(bytes((command,))) for command in sorted(commands)) + b"]")
