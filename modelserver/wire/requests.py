"""Requests, and the replies that carry names, between Python and wire, both ways."""

from __future__ import annotations

import struct

from modelserver.errors import Status, WireError
from modelserver.messages import (
    GetBodyFrameList,
    GetBodyList,
    GetHistory,
    GetHTransform,
    GetStateVector,
    NameListReply,
    ReplyHeader,
    RequestHeader,
    TimeQuery,
)
from modelserver.wire import fields
from modelserver.wire.packed import read_text
from mslcm.get_body_frame_list_request_t import get_body_frame_list_request_t
from mslcm.get_body_list_request_t import get_body_list_request_t
from mslcm.get_h_transform_request_t import get_h_transform_request_t
from mslcm.get_history_request_t import get_history_request_t
from mslcm.get_state_vector_request_t import get_state_vector_request_t
from mslcm.name_list_reply_t import name_list_reply_t
from mslcm.reply_header_t import reply_header_t
from mslcm.request_header_t import request_header_t
from mslcm.time_query_t import time_query_t


def request_header(data: bytes) -> RequestHeader | None:
    """Return the header that every request begins with, None where not even that can be read."""
    try:
        channel, _ = read_text(data, 16)
    except (WireError, struct.error):
        return None
    return RequestHeader(int.from_bytes(data[8:16], "big", signed=True), channel)


def _header(message: request_header_t) -> RequestHeader:
    return RequestHeader(message.request_id, message.reply_channel)


def _wire_header(header: RequestHeader) -> request_header_t:
    message = request_header_t()
    message.request_id = header.request_id
    message.reply_channel = header.reply_channel
    return message


def _time(message: time_query_t) -> TimeQuery:
    return fields.time_query(message.at, message.policy, message.wait_ms)


def _wire_time(time: TimeQuery) -> time_query_t:
    message = time_query_t()
    message.at = time.at
    message.policy = int(time.policy)
    message.wait_ms = time.wait_ms
    return message


def read_get_body_list(message: get_body_list_request_t) -> GetBodyList:
    """Return the request of a message."""
    return GetBodyList(_header(message.header))


def write_get_body_list(request: GetBodyList) -> get_body_list_request_t:
    """Return the message of a request."""
    message = get_body_list_request_t()
    message.header = _wire_header(request.header)
    return message


def read_get_body_frame_list(message: get_body_frame_list_request_t) -> GetBodyFrameList:
    """Return the request of a message."""
    return GetBodyFrameList(_header(message.header), message.body)


def write_get_body_frame_list(request: GetBodyFrameList) -> get_body_frame_list_request_t:
    """Return the message of a request."""
    message = get_body_frame_list_request_t()
    message.header = _wire_header(request.header)
    message.body = request.body
    return message


def read_get_state_vector(message: get_state_vector_request_t) -> GetStateVector:
    """Return the request of a message. Raises WireError."""
    return GetStateVector(_header(message.header), _time(message.time))


def write_get_state_vector(request: GetStateVector) -> get_state_vector_request_t:
    """Return the message of a request."""
    message = get_state_vector_request_t()
    message.header = _wire_header(request.header)
    message.time = _wire_time(request.time)
    return message


def read_get_h_transform(message: get_h_transform_request_t) -> GetHTransform:
    """Return the request of a message. Raises WireError."""
    return GetHTransform(_header(message.header), bool(message.inverse), _time(message.time))


def write_get_h_transform(request: GetHTransform) -> get_h_transform_request_t:
    """Return the message of a request."""
    message = get_h_transform_request_t()
    message.header = _wire_header(request.header)
    message.inverse = request.inverse
    message.time = _wire_time(request.time)
    return message


def read_get_history(message: get_history_request_t) -> GetHistory:
    """Return the request of a message. Raises WireError."""
    return GetHistory(
        _header(message.header),
        fields.checked_utime(message.start_utime, "start_utime"),
        fields.checked_utime(message.end_utime, "end_utime"),
        message.rate_hz,
    )


def write_get_history(request: GetHistory) -> get_history_request_t:
    """Return the message of a request."""
    message = get_history_request_t()
    message.header = _wire_header(request.header)
    message.start_utime = request.start_utime
    message.end_utime = request.end_utime
    message.rate_hz = request.rate_hz
    return message


def _reply_header(message: reply_header_t) -> ReplyHeader:
    fields.checked_count(message.num_nearest, message.nearest, "num_nearest")
    return ReplyHeader(
        message.request_id,
        message.utime,
        fields.member(Status, message.status, "status"),
        message.message,
        tuple(message.nearest),
        message.model_revision,
    )


def _wire_reply_header(header: ReplyHeader) -> reply_header_t:
    message = reply_header_t()
    message.request_id = header.request_id
    message.utime = header.utime
    message.status = int(header.status)
    message.message = header.message
    message.num_nearest = len(header.nearest)
    message.nearest = header.nearest
    message.model_revision = header.model_revision
    return message


def read_name_list_reply(message: name_list_reply_t) -> NameListReply:
    """Return the reply of a message. Raises WireError."""
    fields.checked_count(message.num_names, message.names, "num_names")
    return NameListReply(_reply_header(message.header), tuple(message.names), tuple(message.descriptions))


def write_name_list_reply(reply: NameListReply) -> name_list_reply_t:
    """Return the message of a reply."""
    message = name_list_reply_t()
    message.header = _wire_reply_header(reply.header)
    message.num_names = len(reply.names)
    message.names = reply.names
    message.descriptions = reply.descriptions
    return message
