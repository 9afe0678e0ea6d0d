"""The queries that clients have in common: their signatures, their documentation, and how arguments are checked.

A client defines only how a request is answered: `Platform` sends it to the server, a `LocalPlatform` such as
`PlatformMirror` computes the answer from a replica.
"""

from __future__ import annotations

import reprlib
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from types import TracebackType
from typing import Any, Final, NamedTuple, Self, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from modelserver.errors import MalformedRequestError, WireError
from modelserver.messages import (
    DynamicsAnswer,
    DynamicsReply,
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
    HistoryReply,
    MotionAnswer,
    MotionReply,
    NameListReply,
    Policy,
    PoseAnswer,
    PoseBatch,
    PoseBatchReply,
    PoseDemand,
    RequestHeader,
    StateVectorReply,
    TimeQuery,
    TransformReply,
)
from modelserver.transforms.transformation import Transformation
from modelserver.wire.fields import MAX_PAIRS
from modelserver.wire.generated import pack_pose_demand, unpack_pose_demand

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
    wanted = tuple((interest, reference) for interest, reference in pairs)
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
            Body:Frame.
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
