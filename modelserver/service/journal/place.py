"""Where a vehicle's journal is kept, and what begins it."""

from __future__ import annotations

import logging
import os
import secrets
from pathlib import Path
from typing import Final

from modelserver.config import VehicleConfig
from modelserver.service.clock import Clock
from modelserver.service.journal import build as journal_build
from modelserver.service.journal.queue import JournalQueue
from modelserver.service.journal.ring import Ring
from modelserver.service.journal.writer import JournalWriter, Origins
from modelserver.service.keeping.origin import default_directory, safe

log = logging.getLogger(__name__)

MEGABYTES: Final = 1024
"""Of a journal that is kept without a word on how large it may be."""

SEGMENTS: Final = 8
"""Into so many, at least, a ring is divided: the oldest of them goes as a whole."""

LARGEST_SEGMENT: Final = 16 << 20


def journal_directory(config: VehicleConfig) -> Path | None:
    """Return where the journal is kept; None where none is wanted, or no place is known.

    By default one is kept only by a service that systemd has given a state directory, or where one is named: what a
    developer tries out at the desk is not to fill the home directory.
    """
    settings = config.journal
    if settings.megabytes == 0:
        return None
    if settings.directory:
        return Path(settings.directory)
    if settings.megabytes is None and not os.environ.get("STATE_DIRECTORY"):
        return None
    base = Path(config.state_directory) if config.state_directory else default_directory()
    if base is None:
        return None
    return base / f"journal-{safe(config.vehicle)}"


def make_writer(config: VehicleConfig, file: str, clock: Clock) -> tuple[JournalQueue, JournalWriter] | None:
    """Return the queue for the loop and the writer for it, None where no journal is kept. `file`: the vehicle file."""
    directory = journal_directory(config)
    if directory is None:
        return None
    most = (config.journal.megabytes or MEGABYTES) << 20
    log.info("the journal is kept in %s, %d MB at most", directory, most >> 20)
    ring = Ring(directory, most, min(LARGEST_SEGMENT, most // SEGMENTS))
    facts = {**journal_build.facts(), "vehicle": config.vehicle, "run": secrets.token_hex(8), "pid": os.getpid()}
    files = [(str(path), path.read_bytes()) for path in (Path(file), Path(config.geometry)) if path.is_file()]
    queue = JournalQueue()
    return queue, JournalWriter(queue, ring, Origins(facts, files, config), clock, config.journal.sync_s)
