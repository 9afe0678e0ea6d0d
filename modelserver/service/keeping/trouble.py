"""What to say of a directory in which nothing can be kept: why, and what mends it."""

from __future__ import annotations

import errno
import os
import shlex
from pathlib import Path
from typing import Final

from modelserver.service.keeping.lock import HeldError
from modelserver.service.log import plain

_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_CLOSED: Final = (errno.EACCES, errno.EPERM)
_IN_THE_WAY: Final = (errno.EEXIST, errno.ENOTDIR, errno.ELOOP)


def words_on(error: OSError, directory: Path, setting: str) -> str:
    """Return why nothing can be kept in a directory and what mends it, in one line for people.

    `setting` is the key of the vehicle file that names the directory.
    """
    return f"{why_of(error, directory)}; {mending(error, directory, setting)}"


def why_of(error: OSError, directory: Path) -> str:
    """Return what the system said, and of which path where that lies elsewhere; within, names of drafts change."""
    if isinstance(error, HeldError):
        return f"{error.holder} writes there already"
    why = error.strerror or str(error)
    named = str(error.filename or "")
    return plain(f"{why} ({named})" if named and not Path(named).is_relative_to(directory) else why)


def mending(error: OSError, directory: Path, setting: str) -> str:
    """Return what to do about an error of a directory."""
    place = shlex.quote(plain(str(directory)))
    if not error.errno:
        return "the log has its trace, for the developers"
    if isinstance(error, HeldError):
        return f"end one of the two, or name a {setting} of its own in this one's vehicle file"
    if error.errno in _FULL:
        return f"make room on its disk (df -h {place}), or name another {setting} in the vehicle file"
    if error.errno in _CLOSED:
        return (
            f"let the service's user write there (sudo chown -R {os.geteuid()} {place}), or name another {setting} in "
            "the vehicle file"
        )
    if error.errno == errno.EROFS:
        return (
            f"name a {setting} in the vehicle file where writing is allowed (under systemd: /var/lib/modelserver), or "
            "have its file system mounted for writing"
        )
    if error.errno in _IN_THE_WAY:
        return f"move away what is there and is no folder (ls -ld {place}), or name another {setting}"
    if error.errno == errno.ENOENT:
        return "it is made anew"
    return f"the kernel may know more (sudo dmesg | tail), or name another {setting} in the vehicle file"
