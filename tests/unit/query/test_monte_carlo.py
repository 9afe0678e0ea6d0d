"""How sure an answer is, against samples of everything it rests on: surveys, joints and the vehicle."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support_between import lookup_between
from support_moving import BASE, DEEP, SCAN, T0, UTM, S, estimate, vehicle, view

from modelserver.estimation.history import History
from modelserver.geometry.joint import Joint, JointType
from modelserver.messages import TimeQuery
from modelserver.query.view import PlatformView
from modelserver.transforms import pose_array as arrays
from modelserver.transforms.pose import Pose
from modelserver.transforms.pose_array import PoseArray
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import Transformation

pytestmark = pytest.mark.slow

COUNT = 20_000
AT, LATER = 1.2, 1.9
FINGER = "Finger:Tip"


@cache
def held() -> PlatformView:
    return view(2.0)


def utime(seconds: float) -> int:
    return T0 + round(seconds * S)


def move(joint: Joint, positions: Array) -> PoseArray:
    """Return the poses (n,) of a joint at positions (n, size)."""
    axis, none = np.array(joint.axis), np.zeros((len(positions), 3))
    if joint.type is JointType.REVOLUTE:
        return PoseArray(none, arrays.exponential(positions * axis))
    if joint.type is JointType.PRISMATIC:
        return PoseArray(positions * axis, arrays.exponential(none))
    if joint.type is JointType.SPHERICAL:
        return PoseArray(none, arrays.exponential(positions))
    moved = [joint.compute_pose(row) for row in positions.tolist()]
    return PoseArray(np.array([each.xyz for each in moved]), np.array([each.wxyz for each in moved]))


class Samples:
    """A world with sampled errors: one sample of the surveys, independent ones of the joints at each time."""

    def __init__(self, seed: int, platform: PlatformView):
        self.rng = np.random.default_rng(seed)
        self.platform = platform
        self.drawn: dict[object, Array] = {}

    def error(self, source: object, size: int) -> Array:
        if source not in self.drawn:
            self.drawn[source] = self.rng.standard_normal((COUNT, size))
        return self.drawn[source]

    def off(self, X: Pose, error: Array) -> PoseArray:
        """Return a pose with errors (n, 6) along the axes of its reference."""
        turned = arrays.multiply(arrays.exponential(error[:, 3:]), np.array([X.wxyz]))
        return PoseArray(np.array(X.xyz) + error[:, :3], turned)

    def within(self, interest: str, reference: str, seconds: float) -> PoseArray:
        """Return a frame in another of the vehicle at a time."""
        model = self.platform.model
        poses = PoseArray.of(Pose.identity())
        for edge in model.get_kinematic_path(interest, reference).edges:
            if edge.joint is None:
                sigma = (0.0,) * 6 if edge.sigma is None else (*edge.sigma.position, *edge.sigma.rotation)
                step = self.off(edge.pose, self.error(edge.name, 6) * sigma)
            else:
                drive = model.drives[edge.name]
                columns = []
                for name in drive.names:
                    reading = self.platform.joints.tracks[name].interpolate(utime(seconds))
                    off = self.error((name, seconds), 1)[:, 0] * 0.001
                    columns.append(drive.multiplier * (reading.position + off) + drive.offset)
                step = move(edge.joint, np.stack(columns, axis=1))
            poses = poses @ (step if edge.forward else step.inverse())
        return poses

    def vehicle(self, sigmas: Array, seconds: float) -> PoseArray:
        return self.off(self.platform.history.at(utime(seconds)).utm or Pose.identity(), self.error(UTM, 6) * sigmas)


def residuals(poses: PoseArray, about: Pose) -> Array:
    """Return the errors (n, 6) of poses."""
    p, q = np.broadcast_to(poses.p, (COUNT, 3)), np.broadcast_to(poses.q, (COUNT, 4))
    w, x, y, z = about.wxyz
    turned = Rotation.from_quat(q[:, (1, 2, 3, 0)]) * Rotation.from_quat([x, y, z, w]).inv()
    return np.hstack((p - about.position, turned.as_rotvec()))


def check(poses: PoseArray, about: Pose, covariance: Array | None) -> None:
    """Assert that the samples spread as the covariance states."""
    assert covariance is not None
    errors = residuals(poses, about)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    assert np.linalg.norm(whitened @ whitened.T / COUNT - np.eye(6), 2) < 0.05
    # nor is it off on the whole by more than the second order that a covariance leaves out
    assert np.abs(whitened.mean(axis=1)).max() < 0.1


WITHIN = [(SCAN, BASE), (BASE, SCAN), (DEEP, SCAN), (SCAN, DEEP), (FINGER, SCAN), (FINGER, "Upper:Root")]


@pytest.mark.parametrize(("interest", "reference"), WITHIN)
def test_given_surveys_and_joints_then_the_spread_within_the_vehicle_is_as_stated(
    interest: str, reference: str
) -> None:
    answer = held().transformation(interest, reference, TimeQuery(utime(AT))).transformation
    check(Samples(1, held()).within(interest, reference, AT), answer.pose, answer.covariance)


SIGMAS = np.array([0.05] * 3 + [0.01] * 3)


@pytest.mark.parametrize("frame", [SCAN, DEEP, FINGER])
def test_given_surveys_joints_and_vehicle_then_the_spread_in_the_world_is_as_stated_both_ways(frame: str) -> None:
    samples = Samples(2, held())
    poses = samples.vehicle(SIGMAS, AT) @ samples.within(frame, BASE, AT)
    forth = held().transformation(frame, UTM, TimeQuery(utime(AT))).transformation
    check(poses, forth.pose, forth.covariance)
    back = held().transformation(UTM, frame, TimeQuery(utime(AT))).transformation
    check(poses.inverse(), back.pose, back.covariance)


def drift(samples: Samples) -> PoseArray:
    """Return the vehicle's motion between two times, by an Odom that drifts as in `support_moving`."""
    before, after = vehicle(AT), vehicle(LATER)
    tilt = 1e-3 * min(math.sqrt(2.0), LATER - AT)
    sigmas = np.array([0.01 * (LATER - AT)] * 3 + [tilt, tilt, 0.001 * (LATER - AT)])
    errors = samples.error("drift", 6) * sigmas
    back = before.rotation.T
    # Odom differs from the world by a yaw angle alone, and x and y have equal sigmas
    turned = np.hstack((errors[:, :3] @ back.T, errors[:, 3:] @ back.T))
    return samples.off(before.inverse() @ after, turned)


@pytest.mark.parametrize(("interest", "reference"), [(SCAN, SCAN), (SCAN, BASE), (DEEP, SCAN), (FINGER, SCAN)])
def test_given_two_times_then_surveys_are_shared_joints_are_not_and_odom_drifts(interest: str, reference: str) -> None:
    samples = Samples(3, held())
    poses = samples.within(reference, BASE, AT).inverse() @ drift(samples) @ samples.within(interest, BASE, LATER)
    answer = lookup_between(held(), interest, utime(LATER), reference, utime(AT)).transformation
    check(poses, answer.pose, answer.covariance)


def test_given_a_frame_bolted_to_the_vehicle_at_two_times_then_its_survey_cancels_but_for_the_turn_between() -> None:
    answer = lookup_between(held(), "Rover:Mast", utime(AT + 1e-3), "Rover:Mast", utime(AT)).transformation
    assert answer.covariance is not None
    # the drift is that of the samples around
    assert math.sqrt(answer.covariance[0, 0]) < 2e-4


def test_given_two_times_through_the_world_then_the_covariance_bounds_what_any_correlation_gives() -> None:
    answer = lookup_between(held(), SCAN, utime(LATER), SCAN, utime(AT), UTM).transformation
    assert answer.covariance is not None
    for correlation in (-1.0, 0.0, 1.0):
        samples = Samples(4, held())
        first = samples.error("first", 6) * SIGMAS
        other = samples.error("other", 6) * SIGMAS
        second = correlation * first + math.sqrt(1.0 - correlation**2) * other
        there = samples.off(vehicle(AT), first) @ samples.within(SCAN, BASE, AT)
        here = samples.off(vehicle(LATER), second) @ samples.within(SCAN, BASE, LATER)
        errors = residuals(there.inverse() @ here, answer.pose)
        whitened = np.linalg.solve(np.linalg.cholesky(answer.covariance), errors.T)
        assert np.linalg.eigvalsh(whitened @ whitened.T / COUNT).max() < 1.05


@pytest.mark.parametrize("meters", [0.5, 0.1, 0.05])
@pytest.mark.parametrize("frame", [SCAN, DEEP])
def test_given_a_heading_sigma_of_20_deg_then_a_95_percent_ellipsoid_covers_90_percent(
    frame: str, meters: float
) -> None:
    # as from a satellite receiver alone, before the vehicle has moved
    sigmas = np.array([meters] * 3 + [0.01, 0.01, math.radians(20.0)])
    history = History(60.0)
    for at in (AT - 0.01, AT, AT + 0.01):
        uncertain = replace(estimate(at), covariance=tuple(np.diag(sigmas**2).ravel().tolist()))
        history = history.append(uncertain)
    platform = held()._replace(history=history)
    samples = Samples(5, platform)
    answer = platform.transformation(frame, UTM, TimeQuery(utime(AT))).transformation
    poses = samples.vehicle(sigmas, AT) @ samples.within(frame, BASE, AT)
    assert coverage(poses, answer) > 0.90
    # the world's origin is 22 m from the vehicle, at the end of a far longer arm
    back = platform.transformation(UTM, frame, TimeQuery(utime(AT))).transformation
    assert coverage(poses.inverse(), back) > 0.90


def coverage(poses: PoseArray, answer: Transformation) -> float:
    """Return which part of the samples lies in the ellipsoid of 95 %."""
    assert answer.covariance is not None
    whitened = np.linalg.solve(np.linalg.cholesky(answer.covariance), residuals(poses, answer.pose).T)
    # 95 % of a chi-squared distribution of six degrees of freedom
    return float((np.sum(whitened**2, axis=0) < 12.59).mean())
