"""Questions answered from what is known here, instead of by the service. No socket, no clock."""

from __future__ import annotations

import math
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from modelserver.client.knowledge import NEVER, Known
from modelserver.client.parts import stacked
from modelserver.errors import MalformedRequestError, NoPoseError, OutOfDateError, WireError
from modelserver.geometry import names
from modelserver.geometry.model import CACHE_SIZE
from modelserver.messages import MOST_INSTANTS, Explanation, ManyPoses, MotionAnswer, Policy, PoseAnswer, TimeQuery
from modelserver.platform import WORLD_FRAMES, PlatformView
from modelserver.platform.explained import explained
from modelserver.platform.many import many
from modelserver.platform.moving import motion
from modelserver.spatial.transformation import Transformation
from modelserver.wire.fields import MAX_UTIME, time_query
from modelserver.wire.many import MAX_PAIRS

MAX_WAIT_MS: Final = (1 << 31) - 1
"""What the wire's field holds: a question that `Platform` cannot put is refused here too."""


class LocalPlatform(ABC):
    """The questions of `Platform`, answered from a `Known`. Who derives says what is known, and how to wait for more.

    `limit`: seconds after which knowledge is too old to answer from.
    """

    limit: float = math.inf
    where: str = "here"

    @abstractmethod
    def known(self) -> tuple[Known, int]:
        """Return what is known, and the instant it is, on the clock of reception."""

    def wait_for(self, enough: Callable[[], bool], seconds: float) -> bool:
        """Wait for so long at most until more is known and that is enough; return whether it is."""
        return enough()

    # --- the questions

    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`; see `Platform.get_transformation`.

        Raises OutOfDateError where too little is known, or too long since; the QueryErrors as `Platform` does.
        """
        return self._pose(frame_of_interest, frame_of_reference, at, policy, wait_ms).transformation

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
        return self._pose(frame_of_interest, frame_of_reference, at, policy, wait_ms)

    def _pose(self, interest: str, reference: str, at: int, policy: Policy, wait_ms: int) -> PoseAnswer:
        time = _time(at, policy, wait_ms)
        known, view, now = self._ready(time, interest, reference)
        answer = view.transformation(interest, reference, time, now)
        if _stands_still(view, interest, reference) and len(known.still) < CACHE_SIZE:
            # kept with the geometry that it is of: when that goes, it goes too
            known.answers[interest, reference] = answer
            known.still[interest, reference] = answer.transformation
        return answer

    def get_body_list(self) -> list[str]:
        """Return the names of the bodies, root first. Raises OutOfDateError."""
        return self._geometry().model.get_body_list()

    def get_body_frame_list(self, body: str) -> list[str]:
        """Return the names of a body's frames. Raises OutOfDateError, UnknownBodyError."""
        return self._geometry().model.get_body_frame_list(body)

    def get_state_vector(
        self, *, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM. Raises as `get_transformation`."""
        return self.get_h_transform(at=at, policy=policy, wait_ms=wait_ms)

    def get_h_transform(
        self, *, inverse: bool = False, at: int = 0, policy: Policy = Policy.INTERPOLATED, wait_ms: int = 0
    ) -> Transformation:
        """Return the vehicle's pose in World:UTM, or with `inverse` the world's in the vehicle.

        Raises as `get_transformation`.
        """
        time = _time(at, policy, wait_ms)
        _, view, now = self._ready(time, names.WORLD_UTM, "")
        ends = (view.base_frame, names.WORLD_UTM)
        interest, reference = reversed(ends) if inverse else ends
        return view.transformation(interest, reference, time, now).transformation

    def get_history(self, start_utime: int, end_utime: int, rate_hz: float) -> list[Transformation]:
        """Return the vehicle's poses in World:UTM at an even rate; times not held are left out.

        Raises OutOfDateError, NoPoseError, LimitError (more than 1,000 poses), MalformedRequestError.
        """
        _check_utimes(start_utime, end_utime)
        view = self._held(names.WORLD_UTM)[0]
        return [answer.transformation for answer in view.vehicle_history(start_utime, end_utime, rate_hz)]

    def get_transformations(
        self,
        pairs: Sequence[tuple[str, str]],
        at: Sequence[int] | npt.NDArray[np.int64],
        *,
        fixed_frame: str = "",
        reference_at: int = 0,
        covariance: bool = True,
    ) -> list[ManyPoses]:
        """Return for each pair its poses at all the instants `at`; see `Platform.get_transformations`.

        Raises OutOfDateError, the QueryErrors as `Platform` does; MalformedRequestError for too many pairs.
        """
        utimes = _instants(at)
        wanted = tuple((interest, reference) for interest, reference in pairs)
        if not 1 <= len(wanted) <= MAX_PAIRS:
            raise MalformedRequestError(f"1 to {MAX_PAIRS} pairs go in one question, got {len(wanted)}")
        _check_utimes(reference_at, *((int(utimes.min()), int(utimes.max())) if len(utimes) else ()))
        ends = [frame for pair in wanted for frame in pair]
        if fixed_frame and not reference_at:
            _, view, now = self._ready(TimeQuery(), fixed_frame, *ends)
        else:
            view, now = self._held(fixed_frame, *ends)
        starts = range(0, max(len(utimes), 1), MOST_INSTANTS)
        return [
            stacked(
                [
                    many(
                        view,
                        interest,
                        reference,
                        utimes[start : start + MOST_INSTANTS],
                        reference_at,
                        fixed_frame,
                        covariance,
                        now,
                    )
                    for start in starts
                ]
            )
            for interest, reference in wanted
        ]

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
        """Return how `frame_of_interest` moves in `frame_of_reference`; see `Platform.get_motion`.

        The vehicle's own velocity comes from its last poses in Odom, so it is less sure than the service's, and no
        acceleration is known. Raises as `get_transformation`.
        """
        time = _time(at, policy, wait_ms)
        _, view, now = self._ready(time, frame_of_interest, frame_of_reference)
        return motion(view, frame_of_interest, frame_of_reference, expressed_in, time, now)

    def explain(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Explanation:
        """Return what `get_pose` does, and each edge it rests on. Raises as `get_transformation`."""
        time = _time(at, policy, wait_ms)
        _, view, now = self._ready(time, frame_of_interest, frame_of_reference)
        return explained(view, frame_of_interest, frame_of_reference, time, now)

    # --- whether enough is known

    def is_fresh(self, known: Known, now: int) -> bool:
        """Return whether the geometry may be answered from."""
        return known.view is not None and not known.other_revision and known.ages(now).geometry <= self.limit

    def _geometry(self) -> PlatformView:
        return self._held()[0]

    def _held(self, *ends: str) -> tuple[PlatformView, int]:
        """Return what answers questions about times that are held, and the service's time. Raises as `_ready`."""
        _, view, now = self._ready(TimeQuery(1), *ends)
        return view, now

    def _ready(self, time: TimeQuery, *ends: str) -> tuple[Known, PlatformView, int]:
        """Return what is known, what answers a question, and the service's time; waits for more where it may.

        Raises OutOfDateError that says what is missing, since when, and what to do; NoPoseError.
        """
        known, now = self.known()
        error = self._missing(known, now, time, ends)
        if time.wait_ms and (error is not None or _awaits(known, time, ends)):

            def enough() -> bool:
                known, now = self.known()
                return self._missing(known, now, time, ends) is None and not _awaits(known, time, ends)

            self.wait_for(enough, time.wait_ms * 1e-3)
            known, now = self.known()
            error = self._missing(known, now, time, ends)
        if error is not None or known.view is None:
            raise error or self._nothing(known, now)
        return known, known.view, known.service_time(now)

    def _missing(self, known: Known, now: int, time: TimeQuery, ends: Sequence[str]) -> Exception | None:
        if known.view is None:
            return self._nothing(known, now)
        ages = known.ages(now)
        revision = known.view.model.revision
        if known.other_revision:
            return OutOfDateError(
                f"the service's poses rest on a geometry of revision {known.other_revision}, and the one known "
                f"{self.where} is {revision}: the new one's MODEL_SNAPSHOT is not whole yet. It is sent "
                "anew every few seconds (publish.snapshot_s); ask again, or give wait_ms"
            )
        if ages.geometry > self.limit:
            return OutOfDateError(
                f"the geometry {self.where} (revision {revision}) was confirmed {ages.geometry:.1f} s ago, and the "
                f"limit is {self.limit:g} s: neither MODEL_SNAPSHOT nor POSE has come since. Is the daemon running? "
                "Where it has no POSE and sends snapshots more seldom (publish.snapshot_s), give a larger limit"
            )
        if not any(end in WORLD_FRAMES for end in ends):
            return None
        if known.pose_heard == NEVER:
            return NoPoseError(
                f"no POSE with its POSE_ODOM has been heard {self.where}, so there is no pose in the world: the "
                "vehicle file names no sensor to localize by, none has spoken yet, the service has only been listened "
                "to for a moment (give wait_ms), or one of the two channels does not come through"
            )
        latest = not time.at or time.policy in (Policy.LATEST, Policy.PREDICTED)
        if latest and ages.pose > self.limit:
            return OutOfDateError(
                f"the last POSE {self.where} is {ages.pose:.1f} s old, and the limit is {self.limit:g} s. Is the "
                "daemon running, and do its sensors speak? With publish.mode event, POSE comes with their samples. "
                "Times that are held are still answered: give at="
            )
        return None

    def _nothing(self, known: Known, now: int) -> OutOfDateError:
        heard = "" if known.pose_heard == NEVER else f" (a POSE came {known.ages(now).pose:.1f} s ago)"
        return OutOfDateError(
            f"no whole MODEL_SNAPSHOT has been heard {self.where} yet{heard}, so the geometry is not known. The "
            "service sends it at its start and every few seconds (publish.snapshot_s): wait for it with wait(), or "
            "give wait_ms. Is the daemon running, on this bus ($LCM_DEFAULT_URL) and with this channel prefix?"
        )


def _awaits(known: Known, time: TimeQuery, ends: Sequence[str]) -> bool:
    return known.view is None or known.view.awaits(time, *(ends[0], ends[1] or known.view.base_frame))


def _stands_still(view: PlatformView, interest: str, reference: str) -> bool:
    """Whether the relation of two frames is the same at any time: no world, and no joint that moves between them."""
    if interest in WORLD_FRAMES or reference in WORLD_FRAMES:
        return False
    return not view.model.route(interest, reference).legs


def _time(at: int, policy: Policy, wait_ms: int) -> TimeQuery:
    """Return what time a question means. Raises MalformedRequestError for one that the service would not take."""
    try:
        if isinstance(at, float):
            raise MalformedRequestError(f"at is whole microseconds since 1970, got {at!r}: write int(...) around it")
        if wait_ms > MAX_WAIT_MS:
            raise MalformedRequestError(f"wait_ms {wait_ms} is above {MAX_WAIT_MS}")
        return time_query(at, policy, wait_ms)
    except (WireError, TypeError) as error:
        raise MalformedRequestError(str(error)) from None


def _instants(at: Sequence[int] | npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    try:
        given = np.asarray(at)
        utimes = given.astype(np.int64)
        if given.ndim == 1 and (utimes == given).all():
            return utimes
    except (TypeError, ValueError, OverflowError):
        pass
    raise MalformedRequestError(f"instants are a row of whole microseconds since 1970, got {reprlib.repr(at)}")


def _check_utimes(*utimes: int) -> None:
    for utime in utimes:
        if not 0 <= utime < MAX_UTIME:
            raise MalformedRequestError(f"{utime} is no time in microseconds since 1970")
