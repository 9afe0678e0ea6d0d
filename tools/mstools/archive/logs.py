"""Logs of an archive: found by pattern, folder, list or URL, and read as the events of one recording each.

A folder is searched for what begins as a recording does, whatever its name: LCM logs (lcm-logger names them by date),
ROS 1 bags, MCAP files; and for folders of a ROS 2 recording or a journal, each one log. What is not on this machine is
fetched to a temporary file for its task. Bags are converted as `modelserver import-bag` does by default.
"""

from __future__ import annotations

import glob
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

from modelserver.errors import ModelServerError
from modelserver.files import FileKind, detect_file_kind
from modelserver.server.journal.writer import list_segments
from mstools.archive.storage import open_filesystem, unify_errors
from mstools.recordings.bag_log import BAG_BEGINNINGS, BAG_SUFFIXES, BEGINNING

SUFFIXES: Final = (".lcm", *BAG_SUFFIXES)
"""Names of recordings: one of these is a log also if its beginning is damaged."""

CHUNK: Final = 1 << 20


def find_logs(given: Iterable[str]) -> list[str]:
    """Return the absolute paths and URLs of the logs, each once, in the order given.

    `given`: logs, folders, patterns (* ? [ ] **), fsspec URLs of these, and text files (.txt) with one of them per
    line. Raises ModelServerError where one of them names no log.
    """
    found: dict[str, None] = {}
    for each in given:
        logs = list(_expand(each))
        if not logs:
            raise ModelServerError(f"{each}: no recording there: an LCM log, a journal, a ROS bag, or an MCAP file")
        found |= dict.fromkeys(logs)
    return list(found)


def _expand(given: str) -> Iterator[str]:
    if "://" in given and not given.startswith("file://"):
        yield from _expand_url(given)
        return
    path = Path(given.removeprefix("file://")).absolute()
    if path.suffix == ".txt" and path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            if text := line.partition("#")[0].strip():
                # relative to the list
                yield from _expand(text if "://" in text else str(path.parent / text))
    elif path.is_dir():
        yield from _search(path)
    elif path.exists():
        yield str(path)
    elif glob.has_magic(given):
        for match in sorted(glob.glob(str(path), recursive=True)):
            yield from _expand(match)
    else:
        raise FileNotFoundError(2, "No such file or directory", given)


def _search(folder: Path) -> Iterator[str]:
    if _is_one(folder):
        yield str(folder)
        return
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            yield from _search(path)
        elif path.is_file() and (path.suffix in SUFFIXES or _begins_as_recording(path)):
            yield str(path)


def _is_one(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() or bool(list_segments(folder))


def _begins_as_recording(path: Path) -> bool:
    with path.open("rb") as file:
        return _is_beginning(file.read(BEGINNING))


def _is_beginning(data: bytes) -> bool:
    return data.startswith(BAG_BEGINNINGS) or detect_file_kind(data) is FileKind.LOG


def _expand_url(given: str) -> Iterator[str]:
    fs, path = open_filesystem(given)
    with unify_errors(given):
        if glob.has_magic(path):
            matches = fs.glob(path, detail=True)
        elif fs.isdir(path):
            matches = fs.find(path, detail=True)
        else:
            matches = {path: fs.info(path)}
        for each, info in sorted(matches.items()):
            if info["type"] == "file" and (
                each == path or each.endswith(SUFFIXES) or _begins_as_recording_at(fs, each, info["size"])
            ):
                yield fs.unstrip_protocol(each)


def _begins_as_recording_at(fs: Any, path: str, size: int) -> bool:
    # storage refuses a range of an empty file; the order of the arguments differs between file systems
    return size >= BEGINNING and _is_beginning(fs.cat_file(path, start=0, end=BEGINNING))


@contextmanager
def fetch(log: str) -> Iterator[Path]:
    """Give the path of a log, of a temporary copy where it is not on this machine. Raises OSError."""
    if "://" not in log:
        yield Path(log)
        return
    fs, remote = open_filesystem(log)
    with tempfile.TemporaryDirectory(prefix="modelserver-") as folder:
        path = Path(folder) / Path(remote).name
        with unify_errors(log):
            fs.get_file(remote, str(path))
        yield path


def identify(log: str) -> str:
    """Return what identifies the content of a log: of one on this machine a digest of its bytes, of a folder's files.

    Of a URL it is what the storage states of it without sending it, such as its ETag. Raises OSError.
    """
    if "://" in log:
        fs, remote = open_filesystem(log)
        with unify_errors(log):
            return str(fs.ukey(remote))
    path, found = Path(log), blake2b(digest_size=16)
    for each in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if each.is_file():
            found.update(f"{each.relative_to(path)}\0{os.path.getsize(each)}\0".encode())
            with each.open("rb") as file:
                while chunk := file.read(CHUNK):
                    found.update(chunk)
    return found.hexdigest()
