"""Replies to batches of queries between Python and wire: arrays as they are in memory (get_transformations_reply_t)."""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status, WireError
from modelserver.messages import Origin, PoseBatch, PoseBatchReply
from modelserver.wire.fields import LENGTH, MAX_MESSAGE_INSTANTS
from modelserver.wire.poses import NO_PLACE, pack_reply_header, unpack_reply_header

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
