"""Parts of messages between Python and wire: texts, numbers and their checks. The generated codec is made of them.

nan stands on the wire for what is None in Python. A check raises WireError `malformed`; data that end too early raise
WireError `truncated` or struct.error.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final, NamedTuple, TypeVar

from modelserver.errors import WireError, quote
from modelserver.messages import RelativePoseSample, SnapshotPart
from modelserver.transforms.so3 import Quaternion, Vector3

NAN3 = (math.nan,) * 3
NAN4 = (math.nan,) * 4
NAN9 = (math.nan,) * 9
NAN36 = (math.nan,) * 36

MAX_UTIME = 1 << 61
"""Times beyond are no times: sums and differences of them must not leave 64 bits."""

MAX_NAME = 64
"""Characters of the name of a source, a beacon, a state."""

MAX_FRAME_NAME = 401
"""Characters of a frame's full name: 200 on each side of the colon, as many as a geometry file may have."""

MAX_PAIRS: Final = 64
"""Pairs of frames in one GetTransformations."""

MAX_MESSAGE_INSTANTS: Final = 100_000
"""Instants of a batch in one message; the server takes far fewer."""

MAX_DECISIONS: Final = 1024
"""Decisions in one message; more go out in several."""

MAX_STATES: Final = 64
"""Error states of the filter, and numbers of one measurement."""

MAX_VALUES: Final = 16
"""Numbers of a measurement of an installed package."""

MAX_COORDINATES: Final = 100
"""Generalized coordinates in one reply: its mass matrix takes 40 kB."""

MAX_CONTACTS: Final = 16
"""Contacts with the ground in a health report."""

MAX_SNAPSHOT_PARTS: Final = 100_000

MAX_DISTANCE = 1e12
"""Meters; nothing on a vehicle or on earth is farther."""

MAX_ANGLE = math.pi
"""Radians; no rotation is by more, and a number of degrees mostly is."""

ROTATION_TOLERANCE = 1e-6
"""How far a rotation on the wire may be from one: it comes from computers, so more is damage."""

E = TypeVar("E", bound=IntEnum)
T = TypeVar("T")
V = TypeVar("V", bound=tuple[float, ...])


class Codec(NamedTuple):
    """A wire type, the value it becomes, and the functions between them, both without the fingerprint."""

    type_name: str
    fingerprint: bytes
    value: type
    pack: Callable[[Any], bytes]
    unpack: Callable[[bytes, int], tuple[Any, int]]


def read_known(values: V) -> V | None:
    """Return numbers, or None where one is nan."""
    for value in values:
        if value != value:
            return None
    return values


def read_partial(values: V) -> V | None:
    """Return numbers, or None where all are nan."""
    for value in values:
        if value == value:
            return values
    return None


def check_finite(values: Sequence[float], what: str) -> tuple[float, ...]:
    """Return numbers. Raises WireError where one is nan or infinite."""
    if not all(map(math.isfinite, values)):
        raise WireError("malformed", f"{what} has a number that is not finite")
    return tuple(values)


def check_position(values: Sequence[float], what: str) -> Vector3:
    """Return a place, meters. Raises WireError for one that is nowhere on earth."""
    x, y, z = values
    if not (abs(x) < MAX_DISTANCE and abs(y) < MAX_DISTANCE and abs(z) < MAX_DISTANCE):
        raise WireError("malformed", f"{what} {(x, y, z)} is no place")
    return (x, y, z)


def check_unit_quaternion(values: Sequence[float], what: str) -> Quaternion:
    """Return a rotation. Raises WireError where the numbers are no unit quaternion."""
    w, x, y, z = values
    # a nan fails the comparison
    if not abs(w * w + x * x + y * y + z * z - 1.0) <= ROTATION_TOLERANCE:
        raise WireError("malformed", f"{what} {(w, x, y, z)} is no unit quaternion")
    return (w, x, y, z)


def check_name(value: str, what: str, most: int = MAX_NAME) -> str:
    """Return a name. Raises WireError for an endless one."""
    if len(value) > most:
        raise WireError("malformed", f"{what} {quote(value, 40)} is longer than {most} characters")
    return value


def read_enum(kind: type[E], value: int, what: str) -> E:
    """Return the member of an enumeration. Raises WireError for a number it does not have."""
    found: E | None = _list_members(kind).get(value)
    if found is None:
        raise WireError("malformed", f"{what} {value} is not one of {[int(each) for each in kind]}")
    return found


@lru_cache(maxsize=256)
def _list_members(kind: type[IntEnum]) -> Mapping[int, Any]:
    """Return the members of an enumeration by number: a third of the cost of calling it."""
    return {int(each): each for each in kind}


def read_word(words: Sequence[str], value: int, what: str) -> str:
    """Return the word of a number. Raises WireError for a number that has none."""
    if not 0 <= value < len(words):
        raise WireError("malformed", f"{what} {value} is not one of 0 to {len(words) - 1}")
    return words[value]


def check_utime(value: int, what: str = "utime") -> int:
    """Return a time. Raises WireError for one that cannot be."""
    if not 0 <= value < MAX_UTIME:
        raise WireError("malformed", f"{what} {value} is no time in microseconds since 1970")
    return value


LENGTH = struct.Struct(">I")
"""Of a text, with the closing zero."""

COUNT = struct.Struct(">i")
"""Of the entries of an array."""

_read_length = LENGTH.unpack_from

_MAX_CACHED_LENGTH: Final = 200
"""Characters; longer texts come from strangers and are packed each time."""


def pack_text(value: str) -> bytes:
    """Return the bytes of a string: length with the closing zero, text, zero."""
    return _pack_text_cached(value) if len(value) <= _MAX_CACHED_LENGTH else _pack_text_uncached(value)


def _pack_text_uncached(value: str) -> bytes:
    raw = value.encode()
    return b"%b%b\0" % (LENGTH.pack(len(raw) + 1), raw)


_pack_text_cached = lru_cache(maxsize=4096)(_pack_text_uncached)
"""Names of frames, of channels, of revisions: single ones, never pairs. One that is not kept costs 0.3 us more."""


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """Return the string that begins at `at`, and where it ends. Raises WireError, struct.error."""
    (length,) = _read_length(data, at)
    end = at + 4 + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise WireError("truncated", f"{len(data)} bytes end within a text")
    return data[at + 4 : end - 1].decode("utf-8", "replace"), end


def check_end(data: bytes, end: int) -> None:
    """Raise WireError where a message does not end where its bytes do."""
    if end != len(data):
        raise WireError("malformed", f"{len(data) - end} bytes too many at the end of a message")


# --- arrays -------------------------------------------------------------------------------------------------


def check_count(count: int, what: str, most: int = 1 << 31, least: int = 0) -> None:
    """Raise WireError for a count outside its range."""
    if not least <= count <= most:
        raise WireError("malformed", f"{what} is {least} to {most}, got {count}")


def check_outgoing(count: int, most: int, what: str) -> None:
    """Raise ValueError for more entries than a message may have."""
    if count > most:
        raise ValueError(f"{what}: {count} entries in one message; at most {most} can be sent")


_MAX_CACHED_COUNT: Final = 256
"""Numbers; longer arrays are rare, and may come in any length."""


@lru_cache(maxsize=1024)
def _make_struct(code: str, count: int) -> struct.Struct:
    return struct.Struct(f">{count}{code}")


def read_numbers(code: str, data: bytes, at: int, count: int) -> tuple[tuple[Any, ...], int]:
    """Return `count` numbers of a struct code that begin at `at`, and their end. Raises struct.error."""
    if count <= _MAX_CACHED_COUNT:
        numbers = _make_struct(code, count)
        end = at + numbers.size
        if end <= len(data):
            return numbers.unpack_from(data, at), end
    end = at + count * struct.calcsize(code)
    if end > len(data):
        raise WireError("truncated", f"{len(data)} bytes end within {count} numbers")
    return struct.unpack_from(f">{count}{code}", data, at), end


def read_bytes(data: bytes, at: int, count: int) -> tuple[bytes, int]:
    """Return `count` bytes from `at` on, and their end. Raises WireError."""
    if at + count > len(data):
        raise WireError("truncated", f"{len(data)} bytes end within {count} bytes of payload")
    return data[at : at + count], at + count


def read_each(
    unpack: Callable[[bytes, int], tuple[T, int]], data: bytes, at: int, count: int
) -> tuple[tuple[T, ...], int]:
    """Return `count` values that begin at `at`, and their end. Raises what `unpack` raises."""
    found = []
    for _ in range(count):
        value, at = unpack(data, at)
        found.append(value)
    return tuple(found), at


def pack_numbers(code: str, values: Sequence[float], count: int | None = None) -> bytes:
    """Return the bytes of numbers of a struct code. Raises ValueError where they are not `count`, if that is given."""
    if count is not None and len(values) != count:
        raise ValueError(f"{len(values)} numbers where there should be {count}: inconsistent")
    return struct.pack(f">{len(values)}{code}", *values)


def pack_matrix(values: Sequence[float], n: int) -> bytes:
    """Return the bytes of an n by n matrix, row-major; nan where it is empty. Raises ValueError for another size."""
    return pack_numbers("d", values or (math.nan,) * (n * n), n * n)


def pack_triangle(values: Sequence[float], n: int) -> bytes:
    """Return the bytes of the lower triangle of an n by n matrix, row-major. Raises ValueError for another size."""
    if len(values) != n * n:
        raise ValueError(f"{len(values)} numbers are no {n} by {n} matrix: inconsistent")
    return pack_numbers("d", [value for row in range(n) for value in values[row * n : row * n + row + 1]])


def read_triangle(packed: Sequence[float], n: int) -> tuple[float, ...]:
    """Return the symmetric n by n matrix, row-major, of its lower triangle."""
    return tuple(
        packed[max(row, column) * (max(row, column) + 1) // 2 + min(row, column)]
        for row in range(n)
        for column in range(n)
    )


def skip_nothing(data: bytes, at: int, nothing: bytes) -> int:
    """Return the end of a reply without an answer. Raises WireError where it does not end as one does."""
    if data[at:] != nothing:
        raise WireError("truncated" if len(data) - at < len(nothing) else "malformed", "no answer, and yet some of one")
    return len(data)


# --- checks of single fields and of messages ----------------------------------------------------------------


def check_sample_utime(value: int, what: str) -> int:
    """Return the time of a sample. Raises WireError for none."""
    if value <= 0:
        raise WireError("malformed", f"{what} {value} is no time: a sample or command needs one")
    return check_utime(value, what)


def check_instants(values: Sequence[int], what: str) -> tuple[int, ...]:
    """Return times. Raises WireError where one cannot be."""
    if values:
        check_utime(min(values), what)
        check_utime(max(values), what)
    return tuple(values)


def check_not_negative(value: int, what: str) -> int:
    """Return a number that is not negative. Raises WireError for a negative one."""
    if value < 0:
        raise WireError("malformed", f"{what} {value} is negative")
    return value


def check_distance(value: float, what: str) -> float:
    """Return a distance, meters. Raises WireError for one that cannot be."""
    if not 0.0 <= value < MAX_DISTANCE:
        raise WireError("malformed", f"{what} {value} is no distance")
    return value


def check_demand(value: float, what: str, most: float = math.inf) -> float:
    """Return a number that a request asks for, 0 for nothing. Raises WireError where it is not in [0, most)."""
    if not 0.0 <= value < most:
        raise WireError("malformed", f"{what} {value:g} is not from 0 (not asked for) to less than {most:g}")
    return value


def check_positive(value: float, what: str) -> float:
    """Return a finite number above zero. Raises WireError for another."""
    if not (math.isfinite(value) and value > 0.0):
        raise WireError("malformed", f"{what} {value:g} is not positive and finite")
    return value


def check_number(value: float, what: str) -> float:
    """Return a finite number. Raises WireError for another."""
    if not math.isfinite(value):
        raise WireError("malformed", f"{what} {value} is not finite")
    return value


def verify_relative_pose(sample: RelativePoseSample) -> RelativePoseSample:
    """Return a sample whose earlier instant is before its own. Raises WireError."""
    if not 0 < sample.since_utime < sample.header.utime:
        raise WireError(
            "malformed", f"since_utime {sample.since_utime} is no time before the sample's own, {sample.header.utime}"
        )
    return sample


def verify_model_snapshot(part: SnapshotPart) -> SnapshotPart:
    """Return a part whose number is one of its parts. Raises WireError."""
    if not 0 <= part.part < part.parts <= MAX_SNAPSHOT_PARTS:
        raise WireError("malformed", f"part {part.part} of {part.parts} cannot be")
    return part
