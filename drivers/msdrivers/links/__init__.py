"""Links to devices: the I/O that transports units between an endpoint and its device; TCP for drivers and emulators.

A link is opened, polled, written and closed by one thread. Every failure is a `LinkError`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
from collections.abc import Sequence
from typing import Any, Generic, Protocol, TypeVar

from modelserver.errors import ModelServerError

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

    @property
    def baud(self) -> int: ...

    def open(self, baud: int | None = None) -> None:
        """Open the line, at another baud rate if one is given. Raises LinkError."""

    def close(self) -> None:
        """Flush the output and close; closing twice is no error."""

    def poll(self, timeout: float) -> Sequence[U]:
        """Return received units; wait at most `timeout` seconds for the first. Raises LinkError."""

    def send(self, unit: U) -> None:
        """Send a unit. Raises LinkError."""


class LinkWrapper(Generic[U]):
    """Base of links that wrap another one."""

    def __init__(self, link: Link[U]):
        self._link = link

    @property
    def description(self) -> str:
        return self._link.description

    @property
    def baud(self) -> int:
        return self._link.baud

    def open(self, baud: int | None = None) -> None:
        self._link.open(baud)

    def close(self) -> None:
        self._link.close()


READ_BYTES = 4096
"""Read at once at most."""

WRITE_TIMEOUT_MS = 1000
"""Write timeout, milliseconds."""


class DescriptorLink:
    """Base of the links whose bytes go through a file descriptor."""

    description: str
    _file: Any = None
    """A socket or serial port; None: closed."""

    def fileno(self) -> int:
        """Return the descriptor. Raises LinkError if the line is not open."""
        if self._file is None:
            raise LinkError(self.description, "the line is not open")
        return int(self._file.fileno())

    def close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

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


CONNECT_TIMEOUT_S = 1.0
"""Connect timeout."""


class TcpLink(DescriptorLink):
    """A connection to a device server: a receiver with a network port, or a serial port on the network."""

    baud = 0

    def __init__(self, host: str, port: int):
        self._address = (host, port)
        self.description = f"tcp {host}:{port}"

    def open(self, baud: int | None = None) -> None:
        """Connect; the baud rate is that of the server. Raises LinkError."""
        try:
            connection = socket.create_connection(self._address, CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:
            why, fix = getattr(error, "strerror", None) or str(error), ""
            # UnicodeError: a name with an empty part, or one that is too long
            if isinstance(error, socket.gaierror | UnicodeError):
                why, fix = f"no such host ({why})", "look at address"
            elif isinstance(error, TimeoutError):
                why, fix = "no answer", "is it switched on and on this network?"
            elif isinstance(error, ConnectionRefusedError):
                fix = "nothing listens there: is the device's server on?"
            raise LinkError(self.description, why, fix) from None
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._file = connection


class TcpServerLink(DescriptorLink):
    """A server for one client at a time, the latest. Bytes sent without a client are lost."""

    baud = 0

    def __init__(self, port: int, host: str = "127.0.0.1"):
        """Listen on `port`; 0 takes a free one when the link is opened."""
        self._address = (host, port)
        self.description = f"tcp {host}:{port}"
        self._server: socket.socket | None = None
        self.clients_accepted = 0
        """Number of clients so far."""

    def open(self, baud: int | None = None) -> None:
        if self._server is not None:
            return
        host, port = self._address
        try:
            self._server = socket.create_server(self._address, backlog=1)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                what = f"port {port} is in use"
                raise LinkError(what, "another program listens on it", "end it, or take another port") from None
            raise make_lost_error(self.description, error) from None
        self._address = (host, self._server.getsockname()[1])
        self.description = f"tcp {host}:{self._address[1]}"

    def close(self) -> None:
        self.disconnect_client()
        if self._server is not None:
            self._server.close()
            self._server = None

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return bytes from the client. A disconnect is no error: another client may connect."""
        if self._server is None:
            raise LinkError(self.description, "the line is not open")
        known = [each for each in (self._server, self._file) if each is not None]
        ready, _, _ = select.select(known, (), (), max(0.0, timeout))
        data: Sequence[bytes] = ()
        if self._file in ready:
            try:
                data = self.read_available(self.fileno())
            except LinkError:
                self.disconnect_client()
        if self._server in ready:
            with contextlib.suppress(OSError):
                caller, _ = self._server.accept()
                self.disconnect_client()
                caller.setblocking(False)
                caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._file = caller
                self.clients_accepted += 1
        return data

    def send(self, unit: bytes) -> None:
        """Send bytes to the client; a missing or blocked client is no error."""
        if self._file is None:
            return
        try:
            self._file.sendall(unit)
        except BlockingIOError:
            pass
        except OSError:
            self.disconnect_client()

    def disconnect_client(self) -> None:
        super().close()
