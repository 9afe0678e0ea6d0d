"""The state directory: where it is, its lock, atomic files, and its errors with their remedies."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shlex
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from modelserver.files import check_links
from modelserver.server.log import escape_text

FILE_MODE: Final = 0o640
FOLDER_MODE: Final = 0o750

MAX_PID_DIGITS: Final = 20
"""Digits of the process id that are read from a lock file."""


class LockHeldError(BlockingIOError):
    """Another process, `pid` (0 = not known), holds the lock."""

    def __init__(self, path: Path, pid: int = 0):
        self.pid = pid
        super().__init__(errno.EWOULDBLOCK, f"{self.holder} writes there already", str(path))

    @property
    def holder(self) -> str:
        return f"another service (process {self.pid})" if self.pid else "another service"


class FileLock:
    """A lock file (flock(2)) with its holder's process id. Thread-safe; the kernel releases it when the process ends.

    Releasing does not remove the file: then two processes could each lock one of the same name.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._mutex = threading.Lock()

    def acquire(self) -> None:
        """Acquire the lock if not held yet. Raises LockHeldError, OSError where the file cannot be opened."""
        with self._mutex:
            if self._file is not None:
                # a directory that was removed and created again has another lock file
                with contextlib.suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(self._file), self.path.stat()):
                        return
                self._close_file()
            self._file = _open_locked(self.path)

    def claim(self) -> None:
        """Acquire the lock, creating its directory. Raises LockHeldError.

        Other errors (disk full, read-only, missing) are ignored here: the write that follows reports them.
        """
        try:
            create_directory(self.path.parent)
            self.acquire()
        except LockHeldError:
            raise
        except OSError:
            return

    def release(self) -> None:
        with self._mutex:
            self._close_file()

    def _close_file(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _open_locked(path: Path) -> int:
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, FILE_MODE)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pid = _read_pid(file)
        os.close(file)
        raise LockHeldError(path, pid) from None
    except OSError:
        os.close(file)
        raise
    # for people; the lock is valid without it, also on a full disk
    with contextlib.suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
    return file


def _read_pid(file: int) -> int:
    with contextlib.suppress(OSError):
        digits = os.pread(file, MAX_PID_DIGITS, 0).strip()
        return int(digits) if digits.isdigit() else 0
    return 0


def get_state_directory(named: str) -> Path | None:
    """Return the state directory: as named, else systemd's, else the user's; None without a home directory."""
    if named:
        return Path(named)
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    try:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return Path(base) / "modelserver"


def create_directory(path: Path) -> None:
    """Create a directory and those above it, none of which others can write, whatever the umask. Raises OSError."""
    check_links(path)
    for each in (*reversed(path.parents), path):
        if not each.exists():
            each.mkdir(FOLDER_MODE, exist_ok=True)
    if not path.is_dir():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def to_file_name(vehicle: str) -> str:
    """Return a vehicle's name with the characters that are not safe in file names replaced by _."""
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in vehicle)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically and durably: after a power cut it has the old or the new content. Raises OSError.

    Creates missing directories, and blocks until the data are on the disk.
    """
    temporary: Path | None = None
    create_directory(path.parent)
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


_FULL = "free space on its disk (df -h {place}), or set another {setting} in the vehicle file"
_DENIED = (
    "let the service's user write there (sudo chown -R {user} {place}), or set another {setting} in the vehicle file"
)
_BLOCKED = "move the file at this path away (ls -ld {place}), or set another {setting}"
_READ_ONLY = (
    "set a writable {setting} in the vehicle file (under systemd: /var/lib/modelserver), or mount its file system"
)
_REMEDIES: Final[Mapping[int | None, str]] = {
    **dict.fromkeys((0, None), "the log has its traceback; report it"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _FULL),
    **dict.fromkeys((errno.EACCES, errno.EPERM), _DENIED),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR, errno.ELOOP), _BLOCKED),
    errno.EROFS: f"{_READ_ONLY} read-write",
    errno.ENOENT: "it is created again",
    errno.EWOULDBLOCK: "stop one of the two, or set another {setting} in the vehicle file of this one",
}
_OTHER_REMEDY = "see the kernel log (sudo dmesg | tail), or set another {setting} in the vehicle file"


def describe_error(error: OSError, directory: Path, setting: str) -> str:
    """Return cause and remedy of an error of a directory, in one line for people.

    `setting` is the key of the vehicle file that names the directory. The cause is the system's message, with the path
    where it is outside the directory (temporary names inside vary).
    """
    named, cause = str(error.filename or ""), error.strerror or str(error)
    if named and not isinstance(error, LockHeldError) and not Path(named).is_relative_to(directory):
        cause += f" ({named})"
    place = shlex.quote(escape_text(str(directory)))
    remedy = _REMEDIES.get(error.errno, _OTHER_REMEDY).format(place=place, setting=setting, user=os.geteuid())
    return f"{escape_text(cause)}; {remedy}"
