"""Requests that have something done, and their replies, between Python and wire, both ways."""

from __future__ import annotations

import struct
from typing import Final

from modelserver.messages import (
    Acknowledgement,
    ReloadModel,
    ReloadReply,
    RequestHeader,
    SetHTransform,
    SetStateVector,
)
from modelserver.wire import poses
from modelserver.wire.packed import LENGTH, check_end, read_text, text
from modelserver.wire.queries import header_body, read_header
from mslcm.acknowledgement_t import acknowledgement_t
from mslcm.reload_model_reply_t import reload_model_reply_t
from mslcm.reload_model_request_t import reload_model_request_t
from mslcm.set_h_transform_request_t import set_h_transform_request_t
from mslcm.set_state_vector_request_t import set_state_vector_request_t

_ID = struct.Struct(">q")
_DRY_RUN = struct.Struct(">b")
_RELOAD: Final[bytes] = reload_model_request_t._get_packed_fingerprint()
_RELOAD_REPLY: Final[bytes] = reload_model_reply_t._get_packed_fingerprint()
_SET_VECTOR: Final[bytes] = set_state_vector_request_t._get_packed_fingerprint()
_SET_TRANSFORM: Final[bytes] = set_h_transform_request_t._get_packed_fingerprint()
_ACKNOWLEDGEMENT: Final[bytes] = acknowledgement_t._get_packed_fingerprint()


def _head(fingerprint: bytes, header: RequestHeader) -> bytes:
    return b"%b%b%b" % (fingerprint, _ID.pack(header.request_id), text(header.reply_channel))


def _read_head(data: bytes) -> tuple[RequestHeader, int]:
    (request_id,) = _ID.unpack_from(data, 8)
    channel, at = read_text(data, 16)
    return RequestHeader(request_id, channel), at


def write_reload(request: ReloadModel) -> bytes:
    """Return the bytes of a reload_model_request_t."""
    return _head(_RELOAD, request.header) + _DRY_RUN.pack(request.dry_run)


def read_reload(data: bytes) -> ReloadModel:
    """Return the request in the bytes of a reload_model_request_t. Raises WireError, struct.error."""
    header, at = _read_head(data)
    (dry_run,) = _DRY_RUN.unpack_from(data, at)
    check_end(data, at + _DRY_RUN.size)
    return ReloadModel(header, bool(dry_run))


def write_reload_reply(reply: ReloadReply) -> bytes:
    """Return the bytes of a reload_model_reply_t."""
    return b"".join(
        (
            _RELOAD_REPLY,
            header_body(reply.header),
            text(reply.revision),
            LENGTH.pack(len(reply.changes)),
            *map(text, reply.changes),
        )
    )


def read_reload_reply(data: bytes) -> ReloadReply:
    """Return the reply in the bytes of a reload_model_reply_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    revision, at = read_text(data, at)
    (count,) = LENGTH.unpack_from(data, at)
    at += LENGTH.size
    changes = []
    for _ in range(count):
        change, at = read_text(data, at)
        changes.append(change)
    check_end(data, at)
    return ReloadReply(header, revision, tuple(changes))


def write_set_vector(request: SetStateVector) -> bytes:
    """Return the bytes of a set_state_vector_request_t."""
    return _head(_SET_VECTOR, request.header) + poses.vector_body(request.pose)


def read_set_vector(data: bytes) -> SetStateVector:
    """Return the request in the bytes of a set_state_vector_request_t. Raises WireError, struct.error."""
    header, at = _read_head(data)
    pose, at = poses.read_vector_body(data, at)
    check_end(data, at)
    return SetStateVector(header, pose)


def write_set_transform(request: SetHTransform) -> bytes:
    """Return the bytes of a set_h_transform_request_t."""
    return _head(_SET_TRANSFORM, request.header) + poses.transform_body(request.pose)


def read_set_transform(data: bytes) -> SetHTransform:
    """Return the request in the bytes of a set_h_transform_request_t. Raises WireError, struct.error."""
    header, at = _read_head(data)
    pose, at = poses.read_transform_body(data, at)
    check_end(data, at)
    return SetHTransform(header, pose)


def write_acknowledgement(reply: Acknowledgement) -> bytes:
    """Return the bytes of an acknowledgement_t."""
    return _ACKNOWLEDGEMENT + header_body(reply.header)


def read_acknowledgement(data: bytes) -> Acknowledgement:
    """Return the reply in the bytes of an acknowledgement_t. Raises WireError, struct.error."""
    header, at = read_header(data)
    check_end(data, at)
    return Acknowledgement(header)
