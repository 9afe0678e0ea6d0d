"""Waiting for files to be mended: a service manager starts a service again at once, as often as it ends.

A start with the same files would be refused for the same reason, at the cost of most of a core and of a log that holds
nothing else. So a service that is refused waits for one of its files to change, and then ends.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeAlias

WAIT_S: Final = 30.0
"""The longest wait: what stands in the way may be no file's content."""

LOOK_S: Final = 0.25
"""Between two looks at the files."""

Look: TypeAlias = tuple[int, int, int, int] | None
"""What a file looks like from outside: device, inode, time of change (ns), size (bytes). None: there is none."""


def look_at(path: Path) -> Look:
    """Return what a file looks like; links are followed."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


class Files:
    """Files as they were when they were first named, which is best done before they are read."""

    def __init__(self, *paths: str | Path):
        self._seen: dict[Path, Look] = {}
        self.add(*paths)

    def add(self, *paths: str | Path) -> None:
        """Name more files, also such as are not there; for one that is known already nothing changes."""
        for path in map(Path, paths):
            if path not in self._seen:
                self._seen[path] = look_at(path)

    @property
    def are_changed(self) -> bool:
        """Whether any is another than it was, is gone, or has come."""
        return any(look_at(path) != seen for path, seen in self._seen.items())

    def wait(
        self,
        seconds: float = WAIT_S,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> bool:
        """Wait until one has changed, but no longer than `seconds`; return whether one has."""
        end_ns = monotonic_ns() + round(seconds * 1e9)
        while not self.are_changed:
            left = (end_ns - monotonic_ns()) * 1e-9
            if left <= 0.0:
                return False
            sleep(min(LOOK_S, left))
        return True
