"""Poses satisfy the group axioms and agree with products of 4x4 matrices."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_spatial import angle_between, near_points, points, poses, rotations, scipy_of

from modelserver.transforms import Pose


def close(a, b, meters=1e-12, radians=1e-14):
    return np.linalg.norm(a.position - b.position) < meters and angle_between(a.wxyz, b.wxyz) < radians


def matrix(pose):
    """Return the 4x4 matrix by SciPy, not by the package."""
    m = np.eye(4)
    m[:3, :3] = scipy_of(pose.wxyz).as_matrix()
    m[:3, 3] = pose.xyz
    return m


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    assert close((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_inverse_and_identity(a):
    assert close(a @ a.inverse(), Pose.identity())
    assert close(a.inverse() @ a, Pose.identity())
    assert close(a.inverse().inverse(), a)
    assert a @ Pose.identity() == a == Pose.identity() @ a


@given(poses, poses)
def test_inverse_of_a_product_is_the_reversed_product_of_inverses(a, b):
    assert close((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses, poses, near_points)
def test_products_agree_with_matrices(a, b, p):
    np.testing.assert_allclose((a @ b).matrix, matrix(a) @ matrix(b), atol=1e-13)
    np.testing.assert_allclose(a.inverse().matrix, np.linalg.inv(matrix(a)), atol=1e-12)
    np.testing.assert_allclose(a.transform(p), (matrix(a) @ [*p, 1])[:3], atol=1e-13)
    np.testing.assert_allclose(a.transform([p, p])[1], a.transform(p), atol=1e-14)
    np.testing.assert_allclose((a @ b).transform(p), a.transform(b.transform(p)), atol=1e-12)


@given(points, rotations)
def test_storing_and_reading_back_is_exact(p, q):
    pose = Pose(p, q)
    assert Pose.from_state_vector(pose.state_vector) == pose
    assert Pose(pose.position, pose.quaternion) == pose
    assert pickle.loads(pickle.dumps(pose)) == pose
    assert eval(repr(pose)) == pose
    assert hash(Pose(pose.xyz, pose.wxyz)) == hash(pose)


@given(poses, poses)
def test_results_of_products_are_read_back_exactly_too(a, b):
    for pose in (a @ b, a.inverse(), a.interpolate(b, 0.3)):
        assert Pose(pose.xyz, pose.wxyz) == pose


@given(poses)
def test_matrix_and_rpy_round_trips(pose):
    assert close(Pose.from_matrix(pose.matrix), pose)
    assert close(Pose.from_matrix(pose.matrix[:3]), pose)
    assert close(Pose.from_rpy(pose.xyz, *pose.rpy), pose, radians=1e-11)


@given(poses)
def test_a_quaternion_and_its_negative_are_one_pose(pose):
    assert Pose(pose.xyz, -pose.quaternion) == pose
    assert pose.wxyz[0] >= 0


@given(poses, poses, st.floats(0, 1))
def test_interpolation_stays_between(a, b, fraction):
    between = a.interpolate(b, fraction)
    meters, radians = a.distance(b)
    assert a.distance(between) == pytest.approx((fraction * meters, fraction * radians), abs=1e-12)
    assert between.distance(b) == pytest.approx(((1 - fraction) * meters, (1 - fraction) * radians), abs=1e-12)
    assert close(a.interpolate(b, 0.0), a)
    assert close(a.interpolate(b, 1.0), b)


@given(poses, poses)
def test_distance_is_a_symmetric_measure(a, b):
    assert a.distance(b) == pytest.approx(b.distance(a), abs=1e-13)
    assert a.distance(a) == pytest.approx((0, 0), abs=1e-15)
    assert a.is_close(a)
    assert a.distance(b)[1] == pytest.approx(angle_between(a.wxyz, b.wxyz), abs=1e-13)
