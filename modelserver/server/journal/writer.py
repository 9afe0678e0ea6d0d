"""Writer of the journal: a thread that turns the queue of the loop into a ring of sealed segments on disk.

It never makes the loop wait for the disk, and for the interpreter (GIL) at most a fraction of a millisecond: records
are sealed in small batches with pauses between them. `run_once` is one cycle, so that tests need no thread. After a
disk error, records are dropped and counted, and every `RETRY_S` a new segment is tried.

The head of each segment holds the facts of build and machine on which the bits of results depend, the number of the
segment in the ring, the number of the run, its part number in the run, and the seal of the previous segment. A segment
ends with its seal: with a key the HMAC-SHA256 of the digest of all its bytes including the head, without one the digest
itself. So nobody without the key can forge, change, replace or reorder segments; without a key the checks find
accidental damage only.

The sealed file `newest` names the last segment, which detects missing segments at the end. Limit: an older `newest`
restored together with fewer segments cannot be detected by anything on the same disk.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import hmac
import json
import logging
import mmap
import os
import platform
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, NamedTuple

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import Instant
from modelserver.errors import RecordingError
from modelserver.files import open_regular, read_start
from modelserver.messages import CHANNEL_OF
from modelserver.server import persistence
from modelserver.server.clock import Clock
from modelserver.server.journal import JournalEntry, JournalQueue, SegmentStart, encoding
from modelserver.server.log import escape_text, start_in_background
from modelserver.signing import Key
from modelserver.version import __version__
from modelserver.wire import journal
from modelserver.wire.eventlog import Buffer

log = logging.getLogger(__name__)


INFORMATIVE_FACTS: Final = frozenset({"host", "kernel"})
"""Facts that do not affect results."""


@cache
def collect_facts() -> Mapping[str, str]:
    """Return the facts of build and machine that affect the last bits of results, and the informative ones."""
    return {
        "modelserver": __version__,
        "source": _hash_source(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        # read from the metadata, without importing them; pin is Pinocchio
        **{name: _read_version(name) for name in ("numpy", "filterpy", "pyproj", "pin")},
        "libc": " ".join(platform.libc_ver()),
        "machine": platform.machine(),
        "processor": _read_processor(),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", ""),
        "host": platform.node(),
        "kernel": platform.release(),
    }


def _read_version(name: str) -> str:
    with contextlib.suppress(PackageNotFoundError):
        return version(name)
    return ""


def _hash_source() -> str:
    """Return a digest of the source files, which identifies the build."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _read_processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() in ("model name", "Model", "CPU part"):
                return value.strip()
    return platform.processor()


SEGMENT_NAME: Final = re.compile(r"journal-(\d{8})\.lcm")

LOCK_NAME: Final = "lock"


def list_segments(directory: Path) -> list[Path]:
    return sorted(path for path in directory.iterdir() if SEGMENT_NAME.fullmatch(path.name))


def get_number(path: Path) -> int | None:
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
    """Directory of segments with a maximum size; the oldest are deleted. One writer at a time. Raises OSError."""

    def __init__(self, directory: Path, max_bytes: int, segment_bytes: int):
        self.directory = directory
        self.max_bytes = max_bytes
        self.segment_bytes = segment_bytes
        self._lock = persistence.FileLock(directory / LOCK_NAME)

    def acquire(self) -> None:
        persistence.create_directory(self.directory)
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
        number = max([min_number, *((get_number(path) or 0) + 1 for path in held)])
        segment = Segment(self.directory / f"journal-{number:08d}.lcm", number)
        persistence.sync_directory(self.directory)
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
    key = find_key(found["key"], keys)
    if (key is not None or not found["key"]) and not hmac.compare_digest(_seal_newest(key, line).encode(), seal[:-1]):
        raise RecordingError("its seal is wrong")
    newest = NewestMarker(found["run"], found["number"], found["seal"])
    if type(newest.run) is not int or type(newest.number) is not int or type(newest.seal) is not str:
        raise RecordingError("its fields have wrong types")
    return newest


def find_key(name: str, keys: Sequence[Key]) -> Key | None:
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
        head, end = next(iter(journal.read_segment(data)), None), journal.read_end(data)
    run = head.facts.get("run_number") if isinstance(head, journal.SegmentHead) else None
    return NewestMarker(
        run if type(run) is int else -1, get_number(held[-1]) or 0, "" if end is None else end.seal.hex()
    )


PERIOD_S: Final = 0.2
"""Seconds between two cycles: what a killed process loses at most."""

RETRY_S: Final = 5.0
"""Seconds after a disk error until the next attempt."""

BATCH_RECORDS: Final = 32
"""Records sealed together: less than half a millisecond of work, for which the loop may have to wait."""

PAUSE_S: Final = 5e-5
"""Seconds between two batches in which the loop can get the interpreter."""

CLOSE_TIMEOUT_S: Final = 1.5
"""Seconds that the stopping service waits for the rest to be written."""


def pause() -> None:
    """Release the interpreter to another thread."""
    time.sleep(PAUSE_S)


class JournalWriter:
    """Writes the records of a queue into a ring, on a thread between `start` and `close`.

    Parameters
    ----------
    facts: about service, build and machine, as JSON.
    key: seals the segments; None: without authentication.
    """

    def __init__(
        self,
        queue: JournalQueue,
        ring: Ring,
        config: VehicleConfig,
        facts: Mapping[str, Any],
        clock: Clock,
        pause: Callable[[], object] = pause,
        key: Key | None = None,
    ):
        self._key = key
        self._run_number = -1
        self._previous = ""
        self._queue = queue
        self._ring = ring
        self._config, self._facts = config, facts
        self._clock = clock
        self._sync_ns = round(config.journal.sync_s * 1e9)
        self._pause = pause
        self._segment: Segment | None = None
        self._part = 0
        self._batch = 0
        self._lost = 0
        self._due_ns = 0
        self._retry_ns = 0
        self._failed: OSError | None = None
        self._unsynced = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        queue.wants_state = True

    def start(self) -> None:
        start_in_background(self._thread)

    def close(self) -> None:
        """Write the rest, close the segment, and wait for that at most `CLOSE_TIMEOUT_S`."""
        self._ending.set()
        self._thread.join(CLOSE_TIMEOUT_S)
        if self._thread.is_alive():
            log.warning("the end of the journal is not written: its disk does not respond")

    def _run(self) -> None:
        while not self._ending.wait(PERIOD_S):
            try:
                self.run_once()
            except Exception as error:
                log.exception("internal error while writing the journal")
                self._fail(OSError(0, f"internal error: {error}"))
        self.finish()

    def finish(self) -> None:
        with contextlib.suppress(Exception):
            self.run_once()
            self._end_segment()
        self._ring.release()

    def run_once(self) -> None:
        """Write the queued records, and sync when due. A disk error becomes a health warning."""
        now_ns = self._clock.monotonic_ns()
        try:
            while entries := self._queue.pop(BATCH_RECORDS):
                self._write(entries)
                self._pause()
            if self._segment is not None:
                if self._unsynced and now_ns >= self._due_ns:
                    self._due_ns = now_ns + self._sync_ns
                    self._segment.sync()
                    self._unsynced = False
                if self._segment.size >= self._ring.segment_bytes or not self._queue.is_open:
                    self._queue.wants_state = True
            elif now_ns >= self._retry_ns and not self._queue.wants_state:
                self._queue.wants_state = True
        except OSError as error:
            self._fail(error)

    def _write(self, entries: list[JournalEntry]) -> None:
        """Write entries: a batch for the records between two segment starts."""
        records: list[journal.JournalRecord] = []
        for number, (kind, now, channel, data, event) in enumerate(entries):
            if isinstance(event, SegmentStart):
                try:
                    self._write_batch(records)
                    records = []
                    self._begin_segment(event, now)
                except Exception:
                    self._lost += len(entries) - number - 1
                    raise
                continue
            if self._segment is None:
                self._lost += 1
                continue
            if kind is journal.RecordKind.EVENT:
                data = encoding.encode_value(event, self._pause, is_described=False)
            elif kind is journal.RecordKind.REQUEST and type(event) not in CHANNEL_OF:
                kind = journal.RecordKind.SAMPLE
            records.append(journal.JournalRecord(kind, now.monotonic_ns, now.utime, channel, data))
        self._write_batch(records)

    def _write_batch(self, records: list[journal.JournalRecord]) -> None:
        if not records or self._segment is None:
            self._lost += len(records)
            return
        try:
            self._segment.append(journal.encode_batch(self._batch, records))
        except OSError:
            self._lost += len(records)
            raise
        self._batch += 1
        self._unsynced = True

    def _begin_segment(self, beginning: SegmentStart, now: Instant) -> None:
        """Close the segment and start the next one with the given state."""
        lost = self._lost + beginning.lost
        try:
            self._end_segment()
            run = encoding.RunState(self._config, encoding.detach(beginning.state))
            state = encoding.encode_run(run, self._pause)
            segment = self._create_segment()
            facts: dict[str, Any] = {"format": journal.FORMAT, "part": self._part, "lost": lost, "utime": now.utime}
            facts |= self._facts
            facts["key"] = "" if self._key is None else self._key.name
            facts |= {"number": segment.number, "run_number": self._run_number, "previous": self._previous}
            self._previous, self._segment, self._batch = "", segment, 0
            segment.append(journal.encode_head(facts, now.utime))
            segment.append(journal.encode_state(state, now.utime))
            self._write_newest(segment.number)
        except OSError:
            self._lost = lost
            raise
        self._part += 1
        self._lost = 0
        self._unsynced = True
        if self._failed is not None:
            log.info("the journal is written again in %s; %d records are lost", segment.path, lost)
            self._queue.set_warning("")
            self._failed = None
        elif lost:
            log.warning("%d records of the journal are lost: the disk was too slow", lost)

    def _end_segment(self) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                digest = segment.digest.digest()
                mac = seal_segment(self._key, digest)
                segment.append(journal.encode_end(digest, self._clock.utime(), mac))
                segment.sync()
                self._previous = (mac or digest).hex()
                self._write_newest(segment.number)
            finally:
                segment.close()

    def _create_segment(self) -> Segment:
        """Create the next segment, which continues the chain in the directory."""
        ring = self._ring
        ring.acquire()
        newest = read_newest(ring.directory, () if self._key is None else (self._key,), verify=False)
        if self._run_number < 0:
            before = read_last_segment(ring.directory)
            self._previous = before.seal
            self._run_number = max(before.run, -1 if newest is None else newest.run) + 1
        return ring.create_segment(0 if newest is None else newest.number + 1)

    def _write_newest(self, number: int) -> None:
        newest = NewestMarker(self._run_number, number, self._previous)
        persistence.write_atomically(self._ring.directory / NEWEST_NAME, newest.encode(self._key))

    def _fail(self, error: OSError) -> None:
        """Stop writing until the next attempt; meanwhile records are dropped and counted."""
        if self._segment is not None:
            self._segment.close()
            self._segment = None
        self._retry_ns = self._clock.monotonic_ns() + round(RETRY_S * 1e9)
        text = self._describe_error(error)
        if self._failed is None or self._describe_error(self._failed) != text:
            log.warning("%s", text)
            self._queue.set_warning(text)
        self._failed = error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            # new records are worth more than old ones
            with contextlib.suppress(OSError):
                self._ring.make_room()

    def _describe_error(self, error: OSError) -> str:
        directory = self._ring.directory
        why = persistence.describe_error(error, directory, "journal.directory")
        place = escape_text(str(directory))
        return f"nothing is recorded: the journal cannot be written in {place}: {why}. It retries every {RETRY_S:g} s"


DEFAULT_MEGABYTES: Final = 1024
"""Default size limit."""

MIN_SEGMENTS: Final = 8
"""Minimum number of segments in a ring; the oldest is deleted as a whole."""

MAX_SEGMENT_BYTES: Final = 16 << 20


def get_journal_directory(config: VehicleConfig, systemd_directory: str | None = None) -> Path | None:
    """Return the directory of the journal; None where none is written.

    By default only a service to which systemd gave a state directory writes one, so that experiments of a developer do
    not fill the home directory; a configured directory or size enables it always. `systemd_directory` is that state
    directory, by default the one of this process.
    """
    settings = config.journal
    if settings.megabytes == 0:
        return None
    if settings.directory:
        return Path(settings.directory)
    systemd_directory = os.environ.get("STATE_DIRECTORY", "") if systemd_directory is None else systemd_directory
    if settings.megabytes is None and not systemd_directory:
        return None
    base = persistence.get_state_directory(config.state_directory or systemd_directory.split(":")[0])
    return None if base is None else base / f"journal-{persistence.to_file_name(config.vehicle)}"


def get_max_bytes(config: VehicleConfig) -> int:
    return (config.journal.megabytes or DEFAULT_MEGABYTES) << 20


def make_writer(
    config: VehicleConfig, clock: Clock, key: Key | None = None
) -> tuple[JournalQueue, JournalWriter] | None:
    """Return the queue for the loop and its writer, None where no journal is written.

    `key`: seals segments.
    """
    directory = get_journal_directory(config)
    if directory is None:
        return None
    most = get_max_bytes(config)
    log.info("the journal is written in %s, %d MB at most", directory, most >> 20)
    ring = Ring(directory, most, min(MAX_SEGMENT_BYTES, most // MIN_SEGMENTS))
    facts = {
        **collect_facts(),
        "vehicle": config.vehicle,
        "run": secrets.token_hex(8),
        "pid": os.getpid(),
    }
    queue = JournalQueue()
    return queue, JournalWriter(queue, ring, config, facts, clock, key=key)
