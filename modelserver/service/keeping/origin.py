"""Files that the daemon keeps across restarts, written whole or not at all; and the one with the captured origin."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import tempfile
from pathlib import Path
from typing import Any

from modelserver.earth.geodesy import make_origin
from modelserver.messages import Origin
from modelserver.regular_files import read_start
from modelserver.service.keeping.lock import Lock
from modelserver.service.keeping.trouble import words_on

log = logging.getLogger(__name__)

VERSION = 1

MAX_BYTES = 4096
"""Ten times what is written; more is no kept origin."""


def default_directory() -> Path | None:
    """Return where state is kept unless the vehicle file says otherwise: systemd's choice, else the user's.

    None for a user without a home directory.
    """
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    try:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(base) / "modelserver"


def state_directory(named: str) -> Path | None:
    """Return where state is kept: where the vehicle file says, else `default_directory`."""
    return Path(named) if named else default_directory()


def safe(vehicle: str) -> str:
    """Return a vehicle's name as part of the name of a file."""
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in vehicle)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all: a power cut leaves the old one or the new one. Raises OSError.

    Directories that are not there are made. What was written is on the disk when this returns, and takes as long.
    """
    fresh: Path | None = None
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        # a temporary file, synced and renamed; the directory is synced too, or the new name may be lost
        with tempfile.NamedTemporaryFile("wb", dir=path.parent, prefix=path.name, delete=False) as file:
            fresh = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError:
        if fresh is not None:
            with contextlib.suppress(OSError):
                fresh.unlink()
        raise
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


class OriginKeeper:
    """Keeps the origin of one vehicle in a file. Only who has the directory's `lock` writes; None: there is none."""

    def __init__(self, directory: Path, vehicle: str, lock: Lock | None = None):
        self._lock = lock
        self.path = directory / f"origin-{safe(vehicle)}.json"

    def load(self) -> Origin | None:
        """Return the kept origin; None where there is none or the file is damaged, which is logged."""
        try:
            text = read_start(self.path, MAX_BYTES).decode()
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            log.warning("the kept origin in %s cannot be read (%s); a new one will be captured", self.path, error)
            return None
        try:
            return _origin(json.loads(text))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            log.warning("the kept origin in %s is damaged (%r); a new one will be captured", self.path, error)
            return None

    def save(self, origin: Origin) -> None:
        """Keep an origin. A disk that refuses is logged: the daemon goes on, a restart captures anew."""
        content = json.dumps({"version": VERSION, **dataclasses.asdict(origin)}, indent=1)
        try:
            if self._lock is not None:
                self._lock.claim()
            write_whole(self.path, (content + "\n").encode())
        except OSError as error:
            why = words_on(error, self.path.parent, "state_directory")
            log.warning("the origin cannot be kept in %s: %s. A restart will capture a new one", self.path, why)


def _origin(content: dict[str, Any]) -> Origin:
    if content["version"] != VERSION:
        raise ValueError(f"version {content['version']} is not {VERSION}")
    easting, northing, height = (float(content[name]) for name in ("easting", "northing", "height"))
    zone, north, origin_id = content["zone"], content["north"], content["origin_id"]
    if type(zone) is not int or type(north) is not bool or type(origin_id) is not int:
        raise ValueError("zone, north or origin_id is not what it should be")
    origin = make_origin(easting, northing, height, zone, north)
    if not 0 < origin_id < 1 << 63:
        raise ValueError(f"origin_id {origin_id} is out of range")
    # the id stays the one that was told to others, whatever this version would make of the numbers
    return dataclasses.replace(origin, origin_id=origin_id)
