"""Pseudo-terminal link for emulators: a driver opens the other end like a serial port."""

from __future__ import annotations

import contextlib
import os
import termios
import tty
from collections.abc import Sequence
from pathlib import Path

from msdrivers.links import DescriptorLink, LinkError
from msdrivers.links.serial_port import find_emulators

WRONG_BAUD_TABLE = bytes(byte ^ 0x5A for byte in range(256))
"""Translation of bytes between different baud rates."""


class PtyLink(DescriptorLink):
    """A pseudo-terminal. `description` is the path that a driver opens.

    With another rate than `baud` set by the driver, data is garbled in both directions as on a real line; 0: any rate.
    """

    def __init__(self, baud: int = 0, link: Path | None = None):
        """Make one at `open`; with `link` a symbolic link of that name shows the way, whatever the path is."""
        self.baud = baud
        self.description = str(link) if link else "pty"
        self._link = link
        self._path = ""
        self._emulator_fd = self._driver_fd = -1

    def open(self, baud: int | None = None) -> None:
        """Make the pair, or speak at another rate on the one there is. Raises LinkError."""
        self.baud = baud or self.baud
        if self._emulator_fd >= 0:
            return
        try:
            # the other end stays open here, so that a driver that closes it causes no hang-up
            self._emulator_fd, self._driver_fd = os.openpty()
            tty.setraw(self._driver_fd)
            os.set_blocking(self._emulator_fd, False)
            self._path = os.ttyname(self._driver_fd)
            if self._link is not None:
                remove_stale_link(self._link)
                self._link.symlink_to(self._path)
        except OSError as error:
            self.close()
            raise LinkError(self.description, error.strerror or str(error), "give another path") from None
        except LinkError:
            self.close()
            raise
        self.description = str(self._link) if self._link else self._path

    def close(self) -> None:
        """End both; a driver that has it open sees its port vanish."""
        for file in (self._emulator_fd, self._driver_fd):
            if file >= 0:
                os.close(file)
        if self._link is not None and self._path:
            # what is not this pseudo-terminal's own link stays: a file, or the link of another emulator
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._path:
                    self._link.unlink()
        self._path = ""
        self._emulator_fd = self._driver_fd = -1

    def fileno(self) -> int:
        """Return the emulator's end. Raises LinkError if it is not open."""
        if self._emulator_fd < 0:
            raise LinkError(self.description, "the line is not open")
        return self._emulator_fd

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what the driver sent. Raises LinkError."""
        return tuple(self._apply_baud(data) for data in super().poll(timeout))

    def send(self, unit: bytes) -> None:
        """Send bytes; they are lost when the terminal's buffer is full, as on a real line."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.fileno(), self._apply_baud(unit))

    def _apply_baud(self, data: bytes) -> bytes:
        return data if not self.baud or self._get_driver_baud() in (self.baud, 0) else data.translate(WRONG_BAUD_TABLE)

    def _get_driver_baud(self) -> int:
        """Return the rate that the driver has set, 0 if unknown."""
        speed = termios.tcgetattr(self._driver_fd)[5]
        return next((rate for rate in BAUDS if getattr(termios, f"B{rate}", None) == speed), 0)


def remove_stale_link(link: Path) -> None:
    """Remove a stale link of an emulator. Raises LinkError for anything else, which stays; OSError."""
    try:
        target = os.readlink(link)
    except FileNotFoundError:
        return
    except OSError:
        raise LinkError(f"{link}", "there is a file of that name, and it stays", "give another path") from None
    if link.exists():
        if not target.startswith(PTY_FOLDER):
            why = f"it is a link to {target} that no emulator made, and it stays"
            raise LinkError(f"{link}", why, "give another path")
        users = find_emulators(target)
        if users:
            raise LinkError(f"{link} is in use", f"by the emulator {', '.join(users)}", "end it, or give another path")
    link.unlink()


PTY_FOLDER = "/dev/pts/"

BAUDS = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Those that a terminal has a name for."""
