"""Where a vehicle's journal is kept, and what begins it."""

from __future__ import annotations

import logging
import os
import secrets
from pathlib import Path
from typing import Final

from modelserver.config import VehicleConfig
from modelserver.formats.content import MAX_BYTES as LARGEST_FILE
from modelserver.regular_files import read_regular
from modelserver.service.clock import Clock
from modelserver.service.journal import build as journal_build
from modelserver.service.journal.queue import JournalQueue
from modelserver.service.journal.ring import Ring
from modelserver.service.journal.writer import JournalWriter, Origins
from modelserver.service.keeping.lock import Lock
from modelserver.service.keeping.origin import safe, state_directory
from modelserver.signing import Key

log = logging.getLogger(__name__)

MEGABYTES: Final = 1024
"""Of a journal that is kept without a word on how large it may be."""

SEGMENTS: Final = 8
"""Into so many, at least, a ring is divided: the oldest of them goes as a whole."""

LARGEST_SEGMENT: Final = 16 << 20


def journal_directory(config: VehicleConfig, given: str | None = None) -> Path | None:
    """Return where the journal is kept; None where none is wanted, or no place is known.

    `given`: the state directory that systemd gives the service; by default what it has given this process.

    By default one is kept only by a service that systemd has given a state directory, or where one is named: what a
    developer tries out at the desk is not to fill the home directory.
    """
    settings = config.journal
    if settings.megabytes == 0:
        return None
    if settings.directory:
        return Path(settings.directory)
    given = os.environ.get("STATE_DIRECTORY", "") if given is None else given
    if settings.megabytes is None and not given:
        return None
    base = state_directory(config.state_directory or given.split(":")[0])
    if base is None:
        return None
    return base / f"journal-{safe(config.vehicle)}"


def bound(config: VehicleConfig) -> int:
    """Return how many bytes a vehicle's journal may take, where one is kept."""
    return (config.journal.megabytes or MEGABYTES) << 20


def make_writer(
    config: VehicleConfig, file: str, clock: Clock, lock: Lock | None = None, key: Key | None = None
) -> tuple[JournalQueue, JournalWriter] | None:
    """Return the queue for the loop and the writer for it, None where no journal is kept.

    `file`: the vehicle file. `lock`: that of the state directory, which counts where the journal lies within. `key`:
    what segments are sealed with, None: the vehicle has none.
    """
    directory = journal_directory(config)
    if directory is None:
        return None
    most = bound(config)
    log.info("the journal is kept in %s, %d MB at most", directory, most >> 20)
    within = lock if lock is not None and directory.is_relative_to(lock.path.parent) else None
    ring = Ring(directory, most, min(LARGEST_SEGMENT, most // SEGMENTS), within)
    facts = {**journal_build.facts(), "vehicle": config.vehicle, "run": secrets.token_hex(8), "pid": os.getpid()}
    paths = [path for path in (Path(file), Path(config.geometry)) if path.is_file()]
    files = [(str(path), read_regular(path, LARGEST_FILE)) for path in paths]
    queue = JournalQueue()
    origins = Origins(facts, files, config)
    return queue, JournalWriter(queue, ring, origins, clock, config.journal.sync_s, key=key)
