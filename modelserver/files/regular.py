"""Read files whose paths come from users: regular files only, bounded, and without blocking.

Opening a FIFO waits for a writer, reading a device may never end, and opening a serial port changes its control lines.
So the type of a file is checked before it is opened, and again after (it may have been replaced in between). Symbolic
links are followed. Files of /proc have size 0 and content, so the read itself is bounded as well as the stated size.

Nothing is written through a symbolic link of another user: in a folder that all may write, it would choose the file.
"""

from __future__ import annotations

import errno
import os
import stat
from typing import BinaryIO

_DIRECTORY = "a directory"

_KINDS = (
    (stat.S_ISDIR, _DIRECTORY),
    (stat.S_ISFIFO, "a FIFO (named pipe)"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
    (stat.S_ISSOCK, "a socket"),
)


class NotRegularFileError(OSError):
    """The path names a directory, a FIFO, a device or a socket: `kind`."""

    def __init__(self, path: str, kind: str):
        super().__init__(errno.EINVAL, f"this is {kind}, not a regular file", path)
        self.kind = kind
        self.is_directory = kind == _DIRECTORY


class FileTooLargeError(OSError):
    """The file exceeds the size limit of its reader."""

    def __init__(self, path: str, size: int, limit: int):
        super().__init__(
            errno.EFBIG, f"the file is too large: {_format_size(size)}; the limit is {_format_size(limit)}", path
        )


class ForeignLinkError(OSError):
    """A file is to be written through a symbolic link of another user."""

    def __init__(self, path: str):
        super().__init__(errno.ELOOP, "a symbolic link of another user leads elsewhere; write to another place", path)


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading bytes, without blocking.

    Raises NotRegularFileError, OSError.
    """
    name = os.fspath(path)
    _check_kind(name, os.stat(name).st_mode)
    handle = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        _check_kind(name, os.fstat(handle).st_mode)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_regular(path: str | os.PathLike[str], limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes; a larger one is rejected unread.

    Raises NotRegularFileError, FileTooLargeError, OSError.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise FileTooLargeError(os.fspath(path), size, limit)
        content = _read(file, limit + 1)
    if len(content) > limit:
        raise FileTooLargeError(os.fspath(path), len(content), limit)
    return content


def read_start(path: str | os.PathLike[str], length: int) -> bytes:
    """Read the first `length` bytes of a regular file, fewer at its end.

    Raises NotRegularFileError, OSError.
    """
    with open_regular(path) as file:
        return _read(file, length)


def check_links(path: str | os.PathLike[str]) -> None:
    """Check the symbolic links on the way to a file that is to be written, itself included.

    Raises ForeignLinkError for one of another user. Links of root are the system's own.
    """
    trusted = {os.geteuid(), 0}
    name = os.path.abspath(path)
    while name != "/":
        if os.path.islink(name) and os.lstat(name).st_uid not in trusted:
            raise ForeignLinkError(name)
        name = os.path.dirname(name)


def _read(file: BinaryIO, length: int) -> bytes:
    """Read up to `length` bytes. Raises BlockingIOError if a file of /proc has no data yet."""
    parts = []
    while length > 0 and (part := os.read(file.fileno(), min(length, _CHUNK))):
        parts.append(part)
        length -= len(part)
    return b"".join(parts)


_CHUNK = 1 << 20


def _check_kind(name: str, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise NotRegularFileError(name, next((kind for test, kind in _KINDS if test(mode)), "a special file"))


def _format_size(size: int) -> str:
    return f"{size / 1024**2:.3g} MiB" if size >= 1024**2 else f"{size} bytes"
