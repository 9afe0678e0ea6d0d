"""PlatformView: answers queries from an immutable view of geometry, joints and estimates. Pure.

Time travel: the state history gives estimates, joints their readings at the time of the query (`lookup_joints`). The
poses of all frames in the base frame at that time give every pair: `X_RI = inverse(X_BR) X_BI`. For a frame of the
vehicle it comes from the model and the joints; for a world frame it is the inverse of the vehicle's pose there, which
localization computes for each world frame by geodesy at the vehicle's position.

Covariances: the vehicle's is transported to a frame by the lever arm, also for large heading errors
(`transforms.covariance`), and the independent one of the mount and its joints is added.

A long computation is a generator that yields between steps and returns the result (`Steps`): the server runs a step of
about half a millisecond between its ticks; other callers `complete` the work at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple, TypeAlias, TypeVar

import numpy as np

from modelserver import errors
from modelserver.dynamics.stability import DynamicsSettings
from modelserver.estimation.history import History, Localizer, restamp
from modelserver.geometry import names
from modelserver.geometry.joint import Coordinates
from modelserver.geometry.kinematic_path import KinematicPath, as_array
from modelserver.geometry.model import Model
from modelserver.geometry.parts import JointDrive
from modelserver.joints import MAX_CLOCK_LEAD_S, NO_JOINTS, JointHistory
from modelserver.joints.track import MAX_GAP_S, ROTATION_VECTOR_TYPES, JointTrack, Provenance, Reading, combine
from modelserver.messages import (
    NAN,
    NO_FLAGS,
    STALE_SENSORS,
    VALID,
    Estimate,
    Invalid,
    Policy,
    PoseAnswer,
    Quality,
    TimeQuery,
)
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import (
    Numbers,
    Transformation,
    apply_lever_arm,
    compose_covariance,
    invert_covariance,
    rotate_covariance,
)

T = TypeVar("T")

Steps: TypeAlias = Generator[None, None, T]


def complete(work: Steps[T]) -> T:
    """Run all steps and return the result. Raises what the steps raise."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: T = end.value
            return result


# --- joints -----------------------------------------------------------------------------------------------------------

_QUALITY_OF: Mapping[Provenance, int] = {
    Provenance.MEASURED: 0,
    Provenance.INTERPOLATED: Quality.INTERPOLATED.value,
    Provenance.HELD: Quality.HELD.value,
    Provenance.PREDICTED: Quality.PREDICTED.value,
    Provenance.DEFAULT: Quality.JOINT_DEFAULT.value,
}

# looked up once: accessing an enumeration member costs more than the arithmetic around it
_DEFAULT, _OUT_OF_LIMITS = Provenance.DEFAULT, Quality.OUT_OF_LIMITS.value
_UNKNOWN, _STALE = Invalid.JOINT_UNKNOWN.value, Invalid.STALE_JOINT.value


class JointReadings(NamedTuple):
    """The joints of a path at an instant: a reading for each coordinate, and reasons and flags for them all."""

    positions: tuple[Coordinates, ...]
    readings: tuple[tuple[Reading, ...], ...]
    invalid: Invalid = VALID
    quality: Quality = NO_FLAGS

    @property
    def sigmas(self) -> list[Coordinates]:
        """The sigmas of the coordinates, nan where unknown."""
        return [tuple([reading.sigma for reading in joint]) for joint in self.readings]


NO_READINGS = JointReadings((), ())
"""The joints of a path that has none."""


def find_tracks(path: KinematicPath, model: Model, joints: JointHistory) -> list[tuple[str, JointTrack]]:
    """Return the tracks of a path's joints or their leaders, by name, of those that were ever received."""
    tracks = joints.tracks
    found = []
    for item in path.joints:
        for name in model.drives[item.name].names:
            track = tracks.get(name)
            if track is not None:
                found.append((name, track))
    return found


def lookup_joints(
    path: KinematicPath, model: Model, joints: JointHistory, utime: int, policy: Policy, now: int = 0
) -> JointReadings:
    """Return the positions of the joints of a path at a time. Raises TooOldError, TooNewError, naming the joint.

    `now`, where given, is when the latest is queried: a joint that timed out is then stale, and so is one whose newest
    reading is in the future, from before the clock was set back.
    """
    if not path.joints:
        return NO_READINGS
    invalid = quality = 0
    positions, readings = [], []
    drives, tracks = model.drives, joints.tracks
    # fast path: interpolation of a joint with one coordinate, nearly always the case
    interpolates = policy is not Policy.HELD and policy is not Policy.PREDICTED
    for item in path.joints:
        drive = drives[item.name]

        if len(drive.names) == 1:
            (name,) = drive.names
            found: tuple[Reading, ...]
            track = tracks.get(name) if interpolates else None
            try:
                found = () if track is None else (track.interpolate(utime),)
            except (errors.TooOldError, errors.TooNewError):
                found = ()
            if not found:
                found = (_reading(name, drive, model, joints, utime, policy),)
        else:
            found = tuple([_reading(name, drive, model, joints, utime, policy) for name in drive.names])
            if item.joint.type in ROTATION_VECTOR_TYPES:
                found = _combine_rotation_vector(found, drive.names, joints)
        if drive.leader != item.name:
            found = tuple([_apply_mimic(each, drive) for each in found])
        for each in found:
            how = each.provenance
            if how is _DEFAULT:
                if not model.joints[drive.leader].joint.default:
                    invalid |= _UNKNOWN
            elif each.gap > MAX_GAP_S or (now and not -MAX_CLOCK_LEAD_S <= (now - each.stamp) * 1e-6 <= MAX_GAP_S):
                invalid |= _STALE
            quality |= _QUALITY_OF[how]
        position: Coordinates
        if item.limits is not None:
            low, high = item.limits
            position = (found[0].position,)
            beyond = not low <= position[0] <= high
        else:
            position = tuple([each.position for each in found])
            beyond = item.joint.is_out_of_limits(position)
        if beyond:
            quality |= _OUT_OF_LIMITS
        positions.append(position)
        readings.append(found)
    return JointReadings(
        tuple(positions),
        tuple(readings),
        Invalid(invalid) if invalid else VALID,
        Quality(quality) if quality else NO_FLAGS,
    )


def _reading(name: str, drive: JointDrive, model: Model, joints: JointHistory, utime: int, policy: Policy) -> Reading:
    track = joints.tracks.get(name)
    if track is None:
        leader = model.joints[drive.leader].joint
        number = drive.names.index(name)
        sigma = leader.sigma[number] if leader.sigma else NAN
        return Reading(utime, leader.default_position[number], sigma, 0.0, 0.0, Provenance.DEFAULT)
    try:
        if policy is Policy.HELD:
            return track.hold(utime)
        if policy is Policy.PREDICTED and utime > track.last:
            return track.predict(utime, joints.coordinate(name).rate_limit)
        return track.interpolate(utime)
    except (errors.TooOldError, errors.TooNewError) as error:
        raise type(error)(f"joint {name}: {error}") from None


def _combine_rotation_vector(
    found: tuple[Reading, ...], names: tuple[str, ...], joints: JointHistory
) -> tuple[Reading, ...]:
    """Return the readings of a joint whose last three coordinates are a rotation vector, interpolated as one."""
    tracks = [joints.tracks.get(name) for name in names[-3:]]
    limits = [joints.coordinate(name).rate_limit for name in names[-3:]]
    return (*found[:-3], *combine(tracks, found[-3:], limits))


def _apply_mimic(reading: Reading, drive: JointDrive) -> Reading:
    """Return the reading of a mimic joint from its leader's; sigmas have the multiplier's sign, as the errors do."""
    factor = drive.multiplier
    return reading._replace(
        position=factor * reading.position + drive.offset,
        sigma=factor * reading.sigma,
        rate=factor * reading.rate,
        rate_sigma=factor * reading.rate_sigma,
    )


# --- the view ---------------------------------------------------------------------------------------------------------

PREDICTION_LIMIT_S: Final = 5.0
"""Largest time after the newest sample for which a pose is predicted; by then its protection level is long exceeded."""

HISTORY_LIMIT: Final = 1000
"""Poses in one reply to getHistory."""

WORLD_FRAMES: Final = frozenset({names.WORLD_UTM, names.WORLD_ENU, names.ODOM})
"""World:UTM and World:ENU (map frame of REP-105), Odom:Origin."""


def is_absolute(frame: str) -> bool:
    """Return whether a frame is fixed to the earth."""
    return frame in (names.WORLD_UTM, names.WORLD_ENU)


def check_not_reserved(frame: str) -> None:
    """Raise UnknownFrameError for a frame of the bodies World and Odom that does not exist."""
    if frame.partition(":")[0] in names.RESERVED_BODIES:
        raise errors.UnknownFrameError(
            f"there is no frame {errors.quote(frame)}; the world frames are {', '.join(sorted(WORLD_FRAMES))}",
            errors.find_nearest_names(frame, WORLD_FRAMES),
        )


def find_vehicle_pose(world: str, estimate: Estimate) -> Pose | None:
    """Return the rolling frame's pose in a world frame, None where it is unknown."""
    if world == names.WORLD_UTM:
        return estimate.utm
    return estimate.odom if world == names.ODOM else estimate.enu


def get_vehicle_pose(world: str, estimate: Estimate) -> Pose:
    """Return the rolling frame's pose in a world frame. Raises NoPoseError."""
    pose = find_vehicle_pose(world, estimate)
    if pose is None:
        raise errors.NoPoseError(f"the vehicle's pose in {world} is not known yet: {estimate.invalid.explain()}")
    return pose


class PlatformView(NamedTuple):
    """The current state for queries: geometry, joints, and the history of the vehicle's estimates.

    base_frame: the frame whose pose is queried and published. rolling: the name of the rolling frame; empty for the
    base frame. invalid: reasons against every pose, besides those of its own estimate. dynamics: None where it is not
    configured.
    """

    model: Model
    base_frame: str
    localizer: Localizer | None
    history: History
    rolling: str = ""
    invalid: Invalid = VALID
    joints: JointHistory = NO_JOINTS
    dynamics: DynamicsSettings | None = None

    @property
    def rolling_frame(self) -> str:
        """The frame of the estimates: the point of the vehicle that moves along its own x axis."""
        return self.rolling or self.base_frame

    def transformation(
        self, frame_of_interest: str, frame_of_reference: str, time: TimeQuery, now: int = 0
    ) -> PoseAnswer:
        """Return where a frame is in another. Raises a QueryError for each cause.

        `now` is the utime of the query: the latest pose is invalid where the sensors timed out.
        """
        interest = frame_of_interest in WORLD_FRAMES
        reference = frame_of_reference in WORLD_FRAMES
        if not interest and not reference:
            return self._lookup_within_vehicle(frame_of_interest, frame_of_reference, time, now)
        if frame_of_interest == frame_of_reference:
            return PoseAnswer(Transformation(frame_of_interest, frame_of_reference, Pose.identity(), _ZERO))
        if interest and reference:
            estimate = self.estimate(time, now)
            X_RB = get_vehicle_pose(frame_of_reference, estimate)
            X_IB = get_vehicle_pose(frame_of_interest, estimate)
            return self._build_answer(frame_of_interest, frame_of_reference, X_RB @ X_IB.inverse(), None, estimate)
        frame, world_frame = (
            (frame_of_interest, frame_of_reference) if reference else (frame_of_reference, frame_of_interest)
        )
        path = self.get_path_from_vehicle(frame)
        estimate, joints = self.lookup_vehicle_and_joints(path, time, now)
        pose, covariance = self._in_world(frame, world_frame, estimate, path, joints, inverted=not reference)
        return self._build_answer(frame_of_interest, frame_of_reference, pose, covariance, estimate, joints, path)

    def _lookup_within_vehicle(
        self, frame_of_interest: str, frame_of_reference: str, time: TimeQuery, now: int
    ) -> PoseAnswer:
        model = self.model
        try:
            rigid = model.rigid_transformation(frame_of_interest, frame_of_reference)
            if rigid is not None:
                # constant in time: no stamp
                return PoseAnswer(rigid)
            path = model.get_kinematic_path(frame_of_interest, frame_of_reference)
        except errors.QueryError:
            check_not_reserved(frame_of_interest)
            check_not_reserved(frame_of_reference)
            raise
        if not path.joints:
            fixed = PoseAnswer(model.get_transformation(frame_of_interest, frame_of_reference))
            return fixed._replace(quality=Quality.LOOP) if path.is_in_loop else fixed
        utime, joints = self.lookup_joints(path, time, now)
        places = path.compute_joint_poses(joints.positions)
        return PoseAnswer(
            Transformation(
                frame_of_interest,
                frame_of_reference,
                path.to_pose(places),
                lambda: path.compute_covariance(joints.positions, joints.sigmas, joint_poses=places),
                utime,
                # as numbers: combining flags costs more than the pose
                self.invalid.value & _CLOCK_STEPPED | joints.invalid.value,
                model_revision=self.model.revision,
            ),
            quality=joints.quality | Quality.LOOP if path.is_in_loop else joints.quality,
        )

    def get_path_from_vehicle(self, frame: str) -> KinematicPath:
        """Return the kinematic path from the rolling frame to a frame of the vehicle.

        Raises a QueryError where the frame does not exist, or is not joined to the rolling frame.
        """
        check_not_reserved(frame)
        try:
            return self.model.get_kinematic_path(frame, self.rolling_frame)
        except errors.NotConnectedError as error:
            raise errors.NotConnectedError(f"the world is known at {self.rolling_frame} only: {error}") from None

    def lookup_joints(self, path: KinematicPath, time: TimeQuery, now: int) -> tuple[int, JointReadings]:
        """Return time and positions of the joints of a path; the latest time is one that all joints have reached."""
        if time.at and time.policy is not Policy.LATEST:
            return time.at, lookup_joints(path, self.model, self.joints, time.at, time.policy)
        tracks = find_tracks(path, self.model, self.joints)
        # joints that were never received are at their defaults, which holds now
        utime = min(track.last for _, track in tracks) if tracks else now
        try:
            return utime, lookup_joints(path, self.model, self.joints, utime, Policy.INTERPOLATED, now)
        except errors.TooOldError as error:
            raise self._no_common_time_error(tracks, error) from None

    def lookup_vehicle_and_joints(
        self, path: KinematicPath, time: TimeQuery, now: int
    ) -> tuple[Estimate, JointReadings]:
        """Return the vehicle's estimate and the positions of the joints of a path from it, at one time."""
        if not path.joints:
            return self.estimate(time, now), NO_READINGS
        if time.at and time.policy is not Policy.LATEST:
            return self.estimate(time, now), lookup_joints(path, self.model, self.joints, time.at, time.policy)
        newest = self.estimate(time, now)
        tracks = find_tracks(path, self.model, self.joints)
        utime = min((track.last for _, track in tracks), default=newest.utime)
        try:
            if utime < newest.utime:
                stale = newest.invalid & STALE_SENSORS
                newest = self.history.at(utime)
                if stale not in newest.invalid:
                    newest = replace(newest, invalid=newest.invalid | stale)
            return newest, lookup_joints(path, self.model, self.joints, newest.utime, Policy.INTERPOLATED, now)
        except errors.TooOldError as error:
            raise self._no_common_time_error(tracks, error) from None

    def _no_common_time_error(
        self, tracks: list[tuple[str, JointTrack]], error: errors.TooOldError
    ) -> errors.TooOldError:
        name, track = min(tracks, key=lambda each: each[1].last)
        return errors.TooOldError(
            f"no time is covered by all joints and the vehicle: joint {name} was received last at {track.last}. "
            f"{error}. Query with a time and policy HELD, or check the driver of the joint"
        )

    def vehicle_history(self, start_utime: int, end_utime: int, rate_hz: float) -> Steps[tuple[PoseAnswer, ...]]:
        """Return in steps the base frame's poses in World:UTM at a constant rate, without times outside the history.

        Raises MalformedRequestError for a range that ends before it starts or a rate that is not positive, LimitError
        for too many poses, NoPoseError.
        """
        if not (rate_hz > 0.0 and rate_hz < 1e6):
            raise errors.MalformedRequestError(f"rate_hz is above 0 and below 1e6, got {rate_hz}")
        if end_utime < start_utime:
            raise errors.MalformedRequestError(f"the range ends ({end_utime}) before it starts ({start_utime})")
        count = int((end_utime - start_utime) * 1e-6 * rate_hz + 1e-9) + 1
        if count > HISTORY_LIMIT:
            raise errors.LimitError(
                f"{count} poses were requested; at most {HISTORY_LIMIT} are allowed in one reply. Split the request."
            )
        if self.localizer is None or not len(self.history):
            raise self.no_pose_error()
        answers = []
        for n in range(count):
            utime = start_utime + round(n * 1e6 / rate_hz)
            if self.history.first <= utime <= self.history.last:
                estimate = self.history.at(utime)
                if estimate.utm is not None:
                    answers.append(self.get_published_pose(estimate, names.WORLD_UTM))
                yield
        return tuple(answers)

    def estimate(self, time: TimeQuery, now: int = 0) -> Estimate:
        """Return the vehicle's estimate for a time, queried at `now`. Raises NoPoseError, TooOldError, TooNewError."""
        if self.localizer is None or not len(self.history):
            raise self.no_pose_error()
        if time.at == 0 or time.policy is Policy.LATEST:
            newest = self.history.newest
            stale = self.localizer.find_stale_sensors(now) if now > newest.utime else VALID
            return newest if stale in newest.invalid else replace(newest, invalid=newest.invalid | stale)
        if time.policy is Policy.HELD:
            held = self.history.hold(time.at)
            if held.utime == time.at:
                return held
            # sensors that have timed out since make it invalid: up to the next estimate, or up to the time of the query
            following = self.history.next_after(time.at)
            since = (following or self.localizer.estimate(time.at)).invalid
            return restamp(held, time.at, Quality.HELD, since)
        if time.policy is Policy.PREDICTED and time.at > self.history.last:
            if time.at > self.history.last + PREDICTION_LIMIT_S * 1e6:
                raise errors.TooNewError(
                    f"{time.at} is {(time.at - self.history.last) / 1e6:.3f} s after the newest sample "
                    f"({self.history.last}); poses are predicted {PREDICTION_LIMIT_S:g} s ahead at most"
                )
            return self.localizer.estimate(time.at)
        return self.history.at(time.at)

    def is_covered(self, utime: int, frame_of_interest: str = "", frame_of_reference: str = "") -> bool:
        """Return whether a query for a time can be answered without prediction; without frames, for the vehicle.

        True for a query that has no answer at all: waiting would not help.
        """
        ends = [frame for frame in (frame_of_interest, frame_of_reference) if frame not in WORLD_FRAMES and frame]
        try:
            path = (
                self.model.get_kinematic_path(*ends)
                if len(ends) == 2
                else self.get_path_from_vehicle(ends[0])
                if ends
                else None
            )
        except errors.QueryError:
            return True
        if len(ends) < 2 and (not len(self.history) or utime > self.history.last):
            return False
        if path is None:
            return True
        return all(utime <= track.last for _, track in find_tracks(path, self.model, self.joints))

    def is_awaiting_data(self, time: TimeQuery, frame_of_interest: str, frame_of_reference: str) -> bool:
        """Return whether a query should wait for data: its time is not covered yet."""
        ends = (frame_of_interest, frame_of_reference)
        of_world = any(end.partition(":")[0] in names.RESERVED_BODIES for end in ends)
        if of_world and self.localizer is None:
            return False
        if time.at and time.policy is not Policy.LATEST:
            return not self.is_covered(time.at, *ends)
        return of_world and not len(self.history)

    def get_published_pose(self, estimate: Estimate, world: str) -> PoseAnswer:
        """Return the base frame's pose in a world frame, for publication; an invalid identity where it is unknown."""
        if find_vehicle_pose(world, estimate) is None:
            return self._build_answer(self.base_frame, world, Pose.identity(), None, estimate)
        path = self.get_path_from_vehicle(self.base_frame)
        pose, covariance = self._in_world(self.base_frame, world, estimate, path, NO_READINGS)
        return self._build_answer(self.base_frame, world, pose, covariance, estimate)

    def _in_world(
        self,
        frame: str,
        world: str,
        estimate: Estimate,
        path: KinematicPath,
        joints: JointReadings,
        inverted: bool = False,
    ) -> tuple[Pose, Callable[[], Array | Numbers | None] | None]:
        """Return a frame's pose in a world frame and a function for its covariance, None where it is unknown.

        `inverted`: the world frame's pose in the frame.
        """
        X_WB = get_vehicle_pose(world, estimate)
        numbers = estimate.odom_covariance if world == names.ODOM else estimate.covariance
        fixed: Transformation | None = None
        if frame == self.rolling_frame:
            X_BF, X_WF = None, X_WB
        elif path.joints:
            X_BF = path.compute_pose(joints.positions)
            X_WF = X_WB @ X_BF
        else:
            fixed = self.model.get_transformation(frame, self.rolling_frame)
            X_BF = fixed.pose
            X_WF = X_WB @ X_BF
        known = None if numbers is None else partial(_covariance, numbers, X_WB, X_BF, path, joints, fixed, inverted)
        return X_WF.inverse() if inverted else X_WF, known

    def _build_answer(
        self,
        interest: str,
        reference: str,
        pose: Pose,
        covariance: Callable[[], Array | Numbers | None] | None,
        estimate: Estimate,
        joints: JointReadings = NO_READINGS,
        path: KinematicPath | None = None,
    ) -> PoseAnswer:
        odom_only = names.ODOM in (interest, reference) and not (is_absolute(interest) or is_absolute(reference))
        origin = None if odom_only else estimate.origin
        # as numbers: combining flags costs more than the pose
        of_estimate = int(estimate.invalid) & _ODOM_INVALID if odom_only else int(estimate.invalid)
        invalid = int(self.invalid) | of_estimate | int(joints.invalid)
        quality = estimate.quality
        if path is not None and path.is_in_loop:
            quality |= joints.quality | Quality.LOOP
        elif path is not None and joints.quality:
            quality |= joints.quality
        of_vehicle = self.base_frame in (interest, reference) and not odom_only
        levels = self._get_levels(estimate) if of_vehicle else _NO_LEVELS
        return PoseAnswer(
            Transformation(
                interest,
                reference,
                pose,
                covariance,
                estimate.utime,
                invalid,
                estimate.pose_epoch,
                0 if origin is None else origin.origin_id,
                self.model.revision,
            ),
            origin,
            quality,
            levels[0],
            levels[1],
            NAN if odom_only else estimate.seconds_to_limit,
            levels[2],
            levels[3],
            estimate.limit_risk if of_vehicle else NAN,
            estimate.horizontal_allowance if of_vehicle else NAN,
        )

    def _get_levels(self, estimate: Estimate) -> tuple[float, float, float, float]:
        """Return protection levels and levels at the base frame: the heading error moves it about the rolling one."""
        x, y, _ = self.model.get_transformation(self.base_frame, self.rolling_frame).pose.xyz
        # a chord is no longer than its arc, nor than twice the lever arm
        arm, heading, level = math.hypot(x, y), estimate.heading_protection_level, estimate.heading_level
        return (
            estimate.horizontal_protection_level + arm * min(heading, 2.0),
            heading,
            estimate.horizontal_level + arm * min(level, 2.0),
            level,
        )

    def no_pose_error(self) -> errors.NoPoseError:
        """Return the error that explains why there is no pose in the world."""
        if self.localizer is None:
            return errors.NoPoseError("the vehicle file names no GPS and IMU, so there is no pose in the world")
        # at time 0 every sample is of a later time, as after a step of the clock
        invalid = self.localizer.estimate(0).invalid & ~Invalid.CLOCK_STEPPED
        return errors.NoPoseError(f"the vehicle's pose is not known yet: {invalid.explain() or 'no sensor sample yet'}")


_ZERO = np.zeros((6, 6))
_NO_LEVELS: Final = (NAN, NAN, NAN, NAN)
_CLOCK_STEPPED: Final = Invalid.CLOCK_STEPPED.value
ODOM_INVALID = Invalid.NO_IMU | Invalid.STALE_IMU | Invalid.CLOCK_STEPPED | Invalid.TILTED
"""Reasons against a pose in Odom, which needs no fix and no origin."""

_ODOM_INVALID: Final = ODOM_INVALID.value


def _covariance(
    numbers: tuple[float, ...],
    X_WB: Pose,
    X_BF: Pose | None,
    path: KinematicPath,
    joints: JointReadings,
    fixed: Transformation | None,
    inverted: bool,
) -> Array | Numbers | None:
    """Return the covariance of a frame of the vehicle in a world, `inverted` of the world in the frame.

    X_BF: None for the rolling frame. fixed: the frame in the rolling frame, where no joint moves between them.
    """
    if X_BF is None and not inverted:
        return numbers
    P = np.array(numbers).reshape(6, 6)
    if inverted:
        # the world's origin is at the end of a long lever arm
        P = rotate_covariance(X_WB.rotation.T, apply_lever_arm(P, -X_WB.position))
    if X_BF is None:
        return P
    Q = None if fixed is None else fixed.covariance
    if Q is None:
        # A mount without sigmas counts as exact: the vehicle's own error is far larger. A joint without a sigma does
        # not: the end of a long arm may be anywhere.
        of_path = path.compute_covariance(joints.positions, joints.sigmas, unstated_is_exact=True)
        if of_path is None:
            return None
        Q = as_array(of_path)
    if inverted:
        return compose_covariance(X_BF.inverse(), invert_covariance(X_BF, Q), X_WB.inverse(), P)
    # the heading may be off by tens of degrees before the vehicle has moved
    R = X_WB.rotation
    return apply_lever_arm(P, R @ X_BF.position) + rotate_covariance(R, Q)
