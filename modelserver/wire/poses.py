"""Poses between Python and wire, packed by hand (see `packed`)."""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np

from modelserver.errors import WireError
from modelserver.messages import NO_FLAGS, Origin, PoseAnswer, Quality
from modelserver.spatial import so3
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array
from modelserver.spatial.transformation import Transformation
from modelserver.wire import fields
from modelserver.wire.fields import FAR, TOLERANCE
from modelserver.wire.packed import check_end, read_text, text
from mslcm.pose_transform_t import pose_transform_t
from mslcm.pose_vector_t import pose_vector_t

_UTIME = struct.Struct(">q")
# covariance, initial_utm, zone, north, origin id, epoch, valid, reasons, flags, bounds and seconds
_COMMON = "36d3dbbqibiiddd"
_TRANSFORM = struct.Struct(f">16d{_COMMON}")
_VECTOR = struct.Struct(f">7d{_COMMON}")

_TRANSFORM_FINGERPRINT: Final[bytes] = pose_transform_t._get_packed_fingerprint()
_VECTOR_FINGERPRINT: Final[bytes] = pose_vector_t._get_packed_fingerprint()

NO_TRANSFORM: Final[bytes] = pose_transform_t().encode()[8:]
NO_VECTOR: Final[bytes] = pose_vector_t().encode()[8:]
"""What stands in a reply that carries no pose."""


def write_transform(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_transform_t."""
    return _TRANSFORM_FINGERPRINT + transform_body(answer)


def write_vector(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_vector_t."""
    return _VECTOR_FINGERPRINT + vector_body(answer)


def read_transform(data: bytes) -> PoseAnswer:
    """Return the pose in the bytes of a pose_transform_t. Raises WireError, struct.error."""
    answer, end = read_transform_body(data, 8)
    check_end(data, end)
    return answer


def read_vector(data: bytes) -> PoseAnswer:
    """Return the pose in the bytes of a pose_vector_t. Raises WireError, struct.error."""
    answer, end = read_vector_body(data, 8)
    check_end(data, end)
    return answer


def transform_body(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_transform_t without its fingerprint."""
    a, b, c, d = answer.transformation.pose.matrix_rows()
    return _body(_TRANSFORM, a + b + c + d, answer)


def vector_body(answer: PoseAnswer) -> bytes:
    """Return the bytes of a pose_vector_t without its fingerprint."""
    pose = answer.transformation.pose
    return _body(_VECTOR, pose.xyz + pose.wxyz, answer)


def read_transform_body(data: bytes, at: int) -> tuple[PoseAnswer, int]:
    """Return the pose that begins at `at`, and where it ends. Raises WireError, struct.error."""
    head, values, revision, end = _fields(_TRANSFORM, data, at)
    a, b, c, x, d, e, f, y, g, h, i, z, *last = values[:16]
    if last != [0.0, 0.0, 0.0, 1.0]:
        raise WireError("malformed", f"the last row of a homogeneous transform is 0 0 0 1, got {last}")
    return _answer(head, _pose((x, y, z), ((a, b, c), (d, e, f), (g, h, i))), values[16:], revision), end


def read_vector_body(data: bytes, at: int) -> tuple[PoseAnswer, int]:
    """Return the pose that begins at `at`, and where it ends. Raises WireError, struct.error."""
    head, values, revision, end = _fields(_VECTOR, data, at)
    q = values[3:7]
    if not abs(sum(value * value for value in q) - 1.0) <= TOLERANCE:
        raise WireError("malformed", f"{q} is no unit quaternion")
    try:
        pose = Pose(values[:3], q)
    except ValueError as error:
        raise WireError("malformed", str(error)) from None
    return _answer(head, pose, values[7:], revision), end


def check_no_transform(data: bytes, at: int) -> None:
    """Check that what begins at `at` is a whole pose_transform_t, whatever it says. Raises WireError, struct.error."""
    if data[at:] != NO_TRANSFORM:
        check_end(data, _fields(_TRANSFORM, data, at)[3])


def check_no_vector(data: bytes, at: int) -> None:
    """Check that what begins at `at` is a whole pose_vector_t, whatever it says. Raises WireError, struct.error."""
    if data[at:] != NO_VECTOR:
        check_end(data, _fields(_VECTOR, data, at)[3])


def _body(layout: struct.Struct, pose: tuple[float, ...], answer: PoseAnswer) -> bytes:
    transformation = answer.transformation
    covariance = transformation.covariance
    origin = answer.origin
    return b"%b%b%b%b%b" % (
        _UTIME.pack(transformation.utime),
        text(transformation.frame_of_interest),
        text(transformation.frame_of_reference),
        layout.pack(
            *pose,
            *(fields.NAN36 if covariance is None else covariance.ravel().tolist()),
            *(fields.NAN3 if origin is None else origin.initial_utm),
            0 if origin is None else origin.zone,
            origin is not None and origin.north,
            transformation.origin_id,
            transformation.pose_epoch,
            not transformation.invalid_reasons,
            transformation.invalid_reasons,
            answer.quality,
            answer.horizontal_bound,
            answer.heading_bound,
            answer.seconds_to_limit,
        ),
        text(transformation.model_revision),
    )


def _fields(layout: struct.Struct, data: bytes, at: int) -> tuple[tuple[int, str, str], tuple[Any, ...], str, int]:
    """Return time and names, the numbers, the model revision, and where the pose ends."""
    (utime,) = _UTIME.unpack_from(data, at)
    interest, at = read_text(data, at + 8)
    reference, at = read_text(data, at)
    values = layout.unpack_from(data, at)
    revision, end = read_text(data, at + layout.size)
    return (utime, interest, reference), values, revision, end


def _answer(head: tuple[int, str, str], pose: Pose, values: tuple[Any, ...], revision: str) -> PoseAnswer:
    """Return the answer of what both pose types have in common; `values` begin with the covariance."""
    utime, interest, reference = head
    easting, northing, height, zone, north, origin_id, epoch, _, invalid, quality = values[36:46]
    return PoseAnswer(
        Transformation(
            interest,
            reference,
            pose,
            None if values[0] != values[0] else lambda: _square(values[:36]),
            utime,
            invalid,
            epoch,
            origin_id,
            revision,
        ),
        None if easting != easting else Origin(easting, northing, height, zone, bool(north), origin_id),
        Quality(quality) if quality else NO_FLAGS,
        *values[46:],
    )


def _square(numbers: tuple[float, ...]) -> Array:
    return np.array(numbers, dtype=float).reshape(6, 6)


def _pose(p: so3.Vector3, rows: tuple[so3.Vector3, so3.Vector3, so3.Vector3]) -> Pose:
    """Return the pose of a position and the rows of a rotation. Raises WireError where they are none."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    x, y, z = p
    # rows of length 1 and at right angles, right-handed, and all of it finite: a nan fails every comparison
    if not (
        abs(a * a + b * b + c * c - 1.0) <= TOLERANCE
        and abs(d * d + e * e + f * f - 1.0) <= TOLERANCE
        and abs(g * g + h * h + i * i - 1.0) <= TOLERANCE
        and abs(a * d + b * e + c * f) <= TOLERANCE
        and abs(a * g + b * h + c * i) <= TOLERANCE
        and abs(d * g + e * h + f * i) <= TOLERANCE
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
        and abs(x) < FAR
        and abs(y) < FAR
        and abs(z) < FAR
    ):
        raise WireError("malformed", f"{rows} with {p} is no rigid transform")
    return Pose._of(p, so3.from_rows(rows))
