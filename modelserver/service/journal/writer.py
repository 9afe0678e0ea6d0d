"""The journal's writer: takes what the loop has left in the queue, and makes sealed segments of it.

It works on a thread of its own and never makes the loop wait: neither for the disk, nor, for longer than a fraction of
a millisecond, for the interpreter. `work` is one round of it, so that tests need no thread.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from modelserver.config import VehicleConfig
from modelserver.core import Instant
from modelserver.messages import CHANNEL_OF
from modelserver.service.clock import Clock
from modelserver.service.journal import state as journal_state
from modelserver.service.journal.chain import NEWEST_NAME, Newest, last_link, read_newest, seal_segment
from modelserver.service.journal.queue import Beginning, JournalEntry, JournalQueue
from modelserver.service.journal.ring import Ring, Segment
from modelserver.service.keeping.origin import write_whole
from modelserver.service.keeping.trouble import words_on
from modelserver.service.log import plain
from modelserver.signing import Key
from modelserver.wire.journal import (
    FORMAT,
    End,
    JournalRecord,
    RecordKind,
    batch_written,
    end_written,
    file_written,
    head_written,
    state_written,
)

log = logging.getLogger(__name__)

ROUND_S: Final = 0.2
"""Seconds between two rounds: what a process that is killed loses at most of what it did."""

RETRY_S: Final = 5.0
"""Seconds after which a disk that refused is tried again."""

BATCH: Final = 32
"""Records that are sealed together: less than half a millisecond of work, for which the loop may have to wait."""

PAUSE_S: Final = 5e-5
"""Seconds between two of them in which the loop can have the interpreter."""

CLOSING_S: Final = 1.5
"""How long the end of the service waits for the rest to be written."""

LARGEST_FILE: Final = 4 << 20
"""A larger file is named, not copied, at the beginning of every segment."""


@dataclass(frozen=True, slots=True)
class Origins:
    """What every segment begins with beside the state: whose journal it is.

    facts: about service, build and machine; JSON holds them. files: name and bytes of what the service was started
    with, for people; nothing is run again from them. config: the vehicle's configuration.
    """

    facts: Mapping[str, Any]
    files: Iterable[tuple[str, bytes]]
    config: VehicleConfig


def pause() -> None:
    """Let another thread have the interpreter."""
    time.sleep(PAUSE_S)


class JournalWriter:
    """Writes what a queue holds into a ring. `start` runs it on a thread, `close` ends that.

    `sync_s`: seconds between two times that the disk is told to hold what it was given. `key`: what segments are sealed
    with; None: nobody can prove them.
    """

    def __init__(
        self,
        queue: JournalQueue,
        ring: Ring,
        origins: Origins,
        clock: Clock,
        sync_s: float = 2.0,
        pause: Callable[[], object] = pause,
        key: Key | None = None,
    ):
        # compiled here, before the loop turns
        journal_state.schema()
        self._key = key
        self._run_number = -1
        self._previous = ""
        self._queue = queue
        self._ring = ring
        self._origins = origins
        self._clock = clock
        self._sync_ns = round(sync_s * 1e9)
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
        queue.ask()

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def close(self) -> None:
        """Write what is left, close the segment, and wait for that a moment."""
        self._ending.set()
        self._thread.join(CLOSING_S)
        if self._thread.is_alive():
            log.warning("the journal's end is not written: its disk does not answer")

    def _run(self) -> None:
        while not self._ending.wait(ROUND_S):
            try:
                self.work()
            except Exception as error:
                log.exception("an error of the server's own while writing the journal")
                self._fail(OSError(0, f"an error of the server's own: {error}"))
        self.finish()

    def finish(self) -> None:
        """Write what is left and close the segment."""
        with contextlib.suppress(Exception):
            self.work()
            self._end()
        self._ring.release()

    def work(self) -> None:
        """Write what has come since, and have it held where that is due. An error of the disk ends up in a notice."""
        now_ns = self._clock.monotonic_ns()
        try:
            while entries := self._queue.take(BATCH):
                self._write(entries)
                self._pause()
            if self._segment is not None:
                if self._unsynced and now_ns >= self._due_ns:
                    self._due_ns = now_ns + self._sync_ns
                    self._segment.sync()
                    self._unsynced = False
                if self._segment.size >= self._ring.segment_bytes or not self._queue.is_open:
                    self._queue.ask()
            elif now_ns >= self._retry_ns and not self._queue.wants_state:
                self._queue.ask()
        except OSError as error:
            self._fail(error)

    def _write(self, entries: list[JournalEntry]) -> None:
        """Write entries, each stretch of them between two beginnings in one batch."""
        records: list[JournalRecord] = []
        for number, entry in enumerate(entries):
            if isinstance(entry.event, Beginning):
                try:
                    self._seal(records)
                    records = []
                    self._begin(entry.event, entry.now)
                except Exception:
                    self._lost += len(entries) - number - 1
                    raise
            elif self._segment is None:
                self._lost += 1
            else:
                records.append(self._record(entry))
        self._seal(records)

    def _record(self, entry: JournalEntry) -> JournalRecord:
        kind, data = entry.kind, entry.data
        if kind is RecordKind.EVENT:
            data = journal_state.encode_event(entry.event, self._pause)
        elif kind is RecordKind.REQUEST and type(entry.event) not in CHANNEL_OF:
            kind = RecordKind.SAMPLE
        return JournalRecord(kind, entry.now.monotonic_ns, entry.now.utime, entry.channel, data)

    def _seal(self, records: list[JournalRecord]) -> None:
        if not records or self._segment is None:
            self._lost += len(records)
            return
        try:
            self._segment.append(batch_written(self._batch, records))
        except OSError:
            self._lost += len(records)
            raise
        self._batch += 1
        self._unsynced = True

    def _begin(self, beginning: Beginning, now: Instant) -> None:
        """Close the segment and begin the next with what is known now."""
        lost = self._lost + beginning.lost
        try:
            self._end()
            run = journal_state.RunState(self._origins.config, journal_state.detach(beginning.state))
            state = journal_state.encode_run(run, self._pause)
            segment = self._fresh()
        except OSError:
            self._lost = lost
            raise
        facts = {"format": FORMAT, "part": self._part, "lost": lost, "utime": now.utime, **self._origins.facts}
        facts["kept_s"] = journal_state.KEPT_S if len(beginning.state.history) else None
        facts["key"] = "" if self._key is None else self._key.name
        facts |= {"number": segment.number, "run_number": self._run_number, "previous": self._previous}
        self._previous = ""
        self._segment, self._batch = segment, 0
        try:
            segment.append(head_written(facts, now.utime))
            for name, data in self._origins.files:
                segment.append(file_written(name, data[:LARGEST_FILE], now.utime))
            segment.append(state_written(state, now.utime))
            self._write_newest(segment.number)
        except OSError:
            self._lost = lost
            raise
        self._part += 1
        self._lost = 0
        self._unsynced = True
        if self._failed is not None:
            log.info("the journal is kept again in %s; %d records are lost", segment.path, lost)
            self._queue.tell("")
            self._failed = None
        elif lost:
            log.warning("%d records of the journal are lost: they came faster than they could be written", lost)

    def _end(self) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                end = End(True, segment.digest.digest(), seal_segment(self._key, segment.digest.digest()))
                segment.append(end_written(end.digest, self._clock.utime(), end.mac))
                segment.sync()
                self._previous = end.seal.hex()
                self._write_newest(segment.number)
            finally:
                segment.close()

    def _fresh(self) -> Segment:
        """Return a new segment, which follows from what the directory holds."""
        ring = self._ring
        ring.hold()
        newest = read_newest(ring.directory, () if self._key is None else (self._key,), checks=False)
        if self._run_number < 0:
            before = last_link(ring.directory)
            self._previous = before.seal
            self._run_number = max(before.run, -1 if newest is None else newest.run) + 1
        return ring.fresh(0 if newest is None else newest.number + 1)

    def _write_newest(self, number: int) -> None:
        newest = Newest(self._run_number, number, self._previous)
        write_whole(self._ring.directory / NEWEST_NAME, newest.encode(self._key))

    def _fail(self, error: OSError) -> None:
        """Write no more until the disk is tried again; what comes meanwhile is dropped and counted."""
        if self._segment is not None:
            self._segment.close()
            self._segment = None
        self._retry_ns = self._clock.monotonic_ns() + round(RETRY_S * 1e9)
        said = self._words(error)
        if self._failed is None or self._words(self._failed) != said:
            log.warning("%s", said)
            self._queue.tell(said)
        self._failed = error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            # what happens now is worth more than what was long ago
            with contextlib.suppress(OSError):
                self._ring.make_room()

    def _words(self, error: OSError) -> str:
        directory = self._ring.directory
        why = words_on(error, directory, "journal.directory")
        place = plain(str(directory))
        return (
            f"nothing is recorded: the journal cannot be kept in {place}: {why}. It is tried again every {RETRY_S:g} s"
        )
