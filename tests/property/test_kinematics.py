"""Motions chain and turn round as the poses that they change; Jacobians are what differencing gives."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support_spatial import poses

from modelserver.transforms import chain, so3
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.pose import Pose, RigidMotion

vectors = st.tuples(*[st.floats(-3, 3)] * 3)
motions = st.builds(RigidMotion, poses, vectors, vectors, vectors, vectors)
H = 1e-4


def at(motion: RigidMotion, t: float) -> Pose:
    """Return the pose after a short time, right up to the second order."""
    p, v, a = (np.array(each) for each in (motion.pose.xyz, motion.velocity, motion.acceleration))
    w, b = np.array(motion.angular_velocity), np.array(motion.angular_acceleration)
    x, y, z = (w * t + b * t * t / 2).tolist()
    return Pose((p + v * t + a * t * t / 2).tolist(), so3.multiply(so3.exponential((x, y, z)), motion.pose.wxyz))


def check(found: RigidMotion, before: Pose, here: Pose, after: Pose) -> None:
    def rotation_between(a: Pose, b: Pose) -> np.ndarray:
        return np.array(so3.logarithm(so3.normalize(so3.multiply(b.wxyz, so3.conjugate(a.wxyz)))))

    size = 1.0 + 10.0 * max(1.0, np.linalg.norm(here.position))
    assert found.pose.is_close(here, 1e-12, 1e-12)
    assert np.allclose(found.velocity, (after.position - before.position) / (2 * H), atol=1e-4 * size)
    assert np.allclose(found.angular_velocity, rotation_between(before, after) / (2 * H), atol=1e-4)
    bent = (after.position - 2 * here.position + before.position) / H**2
    assert np.allclose(found.acceleration, bent, atol=1e-3 * size)
    assert np.allclose(
        found.angular_acceleration,
        (rotation_between(here, after) - rotation_between(before, here)) / H**2,
        atol=1e-3 * size,
    )


@given(motions, motions)
def test_given_two_motions_then_their_chain_is_what_differencing_the_product_gives(one, other) -> None:
    check(one.compose(other), *(at(one, t) @ at(other, t) for t in (-H, 0.0, H)))


@given(motions)
def test_given_a_motion_then_its_inverse_is_what_differencing_the_inverse_gives(motion) -> None:
    check(motion.inverse(), *(at(motion, t).inverse() for t in (-H, 0.0, H)))


@given(motions)
def test_given_a_motion_and_its_inverse_then_together_they_are_at_rest(motion) -> None:
    for whole in (motion.compose(motion.inverse()), motion.inverse().compose(motion)):
        assert whole.pose.is_close(Pose.identity(), 1e-12, 1e-12)
        assert np.abs(whole[1:]).max() < 1e-11 * (1.0 + np.abs(motion[1:]).max()) ** 3 * (
            1.0 + np.abs(motion.pose.xyz).max()
        )


@given(motions, motions, motions)
def test_given_three_motions_then_how_they_are_bracketed_does_not_matter(a, b, c) -> None:
    left, right = a.compose(b).compose(c), a.compose(b.compose(c))
    assert np.allclose(left[1:], right[1:], rtol=1e-9, atol=1e-8)


@given(st.lists(st.tuples(poses, st.booleans()), min_size=1, max_size=5), st.integers(0, 4), st.integers(0, 5))
def test_given_a_chain_then_each_links_jacobian_is_what_differencing_gives(some, which, column) -> None:
    which %= len(some)

    def move(size: float) -> Pose:
        links = []
        for number, (X, forward) in enumerate(some):
            off = np.zeros(6)
            off[column] = size if number == which else 0.0
            turn = so3.multiply(so3.exponential(tuple(off[3:].tolist())), X.wxyz)
            links.append(ChainLink(Pose((X.position + off[:3]).tolist(), turn), forward, None, (number,)))
        return chain.compose(links)

    step = 1e-5
    ahead, behind = move(step), move(-step)
    rotation_between = so3.logarithm(so3.normalize(so3.multiply(ahead.wxyz, so3.conjugate(behind.wxyz))))
    expected = np.concatenate((ahead.position - behind.position, rotation_between)) / (2 * step)
    factor = np.zeros((6, 1))
    factor[column] = 1.0
    links = [
        ChainLink(X, forward, factor if n == which else np.zeros((6, 1)), (n,)) for n, (X, forward) in enumerate(some)
    ]
    shares = chain.contributions(links)
    assert shares is not None
    assert np.allclose(shares[(which,)][:, 0], expected, atol=1e-5 * (1.0 + np.abs(expected).max()))
