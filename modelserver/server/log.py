"""Logging: rate-limited, escaped, to a terminal, a file or systemd's journal.

- `RateLimitedLog` logs one cause at most every `LOG_PERIOD_S` seconds, so that a flood cannot fill the log.
- Text from the bus is escaped, so that it cannot imitate a log line or a terminal sequence.
- systemd's journal reads standard error; a prefix gives each line its priority (sd-daemon(3)).
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Final, TextIO

if TYPE_CHECKING:
    from modelserver.server.clock import Clock

LOG_PERIOD_S = 5.0
MAX_CAUSES = 256


class RateLimitedLog:
    """Logs a cause at most once in `LOG_PERIOD_S`, with the number of suppressed lines."""

    def __init__(self, logger: logging.Logger, clock: Clock):
        self._logger = logger
        self._clock = clock
        self._next_ns: dict[str, int] = {}
        self._suppressed: dict[str, int] = {}

    def warning(self, cause: str, message: str, *values: object) -> None:
        self._log(logging.WARNING, cause, message, values, trace=False)

    def exception(self, cause: str, message: str, *values: object) -> None:
        """Log an error with the traceback of the exception that is being handled."""
        self._log(logging.ERROR, cause, message, values, trace=True)

    def _log(self, level: int, cause: str, message: str, values: tuple[object, ...], trace: bool) -> None:
        now = self._clock.monotonic_ns()
        if cause not in self._next_ns and len(self._next_ns) >= MAX_CAUSES:
            cause = "other"
        if now < self._next_ns.get(cause, 0):
            self._suppressed[cause] = self._suppressed.get(cause, 0) + 1
            return
        self._next_ns[cause] = now + round(LOG_PERIOD_S * 1e9)
        suppressed = self._suppressed.pop(cause, 0)
        text = message % tuple(escape_text(str(value)) for value in values)
        if suppressed:
            text += f" (and {suppressed} times since the last line)"
        if trace:
            text += "".join(f"\n    {escape_text(line)}" for line in traceback.format_exc().splitlines())
        self._logger.log(level, "%s", text, stacklevel=3)


SECOND_NS: Final = 1_000_000_000


class RateLimiter:
    """Limits events by name: `per_second` in each window of a second, which starts with the first event."""

    def __init__(self, per_second: int):
        self._per_second = per_second
        self._windows: dict[Hashable, tuple[int, int]] = {}

    def try_acquire(self, name: Hashable, now_ns: int) -> bool:
        """Count an event at an instant (monotonic, ns); return whether it is within the limit."""
        begin, used = self._windows.get(name, (now_ns, 0))
        if now_ns - begin >= SECOND_NS:
            begin, used = now_ns, 0
        if used >= self._per_second:
            return False
        self._windows[name] = (begin, used + 1)
        return True


def escape_lines(text: str) -> str:
    """Escape each line of a text and indent all but the first, so that none imitates a log line."""
    return "\n    ".join(escape_text(line) for line in text.splitlines())


def escape_text(text: str) -> str:
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


FORMATS: Final = ("auto", "journal", "plain")
"""`auto` is journal if standard error is connected to it, else plain."""

MAX_MESSAGE_LENGTH: Final = 60_000
"""Characters of a message; a longer one is truncated."""

INDENT: Final = "    "


def set_up_logging(level: str, form: str = "auto") -> None:
    """Set up logging from `level` on, in a `form` of FORMATS, unless the program has set it up already.

    A process that is killed by a fatal signal, such as the watchdog's, prints the stack of its main thread.
    """
    root = logging.getLogger()
    if not root.handlers:
        root.setLevel(level.upper())
        root.addHandler(make_handler(form))
    with contextlib.suppress(OSError, ValueError):  # standard error is no file
        # other threads may run meanwhile: reading their stacks can crash, before that of the main thread is written
        faulthandler.enable(all_threads=False)


def start_in_background(thread: threading.Thread) -> None:
    """Start a thread that never receives SIGABRT, the watchdog's signal, which prints the main thread's stack."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGABRT})
    try:
        thread.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def make_handler(
    form: str, environment: Mapping[str, str] = os.environ, stream: TextIO | None = None
) -> logging.Handler:
    """Make the log handler of a form."""
    stream = stream or sys.stderr
    handler = logging.StreamHandler(stream)
    is_journal = form == "journal" or (form == "auto" and is_journal_stream(stream, environment))
    handler.setFormatter(LineFormatter(has_priority=is_journal))
    return handler


def is_journal_stream(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Return whether a stream is connected to the journal: JOURNAL_STREAM names its device and inode."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class LineFormatter(logging.Formatter):
    """Formats as `LEVEL name: message`, further lines indented; `has_priority`: each line after its priority."""

    def __init__(self, has_priority: bool = False):
        super().__init__()
        self._has_priority = has_priority

    def format(self, record: logging.LogRecord) -> str:
        first, *rest = lines_of(record)
        prefix = f"<{get_priority(record.levelno)}>" if self._has_priority else ""
        return "\n".join(f"{prefix}{line}" for line in (f"{record.levelname} {record.name}: {first}", *rest))


def lines_of(record: logging.LogRecord) -> list[str]:
    """Return message and traceback of a record as escaped lines of limited length, all but the first indented."""
    text = record.getMessage()
    if record.exc_info and not record.exc_text:
        record.exc_text = logging.Formatter().formatException(record.exc_info)
    if record.exc_text:
        text += f"\n{record.exc_text}"
    if len(text) > MAX_MESSAGE_LENGTH:
        text = f"{text[:MAX_MESSAGE_LENGTH]}... ({len(text)} characters)"
    # not splitlines, which would leave other line separators unescaped
    first, *rest = (escape_text(line) for line in text.split("\n"))
    return [first, *(line if line.startswith(INDENT) else f"{INDENT}{line}" for line in rest)]


def get_priority(level: int) -> int:
    """Return the syslog priority of a level: 2 critical, 3 error, 4 warning, 6 info, 7 debug."""
    ranks = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
    return next((number for least, number in ranks if level >= least), 7)
