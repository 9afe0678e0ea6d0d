"""The exception tree, and the scenario each member is for.

Every error says what is wrong, where, why, and what to do; where a name was mistyped it offers the
nearest known ones. Errors that travel on the bus carry a `Status`, so that a client raises the very
class that the server meant.
"""

from __future__ import annotations

import difflib
import heapq
import operator
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from itertools import islice, repeat


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
    FORBIDDEN = 11
    REJECTED = 12


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
class Location:
    """The place in a file that a value came from."""

    file: str = ""
    line: int = 0
    element: str = ""

    def __str__(self) -> str:
        place = self.file
        if self.line:
            place = f"{self.file}:{self.line}" if self.file else f"line {self.line}"
        return f"{place} ({self.element})" if place and self.element else place or self.element


@dataclass(frozen=True, slots=True)
class Edit:
    """A change of one line of a file that fixes a problem: `old`, a name or a word there, becomes `new`."""

    line: int
    old: str
    new: str

    def apply(self, text: str) -> str:
        """Return the text of the file with the change.

        Raises ValueError where it is not clear which occurrence is meant: `old` is not exactly once on the line, as a
        whole word, and not exactly once in the file.
        """
        word = re.compile(rf"(?<![\w./:-]){re.escape(self.old)}(?![\w./-])")
        lines = text.split("\n")
        for numbers in ([self.line - 1], range(len(lines))):
            found = [(n, match) for n in numbers if 0 <= n < len(lines) for match in word.finditer(lines[n])]
            if len(found) == 1:
                ((n, match),) = found
                lines[n] = lines[n][: match.start()] + self.new + lines[n][match.end() :]
                return "\n".join(lines)
            if found:
                break
        raise ValueError(f"{shown(self.old)} is not clear on line {self.line}")


class Suggested(tuple[str, ...]):
    """Names proposed in place of one that is misspelled, `replaced`; how `Problem` takes them in."""

    replaced = ""

    @classmethod
    def of(cls, replaced: str, *names: str) -> Suggested:
        """Return the proposal of `names` for `replaced`."""
        found = cls(name for name in names if name)
        found.replaced = replaced
        return found


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong with a file: where, what, and what to do about it.

    `nearest` holds the known names closest to a mistyped one, best first; `replaced` is the mistyped one as it stands
    in the file, where writing the first of `nearest` in its place is known to be right (`suggestion`).
    """

    severity: Severity
    message: str
    source: Location = Location()
    fix: str = ""
    nearest: tuple[str, ...] = ()
    replaced: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.nearest, Suggested):
            # stored as plain values: a problem is compared, kept and sent
            object.__setattr__(self, "replaced", self.nearest.replaced if self.nearest else "")
            object.__setattr__(self, "nearest", tuple(self.nearest))

    @property
    def edit(self) -> Edit | None:
        """The change of the file that fixes the problem; None where no single one is known to."""
        return Edit(self.line, self.replaced, self.nearest[0]) if self.replaced and self.nearest else None

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
        tail = f"; nearest: {', '.join(self.nearest)}" if self.nearest else ""
        fix = f"; fix: {self.fix}" if self.fix else ""
        return f"{head}{self.severity}: {self.message}{tail}{fix}"


KNOWN_NAMES = 20_000
COMPARED_LENGTH = 100
COMPARED_NAMES = 16
COMPARED_PAIRS = 12
"""Bounds of `nearest_names`: names it looks at, their length, those compared in full, pairs of letters looked for."""


def nearest_names(name: str, known: Iterable[str], count: int = 3) -> tuple[str, ...]:
    """Return the known names most like `name`, best first; case is no difference.

    The cost is bounded, since mistyped names come from strangers too: names longer than 100 characters are
    not compared, and of many known names only those that share most pairs of letters with `name` are
    compared in full. 10,000 known names take about 10 ms.
    """
    if not name or len(name) > COMPARED_LENGTH:
        return ()
    wanted = name.casefold()
    by_folded: dict[str, str] = {}
    for candidate in islice(known, KNOWN_NAMES):
        by_folded.setdefault(candidate.casefold(), candidate)
    # a similarity of 0.6, 2 M / (a + b), cannot be reached by names that differ more than this in length
    shortest, longest = len(wanted) * 3 / 7, len(wanted) * 7 / 3
    candidates = [each for each in by_folded if shortest <= len(each) <= longest]
    if len(candidates) > COMPARED_NAMES:
        candidates = _sharing_most(wanted, candidates)
    return tuple(by_folded[key] for key in difflib.get_close_matches(wanted, candidates, n=count, cutoff=0.6))


def _sharing_most(wanted: str, candidates: list[str]) -> list[str]:
    """Return the few candidates that hold most of the pairs of letters in `wanted`; of equals, those nearest in length.

    The loops over the candidates run in C.
    """
    pairs = list(dict.fromkeys(wanted[i : i + 2] for i in range(max(1, len(wanted) - 1))))
    # evenly spread over the name where there are too many
    pairs = pairs[:: -(-len(pairs) // COMPARED_PAIRS)]
    shared = map(sum, zip(*(map(operator.contains, candidates, repeat(pair)) for pair in pairs), strict=True))
    lengths = map(abs, map(operator.sub, map(len, candidates), repeat(len(wanted))))
    ranked = zip(map(operator.neg, shared), lengths, range(len(candidates)), strict=True)
    return [candidates[index] for _, _, index in heapq.nsmallest(COMPARED_NAMES, ranked)]


_WORD = re.compile(r"\d+|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W\d_]+")
"""The words of a name: `UtmGrid10S` has Utm, Grid, 10, S."""


def suggestion(name: str, known: Iterable[str], *, is_family: bool = True) -> str:
    """Return the known name that `name` is a misspelling of; empty where that is not clear.

    Clear is a single nearest name by the optimal string alignment distance (a letter more, less or other, or two
    neighbors exchanged): at most one such step for up to six characters, two for more. Numbers and single letters
    tell names of a family apart (`Wheel1`, `CameraL`, `UtmGrid10S`), so they must be the same where `is_family`:
    another of the family is another thing. Case is no difference.
    """
    wanted = name.casefold()
    if not 3 <= len(wanted) <= COMPARED_LENGTH:
        exact = [each for each in islice(known, KNOWN_NAMES) if each.casefold() == wanted and name]
        return exact[0] if len(exact) == 1 else ""
    most = 1 if len(wanted) <= 6 else 2
    names = [each for each in islice(known, KNOWN_NAMES) if abs(len(each) - len(wanted)) <= most]
    if len(names) > COMPARED_NAMES:
        folded = [each.casefold() for each in names]
        chosen = set(_sharing_most(wanted, folded))
        names = [each for each, key in zip(names, folded, strict=True) if key in chosen]
    found = sorted((distance, each) for each in names if (distance := _distance(wanted, each.casefold(), most)) <= most)
    if not found or (len(found) > 1 and found[0][0] == found[1][0]):
        return ""
    best = found[0][1]
    return best if not is_family or _codes(best) == _codes(name) else ""


def suggestions(name: str, known: Iterable[str]) -> Suggested:
    """Return the `suggestion` for a name as a problem takes it: none, or one."""
    return Suggested.of(name, suggestion(name, known))


def suggest_key(key: str, known: Iterable[str]) -> Suggested:
    """Return the key of a schema that `key` misspells, or is without its unit (`rate` for `rate_hz`): none, or one."""
    known = list(known)
    longer = [each for each in known if each.startswith(f"{key}_")] if key else []
    return Suggested.of(key, longer[0] if len(longer) == 1 else suggestion(key, known, is_family=False))


def _codes(name: str) -> list[str]:
    """Return the numbers and single letters among the words of a name."""
    words = [word.casefold() for word in _WORD.findall(name)]
    return [word for word in words if len(word) == 1 or word.isdecimal()]


def _distance(a: str, b: str, most: int) -> int:
    """Return the optimal string alignment distance of two words, or more than `most`."""
    two_above: list[int] = []
    above = list(range(len(b) + 1))
    for i, letter in enumerate(a, 1):
        row = [i]
        for j, other in enumerate(b, 1):
            cost = min(above[j] + 1, row[j - 1] + 1, above[j - 1] + (letter != other))
            if i > 1 and j > 1 and letter == b[j - 2] and a[i - 2] == other:
                cost = min(cost, two_above[j - 2] + 1)
            row.append(cost)
        if min(row) > most:
            return most + 1
        two_above, above = above, row
    return above[-1]


def shown(name: str, limit: int = 80) -> str:
    """Return `name` fit for a message: escaped, quoted, and cut where a stranger sent kilobytes."""
    if len(name) > limit:
        return f"{name[:limit]!r}... ({len(name)} characters)"
    return repr(name)


class ModelServerError(Exception):
    """Base of everything this package raises on purpose."""


class KeyFileError(ModelServerError):
    """A file of keys that commands are signed with cannot be used."""


class FrameMismatchError(ModelServerError, ValueError):
    """Two transformations were multiplied whose adjacent frames differ."""


class ConfigError(ModelServerError):
    """A configuration file is wrong. `problems` lists every finding."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))

    def __reduce__(self) -> tuple[Callable[..., ConfigError], tuple[object, ...]]:
        return type(self), (self.problems,)


class GeometryError(ModelServerError):
    """A geometry file, or a model built in a program, breaks a rule. `problems` lists every finding."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        errors = [problem for problem in self.problems if problem.severity is Severity.ERROR]
        super().__init__("\n".join(str(problem) for problem in errors))

    def __reduce__(self) -> tuple[Callable[..., GeometryError], tuple[object, ...]]:
        return type(self), (self.problems,)


class WireError(ModelServerError, ValueError):
    """Bytes from the bus are no message of the type that the channel carries. `reason` is one word."""

    def __init__(self, reason: str, message: str):
        self.reason = reason
        super().__init__(message)

    def __reduce__(self) -> tuple[Callable[..., WireError], tuple[object, ...]]:
        return type(self), (self.reason, str(self))


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


class ForbiddenError(QueryError):
    """The vehicle file does not allow it; the message names the setting."""

    status = Status.FORBIDDEN


class RejectedError(QueryError):
    """What was given was looked at and not taken: a geometry that does not suit, a pose that cannot be; all stays."""

    status = Status.REJECTED


class ServerError(QueryError):
    """The server failed on its side; its log holds the cause."""

    status = Status.INTERNAL


class BusError(ModelServerError):
    """The message bus cannot be joined."""


class RecordingError(ModelServerError):
    """A recording cannot be read, or is none."""


class NoServerError(ModelServerError, TimeoutError):
    """No reply came in time: no server on this bus, or a bus that drops everything."""


class OutOfDateError(NoServerError):
    """A mirror has not heard enough of the service, or not for longer than its limit: it knows no more than then."""


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
        ForbiddenError,
        RejectedError,
        ServerError,
    )
}


def error_for_status(status: int, message: str, nearest: Iterable[str] = ()) -> QueryError:
    """Return the error that a reply's `status` stands for."""
    return _BY_STATUS.get(status, ServerError)(message, nearest)
