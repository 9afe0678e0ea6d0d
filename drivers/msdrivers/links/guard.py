"""A wrapper that turns every exception of a link into a `LinkError`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from modelserver.errors import quote
from msdrivers.links import Link, LinkError, LinkWrapper

U = TypeVar("U")


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
