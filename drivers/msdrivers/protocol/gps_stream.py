"""NMEA 0183 and NovAtel logs, interleaved on one port."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from msdrivers.protocol.framing import FrameFormat, FrameScanner
from msdrivers.protocol.nmea import EpochAssembler, NmeaEpoch, NmeaSentence, SentenceFormat
from msdrivers.protocol.novatel import (
    AsciiFormat,
    BinaryFormat,
    CommandResponse,
    NovatelLog,
    Prompt,
    PromptFormat,
    TextFormat,
)

GpsMessage: TypeAlias = NmeaEpoch | NovatelLog | CommandResponse | Prompt
"""Each has `start`: offset of its first byte in the stream, to find its receive time."""


class GpsStream:
    """Parses bytes to messages in the order of their completion. Never raises; memory is bounded.

    The messages do not depend on how the bytes are split, except for calls of `flush`.
    """

    def __init__(self) -> None:
        formats: tuple[FrameFormat[NmeaSentence | NovatelLog | CommandResponse | Prompt], ...] = (
            SentenceFormat(),
            BinaryFormat(),
            AsciiFormat(),
            TextFormat(),
            PromptFormat(),
        )
        self._scanner = FrameScanner(formats)
        self._epochs = EpochAssembler()

    @property
    def offset(self) -> int:
        """Bytes that were fed."""
        return self._scanner.offset

    @property
    def pending_bytes(self) -> int:
        """Bytes kept of an incomplete frame."""
        return self._scanner.pending_bytes

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

    def flush(self) -> list[NmeaEpoch]:
        """Return the pending epoch: the line has been silent long enough for it to be complete."""
        return self._epochs.flush()

    def clear(self) -> None:
        """Discard what is incomplete after the line was closed; counters and offsets continue."""
        self._scanner.clear()
        self._epochs.clear()
