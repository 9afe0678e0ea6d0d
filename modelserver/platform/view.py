"""Platform: answers where a frame is in another, at a time, over geometry and localization. Pure.

Every frame's pose in the base frame at the time asked gives every pair: `X_RI = inverse(X_BR) X_BI`. For a frame
of the vehicle it comes from the model; for a world frame it is the inverse of the vehicle's pose there, which
localization works out for each world frame by geodesy at the vehicle's position.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeAlias

import numpy as np

from modelserver.errors import (
    LimitError,
    MalformedRequestError,
    NoPoseError,
    NotConnectedError,
    QueryError,
    TooNewError,
    TooOldError,
)
from modelserver.geometry import names
from modelserver.geometry.model import Model
from modelserver.geometry.path_covariance import as_array
from modelserver.geometry.route import Route
from modelserver.history import History, at_time
from modelserver.joints.joints import NO_JOINTS, Joints, JointTrack
from modelserver.localization.interface import Localizer
from modelserver.messages import (
    NAN,
    NO_FLAGS,
    SILENCE,
    VALID,
    Estimate,
    Invalid,
    Policy,
    PoseAnswer,
    Quality,
    TimeQuery,
)
from modelserver.platform.placing import NOTHING, Placed, heard, placed
from modelserver.platform.steps import Steps, complete
from modelserver.platform.worlds import WORLD_FRAMES, check_not_reserved, is_absolute, known_in, pose_in
from modelserver.spatial import covariance as cov
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array
from modelserver.spatial.transformation import Transformation

PREDICTION_LIMIT_S: Final = 5.0
"""How far past the newest sample a pose is predicted at most; by then its bound is long exceeded."""

HISTORY_LIMIT: Final = 1000
"""Poses in one reply to getHistory."""


@dataclass(frozen=True, slots=True)
class PlatformView:
    """What is known now: the geometry, and where the vehicle has been.

    base_frame: the frame whose pose is asked for and published. rolling_frame: the frame that the estimates are of,
    the point of the vehicle that moves along its own x axis; empty for the base frame. doubt: what speaks against
    every pose now, besides what its own estimate says. joints: where the joints were.
    """

    model: Model
    base_frame: str
    localizer: Localizer | None
    history: History
    rolling_frame: str = ""
    doubt: Invalid = VALID
    joints: Joints = NO_JOINTS

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
            return self._within(frame_of_interest, frame_of_reference, time, now)
        for frame, world in ((frame_of_interest, interest), (frame_of_reference, reference)):
            if not world:
                check_not_reserved(frame)
                self.check_carried(frame)
        if frame_of_interest == frame_of_reference:
            return PoseAnswer(Transformation(frame_of_interest, frame_of_reference, Pose.identity(), _ZERO))
        if interest and reference:
            estimate = self.estimate(time, now)
            X_RB = pose_in(frame_of_reference, estimate)
            X_IB = pose_in(frame_of_interest, estimate)
            return self._answer(frame_of_interest, frame_of_reference, X_RB @ X_IB.inverse(), None, estimate)
        frame, world_frame = (
            (frame_of_interest, frame_of_reference) if reference else (frame_of_reference, frame_of_interest)
        )
        route = self.route_from_vehicle(frame)
        estimate, mounted = self.moment(route, time, now)
        pose, covariance = self._in_world(frame, world_frame, estimate, route, mounted, back=not reference)
        return self._answer(frame_of_interest, frame_of_reference, pose, covariance, estimate, mounted, route)

    def _within(self, frame_of_interest: str, frame_of_reference: str, time: TimeQuery, now: int) -> PoseAnswer:
        """Return a relation within the vehicle."""
        model = self.model
        try:
            rigid = model.rigid_transformation(frame_of_interest, frame_of_reference)
            if rigid is not None:
                # it does not change with time, so it has no stamp
                return PoseAnswer(rigid)
            route = model.route(frame_of_interest, frame_of_reference)
        except QueryError:
            check_not_reserved(frame_of_interest)
            check_not_reserved(frame_of_reference)
            raise
        if not route.legs:
            fixed = PoseAnswer(model.get_transformation(frame_of_interest, frame_of_reference))
            return fixed._replace(quality=Quality.LOOP) if route.closes_loop else fixed
        utime, mounted = self.place(route, time, now)
        places = route.places(mounted.positions)
        return PoseAnswer(
            Transformation(
                frame_of_interest,
                frame_of_reference,
                route.end(places),
                lambda: route.covariance(mounted.positions, mounted.sigmas, places=places),
                utime,
                # as numbers: flags cost more to put together than the pose
                self.doubt.value & _CLOCK_STEPPED | mounted.invalid.value,
                model_revision=self.model.revision,
            ),
            quality=mounted.quality | Quality.LOOP if route.closes_loop else mounted.quality,
        )

    def route_from_vehicle(self, frame: str) -> Route:
        """Return the way from the rolling frame to a frame of the vehicle. Raises QueryError."""
        return self.model.route(frame, self.rolling_frame)

    def place(self, route: Route, time: TimeQuery, now: int) -> tuple[int, Placed]:
        """Return when and where the joints of a route stand; the latest time is that up to which all were heard."""
        if time.at and time.policy is not Policy.LATEST:
            return time.at, placed(route, self.model, self.joints, time.at, time.policy)
        tracks = heard(route, self.model, self.joints)
        # joints that nobody ever told of stand where they rest now as ever: their answer is of now
        utime = min(track.last for _, track in tracks) if tracks else now
        try:
            return utime, placed(route, self.model, self.joints, utime, Policy.INTERPOLATED, now)
        except TooOldError as error:
            raise self._no_common(tracks, error) from None

    def moment(self, route: Route, time: TimeQuery, now: int) -> tuple[Estimate, Placed]:
        """Return the vehicle's estimate and where the joints of a route from it stand, at one time."""
        if not route.legs:
            return self.estimate(time, now), NOTHING
        if time.at and time.policy is not Policy.LATEST:
            return self.estimate(time, now), placed(route, self.model, self.joints, time.at, time.policy)
        newest = self.estimate(time, now)
        tracks = heard(route, self.model, self.joints)
        utime = min((track.last for _, track in tracks), default=newest.utime)
        try:
            if utime < newest.utime:
                silent = newest.invalid & SILENCE
                newest = self.history.at(utime)
                if silent not in newest.invalid:
                    newest = replace(newest, invalid=newest.invalid | silent)
            return newest, placed(route, self.model, self.joints, newest.utime, Policy.INTERPOLATED, now)
        except TooOldError as error:
            raise self._no_common(tracks, error) from None

    def _no_common(self, tracks: list[tuple[str, JointTrack]], error: TooOldError) -> TooOldError:
        name, track = min(tracks, key=lambda each: each[1].last)
        return TooOldError(
            f"there is no time at which all that is asked for is held: joint {name} was heard last at {track.last}. "
            f"{error}. Ask with a time and policy HELD, or look for why the joint is silent"
        )

    def vehicle_pose(self, time: TimeQuery, now: int = 0) -> PoseAnswer:
        """Return the base frame's pose in World:UTM; as `transformation`."""
        return self.transformation(self.base_frame, names.WORLD_UTM, time, now)

    def vehicle_history(self, start_utime: int, end_utime: int, rate_hz: float) -> tuple[PoseAnswer, ...]:
        """Return what `vehicle_history_in_steps` does, at once."""
        return complete(self.vehicle_history_in_steps(start_utime, end_utime, rate_hz))

    def vehicle_history_in_steps(
        self, start_utime: int, end_utime: int, rate_hz: float
    ) -> Steps[tuple[PoseAnswer, ...]]:
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
            raise self.no_pose()
        answers = []
        for n in range(count):
            utime = start_utime + round(n * 1e6 / rate_hz)
            if self.history.first <= utime <= self.history.last:
                estimate = self.history.at(utime)
                if estimate.utm is not None:
                    answers.append(self.broadcast(estimate, names.WORLD_UTM))
                yield
        return tuple(answers)

    def estimate(self, time: TimeQuery, now: int = 0) -> Estimate:
        """Return the vehicle's estimate for a time, asked at `now`. Raises NoPoseError, TooOldError, TooNewError."""
        if self.localizer is None or not len(self.history):
            raise self.no_pose()
        if time.at == 0 or time.policy is Policy.LATEST:
            newest = self.history.newest
            silent = self.localizer.silence(now) if now > newest.utime else VALID
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

    def covers(self, utime: int, frame_of_interest: str = "", frame_of_reference: str = "") -> bool:
        """Return whether a question about a time can be answered without predicting; of the vehicle without frames.

        One that has no answer at all needs no waiting for.
        """
        ends = [frame for frame in (frame_of_interest, frame_of_reference) if frame not in WORLD_FRAMES and frame]
        try:
            route = self.model.route(*ends) if len(ends) == 2 else self.route_from_vehicle(ends[0]) if ends else None
        except QueryError:
            return True
        if len(ends) < 2 and (not len(self.history) or utime > self.history.last):
            return False
        if route is None:
            return True
        return all(utime <= track.last for _, track in heard(route, self.model, self.joints))

    def awaits(self, time: TimeQuery, frame_of_interest: str, frame_of_reference: str) -> bool:
        """Return whether a question will have a better answer when more has come: its time is not covered yet."""
        ends = (frame_of_interest, frame_of_reference)
        of_world = any(end.partition(":")[0] in names.RESERVED_BODIES for end in ends)
        if of_world and self.localizer is None:
            return False
        if time.at and time.policy is not Policy.LATEST:
            return not self.covers(time.at, *ends)
        return of_world and not len(self.history)

    def broadcast(self, estimate: Estimate, world: str) -> PoseAnswer:
        """Return the base frame's pose in a world frame, for publication: with reasons where there is none."""
        if known_in(world, estimate) is None:
            return self._answer(self.base_frame, world, Pose.identity(), None, estimate)
        route = self.route_from_vehicle(self.base_frame)
        pose, covariance = self._in_world(self.base_frame, world, estimate, route, NOTHING)
        return self._answer(self.base_frame, world, pose, covariance, estimate)

    def _in_world(
        self, frame: str, world: str, estimate: Estimate, route: Route, mounted: Placed, back: bool = False
    ) -> tuple[Pose, Callable[[], Array | None] | None]:
        """Return a frame's pose in a world frame, and what works out its covariance; None where nobody knows it.

        With `back` the world frame's pose in the frame.
        """
        X_WB = pose_in(world, estimate)
        numbers = estimate.odom_covariance if world == names.ODOM else estimate.covariance
        if frame == self.rolling_frame:
            at_base = None if numbers is None else partial(_back if back else _matrix, numbers, X_WB)
            return X_WB.inverse() if back else X_WB, at_base
        if route.legs:
            X_BF = route.pose(mounted.positions)
            survey = partial(_mount_covariance, route, mounted)
        else:
            fixed = self.model.get_transformation(frame, self.rolling_frame)
            X_BF = fixed.pose
            survey = partial(_fixed_covariance, fixed, route)
        carried = _carried_back if back else _carried
        X_WF = X_WB @ X_BF
        known = None if numbers is None else partial(carried, numbers, X_WB, X_BF, survey)
        return X_WF.inverse() if back else X_WF, known

    def check_carried(self, frame: str) -> None:
        """Raise where the frame does not exist, or nothing joins it to the frame whose pose is known."""
        try:
            self.model.route(frame, self.rolling_frame)
        except NotConnectedError as error:
            raise NotConnectedError(f"the world is known at {self.rolling_frame} only: {error}") from None

    def _answer(
        self,
        interest: str,
        reference: str,
        pose: Pose,
        covariance: Callable[[], Array | None] | None,
        estimate: Estimate,
        mounted: Placed = NOTHING,
        route: Route | None = None,
    ) -> PoseAnswer:
        odom_only = names.ODOM in (interest, reference) and not (is_absolute(interest) or is_absolute(reference))
        origin = None if odom_only else estimate.origin
        invalid = self.doubt | (estimate.invalid & ODOM_INVALID if odom_only else estimate.invalid) | mounted.invalid
        quality = estimate.quality
        if route is not None:
            quality |= mounted.quality | (Quality.LOOP if route.closes_loop else NO_FLAGS)
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
            quality,
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

    def no_pose(self) -> NoPoseError:
        """Return the error that says why there is no pose in the world."""
        if self.localizer is None:
            return NoPoseError("the vehicle file names no GPS and IMU, so there is no pose in the world")
        invalid = self.localizer.estimate(0).invalid
        return NoPoseError(f"the vehicle's pose is not known yet: {invalid.explain() or 'no sensor sample yet'}")


_ZERO = np.zeros((6, 6))
_CLOCK_STEPPED: Final = Invalid.CLOCK_STEPPED.value
ODOM_INVALID = Invalid.NO_IMU | Invalid.STALE_IMU | Invalid.CLOCK_STEPPED | Invalid.TILTED
"""What speaks against a pose in Odom: it needs no fix and no origin."""


Survey: TypeAlias = Callable[[], Array | None]
"""Works out how sure the way from the vehicle to a frame is."""


def _matrix(numbers: tuple[float, ...], X_WB: Pose) -> Array:
    return np.array(numbers).reshape(6, 6)


def _back(numbers: tuple[float, ...], X_WB: Pose) -> Array:
    """Return the covariance of a world in the vehicle: its origin is at the end of a long lever."""
    return cov.rotated(X_WB.rotation.T, cov.at_end(_matrix(numbers, X_WB), -X_WB.position))


def _carried(numbers: tuple[float, ...], X_WB: Pose, X_BF: Pose, survey: Survey) -> Array | None:
    """Return the covariance of a frame of the vehicle in a world."""
    mounted = survey()
    if mounted is None:
        return None
    # before the vehicle has moved its heading may be off by tens of degrees
    return cov.at_end(_matrix(numbers, X_WB), X_WB.rotation @ X_BF.position) + cov.rotated(X_WB.rotation, mounted)


def _carried_back(numbers: tuple[float, ...], X_WB: Pose, X_BF: Pose, survey: Survey) -> Array | None:
    """Return the covariance of a world in a frame of the vehicle."""
    mounted = survey()
    if mounted is None:
        return None
    return cov.compose(X_BF.inverse(), cov.invert(X_BF, mounted), X_WB.inverse(), _back(numbers, X_WB))


def _mount_covariance(route: Route, mounted: Placed) -> Array | None:
    """Return the covariance of a route from the vehicle with its joints where they stand.

    A mount without stated sigmas counts as exact here: the vehicle's own error is far larger. A joint of which nobody
    told how sure it is does not: a long arm on it may be anywhere.
    """
    found = route.covariance(mounted.positions, mounted.sigmas, unstated_is_exact=True)
    return None if found is None else as_array(found)


def _fixed_covariance(fixed: Transformation, route: Route) -> Array | None:
    found = fixed.covariance
    return _mount_covariance(route, NOTHING) if found is None else found
