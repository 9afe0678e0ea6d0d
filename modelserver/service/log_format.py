"""Where a service's log lines go and what they look like: a terminal or a file, or systemd's journal.

The journal gets each record as one entry of fields, by its native protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL), or
where its socket cannot be reached as lines with a priority in front (sd-daemon(3)). It stamps entries itself.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import socket
import sys
from collections.abc import Iterable, Mapping
from typing import Final, TextIO

from modelserver.service.log import CAUSE, plain

FORMATS: Final = ("auto", "journal", "plain")
"""`auto` is journal where standard error leads there, else plain."""

JOURNAL_SOCKET: Final = "/run/systemd/journal/socket"

LONGEST_MESSAGE: Final = 60_000
"""Characters of a message; what is longer is cut. A datagram of the journal's takes some 200 kB."""

INDENT: Final = "    "


def set_up(level: str, form: str = "auto", identifier: str = "modelserver") -> None:
    """Have this process's log lines written from `level` on. `form` is one of FORMATS; see `handler_for`.

    What ends by a signal of its own, as by the watchdog of a service manager, shows where it was. Where a program has
    set up logging already, as for its tests, it stays.
    """
    root = logging.getLogger()
    if not root.handlers:
        root.setLevel(level.upper())
        root.addHandler(handler_for(form, identifier))
    # a standard error that is no file has nowhere to show it
    with contextlib.suppress(OSError, ValueError):
        faulthandler.enable()


def handler_for(
    form: str,
    identifier: str = "modelserver",
    environment: Mapping[str, str] = os.environ,
    stream: TextIO | None = None,
    path: str = JOURNAL_SOCKET,
) -> logging.Handler:
    """Return what writes records in a form. `identifier` is what the journal calls this process."""
    stream = stream or sys.stderr
    if form == "journal" or (form == "auto" and leads_to_journal(stream, environment)):
        return JournalHandler(stream, identifier, path)
    handler = logging.StreamHandler(stream)
    handler.setFormatter(PlainFormatter())
    return handler


def leads_to_journal(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Return whether a stream is the one that JOURNAL_STREAM, device and inode, says leads to the journal."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class PlainFormatter(logging.Formatter):
    """`LEVEL name: message`, further lines indented: nothing in a message can pass for a record of its own."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines."""
        first, *rest = lines_of(record)
        return "\n".join((f"{record.levelname} {record.name}: {first}", *rest))


class PriorityFormatter(logging.Formatter):
    """The same with `<N>` before every line, N being the priority as syslog counts it, and the cause at the end."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines."""
        first, *rest = lines_of(record)
        cause = getattr(record, CAUSE, "")
        tail = f" cause={plain(str(cause))}" if cause else ""
        head = f"<{priority(record.levelno)}>"
        return "\n".join(f"{head}{line}" for line in (f"{record.name}: {first}{tail}", *rest))


class JournalHandler(logging.StreamHandler[TextIO]):
    """Sends records to the journal; where it cannot, writes them to a stream that leads there, with priorities.

    It never waits: a journal that does not keep up loses entries, and says so with the next that goes through.
    """

    def __init__(self, stream: TextIO, identifier: str, path: str = JOURNAL_SOCKET):
        super().__init__(stream)
        self.setFormatter(PriorityFormatter())
        self._identifier, self._path = identifier, path
        self._lost = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        try:
            datagram = entry(self._fields(record))
            try:
                self._socket.sendto(datagram, self._path)
            except BlockingIOError:
                self._lost += 1
            except OSError:
                super().emit(record)
            else:
                self._lost = 0
        except Exception:
            self.handleError(record)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()
        super().close()

    def _fields(self, record: logging.LogRecord) -> Iterable[tuple[str, str]]:
        text = "\n".join(lines_of(record))
        if self._lost:
            text += f" ({self._lost} entries before this one were lost: the journal did not keep up)"
        yield "MESSAGE", text
        yield "PRIORITY", str(priority(record.levelno))
        yield "SYSLOG_IDENTIFIER", self._identifier
        yield "LOGGER", record.name
        yield "CODE_FILE", record.pathname
        yield "CODE_LINE", str(record.lineno)
        yield "CODE_FUNC", record.funcName or ""
        cause = getattr(record, CAUSE, "")
        if cause:
            yield "MODELSERVER_CAUSE", plain(str(cause))


def lines_of(record: logging.LogRecord) -> list[str]:
    """Return a record's message and trace as lines, at least one, all but the first indented, escaped and bounded."""
    text = record.getMessage()
    if record.exc_info and not record.exc_text:
        record.exc_text = logging.Formatter().formatException(record.exc_info)
    if record.exc_text:
        text += f"\n{record.exc_text}"
    if len(text) > LONGEST_MESSAGE:
        text = f"{text[:LONGEST_MESSAGE]}... ({len(text)} characters)"
    # not splitlines: what a terminal or a reader may take for the end of a line is more than a line feed
    first, *rest = (plain(line) for line in text.split("\n"))
    return [first, *(line if line.startswith(INDENT) else f"{INDENT}{line}" for line in rest)]


def priority(level: int) -> int:
    """Return a level as syslog counts: 3 error, 4 warning, 6 information, 7 for those who debug."""
    for least, number in ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6)):
        if level >= least:
            return number
    return 7


def entry(fields: Iterable[tuple[str, str]]) -> bytes:
    """Return fields as the journal takes them: `NAME=value`, or with the length where a value has several lines."""
    parts = []
    for name, value in fields:
        data = value.encode("utf-8", "backslashreplace")
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n")
        else:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)
