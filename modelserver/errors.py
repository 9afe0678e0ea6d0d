"""The exception tree, and the scenario each member is for.

Every error says what is wrong, where, why, and what to do; where a name was mistyped it offers the
nearest known ones. Errors that travel on the bus carry a `Status`, so that a client raises the very
class that the server meant.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, StrEnum


class Status(IntEnum):
    """How a request ended: the `status` field of every reply on the bus."""

    OK = 0
    UNKNOWN_BODY = 1
    UNKNOWN_FRAME = 2
    NOT_CONNECTED = 3
    NO_POSE = 4
    TOO_OLD = 5
    TOO_NEW = 6
    MALFORMED = 7
    REFUSED_LOAD = 8
    LIMIT = 9
    INTERNAL = 10


class Severity(StrEnum):
    """How much a problem matters.

    error: load raises, and a daemon keeps its old model or refuses to start.
    warning: loads; `modelserver check` lists it and exits 1.
    note: worth knowing, changes no exit code.
    """

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Source:
    """The place in a file that a value came from."""

    file: str = ""
    line: int = 0
    element: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place} ({self.element})" if place and self.element else place or self.element


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong with a file: where, what, and what to do about it.

    `nearest` holds the known names closest to a mistyped one, best first.
    """

    severity: Severity
    message: str
    source: Source = Source()
    fix: str = ""
    nearest: tuple[str, ...] = ()

    @property
    def file(self) -> str:
        """Path of the file, empty for a model built in a program."""
        return self.source.file

    @property
    def line(self) -> int:
        """Line in the file, counted from 1; 0 where there is none."""
        return self.source.line

    @property
    def element(self) -> str:
        """The thing in the file, e.g. `body Raptor, frame CG`."""
        return self.source.element

    def __str__(self) -> str:
        head = f"{self.source}: " if str(self.source) else ""
        tail = f" Nearest: {', '.join(self.nearest)}." if self.nearest else ""
        fix = f" Fix: {self.fix}" if self.fix else ""
        return f"{head}{self.severity}: {self.message}{tail}{fix}"


def nearest_names(name: str, known: Iterable[str], count: int = 3) -> tuple[str, ...]:
    """Return the known names most like `name`, best first; case is no difference.

    Names longer than 200 characters are not compared: the cost of a comparison grows with the product
    of the lengths, and such names come from strangers.
    """
    if len(name) > 200:
        return ()
    by_folded: dict[str, str] = {}
    for candidate in known:
        by_folded.setdefault(candidate.casefold(), candidate)
    found = difflib.get_close_matches(name.casefold(), by_folded, n=count, cutoff=0.6)
    return tuple(by_folded[key] for key in found)


def shown(name: str, limit: int = 80) -> str:
    """Return `name` fit for a message: escaped, quoted, and cut where a stranger sent kilobytes."""
    if len(name) > limit:
        return f"{name[:limit]!r}... ({len(name)} characters)"
    return repr(name)


class ModelServerError(Exception):
    """Base of everything this package raises on purpose."""


class FrameMismatchError(ModelServerError, ValueError):
    """Two transformations were multiplied whose adjacent frames differ."""


class ConfigError(ModelServerError):
    """A configuration file is wrong. `problems` lists every finding."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class GeometryError(ModelServerError):
    """A geometry file, or a model built in a program, breaks a rule. `problems` lists every finding."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        errors = [problem for problem in self.problems if problem.severity is Severity.ERROR]
        super().__init__("\n".join(str(problem) for problem in errors))


class WireError(ModelServerError, ValueError):
    """Bytes from the bus are no message of the type that the channel carries. `reason` is one word."""

    def __init__(self, reason: str, message: str):
        self.reason = reason
        super().__init__(message)


class QueryError(ModelServerError):
    """A question that cannot be answered; `status` is what a reply on the bus carries.

    `nearest` holds known names close to a mistyped one.
    """

    status = Status.INTERNAL

    def __init__(self, message: str, nearest: Iterable[str] = ()):
        self.nearest = tuple(nearest)
        super().__init__(message)


class UnknownBodyError(QueryError, LookupError):
    """The model has no body of that name."""

    status = Status.UNKNOWN_BODY


class UnknownFrameError(QueryError, LookupError):
    """The body exists but has no frame of that name, or the name is not of the form Body:Frame."""

    status = Status.UNKNOWN_FRAME


class NotConnectedError(QueryError):
    """Both frames exist but no chain of constraints joins them."""

    status = Status.NOT_CONNECTED


class NoPoseError(QueryError):
    """A world frame was asked for before the vehicle's pose is known."""

    status = Status.NO_POSE


class TooOldError(QueryError):
    """The time asked for lies before what is held."""

    status = Status.TOO_OLD


class TooNewError(QueryError):
    """The time asked for lies after what is held, and the policy forbids to predict."""

    status = Status.TOO_NEW


class MalformedRequestError(QueryError, ValueError):
    """The request makes no sense: an unknown policy, a negative wait, a range that ends before it starts."""

    status = Status.MALFORMED


class RefusedError(QueryError):
    """The server is loaded and did not take the request; ask again later."""

    status = Status.REFUSED_LOAD


class LimitError(QueryError):
    """The request asks for more than the server gives at once; the message names the limit."""

    status = Status.LIMIT


class ServerError(QueryError):
    """The server failed on its side; its log holds the cause."""

    status = Status.INTERNAL


class NoServerError(ModelServerError, TimeoutError):
    """No reply came in time: no server on this bus, or a bus that drops everything."""


_BY_STATUS: dict[int, type[QueryError]] = {
    cls.status: cls
    for cls in (
        UnknownBodyError,
        UnknownFrameError,
        NotConnectedError,
        NoPoseError,
        TooOldError,
        TooNewError,
        MalformedRequestError,
        RefusedError,
        LimitError,
        ServerError,
    )
}


def error_for_status(status: int, message: str, nearest: Iterable[str] = ()) -> QueryError:
    """Return the error that a reply's `status` stands for."""
    return _BY_STATUS.get(status, ServerError)(message, nearest)
