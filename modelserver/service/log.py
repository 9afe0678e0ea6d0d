"""Logging that a flood of one cause cannot fill, and in which a stranger's text cannot pass for more than text."""

from __future__ import annotations

import logging
import traceback
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from modelserver.service.clock import Clock

PERIOD_S = 5.0
MAX_CAUSES = 256

CAUSE: Final = "cause"
"""Attribute of a log record: what the line is about, e.g. GPS:malformed; the journal's field MODELSERVER_CAUSE."""


class RateLimited:
    """Logs a cause at most once in five seconds, and says how often it was silent since."""

    def __init__(self, logger: logging.Logger, clock: Clock):
        self._logger = logger
        self._clock = clock
        self._next_ns: dict[str, int] = {}
        self._silenced: dict[str, int] = {}

    def warning(self, cause: str, message: str, *values: object) -> None:
        """Log a warning."""
        self._log(logging.WARNING, cause, message, values, trace=False)

    def exception(self, cause: str, message: str, *values: object) -> None:
        """Log an error with the trace of the exception that is being handled."""
        self._log(logging.ERROR, cause, message, values, trace=True)

    def _log(self, level: int, cause: str, message: str, values: tuple[object, ...], trace: bool) -> None:
        now = self._clock.monotonic_ns()
        if cause not in self._next_ns and len(self._next_ns) >= MAX_CAUSES:
            cause = "other"
        if now < self._next_ns.get(cause, 0):
            self._silenced[cause] = self._silenced.get(cause, 0) + 1
            return
        self._next_ns[cause] = now + round(PERIOD_S * 1e9)
        silenced = self._silenced.pop(cause, 0)
        text = message % tuple(plain(str(value)) for value in values)
        if silenced:
            text += f" (and {silenced} times more since the last line)"
        if trace:
            # indented, so that nothing in it can pass for a line of its own
            text += "".join(f"\n    {plain(line)}" for line in traceback.format_exc().splitlines())
        self._logger.log(level, "%s", text, extra={CAUSE: cause}, stacklevel=3)


def plain_lines(text: str) -> str:
    """Return text of several lines with each plain, indented after the first: none passes for a line of its own."""
    return "\n    ".join(plain(line) for line in text.splitlines())


def plain(text: str) -> str:
    """Return `text` with everything escaped that a terminal or a log reader would take for more than text."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
