"""The geometry's broadcast: written once for each model, sent again and again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from modelserver.core import CoreState
from modelserver.geometry.model import Model
from modelserver.messages import SnapshotPart
from modelserver.wire.snapshot import in_parts


class SnapshotWriter:
    """Keeps the parts of the model in force; `write` gives the bytes of a snapshot."""

    def __init__(self, write: Callable[[CoreState], bytes]):
        self._write = write
        self._of: Model | None = None
        self._parts: list[SnapshotPart] = []

    def parts(self, state: CoreState, utime: int) -> list[SnapshotPart]:
        """Return the parts to send at `utime`."""
        if self._of is not state.model:
            self._parts = in_parts(self._write(state), state.model.revision, utime)
            # only now: where writing failed it is tried again
            self._of = state.model
        return [replace(part, utime=utime) for part in self._parts]
