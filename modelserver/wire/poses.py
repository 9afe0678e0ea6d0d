"""What the hot path of a query exchanges, between Python and wire: poses and the header of replies; replies to batches.

The values of pose_transform_t and pose_vector_t are transformations. The arrays of get_transformations_reply_t are on
the wire as they are in memory.
"""

from __future__ import annotations

import struct
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status, WireError
from modelserver.messages import NO_FLAGS, Origin, PoseAnswer, PoseBatch, PoseBatchReply, Quality, ReplyHeader
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire import fields
from modelserver.wire.fields import (
    COUNT,
    LENGTH,
    MAX_DISTANCE,
    MAX_MESSAGE_INSTANTS,
    ROTATION_TOLERANCE,
    check_count,
    pack_text,
    read_each,
    read_enum,
    read_text,
)

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

NO_PLACE: Final = (*fields.NAN3, 0, False)
"""Of no origin: initial_utm, zone, north."""

_NAN_COVARIANCE: Final = _NUMBERS.pack(*fields.NAN36)

_POSE_HEAD: Final = bytes(8) + 2 * pack_text("")
_POSE_END: Final = bytes(_NUMBERS.size + _REST.size) + pack_text("")
NO_POSE_TRANSFORM: Final = _POSE_HEAD + bytes(_MATRIX.size) + _POSE_END
NO_POSE_VECTOR: Final = _POSE_HEAD + bytes(_STATE_VECTOR.size) + _POSE_END
"""What stands in a reply that carries no pose."""


def pack_pose_transform(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_transform_t without its fingerprint."""
    pose = answer.transformation.pose
    (a, b, c), (d, e, f), (g, h, i) = so3.matrix_rows(pose._q)
    x, y, z = pose._p
    return _pack_pose(_MATRIX.pack(a, b, c, x, d, e, f, y, g, h, i, z, 0.0, 0.0, 0.0, 1.0), answer)


def pack_pose_vector(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_vector_t without its fingerprint."""
    pose = answer.transformation.pose
    return _pack_pose(_STATE_VECTOR.pack(*pose._p, *pose._q), answer)


def unpack_pose_transform(data: bytes, at: int) -> tuple[PoseAnswer, int]:
    """Return the pose that begins at `at`, and where it ends. Raises WireError, struct.error."""
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
    """Return the pose that begins at `at`, and where it ends. Raises WireError, struct.error."""
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


def skip_pose_transform(data: bytes, at: int) -> int:
    """Return where the pose_transform_t that begins at `at` ends, whatever is in it. Raises WireError, struct.error."""
    return _find_pose_end(data, at, _MATRIX.size)


def skip_pose_vector(data: bytes, at: int) -> int:
    """Return where the pose_vector_t that begins at `at` ends, whatever is in it. Raises WireError, struct.error."""
    return _find_pose_end(data, at, _STATE_VECTOR.size)


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
    """Return time and names that a pose begins with, and where they end."""
    (utime,) = UTIME.unpack_from(data, at)
    interest, at = read_text(data, at + 8)
    reference, at = read_text(data, at)
    return utime, interest, reference, at


def _find_pose_end(data: bytes, at: int, size: int) -> int:
    """Return where a pose ends whose numbers before the covariance are of that size. Raises WireError, struct.error."""
    at = _read_pose_head(data, at)[3] + size + _NUMBERS.size
    _REST.unpack_from(data, at)
    return read_text(data, at + _REST.size)[1]


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
    """Return the bytes of a reply_header_t without its fingerprint."""
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
    """Return the reply_header_t that begins at `at`, and its end. Raises WireError, struct.error."""
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
    """Return the bytes of a get_transformations_reply_t without the fingerprint."""
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
