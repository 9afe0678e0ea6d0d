"""Atomic files in the state directory, and the one with the captured origin of World:UTM."""

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
from modelserver.files.regular import read_start
from modelserver.messages import Origin
from modelserver.server.persistence.directory import FileLock, describe_error

log = logging.getLogger(__name__)

VERSION = 1

MAX_BYTES = 4096
"""Ten times the size of a valid file."""


def get_default_directory() -> Path | None:
    """Return the default state directory: systemd's, else that of the user; None without a home directory."""
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    try:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(base) / "modelserver"


def get_state_directory(named: str) -> Path | None:
    """Return the state directory named in the vehicle file, else the default one."""
    return Path(named) if named else get_default_directory()


def to_file_name(vehicle: str) -> str:
    """Return a vehicle's name with the characters that are not safe in file names replaced by _."""
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in vehicle)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically and durably: after a power cut it has the old or the new content. Raises OSError.

    Creates missing directories, and blocks until the data are on the disk.
    """
    temporary: Path | None = None
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        # temporary file, fsync, rename; then fsync the directory, or the new name may be lost
        with tempfile.NamedTemporaryFile("wb", dir=path.parent, prefix=path.name, delete=False) as file:
            temporary = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
        raise
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


class OriginStore:
    """Persists the origin of one vehicle in a file. Only the holder of the directory's `lock` writes; None: no lock."""

    def __init__(self, directory: Path, vehicle: str, lock: FileLock | None = None):
        self._lock = lock
        self.path = directory / f"origin-{to_file_name(vehicle)}.json"

    def load(self) -> Origin | None:
        """Return the stored origin; None where there is none or the file is damaged, which is logged."""
        try:
            text = read_start(self.path, MAX_BYTES).decode()
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            log.warning("the stored origin in %s cannot be read (%s); a new one will be captured", self.path, error)
            return None
        try:
            return _parse_origin(json.loads(text))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            log.warning("the stored origin in %s is damaged (%r); a new one will be captured", self.path, error)
            return None

    def save(self, origin: Origin) -> None:
        """Store an origin. An error of the disk is logged: the next start captures a new one."""
        content = json.dumps({"version": VERSION, **dataclasses.asdict(origin)}, indent=1)
        try:
            if self._lock is not None:
                self._lock.claim()
            write_atomically(self.path, (content + "\n").encode())
        except OSError as error:
            why = describe_error(error, self.path.parent, "state_directory")
            log.warning("the origin cannot be stored in %s: %s. The next start will capture a new one", self.path, why)


def _parse_origin(content: dict[str, Any]) -> Origin:
    if content["version"] != VERSION:
        raise ValueError(f"version {content['version']}; expected {VERSION}")
    easting, northing, height = (float(content[name]) for name in ("easting", "northing", "height"))
    zone, north, origin_id = content["zone"], content["north"], content["origin_id"]
    if type(zone) is not int or type(north) is not bool or type(origin_id) is not int:
        raise ValueError("zone, north or origin_id has a wrong type")
    origin = make_origin(easting, northing, height, zone, north)
    if not 0 < origin_id < 1 << 63:
        raise ValueError(f"origin_id {origin_id} is out of range")
    # the published id stays, even if this version would derive another one from the numbers
    return dataclasses.replace(origin, origin_id=origin_id)
