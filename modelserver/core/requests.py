"""Requests: answered at once, deferred, kept waiting until their data arrive, or rejected with the reason. Pure."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Final

from modelserver.core.host_clock import Instant
from modelserver.core.state import (
    AllOutputs,
    CoreState,
    Outputs,
    StepResult,
    TimedRequest,
    WaitingRequest,
    count_rejection,
)
from modelserver.errors import Status
from modelserver.geometry import names
from modelserver.messages import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    Denied,
    GetExplanation,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    Output,
    Request,
    RequestHeader,
    SendReply,
)
from modelserver.query.answers import DeferredAnswer, compute_replies, is_deferred, make_error_reply

_TIMED: Final = (GetTransformation, GetStateVector, GetHTransform, GetMotion, GetExplanation)
"""Requests that name a time, and may wait for its data."""


_PLAIN_NAME = re.compile(r"[A-Za-z0-9_]+")


def is_answerable(header: RequestHeader, prefix: str) -> bool:
    """Return whether a server may reply on the request's reply channel: within its prefix, plain, not too long."""
    channel = header.reply_channel
    # the length first: what is looked up is cached
    return len(channel) <= MAX_CHANNEL_LENGTH and _is_plain(channel, prefix)


@lru_cache(maxsize=1024)
def _is_plain(channel: str, prefix: str) -> bool:
    return len(channel) > len(prefix) and channel.startswith(prefix) and _PLAIN_NAME.fullmatch(channel) is not None


def handle_request(state: CoreState, request: Request, now: Instant) -> tuple[CoreState, AllOutputs]:
    """Answer a request, defer a long answer, or let the request wait until the data it asks for arrive."""
    if not is_answerable(request.header, state.settings.reply_prefix):
        return count_rejection(state, CHANNEL_OF[type(request)], "reply_channel"), ()
    if isinstance(request, _TIMED) and request.time.wait_ms and _must_wait(state, request):
        if len(state.waiting) < state.settings.waiting_requests:
            wait_ms = min(request.time.wait_ms, state.settings.wait_ms)
            waiting = WaitingRequest(request, now.monotonic_ns + wait_ms * 1_000_000)
            return state._replace(waiting=(*state.waiting, waiting)), ()
        state = count_rejection(state, CHANNEL_OF[type(request)], "overload")
        why = f"{len(state.waiting)} requests wait already, the limit (limits.waiting_requests); ask without wait_ms"
        return state, reply_error(state, type(request), request.header, Status.OVERLOADED, why, now)
    # a third of the cost of `_replace`, for every request
    after = CoreState._make((*state[:-1], state.requests_answered + 1))
    if is_deferred(request):
        return after, (DeferredAnswer(state.view, request, now.utime),)
    return after, _make_replies(state, request, now)


def _must_wait(state: CoreState, request: TimedRequest) -> bool:
    """Return whether the data that a request asks for are yet to come, and it may wait for them."""
    ends = (names.WORLD_UTM, state.view.base_frame)
    if isinstance(request, (GetTransformation, GetMotion, GetExplanation)):
        ends = (request.frame_of_interest, request.frame_of_reference)
    return state.view.is_awaiting_data(request.time, *ends)


def answer_waiting(state: CoreState, now: Instant) -> tuple[CoreState, list[Output]]:
    """Answer the waiting requests whose data have arrived or whose deadline has passed."""
    remaining: list[WaitingRequest] = []
    replies: list[Output] = []
    for request in state.waiting:
        if now.monotonic_ns < request.deadline_ns and _must_wait(state, request.request):
            remaining.append(request)
        else:
            replies += _make_replies(state, request.request, now)
    if replies:
        state = state._replace(waiting=tuple(remaining), requests_answered=state.requests_answered + len(replies))
    return state, replies


def _make_replies(state: CoreState, request: Request, now: Instant) -> tuple[SendReply, ...]:
    channel = request.header.reply_channel
    return tuple([SendReply(channel, reply) for reply in compute_replies(state.view, request, now.utime)])


def reply_overloaded(state: CoreState, request: Request, now: Instant) -> Outputs:
    message = "the server is overloaded and dropped the request; try again later"
    return reply_error(state, type(request), request.header, Status.OVERLOADED, message, now)


def reply_internal_error(state: CoreState, request: Request, now: Instant) -> Outputs:
    """Reply to a request whose handling raised an exception in the server."""
    message = "internal error of the server; its log has the traceback"
    return reply_error(state, type(request), request.header, Status.INTERNAL, message, now)


def handle_denied(state: CoreState, command: Denied, now: Instant) -> StepResult:
    """Count a denied command, and reply with the reason to a sender whose signature is verified."""
    state = count_rejection(state, command.channel, command.reason)
    if command.request_type is None or command.header is None:
        return state, ()
    if command.is_malformed:
        status, why = Status.MALFORMED, command.message
    else:
        status, why = Status.FORBIDDEN, f"the command is denied: {command.message}"
    return state, reply_error(state, command.request_type, command.header, status, why, now)


def reply_error(
    state: CoreState, kind: type[Request], header: RequestHeader, status: Status, message: str, now: Instant
) -> Outputs:
    """Reply with an error and its reason; without output if the reply channel is not permitted."""
    if not is_answerable(header, state.settings.reply_prefix):
        return ()
    return (SendReply(header.reply_channel, make_error_reply(state.view, kind, header, status, message, now.utime)),)
