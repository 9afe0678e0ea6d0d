"""Parts of messages between Python and wire: texts, numbers, poses, and their checks; the generated codec uses them.

nan stands on the wire for what is None in Python. A check returns its value, or raises WireError `malformed`; data that
end too early raise WireError `truncated` or struct.error. `pack_*` return bytes without the fingerprint, `unpack_*` and
`read_*` the value that begins at `at` and where it ends, `skip_*` only that. The values of pose_transform_t and
pose_vector_t are transformations. The arrays of get_transformations_reply_t are on the wire as they are in memory.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from functools import lru_cache, partial
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status, WireError, quote
from modelserver.messages import (
    NO_FLAGS,
    Origin,
    PoseAnswer,
    PoseBatch,
    PoseBatchReply,
    Quality,
    RelativePoseSample,
    ReplyHeader,
    SnapshotPart,
)
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Quaternion, Vector3
from modelserver.transforms.transformation import Transformation

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
    if len(value) > most:
        raise WireError("malformed", f"{what} {quote(value, 40)} is longer than {most} characters")
    return value


def read_enum(kind: type[E], value: int, what: str) -> E:
    found: E | None = _list_members(kind).get(value)
    if found is None:
        raise WireError("malformed", f"{what} {value} is not one of {[int(each) for each in kind]}")
    return found


@lru_cache(maxsize=256)
def _list_members(kind: type[IntEnum]) -> Mapping[int, Any]:
    """Return the members of an enumeration by number: a third of the cost of calling it."""
    return {int(each): each for each in kind}


def read_word(words: Sequence[str], value: int, what: str) -> str:
    if not 0 <= value < len(words):
        raise WireError("malformed", f"{what} {value} is not one of 0 to {len(words) - 1}")
    return words[value]


def check_utime(value: int, what: str = "utime") -> int:
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
    if end != len(data):
        raise WireError("malformed", f"{len(data) - end} bytes too many at the end of a message")


# --- arrays -------------------------------------------------------------------------------------------------


def check_count(count: int, what: str, most: int = 1 << 31, least: int = 0) -> None:
    if not least <= count <= most:
        raise WireError("malformed", f"{what} is {least} to {most}, got {count}")


def check_outgoing(count: int, most: int, what: str) -> None:
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
    if value <= 0:
        raise WireError("malformed", f"{what} {value} is no time: a sample or command needs one")
    return check_utime(value, what)


def check_instants(values: Sequence[int], what: str) -> tuple[int, ...]:
    if values:
        check_utime(min(values), what)
        check_utime(max(values), what)
    return tuple(values)


def check_not_negative(value: int, what: str) -> int:
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
    if not (math.isfinite(value) and value > 0.0):
        raise WireError("malformed", f"{what} {value:g} is not positive and finite")
    return value


def check_number(value: float, what: str) -> float:
    if not math.isfinite(value):
        raise WireError("malformed", f"{what} {value} is not finite")
    return value


def verify_relative_pose(sample: RelativePoseSample) -> RelativePoseSample:
    if not 0 < sample.since_utime < sample.header.utime:
        raise WireError(
            "malformed", f"since_utime {sample.since_utime} is no time before the sample's own, {sample.header.utime}"
        )
    return sample


def verify_model_snapshot(part: SnapshotPart) -> SnapshotPart:
    if not 0 <= part.part < part.parts <= MAX_SNAPSHOT_PARTS:
        raise WireError("malformed", f"part {part.part} of {part.parts} cannot be")
    return part


# --- poses, and replies to batches ------------------------------------------------------------------------------------

_REPLY_HEAD = struct.Struct(">qqh")
UTIME = struct.Struct(">q")
_MATRIX = struct.Struct(">16d")
_STATE_VECTOR = struct.Struct(">7d")
_NUMBERS = struct.Struct(">36d")
# initial_utm, zone, north, origin id, epoch, valid, reasons, flags, bounds and seconds
_REST_FORMAT: Final = "3dbbqibii7d"
_REST = struct.Struct(f">{_REST_FORMAT}")
# all of these in one: of the covariance only the first number, nan where there is none
_TRANSFORM = struct.Struct(f">16dd280x{_REST_FORMAT}")
_VECTOR = struct.Struct(f">7dd280x{_REST_FORMAT}")
PLAIN: Final = pack_text("") + LENGTH.pack(0)
"""The part of a reply's header that is the same in each reply with an answer: no message, no nearest names."""

NO_PLACE: Final = (*NAN3, 0, False)
"""Of no origin: initial_utm, zone, north."""

_NAN_COVARIANCE: Final = _NUMBERS.pack(*NAN36)

_POSE_HEAD: Final = bytes(8) + 2 * pack_text("")
_POSE_END: Final = bytes(_NUMBERS.size + _REST.size) + pack_text("")
NO_POSE_TRANSFORM: Final = _POSE_HEAD + bytes(_MATRIX.size) + _POSE_END
NO_POSE_VECTOR: Final = _POSE_HEAD + bytes(_STATE_VECTOR.size) + _POSE_END
"""What stands in a reply that carries no pose."""


def pack_pose_transform(answer: PoseAnswer) -> bytes:
    pose = answer.transformation.pose
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(pose._q)
    x, y, z = pose._p
    return _pack_pose(_MATRIX.pack(a, b, c, x, d, e, f, y, g, h, i, z, 0.0, 0.0, 0.0, 1.0), answer)


def pack_pose_vector(answer: PoseAnswer) -> bytes:
    pose = answer.transformation.pose
    return _pack_pose(_STATE_VECTOR.pack(*pose._p, *pose._q), answer)


def unpack_pose_transform(data: bytes, at: int) -> tuple[PoseAnswer, int]:
    utime, interest, reference, at = _read_pose_head(data, at)
    return read_transform_numbers(data, at, utime, interest, reference)


def read_transform_numbers(data: bytes, at: int, utime: int, interest: str, reference: str) -> tuple[PoseAnswer, int]:
    """Return the pose whose time and names end at `at`, and where it ends. Raises WireError, struct.error."""
    a, b, c, x, d, e, f, y, g, h, i, z, zero_a, zero_b, zero_c, one, *rest = _TRANSFORM.unpack_from(data, at)
    if zero_a or zero_b or zero_c or one != 1.0:
        last = [zero_a, zero_b, zero_c, one]
        raise WireError("malformed", f"the last row of a homogeneous transform is 0 0 0 1, got {last}")
    # rows of length 1 and at right angles, right-handed, and all of it finite: a nan fails every comparison
    if not (
        abs(a * a + b * b + c * c - 1.0) <= ROTATION_TOLERANCE
        and abs(d * d + e * e + f * f - 1.0) <= ROTATION_TOLERANCE
        and abs(g * g + h * h + i * i - 1.0) <= ROTATION_TOLERANCE
        and abs(a * d + b * e + c * f) <= ROTATION_TOLERANCE
        and abs(a * g + b * h + c * i) <= ROTATION_TOLERANCE
        and abs(d * g + e * h + f * i) <= ROTATION_TOLERANCE
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
        and abs(x) < MAX_DISTANCE
        and abs(y) < MAX_DISTANCE
        and abs(z) < MAX_DISTANCE
    ):
        raise WireError("malformed", f"{((a, b, c), (d, e, f), (g, h, i))} with {(x, y, z)} is no rigid transform")
    pose = Pose._of((x, y, z), so3.from_rows(((a, b, c), (d, e, f), (g, h, i))))
    return _make_answer(data, at + _MATRIX.size, utime, interest, reference, pose, rest)


def unpack_pose_vector(data: bytes, at: int) -> tuple[PoseAnswer, int]:
    utime, interest, reference, at = _read_pose_head(data, at)
    x, y, z, *rest = _VECTOR.unpack_from(data, at)
    q, rest = rest[:4], rest[4:]
    if not abs(sum(value * value for value in q) - 1.0) <= ROTATION_TOLERANCE:
        raise WireError("malformed", f"{tuple(q)} is no unit quaternion")
    try:
        pose = Pose((x, y, z), q)
    except ValueError as error:
        raise WireError("malformed", str(error)) from None
    return _make_answer(data, at + _STATE_VECTOR.size, utime, interest, reference, pose, rest)


def _pack_pose(pose: bytes, answer: PoseAnswer) -> bytes:
    transformation, origin, quality, *bounds = answer[:-2]
    covariance = transformation.covariance_numbers
    invalid = transformation.invalid_reasons
    place = NO_PLACE if origin is None else (origin.easting, origin.northing, origin.height, origin.zone, origin.north)
    return b"%b%b%b%b%b%b%b" % (
        UTIME.pack(transformation.utime),
        pack_text(transformation.frame_of_interest),
        pack_text(transformation.frame_of_reference),
        pose,
        _NAN_COVARIANCE if covariance is None else _NUMBERS.pack(*covariance),
        _REST.pack(
            *place,
            transformation.origin_id,
            transformation.pose_epoch,
            not invalid,
            invalid,
            quality,
            *bounds,
        ),
        pack_text(transformation.model_revision),
    )


def _read_pose_head(data: bytes, at: int) -> tuple[int, str, str, int]:
    (utime,) = UTIME.unpack_from(data, at)
    interest, at = read_text(data, at + 8)
    reference, at = read_text(data, at)
    return utime, interest, reference, at


def _find_pose_end(data: bytes, at: int, size: int) -> int:
    """Return where a pose ends whose numbers before the covariance are of that size. Raises WireError, struct.error."""
    at = _read_pose_head(data, at)[3] + size + _NUMBERS.size
    _REST.unpack_from(data, at)
    return read_text(data, at + _REST.size)[1]


skip_pose_transform = partial(_find_pose_end, size=_MATRIX.size)
skip_pose_vector = partial(_find_pose_end, size=_STATE_VECTOR.size)


def _make_answer(
    data: bytes, at: int, utime: int, interest: str, reference: str, pose: Pose, rest: list[Any]
) -> tuple[PoseAnswer, int]:
    """Return the answer of what both pose types have in common, whose covariance is at `at`, and where it ends.

    `rest` are the numbers from the covariance's first one on.
    """
    first, easting, northing, height, zone, north, origin_id, epoch, _, invalid, quality, *bounds = rest
    revision, end = read_text(data, at + _NUMBERS.size + _REST.size)
    covariance = None if first != first else partial(_unpack_covariance, data, at)
    transformation = Transformation(interest, reference, pose, covariance, utime, invalid, epoch, origin_id, revision)
    origin = None if easting != easting else Origin(easting, northing, height, zone, bool(north), origin_id)
    return PoseAnswer(transformation, origin, Quality(quality) if quality else NO_FLAGS, *bounds), end


def _unpack_covariance(data: bytes, at: int) -> tuple[float, ...]:
    return _NUMBERS.unpack_from(data, at)


def pack_reply_header(header: ReplyHeader) -> bytes:
    if not header.message and not header.nearest:
        head = _REPLY_HEAD.pack(header.request_id, header.utime, header.status)
        return b"%b%b%b" % (head, PLAIN, pack_text(header.model_revision))
    return b"%b%b%b%b%b" % (
        _REPLY_HEAD.pack(header.request_id, header.utime, header.status),
        pack_text(header.message),
        LENGTH.pack(len(header.nearest)),
        b"".join(map(pack_text, header.nearest)),
        pack_text(header.model_revision),
    )


def unpack_reply_header(data: bytes, at: int) -> tuple[ReplyHeader, int]:
    request_id, utime, status = _REPLY_HEAD.unpack_from(data, at)
    at += _REPLY_HEAD.size
    if status == 0 and data[at : at + len(PLAIN)] == PLAIN:
        revision, at = read_text(data, at + len(PLAIN))
        return ReplyHeader(request_id, utime, model_revision=revision), at
    message, at = read_text(data, at)
    (count,) = COUNT.unpack_from(data, at)
    check_count(count, "num_nearest")
    nearest, at = read_each(read_text, data, at + COUNT.size, count)
    revision, at = read_text(data, at)
    return ReplyHeader(request_id, utime, read_enum(Status, status, "status"), message, nearest, revision), at


# --- replies to batches -----------------------------------------------------------------------------------------------

_INT = struct.Struct(">i")
_PLACE = struct.Struct(">iiii3dbbqi")


def pack_get_transformations_reply(reply: PoseBatchReply) -> bytes:
    poses = reply.poses
    origin = None if poses is None else poses.origin
    count = 0 if poses is None else len(poses.utimes)
    place = _PLACE.pack(
        reply.part,
        reply.parts,
        reply.pair,
        reply.first,
        *(NO_PLACE if origin is None else (*origin.initial_utm, origin.zone, origin.north)),
        0 if origin is None else origin.origin_id,
        count,
    )
    head = pack_reply_header(reply.header) + place
    if poses is None:
        return head + _INT.pack(0)
    covariances = poses.covariances
    return b"".join(
        (
            head,
            poses.vectors.astype(">f8").tobytes(),
            poses.status.astype(">i2").tobytes(),
            poses.invalid.astype(">i4").tobytes(),
            poses.quality.astype(">i4").tobytes(),
            poses.epochs.astype(">i4").tobytes(),
            _INT.pack(0 if covariances is None else count),
            b"" if covariances is None else covariances.astype(">f8").tobytes(),
        )
    )


def unpack_get_transformations_reply(data: bytes, at: int) -> tuple[PoseBatchReply, int]:
    """Return the get_transformations_reply_t that begins at `at`, and its end. Raises WireError, struct.error.

    The names of the frames and the instants are those of the question, and are left out here.
    """
    header, at = unpack_reply_header(data, at)
    part, parts, pair, first, easting, northing, height, zone, north, origin_id, count = _PLACE.unpack_from(data, at)
    at += _PLACE.size
    if not (0 <= part < parts and pair >= 0 and first >= 0 and 0 <= count <= MAX_MESSAGE_INSTANTS):
        raise WireError("malformed", f"part {part} of {parts}, pair {pair}, from {first}, {count} instants: cannot be")
    vectors = _read_array(data, at, ">f8", 7 * count).reshape(count, 7)
    at += 56 * count
    status = _read_array(data, at, ">i2", count)
    at += 2 * count
    invalid, quality, epochs = (_read_array(data, at + 4 * n * count, ">i4", count).astype(np.int32) for n in range(3))
    at += 12 * count
    (known,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    if known not in (0, count):
        raise WireError("malformed", f"{known} covariances for {count} instants")
    covariances = _read_array(data, at, ">f8", 36 * known).reshape(known, 36) if known else None
    at += 288 * known
    if header.status is not Status.OK:
        return PoseBatchReply(header, part, parts, pair, first), at
    origin = None
    if easting == easting:
        origin = Origin(easting, northing, height, zone, bool(north), origin_id)
    poses = PoseBatch(
        "",
        "",
        np.zeros(count, dtype=np.int64),
        vectors.astype(np.float64),
        status.astype(np.int32),
        invalid,
        quality,
        epochs,
        None if covariances is None else covariances.astype(np.float64),
        origin,
        header.model_revision,
    )
    return PoseBatchReply(header, part, parts, pair, first, poses), at


def _read_array(data: bytes, at: int, kind: str, count: int) -> npt.NDArray[np.generic]:
    if at + np.dtype(kind).itemsize * count > len(data):
        raise WireError("truncated", f"{len(data)} bytes end within {count} numbers")
    return np.frombuffer(data, dtype=kind, count=count, offset=at)
