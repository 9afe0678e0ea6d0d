"""TCP links: clients for drivers, servers for emulators."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
from collections.abc import Sequence

from msdrivers.links import DescriptorLink, LinkError, make_lost_error

CONNECT_TIMEOUT_S = 1.0
"""Connect timeout."""


class TcpLink(DescriptorLink):
    """A connection to a device server: a receiver with a network port, or a serial port on the network."""

    baud = 0

    def __init__(self, host: str, port: int):
        self._address = (host, port)
        self.description = f"tcp {host}:{port}"
        self._socket: socket.socket | None = None

    def open(self, baud: int | None = None) -> None:
        """Connect; the baud rate is that of the server. Raises LinkError."""
        try:
            self._socket = socket.create_connection(self._address, CONNECT_TIMEOUT_S)
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
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def fileno(self) -> int:
        """Return the connection's descriptor. Raises LinkError if it is not open."""
        if self._socket is None:
            raise LinkError(self.description, "the line is not open")
        return self._socket.fileno()


class TcpServerLink(DescriptorLink):
    """A server for one client at a time, the latest. Bytes sent without a client are lost."""

    baud = 0

    def __init__(self, port: int, host: str = "127.0.0.1"):
        """Listen on `port`; 0 takes a free one when the link is opened."""
        self._address = (host, port)
        self.description = f"tcp {host}:{port}"
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self.clients_accepted = 0
        """Number of clients so far."""

    def open(self, baud: int | None = None) -> None:
        """Listen. Raises LinkError if the port is in use."""
        if self._server is not None:
            return
        host, port = self._address
        try:
            self._server = socket.create_server(self._address, backlog=1)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                what = f"port {port} is in use"
                raise LinkError(what, "another program listens on it", "end it, or take another port") from None
            if error.errno == errno.EACCES:
                what = f"port {port} may not be used"
                raise LinkError(what, "ports below 1024 are the system's", "take another port") from None
            raise make_lost_error(self.description, error) from None
        self._address = (host, self._server.getsockname()[1])
        self.description = f"tcp {host}:{self._address[1]}"

    def close(self) -> None:
        """Disconnect and stop listening."""
        self.disconnect_client()
        if self._server is not None:
            self._server.close()
            self._server = None

    def poll(self, timeout: float) -> Sequence[bytes]:
        """Return bytes from the client. A disconnect is no error: another client may connect."""
        if self._server is None:
            raise LinkError(self.description, "the line is not open")
        known = [each for each in (self._server, self._client) if each is not None]
        ready, _, _ = select.select(known, (), (), max(0.0, timeout))
        data: Sequence[bytes] = ()
        if self._client is not None and self._client in ready:
            try:
                data = self.read_available(self._client.fileno())
            except LinkError:
                self.disconnect_client()
        if self._server in ready:
            with contextlib.suppress(OSError):
                caller, _ = self._server.accept()
                self.disconnect_client()
                caller.setblocking(False)
                caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client = caller
                self.clients_accepted += 1
        return data

    def send(self, unit: bytes) -> None:
        """Send bytes to the client; a missing or blocked client is no error."""
        if self._client is None:
            return
        try:
            self._client.sendall(unit)
        except BlockingIOError:
            pass
        except OSError:
            self.disconnect_client()

    def disconnect_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
