"""Segments of a journal on disk: the ring that drops the oldest ones, and the search for a journal's files."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import mmap
import os
import re
from itertools import islice
from pathlib import Path
from typing import Final

from modelserver.errors import RecordingError
from modelserver.files.regular import open_regular
from modelserver.server.persistence.directory import FileLock
from modelserver.wire.eventlog import Buffer, LogEvent, scan
from modelserver.wire.journal import MAGIC

SEGMENT_NAME: Final = re.compile(r"journal-(\d{8})\.lcm")

LOCK_NAME: Final = "lock"


def list_segments(directory: Path) -> list[Path]:
    """List the segments in a directory, the oldest first. Raises OSError."""
    return sorted(path for path in directory.iterdir() if SEGMENT_NAME.fullmatch(path.name))


class Segment:
    """A segment that is being written and hashed. Never an existing file.

    Every method raises OSError for an error of the disk.
    """

    def __init__(self, path: Path, number: int = 0):
        self.path = path
        self.number = number
        """Number in the ring."""
        self.size = 0
        self.digest = hashlib.sha256()
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)

    def append(self, data: bytes) -> None:
        """Write bytes to the page cache: from here on they survive the process."""
        left = memoryview(data)
        while left:
            left = left[os.write(self._file, left) :]
        self.size += len(data)
        self.digest.update(data)

    def sync(self) -> None:
        """Sync to the disk: from here on the bytes survive the machine."""
        if os.fstat(self._file).st_nlink == 0:
            # writes to an unlinked file succeed, but the data are lost
            raise FileNotFoundError(errno.ENOENT, "the segment was removed while it was written", str(self.path))
        os.fdatasync(self._file)

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(OSError):
            os.close(self._file)


class Ring:
    """Directory of segments with a maximum size; the oldest are deleted. One writer at a time. Methods raise OSError.

    `outer_lock`: the lock of a directory around it that another service may hold, None = there is none.
    """

    def __init__(self, directory: Path, max_bytes: int, segment_bytes: int, outer_lock: FileLock | None = None):
        self.directory = directory
        self.max_bytes = max_bytes
        self.segment_bytes = segment_bytes
        self._outer_lock = outer_lock
        self._lock = FileLock(directory / LOCK_NAME)

    def acquire(self) -> None:
        """Acquire the directory for this writer."""
        if self._outer_lock is not None:
            self._outer_lock.claim()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._lock.acquire()

    def create_segment(self, min_number: int = 0) -> Segment:
        """Create a segment with the next number, after deleting the oldest ones to make room for it.

        Its number is at least `min_number`: there may have been segments that were deleted.
        """
        self.acquire()
        held = list_segments(self.directory)
        sizes = [path.stat().st_size for path in held]
        excess = sum(sizes) + self.segment_bytes - self.max_bytes
        for path, size in zip(held, sizes, strict=True):
            if excess <= 0:
                break
            path.unlink()
            excess -= size
        match = SEGMENT_NAME.fullmatch(held[-1].name) if held else None
        number = max(int(match[1]) + 1 if match else 0, min_number)
        segment = Segment(self.directory / f"journal-{number:08d}.lcm", number)
        self._sync_directory()
        return segment

    def make_room(self) -> bool:
        """Delete the oldest segment, except the newest; return whether there was one."""
        held = list_segments(self.directory)
        if len(held) < 2:
            return False
        held[0].unlink()
        return True

    def release(self) -> None:
        """Release the directory."""
        self._lock.release()

    def _sync_directory(self) -> None:
        file = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(file)
        finally:
            os.close(file)


MAX_SEARCHED_ENTRIES: Final = 1000
"""Entries of a folder without segments that are searched for a journal."""


def files_of(journal: Path) -> list[Path]:
    """Return the segments of a journal: those of a directory, or the one file.

    Raises RecordingError with a hint for anything else; OSError.
    """
    if not journal.is_dir():
        _check_journal_file(journal)
        return [journal]
    found = list_segments(journal)
    if not found:
        raise RecordingError(f"{journal}: {_describe_missing_segments(journal)}")
    return found


def _check_journal_file(path: Path) -> None:
    """Raise RecordingError for a file that is no segment. A damaged segment is one."""
    with open_regular(path) as file:
        if file.seek(0, 2) == 0:
            raise RecordingError(
                f"{path}: the file is empty, so there is nothing to verify; give the folder of the journal"
            )
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data.find(MAGIC) >= 0 or SEGMENT_NAME.fullmatch(path.name):
                return
            is_log = _is_log(data)
    if is_log:
        raise RecordingError(
            f"{path}: is an LCM log, not a journal, so it has no output to verify; to play it: "
            f"modelserver replay {path} (without --verify)"
        )
    raise RecordingError(
        f"{path}: is neither a journal nor an LCM log; a journal is a folder of files journal-*.lcm, such as "
        "/var/lib/modelserver/journal-NAME"
    )


def _is_log(data: Buffer) -> bool:
    return isinstance(next(iter(scan(data)), None), LogEvent)


def _describe_missing_segments(folder: Path) -> str:
    """Return the message for a folder without segments, with a hint."""
    entries = sorted(islice(folder.iterdir(), MAX_SEARCHED_ENTRIES))
    if not entries:
        return "the folder is empty; a journal is a folder of files journal-*.lcm"
    for each in entries:
        try:
            if each.is_dir() and list_segments(each):
                return f"contains no segment of a journal (journal-*.lcm); did you mean {each}?"
        except OSError:
            continue  # not readable
    text = "contains no segment of a journal (journal-*.lcm)"
    if any(each.suffix == ".lcm" for each in entries):
        text += "; to play its LCM logs: modelserver replay LOG, without --verify"
    return text
