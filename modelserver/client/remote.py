"""Clients: the queries that they have in common, and the `Platform` that asks the server.

`PlatformClient` has the signatures of the queries, their documentation, and how arguments are checked. A client defines
only how a request is answered: `Platform` sends it to the server, a `LocalPlatform` such as `PlatformMirror` computes
the answer from a replica.

Exchange: publish the request, wait `timeout` seconds for a reply with its id, retry `retries` times. Queries change
nothing, so a retry is safe; commands are sent once and wait the whole time. A batch reply is complete when all its
parts are (`BatchReplyAssembler`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import re
import reprlib
import secrets
import select
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from types import TracebackType
from typing import Any, Final, NamedTuple, Self, TypeAlias, TypeVar

import lcm
import numpy as np
import numpy.typing as npt

from modelserver.errors import MalformedRequestError, NoServerError, Status, WireError, make_status_error
from modelserver.geometry import Sigma, names
from modelserver.key_files import KEY_FILE_VARIABLE, read_keys
from modelserver.messages import (
    CHANNEL_OF,
    MAX_CHANNEL_LENGTH,
    MAX_REQUEST_INSTANTS,
    Acknowledgement,
    DynamicsAnswer,
    DynamicsReply,
    Envelope,
    Explanation,
    ExplanationReply,
    GetBodyFrameList,
    GetBodyList,
    GetDynamics,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    GetTransformation,
    GetTransformations,
    HistoryReply,
    Lifetime,
    MotionAnswer,
    MotionReply,
    NameListReply,
    Policy,
    PoseAnswer,
    PoseBatch,
    PoseBatchReply,
    PoseDemand,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    RequestHeader,
    SetFrame,
    SetHTransform,
    SetStateVector,
    StateVectorReply,
    TimeQuery,
    TransformReply,
)
from modelserver.signing import Key, sign
from modelserver.transforms.pose import Pose
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import REPLY_PREFIX, SIGNED, to_subscription_pattern
from modelserver.wire.codec import decode, encode, get_type_name, pack_get_transformation, read_answer
from modelserver.wire.fields import MAX_PAIRS
from modelserver.wire.generated import pack_pose_demand, unpack_pose_demand
from modelserver.wire.provider import Receiver, handle_message, open_lcm, open_receiver, resolve_url

Time: TypeAlias = int | datetime | np.datetime64
"""An instant: microseconds since the Unix epoch, a datetime with a time zone, or a numpy.datetime64 (UTC)."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def to_utime(time: Time) -> int:
    """Return an instant in microseconds since the Unix epoch.

    Raises MalformedRequestError for a datetime without a time zone, and for anything else, such as seconds.
    """
    if isinstance(time, int | np.integer) and not isinstance(time, bool):
        return int(time)
    if isinstance(time, datetime):
        if time.tzinfo is None:
            raise MalformedRequestError(f"{time!r} has no time zone; write datetime.now(UTC), or .astimezone()")
        return (time - _EPOCH) // timedelta(microseconds=1)
    if isinstance(time, np.datetime64) and not np.isnat(time):
        return int(time.astype("datetime64[us]").astype(np.int64))
    hint = "; write int(1e6 * seconds)" if isinstance(time, float) else ""
    raise MalformedRequestError(
        f"a time is integer microseconds since 1970, a datetime or a numpy.datetime64, got {time!r}{hint}"
    )


# --- batches ----------------------------------------------------------------------------------------------------------


class BatchQuery(NamedTuple):
    """A query of `PlatformClient.get_transformations`, with checked pairs and times."""

    pairs: tuple[tuple[str, str], ...]
    utimes: npt.NDArray[np.int64]
    fixed_frame: str
    reference_at: int
    covariance: bool


def check_batch(
    pairs: Sequence[tuple[str, str]], at: Sequence[Time] | npt.NDArray[Any]
) -> tuple[tuple[tuple[str, str], ...], npt.NDArray[np.int64]]:
    """Return the pairs and times of a batch query. Raises MalformedRequestError where the wire cannot hold them."""
    wanted = tuple((names.complete(interest), names.complete(reference)) for interest, reference in pairs)
    try:
        given = np.asarray(at)
        if given.dtype.kind == "M" or (given.dtype.kind == "O" and given.ndim == 1):
            given = np.array([to_utime(each) for each in at], dtype=np.int64)
        utimes = given.astype(np.int64)
        is_integer = given.ndim == 1 and bool((utimes == given).all())
    except (TypeError, ValueError, OverflowError):
        is_integer = False
    if not is_integer:
        raise MalformedRequestError(
            f"times must be integer microseconds since 1970, datetime or datetime64, got {reprlib.repr(at)}"
        )
    if not 1 <= len(wanted) <= MAX_PAIRS:
        raise MalformedRequestError(f"a batch query has 1 to {MAX_PAIRS} pairs, got {len(wanted)}")
    return wanted, utimes


class BatchReplyAssembler:
    """Collect the parts of one batch reply, received in any order and possibly more than once.

    A retried request is answered again from newer data: parts of two replies are not mixed.
    """

    def __init__(self, decode: Callable[[bytes], PoseBatchReply]):
        self._decode = decode
        self._answers: dict[tuple[int, int], dict[int, PoseBatchReply]] = {}
        self._parts: dict[int, PoseBatchReply] = {}

    def add(self, data: bytes) -> bool:
        """Add a part; return whether the reply is complete. Raises the QueryError in the reply, WireError."""
        part = self._decode(data)
        self._parts = self._answers.setdefault((part.header.utime, part.parts), {})
        self._parts[part.part] = part
        return len(self._parts) >= part.parts

    def join(self, pairs: tuple[tuple[str, str], ...], utimes: npt.NDArray[np.int64]) -> list[PoseBatch]:
        """Return the poses of each pair. Raises WireError where they are not those of `utimes`."""
        of_pair: dict[int, list[PoseBatchReply]] = {}
        for part in self._parts.values():
            of_pair.setdefault(part.pair, []).append(part)
        joined = []
        for number, (interest, reference) in enumerate(pairs):
            parts = sorted(of_pair.get(number, []), key=lambda part: part.first)
            held = 0
            for part in parts:
                if part.first != held:
                    raise WireError(
                        "malformed", f"a part starts at instant {part.first}, but the previous one ends at {held}"
                    )
                held += 0 if part.poses is None else len(part.poses.vectors)
            poses = concatenate([part.poses for part in parts if part.poses is not None])
            if len(poses.vectors) != len(utimes):
                raise WireError("malformed", f"{len(poses.vectors)} poses received for {len(utimes)} instants")
            joined.append(poses._replace(frame_of_interest=interest, frame_of_reference=reference, utimes=utimes))
        return joined


def concatenate(parts: list[PoseBatch]) -> PoseBatch:
    """Concatenate batches of one pair's poses in time. Raises WireError for none."""
    if not parts:
        raise WireError("malformed", "the reply has status OK and no poses")
    first, *more = parts
    if not more:
        return first
    # an array that one part does not have is none of the whole: the covariances
    columns = [[each for each in column if isinstance(each, np.ndarray)] for column in zip(*parts, strict=True)]
    return PoseBatch._make(
        np.concatenate(column) if len(column) == len(parts) else None if column else value
        for column, value in zip(columns, first, strict=True)
    )


# --- the client -------------------------------------------------------------------------------------------------------

R = TypeVar("R")
A = TypeVar("A")

NO_DEMAND: Final = PoseDemand()
"""Nothing is asked for."""


class FrameClient(ABC):
    """The queries that a geometry file can answer too."""

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
        max_horizontal: float = 0.0,
        max_heading: float = 0.0,
        max_age: float = 0.0,
        min_integrity: float = 0.0,
    ) -> PoseAnswer:
        """Return the transformation with its origin, levels and quality flags, and what it lacks of a demand.

        The result's `unmet` and `unmet_reason` are the verdict on what is asked for, each 0 for nothing.

        Parameters
        ----------
        frame_of_interest, frame_of_reference, at, policy, wait_ms
            As in `Platform.get_transformation`.
        max_horizontal, max_heading
            The errors, m and rad, may be beyond them with a probability of 1 - min_integrity at most.
        max_age
            Largest age of the newest data, s; in a `PlatformMirror` that of the newest published pose.
        min_integrity
            0 for 0.99. If it is stated the pose must be valid; without limits above the configured ones must hold with
            it.

        Raises
        ------
        QueryError
            As `Platform.get_transformation`; MalformedRequestError for a demand that cannot be.
        """
        demand = make_demand(max_horizontal, max_heading, max_age, min_integrity)
        utime = at if type(at) is int else to_utime(at)
        return self._query_pose(frame_of_interest, frame_of_reference, utime, policy, wait_ms, demand)

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first. Raises NoServerError."""
        return list(self._query(GetBodyList(self._header()), NameListReply).names)

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames. Raises NoServerError, UnknownBodyError."""
        return list(self._query(GetBodyFrameList(self._header(), body), NameListReply).names)

    def get_motion(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        expressed_in: str = "",
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> MotionAnswer:
        """Return velocity and acceleration, linear and angular, of `frame_of_interest` in `frame_of_reference`.

        Vectors are along the axes of `expressed_in`, by default the frame of reference. `PlatformMirror` estimates the
        vehicle's velocity from its poses in Odom: its sigma is larger than the server's, and its acceleration is
        unknown (nan). Raises as `get_transformation`.
        """
        time = TimeQuery(to_utime(at), policy, wait_ms)
        request = GetMotion(self._header(), frame_of_interest, frame_of_reference, expressed_in, time)
        return require_answer(self._query(request, MotionReply).answer)

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return the pose with the provenance and variance share of each edge on its path.

        Raises as `get_transformation`.
        """
        time = TimeQuery(to_utime(at), policy, wait_ms)
        request = GetExplanation(self._header(), frame_of_interest, frame_of_reference, time)
        return require_answer(self._query(request, ExplanationReply).answer)

    def get_dynamics(
        self,
        frame: str = "",
        *,
        equations: bool = False,
        floating: bool = False,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
    ) -> DynamicsAnswer:
        """Return mass, center of mass and inertia in a frame, by default the base frame, with the joints at that time.

        With `equations` also coordinates, mass matrix, gravity vector and bias vector; `floating`: of a base that moves
        in World:ENU. Needs the section `dynamics` of the vehicle file; `PlatformMirror` has none. Raises as
        `get_transformation`; ForbiddenError where it is not configured.
        """
        request = GetDynamics(self._header(), frame, equations, floating, TimeQuery(to_utime(at), policy))
        return require_answer(self._query(request, DynamicsReply).answer)

    def _header(self) -> RequestHeader:
        return RequestHeader(0, "")

    @abstractmethod
    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        """Answer `get_pose`."""

    @abstractmethod
    def _query(self, request: Any, reply_type: type[R]) -> R:
        """Return the reply to a request."""


class PlatformClient(FrameClient):
    """Annotate a parameter with this where `Platform` or `PlatformMirror` will do.

    Times are microseconds since the Unix epoch, datetime or numpy.datetime64; 0 for the latest. All methods raise
    NoServerError if the server does not answer (`PlatformMirror`: OutOfDateError where its replica is incomplete or too
    old), and a QueryError with the reason if there is no answer.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus. Further queries raise ValueError."""

    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`.

        Parameters
        ----------
        frame_of_interest, frame_of_reference
            Body:Frame; a body alone is its frame Origin, and map, odom and utm are the world frames, as in ROS.
        at
            Time: microseconds since the Unix epoch, a datetime or a numpy.datetime64; 0 for the latest common one.
        policy
            What is accepted at that time: interpolated, latest, held (the last value before it) or predicted data.
        wait_ms
            How long to wait for data that cover it.

        Raises
        ------
        NoServerError
            No reply was received; OutOfDateError where a replica is incomplete or too old.
        QueryError
            The reason in the reply.
        """
        return self._query_pose(
            frame_of_interest, frame_of_reference, at if type(at) is int else to_utime(at), policy, wait_ms
        ).transformation

    def get_state_vector(
        self, *, at: Time = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, through its 7-vector. Raises as `get_transformation`."""
        request = GetStateVector(self._header(), TimeQuery(to_utime(at), policy, wait_ms))
        return require_answer(self._query(request, StateVectorReply).answer).transformation

    def get_h_transform(
        self, *, inverse: bool = False, at: Time = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, with `inverse` the pose of World:UTM in the vehicle.

        Raises as `get_transformation`.
        """
        request = GetHTransform(self._header(), inverse, TimeQuery(to_utime(at), policy, wait_ms))
        return require_answer(self._query(request, TransformReply).answer).transformation

    def get_history(self, start_utime: Time, end_utime: Time, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at a fixed rate; times outside the history are left out.

        Raises NoServerError, NoPoseError, LimitError (more than 1,000 poses), MalformedRequestError.
        """
        request = GetHistory(self._header(), to_utime(start_utime), to_utime(end_utime), rate_hz)
        return [answer.transformation for answer in self._query(request, HistoryReply).answers]

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[Time] | npt.NDArray[Any],
        *,
        fixed_frame: str = "",
        reference_at: Time = 0,
        covariance: bool = True,
    ) -> list[PoseBatch]:
        """Return for each pair (frame of interest, frame of reference) its poses at all times `at`.

        A time without data has a status with the reason, and a pose of nan.

        Parameters
        ----------
        pairs
            Frames of interest and reference.
        at
            (n,) times.
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
            `fixed_frame` and a `reference_at` of 0 for more times than one request to the server holds.
        """
        fixed_frame = names.complete(fixed_frame)
        return self._query_batch(BatchQuery(*check_batch(pairs, at), fixed_frame, to_utime(reference_at), covariance))

    @abstractmethod
    def _query_batch(self, query: BatchQuery) -> list[PoseBatch]:
        """Answer `get_transformations`."""


def make_demand(*values: float) -> PoseDemand:
    """Return a demand on a pose. Raises MalformedRequestError for one that the server would reject."""
    if not any(values):
        return NO_DEMAND
    try:
        return unpack_pose_demand(pack_pose_demand(PoseDemand(*values)), 0)[0]
    except (WireError, struct.error) as error:
        raise MalformedRequestError(str(error)) from None


def require_answer(answer: A | None) -> A:
    """Return the answer of a reply whose status is OK. Raises WireError for none."""
    if answer is None:
        raise WireError("malformed", "the reply has status OK and no answer")
    return answer


# --- the client of a server -------------------------------------------------------------------------------------------

MAX_DISCARDED: Final = 1024
"""Queued replies that are discarded before a request."""

IDLE_S: Final = 0.01
"""After this time without a request, queued replies (to programs of the same name) are discarded first."""

RELOAD_TIMEOUT_S: Final = 60.0
"""Timeout of a reload, seconds: 20 times that of 10,000 frames."""

MAX_WAIT_S: Final = 60.0
_MAX_WAIT_MS: Final = 60_000
"""LCM's timeout is an int of milliseconds: a longer wait is split."""

_REQUEST_ID: Final = slice(8, 16)
"""Bytes of the request's id in every request and reply: the first field after the fingerprint."""


COMMANDS = (ReloadModel, SetFrame, SetStateVector, SetHTransform)
"""Requests that are not retried: a lost reply does not mean that the command was not executed."""


MAX_SENDER_LENGTH = 64


class Signer:
    """Sign the commands of one program to one vehicle. `clock` returns microseconds since the Unix epoch."""

    def __init__(self, key: Key, prefix: str, sender: str, clock: Callable[[], int] = lambda: time.time_ns() // 1000):
        self.channel = f"{prefix}{SIGNED}"
        self._key = key
        self._prefix = prefix
        self._sender = sender[:MAX_SENDER_LENGTH]
        self._clock = clock
        self._counter = 0

    def seal(self, channel: str, payload: bytes) -> bytes:
        """Return an encoded envelope with the message for `channel` (without the prefix)."""
        self._counter += 1
        envelope = Envelope("", self._sender, self._clock(), self._counter, channel, payload)
        return encode(sign(self._key, self._prefix, envelope))


def load_signer(key_file: str, prefix: str, program: str) -> Signer | None:
    """Return a signer with the first key of a file, default $MODELSERVER_KEY_FILE; None if neither is given.

    Raises KeyFileError.
    """
    path = key_file or os.environ.get(KEY_FILE_VARIABLE, "")
    if not path:
        return None
    return Signer(read_keys(path)[0], prefix, f"{program}@{socket.gethostname()}")


class Platform(PlatformClient):
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
        self._lcm: lcm.LCM | None = open_lcm(self.url)
        self._receiver = open_receiver(self.url)
        self._receiver.subscribe(self.reply_channel)
        self._poll = select.poll()
        self._poll.register(self._receiver.fileno, select.POLLIN)
        self._last_request = 0.0

    def close(self) -> None:
        """Leave the bus. Further queries raise ValueError."""
        with self._lock:
            self._lcm = None
            self._receiver.close()

    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        # packed without `_query`: the hot path
        try:
            request = pack_get_transformation(
                self._ids.getrandbits(63), self.reply_channel, interest, reference, at, policy, wait_ms, demand
            )
        except _ENCODE_ERRORS as error:
            raise _to_malformed_request(error, at) from error
        reply = self._exchange(self._channels[GetTransformation], request, self.timeout + wait_ms * 1e-3)
        return decode_pose_reply(reply, interest, reference)

    def _query_batch(self, query: BatchQuery) -> list[PoseBatch]:
        pairs, utimes, fixed_frame, reference_at, covariance = query
        most = MAX_REQUEST_INSTANTS // len(pairs)
        if fixed_frame and not reference_at and len(utimes) > most:
            raise MalformedRequestError(
                f"{len(utimes)} times of {len(pairs)} pairs need several requests of {most}, whose latest times "
                "differ; give reference_at, or fewer times"
            )
        batches = []
        for chunk in np.split(utimes, range(most, len(utimes), most)):
            parts = BatchReplyAssembler(lambda data: _decode_reply(data, PoseBatchReply))
            self._query(
                GetTransformations(self._header(), pairs, tuple(chunk.tolist()), fixed_frame, reference_at, covariance),
                PoseBatchReply,
                is_complete=parts.add,
            )
            batches.append(parts.join(pairs, chunk))
        return [concatenate([batch[number] for batch in batches]) for number in range(len(pairs))]

    def subscribe_pose(self, callback: Callable[[PoseAnswer], object] | None = None) -> PoseStream:
        """Receive the poses that the service publishes on POSE.

        With a callback, a thread calls it with each pose until `close` of the result; without, the result is iterated,
        with `for` or `async for`, and ends when it is closed.
        """
        return PoseStream(self.url, f"{self._prefix}POSE", callback)

    def reload_model(self, *, dry_run: bool = False) -> ReloadReply:
        """Reload the server's geometry file; return its revision and the changes, one per line.

        With `dry_run` nothing is changed. Raises NoServerError; ForbiddenError if the vehicle file or the signature
        does not permit it; KeyFileError; RejectedError if the file is wrong or does not fit the vehicle: the geometry
        in force stays. A large file takes seconds, for up to RELOAD_TIMEOUT_S; the server answers from the old one.
        """
        return self._change_geometry(ReloadModel(self._header(), dry_run))

    def add_frame(
        self, frame: str, pose: Pose, sigma: Sigma | None = None, *, is_permanent: bool = False
    ) -> ReloadReply:
        """Add a frame to a body while the service runs, or move one added before; the geometry file is unchanged.

        `frame` is its full name, Body:Frame, `pose` its pose in the body's coordinates, exact without `sigma`. It is
        there until the service ends, with `is_permanent` also after a restart, and after a reload of the file. For a
        pose in another frame F of the body: `get_transformation(F, "Body:Origin").pose @ pose`. For what moves use a
        joint: each change sends the whole geometry. Raises as `reload_model`; RejectedError for an unknown body, or a
        frame that the file has.
        """
        sigma = sigma or Sigma()
        lifetime = Lifetime.PERMANENT if is_permanent else Lifetime.TEMPORARY
        return self._change_geometry(SetFrame(self._header(), frame, pose, sigma.position, sigma.rotation, lifetime))

    def remove_frame(self, frame: str) -> ReloadReply:
        """Remove a frame that `add_frame` added. Raises as `add_frame`; RejectedError with those there are."""
        return self._change_geometry(SetFrame(self._header(), frame, lifetime=Lifetime.REMOVED))

    def _change_geometry(self, request: ReloadModel | SetFrame) -> ReloadReply:
        # without a server this ends at once
        self.get_body_list()
        return self._query(request, ReloadReply, timeout=RELOAD_TIMEOUT_S)

    def set_state_vector(self, pose: Transformation) -> Acknowledgement:
        """Set the pose of the vehicle, the base frame in World:UTM, through a 7-vector.

        `pose` is as `get_state_vector` returns it: of the base frame, at its `utime` (0: now), from the origin of its
        `origin_id` (0: the server's), with its covariance (None: 1 m and 5 degrees). It is fused like a measurement of
        source "operator"; LOCALIZATION_DECISIONS carries the decision on it, at the `header.utime` of the returned
        reply where `utime` is 0. Sent once: after NoServerError it may still have been accepted. Raises ForbiddenError,
        KeyFileError, RejectedError.
        """
        return self._query(SetStateVector(self._header(), PoseAnswer(pose)), Acknowledgement)

    def set_h_transform(self, pose: Transformation) -> Acknowledgement:
        """Set the pose as `set_state_vector`, through a homogeneous transform."""
        return self._query(SetHTransform(self._header(), PoseAnswer(pose)), Acknowledgement)

    def _header(self) -> RequestHeader:
        return RequestHeader(self._ids.getrandbits(63), self.reply_channel)

    def _query(
        self,
        request: Any,
        reply_type: type[R],
        is_complete: Callable[[bytes], bool] | None = None,
        timeout: float = 0.0,
    ) -> R:
        """Return the reply to a request, for a batch its last part. Raises NoServerError, QueryError, WireError.

        timeout: of a command, seconds; 0 = that of all tries.
        """
        time: TimeQuery = getattr(request, "time", TimeQuery())
        try:
            data = encode(request)
        except _ENCODE_ERRORS as error:
            raise _to_malformed_request(error, time.at) from error
        channel = self._channels[type(request)]
        seconds, tries = self.timeout + time.wait_ms * 1e-3, 1 + self.retries
        request_id = data[_REQUEST_ID]
        if isinstance(request, COMMANDS):
            seconds, tries = timeout or seconds * tries, 1
            self._signer = self._signer or load_signer(self._key_file, self._prefix, self._name)
            # without a key it is sent unsigned: the server's reply explains how to sign
            if self._signer is not None:
                channel, data = self._signer.channel, self._signer.seal(CHANNEL_OF[type(request)], data)
        return _decode_reply(self._exchange(channel, data, seconds, is_complete, tries, request_id), reply_type)

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
        receive = self._receiver.receive
        with self._lock:
            bus = self._lcm
            if bus is None:
                raise ValueError("this Platform is closed")
            for tried in range(tries):
                begin = time.monotonic()
                if tried or begin > self._last_request + IDLE_S:
                    _discard_unread(self._receiver)
                self._last_request = begin
                bus.publish(channel, request)
                left = timeout
                while left > 0:
                    self._poll.poll(int(left * 1000) + 1 if left < MAX_WAIT_S else _MAX_WAIT_MS)
                    message = receive()
                    if message is not None:
                        reply = message[1]
                        if reply[_REQUEST_ID] == request_id and (is_complete is None or is_complete(reply)):
                            return reply
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


def _decode_reply(data: bytes, reply_type: type[R]) -> R:
    """Decode a reply. Raises the QueryError in it, WireError."""
    reply: Any = decode(get_type_name(reply_type), data)
    header: ReplyHeader = reply.header
    if header.status is not Status.OK:
        raise make_status_error(header.status, header.message, header.nearest)
    assert isinstance(reply, reply_type)
    return reply


def decode_pose_reply(data: bytes, frame_of_interest: str, frame_of_reference: str) -> PoseAnswer:
    """Decode the reply to a GetTransformation. Raises as `Platform.get_pose`."""
    try:
        answer = read_answer(data, frame_of_interest, frame_of_reference)
    except struct.error:
        answer = None  # truncated: `decode` raises the error
    if answer is not None:
        return answer
    reply = _decode_reply(data, TransformReply)
    return require_answer(reply.answer)._replace(unmet=reply.unmet, unmet_reason=reply.unmet_reason)


def _discard_unread(receiver: Receiver) -> None:
    for _ in range(MAX_DISCARDED):
        if receiver.receive() is None:
            return


def _make_reply_channel(prefix: str, program: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9]+", "_", program).strip("_").upper() or "CLIENT"
    return f"{prefix}{plain}"[:MAX_CHANNEL_LENGTH]


# --- poses as they are published --------------------------------------------------------------------------------------

POLL_MS: Final = 200
"""Longest wait of the thread for a message: so long does it take to end."""

MAX_WAITING: Final = 1000
"""Poses that wait to be read; of more the oldest are lost."""

POSE_TYPE: Final = "pose_transform_t"


class PoseStream:
    """The poses on a channel, received by a thread of its own; `Platform.subscribe_pose` makes one.

        with platform.subscribe_pose() as poses:
            for pose in poses:
                ...

    It can be iterated with `for` and with `async for`; both end when it is closed. With a callback, that is called by
    the thread, and its exceptions are logged. `lost`: poses that were not read in time.
    """

    def __init__(self, url: str, channel: str, callback: Callable[[PoseAnswer], object] | None = None):
        self.lost = 0
        self._callback = callback
        self._waiting: deque[PoseAnswer] = deque()
        self._condition = threading.Condition()
        self._wake: Callable[[], object] | None = None
        self._is_closed = False
        self._bus = open_lcm(url)
        subscription = self._bus.subscribe(to_subscription_pattern(channel), self._receive)
        self._thread = threading.Thread(target=self._run, args=(subscription,), name=f"poses of {channel}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; iterations end. It may be called from the callback."""
        with self._condition:
            self._is_closed = True
            self._notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def get(self, timeout: float | None = None) -> PoseAnswer:
        """Return the next pose. Raises TimeoutError after `timeout` seconds without one, StopIteration when closed."""
        end = None if timeout is None else time.monotonic() + timeout
        with self._condition:
            while not self._waiting:
                if self._is_closed:
                    raise StopIteration
                if not self._condition.wait(None if end is None else max(0.0, end - time.monotonic())):
                    raise TimeoutError(f"no pose within {timeout:g} s: is the daemon running?")
            return self._waiting.popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> PoseAnswer:
        return self.get()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> PoseAnswer:
        loop, event = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(event.set)

        while True:
            with self._condition:
                if self._waiting:
                    return self._waiting.popleft()
                if self._is_closed:
                    raise StopAsyncIteration
                event.clear()
                self._wake = wake
            await event.wait()

    def _run(self, subscription: lcm.LCMSubscription) -> None:
        while not self._is_closed:
            handle_message(self._bus, POLL_MS)
        # leaves the bus, which the handler would keep open
        self._bus.unsubscribe(subscription)

    def _receive(self, _: str, data: bytes) -> None:
        try:
            pose: PoseAnswer = decode(POSE_TYPE, data)
        except WireError:
            return
        if self._callback is not None:
            try:
                self._callback(pose)
            except Exception:
                logging.getLogger(__name__).exception("the callback of subscribe_pose failed")
            return
        with self._condition:
            if len(self._waiting) == MAX_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(pose)
            self._notify()

    def _notify(self) -> None:
        self._condition.notify_all()
        if self._wake is not None:
            self._wake()
