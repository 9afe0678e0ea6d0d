"""Shared by the readers and writers of geometry files: numbers, rotations, names, cycles, XML, plausible values.

A rotation matrix R from a file is accepted if its largest deviation |R'R - I| is at most 0.05 and its determinant is
positive. It is replaced by the nearest rotation (`so3.nearest_rotation`), with a warning above 1e-3: three-decimal
rows, such as the 2005 report's 0.978 / 0.208, stay below. The same limits hold for the squared length of a quaternion.

Numbers that are possible but improbable, as in another unit, are warnings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar
from xml.sax import saxutils

import numpy as np

from modelserver.errors import Location, Severity, Suggestion, quote, suggest_key
from modelserver.geometry.builder import MAX_POSITION as MAX_POSITION
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.model import Model
from modelserver.geometry.parts import BodyFrame, Constraint
from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3

T = TypeVar("T")

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


class ElementReader:
    """Reads one element of a file, and reports its problems; `place` names it there, e.g. `body Raptor`."""

    def __init__(self, builder: ModelBuilder, file: str, line: int = 0, place: str = ""):
        self.builder = builder
        self.file = file
        self.line = line
        self.place = place

    def line_of(self, key: str) -> int:
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

    def select(
        self, entries: Sequence[tuple[str, T, int]], known: tuple[str, ...], noun: str, is_strict: bool = False
    ) -> dict[str, T]:
        """Return the first entry of each `known` name, from names, entries and lines; report the others.

        A second one is an error, an unknown name a warning. With `is_strict` it is an error too, and the entry of a
        misspelled name is at the name that is meant: it is examined, and not missing.
        """
        found: dict[str, T] = {}
        lines: dict[str, int] = {}
        for name, entry, line in entries:
            if name in lines:
                self.error(f"{noun} {name} is given twice (first on line {lines[name]})", "remove one of the two", line)
            elif name in known:
                found[name], lines[name] = entry, line
            else:
                # a name that is present already is not what was meant
                given = {each for each, _, _ in entries}
                near = suggest_known_key(name, tuple(each for each in known if each not in given))
                fix = f"write {near[0]}" if near else f"{noun}s here are {', '.join(known)}"
                what = f"unknown {noun} {quote(name)}" if name else f"a {noun} without a name"
                if is_strict:
                    self.error(what, fix, line, near)
                    if near:
                        found.setdefault(near[0], entry)
                else:
                    self.warning(f"{what}; ignored", fix, line, near)
        return found

    def read_row(self, texts: Sequence[str], count: int, key: str, fix: str, at: int | str = 0) -> list[float] | None:
        """Return `count` finite numbers; None, with an error, if they are not."""
        try:
            values = [parse_number(text, f"{key}: ") for text in texts]
            if len(values) == count:
                return values
            message = f"{key} has {len(values)} number{'' if len(values) == 1 else 's'}, not {count}"
        except ValueError as error:
            message = str(error)
        self.error(message, fix, at)
        return None

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
        R = np.array(rows)
        if np.array_equal(R, np.eye(3)):
            return so3.IDENTITY
        with np.errstate(over="ignore", invalid="ignore"):
            deviation = float(np.abs(R.T @ R - np.eye(3)).max())
        # a product that overflowed to nan must fail this test
        if not deviation <= MAX_DEVIATION:
            message = f"this is not a rotation: |R'R - I| is {deviation:.3g}, more than {MAX_DEVIATION:g}"
            fix = f"look for a wrong digit or sign in {where}: each row and column has length 1, at right angles"
            self.error(message, fix, line)
            return None
        if np.linalg.det(R) < 0.0:
            fix = f"turn the sign of one row or column in {where}; axes are right-handed"
            self.error(
                "this is a reflection, not a rotation (determinant -1): one axis points the wrong way", fix, line
            )
            return None
        if deviation < 1e-14:
            return so3.from_matrix(rows)
        matrix, deviation = so3.nearest_rotation(rows)
        if deviation > ROUNDING_DEVIATION:
            moved = float(np.abs(matrix - R).max())
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


@dataclass(frozen=True, slots=True)
class SavedModel:
    """The text of a file, and the features of the model that it does not hold, each as a phrase."""

    text: str
    unsupported: tuple[str, ...] = ()


def format_number(value: float) -> str:
    """Return the shortest text that reads back as the same float, without a trailing `.0`."""
    text = repr(value)
    return text[:-2] if text.endswith(".0") else text


def escape(value: str) -> str:
    return saxutils.escape(value, {'"': "&quot;"})


def format_element(
    tag: str, inside: Iterable[str] = (), comment: str = "", /, **attributes: str | float | Sequence[float]
) -> Iterator[str]:
    """Yield the lines of an XML element with the lines `inside`; a comment is written behind the start tag."""
    head = f"<{tag}"
    for key, value in attributes.items():
        if not isinstance(value, str):
            value = " ".join(map(format_number, [value] if isinstance(value, float) else value))
        head += f' {key}="{escape(value)}"'
    lines = [f"  {line}" for line in inside]
    if not lines:
        yield f"{head}/>"
        return
    yield f"{head}>" + (f" <!-- {comment} -->" if comment else "")
    yield from lines
    yield f"</{tag}>"


def format_names(names: list[str], limit: int = 5) -> str:
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def list_text_and_sigma_features(model: Model) -> Iterator[str]:
    """Yield how many descriptions and sigmas a format without them drops."""
    surveyed: list[BodyFrame | Constraint] = [frame for body in model.bodies for frame in body]
    surveyed += model.constraints
    texts = [model.description, *(each.description for each in model.bodies), *(each.description for each in surveyed)]
    if described := sum(map(bool, texts)):
        yield f"{described} descriptions"
    if sigmas := sum(each.sigma is not None for each in surveyed):
        yield f"{sigmas} sigmas"


def list_physical_features(model: Model) -> Iterator[str]:
    """Yield the inertias and shapes that the formats of Miro drop, and the joints that they write as fixed."""
    if heavy := [body.name for body in model.bodies if body.inertia is not None]:
        yield f"the inertia of {len(heavy)} bodies: {format_names(heavy)}"
    if model.joints:
        count = f"{len(model.joints)} joint{'' if len(model.joints) == 1 else 's'}"
        yield f"the motion of {count}, written as fixed at the default position: {format_names(list(model.joints))}"
    for what, bodies in (
        ("visuals", [body.name for body in model.bodies if body.visuals]),
        ("collisions", [body.name for body in model.bodies if body.collisions]),
    ):
        if bodies:
            yield f"the {what} of {len(bodies)} bod{'y' if len(bodies) == 1 else 'ies'}: {format_names(bodies)}"


FARTHEST: Final = 30.0
"""Meters from a body's origin, or along a constraint, that a part of a vehicle has at most."""

LARGEST_SIGMA: Final = 0.1
"""Standard deviation of a joint, rad, that a sensor of angles has at most: 6 deg."""

LARGEST_SURVEY_SIGMA: Final = 0.5
"""The same of how well a mount is known, rad: 29 deg."""

LARGEST_ANGLE: Final = math.tau + 0.01
"""Radians beyond which an angle was hardly written as such."""


def is_far(position: Iterable[float]) -> bool:
    return math.hypot(*position) > FARTHEST


def looks_like_radians(degrees: float) -> bool:
    """Return whether a number of degrees is a fraction of pi: multiples of 90 deg to two decimals, of 15 to three."""
    size = abs(degrees)
    for unit, decimals in ((math.pi / 2.0, 2), (math.pi / 12.0, 3)):
        count = round(size / unit)
        if 0 < count * unit <= 2.1 * math.pi and any(
            math.isclose(size, round(count * unit, digits), abs_tol=1e-9) for digits in range(decimals, 16)
        ):
            return True
    return False


def looks_like_degrees(radians: float) -> bool:
    """Return whether a number of radians is more than a turn, or a whole number of more than half a one."""
    return abs(radians) > LARGEST_ANGLE or (abs(radians) >= 4.0 and float(radians).is_integer())


ROUNDING = 1e-15
"""Greatest change of a quaternion by writing short angles."""

ANGLE_TOLERANCE = 1e-13
"""Greatest change of a quaternion by writing angles in degrees at full precision."""


def to_rpy_degrees(wxyz: Quaternion) -> Vector3 | None:
    """Return roll, pitch, yaw in degrees that read back as the quaternion, None if the error exceeds the tolerance.

    Rounding errors are removed: -10 rather than -10.000000000000002.
    """
    roll, pitch, yaw = (math.degrees(angle) for angle in so3.to_rpy(wxyz))
    short = (_round_off(roll), _round_off(pitch), _round_off(yaw))
    if _quaternion_error(short, wxyz) <= ROUNDING:
        return short
    full = (roll, pitch, yaw)
    return full if _quaternion_error(full, wxyz) <= ANGLE_TOLERANCE else None


def _round_off(angle: float) -> float:
    rounded = round(angle, 9)
    # + 0.0 turns a negative zero into zero
    return (rounded if abs(angle - rounded) < 1e-12 else angle) + 0.0


def _quaternion_error(degrees: Vector3, wxyz: Quaternion) -> float:
    roll, pitch, yaw = (math.radians(angle) for angle in degrees)
    back = so3.from_rpy(roll, pitch, yaw)
    same = max(abs(a - b) for a, b in zip(back, wxyz, strict=True))
    # a half turn has two quaternions, of opposite sign, and rounding may yield either
    return min(same, max(abs(a + b) for a, b in zip(back, wxyz, strict=True)))
