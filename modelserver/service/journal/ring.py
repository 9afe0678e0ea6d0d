"""The ring: a directory of numbered segments, of which the oldest goes when there is too much."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
from pathlib import Path
from typing import Final

from modelserver.service.keeping.lock import Lock

SEGMENT_NAME: Final = re.compile(r"journal-(\d{8})\.lcm")

LOCK_NAME: Final = "lock"


def segments(directory: Path) -> list[Path]:
    """Return the segments in a directory, the oldest first. Raises OSError."""
    return sorted(path for path in directory.iterdir() if SEGMENT_NAME.fullmatch(path.name))


class Segment:
    """A segment that is being written: appended to, and hashed on the way. Never one that exists.

    Every method raises OSError where the disk refuses.
    """

    def __init__(self, path: Path, number: int = 0):
        self.path = path
        self.number = number
        """In the ring."""
        self.size = 0
        self.digest = hashlib.sha256()
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)

    def append(self, data: bytes) -> None:
        """Hand bytes to the system: they survive this process from here on."""
        left = memoryview(data)
        while left:
            left = left[os.write(self._file, left) :]
        self.size += len(data)
        self.digest.update(data)

    def sync(self) -> None:
        """Have the disk hold what was appended: it survives the machine from here on."""
        if os.fstat(self._file).st_nlink == 0:
            # it could be written to for ever, and nobody would find it
            raise FileNotFoundError(errno.ENOENT, "the segment was removed while it was written", str(self.path))
        os.fdatasync(self._file)

    def close(self) -> None:
        """Write no more."""
        with contextlib.suppress(OSError):
            os.close(self._file)


class Ring:
    """The directory. One writer at a time holds it. Methods raise OSError.

    `within`: the lock of a directory around it that another service may hold; None: there is none.
    """

    def __init__(self, directory: Path, most_bytes: int, segment_bytes: int, within: Lock | None = None):
        self.directory = directory
        self.most_bytes = most_bytes
        self.segment_bytes = segment_bytes
        self._within = within
        self._lock = Lock(directory / LOCK_NAME)

    def hold(self) -> None:
        """Have the directory for this writer."""
        if self._within is not None:
            self._within.claim()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._lock.hold()

    def fresh(self, least: int = 0) -> Segment:
        """Return a new segment, numbered behind all others, once the oldest have made room for it.

        `least`: the smallest number that it may have; there may have been segments that are gone.
        """
        self.hold()
        held = segments(self.directory)
        sizes = [path.stat().st_size for path in held]
        excess = sum(sizes) + self.segment_bytes - self.most_bytes
        for path, size in zip(held, sizes, strict=True):
            if excess <= 0:
                break
            path.unlink()
            excess -= size
        match = SEGMENT_NAME.fullmatch(held[-1].name) if held else None
        number = max(int(match[1]) + 1 if match else 0, least)
        segment = Segment(self.directory / f"journal-{number:08d}.lcm", number)
        self._sync_directory()
        return segment

    def make_room(self) -> bool:
        """Drop the oldest segment, where there is more than the newest; return whether there was."""
        held = segments(self.directory)
        if len(held) < 2:
            return False
        held[0].unlink()
        return True

    def release(self) -> None:
        """Let another writer have the directory."""
        self._lock.release()

    def _sync_directory(self) -> None:
        file = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(file)
        finally:
            os.close(file)
