"""Serial ports of this machine: what there is, who may use it and who does."""

from __future__ import annotations

import getpass
import grp
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from serial.tools import list_ports


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
    """Return how this user gets to use a port: which group owns it, and the command."""
    try:
        group = grp.getgrgid(os.stat(path).st_gid).gr_name
    except (OSError, KeyError):
        return "give this user read and write access to it"
    return f"it belongs to group {group}: sudo usermod -aG {group} {_user()}, then log in again"


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "$USER"


def holders(path: str) -> list[str]:
    """Return the processes that have a file open, as far as this user may see."""
    real = os.path.realpath(path)
    return list(dict.fromkeys(_holders(real)))


def _holders(real: str) -> Iterator[str]:
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(each) == real for each in (process / "fd").iterdir()):
                name = (process / "comm").read_text(errors="replace").strip()
                yield f"process {process.name} ({name})"
        except OSError:
            # gone meanwhile, or another user's
            continue
