"""Platform: the client. Its methods look local; each asks the daemon and waits for the reply."""

from __future__ import annotations

import os
import random
import re
import secrets
import struct
import sys
import threading
import time
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import lcm

from modelserver.errors import MalformedRequestError, NoServerError, Status, WireError, error_for_status
from modelserver.messages import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    GetBodyFrameList,
    GetBodyList,
    GetHistory,
    GetHTransform,
    GetStateVector,
    GetTransformation,
    HistoryReply,
    NameListReply,
    Policy,
    PoseAnswer,
    ReplyHeader,
    RequestHeader,
    StateVectorReply,
    TimeQuery,
    TransformReply,
)
from modelserver.spatial.transformation import Transformation
from modelserver.wire.channels import REPLY_PREFIX, literal
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import open_lcm, resolve_url
from modelserver.wire.queries import known_answer, write_question

R = TypeVar("R", TransformReply, NameListReply, StateVectorReply, HistoryReply)

_REPLY_TYPES = {
    TransformReply: "get_transformation_reply_t",
    NameListReply: "name_list_reply_t",
    StateVectorReply: "get_state_vector_reply_t",
    HistoryReply: "get_history_reply_t",
}

UNREAD_REPLIES: Final = 64
"""Replies kept until they are looked at; further ones are lost."""

IDLE_S: Final = 0.01
"""After so long without a question the replies to others of this program's name are thrown away first."""

LONGEST_WAIT_S: Final = 60.0
_LONGEST_WAIT_MS: Final = 60_000
"""LCM counts milliseconds in an int: a longer wait is made of several."""

_ID: Final = slice(8, 16)
"""Where every request and every reply carries the request's id: first, behind the fingerprint."""


class Platform:
    """Asks the running service.

        with modelserver.Platform() as platform:
            platform.get_transformation("Digiclops:ImagePlane", "World:UTM")

    It has an LCM instance of its own, so it may be used inside another instance's handler, and by several
    threads (one asks at a time). `url` is the LCM provider, by default $LCM_DEFAULT_URL, else loopback.
    `timeout` is how long one try waits for its reply, seconds; `retries` how many more tries follow.
    `name` names this program on the bus; its reply channel is made of it.
    """

    def __init__(
        self,
        url: str = "",
        *,
        channel_prefix: str = "",
        reply_prefix: str = REPLY_PREFIX,
        timeout: float = 1.0,
        retries: int = 2,
        name: str = "",
    ):
        if not timeout > 0:
            raise ValueError(f"timeout is above 0 s, got {timeout}")
        if retries < 0:
            raise ValueError(f"retries is 0 or more, got {retries}")
        self.url = resolve_url(url)
        self.timeout = timeout
        self.retries = retries
        self._channels = {kind: f"{channel_prefix}{channel}" for kind, channel in CHANNEL_OF.items()}
        # stable for a program, not random: every process on the bus keeps each channel name it ever saw
        self.reply_channel = _reply_channel(reply_prefix, name or os.path.basename(sys.argv[0] or "python"))
        # ids need to differ between programs, not to be unguessable
        self._ids = random.Random(secrets.randbits(128))
        self._lock = threading.Lock()
        self._fresh: list[bytes] = []
        self._lcm: lcm.LCM | None = open_lcm(self.url)
        self._last_asked = 0.0
        fresh = self._fresh
        # the handler does not hold this object: one that is forgotten, not closed, leaves the bus all the same
        subscription = self._lcm.subscribe(literal(self.reply_channel), lambda _, data: fresh.append(data))
        # between two questions only what others of this program's name are told can come: that is not gathered
        subscription.set_queue_capacity(UNREAD_REPLIES)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus. Further questions raise ValueError."""
        with self._lock:
            self._lcm = None

    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`.

        `at` is a time in microseconds since the Unix epoch, 0 for the latest common one; `policy` says what is
        accepted for an answer there; `wait_ms` how long the server may wait for data that cover it.
        Raises NoServerError, or the QueryError that the server meant.
        """
        return self.get_pose(
            frame_of_interest, frame_of_reference, at=at, policy=policy, wait_ms=wait_ms
        ).transformation

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return what `get_transformation` does, with the origin, the bounds and the flags beside it."""
        # by hand, not through `_ask`: this is what is asked all the time, and mostly what was asked before
        names = (self.reply_channel, frame_of_interest, frame_of_reference)
        try:
            request = write_question(self._ids.getrandbits(63), *names, at, policy, wait_ms)
        except _UNWRITABLE as error:
            raise MalformedRequestError(f"this question cannot be put into a message: {error}") from error
        reply = self._exchange(self._channels[GetTransformation], request, self.timeout + wait_ms * 1e-3)
        return known_answer(reply) or _found(_opened(reply, TransformReply).answer)

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first. Raises NoServerError."""
        return list(self._ask(GetBodyList(self._header()), NameListReply).names)

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames. Raises NoServerError, UnknownBodyError."""
        return list(self._ask(GetBodyFrameList(self._header(), body), NameListReply).names)

    def get_state_vector(
        self, *, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, through its 7-vector. Raises as `get_transformation`."""
        request = GetStateVector(self._header(), TimeQuery(at, policy, wait_ms))
        return _found(self._ask(request, StateVectorReply, wait_ms).answer).transformation

    def get_h_transform(
        self, *, inverse: bool = False, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, or with `inverse` the world's in the vehicle.

        Raises as `get_transformation`.
        """
        request = GetHTransform(self._header(), inverse, TimeQuery(at, policy, wait_ms))
        return _found(self._ask(request, TransformReply, wait_ms).answer).transformation

    def get_history(self, start_utime: int, end_utime: int, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at an even rate; times not held are left out.

        Raises NoServerError, NoPoseError, LimitError (more than 1,000 poses), MalformedRequestError.
        """
        request = GetHistory(self._header(), start_utime, end_utime, rate_hz)
        return [answer.transformation for answer in self._ask(request, HistoryReply).answers]

    def _header(self) -> RequestHeader:
        return RequestHeader(self._ids.getrandbits(63), self.reply_channel)

    def _ask(self, request: Any, reply_kind: type[R], wait_ms: int = 0) -> R:
        """Return the reply to a request. Raises NoServerError, the QueryError that the server meant, WireError."""
        try:
            data = encode(request)
        except _UNWRITABLE as error:
            raise MalformedRequestError(f"this question cannot be put into a message: {error}") from error
        channel = self._channels[type(request)]
        return _opened(self._exchange(channel, data, self.timeout + wait_ms * 1e-3), reply_kind)

    def _exchange(self, channel: str, request: bytes, patience: float) -> bytes:
        """Send a request until its reply comes. Asking twice does no harm: requests change nothing."""
        wanted = request[_ID]
        fresh = self._fresh
        with self._lock:
            bus = self._lcm
            if bus is None:
                raise ValueError("this Platform is closed")
            for tried in range(1 + self.retries):
                begin = time.monotonic()
                if tried or begin > self._last_asked + IDLE_S:
                    _discard_unread(bus)
                self._last_asked = begin
                fresh.clear()
                bus.publish(channel, request)
                left = patience
                while left > 0:
                    bus.handle_timeout(int(left * 1000) + 1 if left < LONGEST_WAIT_S else _LONGEST_WAIT_MS)
                    for reply in fresh:
                        if reply[_ID] == wanted:
                            return reply
                    fresh.clear()
                    left = begin + patience - time.monotonic()
        raise NoServerError(
            f"no reply on {self.reply_channel} to a request on {channel} at {self.url} after "
            f"{1 + self.retries} tries of {patience:g} s. Is the daemon running (modelserver run -c vehicle.yaml), "
            "on this bus ($LCM_DEFAULT_URL) and with this channel prefix?"
        )


_UNWRITABLE: Final = (struct.error, TypeError, AttributeError, UnicodeEncodeError)
"""What writing a question raises for a value that no message can hold."""


def _opened(data: bytes, kind: type[R]) -> R:
    """Return the reply in its bytes. Raises the QueryError that the server meant, WireError."""
    reply: R = decode(_REPLY_TYPES[kind], data)
    header: ReplyHeader = reply.header
    if header.status is not Status.OK:
        raise error_for_status(header.status, header.message, header.nearest)
    return reply


def _found(answer: PoseAnswer | None) -> PoseAnswer:
    if answer is None:
        raise WireError("malformed", "the server said OK but sent no pose")
    return answer


def _discard_unread(bus: lcm.LCM) -> None:
    for _ in range(UNREAD_REPLIES):
        if not bus.handle_timeout(0):
            return


def _reply_channel(prefix: str, program: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9]+", "_", program).strip("_").upper() or "CLIENT"
    return f"{prefix}{plain}"[:MAX_CHANNEL_LENGTH]
