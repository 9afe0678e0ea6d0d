"""The geometry's snapshot in parts, each in one packet, and put together again."""

from __future__ import annotations

from typing import Final

from modelserver.messages import SnapshotPart

PART_BYTES: Final = 1200
"""Of payload: with its header a part fits an Ethernet frame, so that none is lost for a piece of it."""


def split_snapshot(data: bytes, revision: str, utime: int) -> list[SnapshotPart]:
    """Return the parts of a snapshot's bytes."""
    pieces = [data[start : start + PART_BYTES] for start in range(0, len(data), PART_BYTES)]
    return [SnapshotPart(utime, revision, number, len(pieces), piece) for number, piece in enumerate(pieces)]


class SnapshotAssembler:
    """Puts the parts of snapshots together, in whatever order they come; holds one revision at a time."""

    def __init__(self) -> None:
        self._revision = ""
        self._count = 0
        self._parts: dict[int, bytes] = {}

    def add(self, part: SnapshotPart) -> bytes | None:
        """Take a part; return the whole when it is complete, None before."""
        if (part.model_revision, part.parts) != (self._revision, self._count):
            self._revision, self._count, self._parts = part.model_revision, part.parts, {}
        self._parts[part.part] = part.data
        if len(self._parts) < self._count:
            return None
        whole = b"".join(self._parts[number] for number in range(self._count))
        self._parts = {}
        return whole
