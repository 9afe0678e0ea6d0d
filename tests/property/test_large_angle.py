"""Lever-arm error of an uncertain rotation, against quadrature."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import large_angle_lever_arm, large_angle_lever_arm_batch


def moments(root: Array, arm: Array) -> tuple[Array, Array]:
    """Return E[d d'] and E[d theta'] of the end of an arm that is turned by `root` (3, k) times a standard normal."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60 if root.shape[1] == 1 else 12)
    which = np.array(list(itertools.product(range(len(nodes)), repeat=root.shape[1])))
    theta = nodes[which] @ root.T
    weights = (weights / weights.sum())[which].prod(axis=1)
    d = Rotation.from_rotvec(theta).apply(arm) - arm
    return (d * weights[:, None]).T @ d, (d * weights[:, None]).T @ theta


def compute(root: Array, arm: Array) -> tuple[Array, Array]:
    S = root @ root.T
    M, more = large_angle_lever_arm(S, arm)
    lever = np.cross(np.eye(3), arm).T @ M
    return lever @ S @ lever.T + more, lever @ S


@given(seed=st.integers(0, 1 << 32), degrees=st.floats(0.1, 120.0))
def test_given_a_turn_about_one_axis_then_the_moments_are_exact_however_large(seed: int, degrees: float) -> None:
    rng = np.random.default_rng(seed)
    axis, arm = rng.normal(size=(3, 1)), rng.normal(size=3)
    root = np.radians(degrees) * axis / np.linalg.norm(axis)
    across = arm - axis[:, 0] * (axis[:, 0] @ arm) / (axis[:, 0] @ axis[:, 0])
    for found, expected in zip(compute(root, arm), moments(root, across), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * float(np.abs(expected).max()))


@given(seed=st.integers(0, 1 << 32))
def test_given_turns_about_all_axes_then_the_moments_hold_to_the_order_that_is_left_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, arm = 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3)
    size = float(np.trace(root @ root.T))
    for (found, expected), order in zip(zip(compute(root, arm), moments(root, arm), strict=True), (3, 3), strict=True):
        assert np.abs(found - expected).max() < 2.0 * size**order * float(arm @ arm + 1.0)


@given(seed=st.integers(0, 1 << 32), size=st.floats(1e-6, 3.0))
def test_given_any_turn_then_what_is_added_is_a_covariance(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    root = size * rng.normal(size=(3, 3))
    _, more = large_angle_lever_arm(root @ root.T, rng.normal(size=3))
    np.testing.assert_allclose(more, more.T, rtol=1e-12, atol=1e-15 * np.abs(more).max())
    assert np.linalg.eigvalsh(more).min() >= -1e-9 * np.abs(more).max()


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12])
def test_given_no_turn_then_the_lever_is_whole_and_nothing_is_added(size: float) -> None:
    M, more = large_angle_lever_arm(size * np.eye(3), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(M, np.eye(3), atol=1e-11)
    assert np.abs(more).max() < 1e-20


def test_given_many_then_each_row_is_as_one() -> None:
    rng = np.random.default_rng(1)
    roots, arms = 0.4 * rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3))
    S = roots @ np.swapaxes(roots, 1, 2)
    M, more = large_angle_lever_arm_batch(S, arms)
    for number in range(7):
        one, rest = large_angle_lever_arm(S[number], arms[number])
        np.testing.assert_allclose(M[number], one, rtol=1e-12)
        np.testing.assert_allclose(more[number], rest, rtol=1e-11, atol=1e-15)
