"""Serial ports: the link of a driver, diagnostics of this machine's ports, and pseudo-terminals for emulators.

Diagnostics are permissions, users and names. A driver opens the other end of a pseudo-terminal like a serial port.
"""

from __future__ import annotations

import contextlib
import errno
import getpass
import glob
import grp
import io
import os
import termios
import time
import tty
from pathlib import Path
from typing import NamedTuple

import serial
from serial.tools import list_ports

from modelserver.errors import find_nearest_names
from msdrivers.links import DescriptorLink, LinkError

MAX_COMMAND_LENGTH = 60
"""Characters of a process's command line that are shown."""


class PortInfo(NamedTuple):
    """Path and description of a port, and a hint if it cannot be used."""

    path: str
    description: str
    hint: str


BOARD_UARTS = ("ttyS", "ttyAMA", "ttyTHS", "ttymxc", "ttySC", "ttyLP")
"""Kernel names of the UARTs of boards: 8250, Arm PL011, NVIDIA Tegra, NXP i.MX 6 to 8M, SC16IS7xx, NXP i.MX 8 LPUART.

Each is the `dev_name` of its driver in the kernel (drivers/tty/serial). The units allow the same ones.
"""

DEVICES, KERNEL_DEVICES = Path("/dev"), Path("/sys/class/tty")


def find_ports() -> list[PortInfo]:
    """Return the serial ports found, those with something plugged in first."""
    ports = sorted(list_ports.comports(), key=lambda port: (port.vid is None, port.device))
    found = [PortInfo(port.device, _describe_port(port), find_access_problem(port.device)) for port in ports]
    known = {port.path for port in found}
    uarts = sorted(str(path) for path in find_board_uarts())
    return [
        *found,
        *(PortInfo(path, "UART of the board", find_access_problem(path)) for path in uarts if path not in known),
    ]


def find_board_uarts() -> list[Path]:
    """Return the UARTs of the board that are present: pyserial leaves out those that are no separate device.

    The kernel's serial core has the type of each port in sysfs; 0 (PORT_UNKNOWN) is a port without hardware.
    """
    found = []
    for path in (path for name in BOARD_UARTS for path in DEVICES.glob(f"{name}[0-9]*")):
        with contextlib.suppress(OSError):
            if (KERNEL_DEVICES / path.name / "type").read_text().strip() not in ("", "0"):
                found.append(path)
    return found


def _describe_port(port: object) -> str:
    """Return the port's USB description; pyserial writes n/a for an empty field."""
    parts = [str(getattr(port, name) or "") for name in ("description", "manufacturer", "serial_number")]
    known = [part for part in dict.fromkeys(parts) if part and part != "n/a"]
    return ", ".join(known) or "no description"


def suggest_ports(path: str) -> tuple[str, ...]:
    """Return the ports that a missing one may have been meant for: of the same letters (/dev/ttyUBS0), or by their id.

    Others are no help: /dev/ttyS0 is always there.
    """
    letters = sorted(path.rstrip("0123456789"))
    known = [port.path for port in find_ports() if sorted(port.path.rstrip("0123456789")) == letters]
    return (*find_nearest_names(path, known), *sorted(glob.glob("/dev/serial/by-id/*")))


def find_access_problem(path: str) -> str:
    """Return what keeps this user from a port, empty where nothing does."""
    try:
        if not os.access(path, os.R_OK | os.W_OK):
            return explain_permission(path)
    except OSError:
        return ""
    users = [holder for holder in find_users(path) if not holder.startswith(f"process {os.getpid()} ")]
    return f"in use by {', '.join(users)}" if users else ""


def explain_permission(path: str) -> str:
    """Return how this user gets to use a port: the command that joins its group, or a rule that gives it one."""
    try:
        status, group = get_owner(path)
    except (OSError, KeyError):
        return "give this user read and write access to it"
    if status.st_gid != 0 and status.st_mode & 0o060 == 0o060:
        return f"it belongs to group {group}: sudo usermod -aG {group} {_get_user()}, then log in again"
    rule = f'KERNEL=="{os.path.basename(path)}", GROUP="dialout", MODE="0660"'
    return (
        f"no group but root's may use it: write {rule} into /etc/udev/rules.d/99-serial.rules, "
        f"sudo usermod -aG dialout {_get_user()}, plug it in again and log in again"
    )


def get_owner(path: str) -> tuple[os.stat_result, str]:
    """Return a file's status and the name of its group. Raises OSError, KeyError for a group without name."""
    status = os.stat(path)
    return status, grp.getgrgid(status.st_gid).gr_name


def _get_user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "$USER"


def find_users(path: str) -> list[str]:
    """Return the processes that have a port open, as far as this user may see."""
    real = os.path.realpath(path)
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(each) == real for each in (process / "fd").iterdir()):
                found.append(_describe_process(process))
        except OSError:
            # gone meanwhile, or another user's
            continue
    return found


def _describe_process(process: Path) -> str:
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
    if len(text) > MAX_COMMAND_LENGTH:
        text = f"{text[:MAX_COMMAND_LENGTH]}..."
    return f"process {process.name} ({text})"


DRAIN_ATTEMPTS, DRAIN_INTERVAL_S = 50, 0.01
"""Number and interval, seconds, of the checks whether the output is drained."""


class SerialLink(DescriptorLink):
    """A serial port, 8 data bits, no parity, 1 stop bit, for this process alone."""

    def __init__(self, port: str, baud: int):
        self.description = port
        self.baud = baud

    def open(self, baud: int | None = None) -> None:
        """Open the port. Raises LinkError that names the process which holds it."""
        self.baud = baud or self.baud
        try:
            self._file = serial.Serial(self.description, self.baud, timeout=0, exclusive=True)
        # pyserial passes on termios.error, which is no OSError
        except (OSError, ValueError, termios.error) as error:
            raise self._explain_error(error) from None

    def close(self) -> None:
        """Drain the output, with a time limit, and close the port."""
        # not flush(): that waits for ever where the other end does not take what was sent
        with contextlib.suppress(OSError, termios.error):
            for _ in range(DRAIN_ATTEMPTS):
                if self._file is None or not self._file.out_waiting:
                    break
                time.sleep(DRAIN_INTERVAL_S)
        with contextlib.suppress(OSError, termios.error):
            super().close()

    def _explain_error(self, error: Exception) -> LinkError:
        path = self.description
        number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
        # pyserial reports a failed lock only as text
        if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
            users = find_users(path)
            holder = ", ".join(users) or "a process of another user"
            return LinkError(f"{path} is in use", f"by {holder}", "end it, or name another port")
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(f"{path} may not be opened", "permission denied", explain_permission(path))
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            near = suggest_ports(path)
            fix = "plug it in; modelserver driver --list shows what is there"
            fix += f"; nearest: {', '.join(near)}" if near else ""
            return LinkError(path, "there is no such port", fix)
        if isinstance(error, ValueError):
            return LinkError(path, f"{self.baud} baud is not possible", "give another baud")
        if isinstance(error, termios.error):
            fix = f"is it a serial port, and does it know {self.baud} baud?"
            return LinkError(path, f"its settings are rejected: {os.strerror(number or 0)}", fix)
        return LinkError(path, os.strerror(number) if number else str(error), "is it a serial port?")


class PtyLink(DescriptorLink):
    """A pseudo-terminal, of any baud rate. `description` is the path that a driver opens."""

    baud = 0

    def __init__(self, link: Path | None = None):
        """Make one at `open`; with `link` a symbolic link of that name shows the way, whatever the path is."""
        self.description = str(link) if link else "pty"
        self._link = link
        self._path = ""
        self._driver_fd = -1

    def open(self, baud: int | None = None) -> None:
        """Make the pair, unless there is one. Raises LinkError."""
        if self._file is not None:
            return
        try:
            if self._link is not None:
                remove_stale_link(self._link)
            # the other end stays open here, so that a driver that closes it causes no hang-up
            emulator_fd, self._driver_fd = os.openpty()
            self._file = io.FileIO(emulator_fd, "r+")
            tty.setraw(self._driver_fd)
            os.set_blocking(emulator_fd, False)
            self._path = os.ttyname(self._driver_fd)
            if self._link is not None:
                self._link.symlink_to(self._path)
        except OSError as error:
            self.close()
            raise LinkError(self.description, error.strerror or str(error), "give another path") from None
        self.description = str(self._link) if self._link else self._path

    def close(self) -> None:
        """End both; a driver that has it open sees its port vanish."""
        if self._file is not None:
            super().close()
            os.close(self._driver_fd)
        if self._link is not None and self._path:
            # what is not this pseudo-terminal's own link stays: a file, or the link of another emulator
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._path:
                    self._link.unlink()
        self._path = ""

    def send(self, unit: bytes) -> None:
        """Send bytes; they are lost when the terminal's buffer is full, as on a real line."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.fileno(), unit)


def remove_stale_link(link: Path) -> None:
    """Remove a stale link of an emulator. Raises LinkError for anything else, which stays; OSError."""
    try:
        target = os.readlink(link)
    except FileNotFoundError:
        return
    except OSError:
        raise LinkError(f"{link}", "there is a file of that name, and it stays", "give another path") from None
    if link.exists():
        if not target.startswith("/dev/pts/"):
            why = f"it is a link to {target} that no emulator made, and it stays"
            raise LinkError(f"{link}", why, "give another path")
        if users := find_users(target):
            raise LinkError(f"{link} is in use", f"by {', '.join(users)}", "end it, or give another path")
    link.unlink()
