"""Arrays of poses and of chains: row by row equal to the scalar functions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modelserver.transforms import chain, pose_array, so3
from modelserver.transforms.chain import ChainLink, ChainLinkBatch
from modelserver.transforms.pose import Pose
from modelserver.transforms.pose_array import PoseArray
from modelserver.transforms.so3 import left_jacobian

RNG = np.random.default_rng(7)
COUNT = 30
VECTORS = np.vstack(
    (RNG.normal(size=(COUNT - 4, 3)), np.zeros(3), np.full(3, 1e-6), (math.pi, 0.0, 0.0), np.full(3, 1e-9))
)
A = pose_array.exponential(VECTORS)
B = pose_array.exponential(RNG.permutation(VECTORS))
P = RNG.normal(size=(COUNT, 3))


def poses(seed: int, count: int = COUNT) -> PoseArray:
    rng = np.random.default_rng(seed)
    return PoseArray(rng.normal(size=(count, 3)), pose_array.exponential(rng.normal(size=(count, 3))))


def row(some: PoseArray, number: int) -> Pose:
    return Pose(some.p[number if len(some.p) > 1 else 0].tolist(), some.q[number if len(some.q) > 1 else 0].tolist())


@pytest.mark.parametrize("number", range(COUNT))
def test_given_a_row_then_the_rotations_are_those_of_so3(number: int) -> None:
    v, a, b, p = (tuple(each[number].tolist()) for each in (VECTORS, A, B, P))
    assert A[number] == pytest.approx(_align_sign(so3.exponential(v), A[number]), abs=1e-15)
    assert pose_array.multiply(A, B)[number] == pytest.approx(so3.multiply(a, b), abs=1e-15)
    assert pose_array.conjugate(A)[number] == pytest.approx(so3.conjugate(a))
    assert pose_array.rotate(A, P)[number] == pytest.approx(so3.rotate(a, p), abs=1e-14)
    assert np.allclose(pose_array.to_matrices(A)[number], so3.matrix_rows(a), atol=1e-15)
    assert np.allclose(pose_array.skew(P)[number], so3.skew(p))
    assert np.allclose(pose_array.left_jacobian(VECTORS)[number], left_jacobian(v), atol=1e-9)


def _align_sign(q: tuple[float, ...], like: np.ndarray) -> tuple[float, ...]:
    return q if np.dot(q, like) >= 0.0 else tuple(-each for each in q)


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_given_two_rotations_then_each_row_is_the_slerp_and_its_ends_are_the_two(part: float) -> None:
    found = pose_array.slerp(A, B, np.full(COUNT, part))
    for number in range(COUNT):
        a, b = (so3.normalize(tuple(each[number].tolist())) for each in (A, B))
        one = so3.slerp(a, b, part)
        if abs(np.dot(a, b)) > 1e-6:
            assert abs(np.dot(found[number], one)) == pytest.approx(1.0, abs=1e-12)
        if part in (0.0, 1.0):
            assert abs(np.dot(found[number], b if part else a)) == pytest.approx(1.0, abs=1e-14)


def test_given_poses_then_products_and_inverses_are_those_of_pose() -> None:
    one, other = poses(1), poses(2)
    for number in range(COUNT):
        assert row(one @ other, number).is_close(row(one, number) @ row(other, number), 1e-13, 1e-13)
        assert row(one.inverse(), number).is_close(row(one, number).inverse(), 1e-13, 1e-13)
        assert (one @ other).canonical().q[number, 0] >= 0.0


def test_given_one_pose_for_all_rows_then_it_counts_in_each() -> None:
    one, many = PoseArray.of(Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3)), poses(3)
    for found, pick in (
        (one @ many, lambda n: row(one, 0) @ row(many, n)),
        (many @ one, lambda n: row(many, n) @ row(one, 0)),
    ):
        for number in range(COUNT):
            assert row(found, number).is_close(pick(number), 1e-13, 1e-13)


def links() -> list[ChainLinkBatch]:
    """Return a chain of all kinds: one row and many, factors one and many, both ways, sources shared."""
    rng = np.random.default_rng(5)
    return [
        ChainLinkBatch(poses(10), True, rng.normal(size=(COUNT, 6, 6)), ("vehicle",), is_large_angle=True),
        ChainLinkBatch(poses(11, 1), True, rng.normal(size=(6, 6)), ("survey",)),
        ChainLinkBatch(poses(12), False, rng.normal(size=(1, 6, 1)) * rng.normal(size=(COUNT, 1, 1)), ("joint",)),
        ChainLinkBatch(poses(13, 1), True, np.zeros((6, 1)), ("exact",)),
        ChainLinkBatch(poses(14, 1), False, rng.normal(size=(6, 6)), ("survey",)),
        ChainLinkBatch(poses(15), True, rng.normal(size=(COUNT, 6, 3)), ("ball",)),
    ]


def rows(some: list[ChainLinkBatch], number: int) -> list[ChainLink]:
    return [
        ChainLink(
            row(each.X_FT, number),
            each.forward,
            each.factor if each.factor is None or each.factor.ndim == 2 else each.factor[number],
            each.source,
            each.is_large_angle,
        )
        for each in some
    ]


@pytest.mark.parametrize("some", [links(), links()[1:2], links()[3:], links()[::-1], []])
def test_given_chains_then_each_row_is_a_chain(some: list[ChainLinkBatch]) -> None:
    product, covariances = chain.compose_batch(some), chain.covariance_batch(some, COUNT)
    assert covariances is not None
    for number in range(COUNT):
        one = rows(some, number)
        assert row(product, number).is_close(chain.compose(one), 1e-12, 1e-12)
        expected = chain.covariance(one)
        assert expected is not None
        assert np.allclose(covariances[number], expected, rtol=1e-9, atol=1e-12)


def test_given_a_link_that_states_nothing_then_the_covariance_is_unknown() -> None:
    some = [*links(), ChainLinkBatch(poses(1), True, None, ("x",))]
    assert chain.covariance_batch(some, COUNT) is None
    assert chain.covariance(rows(some, 0)) is None


def test_given_no_rows_then_there_are_no_covariances() -> None:
    assert chain.covariance_batch([ChainLinkBatch(poses(1, 0), True, np.eye(6), ("x",))], 0).shape == (0, 6, 6)  # type: ignore[union-attr]


def test_given_out_and_back_by_one_source_then_the_covariance_is_zero() -> None:
    there = ChainLink(Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3), True, np.eye(6), ("survey",))
    found = chain.covariance([there, there._replace(forward=False)])
    assert found is not None
    assert np.abs(found).max() < 1e-14


@pytest.mark.parametrize("rank", [0, 3, 6])
def test_given_a_covariance_of_any_rank_then_its_factor_squares_to_it(rank: int) -> None:
    root = np.random.default_rng(rank).normal(size=(6, rank))
    wanted = root @ root.T
    found = chain.factor(wanted)
    assert np.allclose(found @ found.T, wanted, atol=1e-9)
