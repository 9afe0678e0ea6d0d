"""Velocities, turn rates and accelerations against numerical differentiation of the truth, and unknown ones."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support_moving import BASE, DEEP, ODOM, SCAN, T0, UTM, S, estimate, joints_at, positions, rover, truth, view

from modelserver.errors import NoPoseError, UnknownFrameError
from modelserver.estimation.history import History
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType, Mimic
from modelserver.joints import JointHistory
from modelserver.messages import JointSample, JointsSample, Policy, Quality, SensorHeader, TimeQuery
from modelserver.query.path import compute_motion
from modelserver.query.view import PlatformView
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Array

AT = 1.23
FINGER = "Finger:Tip"


@cache
def dense() -> PlatformView:
    """Samples so close that interpolation between them adds nothing."""
    return view(1.6, 200.0, 200.0)


def utime(seconds: float) -> int:
    return T0 + round(seconds * S)


def changes(interest: str, reference: str, h: float = 1e-4) -> tuple[Array, Array, Array, Array]:
    """Return velocity, turn rate, and how they change, by central differences of the truth."""

    def rotation_between(a: Pose, b: Pose) -> Array:
        return np.array(so3.logarithm(so3.normalize(so3.multiply(b.wxyz, so3.conjugate(a.wxyz)))))

    X = {n: truth(interest, reference, AT + n * h) for n in (-1, 0, 1)}
    velocity = (X[1].position - X[-1].position) / (2 * h)
    rate = rotation_between(X[-1], X[1]) / (2 * h)
    acceleration = (X[1].position - 2 * X[0].position + X[-1].position) / h**2
    return velocity, rate, acceleration, (rotation_between(X[0], X[1]) - rotation_between(X[-1], X[0])) / h**2


PAIRS = [
    (SCAN, UTM),
    (UTM, SCAN),
    (DEEP, SCAN),
    (SCAN, DEEP),
    (FINGER, UTM),
    (UTM, FINGER),
    (SCAN, BASE),
    (BASE, DEEP),
    (FINGER, "Fore:Root"),
    ("Upper:Root", BASE),
]


@pytest.mark.parametrize(("interest", "reference"), PAIRS)
def test_given_a_pair_then_its_motion_is_what_differencing_the_truth_gives(interest: str, reference: str) -> None:
    found = compute_motion(dense(), interest, reference, "", TimeQuery(utime(AT)), utime(1.6))
    velocity, rate, acceleration, turning = changes(interest, reference)
    arm = 1.0 + np.linalg.norm(truth(interest, reference, AT).position)
    assert found.velocity == pytest.approx(velocity, abs=1e-4 * arm)
    assert found.angular_velocity == pytest.approx(rate, abs=1e-4)
    assert found.acceleration == pytest.approx(acceleration, abs=2e-3 * arm)
    assert found.angular_acceleration == pytest.approx(turning, abs=5e-3)
    assert found.expressed_in == reference
    assert found.covariance is not None


@pytest.mark.parametrize(("interest", "reference"), PAIRS)
@pytest.mark.parametrize("axes", [UTM, DEEP, ODOM])
def test_given_other_axes_then_the_same_vectors_are_along_those(interest: str, reference: str, axes: str) -> None:
    time, now = TimeQuery(utime(AT)), utime(1.6)
    own = compute_motion(dense(), interest, reference, "", time, now)
    found = compute_motion(dense(), interest, reference, axes, time, now)
    R = dense().transformation(reference, axes, time, now).transformation.rotation
    assert found.expressed_in == axes
    for vector, rotation_between in zip(own[2:6], found[2:6], strict=True):
        assert np.allclose(R @ vector, rotation_between, atol=1e-12)
    K = np.kron(np.eye(2), R)
    assert own.covariance is not None
    assert found.covariance is not None
    expected = K @ np.array(own.covariance).reshape(6, 6) @ K.T
    assert np.allclose(np.array(found.covariance).reshape(6, 6), expected, atol=1e-15)


def test_given_two_worlds_then_neither_moves_and_that_is_certain() -> None:
    found = compute_motion(dense(), UTM, ODOM, "", TimeQuery(utime(AT)), utime(1.6))
    assert np.abs((*found.velocity, *found.angular_velocity)).max() < 1e-9
    assert found.covariance is not None
    assert np.abs(found.covariance).max() < 1e-15


def test_given_frames_bolted_together_then_they_are_at_rest() -> None:
    found = compute_motion(dense(), "Rover:Mast", BASE, SCAN, TimeQuery(utime(AT)), utime(1.6))
    assert np.array(found[2:6]).tolist() == [[0.0] * 3] * 4


def test_given_velocities_then_their_covariance_is_that_of_samples_of_the_rates() -> None:
    """A nod of a rate with sigma 0.002, seen from the vehicle: the beam's origin moves with it."""
    found = compute_motion(dense(), SCAN, BASE, "", TimeQuery(utime(AT)), utime(1.6))
    assert found.covariance is not None
    per_rate = np.array((*found.velocity, *found.angular_velocity)) / positions(AT)["Nod"][1]
    assert np.allclose(np.array(found.covariance).reshape(6, 6), np.outer(per_rate, per_rate) * 0.002**2, atol=1e-11)


def test_given_joints_never_received_then_they_are_at_defaults() -> None:
    whole = dense()
    alone = whole._replace(joints=JointHistory(whole.model.joints.values(), 60.0))
    found = compute_motion(alone, FINGER, BASE, "", TimeQuery(utime(AT)), utime(1.6))
    assert np.array(found[2:6]).tolist() == [[0.0] * 3] * 4
    assert Quality.JOINT_DEFAULT in found.pose.quality


def one(kind: JointType, samples: list[JointSample], utimes: list[int]) -> PlatformView:
    """Return a platform with one joint, named J, and a follower F where it has one coordinate."""
    builder = ModelBuilder("one")
    for name in ("A", "B", "C"):
        builder.add_body(name).add_frame("O").add_frame("Tip", Pose((0.5, 0.1, 0.0)))
    builder.add_constraint("J", "A:Tip", "B:O", joint=Joint(kind, (0.0, 0.0, 1.0)))
    if kind in (JointType.REVOLUTE, JointType.PRISMATIC):
        builder.add_constraint("F", "B:Tip", "C:O", joint=Joint(kind, (0.0, 1.0, 0.0), mimic=Mimic("J", -2.0, 0.3)))
    model = builder.build()
    joints = JointHistory(model.joints.values(), 60.0)
    for at in utimes:
        joints, rejected = joints.update(JointsSample(SensorHeader(at, "j"), tuple(samples)), at)
        assert not rejected
    return PlatformView(model, "A:O", None, History(60.0), joints=joints)


def test_given_a_floating_joint_then_its_rates_are_the_motion() -> None:
    samples = [
        JointSample(f"J.{axis}", 0.0, 0.01, rate, 0.02)
        for axis, rate in zip(("x", "y", "z", "rx", "ry", "rz"), (1.0, 2.0, 3.0, 0.4, 0.5, 0.6), strict=True)
    ]
    found = compute_motion(
        one(JointType.FLOATING, samples, [T0, T0 + S // 10]), "B:O", "A:Tip", "", TimeQuery(T0 + 1000)
    )
    assert found.velocity == pytest.approx((1.0, 2.0, 3.0))
    assert found.angular_velocity == pytest.approx((0.4, 0.5, 0.6))


@pytest.mark.parametrize("kind", [JointType.REVOLUTE, JointType.PRISMATIC])
def test_given_a_follower_then_it_moves_by_its_leaders_rate(kind: JointType) -> None:
    platform = one(kind, [JointSample("J", 0.2, 0.01, 0.5, 0.02)], [T0, T0 + S // 10])
    found = compute_motion(platform, "C:O", "B:Tip", "", TimeQuery(T0 + 1000))
    moved = found.angular_velocity if kind is JointType.REVOLUTE else found.velocity
    assert moved == pytest.approx((0.0, -1.0, 0.0))
    assert found.covariance is not None
    at = 4 if kind is JointType.REVOLUTE else 1
    assert math.sqrt(found.covariance[7 * at]) == pytest.approx(0.04)


def test_given_one_reading_without_a_rate_then_what_it_moves_is_unknown_and_no_more() -> None:
    found = compute_motion(
        one(JointType.PRISMATIC, [JointSample("J", 0.2, 0.01)], [T0]), "B:O", "A:O", "", TimeQuery(T0)
    )
    assert math.isnan(found.velocity[2])
    # a slide does not turn
    assert found.angular_velocity == (0.0, 0.0, 0.0)
    assert found.covariance is None


def test_given_readings_without_rates_then_the_rate_is_their_slope_and_its_change_unknown() -> None:
    platform = one(JointType.REVOLUTE, [JointSample("J", 0.2, 0.01)], [T0])
    later = JointsSample(SensorHeader(T0 + S // 10, "j"), (JointSample("J", 0.25, 0.01),))
    joints, _ = platform.joints.update(later, T0 + S // 10)
    found = compute_motion(platform._replace(joints=joints), "B:O", "A:Tip", "", TimeQuery(T0 + S // 20))
    assert found.angular_velocity == pytest.approx((0.0, 0.0, 0.5))
    assert math.isnan(found.angular_acceleration[2])


def test_given_a_held_joint_then_how_its_rate_changes_is_unknown() -> None:
    found = compute_motion(dense(), SCAN, BASE, "", TimeQuery(utime(AT) + 1, Policy.HELD), utime(1.6))
    assert all(map(math.isnan, found.acceleration))
    assert not any(map(math.isnan, found.velocity))


def test_given_one_estimate_alone_then_the_acceleration_is_unknown_and_the_velocity_known() -> None:
    history = History(60.0).append(estimate(0.0))
    joints, _ = JointHistory(rover().joints.values(), 60.0).update(joints_at(0.0), T0)
    platform = dense()._replace(history=history, joints=joints)
    found = compute_motion(platform, BASE, UTM, "", TimeQuery(T0))
    assert all(map(math.isnan, found.acceleration))
    assert math.hypot(*found.velocity[:2]) == pytest.approx(3.0, abs=1e-3)


def test_given_estimates_without_motion_then_the_velocity_in_the_world_is_denied_and_within_the_vehicle_known() -> None:
    history = History(60.0)
    for n in range(3):
        history = history.append(replace(estimate(1.0 + 0.1 * n), motion=None))
    platform = dense()._replace(history=history)
    with pytest.raises(NoPoseError, match="velocity is not known"):
        compute_motion(platform, SCAN, UTM, "", TimeQuery(utime(1.1)))
    assert compute_motion(platform, SCAN, BASE, "", TimeQuery(utime(1.1))).covariance is not None


def test_given_axes_that_there_are_not_then_the_error_names_the_nearest() -> None:
    with pytest.raises(UnknownFrameError) as caught:
        compute_motion(dense(), SCAN, BASE, "Rover:Bse", TimeQuery(utime(AT)))
    assert BASE in caught.value.nearest


GYRO_SIGMA = 0.01


def add_gyro_noise(seed: int) -> History:
    """Return a history at 100 Hz whose turn rates have the noise of a MEMS gyro."""
    noise = np.random.default_rng(seed)
    history = History(60.0)
    for n in range(160):
        exact = estimate(n / 100.0)
        assert exact.motion is not None
        rate = np.array(exact.motion.angular_velocity) + noise.normal(0.0, GYRO_SIGMA, 3)
        history = history.append(replace(exact, motion=exact.motion._replace(angular_velocity=so3.to_vector3(rate))))
    return history


@pytest.mark.slow
@pytest.mark.parametrize(("at", "largest"), [(AT, 0.1), (1.59, 0.6)], ids=["within", "newest"])
def test_given_noisy_turn_rates_then_accelerations_away_from_the_imu_are_usable_and_their_covariance_is_right(
    at: float, largest: float
) -> None:
    time, far = TimeQuery(utime(at)), "Rover:Mast"
    true = compute_motion(view(2.0, 200.0, 200.0), far, UTM, "", time, utime(1.6))
    errors, normalized = [], []
    for seed in range(60):
        platform = dense()._replace(history=add_gyro_noise(seed))
        found = compute_motion(platform, far, UTM, "", time, utime(1.6))
        assert found.acceleration_covariance is not None
        P = np.array(found.acceleration_covariance).reshape(6, 6)
        assert np.allclose(P, P.T)
        turning = np.subtract(found.angular_acceleration, true.angular_acceleration)
        errors.append(turning)
        normalized.append(turning @ np.linalg.solve(P[3:, 3:], turning))
    # from one estimate to the next the noise alone would be sqrt(2) sigma / dt
    difference = math.sqrt(2.0) * GYRO_SIGMA * 100.0
    assert np.sqrt(np.mean(np.square(errors))) < largest * difference
    # 3 degrees of freedom, and the variance is an estimate of 12
    assert 1.5 < np.mean(normalized) < 7.0


def test_given_few_estimates_then_the_turn_rate_is_differenced_and_its_covariance_is_unknown() -> None:
    history = History(60.0)
    for n in range(4):
        history = history.append(estimate(AT - 0.15 + 0.1 * n))
    found = compute_motion(dense()._replace(history=history), "Rover:Mast", UTM, "", TimeQuery(utime(AT)), utime(1.6))
    assert not any(map(math.isnan, found.angular_acceleration))
    assert found.acceleration_covariance is None


def test_given_a_new_epoch_then_no_turn_rate_from_before_it_is_used() -> None:
    history = History(60.0)
    for n in range(160):
        each = estimate(n / 100.0)
        assert each.motion is not None
        if n >= 120:
            each = replace(each, pose_epoch=each.pose_epoch + 1)
        else:
            each = replace(each, motion=each.motion._replace(angular_velocity=(9.0, 9.0, 9.0)))
        history = history.append(each)
    exact = compute_motion(dense(), "Rover:Mast", UTM, "", TimeQuery(utime(AT)), utime(1.6))
    found = compute_motion(dense()._replace(history=history), "Rover:Mast", UTM, "", TimeQuery(utime(AT)), utime(1.6))
    assert found.angular_acceleration == pytest.approx(exact.angular_acceleration, abs=0.1)


def test_given_a_measured_joint_then_the_covariance_of_its_acceleration_is_unknown_and_of_bolted_frames_zero() -> None:
    at = TimeQuery(utime(AT))
    assert compute_motion(dense(), SCAN, UTM, "", at, utime(1.6)).acceleration_covariance is None
    bolted = compute_motion(dense(), "Rover:Mast", BASE, SCAN, at, utime(1.6)).acceleration_covariance
    assert bolted is not None
    assert np.abs(bolted).max() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("interest", "reference"), [("Rover:Mast", UTM), (UTM, "Rover:Mast")])
def test_given_errors_of_the_vehicles_accelerations_then_their_covariance_follows_the_path(
    interest: str, reference: str
) -> None:
    """Against samples of both errors, through the whole composition."""
    at, noise = TimeQuery(utime(AT)), np.random.default_rng(1)
    exact = compute_motion(dense(), interest, reference, "", at, utime(1.6))
    assert exact.acceleration_covariance is not None
    P = np.array(exact.acceleration_covariance).reshape(6, 6)
    history, samples = dense().history, []
    near = [n / 200.0 for n in range(240, 252)]
    for _ in range(300):
        error = noise.normal(0.0, 0.02, 3)
        changed = History(60.0)
        for seconds in near:
            each = history.at(utime(seconds))
            assert each.motion is not None
            a = so3.to_vector3(np.array(each.motion.acceleration) + error)
            changed = changed.append(replace(each, motion=each.motion._replace(acceleration=a)))
        found = compute_motion(dense()._replace(history=changed), interest, reference, "", at, utime(1.6))
        samples.append(found.acceleration)
    spread = np.cov(np.array(samples).T)
    assert np.allclose(np.diag(spread), np.diag(P)[:3], rtol=0.35)
