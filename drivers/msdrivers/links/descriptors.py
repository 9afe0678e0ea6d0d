"""Non-blocking I/O on the file descriptor of a byte link."""

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


def wait_readable(file: int, timeout: float) -> bool:
    """Wait at most `timeout` seconds; return whether there is data to read or an error to report."""
    poll = select.poll()
    poll.register(file, select.POLLIN)
    return bool(poll.poll(max(0.0, timeout) * 1e3))


def read_available(file: int, what: str) -> Sequence[bytes]:
    """Return what can be read without waiting. Raises LinkError, beginning with `what`, where the line is lost."""
    try:
        data = os.read(file, READ_BYTES)
    except BlockingIOError:
        return ()
    except OSError as error:
        raise make_lost_error(what, error) from None
    if not data:
        raise LinkError(what, "the other end is gone: unplugged, switched off or closed", "waiting for its return")
    return (data,)


def write_all(file: int, data: bytes, what: str) -> None:
    """Write all of `data`. Raises LinkError, beginning with `what`, where the line is lost or does not take it."""
    rest = memoryview(data)
    while rest:
        try:
            rest = rest[os.write(file, rest) :]
        except BlockingIOError:
            poll = select.poll()
            poll.register(file, select.POLLOUT)
            if not poll.poll(WRITE_TIMEOUT_MS):
                raise LinkError(
                    what, f"{len(rest)} bytes are not taken", "look at the cable and at flow control"
                ) from None
        except OSError as error:
            raise make_lost_error(what, error) from None


def make_lost_error(what: str, error: OSError) -> LinkError:
    """Return the error of a line that was open and has gone."""
    gone = error.errno in (errno.EIO, errno.ENXIO, errno.ENODEV, errno.EPIPE, errno.ECONNRESET, errno.EBADF)
    why = "it was unplugged, switched off or closed" if gone else (error.strerror or str(error))
    return LinkError(what, why, "waiting for its return")
