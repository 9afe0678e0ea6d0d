"""What a Pose accepts, rejects, prints and preserves."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest

from modelserver.transforms import Pose

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("position", "quaternion", "why"),
    [
        ((1, 2), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        ((1, 2, 3, 4), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        ((1, NAN, 3), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        ((1, 2, -INF), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        (("a", 2, 3), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        ((None, 2, 3), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        (None, (1, 0, 0, 0), "3 finite numbers in meters, got None"),
        (7, (1, 0, 0, 0), "3 finite numbers in meters, got 7"),
        ((10**400, 0, 0), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        (np.eye(3), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        (np.ones((3, 1)), (1, 0, 0, 0), "3 finite numbers in meters, got"),
        ((0, 0, 0), (1, 0, 0), "4 numbers, scalar first, got"),
        ((0, 0, 0), np.eye(4), "4 numbers, scalar first, got"),
        ((0, 0, 0), (0, 0, 0, 0), "finite and not zero"),
        ((0, 0, 0), (1, NAN, 0, 0), "finite and not zero"),
        ((0, 0, 0), (1, 0, INF, 0), "finite and not zero"),
    ],
)
@pytest.mark.filterwarnings("ignore:Conversion of an array")
def test_wrong_values_are_rejected_and_named(position, quaternion, why):
    with pytest.raises(ValueError, match=why):
        Pose(position, quaternion)


def test_a_message_stays_short_whatever_was_passed():
    with pytest.raises(ValueError, match="3 finite numbers") as caught:
        Pose([1.0] * 100_000)
    assert len(str(caught.value)) < 300
    with pytest.raises(ValueError, match="7 numbers") as caught:
        Pose.from_state_vector("x" * 100_000)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("matrix", "why"),
    [
        (np.eye(3), r"\(4, 4\) or \(3, 4\) matrix, got shape \(3, 3\)"),
        (np.full((4, 4), NAN), "finite numbers only"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row of a homogeneous transform is 0 0 0 1"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
        (np.diag([1.0, 1.0, 0.0, 1.0]), "singular"),
        (np.diag([1.0, 1.0, 1.1, 1.0]), r"not a rotation: \|R'R - I\| is 0.21, more than 0.05"),
        (np.diag([1e200, 1e200, 1e200, 1.0]), "too large"),
    ],
)
def test_a_matrix_that_is_no_transform_is_rejected(matrix, why):
    with pytest.raises(ValueError, match=why):
        Pose.from_matrix(matrix)


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_angles_and_state_vectors_must_be_finite(bad):
    with pytest.raises(ValueError, match="roll, pitch and yaw must be finite"):
        Pose.from_rpy((0, 0, 0), 0, bad, 0)
    with pytest.raises(ValueError, match="3 finite numbers"):
        Pose.from_state_vector((0, 0, bad, 1, 0, 0, 0))
    with pytest.raises(ValueError, match="7 numbers, px py pz qs qx qy qz, got 6"):
        Pose.from_state_vector((0, 0, 0, 1, 0, 0))


def test_report_eq_4_and_the_inverse_of_a_quarter_turn():
    pose = Pose.from_rpy((1, 2, 3), yaw=math.pi / 2)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(pose.state_vector, [1, 2, 3, half, 0, 0, half])
    np.testing.assert_allclose(pose.matrix, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(pose.inverse().position, [-2, 1, -3])
    assert str(pose) == "position (1.000, 2.000, 3.000) m, roll 0.00 pitch 0.00 yaw 90.00 deg"


@pytest.mark.parametrize("getter", ["position", "quaternion", "rpy", "rotation", "matrix", "state_vector"])
def test_arrays_are_read_only_and_cannot_reach_the_pose(getter):
    pose = Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3)
    array = getattr(pose, getter)
    assert array.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 0
    assert not np.shares_memory(array, getattr(pose, getter))


def test_what_it_was_made_from_may_change_afterwards():
    p, q = np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0])
    pose = Pose(p, q)
    p[0], q[1] = 99.0, 99.0
    assert pose == Pose((1, 2, 3))


def test_nothing_can_be_set_or_deleted():
    pose = Pose()
    for name in ("_p", "_q", "xyz", "position", "anything"):
        with pytest.raises(AttributeError, match="immutable"):
            setattr(pose, name, 1)
        with pytest.raises(AttributeError, match="immutable"):
            delattr(pose, name)


def test_equal_poses_hash_alike_and_negative_zero_is_zero():
    a, b = Pose((0.0, 1.0, 2.0), (1, 0, 0, 0)), Pose((-0.0, 1, 2), (2, -0.0, 0, 0))
    assert a == b
    assert hash(a) == hash(b)
    assert repr(a) == repr(b)
    assert a != Pose((0.0, 1.0, 2.0000001))
    assert a != "a pose"
    assert len({a, b, Pose()}) == 2


def test_copies_and_pickles_are_equal():
    pose = Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3) @ Pose.from_rpy((1, 2, 3), 0.3, 0.2, 0.1)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        assert pickle.loads(pickle.dumps(pose, protocol)) == pose
    assert copy.copy(pose) == copy.deepcopy(pose) == pose


def test_only_a_pose_multiplies_a_pose():
    with pytest.raises(TypeError):
        Pose() @ np.eye(4)
    with pytest.raises(TypeError):
        Pose() @ 3


def test_points_have_three_coordinates():
    pose = Pose((1, 2, 3))
    assert pose.transform(np.zeros((0, 3))).shape == (0, 3)
    np.testing.assert_array_equal(pose.transform([[0, 0, 0], [1, 1, 1]]), [[1, 2, 3], [2, 3, 4]])
    for wrong in ((1, 2), np.zeros((3, 4)), 5.0, np.zeros((2, 2, 3))):
        with pytest.raises(ValueError, match=r"shape \(3,\) or \(n, 3\)"):
            pose.transform(wrong)


def test_many_products_keep_a_unit_quaternion():
    step, pose = Pose.from_rpy((0, 0, 0), 0.01, 0.02, 0.03), Pose()
    for _ in range(20_000):
        pose = pose @ step
    assert abs(sum(value * value for value in pose.wxyz) - 1) < 1e-14


@pytest.mark.parametrize("q", [(1.0, 0.0, 0.0, 0.0), (-0.3, 0.5, -0.0, 0.7), (2.0, -0.0, 0.0, 0.0)])
def test_given_plain_floats_then_of_floats_has_the_bits_of_the_constructor(q):
    p = (-0.0, 1.5, -2.0)
    assert repr(Pose.of_floats(p, q)) == repr(Pose(p, q))
    assert str((Pose.of_floats(p, q).xyz, Pose.of_floats(p, q).wxyz)) == str((Pose(p, q).xyz, Pose(p, q).wxyz))


def test_given_numbers_that_are_not_finite_then_of_floats_raises_what_the_constructor_raises():
    with pytest.raises(ValueError, match="3 finite numbers in meters"):
        Pose.of_floats((1.0, NAN, 0.0), (1.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="finite and not zero"):
        Pose.of_floats((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
