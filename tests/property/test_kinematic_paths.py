"""Kinematic paths and chains at random joint positions, against products and numerical differences."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support_formats import all_frames, models
from support_joints import positions_of
from support_spatial import rotations

from modelserver.geometry import Joint, JointType, Mimic, ModelBuilder, Sigma
from modelserver.transforms import Pose, chain
from modelserver.transforms.chain import ChainLink
from modelserver.transforms.transformation import compose_covariance, invert_covariance


def product_of(route, positions):
    """Return the 4x4 product of a route's edges, by numpy alone."""
    product, rest = np.eye(4), iter(positions)
    for edge in route.edges:
        X = edge.pose.matrix if edge.joint is None else edge.joint.compute_pose(next(rest)).matrix
        product = product @ (X if edge.forward else np.linalg.inv(X))
    return product


@pytest.mark.slow
@given(models(), st.data())
@settings(max_examples=30)
def test_given_joints_anywhere_then_a_routes_pose_is_the_product_of_its_edges(model, data):
    frames = all_frames(model)
    pair = data.draw(st.tuples(st.sampled_from(frames), st.sampled_from(frames)))
    route = model.get_kinematic_path(*pair)
    positions = tuple(data.draw(positions_of(leg.joint)) for leg in route.joints)
    np.testing.assert_allclose(route.compute_pose(positions).matrix, product_of(route, positions), atol=1e-11)
    np.testing.assert_allclose(
        chain.compose(route.build_links(positions, positions)).matrix, product_of(route, positions), atol=1e-11
    )
    at_rest = model.get_transformation(*pair).matrix
    np.testing.assert_allclose(route.compute_pose(route.default_positions).matrix, at_rest, atol=1e-11)
    # the reverse path has the same joints in reverse order
    back = model.get_kinematic_path(*reversed(pair))
    assert [leg.name for leg in back.joints] == [leg.name for leg in reversed(route.joints)]
    assert back.compute_pose(positions[::-1]).is_close(route.compute_pose(positions).inverse(), 1e-10, 1e-10)


# --- chains -----------------------------------------------------------------------------------------------

near = st.tuples(*[st.floats(-3, 3)] * 3)
poses = st.builds(Pose, near, rotations)
factors = st.lists(st.floats(-1e-3, 1e-3), min_size=36, max_size=36).map(lambda flat: np.array(flat).reshape(6, 6))
links = st.builds(ChainLink, poses, st.booleans(), factors, st.integers(), st.just(False))
chains = st.lists(links, min_size=1, max_size=6, unique_by=lambda link: link.source)


def perturb(link, by):
    """Return the link with its pose moved by `factor @ by` along the axes of its first frame."""
    d = link.factor @ by
    q = (Rotation.from_rotvec(d[3:]) * Rotation.from_matrix(link.X_FT.rotation)).as_quat()
    return link._replace(X_FT=Pose(np.array(link.X_FT.xyz) + d[:3], (q[3], *q[:3])))


def apart(X, Y):
    turn = Rotation.from_matrix(Y.rotation) * Rotation.from_matrix(X.rotation).inv()
    return np.concatenate((Y.position - X.position, turn.as_rotvec()))


@given(chains)
def test_given_a_chain_then_its_covariance_is_that_of_composing_and_inverting_step_by_step(some):
    X, cov = Pose.identity(), np.zeros((6, 6))
    for link in some:
        Y, more = link.X_FT, link.factor @ link.factor.T
        if not link.forward:
            Y, more = Y.inverse(), invert_covariance(Y, more)
        X, cov = X @ Y, compose_covariance(X, cov, Y, more)
    np.testing.assert_allclose(chain.covariance(some), cov, rtol=1e-9, atol=1e-15)
    assert chain.compose(some).is_close(X, 1e-12, 1e-12)


@pytest.mark.slow
@given(st.lists(links, min_size=1, max_size=6))
def test_given_links_that_share_a_source_then_each_sources_share_is_what_moving_it_does(some):
    some = [link._replace(source=number % 3) for number, link in enumerate(some)]
    shares = chain.contributions(some)
    X, step = chain.compose(some), 1e-3
    for source, share in shares.items():
        for column in range(6):
            unit = np.eye(6)[column] * step
            ends = [
                chain.compose([perturb(each, sign * unit) if each.source == source else each for each in some])
                for sign in (-1, 1)
            ]
            numerical = (apart(X, ends[1]) - apart(X, ends[0])) / (2 * step)
            np.testing.assert_allclose(share[:, column], numerical, atol=1e-8)


@given(chains)
def test_given_a_chain_and_back_again_then_what_is_shared_cancels(some):
    there_and_back = [*some, *(link._replace(forward=not link.forward) for link in reversed(some))]
    np.testing.assert_allclose(chain.covariance(there_and_back), np.zeros((6, 6)), atol=1e-12)


def test_given_no_links_or_one_that_states_nothing_then_it_is_certain_or_unknown():
    assert np.array_equal(chain.covariance([]), np.zeros((6, 6)))
    assert chain.covariance([ChainLink(Pose(), True, None, 0)]) is None


@pytest.mark.parametrize("rank", range(7))
def test_given_a_covariance_of_any_rank_then_its_factor_squares_to_it(rank):
    root = np.random.default_rng(rank).normal(size=(6, rank))
    found = chain.factor(root @ root.T)
    np.testing.assert_allclose(found @ found.T, root @ root.T, atol=1e-7)


# --- joints in chains -------------------------------------------------------------------------------------


@pytest.mark.slow
@given(models(), st.data())
@settings(max_examples=25)
def test_given_joints_that_err_then_a_routes_covariance_is_what_moving_each_does(model, data):
    frames = all_frames(model)
    pair = max(itertools.product(frames[:4], frames), key=lambda pair: len(model.get_kinematic_path(*pair).edges))
    route = model.get_kinematic_path(*pair)
    positions = [data.draw(positions_of(leg.joint, 1.5)) for leg in route.joints]
    exact = [edge if edge.joint is not None else edge._replace(sigma=Sigma()) for edge in route.edges]
    route = type(route).from_edges([edge._replace(leader="") for edge in exact])
    X, wanted, step = route.compute_pose(positions), np.zeros((6, 6)), 1e-5
    for number, leg in enumerate(route.joints):
        for coordinate in range(leg.joint.count):
            ends = []
            for sign in (-1, 1):
                moved = [list(each) for each in positions]
                moved[number][coordinate] += sign * step
                ends.append(route.compute_pose(moved))
            column = (apart(X, ends[1]) - apart(X, ends[0])) / (2 * step)
            wanted += np.outer(column, column) * 0.01**2
    found = chain.covariance(route.build_links(positions, [(0.01,) * leg.joint.count for leg in route.joints]))
    np.testing.assert_allclose(found, wanted, atol=1e-6 * max(1.0, np.abs(wanted).max()))


def test_given_a_joint_that_turns_back_what_its_leader_turns_then_their_errors_cancel():
    """A table on an arm that follows by -1: it keeps its heading, and the uncertainty of the arm does not rotate it."""
    builder = ModelBuilder()
    builder.add_body("Base").add_frame("O")
    builder.add_body("Arm").add_frame("O").add_frame("End", Pose((2, 0, 0)), sigma=Sigma())
    builder.add_body("Table").add_frame("O")
    up = (0.0, 0.0, 1.0)
    builder.add_constraint("Arm", "Base:O", "Arm:O", joint=Joint(JointType.REVOLUTE, up, sigma=(0.01,)))
    builder.add_constraint("Level", "Arm:End", "Table:O", joint=Joint(JointType.REVOLUTE, up, mimic=Mimic("Arm", -1.0)))
    cov = builder.build().get_transformation("Table:O", "Base:O").covariance
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), (0, 0.02, 0, 0, 0, 0), atol=1e-12)
