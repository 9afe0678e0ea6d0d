"""Many instants in one question, and the parts of its answer, between Python and wire: arrays as they lie in memory."""

from __future__ import annotations

import struct
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status, WireError
from modelserver.messages import GetTransformations, ManyPoses, ManyReply, Origin, RequestHeader
from modelserver.wire import fields
from modelserver.wire.packed import LENGTH, check_end, read_text, text
from modelserver.wire.queries import header_body, read_header
from mslcm.get_transformations_reply_t import get_transformations_reply_t
from mslcm.get_transformations_request_t import get_transformations_request_t

MAX_PAIRS: Final = 64
MAX_INSTANTS: Final = 100_000
"""In a message; the server takes far fewer."""

_ID = struct.Struct(">q")
_INT = struct.Struct(">i")
_TAIL = struct.Struct(">qb")
_PLACE = struct.Struct(">iiii3dbbqi")
_REQUEST: Final[bytes] = get_transformations_request_t._get_packed_fingerprint()
_REPLY: Final[bytes] = get_transformations_reply_t._get_packed_fingerprint()


def write_request(request: GetTransformations) -> bytes:
    """Return the bytes of a get_transformations_request_t."""
    return b"".join(
        (
            _REQUEST,
            _ID.pack(request.header.request_id),
            text(request.header.reply_channel),
            _INT.pack(len(request.pairs)),
            *(text(interest) for interest, _ in request.pairs),
            *(text(reference) for _, reference in request.pairs),
            _INT.pack(len(request.at)),
            np.asarray(request.at, dtype=np.int64).astype(">i8").tobytes(),
            text(request.fixed_frame),
            _TAIL.pack(request.reference_at, request.with_covariance),
        )
    )


def read_request(data: bytes) -> GetTransformations:
    """Return the request in the bytes of a get_transformations_request_t. Raises WireError, struct.error."""
    (request_id,) = _ID.unpack_from(data, 8)
    channel, at = read_text(data, 16)
    (count,) = _INT.unpack_from(data, at)
    if not 1 <= count <= MAX_PAIRS:
        raise WireError("malformed", f"num_pairs is 1 to {MAX_PAIRS}, got {count}")
    at += _INT.size
    names = []
    for _ in range(2 * count):
        name, at = read_text(data, at)
        names.append(fields.frame_name(name, "frame"))
    (instants,) = _INT.unpack_from(data, at)
    if not 0 <= instants <= MAX_INSTANTS:
        raise WireError("malformed", f"num_instants is 0 to {MAX_INSTANTS}, got {instants}")
    at += _INT.size
    utimes = _array(data, at, ">i8", instants)
    at += 8 * instants
    if instants and (utimes.min() < 0 or utimes.max() >= fields.MAX_UTIME):
        raise WireError("malformed", "an instant is no time in microseconds since 1970")
    fixed, at = read_text(data, at)
    reference_at, with_covariance = _TAIL.unpack_from(data, at)
    check_end(data, at + _TAIL.size)
    return GetTransformations(
        RequestHeader(request_id, channel),
        tuple(zip(names[:count], names[count:], strict=True)),
        tuple(utimes.tolist()),
        fields.frame_name(fixed, "fixed_frame"),
        fields.checked_utime(reference_at, "reference_at"),
        bool(with_covariance),
    )


def write_reply(reply: ManyReply) -> bytes:
    """Return the bytes of a get_transformations_reply_t."""
    poses = reply.poses
    origin = None if poses is None else poses.origin
    count = 0 if poses is None else len(poses.utimes)
    place = _PLACE.pack(
        reply.part,
        reply.parts,
        reply.pair,
        reply.first,
        *(fields.NAN3 if origin is None else origin.initial_utm),
        0 if origin is None else origin.zone,
        origin is not None and origin.north,
        0 if origin is None else origin.origin_id,
        count,
    )
    head = b"%b%b%b" % (_REPLY, header_body(reply.header), place)
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


def read_reply(data: bytes) -> ManyReply:
    """Return the part in the bytes of a get_transformations_reply_t. Raises WireError, struct.error.

    The names of the frames and the instants are those of the question, and are left out here.
    """
    header, at = read_header(data)
    part, parts, pair, first, easting, northing, height, zone, north, origin_id, count = _PLACE.unpack_from(data, at)
    at += _PLACE.size
    if not (0 <= part < parts and pair >= 0 and first >= 0 and 0 <= count <= MAX_INSTANTS):
        raise WireError("malformed", f"part {part} of {parts}, pair {pair}, from {first}, {count} instants: cannot be")
    vectors = _array(data, at, ">f8", 7 * count).reshape(count, 7)
    at += 56 * count
    status = _array(data, at, ">i2", count)
    at += 2 * count
    invalid, quality, epochs = (_array(data, at + 4 * n * count, ">i4", count).astype(np.int32) for n in range(3))
    at += 12 * count
    (known,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    if known not in (0, count):
        raise WireError("malformed", f"{known} covariances for {count} instants")
    covariances = _array(data, at, ">f8", 36 * known).reshape(known, 36) if known else None
    check_end(data, at + 288 * known)
    if header.status is not Status.OK:
        return ManyReply(header, part, parts, pair, first)
    origin = None
    if easting == easting:
        origin = Origin(easting, northing, height, zone, bool(north), origin_id)
    poses = ManyPoses(
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
    return ManyReply(header, part, parts, pair, first, poses)


def _array(data: bytes, at: int, kind: str, count: int) -> npt.NDArray[np.generic]:
    if at + np.dtype(kind).itemsize * count > len(data):
        raise WireError("truncated", f"{len(data)} bytes end within {count} numbers")
    return np.frombuffer(data, dtype=kind, count=count, offset=at)
