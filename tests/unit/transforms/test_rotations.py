"""The edges of the rotation formulas, with the numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modelserver.transforms import so3

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (NAN, 0, 0, 1), (1, INF, 0, 0), (-INF, INF, NAN, 0)])
def test_a_quaternion_that_is_no_direction_is_rejected(q):
    with pytest.raises(ValueError, match="finite and not zero"):
        so3.normalize(q)


@pytest.mark.parametrize("size", [5e-324, 1e-200, 1e-150, 1e-8, 1e8, 1e200, 1.7e308])
def test_tiny_and_huge_quaternions_are_normalized(size):
    assert so3.normalize((size, 0.0, 0.0, 0.0)) == so3.IDENTITY
    assert so3.normalize((0.0, 0.0, -size, 0.0)) == (0.0, 0.0, 1.0, 0.0)
    assert so3.normalize((size, size, size, size)) == pytest.approx((0.5, 0.5, 0.5, 0.5), abs=1e-15)


def test_negative_w_is_turned_and_half_turns_have_one_sign():
    assert so3.normalize((-0.5, 0.5, 0.5, 0.5)) == (0.5, -0.5, -0.5, -0.5)
    assert so3.normalize((0.0, -1.0, 0.0, 0.0)) == (0.0, 1.0, 0.0, 0.0)
    assert so3.normalize((-0.0, 0.0, 0.0, -2.0)) == (0.0, 0.0, 0.0, 1.0)
    assert math.copysign(1, so3.normalize((-1.0, 0.0, 0.0, 0.0))[1]) == 1


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize(("roll", "yaw"), [(0, 0), (0, 1.0), (0.4, 1.0), (-2.0, 3.0), (3.0, -3.0), (math.pi, math.pi)])
def test_at_gimbal_lock_roll_is_zero_and_yaw_carries_both(pitch, roll, yaw):
    found = so3.to_rpy(so3.from_rpy(roll, pitch, yaw))
    assert found[0] == 0
    assert found[1] == pytest.approx(pitch, abs=1e-15)
    # at +90 deg the two turn against each other, at -90 deg together
    expected = yaw - roll if pitch > 0 else yaw + roll
    assert math.remainder(found[2] - expected, math.tau) == pytest.approx(0, abs=1e-14)


def test_plain_yaw_has_no_roll_or_pitch_at_all():
    for yaw in (0.1, 1.0, 3.0, -2.5):
        roll, pitch, found = so3.to_rpy(so3.from_rpy(0, 0, yaw))
        assert (roll, pitch) == (0, 0)
        assert found == pytest.approx(yaw, abs=1e-15)


@pytest.mark.parametrize("shift", [1e-15, 1e-13, 1e-11, 1e-9, 1e-7])
def test_rpy_is_precise_right_up_to_the_lock(shift):
    given = (0.7, math.pi / 2 - shift, -0.3)
    back = so3.from_rpy(*so3.to_rpy(so3.from_rpy(*given)))
    np.testing.assert_allclose(back, so3.from_rpy(*given), atol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_matrices_of_half_turns_come_back(axis):
    R = 2 * np.outer(axis, axis) - np.eye(3)
    assert so3.from_matrix(R) == (0.0, *axis)
    assert so3.logarithm(so3.from_matrix(R)) == pytest.approx(tuple(math.pi * value for value in axis))


def test_rotation_is_by_the_right_hand():
    quarter = so3.from_rpy(0, 0, math.pi / 2)
    assert so3.rotate(quarter, (1.0, 0.0, 0.0)) == pytest.approx((0, 1, 0))
    nose_down = so3.from_rpy(0, math.pi / 2, 0)
    assert so3.rotate(nose_down, (1.0, 0.0, 0.0)) == pytest.approx((0, 0, -1))
    right_down = so3.from_rpy(math.pi / 2, 0, 0)
    assert so3.rotate(right_down, (0.0, 1.0, 0.0)) == pytest.approx((0, 0, 1))


@pytest.mark.parametrize("v", [(NAN, 0, 0), (INF, 0, 0), (1e200, 1e200, 0)])
def test_a_rotation_vector_must_be_finite(v):
    with pytest.raises(ValueError, match="rotation vector must be finite"):
        so3.exponential(v)


def test_nearest_rotation_takes_the_rounded_rows_of_a_2005_file():
    M = [[0.978, 0.0, 0.208], [0.0, 1.0, 0.0], [-0.208, 0.0, 0.978]]
    R, deviation = so3.nearest_rotation(M)
    assert deviation == pytest.approx(abs(0.978**2 + 0.208**2 - 1))
    assert deviation < 1e-3
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert math.atan2(R[0, 2], R[0, 0]) == pytest.approx(math.atan2(0.208, 0.978))


@pytest.mark.parametrize(
    ("M", "why"),
    [
        (np.zeros((3, 3)), "singular"),
        (np.diag([1.0, 1.0, 0.0]), "singular"),
        (np.diag([1.0, 1.0, -1.0]), "reflection"),
        (-np.eye(3), "reflection"),
        (np.eye(2), "3 rows of 3"),
        (np.eye(4), "3 rows of 3"),
        (np.full((3, 3), NAN), "3 rows of 3"),
        (np.diag([1.0, INF, 1.0]), "3 rows of 3"),
        # the squares overflow to inf and their differences to nan, which passes no comparison
        (1e200 * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]]), "too large"),
    ],
)
def test_a_matrix_that_means_no_rotation_is_rejected(M, why):
    with pytest.raises(ValueError, match=why):
        so3.nearest_rotation(M)


def test_skew_is_the_cross_product():
    v, u = (1.0, -2.0, 3.0), (0.5, 4.0, -1.0)
    np.testing.assert_allclose(so3.skew(v) @ u, np.cross(v, u))


@pytest.mark.parametrize("v", [(0.0, 0.0, 0.0), (1e-9, -0.0, 2e-3), (0.05, -0.11, 0.02), (0.5, -1.0, 2.0)])
def test_given_a_rotation_vector_then_turn_has_the_bits_of_the_product_with_its_exponential(v):
    q = so3.normalize((0.3, -0.5, 0.7, 0.2))
    assert repr(so3.turn(q, v)) == repr(so3.multiply(q, so3.small_angle_exponential(v)))


@pytest.mark.parametrize("v", [(0.0, 0.0, 1.0), (-0.0, 3.0, -0.0), (1e-9, -7.0, 2e3), (-0.0, -0.0, -0.0)])
@pytest.mark.parametrize("q", [so3.IDENTITY, (0.5, 0.5, -0.5, 0.5), so3.normalize((0.3, -0.5, 0.7, 0.2))])
def test_given_a_vector_then_rotate_back_has_the_bits_of_the_rotation_by_the_conjugate(q, v):
    assert repr(so3.rotate_back(q, v)) == repr(so3.rotate(so3.conjugate(q), v))
