"""Arrays of poses and of chains: row by row what the plain functions say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modelserver.geometry.joint import left_jacobian
from modelserver.spatial import arrays, chain, chains, so3
from modelserver.spatial.arrays import Poses
from modelserver.spatial.chain import ChainLink
from modelserver.spatial.chains import Links
from modelserver.spatial.pose import Pose

RNG = np.random.default_rng(7)
COUNT = 30
VECTORS = np.vstack(
    (RNG.normal(size=(COUNT - 4, 3)), np.zeros(3), np.full(3, 1e-6), (math.pi, 0.0, 0.0), np.full(3, 1e-9))
)
A = arrays.exponentials(VECTORS)
B = arrays.exponentials(RNG.permutation(VECTORS))
P = RNG.normal(size=(COUNT, 3))


def poses(seed: int, count: int = COUNT) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(rng.normal(size=(count, 3)), arrays.exponentials(rng.normal(size=(count, 3))))


def row(some: Poses, number: int) -> Pose:
    return Pose(some.p[number if len(some.p) > 1 else 0].tolist(), some.q[number if len(some.q) > 1 else 0].tolist())


@pytest.mark.parametrize("number", range(COUNT))
def test_given_a_row_then_the_rotations_are_those_of_so3(number: int) -> None:
    v, a, b, p = (tuple(each[number].tolist()) for each in (VECTORS, A, B, P))
    assert A[number] == pytest.approx(_signed(so3.exponential(v), A[number]), abs=1e-15)
    assert arrays.multiplied(A, B)[number] == pytest.approx(so3.multiply(a, b), abs=1e-15)
    assert arrays.conjugated(A)[number] == pytest.approx(so3.conjugate(a))
    assert arrays.rotated(A, P)[number] == pytest.approx(so3.rotate(a, p), abs=1e-14)
    assert np.allclose(arrays.matrices(A)[number], so3.matrix_rows(a), atol=1e-15)
    assert np.allclose(arrays.skews(P)[number], so3.skew(p))
    assert np.allclose(arrays.left_jacobians(VECTORS)[number], left_jacobian(v), atol=1e-9)


def _signed(q: tuple[float, ...], like: np.ndarray) -> tuple[float, ...]:
    return q if np.dot(q, like) >= 0.0 else tuple(-each for each in q)


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_given_two_rotations_then_each_row_is_the_slerp_and_its_ends_are_the_two(part: float) -> None:
    found = arrays.slerped(A, B, np.full(COUNT, part))
    for number in range(COUNT):
        a, b = (so3.normalized(tuple(each[number].tolist())) for each in (A, B))
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
    one, many = Poses.of(Pose.from_rpy((1, 2, 3), 0.1, 0.2, 0.3)), poses(3)
    for found, pick in (
        (one @ many, lambda n: row(one, 0) @ row(many, n)),
        (many @ one, lambda n: row(many, n) @ row(one, 0)),
    ):
        for number in range(COUNT):
            assert row(found, number).is_close(pick(number), 1e-13, 1e-13)


def links() -> list[Links]:
    """Return a chain of all kinds: one row and many, factors one and many, both ways, sources shared."""
    rng = np.random.default_rng(5)
    return [
        Links(poses(10), True, rng.normal(size=(COUNT, 6, 6)), ("vehicle",), bends=True),
        Links(poses(11, 1), True, rng.normal(size=(6, 6)), ("survey",)),
        Links(poses(12), False, rng.normal(size=(1, 6, 1)) * rng.normal(size=(COUNT, 1, 1)), ("joint",)),
        Links(poses(13, 1), True, np.zeros((6, 1)), ("exact",)),
        Links(poses(14, 1), False, rng.normal(size=(6, 6)), ("survey",)),
        Links(poses(15), True, rng.normal(size=(COUNT, 6, 3)), ("ball",)),
    ]


def rows(some: list[Links], number: int) -> list[ChainLink]:
    return [
        ChainLink(
            row(each.X_FT, number),
            each.forward,
            each.factor if each.factor is None or each.factor.ndim == 2 else each.factor[number],
            each.source,
            each.bends,
        )
        for each in some
    ]


@pytest.mark.parametrize("some", [links(), links()[1:2], links()[3:], links()[::-1], []])
def test_given_chains_then_each_row_is_a_chain(some: list[Links]) -> None:
    product, covariances = chains.product(some), chains.covariances(some, COUNT)
    assert covariances is not None
    for number in range(COUNT):
        one = rows(some, number)
        assert row(product, number).is_close(chain.product(one), 1e-12, 1e-12)
        expected = chain.covariance(one)
        assert expected is not None
        assert np.allclose(covariances[number], expected, rtol=1e-9, atol=1e-12)


def test_given_a_link_that_states_nothing_then_the_covariance_is_unknown() -> None:
    some = [*links(), Links(poses(1), True, None, ("x",))]
    assert chains.covariances(some, COUNT) is None
    assert chain.covariance(rows(some, 0)) is None


def test_given_no_rows_then_there_are_no_covariances() -> None:
    assert chains.covariances([Links(poses(1, 0), True, np.eye(6), ("x",))], 0).shape == (0, 6, 6)  # type: ignore[union-attr]


def test_given_out_and_back_by_one_source_then_nothing_is_unsure() -> None:
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
