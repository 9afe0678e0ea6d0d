"""What systemd is told of a service (sd_notify(3)): that it is ready, how it is, that it lives, that it ends.

The protocol is one datagram of `KEY=value` lines to the socket that NOTIFY_SOCKET names. Without that variable, or
where the socket is gone, nothing happens: a service manager is a convenience and never a reason to fail.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from modelserver.service.log import plain

LONGEST_STATUS: Final = 400
"""Characters of a status line."""

STATUS_PERIOD_NS: Final = 1_000_000_000
"""Between two status lines, at least."""

PINGS: Final = 4
"""Signs of life in the time after which the service manager would take the service for hung."""

LOADING_S: Final = 60.0
"""How long one step of the start, or the reading of a geometry, may take before the service manager gives up."""

Send = Callable[[bytes], object]


def manager_socket(environment: Mapping[str, str] = os.environ) -> Send | None:
    """Return what sends a datagram to the service manager; None where no manager waits for one.

    NOTIFY_SOCKET is a path, or with a leading @ a name in the abstract namespace; what is neither is ignored.
    """
    address = environment.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@") or len(address) < 2:
        return None
    if address.startswith("@"):
        address = f"\0{address[1:]}"

    def send(datagram: bytes) -> None:
        # a few a second: a socket for each needs nobody to close it
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            # a manager that does not read must not stop the service: what does not fit is lost
            channel.setblocking(False)
            channel.sendto(datagram, address)

    return send


def watchdog_ns(environment: Mapping[str, str] = os.environ, pid: int | None = None) -> int:
    """Return after how many nanoseconds without a sign of life the manager acts; 0: it does not watch this process."""
    meant_for = environment.get("WATCHDOG_PID", "")
    if meant_for and meant_for != str(os.getpid() if pid is None else pid):
        return 0
    given = environment.get("WATCHDOG_USEC", "")
    return int(given) * 1000 if given.isascii() and given.isdigit() else 0


class Notifier:
    """Tells the service manager. `send` is None where there is none; `watchdog` in nanoseconds, 0 for none."""

    def __init__(self, send: Send | None, watchdog: int = 0, monotonic_ns: Callable[[], int] = time.monotonic_ns):
        self._send, self._watchdog_ns, self._monotonic_ns = send, watchdog, monotonic_ns
        self._ping_due_ns = 0
        self._status, self._status_due_ns = "", 0
        self._is_ready = False

    @classmethod
    def of_environment(cls) -> Notifier:
        """Return the one that the environment of this process asks for."""
        return cls(manager_socket(), watchdog_ns())

    @property
    def is_heard(self) -> bool:
        """Whether there is anybody to tell."""
        return self._send is not None

    @property
    def is_ready(self) -> bool:
        """Whether READY was told."""
        return self._is_ready

    def tell(self, *lines: str) -> None:
        """Send lines of the protocol as they are: for the other methods."""
        if self._send is not None:
            self._send("\n".join(lines).encode("utf-8", "replace"))

    def starting(self, what: str, seconds: float = LOADING_S) -> None:
        """Tell what the start is at, and that it may take so long from now. After READY it tells nothing."""
        if not self._is_ready:
            self._status = _line(what)
            self.tell(f"STATUS={self._status}", f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def ready(self, status: str) -> None:
        """Tell that the service serves."""
        self._is_ready = True
        self._take(status)
        self.tell("READY=1", f"STATUS={self._status}")

    def status(self, status: Callable[[], str]) -> None:
        """Tell how the service is, where that has changed: once a second `status` is asked for its line."""
        if self._send is None or self._monotonic_ns() < self._status_due_ns:
            return
        before = self._status
        self._take(status())
        if self._status != before:
            self.tell(f"STATUS={self._status}")

    def alive(self) -> None:
        """Give a sign of life, where the manager waits for one and the last was a while ago."""
        now = self._monotonic_ns()
        if self._watchdog_ns and now >= self._ping_due_ns:
            self._ping_due_ns = now + self._watchdog_ns // PINGS
            self.tell("WATCHDOG=1")

    @contextlib.contextmanager
    def reloading(self, seconds: float = LOADING_S) -> Iterator[None]:
        """Tell that a reload is under way until the block ends. It may take so long; then it counts as a hang.

        systemd 253 asks for the monotonic time too, so as not to take an older answer for this one's.
        """
        lines = ["RELOADING=1", f"MONOTONIC_USEC={self._monotonic_ns() // 1000}", "STATUS=reading the geometry anew"]
        if self._watchdog_ns:
            # a value given anew counts from now, and a sign of life goes with it
            lines += [f"WATCHDOG_USEC={round(seconds * 1e6)}", "WATCHDOG=1"]
        self.tell(*lines)
        try:
            yield
        finally:
            lines = ["READY=1", f"STATUS={self._status}"]
            if self._watchdog_ns:
                lines += [f"WATCHDOG_USEC={self._watchdog_ns // 1000}", "WATCHDOG=1"]
            self.tell(*lines)
            self._ping_due_ns = self._status_due_ns = 0

    def stopping(self) -> None:
        """Tell that the service ends by itself or as it was told."""
        self.tell("STOPPING=1", "STATUS=ending")

    def _take(self, status: str) -> None:
        self._status = _line(status)
        self._status_due_ns = self._monotonic_ns() + STATUS_PERIOD_NS


def _line(text: str) -> str:
    """Return one line fit for a status: names in it may be a stranger's."""
    text = plain(text)
    return text if len(text) <= LONGEST_STATUS else f"{text[: LONGEST_STATUS - 3]}..."
