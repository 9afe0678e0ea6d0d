"""A serial port, for drivers."""

from __future__ import annotations

import contextlib
import errno
import os
import termios
import time
from collections.abc import Sequence

import serial

from msdrivers.links import LinkError
from msdrivers.links.files import READ_BYTES, lost, wait_readable
from msdrivers.links.ports import holders, near_ports, permission_fix

DRAIN_TRIES, DRAIN_S = 50, 0.01
"""How often, and how far apart in seconds, it is looked whether what was sent has left."""


class SerialLink:
    """A serial port, 8 data bits, no parity, 1 stop bit, for this process alone."""

    def __init__(self, port: str, baud: int):
        self.description = port
        self.baud = baud
        self._serial: serial.Serial | None = None

    def open(self, baud: int | None = None) -> None:
        """Open the port. Raises LinkError that says who keeps it from us."""
        self.baud = baud or self.baud
        try:
            self._serial = serial.Serial(self.description, self.baud, timeout=0, write_timeout=1.0, exclusive=True)
        # pyserial passes on what a terminal's settings are refused with, and that is no OSError
        except (OSError, ValueError, termios.error) as error:
            raise self._explained(error) from None

    def close(self) -> None:
        """Let go of the port after what was sent has left, or could have."""
        port, self._serial = self._serial, None
        if port is None:
            return
        # not port.flush(): that waits for ever where the other end does not take what was sent
        with contextlib.suppress(OSError, termios.error):
            for _ in range(DRAIN_TRIES):
                if not port.out_waiting:
                    break
                time.sleep(DRAIN_S)
        with contextlib.suppress(OSError, termios.error):
            port.close()

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what came in. Raises LinkError where the port is gone."""
        port = self._port()
        if not wait_readable(port.fileno(), timeout):
            return ()
        try:
            data = os.read(port.fileno(), READ_BYTES)
        except BlockingIOError:
            return ()
        except OSError as error:
            raise lost(self.description, error) from None
        if not data:
            raise LinkError(self.description, "it was unplugged", "waiting for its return")
        return (data,)

    def send(self, unit: bytes) -> None:
        """Send bytes. Raises LinkError."""
        try:
            self._port().write(unit)
        except serial.SerialTimeoutException:
            why, fix = f"{len(unit)} bytes are not taken", "look at the cable and at flow control"
            raise LinkError(self.description, why, fix) from None
        except OSError as error:
            raise lost(self.description, error) from None

    def _port(self) -> serial.Serial:
        if self._serial is None:
            raise LinkError(self.description, "the port is not open")
        return self._serial

    def _explained(self, error: Exception) -> LinkError:
        path = self.description
        number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
        # pyserial keeps the cause of a refused lock only as text
        if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
            users = holders(path)
            return LinkError(
                f"{path} is in use",
                f"by {', '.join(users)}" if users else "by a process of another user",
                "end it, or name another port",
            )
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(f"{path} may not be opened", "permission denied", permission_fix(path))
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            near = near_ports(path)
            fix = "plug it in; modelserver driver --list shows what is there"
            fix += f"; nearest: {', '.join(near)}" if near else ""
            return LinkError(path, "there is no such port", fix)
        if isinstance(error, ValueError):
            return LinkError(path, f"{self.baud} baud is not possible", "give another baud")
        if isinstance(error, termios.error):
            fix = f"is it a serial port, and does it know {self.baud} baud?"
            return LinkError(path, f"its settings are refused: {os.strerror(number or 0)}", fix)
        return LinkError(path, os.strerror(number) if number else str(error), "is it a serial port?")
