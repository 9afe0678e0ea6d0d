"""Queries answered from a local replica instead of by the server.

A `LocalPlatform` has no socket and no clock, and answers from any `MirrorState`, such as that of a log. The replica of
`PlatformMirror` follows the server on the bus.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import weakref
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final, Self

import lcm
import numpy as np

from modelserver.client.mirror_state import NEVER, Ages, MirrorReceiver, MirrorState
from modelserver.client.remote import (
    NO_DEMAND,
    BatchQuery,
    PlatformClient,
    R,
    Time,
    concatenate,
    to_utime,
)
from modelserver.errors import MalformedRequestError, NoPoseError, OutOfDateError, WireError
from modelserver.geometry import names
from modelserver.geometry.model import CACHE_SIZE
from modelserver.messages import (
    MAX_REQUEST_INSTANTS,
    GetExplanation,
    GetHistory,
    GetHTransform,
    GetMotion,
    GetStateVector,
    Policy,
    PoseAnswer,
    PoseBatch,
    PoseDemand,
    TimeQuery,
)
from modelserver.query.answers import check_demand, complete_names, compute_answer
from modelserver.query.batch import lookup_batch
from modelserver.query.view import WORLD_FRAMES, PlatformView, complete
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.fields import MAX_UTIME, check_not_negative, check_utime, read_enum
from modelserver.wire.provider import handle_message, open_lcm, resolve_url

IN_HISTORY: Final = TimeQuery(1)
"""A time that no newer pose needs to be waited for."""

MAX_WAIT_MS: Final = (1 << 31) - 1
"""Range of the wire's field, so that a query that `Platform` cannot send is rejected here too."""


class LocalPlatform(PlatformClient):
    """The queries of `Platform`, answered from a `MirrorState`, which subclasses provide.

    `limit`: largest age of the state, seconds. `where`: place of the state for messages.
    """

    limit: float = math.inf
    where: str = "here"

    @abstractmethod
    def read_state(self) -> tuple[MirrorState, int]:
        """Return the state and the time now, microseconds of the receive clock."""

    def wait_for(self, is_enough: Callable[[], bool], seconds: float) -> bool:
        """Wait up to `seconds` for a new state with `is_enough`; return whether there is one."""
        return is_enough()

    # --- queries

    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        interest, reference, time = names.complete(interest), names.complete(reference), _make_time(at, policy, wait_ms)
        state, view, now = self._wait_until_ready(time, interest, reference)
        answer = view.transformation(interest, reference, time, now)
        if _is_static(view, interest, reference) and len(state.static_transforms) < CACHE_SIZE:
            # cached in the state of this geometry, so that a new geometry drops it
            state.static_answers[interest, reference] = answer
            state.static_transforms[interest, reference] = answer.transformation
        unmet, reason = check_demand(view, answer, demand, time, now)
        return answer._replace(unmet=unmet, unmet_reason=reason) if unmet else answer

    def _query(self, request: Any, reply_type: type[R]) -> R:
        request, time = complete_names(request), IN_HISTORY
        ends: tuple[str, ...] = (names.WORLD_UTM, "")
        if isinstance(request, GetHistory):
            _check_utimes(request.start_utime, request.end_utime)
        elif isinstance(request, (GetStateVector, GetHTransform, GetMotion, GetExplanation)):
            time = _make_time(*request.time)
            request = request._replace(time=time)
            if isinstance(request, (GetMotion, GetExplanation)):
                ends = (request.frame_of_interest, request.frame_of_reference)
        else:
            ends = ()
        _, view, now = self._wait_until_ready(time, *ends)
        (reply,) = compute_answer(view, request, now)
        assert isinstance(reply, reply_type)
        return reply

    def _query_batch(self, query: BatchQuery) -> list[PoseBatch]:
        pairs, utimes, fixed_frame, reference_at, covariance = query
        _check_utimes(reference_at, *((int(utimes.min()), int(utimes.max())) if len(utimes) else ()))
        time = TimeQuery() if fixed_frame and not reference_at else IN_HISTORY
        _, view, now = self._wait_until_ready(time, fixed_frame, *(frame for pair in pairs for frame in pair))
        chunks = np.split(utimes, range(MAX_REQUEST_INSTANTS, len(utimes), MAX_REQUEST_INSTANTS))
        return [
            concatenate(
                [
                    complete(lookup_batch(view, *pair, chunk, reference_at, fixed_frame, covariance, now))
                    for chunk in chunks
                ]
            )
            for pair in pairs
        ]

    # --- state

    def is_fresh(self, state: MirrorState, now: int) -> bool:
        """Return whether the geometry is complete, in force and not too old."""
        return state.view is not None and not state.other_revision and state.get_ages(now).geometry <= self.limit

    def _wait_until_ready(self, time: TimeQuery, *ends: str) -> tuple[MirrorState, PlatformView, int]:
        """Return the state, its view and the server's time, after waiting up to the query's wait_ms for new data.

        Raises OutOfDateError with what is missing, since when, and what to do; NoPoseError.
        """
        state, now = self.read_state()
        error = self._find_missing(state, now, time, ends)
        if time.wait_ms and (error is not None or _needs_newer_data(state, time, ends)):

            def is_ready() -> bool:
                state, now = self.read_state()
                return self._find_missing(state, now, time, ends) is None and not _needs_newer_data(state, time, ends)

            self.wait_for(is_ready, time.wait_ms * 1e-3)
            state, now = self.read_state()
            error = self._find_missing(state, now, time, ends)
        if error is not None or state.view is None:
            raise error or self._make_no_geometry_error(state, now)
        return state, state.view, state.get_service_time(now)

    def _find_missing(self, state: MirrorState, now: int, time: TimeQuery, ends: Sequence[str]) -> Exception | None:
        if state.view is None:
            return self._make_no_geometry_error(state, now)
        ages = state.get_ages(now)
        revision = state.view.model.revision
        if state.other_revision:
            return OutOfDateError(
                f"the server's poses have geometry revision {state.other_revision}, the geometry {self.where} has "
                f"revision {revision}: no complete MODEL_SNAPSHOT of the new one was received yet. It is published "
                "every few seconds (publish.snapshot_s); retry, or give wait_ms"
            )
        if ages.geometry > self.limit:
            return OutOfDateError(
                f"the geometry {self.where} (revision {revision}) was confirmed {ages.geometry:.1f} s ago, and the "
                f"limit is {self.limit:g} s: no MODEL_SNAPSHOT and no POSE came since. Is the daemon running? "
                "If it has no POSE and publishes snapshots less often (publish.snapshot_s), give a larger limit"
            )
        if not any(end in WORLD_FRAMES for end in ends):
            return None
        if state.pose_received == NEVER:
            return NoPoseError(
                f"no POSE with its POSE_ODOM was received {self.where}, so there is no pose in the world: no "
                "localization sensor is configured, none has published yet, this client started a moment ago (give "
                "wait_ms), or one of the two channels does not arrive"
            )
        latest = not time.at or time.policy in (Policy.LATEST, Policy.PREDICTED)
        if latest and ages.pose > self.limit:
            return OutOfDateError(
                f"the last POSE {self.where} is {ages.pose:.1f} s old, and the limit is {self.limit:g} s. Is the "
                "daemon running, and do its sensors publish? With publish.mode event, POSE follows their samples. "
                "Times in the history are still answered: give at="
            )
        return None

    def _make_no_geometry_error(self, state: MirrorState, now: int) -> OutOfDateError:
        last = "" if state.pose_received == NEVER else f" (last POSE {state.get_ages(now).pose:.1f} s ago)"
        return OutOfDateError(
            f"no complete MODEL_SNAPSHOT was received {self.where} yet{last}, so the geometry is unknown. The server "
            "publishes it at its start and every few seconds (publish.snapshot_s): wait for it with wait(), or give "
            "wait_ms. Is the daemon running, on this bus ($LCM_DEFAULT_URL) and with this channel prefix?"
        )


def _needs_newer_data(state: MirrorState, time: TimeQuery, ends: Sequence[str]) -> bool:
    return state.view is None or state.view.is_awaiting_data(time, *(ends[0], ends[1] or state.view.base_frame))


def _is_static(view: PlatformView, interest: str, reference: str) -> bool:
    """Return whether two frames are rigidly connected: neither is a world frame, and no joint moves between them."""
    if interest in WORLD_FRAMES or reference in WORLD_FRAMES:
        return False
    return not view.model.get_kinematic_path(interest, reference).joints


def _make_time(at: int, policy: Policy, wait_ms: int) -> TimeQuery:
    """Return the time of a query. Raises MalformedRequestError for one that the server would reject."""
    try:
        if isinstance(at, float):
            raise MalformedRequestError(f"at must be integer microseconds since 1970, got {at!r}; write int(...)")
        if wait_ms > MAX_WAIT_MS:
            raise MalformedRequestError(f"wait_ms {wait_ms} is above {MAX_WAIT_MS}")
        return TimeQuery(
            check_utime(at, "at"), read_enum(Policy, policy, "policy"), check_not_negative(wait_ms, "wait_ms")
        )
    except (WireError, TypeError) as error:
        raise MalformedRequestError(str(error)) from None


def _check_utimes(*utimes: int) -> None:
    for utime in utimes:
        if not 0 <= utime < MAX_UTIME:
            raise MalformedRequestError(f"{utime} is no time in microseconds since 1970")


# --- the mirror -------------------------------------------------------------------------------------------------------

log = logging.getLogger(__name__)

POLL_S: Final = 0.1
"""Longest wait of the listener thread on the bus, and so the delay with which an expired replica is noticed."""

MAX_BATCH: Final = 200
"""Messages processed before the state is published: a flood must not delay it."""

QUEUE_CAPACITY: Final = 10_000
"""Queued messages of a channel: all parts of a large geometry arrive at once."""

JOIN_TIMEOUT_S: Final = 2.0


class PlatformMirror(LocalPlatform):
    """Answer the queries of `Platform` from a replica of geometry, joints and poses that follows the server.

        with modelserver.PlatformMirror() as mirror:
            mirror.wait(10.0)
            mirror.get_transformation("Digiclops:ImagePlane", "World:UTM")

    A thread of its own subscribes, on an LCM instance of its own; any number of threads may query without waiting for
    each other. Poses of the vehicle are those of POSE: in timer mode the server predicts them to the time of sending,
    and flags them so.

    Parameters
    ----------
    url
        LCM provider, default $LCM_DEFAULT_URL, else loopback.
    limit
        Largest age of the replica, seconds. Beyond it queries raise OutOfDateError; `age` is the age now.
    clock
        Returns microseconds of a monotonic clock; for tests.
    """

    def __init__(
        self,
        url: str = "",
        *,
        channel_prefix: str = "",
        limit: float = 10.0,
        clock: Callable[[], int] = lambda: time.monotonic_ns() // 1000,
    ):
        if not limit > 0:
            raise ValueError(f"limit must be above 0 s, got {limit}")
        self.url = resolve_url(url)
        self.limit = limit
        self.where = f"at {self.url}" + (f" with prefix {channel_prefix!r}" if channel_prefix else "")
        self._clock = clock
        self._receiver = MirrorReceiver(channel_prefix)
        self._state = self._receiver.state
        # caches of the state, emptied when it is out of date
        self._static_transforms: dict[tuple[str, str], Transformation] = {}
        self._static_answers: dict[tuple[str, str], PoseAnswer] = {}
        self._changed = threading.Condition()
        self._stop = threading.Event()
        bus = open_lcm(self.url)
        self._thread = threading.Thread(
            # a weak reference, so that a mirror that is deleted without close() also ends its thread
            target=_listen,
            args=(weakref.ref(self), bus, self._stop),
            name="PlatformMirror",
            daemon=True,
        )
        self._thread.start()

    def close(self) -> None:
        """Leave the bus. Further queries raise ValueError."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_TIMEOUT_S)
        self._static_transforms, self._static_answers = {}, {}
        with self._changed:
            self._changed.notify_all()

    # Without `*` before `at`, unlike `Platform`: keyword-only defaults cost a cached lookup 20 % of its time.
    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`; see `Platform.get_transformation`.

        Raises OutOfDateError where the replica is incomplete or too old, and the QueryErrors of `Platform`.
        """
        try:
            return self._static_transforms[frame_of_interest, frame_of_reference]
        except KeyError:
            return self._query_pose(frame_of_interest, frame_of_reference, to_utime(at), policy, wait_ms).transformation

    def _query_pose(
        self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int, demand: PoseDemand = NO_DEMAND
    ) -> PoseAnswer:
        known = self._static_answers.get((interest, reference)) if demand is NO_DEMAND else None
        return known or super()._query_pose(interest, reference, at, policy, wait_ms, demand)

    @property
    def age(self) -> Ages:
        """Seconds since the geometry was confirmed, and a pose and a joint were received; infinite for never."""
        known, now = self._state, self._clock()
        return known.get_ages(now)

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        """Number of rejected messages by channel and reason."""
        return dict(self._receiver.rejected)

    def wait(self, timeout: float = 10.0, *, pose: bool = True) -> Self:
        """Wait for the geometry, and with `pose` for a pose; return self. Raises OutOfDateError."""

        def is_ready() -> bool:
            known, now = self.read_state()
            return self.is_fresh(known, now) and (not pose or known.get_ages(now).pose <= self.limit)

        if not self.wait_for(is_ready, timeout):
            self._wait_until_ready(IN_HISTORY)
            raise OutOfDateError(
                f"no POSE with its POSE_ODOM was received {self.where} within {timeout:g} s, only the geometry. Do the "
                "sensors publish? For a vehicle file without sensors call wait(pose=False)"
            )
        return self

    # --- state

    def read_state(self) -> tuple[MirrorState, int]:
        """Return the replica and the time of its clock. Raises ValueError when closed."""
        if self._stop.is_set():
            raise ValueError("this PlatformMirror is closed")
        return self._state, self._clock()

    def wait_for(self, enough: Callable[[], bool], seconds: float) -> bool:
        """Wait up to `seconds` for a new state with `is_enough`; return whether there is one."""
        with self._changed:
            return self._changed.wait_for(enough, seconds)

    def process_messages(self, messages: list[tuple[str, bytes]]) -> None:
        """Process received messages and check the age of the state; called by the listener thread."""
        now, knowledge = self._clock(), self._receiver
        for channel, data in messages:
            knowledge.feed(channel, data, now)
        known, before = knowledge.state, self._state
        self._state = known
        self._static_transforms, self._static_answers = (
            (known.static_transforms, known.static_answers) if self.is_fresh(known, now) else ({}, {})
        )
        if known is not before:
            with self._changed:
                self._changed.notify_all()

    @property
    def channels(self) -> tuple[str, ...]:
        return self._receiver.channels


def _listen(mirror_ref: weakref.ref[PlatformMirror], bus: lcm.LCM, stop: threading.Event) -> None:
    """Pass messages from a bus to a mirror until it is closed or deleted."""
    received: list[tuple[str, bytes]] = []
    subscribed: set[str] = set()
    while not stop.is_set():
        mirror = mirror_ref()
        if mirror is None:
            return
        try:
            mirror.process_messages(received)
        except Exception:
            # one message must not end the thread; a state that is not updated expires
            log.exception("internal error in PlatformMirror")
        received.clear()
        for channel in mirror.channels:
            if channel not in subscribed:
                subscribed.add(channel)
                subscription = bus.subscribe(
                    to_subscription_pattern(channel), lambda channel, data: received.append((channel, data))
                )
                subscription.set_queue_capacity(QUEUE_CAPACITY)
        del mirror
        handle_message(bus, int(POLL_S * 1000))
        while len(received) < MAX_BATCH and handle_message(bus):
            pass
