"""NMEA 0183 and NovAtel logs, interleaved on one port."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from msdrivers.protocol.framing import Format, Scanner
from msdrivers.protocol.nmea import EpochAssembler, NmeaEpoch, NmeaSentence, SentenceFormat
from msdrivers.protocol.novatel import (
    Answer,
    AsciiFormat,
    BinaryFormat,
    NovatelLog,
    Prompt,
    PromptFormat,
    TextFormat,
)

GpsMessage: TypeAlias = NmeaEpoch | NovatelLog | Answer | Prompt
"""Each has `start`: bytes from the beginning of the stream to its first byte, to find when that came in."""


class GpsStream:
    """Bytes in, messages out, in the order in which they are complete. Never raises; memory is bounded.

    What comes out does not depend on how the bytes were cut, as long as nobody says `idle`.
    """

    def __init__(self) -> None:
        formats: tuple[Format[NmeaSentence | NovatelLog | Answer | Prompt], ...] = (
            SentenceFormat(),
            BinaryFormat(),
            AsciiFormat(),
            TextFormat(),
            PromptFormat(),
        )
        self._scanner = Scanner(formats)
        self._epochs = EpochAssembler()

    @property
    def offset(self) -> int:
        """Bytes that were fed."""
        return self._scanner.offset

    @property
    def waiting(self) -> int:
        """Bytes kept of an incomplete frame."""
        return self._scanner.waiting

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames by kind, `rejected.<reason>`, `skipped` bytes."""
        return {**self._scanner.counts, **({"rejected.late": self._epochs.late} if self._epochs.late else {})}

    def feed(self, data: bytes) -> list[GpsMessage]:
        """Return what `data` completes."""
        messages: list[GpsMessage] = []
        for each in self._scanner.feed(data):
            if isinstance(each, NmeaSentence):
                messages += self._epochs.add(each)
            else:
                messages.append(each)
        return messages

    def idle(self) -> list[NmeaEpoch]:
        """Return the epoch under way: the line has been silent long enough that no more of it will come."""
        return self._epochs.flush()

    def clear(self) -> None:
        """Forget what is incomplete: the line was closed. Counters and offsets go on."""
        self._scanner.clear()
        self._epochs.clear()
