"""Platform: the client. Its methods look local; each asks the daemon and waits for the reply."""

from __future__ import annotations

import os
import random
import re
import reprlib
import secrets
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import lcm
import numpy as np
import numpy.typing as npt

from modelserver.client import commands
from modelserver.client.parts import Parts, stacked
from modelserver.client.signing import Signer, signer
from modelserver.errors import MalformedRequestError, NoServerError, Status, WireError, error_for_status
from modelserver.messages import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    MOST_INSTANTS,
    Acknowledgement,
    Explanation,
    ExplanationReply,
    GetBodyFrameList,
    GetBodyList,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    HistoryReply,
    ManyPoses,
    ManyReply,
    MotionAnswer,
    MotionReply,
    NameListReply,
    Policy,
    PoseAnswer,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    RequestHeader,
    StateVectorReply,
    TimeQuery,
    TransformReply,
)
from modelserver.spatial.transformation import Transformation
from modelserver.wire.channels import REPLY_PREFIX, literal
from modelserver.wire.codec import decode, encode
from modelserver.wire.many import MAX_PAIRS
from modelserver.wire.provider import open_lcm, resolve_url, take_message
from modelserver.wire.queries import read_answer, write_question

R = TypeVar(
    "R",
    TransformReply,
    NameListReply,
    StateVectorReply,
    HistoryReply,
    ManyReply,
    MotionReply,
    ExplanationReply,
    ReloadReply,
    Acknowledgement,
)

_REPLY_TYPES = {
    TransformReply: "get_transformation_reply_t",
    NameListReply: "name_list_reply_t",
    StateVectorReply: "get_state_vector_reply_t",
    HistoryReply: "get_history_reply_t",
    ManyReply: "get_transformations_reply_t",
    MotionReply: "get_motion_reply_t",
    ExplanationReply: "get_explanation_reply_t",
    **commands.REPLY_TYPES,
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
    `name` names this program on the bus; its reply channel is made of it. `key_file` holds the vehicle's key, by
    default $MODELSERVER_KEY_FILE names it: only what is signed with it may change the service. It is read when it is
    first needed.
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
        key_file: str | os.PathLike[str] = "",
    ):
        if not timeout > 0:
            raise ValueError(f"timeout is above 0 s, got {timeout}")
        if retries < 0:
            raise ValueError(f"retries is 0 or more, got {retries}")
        self.url = resolve_url(url)
        self.timeout = timeout
        self.retries = retries
        self._key_file, self._prefix = os.fspath(key_file), channel_prefix
        self._signer: Signer | None = None
        self._channels = {kind: f"{channel_prefix}{channel}" for kind, channel in CHANNEL_OF.items()}
        # stable for a program, not random: every process on the bus keeps each channel name it ever saw
        self._name = name or os.path.basename(sys.argv[0] or "python")
        self.reply_channel = _reply_channel(reply_prefix, self._name)
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
        # by hand, not through `_ask`: this is what is asked all the time, and often what was asked before
        names = (self.reply_channel, frame_of_interest, frame_of_reference)
        try:
            request = write_question(self._ids.getrandbits(63), *names, at, policy, wait_ms)
        except _UNWRITABLE as error:
            raise _unwritable(error, at) from error
        reply = self._exchange(self._channels[GetTransformation], request, self.timeout + wait_ms * 1e-3)
        return opened_pose(reply, frame_of_interest, frame_of_reference)

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

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[int] | npt.NDArray[np.int64],
        *,
        fixed_frame: str = "",
        reference_at: int = 0,
        covariance: bool = True,
    ) -> list[ManyPoses]:
        """Return for each pair, of frame of interest and frame of reference, its poses at all the instants `at`.

        With `fixed_frame` they are those at the instants in the frame of reference at `reference_at` (0: the latest),
        through a frame that is taken to stand still: Odom:Origin for short times. `at` are times in microseconds since
        the Unix epoch. What is not held at an instant has a status there that says so, and nan for a pose.
        Raises NoServerError, or the QueryError that the server meant; MalformedRequestError for too many pairs, for
        instants that are none, and for so many through a fixed frame that one question does not hold them, at a
        reference time of 0: it would be another one in each.
        """
        utimes = _instants(at)
        wanted = tuple((interest, reference) for interest, reference in pairs)
        if not 1 <= len(wanted) <= MAX_PAIRS:
            raise MalformedRequestError(f"1 to {MAX_PAIRS} pairs go in one question, got {len(wanted)}")
        # the server takes so many at once; a longer question is asked in several
        most = MOST_INSTANTS // len(wanted)
        if fixed_frame and not reference_at and len(utimes) > most:
            raise MalformedRequestError(
                f"{len(utimes)} instants of {len(wanted)} pairs take several questions of {most}, and the latest time "
                "is another one in each: give reference_at, or ask for fewer"
            )
        chunks = []
        for start in range(0, max(len(utimes), 1), most):
            some = tuple(utimes[start : start + most].tolist())
            parts = Parts(lambda data: _opened(data, ManyReply))
            self._ask(
                GetTransformations(self._header(), wanted, some, fixed_frame, reference_at, covariance),
                ManyReply,
                whole=parts.add,
            )
            chunks.append(parts.joined(wanted, utimes[start : start + most]))
        return [stacked([chunk[number] for chunk in chunks]) for number in range(len(wanted))]

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Return how `frame_of_interest` moves in `frame_of_reference`: velocity, turn rate, and how they change.

        Vectors are along the axes of `expressed_in`, by default the frame of reference. Raises as `get_transformation`.
        """
        time = TimeQuery(at, policy, wait_ms)
        request = GetMotion(self._header(), frame_of_interest, frame_of_reference, expressed_in, time)
        answer = self._ask(request, MotionReply, wait_ms).answer
        if answer is None:
            raise WireError("malformed", "the server said OK but sent no motion")
        return answer

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return what `get_pose` does, and each edge it rests on: how it was come by, its share of the variance.

        Raises as `get_transformation`.
        """
        time = TimeQuery(at, policy, wait_ms)
        request = GetExplanation(self._header(), frame_of_interest, frame_of_reference, time)
        answer = self._ask(request, ExplanationReply, wait_ms).answer
        if answer is None:
            raise WireError("malformed", "the server said OK but sent no explanation")
        return answer

    def reload_model(self, *, dry_run: bool = False) -> ReloadReply:
        """Have the service read its geometry file anew; return the file's revision and what changes, a line each.

        With `dry_run` nothing is changed. Raises NoServerError, ForbiddenError where the vehicle file does not allow
        it or the signature does not do, KeyFileError, RejectedError where the file is wrong or does not suit the
        vehicle: the geometry in force stays.
        """
        return self._ask(ReloadModel(self._header(), dry_run), ReloadReply)

    def set_state_vector(self, pose: Transformation) -> Acknowledgement:
        """Set the pose of the vehicle, the base frame in World:UTM, through a 7-vector.

        `pose` is as `get_state_vector` returns it: of the base frame, at its `utime` (0: now), from the origin that its
        `origin_id` names (0: the service's own), as sure as its covariance says (None: 1 m and 5 degrees). It is
        fused like a measurement of source "operator"; LOCALIZATION_DECISIONS carries the decision on it, at the
        `header.utime` of the returned reply where `utime` is 0. Sent once: where NoServerError is raised it may have
        been accepted all the same. Raises ForbiddenError, KeyFileError, RejectedError.
        """
        return self._ask(commands.pose_to_set(self._header(), pose, as_vector=True), Acknowledgement)

    def set_h_transform(self, pose: Transformation) -> Acknowledgement:
        """Do what `set_state_vector` does, through a homogeneous transform."""
        return self._ask(commands.pose_to_set(self._header(), pose, as_vector=False), Acknowledgement)

    def _header(self) -> RequestHeader:
        return RequestHeader(self._ids.getrandbits(63), self.reply_channel)

    def _ask(
        self, request: Any, reply_kind: type[R], wait_ms: int = 0, whole: Callable[[bytes], bool] | None = None
    ) -> R:
        """Return the reply to a request; of one in parts, the last that came: `whole` is shown each.

        Raises NoServerError, the QueryError that the server meant, WireError.
        """
        try:
            data = encode(request)
        except _UNWRITABLE as error:
            raise _unwritable(error, getattr(getattr(request, "time", None), "at", 0)) from error
        channel = self._channels[type(request)]
        patience, tries = self.timeout + wait_ms * 1e-3, 1 + self.retries
        wanted = data[_ID]
        if isinstance(request, commands.COMMANDS):
            patience, tries = patience * tries, 1
            self._signer = self._signer or signer(self._key_file, self._prefix, self._name)
            # without a key it goes out as it is: the service says that it must be signed, and how
            if self._signer is not None:
                channel, data = self._signer.channel, self._signer.sealed(CHANNEL_OF[type(request)], data)
        return _opened(self._exchange(channel, data, patience, whole, tries, wanted), reply_kind)

    def _exchange(
        self,
        channel: str,
        request: bytes,
        patience: float,
        whole: Callable[[bytes], bool] | None = None,
        tries: int = 0,
        wanted: bytes = b"",
    ) -> bytes:
        """Send a request until its reply comes, or `whole` says so of its parts; `tries` times, 0: as `retries` says.

        `wanted` is the id of the reply, by default the one that the request begins with.
        Asking twice does no harm: questions change nothing.
        """
        tries = tries or 1 + self.retries
        wanted = wanted or request[_ID]
        fresh = self._fresh
        with self._lock:
            bus = self._lcm
            if bus is None:
                raise ValueError("this Platform is closed")
            for tried in range(tries):
                begin = time.monotonic()
                if tried or begin > self._last_asked + IDLE_S:
                    _discard_unread(bus)
                self._last_asked = begin
                fresh.clear()
                bus.publish(channel, request)
                left = patience
                while left > 0:
                    take_message(bus, int(left * 1000) + 1 if left < LONGEST_WAIT_S else _LONGEST_WAIT_MS)
                    for reply in fresh:
                        if reply[_ID] == wanted and (whole is None or whole(reply)):
                            return reply
                    fresh.clear()
                    left = begin + patience - time.monotonic()
        raise NoServerError(
            f"no reply on {self.reply_channel} to a request on {channel} at {self.url} after "
            f"{tries} {'try' if tries == 1 else 'tries'} of {patience:g} s. Is the daemon running "
            "(modelserver run -c vehicle.yaml), on this bus ($LCM_DEFAULT_URL) and with this channel prefix?"
        )


_UNWRITABLE: Final = (struct.error, TypeError, AttributeError, UnicodeEncodeError)
"""What writing a question raises for a value that no message can hold."""


def _unwritable(error: Exception, at: object) -> MalformedRequestError:
    if isinstance(at, float):
        return MalformedRequestError(f"at is whole microseconds since 1970, got {at!r}: write int(...) around it")
    return MalformedRequestError(f"this question cannot be put into a message: {error}")


def _opened(data: bytes, kind: type[R]) -> R:
    """Return the reply in its bytes. Raises the QueryError that the server meant, WireError."""
    reply: R = decode(_REPLY_TYPES[kind], data)
    header: ReplyHeader = reply.header
    if header.status is not Status.OK:
        raise error_for_status(header.status, header.message, header.nearest)
    return reply


def opened_pose(data: bytes, frame_of_interest: str, frame_of_reference: str) -> PoseAnswer:
    """Return the answer in the reply to a GetTransformation. Raises as `Platform.get_pose`."""
    try:
        answer = read_answer(data, frame_of_interest, frame_of_reference)
    except struct.error:
        # cut short: `decode` says so
        answer = None
    return answer or _found(_opened(data, TransformReply).answer)


def _instants(at: Sequence[int] | npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    try:
        given = np.asarray(at)
        utimes = given.astype(np.int64)
        if given.ndim == 1 and (utimes == given).all():
            return utimes
    except (TypeError, ValueError, OverflowError):
        pass
    raise MalformedRequestError(f"instants are a row of whole microseconds since 1970, got {reprlib.repr(at)}")


def _found(answer: PoseAnswer | None) -> PoseAnswer:
    if answer is None:
        raise WireError("malformed", "the server said OK but sent no pose")
    return answer


def _discard_unread(bus: lcm.LCM) -> None:
    for _ in range(UNREAD_REPLIES):
        if not take_message(bus):
            return


def _reply_channel(prefix: str, program: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9]+", "_", program).strip("_").upper() or "CLIENT"
    return f"{prefix}{plain}"[:MAX_CHANNEL_LENGTH]
