"""Files of an archive, in a folder or in object storage (an fsspec URL): written whole or not at all.

    FOLDER/TABLE/LOG-KEY.parquet

LOG is a digest of the log's address, KEY one of all that its result depends on. The files of a log are drafted in
`.drafts`, and moved into their tables, `drives` last: what an interrupted run leaves is a draft, or files without a row
in `drives`, and the next run removes both. One run at a time writes to a local archive.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any, Final

from modelserver.errors import ModelServerError
from mstools.archive.tables import TABLES, ArchiveError, explain_errors

DRAFTS: Final = ".drafts"
LAST: Final = "drives"
OTHERS: Final = tuple(each for each in TABLES if each != LAST)
UNREAD: Final = "unread"
"""Key of a log that could not be read: it is tried again by the next run."""


def digest(*parts: str) -> str:
    """Return a digest of texts: 16 hexadecimal digits, of which 10^6 logs have two equal ones with 3e-8."""
    return blake2b("\0".join(parts).encode(), digest_size=8).hexdigest()


def open_filesystem(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it. Raises ModelServerError for an unknown kind."""
    import fsspec

    try:
        found: tuple[Any, str] = fsspec.core.url_to_fs(url)
    except (ValueError, ImportError) as error:
        raise ModelServerError(f"{url}: {error}; install the package of this file system on all workers") from None
    return found


@contextmanager
def unify_errors(url: str) -> Iterator[None]:
    """Raise what reading from a file system raises as an OSError: those in object storage have errors of their own."""
    try:
        yield
    except (OSError, ModelServerError):
        raise
    except Exception as error:
        raise OSError(0, f"{type(error).__name__}: {error}", url) from None


class Storage:
    """An archive by its path or URL. Raises ArchiveError where it cannot be written."""

    def __init__(self, url: str):
        self.url = url
        self._fs, self._root = open_filesystem(url)
        self.is_local = "file" in _protocols(self._fs)
        self._lock: IO[Any] | None = None

    def path(self, table: str, name: str = "") -> str:
        return f"{self._root}/{table}{f'/{name}.parquet' if name else ''}"

    def prepare(self) -> dict[str, tuple[str, ...]]:
        """Make the folders, remove what an interrupted run left, and lock a local archive until `close`.

        Returns the names of the results by digest of the log: the archive is listed once, and by no task.
        """
        with explain_errors(self.url):
            for table in (*TABLES, DRAFTS):
                self._fs.makedirs(f"{self._root}/{table}", exist_ok=True)
            if self.is_local:
                self._lock = open(f"{self._root}/.lock", "w")  # noqa: SIM115
                try:
                    fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    self._lock.close()
                    self._lock = None
                    raise ArchiveError(f"{self.url}: another run writes to it; wait for its end") from None
            self._remove_drafts()
            whole = {_name_of(path) for path in self._list(LAST)}
            for table in TABLES:
                for path in self._list(table):
                    if _name_of(path) not in whole:
                        self._fs.rm(path)
        found: defaultdict[str, list[str]] = defaultdict(list)
        for name in sorted(whole):
            found[name.partition("-")[0]].append(name)
        return {log: tuple(names) for log, names in found.items()}

    def close(self) -> None:
        """Remove what killed workers left, and unlock."""
        if self._lock is not None:
            with suppress(OSError):
                self._remove_drafts()
            self._lock.close()

    def _remove_drafts(self) -> None:
        for draft in self._list(DRAFTS):
            self._fs.rm(draft, recursive=True)

    @property
    def filesystem(self) -> Any:
        """The fsspec file system."""
        return self._fs

    def exists(self, table: str) -> bool:
        with unify_errors(self.url):
            return bool(self._fs.exists(self.path(table)))

    @contextmanager
    def draft(self, name: str, others: Iterable[str]) -> Iterator[Path]:
        """Give a folder for the files of a log; at the end of the block they replace those of its `others`."""
        parent = f"{self._root}/{DRAFTS}" if self.is_local else None
        with explain_errors(self.url):
            folder = tempfile.TemporaryDirectory(prefix=f"{name}.", dir=parent)
        with folder as place:
            yield Path(place)
            with explain_errors(self.url):
                for table in (*OTHERS, LAST):
                    self._move(Path(place) / f"{table}.parquet", table, name)
                for other in others:
                    if other != name:
                        self._remove(other)

    def _move(self, path: Path, table: str, name: str) -> None:
        if self.is_local:
            with path.open("rb") as file:
                os.fsync(file.fileno())
            path.replace(self.path(table, name))
        else:
            draft = f"{self._root}/{DRAFTS}/{path.parent.name}.{table}"
            self._fs.put_file(str(path), draft)
            self._fs.mv(draft, self.path(table, name))

    def _remove(self, name: str) -> None:
        for table in (LAST, *OTHERS):
            with suppress(FileNotFoundError):
                self._fs.rm(self.path(table, name))

    def _list(self, table: str) -> list[str]:
        self._fs.invalidate_cache()
        with suppress(FileNotFoundError):  # object storage has no empty folders
            return sorted(self._fs.ls(f"{self._root}/{table}", detail=False))
        return []


def _name_of(path: str) -> str:
    return Path(path).name.removesuffix(".parquet")


def _protocols(fs: Any) -> tuple[str, ...]:
    return (fs.protocol,) if isinstance(fs.protocol, str) else tuple(fs.protocol)
