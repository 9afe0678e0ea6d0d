"""Which files are a journal's: its segments, or why there are none."""

from __future__ import annotations

import mmap
from itertools import islice
from pathlib import Path
from typing import Final

from modelserver.errors import RecordingError
from modelserver.regular_files import open_regular
from modelserver.service.journal.ring import SEGMENT_NAME, segments
from modelserver.wire.eventlog import Buffer, LogEvent, scan
from modelserver.wire.journal import MAGIC

LOOKED_AT: Final = 1000
"""Entries of a folder without segments that are looked at for one that has some."""


def files_of(journal: Path) -> list[Path]:
    """Return the segments of a journal: of a directory, or the one file.

    Raises RecordingError, with what it is and what to do, for what is no journal; OSError.
    """
    if not journal.is_dir():
        _check(journal)
        return [journal]
    found = segments(journal)
    if not found:
        raise RecordingError(f"{journal}: {_without_segments(journal)}")
    return found


def _check(path: Path) -> None:
    """Raise RecordingError for a file that is none of a journal. One that was damaged is."""
    with open_regular(path) as file:
        if file.seek(0, 2) == 0:
            raise RecordingError(f"{path}: the file is empty, so there is nothing to verify; give the journal's folder")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data.find(MAGIC) >= 0 or SEGMENT_NAME.fullmatch(path.name):
                return
            is_log = _is_log(data)
    if is_log:
        raise RecordingError(
            f"{path}: is an LCM log, but no journal of a modelserver, so it does not say what is to be reproduced; "
            f"modelserver replay {path} (without --verify) plays it"
        )
    raise RecordingError(
        f"{path}: is no journal, and no LCM log either; a journal is a folder of files journal-*.lcm, such as "
        "/var/lib/modelserver/journal-NAME"
    )


def _is_log(data: Buffer) -> bool:
    return isinstance(next(iter(scan(data)), None), LogEvent)


def _without_segments(folder: Path) -> str:
    """Return what is to be said of a folder that holds no segment."""
    entries = sorted(islice(folder.iterdir(), LOOKED_AT))
    if not entries:
        return "the folder is empty; a journal is a folder of files journal-*.lcm"
    for each in entries:
        try:
            if each.is_dir() and segments(each):
                return f"holds no segment of a journal (journal-*.lcm); did you mean {each}?"
        except OSError:
            continue  # one that may not be looked into
    text = "holds no segment of a journal (journal-*.lcm)"
    if any(each.suffix == ".lcm" for each in entries):
        text += "; its LCM logs are played by modelserver replay LOG, without --verify"
    return text
