"""Rotations satisfy the group axioms and agree with SciPy, near the identity and near half a turn too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support_spatial import TINY, angle_between, axes, near_points, rotations, scipy_of

from modelserver.transforms import so3

EXACT = 5e-15
angles = st.one_of(st.floats(-math.pi, math.pi), st.sampled_from([*TINY, math.pi, -math.pi, math.pi - 1e-12]))


def is_unit(q):
    return abs(sum(value * value for value in q) - 1) <= so3.UNIT_TOLERANCE and q[0] >= 0


@given(rotations, rotations, rotations)
def test_multiplication_is_associative(a, b, c):
    left = so3.multiply(so3.multiply(a, b), c)
    right = so3.multiply(a, so3.multiply(b, c))
    assert angle_between(left, right) < EXACT


@given(rotations)
def test_the_conjugate_is_the_inverse_and_the_identity_neutral(q):
    assert angle_between(so3.multiply(q, so3.conjugate(q)), so3.IDENTITY) < EXACT
    assert so3.multiply(q, so3.IDENTITY) == q == so3.multiply(so3.IDENTITY, q)


@given(rotations, rotations)
def test_product_agrees_with_scipy(a, b):
    x, y, z, w = (scipy_of(a) * scipy_of(b)).as_quat()
    assert angle_between(so3.multiply(a, b), (w, x, y, z)) < EXACT


@given(rotations, near_points)
def test_matrix_and_rotated_vector_agree_with_scipy(q, v):
    oracle = scipy_of(q)
    np.testing.assert_allclose(so3.matrix_rows(q), oracle.as_matrix(), atol=EXACT)
    np.testing.assert_allclose(so3.rotate(q, v), oracle.apply(v), atol=1e-13)


@given(rotations)
def test_matrix_round_trip(q):
    assert angle_between(so3.from_matrix(so3.matrix_rows(q)), q) < EXACT


@given(rotations)
def test_normalizing_twice_changes_no_bit(q):
    assert is_unit(q)
    assert so3.normalize(q) == q


@given(
    st.tuples(*[st.floats(-1e3, 1e3)] * 4).filter(lambda q: any(q)),
    st.sampled_from((1e-300, 1e-170, 1.0, 1e170, 1e300)),
)
def test_any_length_but_zero_is_normalized_once_and_for_all(q, scale):
    scaled = tuple(value * scale for value in q)
    if not any(scaled):
        return
    unit = so3.normalize(scaled)
    assert is_unit(unit)
    assert so3.normalize(unit) == unit
    # direction kept: every component stands to the largest as before
    i = max(range(4), key=lambda k: abs(scaled[k]))
    sign = math.copysign(1.0, unit[i]) * math.copysign(1.0, scaled[i])
    for k in range(4):
        assert unit[k] / abs(unit[i]) == pytest.approx(sign * (scaled[k] / abs(scaled[i])), rel=1e-12, abs=1e-300)


@given(angles, st.floats(-math.pi / 2, math.pi / 2), angles)
def test_rpy_agrees_with_scipy(roll, pitch, yaw):
    x, y, z, w = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_quat()
    assert angle_between(so3.from_rpy(roll, pitch, yaw), (w, x, y, z)) < EXACT


@given(rotations)
def test_rpy_round_trip_keeps_the_rotation(q):
    roll, pitch, yaw = so3.to_rpy(q)
    assert abs(pitch) <= math.pi / 2
    assert abs(roll) <= math.pi
    assert abs(yaw) <= math.pi
    # below 1e-12 rad from the lock roll is 0, which turns the rotation by no more than that
    assert angle_between(so3.from_rpy(roll, pitch, yaw), q) < 1e-11


@given(angles, st.sampled_from(TINY), angles, st.sampled_from((1, -1)))
def test_rpy_round_trip_near_gimbal_lock(roll, short_of_lock, yaw, side):
    q = so3.from_rpy(roll, side * (math.pi / 2 - short_of_lock), yaw)
    assert angle_between(so3.from_rpy(*so3.to_rpy(q)), q) < 1e-11


@given(angles.filter(lambda a: abs(a) < 3.14), st.floats(-1.5, 1.5), angles.filter(lambda a: abs(a) < 3.14))
def test_rpy_away_from_the_lock_comes_back_as_given(roll, pitch, yaw):
    np.testing.assert_allclose(so3.to_rpy(so3.from_rpy(roll, pitch, yaw)), (roll, pitch, yaw), atol=2e-13)


@given(axes, st.one_of(st.floats(0, math.pi - 1e-9), st.sampled_from(TINY)))
def test_exponential_and_logarithm_are_inverse(axis, angle):
    n = math.hypot(*axis)
    v = tuple(value / n * angle for value in axis)
    q = so3.exponential(v)
    x, y, z, w = Rotation.from_rotvec(v).as_quat()
    assert angle_between(q, (w, x, y, z)) < EXACT
    np.testing.assert_allclose(so3.logarithm(q), v, rtol=1e-12, atol=1e-14 * angle + 1e-300)


@given(rotations)
def test_logarithm_agrees_with_scipy_and_is_at_most_half_a_turn(q):
    v = so3.logarithm(q)
    assert math.hypot(*v) <= math.pi * (1 + 1e-15)
    assert angle_between(so3.exponential(v), q) < EXACT
    assert math.hypot(*v) == pytest.approx(scipy_of(q).magnitude(), abs=1e-14)
    opposite = tuple(-value for value in q)
    assert angle_between(so3.exponential(so3.logarithm(opposite)), q) < EXACT


@given(rotations, rotations, st.floats(0, 1))
def test_slerp_moves_at_constant_rate_from_end_to_end(a, b, fraction):
    whole = angle_between(a, b)
    between = so3.slerp(a, b, fraction)
    assert is_unit(between)
    assert angle_between(a, between) == pytest.approx(fraction * whole, abs=1e-13)
    assert angle_between(between, b) == pytest.approx((1 - fraction) * whole, abs=1e-13)
    assert angle_between(so3.slerp(a, b, 0.0), a) < EXACT
    assert angle_between(so3.slerp(a, b, 1.0), b) < EXACT


@given(rotations, st.floats(-0.02, 0.02), st.floats(0.99, 1.01))
def test_nearest_rotation_corrects_a_rounded_matrix(q, shear, scale):
    R = np.array(so3.matrix_rows(q))
    spoilt = R @ np.array([[scale, shear, 0], [shear, 1, 0], [0, 0, 1]])
    corrected, deviation = so3.nearest_rotation(spoilt)
    # the factor on the right is symmetric and positive, so the polar decomposition gives back R itself
    np.testing.assert_allclose(corrected, R, atol=1e-13)
    assert deviation == pytest.approx(np.abs(spoilt.T @ spoilt - np.eye(3)).max(), abs=1e-12)
