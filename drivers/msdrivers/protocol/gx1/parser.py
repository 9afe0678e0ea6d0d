"""Parse the replies of the 3DM-GX1 from a byte stream.

The protocol has no sync byte, so random bytes pass for a reply one time in 65,536. A reply therefore counts only if
its command is streamed or expected, its checksum is right and the validator accepts it; else one byte is skipped and
the search continues. At most 30 bytes are buffered.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable

from msdrivers.protocol.gx1.packets import LENGTHS, Gx1Packet, decode_packet

ReplyValidator = Callable[[Gx1Packet], str]
"""Returns the reason to reject a reply with a valid checksum; empty to accept it."""


class Gx1Parser:
    """Finds the expected replies; see the module."""

    def __init__(self, judge: ReplyValidator = lambda _: ""):
        self._validate = judge
        self._buffer = bytearray()
        self._streamed: frozenset[int] = frozenset()
        self._expected: Counter[int] = Counter()
        self._update_pattern()
        self.counts: Counter[str] = Counter()
        """`skipped` bytes outside of replies, and `rejected.<reason>`."""

    def set_streamed(self, *commands: int) -> None:
        """Set the commands whose replies are accepted without a request."""
        self._streamed = frozenset(commands)
        self._update_pattern()

    def expect(self, command: int) -> None:
        """Accept one more reply to a command."""
        self._expected[command] += 1
        self._update_pattern()

    def cancel(self, command: int) -> None:
        """Expect no more replies to a command."""
        self._expected.pop(command, None)
        self._update_pattern()

    def clear(self) -> None:
        """Discard buffered bytes and expectations."""
        self.counts["skipped"] += len(self._buffer)
        self._buffer.clear()
        self._expected.clear()
        self.set_streamed()

    def feed(self, data: bytes) -> list[Gx1Packet]:
        """Return the replies that `data` completes, in order."""
        buffer = self._buffer
        buffer += data
        found: list[Gx1Packet] = []
        at = 0
        while True:
            match = self._start_pattern.search(buffer, at)
            begin = len(buffer) if match is None else match.start()
            self.counts["skipped"] += begin - at
            at = begin
            if match is None:
                break
            command = buffer[at]
            if at + LENGTHS[command] > len(buffer):
                break
            packet = decode_packet(buffer, at, command)
            reason = "checksum" if packet is None else self._validate(packet)
            if packet is None or reason:
                self.counts[f"rejected.{reason}"] += 1
                self.counts["skipped"] += 1
                at += 1
                continue
            at += LENGTHS[command]
            found.append(packet)
            if command not in self._streamed:
                self._expected -= Counter((command,))
                self._update_pattern()
        # a match object locks the buffer against resizing
        del match
        del buffer[:at]
        return found

    def _update_pattern(self) -> None:
        """Match the first byte of a reply; nothing where none is expected."""
        first = re.escape(bytes(sorted(self._streamed | self._expected.keys())))
        self._start_pattern = re.compile(b"[" + first + b"]" if first else b"(?!)")
