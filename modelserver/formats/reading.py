"""Shared by the readers of geometry files: numbers, rotations, names, and cycles of references.

A rotation matrix R from a file is accepted if its largest deviation |R'R - I| is at most 0.05 and its determinant is
positive. It is replaced by the nearest rotation (`so3.nearest_rotation`), with a warning above 1e-3: three-decimal
rows, such as the 2005 report's 0.978 / 0.208, stay below. The same limits hold for the squared length of a quaternion.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache

import numpy as np

from modelserver.errors import Location, Severity, Suggestion, quote, suggest_key
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.plausibility import is_far
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion

ORIGIN = "Origin"
"""Frame of a body for a frame, instance or link of a format without frames in bodies."""

MAX_SUGGESTIONS = 50
"""Unknown names of a file for which suggestions are searched."""


def find_cycles(names: Iterable[str], get_parent: Callable[[str], str | None]) -> Iterator[list[str]]:
    """Yield each cycle of `get_parent`, with its first name again at the end; a long one is truncated."""
    done: set[str] = set()
    for start in names:
        path: dict[str, None] = {}
        here: str | None = start
        while here is not None and here not in done and here not in path:
            path[here] = None
            here = get_parent(here)
        if here is not None and here in path:
            line = list(path)
            cycle = line[line.index(here) :]
            yield [*(cycle if len(cycle) <= 8 else [*cycle[:7], "..."]), here]
        done.update(path)


ROUNDING_DEVIATION = 1e-3
"""Greatest |R'R - I| that is repaired without a warning."""

MAX_DEVIATION = 0.05
"""Rotations with a greater |R'R - I| are rejected: that is a mistake, not rounding."""

MAX_POSITION = 1e9
"""Greatest coordinate, meters: beyond it the rounding of sums exceeds a micrometer."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def parse_number(text: str, where: str = "") -> float:
    """Return the finite number in a text. Raises ValueError, whose message begins with `where`."""
    if _NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value):
            return value
        raise ValueError(f"{where}{quote(text, 40)} is too large for a number")
    if text.lower().lstrip("+-.") in ("nan", "inf", "infinity"):
        raise ValueError(f"{where}{quote(text, 40)} is not a finite number")
    if "," in text:
        raise ValueError(f"{where}{quote(text, 40)} is not a number (decimals take a point, and spaces divide numbers)")
    raise ValueError(f"{where}{quote(text, 40)} is not a number")


def parse_numbers(texts: Sequence[str], count: int, key: str) -> list[float]:
    """Return `count` finite numbers. Raises ValueError, whose message begins with `key`."""
    values = [parse_number(text, f"{key}: ") for text in texts]
    if len(values) != count:
        raise ValueError(f"{key} has {len(values)} number{'' if len(values) == 1 else 's'}, not {count}")
    return values


class SyntaxProblemError(Exception):
    """A file cannot be parsed; with the line, and the fix."""

    def __init__(self, message: str, line: int, fix: str):
        super().__init__(message)
        self.line = line
        self.fix = fix


class ElementReader:
    """Reads one element of a file, and reports its problems; `place` names it there, e.g. `body Raptor`."""

    def __init__(self, builder: ModelBuilder, file: str, line: int = 0, place: str = ""):
        self.builder = builder
        self.file = file
        self.line = line
        self.place = place

    def line_of(self, key: str) -> int:
        """Return the line of a named value; 0 if it is absent."""
        return 0

    def locate(self, at: int | str = 0) -> Location:
        """Return the location of a line, or of a named value; by default of the element's first line."""
        return Location(self.file, (self.line_of(at) if isinstance(at, str) else at) or self.line, self.place)

    def error(self, message: str, fix: str, at: int | str = 0, nearest: tuple[str, ...] = ()) -> None:
        """Report an error at a line or a named value, by default at the element's first line."""
        self.builder.add_error(message, self.locate(at), fix, nearest)

    def warning(self, message: str, fix: str, at: int | str = 0, nearest: tuple[str, ...] = ()) -> None:
        self.builder.add_warning(message, self.locate(at), fix, nearest)

    def note(self, message: str, fix: str = "", at: int | str = 0) -> None:
        self.builder.add_problem(Severity.NOTE, message, self.locate(at), fix)

    def check_position(self, position: Sequence[float], line: int = 0) -> bool:
        """Return whether each coordinate is at most `MAX_POSITION`; otherwise report an error."""
        if all(abs(value) <= MAX_POSITION for value in position):
            if is_far(position):
                far = math.hypot(*position)
                self.warning(
                    f"{far:g} m from where it is measured looks like millimeters",
                    f"positions are in meters; {far / 1000.0:g} m?",
                    line,
                )
            return True
        message = f"the position {max(position, key=abs):g} m is out of reach; the limit is {MAX_POSITION:g} m"
        self.error(message, "positions are in meters; look for a slip in the exponent", line)
        return False

    def repair_rotation(self, rows: Sequence[Sequence[float]], where: str, line: int = 0) -> Quaternion | None:
        """Return the rotation nearest to three rows of three numbers; None, with an error, if they are not a rotation.

        `where` names the rows for the fix, e.g. `Row1 to Row3`.
        """
        (a, b, c), (d, e, f), (g, h, i) = rows
        if (a, b, c, d, e, f, g, h, i) == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0):
            return so3.IDENTITY
        products = (
            a * a + d * d + g * g - 1.0,
            b * b + e * e + h * h - 1.0,
            c * c + f * f + i * i - 1.0,
            a * b + d * e + g * h,
            a * c + d * f + g * i,
            b * c + e * f + h * i,
        )
        # a product that overflowed to nan must fail this test
        if not all(abs(value) <= MAX_DEVIATION for value in products):
            worst = max((abs(value) for value in products), key=lambda value: math.inf if math.isnan(value) else value)
            message = f"this is not a rotation: |R'R - I| is {worst:.3g}, more than {MAX_DEVIATION:g}"
            fix = f"look for a wrong digit or sign in {where}: each row and column has length 1, at right angles"
            self.error(message, fix, line)
            return None
        if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
            fix = f"turn the sign of one row or column in {where}; axes are right-handed"
            self.error(
                "this is a reflection, not a rotation (determinant -1): one axis points the wrong way", fix, line
            )
            return None
        deviation = max(abs(value) for value in products)
        if deviation < 1e-14:
            return so3.from_matrix(rows)
        matrix, deviation = so3.nearest_rotation(rows)
        if deviation > ROUNDING_DEVIATION:
            moved = float(np.abs(matrix - np.asarray(rows)).max())
            self.warning(
                f"this is not quite a rotation: |R'R - I| is {deviation:.2g}, more than {ROUNDING_DEVIATION:g}; "
                f"replaced by the nearest one, entries changed by up to {moved:.2g}",
                f"write {where} with more digits, or look for a slip in one of them",
                line,
            )
        return so3.from_matrix(matrix)

    def repair_quaternion(self, wxyz: Sequence[float], line: int = 0) -> Quaternion | None:
        """Return four numbers, w first, as a unit quaternion; None, with an error, if their length is not about 1."""
        w, x, y, z = wxyz
        length, deviation = math.hypot(w, x, y, z), abs(w * w + x * x + y * y + z * z - 1.0)
        if not deviation <= MAX_DEVIATION:
            fix = "write w, x, y, z of a unit quaternion, w first"
            self.error(f"the quaternion has length {length:.4g}, not 1", fix, line)
            return None
        if deviation > ROUNDING_DEVIATION:
            fix = "write it with more digits, or look for a slip in one of them"
            self.warning(f"the quaternion has length {length:.6g}, not 1; normalized", fix, line)
        return so3.normalize((w, x, y, z))


def label(name: str) -> str:
    """Return a name for the place of a problem; escaped, quoted and truncated if it is not printable or too long."""
    return name if name.isprintable() and 0 < len(name) <= 80 else quote(name)


@lru_cache(maxsize=1024)
def suggest_known_key(name: str, known: tuple[str, ...]) -> Suggestion:
    """Return `suggest_key`, cached: a file tends to misspell a key the same way a thousand times."""
    return suggest_key(name, known)
