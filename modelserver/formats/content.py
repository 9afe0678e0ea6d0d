"""Reading a geometry file's bytes, with a limit, before any parser sees them."""

from __future__ import annotations

import os

from modelserver.errors import GeometryError, Location, Problem, Severity
from modelserver.regular_files import FileTooLargeError, NotRegularFileError, read_regular

MAX_BYTES = 32 * 1024 * 1024
"""Larger files are refused unread: 10,000 frames take 3 MiB in the wordiest form."""


def read(path: str | os.PathLike[str]) -> bytes:
    """Return what the file holds.

    Raises GeometryError for a directory, a FIFO, a device or a file that is too large, OSError where it cannot be
    opened.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except NotRegularFileError as error:
        message = f"this is {error.kind}, not a geometry file"
        fix = "name the file inside it" if error.is_directory else "save the geometry to a file, and give that"
    except FileTooLargeError as error:
        message, fix = str(error.strerror), "name a geometry file; point clouds and meshes do not belong in one"
    raise GeometryError([Problem(Severity.ERROR, message, Location(os.fspath(path)), fix)])
