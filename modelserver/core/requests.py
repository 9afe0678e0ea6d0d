"""Questions: answered at once, parked until the data come, or turned down with the reason."""

from __future__ import annotations

from typing import Final

from modelserver.core.answers import DeferredAnswer, answers, failure, is_deferred
from modelserver.core.host_clock import Instant
from modelserver.core.state import AllOutputs, CoreState, Outputs, Parked, Step, TimedRequest, counted
from modelserver.errors import Status
from modelserver.geometry import names
from modelserver.messages import (
    CHANNEL_OF,
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

_TIMED: Final = (GetTransformation, GetStateVector, GetHTransform, GetMotion, GetExplanation)
"""Requests that ask about a time, and may wait for it."""


def requested(state: CoreState, request: Request, now: Instant) -> tuple[CoreState, AllOutputs]:
    """Answer a question, have it answered in steps, or park it until the data come that it is ready to wait for."""
    if not request.header.is_answerable(state.settings.reply_prefix):
        return counted(state, CHANNEL_OF[type(request)], "reply_channel"), ()
    if isinstance(request, _TIMED) and request.time.wait_ms and _must_wait(state, request):
        if len(state.parked) < state.settings.parked_requests:
            wait_ms = min(request.time.wait_ms, state.settings.wait_ms)
            parked = Parked(request, now.monotonic_ns + wait_ms * 1_000_000)
            return state._replace(parked=(*state.parked, parked)), ()
        state = counted(state, CHANNEL_OF[type(request)], "load")
        why = f"{len(state.parked)} requests wait already, as many as may (limits.parked_requests); ask without wait_ms"
        return state, turned_down(state, type(request), request.header, Status.REFUSED_LOAD, why, now)
    # what `_replace` does, at a third of its cost: this is done for every request
    after = CoreState._make((*state[:-1], state.requests_answered + 1))
    if is_deferred(request):
        return after, (DeferredAnswer(state.view, request, now.utime),)
    return after, _replies(state, request, now)


def _must_wait(state: CoreState, request: TimedRequest) -> bool:
    """Whether a request asked for a time that is yet to come, and gave time to wait for it."""
    if not request.time.wait_ms:
        return False
    ends = (names.WORLD_UTM, state.view.base_frame)
    if isinstance(request, (GetTransformation, GetMotion, GetExplanation)):
        ends = (request.frame_of_interest, request.frame_of_reference)
    return state.view.awaits(request.time, *ends)


def answer_parked(state: CoreState, now: Instant) -> tuple[CoreState, list[Output]]:
    """Answer the parked requests whose data have come or whose time is up."""
    still: list[Parked] = []
    replies: list[Output] = []
    for parked in state.parked:
        if now.monotonic_ns < parked.until_ns and _must_wait(state, parked.request):
            still.append(parked)
        else:
            replies += _replies(state, parked.request, now)
    if replies:
        state = state._replace(parked=tuple(still), requests_answered=state.requests_answered + len(replies))
    return state, replies


def _replies(state: CoreState, request: Request, now: Instant) -> tuple[SendReply, ...]:
    channel = request.header.reply_channel
    return tuple([SendReply(channel, reply) for reply in answers(state.view, request, now.utime)])


def refuse(state: CoreState, request: Request, now: Instant) -> Outputs:
    """Return the refusal of a request that the server has no time for."""
    message = "the server is loaded and did not take the request; ask again later"
    return turned_down(state, type(request), request.header, Status.REFUSED_LOAD, message, now)


def fail(state: CoreState, request: Request, now: Instant) -> Outputs:
    """Return the reply to a request that an error of the server's own kept from being answered."""
    message = "the server failed on its side; its log says why"
    return turned_down(state, type(request), request.header, Status.INTERNAL, message, now)


def denied(state: CoreState, command: Denied, now: Instant) -> Step:
    """Count a signed command that is not obeyed, and say why to who has proved to know the key."""
    state = counted(state, command.channel, command.reason)
    if command.kind is None or command.header is None:
        return state, ()
    if command.malformed:
        return state, turn_back(state, command.kind, command.header, command.why, now)
    why = f"the command is not obeyed: {command.why}"
    return state, turned_down(state, command.kind, command.header, Status.FORBIDDEN, why, now)


def turn_back(state: CoreState, kind: type[Request], header: RequestHeader, why: str, now: Instant) -> Outputs:
    """Return the reply to a request that makes no sense beyond its header."""
    return turned_down(state, kind, header, Status.MALFORMED, why, now)


def turned_down(
    state: CoreState, kind: type[Request], header: RequestHeader, status: Status, message: str, now: Instant
) -> Outputs:
    """Return the reply that says why a request is not answered; nothing where it may not be spoken to."""
    if not header.is_answerable(state.settings.reply_prefix):
        return ()
    return (SendReply(header.reply_channel, failure(state.view, kind, header, status, message, now.utime)),)
