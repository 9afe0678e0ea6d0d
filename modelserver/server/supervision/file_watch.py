"""Wait until a file is fixed after a failed start.

A service manager restarts a failed service at once and repeatedly. With the same files it would fail for the same
reason, at the cost of most of a processor and a full log. So the service waits for a change of one of its files, and
then exits.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeAlias

MAX_WAIT_S: Final = 30.0
"""Longest wait: the reason may not be a file's content."""

POLL_S: Final = 0.25
"""Period of checking the files."""

FileStamp: TypeAlias = tuple[int, int, int, int] | None
"""Identity of a file's content: device, inode, time of change (ns), size (bytes); None without a file."""


def stat_file(path: Path) -> FileStamp:
    """Return the stamp of a file; links are followed."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


class FileWatcher:
    """Detects changes of files since they were added; add them before they are read."""

    def __init__(self, *paths: str | Path):
        self._stamps: dict[Path, FileStamp] = {}
        self.add(*paths)

    def add(self, *paths: str | Path) -> None:
        """Add files, also missing ones; a known file keeps its stamp."""
        for path in map(Path, paths):
            if path not in self._stamps:
                self._stamps[path] = stat_file(path)

    @property
    def has_changed(self) -> bool:
        """Whether a file has changed, is gone, or is new."""
        return any(stat_file(path) != stamp for path, stamp in self._stamps.items())

    def wait_for_change(
        self,
        seconds: float = MAX_WAIT_S,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> bool:
        """Wait at most `seconds` until a file has changed; return whether one has."""
        end_ns = monotonic_ns() + round(seconds * 1e9)
        while not self.has_changed:
            left = (end_ns - monotonic_ns()) * 1e-9
            if left <= 0.0:
                return False
            sleep(min(POLL_S, left))
        return True
