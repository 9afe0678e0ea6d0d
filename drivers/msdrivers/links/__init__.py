"""Links to devices: the I/O that transports units between an endpoint and its device.

A link is opened, polled, written and closed by one thread. Every failure is a `LinkError`.
"""

from __future__ import annotations

import errno
import os
import select
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from modelserver.errors import ModelServerError, quote

U = TypeVar("U")


class LinkError(ModelServerError):
    """A line cannot be opened or was lost: what happened, the reason, the fix."""

    def __init__(self, what: str, why: str, fix: str = ""):
        self.what, self.reason, self.fix = what, why, fix
        super().__init__(f"{what}: {why}{f'; {fix}' if fix else ''}")


class EndOfRecordingError(LinkError):
    """A recording has ended."""


class Link(Protocol[U]):
    """A line of units: bytes, CAN frames, or Modbus requests and replies."""

    @property
    def description(self) -> str:
        """Path or address of the line."""
        ...

    @property
    def baud(self) -> int: ...

    def open(self, baud: int | None = None) -> None:
        """Open the line, at another baud rate if one is given. Raises LinkError."""
        ...

    def close(self) -> None:
        """Flush the output and close; closing twice is no error."""
        ...

    def poll(self, timeout: float) -> Sequence[U]:
        """Return received units; wait at most `timeout` seconds for the first. Raises LinkError."""
        ...

    def send(self, unit: U) -> None:
        """Send a unit. Raises LinkError."""
        ...


class LinkWrapper(Generic[U]):
    """Base of links that wrap another one."""

    def __init__(self, link: Link[U]):
        self._link = link

    @property
    def description(self) -> str:
        """Path or address of the wrapped link."""
        return self._link.description

    @property
    def baud(self) -> int:
        return self._link.baud

    def open(self, baud: int | None = None) -> None:
        """Open the wrapped link. Raises LinkError."""
        self._link.open(baud)

    def close(self) -> None:
        self._link.close()


class GuardedLink(LinkWrapper[U]):
    """A link that reports any other exception to `on_error` with its place and turns it into a `LinkError`."""

    def __init__(self, link: Link[U], on_error: Callable[[str], object]):
        super().__init__(link)
        self._on_error = on_error

    def open(self, baud: int | None = None) -> None:
        """Open the line. Raises LinkError."""
        with self._guard("open"):
            self._link.open(baud)

    def close(self) -> None:
        """Close the line; an exception is only reported."""
        try:
            self._link.close()
        except Exception:
            self._on_error("link.close")

    def poll(self, timeout: float) -> Sequence[U]:
        """Return received units. Raises LinkError."""
        with self._guard("poll"):
            return self._link.poll(timeout)

    def send(self, unit: U) -> None:
        """Send a unit. Raises LinkError."""
        with self._guard("send"):
            self._link.send(unit)

    @contextmanager
    def _guard(self, what: str) -> Iterator[None]:
        try:
            yield
        except LinkError:
            raise
        except Exception as error:
            self._on_error(f"link.{what}")
            why = f"{type(error).__name__}: {quote(str(error), 100)}"
            raise LinkError(self.description, why, "an error of the line's own, with its place in the log") from error


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
