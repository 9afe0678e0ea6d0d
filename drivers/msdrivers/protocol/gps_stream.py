"""NMEA 0183 and NovAtel logs, interleaved on one port."""

from __future__ import annotations

from typing import Any, TypeAlias

from msdrivers.protocol.framing import FrameScanner
from msdrivers.protocol.nmea import EpochAssembler, NmeaEpoch, NmeaSentence, SentenceFormat
from msdrivers.protocol.novatel import CommandResponse, NovatelLog, Prompt
from msdrivers.protocol.novatel.frames import AsciiFormat, BinaryFormat, PromptFormat, TextFormat

GpsMessage: TypeAlias = NmeaEpoch | NovatelLog | CommandResponse | Prompt
"""Each has `start`: offset of its first byte in the stream, to find its receive time."""


class GpsStream(FrameScanner[Any]):
    """Parses bytes to messages in the order of their completion. Never raises; memory is bounded.

    The messages do not depend on how the bytes are split, except for calls of `flush`.
    """

    def __init__(self) -> None:
        super().__init__((SentenceFormat(), BinaryFormat(), AsciiFormat(), TextFormat(), PromptFormat()))
        self._epochs = EpochAssembler()

    @property
    def counts(self) -> dict[str, int]:
        """Frames by kind, `rejected.<reason>`, `skipped` bytes."""
        return super().counts | ({"rejected.late": self._epochs.late} if self._epochs.late else {})

    def feed(self, data: bytes) -> list[GpsMessage]:
        """Return what `data` completes."""
        messages: list[GpsMessage] = []
        for each in super().feed(data):
            messages += self._epochs.add(each) if isinstance(each, NmeaSentence) else [each]
        return messages

    def flush(self) -> list[NmeaEpoch]:
        """Return the pending epoch: the line has been silent long enough for it to be complete."""
        return self._epochs.flush()

    def clear(self) -> None:
        """Discard what is incomplete after the line was closed; counters and offsets continue."""
        super().clear()
        self._epochs.clear()
