"""A line on which whatever goes wrong is a `LinkError`, be it an error of ours or of a library."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, TypeVar

from modelserver.errors import shown
from msdrivers.links import Link, LinkError

U = TypeVar("U")


class GuardedLink(Generic[U]):
    """A line whose errors that are no `LinkError` are told to `failed`, with where they came, and lose the line."""

    def __init__(self, link: Link[U], failed: Callable[[str], object]):
        self._link, self._failed = link, failed

    @property
    def description(self) -> str:
        """The line's."""
        return self._link.description

    @property
    def baud(self) -> int:
        """The line's."""
        return self._link.baud

    def open(self, baud: int | None = None) -> None:
        """Open the line. Raises LinkError."""
        with self._guard("open"):
            self._link.open(baud)

    def close(self) -> None:
        """Close the line, as well as can be."""
        try:
            self._link.close()
        except Exception:
            self._failed("link.close")

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what came in. Raises LinkError."""
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
            self._failed(f"link.{what}")
            why = f"{type(error).__name__}: {shown(str(error), 100)}"
            raise LinkError(self.description, why, "an error of the line's own, with its place in the log") from error
