"""Platform: answers where a frame is in another, at a time, over geometry and localization. Pure.

Every frame's pose in the base frame at the time asked gives every pair: `X_RI = inverse(X_BR) X_BI`. For a frame
of the vehicle it comes from the model; for a world frame it is the inverse of the vehicle's pose there, which
localization works out for each world frame by geodesy at the vehicle's position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from modelserver.errors import (
    LimitError,
    MalformedRequestError,
    NoPoseError,
    NotConnectedError,
    QueryError,
    TooNewError,
    UnknownFrameError,
    nearest_names,
    shown,
)
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.history import History, at_time
from modelserver.localization.interface import Localizer
from modelserver.messages import NAN, VALID, Estimate, Invalid, Policy, PoseAnswer, Quality, TimeQuery
from modelserver.spatial import covariance as cov
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array
from modelserver.spatial.transformation import Transformation

PREDICTION_LIMIT_S: Final = 5.0
"""How far past the newest sample a pose is predicted at most; by then its bound is long exceeded."""

HISTORY_LIMIT: Final = 1000
"""Poses in one reply to getHistory."""

WORLD_FRAMES: Final = frozenset({names.WORLD_UTM, names.WORLD_ENU, names.ODOM})


@dataclass(frozen=True, slots=True)
class PlatformView:
    """What is known now: the geometry, and where the vehicle has been.

    base_frame: the frame whose pose is asked for and published. rolling_frame: the frame that the estimates are of,
    the point of the vehicle that moves along its own x axis; empty for the base frame. doubt: what speaks against
    every pose now, besides what its own estimate says.
    """

    model: Model
    base_frame: str
    localizer: Localizer | None
    history: History
    rolling_frame: str = ""
    doubt: Invalid = VALID

    def __post_init__(self) -> None:
        if not self.rolling_frame:
            object.__setattr__(self, "rolling_frame", self.base_frame)

    def transformation(
        self, frame_of_interest: str, frame_of_reference: str, time: TimeQuery, now: int = 0
    ) -> PoseAnswer:
        """Return where a frame is in another. Raises QueryError, each kind for its own cause.

        `now` is the utime at which it is asked: the latest pose is not valid where the sensors are silent since long.
        """
        interest = frame_of_interest in WORLD_FRAMES
        reference = frame_of_reference in WORLD_FRAMES
        if not interest and not reference:
            return self._static(frame_of_interest, frame_of_reference)
        for frame, world in ((frame_of_interest, interest), (frame_of_reference, reference)):
            if not world:
                check_not_reserved(frame)
                self._check_carried(frame)
        if frame_of_interest == frame_of_reference:
            return PoseAnswer(Transformation(frame_of_interest, frame_of_reference, Pose.identity(), _ZERO))
        estimate = self.estimate(time, now)
        if interest and reference:
            X_RB = _pose_in(frame_of_reference, estimate)
            X_IB = _pose_in(frame_of_interest, estimate)
            pose, covariance = X_RB @ X_IB.inverse(), None
        elif reference:
            pose, covariance = self._in_world(frame_of_interest, frame_of_reference, estimate)
        else:
            forth, forth_cov = self._in_world(frame_of_reference, frame_of_interest, estimate)
            pose = forth.inverse()
            covariance = None if forth_cov is None else cov.invert(forth, forth_cov)
        return self._answer(frame_of_interest, frame_of_reference, pose, covariance, estimate)

    def vehicle_pose(self, time: TimeQuery, now: int = 0) -> PoseAnswer:
        """Return the base frame's pose in World:UTM; as `transformation`."""
        return self.transformation(self.base_frame, names.WORLD_UTM, time, now)

    def vehicle_history(self, start_utime: int, end_utime: int, rate_hz: float) -> tuple[PoseAnswer, ...]:
        """Return the base frame's poses in World:UTM at an even rate; times not held are left out.

        Raises MalformedRequestError for a range that ends before it starts or a rate that is not positive,
        LimitError for too many poses, NoPoseError.
        """
        if not (rate_hz > 0.0 and rate_hz < 1e6):
            raise MalformedRequestError(f"rate_hz is above 0 and below 1e6, got {rate_hz}")
        if end_utime < start_utime:
            raise MalformedRequestError(f"the range ends ({end_utime}) before it starts ({start_utime})")
        count = int((end_utime - start_utime) * 1e-6 * rate_hz + 1e-9) + 1
        if count > HISTORY_LIMIT:
            raise LimitError(f"{count} poses were asked for; at most {HISTORY_LIMIT} go in one reply. Ask in parts.")
        if self.localizer is None or not len(self.history):
            raise self._no_pose()
        answers = []
        for n in range(count):
            utime = start_utime + round(n * 1e6 / rate_hz)
            if self.history.first <= utime <= self.history.last:
                estimate = self.history.at(utime)
                if estimate.utm is not None:
                    answers.append(self.broadcast(estimate, names.WORLD_UTM))
        return tuple(answers)

    def estimate(self, time: TimeQuery, now: int = 0) -> Estimate:
        """Return the vehicle's estimate for a time, asked at `now`. Raises NoPoseError, TooOldError, TooNewError."""
        if self.localizer is None or not len(self.history):
            raise self._no_pose()
        if time.at == 0 or time.policy is Policy.LATEST:
            newest = self.history.newest
            silent = self.localizer.estimate(now).invalid & _STALE if now > newest.utime else VALID
            return newest if silent in newest.invalid else replace(newest, invalid=newest.invalid | silent)
        if time.policy is Policy.HELD:
            held = self.history.held(time.at)
            if held.utime == time.at:
                return held
            # what silence there was since speaks against it: up to the next estimate, or up to the time asked
            following = self.history.following(time.at)
            since = (following or self.localizer.estimate(time.at)).invalid
            return at_time(held, time.at, Quality.HELD, since)
        if time.policy is Policy.PREDICTED and time.at > self.history.last:
            if time.at > self.history.last + PREDICTION_LIMIT_S * 1e6:
                raise TooNewError(
                    f"{time.at} is {(time.at - self.history.last) / 1e6:.3f} s after the newest sample "
                    f"({self.history.last}); poses are predicted {PREDICTION_LIMIT_S:g} s ahead at most"
                )
            return self.localizer.estimate(time.at)
        return self.history.at(time.at)

    def covers(self, utime: int) -> bool:
        """Return whether a question about a time can be answered without predicting."""
        return len(self.history) > 0 and utime <= self.history.last

    def broadcast(self, estimate: Estimate, world: str) -> PoseAnswer:
        """Return the base frame's pose in a world frame, for publication: with reasons where there is none."""
        known = _POSE_IN[world](estimate) is not None
        pose, covariance = self._in_world(self.base_frame, world, estimate) if known else (Pose.identity(), None)
        return self._answer(self.base_frame, world, pose, covariance, estimate)

    def _static(self, frame_of_interest: str, frame_of_reference: str) -> PoseAnswer:
        """Return a relation within the vehicle: it does not change with time, so it has no stamp."""
        try:
            return PoseAnswer(self.model.get_transformation(frame_of_interest, frame_of_reference))
        except QueryError:
            check_not_reserved(frame_of_interest)
            check_not_reserved(frame_of_reference)
            raise

    def _in_world(self, frame: str, world: str, estimate: Estimate) -> tuple[Pose, Array | None]:
        X_WB = _pose_in(world, estimate)
        numbers = estimate.odom_covariance if world == names.ODOM else estimate.covariance
        if frame == self.rolling_frame:
            return X_WB, None if numbers is None else np.array(numbers).reshape(6, 6)
        mounted = self.model.get_transformation(frame, self.rolling_frame)
        if numbers is None:
            return X_WB @ mounted.pose, None
        # a mount without stated sigmas counts as exact here: the vehicle's own error is far larger
        survey = _ZERO if mounted.covariance is None else mounted.covariance
        return X_WB @ mounted.pose, cov.compose(X_WB, np.array(numbers).reshape(6, 6), mounted.pose, survey)

    def _check_carried(self, frame: str) -> None:
        """Raise where the frame does not exist, or nothing joins it to the frame whose pose is known."""
        try:
            self.model.get_transformation(frame, self.rolling_frame)
        except NotConnectedError as error:
            raise NotConnectedError(f"the world is known at {self.rolling_frame} only: {error}") from None

    def _answer(
        self, interest: str, reference: str, pose: Pose, covariance: Array | None, estimate: Estimate
    ) -> PoseAnswer:
        odom_only = names.ODOM in (interest, reference) and not (is_absolute(interest) or is_absolute(reference))
        origin = None if odom_only else estimate.origin
        invalid = self.doubt | (estimate.invalid & _ODOM_INVALID if odom_only else estimate.invalid)
        of_vehicle = self.base_frame in (interest, reference) and not odom_only
        horizontal, heading = self._bounds(estimate) if of_vehicle else (NAN, NAN)
        return PoseAnswer(
            Transformation(
                interest,
                reference,
                pose,
                covariance,
                estimate.utime,
                int(invalid),
                estimate.pose_epoch,
                0 if origin is None else origin.origin_id,
                self.model.revision,
            ),
            origin,
            estimate.quality,
            horizontal,
            heading,
            NAN if odom_only else estimate.seconds_to_limit,
        )

    def _bounds(self, estimate: Estimate) -> tuple[float, float]:
        """Return the bounds at the base frame: a heading error swings it about the rolling frame."""
        x, y, _ = self.model.get_transformation(self.base_frame, self.rolling_frame).pose.xyz
        # a chord is no longer than its arc, nor than twice the arm
        swing = math.hypot(x, y) * min(estimate.heading_bound, 2.0)
        return estimate.horizontal_bound + swing, estimate.heading_bound

    def _no_pose(self) -> NoPoseError:
        if self.localizer is None:
            return NoPoseError("the vehicle file names no GPS and IMU, so there is no pose in the world")
        invalid = self.localizer.estimate(0).invalid
        return NoPoseError(f"the vehicle's pose is not known yet: {invalid.explain() or 'no sensor sample yet'}")


_ZERO = np.zeros((6, 6))
_ODOM_INVALID = Invalid.NO_IMU | Invalid.STALE_IMU | Invalid.CLOCK_STEPPED | Invalid.TILTED
"""What speaks against a pose in Odom: it needs no fix and no origin."""

_STALE = Invalid.STALE_GPS | Invalid.STALE_IMU

_POSE_IN = {
    names.WORLD_UTM: lambda estimate: estimate.utm,
    names.WORLD_ENU: lambda estimate: estimate.enu,
    names.ODOM: lambda estimate: estimate.odom,
}


def is_absolute(frame: str) -> bool:
    """Return whether a frame is tied to the earth."""
    return frame in (names.WORLD_UTM, names.WORLD_ENU)


def check_not_reserved(frame: str) -> None:
    """Raise UnknownFrameError for a frame of the bodies World and Odom that there is not."""
    if frame.partition(":")[0] in names.RESERVED_BODIES:
        raise UnknownFrameError(
            f"there is no frame {shown(frame)}; the world frames are {', '.join(sorted(WORLD_FRAMES))}",
            nearest_names(frame, WORLD_FRAMES),
        )


def _pose_in(world: str, estimate: Estimate) -> Pose:
    pose: Pose | None = _POSE_IN[world](estimate)
    if pose is None:
        raise NoPoseError(f"the vehicle's pose in {world} is not known yet: {estimate.invalid.explain()}")
    return pose
