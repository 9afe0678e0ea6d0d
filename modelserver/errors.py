"""Exceptions, problems of files, and suggestions for misspelled names.

A message states what is wrong, where, what was expected, and what to do. `Problem` is one finding in a file;
ConfigError and GeometryError hold all of them. A QueryError has a `Status`, the wire's code, from which the client
raises the same class again.

Suggestions have two strengths, both by difflib's ratio, 2 M / (a + b) for M equal characters. `find_nearest_names`
lists similar names for a person (at least `MIN_RATIO`). `find_suggestion` returns the one name that is meant, or none:
of the longer of the two names at most one character is not equal for names of up to six characters, else two, and the
nearest name is unique. Names come from strangers too, so the cost is bounded: from many known names those that share
the most bigrams with the wanted one are compared.
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
    OVERLOADED = 8
    LIMIT = 9
    INTERNAL = 10
    FORBIDDEN = 11
    REJECTED = 12


class Severity(StrEnum):
    """Severity of a problem in a file."""

    ERROR = "error"
    """Loading raises; a running service retains its old model, a new one does not start."""
    WARNING = "warning"
    """The file loads; `modelserver check` lists the problem and exits with 1."""
    NOTE = "note"
    """For information; does not change the exit code."""


@dataclass(frozen=True, slots=True)
class Location:
    """The place in a file from which a value was read."""

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

        Raises ValueError if the occurrence is ambiguous: `old` is not exactly once, as a whole word, on the line, or
        else in the file.
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
        raise ValueError(f"{quote(self.old)} on line {self.line} is ambiguous")


class Suggestion(tuple[str, ...]):
    """Names suggested in place of a misspelled one, `replaced`; an argument of `Problem`."""

    replaced = ""

    @classmethod
    def of(cls, replaced: str, *names: str) -> Suggestion:
        found = cls(name for name in names if name)
        found.replaced = replaced
        return found


@dataclass(frozen=True, slots=True)
class Problem:
    """One finding in a file: what is wrong, where, and the fix.

    `nearest` holds the known names closest to a misspelled one, best first. `replaced` is the misspelled name in the
    file if the first of `nearest` is certain to be meant (`find_suggestion`), else empty.
    """

    severity: Severity
    message: str
    source: Location = Location()
    fix: str = ""
    nearest: tuple[str, ...] = ()
    replaced: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.nearest, Suggestion):
            # stored as plain values: a problem is compared and encoded
            object.__setattr__(self, "replaced", self.nearest.replaced if self.nearest else "")
            object.__setattr__(self, "nearest", tuple(self.nearest))

    @property
    def edit(self) -> Edit | None:
        """The change of the file that fixes the problem; None without a certain one."""
        return Edit(self.line, self.replaced, self.nearest[0]) if self.replaced and self.nearest else None

    @property
    def file(self) -> str:
        """Path of the file, empty for a model built in a program."""
        return self.source.file

    @property
    def line(self) -> int:
        """Line in the file, counted from 1; 0 if unknown."""
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


def has_error(problems: Iterable[Problem]) -> bool:
    return any(each.severity is Severity.ERROR for each in problems)


MIN_RATIO = 0.6
"""Names with a lower ratio are not similar."""

MAX_KNOWN_NAMES = 20_000
MAX_COMPARED_LENGTH = 100
MAX_COMPARED_NAMES = 16
MAX_COMPARED_PAIRS = 12
"""Bounds of the search: known names, length of a name, names compared in full, bigrams of the wanted name."""


def find_nearest_names(name: str, known: Iterable[str], count: int = 3) -> tuple[str, ...]:
    """Return the known names most similar to `name`, best first, without regard to case.

    Names longer than 100 characters are not compared. 10,000 known names take about 10 ms.
    """
    return tuple(each for _, each in _rank_names(name, known)[:count])


def _rank_names(name: str, known: Iterable[str]) -> list[tuple[float, str]]:
    """Return the similar known names, best first, each after its ratio."""
    if not name or len(name) > MAX_COMPARED_LENGTH:
        return []
    # names that differ more than this in length cannot reach the ratio
    shortest, longest = len(name) * MIN_RATIO / (2.0 - MIN_RATIO), len(name) * (2.0 - MIN_RATIO) / MIN_RATIO
    candidates = [each for each in dict.fromkeys(islice(known, MAX_KNOWN_NAMES)) if shortest <= len(each) <= longest]
    wanted = name.casefold()
    if len(candidates) > MAX_COMPARED_NAMES:
        candidates = _select_by_bigrams(wanted, candidates)
    matcher = difflib.SequenceMatcher(b=wanted)
    found = []
    for each in candidates:
        matcher.set_seq1(each.casefold())
        if matcher.quick_ratio() >= MIN_RATIO and (ratio := matcher.ratio()) >= MIN_RATIO:
            found.append((ratio, each))
    return sorted(found, reverse=True)


def _select_by_bigrams(wanted: str, candidates: list[str]) -> list[str]:
    """Return the candidates with the most bigrams of `wanted`, whatever their case; of equals, those nearest in length.

    The loops over the candidates run in C.
    """
    pairs = list(dict.fromkeys(wanted[i : i + 2] for i in range(max(1, len(wanted) - 1))))
    # spread evenly over a long name
    pairs = pairs[:: -(-len(pairs) // MAX_COMPARED_PAIRS)]
    folded = list(map(str.casefold, candidates))
    shared = map(sum, zip(*(map(operator.contains, folded, repeat(pair)) for pair in pairs), strict=True))
    lengths = map(abs, map(operator.sub, map(len, folded), repeat(len(wanted))))
    ranked = zip(map(operator.neg, shared), lengths, range(len(folded)), strict=True)
    return [candidates[index] for _, _, index in heapq.nsmallest(MAX_COMPARED_NAMES, ranked)]


_WORD = re.compile(r"\d+|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W\d_]+")
"""The words of a name: `UtmGrid10S` has Utm, Grid, 10, S."""


def find_suggestion(name: str, known: Iterable[str], *, is_family: bool = True) -> str:
    """Return the known name of which `name` is a misspelling, without regard to case; empty if that is ambiguous.

    With `is_family`, numbers and single letters must be equal: they distinguish the members of a family (`Wheel1`,
    `CameraL`, `UtmGrid10S`), and another member is another thing.
    """
    most = (len(name) > 2) + (len(name) > 6)
    counts = (
        (max(len(each), len(name)) - round(0.5 * ratio * (len(each) + len(name))), each)
        for ratio, each in _rank_names(name, known)
    )
    found = sorted(each for each in counts if each[0] <= most)
    if not found or (len(found) > 1 and found[0][0] == found[1][0]):
        return ""
    best = found[0][1]
    return best if not is_family or _find_codes(best) == _find_codes(name) else ""


def suggest_name(name: str, known: Iterable[str]) -> Suggestion:
    """Return `find_suggestion` as an argument of a problem: no name, or one."""
    return Suggestion.of(name, find_suggestion(name, known))


def suggest_key(key: str, known: Iterable[str]) -> Suggestion:
    """Return the key of a schema that `key` misspells, or lacks the unit of (`rate` for `rate_hz`): none, or one."""
    known = list(known)
    longer = [each for each in known if each.startswith(f"{key}_")] if key else []
    return Suggestion.of(key, longer[0] if len(longer) == 1 else find_suggestion(key, known, is_family=False))


def _find_codes(name: str) -> list[str]:
    """Return the numbers and single letters among the words of a name."""
    words = [word.casefold() for word in _WORD.findall(name)]
    return [word for word in words if len(word) == 1 or word.isdecimal()]


def quote(name: str, limit: int = 80) -> str:
    """Return `name` for a message: escaped, quoted, and truncated."""
    if len(name) > limit:
        return f"{name[:limit]!r}... ({len(name)} characters)"
    return repr(name)


class ModelServerError(Exception):
    """Base of the exceptions that this package raises."""


class KeyFileError(ModelServerError):
    """A file of keys for signed commands cannot be used."""


class FrameMismatchError(ModelServerError, ValueError):
    """The adjacent frames of two multiplied transformations differ."""


class SyntaxProblemError(Exception):
    """A file cannot be parsed; with the line, and the fix."""

    def __init__(self, message: str, line: int, fix: str):
        super().__init__(message)
        self.line = line
        self.fix = fix


class ProblemsError(ModelServerError):
    """A file breaks rules. `problems` lists every finding; the message, those of `LISTED` severities."""

    LISTED: frozenset[Severity] = frozenset(Severity)

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(problems)
        super().__init__("\n".join(str(each) for each in self.problems if each.severity in self.LISTED))

    def __reduce__(self) -> tuple[Callable[..., ProblemsError], tuple[object, ...]]:
        return type(self), (self.problems,)


class ConfigError(ProblemsError):
    """A configuration file is wrong. `problems` lists every finding."""


class GeometryError(ProblemsError):
    """A geometry file, or a model built in a program, breaks a rule. `problems` lists every finding."""

    LISTED = frozenset({Severity.ERROR})


class WireError(ModelServerError, ValueError):
    """Bytes from the bus are not a message of the channel's type. `reason` is one word."""

    def __init__(self, reason: str, message: str):
        self.reason = reason
        super().__init__(message)

    def __reduce__(self) -> tuple[Callable[..., WireError], tuple[object, ...]]:
        return type(self), (self.reason, str(self))


class QueryError(ModelServerError):
    """A query that cannot be answered; `status` is the code in the reply on the bus.

    `nearest` holds known names close to a misspelled one.
    """

    status = Status.INTERNAL
    by_status: dict[int, type[QueryError]] = {}  # noqa: RUF012 - filled by the subclasses

    def __init__(self, message: str, nearest: Iterable[str] = ()):
        self.nearest = tuple(nearest)
        super().__init__(message)

    def __init_subclass__(cls, status: Status = Status.INTERNAL) -> None:
        cls.status = status
        cls.by_status.setdefault(status, cls)


class UnknownBodyError(QueryError, LookupError, status=Status.UNKNOWN_BODY):
    """The model has no body of this name."""


class UnknownFrameError(QueryError, LookupError, status=Status.UNKNOWN_FRAME):
    """The body has no frame of this name, or the name is not of the form Body:Frame."""


class NotConnectedError(QueryError, status=Status.NOT_CONNECTED):
    """No chain of constraints connects the two frames."""


class NoPoseError(QueryError, status=Status.NO_POSE):
    """A world frame was queried before the vehicle's pose is known."""


class TooOldError(QueryError, status=Status.TOO_OLD):
    """The queried time is before the stored history."""


class TooNewError(QueryError, status=Status.TOO_NEW):
    """The queried time is after the newest data, and the policy does not allow prediction."""


class MalformedRequestError(QueryError, ValueError, status=Status.MALFORMED):
    """The request is invalid: an unknown policy, a negative wait, a range that ends before it starts."""


class OverloadedError(QueryError, status=Status.OVERLOADED):
    """The server is overloaded and dropped the request; retry later."""


class LimitError(QueryError, status=Status.LIMIT):
    """The request exceeds a limit, which the message names."""


class ForbiddenError(QueryError, status=Status.FORBIDDEN):
    """The vehicle file does not permit the command; the message names the setting."""


class RejectedError(QueryError, status=Status.REJECTED):
    """The command was examined and rejected, e.g. an unsuitable geometry or an impossible pose; nothing has changed."""


class ServerError(QueryError, status=Status.INTERNAL):
    """The server failed on its side; its log holds the cause."""


class BusError(ModelServerError):
    """The message bus cannot be joined."""


class RecordingError(ModelServerError):
    """A file is not a recording, or cannot be read."""


class NoServerError(ModelServerError, TimeoutError):
    """No reply before the timeout: there is no server on this bus, or the bus drops everything."""


class OutOfDateError(NoServerError):
    """A mirror has not received the messages it needs, or none within its timeout."""


def make_status_error(status: int, message: str, nearest: Iterable[str] = ()) -> QueryError:
    return QueryError.by_status.get(status, ServerError)(message, nearest)
