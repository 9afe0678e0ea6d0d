"""A pseudo-terminal, for emulators: drivers open its other end as if it were a serial port."""

from __future__ import annotations

import contextlib
import os
import termios
import tty
from collections.abc import Sequence
from pathlib import Path

from msdrivers.links import LinkError
from msdrivers.links.files import read_some, wait_readable
from msdrivers.links.ports import other_ends

GARBLE = bytes(byte ^ 0x5A for byte in range(256))
"""What bytes turn into when the two ends speak at different rates."""


class PtyLink:
    """A pseudo-terminal. `description` is the path that a driver opens.

    A driver that has set another rate than `baud` hears and says garbage, as on a real line; 0: any rate will do.
    """

    def __init__(self, baud: int = 0, link: Path | None = None):
        """Make one at `open`; with `link` a symbolic link of that name shows the way, whatever the path is."""
        self.baud = baud
        self.description = str(link) if link else "pty"
        self._link = link
        self._path = ""
        self._own = self._other = -1

    def open(self, baud: int | None = None) -> None:
        """Make the pair, or speak at another rate on the one there is. Raises LinkError."""
        self.baud = baud or self.baud
        if self._own >= 0:
            return
        try:
            # the other end stays open here too, so that a driver that goes is no hang-up
            self._own, self._other = os.openpty()
            tty.setraw(self._other)
            os.set_blocking(self._own, False)
            self._path = os.ttyname(self._other)
            if self._link is not None:
                make_way(self._link)
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
        for file in (self._own, self._other):
            if file >= 0:
                os.close(file)
        if self._link is not None and self._path:
            # what is not this pseudo-terminal's own link stays: a file, or the link of another emulator
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._path:
                    self._link.unlink()
        self._path = ""
        self._own = self._other = -1

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what the driver sent. Raises LinkError."""
        if self._own < 0:
            raise LinkError(self.description, "the line is not open")
        if not wait_readable(self._own, timeout):
            return ()
        return [self._as_heard(data) for data in read_some(self._own, self.description)]

    def send(self, unit: bytes) -> None:
        """Send bytes; what nobody reads is lost once the terminal's buffer is full, as on a real line."""
        if self._own < 0:
            raise LinkError(self.description, "the line is not open")
        with contextlib.suppress(BlockingIOError):
            os.write(self._own, self._as_heard(unit))

    def _as_heard(self, data: bytes) -> bytes:
        return data if not self.baud or self._rate() in (self.baud, 0) else data.translate(GARBLE)

    def _rate(self) -> int:
        """Return the rate that the driver has set, 0 where it cannot be told."""
        speed = termios.tcgetattr(self._other)[5]
        return next((rate for rate in RATES if getattr(termios, f"B{rate}", None) == speed), 0)


def make_way(link: Path) -> None:
    """Take away a link that an emulator left behind. Raises LinkError for anything else, which stays; OSError."""
    try:
        target = os.readlink(link)
    except FileNotFoundError:
        return
    except OSError:
        raise LinkError(f"{link}", "there is a file of that name, and it stays", "give another path") from None
    if link.exists():
        if not target.startswith(PTS):
            why = f"it is a link to {target} that no emulator made, and it stays"
            raise LinkError(f"{link}", why, "give another path")
        users = other_ends(target)
        if users:
            raise LinkError(f"{link} is in use", f"by the emulator {', '.join(users)}", "end it, or give another path")
    link.unlink()


PTS = "/dev/pts/"

RATES = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Those that a terminal has a name for."""
