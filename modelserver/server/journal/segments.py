"""Segments of a journal on disk: the ring that drops the oldest ones, how they are found, the chain of their seals.

The head of each segment holds its number in the ring, the number of the run, its part number in the run, and the seal
of the previous segment. A segment ends with its seal: with a key the HMAC-SHA256 of the digest of all its bytes
including the head, without one the digest itself. So nobody without the key can forge, change, replace or reorder
segments; without a key the checks find accidental damage only.

The sealed file `newest` names the last segment, which detects missing segments at the end. Limit: an older `newest`
restored together with fewer segments cannot be detected by anything on the same disk.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import hmac
import json
import mmap
import os
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from modelserver.errors import RecordingError
from modelserver.files import open_regular, read_start
from modelserver.server.persistence.directory import FileLock, create_directory
from modelserver.signing import Key
from modelserver.wire.eventlog import Buffer, LogEvent, scan
from modelserver.wire.journal import MAGIC, SegmentEnd, SegmentHead, read_end, read_segment

SEGMENT_NAME: Final = re.compile(r"journal-(\d{8})\.lcm")

LOCK_NAME: Final = "lock"


def list_segments(directory: Path) -> list[Path]:
    """List the segments in a directory, the oldest first. Raises OSError."""
    return sorted(path for path in directory.iterdir() if SEGMENT_NAME.fullmatch(path.name))


def get_number(path: Path) -> int | None:
    """Return the number in the name of a segment; None for another name."""
    match = SEGMENT_NAME.fullmatch(path.name)
    return int(match[1]) if match else None


@contextlib.contextmanager
def open_mapped(path: Path) -> Iterator[Buffer]:
    """Map a regular file into memory, for reading. Raises OSError."""
    with open_regular(path) as file:
        if not file.seek(0, 2):
            yield b""  # an empty file cannot be mapped
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


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
        create_directory(self.directory)
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
        newest = get_number(held[-1]) if held else None
        number = max(0 if newest is None else newest + 1, min_number)
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
    with open_mapped(path) as data:
        if not data:
            raise RecordingError(
                f"{path}: the file is empty, so there is nothing to verify; give the folder of the journal"
            )
        if data.find(MAGIC) >= 0 or SEGMENT_NAME.fullmatch(path.name):
            return
        is_log = isinstance(next(iter(scan(data)), None), LogEvent)
    if is_log:
        raise RecordingError(
            f"{path}: is an LCM log, not a journal, so it has no output to verify; to play it: "
            f"modelserver replay {path} (without --verify)"
        )
    raise RecordingError(
        f"{path}: is neither a journal nor an LCM log; a journal is a folder of files journal-*.lcm, such as "
        "/var/lib/modelserver/journal-NAME"
    )


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


SEGMENT_DOMAIN: Final = b"modelserver journal segment, version 1\n"
NEWEST_DOMAIN: Final = b"modelserver journal newest, version 1\n"
"""Domain separation: prefix of the sealed bytes, which no other use of a key shares."""

NEWEST_NAME: Final = "newest"

MAX_NEWEST_BYTES: Final = 1024
"""Bytes of the file."""


def seal_segment(key: Key | None, digest: bytes) -> bytes:
    """Return the MAC of a segment with this SHA-256 digest; empty without a key."""
    return b"" if key is None else hmac.digest(key.secret, SEGMENT_DOMAIN + digest, hashlib.sha256)


class NewestMarker(NamedTuple):
    """The last segment: run, number in the ring, seal (hex; empty = not closed); the content of the file `newest`."""

    run: int = -1
    number: int = -1
    seal: str = ""

    def encode(self, key: Key | None) -> bytes:
        line = json.dumps({"key": "" if key is None else key.name, **self._asdict()}).encode() + b"\n"
        return line + _seal_newest(key, line).encode() + b"\n"


def _seal_newest(key: Key | None, line: bytes) -> str:
    data = NEWEST_DOMAIN + line
    return (hashlib.sha256(data) if key is None else hmac.new(key.secret, data, hashlib.sha256)).hexdigest()


def read_newest(directory: Path, keys: Sequence[Key], verify: bool = True) -> NewestMarker | None:
    """Return the marker of a journal; None where there is no file.

    With `verify`, raise RecordingError where it is damaged or not authentic; else such a file counts as missing. The
    seal of a key is not checked if `keys` is empty.
    """
    try:
        data = read_start(directory / NEWEST_NAME, MAX_NEWEST_BYTES)
    except OSError:
        return None
    try:
        return _parse_newest(data, keys)
    except (RecordingError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        if not verify:
            return None
        raise RecordingError(f"the file {NEWEST_NAME} is damaged or not authentic: {error}") from error


def _parse_newest(data: bytes, keys: Sequence[Key]) -> NewestMarker:
    line, _, seal = data.partition(b"\n")
    line += b"\n"
    found = json.loads(line)
    key = _find_key(found["key"], keys)
    if (key is not None or not found["key"]) and not hmac.compare_digest(_seal_newest(key, line).encode(), seal[:-1]):
        raise RecordingError("its seal is wrong")
    newest = NewestMarker(found["run"], found["number"], found["seal"])
    if type(newest.run) is not int or type(newest.number) is not int or type(newest.seal) is not str:
        raise RecordingError("its fields have wrong types")
    return newest


def _find_key(name: str, keys: Sequence[Key]) -> Key | None:
    """Return the named key; None where the journal has no key or no keys are given. Raises RecordingError."""
    if not name or not keys:
        return None
    for key in keys:
        if key.name == name:
            return key
    raise RecordingError(f"it is sealed with key {name[:64]!r}, which is not in the key file")


def read_last_segment(directory: Path) -> NewestMarker:
    """Return the last segment of a directory, as far as its head and end are readable. Raises OSError."""
    held = list_segments(directory)
    if not held:
        return NewestMarker()
    with open_mapped(held[-1]) as data:
        head, end = next(iter(read_segment(data)), None), read_end(data)
    run = head.facts.get("run_number") if isinstance(head, SegmentHead) else None
    return NewestMarker(
        run if type(run) is int else -1, get_number(held[-1]) or 0, "" if end is None else end.seal.hex()
    )


class _Link(NamedTuple):
    path: Path
    number: int
    seal: str
    """Hexadecimal; empty = the segment is not closed."""


class ChainVerifier:
    """Verifies segments in the given order. `genuine` counts those with a valid keyed seal.

    `report` gets each finding about the current segment, and whether it is damage: segments that are missing, replaced,
    or not authentic.
    """

    def __init__(self, report: Callable[[str, bool], object], keys: Sequence[Key] = ()):
        self.genuine = 0
        self.unsealed: list[Path] = []
        """Segments without a verifiable seal: not closed, without a key, or the key is not given."""
        self._report = report
        self._keys = keys
        self._before: _Link | None = None
        self._places: dict[int, Path] = {}

    def begin(self, path: Path, facts: dict[str, Any]) -> None:
        """Check the position of a segment in the chain, by its head."""
        number, previous = facts["number"], str(facts["previous"])
        if get_number(path) not in (None, number):
            self._report(f"is segment {number} by its own head: renamed, or put in place of another", True)
        first = self._places.setdefault(number, path)
        before = self._before
        if first != path:
            self._report(f"is a copy of {first.name}", True)
        elif before is None:
            if number > 0 or previous:
                count = f"{number} earlier segments" if number > 0 else "earlier segments"
                self._report(f"{count} were dropped by the ring, or removed", False)
        elif number <= before.number:
            self._report(f"is older than {before.path.name} before it: out of order", True)
        elif number > before.number + 1:
            missing = number - before.number - 1
            self._report(f"{missing} segments before it are missing, after {before.path.name}: removed, or lost", True)
        elif previous and not before.seal:
            self._report(f"follows {before.path.name}, whose end was cut off after it was written", True)
        elif previous != before.seal:
            self._report(f"does not match {before.path.name} before it: one of the two was replaced", True)
        self._before = _Link(path, number, "")

    def end(self, facts: dict[str, Any], end: SegmentEnd | None) -> None:
        """Check the seal of the current segment; `end` None: it is not closed."""
        before = self._before
        assert before is not None
        name = str(facts["key"])
        if end is None:
            self.unsealed.append(before.path)
            return
        self._before = before._replace(seal=end.seal.hex())
        if not name or not self._keys:
            self.unsealed.append(before.path)
            if name or not end.mac:
                return
        try:
            key = _find_key(name, self._keys)
        except RecordingError as error:
            self._report(f"cannot be verified: {error}", True)
            return
        if not hmac.compare_digest(seal_segment(key, end.digest), end.mac):
            self._report("its seal is wrong: it was not written with the key", True)
            return
        self.genuine += key is not None

    def skip(self, path: Path) -> None:
        """Skip a segment with an unreadable head, which counts as not closed."""
        self.unsealed.append(path)
        number = get_number(path)
        if self._before is not None and number is not None:
            self._before = _Link(path, number, "")

    def finish(self, newest: NewestMarker | None) -> None:
        """Check that the last segment is the one in `newest`; None: not known."""
        before = self._before
        if newest is None or before is None:
            return
        name = before.path.name
        if newest.number > before.number:
            count = newest.number - before.number
            self._report(f"{count} segments after {name} are missing at the end: removed, or lost", True)
        elif newest.number < before.number:
            # a stop between creating a segment and updating the marker is normal
            if newest.number != before.number - 1 or before.seal:
                self._report(f"the file {NEWEST_NAME} is older than {name}: restored", True)
        elif newest.seal and newest.seal != before.seal:
            why = "was replaced" if before.seal else "was cut off after it was closed"
            self._report(f"{name}, the last segment, {why}", True)
