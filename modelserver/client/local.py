"""Queries answered from a local replica instead of by the server. No socket, no clock."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from modelserver.client.batch_reply import BatchQuery, concatenate
from modelserver.client.interface import NO_DEMAND, PlatformClient, R
from modelserver.client.mirror_state import NEVER, MirrorState
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
from modelserver.query import WORLD_FRAMES, PlatformView
from modelserver.query.answers import compute_answer
from modelserver.query.batch import lookup_batch
from modelserver.query.demand import check_demand
from modelserver.query.steps import complete
from modelserver.wire.fields import MAX_UTIME, check_not_negative, check_utime, read_enum

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
        time = _make_time(at, policy, wait_ms)
        state, view, now = self._wait_until_ready(time, interest, reference)
        answer = view.transformation(interest, reference, time, now)
        if _is_static(view, interest, reference) and len(state.static_transforms) < CACHE_SIZE:
            # cached in the state of this geometry, so that a new geometry drops it
            state.static_answers[interest, reference] = answer
            state.static_transforms[interest, reference] = answer.transformation
        unmet, reason = check_demand(view, answer, demand, time, now)
        return answer._replace(unmet=unmet, unmet_reason=reason) if unmet else answer

    def _query(self, request: Any, reply_type: type[R]) -> R:
        time = IN_HISTORY
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
