"""A file that is not there: which one may have been meant."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from modelserver.errors import nearest_names


def nearest_path(path: str | Path) -> str:
    """Return the path beside one that is not there whose name is nearest to its own; empty where none is near."""
    path = Path(path)
    with suppress(OSError):
        near = nearest_names(path.name, os.listdir(path.parent), 1)
        if near:
            return str(path.parent / near[0])
    return ""


def meant(error: OSError) -> str:
    """Return the question whether another file was meant, for an error that one is not there; else nothing."""
    near = nearest_path(error.filename) if isinstance(error, FileNotFoundError) and error.filename else ""
    return f"; did you mean {near}?" if near else ""
