"""Serial ports of this machine: what there is, who may use it and who does."""

from __future__ import annotations

import getpass
import glob
import grp
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from serial.tools import list_ports

from modelserver.errors import nearest_names

MAX_COMMAND = 60
"""Characters of a process's command line that are shown."""


class PortLine(NamedTuple):
    """A port for people: its path, what is plugged in, and a hint where it cannot be used as it is."""

    path: str
    what: str
    hint: str


def found_ports() -> list[PortLine]:
    """Return the serial ports found, those with something plugged in first."""
    ports = sorted(list_ports.comports(), key=lambda port: (port.vid is None, port.device))
    return [PortLine(port.device, _what(port), hint_for(port.device)) for port in ports]


def _what(port: object) -> str:
    """Return what a port says of itself; pyserial writes n/a where it says nothing."""
    parts = [str(getattr(port, name) or "") for name in ("description", "manufacturer", "serial_number")]
    said = [part for part in dict.fromkeys(parts) if part and part != "n/a"]
    return ", ".join(said) or "nothing is known of it"


def near_ports(path: str) -> tuple[str, ...]:
    """Return the ports that a missing one may have been meant for: of the same name but its number, or by their id.

    A name of the same letters counts as the same: /dev/ttyUBS0. Others are no help: /dev/ttyS0 is always there.
    """
    known = [port.path for port in found_ports() if _letters(port.path) == _letters(path)]
    return (*nearest_names(path, known), *sorted(glob.glob("/dev/serial/by-id/*")))


def _letters(path: str) -> list[str]:
    return sorted(path.rstrip("0123456789"))


def hint_for(path: str) -> str:
    """Return what keeps this user from a port, empty where nothing does."""
    try:
        if not os.access(path, os.R_OK | os.W_OK):
            return permission_fix(path)
    except OSError:
        return ""
    users = [holder for holder in holders(path) if not holder.startswith(f"process {os.getpid()} ")]
    return f"in use by {', '.join(users)}" if users else ""


def permission_fix(path: str) -> str:
    """Return how this user gets to use a port: the command that joins its group, or a rule that gives it one."""
    try:
        status, group = owner_of(path)
    except (OSError, KeyError):
        return "give this user read and write access to it"
    if status.st_gid != 0 and status.st_mode & 0o060 == 0o060:
        return f"it belongs to group {group}: sudo usermod -aG {group} {_user()}, then log in again"
    rule = f'KERNEL=="{os.path.basename(path)}", GROUP="dialout", MODE="0660"'
    return (
        f"no group but root's may use it: write {rule} into /etc/udev/rules.d/99-serial.rules, "
        f"sudo usermod -aG dialout {_user()}, plug it in again and log in again"
    )


def owner_of(path: str) -> tuple[os.stat_result, str]:
    """Return a file's status and the name of its group. Raises OSError, KeyError for a group without name."""
    status = os.stat(path)
    return status, grp.getgrgid(status.st_gid).gr_name


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "$USER"


def holders(path: str) -> list[str]:
    """Return the processes that have a port open, as far as this user may see.

    Of a pseudo-terminal that is who has it as a port; the emulator at its other end only where there is nobody else.
    """
    real = os.path.realpath(path)
    found = list(_holders(real))
    return [_shown(each) for each in [each for each in found if not _has_other_end(each, real)] or found]


def other_ends(path: str) -> list[str]:
    """Return the emulators that speak on a pseudo-terminal: they have both its ends open, which no terminal does."""
    return [_shown(each) for each in _holders(path) if _has_other_end(each, path)]


def _holders(real: str) -> Iterator[Path]:
    """Yield the processes that have a file open, as their folders below /proc."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(each) == real for each in (process / "fd").iterdir()):
                yield process
        except OSError:
            # gone meanwhile, or another user's
            continue


def _has_other_end(process: Path, path: str) -> bool:
    """Return whether a process has the other end of the pseudo-terminal `path` too."""
    said = f"tty-index:\t{path.rpartition('/')[2]}\n"
    try:
        return any(said in each.read_text() for each in (process / "fdinfo").iterdir())
    except OSError:
        return False


def _shown(process: Path) -> str:
    """Return a process's number, and its command line as it is typed: without folders and a script's interpreter."""
    try:
        words = (process / "cmdline").read_text(errors="replace").rstrip("\0").split("\0")
        name = (process / "comm").read_text(errors="replace").strip()
    except OSError:
        return f"process {process.name}"
    if os.path.basename(words[0]).startswith("python") and len(words) > 1:
        # the code of -c is no name of a program
        words = ["python", *words[3:]] if words[1] == "-c" else words[1:]
    text = " ".join((os.path.basename(words[0]) or name, *words[1:]))
    if len(text) > MAX_COMMAND:
        text = f"{text[:MAX_COMMAND]}..."
    return f"process {process.name} ({text})"
