"""Who may write in a directory: one service at a time, by a lock that ends with its process, however that ends."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
from pathlib import Path
from typing import Final

MODE: Final = 0o640

LONGEST_PID: Final = 20
"""Digits of a process number that are read of a lock file."""


class HeldError(BlockingIOError):
    """Another process holds the lock. `pid` is that process's number, 0 where it is not known."""

    def __init__(self, path: Path, pid: int = 0):
        self.pid = pid
        super().__init__(errno.EWOULDBLOCK, f"{self.holder} writes there already", str(path))

    @property
    def holder(self) -> str:
        """Who holds it, in words."""
        return f"another service (process {self.pid})" if self.pid else "another service"


class Lock:
    """A lock file (flock(2)), in which its holder's process number stands. Any thread of the process may ask.

    The file stays when the lock is let go: removing it would let two processes hold one each.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._asking = threading.Lock()

    def hold(self) -> None:
        """Hold the lock from now on, or still. Raises HeldError, OSError where the file cannot be opened."""
        with self._asking:
            if self._file is not None:
                # a directory that was removed and made again has another lock
                with contextlib.suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(self._file), self.path.stat()):
                        return
                self._let_go()
            self._file = _locked(self.path)

    def claim(self) -> None:
        """Hold the lock where that can be tried, and make its directory for that. Raises HeldError.

        A disk that is full, read-only or not there keeps nobody off: who writes there is told soon enough.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.hold()
        except HeldError:
            raise
        except OSError:
            return

    def release(self) -> None:
        """Let another process have it."""
        with self._asking:
            self._let_go()

    def _let_go(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _locked(path: Path) -> int:
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, MODE)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pid = _pid(file)
        os.close(file)
        raise HeldError(path, pid) from None
    except OSError:
        os.close(file)
        raise
    # for people; what counts is the lock, also on a disk that is full
    with contextlib.suppress(OSError):
        os.ftruncate(file, 0)
        os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
    return file


def _pid(file: int) -> int:
    with contextlib.suppress(OSError):
        digits = os.pread(file, LONGEST_PID, 0).strip()
        return int(digits) if digits.isdigit() else 0
    return 0
