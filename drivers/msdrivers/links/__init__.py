"""Links to devices: the I/O that transports units between an endpoint and its device.

A link is opened, polled, written and closed by one thread. Every failure is a `LinkError`.
"""

from __future__ import annotations

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
    def baud(self) -> int:
        """Baud rate, 0 without one."""
        ...

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
        """Baud rate of the wrapped link."""
        return self._link.baud

    def open(self, baud: int | None = None) -> None:
        """Open the wrapped link. Raises LinkError."""
        self._link.open(baud)

    def close(self) -> None:
        """Close the wrapped link."""
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
