"""TCP, for drivers that call a device server, and for emulators that are called."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
from collections.abc import Sequence

from msdrivers.links import LinkError
from msdrivers.links.files import lost, read_some, wait_readable, write_all

CONNECT_S = 1.0
"""How long a server may take to answer a call."""


class TcpLink:
    """A call to a device server: a receiver with a network port, or a serial port on the network."""

    baud = 0

    def __init__(self, host: str, port: int):
        self._address = (host, port)
        self.description = f"tcp {host}:{port}"
        self._socket: socket.socket | None = None

    def open(self, baud: int | None = None) -> None:
        """Call the server. Raises LinkError. The rate is the server's business."""
        try:
            self._socket = socket.create_connection(self._address, CONNECT_S)
        except socket.gaierror as error:
            raise LinkError(self.description, f"no such host ({error.strerror})", "look at address") from None
        except UnicodeError as error:
            # a name with an empty part, or one that is too long
            raise LinkError(self.description, f"no such address ({error})", "look at address") from None
        except TimeoutError:
            raise LinkError(self.description, "no answer", "is it switched on and on this network?") from None
        except OSError as error:
            why = error.strerror or str(error)
            fix = "nothing listens there: is the device's server on?" if error.errno == errno.ECONNREFUSED else ""
            raise LinkError(self.description, why, fix) from None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def close(self) -> None:
        """Hang up."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what came in. Raises LinkError where the server has hung up."""
        file = self._file()
        return read_some(file, self.description) if wait_readable(file, timeout) else ()

    def send(self, unit: bytes) -> None:
        """Send bytes. Raises LinkError."""
        write_all(self._file(), unit, self.description)

    def _file(self) -> int:
        if self._socket is None:
            raise LinkError(self.description, "the line is not open")
        return self._socket.fileno()


class TcpServerLink:
    """The emulator's side: takes one caller at a time, the latest. What is sent while nobody listens is lost."""

    baud = 0

    def __init__(self, port: int, host: str = "127.0.0.1"):
        """Listen on `port`; 0 takes a free one when the link is opened."""
        self._host, self._port = host, port
        self._server: socket.socket | None = None
        self._caller: socket.socket | None = None
        self.callers = 0
        """How many have called so far."""

    @property
    def description(self) -> str:
        """The address to call."""
        return f"tcp {self._host}:{self._port}"

    def open(self, baud: int | None = None) -> None:
        """Listen, if that is not done yet. Raises LinkError where another program does on this port."""
        if self._server is not None:
            return
        self._server = listening(self._host, self._port)
        self._port = self._server.getsockname()[1]

    def close(self) -> None:
        """Hang up and listen no more."""
        self.hang_up()
        if self._server is not None:
            self._server.close()
            self._server = None

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return what the caller sent. A caller who goes is no error: another may come."""
        if self._server is None:
            raise LinkError(self.description, "the line is not open")
        caller = self._caller
        ready = ready_of([self._server] if caller is None else [self._server, caller], timeout)
        data: Sequence[bytes] = ()
        if caller in ready and caller is not None:
            try:
                data = read_some(caller.fileno(), self.description)
            except LinkError:
                self.hang_up()
        if self._server in ready:
            self._take_caller()
        return data

    def send(self, unit: bytes) -> None:
        """Send bytes to the caller; nobody there, or nobody who takes them, is no error."""
        if self._caller is None:
            return
        try:
            self._caller.sendall(unit)
        except BlockingIOError:
            pass
        except OSError:
            self.hang_up()

    def _take_caller(self) -> None:
        assert self._server is not None
        with contextlib.suppress(OSError):
            caller, _ = self._server.accept()
            self.hang_up()
            caller.setblocking(False)
            caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._caller = caller
            self.callers += 1

    def hang_up(self) -> None:
        """End the call of the one who is there."""
        if self._caller is not None:
            self._caller.close()
            self._caller = None


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens. Raises LinkError."""
    try:
        return socket.create_server((host, port), backlog=1)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            what = f"port {port} is in use"
            raise LinkError(what, "another program listens on it", "end it, or take another port") from None
        if error.errno == errno.EACCES:
            what = f"port {port} may not be used"
            raise LinkError(what, "ports below 1024 are the system's", "take another port") from None
        raise lost(f"tcp {host}:{port}", error) from None


def ready_of(sockets: Sequence[socket.socket], timeout: float) -> list[socket.socket]:
    """Return those of `sockets` with something to read, within `timeout` seconds."""
    ready, _, _ = select.select(sockets, (), (), max(0.0, timeout))
    return ready
