"""Fields between Python and wire: nan stands on the wire for what Python says with None."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import TypeVar

from modelserver.errors import WireError, shown
from modelserver.messages import Matrix3, Policy, SensorHeader, TimeQuery
from modelserver.spatial.so3 import Quaternion, Vector3
from mslcm.sensor_header_t import sensor_header_t

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

FAR = 1e12
"""Metres; nothing on a vehicle or on earth is farther."""

TOLERANCE = 1e-6
"""How far a rotation on the wire may be from one: it comes from computers, so more is damage."""

E = TypeVar("E", bound=IntEnum)


def vector3(values: Sequence[float]) -> Vector3 | None:
    """Return three numbers, or None where one is nan."""
    x, y, z = values
    return None if x != x or y != y or z != z else (x, y, z)


def quaternion(values: Sequence[float]) -> Quaternion | None:
    """Return four numbers, or None where one is nan."""
    w, x, y, z = values
    return None if w != w or x != x or y != y or z != z else (w, x, y, z)


def matrix3(values: Sequence[float]) -> Matrix3 | None:
    """Return nine numbers, or None where one is nan."""
    a, b, c, d, e, f, g, h, i = values
    total = a + b + c + d + e + f + g + h + i
    return None if total != total and any(value != value for value in values) else (a, b, c, d, e, f, g, h, i)


def finite(values: Sequence[float], what: str) -> tuple[float, ...]:
    """Return numbers. Raises WireError where one is nan or infinite."""
    if not all(map(math.isfinite, values)):
        raise WireError("malformed", f"{what} has a number that is not finite")
    return tuple(values)


def finite_vector3(values: Sequence[float], what: str) -> Vector3:
    """Return a place, metres. Raises WireError for one that is nowhere on earth."""
    x, y, z = values
    if not (abs(x) < FAR and abs(y) < FAR and abs(z) < FAR):
        raise WireError("malformed", f"{what} {(x, y, z)} is no place")
    return (x, y, z)


def unit_quaternion(values: Sequence[float], what: str) -> Quaternion:
    """Return a rotation. Raises WireError where the numbers are no unit quaternion."""
    w, x, y, z = values
    # a nan fails the comparison
    if not abs(w * w + x * x + y * y + z * z - 1.0) <= TOLERANCE:
        raise WireError("malformed", f"{what} {(w, x, y, z)} is no unit quaternion")
    return (w, x, y, z)


def name(value: str, what: str) -> str:
    """Return a name. Raises WireError for an endless one."""
    if len(value) > MAX_NAME:
        raise WireError("malformed", f"{what} {shown(value, 40)} is longer than {MAX_NAME} characters")
    return value


def frame_name(value: str, what: str) -> str:
    """Return the full name of a frame. Raises WireError for an endless one."""
    if len(value) > MAX_FRAME_NAME:
        raise WireError("malformed", f"{what} {shown(value, 40)} is longer than {MAX_FRAME_NAME} characters")
    return value


def member(kind: type[E], value: int, what: str) -> E:
    """Return the member of an enumeration. Raises WireError for a number it does not have."""
    try:
        return kind(value)
    except ValueError:
        raise WireError("malformed", f"{what} {value} is not one of {[int(each) for each in kind]}") from None


def checked_count(count: int, found: Sequence[object], what: str) -> None:
    """Raise WireError where an array has not as many entries as it says: a negative count is read as none."""
    if count != len(found):
        raise WireError("malformed", f"{what} {count} cannot be")


def checked_utime(value: int, what: str = "utime") -> int:
    """Return a time. Raises WireError for one that cannot be."""
    if not 0 <= value < MAX_UTIME:
        raise WireError("malformed", f"{what} {value} is no time in microseconds since 1970")
    return value


def sensor_header(header: sensor_header_t) -> SensorHeader:
    """Return the header of a sample. Raises WireError for a sample without time or with an endless source name."""
    if header.utime <= 0:
        raise WireError("malformed", f"a sample needs utime, got {header.utime}")
    return SensorHeader(
        checked_utime(header.utime),
        name(header.source, "source"),
        header.seq,
        checked_utime(header.host_utime, "host_utime"),
        header.device_utime,
        header.utime_sigma,
    )


def wire_sensor_header(header: SensorHeader) -> sensor_header_t:
    """Return the header as the wire has it."""
    message = sensor_header_t()
    message.utime = header.utime
    message.utime_sigma = header.utime_sigma
    message.host_utime = header.host_utime
    message.device_utime = header.device_utime
    message.seq = header.seq
    message.source = header.source
    return message


_NOW = TimeQuery()


def time_query(at: int, policy: int, wait_ms: int) -> TimeQuery:
    """Return what time a request means. Raises WireError for a time, policy or wait that cannot be."""
    if not at and not policy and not wait_ms:
        return _NOW
    if wait_ms < 0:
        raise WireError("malformed", f"wait_ms {wait_ms} is negative")
    return TimeQuery(checked_utime(at, "at"), member(Policy, policy, "policy"), wait_ms)
