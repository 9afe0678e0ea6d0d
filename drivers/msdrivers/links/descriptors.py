"""Byte links on a file descriptor: non-blocking I/O."""

from __future__ import annotations

import errno
import os
import select
from collections.abc import Sequence

from msdrivers.links import LinkError

READ_BYTES = 4096
"""Read at once at most."""

WRITE_TIMEOUT_MS = 1000
"""Write timeout, milliseconds."""


class DescriptorLink:
    """Base of the links whose bytes go through a file descriptor."""

    description: str

    def fileno(self) -> int:
        """Return the descriptor. Raises LinkError if the line is not open."""
        raise NotImplementedError

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return received bytes; wait at most `timeout` seconds. Raises LinkError if the line is lost."""
        file = self.fileno()
        return self.read_available(file) if _wait(file, select.POLLIN, max(0.0, timeout) * 1e3) else ()

    def send(self, unit: bytes) -> None:
        """Send all bytes. Raises LinkError if the line is lost or does not take them."""
        file, rest = self.fileno(), memoryview(unit)
        while rest:
            try:
                rest = rest[os.write(file, rest) :]
            except BlockingIOError:
                if not _wait(file, select.POLLOUT, WRITE_TIMEOUT_MS):
                    why, fix = f"{len(rest)} bytes are not taken", "look at the cable and at flow control"
                    raise LinkError(self.description, why, fix) from None
            except OSError as error:
                raise make_lost_error(self.description, error) from None

    def read_available(self, file: int) -> Sequence[bytes]:
        """Return what can be read without waiting. Raises LinkError if the line is lost."""
        try:
            data = os.read(file, READ_BYTES)
        except BlockingIOError:
            return ()
        except OSError as error:
            raise make_lost_error(self.description, error) from None
        if not data:
            why = "the other end is gone: unplugged, switched off or closed"
            raise LinkError(self.description, why, "waiting for its return")
        return (data,)


def _wait(file: int, event: int, timeout_ms: float) -> bool:
    """Return whether an event, or an error to report, came in time."""
    poll = select.poll()
    poll.register(file, event)
    return bool(poll.poll(timeout_ms))


def make_lost_error(what: str, error: OSError) -> LinkError:
    """Return the error of a line that was open and has gone."""
    gone = error.errno in (errno.EIO, errno.ENXIO, errno.ENODEV, errno.EPIPE, errno.ECONNRESET, errno.EBADF)
    why = "it was unplugged, switched off or closed" if gone else (error.strerror or str(error))
    return LinkError(what, why, "waiting for its return")
