"""Covariance transport against Monte Carlo: the convention is X = (p + dp, exp(dtheta) R), fixed axes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modelserver.transforms import Pose, Transformation
from modelserver.transforms.transformation import (
    compose_covariance,
    find_covariance_problem,
    invert_covariance,
    make_covariance,
    rotate_covariance,
)

SAMPLES = 40_000
SMALL = 1e-4
"""Perturbations so small that second order, about SMALL * SMALL, is lost in the noise of the samples."""

PLACES = {
    "ordinary": (Pose.from_rpy((1.0, -2.0, 0.5), 0.3, -0.4, 2.0), Pose.from_rpy((-0.7, 3.0, 1.1), -1.0, 0.2, 0.6)),
    "half turns": (Pose((2.0, 0.0, 1.0), (0, 0, 0, 1)), Pose((0.5, 4.0, 0.0), (0, 1, 0, 0))),
    "no rotation": (Pose((5.0, 1.0, 0.0)), Pose((0.0, 7.0, -1.0))),
    "gimbal lock": (Pose.from_rpy((0.2, 0.1, 3.0), 0.5, np.pi / 2, 0.1), Pose.from_rpy((1, 1, 1), 0, -np.pi / 2, 0)),
}


def some_covariance(seed):
    square = np.random.default_rng(seed).normal(size=(6, 6))
    return SMALL**2 * (square @ square.T + 0.1 * np.eye(6))


def samples_of(pose, cov, seed):
    """Return positions (n, 3) and rotations of `pose` perturbed by `cov`."""
    d = np.random.default_rng(seed).multivariate_normal(np.zeros(6), cov, SAMPLES, method="cholesky")
    return np.array(pose.xyz) + d[:, :3], Rotation.from_rotvec(d[:, 3:]) * Rotation.from_matrix(pose.rotation)


def covariance_of(mean, positions, rotations):
    """Return the covariance of samples about `mean`, in the convention."""
    turned = (rotations * Rotation.from_matrix(mean.rotation).inv()).as_rotvec()
    d = np.hstack([positions - np.array(mean.xyz), turned])
    return d.T @ d / len(d)


def assert_alike(found, sampled):
    """Compare as correlations: the standard error of each sampled entry is at most sqrt(2 / n) of its scale."""
    scale = np.sqrt(np.diag(found))
    np.testing.assert_allclose(
        sampled / np.outer(scale, scale), found / np.outer(scale, scale), atol=5 * (2 / SAMPLES) ** 0.5
    )
    np.testing.assert_array_equal(found, found.T)
    assert np.linalg.eigvalsh(found).min() > -1e-20


@pytest.mark.slow
@pytest.mark.parametrize("where", PLACES)
def test_compose_agrees_with_monte_carlo(where):
    X_AB, X_BC = PLACES[where]
    cov_AB, cov_BC = some_covariance(1), some_covariance(2)
    p_AB, R_AB = samples_of(X_AB, cov_AB, 3)
    p_BC, R_BC = samples_of(X_BC, cov_BC, 4)
    sampled = covariance_of(X_AB @ X_BC, p_AB + R_AB.apply(p_BC), R_AB * R_BC)
    assert_alike(compose_covariance(X_AB, cov_AB, X_BC, cov_BC), sampled)


@pytest.mark.parametrize("where", PLACES)
def test_invert_agrees_with_monte_carlo(where):
    X_AB, _ = PLACES[where]
    cov_AB = some_covariance(5)
    p, R = samples_of(X_AB, cov_AB, 6)
    sampled = covariance_of(X_AB.inverse(), -R.inv().apply(p), R.inv())
    assert_alike(invert_covariance(X_AB, cov_AB), sampled)


@pytest.mark.parametrize("where", PLACES)
def test_laws_that_hold_exactly(where):
    X_AB, X_BC = PLACES[where]
    cov_AB, cov_BC = some_covariance(7), some_covariance(8)
    tight = {"rtol": 1e-9, "atol": 1e-18}
    twice = invert_covariance(X_AB.inverse(), invert_covariance(X_AB, cov_AB))
    np.testing.assert_allclose(twice, cov_AB, **tight)
    # the inverse of a chain is the chain of the inverses
    forward = invert_covariance(X_AB @ X_BC, compose_covariance(X_AB, cov_AB, X_BC, cov_BC))
    backward = compose_covariance(
        X_BC.inverse(), invert_covariance(X_BC, cov_BC), X_AB.inverse(), invert_covariance(X_AB, cov_AB)
    )
    np.testing.assert_allclose(forward, backward, **tight)
    # a chain of three may be taken in either order
    X_CD, cov_CD = Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3), some_covariance(9)
    left = compose_covariance(X_AB @ X_BC, compose_covariance(X_AB, cov_AB, X_BC, cov_BC), X_CD, cov_CD)
    right = compose_covariance(X_AB, cov_AB, X_BC @ X_CD, compose_covariance(X_BC, cov_BC, X_CD, cov_CD))
    np.testing.assert_allclose(left, right, **tight)
    # an exact right side adds nothing but the lever arm
    np.testing.assert_allclose(compose_covariance(X_AB, cov_AB, Pose.identity(), np.zeros((6, 6))), cov_AB, **tight)
    # turning the axes is what an exact rotation on the left does
    turn = Pose((0, 0, 0), X_AB.wxyz)
    np.testing.assert_allclose(
        rotate_covariance(turn.rotation, cov_BC), compose_covariance(turn, np.zeros((6, 6)), X_BC, cov_BC), **tight
    )


def test_a_lever_arm_turns_a_heading_error_into_a_sideways_error():
    heading = make_covariance((0.0, 0.0, 0.0), (0.0, 0.0, 0.01))
    found = compose_covariance(Pose.identity(), heading, Pose((10.0, 0.0, 0.0)), np.zeros((6, 6)))
    assert np.sqrt(np.diag(found)) == pytest.approx([0, 0.1, 0, 0, 0, 0.01])
    assert found[1, 5] == pytest.approx(0.1 * 0.01)


def test_transformations_carry_it_along():
    X_AB, X_BC = PLACES["ordinary"]
    cov_AB, cov_BC = some_covariance(1), some_covariance(2)
    ab, bc = Transformation("b:b", "a:a", X_AB, cov_AB), Transformation("c:c", "b:b", X_BC, cov_BC)
    np.testing.assert_allclose((ab @ bc).covariance, compose_covariance(X_AB, cov_AB, X_BC, cov_BC))
    np.testing.assert_allclose(ab.inverse().covariance, invert_covariance(X_AB, cov_AB))
    assert (ab @ Transformation("c:c", "b:b", X_BC)).covariance is None
    assert Transformation("c:c", "b:b", X_BC).inverse().covariance is None


def test_given_matrices_that_are_no_covariance_then_it_reports_why():
    good = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.0])
    assert find_covariance_problem(good) == ""
    for row, column, value, message in (
        (0, 0, np.nan, "not finite"),
        (1, 2, np.inf, "not finite"),
        (0, 1, 0.5, "not symmetric"),
        (5, 5, -0.1, "negative"),
    ):
        bad = good.copy()
        bad[row, column] = value
        assert message in find_covariance_problem(bad)
