"""Lines to devices: what carries units between a station and the world.

A link is opened, polled, sent on and closed by one thread. Everything that goes wrong is a `LinkError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

from modelserver.errors import ModelServerError

U = TypeVar("U")


class LinkError(ModelServerError):
    """A line cannot be opened, or is lost: `what` happened, `why`, and `fix`, what to do about it."""

    def __init__(self, what: str, why: str, fix: str = ""):
        self.what, self.why, self.fix = what, why, fix
        super().__init__(f"{what}: {why}{f'; {fix}' if fix else ''}")


class PlayedOutError(LinkError):
    """A recording has come to its end: nothing more will come on this line."""


class Link(Protocol[U]):
    """A line that carries units: bytes, CAN frames, or Modbus requests and replies."""

    @property
    def description(self) -> str:
        """The line, for people: a path, an address."""
        ...

    @property
    def baud(self) -> int:
        """Symbols a second, 0 where that makes no sense."""
        ...

    def open(self, baud: int | None = None) -> None:
        """Open the line, at another rate than before where one is given. Raises LinkError."""
        ...

    def close(self) -> None:
        """Send what is still to be sent, and close; closing twice is no error."""
        ...

    def poll(self, timeout: float) -> Sequence[U]:
        """Return what came in, waiting `timeout` seconds at most for the first of it. Raises LinkError."""
        ...

    def send(self, unit: U) -> None:
        """Put a unit on the line. Raises LinkError."""
        ...
