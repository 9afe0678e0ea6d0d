"""Reading a file's bytes, with a limit, before any parser sees them."""

from __future__ import annotations

import os
import stat

from modelserver.errors import GeometryError, Problem, Severity, Source

MAX_BYTES = 32 * 1024 * 1024
"""Larger files are refused unread: 10,000 frames take 3 MiB in the wordiest form."""


def read(path: str | os.PathLike[str]) -> bytes:
    """Return what the file holds.

    Raises GeometryError for a directory, an empty or a too large file, and OSError where it cannot be opened.
    """
    file = os.fspath(path)
    if stat.S_ISDIR(os.stat(file).st_mode):
        raise _refused(file, "this is a directory, not a geometry file", "name the file inside it")
    with open(file, "rb") as stream:
        status = os.fstat(stream.fileno())
        if status.st_size > MAX_BYTES:
            raise _too_large(file, f"{status.st_size / 1024**2:.1f} MiB")
        # a pipe has no size, so what is read is bounded as well
        content = stream.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise _too_large(file, f"more than {MAX_BYTES / 1024**2:.0f} MiB")
    return content


def _too_large(file: str, size: str) -> GeometryError:
    return _refused(
        file,
        f"the file is too large: {size}; the limit is {MAX_BYTES // 1024**2} MiB",
        "name a geometry file; point clouds and meshes do not belong in one",
    )


def _refused(file: str, message: str, fix: str) -> GeometryError:
    return GeometryError([Problem(Severity.ERROR, message, Source(file), fix)])
