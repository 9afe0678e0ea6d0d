"""Platform: the client that sends each query as a request and waits for the reply of the server.

Exchange: publish the request, wait `timeout` seconds for a reply with its id, retry `retries` times. Queries change
nothing, so a retry is safe; commands are sent once and wait the whole time. A batch reply is complete when all its
parts are (`batch_reply`).
"""

from __future__ import annotations

import os
import random
import re
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
from modelserver.client.batch_reply import BatchReplyAssembler, check_batch, concatenate
from modelserver.client.commands import Signer, load_signer
from modelserver.errors import MalformedRequestError, NoServerError, Status, WireError, make_status_error
from modelserver.messages import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    MAX_REQUEST_INSTANTS,
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
    MotionAnswer,
    MotionReply,
    NameListReply,
    Policy,
    PoseAnswer,
    PoseBatch,
    PoseBatchReply,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    RequestHeader,
    StateVectorReply,
    TimeQuery,
    TransformReply,
)
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import REPLY_PREFIX, to_subscription_pattern
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import handle_message, open_lcm, resolve_url
from modelserver.wire.queries import pack_get_transformation, read_answer

R = TypeVar(
    "R",
    TransformReply,
    NameListReply,
    StateVectorReply,
    HistoryReply,
    PoseBatchReply,
    MotionReply,
    ExplanationReply,
    ReloadReply,
    Acknowledgement,
)

A = TypeVar("A")

_REPLY_TYPES = {
    TransformReply: "get_transformation_reply_t",
    NameListReply: "name_list_reply_t",
    StateVectorReply: "get_state_vector_reply_t",
    HistoryReply: "get_history_reply_t",
    PoseBatchReply: "get_transformations_reply_t",
    MotionReply: "get_motion_reply_t",
    ExplanationReply: "get_explanation_reply_t",
    **commands.REPLY_TYPES,
}

REPLY_QUEUE_CAPACITY: Final = 64
"""Queued replies; further ones are lost."""

IDLE_S: Final = 0.01
"""After this time without a request, queued replies (to programs of the same name) are discarded first."""

MAX_WAIT_S: Final = 60.0
_MAX_WAIT_MS: Final = 60_000
"""LCM's timeout is an int of milliseconds: a longer wait is split."""

_REQUEST_ID: Final = slice(8, 16)
"""Bytes of the request's id in every request and reply: the first field after the fingerprint."""


class Platform:
    """Query the running server.

        with modelserver.Platform() as platform:
            platform.get_transformation("Digiclops:ImagePlane", "World:UTM")

    It has an LCM instance of its own, so it may be used inside another instance's handler, and by several threads (one
    request at a time).

    Parameters
    ----------
    url
        LCM provider, default $LCM_DEFAULT_URL, else loopback.
    channel_prefix, reply_prefix
        Prefix of the vehicle's channels and of reply channels.
    timeout
        Wait for a reply before the next try, seconds.
    retries
        Number of further tries.
    name
        Name of this program on the bus, from which its reply channel is made; default: the script's name.
    key_file
        The vehicle's key, default $MODELSERVER_KEY_FILE: commands must be signed with it. Read when first needed.
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
            raise ValueError(f"timeout must be above 0 s, got {timeout}")
        if retries < 0:
            raise ValueError(f"retries must be 0 or more, got {retries}")
        self.url = resolve_url(url)
        self.timeout = timeout
        self.retries = retries
        self._key_file, self._prefix = os.fspath(key_file), channel_prefix
        self._signer: Signer | None = None
        self._channels = {kind: f"{channel_prefix}{channel}" for kind, channel in CHANNEL_OF.items()}
        # the same at each start, not random: every process on the bus stores each channel name it ever received
        self._name = name or os.path.basename(sys.argv[0] or "python")
        self.reply_channel = _make_reply_channel(reply_prefix, self._name)
        # ids need to differ between programs, not to be unguessable
        self._ids = random.Random(secrets.randbits(128))
        self._lock = threading.Lock()
        self._received: list[bytes] = []
        self._lcm: lcm.LCM | None = open_lcm(self.url)
        self._last_request = 0.0
        received = self._received
        # the handler holds no reference to self, so that an object that is deleted without close() leaves the bus
        subscription = self._lcm.subscribe(
            to_subscription_pattern(self.reply_channel), lambda _, data: received.append(data)
        )
        # between two requests only replies to programs of the same name arrive
        subscription.set_queue_capacity(REPLY_QUEUE_CAPACITY)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus. Further queries raise ValueError."""
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

        Parameters
        ----------
        frame_of_interest, frame_of_reference
            Body:Frame.
        at
            Time in microseconds since the Unix epoch, 0 for the latest common one.
        policy
            What is accepted at that time: interpolated, latest, held (the last value before it) or predicted data.
        wait_ms
            How long the server may wait for data that cover it.

        Raises
        ------
        NoServerError
            No reply was received.
        QueryError
            The reason in the reply.
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
        """Return the transformation with its origin, protection levels and quality flags."""
        # packed without `_request`: the hot path
        names = (self.reply_channel, frame_of_interest, frame_of_reference)
        try:
            request = pack_get_transformation(self._ids.getrandbits(63), *names, at, policy, wait_ms)
        except _ENCODE_ERRORS as error:
            raise _to_malformed_request(error, at) from error
        reply = self._exchange(self._channels[GetTransformation], request, self.timeout + wait_ms * 1e-3)
        return decode_pose_reply(reply, frame_of_interest, frame_of_reference)

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first. Raises NoServerError."""
        return list(self._request(GetBodyList(self._header()), NameListReply).names)

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames. Raises NoServerError, UnknownBodyError."""
        return list(self._request(GetBodyFrameList(self._header(), body), NameListReply).names)

    def get_state_vector(
        self, *, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, through its 7-vector. Raises as `get_transformation`."""
        request = GetStateVector(self._header(), TimeQuery(at, policy, wait_ms))
        return _require_answer(self._request(request, StateVectorReply, wait_ms).answer).transformation

    def get_h_transform(
        self, *, inverse: bool = False, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, with `inverse` the pose of World:UTM in the vehicle.

        Raises as `get_transformation`.
        """
        request = GetHTransform(self._header(), inverse, TimeQuery(at, policy, wait_ms))
        return _require_answer(self._request(request, TransformReply, wait_ms).answer).transformation

    def get_history(self, start_utime: int, end_utime: int, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at a fixed rate; times outside the history are left out.

        Raises NoServerError, NoPoseError, LimitError (more than 1,000 poses), MalformedRequestError.
        """
        request = GetHistory(self._header(), start_utime, end_utime, rate_hz)
        return [answer.transformation for answer in self._request(request, HistoryReply).answers]

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[int] | npt.NDArray[np.int64],
        *,
        fixed_frame: str = "",
        reference_at: int = 0,
        covariance: bool = True,
    ) -> list[PoseBatch]:
        """Return for each pair (frame of interest, frame of reference) its poses at all times `at`.

        A time without data has a status with the reason, and a pose of nan.

        Parameters
        ----------
        pairs
            Frames of interest and reference.
        at
            (n,) times, microseconds since the Unix epoch.
        fixed_frame
            If given, the frame of reference is taken at `reference_at` instead of at each time, through this frame,
            which is assumed stationary between the times: Odom:Origin for short ones (tf2's "advanced" lookup).
        reference_at
            Time of the frame of reference with `fixed_frame`, 0 for the latest.
        covariance
            Whether to compute covariances.

        Raises
        ------
        NoServerError, QueryError
            As `get_transformation`; MalformedRequestError also for too many pairs, non-integer times, and with
            `fixed_frame` and a `reference_at` of 0 for more times than one request holds.
        """
        wanted, utimes = check_batch(pairs, at)
        most = MAX_REQUEST_INSTANTS // len(wanted)
        if fixed_frame and not reference_at and len(utimes) > most:
            raise MalformedRequestError(
                f"{len(utimes)} times of {len(wanted)} pairs need several requests of {most}, whose latest times "
                "differ; give reference_at, or fewer times"
            )
        batches = []
        for start in range(0, max(len(utimes), 1), most):
            chunk = utimes[start : start + most]
            parts = BatchReplyAssembler(lambda data: _decode_reply(data, PoseBatchReply))
            self._request(
                GetTransformations(
                    self._header(), wanted, tuple(chunk.tolist()), fixed_frame, reference_at, covariance
                ),
                PoseBatchReply,
                is_complete=parts.add,
            )
            batches.append(parts.join(wanted, chunk))
        return [concatenate([batch[number] for batch in batches]) for number in range(len(wanted))]

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
        """Return velocity and acceleration, linear and angular, of `frame_of_interest` in `frame_of_reference`.

        Vectors are along the axes of `expressed_in`, by default the frame of reference. Raises as `get_transformation`.
        """
        time = TimeQuery(at, policy, wait_ms)
        request = GetMotion(self._header(), frame_of_interest, frame_of_reference, expressed_in, time)
        return _require_answer(self._request(request, MotionReply, wait_ms).answer)

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return the pose with the provenance and variance share of each edge on its path.

        Raises as `get_transformation`.
        """
        time = TimeQuery(at, policy, wait_ms)
        request = GetExplanation(self._header(), frame_of_interest, frame_of_reference, time)
        return _require_answer(self._request(request, ExplanationReply, wait_ms).answer)

    def reload_model(self, *, dry_run: bool = False) -> ReloadReply:
        """Reload the server's geometry file; return its revision and the changes, one per line.

        With `dry_run` nothing is changed. Raises NoServerError; ForbiddenError if the vehicle file or the signature
        does not permit it; KeyFileError; RejectedError if the file is wrong or does not fit the vehicle: the geometry
        in force stays.
        """
        return self._request(ReloadModel(self._header(), dry_run), ReloadReply)

    def set_state_vector(self, pose: Transformation) -> Acknowledgement:
        """Set the pose of the vehicle, the base frame in World:UTM, through a 7-vector.

        `pose` is as `get_state_vector` returns it: of the base frame, at its `utime` (0: now), from the origin of its
        `origin_id` (0: the server's), with its covariance (None: 1 m and 5 degrees). It is fused like a measurement of
        source "operator"; LOCALIZATION_DECISIONS carries the decision on it, at the `header.utime` of the returned
        reply where `utime` is 0. Sent once: after NoServerError it may still have been accepted. Raises ForbiddenError,
        KeyFileError, RejectedError.
        """
        return self._request(commands.make_set_pose_request(self._header(), pose, as_vector=True), Acknowledgement)

    def set_h_transform(self, pose: Transformation) -> Acknowledgement:
        """Set the pose as `set_state_vector`, through a homogeneous transform."""
        return self._request(commands.make_set_pose_request(self._header(), pose, as_vector=False), Acknowledgement)

    def _header(self) -> RequestHeader:
        return RequestHeader(self._ids.getrandbits(63), self.reply_channel)

    def _request(
        self, request: Any, reply_kind: type[R], wait_ms: int = 0, is_complete: Callable[[bytes], bool] | None = None
    ) -> R:
        """Return the reply to a request, for a batch its last part. Raises NoServerError, QueryError, WireError."""
        try:
            data = encode(request)
        except _ENCODE_ERRORS as error:
            raise _to_malformed_request(error, getattr(getattr(request, "time", None), "at", 0)) from error
        channel = self._channels[type(request)]
        timeout, tries = self.timeout + wait_ms * 1e-3, 1 + self.retries
        request_id = data[_REQUEST_ID]
        if isinstance(request, commands.COMMANDS):
            timeout, tries = timeout * tries, 1
            self._signer = self._signer or load_signer(self._key_file, self._prefix, self._name)
            # without a key it is sent unsigned: the server's reply explains how to sign
            if self._signer is not None:
                channel, data = self._signer.channel, self._signer.seal(CHANNEL_OF[type(request)], data)
        return _decode_reply(self._exchange(channel, data, timeout, is_complete, tries, request_id), reply_kind)

    def _exchange(
        self,
        channel: str,
        request: bytes,
        timeout: float,
        is_complete: Callable[[bytes], bool] | None = None,
        tries: int = 0,
        request_id: bytes = b"",
    ) -> bytes:
        """Send a request up to `tries` times (0: 1 + retries) until a reply with its id is complete; return that."""
        tries = tries or 1 + self.retries
        request_id = request_id or request[_REQUEST_ID]
        received = self._received
        with self._lock:
            bus = self._lcm
            if bus is None:
                raise ValueError("this Platform is closed")
            for tried in range(tries):
                begin = time.monotonic()
                if tried or begin > self._last_request + IDLE_S:
                    _discard_unread(bus)
                self._last_request = begin
                received.clear()
                bus.publish(channel, request)
                left = timeout
                while left > 0:
                    handle_message(bus, int(left * 1000) + 1 if left < MAX_WAIT_S else _MAX_WAIT_MS)
                    for reply in received:
                        if reply[_REQUEST_ID] == request_id and (is_complete is None or is_complete(reply)):
                            return reply
                    received.clear()
                    left = begin + timeout - time.monotonic()
        raise NoServerError(
            f"no reply on {self.reply_channel} to a request on {channel} at {self.url} after "
            f"{tries} {'try' if tries == 1 else 'tries'} of {timeout:g} s. Is the daemon running "
            "(modelserver run -c vehicle.yaml), on this bus ($LCM_DEFAULT_URL) and with this channel prefix?"
        )


_ENCODE_ERRORS: Final = (struct.error, TypeError, AttributeError, UnicodeEncodeError)
"""Errors of encoding a value that the message cannot hold."""


def _to_malformed_request(error: Exception, at: object) -> MalformedRequestError:
    if isinstance(at, float):
        return MalformedRequestError(f"at must be integer microseconds since 1970, got {at!r}; write int(...)")
    return MalformedRequestError(f"the request cannot be encoded: {error}")


def _decode_reply(data: bytes, kind: type[R]) -> R:
    """Decode a reply. Raises the QueryError in it, WireError."""
    reply: R = decode(_REPLY_TYPES[kind], data)
    header: ReplyHeader = reply.header
    if header.status is not Status.OK:
        raise make_status_error(header.status, header.message, header.nearest)
    return reply


def decode_pose_reply(data: bytes, frame_of_interest: str, frame_of_reference: str) -> PoseAnswer:
    """Decode the reply to a GetTransformation. Raises as `Platform.get_pose`."""
    try:
        answer = read_answer(data, frame_of_interest, frame_of_reference)
    except struct.error:
        answer = None  # truncated: `decode` raises the error
    return answer or _require_answer(_decode_reply(data, TransformReply).answer)


def _require_answer(answer: A | None) -> A:
    if answer is None:
        raise WireError("malformed", "the reply has status OK and no answer")
    return answer


def _discard_unread(bus: lcm.LCM) -> None:
    for _ in range(REPLY_QUEUE_CAPACITY):
        if not handle_message(bus):
            return


def _make_reply_channel(prefix: str, program: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9]+", "_", program).strip("_").upper() or "CLIENT"
    return f"{prefix}{plain}"[:MAX_CHANNEL_LENGTH]
