"""Writer of the journal: a thread that turns the queue of the loop into sealed segments, and where they are stored.

It never makes the loop wait for the disk, and for the interpreter (GIL) at most a fraction of a millisecond: records
are sealed in small batches with pauses between them. `run_once` is one cycle, so that tests need no thread. After a
disk error, records are dropped and counted, and every `RETRY_S` a new segment is tried.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from modelserver.config.vehicle_file import VehicleConfig
from modelserver.core import Instant
from modelserver.files import read_regular
from modelserver.formats import MAX_BYTES as LARGEST_FILE
from modelserver.messages import CHANNEL_OF
from modelserver.server.clock import Clock
from modelserver.server.journal import environment
from modelserver.server.journal import state as journal_state
from modelserver.server.journal.queue import JournalEntry, JournalQueue, SegmentStart
from modelserver.server.journal.segments import (
    NEWEST_NAME,
    NewestMarker,
    Ring,
    Segment,
    read_last_segment,
    read_newest,
    seal_segment,
)
from modelserver.server.log import escape_text, start_in_background
from modelserver.server.persistence.directory import (
    FileLock,
    describe_error,
    get_state_directory,
    to_file_name,
    write_atomically,
)
from modelserver.signing import Key
from modelserver.wire import journal

log = logging.getLogger(__name__)

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

MAX_FILE_BYTES: Final = 4 << 20
"""Greatest size of a file that is copied into every segment; of a larger one only the beginning."""


@dataclass(frozen=True, slots=True)
class JournalContext:
    """What every segment begins with in addition to the state.

    Attributes
    ----------
    facts: about service, build and machine, as JSON.
    files: name and bytes of the files that the service was started with, for people; the replay does not use them.
    config: configuration of the vehicle.
    """

    facts: Mapping[str, Any]
    files: Iterable[tuple[str, bytes]]
    config: VehicleConfig


def pause() -> None:
    """Release the interpreter to another thread."""
    time.sleep(PAUSE_S)


class JournalWriter:
    """Writes the records of a queue into a ring, on a thread between `start` and `close`.

    `key`: seals the segments; None: without authentication.
    """

    def __init__(
        self,
        queue: JournalQueue,
        ring: Ring,
        context: JournalContext,
        clock: Clock,
        pause: Callable[[], object] = pause,
        key: Key | None = None,
    ):
        # compiled before the loop starts
        journal_state.get_schema()
        self._key = key
        self._run_number = -1
        self._previous = ""
        self._queue = queue
        self._ring = ring
        self._context = context
        self._clock = clock
        self._sync_ns = round(context.config.journal.sync_s * 1e9)
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
        """Write the rest and close the segment."""
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
        for number, entry in enumerate(entries):
            if isinstance(entry.event, SegmentStart):
                try:
                    self._write_batch(records)
                    records = []
                    self._begin_segment(entry.event, entry.now)
                except Exception:
                    self._lost += len(entries) - number - 1
                    raise
            elif self._segment is None:
                self._lost += 1
            else:
                records.append(self._record(entry))
        self._write_batch(records)

    def _record(self, entry: JournalEntry) -> journal.JournalRecord:
        kind, data = entry.kind, entry.data
        if kind is journal.RecordKind.EVENT:
            data = journal_state.encode_event(entry.event, self._pause)
        elif kind is journal.RecordKind.REQUEST and type(entry.event) not in CHANNEL_OF:
            kind = journal.RecordKind.SAMPLE
        return journal.JournalRecord(kind, entry.now.monotonic_ns, entry.now.utime, entry.channel, data)

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
            run = journal_state.RunState(self._context.config, journal_state.detach(beginning.state))
            state = journal_state.encode_run(run, self._pause)
            segment = self._create_segment()
            facts: dict[str, Any] = {"format": journal.FORMAT, "part": self._part, "lost": lost, "utime": now.utime}
            facts |= self._context.facts
            facts["history_s"] = journal_state.HISTORY_S if len(beginning.state.history) else None
            facts["key"] = "" if self._key is None else self._key.name
            facts |= {"number": segment.number, "run_number": self._run_number, "previous": self._previous}
            self._previous = ""
            self._segment, self._batch = segment, 0
            segment.append(journal.encode_head(facts, now.utime))
            for name, data in self._context.files:
                segment.append(journal.encode_file(name, data[:MAX_FILE_BYTES], now.utime))
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
                end = journal.SegmentEnd(
                    True, segment.digest.digest(), seal_segment(self._key, segment.digest.digest())
                )
                segment.append(journal.encode_end(end.digest, self._clock.utime(), end.mac))
                segment.sync()
                self._previous = end.seal.hex()
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
        write_atomically(self._ring.directory / NEWEST_NAME, newest.encode(self._key))

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
        why = describe_error(error, directory, "journal.directory")
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
    base = get_state_directory(config.state_directory or systemd_directory.split(":")[0])
    if base is None:
        return None
    return base / f"journal-{to_file_name(config.vehicle)}"


def get_max_bytes(config: VehicleConfig) -> int:
    """Return the size limit of a vehicle's journal, bytes."""
    return (config.journal.megabytes or DEFAULT_MEGABYTES) << 20


def make_writer(
    config: VehicleConfig, file: str, clock: Clock, lock: FileLock | None = None, key: Key | None = None
) -> tuple[JournalQueue, JournalWriter] | None:
    """Return the queue for the loop and its writer, None where no journal is written.

    `file`: the vehicle file. `lock`: that of the state directory, used if the journal is inside. `key`: seals segments.
    """
    directory = get_journal_directory(config)
    if directory is None:
        return None
    most = get_max_bytes(config)
    log.info("the journal is written in %s, %d MB at most", directory, most >> 20)
    within = lock if lock is not None and directory.is_relative_to(lock.path.parent) else None
    ring = Ring(directory, most, min(MAX_SEGMENT_BYTES, most // MIN_SEGMENTS), within)
    facts = {
        **environment.collect_facts(),
        "vehicle": config.vehicle,
        "run": secrets.token_hex(8),
        "pid": os.getpid(),
    }
    paths = [path for path in (Path(file), Path(config.geometry)) if path.is_file()]
    files = [(str(path), read_regular(path, LARGEST_FILE)) for path in paths]
    queue = JournalQueue()
    origins = JournalContext(facts, files, config)
    return queue, JournalWriter(queue, ring, origins, clock, key=key)
