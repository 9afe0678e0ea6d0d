"""Files whose paths come from users: what they are by their content, and safe reading.

The kind of a file is for messages about one that was given in place of another. Only regular files are read, bounded,
and without blocking. Opening a FIFO waits for a writer, reading a device may never end, and opening a serial port
changes its control lines. So the type of a file is checked before it is opened, and again after (it may have been
replaced in between). Symbolic links are followed. Files of /proc have size 0 and content, so the read itself is bounded
as well as the stated size.

Nothing is written through a symbolic link of another user: in a folder that all may write, it would choose the file.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from enum import Enum
from typing import BinaryIO, Final

EXAMINED_BYTES: Final = 1 << 20
"""Bytes of a file that are examined."""

INSTALLED_FOLDER: Final = "/etc/modelserver"
"""Folder of the installed vehicle file."""

STATE_FOLDER: Final = "/var/lib/modelserver"
"""Folder of the installed service's state: `StateDirectory=` of its unit."""


class FileKind(Enum):
    """What a file is; the value is the text of messages."""

    EMPTY = "the file is empty"
    COMMENTS = "there is nothing in the file but comments"
    VEHICLE = "this is a vehicle file"
    GEOMETRY = "this is a geometry file"
    URDF = "this is a URDF, a geometry file format"
    MIRO_PROCESS = "this is a process file of the original ModelServer (2005)"
    XML = "this is XML"
    LOG = "this is an LCM event log"
    BINARY = "this is not text"
    OTHER = "this is some text"

    @property
    def is_empty(self) -> bool:
        return self in (FileKind.EMPTY, FileKind.COMMENTS)


PROCESS_FIX: Final = (
    "write a vehicle file (docs/vehicle-file.md); these keys replace its parameters: vehicle, geometry, base_frame, "
    "rolling_frame, publish.rate_hz, publish.mode, localization.mode, origin, sensors"
)
"""Fix for a process file, wherever it is given."""

_KEY: Final = re.compile(rb"^([A-Za-z_]+)[ \t]*:(?=\s|$)", re.MULTILINE)
_VEHICLE: Final = frozenset(
    b"vehicle geometry base_frame rolling_frame sensors lcm publish localization drivers".split()
)
_REQUIRED: Final = frozenset((b"vehicle", b"base_frame"))
_GEOMETRY: Final = frozenset((b"bodies", b"constraints", b"templates"))
_FORMAT: Final = re.compile(rb"^modelserver[ \t]*:[ \t]*[\"']?geometry/", re.MULTILINE)
_PROCESS: Final = (b"<config", b"<section", b"<parameter")
_MIRO_GEOMETRY: Final = re.compile(
    rb"BodyName|ConstraintName|FrameName|HTransform|FrameRpyParameters|FrameList|<config_group\b|<!ENTITY"
)
"""In Miro's geometry files and compile-time files, but not in a process file; entities neither."""
_URDF: Final = re.compile(rb"<(\w+:)?robot[\s>]")
_GEOMETRY_PATH: Final = re.compile(rb"^geometry[ \t]*:[ \t]*[\"']?([^\s\"'#]+)", re.MULTILINE)

_LOG: Final = b"\xed\xa1\xda\x01"
"""Sync word of every event of an LCM log."""

_BOMS: Final = (b"\xff\xfe", b"\xfe\xff")


def detect_file_kind(content: bytes) -> FileKind:
    """Return what a file with these bytes is.

    A YAML file with the keys of a vehicle file and those of a geometry file is a vehicle file.
    """
    head = content[:EXAMINED_BYTES]
    if head.startswith(_LOG):
        return FileKind.LOG
    text = head.removeprefix(b"\xef\xbb\xbf").strip()
    if not text:
        return FileKind.EMPTY
    if b"\0" in head[:4096] and not head.startswith(_BOMS):
        return FileKind.BINARY
    if text.startswith(b"<"):
        if all(tag in head for tag in _PROCESS) and not _MIRO_GEOMETRY.search(head):
            return FileKind.MIRO_PROCESS
        return FileKind.URDF if _URDF.search(text) else FileKind.XML
    keys = frozenset(_KEY.findall(head))
    if keys >= _REQUIRED:
        return FileKind.VEHICLE
    if keys & _GEOMETRY or _FORMAT.search(head):
        return FileKind.OTHER if keys & _REQUIRED else FileKind.GEOMETRY
    if len(keys & _VEHICLE) >= 2:
        return FileKind.VEHICLE
    if len(content) <= EXAMINED_BYTES and all(
        line.lstrip().startswith(b"#") for line in text.splitlines() if line.strip()
    ):
        return FileKind.COMMENTS
    return FileKind.OTHER


def find_geometry_path(content: bytes) -> str:
    """Return the path of the geometry file in a vehicle file, empty if there is none."""
    found = _GEOMETRY_PATH.search(content[:EXAMINED_BYTES])
    return found[1].decode(errors="replace") if found else ""


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
